"""A harbour: basins with ships and cranes, container stacks, long warehouses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crossloc3d_ros.simulation.drawing import scatter_trees
from crossloc3d_ros.simulation.layout import Plan, Rect
from crossloc3d_ros.simulation.scene import Label

Generator = np.random.Generator

_CONTAINER_M = (12.2, 2.44, 2.6)


def _containers(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Containers in bays one to five high, lanes between, gantries over some of them."""
    along_u = rng.random() < 0.5
    length, wide, tall = _CONTAINER_M
    inner = rect.inset(rng.uniform(4.0, 9.0))
    total, across = (inner.width, inner.height) if along_u else (inner.height, inner.width)
    most, filled, abreast = int(rng.integers(2, 6)), rng.uniform(0.5, 0.95), int(rng.integers(3, 7))
    lane, gap = rng.uniform(8.0, 15.0), rng.uniform(1.0, 4.5)

    def place(a0: float, b0: float, a1: float, b1: float) -> Rect:
        flat = Rect(a0, b0, a1, b1) if along_u else Rect(b0, a0, b1, a1)
        return flat.shifted(inner.u0, inner.v0)

    deep = abreast * (wide + 0.35)
    for near in np.arange(0.0, across - deep, deep + lane):
        for start in np.arange(0.0, total - length, length + gap):
            if rng.random() > filled:
                continue
            level = int(rng.integers(1, most + 1))
            for i in range(abreast):
                high = max(0, level - int(rng.integers(0, 3)))
                if high == 0:
                    continue
                b = near + i * (wide + 0.35)
                pieces = [(start, start + length)]
                if rng.random() < 0.3:
                    pieces = [(start, start + 6.06), (start + 6.14, start + length)]
                for a0, a1 in pieces:
                    box = place(a0, b, a1, b + wide)
                    plan.wing(plan.owner(*box.centre), box, high * tall, label=Label.STRUCTURE)
        if rng.random() < 0.35:
            start = rng.uniform(0, max(total - 14, 0.1))
            _gantry(plan, place, start, start + 12, near - 2.5, near + deep + 2.5, rng.uniform(15, 21))
    for _ in range(rng.poisson(5)):
        u, v = rng.uniform(rect.u0 + 2, rect.u1 - 2), rng.uniform(rect.v0 + 1.5, rect.v0 + 4)
        plan.cars.append((u, v, 0.0, 0.7, 1.0))
    scatter_trees(plan, Rect(rect.u0, rect.v1 - 2.5, rect.u1, rect.v1), rng, per_hectare=rng.uniform(0, 150))
    for u in (rect.u0 + 2, rect.u1 - 2):
        plan.poles.append((u, rng.uniform(rect.v0, rect.v1), rng.uniform(22, 32), 0.5, 0.3, float(Label.STRUCTURE)))


def _gantry(
    plan: Plan, place: Callable[[float, float, float, float], Rect], a0: float, a1: float, b0: float, b1: float,
    high: float,
) -> None:  # fmt: skip
    """Draw a frame on four legs that spans from b0 to b1."""
    owner = plan.owner(*place(a0, b0, a1, b1).centre)
    for a in (a0, a1):
        for b in (b0, b1):
            plan.wing(owner, place(a - 0.4, b - 0.4, a + 0.4, b + 0.4), high, label=Label.STRUCTURE)
        plan.wing(owner, place(a - 0.6, b0 - 3, a + 0.6, b1 + 3), high + 1.6, bottom=high, label=Label.STRUCTURE)
    for b in (b0, b1):
        plan.wing(owner, place(a0, b - 0.3, a1, b + 0.3), 0.6 * high + 0.8, bottom=0.6 * high, label=Label.STRUCTURE)


def _basin(plan: Plan, rect: Rect, rng: Generator) -> None:
    """A basin between quays, ships along them, cranes that reach over the water."""
    quay = rng.uniform(13.0, 20.0)
    water = rect.inset(quay)
    if min(water.width, water.height) < 25:
        _warehouses(plan, rect, rng)
        return
    plan.water.append(water)
    along_u = water.width >= water.height
    total, across = (water.width, water.height) if along_u else (water.height, water.width)

    def place(a0: float, b0: float, a1: float, b1: float) -> Rect:
        flat = Rect(a0, b0, a1, b1) if along_u else Rect(b0, a0, b1, a1)
        return flat.shifted(water.u0, water.v0)

    for far in (False, True):
        position = rng.uniform(2, 12)
        while position < total - 20:
            length = min(rng.uniform(22, 95), total - position - 2)
            beam = min(rng.uniform(5.0, 9.0) + 0.08 * length, 0.4 * across)
            if rng.random() < 0.7:
                low = across - 1.2 - beam if far else 1.2
                _ship(plan, place, position, low, length, beam, rng)
            position += length + rng.uniform(4, 25)
        cranes = rng.random() < 0.75
        for start in np.arange(rng.uniform(5, 40), total - 14, rng.uniform(35, 80)):
            if cranes:
                _crane(plan, place, float(start), across, far, rng)
        for start in np.arange(3, total, 9.0):
            b = across + 0.7 if far else -0.7
            bollard = place(float(start) - 0.25, b - 0.25, float(start) + 0.25, b + 0.25)
            plan.wing(plan.owner(*bollard.centre), bollard, 0.6, label=Label.STRUCTURE)
    if rng.random() < 0.6:
        shed = place(rng.uniform(0.0, 0.3) * total, across + 6.5, rng.uniform(0.5, 1.0) * total, across + quay - 1.5)
        eave = rng.uniform(4, 8)
        plan.wing(plan.owner(*shed.centre), shed, eave, eave + rng.uniform(0, 2.5), along_u=along_u)


