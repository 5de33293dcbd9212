"""A village: farmsteads at all angles, cottages, orchards, meadows, stone walls and hedges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crossloc3d_ros.simulation.drawing import divide, scatter_trees, within
from crossloc3d_ros.simulation.layout import Plan, Rect
from crossloc3d_ros.simulation.scene import Label

Generator = np.random.Generator


def _farmstead(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Draw farms: house, barn, stables and sheds around a yard, each farm at an angle of its own."""
    for lot in divide(rect.inset(2.0), rng, least=30.0, most=rng.uniform(48, 75), gap=rng.uniform(2, 8)):
        side = min(lot.width, lot.height)
        with plan.turned(lot.centre, float(rng.uniform(-0.45, 0.45)) if side > 26 else 0.0):
            _farm(plan, _middle(lot, min(0.8 * side, 46.0)), rng)
        scatter_trees(plan, lot, rng, per_hectare=rng.uniform(10, 70), height=(4.0, 15.0))
    if rng.random() < 0.65:
        _fence(plan, rect.inset(0.6), rng)


def _middle(lot: Rect, side: float) -> Rect:
    u, v = lot.centre
    return Rect(u - side / 2, v - side / 2, u + side / 2, v + side / 2)


def _farm(plan: Plan, yard: Rect, rng: Generator) -> None:
    size = yard.width
    if size < 16:
        _cottage(plan, yard, rng)
        return
    deep, long = rng.uniform(7.5, 10.5), rng.uniform(0.4, 0.75) * size
    home = Rect(yard.u0, yard.v0, yard.u0 + long, yard.v0 + deep)
    eave = rng.uniform(2.8, 5.2)
    owner = plan.owner(*home.centre)
    plan.wing(owner, home, eave, eave + 0.5 * deep * rng.uniform(0.8, 1.3), along_u=True,
              hip=0.2 * float(rng.random() < 0.4))  # fmt: skip
    wide = min(rng.uniform(9.0, 15.0), 0.42 * size)
    barn = Rect(yard.u1 - wide, yard.v0 + rng.uniform(0, 4), yard.u1, yard.v0 + rng.uniform(0.6, 0.95) * size)
    high = rng.uniform(3.5, 6.5)
    plan.wing(plan.owner(*barn.centre), barn, high, high + 0.5 * wide * rng.uniform(0.7, 1.1), along_u=False,
              hip=0.3 * float(rng.random() < 0.3))  # fmt: skip
    if rng.random() < 0.75:
        low = rng.uniform(2.4, 4.0)
        stable = Rect(yard.u0, yard.v1 - rng.uniform(5, 8), yard.u0 + rng.uniform(0.3, 0.55) * size, yard.v1)
        plan.wing(plan.owner(*stable.centre), stable, low, low + rng.uniform(0.5, 3.0), along_u=True)
    if rng.random() < 0.35:
        # A roof on posts, open on all sides.
        shed = Rect(yard.u0 - 1, yard.v0 + 0.45 * size, yard.u0 + 7, yard.v0 + 0.45 * size + rng.uniform(7, 12))
        roof = plan.owner(*shed.centre)
        plan.wing(roof, shed, 4.4, 5.8, bottom=4.2)
        for u in (shed.u0 + 0.2, shed.u1 - 0.2):
            for v in np.arange(shed.v0 + 0.2, shed.v1, 3.4):
                plan.wing(roof, Rect(u - 0.12, v - 0.12, u + 0.12, v + 0.12), 4.3)
    if rng.random() < 0.4:
        radius = rng.uniform(1.6, 3.2)
        plan.poles.append((yard.u1 - rng.uniform(2, 8), yard.v1 - rng.uniform(1, 4), rng.uniform(5, 13), radius, radius,
                           float(Label.BUILDING)))  # fmt: skip
    for _ in range(rng.poisson(1.5)):
        u, v = rng.uniform(yard.u0, yard.u1), rng.uniform(yard.v0 + 0.4 * size, yard.v1)
        plan.wing(plan.owner(u, v), Rect(u, v, u + rng.uniform(2, 7), v + rng.uniform(1.5, 3.5)), rng.uniform(1.2, 3.2),
                  label=Label.STRUCTURE)  # fmt: skip
    for _ in range(rng.poisson(1.2)):
        u, v = yard.u0 + rng.uniform(0.2, 0.6) * size, yard.v0 + deep + rng.uniform(0.2, 0.6) * (size - deep)
        plan.cars.append((u, v, rng.uniform(0, 6.28), 0.6, rng.uniform(0.4, 1.0)))


