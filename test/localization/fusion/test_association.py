"""Data association and evidence: each pose once, the scans of a spot once, and the distance travelled counts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.decision import Belief
from crossloc3d_ros.localization.fusion.odometry import Motion, motion_covariance
from crossloc3d_ros.localization.fusion.tracker import Tracker


def test_a_pose_found_twice_counts_once(worlds: Any) -> None:
    once, twice = Tracker(worlds.CONFIG), Tracker(worlds.CONFIG)
    for tracker in (once, twice):
        tracker.predict(0, None)
    single = once.update(worlds.aligned_at([(0, 0, 0)], [8.0]))
    double = twice.update(worlds.aligned_at([(0, 0, 0), (0.05, 0, 0)], [8.0, 7.9]))
    assert double.probability == pytest.approx(single.probability)
    assert len(double.hypotheses) == 1


def test_however_well_a_scan_fits_it_is_no_proof_but_distinguishes_places(worlds: Any) -> None:
    tracker = Tracker(FusionConfig(max_log_likelihood=12.0, null_log_likelihood=0.0))
    tracker.predict(0, None)
    belief = tracker.update(worlds.aligned_at([(0, 0, 0), (200, 0, 0)], [80.0, 77.0]))
    none = 1 - belief.hypotheses.probabilities.sum()
    assert belief.hypotheses.probabilities[0] / none == pytest.approx(math.exp(12.0 - 8.0), rel=0.1)
    assert belief.hypotheses.probabilities[0] / belief.hypotheses.probabilities[1] == pytest.approx(math.e**3, rel=0.1)


def test_poses_that_are_no_numbers_are_left_out(worlds: Any) -> None:
    good = worlds.aligned_at([(0, 0, 0), (50, 0, 0), (90, 0, 0), (130, 0, 0)], [9.0, 9.0, 9.0, 9.0])
    good.grid[1, 0], good.log_likelihood[2], good.covariance[3] = np.nan, np.nan, np.inf
    tracker = Tracker(worlds.CONFIG)
    tracker.predict(0, None)
    belief = tracker.update(good)
    np.testing.assert_allclose(belief.hypotheses.grid, [[0, 0, 2]])


def stand(
    worlds: Any, tracker: Tracker, levels: Sequence[float], poses: Sequence[Sequence[float]] = ((0, 0, 0),)
) -> Belief:
    for k, level in enumerate(levels):
        tracker.predict(k * worlds.SECOND // 10, Motion(np.zeros(3), motion_covariance(0, 0, worlds.CONFIG)))
        belief = tracker.update(worlds.aligned_at(poses, [level] * len(poses)))
    return belief


def test_standing_still_adds_no_evidence(worlds: Any) -> None:
    first = stand(worlds, Tracker(worlds.CONFIG), [8.0])
    later = stand(worlds, Tracker(worlds.CONFIG), [8.0] * 200)
    assert first.probability == pytest.approx(0.5, abs=0.02)
    assert later.probability == pytest.approx(first.probability, abs=0.15)


def test_scans_of_one_spot_count_by_their_mean(worlds: Any) -> None:
    rng = np.random.default_rng(0)
    noisy = stand(worlds, Tracker(worlds.CONFIG), [8.0, *(8.0 + 4.0 * rng.standard_normal(300))])
    assert noisy.probability < 0.95, "the luckiest of 300 scans would be believed 99.99 %"
    disappointed = stand(worlds, Tracker(worlds.CONFIG), [16.0, *[-2.0] * 30])
    assert disappointed.probability < 0.01, "one lucky scan, refuted by those that follow"


def test_evidence_grows_with_the_distance_travelled(worlds: Any) -> None:
    beliefs = []
    for length in (0.0, 10.0, 40.0):
        tracker, delta = Tracker(worlds.CONFIG), np.array([length / 20, 0, 0])
        for k in range(21):
            tracker.predict(k * worlds.SECOND, Motion(delta, motion_covariance(delta[0], 0, worlds.CONFIG)))
            belief = tracker.update(worlds.aligned_at([(k * delta[0], 0, 0)], [6.0]))
        beliefs.append(math.log(belief.probability / (1 - belief.probability)))
    # 10 m are half of a look more, 40 m two: each look tells 6.
    assert beliefs[1] - beliefs[0] == pytest.approx(3.0, abs=1.5)
    assert beliefs[2] - beliefs[0] == pytest.approx(12.0, abs=4.0)


def test_the_distance_counts_and_not_the_number_of_scans_on_it(worlds: Any) -> None:
    beliefs = []
    for scans in (10, 200):
        config = dataclasses.replace(worlds.CONFIG, odometry_relative_std=1e-3, odometry_drift_deg_per_m=0.0)
        tracker, delta = Tracker(config), np.array([30.0 / scans, 0, 0])
        for k in range(scans + 1):
            tracker.predict(k * 30 * worlds.SECOND // scans, Motion(delta, motion_covariance(delta[0], 0, config)))
            belief = tracker.update(worlds.aligned_at([(k * delta[0], 0, 0)], [5.0]))
        beliefs.append(math.log(belief.probability / (1 - belief.probability)))
    assert beliefs[1] == pytest.approx(beliefs[0], abs=1.0)


def test_a_pose_that_is_detected_late_is_granted_the_evidence_that_it_would_have_had(worlds: Any) -> None:
    tracker = Tracker(worlds.CONFIG)
    here, missed = np.array([0.0, 0.0, 0.0]), np.array([500.0, 80.0, 2.0])
    for k in range(31):
        tracker.predict(k * worlds.SECOND, Motion(worlds.AHEAD, motion_covariance(1.0, 0.0, worlds.CONFIG)))
        poses = [here, missed] if k >= 15 else [here]
        belief = tracker.update(worlds.aligned_at(poses, [8.0] * len(poses)))
        here, missed = worlds.compose(here, worlds.AHEAD), worlds.compose(missed, worlds.AHEAD)
    # It fits as well since it was found: only that it was missed for 15 m speaks against it.
    odds = belief.hypotheses.probabilities[1] / belief.hypotheses.probabilities[0]
    assert odds == pytest.approx((1 - worlds.CONFIG.detection_probability) ** (15 / worlds.CONFIG.novelty_m), rel=0.5)
    assert not belief.is_fix


def driven(worlds: Any, log_likelihood: float, null_log_likelihood: float) -> float:
    """Return the probability after ten scans, 12 m apart, that fit one pose moving along by so much each."""
    config = dataclasses.replace(worlds.CONFIG, null_log_likelihood=null_log_likelihood)
    tracker, step = Tracker(config), np.array([12.0, 0.0, 0.0])
    for k in range(10):
        tracker.predict(k * worlds.SECOND * 5, Motion(step, motion_covariance(12.0, 0.0, config)) if k else None)
        belief = tracker.update(worlds.aligned_at([(12.0 * k, 0, 0)], [log_likelihood]))
    return float(belief.probability)


def test_what_wrong_hypotheses_reach_scan_after_scan_is_no_evidence(worlds: Any) -> None:
    assert driven(worlds, 7.0, 0.0) > 0.999
    assert driven(worlds, 7.0, 9.0) < 0.5
    assert driven(worlds, 20.0, 9.0) > 0.999, "what is above still counts"


def test_what_wrong_hypotheses_reach_says_nothing_for_a_robot_that_was_carried_away(worlds: Any) -> None:
    """Evidence just above the null hypothesis keeps a belief as certain as it became, at a spot and along the way."""
    config = dataclasses.replace(worlds.CONFIG, null_log_likelihood=9.0, kidnapping_per_s=1e-3)
    tracker, probabilities = Tracker(config), []
    for k, fits in enumerate([20.0] * 60 + [10.0] * 200):
        motion = Motion(worlds.AHEAD * (k < 160), motion_covariance(1.0, 0.0, config))
        tracker.predict(k * worlds.SECOND // 10, motion if k else None)
        probabilities.append(tracker.update(worlds.aligned_at([(min(k, 159), 0, 0)], [fits])).probability)
    assert min(probabilities[60:]) > 0.999
