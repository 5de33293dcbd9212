"""Learn what air and ground have in common, and what a score of it means, from simulated towns of known poses.

First the log likelihood ratios: how often a beam was returned from a cell, by what the aerial map shows there. Then the
calibration: every scan is sought on the whole map, and what its best poses scored, right, wrong or off the map, tells
which score to believe.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from crossloc3d_ros.clouds.scan import PreparedScan, prepare_scan
from crossloc3d_ros.config import AlignmentConfig, PreprocessingConfig, ScanConfig
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.evaluation.pose_sets import PoseSet
from crossloc3d_ros.evaluation.raw_scans import RawScan
from crossloc3d_ros.localization.alignment import Aligner, fine_counts
from crossloc3d_ros.localization.evidence import CHANNELS, evidence_of
from crossloc3d_ros.localization.likelihood import MapLikelihood
from crossloc3d_ros.localization.observation_model import CLASSES, ObservationModel, fit_log_ratios
from crossloc3d_ros.places.store import AerialMap
from crossloc3d_ros.types import AlignedPoses, Float64Array, no_candidates

RIGHT_M, RIGHT_RAD = 2.0, math.radians(5.0)
"""A pose is right within these."""

Progress = Callable[[str, float, float, str], None]


@dataclass(frozen=True, eq=False)
class Answer:
    """What the best poses of one scan scored."""

    scores: Float64Array
    """(p,) nats, before the calibration."""
    expected: float
    """Score to be expected at the true pose."""
    right: int | None
    """Which of them is right; None: none is, or the scan is from off the map."""
    log_prior: float


def fit_alignment(
    pose_set: PoseSet, config: AlignmentConfig | None = None, progress: Progress | None = None
) -> tuple[ObservationModel, list[Answer]]:
    """Return the observation model that a pose set teaches, and the answers that its calibration was fitted to.

    The set needs scans on its map and off it; TrainingError otherwise.
    """
    report = progress or (lambda stage, done, total, unit: None)
    on_map = [scan for scan in pose_set.scans if pose_set.on_map[scan.area]]
    if not on_map or len(on_map) == len(pose_set.scans):
        raise TrainingError("an alignment is learned from scans on the map and off it; the set holds one kind only")
    aerial_map = AerialMap.load(pose_set.map_folder)
    ratios, expected = fit_log_ratios(_seen(aerial_map, on_map, report))
    model = ObservationModel(ratios, expected, expected_share=0.0, temperature=1.0)
    aligner = Aligner(aerial_map, config or AlignmentConfig(), model)
    answers = []
    for i, scan in enumerate(pose_set.scans):
        answer = _answer(aligner, scan, bool(pose_set.on_map[scan.area]))
        if answer is not None:
            answers.append(answer)
        report("aligning", i + 1, len(pose_set.scans), "scans")
    share, temperature = calibrate(answers)
    return dataclasses.replace(model, expected_share=share, temperature=temperature), answers


def calibrate(answers: Sequence[Answer]) -> tuple[float, float]:
    """Return share of the expected score and temperature that make the right answers likeliest."""

    def loss(x: Float64Array) -> float:
        share, temperature = x[0], math.exp(x[1])
        total = 0.0
        for answer in answers:
            log_odds = (answer.scores - share * answer.expected) / temperature + answer.log_prior
            everything = np.logaddexp(0.0, np.logaddexp.reduce(log_odds)) if len(log_odds) else 0.0
            total += everything - (0.0 if answer.right is None else log_odds[answer.right])
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
    turned = np.abs((aligned.heading_rad - scan.heading_rad + np.pi) % (2.0 * np.pi) - np.pi)
    return np.asarray((away <= RIGHT_M) & (turned <= RIGHT_RAD))


def _seen(aerial_map: AerialMap, scans: Sequence[RawScan], report: Progress) -> Float64Array:
    """Count (CHANNELS, CLASSES) on which classes the evidence of scans falls at their true poses."""
    nothing = ObservationModel(np.zeros((CHANNELS, CLASSES), np.float32), np.zeros(CHANNELS))
    likelihood = MapLikelihood(aerial_map, nothing)
    likelihood.prepare()
    seen = np.zeros((CHANNELS, CLASSES))
    for i, scan in enumerate(scans):
        prepared, T = prepared_of(scan), scan.T_base_lidar
        evidence = evidence_of(prepared.place, prepared.sensor_height_m, (float(T[0, 3]), float(T[1, 3])))
        c, s = math.cos(scan.heading_rad), math.sin(scan.heading_rad)
        turned = evidence.xy_m @ np.array([[c, s], [-s, c]])
        easting, northing = (scan.T_grid_base[:2, 3] + turned).T
        rows = np.floor(northing - likelihood.south_m).astype(np.int64)
        columns = np.floor(easting - likelihood.west_m).astype(np.int64)
        np.add.at(seen, (evidence.channel, likelihood.classes[rows, columns]), 1.0)
        report("learning", i + 1, len(scans), "scans")
    return seen


def _answer(aligner: Aligner, scan: RawScan, on_map: bool) -> Answer | None:
    """Seek one scan on the whole map."""
    prepared, T = prepared_of(scan), scan.T_base_lidar
    sensor_xy = float(T[0, 3]), float(T[1, 3])
    aligned = aligner.align(prepared, sensor_xy, no_candidates(), everywhere=True)
    if not len(aligned):
        return None
    expected = float(aligner.model.expected @ fine_counts(prepared, sensor_xy))
    right = np.flatnonzero(is_right(aligned, scan)) if on_map else np.empty(0, np.int64)
    # The model's calibration is neutral here: log likelihoods are scores.
    return Answer(aligned.log_likelihood, expected, int(right[0]) if len(right) else None, aligned.log_prior)
