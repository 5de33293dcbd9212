"""Scans of a recording with the places and headings that GNSS and odometry measure, to learn from and to test on."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.clouds.frames import CloudFrames
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import DatasetConfig, PreprocessingConfig, ScanConfig
from crossloc3d_ros.datasets.truth import find_truth_topic, is_fix
from crossloc3d_ros.errors import BagError, CloudError, PoseError
from crossloc3d_ros.formats.bag import IMU, NAV_SAT_FIX, ODOMETRY, POINT_CLOUD, BagReader, open_bag, stamp_ns_of
from crossloc3d_ros.formats.odometry import OdometryPoses
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.gravity import GravityFilter
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

log = logging.getLogger(__name__)

OUTSIDE = "before the first or after the last GNSS fix"
NO_FIX = "the receiver had no fix"
DOUBTFUL = "the GNSS covariance is too large"
OUTAGE = "between GNSS fixes too far apart in time"
TOO_NEAR = "too near to the last scan used"
UNUSABLE = "too few points, or a damaged cloud"

_COURSE_S = 1.5
"""The direction of travel is taken over twice this time."""
_COURSE_M = 1.0
"""Over less than this way it says nothing."""
_ALIGN_S = 30.0
"""The odometry's drift is followed over twice this time."""

Progress = Callable[[int, int], None]
"""Scans seen, scans to see."""


@dataclass(frozen=True)
class Topics:
    """Where in a recording to look; None for the points and GNSS: the only topic of its type."""

    points: str | None = None
    gnss: str | None = None
    imu: str | None = None
    """None: scans are not levelled by an IMU."""
    odometry: str | None = None
    """None: the only one beside ground truth, if there is one; headings come from the course without it."""


@dataclass(frozen=True, eq=False)
class GnssTrack:
    """All fixes of a recording, good and bad, in the order of their stamps."""

    stamp_ns: Int64Array
    """(T,) strictly increasing."""
    xy_m: Float64Array
    """(T, 2) easting, northing, metres; NaN without a fix."""
    std_m: Float64Array
    """(T,) larger horizontal standard deviation; NaN without a fix, 0 where the receiver does not say."""

    def locate(self, stamps_ns: npt.ArrayLike, config: DatasetConfig) -> tuple[Float64Array, list[str]]:
        """Return positions (S, 2) interpolated at the stamps and, where there is none (NaN), why; else ''.

        Both fixes around a stamp must be good; nothing is extrapolated beyond the first and the last one.
        """
        stamps = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        places = np.full((len(stamps), 2), np.nan)
        reasons = [OUTSIDE] * len(stamps)
        after = np.searchsorted(self.stamp_ns, stamps, side="left")
        for i, (stamp, right) in enumerate(zip(stamps.tolist(), after.tolist(), strict=True)):
            if right == len(self.stamp_ns):
                continue
            left = right if self.stamp_ns[right] == stamp else right - 1
            if left < 0:
                continue
            std_m = self.std_m[[left, right]]
            gap_ns = int(self.stamp_ns[right] - self.stamp_ns[left])
            if np.isnan(std_m).any():
                reasons[i] = NO_FIX
            elif (std_m > config.max_gnss_std_m).any():
                reasons[i] = DOUBTFUL
            elif gap_ns > config.max_gap_s * 1e9:
                reasons[i] = OUTAGE
            else:
                share = (stamp - int(self.stamp_ns[left])) / gap_ns if gap_ns else 0.0
                places[i] = self.xy_m[left] + share * (self.xy_m[right] - self.xy_m[left])
                reasons[i] = ""
        return places, reasons


@dataclass(frozen=True, eq=False)
class OdometryTrack:
    """Poses in a frame that drifts."""

    stamp_ns: Int64Array
    """(T,) strictly increasing."""
    xy_m: Float64Array
    """(T, 2)."""
    yaw_rad: Float64Array
    """(T,) without jumps."""


@dataclass(frozen=True, eq=False)
class RecordedScans:
    """What a recording gives."""

    stamp_ns: Int64Array
    """(S,)"""
    xy_m: Float64Array
    """(S, 2) easting, northing, metres."""
    heading_rad: Float64Array
    """(S,) of the robot's x axis, counter-clockwise from grid east; NaN where it is not known."""
    patches: Float32Array
    """(S, n, 3) in patch units."""
    seen: int
    """Scans that the recording holds."""
    dropped: Mapping[str, int]
    """How many of them were left out, by reason."""
    topics: Mapping[str, str | None]
    """The topics that were used."""
    damage: str
    """What is wrong with the recording, where it could not be read to its end."""

    def __len__(self) -> int:
        return len(self.stamp_ns)


