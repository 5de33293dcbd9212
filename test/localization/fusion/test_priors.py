"""What is known from outside: initial poses, right and wrong, and a compass."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.fusion.tracker import Tracker
from crossloc3d_ros.types import no_aligned_poses


def test_a_given_pose_finds_the_robot_at_once_where_the_scan_agrees(worlds: Any) -> None:
    world, tracker = worlds.World(11), Tracker(worlds.CONFIG)
    covariance = np.diag([1.0, 1.0, 0.1])
    tracker.set_prior(PosePrior(np.append(world.truth[:2], 2.0), world.truth[2], covariance, 0))
    assert np.hypot(*(tracker.predict(0, None).grid[0, :2] - world.truth[:2])) < 1e-6
    belief = tracker.update(worlds.aligned_at([world.truth], [12.0]))
    assert belief.is_fix
    np.testing.assert_allclose(belief.grid[:2], world.truth[:2], atol=0.2)


def test_a_given_pose_alone_is_no_fix_and_a_wrong_one_is_overcome(worlds: Any) -> None:
    for seed in range(3):
        world, tracker = worlds.World(seed, level=20.0), Tracker(worlds.CONFIG)
        wrong = np.append(world.truth[:2] + 300.0, 2.0)
        tracker.set_prior(PosePrior(wrong, 0.3, np.diag([0.25, 0.25, 0.07]), 0))
        tracker.predict(0, None)
        assert not tracker.update(no_aligned_poses()).is_fix
        steps = worlds.travel(world, tracker, 60)
        assert worlds.fixes(steps)
        assert not worlds.wrong_fixes(steps)


def test_a_position_without_a_heading_is_aligned_in_every_heading(worlds: Any) -> None:
    tracker = Tracker(worlds.CONFIG)
    covariance = np.diag([25.0, 25.0, np.inf])
    tracker.set_prior(PosePrior(np.array([50.0, 60.0, 1.0]), None, covariance, 0))
    hypotheses = tracker.predict(0, None)
    assert math.sqrt(hypotheses.covariance[0, 2, 2]) > 1.5
    belief = tracker.update(worlds.aligned_at([(52.0, 58.0, -2.0), (400.0, 0.0, 1.0)], [10.0, 10.0]))
    np.testing.assert_allclose(belief.grid[:2], [52, 58], atol=0.5)
    assert belief.heading_rad == pytest.approx(-2.0, abs=0.2)


def test_a_compass_distinguishes_two_headings(worlds: Any) -> None:
    beliefs = []
    for compass in (False, True):
        tracker = Tracker(worlds.CONFIG)
        if compass:
            tracker.set_prior(PosePrior(None, 0.1, np.diag([np.inf, np.inf, math.radians(15) ** 2]), 0))
        tracker.predict(0, None)
        beliefs.append(tracker.update(worlds.aligned_at([(0, 0, 0.0), (300, 0, math.pi)], [12.0, 12.0])))
    assert sorted(beliefs[0].hypotheses.probabilities) == pytest.approx([0.5, 0.5], abs=0.02)
    assert beliefs[1].hypotheses.probabilities[0] > 0.9
    assert beliefs[1].heading_rad == pytest.approx(0.0, abs=0.05)
