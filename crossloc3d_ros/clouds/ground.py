"""Where the ground is under a robot that sees it in a few sparse rings."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from crossloc3d_ros.clouds.filters import check_points
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import Float32Array, Float64Array

_CELL_M = 2.0  # holds a few points of most rings near the robot, and is narrower than a street
_STEEPEST = 0.35  # what rises faster than this is a wall, a car or a kerb, never the road
_STEP_M = 0.25  # and so is a step higher than this
_BENDING = 0.12  # the ground may fall away from the plane through it by this much a metre of distance
_CONE_M = 0.4  # and by this much anywhere; what lies deeper is a reflection
_DROP_M = 0.4  # what lies this far below the ground around it is another storey
_CEILING = 0.15  # weight of a cell's ceiling beside that of a flat cell, 1
_FARTHEST_M = 150.0  # no sensor on a robot sees the ground beyond
_LEVELS = 3  # the membrane is stretched over cells of 8, 4 and 2 m
_SWEEPS = 12  # relaxations of each level; coarse levels have done the long range before


def scan_heights(points_base: Float32Array, sensor_height_m: float, *, reach_m: float = 72.0) -> Float32Array:
    """Return the heights (N,) float32 of a scan's points above the ground below them, metres.

    Points (N, 3): base frame, z up, the base standing on the ground at about z = 0, the sensor `sensor_height_m`
    above it. The ground is modelled out to `reach_m` on either side and extrapolated beyond. NaN points get NaN.

    The ground is a plane through the ground points, plus a membrane that follows the rings where they touch it
    and comes back to the plane where they do not. Ground points are the lowest points of flat cells, no higher
    above any other cell than the steepest road would lead, which keeps walls and car roofs out, and not far below the
    ground around, as canals and boats are. Every ray passes above the ground on its way to its point. With no usable
    point the ground is the plane z = 0.
    """
    check_points(points_base, "points_base")
    if not (math.isfinite(sensor_height_m) and math.isfinite(reach_m) and reach_m > 0):
        raise CloudError(f"sensor_height_m and reach_m must be finite, got {sensor_height_m} and {reach_m}")
    reach_m = min(reach_m, _FARTHEST_M)
    points = np.ascontiguousarray(points_base, dtype=np.float32)
    step = 1 << (_LEVELS - 1)
    cells = 2 * step * math.ceil(reach_m / _CELL_M / step)  # every level halves it evenly
    heights: Float32Array = _heights_above_ground(points, np.float32(sensor_height_m), cells)
    return heights


@njit(cache=True, nogil=True)
def _heights_above_ground(points: Float32Array, sensor_height: float, cells: int) -> Float32Array:
    """Run the steps: cells and plane; once more along that plane; ceiling, membrane, heights."""
    plane = np.zeros(3)
    deepest = np.float32(_STEEPEST)  # before the slope is known
    for _ in range(2):
        # The second time "lowest" and "flat" are meant along the slope that the first time found.
        lowest, where, flat = _lowest_of_cells(points, cells, plane, deepest)
        deepest = np.float32(_BENDING)
        plane = _fit_plane(where, lowest, _below(lowest, _steepest_bound(lowest), flat), plane)

    # From here on everything is measured from the plane.
    ceiling = _seen_through(lowest, where, sensor_height)
    target = np.zeros((cells, cells), np.float32)
    half = cells * _CELL_M / 2
    for row in range(cells):
        for column in range(cells):
            if lowest[row, column] < np.inf:
                x, y = where[row, column, 0], where[row, column, 1]
                target[row, column] = lowest[row, column] - (plane[0] * x + plane[1] * y + plane[2])
            x, y = (column + 0.5) * _CELL_M - half, (row + 0.5) * _CELL_M - half
            ceiling[row, column] -= plane[0] * x + plane[1] * y + plane[2]
    ground = np.zeros((cells, cells), np.float32)
    _stretch(ground, target, flat, ceiling, 1.0)
    # What lies well below the ground so far (a canal's wall, a boat, a cellar) is no measurement of the road above it.
    for row in range(cells):
        for column in range(cells):
            if target[row, column] < ground[row, column] - np.float32(_DROP_M):
                lowest[row, column] = np.inf
    weight = _below(lowest, _steepest_bound(lowest), flat)
    for scale in (2.0, 1.0, 0.5, 0.25):
        _stretch(ground, target, weight, ceiling, scale)
    heights: Float32Array = _heights_above(points, plane, ground)
    return heights


@njit(cache=True, nogil=True)
def _below(lowest: Float32Array, bound: Float32Array, flat: Float32Array) -> Float32Array:
    """Return the weight of each cell as ground: its flatness, nothing where it rises above the bound."""
    weight = np.zeros_like(flat)
    for row in range(flat.shape[0]):
        for column in range(flat.shape[0]):
            if lowest[row, column] <= bound[row, column] + np.float32(_STEP_M):
                weight[row, column] = flat[row, column]
    return weight


@njit(cache=True, nogil=True)
def _lowest_of_cells(points: Float32Array, cells: int, plane: Float64Array, deepest: float):  # type: ignore[no-untyped-def]
    """Return each cell's lowest z (infinite where there is none to trust), its x and y, and how flat the cell is.

    Lowest is the point that lies lowest over the plane. Flat is the cubed share of the points up to 2 m above it that
    lie within 0.3 m of it: 1 on a road, little where a wall stands. A lowest point without a second one near it, or far
    below all cells around, is a reflection.
    """
    inverse = np.float32(1.0 / _CELL_M)
    half = np.float32(cells * _CELL_M / 2)
    lowest = np.full((cells, cells), np.inf, np.float32)
    where = np.zeros((cells, cells, 2), np.float32)
    low = np.zeros((cells, cells), np.int32)
    near = np.zeros((cells, cells), np.int32)
    cell_of = np.empty(points.shape[0], np.int32)
    over = np.empty(points.shape[0], np.float32)
    a, b, c = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cell_of[i] = -1
        if not (abs(x) < half and abs(y) < half):
            continue
        distance = np.sqrt(x * x + y * y)
        if not (z <= distance * np.float32(_STEEPEST) + np.float32(_CONE_M)):
            continue  # no ground; and infinity stays out of the sums
        row, column = min(int((y + half) * inverse), cells - 1), min(int((x + half) * inverse), cells - 1)
        over[i] = z - (a * x + b * y + c)
        if not (over[i] >= -(distance * deepest + np.float32(_CONE_M))):
            continue
        cell_of[i] = row * cells + column
        held = lowest[row, column]
        first = x < where[row, column, 0] or (x == where[row, column, 0] and y < where[row, column, 1])
        if over[i] < held or (over[i] == held and first):  # whatever the order of the points
            lowest[row, column] = over[i]
            where[row, column, 0] = x
            where[row, column, 1] = y
    for i in range(points.shape[0]):
        if cell_of[i] >= 0:
            row, column = cell_of[i] // cells, cell_of[i] % cells
            above = over[i] - lowest[row, column]
            if above < np.float32(2.0):
                near[row, column] += 1
                if above < np.float32(0.3):
                    low[row, column] += 1
    flat = np.zeros((cells, cells), np.float32)
    trusted = np.full((cells, cells), np.inf, np.float32)
    for row in range(cells):
        for column in range(cells):
            if low[row, column] >= 2 and not _is_pit_of_scan(lowest, row, column):
                flat[row, column] = (low[row, column] / near[row, column]) ** 3
                x, y = where[row, column, 0], where[row, column, 1]
                trusted[row, column] = lowest[row, column] + (a * x + b * y + c)
    return trusted, where, flat


@njit(cache=True, nogil=True)
def _is_pit_of_scan(lowest: Float32Array, row: int, column: int):  # type: ignore[no-untyped-def]
    """Return whether at least three cells around are occupied and all lie far above this one."""
    n = lowest.shape[0]
    others = 0
    for r in range(max(0, row - 1), min(n, row + 2)):
        for c in range(max(0, column - 1), min(n, column + 2)):
            if (r != row or c != column) and lowest[r, c] < np.inf:
                others += 1
                if lowest[r, c] - lowest[row, column] < np.float32(0.4 + _STEEPEST * _CELL_M):
                    return False
    return others >= 3


@njit(cache=True, nogil=True)
def _steepest_bound(lowest: Float32Array) -> Float32Array:
    """Return the highest ground that the steepest slope allows above all cells and the base (two chamfer passes)."""
    n = lowest.shape[0]
    bound = lowest.copy()
    straight = np.float32(_STEEPEST * _CELL_M)
    diagonal = np.float32(_STEEPEST * _CELL_M * 1.4142)
    for row in range(n // 2 - 1, n // 2 + 1):
        for column in range(n // 2 - 1, n // 2 + 1):
            bound[row, column] = min(bound[row, column], straight)
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
def _seen_through(lowest: Float32Array, where: Float32Array, sensor_height: float) -> Float32Array:
    """Return the lowest ray over each cell, from the sensor to the cells' lowest points: it passes above the ground."""
    n = lowest.shape[0]
    half = np.float32(n * _CELL_M / 2)
    inverse = np.float32(1.0 / _CELL_M)
    ceiling = lowest.copy()
    for row in range(n):
        for column in range(n):
            z = lowest[row, column]
            if not z < np.inf:
                continue
            x, y = where[row, column, 0], where[row, column, 1]
            steps = int(np.sqrt(x * x + y * y) * inverse)
            if steps < 2:
                continue
            share = np.float32(1.0) / np.float32(steps)
            u, v = half * inverse, half * inverse
            height = np.float32(sensor_height)
            du, dv, dz = x * inverse * share, y * inverse * share, (z - height) * share
            for _ in range(steps - 1):
                u += du
                v += dv
                height += dz
                r, c = int(v), int(u)
                ceiling[r, c] = min(ceiling[r, c], height)
    return ceiling


