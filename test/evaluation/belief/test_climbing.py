"""Poses compared by the aligner itself: the one refined from the truth, and the answer."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.datasets.pose_sets import PoseSet
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.evaluation.belief.climbing import Climber
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.types import AlignedPoses, Estimate


@pytest.fixture(scope="module")
def climber(simulated_town) -> Climber:
    pose_set, encoder = simulated_town
    return Climber(AerialMap.load(pose_set.map_folder, encoder.fingerprint), encoder, LocalizerConfig())


@pytest.fixture(scope="module")
def scans(simulated_town) -> list[RawScan]:
    pose_set: PoseSet = simulated_town[0]
    return [scan for scan in pose_set.scans if pose_set.on_map[scan.area]]


def answer(scan: RawScan, east_m: float) -> Estimate:
    """Return an estimate whose best pose is that far from the truth."""
    grid = scan.T_grid_base[None, :3, 3] + [east_m, 0.0, 0.0]
    one, heading = np.ones(1), np.array([scan.heading_rad])
    aligned = AlignedPoses(grid, heading, np.eye(3)[None], one, one, one, one > 0, np.zeros(1, np.int64), -5.0)
    return dataclasses.replace(no_estimate(scan.stamp_ns, "made up"), aligned=aligned)


def test_the_truth_scores_higher_than_a_place_elsewhere(climber: Climber, scans: list[RawScan]) -> None:
    compared = np.array([climber.compare(scan, answer(scan, 30.0)) for scan in scans])
    assert np.isfinite(compared).all()
    assert np.mean(compared[:, 0] > compared[:, 1] + 1.0) > 0.8


def test_an_answer_at_the_truth_scores_the_same(climber: Climber, scans: list[RawScan]) -> None:
    for scan in scans[:3]:
        truth, other = climber.compare(scan, answer(scan, 0.0))
        assert truth == pytest.approx(other, abs=1e-9)


def test_without_an_answer_the_truth_alone_has_a_score(climber: Climber, scans: list[RawScan]) -> None:
    truth, other = climber.compare(scans[0], no_estimate(0, "nothing fits"))
    assert np.isfinite(truth)
    assert np.isnan(other)


def test_a_scan_of_nothing_is_not_compared(climber: Climber, scans: list[RawScan]) -> None:
    blind = dataclasses.replace(scans[0], points=scans[0].points[:5])
    assert np.isnan(climber.compare(blind, no_estimate(0, "nothing seen"))).all()
