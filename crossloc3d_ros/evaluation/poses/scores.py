"""From predictions to the figures of the pose benchmark: pure functions over `PosePredictions`.

What is counted is said at each measure. Intervals are those of `statistics`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.evaluation.poses.errors import (
    AMONG_M,
    STAGES,
    WITHIN_DEG,
    WITHIN_M,
    WRONG_M,
    best_aligned,
    distance_m,
    error_deg,
    error_m,
    is_right,
    legs_of,
    localized_before,
    mahalanobis,
)
from crossloc3d_ros.evaluation.poses.measures import Goals, Measure, Unit, goals_of
from crossloc3d_ros.evaluation.poses.predictions import SINGLE, PoseAbout, PosePredictions, number_of_alone, select
from crossloc3d_ros.evaluation.statistics import (
    clustered_quantile,
    clustered_share,
    clusters_of,
    independent_places_in_areas,
    quantile,
    reliability,
)
from crossloc3d_ros.simulation.families import HELD_OUT_FAMILIES
from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

SIGMAS = np.linspace(0.0, 4.0, 41)
_TWO_SIGMA = 0.9545
_BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 0.99, 0.999, 0.9999, 1.0)
"""Of believed probabilities; fine where it matters."""


@dataclass(frozen=True)
class Stage:
    """What the poses are worth up to one stage of the chain, on the same scans."""

    name: str
    scans: int
    within: float
    """Share within 2 m and 5 degrees."""
    within_low: float
    within_high: float
    within_10_m: float
    within_50_m: float
    median_m: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is believed against what is true."""

    name: str
    believed: Float64Array
    """(B,) mean of the probabilities in each bin that holds any."""
    right: Float64Array
    """(B,) share of them that was right."""
    count: Int64Array
    """(B,)"""


@dataclass(frozen=True, eq=False)
class PoseScores:
    """Everything that predictions are worth."""

    about: PoseAbout
    measures: tuple[Measure, ...]
    stages: tuple[Stage, ...]
    """Of the single scans on the map."""
    drive_stages: tuple[Stage, ...]
    """Of scans along drives, alone and with all that came before."""
    families: tuple[Measure, ...]
    """One scan end to end, by families seen and held out, then by family."""
    calibrations: tuple[Calibration, ...]
    inside: dict[str, Float64Array]
    """(41,) share of the errors inside of k sigma, k in `SIGMAS`, by what they are errors of."""
    errors_m: dict[str, Float64Array]
    """Horizontal errors of the single scans by stage, and of the fixes along drives; infinite where there is no
    pose."""

    def measure(self, key: str) -> Measure:
        """Return one figure."""
        for each in (*self.measures, *self.families):
            if each.key == key:
                return each
        raise KeyError(key)


def score_poses(predictions: PosePredictions, about: PoseAbout) -> PoseScores:
    """Score predictions."""
    on_map = np.array(about.on_map, np.bool_)[predictions.area]
    single = predictions.journey == SINGLE
    driven = predictions.journey >= 0
    singles = select(predictions, single & on_map)
    track = select(predictions, driven & on_map)
    away = select(predictions, (driven | single) & ~on_map)
    evaluated = select(predictions, driven | single)
    after = select(track, localized_before(track) & track.has_fix)
    goals = goals_of(about)
    measures = (
        *_single_measures(singles, goals),
        *way_measures(track, goals),
        *_after_measures(track, after, goals),
        _wrong_measure(evaluated, goals),
        sigma_measure(after, goals),
        *_away_measures(away, select(away, away.journey >= 0), goals),
        *_time_measures(predictions),
    )
    stages = {name: pose(singles) for name, pose in STAGES.items()}
    fused = {"single, " + name: distance_m(singles, pose) for name, pose in stages.items()}
    return PoseScores(
        about=about,
        measures=measures,
        stages=tuple(_stage(name, singles, pose) for name, pose in stages.items()),
        drive_stages=_drive_stages(predictions, on_map),
        families=_family_measures(singles, about),
        calibrations=_calibrations(singles, track, away),
        inside=_inside_curves(after),
        errors_m={**fused, "drive, fixes once localized": error_m(after)},
    )


def clusters(predictions: PosePredictions) -> Int64Array:
    """Return (N,) which independent piece of evidence each row belongs to; see `statistics`."""
    return clusters_of(predictions.area, predictions.truth[:, :2])


def places(predictions: PosePredictions) -> int:
    """Count the places at least 25 m apart."""
    return independent_places_in_areas(predictions.area, predictions.truth[:, :2])


def share_measure(key: str, text: str, hit: BoolArray, of: PosePredictions, counted: str, goals: Goals) -> Measure:
    """Return the share of hits (N,) among rows, with its interval."""
    share = clustered_share(hit, clusters(of), places(of))
    return goals.measure(key, text, "%", share.value, share.low, share.high, len(hit), counted)