@njit(cache=True, nogil=True)
def _fit_plane(where: Float32Array, lowest: Float32Array, weight: Float32Array, plane: Float64Array) -> Float64Array:
    """Return the plane z = a x + b y + c through the cells' lowest points, held by the base that stands at z = 0.

    Cells off the last plane count less (Cauchy), in ever narrower bounds. Cells near the robot count more: there the
    rings are dense.
    """
    n = lowest.shape[0]
    count = 0
    x, y, z, w = np.empty(n * n), np.empty(n * n), np.empty(n * n), np.empty(n * n)
    for row in range(n):
        for column in range(n):
            if weight[row, column] > 0:
                x[count], y[count] = where[row, column, 0], where[row, column, 1]
                z[count] = lowest[row, column]
                w[count] = weight[row, column] / (1.0 + (x[count] ** 2 + y[count] ** 2) / 400.0)
                count += 1
    pa, pb, pc = plane
    for scale in (2.0, 2.0, 2.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.25, 0.25, 0.25):
        xx, yy = 4.0, 4.0  # flat unless the rings show a slope
        n1 = 20.0
        xy, x1, y1, xz, yz, z1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(count):
            off = z[i] - (pa * x[i] + pb * y[i] + pc)
            scaled = off / scale
            v = w[i] / (1.0 + scaled * scaled)
            xx += v * x[i] * x[i]
            xy += v * x[i] * y[i]
            x1 += v * x[i]
            yy += v * y[i] * y[i]
            y1 += v * y[i]
            n1 += v
            xz += v * x[i] * z[i]
            yz += v * y[i] * z[i]
            z1 += v * z[i]
        # Cramer's rule: symmetric, positive definite, and quicker to compile than LAPACK.
        c00, c01, c02 = yy * n1 - y1 * y1, x1 * y1 - xy * n1, xy * y1 - x1 * yy
        c11, c12, c22 = xx * n1 - x1 * x1, xy * x1 - xx * y1, xx * yy - xy * xy
        determinant = xx * c00 + xy * c01 + x1 * c02
        pa = (c00 * xz + c01 * yz + c02 * z1) / determinant
        pb = (c01 * xz + c11 * yz + c12 * z1) / determinant
        pc = (c02 * xz + c12 * yz + c22 * z1) / determinant
    return np.array([pa, pb, pc])


