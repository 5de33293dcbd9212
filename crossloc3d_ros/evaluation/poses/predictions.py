"""What the localizer estimates for the scans and journeys of a pose set: made once, kept, scored afterwards."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import LocalizerConfig, to_dict
from crossloc3d_ros.datasets.pose_drives import Journey, RawDrive, load_drives, steps_of
from crossloc3d_ros.datasets.pose_sets import PoseSet, load_pose_set
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.datasets.set_maps import Progress
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.odometry import planar_pose
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.localization.session import OdometryKind, ScanLocalizer, Session
from crossloc3d_ros.types import (
    BoolArray,
    DescriptorEncoder,
    Estimate,
    FixStatus,
    Float64Array,
    Int64Array,
    TrackState,
)
from crossloc3d_ros.workers import EncoderLoader, open_workers

Odometry = Literal["wheels", "scan", "none"]
_SESSION_ODOMETRY: dict[Odometry, OdometryKind] = {"wheels": "topic", "scan": "scan", "none": "none"}
"""What measures how the robot moves: its wheels, its scans, nothing."""
CANDIDATES, ALIGNED = 25, 25
"""How many of each scan's candidates and aligned poses are kept."""
STATES = tuple(TrackState)
SINGLE = -1
"""The journey of a scan of the set, localized from nothing."""
_ALONE = -2
"""Scans of journey j that were localized again from nothing are of the journey `_ALONE - j`."""
_ALONE_EVERY = 5
_SINGLES_AT_ONCE = 16


@dataclass(frozen=True)
class PoseAbout:
    """What was evaluated, and how."""

    pose_set: str
    """Name of the set."""
    data: str
    """Name of its folder, which changes with its content."""
    weights: str
    encoder: str
    """Fingerprint of the weights."""
    area_names: tuple[str, ...]
    families: tuple[str, ...]
    on_map: tuple[bool, ...]
    groups: tuple[str, ...]
    map_km2: float
    submaps: int
    config: dict[str, Any] = field(default_factory=dict)
    """The localizer's settings."""
    odometry: Odometry = "wheels"
    every: int = 1
    """Each n-th scan and journey was evaluated."""


@dataclass(frozen=True, eq=False)
class PosePredictions:
    """One row a scan; angles are counter-clockwise from grid east, metres and radians, NaN where unknown."""

    journey: Int64Array
    """(N,) number of the journey; `SINGLE` for the set's scans, localized from nothing; less: see `number_of_alone`."""
    leg: Int64Array
    """(N,) number of the journey's leg: before each but the first the robot was kidnapped."""
    area: Int64Array
    """(N,)"""
    group: Int64Array
    """(N,)"""
    stamp_ns: Int64Array
    """(N,) by the journey's clock."""
    travelled_m: Float64Array
    """(N,) driven truly since the leg began."""
    truth: Float64Array
    """(N, 4) easting, northing, height, heading."""
    has_fix: BoolArray
    """(N,)"""
    state: Int64Array
    """(N,) row of `STATES`."""
    probability: Float64Array
    """(N,) believed of an error below 10 m."""
    pose: Float64Array
    """(N, 4) easting, northing, height, heading that the localizer gave."""
    covariance: Float64Array
    """(N, 3, 3) of easting, northing, heading."""
    candidates: Float64Array
    """(N, 25, 2) centres of the submaps retrieved, best first."""
    aligned: Float64Array
    """(N, 25, 3) easting, northing, heading at which the scan alone fits, best first."""
    aligned_source: Int64Array
    """(N, 25) `AlignedPoses.source`; meaningless where `aligned` is NaN."""
    aligned_probability: Float64Array
    """(N, 25)"""
    aligned_log_likelihood: Float64Array
    """(N, 25)"""
    aligned_covariance: Float64Array
    """(N, 3, 3) of the first."""
    milliseconds: Float64Array
    """(N, 5) prepare, encode, search, align, fuse."""

    def __len__(self) -> int:
        return len(self.journey)


def predict(
    pose_set: PoseSet,
    drives: Sequence[RawDrive],
    journeys: Sequence[Journey],
    loader: EncoderLoader,
    config: LocalizerConfig,
    *,
    odometry: Odometry = "wheels",
    every: int = 1,
    workers: int = 1,
    progress: Progress | None = None,
) -> PosePredictions:
    """Localize every single scan of a set and along every journey, in so many processes.

    `every`: for a quick look, each n-th scan and each n-th journey alone.
    """
    report = progress or (lambda stage, done, total, unit: None)
    scans = range(0, len(pose_set.scans), every)
    singles = [tuple(scans[first : first + _SINGLES_AT_ONCE]) for first in range(0, len(scans), _SINGLES_AT_ONCE)]
    steps = {i: len(steps_of(journey, drives)) for i, journey in enumerate(journeys) if i % every == 0}
    done, total = 0, len(scans) + sum(steps.values())
    report("localizing", done, total, "scans")

    def advance(count: int) -> None:
        nonlocal done
        done += count
        report("localizing", done, total, "scans")

    # The longest first, so that no worker is left alone with one at the end.
    order = sorted(steps, key=lambda i: -steps[i])
    where = (pose_set.folder, pose_set.map_folder)
    tasks = [_Task(*where, config, odometry, (i, journeys[i]), ()) for i in order]
    tasks += [_Task(*where, config, odometry, None, rows) for rows in singles]
    sizes = [steps[i] for i in order] + [len(rows) for rows in singles]
    with open_workers(loader, loader(), workers, None, pose_set.folder) as pool:
        parts = list(pool.run_encoding(_do, zip(tasks, sizes, strict=True), advance))
    return _in_order(join(parts))


