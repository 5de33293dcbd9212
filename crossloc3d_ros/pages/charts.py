"""Small charts as SVG text: drawn here, coloured by the page's style sheet, so that they follow its light or dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from markupsafe import Markup

from crossloc3d_ros.types import Float64Array

_LEFT, _RIGHT, _TOP, _BOTTOM = 66.0, 14.0, 14.0, 44.0


@dataclass(frozen=True)
class Axis:
    """From values to pixels of one axis."""

    low: float
    high: float
    label: str
    ticks: Sequence[tuple[float, str]]
    log: bool = False

    def share(self, value: float) -> float:
        """Return where a value lies between low (0) and high (1), clipped."""
        if self.log:
            value = max(value, self.low)
            place = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            place = (value - self.low) / (self.high - self.low)
        return min(1.0, max(0.0, place))


@dataclass(frozen=True)
class Chart:
    """A frame with axes into which marks are drawn."""

    x: Axis
    y: Axis
    title: str
    """What screen readers say."""
    width: float = 570.0
    """Pixels, as wide as the page shows it, so that its letters are as large as the page's."""
    height: float = 280.0
    foot: float = _BOTTOM
    """Pixels below the x axis, for its numbers and its name."""

    def x_px(self, value: float) -> float:
        """Return the pixel of a value along x."""
        return _LEFT + self.x.share(value) * (self.width - _LEFT - _RIGHT)

    def y_px(self, value: float) -> float:
        """Return the pixel of a value along y."""
        return self.height - self.foot - self.y.share(value) * (self.height - _TOP - self.foot)

    def render(self, marks: Sequence[str], identity: str = "", css: str = "") -> Markup:
        """Return the chart as an SVG element with `marks` inside its axes, and classes `css` besides `chart`.

        `marks` are what the other methods return. All text in it is escaped here, so that pages take it as it is.
        """
        bottom, right = self.height - self.foot, self.width - _RIGHT
        classes = escape(f"chart {css}".rstrip())
        parts = [
            f'<svg class="{classes}" id="{escape(identity)}" viewBox="0 0 {self.width:g} {self.height:g}" role="img" '
            f'aria-label="{escape(self.title)}" data-left="{_LEFT:g}" data-right="{right:g}" '
            f'data-top="{_TOP:g}" data-bottom="{bottom:g}">'
        ]
        for value, text in self.y.ticks:
            y = self.y_px(value)
            parts.append(f'<line class="grid" x1="{_LEFT:g}" x2="{right:g}" y1="{y:.1f}" y2="{y:.1f}"/>')
            parts.append(
                f'<text class="tick" x="{_LEFT - 7:g}" y="{y + 4:.1f}" text-anchor="end">{escape(text)}</text>'
            )
        for value, text in self.x.ticks:
            x = self.x_px(value)
            parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP:g}" y2="{bottom:g}"/>')
            at, anchor = (right + _RIGHT - 2, "end") if x > right - 6 and len(text) > 3 else (x, "middle")
            parts.append(
                f'<text class="tick" x="{at:.1f}" y="{bottom + 17:g}" text-anchor="{anchor}">{escape(text)}</text>'
            )
        parts.append(f'<line class="axis" x1="{_LEFT:g}" x2="{right:g}" y1="{bottom:g}" y2="{bottom:g}"/>')
        if self.x.label:
            parts.append(
                f'<text class="label" x="{(_LEFT + right) / 2:g}" y="{self.height - 7:g}" text-anchor="middle">'
                f"{escape(self.x.label)}</text>"
            )
        if self.y.label:
            middle = (_TOP + bottom) / 2
            parts.append(
                f'<text class="label" x="14" y="{middle:g}" text-anchor="middle" transform="rotate(-90 14 {middle:g})">'
                f"{escape(self.y.label)}</text>"
            )
        return Markup("".join([*parts, *marks, "</svg>"]))

    def line(self, xs: Float64Array, ys: Float64Array, css: str) -> str:
        """Draw a line through points, broken where one is not finite."""
        commands, pen_down = [], False
        for x, y in zip(xs, ys, strict=True):
            if not (math.isfinite(x) and math.isfinite(y)):
                pen_down = False
                continue
            commands.append(f"{'L' if pen_down else 'M'}{self.x_px(x):.1f} {self.y_px(y):.1f}")
            pen_down = True
        return f'<path class="line {css}" d="{"".join(commands)}"/>' if commands else ""

    def dots(self, xs: Float64Array, ys: Float64Array, css: Sequence[str], radius: float) -> str:
        """Draw a dot at every finite point, each with its own class."""
        return "".join(
            f'<circle class="{kind}" cx="{self.x_px(x):.1f}" cy="{self.y_px(y):.1f}" r="{radius:g}"/>'
            for x, y, kind in zip(xs, ys, css, strict=True)
            if math.isfinite(x) and math.isfinite(y)
        )

    def band(self, xs: Float64Array, lows: Float64Array, highs: Float64Array, css: str) -> str:
        """Fill between two lines, broken where one of them is not finite."""
        whole = np.isfinite(xs) & np.isfinite(lows) & np.isfinite(highs)
        pieces = np.split(np.arange(len(xs)), np.flatnonzero(np.diff(whole.astype(np.int8))) + 1)
        outlines = []
        for piece in pieces:
            if len(piece) == 0 or not whole[piece[0]]:
                continue
            above = [f"{self.x_px(xs[i]):.1f} {self.y_px(highs[i]):.1f}" for i in piece]
            below = [f"{self.x_px(xs[i]):.1f} {self.y_px(lows[i]):.1f}" for i in piece[::-1]]
            outlines.append("M" + "L".join([*above, *below]) + "Z")
        return f'<path class="{css}" d="{"".join(outlines)}"/>' if outlines else ""

    def whisker(self, x: float, low: float, high: float, css: str) -> str:
        """Draw a vertical line from low to high with a bar across each end."""
        at, top, bottom = self.x_px(x), self.y_px(high), self.y_px(low)
        path = f"M{at:.1f} {top:.1f}V{bottom:.1f}M{at - 5:.1f} {top:.1f}h10M{at - 5:.1f} {bottom:.1f}h10"
        return f'<path class="{css}" d="{path}"/>'

    def level(self, x_low: float, x_high: float, y: float, css: str) -> str:
        """Draw a horizontal line."""
        left, right, at = self.x_px(x_low), self.x_px(x_high), self.y_px(y)
        return f'<line class="{css}" x1="{left:.1f}" x2="{right:.1f}" y1="{at:.1f}" y2="{at:.1f}"/>'

    def word(self, x: float, y: float, text: str, css: str = "tick") -> str:
        """Write a word centred on a point."""
        return (
            f'<text class="{css}" x="{self.x_px(x):.1f}" y="{self.y_px(y):.1f}" text-anchor="middle">'
            f"{escape(text)}</text>"
        )

    def bar(self, x_low: float, x_high: float, y: float, css: str) -> str:
        """Draw a bar from the x axis up to y."""
        left, right, top = self.x_px(x_low), self.x_px(x_high), self.y_px(y)
        return (
            f'<rect class="{css}" x="{left + 0.5:.1f}" y="{top:.1f}" width="{max(0.5, right - left - 1):.1f}" '
            f'height="{self.height - self.foot - top:.1f}"/>'
        )

    def mark_x(self, value: float, css: str, text: str = "", row: int = 0) -> str:
        """Draw a vertical line with a word beside it, to the left of it where there is no room to the right."""
        x = self.x_px(value)
        line = f'<line class="{css}" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP:g}" y2="{self.height - self.foot:g}"/>'
        if not text:
            return line
        to_left = x > 0.7 * self.width
        place = f'x="{x + (-5 if to_left else 5):.1f}" y="{_TOP + 11 + 15 * row:g}"'
        return f'{line}<text class="word" {place} text-anchor="{"end" if to_left else "start"}">{escape(text)}</text>'


