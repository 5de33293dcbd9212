"""The Kalman filter of each hypothesis: prediction by odometry, correction by aligned poses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.linear_algebra import determinant, diagonal, mahalanobis_squared, square_root
from crossloc3d_ros.localization.fusion.mixture import (
    COMMON_ERROR,
    HEADING,
    LASTING_ERRORS,
    ODOMETRY_DRIFT,
    ODOMETRY_SCALE,
    POSE,
    POSITION,
    STATE_SIZE,
    Mixture,
    lasting_variances,
)
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.types import AlignedPoses, BoolArray, Float64Array, Int64Array

UNKNOWN_HEADING_VARIANCE = math.pi**2 / 3.0
"""Of a heading that is uniform over the circle, rad2."""
_GATE = 16.27  # chi-square of three degrees of freedom, 99.9 %
_ODOMETRY_CORRELATION_M = 200.0  # distance over which systematic errors of odometry change: floors and loads do
_NIS_GAIN = 0.1  # of the running mean: over some ten scans, inconsistency stands out from noise
_NIS_MOST = 10.0  # one outlier moves the mean by no more than this
_NIS_TOLERATED = 1.3  # above, the process noise grows: less happens by chance in ten scans
_NOISE_SCALE_RATE = 0.2  # logarithm by which it grows a scan, for each unit above
_NOISE_SCALE_MOST = 1e3  # from here on odometry is next to ignored


@dataclass(frozen=True, eq=False)
class Innovations:
    """What n hypotheses and m aligned poses have to do with each other."""

    log_likelihood: Float64Array
    """(n, m) of the scan, were the robot where the hypothesis expects it; -inf outside of the gate."""
    innovation: Float64Array
    """(n, m, 3) aligned pose minus expected pose."""
    squared: Float64Array
    """(n, m) normalized innovation squared, under the odometry's own covariance."""
    slipped: BoolArray
    """(n, m) whether only a slip of the odometry explains it."""
    observation: Float64Array
    """(m, 3, 8) derivative of an aligned pose by the state."""
    noise: Float64Array
    """(m, 3, 3) covariance of the part of the error that is independent of the scans before."""


def predict(mixture: Mixture, motion: Motion, config: FusionConfig) -> Mixture:
    """Return the hypotheses after a known motion: exact moments of a displacement in an uncertain heading."""
    mean, covariance = mixture.mean.copy(), mixture.covariance
    variance = covariance[:, HEADING, HEADING]
    shrink = np.exp(-0.5 * variance)
    rotation = _rotations(mean[:, HEADING])
    shift = _displacements(mean, motion)
    across = np.column_stack([-shift[:, 1], shift[:, 0]])
    step = np.tile(np.eye(STATE_SIZE), (len(mixture), 1, 1))
    step[:, POSITION, HEADING] = shrink[:, None] * across
    step[:, POSITION, ODOMETRY_SCALE] = (shrink / (1.0 + mean[:, ODOMETRY_SCALE]))[:, None] * shift
    step[:, HEADING, ODOMETRY_DRIFT] = motion.distance_m
    mean[:, POSITION] += shrink[:, None] * shift
    mean[:, HEADING] = wrap(mean[:, HEADING] + motion.delta[2] + motion.distance_m * mean[:, ODOMETRY_DRIFT])
    # Errors that last change with the distance, and keep their size.
    correlation_m = np.array([config.measurement_correlation_m] * 3 + [_ODOMETRY_CORRELATION_M] * 2)
    kept = np.exp(-motion.distance_m / correlation_m)
    mean[:, LASTING_ERRORS] *= kept
    diagonal(step)[:, LASTING_ERRORS] *= kept
    moved = step @ covariance @ step.transpose(0, 2, 1)
    diagonal(moved)[:, LASTING_ERRORS] += (1.0 - kept**2) * lasting_variances(config)
    # What the linear step leaves out where the heading is hardly known.
    along2 = 0.5 * (1.0 - np.exp(-variance)) ** 2
    across2 = 0.5 * (1.0 - np.exp(-2.0 * variance)) - variance * np.exp(-variance)
    moved[:, POSITION, POSITION] += along2[:, None, None] * shift[:, :, None] * shift[:, None, :]
    moved[:, POSITION, POSITION] += across2[:, None, None] * across[:, :, None] * across[:, None, :]
    noise = rotation @ motion.covariance @ rotation.transpose(0, 2, 1)
    moved[:, POSE, POSE] += mixture.process_noise_scale[:, None, None] * noise
    return dataclasses.replace(mixture, mean=mean, covariance=_with_bounded_heading(moved))


def predict_unknown(mixture: Mixture, elapsed_s: float, config: FusionConfig) -> Mixture:
    """Return the hypotheses after an unknown motion: as wide as the robot could drive."""
    mean, covariance = mixture.mean.copy(), mixture.covariance.copy()
    covariance[:, COMMON_ERROR, :] = covariance[:, :, COMMON_ERROR] = 0.0
    diagonal(covariance)[:, COMMON_ERROR] = 1.0
    # A robot that may be anywhere up to the farthest point is half as far away, one sigma, each way.
    position = (0.5 * config.max_speed_mps * elapsed_s) ** 2
    heading = (0.5 * math.radians(config.max_turn_deg_per_s) * elapsed_s) ** 2
    diagonal(covariance)[:, POSE] += np.array([position, position, heading])
    mean[:, COMMON_ERROR] = 0.0
    return dataclasses.replace(
        mixture, mean=mean, covariance=_with_bounded_heading(covariance), explained_m=np.zeros(len(mixture))
    )


