"""Take the motion of the lidar during its turn out of the points: each where it would have been at the stamp."""

from __future__ import annotations

import numpy as np
from numba import njit

from crossloc3d_ros.clouds.filters import check_points, check_pose
from crossloc3d_ros.config import ScanConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import Float32Array, Float64Array


def deskew(
    points: Float32Array,
    times_s: Float32Array,
    knots_s: Float64Array,
    T_stamp_knots: Float64Array,
    T_base_lidar: Float64Array,
    config: ScanConfig,
) -> Float32Array:
    """Return points (N, 3), lidar frame at their own times (N,), in the lidar frame at the stamp; metres, seconds.

    `T_stamp_knots` (K, 4, 4) are poses of the base at evenly spaced times `knots_s` (K,), K at least 2, in the base
    frame at the stamp; between them poses are interpolated, beyond them they go on as between the last two. What moves
    with the robot keeps its place: points nearer than `min_range_m` and inside of the robot's body. A point without a
    time becomes NaN. Raises CloudError for unusable arguments.
    """
    check_points(points)
    check_pose(T_base_lidar, "T_base_lidar")
    if times_s.shape != (len(points),):
        raise CloudError(f"the times of {len(points)} points must have the shape ({len(points)},), got {times_s.shape}")
    if len(knots_s) < 2 or T_stamp_knots.shape != (len(knots_s), 4, 4):
        raise CloudError(f"poses at {len(knots_s)} times, at least 2, are needed, got {T_stamp_knots.shape}")
    T_stamp_lidar = np.linalg.inv(T_base_lidar) @ T_stamp_knots @ T_base_lidar
    return np.asarray(
        _moved(
            np.ascontiguousarray(points, dtype=np.float32),
            np.ascontiguousarray(times_s, dtype=np.float32),
            float(knots_s[0]),
            float(knots_s[1] - knots_s[0]),
            np.ascontiguousarray(T_stamp_lidar[:, :3], dtype=np.float64),
            np.ascontiguousarray(T_base_lidar, dtype=np.float64),
            config.min_range_m,
            np.array(config.body_min_m),
            np.array(config.body_max_m),
        )
    )


@njit(cache=True, nogil=True)
def _moved(  # type: ignore[no-untyped-def]
    points: Float32Array, times: Float32Array, first: float, step: float, poses: Float64Array, T: Float64Array,
    min_range: float, body_min: Float64Array, body_max: Float64Array,
):  # fmt: skip
    """Move each point by the pose of its time; matrices are interpolated entry by entry, exact enough between knots."""
    moved = np.empty_like(points)
    last = poses.shape[0] - 2
    for i in range(points.shape[0]):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        moved[i, 0], moved[i, 1], moved[i, 2] = x, y, z
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)) or x * x + y * y + z * z < min_range * min_range:
            continue
        bx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        by = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        bz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if body_min[0] < bx < body_max[0] and body_min[1] < by < body_max[1] and body_min[2] < bz < body_max[2]:
            continue
        if not np.isfinite(times[i]):
            moved[i, 0] = moved[i, 1] = moved[i, 2] = np.nan
            continue
        at = (times[i] - first) / step
        k = min(max(int(np.floor(at)), 0), last)
        share = at - k
        A, B = poses[k], poses[k + 1]
        for row in range(3):
            before = A[row, 0] * x + A[row, 1] * y + A[row, 2] * z + A[row, 3]
            after = B[row, 0] * x + B[row, 1] * y + B[row, 2] * z + B[row, 3]
            moved[i, row] = before + share * (after - before)
    return moved
