"""What several families draw with: houses, rows of houses, lots, trees, parked cars."""

from __future__ import annotations

import numpy as np

from crossloc3d_ros.simulation.layout import Plan, Rect

Generator = np.random.Generator


def within(rng: Generator, low: float, high: float) -> float:
    """Return a place between two bounds, the lower one where a block is too small for the upper."""
    return float(rng.uniform(low, max(low, high)))


def town_house(
    plan: Plan, rect: Rect, eave: float, rng: Generator, *, front_along_u: bool, flat: float = 0.25, gable: float = 0.45
) -> int:
    """Draw a town house: flat, ridge along the street, or gable to the street, with chimneys and dormers."""
    owner = plan.owner(*rect.centre)
    draw = rng.random(6)
    across = rect.height if front_along_u else rect.width
    front = rect.width if front_along_u else rect.height
    if draw[0] < flat:
        plan.wing(owner, rect, eave)
        top = eave
        if draw[4] < 0.3 and min(rect.width, rect.height) > 5:
            plan.wing(owner, rect.inset(1.5), eave + 2.8, bottom=eave - 0.5)
    else:
        ridge_along_street = draw[0] > flat + gable
        span = across if ridge_along_street else front
        top = eave + min(0.5 * span * (0.6 + 0.7 * draw[1]), 6.5)
        along_u = front_along_u if ridge_along_street else not front_along_u
        plan.wing(owner, rect, eave, top, along_u=along_u, hip=0.25 * float(draw[2] < 0.3))
    if draw[3] < 0.6:
        u = rect.u0 + rect.width * (0.1 + 0.8 * draw[4])
        v = rect.v0 + rect.height * (0.1 + 0.8 * draw[5])
        plan.wing(owner, Rect(u - 0.45, v - 0.45, u + 0.45, v + 0.45), top + 0.8, bottom=eave - 0.5)
    return owner


def row_houses(
    plan: Plan,
    rect: Rect,
    rng: Generator,
    *,
    depth: float,
    eave: float,
    spread: float,
    flat: float,
    gable: float,
    front: float,
    missing: float,
    hall: float = 0.3,
) -> None:
    """Draw houses shoulder to shoulder along all sides of a block, with annexes and gardens behind.

    `depth`, `front` of a house and `eave` with its `spread` in metres; `flat`, `gable`, `missing`: shares of the houses
    with a flat roof, with the gable to the street, and of gaps; `hall` chance of a hall in the yard.
    """
    inner = rect.inset(depth)
    sides = [
        (Rect(rect.u0, rect.v0, rect.u1, inner.v0), True, 1.0), (Rect(rect.u0, inner.v1, rect.u1, rect.v1), True, -1.0),
        (Rect(rect.u0, inner.v0, inner.u0, inner.v1), False, 1.0),
        (Rect(inner.u1, inner.v0, rect.u1, inner.v1), False, -1.0),
    ]  # fmt: skip
    for side, along_u, inward in sides:
        length = side.width if along_u else side.height
        position = 0.0
        while position < length - 0.5:
            wide = front * rng.uniform(0.6, 1.5)
            if length - position - wide < 0.6 * front:
                wide = length - position
            start, end = position, position + wide
            position = end
            if rng.random() < missing:
                continue
            back = rng.uniform(-1.5, 1.0) if inner.width > 4 and inner.height > 4 else 0.0
            if along_u:
                low, high = (side.v0, side.v1 + back) if inward > 0 else (side.v0 - back, side.v1)
                house = Rect(side.u0 + start, low, side.u0 + end, high)
            else:
                low, high = (side.u0, side.u1 + back) if inward > 0 else (side.u0 - back, side.u1)
                house = Rect(low, side.v0 + start, high, side.v0 + end)
            owner = town_house(
                plan, house, max(3.2, eave + spread * rng.standard_normal()), rng,
                front_along_u=along_u, flat=flat, gable=gable,
            )  # fmt: skip
            room = (inner.height if along_u else inner.width) * 0.42
            if rng.random() < 0.45 and room > 3:
                reach, share = rng.uniform(2.0, room), rng.uniform(0.35, 0.8)
                if along_u:
                    near = house.v1 if inward > 0 else house.v0 - reach
                    shed = Rect(house.u0, near, house.u0 + share * house.width, near + reach)
                else:
                    near = house.u1 if inward > 0 else house.u0 - reach
                    shed = Rect(near, house.v0, near + reach, house.v0 + share * house.height)
                plan.wing(owner, shed, rng.uniform(2.6, 6.5))
    if inner.width > 6 and inner.height > 6:
        scatter_trees(plan, inner.inset(2.0), rng, per_hectare=rng.uniform(10, 90), height=(5.0, 12.0))
        if rng.random() < hall and inner.width > 16 and inner.height > 16:
            yard = inner.inset(rng.uniform(5.0, 7.5))
            low = rng.uniform(3.5, 8.0)
            plan.wing(plan.owner(*yard.centre), yard, low, low + rng.uniform(0, 3))


