"""The topic odom: poses of the base from the subscription to the thread that localizes."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from crossloc3d_ros.errors import CrossLocError, PoseError
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.ros.poses import frame_of, stamp_of
from crossloc3d_ros.ros.subscriptions import REPEAT_REASON_S, subscribe
from crossloc3d_ros.types import Float64Array

SILENCE_S = 1.0
"""A source that has been silent for so long is not waited for, and is reported."""
_KEPT = 24_000
"""Samples that wait for a scan at most: two minutes at 200 Hz, as long as odometry is kept for scans."""
QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Receives from reliable publishers too; deep, because a second of 200 Hz may wait while this process has no time."""


class OdometrySample(NamedTuple):
    """One pose of the base."""

    stamp_ns: int
    T_odom_base: Float64Array
    """(4, 4)"""
    odom_frame_id: str


@dataclass(frozen=True)
class OdometryState:
    """What has been received until now."""

    messages: int
    """Those that could be used."""
    silent_s: float
    """Since the last of them, or since the start."""
    complaint: str
    """Why the last message could not be used, or empty."""


class OdometryInput:
    """Receive messages in the executor's thread; hand their poses over to the thread that localizes."""

    def __init__(
        self,
        base_frame_id: str,
        odom_frame_id: str,
        timeout_s: float,
        pose_on_base: Callable[[str], Float64Array] | None = None,
    ) -> None:
        """Take poses of `base_frame_id` in `odom_frame_id` (empty: whichever the messages name).

        A scan waits up to `timeout_s` for the odometry of its stamp. `pose_on_base(frame)` gives `T_base_frame` (4, 4)
        where TF is used.
        """
        self._base_frame_id = base_frame_id
        self._odom_frame_id = odom_frame_id
        self._timeout_s = timeout_s
        self._pose_on_base = pose_on_base
        self._arrived = threading.Condition()
        self._samples: deque[OdometrySample] = deque(maxlen=_KEPT)
        self._messages = 0
        self._heard_at = time.monotonic()
        self._complaint = ""

    def subscribe(self, node: Node) -> list[object]:
        """Subscribe to odom; return the subscription."""

        def receive(message: Odometry) -> None:
            try:
                self.take(message)
            except CrossLocError as error:
                node.get_logger().warning(f"odometry is not used: {error}", throttle_duration_sec=REPEAT_REASON_S)

        return [subscribe(node, Odometry, "odom", receive, QOS)]

    # In the executor's thread

    def take(self, message: Odometry) -> None:
        """Take in a message; PoseError where it cannot be used."""
        try:
            frame = frame_of(message.header.frame_id)
            sample = OdometrySample(stamp_of(message), self._base_pose(message, frame), frame)
        except CrossLocError as error:
            self._complaint = str(error)
            raise
        self._complaint = ""
        self._messages += 1
        self._heard_at = time.monotonic()
        with self._arrived:
            self._samples.append(sample)
            self._arrived.notify()

    def state(self) -> OdometryState:
        """Return what has been received until now."""
        return OdometryState(self._messages, time.monotonic() - self._heard_at, self._complaint)

    # In the thread that localizes

    def drain(self) -> list[OdometrySample]:
        """Return the samples that have arrived since the last call, in their order."""
        with self._arrived:
            samples = list(self._samples)
            self._samples.clear()
        return samples

    def wait(self, add: Callable[[OdometrySample], bool]) -> None:
        """Hand samples to `add` as they arrive until it returns True, the timeout ends or odometry is silent."""
        deadline = time.monotonic() + self._timeout_s
        while time.monotonic() - self._heard_at < SILENCE_S:
            with self._arrived:
                if not self._samples:
                    self._arrived.wait(max(deadline - time.monotonic(), 0.0))
                if not self._samples:
                    return
                sample = self._samples.popleft()
            if add(sample):
                return

    def _base_pose(self, message: Odometry, frame: str) -> Float64Array:
        child = frame_of(message.child_frame_id)
        if self._odom_frame_id not in ("", frame):
            raise PoseError(
                f"it is given in '{frame}', not in '{self._odom_frame_id}': set odom_frame_id to '{frame}', or to '' "
                "where any frame will do"
            )
        T_odom_child = pose_matrix(message.pose.pose)
        if child in ("", self._base_frame_id):
            return T_odom_child
        if self._pose_on_base is None:
            raise PoseError(
                f"it is the pose of '{child}', not of '{self._base_frame_id}': set base_frame_id to '{child}', or "
                "mounting_from_tf to true where TF relates the two"
            )
        return np.asarray(T_odom_child @ np.linalg.inv(self._pose_on_base(child)))


def odometry_complaint(state: OdometryState, topic: str, publishers: int) -> str:
    """Return what is wrong with the odometry, or an empty text."""
    if state.complaint:
        return f"odometry on {topic} is not used: {state.complaint}"
    if state.silent_s < SILENCE_S:
        return ""
    if state.messages:
        return f"odometry on {topic} has been silent for {state.silent_s:.0f} s"
    if publishers:
        return f"no odometry has come on {topic} ({publishers} publishers)"
    return f"no publisher of odometry on {topic}: remap odom, or set odometry to scan or none"
