"""From a scan as the sensor gives it to a patch as the encoder wants it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.clouds.filters import check_points, check_pose, levelling_matrix, mounting_matrix
from crossloc3d_ros.clouds.ground import scan_heights
from crossloc3d_ros.clouds.patch import crop_above_ground, patch_of_cropped
from crossloc3d_ros.config import PreprocessingConfig, ScanConfig
from crossloc3d_ros.types import Float32Array, Float64Array, Patch, Scan, ScanCounts


@dataclass(frozen=True, eq=False)
class PreparedScan:
    """What became of a scan."""

    patch: Patch | None
    """None where too little of the scan can be used; `reason` says why."""
    counts: ScanCounts
    reason: str
    """Empty where there is a patch, else one sentence for people."""
    place: Float32Array
    """(N, 3) the usable points, metres: x, y from the sensor along the robot's heading, z above the ground below them.
    Outside of the robot's own body, as far as the sensor reaches."""
    level_z_m: Float32Array
    """(N,) the same points' z in the levelled base frame."""
    sensor_height_m: float
    """Of the sensor above the ground under the robot."""


def prepare_scan(
    scan: Scan,
    config: ScanConfig,
    preprocessing: PreprocessingConfig,
    gravity_base: npt.NDArray[np.floating] | None = None,
    T_base_lidar: Float64Array | None = None,
) -> PreparedScan:
    """Turn a scan into its patch: x, y from the sensor along the robot's heading, z above the ground.

    Non-finite points, those nearer or farther from the sensor than `config` allows and those inside the robot's own
    body are left out. The rest is levelled by the mounting, `T_base_lidar` (4, 4) where one is given in place of the
    configured one, and by `gravity_base` (3,), the measured "up" in the base frame, where an IMU gives it. Raises
    CloudError for unusable arguments only; a scan without use gives a reason instead of a patch.
    """
    check_points(scan.points, "scan.points")
    if T_base_lidar is None:
        T_base_lidar = mounting_matrix(config.mounting)
    check_pose(T_base_lidar, "T_base_lidar")
    T_level_base = np.eye(4) if gravity_base is None else levelling_matrix(gravity_base)
    sensor_level = (T_level_base @ T_base_lidar)[:3, 3]

    points_level, finite, in_range, off_body = _usable_points(
        np.ascontiguousarray(scan.points, dtype=np.float32),
        np.ascontiguousarray(T_base_lidar, dtype=np.float64),
        T_level_base,
        config.min_range_m,
        config.max_range_m,
        np.array(config.body_min_m),
        np.array(config.body_max_m),
    )
    place = points_level - np.array([sensor_level[0], sensor_level[1], 0.0], np.float32)
    half_extent_m = preprocessing.scan_half_extent_m
    reach_m = min(1.45 * half_extent_m, config.max_range_m)  # as far as the patch's corners
    level_z = place[:, 2].copy()
    place[:, 2] = scan_heights(place, float(sensor_level[2]), reach_m=reach_m)

    cropped = crop_above_ground(place, half_extent_m, preprocessing)
    above_ground = int(np.count_nonzero(place[:, 2] >= preprocessing.ground_clearance_m))
    counts = ScanCounts(len(scan.points), finite, in_range, off_body, above_ground, len(cropped))
    origin = "mean" if preprocessing.scan_origin == "mean" else "given"
    patch = patch_of_cropped(cropped, half_extent_m, preprocessing, origin=origin)  # type: ignore[arg-type]
    reason = "" if patch is not None else _why_not(counts, config, preprocessing)
    return PreparedScan(patch, counts, reason, place, level_z, float(sensor_level[2]))


def _why_not(counts: ScanCounts, config: ScanConfig, preprocessing: PreprocessingConfig) -> str:
    """Name the step that lost most of the points."""
    if counts.received == 0:
        return "the scan is empty"
    received = f"{counts.received:,}"
    if counts.off_body < preprocessing.min_points:
        why = [
            (counts.received - counts.finite, "are not finite"),
            (counts.finite - counts.in_range, f"lie outside {config.min_range_m:g} to {config.max_range_m:g} m"),
            (counts.in_range - counts.off_body, "lie on the robot's own body"),
        ]
        lost = ", ".join(f"{number:,} {what}" for number, what in why if number)
        left = f"{counts.off_body:,} of {received} points left after filtering"
        return f"{left} ({lost})" if lost else left
    return (
        f"{counts.in_patch:,} of {received} points stand {preprocessing.ground_clearance_m:g} m or more above the "
        f"ground within {preprocessing.scan_half_extent_m:g} m; {preprocessing.min_points:,} are needed"
    )


@njit(cache=True, nogil=True)
def _usable_points(  # type: ignore[no-untyped-def]
    points: Float32Array, T_base_lidar: Float64Array, T_level_base: Float64Array, min_range: float, max_range: float,
    body_min: Float64Array, body_max: Float64Array,
):  # fmt: skip
    """Return the usable points in the levelled base frame and how many were finite, in range and off the body."""
    T, L = T_base_lidar, T_level_base
    kept = np.empty_like(points)
    finite = 0
    in_range = 0
    n = 0
    for i in range(points.shape[0]):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            continue
        finite += 1
        range2 = x * x + y * y + z * z
        if range2 < min_range * min_range or range2 > max_range * max_range:
            continue
        in_range += 1
        bx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        by = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        bz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if body_min[0] < bx < body_max[0] and body_min[1] < by < body_max[1] and body_min[2] < bz < body_max[2]:
            continue
        kept[n, 0] = L[0, 0] * bx + L[0, 1] * by + L[0, 2] * bz
        kept[n, 1] = L[1, 0] * bx + L[1, 1] * by + L[1, 2] * bz
        kept[n, 2] = L[2, 0] * bx + L[2, 1] * by + L[2, 2] * bz
        n += 1
    return kept[:n], finite, in_range, n
