"""The filter: least squares over all scans, moments of samples, and no frame that is special."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.localization.fusion.odometry import Motion, unknown_motion
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.fusion.tracker import Tracker
from crossloc3d_ros.types import no_aligned_poses


def test_position_and_variance_are_those_of_least_squares_over_all_scans(worlds: Any) -> None:
    """Oracle: the batch solution with the full covariance of errors that are alike over some metres."""
    config = dataclasses.replace(
        worlds.CONFIG,
        odometry_relative_std=1e-4,
        odometry_drift_deg_per_m=1e-6,
        map_std_m=0.0,
        measurement_error_correlation=0.7,
    )
    rng = np.random.default_rng(3)
    n, step_m, noise = 12, 2.0, 0.1
    common = 0.7 * np.exp(
        -step_m * np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / config.measurement_correlation_m
    )
    errors = worlds.STD[0] ** 2 * (common + 0.3 * np.eye(n))
    z = step_m * np.arange(n) + rng.multivariate_normal(np.zeros(n), errors)
    tracker = Tracker(config)
    for k in range(n):
        tracker.predict(k * worlds.SECOND, Motion(np.array([step_m, 0, 0]), np.diag([noise**2, 1e-8, 1e-12])))
        belief = tracker.update(worlds.aligned_at([(z[k], 0, 0)], [12.0]))
    # z = position at the end - what odometry says is still to go + its random errors on that way + errors of alignment.
    to_go = np.arange(n)[::-1]
    walk = noise**2 * np.minimum.outer(to_go, to_go)
    weights = np.linalg.inv(errors + walk)
    variance = 1.0 / weights.sum()
    assert belief.grid[0] == pytest.approx(variance * (weights.sum(axis=0) @ (z + step_m * to_go)), abs=1e-3)
    assert belief.covariance[0, 0] == pytest.approx(variance, rel=1e-3)


@given(st.floats(0.01, 1.7), st.floats(-3, 3), st.floats(-8, 8), st.floats(-3, 3))
@settings(max_examples=10, deadline=None)
def test_a_motion_in_an_uncertain_heading_has_the_moments_of_its_samples(
    worlds: Any, std: float, heading: float, forward: float, turn: float
) -> None:
    rng = np.random.default_rng(0)
    tracker = Tracker(dataclasses.replace(worlds.CONFIG, odometry_relative_std=1e-4, odometry_drift_deg_per_m=0.0))
    prior = np.array([[0.5, 0.1, 0.1 * std], [0.1, 0.3, 0.0], [0.1 * std, 0.0, std**2]])
    tracker.set_prior(PosePrior(np.array([10.0, 20.0, 0.0]), heading, prior, 0))
    tracker.predict(0, None)
    hypotheses = tracker.predict(worlds.SECOND, Motion(np.array([forward, 0.5, turn]), np.diag([1e-6, 1e-6, 1e-8])))
    samples = worlds.compose(rng.multivariate_normal([10, 20, heading], prior, 200_000), np.array([forward, 0.5, turn]))
    off = samples - np.append(hypotheses.grid[0, :2], hypotheses.heading_rad[0])
    off[:, 2] = wrap(off[:, 2])
    sampled = np.cov(off[:, :2].T)
    by_chance = (
        5.0 * np.sqrt(2.0 / len(samples)) * sampled.diagonal().max()
    )  # five standard deviations of the samples' own
    scale = 0.5 + 0.02 * forward**2
    np.testing.assert_allclose(off[:, :2].mean(axis=0), 0.0, atol=0.03 * scale + 0.01)
    np.testing.assert_allclose(hypotheses.covariance[0, :2, :2], sampled, atol=0.01 * scale + by_chance)


def test_turning_and_moving_the_world_turns_and_moves_the_estimate(worlds: Any) -> None:
    turn, shift = 1.1, np.array([500_000.0, 4_000_000.0])
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    here, there = worlds.World(5), Tracker(worlds.CONFIG)
    tracker = Tracker(worlds.CONFIG)
    for k in range(15):
        motion = worlds.odometry(here, worlds.AHEAD)
        if k:
            here.drive(worlds.AHEAD)
        scan = here.scan(tracker.predict(k * worlds.SECOND, motion))
        belief = tracker.update(scan)
        there.predict(k * worlds.SECOND, motion)
        grid = np.column_stack([scan.grid[:, :2] @ rotation.T + shift, scan.grid[:, 2]])
        poses = np.column_stack([grid[:, :2], wrap(scan.heading_rad + turn)])
        other = there.update(worlds.aligned_at(poses, scan.log_likelihood, scan.log_prior))
    np.testing.assert_allclose(other.grid[:2], rotation @ belief.grid[:2] + shift, atol=1e-5)
    assert other.probability == pytest.approx(belief.probability, rel=1e-5)
    turned = rotation @ belief.covariance[:2, :2] @ rotation.T
    np.testing.assert_allclose(other.covariance[:2, :2], turned, rtol=1e-4, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("correlation", "error_m"), [(0.8, 5.0), (0.0, 5.0), (0.8, 15.0)])
def test_the_covariance_holds_where_errors_are_of_another_kind_than_thought(
    worlds: Any, correlation: float, error_m: float
) -> None:
    steps = []
    for seed in range(12):
        world = worlds.World(100 + seed, level=20.0)
        world.correlation, world.error_m = correlation, error_m
        steps += worlds.fixes(worlds.travel(world, Tracker(worlds.CONFIG), 100))
    inside = np.array([np.abs(step.error[:2]) < 2 * np.sqrt(np.diag(step.belief.covariance)[:2]) for step in steps])
    # Errors that change faster than thought average out faster, too: then it is cautious, but not beyond all measure.
    assert 0.90 <= inside.mean() < 1.0


def test_after_unknown_motion_the_belief_is_as_wide_as_the_robot_could_drive(worlds: Any) -> None:
    world, tracker = worlds.localized(5)
    stamp_ns = tracker.stamp_ns
    assert stamp_ns is not None
    hypotheses = tracker.predict(stamp_ns + 2 * worlds.SECOND, unknown_motion("a gap"))
    assert hypotheses.covariance[0, 0, 0] >= worlds.CONFIG.max_speed_mps**2
    away = worlds.travel(world, tracker, 1, lambda w, d: unknown_motion("a gap"))[0].belief
    assert not away.is_fix
    hypotheses = tracker.predict((tracker.stamp_ns or 0) + 600 * worlds.SECOND, unknown_motion("a long gap"))
    assert len(hypotheses) == 0, "after ten minutes it may be anywhere"
    assert not tracker.update(no_aligned_poses()).is_fix
