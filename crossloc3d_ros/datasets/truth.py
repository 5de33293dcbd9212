"""Where the robot really was, and which way it stood: tracks out of a bag, brought to the scans' stamps."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.errors import BagError, PoseError
from crossloc3d_ros.formats.bag import NAV_SAT_FIX, ODOMETRY, BagReader, stamp_ns_of
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

log = logging.getLogger(__name__)

MAX_STD_M = 10.0
"""A fix whose receiver doubts it by more than this horizontally is no truth."""
MAX_GAP_S = 2.5
"""Between fixes farther apart than this in time the robot may have been anywhere."""
MAX_SPEED_M_S = 60.0
"""What moves faster than this, and farther than `JUMP_M`, did not drive: it was kidnapped, or the receiver jumped."""
JUMP_M = 10.0
MAX_TURNED_DEG = 2.0
"""A track turned by more than this against GNSS is no truth of headings: it was started in some frame of its own."""
_LEAST_SPREAD_M = 20.0
"""A way at least so long, root mean square from its middle, shows how it is turned."""


@dataclass(frozen=True, eq=False)
class TruthTrack:
    """GNSS fixes in the order of their stamps."""

    topic: str
    stamp_ns: Int64Array
    """(T,) strictly increasing."""
    grid: Float64Array
    """(T, 3) easting, northing, height, metres, the map's grid; heights NaN where the geoid is not known."""
    dropped: int
    """Fixes left out: no fix, not finite, at 0, 0, or a standard deviation above MAX_STD_M."""
    std_m: float = float("nan")
    """Median of the larger horizontal standard deviations that the receiver gives; NaN where it gives none."""

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def at(self, stamps_ns: Int64Array) -> Float64Array:
        """Return (S, 3) positions interpolated at the stamps; NaN outside the track and inside its gaps."""
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        result = np.full((len(stamps_ns), 3), np.nan)
        if len(self) == 0:
            return result
        after = np.searchsorted(self.stamp_ns, stamps_ns, side="left")
        exact = (after < len(self)) & (self.stamp_ns[np.minimum(after, len(self) - 1)] == stamps_ns)
        result[exact] = self.grid[after[exact]]
        between = np.flatnonzero(~exact & (after > 0) & (after < len(self)))
        right = after[between]
        left = right - 1
        gap_ns = self.stamp_ns[right] - self.stamp_ns[left]
        weight = (stamps_ns[between] - self.stamp_ns[left]) / gap_ns  # integers: nanoseconds do not fit a float64
        way = np.hypot(*(self.grid[right] - self.grid[left])[:, :2].T)
        near = (gap_ns <= MAX_GAP_S * 1e9) & ~jumped(way, gap_ns / 1e9)
        blend = self.grid[left] + weight[:, None] * (self.grid[right] - self.grid[left])
        result[between[near]] = blend[near]
        return result


def find_truth_topic(bag: BagReader, chosen: str | None) -> str | None:
    """Return the NavSatFix topic to score against, None where the bag has none.

    `chosen` wins and must exist; then a topic that calls itself ground truth; then the only one. BagError lists the
    topics when there are several.
    """
    if chosen is not None:
        return bag.topic(chosen, NAV_SAT_FIX).name
    names = [topic.name for topic in bag.topics().values() if topic.msgtype == NAV_SAT_FIX]
    named = [name for name in names if "ground_truth" in name or "groundtruth" in name]
    if len(named) == 1:
        return named[0]
    if len(names) > 1:
        raise BagError(f"{bag.path} has several GNSS topics ({', '.join(names)}); choose one with --gnss-topic")
    return names[0] if names else None


def read_truth(bag: BagReader, topic: str, frame: MapFrame) -> TruthTrack:
    """Read the usable fixes of a NavSatFix topic.

    The antenna is taken for the robot: its lever arm is small against the distances that are scored. Of a recording
    that breaks off the fixes before the break are returned; BagError where there are none.
    """
    stamps: list[int] = []
    stds: list[float] = []
    positions: list[tuple[float, float, float]] = []
    dropped = 0
    try:
        for _, recorded_ns, fix in bag.messages([topic]):
            std_m = _std_m(fix)
            if not is_fix(fix.status.status, fix.latitude, fix.longitude) or std_m > MAX_STD_M:
                dropped += 1
                continue
            if fix.position_covariance_type != 0:
                stds.append(std_m)
            stamps.append(stamp_ns_of(fix, recorded_ns))
            positions.append((float(fix.latitude), float(fix.longitude), float(fix.altitude)))
    except BagError as error:
        if not stamps:
            raise
        log.warning("the truth ends early: %s", error)
    stamp_ns, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)  # sorts, too
    table = np.array(positions, dtype=np.float64).reshape(-1, 3)[first]
    grid = frame.from_geographic(table[:, 0], table[:, 1], table[:, 2]) if len(table) else np.empty((0, 3))
    return TruthTrack(topic, stamp_ns, grid, dropped, float(np.median(stds)) if stds else math.nan)


