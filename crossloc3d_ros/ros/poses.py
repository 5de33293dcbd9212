"""Poses from messages: odometry, initial poses, an IMU's orientation. What cannot be used is refused with a reason."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import Pose, PoseWithCovariance
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu

from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.ros.conversions import in_grid
from crossloc3d_ros.types import Float64Array

EARTH_FRAME_ID = "earth"
"""ECEF (REP-105): the map's origin explains it, and TF need not."""
OUTSIDE_M = 100.0
"""An initial pose may lie so far outside of the map: whoever points at its border means the border."""
FARTHEST_M = 1e6
LEAST_STD_M, LEAST_STD_RAD = 0.1, math.radians(0.5)
DEFAULT_STD_M, DEFAULT_STD_RAD = 2.0, math.radians(20.0)
"""Of a pose whose covariance is all zeros, which in ROS means that it was not filled in."""
UNKNOWN_STD_M, UNKNOWN_STD_RAD = 1e5, math.pi
"""What deviates by more is not known at all."""
LEVEL_COSINE = 0.5
"""A base is upright within 60 degrees; what lies flatter follows another convention of axes."""


def frame_of(frame_id: str) -> str:
    """Return the name of a frame as tf2 has it: without the leading slash that nodes of ROS 1 gave it."""
    return frame_id.lstrip("/")


def stamp_of(message: Odometry | Imu) -> int:
    """Return the stamp of a message's header in nanoseconds."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def initial_pose(
    pose: PoseWithCovariance, stamp_ns: int, T_map_frame: Float64Array, frame: MapFrame, bounds: Bounds
) -> PosePrior:
    """Return the prior that a pose in some frame means, that frame's pose in the map being `T_map_frame` (4, 4).

    `bounds` are those of the map. PoseError where the pose is none, lies outside or on its side.
    """
    T_map_base = T_map_frame @ pose_matrix(pose.pose)
    if T_map_base[2, 2] < LEVEL_COSINE:
        raise PoseError("the pose lies on its side in the map: z must point up (REP-103)")
    covariance = _map_covariance(np.array(pose.covariance, dtype=np.float64).reshape(6, 6), T_map_frame[:3, :3])
    yaw = math.atan2(T_map_base[1, 0], T_map_base[0, 0])
    if np.abs(T_map_base[:3, 3]).max() > FARTHEST_M:
        raise PoseError("it lies outside of the map, and of what a map can be")
    grid, heading = _in_grid(frame, T_map_base[:3, 3], yaw)
    c, s = math.cos(heading - yaw), math.sin(heading - yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    covariance = R @ covariance @ R.T
    west, south, east, north = bounds
    away = math.hypot(max(west - grid[0], 0.0, grid[0] - east), max(south - grid[1], 0.0, grid[1] - north))
    has_position = covariance[0, 0] + covariance[1, 1] < UNKNOWN_STD_M**2
    has_heading = covariance[2, 2] < UNKNOWN_STD_RAD**2
    if has_position and not away <= OUTSIDE_M:
        raise PoseError(f"it lies {away:,.0f} m outside of the map")
    if not has_position and not has_heading:
        raise PoseError("by its covariance neither position nor heading is known")
    return PosePrior(
        grid=grid if has_position else None,
        heading_rad=heading if has_heading else None,
        covariance=_forgetting(covariance, has_position, has_heading),
        stamp_ns=stamp_ns,
    )


def heading_prior(
    imu: Imu, R_base_imu: Float64Array, frame: MapFrame, std_rad: float, offset_rad: float
) -> PosePrior | None:
    """Return the heading measured by an IMU's orientation; None where it has no orientation.

    REP-145: the orientation rotates the IMU's axes, whose directions on the base are `R_base_imu` (3, 3), to east,
    north and up. `offset_rad` is added, counter-clockwise. PoseError where the orientation follows another convention,
    which shows in that it does not rotate the measured acceleration upwards.
    """
    if imu.orientation_covariance[0] < 0.0:
        return None
    pose = Pose(orientation=imu.orientation)
    R_world_imu = pose_matrix(pose)[:3, :3]
    force = imu.linear_acceleration
    up = R_world_imu @ np.array([force.x, force.y, force.z])
    length = float(np.linalg.norm(up))
    if not up[2] > LEVEL_COSINE * length:
        raise PoseError(
            f"the orientation rotates the acceleration to {np.round(up, 2).tolist()}, which does not point up: "
            "it must be that of the IMU's axes in east, north, up (REP-145)"
        )
    R_world_base = R_world_imu @ R_base_imu.T
    if R_world_base[2, 2] < LEVEL_COSINE:
        raise PoseError("by its orientation the robot lies on its side")
    yaw = math.atan2(R_world_base[1, 0], R_world_base[0, 0]) + offset_rad
    _, heading = _in_grid(frame, np.zeros(3), yaw)
    measured = float(imu.orientation_covariance[8])
    variance = max(std_rad**2, measured if math.isfinite(measured) else 0.0)
    return PosePrior(None, heading, np.diag([math.inf, math.inf, variance]), stamp_of(imu))


def _in_grid(frame: MapFrame, enu: Float64Array, yaw_rad: float) -> tuple[Float64Array, float]:
    grid, heading = in_grid(frame, enu[None], np.array([yaw_rad]))
    return grid[0], float(heading[0])


def _map_covariance(covariance: Float64Array, R_map_frame: Float64Array) -> Float64Array:
    """Return x, y, yaw (3, 3) in the map of a pose's covariance (6, 6) in its own frame, no smaller than can be."""
    variances = np.diag(covariance)
    if np.isnan(covariance).any() or (variances < 0.0).any():
        raise PoseError("its covariance is none: variances must not be negative")
    if not covariance.any():
        return np.diag([DEFAULT_STD_M**2, DEFAULT_STD_M**2, DEFAULT_STD_RAD**2])
    # Infinities and what is as good as one would spoil the products.
    most = np.array([UNKNOWN_STD_M] * 3 + [2.0 * UNKNOWN_STD_RAD] * 3)
    scale = np.minimum(1.0, most / np.sqrt(np.maximum(variances, 1e-300)))
    with np.errstate(invalid="ignore"):
        bounded = np.nan_to_num(covariance * np.outer(scale, scale), nan=0.0, posinf=0.0, neginf=0.0)
    np.fill_diagonal(bounded, np.minimum(variances, most**2))
    R = np.zeros((6, 6))
    R[:3, :3] = R[3:, 3:] = R_map_frame
    wanted = np.ix_([0, 1, 5], [0, 1, 5])
    result: Float64Array = (R @ bounded @ R.T)[wanted]
    unit = result / np.sqrt(np.outer(np.diag(result), np.diag(result)).clip(1e-300))
    if np.linalg.eigvalsh(unit)[0] < -1e-3:
        raise PoseError("its covariance is none: correlations exceed 1")
    floor = np.array([LEAST_STD_M, LEAST_STD_M, LEAST_STD_RAD]) ** 2
    result[np.diag_indices(3)] = np.maximum(np.diag(result), floor)
    return result


def _forgetting(covariance: Float64Array, has_position: bool, has_heading: bool) -> Float64Array:
    """Return a covariance (3, 3) of easting, northing, heading that is infinite in what is not known."""
    result = covariance.copy()
    for known, part in ((has_position, slice(0, 2)), (has_heading, slice(2, 3))):
        if not known:
            result[part, :] = result[:, part] = 0.0
            result[part, part] = np.diag(np.full(result[part, part].shape[0], math.inf))
    return result