def linear_axis(low: float, high: float, label: str, *, steps: int = 6, suffix: str = "") -> Axis:
    """Return an axis with round ticks that covers low to high."""
    span = max(high - low, 1e-9)
    raw = span / steps
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= raw)
    first = math.ceil(low / step - 1e-9)
    values = [step * i for i in range(first, math.floor(high / step + 1e-9) + 1)]
    digits = max(0, -math.floor(math.log10(step)))
    return Axis(low, max(high, low + span), label, [(value, f"{value:.{digits}f}{suffix}") for value in values])


def distance_axis(high_m: float, label: str, low_m: float = 2.0, most_ticks: int = 16) -> Axis:
    """Return a logarithmic axis of metres up to at least `high_m`, at least a decade and a half long."""
    kilometres = (1000, 2500, 5000, 10_000, 25_000, 50_000, 100_000, 1_000_000)
    choices = (0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10, 25, 50, 100, 250, 500, *kilometres)
    least = 250.0 if low_m >= 2.0 else 40.0 * low_m
    high = next((value for value in choices if value >= max(high_m, least)), choices[-1])
    ticks = [(float(v), f"{v / 1000:g} km" if v >= 1000 else f"{v:g} m") for v in choices if low_m < v <= high]
    # Counted from the end, so that the end keeps its number.
    ticks = ticks[:: -math.ceil(len(ticks) / most_ticks)][::-1]
    return Axis(low_m, float(high), label, ticks, log=True)


def angle_axis(label: str, low_deg: float = 0.02) -> Axis:
    """Return a logarithmic axis of degrees up to half a turn."""
    ticks = [(value, f"{value:g}°") for value in (0.1, 0.5, 2.0, 10.0, 45.0, 180.0)]
    return Axis(low_deg, 180.0, label, ticks, log=True)


def doubt_axis(label: str, least: float = 1e-5) -> Axis:
    """Return an axis of what is missing to certainty, 1 - p: half a doubt and a thousandth lie far apart on it."""
    texts = ("0", "90", "99", "99.9", "99.99")
    return Axis(-0.15, -math.log10(least), label, [(float(nines), text) for nines, text in enumerate(texts)])


def share_axis(label: str) -> Axis:
    """Return an axis from 0 to 100 %."""
    return Axis(0.0, 1.0, label, [(i / 4, f"{25 * i} %") for i in range(5)])


def cumulative(values: Float64Array, total: int, at: Float64Array) -> Float64Array:
    """Return for each entry of `at` the share of `total` values that are at most so large; NaN counts as larger."""
    ordered = np.sort(values[np.isfinite(values)])
    return np.searchsorted(ordered, at, side="right") / max(total, 1)
