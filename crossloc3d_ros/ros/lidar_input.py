"""The topic points: clouds from the subscription to the thread that localizes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import qos_policy_name_from_kind, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.ros.diagnostics import Statistics
from crossloc3d_ros.ros.poses import frame_of
from crossloc3d_ros.ros.subscriptions import subscribe
from crossloc3d_ros.types import Float64Array


@dataclass(frozen=True, eq=False)
class Arrival:
    """A cloud, when it arrived, and the mounting of its lidar by then."""

    message: PointCloud2
    received_s: float
    """Monotonic clock."""
    T_base_lidar: Float64Array | None
    """(4, 4) from TF; None where the configuration's mounting holds."""
    fault: str
    """Why the cloud cannot be used already; or empty."""


class LidarInput:
    """Receive clouds in the executor's thread; hand them over, and count what happens to them on the way."""

    def __init__(
        self,
        offer: Callable[[Arrival], int],
        statistics: Statistics,
        pose_on_base: Callable[[str], Float64Array] | None = None,
    ) -> None:
        """Call `offer` with each arrival; it returns how many waiting scans were dropped for it.

        `pose_on_base(frame)` gives `T_base_frame` (4, 4) where the mounting comes from TF.
        """
        self._offer = offer
        self._statistics = statistics
        self._pose_on_base = pose_on_base
        self.complaint = ""
        """What the middleware found wrong with the publishers; or empty."""

    def subscribe(self, node: Node) -> list[object]:
        """Subscribe to points; return the subscription."""
        topic = node.resolve_topic_name("points")
        self.complaint = ""

        def on_incompatible_qos(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            self.complaint = (
                f"a publisher on {topic} offers an incompatible {policy}, so its clouds never arrive: "
                f"set qos_overrides.{topic}.subscription.*"
            )
            node.get_logger().error(self.complaint)

        def on_message_lost(event: Any) -> None:
            self._statistics.lost(int(event.total_count))

        events = SubscriptionEventCallbacks(incompatible_qos=on_incompatible_qos, message_lost=on_message_lost)
        return [subscribe(node, PointCloud2, "points", self.take, qos_profile_sensor_data, events)]

    def take(self, message: PointCloud2) -> None:
        """Take in a cloud."""
        self._statistics.received()
        T_base_lidar, fault = None, ""
        if self._pose_on_base is not None:
            try:
                T_base_lidar = self._pose_on_base(frame_of(message.header.frame_id))
            except CrossLocError as error:
                fault = str(error)
        self._statistics.dropped(self._offer(Arrival(message, time.monotonic(), T_base_lidar, fault)))