@dataclass(frozen=True, eq=False)
class HeadingTrack:
    """True headings in the order of their stamps."""

    topic: str
    stamp_ns: Int64Array
    """(T,) strictly increasing."""
    heading_rad: Float64Array
    """(T,) of base, counter-clockwise from true east."""

    def at(self, stamps_ns: Int64Array) -> Float64Array:
        """Return (S,) headings interpolated at the stamps; NaN outside the track and inside its gaps."""
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        result = np.full(len(stamps_ns), np.nan)
        if len(self.stamp_ns) == 0:
            return result
        right = np.minimum(np.searchsorted(self.stamp_ns, stamps_ns, side="left"), len(self.stamp_ns) - 1)
        left = np.where(self.stamp_ns[right] == stamps_ns, right, np.maximum(right - 1, 0))
        gap_ns = self.stamp_ns[right] - self.stamp_ns[left]
        inside = (self.stamp_ns[left] <= stamps_ns) & (stamps_ns <= self.stamp_ns[right]) & (gap_ns <= MAX_GAP_S * 1e9)
        share = (stamps_ns - self.stamp_ns[left]) / np.maximum(gap_ns, 1)
        turned = np.angle(np.exp(1j * (self.heading_rad[right] - self.heading_rad[left])))
        heading = np.angle(np.exp(1j * (self.heading_rad[left] + share * turned)))
        result[inside] = heading[inside]
        return result


def find_heading_topic(bag: BagReader) -> str | None:
    """Return the Odometry topic that calls itself ground truth, None where there is none or more than one."""
    names = [
        topic.name
        for topic in bag.topics().values()
        if topic.msgtype == ODOMETRY and ("ground_truth" in topic.name or "groundtruth" in topic.name)
    ]
    return names[0] if len(names) == 1 else None


def read_heading(bag: BagReader, topic: str, truth: TruthTrack, frame: MapFrame) -> HeadingTrack | None:
    """Read the headings of a ground-truth Odometry topic whose frame has x to true east.

    Many such topics begin at (0, 0) with a heading of 0. So the way is held against that of `truth`: where it is turned
    by more than `MAX_TURNED_DEG` a warning says so, and None is returned.
    """
    stamps: list[int] = []
    poses: list[Float64Array] = []
    try:
        for _, recorded_ns, message in bag.messages([topic]):
            try:
                poses.append(pose_matrix(message.pose.pose))
            except PoseError:
                continue
            stamps.append(stamp_ns_of(message, recorded_ns))
    except BagError as error:
        log.warning("the true headings end early: %s", error)
    if not stamps:
        return None
    stamp_ns, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
    T_world_base = np.array(poses)[first]
    turned = _turned_rad(T_world_base[:, :2, 3], truth.at(stamp_ns), frame)
    if turned is not None and abs(turned) > math.radians(MAX_TURNED_DEG):
        log.warning(
            "'%s' is turned by %.1f degrees against '%s', so its headings are not from true east: left out",
            topic,
            math.degrees(turned),
            truth.topic,
        )
        return None
    return HeadingTrack(topic, stamp_ns, np.arctan2(T_world_base[:, 1, 0], T_world_base[:, 0, 0]))


def jumped(way_m: Float64Array, seconds: Float64Array) -> BoolArray:
    """Say (n,) which ways (n,) were too long for the time (n,) that they took: the robot was kidnapped."""
    return np.asarray((way_m > JUMP_M) & (way_m > MAX_SPEED_M_S * np.maximum(seconds, 0.0)), dtype=np.bool_)


def _turned_rad(xy_m: Float64Array, grid: Float64Array, frame: MapFrame) -> float | None:
    """Return by how much a way (T, 2) is turned against the same way in the grid (T, 3); None where it does not show.

    The angle of least squares between the two, each about its own middle.
    """
    known = np.isfinite(grid[:, :2]).all(axis=1) & np.isfinite(xy_m).all(axis=1)
    if known.sum() < 2:
        return None
    place = np.column_stack([grid[known, :2], np.zeros(int(known.sum()))])
    convergence = float(frame.convergence_rad(place.mean(axis=0)[None])[0])
    true = (place[:, 0] + 1j * place[:, 1]) * np.exp(-1j * convergence)
    measured = xy_m[known, 0] + 1j * xy_m[known, 1]
    true, measured = true - true.mean(), measured - measured.mean()
    if min(np.sqrt(np.mean(np.abs(true) ** 2)), np.sqrt(np.mean(np.abs(measured) ** 2))) < _LEAST_SPREAD_M:
        return None
    return float(np.angle(np.sum(measured * np.conj(true))))


def is_fix(status: int, latitude: float, longitude: float) -> bool:
    """Return whether a NavSatFix holds a place on Earth.

    Exactly 0, 0 is no place: drivers that have no position yet send it, some with STATUS_FIX.
    """
    finite = math.isfinite(latitude) and math.isfinite(longitude)
    on_earth = finite and abs(latitude) <= 90.0 and abs(longitude) <= 180.0
    return status >= 0 and on_earth and not (latitude == 0.0 and longitude == 0.0)


def _std_m(fix: object) -> float:
    """Return the larger horizontal standard deviation; 0 where the receiver does not say."""
    if fix.position_covariance_type == 0:  # type: ignore[attr-defined]
        return 0.0
    covariance = np.asarray(fix.position_covariance, dtype=np.float64).reshape(3, 3)[:2, :2]  # type: ignore[attr-defined]
    if not np.isfinite(covariance).all():
        return math.inf
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh((covariance + covariance.T) / 2)[-1])))
