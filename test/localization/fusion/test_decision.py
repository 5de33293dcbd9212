"""Fix or no fix: one place of two that look the same, and after unknown motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from crossloc3d_ros.localization.fusion.odometry import Motion, unknown_motion
from crossloc3d_ros.localization.fusion.tracker import Tracker
from crossloc3d_ros.types import TrackState

Array = npt.NDArray[np.float64]


def test_places_that_look_the_same_are_no_fix(worlds: Any) -> None:
    for seed in range(3):
        world, tracker = worlds.World(seed, level=20.0, twins=[np.array([60.0, 30.0, 1.0])]), Tracker(worlds.CONFIG)
        steps = worlds.travel(world, tracker, 40)
        assert not worlds.fixes(steps)
        assert steps[-1].belief.state is TrackState.AMBIGUOUS
        assert "67 m away" in steps[-1].belief.reason
        world.twins = 0  # from here on the places differ
        later = worlds.travel(world, tracker, 40)
        assert worlds.fixes(later)
        assert not worlds.wrong_fixes(later)


@pytest.mark.parametrize(
    ("reported", "reason"),
    [
        (lambda w, d: None, "there is no odometry"),
        (lambda w, d: unknown_motion("the odometry has a gap of 2 s"), "the odometry has a gap of 2 s"),
        (lambda w, d: Motion(np.full(3, np.nan), np.eye(3)), "the odometry is not a number"),
        (lambda w, d: Motion(np.array([300.0, 0, 0]), np.eye(3)), "faster than the robot"),
    ],
)
def test_no_fix_rests_on_unknown_motion(
    worlds: Any, reported: Callable[[Any, Array], Motion | None], reason: str
) -> None:
    world, tracker = worlds.localized(4)
    before = tracker.predict(tracker.stamp_ns or 0, None).covariance[0]
    [step] = worlds.travel(world, tracker, 1, reported)
    assert not step.belief.is_fix
    assert reason in step.belief.reason
    assert before[0, 0] < 1
    steps = worlds.travel(world, tracker, 40)
    assert not worlds.wrong_fixes(steps)
    first = worlds.fixes(steps)[0].travelled_m - step.travelled_m
    assert first >= worlds.CONFIG.confirm_m


def test_two_poses_within_an_unknown_motion_are_both_believed(worlds: Any) -> None:
    world, tracker = worlds.localized(6)
    at, stamp_ns = world.truth, tracker.stamp_ns
    assert stamp_ns is not None
    tracker.predict(stamp_ns + worlds.SECOND, unknown_motion("a gap"))
    both = [(at[0] + 6, at[1], at[2]), (at[0] - 6, at[1], at[2])]
    belief = tracker.update(worlds.aligned_at(both, [15.0, 15.0]))
    assert belief.state is TrackState.AMBIGUOUS
    np.testing.assert_allclose(sorted(belief.hypotheses.probabilities)[-2:], 0.5, atol=0.05)
