"""Estimates on disk: written while they are made, read back to be scored, so that figures can be checked later.

One CSV row a scan. Lists inside a row (candidates, aligned poses, hypotheses, best first) are separated by spaces;
unknown numbers are empty, inside of lists `nan`. `heading_deg` and its truth are counter-clockwise from true east, as
in the frame `map`; the `grid_headings_deg` of the lists are counter-clockwise from grid east, the axis of their
eastings. Files from before there were poses lack columns, and are read all the same.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import (
    WHOLE_MAP,
    AlignedPoses,
    BoolArray,
    Estimate,
    FixStatus,
    Float64Array,
    Hypotheses,
    Int64Array,
    TrackState,
)

_COVARIANCE_COLUMNS = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")
_TIMING_COLUMNS = ("prepare_ms", "encode_ms", "search_ms", "align_ms", "fuse_ms", "latency_ms")
_POSE_COLUMNS = ("state", "probability", "heading_deg", "heading_std_deg")
_LIST_COLUMNS = (
    "eastings_m",
    "northings_m",
    "grid_headings_deg",
    "cov_ee_m2",
    "cov_en_m2",
    "cov_nn_m2",
    "heading_stds_deg",
    "probabilities",
)
_ALIGNED, _HYPOTHESIS = "aligned_", "hypothesis_"
_ALIGNED_COLUMNS = (
    "aligned_sources",
    "aligned_log_likelihoods",
    "aligned_inliers",
    *(_ALIGNED + name for name in _LIST_COLUMNS),
)
_HYPOTHESIS_COLUMNS = tuple(_HYPOTHESIS + name for name in _LIST_COLUMNS)
_CANDIDATE_COLUMNS = (
    "candidate_ids",
    "candidate_distances",
    "candidate_probabilities",
    "candidate_eastings_m",
    "candidate_northings_m",
)
_ESTIMATE_COLUMNS = (
    "stamp_ns",
    "status",
    "latitude_deg",
    "longitude_deg",
    "altitude_m",
    "easting_m",
    "northing_m",
    "height_m",
    *_COVARIANCE_COLUMNS,
    *_POSE_COLUMNS,
    "points_received",
    "points_in_patch",
    *_TIMING_COLUMNS,
    *_CANDIDATE_COLUMNS,
    *_ALIGNED_COLUMNS,
    *_HYPOTHESIS_COLUMNS,
    "reason",
)
_TRUTH_COLUMNS = (
    "truth_latitude_deg",
    "truth_longitude_deg",
    "truth_easting_m",
    "truth_northing_m",
    "error_m",
    "truth_heading_deg",
    "heading_error_deg",
)


@dataclass(frozen=True, eq=False)
class PoseLists:
    """Several poses for each of S scans, likeliest first: up to K, the rest NaN."""

    grid: Float64Array
    """(S, K, 2) easting and northing, metres."""
    heading_rad: Float64Array
    """(S, K) counter-clockwise from grid east."""
    covariance: Float64Array
    """(S, K, 2, 2) of easting and northing, m2."""
    heading_std_rad: Float64Array
    """(S, K)"""
    probabilities: Float64Array
    """(S, K)"""

    def count(self, scan: int) -> int:
        """Return how many poses the scan has."""
        return int(np.isfinite(self.grid[scan, :, 0]).sum())


def no_pose_lists(scans: int) -> PoseLists:
    """Return the lists of scans that have no poses."""
    none = np.empty((scans, 0))
    return PoseLists(np.empty((scans, 0, 2)), none, np.empty((scans, 0, 2, 2)), none, none)


@dataclass(frozen=True, eq=False)
class EstimateTable:
    """The estimates of a drive as columns over S scans, with up to K candidates each."""

    stamp_ns: Int64Array
    """(S,)"""
    has_fix: BoolArray
    """(S,)"""
    geographic: Float64Array
    """(S, 3) latitude and longitude in degrees, ellipsoidal height in metres; NaN where unknown."""
    grid: Float64Array
    """(S, 3) easting, northing, height, metres, the map's grid; NaN where there was no candidate."""
    covariance: Float64Array
    """(S, 3, 3) ENU, square metres."""
    timings_ms: Float64Array
    """(S, 6) preparing, encoding, searching, aligning, fusing, and last from scan to estimate altogether; NaN where not
    measured."""
    points: Int64Array
    """(S, 2) points received and points used; -1 where not known."""
    candidate_ids: Int64Array
    """(S, K) rows of the map's submap table, -1 where there are fewer."""
    candidate_distances: Float64Array
    """(S, K) between descriptors."""
    candidate_probabilities: Float64Array
    """(S, K)"""
    candidate_grid: Float64Array
    """(S, K, 2) easting and northing, metres; NaN where there are fewer."""
    truth_grid: Float64Array
    """(S, 2) easting and northing, metres; NaN where unknown."""
    truth_heading_rad: Float64Array
    """(S,) counter-clockwise from true east; NaN where unknown."""
    states: tuple[TrackState | None, ...]
    """(S,); None where the file does not say, and for scans that got no estimate or could not be used."""
    probability: Float64Array
    """(S,) belief that the horizontal error is below 10 m; NaN where the file does not say."""
    heading_rad: Float64Array
    """(S,) of base, counter-clockwise from true east, as in the frame map; NaN where unknown."""
    heading_std_rad: Float64Array
    """(S,)"""
    aligned: PoseLists
    aligned_sources: Int64Array
    """(S, K) as `AlignedPoses.source`: rows of the candidates, below 0 where the search began at a hypothesis."""
    hypotheses: PoseLists
    reasons: tuple[str, ...]
    """(S,)"""

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def error_m(self) -> Float64Array:
        """Horizontal distance (S,) from the estimate to the truth, NaN where either is unknown."""
        return np.asarray(np.hypot(*(self.grid[:, :2] - self.truth_grid).T))

    @property
    def heading_error_rad(self) -> Float64Array:
        """Signed heading error (S,) in [-pi, pi], NaN where either is unknown."""
        return wrap(self.heading_rad - self.truth_heading_rad)

    @property
    def latency_ms(self) -> Float64Array:
        """From scan to estimate altogether (S,), NaN where not measured."""
        return np.asarray(self.timings_ms[:, -1])

    @property
    def first_aligned(self) -> tuple[Float64Array, Float64Array]:
        """Return what each scan alone has to say: easting and northing (S, 2) and heading from grid east (S,), or NaN.

        The likeliest aligned pose whose search did not begin at a hypothesis, which earlier scans have led to.
        """
        grid, heading = np.full((len(self), 2), np.nan), np.full(len(self), np.nan)
        alone = (self.aligned_sources >= 0) | (self.aligned_sources == WHOLE_MAP)
        for scan in np.flatnonzero(alone.any(axis=1)):
            first = int(alone[scan].argmax())
            grid[scan], heading[scan] = self.aligned.grid[scan, first], self.aligned.heading_rad[scan, first]
        return grid, heading

    @property
    def has_track(self) -> bool:
        """Whether the file knows of poses followed over time, and not of places alone."""
        return bool(np.isfinite(self.probability).any() or np.isfinite(self.heading_rad).any())


