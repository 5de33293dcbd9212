"""Fusion over time: in worlds where it is known how likely everything is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.odometry import Motion, motion_covariance, unknown_motion
from crossloc3d_ros.localization.fusion.tracking import Belief, PosePrior, Tracker
from crossloc3d_ros.types import AlignedPoses, Hypotheses, TrackState, no_aligned_poses

Array = npt.NDArray[np.float64]

# As the worlds below are, which need not be as the defaults are.
CONFIG = FusionConfig(
    novelty_m=20.0, confirm_m=3.0, measurement_std_scale=1.0, measurement_error_correlation=0.8,
    measurement_correlation_m=5.0, measurement_min_std_m=0.1, measurement_min_std_deg=0.2,
)  # fmt: skip
SECOND = 1_000_000_000
AHEAD = np.array([1.0, 0.0, 0.0])
STD = np.array([0.25, 0.25, 0.01])


def wrap(angle_rad: Array) -> Array:
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def compose(poses: Array, delta: Array) -> Array:
    """Move poses (..., 3) by `delta` (3,), told in each one's own frame."""
    cosine, sine = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    east = poses[..., 0] + cosine * delta[0] - sine * delta[1]
    north = poses[..., 1] + sine * delta[0] + cosine * delta[1]
    return np.stack([east, north, wrap(poses[..., 2] + delta[2])], axis=-1)


def aligned_at(
    poses: Sequence[Sequence[float]] | Array, log_likelihood: Sequence[float] | Array, log_prior: float = -8.0
) -> AlignedPoses:
    poses_, levels = np.array(poses, dtype=np.float64).reshape(-1, 3), np.array(log_likelihood, dtype=np.float64)
    n = len(levels)
    odds = np.exp(np.minimum(levels + log_prior, 500.0))
    return AlignedPoses(
        np.column_stack([poses_[:, :2], np.full(n, 2.0)]), poses_[:, 2], np.tile(np.diag(STD**2), (n, 1, 1)), levels,
        odds / (1 + odds.sum()), np.ones(n), np.ones(n, np.bool_), np.arange(n), log_prior,
    )  # fmt: skip


class World:
    """Many places. The scan fits the true one by l ~ N(m, 2m), every other by l ~ N(-m, 2m): then l is exactly the
    logarithm of the likelihood ratio. Both, and the error of the aligned pose, change slowly along the way.
    """

    def __init__(self, seed: int, *, places: int = 400, level: float = 14.0, twins: Sequence[Array] = ()) -> None:
        self.rng = np.random.default_rng(seed)
        self.places, self.level, self.twins, self.on_map, self.found = places, level, len(twins), True, 0.9
        self.correlation, self.error_m = CONFIG.measurement_error_correlation, CONFIG.measurement_correlation_m
        self.way_m, self.common = 0.0, self.rng.standard_normal(3)
        self.carry_away()
        for row, offset in enumerate(twins, 1):
            self.poses[row] = compose(self.poses[0], offset)

    def carry_away(self) -> None:
        """Put the robot somewhere else."""
        corner = self.rng.uniform(0, 1500, (self.places, 2))
        self.poses = np.column_stack([corner, self.rng.uniform(-np.pi, np.pi, self.places)])
        # Random waves along the way, whose correlation adds up to some 20 m.
        self.waves = self.rng.standard_normal((self.places, 8)) / 8.0
        self.phases = self.rng.uniform(0, 2 * np.pi, (self.places, 8))

    @property
    def truth(self) -> Array:
        pose: Array = self.poses[0]
        return pose

    def drive(self, delta: Array) -> None:
        self.poses = compose(self.poses, delta)
        length = math.hypot(delta[0], delta[1])
        self.way_m += length
        kept = math.exp(-length / self.error_m)
        self.common = kept * self.common + math.sqrt(1 - kept**2) * self.rng.standard_normal(3)

    def levels(self) -> Array:
        waves = np.cos(self.waves * self.way_m + self.phases).sum(axis=1) / 2.0
        level = -self.level + math.sqrt(2 * self.level) * waves
        if self.on_map:
            level[: 1 + self.twins] = level[0] + 2 * self.level
        return np.asarray(level + 0.5 * self.rng.standard_normal(self.places))

    def scan(self, looked_at: Hypotheses, candidates: int = 12) -> AlignedPoses:
        """Align a scan around the best candidates, of which the true one may be missing, and around hypotheses."""
        levels = self.levels()
        fitting = 1 + self.twins if self.on_map else 0
        rows = [r for r in np.argsort(-levels)[:candidates] if r >= fitting or self.rng.random() < self.found]
        poses, level = [self.poses[r] for r in rows], [levels[r] for r in rows]
        for h in range(len(looked_at)):
            at = np.append(looked_at.grid[h, :2], looked_at.heading_rad[h])
            off = self.poses - at
            off[:, 2] = wrap(off[:, 2])
            around = looked_at.covariance[h] + np.diag([1.0, 1.0, 0.02])
            near = np.flatnonzero(np.einsum("ni,ij,nj->n", off, np.linalg.inv(around), off) < 16)
            if len(near):
                rows.append(near[np.argmax(levels[near])])
                poses.append(self.poses[rows[-1]])
                level.append(levels[rows[-1]])
            else:
                rows.append(self.places)
                poses.append(self.rng.multivariate_normal(at, looked_at.covariance[h]))
                level.append(-self.level + math.sqrt(2 * self.level) * self.rng.standard_normal())
        share = self.correlation
        error = STD * (math.sqrt(share) * self.common + math.sqrt(1 - share) * self.rng.standard_normal(3))
        stack = np.array(poses).reshape(-1, 3)
        stack[np.array(rows, dtype=np.int64) < fitting] += error
        return aligned_at(stack, level, -math.log(self.places))


