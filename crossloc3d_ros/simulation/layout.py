"""The plan of a town: streets and blocks on squared paper, and the warp that makes them a place of its own.

A plan is drawn in (u, v) metres with axis-parallel streets, which keeps every family's drawing simple; `Warp` bends,
shears and turns it into local (x, y). What is drawn is collected by `Plan` as rows of numbers, so that a town of ten
thousand parts becomes triangles in a few numpy calls.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.types import Float64Array

Layout = Literal["grid", "irregular", "curved"]


class Rect(NamedTuple):
    """A rectangle of the plan."""

    u0: float
    v0: float
    u1: float
    v1: float

    @property
    def width(self) -> float:
        return self.u1 - self.u0

    @property
    def height(self) -> float:
        return self.v1 - self.v0

    @property
    def centre(self) -> tuple[float, float]:
        return 0.5 * (self.u0 + self.u1), 0.5 * (self.v0 + self.v1)

    def inset(self, by: float) -> Rect:
        """Return the rectangle drawn in by `by` metres on every side."""
        return Rect(self.u0 + by, self.v0 + by, self.u1 - by, self.v1 - by)

    def shifted(self, u: float, v: float) -> Rect:
        """Return the rectangle moved by (u, v)."""
        return Rect(self.u0 + u, self.v0 + v, self.u1 + u, self.v1 + v)


class Street(NamedTuple):
    """A strip between blocks, along u or along v."""

    rect: Rect
    along_u: bool
    level: int
    """0 the town's first divisions, growing towards the lanes."""
    quay_m: float = 0.0
    """Width of the quays on either side of the water in the middle; 0: a street without water of its own."""
    bridges: tuple[tuple[float, float], ...] = ()
    """Where the water is crossed: from and to, along the street."""

    @property
    def width(self) -> float:
        return self.rect.height if self.along_u else self.rect.width

    @property
    def length(self) -> float:
        return self.rect.width if self.along_u else self.rect.height

    def at(self, along: float, across: float) -> tuple[float, float]:
        """Return the plan position `along` metres from the start and `across` metres left of the middle line."""
        centre_u, centre_v = self.rect.centre
        if self.along_u:
            return self.rect.u0 + along, centre_v + across
        return centre_u - across, self.rect.v0 + along

    @property
    def yaw_rad(self) -> float:
        return 0.0 if self.along_u else float(np.pi / 2)


_WARP_RADIUS_M = 480.0
"""Where a polynomial warp has its full strength."""


@dataclass(frozen=True, eq=False)
class Warp:
    """Plan (u, v) to local (x, y): waves, a conformal bend, a turn and a shear; smooth and without folds."""

    waves: Float64Array
    """(W, 5) wave vector u, v [rad/m]; phase; displacement u, v [m]."""
    bend: npt.NDArray[np.complex128]
    """(B,) the derivative is 1 + sum bend[i] (z / radius)^(i + 1): right angles stay right where streets turn."""
    linear: Float64Array
    """(2, 2) turn and shear."""

    def __call__(self, uv: npt.NDArray[np.floating]) -> Float64Array:
        """Return local positions (..., 2) of plan positions (..., 2)."""
        flat = np.asarray(uv, dtype=np.float64)
        moved = flat.copy()
        for ku, kv, phase, du, dv in self.waves:
            wave = np.sin(flat[..., 0] * ku + flat[..., 1] * kv + phase)
            moved[..., 0] += du * wave
            moved[..., 1] += dv * wave
        z = moved[..., 0] + 1j * moved[..., 1]
        bent, power = z.copy(), z.copy()
        for i, strength in enumerate(self.bend):
            power = power * z / _WARP_RADIUS_M
            bent = bent + strength * power / (i + 2)
        return np.asarray(np.stack([bent.real, bent.imag], -1) @ self.linear.T, dtype=np.float64)

    def yaw(self, uv: Float64Array, yaw_plan: Float64Array) -> Float64Array:
        """Return the local heading (N,) of a plan heading at plan positions (N, 2)."""
        step = 0.5 * np.stack([np.cos(yaw_plan), np.sin(yaw_plan)], -1)
        ahead = self(uv + step) - self(uv - step)
        return np.asarray(np.arctan2(ahead[:, 1], ahead[:, 0]), dtype=np.float64)