class EstimateWriter:
    """Write estimates as they come; what was written stays readable if the run is cut short."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Self:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # Line by line: after Ctrl-C the file ends with a whole row.
            self._file = self.path.open("w", encoding="utf-8", newline="", buffering=1)
            self._writer = csv.writer(self._file, lineterminator="\n")
            self._writer.writerow(_ESTIMATE_COLUMNS)
        except OSError as error:
            raise CrossLocError(f"cannot write {self.path}: {error}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()

    def write(self, estimate: Estimate, latency_ms: float | None = None) -> None:
        """Append one estimate; `latency_ms` defaults to the sum of its timings."""
        candidates = estimate.candidates
        covariance = estimate.covariance[np.triu_indices(3)]
        timings = estimate.timings
        parts = (timings.prepare_ms, timings.encode_ms, timings.search_ms, timings.align_ms, timings.fuse_ms)
        measured = parts if timings.total_ms > 0 else (math.nan,) * len(parts)
        latency = timings.total_ms if latency_ms is None else latency_ms
        row: list[str] = [
            str(estimate.stamp_ns),
            estimate.status.value,
            _number(estimate.latitude_deg, 9),
            _number(estimate.longitude_deg, 9),
            _number(estimate.altitude_m, 3),
            *(_number(value, 3) for value in estimate.grid),
            *(_number(value, 4) for value in covariance),
            # A scan that was dropped, or could not be used, has changed nothing: the state is not its own.
            estimate.state.value if math.isfinite(estimate.probability) else "",
            _number(estimate.probability, 6),
            _number(math.degrees(heading_of(estimate.T_map_base)), 4),
            _number(math.degrees(_std(estimate.pose_covariance[5, 5])), 4),
            str(estimate.counts.received),
            str(estimate.counts.in_patch),
            *(_number(value, 3) for value in measured),
            _number(latency, 3),
            " ".join(str(int(i)) for i in candidates.submap_ids),
            " ".join(f"{value:.6g}" for value in candidates.descriptor_distances),
            " ".join(f"{value:.6g}" for value in candidates.probabilities),
            " ".join(f"{value:.2f}" for value in candidates.grid[:, 0]),
            " ".join(f"{value:.2f}" for value in candidates.grid[:, 1]),
            " ".join(str(int(source)) for source in estimate.aligned.source),
            _list(estimate.aligned.log_likelihood, ".3f"),
            _list(estimate.aligned.inliers, ".3f"),
            *_pose_list(estimate.aligned),
            *_pose_list(estimate.hypotheses),
            estimate.reason,
        ]
        try:
            self._writer.writerow(row)
        except OSError as error:
            raise CrossLocError(f"cannot write {self.path}: {error}") from error


def read_estimates(path: Path) -> EstimateTable:
    """Read a file of estimates, with or without truth; CrossLocError where it is none."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise CrossLocError(f"cannot read {path}: {error}") from error
    try:
        return _table(rows)
    except (KeyError, ValueError, TypeError) as error:
        raise CrossLocError(f"{path} is not a file of estimates: {error!r}") from error


