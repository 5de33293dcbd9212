"""A recording straight through the localizer, in this process: every scan becomes a row of the estimates' CSV."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from crossloc3d_ros.clouds.frames import CloudFrames
from crossloc3d_ros.errors import BagError, CloudError, PoseError
from crossloc3d_ros.evaluation.drives.estimates import EstimateWriter
from crossloc3d_ros.formats.bag import IMU, ODOMETRY, POINT_CLOUD, BagReader, stamp_ns_of
from crossloc3d_ros.formats.odometry import OdometryPoses
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.localization.session import OdometryKind, Outcome, PreparedInput, ScanLocalizer, Session
from crossloc3d_ros.types import Estimate

log = logging.getLogger(__name__)

Progress = Callable[[int, int, Estimate], None]
"""Scans done, scans to do, the newest estimate."""


@dataclass(frozen=True)
class OdometrySource:
    """What measures the motion between two scans: a topic, or the scans themselves."""

    topic: str | None = None
    """nav_msgs/Odometry; None: from scan to scan, by KISS-ICP."""
    base_frame_id: str = "base_link"
    """Odometry of another frame is used with a warning: no TF is at hand that would relate the two."""


@dataclass(frozen=True)
class Ended:
    """How the localizing of a recording ended."""

    broken: BagError | None = None
    """What was read before the damage is evaluated."""
    interrupted: bool = False

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for readers of the results."""
        if self.broken is not None:
            return (f"The recording is damaged; only the part before the damage is shown. {self.broken}",)
        return ("The run was interrupted; only the scans before that are shown.",) if self.interrupted else ()


HELD_NS = 500_000_000
"""A scan waits so long in the recording for the odometry of its stamp."""


def localize_bag(
    bag: BagReader,
    topic: str,
    localizer: ScanLocalizer,
    output: Path,
    *,
    every: int = 1,
    imu_topic: str | None = None,
    imu_time_constant_s: float = 1.0,
    odometry: OdometrySource | None = None,
    base_frame_id: str = "base_link",
    progress: Progress | None = None,
) -> int:
    """Localize every `every`-th scan of a bag, write the estimates to the CSV file `output` and return their number.

    `imu_topic` levels the scans by accelerations in the axes of the base; `odometry` names what measures the motion
    between them; None = nothing does. Clouds of `base_frame_id` are in the base's frame already. A cloud that
    cannot be used becomes a row without a fix, with the reason; a bag that breaks off raises BagError when the rows
    before the break are written.
    """
    total = math.ceil(bag.topic(topic, POINT_CLOUD).count / every)
    kind: OdometryKind = "none" if odometry is None else "scan" if odometry.topic is None else "topic"
    frames = CloudFrames(localizer.config.scan.mounting, base_frame_id)
    feed = _Feed(Session(localizer, kind, imu_time_constant_s), odometry, frames)
    odometry_topic = None if odometry is None else odometry.topic
    done = 0
    with EstimateWriter(output) as writer:
        for outcome in _outcomes(bag, topic, every, imu_topic, odometry_topic, feed):
            writer.write(outcome.estimate)
            done += 1
            if progress is not None:
                progress(done, max(total, done), outcome.estimate)
    if done == 0:
        raise BagError(f"topic '{topic}' of {bag.path} holds no message")
    return done


class _Waiting(NamedTuple):
    """A cloud of the recording that waits for the odometry of its stamp."""

    stamp_ns: int
    recorded_ns: int
    scan: PreparedInput | CloudError
    """The error is why the cloud cannot be used."""


class _Feed:
    """Feed a session with the messages of a recording, in the order in which they were recorded."""

    def __init__(self, session: Session, odometry: OdometrySource | None, frames: CloudFrames) -> None:
        self._session = session
        self._frames = frames
        self._poses = OdometryPoses((odometry.topic if odometry else None) or "odometry")
        self._source = odometry
        self._warned = False
        self._within_turn = ""

    @property
    def registers_scans(self) -> bool:
        return self._session.registers_scans

    def take_imu(self, message: Any, recorded_ns: int) -> None:
        force = message.linear_acceleration
        self._session.add_acceleration(stamp_ns_of(message, recorded_ns), np.array([force.x, force.y, force.z]))

    def take_odometry(self, message: Any, recorded_ns: int) -> None:
        """Take in a message of the odometry's topic; what is no pose is left out."""
        assert self._source is not None
        child, base = message.child_frame_id, self._source.base_frame_id
        if not self._warned and child not in ("", base):
            log.warning("'%s' gives the pose of '%s'; it is taken for '%s'", self._source.topic, child, base)
            self._warned = True
        try:
            stamp_ns = stamp_ns_of(message, recorded_ns)
            self._session.add_odometry(stamp_ns, self._poses.pose(message, stamp_ns))
        except PoseError as error:
            log.debug("odometry left out: %s", error)

    def take_cloud(self, message: Any, recorded_ns: int) -> _Waiting:
        stamp_ns = stamp_ns_of(message, recorded_ns)
        try:
            scan = self._frames(replace(scan_from_pointcloud2(message), stamp_ns=stamp_ns))
            return _Waiting(stamp_ns, recorded_ns, self._session.receive(scan))
        except CloudError as error:
            return _Waiting(stamp_ns, recorded_ns, error)

    def is_ready(self, waiting: _Waiting, now_ns: int) -> bool:
        """Return whether all odometry that a scan needs has been read, or as much as will come."""
        return now_ns - waiting.recorded_ns > HELD_NS or self._session.has_odometry_until(waiting.stamp_ns)

    def localize(self, waiting: _Waiting) -> Outcome:
        if isinstance(waiting.scan, CloudError):
            return self._session.fault(waiting.stamp_ns, str(waiting.scan))
        outcome = self._session.localize(waiting.scan)
        compensated = outcome.within_turn.partition(":")[0]
        if compensated and compensated != self._within_turn:
            self._within_turn = compensated
            log.info("motion within a turn is %s", outcome.within_turn)
        return outcome


def _outcomes(
    bag: BagReader, topic: str, every: int, imu_topic: str | None, odometry_topic: str | None, feed: _Feed
) -> Iterator[Outcome]:
    """Yield the outcomes of every `every`-th scan of a bag in their order."""
    imu = None if imu_topic is None else bag.topic(imu_topic, IMU).name
    odometry = None if odometry_topic is None else bag.topic(odometry_topic, ODOMETRY).name
    waiting: deque[_Waiting] = deque()
    seen = 0
    topics = [name for name in (topic, imu, odometry) if name is not None]
    try:
        for name, recorded_ns, message in bag.messages(topics):
            if name == imu:
                feed.take_imu(message, recorded_ns)
            elif name == odometry:
                feed.take_odometry(message, recorded_ns)
            else:
                is_used = seen % every == 0
                if is_used or feed.registers_scans:
                    cloud = feed.take_cloud(message, recorded_ns)
                    if is_used:
                        waiting.append(cloud)
                seen += 1
            while waiting and feed.is_ready(waiting[0], recorded_ns):
                yield feed.localize(waiting.popleft())
    except BagError:
        yield from map(feed.localize, waiting)  # what was read before the damage is whole
        raise
    yield from map(feed.localize, waiting)
