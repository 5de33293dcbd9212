"""Figures as people read them."""

from __future__ import annotations

import datetime
import math
from typing import TYPE_CHECKING

from crossloc3d_ros import __version__

if TYPE_CHECKING:
    from crossloc3d_ros.evaluation.statistics import Share

UNKNOWN = "–"


def percent(share: float, digits: int | None = None, unit: str = " %") -> str:
    """Return a share as per cent, with as many decimals.

    By default with one where it is small, or so near to 1 that rounding would hide it.
    """
    if not math.isfinite(share):
        return UNKNOWN
    value = 100 * share
    if digits is not None:
        return f"{value:.{digits}f}{unit}"
    if 0 < value < 0.1:
        return f"{value:.2f}{unit}"
    if value in (0, 100) or 10 <= value < 99.5:
        return f"{value:.0f}{unit}"
    return f"{min(value, 99.9):.1f}{unit}" if value > 10 else f"{value:.1f}{unit}"


def fine_percent(share: float) -> str:
    """Return a share as per cent with one decimal, near to 1 with two."""
    if share in (0.0, 1.0):
        return percent(share)
    return percent(share, 1) if not share >= 0.9995 else percent(min(share, 0.9999), 2)


def percent_range(low: float, high: float) -> str:
    """Return a range of shares as per cent."""
    if low <= 0.0:
        return f"< {100 * high:g} %"
    return f"≥ {100 * low:g} %" if high >= 1.0 else f"{100 * low:g}–{100 * high:g} %"


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


def number(value: float, digits: int = 0) -> str:
    """Return a number with as many decimals and commas between thousands."""
    return f"{value:,.{digits}f}"


def count(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural where that is right."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def rounded(value: float, digits: int) -> float | None:
    """Return a number for JSON; None where it is not known."""
    return round(float(value), digits) if math.isfinite(value) else None


def finite(value: float) -> float:
    """Return the number, or 0 where it is not known."""
    return value if math.isfinite(value) else 0.0


def written_by() -> str:
    """Return the sentence that says which version wrote a page, and on which day."""
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    return f"Written by crossloc3d_ros {__version__} on {today}."