def add_truth(
    path: Path, truth_grid: Float64Array, frame: MapFrame, truth_heading_rad: Float64Array | None = None
) -> EstimateTable:
    """Add the columns of truth and error to a file of estimates and return its table.

    `truth_grid` (S, 2 or 3) easting and northing of each row, `truth_heading_rad` (S,) counter-clockwise from true
    east; NaN where unknown. The file is replaced as a whole.
    """
    table = read_estimates(path)
    headings = np.full(len(table), np.nan) if truth_heading_rad is None else truth_heading_rad
    if len(truth_grid) != len(table):
        raise CrossLocError(f"truth for {len(truth_grid)} scans does not fit the {len(table)} estimates of {path}")
    places = np.column_stack([truth_grid[:, :2], np.zeros(len(truth_grid))])
    known = np.isfinite(places).all(axis=1)
    latitude, longitude = np.full(len(table), np.nan), np.full(len(table), np.nan)
    if known.any():
        latitude[known], longitude[known], _ = frame.to_geographic(places[known])
    errors = np.hypot(*(table.grid[:, :2] - truth_grid[:, :2]).T)
    heading_errors = wrap(table.heading_rad - headings)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*_ESTIMATE_COLUMNS, *_TRUTH_COLUMNS], lineterminator="\n")
    writer.writeheader()
    for i, row in enumerate(rows):
        values = (
            _number(latitude[i], 9),
            _number(longitude[i], 9),
            _number(truth_grid[i, 0], 3),
            _number(truth_grid[i, 1], 3),
            _number(errors[i], 3),
            _number(math.degrees(headings[i]), 4),
            _number(math.degrees(heading_errors[i]), 4),
        )
        writer.writerow({**row, **dict(zip(_TRUTH_COLUMNS, values, strict=True))})
    write_atomically(path, text.getvalue())
    return read_estimates(path)


def heading_of(T_map_base: Float64Array) -> float:
    """Return the heading of a pose (4, 4), counter-clockwise from the x axis of its frame, radians; NaN of none."""
    return math.atan2(T_map_base[1, 0], T_map_base[0, 0])


