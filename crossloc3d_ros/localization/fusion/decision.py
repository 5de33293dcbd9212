"""Whether the mixture is a fix: the estimate, its probability, the state, and the reason as a sentence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.mixture import HEADING, POSE, POSITION, Mixture
from crossloc3d_ros.localization.fusion.null_hypothesis import NullHypothesis
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.localization.fusion.odometry_monitor import OdometryMonitor
from crossloc3d_ros.types import BoolArray, Float64Array, Hypotheses, TrackState, no_hypotheses

RIGHT_WITHIN_M = 10.0
"""An estimate is right where its horizontal error is below."""
_RIVAL_SHARE = 0.01  # of the leading pose's probability: what is less is not named to people


@dataclass(frozen=True, eq=False)
class Belief:
    """What the tracker believes after a scan."""

    state: TrackState
    reason: str
    """One sentence for people."""
    probability: float
    """That the horizontal error of `grid` is below 10 m."""
    grid: Float64Array
    """(3,) easting, northing, height of base, metres, grid frame; NaN without hypotheses."""
    heading_rad: float
    """Counter-clockwise from grid east; NaN without hypotheses."""
    covariance: Float64Array
    """(3, 3) of easting, northing, heading: m2, m rad, rad2; NaN without hypotheses."""
    hypotheses: Hypotheses
    is_fix: bool
    """Whether the estimate may be driven by."""


def no_belief(state: TrackState, reason: str) -> Belief:
    """Return the belief of a tracker without hypotheses."""
    return Belief(
        state, reason, 0.0, np.full(3, np.nan), math.nan, np.full((3, 3), np.nan), no_hypotheses(), is_fix=False
    )


@dataclass(frozen=True, eq=False)
class _Estimate:
    """The common moments of the likeliest hypothesis and those around it."""

    grid: Float64Array
    heading_rad: float
    covariance: Float64Array
    leader: int
    """Row of the likeliest hypothesis."""
    members: BoolArray
    """(n,) which hypotheses lie around it."""
    weights: Float64Array
    """(n,) probabilities of the hypotheses."""
    probability: float
    """That the horizontal error is below RIGHT_WITHIN_M."""
    explained_m: float
    """Distance over which one of the members explained the scans."""

    @property
    def share(self) -> float:
        """Probability of the members."""
        return float(self.weights[self.members].sum())


class FixDecision:
    """Decide scan after scan whether the estimate may be driven by."""

    def __init__(self) -> None:
        self._odometry = OdometryMonitor()
        self._was_localized = False
        self._unknown_motion = ""

    def add_motion(self, motion: Motion) -> None:
        """Take in the motion before a scan."""
        self._odometry.add_motion(motion)
        if not motion.is_known:
            self._unknown_motion = motion.reason

    def add_initial_pose(self) -> None:
        """Take in that the pose was given: earlier unknown motion no longer matters."""
        self._unknown_motion = ""

    def decide(self, mixture: Mixture, null: NullHypothesis, config: FusionConfig) -> Belief:
        """Return the belief that a mixture and the null hypothesis beside it are."""
        not_tracked = TrackState.LOST if self._was_localized else TrackState.SEARCHING
        if not len(mixture):
            return no_belief(not_tracked, "no pose on the map fits the scan")
        null_probability = math.exp(null.log_weight)
        estimate = _estimate(mixture, config)
        is_probable = estimate.probability >= config.min_probability
        is_fix = is_probable and estimate.explained_m >= config.confirm_m
        if is_fix:
            self._was_localized, self._unknown_motion = True, ""
            self._odometry.add_fix(estimate.grid[:2], RIGHT_WITHIN_M)
            state = TrackState.LOCALIZED
            reason = f"localized: {_probability_of_fix(estimate)}" + self._odometry.fault(
                mixture, estimate.leader, config
            )
        else:
            self._odometry.add_no_fix()
            if null_probability < 0.5:
                state, reason = TrackState.AMBIGUOUS, _why_no_fix(mixture, estimate, is_probable, config)
                reason += self._odometry.fault(mixture, estimate.leader, config)
            else:
                state, reason = not_tracked, self._why_not_tracked(null_probability)
            if self._unknown_motion:
                reason += f", since the motion was unknown: {self._unknown_motion}"
        return Belief(
            state, reason, estimate.probability, estimate.grid, estimate.heading_rad, estimate.covariance,
            mixture.as_hypotheses(), is_fix,
        )  # fmt: skip

    def _why_not_tracked(self, null_probability: float) -> str:
        what = "the tracked pose no longer fits the scans" if self._was_localized else "no pose fits the scans well"
        return f"{what}: probability {_percent(null_probability)} that the robot is at none of the poses found"


def _why_no_fix(mixture: Mixture, estimate: _Estimate, is_probable: bool, config: FusionConfig) -> str:
    """Return why hypotheses that are likelier than the null hypothesis are no fix."""
    if is_probable:
        return (
            f"{_probability_of_fix(estimate)}, but the pose has explained the scans over only"
            f" {estimate.explained_m:.1f} m of the {config.confirm_m:g} m needed"
        )
    weights, share, leader = estimate.weights, estimate.share, estimate.leader
    rivals = np.flatnonzero(~estimate.members & (weights > _RIVAL_SHARE * share))
    if len(rivals) and weights[rivals].sum() > 0.5 * (1.0 - share):
        rival = rivals[np.argmax(weights[rivals])]
        apart_m = float(np.hypot(*(mixture.mean[leader] - mixture.mean[rival])[POSITION]))
        return (
            f"{1 + len(rivals)} places fit the scans: probability {_percent(share)} of the likeliest,"
            f" {_percent(weights[rival])} of one {apart_m:.0f} m away"
        )
    if estimate.probability < 0.9 * share:
        std_m = float(np.sqrt(np.linalg.eigvalsh(mixture.covariance[leader, POSITION, POSITION])[1]))
        return f"probability {_percent(share)} of one place, but its standard deviation is {std_m:.1f} m"
    return f"{_probability_of_fix(estimate)}, {_percent(config.min_probability)} needed"


def _estimate(mixture: Mixture, config: FusionConfig) -> _Estimate:
    weights = np.exp(mixture.log_weight)
    leader = int(np.argmax(weights))
    off = mixture.mean[:, POSE] - mixture.mean[leader, POSE]
    off[:, HEADING] = wrap(off[:, HEADING])
    members: BoolArray = np.hypot(off[:, 0], off[:, 1]) < RIGHT_WITHIN_M
    shares = weights[members] / weights[members].sum()
    middle = shares @ off[members]
    rest = off[members] - middle
    covariance = np.einsum("b,bij->ij", shares, mixture.covariance[members, POSE, POSE])
    covariance = covariance + (rest * shares[:, None]).T @ rest
    covariance += np.diag(np.square([config.map_std_m, config.map_std_m, math.radians(config.map_std_deg)]))
    pose = mixture.mean[leader, POSE] + middle
    grid = np.array([pose[0], pose[1], float(shares @ mixture.height[members])])
    return _Estimate(
        grid=grid,
        heading_rad=float(wrap(pose[HEADING])),
        covariance=covariance,
        leader=leader,
        members=members,
        weights=weights,
        probability=_probability(mixture, weights, grid, config),
        explained_m=float(mixture.explained_m[members].max()),
    )


def _probability(mixture: Mixture, weights: Float64Array, grid: Float64Array, config: FusionConfig) -> float:
    """Return a lower bound of the probability that the robot is within RIGHT_WITHIN_M of a position.

    Of each hypothesis a circle around its own mean counts, as large as the circle around the position holds.
    """
    off = np.hypot(*(mixture.mean[:, POSITION] - grid[:2]).T)
    variance = mixture.covariance[:, POSITION, POSITION] + np.eye(2) * config.map_std_m**2
    largest = np.linalg.eigvalsh(variance)[:, 1]
    inside = -np.expm1(-0.5 * np.maximum(RIGHT_WITHIN_M - off, 0.0) ** 2 / largest)
    return float(weights @ inside)


def _probability_of_fix(estimate: _Estimate) -> str:
    return f"probability {_percent(estimate.probability)} of an error below {RIGHT_WITHIN_M:g} m"


def _percent(probability: float) -> str:
    """Write a probability so that 99.95 % and 100 % differ."""
    return (
        f"{100.0 * probability:.3g} %" if probability < 0.99 else f"{100.0 * math.floor(probability * 1e5) / 1e5:.5g} %"
    )
