"""Types passed between the packages: frozen, with shape, unit and frame beside each field.

Frames. `lidar`: as the sensor gives it (x forward, y left, z up). `base`: the robot's `base_link`
(REP-103). `grid`: the map's projected CRS, easting/northing/height in metres, float64. `map`: the ENU
tangent frame at the map's origin (REP-105). Time is integer nanoseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from crossloc3d_ros.config import CalibrationConfig, PreprocessingConfig

BoolArray = npt.NDArray[np.bool_]
Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
UInt8Array = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class PointTimes:
    """When the points of a cloud were measured, as the driver sends it."""

    field: str
    """Its name in the message."""
    values: npt.NDArray[Any]
    """(N,) numbers of the field's own type; unit and origin are the driver's."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One revolution of the LiDAR."""

    points: Float32Array
    """(N, 3), metres, lidar frame; may hold NaN and infinities as drivers send them."""
    stamp_ns: int
    frame_id: str
    times: PointTimes | None = None
    """Of the points; None where the cloud carries none."""
    is_at_stamp: bool = False
    """Whether each point is where it would have been at the stamp, not at its own time within the revolution."""


@dataclass(frozen=True, eq=False)
class Patch:
    """What the encoder sees: a fixed number of above-ground points around a place."""

    points: Float32Array
    """(n_points, 3) in [-1, 1]: x and y from the centre, z the height above the ground, all over `half_extent_m`."""
    half_extent_m: float
    source_count: int
    """How many points there were to choose from."""


@dataclass(frozen=True, eq=False)
class AerialChunk:
    """Some points of an aerial survey, in the order of the file."""

    points: Float64Array
    """(N, 3) easting, northing, height, metres; the CRS is the file's."""
    classification: UInt8Array
    """(N,) ASPRS classes; 2 ground, 6 building, 7 and 18 noise, 9 water."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """The k submaps whose descriptors lie nearest, best first."""

    submap_ids: Int64Array
    """(k,) rows of the map's submap table."""
    descriptor_distances: Float32Array
    """(k,) Euclidean, in descriptor units."""
    probabilities: Float64Array
    """(k,) probability that each candidate is the place; at most 1 in all."""
    grid: Float64Array
    """(k, 3) easting, northing, ground height, metres, grid frame."""
    heading_rad: Float64Array = field(default_factory=lambda: np.empty(0))
    """(k,) the robot's heading that fits best, counter-clockwise from grid east, to half a step of the headings tried;
    empty where the descriptor does not give it."""

    def __len__(self) -> int:
        return len(self.submap_ids)


@dataclass(frozen=True, eq=False)
class AlignedPoses:
    """Poses of the base at which a scan fits the aerial map, best first."""

    grid: Float64Array
    """(n, 3) easting, northing, height of base, metres, grid frame."""
    heading_rad: Float64Array
    """(n,) heading of base, counter-clockwise from grid east."""
    covariance: Float64Array
    """(n, 3, 3) of easting, northing, heading: m2, m rad, rad2; from the score's shape."""
    log_likelihood: Float64Array
    """(n,) natural logarithm of how much likelier the scan is here than at a place that the map does not hold."""
    probabilities: Float64Array
    """(n,) from this scan alone; what is missing to 1 is that of the null hypothesis, that none of them is right."""
    inliers: Float64Array
    """(n,) share of the scan's evidence that the map explains at this pose."""
    converged: BoolArray
    """(n,) whether the refinement converged inside of the area searched."""
    source: Int64Array
    """(n,) which candidate it was found at: its row among the candidates; -1 - h for hypothesis h, and
    `WHOLE_MAP` where the whole map was searched."""
    log_prior: float = 0.0
    """Natural logarithm of the odds, before the scan, that the robot is at a given one of the places of the map rather
    than off it: `probabilities` is the softmax of `log_likelihood + log_prior` and a 0 for the null hypothesis."""

    def __len__(self) -> int:
        return len(self.log_likelihood)


