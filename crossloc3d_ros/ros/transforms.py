"""Poses of sensors from TF, where tf2_ros is installed: a ROS distribution has it, the package index has not."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.time import Time

from crossloc3d_ros.errors import CloudError, ConfigError
from crossloc3d_ros.ros.conversions import matrix_from_transform
from crossloc3d_ros.types import Float64Array


class TransformSource:
    """Look up poses on the robot."""

    def __init__(self, node: Node, base_frame_id: str) -> None:
        """Begin to listen to /tf and /tf_static; raises ConfigError where tf2_ros is not installed."""
        try:
            import tf2_ros
        except ImportError as error:
            raise ConfigError(
                "mounting_from_tf needs tf2_ros, which is not installed: install ros-jazzy-tf2-ros-py, "
                "or set mounting_from_tf to false and give the mounting as scan.mounting.*"
            ) from error
        self._base_frame_id = base_frame_id
        self._failures: type[Exception] = tf2_ros.TransformException
        self._buffer: Any = tf2_ros.Buffer()
        self._listener: Any = tf2_ros.TransformListener(self._buffer, node, spin_thread=False)

    def pose_on_base(self, frame_id: str) -> Float64Array:
        """Return `T_base_frame` (4, 4), the latest known; raises CloudError naming the frames where there is none."""
        try:
            # The latest one, not the scan's: a mounting is static, and a scan must not wait for TF.
            found = self._buffer.lookup_transform(self._base_frame_id, frame_id, Time())
        except self._failures as failure:
            raise CloudError(f"TF knows no pose of '{frame_id}' on '{self._base_frame_id}': {failure}") from failure
        return matrix_from_transform(found.transform)

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()
