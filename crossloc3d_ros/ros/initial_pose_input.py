"""The topic initialpose: a pose given by an operator, in the map, on the earth, or in a frame that TF relates to it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.errors import ConfigError, PoseError
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.ros.poses import EARTH_FRAME_ID, frame_of, initial_pose, stamp_of
from crossloc3d_ros.ros.subscriptions import subscribe
from crossloc3d_ros.ros.transforms import TransformSource
from crossloc3d_ros.types import Float64Array

QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
TF_TIMEOUT_S = 3.0
"""How long TF may take to relate a frame to the map: a listener that has just started has no transforms yet."""
TF_PERIOD_S = 0.1


class InitialPoseInput:
    """Receive initial poses in the executor's thread; hand the priors that they mean over."""

    def __init__(
        self,
        node: Node,
        aerial_map: AerialMap,
        global_frame_id: str,
        base_frame_id: str,
        on_prior: Callable[[PosePrior], None],
        why_unused: Callable[[], str] = lambda: "",
        pose_of_odom: Callable[[str], Float64Array | None] = lambda frame_id: None,
    ) -> None:
        """Call `on_prior` with each initial pose that can be used; the others are logged as errors, with the reason.

        `why_unused` returns why none can be used at present, or an empty text. `pose_of_odom(frame_id)` returns
        `T_map_odom` (4, 4) as this node knows it; None for another frame, and before the first fix.
        """
        self._node = node
        self._map = aerial_map
        self._global_frame_id = global_frame_id
        self._base_frame_id = base_frame_id
        self._on_prior = on_prior
        self._why_unused = why_unused
        self._pose_of_odom = pose_of_odom
        # Its own, and only once a pose needs it: the mounting of the lidar has nothing to do with it.
        self._transforms: TransformSource | None = None
        self._timer: Any = None
        self.result = ""
        """What became of the last one: taken or refused, and why; empty where none has come."""

    def subscribe(self) -> list[object]:
        """Subscribe to initialpose; return the subscription."""
        return [subscribe(self._node, PoseWithCovarianceStamped, "initialpose", self.take, QOS)]

    def reset(self) -> None:
        """Forget the last one, and stop waiting for TF."""
        self._stop_waiting()
        self.result = ""

    def close(self) -> None:
        """Stop waiting for TF, and listening to it."""
        self._stop_waiting()
        if self._transforms is not None:
            self._transforms.close()
        self._transforms = None

    def take(self, message: PoseWithCovarianceStamped) -> None:
        """Take in an initial pose; a newer one replaces one that still waits for TF."""
        self._stop_waiting()
        frame_id, unused = frame_of(message.header.frame_id), self._why_unused()
        T_map_odom = self._pose_of_odom(frame_id)
        if unused:
            self._refuse(unused)
        elif frame_id == self._global_frame_id:
            self._accept(message, np.eye(4))
        elif frame_id == EARTH_FRAME_ID:
            self._accept(message, np.asarray(np.linalg.inv(self._map.frame.pose_on_earth)))
        elif not frame_id:
            self._refuse("it names no frame")
        elif T_map_odom is not None:
            self._accept(message, T_map_odom)
        else:
            self._look_up(message, frame_id)

    def _look_up(self, message: PoseWithCovarianceStamped, frame_id: str) -> None:
        try:
            source = self._transforms = self._transforms or TransformSource(self._node, self._base_frame_id)
        except ConfigError:
            self._refuse(
                f"it is given in '{frame_id}': without tf2_ros only '{self._global_frame_id}', '{EARTH_FRAME_ID}' and, "
                "after a fix, the frame of the odometry can be used"
            )
            return
        deadline = time.monotonic() + TF_TIMEOUT_S

        def attempt() -> None:
            try:
                T_map_frame = source.pose_in(self._global_frame_id, frame_id)
            except PoseError as error:
                if time.monotonic() > deadline:
                    self._stop_waiting()
                    self._refuse(str(error))
                return
            self._stop_waiting()
            self._accept(message, T_map_frame)

        self._timer = self._node.create_timer(TF_PERIOD_S, attempt, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._timer = None

    def _accept(self, message: PoseWithCovarianceStamped, T_map_frame: Float64Array) -> None:
        try:
            prior = initial_pose(message.pose, stamp_of(message), T_map_frame, self._map.frame, self._map.bounds)
        except PoseError as error:
            self._refuse(str(error))
            return
        self._on_prior(prior)
        self.result = f"taken: {_described(prior)}"
        self._node.get_logger().info(f"initial pose {self.result}")

    def _refuse(self, reason: str) -> None:
        self.result = f"refused: {reason}"
        self._node.get_logger().error(f"initial pose {self.result}")


def _described(prior: PosePrior) -> str:
    parts = []
    if prior.grid is not None:
        std_m = float(np.sqrt(np.trace(prior.covariance[:2, :2]) / 2.0))
        parts.append(f"{prior.grid[0]:.1f} E, {prior.grid[1]:.1f} N, standard deviation {std_m:.1f} m")
    if prior.heading_rad is not None:
        std_deg = float(np.degrees(np.sqrt(prior.covariance[2, 2])))
        parts.append(f"heading {np.degrees(prior.heading_rad):.0f} degrees from east, standard deviation {std_deg:.0f}")
    return "; ".join(parts)
