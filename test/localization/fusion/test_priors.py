"""What is known from outside: initial poses, right and wrong, and a compass."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.localization.fusion.odometry import Motion
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


# What is none is refused, and what is taken leaves a belief that is one

NUMBERS = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, math.nan, math.inf, -math.inf]), st.floats(-1e4, 1e4)
)
SHAPES = st.sampled_from([(3, 3), (3, 3), (3, 3), (3,), (9,), (6, 6), (1, 3, 3), (0,), ()])


def arrays(shape: tuple[int, ...]) -> st.SearchStrategy[np.ndarray]:
    return st.lists(NUMBERS, min_size=math.prod(shape), max_size=math.prod(shape)).map(
        lambda values: np.array(values).reshape(shape)
    )


def covariances() -> st.SearchStrategy[np.ndarray]:
    """Some that are none, and some that are: of any size, known in part, correlated."""
    root = arrays((3, 3)).filter(lambda a: np.isfinite(a).all() and np.abs(a).max() < 1e5).map(lambda a: a @ a.T)
    known = st.lists(st.sampled_from([1e-8, 0.3, 90.0, 1e12, math.inf]), min_size=3, max_size=3).map(np.diag)
    return st.one_of(root, known, SHAPES.flatmap(arrays))


@given(
    grid=st.one_of(st.none(), arrays((3,)), SHAPES.flatmap(arrays)),
    heading=st.one_of(st.none(), NUMBERS),
    covariance=covariances(),
    stamp_ns=st.sampled_from([0, 1, 10**18, -5, 2**70, 0.5, math.nan, None]),
)
@settings(max_examples=300, deadline=None)
def test_a_prior_is_refused_or_leaves_a_belief_that_scans_can_correct(
    worlds: Any, grid: Any, heading: Any, covariance: Any, stamp_ns: Any
) -> None:
    tracker = Tracker(worlds.CONFIG)
    poses, levels = [[10.0, 20.0, 0.3], [400.0, 1.0, -2.0]], [14.0, 3.0]
    tracker.predict(0, None)
    tracker.update(worlds.aligned_at(poses, levels))
    with np.errstate(all="raise", under="ignore"):
        try:
            tracker.set_prior(PosePrior(grid, heading, covariance, stamp_ns))
        except PoseError as error:
            assert "of a prior" in str(error)
        for k in range(1, 4):
            hypotheses = tracker.predict(k * worlds.SECOND, Motion(np.zeros(3), np.diag([0.1, 0.1, 0.01])))
            assert all(np.isfinite(values).all() for values in vars(hypotheses).values())
            belief = tracker.update(worlds.aligned_at(poses, levels))
    assert 0.0 <= belief.probability <= 1.0 + 1e-9
    assert np.isfinite(belief.grid).all()
    assert np.linalg.eigvalsh(belief.covariance).min() > 0.0


@given(delta=st.one_of(arrays((3,)), SHAPES.flatmap(arrays)), covariance=covariances())
@settings(max_examples=300, deadline=None)
def test_a_motion_is_refused_or_unknown_or_leaves_a_belief(worlds: Any, delta: Any, covariance: Any) -> None:
    tracker = Tracker(worlds.CONFIG)
    poses, levels = [[10.0, 20.0, 0.3], [400.0, 1.0, -2.0]], [14.0, 3.0]
    tracker.predict(0, None)
    tracker.update(worlds.aligned_at(poses, levels))
    with np.errstate(all="raise", under="ignore"):
        try:
            hypotheses = tracker.predict(worlds.SECOND, Motion(delta, covariance))
        except PoseError as error:
            assert "motion" in str(error)
            hypotheses = tracker.predict(worlds.SECOND, None)
        assert all(np.isfinite(values).all() for values in vars(hypotheses).values())
        tracker.update(worlds.aligned_at(poses, levels))
        tracker.predict(2 * worlds.SECOND, Motion(np.zeros(3), np.diag([0.1, 0.1, 0.01])))
        belief = tracker.update(worlds.aligned_at(poses, levels))
    assert 0.0 <= belief.probability <= 1.0 + 1e-9
    assert np.isfinite(belief.grid).all()


@pytest.mark.parametrize("stamp_ns", [math.nan, 1.5, None, "now", True])
def test_a_stamp_that_is_none_is_refused_and_the_next_scan_counts(worlds: Any, stamp_ns: Any) -> None:
    tracker = Tracker(worlds.CONFIG)
    with pytest.raises(PoseError, match="the stamp of a scan must be an integer, nanoseconds, got"):
        tracker.predict(stamp_ns, None)
    tracker.predict(0, None)
    tracker.predict(worlds.SECOND, None)
    assert tracker.stamp_ns == worlds.SECOND
