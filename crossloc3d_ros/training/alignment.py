"""Learn what air and ground have in common, and what a score of it means, from simulated towns of known poses.

First the log likelihood ratios: how often a beam was returned from a cell, by what the aerial map shows there, and how
often beams come inside of what the map shows closed, at true poses and at others. Then the calibration: every scan is
aligned on the whole map, and the scores of its best poses, right, wrong or off the map, calibrate the probability of a
score.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.angles import wrap
from crossloc3d_ros.clouds.scan import PreparedScan, prepare_scan
from crossloc3d_ros.config import AlignmentConfig, PreprocessingConfig, ScanConfig
from crossloc3d_ros.datasets.pose_sets import PoseSet
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.localization.alignment.aligner import Aligner, fine_counts
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, Evidence, evidence_of
from crossloc3d_ros.localization.alignment.likelihood import MapLikelihood
from crossloc3d_ros.localization.alignment.observation_model import (
    CLASSES,
    OPEN_GROUND,
    ObservationModel,
    fit_log_ratios,
)
from crossloc3d_ros.types import AlignedPoses, Float64Array, no_candidates

RIGHT_M, RIGHT_RAD = 2.0, math.radians(5.0)
"""A pose is right within these."""

_OTHERS = 8  # wrong poses that the evidence of each scan is counted at

Progress = Callable[[str, float, float, str], None]


@dataclass(frozen=True, eq=False)
class ScoredPoses:
    """The scores of the best poses of one scan."""

    scores: Float64Array
    """(p,) nats, before the calibration."""
    expected: float
    """Score to be expected at the true pose."""
    right: int | None
    """Which of them is right; None: none is, or the scan is from off the map."""
    log_prior: float


def fit_alignment(
    pose_set: PoseSet, config: AlignmentConfig | None = None, progress: Progress | None = None
) -> tuple[ObservationModel, list[ScoredPoses]]:
    """Return the observation model learned from a pose set, and the scores that its calibration was fitted to.

    The set needs scans on its map and off it; TrainingError otherwise.
    """
    report = progress or (lambda stage, done, total, unit: None)
    on_map = [scan for scan in pose_set.scans if pose_set.on_map[scan.area]]
    if not on_map or len(on_map) == len(pose_set.scans):
        raise TrainingError("an alignment is learned from scans on the map and off it; the set holds one kind only")
    aerial_map = AerialMap.load(pose_set.map_folder)
    fitted = fit_log_ratios(*_seen(aerial_map, on_map, report))
    model = ObservationModel(*fitted, expected_share=0.0, temperature=1.0)
    aligner = Aligner(aerial_map, config or AlignmentConfig(), model)
    scored = []
    for i, scan in enumerate(pose_set.scans):
        poses = _scored_poses(aligner, scan, bool(pose_set.on_map[scan.area]))
        if poses is not None:
            scored.append(poses)
        report("aligning", i + 1, len(pose_set.scans), "scans")
    share, temperature = calibrate(scored)
    return dataclasses.replace(model, expected_share=share, temperature=temperature), scored


def calibrate(scored: Sequence[ScoredPoses]) -> tuple[float, float]:
    """Return share of the expected score and temperature that make the right poses likeliest."""

    def loss(x: Float64Array) -> float:
        share, temperature = x[0], math.exp(x[1])
        total = 0.0
        for poses in scored:
            log_odds = (poses.scores - share * poses.expected) / temperature + poses.log_prior
            everything = np.logaddexp(0.0, np.logaddexp.reduce(log_odds)) if len(log_odds) else 0.0
            total += everything - (0.0 if poses.right is None else log_odds[poses.right])
        return float(total)

    best = min(
        (minimize(loss, [share, math.log(t)], method="Nelder-Mead") for share in (0.4, 0.6) for t in (5.0, 20.0)),
        key=lambda result: float(result.fun),
    )
    return float(best.x[0]), float(math.exp(best.x[1]))


def prepared_of(scan: RawScan) -> PreparedScan:
    """Return a raw scan as the localizer prepares it."""
    return prepare_scan(scan.as_scan(), ScanConfig(), PreprocessingConfig(), scan.up_base, scan.T_base_lidar)


def is_right(aligned: AlignedPoses, scan: RawScan) -> np.ndarray:
    """Return which aligned poses (p,) are those of the scan."""
    away = np.hypot(*(aligned.grid[:, :2] - scan.T_grid_base[:2, 3]).T)
    rotation = np.abs(wrap(aligned.heading_rad - scan.heading_rad))
    return np.asarray((away <= RIGHT_M) & (rotation <= RIGHT_RAD))


def _seen(aerial_map: AerialMap, scans: Sequence[RawScan], report: Progress) -> tuple[Float64Array, Float64Array]:
    """Count (CHANNELS, CLASSES) on which classes the evidence of scans falls at their true poses, and at others."""
    ratios = np.zeros((CHANNELS, CLASSES), np.float32)
    nothing = ObservationModel(ratios, ratios, np.zeros(CHANNELS))
    likelihood = MapLikelihood(aerial_map, nothing)
    likelihood.prepare()
    rng = np.random.default_rng(0)
    at_true, at_others = np.zeros((CHANNELS, CLASSES)), np.zeros((CHANNELS, CLASSES))
    others = _places(likelihood)
    for i, scan in enumerate(scans):
        prepared, T = prepared_of(scan), scan.T_base_lidar
        evidence = evidence_of(prepared.place, prepared.sensor_height_m, (float(T[0, 3]), float(T[1, 3])))
        true = np.append(scan.T_grid_base[:2, 3] - [likelihood.west_m, likelihood.south_m], scan.heading_rad)
        _lay(evidence, likelihood, true, at_true)
        for place in others[rng.integers(0, len(others), _OTHERS)]:
            _lay(evidence, likelihood, np.append(place, rng.uniform(-math.pi, math.pi)), at_others)
        report("learning", i + 1, len(scans), "scans")
    return at_true, at_others


def _places(likelihood: MapLikelihood) -> Float64Array:
    """Return the places (n, 2) where a robot could stand: middles of cells of open ground."""
    rows, columns = np.nonzero(likelihood.classes == OPEN_GROUND)
    west, south, east, north = likelihood.aerial_map.bounds
    x, y = columns + 0.5, rows + 0.5
    on_map = (x > west - likelihood.west_m) & (x < east - likelihood.west_m)
    on_map &= (y > south - likelihood.south_m) & (y < north - likelihood.south_m)
    return np.column_stack([x, y])[on_map]


def _lay(evidence: Evidence, likelihood: MapLikelihood, pose: Float64Array, counts: Float64Array) -> None:
    """Count (CHANNELS, CLASSES) on which classes the evidence falls at a pose (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = (pose[:2] + evidence.xy_m @ np.array([[c, s], [-s, c]])).T
    classes = likelihood.classes[np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)]
    np.add.at(counts, (evidence.channel, classes), 1.0)


def _scored_poses(aligner: Aligner, scan: RawScan, on_map: bool) -> ScoredPoses | None:
    """Search the whole map for one scan; None where it cannot be aligned."""
    prepared, T = prepared_of(scan), scan.T_base_lidar
    sensor_xy = float(T[0, 3]), float(T[1, 3])
    aligned = aligner.align(prepared, sensor_xy, no_candidates(), search_map=True)
    if not len(aligned):
        return None
    expected = float(aligner.model.expected @ fine_counts(prepared, sensor_xy))
    right = np.flatnonzero(is_right(aligned, scan)) if on_map else np.empty(0, np.int64)
    # The model's calibration is neutral here: log likelihoods are scores.
    return ScoredPoses(aligned.log_likelihood, expected, int(right[0]) if len(right) else None, aligned.log_prior)
