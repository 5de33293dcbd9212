"""Which squares of a map are driven, and from how many places.

A map is divided into squares, each with a world of its own. Of a map of many, some are drawn in proportion to their
open ground, so that time and memory do not grow with the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.simulation.map_world import open_ground
from crossloc3d_ros.simulation.world import Bounds
from crossloc3d_ros.types import BoolArray, Float32Array

SIDE_M = 340.0
"""Of a square at most; even, so that its middle lies on whole metres."""
MOST_SQUARES = 24
_LEAST_OPEN_M2 = 2000.0
"""A square with less open ground is not driven: a drive needs some hundred metres of street."""


@dataclass(frozen=True)
class Square:
    """One square that is driven."""

    number: int
    bounds: Bounds
    """Easting and northing, whole metres."""
    places: int
    """From how many places drives begin."""


def choose_squares(aerial_map: AerialMap, places: int, seed: int) -> tuple[Square, ...]:
    """Return the squares of a map that are driven, and how many of the places lie in each.

    Raises MapError where the map has hardly any open ground.
    """
    every = divided(aerial_map)
    open_m2 = np.array([_open_m2(aerial_map, square) for square in every])
    enough = np.flatnonzero(open_m2 >= _LEAST_OPEN_M2)
    if not len(enough):
        raise MapError(
            f"the map {aerial_map.path} has no open ground to drive on: nowhere {_LEAST_OPEN_M2:g} square metres in "
            f"{SIDE_M:g} x {SIDE_M:g} m; it cannot be calibrated"
        )
    most = min(MOST_SQUARES, max(1, places // 4))
    if len(enough) > most:
        rng = np.random.default_rng([seed, 20])
        share = open_m2[enough] / open_m2[enough].sum()
        enough = np.sort(rng.choice(enough, most, replace=False, p=share))
    share = open_m2[enough] / open_m2[enough].sum()
    counts = np.diff(np.round(np.cumsum(share) * places), prepend=0.0).astype(int)
    return tuple(
        Square(number, every[row], int(count))
        for number, (row, count) in enumerate(zip(enough.tolist(), counts, strict=True))
        if count > 0
    )


def divided(aerial_map: AerialMap) -> list[Bounds]:
    """Return the squares of a map, on whole metres; those at the eastern and northern edges are no larger than it."""
    west, south, east, north = aerial_map.bounds
    columns, rows = (max(1, math.ceil((high - low) / SIDE_M)) for low, high in ((west, east), (south, north)))
    width, height = (2.0 * math.floor((high - low) / (2.0 * n)) for low, high, n in
                     ((west, east, columns), (south, north, rows)))  # fmt: skip
    west, south = math.ceil(west), math.ceil(south)
    return [
        Bounds(west + i * width, south + j * height, west + (i + 1) * width, south + (j + 1) * height)
        for j in range(rows)
        for i in range(columns)
    ]


def open_cells(aerial_map: AerialMap, bounds: Bounds) -> BoolArray:
    """Return the cells (H, W) of the map's rasters in some bounds where a robot can stand, row 0 in the north."""
    west, south, east, north = bounds
    window = (west, south, east, north)
    above: Float32Array = aerial_map.surface(window).values - aerial_map.terrain(window).values
    return open_ground(above)


def _open_m2(aerial_map: AerialMap, bounds: Bounds) -> float:
    return float(open_cells(aerial_map, bounds).sum()) * aerial_map.manifest.build.cell_m**2
