"""Where the robot really was: a GNSS track out of a bag, brought to the map's grid and to the scans' stamps."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats.bag import NAV_SAT_FIX, BagReader, stamp_ns_of
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import Float64Array, Int64Array

log = logging.getLogger(__name__)

MAX_STD_M = 10.0
"""A fix whose receiver doubts it by more than this horizontally is no truth."""
MAX_GAP_S = 2.5
"""Between fixes farther apart than this in time the robot may have been anywhere."""


@dataclass(frozen=True, eq=False)
class TruthTrack:
    """GNSS fixes in the order of their stamps."""

    topic: str
    stamp_ns: Int64Array
    """(T,) strictly increasing."""
    grid: Float64Array
    """(T, 3) easting, northing, height, metres, the map's grid; heights NaN where the geoid is not known."""
    dropped: int
    """Fixes left out: no fix, not finite, or a standard deviation above MAX_STD_M."""

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
        near = gap_ns <= MAX_GAP_S * 1e9
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
    positions: list[tuple[float, float, float]] = []
    dropped = 0
    try:
        for _, recorded_ns, fix in bag.messages([topic]):
            if not _usable(fix.status.status, fix.latitude, fix.longitude) or _std_m(fix) > MAX_STD_M:
                dropped += 1
                continue
            stamps.append(stamp_ns_of(fix, recorded_ns))
            positions.append((float(fix.latitude), float(fix.longitude), float(fix.altitude)))
    except BagError as error:
        if not stamps:
            raise
        log.warning("the truth ends early: %s", error)
    stamp_ns, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)  # sorts, too
    table = np.array(positions, dtype=np.float64).reshape(-1, 3)[first]
    grid = frame.from_geographic(table[:, 0], table[:, 1], table[:, 2]) if len(table) else np.empty((0, 3))
    return TruthTrack(topic, stamp_ns, grid, dropped)


def _usable(status: int, latitude: float, longitude: float) -> bool:
    finite = math.isfinite(latitude) and math.isfinite(longitude)
    return status >= 0 and finite and abs(latitude) <= 90.0 and abs(longitude) <= 180.0


def _std_m(fix: object) -> float:
    """Return the larger horizontal standard deviation; 0 where the receiver does not say."""
    if fix.position_covariance_type == 0:  # type: ignore[attr-defined]
        return 0.0
    covariance = np.asarray(fix.position_covariance, dtype=np.float64).reshape(3, 3)[:2, :2]  # type: ignore[attr-defined]
    if not np.isfinite(covariance).all():
        return math.inf
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh((covariance + covariance.T) / 2)[-1])))
