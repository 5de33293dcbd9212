"""From predictions to the figures of the belief benchmark: pure functions over `BeliefPredictions`.

Rows on maps or of scans that something was learned on are scored and shown, and counted in no total but that of fixes
off the map, which is given without them too. Intervals are those of `statistics`; where nothing was counted, the upper
end is that of the rule of three.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.evaluation.belief.goals import LEAST_PLACES, OFF_MAP_SCANS, ON_MAP_FIXES, goals_of
from crossloc3d_ros.evaluation.belief.predictions import BeliefAbout, BeliefPredictions
from crossloc3d_ros.evaluation.poses.errors import (
    WITHIN_DEG,
    WITHIN_M,
    WRONG_M,
    best_aligned,
    distance_m,
    error_m,
    is_right,
    localized_before,
)
from crossloc3d_ros.evaluation.poses.measures import Goals, Measure
from crossloc3d_ros.evaluation.poses.predictions import SINGLE, PosePredictions, select
from crossloc3d_ros.evaluation.poses.scores import (
    Calibration,
    clusters,
    places,
    share_measure,
    sigma_measure,
    way_measures,
)
from crossloc3d_ros.evaluation.statistics import clustered_calibration_error, reliability, rule_of_three
from crossloc3d_ros.types import BoolArray, Float64Array

SURE = 0.99
BINS = 10
_SCORE_TOLERANCE = 0.01
"""A score that is higher by less is that of the same maximum, where another climb ended a step beside."""
ORDER = ("right", "sure", "calibration", "lost", "until_median", "until_95", "without_fix", "inside_2_sigma", "wrong")
"""Of the measures of a set."""


@dataclass(frozen=True, eq=False)
class SetScores:
    """One set on its own map under one condition."""

    set_name: str
    condition: str
    is_learned: bool
    singles: int
    fixes: int
    measures: dict[str, Measure]
    """By the keys of `ORDER`."""
    calibration: Calibration
    """Of single scans, in `BINS` equal bins."""

    @property
    def name(self) -> str:
        """The set and the condition."""
        return f"{self.set_name}, {self.condition}"


@dataclass(frozen=True)
class PairScores:
    """Drives of one set, or one of them, on a map that they are not on."""

    map_name: str
    set_name: str
    drive: str
    is_learned: bool
    """Whether something was learned on the survey of the map or on that of the scans."""
    scans: int
    fixes: int
    sure: int
    """Scans at which the pose that is followed is believed by more than `SURE`."""
    sure_alone: int
    """Scans that are so sure of their best pose by themselves."""
    most_believed: float
    """The largest probability of a pose that is followed."""


@dataclass(frozen=True, eq=False)
class BeliefScores:
    """Everything that predictions are worth."""

    about: BeliefAbout
    missing: int
    """Pieces that were not made yet."""
    measures: tuple[Measure, ...]
    """The totals, then every measure of a set that has a goal."""
    sets: tuple[SetScores, ...]
    pairs: tuple[PairScores, ...]
    """By map and drive."""
    maps: tuple[PairScores, ...]
    """By map and set."""


def score_belief(predictions: BeliefPredictions, about: BeliefAbout) -> BeliefScores:
    """Score predictions."""
    pieces = predictions.pieces
    on_map = np.array([piece.is_on_map for piece in pieces])[predictions.piece]
    learned = np.array([piece.is_learned for piece in pieces])[predictions.piece]
    sets = tuple(_sets(predictions, on_map))
    drives, maps = _pairs(predictions, by_drive=True), _pairs(predictions, by_drive=False)
    totals = (*_off_map_measures(predictions, ~on_map, learned), *_wrong_measures(predictions, on_map & ~learned))
    wanted = (each.measures[key] for key in ORDER for each in sets if key in each.measures)
    return BeliefScores(
        about, predictions.missing, (*totals, *(each for each in wanted if each.goal is not None)), sets, drives, maps
    )


def belief_alone(rows: PosePredictions) -> Float64Array:
    """Return (N,) what a scan by itself believes of its best pose: all of its poses within 10 m of it count."""
    offsets = rows.aligned[:, :, :2] - rows.aligned[:, :1, :2]
    near = np.hypot(offsets[:, :, 0], offsets[:, :, 1]) <= WRONG_M
    believed = np.where(near & np.isfinite(rows.aligned_probability), rows.aligned_probability, 0.0)
    return np.asarray(np.clip(believed.sum(axis=1), 0.0, 1.0))


def is_lost(rows: PosePredictions, climbed: Float64Array) -> BoolArray:
    """Say (N,) whether the answer is wrong and a pose refined from the truth scores higher.

    `climbed` (N, 2): log likelihoods of the two. Without an answer any score of the truth is higher.
    """
    answer = np.where(np.isnan(climbed[:, 1]), -np.inf, climbed[:, 1])
    higher = climbed[:, 0] > answer + _SCORE_TOLERANCE
    return np.asarray(higher & ~is_right(rows, best_aligned(rows)), np.bool_)


def _sets(predictions: BeliefPredictions, on_map: BoolArray) -> Iterable[SetScores]:
    keys = [(piece.set_name, piece.condition, piece.is_learned) for piece in predictions.pieces]
    for key in dict.fromkeys(key for key, piece in zip(keys, predictions.pieces, strict=True) if piece.is_on_map):
        chosen = on_map & np.array([each == key for each in keys])[predictions.piece]
        rows = select(predictions.rows, chosen)
        yield _set_scores(*key, rows, predictions.climbed[chosen])


def _set_scores(name: str, condition: str, is_learned: bool, rows: PosePredictions, climbed: Float64Array) -> SetScores:
    goals = goals_of(name, condition, is_learned=is_learned)
    single = rows.journey == SINGLE
    singles, track = select(rows, single), select(rows, ~single)
    found = (
        *_single_measures(singles, climbed[single], goals),
        *(each for each in way_measures(track, goals) if each.key.startswith("until") or each.count),
        *_track_measures(track, goals),
    )
    measures = {each.key: dataclasses.replace(each, text=f"{name}, {condition}: {each.text}") for each in found}
    near = distance_m(singles, best_aligned(singles)) <= WRONG_M
    bins = reliability(belief_alone(singles), near, np.linspace(0.0, 1.0, BINS + 1).tolist())
    calibration = Calibration(
        f"{name}, {condition}",
        np.array([each.mean_belief for each in bins]),
        np.array([each.right.value for each in bins]),
        np.array([each.scans for each in bins], np.int64),
    )
    return SetScores(name, condition, is_learned, len(singles), int(track.has_fix.sum()), measures, calibration)


def _single_measures(singles: PosePredictions, climbed: Float64Array, goals: Goals) -> tuple[Measure, ...]:
    best, believed = best_aligned(singles), belief_alone(singles)
    near = np.asarray(distance_m(singles, best) <= WRONG_M, np.bool_)
    known = select(singles, near)
    error = clustered_calibration_error(believed, near, clusters(singles), BINS)
    return (
        share_measure("right", f"one scan within {WITHIN_M:g} m and {WITHIN_DEG:g}°", is_right(singles, best), singles,
                      "scans", goals),
        share_measure("sure", f"right single scans believed above {100 * SURE:g} %", believed[near] > SURE, known,
                      "scans", goals),
        goals.measure("calibration", "expected calibration error of single scans", "%", error.value, error.low,
                      error.high, len(singles), "scans"),
        share_measure("lost", "a pose refined from the truth scores higher than the wrong answer",
                      is_lost(singles, climbed), singles, "scans", goals),
    )  # fmt: skip


def _track_measures(track: PosePredictions, goals: Goals) -> tuple[Measure, ...]:
    known = localized_before(track)
    later, after = select(track, known), select(track, known & track.has_fix)
    fixes = select(track, track.has_fix)
    return (
        share_measure("without_fix", "scans without a fix, once localized", ~later.has_fix, later, "scans", goals),
        sigma_measure(after, goals),
        _bounded("wrong", f"fixes wrong by more than {WRONG_M:g} m", _is_wrong(fixes), fixes, "fixes", places(fixes)),
    )


def _is_wrong(fixes: PosePredictions) -> BoolArray:
    return np.asarray(error_m(fixes) > WRONG_M, np.bool_)


def _bounded(key: str, text: str, hit: BoolArray, rows: PosePredictions, counted: str, trials: int) -> Measure:
    """Return a share that should be zero; where it is, its upper end is the rule of three's for so many trials."""
    share = share_measure(key, text, hit, rows, counted, Goals({}))
    return share if hit.any() or not len(hit) else dataclasses.replace(share, low=0.0, high=rule_of_three(trials))