def draw_warp(layout: Layout, rng: np.random.Generator) -> Warp:
    """Return a warp in the manner of `layout`; lengths change by less than two thirds within 500 m of the middle."""
    bands, bends = {
        "grid": ([(500.0, 900.0, 0.05, 1)], (0.0, 0.0, 0.0)),
        "irregular": ([(300.0, 650.0, 0.2, 2), (120.0, 220.0, 0.14, 2)], (0.2, 0.15, 0.1)),
        "curved": ([(200.0, 400.0, 0.08, 1)], (0.3, 0.3, 0.15)),
    }[layout]
    waves = []
    for low, high, slope, count in bands:
        for _ in range(count):
            wavelength, direction, push = rng.uniform(low, high), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
            number = 2 * np.pi / wavelength
            amplitude = slope / number * rng.uniform(0.6, 1.0) / np.sqrt(count)
            waves.append([number * np.cos(direction), number * np.sin(direction), rng.uniform(0, 2 * np.pi),
                          amplitude * np.cos(push), amplitude * np.sin(push)])  # fmt: skip
    angles = rng.uniform(0, 2 * np.pi, len(bends))
    strengths = np.array(bends) * rng.uniform(0.5, 1.0, len(bends))
    turn = rng.uniform(0, 2 * np.pi)
    shear = rng.uniform(-0.12, 0.12) if layout != "grid" else rng.uniform(-0.06, 0.06)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    linear = rotation @ np.array([[1.0, shear], [0.0, 1.0]])
    return Warp(np.array(waves), strengths * (np.cos(angles) + 1j * np.sin(angles)), linear)


def draw_streets(
    extent: Rect, block_m: tuple[float, float], street_m: tuple[float, float, float], jitter: float,
    rng: np.random.Generator,
) -> tuple[list[Rect], list[Street]]:  # fmt: skip
    """Divide `extent` into blocks by streets.

    `block_m` least and greatest side of a block, `street_m` widths of main streets, streets and lanes, `jitter` 0 to 1:
    how far from the middle a division may lie.
    """
    blocks: list[Rect] = []
    streets: list[Street] = []
    pending = [(extent, 0)]
    while pending:
        rect, level = pending.pop()
        target = rng.uniform(*block_m)
        longer = max(rect.width, rect.height)
        if longer < 1.5 * target or longer < 2 * block_m[0] + street_m[0]:
            blocks.append(rect)
            continue
        rank = 0 if level < 3 else 1 if level < 7 else 2
        width = street_m[rank] * rng.uniform(0.75, 1.35)
        share = 0.5 + jitter * rng.uniform(-0.3, 0.3)
        if rect.width >= rect.height:
            middle = rect.u0 + share * rect.width
            streets.append(Street(Rect(middle - width / 2, rect.v0, middle + width / 2, rect.v1), False, level))
            halves = (Rect(rect.u0, rect.v0, middle - width / 2, rect.v1), Rect(middle + width / 2, rect.v0, *rect[2:]))
        else:
            middle = rect.v0 + share * rect.height
            streets.append(Street(Rect(rect.u0, middle - width / 2, rect.u1, middle + width / 2), True, level))
            halves = (Rect(rect.u0, rect.v0, rect.u1, middle - width / 2), Rect(rect.u0, middle + width / 2, *rect[2:]))
        pending += [(half, level + 1) for half in halves]
    return blocks, streets


class Belt(NamedTuple):
    """Measures of a quarter of parallel canals."""

    water_m: tuple[float, float]
    quay_m: tuple[float, float]
    depth_m: tuple[float, float]
    """From the houses of one canal to those of the next."""
    cross_m: tuple[float, float]
    """Between neighbouring cross streets."""
    lane_m: tuple[float, float]
    cross_canals: float
    """Share of the cross streets that are canals."""
    broad: float
    """Share of the canals that are a broad river or an old harbour."""


def draw_belt(extent: Rect, belt: Belt, rng: np.random.Generator) -> tuple[list[Rect], list[Street]]:
    """Divide `extent` into blocks by canals along u, with quays on both sides, and streets and canals across."""
    canals: list[tuple[float, float, float]] = []  # middle, half of the whole width, quay
    v = extent.v0 + rng.uniform(-0.5, 0.5) * belt.depth_m[1]
    while v < extent.v1:
        canals.append(_draw_canal(v, belt, rng))
        v += 2 * canals[-1][1] + rng.uniform(*belt.depth_m)
    crossings: list[tuple[float, float, float]] = []
    u = extent.u0 + rng.uniform(0.0, 1.0) * belt.cross_m[1]
    while u < extent.u1 - 20.0:
        if rng.random() < belt.cross_canals:
            crossings.append(_draw_canal(u, belt._replace(broad=0.0), rng))
            u += crossings[-1][1]
        else:
            crossings.append((u, 0.5 * rng.uniform(*belt.lane_m), 0.0))
        u += rng.uniform(*belt.cross_m)
    streets = []
    for middle, half, quay in canals:
        bridges: list[tuple[float, float]] = []
        for across, reach, shore in crossings:
            if shore > 0:
                bridges += [(across - reach, across - reach + shore), (across + reach - shore, across + reach)]
            elif rng.random() < 0.75:
                bridges.append((across - reach, across + reach))
        rect = Rect(extent.u0, middle - half, extent.u1, middle + half)
        streets.append(Street(rect, True, 0, quay, tuple((a - extent.u0, b - extent.u0) for a, b in bridges)))
    for across, reach, shore in crossings:
        if shore > 0:
            bridges = []
            for middle, half, quay in canals:
                bridges += [(middle - half, middle - half + quay), (middle + half - quay, middle + half)]
            rect = Rect(across - reach, extent.v0, across + reach, extent.v1)
            streets.append(Street(rect, False, 1, shore, tuple((a - extent.v0, b - extent.v0) for a, b in bridges)))
    blocks: list[Rect] = []
    edges = [extent.v0, *(edge for middle, half, _ in canals for edge in (middle - half, middle + half)), extent.v1]
    for low, high in zip(edges[::2], edges[1::2], strict=True):
        if high - low > 12.0:
            _divide_band(Rect(extent.u0, low, extent.u1, high), crossings, belt, blocks, streets, rng)
    return blocks, streets


