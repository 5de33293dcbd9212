"""Where the ground is: under a robot that sees it in a few sparse rings, and in an aerial survey without classes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import ndimage

from crossloc3d_ros.clouds.filters import check_points
from crossloc3d_ros.clouds.raster import fill_holes
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array

# --- the ground around a robot ------------------------------------------------------------------------------------

_CELL_M = 2.0
_REACH_M = 100.0
_STEEPEST = 0.30  # a rise faster than this is a wall, a car or a kerb, never the road
_STEP_M = 0.25  # and so is a step higher than this
_BENDING = 0.12  # slope by which the ground may leave the fitted plane, a metre a metre of distance
_LEVELS = 3  # grids of 8, 4 and 2 m
_SWEEPS = 12


def scan_heights(points_base: Float32Array, sensor_height_m: float) -> Float32Array:
    """Return the heights (N,) float32 of a scan's points above the ground below them, metres.

    Points (N, 3): base frame, z up, the base standing on the ground near z = 0, the sensor `sensor_height_m` above it.
    NaN points have NaN heights.

    The ground is a plane through what looks like ground, plus a membrane that follows the rings where they touch it
    and comes back to the plane where they do not. What looks like ground: the lowest point of a cell, no higher above
    any other cell than the steepest road would take it. Points bound the ground from above even where they are not
    on it, which is how walls and car roofs are kept out. With no usable point the ground is the plane z = 0.
    """
    check_points(points_base, "points_base")
    if not np.isfinite(sensor_height_m):
        raise CloudError(f"sensor_height_m must be finite, got {sensor_height_m}")
    points = np.ascontiguousarray(points_base, dtype=np.float32)
    cells = 2 * int(_REACH_M / _CELL_M)
    lowest, where, support = _lowest_of_cells(points, cells, _CELL_M)
    plane, ground = _fit_ground(lowest, where, support, _CELL_M, float(sensor_height_m))
    heights: Float32Array = _heights_above(points, plane, ground, _CELL_M)
    return heights


@njit(cache=True, nogil=True)
def _lowest_of_cells(points: Float32Array, cells: int, cell: float):  # type: ignore[no-untyped-def]
    """Return each cell's lowest z (infinite where empty), where it lies (x, y), and how many points share its height.

    A point far below what the steepest ground through the base allows is a reflection and does not count.
    """
    half = cells * cell / 2
    lowest = np.full((cells, cells), np.inf, np.float32)
    where = np.zeros((cells, cells, 2), np.float32)
    support = np.zeros((cells, cells), np.int32)
    cell_of = np.empty(points.shape[0], np.int32)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cell_of[i] = -1
        if not (abs(x) < half and abs(y) < half):
            continue
        reach = np.sqrt(x * x + y * y) * np.float32(_STEEPEST) + np.float32(1.0)
        if not (abs(z) <= reach):
            continue
        row, column = int((y + half) / cell), int((x + half) / cell)
        cell_of[i] = row * cells + column
        if z < lowest[row, column]:
            lowest[row, column] = z
            where[row, column, 0] = x
            where[row, column, 1] = y
    for i in range(points.shape[0]):
        if cell_of[i] >= 0:
            row, column = cell_of[i] // cells, cell_of[i] % cells
            if points[i, 2] < lowest[row, column] + 0.3:
                support[row, column] += 1
    return lowest, where, support


@njit(cache=True, nogil=True)
def _envelope(lowest: Float32Array, cell: float, steepest: float, sensor_ground: float) -> Float32Array:
    """Return the highest ground that the steepest slope allows over all cells (two chamfer passes) and the base."""
    n = lowest.shape[0]
    bound = lowest.copy()
    middle = n // 2
    for row in range(middle - 1, middle + 1):
        for column in range(middle - 1, middle + 1):
            bound[row, column] = min(bound[row, column], sensor_ground + steepest * cell)
    straight = np.float32(steepest * cell)
    diagonal = np.float32(steepest * cell * 1.4142)
    for row in range(n):
        for column in range(n):
            b = bound[row, column]
            if column > 0:
                b = min(b, bound[row, column - 1] + straight)
            if row > 0:
                b = min(b, bound[row - 1, column] + straight)
                if column > 0:
                    b = min(b, bound[row - 1, column - 1] + diagonal)
                if column < n - 1:
                    b = min(b, bound[row - 1, column + 1] + diagonal)
            bound[row, column] = b
    for row in range(n - 1, -1, -1):
        for column in range(n - 1, -1, -1):
            b = bound[row, column]
            if column < n - 1:
                b = min(b, bound[row, column + 1] + straight)
            if row < n - 1:
                b = min(b, bound[row + 1, column] + straight)
                if column > 0:
                    b = min(b, bound[row + 1, column - 1] + diagonal)
                if column < n - 1:
                    b = min(b, bound[row + 1, column + 1] + diagonal)
            bound[row, column] = b
    return bound


@njit(cache=True, nogil=True)
def _fit_plane(where: Float32Array, lowest: Float32Array, weight: Float32Array, plane: Float64Array) -> Float64Array:
    """Return the weighted plane z = a x + b y + c through the cells, held by the base standing at z = 0.

    Cells far from the last plane count less (Cauchy), those above it least: what stands on the ground is above it.
    """
    n = lowest.shape[0]
    A = np.zeros((3, 3))
    r = np.zeros(3)
    A[0, 0] = A[1, 1] = 40.0  # flat unless the rings say otherwise
    A[2, 2] = 20.0
    for row in range(n):
        for column in range(n):
            w = weight[row, column]
            if w <= 0:
                continue
            x, y, z = where[row, column, 0], where[row, column, 1], lowest[row, column]
            residual = z - (plane[0] * x + plane[1] * y + plane[2])
            scale = 0.15 if residual > 0 else 0.4
            distance2 = x * x + y * y
            w = w / (1.0 + (residual / scale) ** 2) / (1.0 + distance2 / 400.0)
            A[0, 0] += w * x * x
            A[0, 1] += w * x * y
            A[0, 2] += w * x
            A[1, 1] += w * y * y
            A[1, 2] += w * y
            A[2, 2] += w
            r[0] += w * x * z
            r[1] += w * y * z
            r[2] += w * z
    A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
    solution: Float64Array = np.linalg.solve(A, r)
    return solution


@njit(cache=True, nogil=True)
def _fit_ground(  # type: ignore[no-untyped-def]
    lowest: Float32Array, where: Float32Array, support: Float32Array, cell: float, sensor_height: float
):
    """Return the plane (a, b, c) and the ground's height above it on the grid of cells."""
    n = lowest.shape[0]
    bound = _envelope(lowest, cell, _STEEPEST, 0.0)
    weight = np.zeros((n, n), np.float32)
    for row in range(n):
        for column in range(n):
            if lowest[row, column] <= bound[row, column] + _STEP_M:
                weight[row, column] = 1.0 if support[row, column] > 1 else 0.3
    plane = np.zeros(3)
    for _ in range(6):
        plane = _fit_plane(where, lowest, weight, plane)

    residual = np.zeros((n, n), np.float32)
    ceiling = np.full((n, n), np.inf, np.float32)
    for row in range(n):
        for column in range(n):
            z = lowest[row, column]
            if not np.isfinite(z):
                continue
            x, y = where[row, column, 0], where[row, column, 1]
            r = z - (plane[0] * x + plane[1] * y + plane[2])
            residual[row, column] = r
            ceiling[row, column] = r + 0.1
            distance = np.sqrt(x * x + y * y)
            if abs(r) > 0.2 + _BENDING * distance:
                weight[row, column] = 0.0
    ground = np.zeros((n, n), np.float32)
    for _ in range(3):
        _stretch(ground, residual, weight, ceiling)
        for row in range(n):
            for column in range(n):
                if weight[row, column] > 0:
                    above = residual[row, column] - ground[row, column]
                    weight[row, column] = 1.0 / (1.0 + (above / 0.15) ** 2)
    _stretch(ground, residual, weight, ceiling)
    return plane, ground


