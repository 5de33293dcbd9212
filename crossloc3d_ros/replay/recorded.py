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

from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.errors import BagError, CloudError, PoseError
from crossloc3d_ros.evaluation.drives.estimates import (
    EstimateWriter,
)
from crossloc3d_ros.formats.bag import IMU, ODOMETRY, POINT_CLOUD, BagReader, stamp_ns_of
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.localization.fusion.gravity import GravityFilter
from crossloc3d_ros.localization.fusion.odometry import Motion, OdometryBuffer, ScanOdometry
from crossloc3d_ros.localization.localizer import Localizer, no_estimate
from crossloc3d_ros.types import Estimate, Float64Array, Scan

log = logging.getLogger(__name__)


Progress = Callable[[int, int, Estimate], None]
"""Scans done, scans to do, the newest estimate."""


@dataclass(frozen=True)
class OdometrySource:
    """What tells how the robot moved between two scans: a topic, or the scans themselves."""

    topic: str | None = None
    """nav_msgs/Odometry; None: from scan to scan, by KISS-ICP."""
    base_frame_id: str = "base_link"
    """Odometry of another frame is used with a warning: no TF is at hand that would relate the two."""


HELD_NS = 500_000_000
"""A scan waits so long in the recording for the odometry of its stamp."""


def localize_bag(
    bag: BagReader,
    topic: str,
    localizer: Localizer,
    output: Path,
    *,
    every: int = 1,
    imu_topic: str | None = None,
    imu_time_constant_s: float = 1.0,
    odometry: OdometrySource | None = None,
    progress: Progress | None = None,
) -> int:
    """Localize every `every`-th scan of a bag, write the estimates to the CSV file `output` and return their number.

    `imu_topic` levels the scans by accelerations in the axes of the base; `odometry` tells how the robot moved between
    them, None that nothing does. A cloud that cannot be used becomes a row without a fix that says why; a bag that
    breaks off raises BagError when the rows before the break are written.
    """
    total = math.ceil(bag.topic(topic, POINT_CLOUD).count / every)
    motions = None if odometry is None else _Motions(odometry, localizer)
    done = 0
    with EstimateWriter(output) as writer:
        for moment in _moments(bag, topic, every, imu_topic, imu_time_constant_s, motions):
            if isinstance(moment.scan, CloudError):
                estimate = no_estimate(moment.stamp_ns, str(moment.scan))
            else:
                motion = None if motions is None else motions.between(localizer.stamp_ns, moment.stamp_ns)
                try:
                    estimate = localizer.localize(moment.scan, moment.up, motion=motion)
                except CloudError as error:
                    estimate = no_estimate(moment.stamp_ns, str(error))
            writer.write(estimate)
            done += 1
            if progress is not None:
                progress(done, max(total, done), estimate)
    if done == 0:
        raise BagError(f"topic '{topic}' of {bag.path} holds no message")
    return done


class _Moment(NamedTuple):
    """A scan to localize, or why it cannot be."""

    stamp_ns: int
    recorded_ns: int
    scan: Scan | CloudError
    up: Float64Array | None


class _Motions:
    """How the robot moved between scans."""

    def __init__(self, source: OdometrySource, localizer: Localizer) -> None:
        self.topic = source.topic
        self._base_frame_id = source.base_frame_id
        self._T_base_lidar = mounting_matrix(localizer.config.scan.mounting)
        self._max_range_m = localizer.config.scan.max_range_m
        fusion = localizer.config.fusion
        self._buffer = OdometryBuffer(fusion) if source.topic is not None else ScanOdometry(fusion, self._max_range_m)
        self._warned = False

    def take_odometry(self, message: Any, recorded_ns: int) -> None:
        """Take in a message of the odometry's topic; what is no pose is left out."""
        assert isinstance(self._buffer, OdometryBuffer)
        child = message.child_frame_id
        if not self._warned and child not in ("", self._base_frame_id):
            log.warning("'%s' tells the pose of '%s'; it is taken for '%s'", self.topic, child, self._base_frame_id)
            self._warned = True
        try:
            self._buffer.add(stamp_ns_of(message, recorded_ns), pose_matrix(message.pose.pose))
        except PoseError as error:
            log.debug("odometry left out: %s", error)

    def take_scan(self, scan: Scan) -> None:
        """Take in a scan, where the scans themselves are the odometry."""
        if isinstance(self._buffer, ScanOdometry):
            points = scan.points[np.isfinite(scan.points).all(axis=1)].astype(np.float64)
            points = points[np.linalg.norm(points, axis=1) <= self._max_range_m]
            R, t = self._T_base_lidar[:3, :3], self._T_base_lidar[:3, 3]
            self._buffer.add(scan.stamp_ns, points @ R.T + t)

    def tells(self, moment: _Moment, now_ns: int) -> bool:
        """Say whether all odometry that a scan needs has been read, or as much as will come."""
        if not isinstance(self._buffer, OdometryBuffer):
            return True
        newest_ns = self._buffer.newest_ns
        return now_ns - moment.recorded_ns > HELD_NS or (newest_ns is not None and newest_ns >= moment.stamp_ns)

    def between(self, from_ns: int | None, to_ns: int) -> Motion | None:
        """Return the motion between the stamps of two scans; None where there is no first one."""
        return None if from_ns is None else self._buffer.motion(from_ns, to_ns)


def _moments(
    bag: BagReader,
    topic: str,
    every: int,
    imu_topic: str | None,
    imu_time_constant_s: float,
    motions: _Motions | None,
) -> Iterator[_Moment]:
    """Yield the scans of a bag in their order; each waits until the odometry of its stamp has been read."""
    gravity = GravityFilter(imu_time_constant_s)
    imu = None if imu_topic is None else bag.topic(imu_topic, IMU).name
    odometry = None if motions is None or motions.topic is None else bag.topic(motions.topic, ODOMETRY).name
    waiting: deque[_Moment] = deque()
    seen = 0
    topics = [name for name in (topic, imu, odometry) if name is not None]
    try:
        for name, recorded_ns, message in bag.messages(topics):
            if name == imu:
                acceleration = message.linear_acceleration
                gravity.update(
                    stamp_ns_of(message, recorded_ns), np.array([acceleration.x, acceleration.y, acceleration.z])
                )
            elif name == odometry and motions is not None:
                motions.take_odometry(message, recorded_ns)
            else:
                seen += 1
                stamp_ns = stamp_ns_of(message, recorded_ns)
                is_used = (seen - 1) % every == 0
                if is_used or (motions is not None and odometry is None):
                    scan = _scan_of(message, stamp_ns)
                    if motions is not None and isinstance(scan, Scan):
                        motions.take_scan(scan)
                    if is_used:
                        waiting.append(_Moment(stamp_ns, recorded_ns, scan, gravity.up(stamp_ns)))
            while waiting and (motions is None or motions.tells(waiting[0], recorded_ns)):
                yield waiting.popleft()
    except BagError:
        yield from waiting  # what was read before the damage is whole
        raise
    yield from waiting


def _scan_of(message: Any, stamp_ns: int) -> Scan | CloudError:
    try:
        return replace(scan_from_pointcloud2(message), stamp_ns=stamp_ns)
    except CloudError as error:
        return error