def find_topics(bag: BagReader, topics: Topics) -> dict[str, str | None]:
    """Return the topics to use by role; BagError says what the recording lacks and lists what it has."""
    points = bag.topic(topics.points, POINT_CLOUD) if topics.points else bag.only_topic(POINT_CLOUD, "give --topic")
    gnss = find_truth_topic(bag, topics.gnss)
    if gnss is None:
        try:
            bag.only_topic(NAV_SAT_FIX, "")
        except BagError as error:
            raise BagError(f"{error}; a dataset needs GNSS, to know where each scan was taken") from error
    odometry = bag.topic(topics.odometry, ODOMETRY).name if topics.odometry else None
    if odometry is None:
        others = [t.name for t in bag.topics().values() if t.msgtype == ODOMETRY and "truth" not in t.name]
        odometry = others[0] if len(others) == 1 else None
    imu = bag.topic(topics.imu, IMU).name if topics.imu else None
    return {"points": points.name, "gnss": gnss, "imu": imu, "odometry": odometry}


def read_scans(
    path: Path,
    topics: Topics,
    crs: str,
    scan_config: ScanConfig,
    preprocessing: PreprocessingConfig,
    config: DatasetConfig,
    progress: Progress | None = None,
) -> RecordedScans:
    """Return the usable scans of a recording as patches, with their places in the projected `crs`.

    A scan is left out where GNSS does not place it, where it is nearer than `scan_spacing_m` to the last one used, and
    where it has too few points. Of a recording that breaks off the part before the break is used. BagError where
    topics are missing.
    """
    with open_bag(path) as bag:
        used = find_topics(bag, topics)
        assert used["points"] is not None
        assert used["gnss"] is not None
        track, odometry, damage = read_tracks(bag, used["gnss"], used["odometry"], MapFrame(crs, np.zeros(3)))
        total = bag.topic(used["points"], POINT_CLOUD).count
        gravity = GravityFilter(1.0)
        frames = CloudFrames(scan_config.mounting)
        dropped: Counter[str] = Counter()
        stamps: list[int] = []
        places: list[Float64Array] = []
        patches: list[Float32Array] = []
        seen = 0
        try:
            for name, recorded_ns, message in bag.messages([t for t in (used["points"], used["imu"]) if t]):
                stamp_ns = stamp_ns_of(message, recorded_ns)
                if name != used["points"]:
                    force = message.linear_acceleration
                    gravity.update(stamp_ns, np.array([force.x, force.y, force.z]))
                    continue
                seen += 1
                if progress is not None:
                    progress(seen, max(seen, total))
                place, reasons = track.locate(stamp_ns, config)
                reason = reasons[0]
                if not reason and places and math.dist(place[0], places[-1]) < config.scan_spacing_m:
                    reason = TOO_NEAR
                if not reason:
                    patch = _patch(message, stamp_ns, scan_config, preprocessing, gravity.up(stamp_ns), frames)
                    if patch is None:
                        reason = UNUSABLE
                    else:
                        stamps.append(stamp_ns)
                        places.append(place[0])
                        patches.append(patch)
                if reason:
                    dropped[reason] += 1
        except BagError as error:
            damage = str(error)
    if damage:
        log.warning("used up to its damage: %s", damage)
    stamp_table = np.array(stamps, np.int64)
    return RecordedScans(
        stamp_ns=stamp_table,
        xy_m=np.array(places, np.float64).reshape(-1, 2),
        heading_rad=headings(stamp_table, track, odometry, config),
        patches=np.array(patches, np.float32).reshape(len(patches), preprocessing.n_points, 3),
        seen=seen,
        dropped=dict(dropped),
        topics=used,
        damage=damage,
    )


def read_tracks(
    bag: BagReader, gnss_topic: str, odometry_topic: str | None, frame: MapFrame
) -> tuple[GnssTrack, OdometryTrack | None, str]:
    """Return the GNSS track, the odometry where there is any, and what broke the reading off, or ''."""
    fixes: list[tuple[int, float, float, float]] = []
    poses: list[tuple[int, float, float, float]] = []
    damage = ""
    by_topic = OdometryPoses(odometry_topic or "")
    try:
        for name, recorded_ns, message in bag.messages([t for t in (gnss_topic, odometry_topic) if t]):
            stamp_ns = stamp_ns_of(message, recorded_ns)
            if name == gnss_topic:
                fixes.append((stamp_ns, float(message.latitude), float(message.longitude), _std_m(message)))
            else:
                try:
                    pose = by_topic.pose(message, stamp_ns)
                except PoseError:
                    continue
                poses.append((stamp_ns, float(pose[0, 3]), float(pose[1, 3]), math.atan2(pose[1, 0], pose[0, 0])))
    except BagError as error:
        damage = str(error)
    stamps, first = np.unique(np.array([fix[0] for fix in fixes], np.int64), return_index=True)
    table = np.array([fix[1:] for fix in fixes], np.float64).reshape(-1, 3)[first]
    xy_m = np.full((len(table), 2), np.nan)
    has_fix = np.isfinite(table[:, 2])
    if has_fix.any():
        xy_m[has_fix] = frame.from_geographic(table[has_fix, 0], table[has_fix, 1])[:, :2]
    track = GnssTrack(stamps, xy_m, np.where(np.isfinite(xy_m).all(axis=1), table[:, 2], np.nan))
    odometry = None
    if len(poses) > 1:
        stamps, first = np.unique(np.array([pose[0] for pose in poses], np.int64), return_index=True)
        values = np.array([pose[1:] for pose in poses], np.float64)[first]
        finite = np.isfinite(values).all(axis=1)
        if finite.sum() > 1:
            odometry = OdometryTrack(stamps[finite], values[finite, :2], np.unwrap(values[finite, 2]))
    return track, odometry, damage


