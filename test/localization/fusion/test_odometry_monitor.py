"""Odometry that is wrong: named, bridged, and never the cause of a wrong fix."""

from __future__ import annotations

from typing import Any

import numpy as np

from crossloc3d_ros.localization.fusion.tracker import Tracker


def test_odometry_that_reports_a_fifth_too_much_is_noticed(worlds: Any) -> None:
    steps = []
    for seed in range(4):
        world, tracker = worlds.World(seed, level=20.0), Tracker(worlds.CONFIG)
        steps += worlds.travel(world, tracker, 60, lambda w, d: worlds.odometry(w, d * [1.2, 1.2, 1.0]))
    good = worlds.fixes(steps)
    assert len(good) > 100
    assert not worlds.wrong_fixes(steps)
    inside = np.array([np.abs(step.error[:2]) < 2 * np.sqrt(np.diag(step.belief.covariance)[:2]) for step in good])
    assert inside.mean() > 0.9
    assert "% too long" in good[-1].belief.reason


def test_odometry_that_stands_still_while_the_robot_drives_makes_no_wrong_fix(worlds: Any) -> None:
    world, tracker = worlds.localized(2)
    steps = worlds.travel(world, tracker, 40, lambda w, d: worlds.odometry(w, np.zeros(3)))
    assert not worlds.wrong_fixes(steps)
    assert any("disagree" in step.belief.reason for step in steps) or not steps[-1].belief.is_fix
    assert worlds.fixes(worlds.travel(world, tracker, 60)), "good again"


def test_a_small_jump_of_the_odometry_is_bridged(worlds: Any) -> None:
    world, tracker = worlds.localized(3)
    steps = worlds.travel(world, tracker, 1, lambda w, d: worlds.odometry(w, d + np.array([1.5, 1.0, 0.0])))
    steps += worlds.travel(world, tracker, 10)
    assert not [step for step in steps if step.error_m > 3]
    assert steps[-1].belief.is_fix