@njit(cache=True, nogil=True)
def _stretch(
    ground: Float32Array, target: Float32Array, weight: Float32Array, ceiling: Float32Array, scale: float
) -> None:
    """Relax `ground` towards the weighted targets, softly under the ceiling, faintly towards 0; coarse to fine.

    Targets farther than `scale` from where the ground is now count less (Cauchy).
    """
    n = ground.shape[0]
    w = np.zeros((n, n), np.float32)
    t = np.zeros((n, n), np.float32)
    inverse_scale = np.float32(1.0 / scale)
    for row in range(n):
        for column in range(n):
            now = ground[row, column]
            if weight[row, column] > 0:
                off = (target[row, column] - now) * inverse_scale
                w[row, column] = weight[row, column] / (np.float32(1.0) + off * off)
                t[row, column] = w[row, column] * target[row, column]
            over = now - ceiling[row, column]
            if over > np.float32(0.1):
                w[row, column] += np.float32(_CEILING)
                t[row, column] += np.float32(_CEILING) * ceiling[row, column]
    for level in range(_LEVELS - 1, -1, -1):
        step = 1 << level
        m = n // step
        held = np.zeros((m, m), np.float32)
        inverse = np.zeros((m, m), np.float32)
        g = np.zeros((m + 2, m + 2), np.float32)  # with a rim that repeats the outermost cells: free edges
        for row in range(n):
            for column in range(n):
                R, C = row // step, column // step
                inverse[R, C] += w[row, column]
                held[R, C] += t[row, column]
                g[R + 1, C + 1] += ground[row, column]
        others = np.float32(4.0 + 0.0005 * step * step)
        mean = np.float32(1.0 / (step * step))
        for R in range(m):
            for C in range(m):
                inverse[R, C] = np.float32(1.0) / (inverse[R, C] + others)
                g[R + 1, C + 1] *= mean
        for _ in range(_SWEEPS):
            for k in range(1, m + 1):
                g[0, k], g[m + 1, k], g[k, 0], g[k, m + 1] = g[1, k], g[m, k], g[k, 1], g[k, m]
            for R in range(1, m + 1):
                left = g[R, 0]
                for C in range(1, m + 1):
                    around = held[R - 1, C - 1] + g[R - 1, C] + g[R + 1, C] + g[R, C + 1]
                    left = (around + left) * inverse[R - 1, C - 1]
                    g[R, C] = left
        for row in range(n):
            for column in range(n):
                ground[row, column] = g[row // step + 1, column // step + 1]


@njit(cache=True, nogil=True)
def _heights_above(points: Float32Array, plane: Float64Array, ground: Float32Array) -> Float32Array:
    """Return z minus the plane minus the bilinear ground (N,); beyond the grid its outermost value holds."""
    n = ground.shape[0]
    inverse = np.float32(1.0 / _CELL_M)
    half = np.float32(n * _CELL_M / 2)
    last = np.float32(n - 1.001)
    a, b, c = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    heights = np.empty(points.shape[0], np.float32)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (np.isfinite(x) and np.isfinite(y)):
            heights[i] = np.nan
            continue
        u = min(max((x + half) * inverse - np.float32(0.5), np.float32(0.0)), last)
        v = min(max((y + half) * inverse - np.float32(0.5), np.float32(0.0)), last)
        column, row = int(u), int(v)
        fu, fv = u - np.float32(column), v - np.float32(row)
        south = ground[row, column] + (ground[row, column + 1] - ground[row, column]) * fu
        north = ground[row + 1, column] + (ground[row + 1, column + 1] - ground[row + 1, column]) * fu
        heights[i] = z - (a * x + b * y + c) - (south + (north - south) * fv)
    return heights