def quantile_measure(
    key: str, text: str, unit: Unit, values: Float64Array, of: PosePredictions, q: float, counted: str, goals: Goals
) -> Measure:
    """Return a quantile of values (N,) of rows, with its interval."""
    value, low, high = clustered_quantile(values, clusters(of), q)
    return goals.measure(key, text, unit, value, low, high, len(values), counted)


def _single_measures(singles: PosePredictions, goals: Goals) -> tuple[Measure, ...]:
    nearest = np.hypot(*np.moveaxis(singles.candidates - singles.truth[:, None, :2], 2, 0))
    among = select(singles, np.asarray((nearest <= AMONG_M).any(axis=1), np.bool_))
    pose = f"pose within {WITHIN_M:g} m and {WITHIN_DEG:g}°"
    found = np.asarray((nearest <= AMONG_M).any(axis=1), np.bool_)
    return (
        share_measure("among", f"one scan, no prior: {pose}, of the scans whose true place is among the 25 candidates",
               is_right(among, best_aligned(among)), among, "scans", goals),
        share_measure("end_to_end", f"one scan, no prior, end to end: {pose}",
               is_right(singles, best_aligned(singles)), singles, "scans", goals),
        share_measure("place_found", f"… the true place is among the 25 candidates (a centre within {AMONG_M:g} m)",
               found, singles, "scans", goals),
    )  # fmt: skip


def way_measures(track: PosePredictions, goals: Goals) -> tuple[Measure, ...]:
    """Return how far robots travel until they are localized, from nothing and kidnapped."""
    legs = legs_of(track)
    right = track.has_fix & (error_m(track) <= WRONG_M)
    measures = []
    for key, text, kidnapped in (
        ("until", "travelled until localized, from nothing", False),
        ("carried", "kidnapped while running: recovered after", True),
    ):
        chosen = [rows for rows in legs if (track.leg[rows[0]] > 0) == kidnapped]
        ways = np.array([track.travelled_m[rows[right[rows].argmax()]] if right[rows].any() else np.inf
                         for rows in chosen])  # fmt: skip
        first = select(track, np.array([rows[0] for rows in chosen], np.int64))
        measures += [
            quantile_measure(f"{key}_median", f"{text}, median", "m", ways, first, 0.5, "drives", goals),
            quantile_measure(f"{key}_95", f"{text}, 95 %", "m", ways, first, 0.95, "drives", goals),
        ]
    return tuple(measures)


def _after_measures(track: PosePredictions, after: PosePredictions, goals: Goals) -> tuple[Measure, ...]:
    metres, degrees = error_m(after), error_deg(after)
    later = select(track, localized_before(track))
    return (
        quantile_measure("after_median", "afterwards: error, median", "m", metres, after, 0.5, "fixes", goals),
        quantile_measure("after_95", "afterwards: error, 95 %", "m", metres, after, 0.95, "fixes", goals),
        quantile_measure("heading_median", "heading error, median", "degrees", degrees, after, 0.5, "fixes", goals),
        quantile_measure("heading_95", "heading error, 95 %", "degrees", degrees, after, 0.95, "fixes", goals),
        share_measure("available", "scans with a fix, once localized", later.has_fix, later, "scans", goals),
    )


def _wrong_measure(evaluated: PosePredictions, goals: Goals) -> Measure:
    fixes = select(evaluated, evaluated.has_fix)
    return share_measure("wrong", f"fixes that are wrong by more than {WRONG_M:g} m", error_m(fixes) > WRONG_M, fixes,
                  "fixes", goals)  # fmt: skip


def sigma_measure(after: PosePredictions, goals: Goals) -> Measure:
    """Return the share of the errors of fixes inside of two sigma of their covariance."""
    inside = mahalanobis(after) <= -2.0 * math.log(1.0 - _TWO_SIGMA)
    return share_measure(
        "inside_2_sigma", "errors inside 2 sigma (the ellipse of 95.4 %)", inside, after, "fixes", goals
    )


def _away_measures(away: PosePredictions, driven: PosePredictions, goals: Goals) -> tuple[Measure, ...]:
    minutes = sum(np.ptp(driven.stamp_ns[rows]) for rows in legs_of(driven)) / 60e9
    fixes = float(away.has_fix.sum()) if len(away) else math.nan
    text = f"robot outside the map ({minutes:.0f} minutes of driving, and single scans): fixes given"
    return (goals.measure("away_fixes", text, "fixes", fixes, fixes, fixes, len(away), "scans"),)


def _time_measures(predictions: PosePredictions) -> tuple[Measure, ...]:
    total = predictions.milliseconds.sum(axis=1)
    median, high = quantile(total, 0.5), quantile(total, 0.95)
    return (
        Measure("scan_ms", "a scan, median", "ms", median, median, median, len(total), "scans"),
        Measure("scan_ms_95", "a scan, 95 %", "ms", high, high, high, len(total), "scans"),
    )


