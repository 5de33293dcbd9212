"""The topic imu: which way is up, and a first guess of the heading."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu

from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.errors import CrossLocError, PoseError
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.gravity import is_gravity
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.ros.poses import frame_of, heading_prior, stamp_of
from crossloc3d_ros.ros.subscriptions import REPEAT_REASON_S, subscribe
from crossloc3d_ros.types import Float64Array

SILENCE_S = 1.0
_HEADING_PERIOD_NS = 50_000_000
"""A heading is taken no more often: it is a guess of the order of ten degrees, and each costs a projection."""


class ImuInput:
    """Receive messages in the executor's thread; hand accelerations and headings, in the axes of the base, over."""

    def __init__(
        self,
        config: LocalizerNodeConfig,
        frame: MapFrame,
        on_acceleration: Callable[[int, Float64Array], None],
        on_heading: Callable[[PosePrior], None],
        pose_on_base: Callable[[str], Float64Array] | None = None,
    ) -> None:
        """Call `on_acceleration(stamp_ns, acceleration)` (m/s2, base frame) and `on_heading` where they are used.

        `pose_on_base(frame)` gives `T_base_frame` (4, 4) where TF is used; else the IMU's axes are the base's.
        """
        self._config = config
        self._frame = frame
        self._on_acceleration = on_acceleration
        self._on_heading = on_heading
        self._pose_on_base = pose_on_base
        self._heading_ns = 0
        self._acceleration: Float64Array | None = None
        self._heard_at = 0.0
        self._log: Callable[[str], None] = lambda text: None
        self._warned_s: dict[str, float] = {}

    def subscribe(self, node: Node) -> list[object]:
        """Subscribe to imu where the configuration uses it; return the subscriptions."""

        self._log = node.get_logger().warning
        used = self._config.use_imu or self._config.use_imu_heading
        return [subscribe(node, Imu, "imu", self.take, qos_profile_sensor_data)] if used else []

    def take(self, message: Imu) -> None:
        """Take in a message; what cannot be used is logged with the reason."""
        try:
            R_base_imu = np.eye(3)
            if self._pose_on_base is not None:
                R_base_imu = self._pose_on_base(frame_of(message.header.frame_id))[:3, :3]
            self._take_acceleration(message, R_base_imu)
            self._take_heading(message, R_base_imu)
        except CrossLocError as error:
            self._warn(type(error).__name__, str(error))

    def _warn(self, kind: str, text: str) -> None:
        """Log a warning, each kind no more often than every `REPEAT_REASON_S`."""
        now_s = time.monotonic()
        if now_s - self._warned_s.get(kind, -REPEAT_REASON_S) >= REPEAT_REASON_S:
            self._warned_s[kind] = now_s
            self._log(f"IMU: {text}")

    def state(self) -> str:
        """Return the last acceleration that could be gravity as a text."""
        if self._acceleration is None or time.monotonic() - self._heard_at > SILENCE_S:
            return "no recent sample"
        return f"acceleration {np.round(self._acceleration, 2).tolist()} m/s2 in base"

    def _take_acceleration(self, message: Imu, R_base_imu: Float64Array) -> None:
        force = message.linear_acceleration
        acceleration = R_base_imu @ np.array([force.x, force.y, force.z])
        text = f"acceleration {np.round(acceleration, 2).tolist()} m/s2"
        if not is_gravity(acceleration):
            raise PoseError(f"{text} is no gravity; sample left out")
        if acceleration[2] < 0.0:
            self._warn(
                "down", f"{text} points down: at rest it must be +9.8 upwards, in the axes of the base (REP-145)"
            )
        self._acceleration, self._heard_at = acceleration, time.monotonic()
        if self._config.use_imu:
            self._on_acceleration(stamp_of(message), acceleration)

    def _take_heading(self, message: Imu, R_base_imu: Float64Array) -> None:
        stamp_ns = stamp_of(message)
        if not self._config.use_imu_heading or 0 <= stamp_ns - self._heading_ns < _HEADING_PERIOD_NS:
            return
        self._heading_ns = stamp_ns
        std_rad, offset_rad = np.radians([self._config.imu_heading_std_deg, self._config.imu_heading_offset_deg])
        prior = heading_prior(message, R_base_imu, self._frame, float(std_rad), float(offset_rad))
        if prior is None:
            raise PoseError("its messages have no orientation")
        self._on_heading(prior)
