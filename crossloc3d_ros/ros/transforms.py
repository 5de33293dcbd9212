"""TF, where tf2_ros is installed: a ROS distribution has it, the package index has not."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.time import Time

from crossloc3d_ros.errors import CloudError, ConfigError, PoseError
from crossloc3d_ros.ros.conversions import matrix_from_transform, transform_message
from crossloc3d_ros.types import Float64Array


class TransformSource:
    """Look up poses of frames."""

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
            return self._latest(self._base_frame_id, frame_id)
        except self._failures as failure:
            raise CloudError(f"TF has no pose of '{frame_id}' on '{self._base_frame_id}': {failure}") from failure

    def pose_in(self, global_frame_id: str, frame_id: str) -> Float64Array:
        """Return `T_global_frame` (4, 4), the latest known; raises PoseError naming the frames where there is none."""
        try:
            return self._latest(global_frame_id, frame_id)
        except self._failures as failure:
            raise PoseError(f"TF has no pose of '{frame_id}' in '{global_frame_id}': {failure}") from failure

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()

    def _latest(self, target: str, source: str) -> Float64Array:
        return matrix_from_transform(self._buffer.lookup_transform(target, source, Time()).transform)


class MapTransform:
    """Broadcast the odometry's frame in the map (REP-105)."""

    def __init__(self, node: Node, global_frame_id: str, tolerance_ns: int) -> None:
        """Announce /tf; raises ConfigError where tf2_ros is not installed."""
        try:
            import tf2_ros
        except ImportError as error:
            raise ConfigError(
                "tf_broadcast needs tf2_ros, which is not installed: install ros-jazzy-tf2-ros-py, "
                "or set tf_broadcast to false and take the pose from ~/pose"
            ) from error
        self._global_frame_id = global_frame_id
        self._tolerance_ns = tolerance_ns
        self._broadcaster: Any = tf2_ros.TransformBroadcaster(node)
        self._node = node

    def send(self, stamp_ns: int, T_map_odom: Float64Array, odom_frame_id: str) -> None:
        """Publish the pose (4, 4) estimated from a scan of that stamp.

        It is stamped a little ahead, because it holds until the next one comes and TF does not extrapolate.
        """
        message = transform_message(T_map_odom, stamp_ns + self._tolerance_ns, self._global_frame_id, odom_frame_id)
        self._broadcaster.sendTransform(message)

    def close(self) -> None:
        """Withdraw from /tf."""
        self._node.destroy_publisher(self._broadcaster.pub_tf)
