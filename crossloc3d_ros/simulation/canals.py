"""A quarter of canals: narrow houses around closed blocks, quays with trees, moored house boats, bridges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crossloc3d_ros.simulation.drawing import row_houses
from crossloc3d_ros.simulation.layout import Plan, Rect, Street
from crossloc3d_ros.simulation.scene import Label

Generator = np.random.Generator

_WATER_M = 1.7
"""How far below the quay the boats' hulls begin."""


def draw_quays(plan: Plan, street: Street, rng: Generator) -> None:
    """Draw a canal's water between its bridges and what stands on both of its quays."""
    half_water = street.width / 2 - street.quay_m
    reaches = _reaches(street)
    for start, end in reaches:
        plan.water.append(_strip(street, start, end, -half_water, half_water))
    for bridge in street.bridges:
        rail = rng.uniform(0.9, 1.2)
        for along in bridge:
            (u0, v0), (u1, v1) = street.at(along, -half_water), street.at(along, half_water)
            plan.barrier(u0, v0, u1, v1, 0.15, rail, Label.STRUCTURE)
    tall, spacing, alike = rng.uniform(9.0, 15.0), rng.uniform(6.0, 11.0), rng.uniform(0.05, 0.3)
    for side in (-1.0, 1.0):
        plan.pedestrians.append(
            _strip(street, 0.0, street.length, side * (half_water + 2.5), side * (street.width / 2 - 1.0))
        )
        _draw_quay(plan, street, side, half_water, reaches, tall * rng.uniform(1 - alike, 1 + alike), spacing, rng)


def _reaches(street: Street) -> list[tuple[float, float]]:
    """Return the stretches of open water between the bridges."""
    reaches, start = [], 0.0
    for low, high in sorted(street.bridges):
        if low - start > 2.0:
            reaches.append((start, low))
        start = max(start, high)
    if street.length - start > 2.0:
        reaches.append((start, street.length))
    return reaches


def _strip(street: Street, start: float, end: float, one: float, other: float) -> Rect:
    """Return the rectangle between two places along and two places across a street."""
    (u0, v0), (u1, v1) = street.at(start, one), street.at(end, other)
    return Rect(min(u0, u1), min(v0, v1), max(u0, u1), max(v0, v1))


def _draw_quay(
    plan: Plan, street: Street, side: float, half_water: float, reaches: list[tuple[float, float]], tall: float,
    spacing: float, rng: Generator,
) -> None:  # fmt: skip
    """Draw trees, cars, lamps and racks along the edge of a quay, and boats beside it."""
    treed, occupied = rng.random() < 0.85, rng.uniform(0.1, 0.95)
    slanted = street.quay_m > 9.0 and rng.random() < 0.4
    moored, lamp, rack = rng.uniform(0.0, 0.95), rng.uniform(18.0, 32.0), rng.uniform(0.0, 0.5)
    for start, end in reaches:
        if treed:
            for along in np.arange(start + rng.uniform(2, 5), end - 2, spacing):
                if rng.random() < 0.9:
                    place = street.at(along, side * (half_water + 1.1))
                    plan.tree(*place, rng, height=(0.8 * tall, 1.15 * tall), kinds=(0.97, 0.0, 0.03, 0.0))
        step, across, turn = (2.9, 3.0, 1.1) if slanted else (5.9, 1.9, 0.0)
        for along in np.arange(start + 4, end - 4, step):
            plan.cars.append(
                (*street.at(along, side * (half_water + across)), street.yaw_rad + side * turn, occupied, rng.random())
            )
        for along in np.arange(start + rng.uniform(3, lamp), end, lamp):
            place = street.at(along, side * (half_water + 0.7))
            plan.poles.append((*place, rng.uniform(3.8, 5.5), 0.1, 0.15, float(Label.STRUCTURE)))
        if rng.random() < rack:
            along = rng.uniform(start, end)
            racks = _strip(street, along, along + rng.uniform(3, 9), side * (half_water + 0.4), side * (half_water + 1))
            plan.wing(plan.owner(*racks.centre), racks, 1.05, label=Label.STRUCTURE)
        if half_water > 8.0 and end - start > 20.0:
            _moor(plan, street, side, half_water, start + 3, end - 3, moored, rng)
    # Steps and stalls before the houses.
    for along in np.arange(rng.uniform(2, 9), street.length, rng.uniform(6, 14)):
        if rng.random() < 0.5:
            reach = rng.uniform(0.6, 1.4)
            low, high = side * (street.width / 2 - reach), side * (street.width / 2 + 0.6)
            steps = _strip(street, along, along + rng.uniform(1.2, 2.5), low, high)
            plan.wing(plan.owner(*steps.centre), steps, rng.uniform(0.6, 1.5), label=Label.STRUCTURE)


def _moor(
    plan: Plan, street: Street, side: float, half_water: float, start: float, end: float, moored: float, rng: Generator
) -> None:
    """Draw house boats and smaller boats along one quay."""
    along = start
    while along < end - 8:
        home = rng.random() < 0.6
        length, beam = (rng.uniform(13, 26), rng.uniform(3.8, 5.2)) if home else (rng.uniform(5, 9), rng.uniform(2, 3))
        length = min(length, end - along)
        if rng.random() < moored:
            middle = side * (half_water - 0.9 - beam / 2)
            hull = _strip(street, along, along + length, middle - beam / 2, middle + beam / 2)
            owner = plan.owner(*hull.centre)
            plan.wing(owner, hull, rng.uniform(-0.9, -0.3), bottom=-_WATER_M, label=Label.STRUCTURE)
            if home:
                inset = rng.uniform(0.1, 0.6)
                cabin = _strip(street, along + rng.uniform(0.3, 3.5), along + length - rng.uniform(0.3, 3.5),
                               middle - beam / 2 + inset, middle + beam / 2 - inset)  # fmt: skip
                roof = rng.uniform(0.7, 1.9)
                ridge = roof + (rng.uniform(0.3, 0.9) if rng.random() < 0.25 else 0.0)
                plan.wing(owner, cabin, roof, ridge, bottom=-_WATER_M, label=Label.STRUCTURE)
        along += length + rng.uniform(0.8, 5.0)


def _canal_houses(plan: Plan, rect: Rect, rng: Generator) -> None:
    """Deep and narrow houses of three to five storeys, most with the gable to the canal, around gardens."""
    row_houses(
        plan, rect, rng,
        depth=min(rng.uniform(11.0, 18.0), 0.45 * min(rect.width, rect.height)),
        eave=rng.uniform(9.0, 13.5), spread=rng.uniform(0.6, 2.0),
        flat=rng.uniform(0.03, 0.22), gable=rng.uniform(0.5, 0.9),
        front=rng.uniform(4.8, 7.5), missing=rng.uniform(0.0, 0.03), hall=0.08,
    )  # fmt: skip


KINDS: dict[str, Callable[[Plan, Rect, Generator], None]] = {"canal_houses": _canal_houses}