def _cottages(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Small old houses close to the lane, each at its own angle and distance, with sheds and kitchen gardens."""
    along_u = rect.width >= rect.height
    length, deep = (rect.width, rect.height) if along_u else (rect.height, rect.width)
    for far in (False, True) if deep > 40 else (False,):
        position = rng.uniform(1, 6)
        while position < length - 10:
            front, back = rng.uniform(9, 20), min(rng.uniform(14, 24), deep / (2 if deep > 40 else 1))
            near = rng.uniform(0.3, 6.0)
            low = deep - near - back if far else near
            u0, v0 = (position, low) if along_u else (low, position)
            lot = (Rect(u0, v0, u0 + front, v0 + back) if along_u else Rect(u0, v0, u0 + back, v0 + front)).shifted(
                rect.u0, rect.v0
            )
            with plan.turned(lot.centre, float(rng.normal(0.0, 0.18))):
                _cottage(plan, lot, rng)
            position += front + rng.uniform(1, 14)
    scatter_trees(plan, rect.inset(1.5), rng, per_hectare=rng.uniform(20, 80), height=(3.5, 11.0))
    if rng.random() < 0.8:
        _fence(plan, rect.inset(0.5), rng)


def _cottage(plan: Plan, lot: Rect, rng: Generator) -> None:
    wide, deep = min(rng.uniform(8, 14), lot.width - 1), min(rng.uniform(6, 8.5), lot.height - 1)
    if wide < 4 or deep < 4:
        return
    body = Rect(lot.u0, lot.v0, lot.u0 + wide, lot.v0 + deep)
    eave, owner = rng.uniform(2.3, 4.8), plan.owner(*body.centre)
    plan.wing(owner, body, eave, eave + 0.5 * min(wide, deep) * rng.uniform(0.9, 1.5), hip=0.15 * rng.integers(2))
    u = body.u0 + rng.uniform(0.5, wide - 1.2)
    v = body.centre[1]
    plan.wing(owner, Rect(u, v, u + 0.8, v + 0.8), eave + 0.6 * deep + 0.9, bottom=eave - 0.5)
    if rng.random() < 0.5:
        annex = Rect(body.u0 + rng.uniform(0, 0.4) * wide, body.v1, body.u0 + 0.8 * wide, body.v1 + rng.uniform(2, 4.5))
        plan.wing(owner, annex, 2.2, rng.uniform(2.4, 3.6), along_u=True)
    if rng.random() < 0.6:
        u, v = lot.u0 + rng.uniform(0, max(lot.width - 4, 0.1)), lot.v1 - rng.uniform(3, 5)
        if v > body.v1 + 1:
            plan.wing(plan.owner(u, v), Rect(u, v, u + rng.uniform(2, 4), v + rng.uniform(2, 3.5)), 2.1, 3.0)


def _orchard(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Fruit trees in rows behind a hedge or a wall, with a hut."""
    tall, pitch = rng.uniform(3.5, 6.5), rng.uniform(5.0, 8.0)
    inner = rect.inset(3.5)
    with plan.turned(inner.centre, float(rng.uniform(-0.12, 0.12))):
        for u in np.arange(inner.u0, inner.u1, pitch):
            for v in np.arange(inner.v0, inner.v1, pitch):
                if rng.random() < 0.85:
                    plan.tree(u, v, rng, height=(0.8 * tall, 1.2 * tall), kinds=(0.85, 0.0, 0.0, 0.15))
    if rng.random() < 0.6:
        u, v = within(rng, inner.u0, inner.u1 - 5), within(rng, inner.v0, inner.v1 - 5)
        plan.wing(plan.owner(u, v), Rect(u, v, u + 4, v + 3.2), 2.3, 3.4)
    _fence(plan, rect.inset(0.7), rng)


def _meadow(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Open grass with a pond, single old trees, bales and posts, between hedges."""
    scatter_trees(plan, rect.inset(3), rng, per_hectare=rng.uniform(4, 22), height=(9.0, 19.0))
    for _ in range(rng.poisson(5)):
        u, v = within(rng, rect.u0 + 3, rect.u1 - 3), within(rng, rect.v0 + 3, rect.v1 - 3)
        plan.poles.append((u, v, 1.3, 0.7, 0.7, float(Label.STRUCTURE)))
    if rng.random() < 0.4 and min(rect.width, rect.height) > 45:
        plan.water.append(rect.inset(0.36 * min(rect.width, rect.height)))
    if rng.random() < 0.5:
        u, v = within(rng, rect.u0 + 4, rect.u1 - 16), within(rng, rect.v0 + 4, rect.v1 - 12)
        plan.wing(plan.owner(u, v), Rect(u, v, u + rng.uniform(6, 12), v + rng.uniform(5, 8)), 2.8, 4.4)
    _fence(plan, rect.inset(0.7), rng)


def _fence(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Draw a stone wall, a hedge or a wooden fence around a piece of land."""
    draw = rng.random()
    if draw < 0.45:
        plan.enclosure(rect, rng.uniform(0.4, 0.7), rng.uniform(0.9, 2.1), Label.STRUCTURE, rng)
    elif draw < 0.85:
        plan.enclosure(rect, rng.uniform(0.8, 1.6), rng.uniform(1.1, 3.0), Label.VEGETATION, rng)
    else:
        plan.enclosure(rect, 0.1, rng.uniform(1.0, 1.5), Label.STRUCTURE, rng)


KINDS: dict[str, Callable[[Plan, Rect, Generator], None]] = {
    "farmstead": _farmstead, "cottages": _cottages, "orchard": _orchard, "meadow": _meadow,
}  # fmt: skip