def _ship(
    plan: Plan, place: Callable[[float, float, float, float], Rect], a: float, b: float, length: float, beam: float,
    rng: Generator,
) -> None:  # fmt: skip
    """Draw a hull, a bridge at one end and a load."""
    deck = rng.uniform(0.3, 1.5) + 0.04 * length
    owner = plan.owner(*place(a, b, a + length, b + beam).centre)
    plan.wing(owner, place(a, b, a + 0.9 * length, b + beam), deck, bottom=-1.7, label=Label.STRUCTURE)
    bow = place(a + 0.9 * length, b + 0.25 * beam, a + length, b + 0.75 * beam)
    plan.wing(owner, bow, deck + 0.6, bottom=-1.7, label=Label.STRUCTURE)
    house = rng.uniform(0.08, 0.2) * length
    plan.wing(owner, place(a + 2, b + 0.5, a + 2 + house, b + beam - 0.5), deck + rng.uniform(2.5, 0.12 * length + 4),
              bottom=-1.7, label=Label.STRUCTURE)  # fmt: skip
    for start in np.arange(a + 4 + house, a + 0.85 * length - 6, 6.4):
        if rng.random() < 0.5:
            plan.wing(owner, place(start, b + 0.8, start + 6, b + beam - 0.8), deck + rng.uniform(0.8, 5.5),
                      bottom=-1.7, label=Label.STRUCTURE)  # fmt: skip


def _crane(
    plan: Plan, place: Callable[[float, float, float, float], Rect], start: float, across: float, far: bool,
    rng: Generator,
) -> None:  # fmt: skip
    """Draw a portal crane on the quay with its boom over the water."""
    high, reach = rng.uniform(16, 30), min(rng.uniform(16, 34), 0.7 * across)

    def placed(a0: float, b0: float, a1: float, b1: float) -> Rect:
        return place(a0, across - b1, a1, across - b0) if far else place(a0, b0, a1, b1)

    _gantry(plan, placed, start, start + 9, -9.5, -2.0, high)
    owner = plan.owner(*placed(start, -9.5, start + 9, -2.0).centre)
    boom = placed(start + 3.3, -16.0, start + 5.7, reach)
    plan.wing(owner, boom, high + 4.2, bottom=high + 2.2, label=Label.STRUCTURE)
    plan.wing(owner, placed(start + 2, -11, start + 7, -4), high + 5.5, bottom=high + 1.6, label=Label.STRUCTURE)
    plan.wing(owner, placed(start + 4, -4, start + 5, -3), high + 13, bottom=high + 2, label=Label.STRUCTURE)


def _warehouses(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Long warehouses side by side, low sheds or brick stores of some floors, with loading bays under canopies."""
    along_u = rect.width >= rect.height
    inner = rect.inset(rng.uniform(3, 8))
    total, across = (inner.width, inner.height) if along_u else (inner.height, inner.width)
    brick = rng.random() < 0.4
    deep = rng.uniform(14, 20) if brick else rng.uniform(22, 40)
    pitch = deep + rng.uniform(12, 24)

    def place(a0: float, b0: float, a1: float, b1: float) -> Rect:
        flat = Rect(a0, b0, a1, b1) if along_u else Rect(b0, a0, b1, a1)
        return flat.shifted(inner.u0, inner.v0)

    scatter_trees(plan, Rect(rect.u0, rect.v0, rect.u1, rect.v0 + 2.5), rng, per_hectare=rng.uniform(0, 250))
    for near in np.arange(0.0, max(across - deep, 0.0) + 0.1, pitch):
        start, eave = rng.uniform(0, 0.12) * total, rng.uniform(12, 22) if brick else rng.uniform(6, 10)
        end = total - rng.uniform(0, 0.12) * total
        bay = rng.uniform(18, 30) if brick else rng.uniform(30, 70)
        ridge = rng.uniform(2, 4.5)
        for a0 in np.arange(start, end - 8, bay):
            body = place(a0, near, min(a0 + bay, end), near + deep)
            owner = plan.owner(*body.centre)
            plan.wing(owner, body, eave, eave + ridge, along_u=along_u != brick)
            if rng.random() < 0.8 and near > 0.5:
                canopy = place(a0 + 1, near - 3.2, min(a0 + bay, end) - 1, near)
                plan.wing(owner, canopy, 4.7, bottom=4.3)
            for _ in range(rng.poisson(0.8)):
                stack = a0 + rng.uniform(0, bay)
                load = place(stack, near + deep + 0.5, stack + rng.uniform(1.5, 6), near + deep + rng.uniform(2, 4))
                plan.wing(plan.owner(*load.centre), load, rng.uniform(0.8, 3.0), label=Label.STRUCTURE)
            for b in (near - 8.0, near + deep + 7.0):
                lorry = place(a0 + 0.5 * bay - 1, b - 1, a0 + 0.5 * bay + 1, b + 1).centre
                plan.cars.append((*lorry, np.pi / 2 if along_u else 0.0, 0.35, 1.0))


KINDS: dict[str, Callable[[Plan, Rect, Generator], None]] = {
    "containers": _containers, "basin": _basin, "warehouses": _warehouses,
}  # fmt: skip