def _draw_canal(middle: float, belt: Belt, rng: np.random.Generator) -> tuple[float, float, float]:
    water = rng.uniform(*belt.water_m) * (rng.uniform(1.8, 3.2) if rng.random() < belt.broad else 1.0)
    quay = rng.uniform(*belt.quay_m)
    return middle, 0.5 * water + quay, quay


def _divide_band(
    band: Rect, crossings: list[tuple[float, float, float]], belt: Belt, blocks: list[Rect], streets: list[Street],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Divide the ground between two canals by its cross streets and, where it is deep, by a lane along its middle."""
    lanes: list[tuple[float, float]] = []
    if band.height > 0.75 * belt.depth_m[1] and rng.random() < 0.5:
        half = 0.5 * rng.uniform(*belt.lane_m)
        middle = band.v0 + rng.uniform(0.42, 0.58) * band.height
        lanes.append((middle - half, middle + half))
        streets.append(Street(Rect(band.u0, middle - half, band.u1, middle + half), True, 7))
    rows = [band.v0, *(edge for lane in lanes for edge in lane), band.v1]
    start = band.u0
    for across, reach, shore in [*crossings, (band.u1, 0.0, 0.0)]:
        if shore == 0.0 and across < band.u1 and rng.random() < 0.15:
            continue  # two blocks in one
        for low, high in zip(rows[::2], rows[1::2], strict=True):
            if across - reach - start > 8.0:
                blocks.append(Rect(start, low, across - reach, high))
        if shore == 0.0 and across < band.u1:
            streets.append(Street(Rect(across - reach, band.v0, across + reach, band.v1), False, 4))
        start = across + reach


BROADLEAF, CONIFER, COLUMN, BUSH = range(4)


@dataclass(eq=False)
class Plan:
    """Everything drawn so far, in plan coordinates; heights are above the ground at the part's anchor."""

    wings: list[tuple[float, ...]] = field(default_factory=list)
    """8 corner coordinates, bottom (NaN: down into the ground), eave, ridge, hip, label, owner."""
    anchors: list[tuple[float, float]] = field(default_factory=list)
    """Where each owner (a building and all that stands on it) meets the ground."""
    trees: list[tuple[float, ...]] = field(default_factory=list)
    """u, v, kind, height, crown radius, crown base as share of the height."""
    cars: list[tuple[float, ...]] = field(default_factory=list)
    """u, v, yaw, chance that a car stands here, size class."""
    poles: list[tuple[float, ...]] = field(default_factory=list)
    """u, v, height, radius at the foot, radius at the top, label."""
    water: list[Rect] = field(default_factory=list)
    pedestrians: list[Rect] = field(default_factory=list)
    """Where people may stand."""

    def owner(self, u: float, v: float) -> int:
        """Register a building whose ground floor lies at the height of the ground at (u, v)."""
        self.anchors.append((u, v))
        return len(self.anchors) - 1

    def wing(
        self,
        owner: int,
        rect: Rect,
        eave: float,
        ridge: float | None = None,
        *,
        along_u: bool | None = None,
        hip: float = 0.0,
        bottom: float = float("nan"),
        label: Label = Label.BUILDING,
    ) -> None:
        """Draw a part of a building; the ridge runs along u, along v, or along the longer side."""
        along = rect.width >= rect.height if along_u is None else along_u
        u0, v0, u1, v1 = rect
        corners = (u0, v0, u1, v0, u1, v1, u0, v1) if along else (u1, v0, u1, v1, u0, v1, u0, v0)
        self.wings.append((*corners, bottom, eave, eave if ridge is None else ridge, hip, float(label), float(owner)))

    @contextmanager
    def turned(self, centre: tuple[float, float], angle_rad: float) -> Iterator[None]:
        """Turn what is drawn meanwhile about `centre`; water and places for people stay where they are drawn."""
        wings, anchors, trees = len(self.wings), len(self.anchors), len(self.trees)
        cars, poles = len(self.cars), len(self.poles)
        yield
        cosine, sine = float(np.cos(angle_rad)), float(np.sin(angle_rad))

        def turn(u: float, v: float) -> tuple[float, float]:
            du, dv = u - centre[0], v - centre[1]
            return centre[0] + cosine * du - sine * dv, centre[1] + sine * du + cosine * dv

        self.wings[wings:] = [
            (*turn(*row[0:2]), *turn(*row[2:4]), *turn(*row[4:6]), *turn(*row[6:8]), *row[8:])
            for row in self.wings[wings:]
        ]
        self.anchors[anchors:] = [turn(*row) for row in self.anchors[anchors:]]
        self.trees[trees:] = [(*turn(*row[:2]), *row[2:]) for row in self.trees[trees:]]
        self.poles[poles:] = [(*turn(*row[:2]), *row[2:]) for row in self.poles[poles:]]
        self.cars[cars:] = [(*turn(*row[:2]), row[2] + angle_rad, *row[3:]) for row in self.cars[cars:]]

    def barrier(self, u0: float, v0: float, u1: float, v1: float, thick: float, height: float, label: Label) -> None:
        """Draw a hedge, wall or fence along an axis-parallel line, in pieces that follow the bends."""
        length = max(abs(u1 - u0), abs(v1 - v0))
        pieces = max(1, int(length / 12.0))
        for i in range(pieces):
            a, b = i / pieces, (i + 1) / pieces
            start_u, start_v = u0 + a * (u1 - u0), v0 + a * (v1 - v0)
            end_u, end_v = u0 + b * (u1 - u0), v0 + b * (v1 - v0)
            rect = Rect(min(start_u, end_u) - thick / 2, min(start_v, end_v) - thick / 2,
                        max(start_u, end_u) + thick / 2, max(start_v, end_v) + thick / 2)  # fmt: skip
            self.wing(self.owner(*rect.centre), rect, height, label=label)

    def enclosure(self, rect: Rect, thick: float, height: float, label: Label, rng: np.random.Generator) -> None:
        """Draw a barrier around a rectangle with a gate somewhere in one of its sides."""
        sides = [
            (rect.u0, rect.v0, rect.u1, rect.v0), (rect.u1, rect.v0, rect.u1, rect.v1),
            (rect.u0, rect.v1, rect.u1, rect.v1), (rect.u0, rect.v0, rect.u0, rect.v1),
        ]  # fmt: skip
        gate = int(rng.integers(4))
        for i, (u0, v0, u1, v1) in enumerate(sides):
            if i != gate:
                self.barrier(u0, v0, u1, v1, thick, height, label)
                continue
            opening, width = rng.uniform(0.2, 0.8), 4.0 / max(abs(u1 - u0), abs(v1 - v0), 4.0)
            for a, b in ((0.0, opening - width / 2), (opening + width / 2, 1.0)):
                if b > a:
                    self.barrier(u0 + a * (u1 - u0), v0 + a * (v1 - v0), u0 + b * (u1 - u0), v0 + b * (v1 - v0),
                                 thick, height, label)  # fmt: skip

    def tree(
        self, u: float, v: float, rng: np.random.Generator, *, height: tuple[float, float] = (6.0, 14.0),
        kinds: tuple[float, float, float, float] = (0.8, 0.1, 0.05, 0.05),
    ) -> None:  # fmt: skip
        """Draw a tree of a kind chosen by the shares `kinds` (broadleaf, conifer, column, bush)."""
        draw = rng.random(5)
        kind = int(np.searchsorted(np.cumsum(kinds), draw[0] * sum(kinds), side="right"))
        tall = height[0] + draw[1] * (height[1] - height[0])
        if kind == BROADLEAF:
            self.trees.append((u, v, kind, tall, tall * (0.24 + 0.18 * draw[2]), 0.18 + 0.22 * draw[3]))
        elif kind == CONIFER:
            self.trees.append((u, v, kind, 1.25 * tall, tall * (0.16 + 0.1 * draw[2]), 0.08 + 0.1 * draw[3]))
        elif kind == COLUMN:
            self.trees.append((u, v, kind, 1.4 * tall, 0.1 * tall + 0.5 * draw[2], 0.1))
        else:
            self.trees.append((u, v, BUSH, 1.5 + 2.5 * draw[1], 1.0 + 1.3 * draw[2], 0.0))
