"""`localizability.tif`: how far a robot drives until it is localized, where it was tried and close by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from crossloc3d_ros.aerial_map.geotiff import write_bands
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.localizability.driving import FAR_M, NEAR_M, DrivenPlace
from crossloc3d_ros.localizability.squares import Square, open_cells
from crossloc3d_ros.types import BoolArray, Float64Array

RASTER = "localizability.tif"
CELL_M = 10.0
REACH_M = 25.0
"""A cell farther from every place tells nothing."""
NEVER = 255.0
"""Distance of places where a robot is not localized within 100 m."""
DISTANCE, PROBABILITY = "metres until localized: 0 at once, 20, 100, 255 never", "probability that one scan is right"
_KERNEL_M = 12.0  # one sigma of the weights of places around a cell
_SHRINK = 0.5  # places' worth of the whole map's share that each cell starts with
_LEAST_OPEN = 0.2  # share of a cell that a robot can stand on


def distance_class(place: DrivenPlace) -> float:
    """Return 0, 20, 100 or `NEVER`: what the raster says of a place."""
    if place.localized_m == 0.0:
        return 0.0
    return NEAR_M if place.localized_m <= NEAR_M else FAR_M if place.localized_m <= FAR_M else NEVER


def rasters_of(
    aerial_map: AerialMap, squares: Sequence[Square], places: Sequence[DrivenPlace]
) -> tuple[Raster, Raster]:
    """Return distance and probability over the whole map, NaN where it was not driven or no robot can stand.

    The distance of a cell is that of the place nearest to its middle. The probability is the weighted share of right
    scans around it, shrunk a little to that of all places.
    """
    west, north, rows, columns = _grid(aerial_map)
    is_open = _open_share(aerial_map, squares, west, north, rows, columns) >= _LEAST_OPEN
    row, column = np.nonzero(is_open)
    middles = np.column_stack([west + (column + 0.5) * CELL_M, north - (row + 0.5) * CELL_M])
    tree = cKDTree([(place.easting, place.northing) for place in places])
    away, nearest = tree.query(middles)
    near = away <= REACH_M
    row, column, middles, nearest = row[near], column[near], middles[near], nearest[near]
    distance, probability = (np.full((rows, columns), np.nan, np.float32) for _ in range(2))
    distance[row, column] = np.array([distance_class(place) for place in places])[nearest]
    probability[row, column] = _shares(tree, middles, np.array([place.is_right for place in places]))
    return Raster(distance, west, north, CELL_M), Raster(probability, west, north, CELL_M)


def write_raster(folder: Path, aerial_map: AerialMap, distance: Raster, probability: Raster) -> None:
    """Write both bands into the map's folder; MapError where that fails."""
    with atomic_path(folder / RASTER, MapError) as partial:
        write_bands(partial, {DISTANCE: distance, PROBABILITY: probability}, aerial_map.manifest.crs)


def _shares(tree: cKDTree, middles: Float64Array, right: BoolArray) -> Float64Array:
    """Return the probabilities (n,) at middles of cells (n, 2)."""
    overall = float(right.mean())
    shares = np.full(len(middles), overall)
    for i, around in enumerate(tree.query_ball_point(middles, 3.0 * _KERNEL_M)):
        away = np.hypot(*(tree.data[around] - middles[i]).T)
        weight = np.exp(-0.5 * (away / _KERNEL_M) ** 2)
        shares[i] = (weight @ right[around] + _SHRINK * overall) / (weight.sum() + _SHRINK)
    return shares


def _grid(aerial_map: AerialMap) -> tuple[float, float, int, int]:
    """Return west, north, rows and columns of cells on multiples of their side that hold the map."""
    west, south, east, north = aerial_map.bounds
    left, top = math.floor(west / CELL_M) * CELL_M, math.ceil(north / CELL_M) * CELL_M
    return left, top, math.ceil((top - south) / CELL_M), math.ceil((east - left) / CELL_M)


def _open_share(
    aerial_map: AerialMap, squares: Sequence[Square], west: float, north: float, rows: int, columns: int
) -> Float64Array:
    """Return the share of each cell (rows, columns) that is open ground of a square that is driven."""
    cell_m = aerial_map.manifest.build.cell_m
    open_m2 = np.zeros((rows, columns))
    for square in squares:
        row, column = np.nonzero(open_cells(aerial_map, square.bounds))
        easting = square.bounds.min_x + (column + 0.5) * cell_m
        northing = square.bounds.max_y - (row + 0.5) * cell_m
        at = np.floor((north - northing) / CELL_M).astype(int), np.floor((easting - west) / CELL_M).astype(int)
        inside = (at[0] >= 0) & (at[0] < rows) & (at[1] >= 0) & (at[1] < columns)
        np.add.at(open_m2, (at[0][inside], at[1][inside]), cell_m**2)
    return open_m2 / CELL_M**2
