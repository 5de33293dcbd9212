"""Probabilities of candidates, the most probable place among them, its covariance, and whether it is a fix.

The probability has two factors. That the scan's place is on the map at all is a logistic function of the smallest
descriptor distance: indoors, or outside of the surveyed area, no descriptor is near. Which place it is, if any, is a
softmax of the distances. Both are fitted by `calibrate` on scans of known places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logsumexp, softmax

from crossloc3d_ros.config import CalibrationConfig, RetrievalConfig
from crossloc3d_ros.types import (
    BoolArray,
    CalibratedEncoder,
    Candidates,
    DescriptorEncoder,
    FixStatus,
    Float32Array,
    Float64Array,
)

_MIN_DISTANCE = 1e-6  # the least that CalibrationConfig admits


@dataclass(frozen=True, eq=False)
class PlaceBelief:
    """The most probable place, as the candidates have it."""

    status: FixStatus
    reason: str
    """One sentence for people."""
    probability: float
    """Of the place; what is missing to 1 is that of other places and of the null hypothesis."""
    enu: Float64Array
    """(3,) metres, map frame."""
    covariance: Float64Array
    """(3, 3) ENU, square metres."""
    members: BoolArray
    """(k,) which candidates belong to the place."""


def effective_calibration(config: RetrievalConfig, encoder: DescriptorEncoder) -> CalibrationConfig:
    """Return the calibration that comes with the encoder's weights, as far as `config` does not override it."""
    stored = encoder.calibration if isinstance(encoder, CalibratedEncoder) else None
    base = stored if stored is not None else CalibrationConfig()
    return CalibrationConfig(
        temperature=config.temperature or base.temperature,
        null_distance=config.null_distance or base.null_distance,
        null_scale=config.null_scale or base.null_scale,
    )


def candidate_probabilities(distances: Float32Array, calibration: CalibrationConfig) -> Float64Array:
    """Return the candidates' probabilities (k,); what is missing to 1 is that of the null hypothesis.

    `distances` (k,) are Euclidean distances between descriptors.
    """
    if len(distances) == 0:
        return np.empty(0)
    distances_64 = np.asarray(distances, dtype=np.float64)
    on_map = expit((calibration.null_distance - distances_64.min()) / calibration.null_scale)
    with np.errstate(invalid="ignore"):  # infinitely far from everything: no number, and so no fix
        return np.asarray(on_map * softmax(-distances_64 / calibration.temperature))


def decide(candidates: Candidates, enu: Float64Array, config: RetrievalConfig) -> PlaceBelief:
    """Return the most probable place, and whether its probability is enough for a fix.

    `enu` (k, 3) holds the candidates' positions in the map frame. The place is the group of candidates within
    `cluster_radius_m` of one of them with the largest probability; its position is their weighted mean, its covariance
    their weighted spread on top of the floor that the size of a submap sets. Without candidates it is NaN.
    """
    if not len(candidates):
        nowhere = np.full(3, np.nan), np.full((3, 3), np.nan)
        return PlaceBelief(FixStatus.NO_FIX, "there are no candidates", 0.0, *nowhere, np.empty(0, np.bool_))
    probabilities = candidates.probabilities
    members = _heaviest_group(enu, probabilities, config.cluster_radius_m)
    probability = float(probabilities[members].sum())
    mean, covariance = _weighted_moments(enu[members], probabilities[members])
    covariance += np.diag([config.min_std_m**2, config.min_std_m**2, config.min_height_std_m**2])
    # Written so that a probability that is not a number gives no fix.
    is_fix = probability >= config.min_probability
    return PlaceBelief(
        status=FixStatus.FIX if is_fix else FixStatus.NO_FIX,
        reason=_explain(candidates, enu, members, probability, is_fix),
        probability=probability,
        enu=mean,
        covariance=covariance,
        members=members,
    )


