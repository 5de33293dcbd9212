"""Worlds in which it is known how likely everything is, and drives through them."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import numpy.typing as npt
import pytest

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.decision import Belief
from crossloc3d_ros.localization.fusion.odometry import Motion, motion_covariance
from crossloc3d_ros.localization.fusion.tracker import Tracker
from crossloc3d_ros.types import AlignedPoses, Hypotheses

Array = npt.NDArray[np.float64]

# As the worlds below are, which need not be as the defaults are.
CONFIG = FusionConfig(
    null_log_likelihood=0.0,  # the log likelihoods of these worlds are those of independent scans
    novelty_m=20.0, confirm_m=3.0, measurement_std_scale=1.0, measurement_error_correlation=0.8,
    measurement_correlation_m=5.0, measurement_min_std_m=0.1, measurement_min_std_deg=0.2,
)  # fmt: skip
SECOND = 1_000_000_000
AHEAD = np.array([1.0, 0.0, 0.0])
STD = np.array([0.25, 0.25, 0.01])


def compose(poses: Array, delta: Array) -> Array:
    """Move poses (..., 3) by `delta` (3,), given in each one's own frame."""
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
    logarithm of the likelihood ratio. Both, and the error of the aligned pose, change slowly with the distance
    travelled.
    """

    def __init__(self, seed: int, *, places: int = 400, level: float = 14.0, twins: Sequence[Array] = ()) -> None:
        self.rng = np.random.default_rng(seed)
        self.places, self.level, self.twins, self.on_map, self.found = places, level, len(twins), True, 0.9
        self.correlation, self.error_m = CONFIG.measurement_error_correlation, CONFIG.measurement_correlation_m
        self.travelled_m, self.common = 0.0, self.rng.standard_normal(3)
        self.kidnap()
        for row, offset in enumerate(twins, 1):
            self.poses[row] = compose(self.poses[0], offset)

    def kidnap(self) -> None:
        """Put the robot somewhere else."""
        corner = self.rng.uniform(0, 1500, (self.places, 2))
        self.poses = np.column_stack([corner, self.rng.uniform(-np.pi, np.pi, self.places)])
        # Random waves over the distance travelled, whose correlation adds up to some 20 m.
        self.waves = self.rng.standard_normal((self.places, 8)) / 8.0
        self.phases = self.rng.uniform(0, 2 * np.pi, (self.places, 8))

    @property
    def truth(self) -> Array:
        pose: Array = self.poses[0]
        return pose

    def drive(self, delta: Array) -> None:
        self.poses = compose(self.poses, delta)
        length = math.hypot(delta[0], delta[1])
        self.travelled_m += length
        kept = math.exp(-length / self.error_m)
        self.common = kept * self.common + math.sqrt(1 - kept**2) * self.rng.standard_normal(3)

    def levels(self) -> Array:
        waves = np.cos(self.waves * self.travelled_m + self.phases).sum(axis=1) / 2.0
        level = -self.level + math.sqrt(2 * self.level) * waves
        if self.on_map:
            level[: 1 + self.twins] = level[0] + 2 * self.level
        return np.asarray(level + 0.5 * self.rng.standard_normal(self.places))

    def scan(self, hypotheses: Hypotheses, candidates: int = 12) -> AlignedPoses:
        """Align a scan around the best candidates, of which the true one may be missing, and around hypotheses."""
        levels = self.levels()
        fitting = 1 + self.twins if self.on_map else 0
        rows = [r for r in np.argsort(-levels)[:candidates] if r >= fitting or self.rng.random() < self.found]
        poses, level = [self.poses[r] for r in rows], [levels[r] for r in rows]
        for h in range(len(hypotheses)):
            at = np.append(hypotheses.grid[h, :2], hypotheses.heading_rad[h])
            off = self.poses - at
            off[:, 2] = wrap(off[:, 2])
            around = hypotheses.covariance[h] + np.diag([1.0, 1.0, 0.02])
            near = np.flatnonzero(np.einsum("ni,ij,nj->n", off, np.linalg.inv(around), off) < 16)
            if len(near):
                rows.append(near[np.argmax(levels[near])])
                poses.append(self.poses[rows[-1]])
                level.append(levels[rows[-1]])
            else:
                rows.append(self.places)
                poses.append(self.rng.multivariate_normal(at, hypotheses.covariance[h]))
                level.append(-self.level + math.sqrt(2 * self.level) * self.rng.standard_normal())
        share = self.correlation
        error = STD * (math.sqrt(share) * self.common + math.sqrt(1 - share) * self.rng.standard_normal(3))
        stack = np.array(poses).reshape(-1, 3)
        stack[np.array(rows, dtype=np.int64) < fitting] += error
        return aligned_at(stack, level, -math.log(self.places))


@dataclass
class Step:
    """What was believed after a scan, and what was so."""

    travelled_m: float
    belief: Belief
    error: Array

    @property
    def error_m(self) -> float:
        return math.hypot(self.error[0], self.error[1])

    @property
    def nees(self) -> float:
        return float(self.error @ np.linalg.solve(self.belief.covariance, self.error))


def odometry(world: World, delta: Array) -> Motion:
    """Report a motion with errors as large as its covariance says."""
    covariance = motion_covariance(math.hypot(delta[0], delta[1]), abs(delta[2]), CONFIG)
    return Motion(world.rng.multivariate_normal(delta, covariance), covariance)


def travel(
    world: World,
    tracker: Tracker,
    scans: int,
    reported: Callable[[World, Array], Motion | None] = odometry,
    delta: Array = AHEAD,
) -> list[Step]:
    """Drive on, a scan every `delta` and half a second."""
    steps = []
    for _ in range(scans):
        stamp_ns = 0 if tracker.stamp_ns is None else tracker.stamp_ns + SECOND // 2
        bent = delta + np.array([0.0, 0.0, 0.03 * math.sin(world.travelled_m / 7)])
        motion = None
        if tracker.stamp_ns is not None:
            world.drive(bent)
            motion = reported(world, bent)
        belief = tracker.update(world.scan(tracker.predict(stamp_ns, motion)))
        error = np.append(belief.grid[:2], belief.heading_rad) - world.truth
        error[2] = wrap(error[2])
        steps.append(Step(world.travelled_m, belief, error))
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


@pytest.fixture(scope="session")
def worlds() -> ModuleType:
    """Give the functions of this file to the tests beside it."""
    return sys.modules[__name__]
