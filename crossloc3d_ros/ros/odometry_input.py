"""Odometry between the subscription that hears it and the worker that asks how the robot has moved."""

from __future__ import annotations

import bisect
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation, Slerp

from crossloc3d_ros.errors import CrossLocError, PoseError
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.localization.fusion.odometry import Motion, OdometryBuffer
from crossloc3d_ros.ros.poses import stamp_of
from crossloc3d_ros.types import Float64Array

SILENCE_S = 1.0
"""A source that has been silent for so long is not waited for, and is told of."""
_KEPT = 2000
"""Whole poses kept: ten seconds at 200 Hz, far more than a scan takes."""


@dataclass(frozen=True)
class OdometryState:
    """How odometry fares at one moment."""

    messages: int
    silent_s: float
    """Since the last message, or since the start."""
    complaint: str
    """Why the last message could not be used, or empty."""


class OdometryInput:
    """Take in messages in one thread, answer in another; a scan may come before the odometry of its stamp."""

    def __init__(
        self,
        buffer: OdometryBuffer,
        base_frame_id: str,
        wait_s: float,
        pose_on_base: Callable[[str], Float64Array] | None = None,
    ) -> None:
        """Fill `buffer`; `pose_on_base(frame)` gives `T_base_frame` where TF is at hand."""
        self._buffer = buffer
        self._base_frame_id = base_frame_id
        self._wait_s = wait_s
        self._pose_on_base = pose_on_base
        self._heard = threading.Condition()
        self._messages = 0
        self._poses: deque[tuple[int, Float64Array]] = deque(maxlen=_KEPT)
        self._heard_at = time.monotonic()
        self._complaint = ""
        self.frame_id = ""
        """Of the odometry, as its last message names it."""

    def take(self, message: Odometry) -> None:
        """Take in a message; PoseError where it cannot be used."""
        try:
            T_odom_base = self._base_pose(message)
        except CrossLocError as error:
            with self._heard:
                self._complaint = str(error)
            raise
        stamp_ns = stamp_of(message)
        with self._heard:
            if self._buffer.add(stamp_ns, T_odom_base):
                if self._poses and stamp_ns <= self._poses[-1][0]:
                    self._poses.clear()  # a recording that begins again
                self._poses.append((stamp_ns, T_odom_base))
            self.frame_id = message.header.frame_id
            self._messages += 1
            self._heard_at = time.monotonic()
            self._complaint = ""
            self._heard.notify_all()

    def motion(self, from_ns: int, to_ns: int) -> Motion:
        """Return how the robot moved between two stamps, after waiting a little for what is still on its way."""
        deadline = time.monotonic() + self._wait_s
        with self._heard:
            while (self._buffer.newest_ns or 0) < to_ns and time.monotonic() - self._heard_at < SILENCE_S:
                remaining_s = deadline - time.monotonic()
                if remaining_s <= 0.0 or not self._heard.wait(remaining_s):
                    break
            return self._buffer.motion(from_ns, to_ns)

    def pose_at(self, stamp_ns: int) -> Float64Array | None:
        """Return `T_odom_base` (4, 4) at a stamp between two samples, None where odometry does not tell it."""
        with self._heard:
            poses = list(self._poses)
        after = bisect.bisect_left(poses, stamp_ns, key=lambda pose: pose[0])
        if after == len(poses):
            return None
        (end_ns, T_end) = poses[after]
        if end_ns == stamp_ns:
            return T_end
        if after == 0:
            return None
        (begin_ns, T_begin) = poses[after - 1]
        if not self._buffer.motion(begin_ns, end_ns).is_known:
            return None
        share = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        T = np.eye(4)
        T[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix([T_begin[:3, :3], T_end[:3, :3]]))(share).as_matrix()
        T[:3, 3] = T_begin[:3, 3] + share * (T_end[:3, 3] - T_begin[:3, 3])
        return T

    def state(self) -> OdometryState:
        """Return how it fares."""
        with self._heard:
            return OdometryState(self._messages, time.monotonic() - self._heard_at, self._complaint)

    def _base_pose(self, message: Odometry) -> Float64Array:
        T_odom_child = pose_matrix(message.pose.pose)
        child = message.child_frame_id
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
    return f"nobody publishes odometry on {topic}: remap odom, or set odometry to scan or none"