@dataclass
class Step:
    """What was believed after a scan, and what was so."""

    way_m: float
    belief: Belief
    error: Array

    @property
    def error_m(self) -> float:
        return math.hypot(self.error[0], self.error[1])

    @property
    def nees(self) -> float:
        return float(self.error @ np.linalg.solve(self.belief.covariance, self.error))


def odometry(world: World, delta: Array) -> Motion:
    """Tell a motion with errors as large as they are said to be."""
    covariance = motion_covariance(math.hypot(delta[0], delta[1]), abs(delta[2]), CONFIG)
    return Motion(world.rng.multivariate_normal(delta, covariance), covariance)


def travel(
    world: World,
    tracker: Tracker,
    scans: int,
    told: Callable[[World, Array], Motion | None] = odometry,
    delta: Array = AHEAD,
) -> list[Step]:
    """Drive on, a scan every `delta` and half a second."""
    steps = []
    for _ in range(scans):
        stamp_ns = 0 if tracker.stamp_ns is None else tracker.stamp_ns + SECOND // 2
        bent = delta + np.array([0.0, 0.0, 0.03 * math.sin(world.way_m / 7)])
        motion = None
        if tracker.stamp_ns is not None:
            world.drive(bent)
            motion = told(world, bent)
        belief = tracker.update(world.scan(tracker.predict(stamp_ns, motion)))
        error = np.append(belief.grid[:2], belief.heading_rad) - world.truth
        error[2] = wrap(error[2])
        steps.append(Step(world.way_m, belief, error))
    return steps


def localized(seed: int, **kwargs: float) -> tuple[World, Tracker]:
    """Return a robot that knows where it is."""
    world, tracker = World(seed, level=20.0, **kwargs), Tracker(CONFIG)  # type: ignore[arg-type]
    assert any(step.belief.is_fix for step in travel(world, tracker, 40))
    return world, tracker


def fixes(steps: Sequence[Step]) -> list[Step]:
    return [step for step in steps if step.belief.is_fix]


def wrong_fixes(steps: Sequence[Step]) -> list[Step]:
    return [step for step in fixes(steps) if step.error_m > 10]


# One scan