def _table(rows: Sequence[dict[str, str]]) -> EstimateTable:
    count = len(rows)
    width = max((len(row["candidate_ids"].split()) for row in rows), default=0)
    ids = np.full((count, width), -1, dtype=np.int64)
    lists = {name: np.full((count, width), np.nan) for name in _CANDIDATE_COLUMNS[1:]}
    for i, row in enumerate(rows):
        found = row["candidate_ids"].split()
        ids[i, : len(found)] = [int(j) for j in found]
        for name, values in lists.items():
            values[i, : len(found)] = [float(value) for value in row[name].split()]
    covariance = np.full((count, 3, 3), np.nan)
    upper = np.triu_indices(3)
    covariance[:, upper[0], upper[1]] = covariance[:, upper[1], upper[0]] = _columns(rows, _COVARIANCE_COLUMNS)
    return EstimateTable(
        stamp_ns=np.array([int(row["stamp_ns"]) for row in rows], dtype=np.int64),
        has_fix=np.array([FixStatus(row["status"]) is FixStatus.FIX for row in rows], dtype=np.bool_),
        geographic=_columns(rows, ("latitude_deg", "longitude_deg", "altitude_m")),
        grid=_columns(rows, ("easting_m", "northing_m", "height_m")),
        covariance=covariance,
        timings_ms=_columns(rows, _TIMING_COLUMNS),
        points=np.array(
            [[int(row["points_received"]), int(row["points_in_patch"])] for row in rows], dtype=np.int64
        ).reshape(count, 2),
        candidate_ids=ids,
        candidate_distances=lists["candidate_distances"],
        candidate_probabilities=lists["candidate_probabilities"],
        candidate_grid=np.stack([lists["candidate_eastings_m"], lists["candidate_northings_m"]], axis=-1),
        truth_grid=_columns(rows, ("truth_easting_m", "truth_northing_m")),
        truth_heading_rad=np.radians(_columns(rows, ("truth_heading_deg",))[:, 0]),
        states=tuple(TrackState(row["state"]) if row.get("state") else None for row in rows),
        probability=_columns(rows, ("probability",))[:, 0],
        heading_rad=np.radians(_columns(rows, ("heading_deg",))[:, 0]),
        heading_std_rad=np.radians(_columns(rows, ("heading_std_deg",))[:, 0]),
        aligned=(aligned := _pose_lists(rows, _ALIGNED)),
        aligned_sources=_sources(rows, aligned.heading_rad.shape[1]),
        hypotheses=_pose_lists(rows, _HYPOTHESIS),
        reasons=tuple(row["reason"] for row in rows),
    )


def _columns(rows: Sequence[dict[str, str]], names: Sequence[str]) -> Float64Array:
    values = [[float(row.get(name) or "nan") for name in names] for row in rows]
    return np.array(values, dtype=np.float64).reshape(len(rows), len(names))


def _pose_list(poses: AlignedPoses | Hypotheses) -> tuple[str, ...]:
    """Return the columns `_LIST_COLUMNS` of poses."""
    covariance = poses.covariance
    stds = np.sqrt(np.maximum(covariance[:, 2, 2], 0.0))
    return (
        _list(poses.grid[:, 0], ".2f"),
        _list(poses.grid[:, 1], ".2f"),
        _list(np.degrees(poses.heading_rad), ".2f"),
        _list(covariance[:, 0, 0], ".4g"),
        _list(covariance[:, 0, 1], ".4g"),
        _list(covariance[:, 1, 1], ".4g"),
        _list(np.degrees(stds), ".3g"),
        _list(poses.probabilities, ".6g"),
    )


def _list(values: Float64Array, form: str) -> str:
    return " ".join(format(float(value), form) for value in values)


def _pose_lists(rows: Sequence[dict[str, str]], prefix: str) -> PoseLists:
    """Return the lists whose columns begin with `prefix`; empty ones where the file has none."""
    texts = [[(row.get(prefix + name) or "").split() for name in _LIST_COLUMNS] for row in rows]
    width = max((len(lists[0]) for lists in texts), default=0)
    values = np.full((len(_LIST_COLUMNS), len(rows), width), np.nan)
    for i, lists in enumerate(texts):
        for column, found in enumerate(lists):
            values[column, i, : len(lists[0])] = [float(value) for value in found]
    east, north, heading_deg, ee, en, nn, std_deg, probabilities = values
    return PoseLists(
        grid=np.stack([east, north], axis=-1),
        heading_rad=np.radians(heading_deg),
        covariance=np.stack([np.stack([ee, en], axis=-1), np.stack([en, nn], axis=-1)], axis=-1),
        heading_std_rad=np.radians(std_deg),
        probabilities=probabilities,
    )


def _sources(rows: Sequence[dict[str, str]], width: int) -> Int64Array:
    """Return where the search for each aligned pose began; the least number there is where there is no pose."""
    sources = np.full((len(rows), width), np.iinfo(np.int64).min)
    for i, row in enumerate(rows):
        found = (row.get("aligned_sources") or "").split()
        sources[i, : len(found)] = [int(source) for source in found]
    return sources


def _std(variance: float) -> float:
    return math.sqrt(variance) if variance >= 0.0 else math.nan


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