WHOLE_MAP = -(2**31)
"""`AlignedPoses.source` of a pose found by a search of the whole map."""


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Poses that the robot may have, tracked by odometry, likeliest first."""

    grid: Float64Array
    """(h, 3) easting, northing, height of base, metres, grid frame."""
    heading_rad: Float64Array
    """(h,) counter-clockwise from grid east."""
    covariance: Float64Array
    """(h, 3, 3) of easting, northing, heading: m2, m rad, rad2."""
    probabilities: Float64Array
    """(h,) what is missing to 1 is that of the null hypothesis."""

    def __len__(self) -> int:
        return len(self.probabilities)


class TrackState(Enum):
    """State of the localization."""

    SEARCHING = "searching"
    """The null hypothesis is likelier than all poses."""
    AMBIGUOUS = "ambiguous"
    """Some poses are likely, none by more than the threshold."""
    LOCALIZED = "localized"
    """One pose is probable, by more than the threshold."""
    LOST = "lost"
    """It was localized, and the scans no longer fit, or none has been of use for a while."""


class FixStatus(Enum):
    """Whether an estimate may be driven by."""

    NO_FIX = "no fix"
    FIX = "fix"


@dataclass(frozen=True)
class Timings:
    """Milliseconds that each step of one localisation took."""

    prepare_ms: float = 0.0
    encode_ms: float = 0.0
    search_ms: float = 0.0
    align_ms: float = 0.0
    fuse_ms: float = 0.0

    @property
    def total_ms(self) -> float:
        return self.prepare_ms + self.encode_ms + self.search_ms + self.align_ms + self.fuse_ms


@dataclass(frozen=True)
class ScanCounts:
    """How many points each step of the scan's preparation left."""

    received: int = 0
    finite: int = 0
    in_range: int = 0
    off_body: int = 0
    above_ground: int = 0
    in_patch: int = 0


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where the scan was taken, as far as it is known."""

    stamp_ns: int
    status: FixStatus
    reason: str
    """One sentence for people: why there is or is no fix."""
    grid: Float64Array
    """(3,) easting, northing, height, metres, grid frame; NaN where there is no candidate at all."""
    enu: Float64Array
    """(3,) metres, map frame; NaN as above."""
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    """WGS84 ellipsoidal height; NaN where the geoid is not known."""
    covariance: Float64Array
    """(3, 3) ENU, square metres."""
    candidates: Candidates
    counts: ScanCounts = field(default_factory=ScanCounts)
    timings: Timings = field(default_factory=Timings)
    state: TrackState = TrackState.SEARCHING
    probability: float = float("nan")
    """That the horizontal error is below 10 m."""
    T_map_base: Float64Array = field(default_factory=lambda: np.full((4, 4), np.nan))
    """(4, 4) the base in the frame map; NaN where no pose is known."""
    pose_covariance: Float64Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    """(6, 6) of x, y, z, and rotations about x, y, z of the frame map: m2, m rad, rad2; NaN where unknown."""
    aligned: AlignedPoses = field(default_factory=lambda: no_aligned_poses())
    hypotheses: Hypotheses = field(default_factory=lambda: no_hypotheses())


def no_candidates() -> Candidates:
    """Return the candidates of a scan that nothing was retrieved for."""
    return Candidates(np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0), np.empty((0, 3)))


def no_aligned_poses() -> AlignedPoses:
    """Return the poses of a scan that fits nowhere, or that was not aligned."""
    none = np.empty(0)
    return AlignedPoses(
        np.empty((0, 3)), none, np.empty((0, 3, 3)), none, none, none, np.empty(0, np.bool_), np.empty(0, np.int64)
    )


def no_hypotheses() -> Hypotheses:
    """Return the hypotheses of a robot that has seen nothing."""
    return Hypotheses(np.empty((0, 3)), np.empty(0), np.empty((0, 3, 3)), np.empty(0))


class DescriptorEncoder(Protocol):
    """An encoder of patches to descriptors; `encoder.runtime.Encoder` is the one that ships."""

    @property
    def fingerprint(self) -> str:
        """Identify weights, model and preprocessing: a map is used only with the encoder that made it."""

    @property
    def descriptor_size(self) -> int:
        """Numbers in a descriptor."""

    @property
    def preprocessing(self) -> PreprocessingConfig:
        """Return the preprocessing that the weights were trained on."""

    def encode(self, points: Float32Array) -> Float32Array:
        """Return the descriptor (D,) of a patch's points (n, 3) in [-1, 1]."""

    def encode_batch(self, clouds: Sequence[Float32Array]) -> Float32Array:
        """Return the descriptors (B, D) of B patches; each depends on its own points alone."""

    def warm_up(self) -> None:
        """Compile and touch whatever makes the first call slow."""


@runtime_checkable
class CalibratedEncoder(Protocol):
    """An encoder whose weights hold a calibration of descriptor distances."""

    @property
    def calibration(self) -> CalibrationConfig | None:
        """Return the calibration stored with the weights; None where there is none."""


@runtime_checkable
class HeadingEncoder(Protocol):
    """An encoder with its way to treat the unknown heading of a query."""

    @property
    def headings(self) -> int:
        """Return in how many headings, evenly over the circle, a query is tried; 1 = the descriptor is free of it."""

    @property
    def rotations(self) -> int:
        """Return over how many test-time rotations, evenly over the circle, a descriptor is averaged; 1 = none."""