def headings(
    stamps_ns: Int64Array, track: GnssTrack, odometry: OdometryTrack | None, config: DatasetConfig
) -> Float64Array:
    """Return the headings (S,) of the robot at the stamps, counter-clockwise from grid east; NaN where not known.

    With odometry: its yaw, plus the angle between its ways and those of GNSS around the stamp. That holds while the
    robot turns, stands or drives backwards. Without: the course over ground, as if the robot drove forwards.
    """
    if odometry is None:
        way = _way(track, stamps_ns, config)
        course: Float64Array = np.where(np.abs(way) >= _COURSE_M, np.angle(way), np.nan)
        return course
    start = int(odometry.stamp_ns[0])
    times = np.arange(start, int(odometry.stamp_ns[-1]) + 1, 500_000_000)
    half = round(_COURSE_S * 1e9)
    inside = (times - half >= start) & (times + half <= int(odometry.stamp_ns[-1]))
    times = times[inside]
    driven = _position(odometry, times + half) - _position(odometry, times - half)
    seen = _way(track, times, config)
    usable = np.isfinite(seen) & (np.abs(seen) >= _COURSE_M) & (np.abs(driven) >= _COURSE_M)
    times, agreement = times[usable], (seen * np.conj(driven))[usable]
    sums = np.concatenate([[0.0], np.cumsum(agreement)])
    reach = round(_ALIGN_S * 1e9)
    low = np.searchsorted(times, stamps_ns - reach, side="left")
    high = np.searchsorted(times, stamps_ns + reach, side="right")
    turned = sums[high] - sums[low]
    seconds = (stamps_ns - start) / 1e9
    yaw = np.interp(seconds, (odometry.stamp_ns - start) / 1e9, odometry.yaw_rad, left=np.nan, right=np.nan)
    heading = np.angle(np.exp(1j * (yaw + np.angle(turned))))
    result: Float64Array = np.where(high > low, heading, np.nan)
    return result


def _way(track: GnssTrack, stamps_ns: Int64Array, config: DatasetConfig) -> npt.NDArray[np.complex128]:
    """Return how far GNSS moved around each stamp, east + i north, metres; NaN where it was lost."""
    half = round(_COURSE_S * 1e9)
    before, _ = track.locate(stamps_ns - half, config)
    after, _ = track.locate(stamps_ns + half, config)
    moved = after - before
    return np.asarray(moved[:, 0] + 1j * moved[:, 1])


def _position(odometry: OdometryTrack, stamps_ns: Int64Array) -> npt.NDArray[np.complex128]:
    start = int(odometry.stamp_ns[0])
    known, wanted = (odometry.stamp_ns - start) / 1e9, (stamps_ns - start) / 1e9
    x, y = (np.interp(wanted, known, odometry.xy_m[:, axis]) for axis in range(2))
    return np.asarray(x + 1j * y)


def _patch(
    message: Any,
    stamp_ns: int,
    config: ScanConfig,
    preprocessing: PreprocessingConfig,
    up: Float64Array | None,
    frames: CloudFrames,
) -> Float32Array | None:
    try:
        scan = frames(replace(scan_from_pointcloud2(message), stamp_ns=stamp_ns))
        patch = prepare_scan(scan, config, preprocessing, up).patch
    except CloudError as error:
        log.debug("a cloud is left out: %s", error)
        return None
    return None if patch is None else patch.points


def _std_m(fix: Any) -> float:
    """Return the larger horizontal standard deviation, NaN without a fix, 0 where the receiver does not say."""
    if not is_fix(fix.status.status, fix.latitude, fix.longitude):
        return math.nan
    if fix.position_covariance_type == 0:
        return 0.0
    covariance = np.asarray(fix.position_covariance, dtype=np.float64).reshape(3, 3)[:2, :2]
    if not np.isfinite(covariance).all():
        return math.inf
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh((covariance + covariance.T) / 2)[-1])))