def divide(rect: Rect, rng: Generator, *, least: float, most: float, gap: float) -> list[Rect]:
    """Divide a block into lots with gaps between."""
    longer = max(rect.width, rect.height)
    if longer < most or longer < 2 * least + gap:
        return [rect] if min(rect.width, rect.height) > 8 else []
    share = rng.uniform(0.38, 0.62)
    if rect.width >= rect.height:
        middle = rect.u0 + share * rect.width
        halves = [Rect(rect.u0, rect.v0, middle - gap / 2, rect.v1), Rect(middle + gap / 2, rect.v0, rect.u1, rect.v1)]
    else:
        middle = rect.v0 + share * rect.height
        halves = [Rect(rect.u0, rect.v0, rect.u1, middle - gap / 2), Rect(rect.u0, middle + gap / 2, rect.u1, rect.v1)]
    return [lot for half in halves for lot in divide(half, rng, least=least, most=most, gap=gap)]


def scatter_trees(
    plan: Plan, rect: Rect, rng: Generator, *, per_hectare: float, height: tuple[float, float] = (5.0, 15.0)
) -> None:
    """Draw trees anywhere in a rectangle."""
    for _ in range(rng.poisson(max(per_hectare, 0) * max(rect.width, 0) * max(rect.height, 0) / 1e4)):
        plan.tree(rng.uniform(rect.u0, rect.u1), rng.uniform(rect.v0, rect.v1), rng, height=height)


def rows_of_trees(plan: Plan, rect: Rect, rng: Generator, chance: float) -> None:
    """Draw rows of like trees just inside some of a block's sides."""
    tall, spacing, margin = rng.uniform(7, 15), rng.uniform(7, 13), rng.uniform(2, 4)
    kinds = (0.9, 0.0, 0.1, 0.0) if rng.random() < 0.8 else (0.1, 0.0, 0.9, 0.0)
    for along_u, line in ((True, rect.v0 + margin), (True, rect.v1 - margin), (False, rect.u0 + margin),
                          (False, rect.u1 - margin)):  # fmt: skip
        if rng.random() > chance:
            continue
        low, high = (rect.u0, rect.u1) if along_u else (rect.v0, rect.v1)
        for position in np.arange(low + 4, high - 4, spacing):
            if rng.random() < 0.92:
                u, v = (position, line) if along_u else (line, position)
                plan.tree(u, v, rng, height=(tall, 1.15 * tall), kinds=kinds)


def parking_rows(plan: Plan, rect: Rect, rng: Generator, *, chance: float, certain: bool = False) -> None:
    """Draw bays at right angles to u along a strip, in one stretch or all along."""
    start, end = (0.0, 1.0) if certain else np.sort(rng.random(2))
    v = 0.5 * (rect.v0 + rect.v1)
    for u in np.arange(rect.u0 + start * rect.width + 1.3, rect.u0 + end * rect.width - 1.3, 2.6):
        plan.cars.append((u, v, np.pi / 2, chance, rng.random()))
