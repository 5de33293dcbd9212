"""Rigid motions of clouds and the checks that every public function of this room makes on its points."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.config import MountingConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import Float64Array


def check_points(points: npt.NDArray[np.floating], name: str = "points") -> None:
    """Raise CloudError unless `points` is an (N, 3) array of floating-point numbers."""
    if not isinstance(points, np.ndarray) or points.ndim != 2 or points.shape[1] != 3:
        raise CloudError(f"{name} must have the shape (N, 3), got {np.shape(points)}")
    if points.dtype not in (np.float32, np.float64):
        raise CloudError(f"{name} must be float32 or float64, got {points.dtype}")


def check_pose(T: npt.NDArray[np.floating], name: str = "T") -> None:
    """Raise CloudError unless `T` is a finite rigid motion, shape (4, 4)."""
    if np.shape(T) != (4, 4):
        raise CloudError(f"{name} must have the shape (4, 4), got {np.shape(T)}")
    R = T[:3, :3]
    rigid = np.isfinite(T).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0
    if not rigid or not np.allclose(T[3], (0, 0, 0, 1)):
        raise CloudError(f"{name} is not a rigid motion: {np.array2string(np.asarray(T), precision=4)}")


def transform_points(T: Float64Array, points: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return points (N, 3) moved by the rigid motion T (4, 4); keeps the points' dtype, metres.

    The sum is formed in float64, so that a large translation does not cost millimetres.
    """
    check_points(points)
    check_pose(T)
    moved = points.astype(np.float64, copy=False) @ T[:3, :3].T + T[:3, 3]
    return moved.astype(points.dtype, copy=False)


def mounting_matrix(mounting: MountingConfig) -> Float64Array:
    """Return `T_base_lidar` (4, 4): R = Rz(yaw) Ry(pitch) Rx(roll), translation in metres."""
    roll, pitch, yaw = (math.radians(a) for a in (mounting.roll_deg, mounting.pitch_deg, mounting.yaw_deg))
    cr, sr, cp, sp, cy, sy = (
        math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw),
    )  # fmt: skip
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, mounting.x_m],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, mounting.y_m],
            [-sp, cp * sr, cp * cr, mounting.z_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def levelling_matrix(up_base: npt.NDArray[np.floating]) -> Float64Array:
    """Return the smallest rotation (4, 4) that takes the measured "up" (3,) of the base frame to +z.

    The length of `up_base` does not matter: an accelerometer at rest measures about 9.8 m/s^2 upwards. Raises
    CloudError where it is not finite, or zero, or where the base would stand on its side.
    """
    up = np.asarray(up_base, dtype=np.float64)
    if up.shape != (3,):
        raise CloudError(f"gravity must have the shape (3,), got {up.shape}")
    length = float(np.linalg.norm(up))
    if not np.isfinite(length) or length < 1e-6:
        raise CloudError(f"gravity must be a finite vector with a length, got {up.tolist()}")
    x, y, z = up / length
    if z < 0.2:
        raise CloudError(
            f"by the measured gravity the robot lies on its side: up is {np.round(up / length, 3).tolist()}"
        )
    # Rodrigues about the axis up x z, written out: no case distinction at zero tilt.
    k = 1.0 / (1.0 + z)
    T = np.eye(4)
    T[:3, :3] = [[1.0 - k * x * x, -k * x * y, -x], [-k * x * y, 1.0 - k * y * y, -y], [x, y, z]]
    return T