def innovations(mixture: Mixture, poses: AlignedPoses, config: FusionConfig) -> Innovations:
    """Return the innovations of all hypotheses by all aligned poses, gated, and their likelihoods."""
    n, m = len(mixture), len(poses)
    observation = np.zeros((m, 3, STATE_SIZE))
    observation[:, :, POSE] = np.eye(3)
    observation[:, :, COMMON_ERROR] = math.sqrt(config.measurement_error_correlation) * square_root(poses.covariance)
    noise = (1.0 - config.measurement_error_correlation) * poses.covariance
    expected = np.einsum("mij,nj->nmi", observation, mixture.mean)
    innovation = np.column_stack([poses.grid[:, :2], poses.heading_rad])[None] - expected
    innovation[..., 2] = wrap(innovation[..., 2])
    narrow = np.einsum("mij,njk,mlk->nmil", observation, mixture.covariance, observation) + noise[None]
    wide = narrow + np.diag(_slip_variances(config))
    squared, squared_wide = mahalanobis_squared(innovation, narrow), mahalanobis_squared(innovation, wide)
    held, slipped = squared <= _GATE, (squared > _GATE) & (squared_wide <= _GATE)
    if config.slip_probability <= 0.0:
        slipped = np.zeros_like(held)
    likelihood = np.full((n, m), -np.inf)
    peak = np.log(determinant(poses.covariance))
    # The likelihood at the peak, spread over as wide as the hypothesis is: a wide one fits everything, and badly.
    for which, covariance, distance, share in (
        (held, narrow, squared, 1.0 - config.slip_probability),
        (slipped, wide, squared_wide, config.slip_probability),
    ):
        if which.any():
            narrower = np.minimum(0.5 * (peak[None] - np.log(determinant(covariance))), 0.0)
            value = poses.log_likelihood[None] + narrower - 0.5 * distance + math.log(max(share, 1e-12))
            likelihood[which] = value[which]
    return Innovations(likelihood, innovation, squared, slipped, observation, noise)


def correct(
    mixture: Mixture,
    poses: AlignedPoses,
    found: Innovations,
    h: Int64Array,
    i: Int64Array,
    travelled_m: float,
    config: FusionConfig,
) -> Mixture:
    """Return hypotheses `h` (b,) corrected by poses `i` (b,): the Kalman filter's update, in Joseph's form."""
    rows = mixture.take(h)
    observation, noise, innovation = found.observation[i], found.noise[i], found.innovation[h, i]
    prior = rows.covariance.copy()
    diagonal(prior)[:, POSE] += found.slipped[h, i][:, None] * _slip_variances(config)
    cross = prior @ observation.transpose(0, 2, 1)
    gain = np.linalg.solve(observation @ cross + noise, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    mean = rows.mean + np.einsum("bij,bj->bi", gain, innovation)
    mean[:, HEADING] = wrap(mean[:, HEADING])
    kept = np.eye(STATE_SIZE) - gain @ observation
    covariance = kept @ prior @ kept.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
    ratio = np.minimum(found.squared[h, i] / 3.0, _NIS_MOST)
    nis = rows.nis + _NIS_GAIN * (ratio - rows.nis)
    # Odometry that is worse than its covariance counts less, until the innovations are consistent.
    growth = np.exp(_NOISE_SCALE_RATE * np.clip(nis - _NIS_TOLERATED, -1.0, 2.0))
    return dataclasses.replace(
        rows,
        mean=mean,
        covariance=0.5 * (covariance + covariance.transpose(0, 2, 1)),
        height=poses.grid[i, 2],
        explained_m=rows.explained_m + travelled_m,
        nis=nis,
        process_noise_scale=np.clip(rows.process_noise_scale * growth, 1.0, _NOISE_SCALE_MOST),
    )


def _displacements(mean: Float64Array, motion: Motion) -> Float64Array:
    """Return the displacements (n, 2) in the grid frame that a motion means to hypotheses (n, 8)."""
    cosine, sine = np.cos(mean[:, HEADING]), np.sin(mean[:, HEADING])
    scale = 1.0 + mean[:, ODOMETRY_SCALE]
    forward, left = scale * motion.delta[0], scale * motion.delta[1]
    return np.column_stack([cosine * forward - sine * left, sine * forward + cosine * left])


def _rotations(heading_rad: Float64Array) -> Float64Array:
    """Return the rotations (n, 3, 3) of base poses into the grid frame."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    rotation = np.zeros((len(heading_rad), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1] = cosine, -sine, sine, cosine
    rotation[:, 2, 2] = 1.0
    return rotation


def _slip_variances(config: FusionConfig) -> Float64Array:
    """Return the variances (3,) of a slip: m2, m2, rad2."""
    return np.array([config.slip_std_m**2, config.slip_std_m**2, (0.1 * config.slip_std_m) ** 2])


def _with_bounded_heading(covariance: Float64Array) -> Float64Array:
    """Return covariances (n, 8, 8) of headings that are at most as uncertain as one of which nothing is known."""
    factor = np.sqrt(np.minimum(1.0, UNKNOWN_HEADING_VARIANCE / np.maximum(covariance[:, HEADING, HEADING], 1e-12)))
    covariance[:, HEADING, :] *= factor[:, None]
    covariance[:, :, HEADING] *= factor[:, None]
    return covariance