def calibrate(
    distances: Sequence[Float32Array],
    separations_m: Sequence[Float64Array],
    *,
    radius_m: float = 50.0,
    start: CalibrationConfig | None = None,
) -> CalibrationConfig:
    """Fit the calibration to scans of known places by maximum likelihood.

    `distances[i]` (k,) are the descriptor distances of scan i's candidates, `separations_m[i]` (k,) how far the
    candidates lie from where the scan was taken: infinite for scans from outside of the map, which belong in here
    so that the null hypothesis is learned. A candidate is right within `radius_m`.
    """
    width = max(len(row) for row in distances)
    # Rows of fewer candidates are filled up with some that are infinitely far and wrong.
    near = np.array([np.pad(row, (0, width - len(row)), constant_values=np.inf) for row in distances], np.float64)
    apart = np.array([np.pad(row, (0, width - len(row)), constant_values=np.inf) for row in separations_m], np.float64)
    right = apart <= radius_m
    best = near.min(axis=1)
    found = right.any(axis=1)
    scale = float(np.std(best)) or 1.0
    initial = start or CalibrationConfig(temperature=scale, null_distance=float(np.median(best)), null_scale=scale)
    near_found, right_near = near[found], np.where(right, near, np.inf)[found]

    def presence_loss(x: Float64Array) -> float:
        z = (x[0] - best) * np.exp(-x[1])
        # A weak pull on the scale keeps it finite where the two kinds of scans separate perfectly.
        return float(np.sum(np.logaddexp(0.0, np.where(found, -z, z))) + 1e-2 * (x[1] - np.log(scale)) ** 2)

    def choice_loss(x: Float64Array) -> float:
        beta = np.exp(-x[0])
        losses = logsumexp(-beta * near_found, axis=1) - logsumexp(-beta * right_near, axis=1)
        return float(np.sum(losses) + 1e-2 * (x[0] - np.log(scale)) ** 2)

    presence = minimize(presence_loss, [initial.null_distance, np.log(initial.null_scale)], method="Nelder-Mead").x
    choice = minimize(choice_loss, [np.log(initial.temperature)], method="Nelder-Mead").x
    # Where scans on the map are no nearer to submaps than those outside, the best threshold may lie below zero.
    null_distance = max(float(presence[0]), _MIN_DISTANCE)
    return CalibrationConfig(float(np.exp(choice[0])), null_distance, float(np.exp(presence[1])))


def _heaviest_group(enu: Float64Array, probabilities: Float64Array, radius_m: float) -> BoolArray:
    """Mark the candidates (k,) within `radius_m` of the one around which they are most probable."""
    offsets = enu[:, None, :2] - enu[None, :, :2]
    near = np.hypot(offsets[..., 0], offsets[..., 1]) <= radius_m
    group: BoolArray = near[np.argmax(near @ probabilities)]
    return group


def _weighted_moments(points: Float64Array, weights: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return mean (3,) and covariance (3, 3) of points (n, 3) with the given weights (n,), of any sum."""
    total = weights.sum()
    # Far from every descriptor all weights underflow to 0: then all members count alike.
    shares = weights / total if total > 0 else np.full(len(points), 1.0 / len(points))
    mean = shares @ points
    offsets = points - mean
    return mean, (offsets * shares[:, None]).T @ offsets


def _explain(candidates: Candidates, enu: Float64Array, members: BoolArray, probability: float, is_fix: bool) -> str:
    count, agreeing = len(candidates), int(members.sum())
    if is_fix:
        return f"{agreeing} of {count} candidates lie at one place, probability {probability:.0%}"
    null = 1.0 - float(candidates.probabilities.sum())
    best = float(candidates.descriptor_distances[0])
    if not probability >= null or agreeing == count:
        on_map = f"probability {1 - null:.0%} of being on the map"
        return f"no submap resembles the scan: least descriptor distance {best:.3g}, {on_map}"
    others = np.flatnonzero(~members)
    rival = others[np.argmax(candidates.probabilities[others])]
    leader = np.flatnonzero(members)[np.argmax(candidates.probabilities[members])]
    apart = float(np.hypot(*(enu[leader] - enu[rival])[:2]))
    return f"best candidates lie {apart:.0f} m apart: the likeliest place has a probability of {probability:.0%} only"
