"""From the poses of messages to matrices; for messages of rclpy and of recordings alike."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.types import Float64Array

_log = logging.getLogger(__name__)

_NO_POSE_AFTER_M = 1.0
"""A robot that has driven so far by its twists, and stands still by its poses, has none."""
_MOST_GAP_S = 1.0
"""Over longer than this a velocity says nothing of the way."""


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


class OdometryPoses:
    """The poses of one topic of odometry: those of its messages, or its twists integrated where no pose is filled in.

    Drivers of wheels give a twist, and leave the pose at zero for a filter to fill.
    """

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._first: Float64Array | None = None
        self._has_pose = False
        self._integrated: Float64Array | None = None
        self._newest_ns: int | None = None
        self._driven_m = 0.0

    def pose(self, message: Any, stamp_ns: int) -> Float64Array:
        """Return `T_odom_base` (4, 4) of a nav_msgs/Odometry; PoseError where it gives none.

        The twist is that of the base in its own axes (REP-105).
        """
        T = np.eye(4) if _is_empty(message.pose.pose) else pose_matrix(message.pose.pose)
        if self._has_pose:
            return T
        if self._first is None:
            self._first = T
        if not np.allclose(T, self._first, atol=1e-9):
            self._has_pose = self._integrated is None
            if self._has_pose:
                return T
        step = self._step(message.twist.twist, stamp_ns)
        self._driven_m += float(np.linalg.norm(step[:3, 3]))
        if self._integrated is None and self._driven_m > _NO_POSE_AFTER_M:
            _log.warning("'%s' gives twists and no pose: the twists are integrated", self._topic)
            self._integrated = self._first
        if self._integrated is None:
            return T
        self._integrated = self._integrated @ step
        return self._integrated

    def _step(self, twist: Any, stamp_ns: int) -> Float64Array:
        """Return the motion (4, 4) since the last message, at the velocity of this one."""
        seconds = 0.0 if self._newest_ns is None else (stamp_ns - self._newest_ns) / 1e9
        self._newest_ns = max(stamp_ns, self._newest_ns or stamp_ns)
        step = np.eye(4)
        velocity = np.array([twist.linear.x, twist.linear.y, twist.linear.z], dtype=np.float64)
        turn = np.array([twist.angular.x, twist.angular.y, twist.angular.z], dtype=np.float64)
        if 0.0 < seconds <= _MOST_GAP_S and np.isfinite([velocity, turn]).all():
            half = Rotation.from_rotvec(turn * seconds / 2.0)
            step[:3, :3] = (half * half).as_matrix()
            step[:3, 3] = half.apply(velocity * seconds)
        return step


def _is_empty(pose: Any) -> bool:
    """Return whether nobody filled a pose in: even its orientation is zero."""
    position, orientation = pose.position, pose.orientation
    return not any((position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w))
