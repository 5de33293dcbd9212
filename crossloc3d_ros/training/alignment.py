"""Learn what air and ground have in common, and what a score of it means, from scans of known poses.

First the log likelihood ratios: how often a beam hits something in a cell, by what the aerial map shows there, and how
often beams come inside of what the map shows closed, at true poses and at others. Then the weights of the measures by
which `alignment.local_null` compares a score with that of a scan from elsewhere: every scan is aligned on the whole
map, and the measures of its best poses, right, wrong or off the map, are fitted as a conditional logit beside the null
hypothesis.

Both are learned from several maps: simulated towns with surveys of several densities, and real surveys. For the
weights, each fold is aligned with log ratios that were learned without it: so they are those of places that nothing was
learned from, and of kinds of surveys that were never seen.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.evaluation.poses.errors import right_aligned
from crossloc3d_ros.localization.alignment.aligner import Aligner
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS, Evidence
from crossloc3d_ros.localization.alignment.likelihood import MapLikelihood
from crossloc3d_ros.localization.alignment.observation_model import (
    CLASSES,
    HOLE,
    MEASURES,
    OPEN_GROUND,
    PATTERNS,
    ObservationModel,
    fit_log_ratios,
)
from crossloc3d_ros.training.queries import Query
from crossloc3d_ros.types import AlignedPoses, BoolArray, Float64Array, Int64Array, no_candidates

NEAR_M = 10.0
"""A pose that is not right but as near as this teaches neither."""

_OTHERS = 8  # wrong poses that the evidence of each scan is counted at
_POSES = 16  # of each scan that the weights are fitted to: the worse ones decide nothing
_RIDGE = 0.01  # of the standardized weights: measures that say the same share their weight
_INITIAL = (6.0, 7.0, 5.0, 4.0, 4.0, -3.0)  # weights before any are learned, for the order of the poses alone

Progress = Callable[[str, float, float, str], None]


@dataclass(frozen=True, eq=False)
class LearningSet:
    """A map, and queries that were taken on it and off it: scans, and local maps of several."""

    name: str
    fold: str
    """Sets of one fold show the same places."""
    map_folder: Path
    on_map: Sequence[Query]
    off_map: Sequence[Query] = ()


@dataclass(frozen=True, eq=False)
class MeasuredPoses:
    """The best poses of one scan."""

    set_name: str
    measures: Float64Array
    """(p, M) see `MEASURES`."""
    right: int | None
    """Which of them is right; None: none is, or the scan is from off the map."""
    log_prior: float


def fit_alignment(
    sets: Sequence[LearningSet], config: AlignmentConfig | None = None, progress: Progress | None = None
) -> tuple[ObservationModel, list[MeasuredPoses]]:
    """Return the observation model learned from sets, and the poses that its weights were fitted to.

    TrainingError where there are not two folds with scans on their maps, or no scan off its map.
    """
    report = progress or (lambda stage, done, total, unit: None)
    folds = sorted({each.fold for each in sets if len(each.on_map)})
    if len(folds) < 2 or not any(len(each.off_map) for each in sets):
        raise TrainingError("an alignment is learned from two folds of scans on their maps, and scans off them")
    seen = _seen_by_fold(sets, report)
    everything = _sum(seen.values())
    measured: list[MeasuredPoses] = []
    total = sum(len(each.on_map) + len(each.off_map) for each in sets)
    done = 0
    for fold, of_fold in _by_fold(sets).items():
        others = [counts for name, counts in seen.items() if name != fold]
        model = _model(_sum(others), np.array(_INITIAL))
        for each in of_fold:
            with closing(Aligner(AerialMap.load(each.map_folder), config or AlignmentConfig(), model)) as aligner:
                for query, on_map in _queries(each):
                    poses = _measured_poses(each.name, aligner, query, on_map)
                    measured += [] if poses is None else [poses]
                    done += 1
                    report("aligning", done, total, "scans")
    return _model(everything, fit_weights(measured)), measured


def fit_weights(measured: Sequence[MeasuredPoses]) -> Float64Array:
    """Return the weights (M + 1,) under which the right poses are likeliest: none is negative but for the constant.

    A conditional logit: log odds of pose i to the null hypothesis are weights . measures + constant + log prior. Each
    set counts by the square root of its scans, so that no large one decides alone. Raises TrainingError where no
    pose is right.
    """
    some = [poses for poses in measured if len(poses.measures)]
    if not any(poses.right is not None for poses in some):
        raise TrainingError("no scan was found on its map: are the scans' poses those of the maps?")
    measures = np.concatenate([poses.measures for poses in some])
    scan = np.repeat(np.arange(len(some)), [len(poses.measures) for poses in some])
    prior = np.array([poses.log_prior for poses in some])[scan]
    right = _right_rows(some)
    sizes = {poses.set_name: 0 for poses in some}
    for poses in some:
        sizes[poses.set_name] += 1
    share = np.array([1.0 / math.sqrt(sizes[poses.set_name]) for poses in some])
    middle, spread = measures.mean(axis=0), np.maximum(measures.std(axis=0), 1e-9)
    standardized = np.column_stack([(measures - middle) / spread, np.ones(len(measures))])

    def loss(weights: Float64Array) -> tuple[float, Float64Array]:
        log_odds = standardized @ weights + prior
        largest = np.zeros(len(some))
        np.maximum.at(largest, scan, log_odds)
        odds = np.exp(log_odds - largest[scan])
        everything = np.exp(-largest) + np.bincount(scan, odds, len(some))
        value = share @ (largest + np.log(everything)) - share[scan[right]] @ log_odds[right]
        off = share[scan] * (odds / everything[scan] - right)
        ridge = _RIDGE * np.append(weights[:-1], 0.0)
        return float(value + 0.5 * ridge @ weights), standardized.T @ off + ridge

    bounds = [(0.0, None)] * measures.shape[1] + [(None, None)]
    found = minimize(loss, np.zeros(len(bounds)), jac=True, method="L-BFGS-B", bounds=bounds).x
    weights = found[:-1] / spread
    return np.append(weights, found[-1] - weights @ middle)


def is_right(aligned: AlignedPoses, query: Query) -> BoolArray:
    """Return which aligned poses (p,) are those of the query."""
    return right_aligned(aligned, np.append(query.T_grid_base[:2, 3], query.heading_rad))


def _away(aligned: AlignedPoses, query: Query) -> Float64Array:
    return np.asarray(np.hypot(*(aligned.grid[:, :2] - query.T_grid_base[:2, 3]).T))


def _right_rows(some: Sequence[MeasuredPoses]) -> BoolArray:
    rows = []
    for poses in some:
        is_its = np.zeros(len(poses.measures), np.bool_)
        if poses.right is not None:
            is_its[poses.right] = True
        rows.append(is_its)
    return np.concatenate(rows)


def _by_fold(sets: Sequence[LearningSet]) -> dict[str, list[LearningSet]]:
    folds: dict[str, list[LearningSet]] = {}
    for each in sets:
        folds.setdefault(each.fold, []).append(each)
    return folds


def _queries(learned: LearningSet) -> Iterator[tuple[Query, bool]]:
    yield from ((query, True) for query in learned.on_map)
    yield from ((query, False) for query in learned.off_map)


def _sum(counts: Iterable[Float64Array]) -> Float64Array:
    return functools.reduce(np.add, counts)


def _model(counts: Float64Array, weights: Float64Array) -> ObservationModel:
    return ObservationModel(*fit_log_ratios(*counts), weights)


def _seen_by_fold(sets: Sequence[LearningSet], report: Progress) -> Mapping[str, Float64Array]:
    """Count (2, CHANNELS, CLASSES) on which classes the evidence of each fold falls at true poses, and at others.

    A set counts by the square root of its scans.
    """
    counts: dict[str, Float64Array] = {}
    total, done = sum(len(each.on_map) for each in sets), 0
    for each in sets:
        if not len(each.on_map):
            continue
        likelihood = _bare_likelihood(each.map_folder)
        seen = np.zeros((2, CHANNELS, CLASSES))
        others = _places(likelihood)
        rng = np.random.default_rng(0)
        for query in each.on_map:
            evidence = query.evidence
            true = np.append(query.T_grid_base[:2, 3] - [likelihood.west_m, likelihood.south_m], query.heading_rad)
            _lay(evidence, likelihood, true, seen[0])
            # A map without open ground says nothing of other places.
            for place in others[rng.integers(0, len(others), _OTHERS)] if len(others) else others:
                _lay(evidence, likelihood, np.append(place, rng.uniform(-math.pi, math.pi)), seen[1])
            done += 1
            report("learning", done, total, "scans")
        seen /= math.sqrt(len(each.on_map))
        counts[each.fold] = counts[each.fold] + seen if each.fold in counts else seen
    return counts


def _bare_likelihood(map_folder: Path) -> MapLikelihood:
    nothing = np.zeros((CHANNELS, CLASSES), np.float32)
    model = ObservationModel(nothing, nothing, np.full(LAYERS, 0.5), np.zeros(len(MEASURES) + 1))
    likelihood = MapLikelihood(AerialMap.load(map_folder), model)
    likelihood.prepare()
    return likelihood


def _places(likelihood: MapLikelihood) -> Float64Array:
    """Return the places (n, 2) where a robot could stand: middles of cells of open ground."""
    classes = likelihood.classes
    rows, columns = np.nonzero((classes < HOLE) & (classes % PATTERNS == OPEN_GROUND))
    west, south, east, north = likelihood.aerial_map.bounds
    x, y = columns + 0.5, rows + 0.5
    on_map = (x > west - likelihood.west_m) & (x < east - likelihood.west_m)
    on_map &= (y > south - likelihood.south_m) & (y < north - likelihood.south_m)
    return np.column_stack([x, y])[on_map]


def _lay(evidence: Evidence, likelihood: MapLikelihood, pose: Float64Array, counts: Float64Array) -> None:
    """Count (CHANNELS, CLASSES) on which classes the evidence falls at a pose (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = np.floor(pose[:2] + evidence.xy_m @ np.array([[c, s], [-s, c]])).astype(np.int64).T
    rows, columns = likelihood.classes.shape
    inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    np.add.at(counts, (evidence.channel[inside], likelihood.classes[y[inside], x[inside]]), 1.0)


def _measured_poses(name: str, aligner: Aligner, query: Query, on_map: bool) -> MeasuredPoses | None:
    """Search the whole map for one query; None where it cannot be aligned."""
    alignment = aligner.begin(query.evidence, no_candidates())
    if alignment is None:
        return None
    alignment.search_map()
    aligned, measures = alignment.measured()
    kept: Int64Array = np.arange(len(aligned))
    right = np.empty(0, np.int64)
    if on_map:
        is_its = is_right(aligned, query)
        kept = np.flatnonzero(is_its | (_away(aligned, query) >= NEAR_M))
        right = np.flatnonzero(is_its[kept])
        kept = np.delete(kept, right[1:])  # one pose of the robot is enough
    if len(right) and right[0] >= _POSES:
        kept[_POSES - 1], right = kept[right[0]], np.array([_POSES - 1])
    kept = kept[:_POSES]
    return MeasuredPoses(name, measures[kept], int(right[0]) if len(right) else None, aligned.log_prior)
