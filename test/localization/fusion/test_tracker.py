"""Tracking as a whole: from nothing to a fix, in worlds where it is known how likely everything is."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.odometry import Motion, unknown_motion
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.fusion.tracker import Tracker
from crossloc3d_ros.types import TrackState, no_aligned_poses


def test_a_robot_that_has_seen_nothing_believes_nothing(worlds: Any) -> None:
    tracker = Tracker(worlds.CONFIG)
    for k in range(20):
        assert len(tracker.predict(k * worlds.SECOND, None)) == 0
        belief = tracker.update(no_aligned_poses())
        assert (belief.state, belief.is_fix, belief.probability) == (TrackState.SEARCHING, False, 0.0)
        assert np.isnan(belief.grid).all()
        assert np.isnan(belief.heading_rad)
        assert "no pose on the map fits" in belief.reason


@given(st.lists(st.floats(-20, 20), min_size=1, max_size=9))
def test_after_one_scan_the_belief_is_that_of_the_scan_alone(worlds: Any, levels: list[float]) -> None:
    config = FusionConfig(clutter_probability=1e-6, max_log_likelihood=1000.0, null_log_likelihood=0.0)
    aligned = worlds.aligned_at([(100.0 * i, 0, 0) for i in range(len(levels))], levels)
    tracker = Tracker(config)
    tracker.predict(0, None)
    hypotheses = tracker.update(aligned).hypotheses
    for grid, probability in zip(hypotheses.grid, hypotheses.probabilities, strict=True):
        assert probability == pytest.approx(aligned.probabilities[round(grid[0] / 100)], rel=1e-4, abs=1e-8)
    held = aligned.probabilities[aligned.probabilities > 1e-8]
    assert len(hypotheses) >= len(held)


def test_it_finds_itself_and_knows_how_well(worlds: Any) -> None:
    config = dataclasses.replace(worlds.CONFIG, map_std_m=0.1)  # the map of these worlds has no errors of its own
    steps = [step for seed in range(6) for step in worlds.travel(worlds.World(seed), Tracker(config), 60)]
    found = [min(s.travelled_m for s in worlds.fixes(steps[60 * i : 60 * i + 60])) for i in range(6)]
    assert np.median(found) < 20
    assert not worlds.wrong_fixes(steps)
    good = worlds.fixes(steps)
    assert len(good) > 200
    inside = np.array([np.abs(step.error) < 2 * np.sqrt(np.diag(step.belief.covariance)) for step in good])
    assert 0.90 <= inside[:, :2].mean() <= 0.995
    # Normalized squared errors of three numbers: 3 on average, where the covariance is what it says; less is cautious.
    assert 1.5 < np.mean([step.nees for step in good]) < 3.6
    assert np.median([step.error_m for step in good]) < 0.4


def test_a_repeated_or_late_scan_changes_nothing(worlds: Any) -> None:
    world, tracker = worlds.localized(7)
    stamp_ns = tracker.stamp_ns
    assert stamp_ns is not None
    before = tracker.predict(stamp_ns, None)
    for back_ns, reason in (
        (0, "the same stamp"),
        (worlds.SECOND // 2, "0.5 s older"),
        (2 * worlds.SECOND, "2 s older"),
    ):
        tracker.predict(stamp_ns - back_ns, worlds.odometry(world, worlds.AHEAD))
        belief = tracker.update(world.scan(before))
        assert not belief.is_fix
        assert reason in belief.reason
        assert tracker.stamp_ns == stamp_ns
    after = tracker.predict(stamp_ns, None)
    np.testing.assert_array_equal(after.grid, before.grid)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    np.testing.assert_array_equal(after.probabilities, before.probabilities)
    assert worlds.travel(world, tracker, 3)[-1].belief.is_fix


def test_a_recording_that_begins_anew_forgets(worlds: Any) -> None:
    world, tracker = worlds.localized(8)
    assert len(tracker.predict(-3600 * worlds.SECOND, worlds.odometry(world, worlds.AHEAD))) == 0
    belief = tracker.update(no_aligned_poses())
    assert belief.state is TrackState.SEARCHING
    assert tracker.stamp_ns == -3600 * worlds.SECOND


def test_reset_forgets(worlds: Any) -> None:
    _, tracker = worlds.localized(9)
    tracker.reset()
    assert tracker.stamp_ns is None
    assert len(tracker.predict(0, None)) == 0


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_whatever_comes_in_the_belief_is_one(worlds: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracker = Tracker(worlds.CONFIG)
    for k in range(12):
        n = int(rng.integers(0, 8))
        poses = np.column_stack([rng.normal(0, 10.0 ** rng.integers(0, 3), (n, 2)), rng.uniform(-9, 9, n)])
        aligned = worlds.aligned_at(
            poses, np.nan_to_num(rng.normal(0, 10.0 ** rng.integers(0, 4), n)), float(rng.normal())
        )
        wild = rng.normal(0, 10.0 ** rng.integers(-4, 4), (n, 3, 3))
        aligned.covariance[:] = wild  # not even symmetric
        if n and rng.random() < 0.2:
            aligned.log_likelihood[0] = rng.choice([np.nan, np.inf, -np.inf])
        motion = [None, unknown_motion("x"), Motion(rng.normal(0, 1, 3), np.diag(rng.uniform(0, 1, 3)))][k % 3]
        if rng.random() < 0.2:
            tracker.set_prior(PosePrior(rng.normal(0, 99, 3), None, np.diag([1.0, np.inf, np.inf]), 0))
        hypotheses = tracker.predict(int(rng.integers(-3, 20)) * worlds.SECOND, motion)
        assert np.isfinite(hypotheses.covariance).all()
        belief = tracker.update(aligned)
        assert 0 <= belief.probability <= 1 + 1e-9
        assert belief.hypotheses.probabilities.sum() <= 1 + 1e-9
        assert len(belief.hypotheses) <= worlds.CONFIG.max_hypotheses
        assert belief.reason
        if len(belief.hypotheses):
            assert np.linalg.eigvalsh(belief.covariance).min() > 0
            assert np.isfinite(belief.grid).all()
            assert -math.pi <= belief.heading_rad <= math.pi
