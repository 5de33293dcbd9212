"""Rasters of a tile: the terrain, with its holes filled, the surface, the lowest echoes, and how many there are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.clouds.filters import check_points
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array

Bounds = tuple[float, float, float, float]
"""min easting, min northing, max easting, max northing; metres; the maxima are exclusive."""

_RELAXATIONS = 24  # the half resolution has filled the long range before
_MOST_CELLS = 200_000_000  # more than any tile has: an outlier far off, which would exhaust the memory


@dataclass(frozen=True, eq=False)
class Raster:
    """Heights on a regular grid, row 0 in the north, as a GIS keeps them."""

    values: Float32Array
    """(H, W) metres; NaN where nothing is known."""
    west_m: float
    """Easting of the western edge of column 0."""
    north_m: float
    """Northing of the northern edge of row 0."""
    cell_m: float

    def sample(self, easting: npt.ArrayLike, northing: npt.ArrayLike) -> Float32Array:
        """Return the bilinear heights at the given places, float32 in their shape; NaN outside and in holes.

        Between the outermost cell centres and the raster's edge the outermost value holds. Beside a hole the known
        neighbours alone are weighed.
        """
        e, n = np.broadcast_arrays(np.asarray(easting, np.float64), np.asarray(northing, np.float64))
        heights = _bilinear(self.values, self.west_m, self.north_m, self.cell_m, e.ravel(), n.ravel())
        shaped: Float32Array = heights.reshape(e.shape)
        return shaped

    def nearest(self, easting: npt.ArrayLike, northing: npt.ArrayLike) -> Float32Array:
        """Return the heights of the cells that hold the given places, float32 in their shape; NaN outside."""
        e, n = np.broadcast_arrays(np.asarray(easting, np.float64), np.asarray(northing, np.float64))
        column = np.floor((e - self.west_m) / self.cell_m)
        row = np.ceil((self.north_m - n) / self.cell_m) - 1
        inside = (row >= 0) & (row < self.values.shape[0]) & (column >= 0) & (column < self.values.shape[1])
        rows, columns = (np.where(inside, index, 0.0).astype(np.int64) for index in (row, column))
        return np.where(inside, self.values[rows, columns], np.float32("nan"))


def terrain_raster(points: Float64Array, ground_mask: BoolArray, bounds: Bounds, cell_m: float) -> Raster:
    """Return the terrain of `bounds`: the mean height of each cell's ground points, holes filled smoothly.

    Points (N, 3) easting, northing, height; ground_mask (N,). Under buildings and over canals the heights at the
    hole's rim are continued over it as a stretched membrane would. All NaN where there is no ground point at all.
    """
    check_points(points)
    if np.shape(ground_mask) != (len(points),):
        raise CloudError(f"ground_mask must have the shape ({len(points)},), got {np.shape(ground_mask)}")
    height, width = _shape(bounds, cell_m)
    sums, counts = _accumulate(
        np.ascontiguousarray(points, np.float64), np.asarray(ground_mask, np.bool_), bounds[0], bounds[3], cell_m,
        height, width,
    )  # fmt: skip
    with np.errstate(invalid="ignore"):
        values = (sums / counts).astype(np.float32)  # 0 / 0 marks the holes as NaN
    return Raster(fill_holes(values), bounds[0], bounds[3], cell_m)


def surface_raster(points: Float64Array, bounds: Bounds, cell_m: float) -> Raster:
    """Return the surface of `bounds`: the highest of each cell's points (N, 3), NaN where there is none."""
    check_points(points)
    height, width = _shape(bounds, cell_m)
    values = _highest(np.ascontiguousarray(points, np.float64), bounds[0], bounds[3], cell_m, height, width)
    return Raster(values, bounds[0], bounds[3], cell_m)


def lowest_raster(points: Float64Array, bounds: Bounds, cell_m: float) -> Raster:
    """Return the lowest of each cell's points (N, 3) in `bounds`, NaN where there is none."""
    check_points(points)
    upside_down = surface_raster(np.column_stack([points[:, :2], -points[:, 2]]), bounds, cell_m)
    return Raster(-upside_down.values, upside_down.west_m, upside_down.north_m, cell_m)


def count_raster(points: Float64Array, bounds: Bounds, cell_m: float) -> Raster:
    """Return how many of the points (N, 3) lie in each cell of `bounds`, 0 where there is none."""
    check_points(points)
    height, width = _shape(bounds, cell_m)
    every = np.ones(len(points), np.bool_)
    values = np.ascontiguousarray(points, np.float64)
    _, counts = _accumulate(values, every, bounds[0], bounds[3], cell_m, height, width)
    return Raster(counts.astype(np.float32), bounds[0], bounds[3], cell_m)


def fill_holes(values: Float32Array) -> Float32Array:
    """Return the grid (H, W) with its NaN cells filled as a membrane stretched over their rims; the rest untouched.

    Coarse to fine: each level averages four cells of the finer one, is filled itself and hands its values down as
    the start of a few relaxations, so that a wide hole costs no more than a narrow one.
    """
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values.astype(np.float32, copy=True)
    filled = np.where(known, values, np.nan).astype(np.float64)
    if min(values.shape) > 1 or max(values.shape) > 2:
        start = _enlarge(fill_holes(_halve(filled)), values.shape)
    else:
        start = np.full(values.shape, np.nanmean(filled))
    filled = np.where(known, filled, start)
    _relax(filled, known, _RELAXATIONS)
    return filled.astype(np.float32)