@dataclass(frozen=True, eq=False)
class _Task:
    """A part of the work; the scans stay on the disk."""

    folder: Path
    map_folder: Path
    config: LocalizerConfig
    odometry: Odometry
    journey: tuple[int, Journey] | None
    singles: tuple[int, ...]


def _do(task: _Task, encoder: DescriptorEncoder, advance: Callable[[int], None] | None) -> PosePredictions:
    frame = map_of(task.map_folder, encoder.fingerprint).frame
    localizer = localizer_of(task.map_folder, encoder, task.config)
    report = advance or (lambda _: None)
    if task.journey is None:
        scans = set_of(task.folder, task.map_folder).scans
        return predict_singles([scans[i] for i in task.singles], localizer, frame, report)
    number, journey = task.journey
    return predict_journey(number, journey, drives_of(task.folder), localizer, frame, task.odometry, report)


@functools.lru_cache(maxsize=1)
def map_of(folder: Path, fingerprint: str) -> AerialMap:
    """Return a map, read once while one after the other uses it."""
    return AerialMap.load(folder, fingerprint)


@functools.lru_cache(maxsize=1)
def set_of(folder: Path, map_folder: Path) -> PoseSet:
    """Return a pose set, read once while one after the other uses it."""
    return load_pose_set(folder, map_folder)


@functools.lru_cache(maxsize=1)
def drives_of(folder: Path) -> tuple[RawDrive, ...]:
    """Return the drives of a set's folder, read once while one after the other uses them."""
    return tuple(load_drives(folder))


_localizers: dict[tuple[Path, str, LocalizerConfig], ScanLocalizer] = {}


def localizer_of(folder: Path, encoder: DescriptorEncoder, config: LocalizerConfig) -> ScanLocalizer:
    """Return this process's localizer: a worker does many tasks with one."""
    key = (folder, encoder.fingerprint, config)
    if key not in _localizers:
        _localizers.clear()
        localizer = Localizer(map_of(folder, encoder.fingerprint), encoder, config)
        localizer.warm_up()
        _localizers[key] = localizer
    return _localizers[key]


def predict_singles(
    scans: Sequence[RawScan],
    localizer: ScanLocalizer,
    frame: MapFrame,
    advance: Callable[[int], None] = lambda _: None,
    examine: Callable[[RawScan, Estimate], None] = lambda scan, estimate: None,
) -> PosePredictions:
    """Localize each scan as if it were the first of all; `examine` is called with each and its estimate."""
    rows = []
    session = Session(localizer)
    for scan in scans:
        session.reset()
        estimate = _localize(session, scan)
        rows.append(_row(scan, estimate, frame, SINGLE, 0, 0.0))
        examine(scan, estimate)
        advance(1)
    return join(rows)


def predict_journey(
    number: int,
    journey: Journey,
    drives: Sequence[RawDrive],
    localizer: ScanLocalizer,
    frame: MapFrame,
    odometry: Odometry = "wheels",
    advance: Callable[[int], None] = lambda _: None,
    alone_every: int = _ALONE_EVERY,
) -> PosePredictions:
    """Localize each scan of a journey, with the odometry that has arrived until then.

    Each `alone_every`-th scan of the first leg again, from nothing; none of them where it is 0.
    """
    localizer.reset()
    session = Session(localizer, _SESSION_ODOMETRY[odometry])
    rows = []
    for step in steps_of(journey, drives):
        scan = dataclasses.replace(drives[step.drive].scans[step.row], stamp_ns=step.stamp_ns)
        for stamp_ns, (x, y, heading) in zip(step.odometry_ns.tolist(), step.odometry.tolist(), strict=True):
            session.add_odometry(stamp_ns, planar_pose(x, y, heading))
        estimate = _localize(session, scan)
        rows.append(_row(scan, estimate, frame, number, step.leg, step.travelled_m))
        advance(1)
    # Some of them again, alone: what a scan shows by itself, against what the drive until there adds.
    session = Session(localizer)
    again = [step for step in steps_of(journey, drives) if step.leg == 0] if alone_every else []
    for step in again[:: max(alone_every, 1)]:
        session.reset()
        scan = dataclasses.replace(drives[step.drive].scans[step.row], stamp_ns=step.stamp_ns)
        rows.append(_row(scan, _localize(session, scan), frame, _ALONE - number, 0, step.travelled_m))
    return join(rows)


