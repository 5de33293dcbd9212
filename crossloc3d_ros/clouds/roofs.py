"""Roofs of any width in a height raster: regions that end in walls (Sithole and Vosselman 2005)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

_WALL_M = 2.0  # the lowest wall of a hall; kerbs, terraces of gardens and parked cars are lower
_STEEP = 0.8  # a wall is steeper than this between two echoes; banks of roads and railways reach 0.67 (1 : 1.5)
_DOWN_SHARE = 0.6  # of its rim, from which a region stands upon the ground: a terrace has walls down on half of it
_GAP_M = 3.0  # from the nearest echo: farther inside a removed house nobody knows whether a wall goes through
_SMALLEST_M2 = 20.0  # smaller regions are what the openings are for


def roof_cells(surface: Float64Array, unknown: BoolArray, cell_m: float, largest_m2: float) -> BoolArray:
    """Return the cells (H, W) of the regions that stand upon what surrounds them.

    `surface` (H, W): heights of the lowest echoes, metres; `unknown` (H, W): cells without an echo, or with one on a
    tree, a car or another small object. They take the height of the nearest known cell, so that a wall stays a wall
    where the survey is sparse. The raster is torn along its walls: where neighbours differ by more than 2 m and the
    slope between their echoes exceeds 0.8. A region between the tears is a roof where at least 60 % of its rim go down
    by a wall and its area is less than `largest_m2`. The raster's edge counts as rim that does not, which keeps the
    upper side of a cliff on the ground.
    """
    none = np.zeros(surface.shape, np.bool_)
    if unknown.all() or largest_m2 <= 0:
        return none
    distance, (row, column) = ndimage.distance_transform_edt(unknown, return_indices=True)
    height = surface[row, column]
    walls = [_walls(height, row, column, axis, cell_m) for axis in (0, 1)]
    regions = _regions(walls, distance * cell_m > _GAP_M, cell_m)
    if not regions.any():
        return none
    return _stands_on_its_rim(regions, walls, cell_m, largest_m2)[regions]


def _walls(height: Float64Array, row: Int64Array, column: Int64Array, axis: int, cell_m: float) -> npt.NDArray[np.int8]:
    """Return +1 where the next cell along the axis lies a wall higher, -1 where lower, else 0."""
    rise = np.diff(height, axis=axis)
    distance_m = np.hypot(np.diff(row, axis=axis), np.diff(column, axis=axis)) * cell_m
    is_wall = (np.abs(rise) > _WALL_M) & (np.abs(rise) > _STEEP * distance_m)
    return (np.sign(rise) * is_wall).astype(np.int8)


def _regions(walls: list[npt.NDArray[np.int8]], gaps: BoolArray, cell_m: float) -> npt.NDArray[np.int32]:
    """Return the region (H, W) of each cell from 1 on; all 0 where there is no region.

    Cells beside a wall and those in `gaps` (H, W) belong to no region while regions are found, so that none leaks
    through a house that leans on the wall; then they, and regions that are too small, go to the nearest one.
    """
    torn = gaps.copy()
    for axis, wall in enumerate(walls):
        before, after = _pair(axis)
        torn[before] |= wall != 0
        torn[after] |= wall != 0
    regions, count = ndimage.label(~torn)
    too_small = np.bincount(regions.ravel(), minlength=count + 1) * cell_m**2 < _SMALLEST_M2
    regions[too_small[regions]] = 0
    if not regions.any():
        return np.zeros(gaps.shape, np.int32)
    row, column = ndimage.distance_transform_edt(regions == 0, return_distances=False, return_indices=True)
    nearest: npt.NDArray[np.int32] = regions[row, column]
    return nearest


def _stands_on_its_rim(
    regions: npt.NDArray[np.int32], walls: list[npt.NDArray[np.int8]], cell_m: float, largest_m2: float
) -> BoolArray:
    """Return of each region number whether it is a roof."""
    count = int(regions.max()) + 1
    rim, down = np.zeros(count), np.zeros(count)
    for axis, wall in enumerate(walls):
        before, after = _pair(axis)
        meets = regions[before] != regions[after]
        for side, falls in ((before, -1), (after, 1)):
            region = regions[side]
            rim += np.bincount(region[meets], minlength=count)
            down += np.bincount(region[meets & (wall == falls)], minlength=count)
    for edge in (regions[0], regions[-1], regions[:, 0], regions[:, -1]):
        rim += np.bincount(edge, minlength=count)
    area_m2 = np.bincount(regions.ravel(), minlength=count) * cell_m**2
    roof: BoolArray = (rim > 0) & (down >= _DOWN_SHARE * rim) & (area_m2 < largest_m2)
    return roof


def _pair(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the slices of all cells but the last, and but the first, along an axis."""
    every = slice(None)
    before, after = slice(None, -1), slice(1, None)
    return ((before, every), (after, every)) if axis == 0 else ((every, before), (every, after))
