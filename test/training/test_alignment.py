"""What `train alignment` learns: the calibration that made the data, a model that finds and doubts."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.datasets.pose_sets import PoseSet
from crossloc3d_ros.datasets.raw_scans import RawScans
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.localization.alignment.aligner import Aligner
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS
from crossloc3d_ros.localization.alignment.observation_model import CLASSES, UNKNOWN, ObservationModel
from crossloc3d_ros.training.alignment import (
    RIGHT_M,
    RIGHT_RAD,
    ScoredPoses,
    calibrate,
    fit_alignment,
    is_right,
    prepared_of,
)
from crossloc3d_ros.types import AlignedPoses, no_aligned_poses, no_candidates

Learned = tuple[ObservationModel, list[ScoredPoses]]


@pytest.fixture(scope="module")
def pose_set(simulated_town: tuple[PoseSet, Any]) -> PoseSet:
    return simulated_town[0]


@pytest.fixture(scope="module")
def learned(pose_set: PoseSet) -> Learned:
    return fit_alignment(pose_set)


def drawn(share: float, temperature: float, count: int, seed: int) -> list[ScoredPoses]:
    """Draw scored from the very model that the calibration assumes: which pose is right follows from the scores."""
    rng, scored = np.random.default_rng(seed), []
    for _ in range(count):
        expected, log_prior = float(rng.uniform(200, 900)), -7.0
        scores = np.sort(expected * rng.uniform(0.3, 0.9, rng.integers(1, 12)))[::-1]
        log_odds = np.append((scores - share * expected) / temperature + log_prior, 0.0)
        shares = np.exp(log_odds - np.logaddexp.reduce(log_odds))
        right = int(rng.choice(len(shares), p=shares))
        scored.append(ScoredPoses(scores, expected, right if right < len(scores) else None, log_prior))
    return scored


@pytest.mark.parametrize(("share", "temperature"), [(0.5, 12.0), (0.35, 25.0)])
def test_the_calibration_that_made_the_scores_is_found(share: float, temperature: float) -> None:
    detection_probability, found_temperature = calibrate(drawn(share, temperature, 600, 1))
    assert detection_probability == pytest.approx(share, abs=0.03)
    assert found_temperature == pytest.approx(temperature, rel=0.2)


def test_probabilities_after_the_calibration_are_shares_of_what_is_right() -> None:
    share, temperature = calibrate(drawn(0.5, 15.0, 600, 2))
    predicted, right = [], []
    for poses in drawn(0.5, 15.0, 1000, 3):
        log_odds = (poses.scores - share * poses.expected) / temperature + poses.log_prior
        predicted.append(math.exp(log_odds[0] - np.logaddexp(0.0, np.logaddexp.reduce(log_odds))))
        right.append(poses.right == 0)
    for low, high in ((0.05, 0.35), (0.35, 0.65), (0.65, 0.95)):
        here = (np.array(predicted) >= low) & (np.array(predicted) < high)
        assert here.sum() > 30
        assert np.mean(np.array(right)[here]) == pytest.approx(np.mean(np.array(predicted)[here]), abs=0.12)


def test_scans_without_any_pose_do_no_harm() -> None:
    scored = drawn(0.5, 12.0, 100, 4)
    nothing = ScoredPoses(np.empty(0), 300.0, None, -7.0)
    np.testing.assert_allclose(calibrate([*scored, nothing]), calibrate(scored), rtol=1e-3)


def test_a_pose_is_right_within_two_metres_and_five_degrees(pose_set: PoseSet) -> None:
    scan = pose_set.scans[0]
    offsets = np.array(
        [[0, 0, 0], [RIGHT_M - 0.01, 0, 0], [0, -RIGHT_M - 0.01, 0], [0, 0, RIGHT_RAD - 1e-3],
         [0, 0, -RIGHT_RAD - 1e-3], [0, 0, 2 * math.pi], [0, 0, math.pi]]
    )  # fmt: skip
    count = len(offsets)
    grid = scan.T_grid_base[:3, 3] + np.column_stack([offsets[:, :2], np.full(count, 50.0)])
    numbers = np.zeros(count)
    poses = AlignedPoses(
        grid, scan.heading_rad + offsets[:, 2], np.zeros((count, 3, 3)), numbers, numbers, numbers,
        np.ones(count, np.bool_), np.zeros(count, np.int64),
    )  # fmt: skip
    assert is_right(poses, scan).tolist() == [True, True, False, True, False, True, False]
    assert is_right(no_aligned_poses(), scan).shape == (0,)


def test_what_is_learned_is_whole_and_separates_walls_from_streets(learned: Learned, tmp_path: Path) -> None:
    model, scored = learned
    assert model.log_ratios.shape == (CHANNELS, CLASSES)
    assert np.isfinite(model.log_ratios).all()
    assert (model.log_ratios[:, UNKNOWN] == 0.0).all()
    assert (model.expected > 0.0).all(), "at true poses every channel supports them"
    assert 0.0 < model.expected_share < 1.0
    assert model.temperature > 0.0
    assert (model.log_ratios[:LAYERS, 0] < 0.0).all(), "no returns from an empty street"
    model.save(tmp_path / "learned.safetensors")
    np.testing.assert_array_equal(ObservationModel.load(tmp_path / "learned.safetensors").log_ratios, model.log_ratios)
    assert sum(poses.right is not None for poses in scored) >= 6


def test_log_likelihoods_are_scores_before_any_calibration(pose_set: PoseSet, learned: Learned) -> None:
    on_map = [bool(pose_set.on_map[scan.area]) for scan in pose_set.scans]
    _, scored = learned
    assert len(scored) == len(on_map)
    for poses, on in zip(scored, on_map, strict=True):
        assert on or poses.right is None, "nothing is right off the map"
        assert poses.expected > 0.0
        assert (np.diff(poses.scores) <= 1e-9).all()
        assert poses.log_prior < 0.0
    right = [poses.scores[poses.right] / poses.expected for poses in scored if poses.right is not None]
    assert 0.5 < np.median(right) < 1.5, "the true pose scores what is expected of it"


def test_a_learned_model_finds_its_scans_and_doubts_the_others(pose_set: PoseSet, learned: Learned) -> None:
    aligner = Aligner(AerialMap.load(pose_set.map_folder), AlignmentConfig(), learned[0])
    for scan in pose_set.scans[::3]:
        T = scan.T_base_lidar
        found = aligner.align(prepared_of(scan), (float(T[0, 3]), float(T[1, 3])), no_candidates(), search_map=True)
        if pose_set.on_map[scan.area]:
            assert is_right(found, scan)[0]
        else:
            assert found.probabilities.sum() < 0.5


def test_progress_is_reported(pose_set: PoseSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "crossloc3d_ros.training.alignment._scored_poses", lambda *_: ScoredPoses(np.array([9.0]), 10.0, 0, -5.0)
    )
    reports: list[tuple[str, float, float, str]] = []
    fit_alignment(pose_set, progress=lambda *report: reports.append(report))
    assert {report[0] for report in reports} == {"learning", "aligning"}
    assert all(report[1] <= report[2] for report in reports)
    assert reports[-1] == ("aligning", 10, 10, "scans")


@pytest.mark.parametrize("kind", [True, False])
def test_scans_of_one_kind_teach_nothing(pose_set: PoseSet, kind: bool) -> None:
    scans = RawScans.of(scan for scan in pose_set.scans if pose_set.on_map[scan.area] is kind)
    with pytest.raises(TrainingError, match="on the map and off it"):
        fit_alignment(dataclasses.replace(pose_set, scans=scans))