@njit(cache=True, nogil=True, fastmath=False)
def _stretch(ground: Float32Array, target: Float32Array, weight: Float32Array, ceiling: Float32Array) -> None:
    """Relax `ground` between the weighted targets, under the ceiling, with a faint pull to 0; coarse to fine."""
    n = ground.shape[0]
    for level in range(_LEVELS - 1, -1, -1):
        step = 1 << level
        m = n // step
        w = np.zeros((m, m), np.float32)
        t = np.zeros((m, m), np.float32)
        g = np.zeros((m, m), np.float32)
        top = np.full((m, m), np.inf, np.float32)
        for row in range(m * step):
            for column in range(m * step):
                R, C = row // step, column // step
                w[R, C] += weight[row, column]
                t[R, C] += weight[row, column] * target[row, column]
                g[R, C] += ground[row, column] / (step * step)
                top[R, C] = min(top[R, C], ceiling[row, column])
        pull = np.float32(0.002 * step * step)
        for _ in range(_SWEEPS):
            for row in range(m):
                for column in range(m):
                    up = g[row - 1, column] if row > 0 else g[row, column]
                    down = g[row + 1, column] if row < m - 1 else g[row, column]
                    left = g[row, column - 1] if column > 0 else g[row, column]
                    right = g[row, column + 1] if column < m - 1 else g[row, column]
                    value = (t[row, column] + up + down + left + right) / (w[row, column] + 4.0 + pull)
                    g[row, column] = min(value, top[row, column])
        for row in range(m * step):
            for column in range(m * step):
                ground[row, column] = g[row // step, column // step]


@njit(cache=True, nogil=True)
def _heights_above(points: Float32Array, plane: Float64Array, ground: Float32Array, cell: float) -> Float32Array:
    n = ground.shape[0]
    half = n * cell / 2
    heights = np.empty(points.shape[0], np.float32)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (np.isfinite(x) and np.isfinite(y)):
            heights[i] = np.nan
            continue
        u = min(max((x + half) / cell - 0.5, 0.0), n - 1.001)
        v = min(max((y + half) / cell - 0.5, 0.0), n - 1.001)
        column, row = int(u), int(v)
        fu, fv = u - column, v - row
        south = ground[row, column] * (1 - fu) + ground[row, column + 1] * fu
        north = ground[row + 1, column] * (1 - fu) + ground[row + 1, column + 1] * fu
        heights[i] = z - (plane[0] * x + plane[1] * y + plane[2]) - (south * (1 - fv) + north * fv)
    return heights


# --- the ground in an aerial survey -------------------------------------------------------------------------------


def classify_ground(
    points: Float64Array,
    cell_m: float = 1.0,
    *,
    slope: float = 0.15,
    largest_window_m: float = 40.0,
    tolerance_m: float = 0.4,
) -> BoolArray:
    """Return the mask (N,) of ground points in an aerial survey that carries no classes.

    Points (N, 3) easting, northing, height, metres. A progressive morphological filter in the manner of Zhang et al.
    (2003) and SMRF (Pingel et al. 2013): openings of the lowest-point raster with windows that grow up to
    `largest_window_m`, which must exceed half the width of the widest building; what an opening lowers by more than
    `slope` times the window is an object. A point is ground within `tolerance_m` of the terrain that is left, plus
    what the terrain's own steepness adds.
    """
    check_points(points)
    if not (cell_m > 0 and slope > 0 and largest_window_m > 0 and tolerance_m > 0):
        raise CloudError("cell_m, slope, largest_window_m and tolerance_m must be positive")
    mask = np.zeros(len(points), np.bool_)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        return mask
    e, n, z = points[finite].T
    west, south = e.min(), n.min()
    columns = ((e - west) / cell_m).astype(np.int64)
    rows = ((n - south) / cell_m).astype(np.int64)
    shape = (int(rows.max()) + 1, int(columns.max()) + 1)
    lowest = np.full(shape, np.inf)
    np.minimum.at(lowest, (rows, columns), z)
    raster = np.where(np.isfinite(lowest), lowest, np.nan)
    raster[_is_pit(raster, cell_m)] = np.nan
    surface = fill_holes(raster.astype(np.float32)).astype(np.float64)

    is_object = np.zeros(shape, np.bool_)
    opened = surface
    for radius in _radii(largest_window_m / cell_m):
        size = 2 * radius + 1
        lower = ndimage.grey_opening(opened, size=(size, size))
        is_object |= opened - lower > slope * radius * cell_m
        opened = lower
    terrain = fill_holes(np.where(is_object | np.isnan(raster), np.nan, surface).astype(np.float32)).astype(np.float64)
    steepness = np.hypot(*np.gradient(terrain, cell_m)) if min(shape) > 1 else np.zeros(shape)
    at = np.stack([(n - south) / cell_m - 0.5, (e - west) / cell_m - 0.5])
    below = ndimage.map_coordinates(terrain, at, order=1, mode="nearest")
    steep = ndimage.map_coordinates(steepness, at, order=1, mode="nearest")
    mask[finite] = np.abs(z - below) <= tolerance_m + 0.5 * steep * cell_m
    return mask


def _radii(largest: float) -> list[int]:
    """Return growing window radii in cells: every one at first, then in steps of a fifth."""
    radii = [1]
    while radii[-1] < largest:
        radii.append(max(radii[-1] + 1, int(radii[-1] * 1.2)))
    return radii


def _is_pit(raster: npt.NDArray[np.float64], cell_m: float) -> BoolArray:
    """Return the cells that lie far below all their neighbours: reflections, not terrain."""
    filled = np.where(np.isfinite(raster), raster, np.inf)
    around = ndimage.minimum_filter(filled, footprint=np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]))
    pits: BoolArray = np.isfinite(around) & (filled < around - 5.0 * cell_m)
    return pits