def number_of_alone(predictions: PosePredictions) -> Int64Array:
    """Return (N,) of which journey a scan is that was localized again from nothing; negative for all others."""
    return _ALONE - predictions.journey


def _localize(session: Session, scan: RawScan) -> Estimate:
    return session.localize(session.receive(scan.as_scan(), scan.T_base_lidar, scan.up_base)).estimate


def _row(
    scan: RawScan, estimate: Estimate, frame: MapFrame, journey: int, leg: int, travelled_m: float
) -> PosePredictions:
    aligned, timings = estimate.aligned, estimate.timings
    kept = min(len(aligned), ALIGNED)
    pose, covariance = grid_pose(estimate, frame)
    return PosePredictions(
        journey=np.array([journey]),
        leg=np.array([leg]),
        area=np.array([scan.area]),
        group=np.array([scan.group]),
        stamp_ns=np.array([scan.stamp_ns]),
        travelled_m=np.array([travelled_m]),
        truth=np.array([[*scan.T_grid_base[:3, 3], scan.heading_rad]]),
        has_fix=np.array([estimate.status is FixStatus.FIX]),
        state=np.array([STATES.index(estimate.state)]),
        probability=np.array([estimate.probability]),
        pose=pose[None],
        covariance=covariance[None],
        candidates=_padded(estimate.candidates.grid[:, :2], CANDIDATES)[None],
        aligned=_padded(np.column_stack([aligned.grid[:, :2], aligned.heading_rad]), ALIGNED)[None],
        aligned_source=np.concatenate([aligned.source[:kept], np.zeros(ALIGNED - kept, np.int64)])[None],
        aligned_probability=_padded(aligned.probabilities, ALIGNED)[None],
        aligned_log_likelihood=_padded(aligned.log_likelihood, ALIGNED)[None],
        aligned_covariance=(aligned.covariance[0] if kept else np.full((3, 3), np.nan))[None],
        milliseconds=np.array(
            [[timings.prepare_ms, timings.encode_ms, timings.search_ms, timings.align_ms, timings.fuse_ms]]
        ),
    )


def grid_pose(estimate: Estimate, frame: MapFrame) -> tuple[Float64Array, Float64Array]:
    """Return an estimate's easting, northing, height, heading (4,) in the grid, and the covariance (3, 3) without the
    height's.

    Without a pose the place takes its stead, and the heading is NaN.
    """
    T = estimate.T_map_base
    if not np.isfinite(T).all():
        covariance = np.full((3, 3), np.nan)
        covariance[:2, :2] = estimate.covariance[:2, :2]
        return np.append(estimate.grid, np.nan), covariance
    grid = frame.from_enu(T[None, :3, 3])[0]
    turn = float(frame.convergence_rad(grid[None])[0])
    heading = math.atan2(T[1, 0], T[0, 0]) + turn
    cosine, sine = math.cos(turn), math.sin(turn)
    R = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    covariance = R @ estimate.pose_covariance[np.ix_([0, 1, 5], [0, 1, 5])] @ R.T
    return np.append(grid, math.remainder(heading, math.tau)), covariance


def _padded(values: Float64Array, rows: int) -> Float64Array:
    padded = np.full((rows, *values.shape[1:]), np.nan)
    kept = min(len(values), rows)
    padded[:kept] = values[:kept]
    return padded


def join(parts: Sequence[PosePredictions]) -> PosePredictions:
    """Return the rows of all parts."""
    if not parts:
        raise EvaluationError("nothing was predicted: the set holds neither scans nor drives")
    return PosePredictions(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in column_names()})


def select(predictions: PosePredictions, rows: BoolArray | Int64Array) -> PosePredictions:
    """Return some of the rows."""
    return PosePredictions(**{name: getattr(predictions, name)[rows] for name in column_names()})


def column_names() -> Iterator[str]:
    """Return the names of the columns."""
    return (item.name for item in dataclasses.fields(PosePredictions))


def _in_order(predictions: PosePredictions) -> PosePredictions:
    """Sort by journey, then by time; single scans by area and place, which does not depend on the workers."""
    keys = (predictions.truth[:, 1], predictions.truth[:, 0], predictions.stamp_ns, predictions.leg,
            predictions.journey)  # fmt: skip
    return select(predictions, np.lexsort(keys).astype(np.int64))


def about_of(
    pose_set: PoseSet, aerial_map: AerialMap, weights: str, config: LocalizerConfig, odometry: Odometry, every: int
) -> PoseAbout:
    """Return what the predictions say of themselves."""
    west, south, east, north = aerial_map.bounds
    return PoseAbout(
        pose_set.name, pose_set.folder.name, weights, aerial_map.manifest.encoder_fingerprint, pose_set.area_names,
        pose_set.families, pose_set.on_map, pose_set.groups, (east - west) * (north - south) / 1e6,
        len(aerial_map.submaps), to_dict(config), odometry, every,
    )  # fmt: skip
