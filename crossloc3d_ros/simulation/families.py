"""What stands on a block, family by family: each function draws one block into the plan.

The families differ in what a LiDAR sees: how closed the street fronts are, how high, how deep, how regular, how green.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from crossloc3d_ros.simulation.canals import KINDS as CANAL_KINDS
from crossloc3d_ros.simulation.canals import draw_quays
from crossloc3d_ros.simulation.drawing import divide, parking_rows, row_houses, rows_of_trees, scatter_trees, within
from crossloc3d_ros.simulation.harbour import KINDS as HARBOUR_KINDS
from crossloc3d_ros.simulation.layout import Belt, Layout, Plan, Rect, Street
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.village import KINDS as VILLAGE_KINDS

Generator = np.random.Generator


class Family(NamedTuple):
    """A way of building a town."""

    layouts: tuple[Layout, ...]
    block_m: tuple[float, float]
    street_m: tuple[float, float, float]
    """Widths of main streets, streets and lanes."""
    jitter: float
    blocks: dict[str, float]
    """Share of each kind of block."""
    street_trees: float
    """Share of the streets with rows of trees."""
    parked: float
    """Share of the kerb that is parked full."""
    canals: float
    """Share of the main streets that are canals."""
    pedestrians: float
    """People a hundred metres of street."""
    flat: bool = False
    """Whether the ground is mostly level."""
    belt: Belt | None = None
    """Canals in parallel instead of streets that divide and divide again."""
    avenues: bool = True
    """Whether an avenue may cut across the streets."""
    ground_cell_m: float = 3.0
    """How finely the ground is drawn: the steps of its shores."""


FAMILIES: dict[str, Family] = {
    "old_town": Family(
        ("irregular", "curved", "grid"), (38.0, 85.0), (17.0, 8.5, 5.0), 1.0,
        {"closed": 0.72, "terraces": 0.1, "square": 0.06, "church": 0.04, "monument": 0.04, "garden": 0.04},
        0.35, 0.5, 0.45, 3.0, flat=True,
    ),
    "suburb": Family(
        ("curved", "irregular", "grid"), (48.0, 95.0), (14.0, 10.5, 8.0), 0.8,
        {"detached": 0.58, "terraces": 0.22, "garden": 0.08, "slabs": 0.06, "square": 0.03, "campus": 0.03},
        0.4, 0.3, 0.02, 0.6,
    ),
    "campus": Family(
        ("grid", "irregular", "curved"), (80.0, 150.0), (18.0, 12.0, 8.0), 0.7,
        {"campus": 0.68, "garden": 0.12, "car_park": 0.1, "slabs": 0.06, "square": 0.04},
        0.6, 0.25, 0.05, 2.0,
    ),
    "industry": Family(
        ("grid", "irregular"), (80.0, 170.0), (20.0, 15.0, 11.0), 0.7,
        {"halls": 0.72, "tanks": 0.08, "car_park": 0.1, "campus": 0.06, "garden": 0.04},
        0.2, 0.25, 0.08, 0.3, flat=True,
    ),
    "park_edge": Family(
        ("curved", "irregular"), (60.0, 120.0), (16.0, 10.0, 7.0), 1.0,
        {"garden": 0.3, "wood": 0.14, "detached": 0.2, "slabs": 0.14, "terraces": 0.14, "campus": 0.08},
        0.6, 0.3, 0.06, 1.5,
    ),
    "estate": Family(
        ("grid", "irregular", "curved"), (65.0, 130.0), (20.0, 13.0, 9.0), 0.7,
        {"slabs": 0.5, "towers": 0.18, "terraces": 0.12, "garden": 0.08, "car_park": 0.07, "square": 0.05},
        0.5, 0.5, 0.05, 1.0,
    ),
    "canal_town": Family(
        ("curved", "irregular", "curved"), (45.0, 95.0), (14.0, 9.0, 6.0), 0.8,
        {"canal_houses": 0.72, "closed": 0.08, "square": 0.09, "garden": 0.05, "church": 0.03, "monument": 0.03},
        0.4, 0.5, 0.0, 3.0, flat=True, avenues=False, ground_cell_m=1.5,
        belt=Belt((20.0, 45.0), (6.5, 11.0), (60.0, 125.0), (65.0, 150.0), (6.0, 12.0), 0.12, 0.1),
    ),
    "village": Family(
        ("irregular", "curved"), (50.0, 105.0), (10.0, 7.5, 5.5), 1.0,
        {"farmstead": 0.5, "cottages": 0.22, "orchard": 0.1, "meadow": 0.06, "church": 0.06, "garden": 0.06},
        0.12, 0.05, 0.0, 0.4, avenues=False,
    ),
    "harbour": Family(
        ("grid", "irregular"), (95.0, 170.0), (24.0, 17.0, 13.0), 0.7,
        {"containers": 0.34, "warehouses": 0.3, "basin": 0.24, "tanks": 0.07, "car_park": 0.05},
        0.05, 0.15, 0.0, 0.3, flat=True, avenues=False, ground_cell_m=1.5,
    ),
}  # fmt: skip

HELD_OUT_FAMILIES = ("harbour", "village")
"""Never learned from: the benchmark shows with them what a kind of town is worth that training has not seen."""
TRAINING_FAMILIES = tuple(sorted(set(FAMILIES) - set(HELD_OUT_FAMILIES)))
FAMILIES_BY_SEED = ("campus", "estate", "industry", "old_town", "park_edge", "suburb")
"""What a seed alone chooses from. Frozen: with another list a seed would make another town."""


def draw_block(kind: str, plan: Plan, rect: Rect, rng: Generator) -> None:
    """Draw one block of a kind that a family names."""
    _KINDS[kind](plan, rect, rng)


# Old town ------------------------------------------------------------------------------------------------------------


def _closed(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Row houses shoulder to shoulder around courtyards."""
    depth = min(rng.uniform(8.5, 14.0), 0.5 * min(rect.width, rect.height))
    base, spread = rng.uniform(7.5, 15.0), rng.uniform(0.3, 2.6)
    flat, gable = rng.uniform(0.05, 0.5), rng.uniform(0.1, 0.7)
    width = rng.uniform(4.8, 9.5)
    missing = rng.uniform(0.0, 0.08)
    row_houses(
        plan, rect, rng, depth=depth, eave=base, spread=spread, flat=flat, gable=gable, front=width, missing=missing
    )


