"""The null hypothesis: kidnapped, off the map, or hidden behind a truck."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from crossloc3d_ros.localization.fusion.tracker import Tracker
from crossloc3d_ros.types import TrackState

Array = npt.NDArray[np.float64]


def test_a_kidnapped_robot_is_found_again(worlds: Any) -> None:
    ways = []
    for seed in range(3):
        world, tracker = worlds.localized(seed)
        away = world.travelled_m
        world.kidnap()
        steps = worlds.travel(world, tracker, 60)
        assert not worlds.wrong_fixes(steps)
        assert not steps[0].belief.is_fix, "the very first scan does not fit"
        ways.append(worlds.fixes(steps)[0].travelled_m - away)
    assert np.median(ways) < 30


def test_a_robot_that_leaves_the_map_gets_no_fix_there_and_is_found_when_it_is_back(worlds: Any) -> None:
    for seed in range(2):
        world, tracker = worlds.localized(seed)
        world.on_map = False
        steps = worlds.travel(world, tracker, 50)
        assert not worlds.fixes(steps)[5:], "at most over some metres, by worlds.odometry"
        assert steps[-1].belief.state is TrackState.LOST
        assert "no longer fits" in steps[-1].belief.reason
        world.on_map = True
        assert worlds.fixes(worlds.travel(world, tracker, 60))


@pytest.mark.parametrize("delta", [np.array([1.0, 0.0, 0.0]), np.zeros(3)])
def test_outside_of_the_map_there_is_no_fix(worlds: Any, delta: Array) -> None:
    for seed in range(2):
        world = worlds.World(seed)
        world.on_map = False
        steps = worlds.travel(world, Tracker(worlds.CONFIG), 100, delta=delta)
        assert not worlds.fixes(steps)
        assert np.mean([step.belief.probability for step in steps]) < 0.1


def test_a_truck_before_the_sensor_costs_the_fix_only_while_it_is_there(worlds: Any) -> None:
    world, tracker = worlds.localized(1)
    standing = np.zeros(3)
    worlds.travel(world, tracker, 5, delta=standing)
    world.on_map = False
    worlds.travel(world, tracker, 3, delta=standing)
    world.on_map = True
    steps = worlds.travel(world, tracker, 30, delta=standing)
    assert steps[-1].belief.is_fix
    assert steps[-1].error_m < 1
