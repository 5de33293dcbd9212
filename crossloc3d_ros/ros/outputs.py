"""What the node publishes of an estimate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import NavSatFix, PointCloud2
from visualization_msgs.msg import MarkerArray

from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.ros.conversions import (
    candidate_table_message,
    candidates_message,
    fix_message,
    hypotheses_message,
    markers_message,
    origin_message,
    pose_message,
    stale_message,
    state_message,
)
from crossloc3d_ros.ros.subscriptions import REPEAT_REASON_S
from crossloc3d_ros.ros.transforms import MapTransform
from crossloc3d_ros.types import Estimate, FixStatus, Float64Array, TrackState

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

_ON_DEMAND: dict[str, Callable[[Estimate, MapFrame, str], Any]] = {
    "hypotheses": hypotheses_message,
    "candidates": candidates_message,
    "candidate_table": candidate_table_message,
    "markers": markers_message,
}
"""Made only where somebody subscribes."""


class Outputs:
    """The publishers of one configured node; they are set up once and not changed afterwards."""

    def __init__(
        self,
        node: LifecycleNode,
        config: LocalizerNodeConfig,
        frame: MapFrame,
        status_name: str,
        transform: MapTransform | None,
    ) -> None:
        """Announce the topics and publish the map's origin; `transform` where TF is to be published too."""
        self._node, self._config, self._frame, self._status_name = node, config, frame, status_name
        self._transform = transform
        self._odometry: tuple[str, Float64Array | None] = "", None
        """The odometry's frame, and its pose in the map."""
        self._publishers: dict[str, Any] = {
            "fix": node.create_lifecycle_publisher(NavSatFix, "~/fix", 10),
            "pose": node.create_lifecycle_publisher(PoseWithCovarianceStamped, "~/pose", LATCHED),
            "candidates": node.create_lifecycle_publisher(PoseArray, "~/candidates", 10),
            "candidate_table": node.create_lifecycle_publisher(PointCloud2, "~/candidate_table", 10),
            "hypotheses": node.create_lifecycle_publisher(PoseArray, "~/hypotheses", 10),
            "state": node.create_lifecycle_publisher(DiagnosticStatus, "~/state", LATCHED),
            "markers": node.create_lifecycle_publisher(MarkerArray, "~/markers", 1),
        }
        # Not managed: who joins while the node is inactive shall receive the origin too.
        self._origin_publisher = node.create_publisher(NavSatFix, "~/map_origin", LATCHED)
        self.origin = origin_message(frame, node.get_clock().now().nanoseconds, config.global_frame_id)
        """Where the frame `map` lies, as published."""
        self._origin_publisher.publish(self.origin)

    def publish(self, estimate: Estimate, T_odom_base: Float64Array | None, odom_frame_id: str) -> None:
        """Publish an estimate; `T_odom_base` (4, 4) is the odometry's pose at its stamp, None where it is not known."""
        config, publishers = self._config, self._publishers
        if estimate.status is FixStatus.FIX:  # first: whoever has seen the fix may give a pose relative to it
            self._place_odometry(estimate, T_odom_base, odom_frame_id)
        publishers["fix"].publish(fix_message(estimate, config.base_frame_id))
        publishers["state"].publish(state_message(estimate, self._status_name))
        if estimate.status is FixStatus.FIX:
            publishers["pose"].publish(pose_message(estimate, config.global_frame_id))
        for name, make in _ON_DEMAND.items():
            if publishers[name].get_subscription_count() > 0:
                publishers[name].publish(make(estimate, self._frame, config.global_frame_id))

    def publish_stale(self, state: TrackState, reason: str) -> None:
        """Report on the latched topic that the last state is no longer current, and why."""
        self._publishers["state"].publish(stale_message(state, reason, self._status_name))

    def close(self) -> None:
        """Withdraw all topics."""
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._node.destroy_publisher(self._origin_publisher)

    def pose_of_odom(self, frame_id: str) -> Float64Array | None:
        """Return `T_map_odom` (4, 4) by the last fix; None for another frame than the odometry's, and before a fix."""
        known, T_map_odom = self._odometry  # one assignment in the worker's thread: both are of one scan
        return T_map_odom if frame_id == known else None

    def forget_odometry(self) -> None:
        """Forget where the odometry's frame lies in the map."""
        self._odometry = "", None

    def _place_odometry(self, estimate: Estimate, T_odom_base: Float64Array | None, odom_frame_id: str) -> None:
        """Note where the odometry's frame lies in the map while localized, and publish it (REP-105)."""
        if estimate.state is not TrackState.LOCALIZED:
            return
        if odom_frame_id in ("", self._config.global_frame_id):
            if self._transform is None:
                return
            self._node.get_logger().warning(
                f"no transform is published: the odometry names '{odom_frame_id}' as its frame, which must be one of "
                "its own (REP-105)",
                throttle_duration_sec=REPEAT_REASON_S,
            )
            return
        if T_odom_base is None or not np.isfinite(estimate.T_map_base).all():
            return
        T_map_odom = estimate.T_map_base @ np.linalg.inv(T_odom_base)
        self._odometry = odom_frame_id, T_map_odom
        if self._transform is not None:
            self._transform.send(estimate.stamp_ns, T_map_odom, odom_frame_id)