def test_a_robot_that_has_seen_nothing_believes_nothing() -> None:
    tracker = Tracker(CONFIG)
    for k in range(20):
        assert len(tracker.predict(k * SECOND, None)) == 0
        belief = tracker.update(no_aligned_poses())
        assert (belief.state, belief.is_fix, belief.probability) == (TrackState.SEARCHING, False, 0.0)
        assert np.isnan(belief.grid).all()
        assert np.isnan(belief.heading_rad)
        assert "nothing in the map fits" in belief.reason


@given(st.lists(st.floats(-20, 20), min_size=1, max_size=9))
def test_after_one_scan_the_belief_is_that_of_the_scan_alone(levels: list[float]) -> None:
    config = FusionConfig(clutter_probability=1e-6, max_log_likelihood=1000.0)
    aligned = aligned_at([(100.0 * i, 0, 0) for i in range(len(levels))], levels)
    tracker = Tracker(config)
    tracker.predict(0, None)
    hypotheses = tracker.update(aligned).hypotheses
    for grid, probability in zip(hypotheses.grid, hypotheses.probabilities, strict=True):
        assert probability == pytest.approx(aligned.probabilities[round(grid[0] / 100)], rel=1e-4, abs=1e-8)
    held = aligned.probabilities[aligned.probabilities > 1e-8]
    assert len(hypotheses) >= len(held)


def test_a_pose_found_twice_counts_once() -> None:
    once, twice = Tracker(CONFIG), Tracker(CONFIG)
    for tracker in (once, twice):
        tracker.predict(0, None)
    single = once.update(aligned_at([(0, 0, 0)], [8.0]))
    double = twice.update(aligned_at([(0, 0, 0), (0.05, 0, 0)], [8.0, 7.9]))
    assert double.probability == pytest.approx(single.probability)
    assert len(double.hypotheses) == 1


def test_however_well_a_scan_fits_it_is_no_proof_but_tells_places_apart() -> None:
    tracker = Tracker(FusionConfig(max_log_likelihood=12.0))
    tracker.predict(0, None)
    belief = tracker.update(aligned_at([(0, 0, 0), (200, 0, 0)], [80.0, 77.0]))
    none = 1 - belief.hypotheses.probabilities.sum()
    assert belief.hypotheses.probabilities[0] / none == pytest.approx(math.exp(12.0 - 8.0), rel=0.1)
    assert belief.hypotheses.probabilities[0] / belief.hypotheses.probabilities[1] == pytest.approx(math.e**3, rel=0.1)


# Evidence