def _wrong_measures(predictions: BeliefPredictions, chosen: BoolArray) -> tuple[Measure, ...]:
    """Count wrong fixes on the maps, over all sets and conditions."""
    fixes = select(predictions.rows, chosen & predictions.rows.has_fix)
    wrong, where = _is_wrong(fixes), places(fixes)
    text = f"on the map: fixes wrong by more than {WRONG_M:g} m"
    number = float(wrong.sum()) if len(fixes) else math.nan
    enough = where >= LEAST_PLACES
    return (
        Measure("wrong", f"{text} ({where:,} places)", "fixes", number, number, number, len(fixes), "fixes",
                floor=0.0, goal=0.0, higher_is_better=False,
                floor_count=ON_MAP_FIXES[0] if enough else len(fixes) + 1,
                goal_count=ON_MAP_FIXES[1] if enough else len(fixes) + 1),
        _bounded("wrong_share", "… as a share of the fixes", wrong, fixes, "fixes", where),
    )  # fmt: skip


def _off_map_measures(predictions: BeliefPredictions, off_map: BoolArray, learned: BoolArray) -> tuple[Measure, ...]:
    """Count fixes off the map: a place on one map is one trial, on another map another."""
    numbers = {name: i for i, name in enumerate(dict.fromkeys(piece.map_name for piece in predictions.pieces))}
    number = np.array([numbers[piece.map_name] for piece in predictions.pieces])[predictions.piece]
    area = predictions.rows.area + number * (int(predictions.rows.area.max()) + 1)
    rows = select(dataclasses.replace(predictions.rows, area=area), off_map)
    pairs = len(set(predictions.piece[off_map].tolist()))
    believed = np.nan_to_num(rows.probability) > SURE
    unlearned = select(rows, ~learned[off_map])

    def counted(key: str, text: str, hit: BoolArray) -> Measure:
        value = float(hit.sum()) if len(hit) else math.nan
        return Measure(key, text, "scans", value, value, value, len(hit), "scans")

    total = counted("away", f"off the map, {pairs:,} pairs of map and drive: scans with a fix", rows.has_fix)
    return (
        dataclasses.replace(total, floor=0.0, goal=0.0, higher_is_better=False, floor_count=OFF_MAP_SCANS[0],
                            goal_count=OFF_MAP_SCANS[1]),
        _bounded("away_share", "… as a share of the scans", rows.has_fix, rows, "scans", places(rows)),
        counted("away_unlearned", "… on surveys that nothing was learned on", unlearned.has_fix),
        counted("away_sure", f"… scans whose pose is believed above {100 * SURE:g} %", believed),
    )  # fmt: skip


def _pairs(predictions: BeliefPredictions, *, by_drive: bool) -> tuple[PairScores, ...]:
    """Return the figures off the map, by map and drive, or by map and set."""
    keys = [
        (piece.map_name, piece.set_name, piece.drive if by_drive else "", piece.is_learned)
        for piece in predictions.pieces
    ]
    pairs = []
    for key in dict.fromkeys(key for key, piece in zip(keys, predictions.pieces, strict=True) if not piece.is_on_map):
        chosen = np.array([each == key and not p.is_on_map for each, p in zip(keys, predictions.pieces, strict=True)])[
            predictions.piece
        ]
        rows = select(predictions.rows, chosen)
        believed = np.nan_to_num(rows.probability)
        pairs.append(
            PairScores(
                *key, len(rows), int(rows.has_fix.sum()), int((believed > SURE).sum()),
                int((belief_alone(rows) > SURE).sum()), float(believed.max(initial=0.0)),
            )
        )  # fmt: skip
    return tuple(sorted(pairs, key=lambda pair: (-pair.fixes, -pair.most_believed)))
