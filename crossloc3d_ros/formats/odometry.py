"""From the poses of messages to matrices; for messages of rclpy and of recordings alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.types import Float64Array


def pose_matrix(pose: Any) -> Float64Array:
    """Return a geometry_msgs/Pose as (4, 4), metres; PoseError where it is not finite or its quaternion is no rotation.

    For nav_msgs/Odometry, `pose_matrix(message.pose.pose)` is `T_odom_base`.
    """
    position, orientation = pose.position, pose.orientation
    xyz = np.array([position.x, position.y, position.z], dtype=np.float64)
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w], dtype=np.float64)
    if not (np.isfinite(xyz).all() and np.isfinite(quaternion).all()):
        raise PoseError(f"the pose is not finite: position {xyz.tolist()}, orientation {quaternion.tolist()}")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > 0.1:  # drivers round, but an orientation of zeros was never filled in
        raise PoseError(f"the orientation {quaternion.tolist()} is no rotation: its length is {length:.3g}, not 1")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[:3, 3] = xyz
    return T