def stand(tracker: Tracker, levels: Sequence[float], poses: Sequence[Sequence[float]] = ((0, 0, 0),)) -> Belief:
    for k, level in enumerate(levels):
        tracker.predict(k * SECOND // 10, Motion(np.zeros(3), motion_covariance(0, 0, CONFIG)))
        belief = tracker.update(aligned_at(poses, [level] * len(poses)))
    return belief


def test_standing_still_adds_no_evidence() -> None:
    first = stand(Tracker(CONFIG), [8.0])
    later = stand(Tracker(CONFIG), [8.0] * 200)
    assert first.probability == pytest.approx(0.5, abs=0.02)
    assert later.probability == pytest.approx(first.probability, abs=0.15)


def test_scans_of_one_spot_count_by_their_average() -> None:
    rng = np.random.default_rng(0)
    noisy = stand(Tracker(CONFIG), [8.0, *(8.0 + 4.0 * rng.standard_normal(300))])
    assert noisy.probability < 0.95, "the luckiest of 300 scans would be believed 99.99 %"
    disappointed = stand(Tracker(CONFIG), [16.0, *[-2.0] * 30])
    assert disappointed.probability < 0.01, "one lucky scan, refuted by those that follow"


def test_evidence_grows_with_the_way() -> None:
    beliefs = []
    for length in (0.0, 10.0, 40.0):
        tracker, delta = Tracker(CONFIG), np.array([length / 20, 0, 0])
        for k in range(21):
            tracker.predict(k * SECOND, Motion(delta, motion_covariance(delta[0], 0, CONFIG)))
            belief = tracker.update(aligned_at([(k * delta[0], 0, 0)], [6.0]))
        beliefs.append(math.log(belief.probability / (1 - belief.probability)))
    # 10 m are half of a look more, 40 m two: each look tells 6.
    assert beliefs[1] - beliefs[0] == pytest.approx(3.0, abs=1.5)
    assert beliefs[2] - beliefs[0] == pytest.approx(12.0, abs=4.0)


def test_the_way_counts_and_not_the_number_of_scans_on_it() -> None:
    beliefs = []
    for scans in (10, 200):
        config = dataclasses.replace(CONFIG, odometry_relative_std=1e-3, odometry_drift_deg_per_m=0.0)
        tracker, delta = Tracker(config), np.array([30.0 / scans, 0, 0])
        for k in range(scans + 1):
            tracker.predict(k * 30 * SECOND // scans, Motion(delta, motion_covariance(delta[0], 0, config)))
            belief = tracker.update(aligned_at([(k * delta[0], 0, 0)], [5.0]))
        beliefs.append(math.log(belief.probability / (1 - belief.probability)))
    assert beliefs[1] == pytest.approx(beliefs[0], abs=1.0)


# The filter


def test_position_and_variance_are_those_of_least_squares_over_all_scans() -> None:
    """Oracle: the batch solution with the full covariance of errors that are alike over some metres."""
    config = dataclasses.replace(
        CONFIG,
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
    errors = STD[0] ** 2 * (common + 0.3 * np.eye(n))
    z = step_m * np.arange(n) + rng.multivariate_normal(np.zeros(n), errors)
    tracker = Tracker(config)
    for k in range(n):
        tracker.predict(k * SECOND, Motion(np.array([step_m, 0, 0]), np.diag([noise**2, 1e-8, 1e-12])))
        belief = tracker.update(aligned_at([(z[k], 0, 0)], [12.0]))
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
    std: float, heading: float, forward: float, turn: float
) -> None:
    rng = np.random.default_rng(0)
    tracker = Tracker(dataclasses.replace(CONFIG, odometry_relative_std=1e-4, odometry_drift_deg_per_m=0.0))
    prior = np.array([[0.5, 0.1, 0.1 * std], [0.1, 0.3, 0.0], [0.1 * std, 0.0, std**2]])
    tracker.set_prior(PosePrior(np.array([10.0, 20.0, 0.0]), heading, prior, 0))
    tracker.predict(0, None)
    hypotheses = tracker.predict(SECOND, Motion(np.array([forward, 0.5, turn]), np.diag([1e-6, 1e-6, 1e-8])))
    samples = compose(rng.multivariate_normal([10, 20, heading], prior, 200_000), np.array([forward, 0.5, turn]))
    off = samples - np.append(hypotheses.grid[0, :2], hypotheses.heading_rad[0])
    off[:, 2] = wrap(off[:, 2])
    scale = 0.5 + 0.02 * forward**2
    np.testing.assert_allclose(off[:, :2].mean(axis=0), 0.0, atol=0.03 * scale + 0.01)
    np.testing.assert_allclose(hypotheses.covariance[0, :2, :2], np.cov(off[:, :2].T), atol=0.06 * scale)


def test_turning_and_moving_the_world_turns_and_moves_the_estimate() -> None:
    turn, shift = 1.1, np.array([500_000.0, 4_000_000.0])
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    here, there = World(5), Tracker(CONFIG)
    tracker = Tracker(CONFIG)
    for k in range(15):
        motion = odometry(here, AHEAD)
        if k:
            here.drive(AHEAD)
        scan = here.scan(tracker.predict(k * SECOND, motion))
        belief = tracker.update(scan)
        there.predict(k * SECOND, motion)
        grid = np.column_stack([scan.grid[:, :2] @ rotation.T + shift, scan.grid[:, 2]])
        poses = np.column_stack([grid[:, :2], wrap(scan.heading_rad + turn)])
        other = there.update(aligned_at(poses, scan.log_likelihood, scan.log_prior))
    np.testing.assert_allclose(other.grid[:2], rotation @ belief.grid[:2] + shift, atol=1e-5)
    assert other.probability == pytest.approx(belief.probability, rel=1e-5)
    turned = rotation @ belief.covariance[:2, :2] @ rotation.T
    np.testing.assert_allclose(other.covariance[:2, :2], turned, rtol=1e-4, atol=1e-9)


# Drives


def test_it_finds_itself_and_knows_how_well() -> None:
    config = dataclasses.replace(CONFIG, map_std_m=0.1)  # the map of these worlds has no errors of its own
    steps = [step for seed in range(6) for step in travel(World(seed), Tracker(config), 60)]
    found = [min(s.way_m for s in fixes(steps[60 * i : 60 * i + 60])) for i in range(6)]
    assert np.median(found) < 20
    assert not wrong_fixes(steps)
    good = fixes(steps)
    assert len(good) > 200
    inside = np.array([np.abs(step.error) < 2 * np.sqrt(np.diag(step.belief.covariance)) for step in good])
    assert 0.90 <= inside[:, :2].mean() <= 0.995
    # Normalized squared errors of three numbers: 3 on average, where the covariance is what it says; less is cautious.
    assert 1.5 < np.mean([step.nees for step in good]) < 3.6
    assert np.median([step.error_m for step in good]) < 0.4


@pytest.mark.slow
@pytest.mark.parametrize(("correlation", "error_m"), [(0.8, 5.0), (0.0, 5.0), (0.8, 15.0)])
def test_the_covariance_holds_where_errors_are_of_another_kind_than_thought(correlation: float, error_m: float) -> None:
    steps = []
    for seed in range(12):
        world = World(100 + seed, level=20.0)
        world.correlation, world.error_m = correlation, error_m
        steps += fixes(travel(world, Tracker(CONFIG), 100))
    inside = np.array([np.abs(step.error[:2]) < 2 * np.sqrt(np.diag(step.belief.covariance)[:2]) for step in steps])
    # Errors that change faster than thought average out faster, too: then it is cautious, but not beyond all measure.
    assert 0.90 <= inside.mean() < 1.0


def test_places_that_look_the_same_are_not_told_apart_by_hope() -> None:
    for seed in range(3):
        world, tracker = World(seed, level=20.0, twins=[np.array([60.0, 30.0, 1.0])]), Tracker(CONFIG)
        steps = travel(world, tracker, 40)
        assert not fixes(steps)
        assert steps[-1].belief.state is TrackState.AMBIGUOUS
        assert "67 m away" in steps[-1].belief.reason
        world.twins = 0  # from here on the places differ
        later = travel(world, tracker, 40)
        assert fixes(later)
        assert not wrong_fixes(later)


def test_a_place_that_the_search_missed_at_first_is_granted_what_it_would_have_told() -> None:
    tracker = Tracker(CONFIG)
    here, missed = np.array([0.0, 0.0, 0.0]), np.array([500.0, 80.0, 2.0])
    for k in range(31):
        tracker.predict(k * SECOND, Motion(AHEAD, motion_covariance(1.0, 0.0, CONFIG)))
        poses = [here, missed] if k >= 15 else [here]
        belief = tracker.update(aligned_at(poses, [8.0] * len(poses)))
        here, missed = compose(here, AHEAD), compose(missed, AHEAD)
    # It fits as well since it was found: only that it was missed for 15 m speaks against it.
    odds = belief.hypotheses.probabilities[1] / belief.hypotheses.probabilities[0]
    assert odds == pytest.approx((1 - CONFIG.detection_probability) ** (15 / CONFIG.novelty_m), rel=0.5)
    assert not belief.is_fix


def test_a_robot_that_is_carried_away_is_found_again() -> None:
    ways = []
    for seed in range(3):
        world, tracker = localized(seed)
        away = world.way_m
        world.carry_away()
        steps = travel(world, tracker, 60)
        assert not wrong_fixes(steps)
        assert not steps[0].belief.is_fix, "the very first scan does not fit"
        ways.append(fixes(steps)[0].way_m - away)
    assert np.median(ways) < 30


def test_a_robot_that_leaves_the_map_gets_no_fix_there_and_is_found_when_it_is_back() -> None:
    for seed in range(2):
        world, tracker = localized(seed)
        world.on_map = False
        steps = travel(world, tracker, 50)
        assert not fixes(steps)[5:], "at most over some metres, by odometry"
        assert steps[-1].belief.state is TrackState.LOST
        assert "no longer fits" in steps[-1].belief.reason
        world.on_map = True
        assert fixes(travel(world, tracker, 60))


@pytest.mark.parametrize("delta", [AHEAD, np.zeros(3)])
def test_outside_of_the_map_there_is_no_fix(delta: Array) -> None:
    for seed in range(2):
        world = World(seed)
        world.on_map = False
        steps = travel(world, Tracker(CONFIG), 100, delta=delta)
        assert not fixes(steps)
        assert np.mean([step.belief.probability for step in steps]) < 0.1


def test_a_truck_before_the_sensor_costs_the_fix_only_while_it_is_there() -> None:
    world, tracker = localized(1)
    standing = np.zeros(3)
    travel(world, tracker, 5, delta=standing)
    world.on_map = False
    travel(world, tracker, 3, delta=standing)
    world.on_map = True
    steps = travel(world, tracker, 30, delta=standing)
    assert steps[-1].belief.is_fix
    assert steps[-1].error_m < 1


# Odometry that fails


def test_odometry_that_tells_a_fifth_too_much_is_seen_through() -> None:
    steps = []
    for seed in range(4):
        world, tracker = World(seed, level=20.0), Tracker(CONFIG)
        steps += travel(world, tracker, 60, lambda w, d: odometry(w, d * [1.2, 1.2, 1.0]))
    good = fixes(steps)
    assert len(good) > 100
    assert not wrong_fixes(steps)
    inside = np.array([np.abs(step.error[:2]) < 2 * np.sqrt(np.diag(step.belief.covariance)[:2]) for step in good])
    assert inside.mean() > 0.9
    assert "% too long" in good[-1].belief.reason


def test_odometry_that_stands_still_while_the_robot_drives_makes_no_wrong_fix() -> None:
    world, tracker = localized(2)
    steps = travel(world, tracker, 40, lambda w, d: odometry(w, np.zeros(3)))
    assert not wrong_fixes(steps)
    assert any("disagree" in step.belief.reason for step in steps) or not steps[-1].belief.is_fix
    assert fixes(travel(world, tracker, 60)), "good again"


def test_a_small_jump_of_the_odometry_is_bridged() -> None:
    world, tracker = localized(3)
    steps = travel(world, tracker, 1, lambda w, d: odometry(w, d + np.array([1.5, 1.0, 0.0])))
    steps += travel(world, tracker, 10)
    assert not [step for step in steps if step.error_m > 3]
    assert steps[-1].belief.is_fix


@pytest.mark.parametrize(
    ("told", "reason"),
    [
        (lambda w, d: None, "there is no odometry"),
        (lambda w, d: unknown_motion("the odometry has a gap of 2 s"), "the odometry has a gap of 2 s"),
        (lambda w, d: Motion(np.full(3, np.nan), np.eye(3)), "the odometry is not a number"),
        (lambda w, d: Motion(np.array([300.0, 0, 0]), np.eye(3)), "faster than the robot"),
    ],
)
def test_no_fix_rests_on_an_unknown_stretch(told: Callable[[World, Array], Motion | None], reason: str) -> None:
    world, tracker = localized(4)
    before = tracker.predict(tracker.stamp_ns or 0, None).covariance[0]
    [step] = travel(world, tracker, 1, told)
    assert not step.belief.is_fix
    assert reason in step.belief.reason
    assert before[0, 0] < 1
    steps = travel(world, tracker, 40)
    assert not wrong_fixes(steps)
    first = fixes(steps)[0].way_m - step.way_m
    assert first >= CONFIG.confirm_m


def test_over_an_unknown_stretch_the_belief_is_as_wide_as_the_robot_could_drive() -> None:
    world, tracker = localized(5)
    stamp_ns = tracker.stamp_ns
    assert stamp_ns is not None
    hypotheses = tracker.predict(stamp_ns + 2 * SECOND, unknown_motion("a gap"))
    assert hypotheses.covariance[0, 0, 0] >= CONFIG.max_speed_mps**2
    away = travel(world, tracker, 1, lambda w, d: unknown_motion("a gap"))[0].belief
    assert not away.is_fix
    hypotheses = tracker.predict((tracker.stamp_ns or 0) + 600 * SECOND, unknown_motion("a long gap"))
    assert len(hypotheses) == 0, "after ten minutes it may be anywhere"
    assert not tracker.update(no_aligned_poses()).is_fix


def test_two_poses_within_an_unknown_stretch_are_both_believed() -> None:
    world, tracker = localized(6)
    at, stamp_ns = world.truth, tracker.stamp_ns
    assert stamp_ns is not None
    tracker.predict(stamp_ns + SECOND, unknown_motion("a gap"))
    both = [(at[0] + 6, at[1], at[2]), (at[0] - 6, at[1], at[2])]
    belief = tracker.update(aligned_at(both, [15.0, 15.0]))
    assert belief.state is TrackState.AMBIGUOUS
    np.testing.assert_allclose(sorted(belief.hypotheses.probabilities)[-2:], 0.5, atol=0.05)


# Time


def test_a_repeated_or_late_scan_changes_nothing() -> None:
    world, tracker = localized(7)
    stamp_ns = tracker.stamp_ns
    assert stamp_ns is not None
    before = tracker.predict(stamp_ns, None)
    for back_ns, reason in ((0, "the same stamp"), (SECOND // 2, "0.5 s older"), (2 * SECOND, "2 s older")):
        tracker.predict(stamp_ns - back_ns, odometry(world, AHEAD))
        belief = tracker.update(world.scan(before))
        assert not belief.is_fix
        assert reason in belief.reason
        assert tracker.stamp_ns == stamp_ns
    after = tracker.predict(stamp_ns, None)
    np.testing.assert_array_equal(after.grid, before.grid)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    np.testing.assert_array_equal(after.probabilities, before.probabilities)
    assert travel(world, tracker, 3)[-1].belief.is_fix


def test_a_recording_that_begins_anew_forgets() -> None:
    world, tracker = localized(8)
    assert len(tracker.predict(-3600 * SECOND, odometry(world, AHEAD))) == 0
    belief = tracker.update(no_aligned_poses())
    assert belief.state is TrackState.SEARCHING
    assert tracker.stamp_ns == -3600 * SECOND


def test_reset_forgets() -> None:
    _, tracker = localized(9)
    tracker.reset()
    assert tracker.stamp_ns is None
    assert len(tracker.predict(0, None)) == 0


# Priors


def test_a_given_pose_finds_the_robot_at_once_where_the_scan_agrees() -> None:
    world, tracker = World(11), Tracker(CONFIG)
    covariance = np.diag([1.0, 1.0, 0.1])
    tracker.set_prior(PosePrior(np.append(world.truth[:2], 2.0), world.truth[2], covariance, 0))
    assert np.hypot(*(tracker.predict(0, None).grid[0, :2] - world.truth[:2])) < 1e-6
    belief = tracker.update(aligned_at([world.truth], [12.0]))
    assert belief.is_fix
    np.testing.assert_allclose(belief.grid[:2], world.truth[:2], atol=0.2)


def test_a_given_pose_alone_is_no_fix_and_a_wrong_one_is_overcome() -> None:
    for seed in range(3):
        world, tracker = World(seed, level=20.0), Tracker(CONFIG)
        wrong = np.append(world.truth[:2] + 300.0, 2.0)
        tracker.set_prior(PosePrior(wrong, 0.3, np.diag([0.25, 0.25, 0.07]), 0))
        tracker.predict(0, None)
        assert not tracker.update(no_aligned_poses()).is_fix
        steps = travel(world, tracker, 60)
        assert fixes(steps)
        assert not wrong_fixes(steps)


def test_a_position_without_a_heading_is_looked_at_in_every_heading() -> None:
    tracker = Tracker(CONFIG)
    covariance = np.diag([25.0, 25.0, np.inf])
    tracker.set_prior(PosePrior(np.array([50.0, 60.0, 1.0]), None, covariance, 0))
    hypotheses = tracker.predict(0, None)
    assert math.sqrt(hypotheses.covariance[0, 2, 2]) > 1.5
    belief = tracker.update(aligned_at([(52.0, 58.0, -2.0), (400.0, 0.0, 1.0)], [10.0, 10.0]))
    np.testing.assert_allclose(belief.grid[:2], [52, 58], atol=0.5)
    assert belief.heading_rad == pytest.approx(-2.0, abs=0.2)


def test_a_compass_tells_two_headings_apart() -> None:
    beliefs = []
    for compass in (False, True):
        tracker = Tracker(CONFIG)
        if compass:
            tracker.set_prior(PosePrior(None, 0.1, np.diag([np.inf, np.inf, math.radians(15) ** 2]), 0))
        tracker.predict(0, None)
        beliefs.append(tracker.update(aligned_at([(0, 0, 0.0), (300, 0, math.pi)], [12.0, 12.0])))
    assert sorted(beliefs[0].hypotheses.probabilities) == pytest.approx([0.5, 0.5], abs=0.02)
    assert beliefs[1].hypotheses.probabilities[0] > 0.9
    assert beliefs[1].heading_rad == pytest.approx(0.0, abs=0.05)


# Nonsense


def test_poses_that_are_no_numbers_are_left_out() -> None:
    good = aligned_at([(0, 0, 0), (50, 0, 0), (90, 0, 0), (130, 0, 0)], [9.0, 9.0, 9.0, 9.0])
    good.grid[1, 0], good.log_likelihood[2], good.covariance[3] = np.nan, np.nan, np.inf
    tracker = Tracker(CONFIG)
    tracker.predict(0, None)
    belief = tracker.update(good)
    np.testing.assert_allclose(belief.hypotheses.grid, [[0, 0, 2]])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_whatever_comes_in_the_belief_is_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracker = Tracker(CONFIG)
    for k in range(12):
        n = int(rng.integers(0, 8))
        poses = np.column_stack([rng.normal(0, 10.0 ** rng.integers(0, 3), (n, 2)), rng.uniform(-9, 9, n)])
        aligned = aligned_at(poses, np.nan_to_num(rng.normal(0, 10.0 ** rng.integers(0, 4), n)), float(rng.normal()))
        wild = rng.normal(0, 10.0 ** rng.integers(-4, 4), (n, 3, 3))
        aligned.covariance[:] = wild  # not even symmetric
        if n and rng.random() < 0.2:
            aligned.log_likelihood[0] = rng.choice([np.nan, np.inf, -np.inf])
        motion = [None, unknown_motion("x"), Motion(rng.normal(0, 1, 3), np.diag(rng.uniform(0, 1, 3)))][k % 3]
        if rng.random() < 0.2:
            tracker.set_prior(PosePrior(rng.normal(0, 99, 3), None, np.diag([1.0, np.inf, np.inf]), 0))
        looked_at = tracker.predict(int(rng.integers(-3, 20)) * SECOND, motion)
        assert np.isfinite(looked_at.covariance).all()
        belief = tracker.update(aligned)
        assert 0 <= belief.probability <= 1 + 1e-9
        assert belief.hypotheses.probabilities.sum() <= 1 + 1e-9
        assert len(belief.hypotheses) <= CONFIG.max_hypotheses
        assert belief.reason
        if len(belief.hypotheses):
            assert np.linalg.eigvalsh(belief.covariance).min() > 0
            assert np.isfinite(belief.grid).all()
            assert -math.pi <= belief.heading_rad <= math.pi