def _shape(bounds: Bounds, cell_m: float) -> tuple[int, int]:
    min_e, min_n, max_e, max_n = bounds
    if not all(map(math.isfinite, bounds)) or not cell_m > 0 or not (max_e > min_e and max_n > min_n):
        raise CloudError(f"bounds {bounds} with cells of {cell_m} m do not span a raster")
    if (max_n - min_n) / cell_m * ((max_e - min_e) / cell_m) > _MOST_CELLS:
        raise CloudError(f"{max_e - min_e:.4g} x {max_n - min_n:.4g} m are too many cells of {cell_m} m: stray points?")
    # A hair's tolerance, so that 380.0000001 m in cells of 1 m stay 380 cells.
    return math.ceil((max_n - min_n) / cell_m - 1e-6), math.ceil((max_e - min_e) / cell_m - 1e-6)


@njit(cache=True, nogil=True)
def _accumulate(  # type: ignore[no-untyped-def]
    points: Float64Array, mask: BoolArray, west: float, north: float, cell: float, height: int, width: int
):
    sums = np.zeros((height, width))
    counts = np.zeros((height, width))
    for i in range(points.shape[0]):
        if mask[i]:
            column = np.floor((points[i, 0] - west) / cell)
            row = np.ceil((north - points[i, 1]) / cell) - 1  # western and southern edges belong to a cell
            z = points[i, 2]
            if 0 <= row < height and 0 <= column < width and np.isfinite(z):
                sums[int(row), int(column)] += z
                counts[int(row), int(column)] += 1
    return sums, counts


@njit(cache=True, nogil=True)
def _highest(points: Float64Array, west: float, north: float, cell: float, height: int, width: int) -> Float32Array:
    values = np.full((height, width), np.nan, np.float32)
    for i in range(points.shape[0]):
        column = np.floor((points[i, 0] - west) / cell)
        row = np.ceil((north - points[i, 1]) / cell) - 1  # western and southern edges belong to a cell
        z = points[i, 2]
        if 0 <= row < height and 0 <= column < width and np.isfinite(z):
            held = values[int(row), int(column)]
            if not held >= z:
                values[int(row), int(column)] = z
    return values


@njit(cache=True, nogil=True)
def _bilinear(
    values: Float32Array, west: float, north: float, cell: float, easting: Float64Array, northing: Float64Array
) -> Float32Array:
    height, width = values.shape
    heights = np.full(easting.shape[0], np.nan, np.float32)
    for i in range(easting.shape[0]):
        u = (easting[i] - west) / cell
        v = (north - northing[i]) / cell
        if not (0 <= u <= width and 0 <= v <= height):
            continue
        u = min(max(u - 0.5, 0.0), width - 1.0)
        v = min(max(v - 0.5, 0.0), height - 1.0)
        column, row = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
        fu, fv = u - column, v - row
        if not np.isfinite(values[row + (fv > 0.5), column + (fu > 0.5)]):
            continue
        total = 0.0
        weights = 0.0
        for dr in range(2):
            for dc in range(2):
                weight = (fv if dr else 1.0 - fv) * (fu if dc else 1.0 - fu)
                if weight > 0.0 and np.isfinite(values[row + dr, column + dc]):
                    total += weight * values[row + dr, column + dc]
                    weights += weight
        heights[i] = total / weights
    return heights


def _halve(values: Float64Array) -> Float32Array:
    """Average blocks of 2 x 2 cells, over the known ones of each."""
    height, width = (-(-s // 2) for s in values.shape)
    padded = np.full((2 * height, 2 * width), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    blocks = padded.reshape(height, 2, width, 2)
    known = np.isfinite(blocks)
    counts = known.sum(axis=(1, 3))
    sums = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    with np.errstate(invalid="ignore"):
        averaged: Float32Array = (sums / counts).astype(np.float32)
    return averaged


def _enlarge(coarse: Float32Array, shape: tuple[int, ...]) -> Float64Array:
    """Interpolate the coarse level at the centres of the fine one."""
    rows, columns = np.meshgrid(np.arange(shape[0]) + 0.5, np.arange(shape[1]) + 0.5, indexing="ij")
    fine = _bilinear(coarse, 0.0, float(2 * coarse.shape[0]), 2.0, columns.ravel(), 2 * coarse.shape[0] - rows.ravel())
    shaped: Float64Array = fine.reshape(shape).astype(np.float64)
    return shaped


@njit(cache=True, nogil=True, fastmath=True)
def _relax(values: Float64Array, known: BoolArray, times: int) -> None:
    """Let the unknown cells come to rest between their neighbours (red-black Gauss-Seidel, free edges)."""
    height, width = values.shape
    for sweep in range(2 * times):
        for row in range(height):
            for column in range((row + sweep) % 2, width, 2):
                if known[row, column]:
                    continue
                total = 0.0
                count = 0
                if row > 0:
                    total += values[row - 1, column]
                    count += 1
                if row < height - 1:
                    total += values[row + 1, column]
                    count += 1
                if column > 0:
                    total += values[row, column - 1]
                    count += 1
                if column < width - 1:
                    total += values[row, column + 1]
                    count += 1
                values[row, column] = total / count
