"""Whether a scan can be that of a lidar which is mounted as configured and sees its surroundings.

    reason = implausible(scan.points, T_base_lidar, config.scan)       # empty, or what is wrong and what to do

Ground shows as many flat cells of a metre below the lidar, out to some distance. Where they lie on another side of it,
and hardly any below, the lidar is mounted otherwise than configured. A ceiling or a long wall is no ground: below there
is a floor as well. A mirrored scan looks like any other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.clouds.filters import check_points, check_pose
from crossloc3d_ros.config import ScanConfig
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

BLOCKED_M = 2.0
"""A robot outdoors that sees nothing farther away has something in front of its lidar."""
_BLOCKED_SHARE = 0.98
_LEAST_POINTS = 64  # of fewer nothing is concluded

_MOST_POINTS = 40_000  # a lidar of 128 beams is looked at by a part of its columns
_REACH_M = 25  # cells of a metre, so far around
_FAR_M = 10.0  # no room's ceiling or wall close by
_NEAR_PLANE_M = 4.0  # lidars are mounted lower than that above the ground
_FLAT_M = 0.3  # thickness of a flat cell: kerbs, grass and slopes of 15 degrees are
_CELL_POINTS = 3

# Of the 1,593 scans of the pose set `fitting` each has at least 54 flat cells below the lidar and at most 0.56 times as
# many above; upside down, 95 % have twice as many above.
_LEAST_CELLS, _LEAST_FAR_CELLS = 40, 6
_ABOVE_RATIO = 2
_OPPOSITE_RATIO = 4  # opposite of the ground is the sky, opposite of a wall in an alley another one
_LEAST_AROUND = 32  # of the cells nearer than `_FAR_M`; upright or upside down there are at least 42
_MOST_AROUND = 10  # beside a long wall more is seen of even a narrow path, but by a lidar that is turned of no ground

_COMPARED, _SAME_M, _SAME_SHARE = 512, 1e-3, 0.99
_FARTHEST_M = 1e6

_WHERE = ("behind it", "ahead of it", "to its right", "to its left")
"""-x, +x, -y, +y of the base frame; the counts of sides begin with -z and +z."""


def implausible(points: Float32Array, T_base_lidar: Float64Array, config: ScanConfig) -> str:
    """Return why points (N, 3), lidar frame, cannot be a usable scan; empty where they can.

    Raises CloudError for unusable arguments only.
    """
    check_points(points)
    check_pose(T_base_lidar, "T_base_lidar")
    step = 1 + len(points) // _MOST_POINTS
    near, known, flat, far = _survey(
        np.ascontiguousarray(points[::step], dtype=np.float32),
        np.ascontiguousarray(T_base_lidar, dtype=np.float64),
        config.min_range_m,
        np.array(config.body_min_m),
        np.array(config.body_max_m),
    )
    if known >= _LEAST_POINTS and near >= _BLOCKED_SHARE * known and config.max_range_m > BLOCKED_M:
        return (
            f"the lidar is covered or blocked: {near / known:.0%} of what it sees off the robot's body lies within "
            f"{BLOCKED_M:g} m"
        )
    return _mounting(flat, far)


def _mounting(flat: Int64Array, far: Int64Array) -> str:
    """Return what is wrong with the mounting by the flat cells (6,), and those of them farther away, on each side."""
    is_wide = (flat >= _LEAST_CELLS) & (far >= _LEAST_FAR_CELLS)
    below, above = int(flat[0]), int(flat[1])
    around = flat - far
    if is_wide[1] and around[1] >= _LEAST_AROUND and above >= _ABOVE_RATIO * below:
        return (
            f"the lidar is upside down: the ground lies above it ({above} m2 are seen there and {below} below); check "
            "its mounting"
        )
    side = 2 + int(np.argmax(flat[2:]))
    beside, opposite = int(flat[side]), int(flat[side ^ 1])
    if is_wide[side] and beside >= _OPPOSITE_RATIO * opposite and around[0] <= _MOST_AROUND:
        return (
            f"the lidar is turned by 90 degrees in {'pitch' if side < 4 else 'roll'}: the ground stands upright "
            f"{_WHERE[side - 2]} ({beside} m2 are seen there and {around[0]} close below); check its mounting"
        )
    return ""


@njit(cache=True, nogil=True)
def _survey(  # type: ignore[no-untyped-def]
    points: Float32Array, T: Float64Array, min_range: float, body_min: Float64Array, body_max: Float64Array,
):  # fmt: skip
    """Return how many points lie near and in all, off the body, and the flat cells, all and far ones, on six sides."""
    cells = 2 * _REACH_M
    low = np.full((6, cells, cells), np.inf, dtype=np.float32)
    high = np.full((6, cells, cells), -np.inf, dtype=np.float32)
    count = np.zeros((6, cells, cells), dtype=np.int32)
    near = 0
    known = 0
    rel = np.empty(3)
    for i in range(points.shape[0]):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        range2 = x * x + y * y + z * z
        if not np.isfinite(range2) or range2 == 0.0:  # drivers send no echo as NaN or as the origin
            continue
        for row in range(3):
            rel[row] = T[row, 0] * x + T[row, 1] * y + T[row, 2] * z
        bx, by, bz = rel[0] + T[0, 3], rel[1] + T[1, 3], rel[2] + T[2, 3]
        if body_min[0] < bx < body_max[0] and body_min[1] < by < body_max[1] and body_min[2] < bz < body_max[2]:
            continue
        known += 1
        if range2 < BLOCKED_M * BLOCKED_M:
            near += 1
        if range2 < min_range * min_range:
            continue
        for pair in range(3):
            axis = (2, 0, 1)[pair]
            away = abs(rel[axis])
            if not 0.15 < away < _NEAR_PLANE_M:  # what lies at the lidar's own height belongs to no side
                continue
            u, v = rel[(axis + 1) % 3] + _REACH_M, rel[(axis + 2) % 3] + _REACH_M
            if not (0.0 <= u < cells and 0.0 <= v < cells):
                continue
            side, j, k = 2 * pair + (1 if rel[axis] > 0.0 else 0), int(u), int(v)
            count[side, j, k] += 1
            low[side, j, k] = min(low[side, j, k], away)
            high[side, j, k] = max(high[side, j, k], away)
    flat = np.zeros(6, dtype=np.int64)
    far = np.zeros(6, dtype=np.int64)
    for side in range(6):
        for j in range(cells):
            for k in range(cells):
                if count[side, j, k] >= _CELL_POINTS and high[side, j, k] - low[side, j, k] < _FLAT_M:
                    flat[side] += 1
                    if (j + 0.5 - _REACH_M) ** 2 + (k + 0.5 - _REACH_M) ** 2 > _FAR_M * _FAR_M:
                        far[side] += 1
    return near, known, flat, far


def same_points(points: npt.NDArray[np.float32], before: npt.NDArray[np.float32]) -> bool:
    """Return whether two clouds (N, 3) are the same to a millimetre: a live lidar never repeats its noise.

    It scatters by centimetres, and at rest too hardly a point comes back to where it was. Compared are `_COMPARED`
    points, alike in which of them are no echo. Of too few echoes nothing is concluded.
    """
    if points.shape != before.shape:
        return False
    rows = np.linspace(0, len(points) - 1, min(len(points), _COMPARED)).astype(np.int64)
    now, then = points[rows].astype(np.float64), before[rows].astype(np.float64)
    is_echo, was_echo = _is_echo(now), _is_echo(then)
    both = is_echo & was_echo
    if np.count_nonzero(both) < _LEAST_POINTS:
        return False
    same = is_echo == was_echo
    same[both] = np.abs(now[both] - then[both]).max(axis=1) < _SAME_M
    return float(np.mean(same)) >= _SAME_SHARE


def _is_echo(points: Float64Array) -> npt.NDArray[np.bool_]:
    """Return which points (N, 3) are echoes: drivers send none as NaN, as the origin, or as far away as can be."""
    nearness = np.abs(points).max(axis=1)
    return np.asarray(np.isfinite(nearness) & (nearness > 0.0) & (nearness < _FARTHEST_M))