def _stage(name: str, of: PosePredictions, pose: Float64Array) -> Stage:
    metres = distance_m(of, pose)
    share = clustered_share(is_right(of, pose), clusters(of), places(of))
    middle = float(np.median(metres)) if len(metres) else math.nan
    near, far = (float(np.mean(metres <= radius)) if len(metres) else math.nan for radius in (10.0, 50.0))
    return Stage(name, len(of), share.value, share.low, share.high, near, far, middle)


def _drive_stages(predictions: PosePredictions, on_map: BoolArray) -> tuple[Stage, ...]:
    """Compare scans of drives that were localized alone with the estimate along the drive at the same moment."""
    number = number_of_alone(predictions)
    alone = np.flatnonzero((number >= 0) & on_map)
    at = {
        (int(j), int(t)): i
        for i, (j, t) in enumerate(zip(predictions.journey, predictions.stamp_ns, strict=True))
        if j >= 0
    }
    pairs = [(row, at[key]) for row in alone if (key := (int(number[row]), int(predictions.stamp_ns[row]))) in at]
    if not pairs:
        return ()
    lonely = select(predictions, np.array([pair[0] for pair in pairs], np.int64))
    tracked = select(predictions, np.array([pair[1] for pair in pairs], np.int64))
    stages = [_stage(name, lonely, pose(lonely)) for name, pose in STAGES.items()]
    stages.append(_stage("+ fusion, from the first scan on", tracked, tracked.pose[:, [0, 1, 3]]))
    fixed = select(tracked, tracked.has_fix)
    stages.append(_stage("+ fusion, where a fix is given", fixed, fixed.pose[:, [0, 1, 3]]))
    return tuple(stages)


def _family_measures(singles: PosePredictions, about: PoseAbout) -> tuple[Measure, ...]:
    family = np.array(about.families)[singles.area] if len(singles) else np.empty(0, str)
    held_out = np.isin(family, HELD_OUT_FAMILIES)
    group = np.array(about.groups)[singles.group] if len(singles) else np.empty(0, str)
    divisions: list[tuple[str, BoolArray]] = []
    if held_out.any() and not held_out.all():
        divisions += [("families seen in training", ~held_out), ("held-out families", held_out)]
    if len(about.groups) > 1:
        divisions += [(name, np.asarray(group == name, np.bool_)) for name in about.groups]
    if len(set(about.families)) > 1:
        divisions += [(name, np.asarray(family == name, np.bool_)) for name in dict.fromkeys(about.families)]
    measures = []
    for name, chosen in divisions:
        of = select(singles, chosen)
        if len(of):
            measures.append(
                share_measure(f"end_to_end/{name}", name, is_right(of, best_aligned(of)), of, "scans", Goals({}))
            )
    return tuple(measures)


def calibration_of(name: str, believed: Float64Array, right: BoolArray) -> Calibration:
    """Compare probabilities (N,) with what was right (N,), in bins; NaN counts as no belief at all."""
    bins = reliability(np.where(np.isfinite(believed), believed, 0.0), right, _BINS)
    return Calibration(
        name,
        np.array([each.mean_belief for each in bins]),
        np.array([each.right.value for each in bins]),
        np.array([each.scans for each in bins], np.int64),
    )


def _calibrations(singles: PosePredictions, track: PosePredictions, away: PosePredictions) -> tuple[Calibration, ...]:
    """Compare belief and truth; off the map nothing is right."""
    lonely = select(away, away.journey == SINGLE)
    driven = select(away, away.journey >= 0)
    nothing = np.zeros(len(lonely), np.bool_)
    near = distance_m(singles, best_aligned(singles)) <= WRONG_M
    return (
        calibration_of(
            "one scan: the best pose, within 10 m",
            np.concatenate([singles.aligned_probability[:, 0], lonely.aligned_probability[:, 0]]),
            np.concatenate([near, nothing]),
        ),
        calibration_of(
            "drives: the pose that is followed, within 10 m",
            np.concatenate([track.probability, driven.probability]),
            np.concatenate([error_m(track) <= WRONG_M, np.zeros(len(driven), np.bool_)]),
        ),
    )


def _inside_curves(after: PosePredictions) -> dict[str, Float64Array]:
    """Return the share of the errors inside of k sigma: of the position by its ellipse, of the heading by its sigma."""
    if not len(after):
        return {}
    position = np.sqrt(mahalanobis(after))
    with np.errstate(invalid="ignore", divide="ignore"):
        heading = np.radians(error_deg(after)) / np.sqrt(after.covariance[:, 2, 2])
    heading = np.where(np.isfinite(heading), heading, np.inf)
    return {
        "position": np.array([np.mean(position <= k) for k in SIGMAS]),
        "heading": np.array([np.mean(heading <= k) for k in SIGMAS]),
    }


def expected_inside(name: str) -> Float64Array:
    """Return (41,) what share an honest covariance would have inside of k sigma: chi with two degrees, or with one."""
    if name == "position":
        return np.asarray(1.0 - np.exp(-0.5 * SIGMAS**2))
    return np.array([math.erf(k / math.sqrt(2.0)) for k in SIGMAS])