def _terraces(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Rows of like houses with gardens between."""
    along_u = rng.random() < 0.5
    long_side, depth_side = (rect.width, rect.height) if along_u else (rect.height, rect.width)
    depth, setback = rng.uniform(7.5, 10.5), rng.uniform(1.5, 5.0)
    eave, front = rng.uniform(5.0, 9.0), rng.uniform(4.8, 7.0)
    ridge_along = rng.random() < 0.8
    rise = rng.uniform(0.0, 4.5) if rng.random() < 0.8 else 0.0
    rows = max(1, int((depth_side - 2 * setback + 12) / (depth + rng.uniform(14, 22))))
    pitch = (depth_side - 2 * setback - depth) / max(rows - 1, 1)
    for row in range(rows):
        near = setback + (row * pitch if rows > 1 else rng.uniform(0, max(pitch, 0)))
        position = rng.uniform(1.0, 5.0)
        while position < long_side - front - 1:
            houses = int(rng.integers(3, 9))
            for _ in range(houses):
                if position > long_side - front - 1:
                    break
                house = Rect(rect.u0 + position, rect.v0 + near, rect.u0 + position + front, rect.v0 + near + depth)
                if not along_u:
                    house = Rect(rect.u0 + near, rect.v0 + position, rect.u0 + near + depth, rect.v0 + position + front)
                owner = plan.owner(*house.centre)
                plan.wing(owner, house, eave, eave + rise, along_u=along_u == ridge_along)
                if rng.random() < 0.3:
                    garden = rng.uniform(2.0, 4.5)
                    annex = (Rect(house.u0, house.v1, house.u1, house.v1 + garden) if along_u
                             else Rect(house.u1, house.v0, house.u1 + garden, house.v1))  # fmt: skip
                    plan.wing(owner, annex, rng.uniform(2.6, 3.4))
                if rng.random() < 0.4:
                    offset = depth + rng.uniform(5.0, 9.0)
                    u, v = (house.u0, house.v0 + offset) if along_u else (house.u0 + offset, house.v0)
                    if rect.u0 < u < rect.u1 - 3 and rect.v0 < v < rect.v1 - 3:
                        plan.wing(plan.owner(u, v), Rect(u, v, u + 2.5, v + 2.5), 2.2, 2.9)
                position += front
            position += rng.uniform(2.0, 7.0)
    scatter_trees(plan, rect.inset(2.0), rng, per_hectare=rng.uniform(10, 50), height=(3.5, 9.0))
    if rng.random() < 0.6:
        plan.enclosure(rect.inset(0.6), 0.6, rng.uniform(0.9, 2.0), Label.VEGETATION, rng)


def _square(plan: Plan, rect: Rect, rng: Generator) -> None:
    """A paved square: trees in rows, a kiosk, a fountain, market stalls."""
    plan.pedestrians.append(rect.inset(3.0))
    spacing, margin = rng.uniform(7.0, 11.0), rng.uniform(4.0, 8.0)
    height = float(rng.uniform(7.0, 13.0))
    if rng.random() < 0.7:
        ring = rect.inset(margin)
        for u in np.arange(ring.u0, ring.u1, spacing):
            plan.tree(u, ring.v0, rng, height=(height, 1.1 * height))
            plan.tree(u, ring.v1, rng, height=(height, 1.1 * height))
        for v in np.arange(ring.v0 + spacing, ring.v1, spacing):
            plan.tree(ring.u0, v, rng, height=(height, 1.1 * height))
            plan.tree(ring.u1, v, rng, height=(height, 1.1 * height))
    u, v = rect.centre
    if rng.random() < 0.6:
        size = rng.uniform(2.0, 5.0)
        plan.wing(plan.owner(u, v), Rect(u - size, v - size, u + size, v + size), 3.0, 4.5, hip=0.5)
    elif rng.random() < 0.6:
        plan.poles.append((u, v, rng.uniform(5, 14), 0.9, 0.4, float(Label.STRUCTURE)))
    if rng.random() < 0.5:
        for _ in range(int(rng.integers(4, 18))):
            u, v = within(rng, rect.u0 + 6, rect.u1 - 6), within(rng, rect.v0 + 6, rect.v1 - 6)
            plan.wing(plan.owner(u, v), Rect(u - 1.6, v - 1.2, u + 1.6, v + 1.2), 2.5, 3.0, bottom=2.1,
                      label=Label.STRUCTURE)  # fmt: skip
    parking_rows(plan, Rect(rect.u0, rect.v0, rect.u1, rect.v0 + 6), rng, chance=0.5)


def _church(plan: Plan, rect: Rect, rng: Generator) -> None:
    """A nave with aisles, a transept and a tower, in a churchyard."""
    along_u = rect.width >= rect.height
    length = min(max(rect.width, rect.height) - 8, rng.uniform(35, 65))
    width = min(min(rect.width, rect.height) - 8, rng.uniform(16, 26))
    u, v = rect.centre
    owner = plan.owner(u, v)

    def place(a0: float, b0: float, a1: float, b1: float) -> Rect:
        return Rect(u + a0, v + b0, u + a1, v + b1) if along_u else Rect(u + b0, v + a0, u + b1, v + a1)

    nave, wall = rng.uniform(12, 20), 0.3 * width
    plan.wing(owner, place(-length / 2, -wall, length / 2, wall), nave, nave + wall * 1.4, along_u=along_u)
    plan.wing(owner, place(-length / 2 + 3, -width / 2, length / 2 - 4, width / 2), 0.5 * nave, 0.72 * nave,
              along_u=along_u)  # fmt: skip
    cross = rng.uniform(0.0, 0.25) * length
    plan.wing(owner, place(cross - 5, -0.62 * width, cross + 5, 0.62 * width), nave, nave + 5, along_u=not along_u)
    tower, half = rng.uniform(28, 60), rng.uniform(3.5, 5.5)
    plan.wing(
        owner, place(-length / 2 - 2 * half, -half, -length / 2, half), tower, tower + rng.uniform(0, 18), hip=0.5
    )
    scatter_trees(plan, rect.inset(3), rng, per_hectare=30, height=(6, 14))


def _monument(plan: Plan, rect: Rect, rng: Generator) -> None:
    """A palace or town hall: wings around a court, higher in the middle."""
    inner = rect.inset(rng.uniform(2.0, 6.0))
    if min(inner.width, inner.height) < 22:
        _closed(plan, rect, rng)
        return
    eave = rng.uniform(12, 19)
    owner = _composite(plan, inner, rng, "court" if rng.random() < 0.6 else "u", rng.uniform(9, 14), eave, 0.25, 5.0)
    u = inner.centre[0]
    plan.wing(owner, Rect(u - 6, inner.v0 - 1, u + 6, inner.v0 + 11), eave + rng.uniform(3, 7), eave + 10, hip=0.5)


# Larger buildings -----------------------------------------------------------------------------------------------------


def _composite(
    plan: Plan, rect: Rect, rng: Generator, shape: str, depth: float, height: float, hip: float, rise: float
) -> int:
    """Draw a building of several wings within `rect`: slab, l, u, court, h, t, tower, setback."""
    owner = plan.owner(*rect.centre)
    flip_u, flip_v = rng.random() < 0.5, rng.random() < 0.5
    w, h = rect.width, rect.height
    du, dv = min(depth, 0.45 * w), min(depth, 0.45 * h)

    def wing(a0: float, b0: float, a1: float, b1: float, top: float, bottom: float = float("nan")) -> None:
        if flip_u:
            a0, a1 = w - a1, w - a0
        if flip_v:
            b0, b1 = h - b1, h - b0
        part = Rect(rect.u0 + a0, rect.v0 + b0, rect.u0 + a1, rect.v0 + b1)
        plan.wing(owner, part, top, top + rise * min(1.0, min(part.width, part.height) / 12), hip=hip, bottom=bottom)

    second = height * rng.choice([1.0, 1.0, 0.75, 0.6, 1.3])
    if shape == "slab":
        wing(0, 0, w, dv if w > h else h, height) if w > h else wing(0, 0, du, h, height)
    elif shape == "l":
        wing(0, 0, w, dv, height)
        wing(0, dv, du, h, second)
    elif shape == "u":
        wing(0, 0, w, dv, height)
        wing(0, dv, du, h, second)
        wing(w - du, dv, w, h, second)
    elif shape == "court":
        wing(0, 0, w, dv, height)
        wing(0, h - dv, w, h, second)
        wing(0, dv, du, h - dv, height)
        wing(w - du, dv, w, h - dv, height)
    elif shape == "h":
        wing(0, 0, du, h, height)
        wing(w - du, 0, w, h, second)
        middle = rng.uniform(0.2, 0.8) * (h - dv)
        wing(du, middle, w - du, middle + dv, 0.8 * height)
    elif shape == "t":
        wing(0, 0, w, dv, height)
        middle = rng.uniform(0.2, 0.8) * (w - du)
        wing(middle, dv, middle + du, h, second)
    elif shape == "tower":
        wing(0, 0, w, h, rng.uniform(3.5, 8.0))
        a, b = rng.uniform(0, w - min(w, 22)), rng.uniform(0, h - min(h, 22))
        wing(a, b, a + min(w, 22), b + min(h, 22), height * rng.uniform(1.6, 3.0))
    else:
        step = rng.uniform(2.5, 5.0)
        wing(0, 0, w, h, height)
        if min(w, h) > 3 * step:
            wing(step, step, w - step, h - step, height + 3.4, height - 0.5)
        if min(w, h) > 6 * step and rng.random() < 0.6:
            wing(2 * step, 2 * step, w - step, h - 2 * step, height + 6.8, height - 0.5)
    return owner


_SHAPES = ("slab", "l", "u", "court", "h", "t", "tower", "setback")


def _roof_boxes(plan: Plan, owner: int, rect: Rect, roof: float, rng: Generator) -> None:
    """Draw plant rooms and lift heads on a flat roof."""
    for _ in range(int(rng.integers(0, 2 + int(rect.width * rect.height / 300)))):
        a, b, tall = rng.uniform(1.5, 6.0), rng.uniform(1.5, 6.0), rng.uniform(0.8, 3.5)
        if a > rect.width - 2 or b > rect.height - 2:
            continue
        u, v = rng.uniform(rect.u0 + 1, rect.u1 - a - 1), rng.uniform(rect.v0 + 1, rect.v1 - b - 1)
        plan.wing(owner, Rect(u, v, u + a, v + b), roof + tall, bottom=roof - 0.5)


def _arcade(plan: Plan, rect: Rect, height: float, rng: Generator) -> None:
    """Draw a slab whose front stands on piers: there is room to walk under it."""
    owner = plan.owner(*rect.centre)
    reach, clear = rng.uniform(2.8, 4.0), rng.uniform(3.2, 4.5)
    plan.wing(owner, Rect(rect.u0, rect.v0 + reach, rect.u1, rect.v1), height)
    plan.wing(owner, Rect(rect.u0, rect.v0, rect.u1, rect.v0 + reach), height, bottom=clear)
    for u in np.arange(rect.u0 + 0.4, rect.u1, rng.uniform(3.5, 5.5)):
        plan.wing(owner, Rect(u - 0.3, rect.v0, u + 0.3, rect.v0 + 0.6), clear)


def _campus(plan: Plan, rect: Rect, rng: Generator) -> None:
    """One to four large buildings of several wings on lawns with rows and clusters of trees."""
    lots = divide(rect.inset(rng.uniform(4, 10)), rng, least=30.0, most=rng.uniform(45, 90), gap=rng.uniform(8, 20))
    rise, hip = (rng.uniform(2, 5), 0.2) if rng.random() < 0.3 else (0.0, 0.0)
    for lot in lots:
        if rng.random() < 0.12:
            scatter_trees(plan, lot, rng, per_hectare=60)
            continue
        body = Rect(
            lot.u0 + rng.uniform(0, 0.2) * lot.width, lot.v0 + rng.uniform(0, 0.2) * lot.height,
            lot.u1 - rng.uniform(0, 0.2) * lot.width, lot.v1 - rng.uniform(0, 0.2) * lot.height,
        )  # fmt: skip
        height = rng.choice([1, 2, 2, 3, 3, 4, 5, 6]) * rng.uniform(3.2, 4.2) + 1.0
        if rng.random() < 0.15 and min(body.width, body.height) > 15:
            _arcade(plan, body, max(height, 7.0), rng)
            continue
        shape = str(rng.choice(_SHAPES))
        owner = _composite(plan, body, rng, shape, rng.uniform(11, 20), height, hip, rise)
        if shape in ("slab", "setback", "court") and rise == 0:
            _roof_boxes(plan, owner, Rect(body.u0, body.v0, body.u1, body.v0 + 11), height, rng)
        scatter_trees(plan, lot, rng, per_hectare=rng.uniform(0, 30))
    rows_of_trees(plan, rect, rng, 0.5)
    if rng.random() < 0.5:
        parking_rows(plan, Rect(rect.u0, rect.v1 - 7, rect.u1, rect.v1), rng, chance=rng.uniform(0.2, 0.9))
    if rng.random() < 0.3:
        plan.barrier(rect.u0 + 2, rect.v0 + 1, rect.u1 - 2, rect.v0 + 1, 0.8, rng.uniform(0.9, 1.8), Label.VEGETATION)


def _slabs(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Long blocks of flats in parallel or at right angles, on lawns."""
    along_u = rng.random() < 0.5
    depth, floors = rng.uniform(9.5, 14.0), int(rng.integers(3, 11))
    height = floors * 2.9 + 1
    inner = rect.inset(rng.uniform(3, 8))
    side = inner.height if along_u else inner.width
    pitch = depth + rng.uniform(14, 32)
    bays = rng.random() < 0.5
    roof = rng.uniform(1.5, 3.5) if rng.random() < 0.25 and floors < 6 else 0.0
    for near in np.arange(0, max(side - depth, 0) + 0.1, pitch):
        total = inner.width if along_u else inner.height
        start = rng.uniform(0, 0.25) * total
        length = rng.uniform(0.5, 1.0) * (total - start)
        if length < 15:
            continue
        top = height * rng.choice([1.0, 1.0, 1.0, 0.7])
        body = (
            Rect(start, near, start + length, near + depth)
            if along_u
            else Rect(near, start, near + depth, start + length)
        )
        body = body.shifted(inner.u0, inner.v0)
        owner = plan.owner(*body.centre)
        plan.wing(owner, body, top, top + roof, along_u=along_u)
        if bays:
            for offset in np.arange(3, length - 5, rng.uniform(7, 12)):
                bay = (Rect(body.u0 + offset, body.v0 - 1.4, body.u0 + offset + 3, body.v0) if along_u
                       else Rect(body.u0 - 1.4, body.v0 + offset, body.u0, body.v0 + offset + 3))  # fmt: skip
                plan.wing(owner, bay, top - rng.uniform(0, 1.5), bottom=0.0 if rng.random() < 0.5 else 2.6)
        if roof == 0:
            _roof_boxes(plan, owner, body, top, rng)
    scatter_trees(plan, rect.inset(2), rng, per_hectare=rng.uniform(10, 60), height=(5, 15))
    rows_of_trees(plan, rect, rng, 0.4)
    if rng.random() < 0.6:
        parking_rows(plan, Rect(rect.u0, rect.v0, rect.u1, rect.v0 + 6), rng, chance=rng.uniform(0.3, 0.9))


def _towers(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Free-standing towers with low plinths."""
    for lot in divide(rect.inset(6), rng, least=28, most=50, gap=12):
        size_u, size_v = rng.uniform(15, 24), rng.uniform(15, 24)
        u = rng.uniform(lot.u0, max(lot.u1 - size_u, lot.u0 + 0.1))
        v = rng.uniform(lot.v0, max(lot.v1 - size_v, lot.v0 + 0.1))
        body = Rect(u, v, u + size_u, v + size_v)
        height = rng.uniform(18, 55)
        owner = plan.owner(*body.centre)
        plan.wing(owner, body, height)
        _roof_boxes(plan, owner, body, height, rng)
        if rng.random() < 0.6:
            plan.wing(owner, Rect(u - rng.uniform(0, 8), v - rng.uniform(0, 8), u + size_u + 3, v + size_v + 3),
                      rng.uniform(3.5, 6.0))  # fmt: skip
    scatter_trees(plan, rect.inset(2), rng, per_hectare=rng.uniform(15, 60), height=(5, 15))
    parking_rows(plan, Rect(rect.u0, rect.v1 - 7, rect.u1, rect.v1), rng, chance=0.6)


# Suburb ---------------------------------------------------------------------------------------------------------------


def _detached(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Single houses in gardens: hedges, fences, garages, fruit trees."""
    along_u = rect.width >= rect.height
    long_side, short_side = (rect.width, rect.height) if along_u else (rect.height, rect.width)
    rows = 2 if short_side > 36 else 1
    parcel, setback = rng.uniform(13, 24), rng.uniform(3, 8)
    hedge, hedge_height = rng.uniform(0.2, 0.9), rng.uniform(1.0, 2.2)
    green = rng.uniform(0.5, 3.0)
    for row in range(rows):
        position = 0.0
        while position < long_side - 0.6 * parcel:
            front = min(parcel * rng.uniform(0.8, 1.3), long_side - position)
            low, high = (row * short_side / rows, (row + 1) * short_side / rows)
            lot = (
                Rect(position, low, position + front, high) if along_u else Rect(low, position, high, position + front)
            )
            lot = lot.shifted(rect.u0, rect.v0)
            position += front
            _single_house(plan, lot, rng, along_u, row == 0, setback)
            for _ in range(rng.poisson(green)):
                plan.tree(rng.uniform(lot.u0 + 1, lot.u1 - 1), rng.uniform(lot.v0 + 1, lot.v1 - 1), rng,
                          height=(3.5, 10.0), kinds=(0.6, 0.15, 0.05, 0.2))  # fmt: skip
            if rng.random() < hedge:
                label = Label.VEGETATION if rng.random() < 0.7 else Label.STRUCTURE
                thick = 0.8 if label == Label.VEGETATION else 0.12
                plan.enclosure(lot.inset(0.6), thick, hedge_height, label, rng)


def _single_house(plan: Plan, lot: Rect, rng: Generator, along_u: bool, first_row: bool, setback: float) -> None:
    front, deep = (lot.width, lot.height) if along_u else (lot.height, lot.width)
    width, depth = min(rng.uniform(7.5, 13), front - 3), min(rng.uniform(7.5, 12), deep - setback - 2)
    if width < 5 or depth < 5:
        return
    a = rng.uniform(1.2, max(front - width - 1.2, 1.3))
    b = setback * rng.uniform(0.8, 1.2) if first_row else deep - depth - setback * rng.uniform(0.8, 1.2)

    def place(a0: float, b0: float, a1: float, b1: float) -> Rect:
        if along_u:
            return Rect(lot.u0 + a0, lot.v0 + b0, lot.u0 + a1, lot.v0 + b1)
        return Rect(lot.u0 + b0, lot.v0 + a0, lot.u0 + b1, lot.v0 + a1)

    body = place(a, b, a + width, b + depth)
    owner = plan.owner(*body.centre)
    eave = rng.uniform(2.8, 6.5)
    rise = 0.0 if rng.random() < 0.15 else 0.5 * min(width, depth) * rng.uniform(0.5, 1.2)
    plan.wing(owner, body, eave, eave + rise, along_u=bool(rng.random() < 0.5), hip=0.3 * float(rng.random() < 0.35))
    if rng.random() < 0.35:
        bay = rng.uniform(3, 0.6 * width + 2)
        plan.wing(owner, place(a, b - 2.5 if first_row else b + depth, a + bay, b if first_row else b + depth + 2.5),
                  0.9 * eave, 0.9 * eave + 0.6 * rise, along_u=not along_u)  # fmt: skip
    if rng.random() < 0.5 and front - width > 5:
        side = a - 3.6 if a > 4.5 else a + width + 0.4
        plan.wing(plan.owner(*body.centre), place(side, b + 1, side + 3.2, b + 7), 2.4,
                  2.4 + 1.2 * float(rng.random() < 0.4))  # fmt: skip
        yaw = np.pi / 2 if along_u else 0.0
        car_u, car_v = place(side, b - 3.5 if first_row else b + 10.0, side + 3.2, b).centre
        plan.cars.append((car_u, car_v, yaw, 0.5, rng.random()))


# Industry -------------------------------------------------------------------------------------------------------------


def _halls(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Large halls with flat, shallow or saw-tooth roofs, yards with containers and lorries, fences."""
    for lot in divide(rect.inset(rng.uniform(3, 8)), rng, least=35, most=rng.uniform(60, 110), gap=rng.uniform(8, 18)):
        yard = rng.uniform(0.0, 0.4)
        body = Rect(lot.u0, lot.v0 + yard * lot.height * float(rng.random() < 0.5), lot.u1,
                    lot.v1 - yard * lot.height * float(rng.random() < 0.5))  # fmt: skip
        owner = plan.owner(*body.centre)
        eave = rng.uniform(5, 13)
        style = rng.random()
        if style < 0.4:
            plan.wing(owner, body, eave)
            _roof_boxes(plan, owner, body, eave, rng)
        elif style < 0.7:
            bays = max(1, int(body.width / rng.uniform(16, 30)))
            step = body.width / bays
            rise = rng.uniform(1.0, 3.5)
            for i in range(bays):
                bay = Rect(body.u0 + i * step, body.v0, body.u0 + (i + 1) * step, body.v1)
                plan.wing(owner, bay, eave, eave + rise, along_u=False)
        else:
            cut = body.u0 + rng.uniform(0.4, 0.8) * body.width
            plan.wing(owner, Rect(body.u0, body.v0, cut, body.v1), eave)
            plan.wing(owner, Rect(cut, body.v0 + rng.uniform(0, 12), body.u1, body.v1), eave * rng.uniform(0.5, 1.6))
        if rng.random() < 0.5:
            office = Rect(body.u0 + 3, body.v0 - 6, body.u0 + rng.uniform(12, 28), body.v0)
            plan.wing(owner, office, rng.uniform(4, 11))
        for _ in range(rng.poisson(5)):
            u, v = rng.uniform(rect.u0 + 3, rect.u1 - 3), rng.uniform(rect.v0 + 2, rect.v0 + 6)
            plan.cars.append((u, v, float(rng.integers(2)) * np.pi / 2, 0.7, 1.0))
        for _ in range(int(rng.integers(0, 3))):
            plan.poles.append((rng.uniform(*lot[::2]), rng.uniform(*lot[1::2]), rng.uniform(8, 22),
                               rng.uniform(1.0, 3.0), rng.uniform(0.8, 2.6), float(Label.BUILDING)))  # fmt: skip
    if rng.random() < 0.7:
        plan.enclosure(rect.inset(0.8), 0.1, rng.uniform(1.6, 2.4), Label.STRUCTURE, rng)
    rows_of_trees(plan, rect, rng, 0.2)
    scatter_trees(plan, rect.inset(1), rng, per_hectare=rng.uniform(0, 12))


def _tanks(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Round tanks and silos."""
    for lot in divide(rect.inset(5), rng, least=14, most=32, gap=5):
        radius = 0.5 * min(lot.width, lot.height) * rng.uniform(0.6, 0.95)
        u, v = lot.centre
        height = rng.uniform(6, 18)
        plan.poles.append((u, v, height, radius, radius, float(Label.BUILDING)))
    plan.enclosure(rect.inset(0.8), 0.1, 2.2, Label.STRUCTURE, rng)


# Green and open -------------------------------------------------------------------------------------------------------


def _garden(plan: Plan, rect: Rect, rng: Generator) -> None:
    """A park: clusters of trees, open lawn, a pond, avenues, a pavilion."""
    plan.pedestrians.append(rect.inset(3))
    for _ in range(max(1, int(rect.width * rect.height / rng.uniform(600, 1800)))):
        u, v = within(rng, rect.u0 + 3, rect.u1 - 3), within(rng, rect.v0 + 3, rect.v1 - 3)
        spread = rng.uniform(3, 14)
        for _ in range(int(rng.integers(1, 9))):
            a, b = u + spread * rng.standard_normal(), v + spread * rng.standard_normal()
            if rect.u0 < a < rect.u1 and rect.v0 < b < rect.v1:
                plan.tree(a, b, rng, height=(5, 18), kinds=(0.7, 0.15, 0.05, 0.1))
    rows_of_trees(plan, rect, rng, 0.6)
    if rng.random() < 0.4 and min(rect.width, rect.height) > 40:
        plan.water.append(rect.inset(rng.uniform(12, 18)))
    if rng.random() < 0.4:
        u, v = within(rng, rect.u0 + 6, rect.u1 - 6), within(rng, rect.v0 + 6, rect.v1 - 6)
        size = rng.uniform(3, 6)
        plan.wing(plan.owner(u, v), Rect(u - size, v - size, u + size, v + 0.7 * size), 3.2, 5.0, hip=0.4)
    if rng.random() < 0.4:
        plan.enclosure(rect.inset(0.7), 0.9, rng.uniform(0.9, 2.0), Label.VEGETATION, rng)


def _wood(plan: Plan, rect: Rect, rng: Generator) -> None:
    """A dense wood with a path left free."""
    conifers = rng.uniform(0, 0.6)
    path = rng.uniform(0.3, 0.7)
    for _ in range(int(rect.width * rect.height * rng.uniform(0.012, 0.024))):
        u, v = rng.uniform(rect.u0, rect.u1), rng.uniform(rect.v0, rect.v1)
        bend = rect.v0 + path * rect.height + 0.1 * rect.height * np.sin((u - rect.u0) / 15)
        if abs(v - bend) > 3:
            plan.tree(u, v, rng, height=(7, 19), kinds=(1 - conifers, conifers, 0.02, 0.15))


def _car_park(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Rows of parking bays with trees between."""
    chance = rng.uniform(0.15, 0.95)
    for v in np.arange(rect.v0 + 4, rect.v1 - 8, 16.5):
        parking_rows(plan, Rect(rect.u0 + 3, v, rect.u1 - 3, v + 5), rng, chance=chance, certain=True)
        parking_rows(plan, Rect(rect.u0 + 3, v + 5, rect.u1 - 3, v + 10), rng, chance=chance, certain=True)
        if rng.random() < 0.5:
            for u in np.arange(rect.u0 + 6, rect.u1 - 6, rng.uniform(9, 16)):
                plan.tree(u, v + 5, rng, height=(4.5, 8.0))
    if rng.random() < 0.4:
        u, v = rect.u0 + 6, rect.v0 + 6
        plan.wing(plan.owner(u, v), Rect(u, v, u + rng.uniform(6, 20), v + rng.uniform(5, 12)), rng.uniform(3, 6))


# Streets --------------------------------------------------------------------------------------------------------------


def _draw_canal(plan: Plan, street: Street, half_width: float, rng: Generator) -> None:
    """Draw the water of a canal between its quays, with a bridge every block or so."""
    start = 0.0
    while start < street.length:
        end = min(start + rng.uniform(45.0, 90.0), street.length)
        (u0, v0), (u1, v1) = street.at(start, -half_width), street.at(end, half_width)
        plan.water.append(Rect(min(u0, u1), min(v0, v1), max(u0, u1), max(v0, v1)))
        start = end + rng.uniform(7.0, 12.0)


def draw_street(plan: Plan, street: Street, family: Family, rng: Generator) -> None:
    """Draw what lines a street: canal, trees, parked cars, lamps, signs."""
    if street.quay_m > 0:
        draw_quays(plan, street, rng)
        return
    half = street.width / 2
    canal = street.level < 3 and street.width > 15 and rng.random() < family.canals
    bank = float(rng.uniform(4.5, 6.5)) if canal else 0.0
    if canal:
        _draw_canal(plan, street, half - bank, rng)
    plan.pedestrians.append(street.rect)
    trees = rng.random() < family.street_trees and street.width > 9
    if trees or (canal and rng.random() < 0.7):
        tall, spacing = rng.uniform(7, 15), rng.uniform(8, 15)
        across = half - bank + 1.0 if canal else half - rng.uniform(1.5, 2.5)
        kinds = (0.95, 0.0, 0.05, 0.0) if rng.random() < 0.85 else (0.1, 0.0, 0.9, 0.0)
        for side in (-1, 1) if canal or rng.random() < 0.7 else (1,):
            for along in np.arange(rng.uniform(0, spacing), street.length, spacing):
                if rng.random() < 0.9:
                    plan.tree(*street.at(along, side * across), rng, height=(0.85 * tall, 1.15 * tall), kinds=kinds)
    if street.width > 7:
        across = half - bank + 2.2 if canal else half - rng.uniform(2.4, 3.0)
        for side in (-1, 1):
            occupied = family.parked * rng.uniform(0.2, 1.6) * float(rng.random() < 0.8)
            if occupied <= 0 or (side > 0 and street.width < 9):
                continue
            for along in np.arange(5, street.length - 5, 5.9):
                plan.cars.append((*street.at(along, side * across), street.yaw_rad, min(occupied, 0.95), rng.random()))
        for along in np.arange(rng.uniform(5, 40), street.length, 45):
            across_lane = rng.choice([-1, 1]) * 0.2 * street.width
            if not canal:
                plan.cars.append((*street.at(along, across_lane), street.yaw_rad, 0.12, rng.random()))
    lit = float(rng.choice([-1, 1]))
    height, spacing = rng.uniform(4.5, 9.5), rng.uniform(22, 38)
    for along in np.arange(rng.uniform(2, spacing), street.length, spacing):
        plan.poles.append((*street.at(along, lit * (half - 0.6)), height, 0.12, 0.08, float(Label.STRUCTURE)))
    for along in np.arange(rng.uniform(5, 40), street.length, rng.uniform(25, 60)):
        place = street.at(along, -lit * (half - 0.5))
        if rng.random() < 0.8:
            plan.poles.append((*place, rng.uniform(0.9, 3.2), 0.05, 0.3, float(Label.STRUCTURE)))
        else:
            size = 1.6
            shelter = Rect(place[0] - size, place[1] - size / 2, place[0] + size, place[1] + size / 2)
            plan.wing(plan.owner(*place), shelter, 2.5, label=Label.STRUCTURE)


_KINDS: dict[str, Callable[[Plan, Rect, Generator], None]] = {
    "closed": _closed, "terraces": _terraces, "square": _square, "church": _church, "monument": _monument,
    "campus": _campus, "slabs": _slabs, "towers": _towers, "detached": _detached, "halls": _halls, "tanks": _tanks,
    "garden": _garden, "wood": _wood, "car_park": _car_park, **CANAL_KINDS, **VILLAGE_KINDS, **HARBOUR_KINDS,
}  # fmt: skip
