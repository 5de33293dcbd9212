"""Figures as people read them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crossloc3d_ros.evaluation.recall import Share

UNKNOWN = "–"


def percent(share: float) -> str:
    """Return a share as per cent, with one decimal where it is small, or so near to 1 that rounding would hide it."""
    if not math.isfinite(share):
        return UNKNOWN
    value = 100 * share
    if 0 < value < 0.1:
        return f"{value:.2f} %"
    if value in (0, 100) or 10 <= value < 99.5:
        return f"{value:.0f} %"
    return f"{min(value, 99.9):.1f} %" if value > 10 else f"{value:.1f} %"


def metres(value: float) -> str:
    """Return a distance, in decimetres or centimetres where it is short."""
    if not math.isfinite(value):
        return UNKNOWN
    if value >= 1000:
        return f"{value / 1000:.1f} km"
    return f"{value:.0f} m" if value >= 9.95 else f"{value:.1f} m" if value >= 0.995 else f"{value:.2f} m"


def degrees(value: float) -> str:
    """Return an angle."""
    if not math.isfinite(value):
        return UNKNOWN
    return f"{value:.0f}°" if value >= 9.95 else f"{value:.1f}°" if value >= 0.995 else f"{value:.2f}°"


def interval(share: Share) -> str:
    """Return the interval of a share."""
    return f"{100 * share.low:.0f} to {100 * share.high:.0f} %"


def count(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural where that is right."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def rounded(value: float, digits: int) -> float | None:
    """Return a number for JSON; None where it is not known."""
    return round(float(value), digits) if math.isfinite(value) else None


def finite(value: float) -> float:
    """Return the number, or 0 where it is not known."""
    return value if math.isfinite(value) else 0.0
