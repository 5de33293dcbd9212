"""The Gaussian mixture over the poses that the robot may have, each with the errors that last from scan to scan."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.linear_algebra import (
    diagonal,
    log_sum,
    mahalanobis_squared,
    pose_offsets,
    square_root,
)
from crossloc3d_ros.types import BoolArray, Float64Array, Hypotheses, Int64Array

# The state of a hypothesis.
POSITION = slice(0, 2)
"""Easting and northing, metres."""
HEADING = 2
"""Radians, counter-clockwise from grid east."""
POSE = slice(0, 3)
COMMON_ERROR = slice(3, 6)
"""The error that successive aligned poses have in common, in units of its standard deviation."""
ODOMETRY_SCALE = 6
"""By which share the odometry's distances are too short."""
ODOMETRY_DRIFT = 7
"""By how many radians a metre the odometry turns too little."""
LASTING_ERRORS = slice(3, 8)
STATE_SIZE = 8

SAME_POSE = 1.0
"""Squared Mahalanobis distance below which two poses are one: they differ by less than one standard deviation."""
_MERGE_STD = np.diag([0.1**2, 0.1**2, math.radians(0.5) ** 2])  # nearer poses differ by rounding and cells alone
_CONSIDERED = 4  # times as many as are kept: enough for the branches of each to merge


@dataclass(frozen=True, eq=False)
class Mixture:
    """n weighted Gaussians over the pose and the errors that last."""

    mean: Float64Array
    """(n, 8): POSE, COMMON_ERROR, ODOMETRY_SCALE, ODOMETRY_DRIFT."""
    covariance: Float64Array
    """(n, 8, 8)."""
    height: Float64Array
    """(n,) metres, grid frame."""
    log_weight: Float64Array
    """(n,) natural logarithms, beside that of the null hypothesis."""
    mean_log_likelihood: Float64Array
    """(n,) of the scans of the present spot."""
    scan_count: Float64Array
    """(n,) how many scans of the spot that mean stands for."""
    accumulated: Float64Array
    """(n,) log likelihood of the spots before, since the hypothesis was born."""
    explained_m: Float64Array
    """(n,) distance over which it explained the scans, since it was born or since the motion was unknown."""
    nis: Float64Array
    """(n,) running mean of the normalized innovation squared over its expectation: 1 for a consistent filter."""
    process_noise_scale: Float64Array
    """(n,) factor on the odometry's covariance: 1 where the innovations are consistent."""

    def __len__(self) -> int:
        return len(self.height)

    def take(self, rows: Int64Array | BoolArray) -> Mixture:
        """Return the hypotheses of some rows."""
        return Mixture(*(values[rows] for values in vars(self).values()))

    def join(self, other: Mixture) -> Mixture:
        """Return these hypotheses and then the others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Mixture(*(np.concatenate(pair) for pair in pairs))

    def scaled(self, log_factor: float) -> Mixture:
        """Return the hypotheses with their weights multiplied by a factor, given by its logarithm."""
        return dataclasses.replace(self, log_weight=self.log_weight + log_factor)

    def by_weight(self) -> Mixture:
        """Return the hypotheses, likeliest first."""
        return self.take(np.argsort(-self.log_weight, kind="stable"))

    def as_hypotheses(self) -> Hypotheses:
        """Return poses and probabilities, in the same order."""
        return Hypotheses(
            grid=np.column_stack([self.mean[:, POSITION], self.height]),
            heading_rad=wrap(self.mean[:, HEADING]),
            covariance=self.covariance[:, POSE, POSE],
            probabilities=np.exp(self.log_weight),
        )


def no_mixture(config: FusionConfig) -> Mixture:
    """Return a mixture of no hypothesis."""
    nothing = np.empty(0)
    return new_hypotheses(np.empty((0, 3)), nothing, np.empty((0, 3, 3)), nothing, config)


def new_hypotheses(
    grid: Float64Array,
    heading_rad: Float64Array,
    covariance: Float64Array,
    log_weight: Float64Array,
    config: FusionConfig,
    log_likelihood: Float64Array | None = None,
) -> Mixture:
    """Return hypotheses born at poses (n, ...): aligned ones, where their `log_likelihood` (n,) is given.

    The errors of aligned poses are in part those that the next aligned poses will have.
    """
    n = len(grid)
    joint = np.zeros((n, STATE_SIZE, STATE_SIZE))
    joint[:, POSE, POSE] = covariance
    diagonal(joint)[:, LASTING_ERRORS] = lasting_variances(config)
    if log_likelihood is not None:
        # The pose is off by what the alignment is off, with the other sign.
        root = math.sqrt(config.measurement_error_correlation) * square_root(covariance)
        joint[:, POSE, COMMON_ERROR], joint[:, COMMON_ERROR, POSE] = -root, -root
    return Mixture(
        mean=np.column_stack([grid[:, :2], heading_rad, np.zeros((n, STATE_SIZE - 3))]),
        covariance=joint,
        height=grid[:, 2],
        log_weight=log_weight,
        mean_log_likelihood=np.zeros(n) if log_likelihood is None else log_likelihood,
        scan_count=np.ones(n),
        accumulated=np.zeros(n),
        explained_m=np.zeros(n),
        nis=np.ones(n),
        process_noise_scale=np.ones(n),
    )


def lasting_variances(config: FusionConfig) -> Float64Array:
    """Return the variances (5,) of the errors that last, as they are before any measurement."""
    drift = math.radians(config.odometry_drift_deg_per_m)
    return np.array([1.0, 1.0, 1.0, config.odometry_relative_std**2, drift**2])


def merge(mixture: Mixture, most: int) -> Mixture:
    """Return the mixture with hypotheses of one pose merged, by their common moments, and the `most` likeliest kept."""
    mixture = mixture.by_weight().take(np.arange(min(len(mixture), _CONSIDERED * most)))
    if len(mixture) == 0:
        return mixture
    group = _groups(mixture)
    leaders = np.unique(group)[:most]
    merged = mixture.take(leaders)
    member = leaders[:, None] == group[None]
    log_weight = log_sum(np.where(member, mixture.log_weight, -np.inf), axis=1)
    shares = np.where(member, np.exp(mixture.log_weight - log_weight[:, None]), 0.0)
    off = mixture.mean[None] - merged.mean[:, None]
    off[..., HEADING] = wrap(off[..., HEADING])
    middle = np.einsum("ln,lni->li", shares, off)
    rest = (off - middle[:, None]) * np.sqrt(shares)[..., None]
    joint = np.tensordot(shares, mixture.covariance, axes=1) + rest.transpose(0, 2, 1) @ rest
    explained_m = np.where(member, mixture.explained_m, 0.0).max(axis=1)
    return dataclasses.replace(
        merged, mean=merged.mean + middle, covariance=joint, log_weight=log_weight, explained_m=explained_m
    )


def _groups(mixture: Mixture) -> Int64Array:
    """Return for each hypothesis (n,), likeliest first, the row of the likeliest one of the same pose."""
    offsets = pose_offsets(mixture.mean[:, POSITION], mixture.mean[:, HEADING])
    covariance = mixture.covariance[:, POSE, POSE]
    near = mahalanobis_squared(offsets, covariance[:, None] + covariance[None] + _MERGE_STD) < SAME_POSE
    group = np.full(len(mixture), -1)
    for i in range(len(mixture)):
        if group[i] < 0:
            group[near[i] & (group < 0)] = i
    return group
