"""Data association: which hypothesis explains which aligned pose, and which poses are born as hypotheses."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.filter import correct, innovations
from crossloc3d_ros.localization.fusion.linear_algebra import at_least, log_sum, mahalanobis_squared, pose_offsets
from crossloc3d_ros.localization.fusion.mixture import SAME_POSE, Mixture, new_hypotheses
from crossloc3d_ros.types import WHOLE_MAP, AlignedPoses, Float64Array, Int64Array

_SPOT_SCANS = 20.0  # scans of a spot that its mean remembers: then a change of the scene shows within some seconds


@dataclass(frozen=True, eq=False)
class Branches:
    """Each hypothesis uncorrected, and corrected by each pose that it explains."""

    mixture: Mixture
    corrected_by: Int64Array
    """(b,) row of the pose that each was corrected by; -1 = not detected by this scan."""
    log_unseen: Float64Array
    """(n,) log weight of each hypothesis before branching, as it were without this scan's own evidence, all of it."""


def measurements(aligned: AlignedPoses, config: FusionConfig) -> AlignedPoses:
    """Return the aligned poses that can be used, each once, with covariances and likelihoods as configured."""
    usable = (
        np.isfinite(aligned.grid).all(axis=1)
        & np.isfinite(aligned.heading_rad)
        & np.isfinite(aligned.covariance).all(axis=(1, 2))
        & np.isfinite(aligned.log_likelihood)
    )
    rows = np.flatnonzero(usable)
    rows = rows[np.argsort(-aligned.log_likelihood[rows], kind="stable")]
    covariance = at_least(
        aligned.covariance[rows] * config.measurement_std_scale**2,
        config.measurement_min_std_m,
        config.measurement_min_std_deg,
    )
    offsets = pose_offsets(aligned.grid[rows, :2], aligned.heading_rad[rows])
    near = mahalanobis_squared(offsets, covariance[:, None] + covariance[None]) < SAME_POSE
    kept: list[int] = []
    for i in range(len(rows)):
        if not near[i, kept].any():
            kept.append(i)
    rows, covariance = rows[kept], covariance[kept]
    log_likelihood = config.likelihood_weight * aligned.log_likelihood[rows]
    # However well a scan fits somewhere: a place off the map may resemble it.
    log_likelihood -= max(float(log_likelihood.max(initial=0.0)) - config.max_log_likelihood, 0.0)
    return AlignedPoses(
        grid=aligned.grid[rows],
        heading_rad=aligned.heading_rad[rows],
        covariance=covariance,
        log_likelihood=log_likelihood,
        probabilities=aligned.probabilities[rows],
        inliers=aligned.inliers[rows],
        converged=aligned.converged[rows],
        source=aligned.source[rows],
        log_prior=aligned.log_prior,
    )


def was_searched(aligned: AlignedPoses) -> bool:
    """Return whether the scan was aligned anywhere but at the hypotheses, where an undetected pose could be found."""
    return bool((aligned.source >= 0).any() or (aligned.source == WHOLE_MAP).any())


def branch(before: Mixture, poses: AlignedPoses, novelty: float, travelled_m: float, config: FusionConfig) -> Branches:
    """Return each hypothesis corrected by each pose that it explains, and uncorrected, weighted by the scan."""
    n = len(before)
    if n == 0:
        return Branches(before, np.empty(0, np.int64), np.empty(0))
    log_clutter = math.log(config.clutter_probability)
    found = innovations(before, poses, config)
    log_fitting = math.log1p(-config.clutter_probability) + found.log_likelihood
    # What follows a hypothesis is not independent of what it was born of: a wrong one goes on to fit for a while.
    log_detected = log_fitting - config.null_log_likelihood
    evidence = _or_clutter(log_detected, log_clutter)
    moved_on, gain = _spot_evidence(before, evidence, novelty)
    total = before.log_weight + gain
    unseen = dataclasses.replace(moved_on, log_weight=total + log_clutter - evidence)
    h, i = np.nonzero(np.isfinite(log_detected))
    seen = dataclasses.replace(
        correct(moved_on, poses, found, h, i, travelled_m, config),
        log_weight=(total[:, None] + log_detected - evidence[:, None])[h, i],
    )
    # A robot that was carried away just now fits by chance alone where it was expected: nothing was selected there.
    log_unseen = total - _or_clutter(log_fitting, log_clutter)
    return Branches(unseen.join(seen), np.concatenate([np.full(n, -1), i]), log_unseen)


def _or_clutter(log_detected: Float64Array, log_clutter: float) -> Float64Array:
    """Return the evidence (n,) for hypotheses that explain poses (n, m) by as much, or the scan as clutter."""
    clutter = np.full((len(log_detected), 1), log_clutter)
    return np.asarray(log_sum(np.concatenate([log_detected, clutter], axis=1), axis=1))


def births(
    poses: AlignedPoses, log_undetected: float, log_prior: float, branches: Branches, config: FusionConfig
) -> Mixture:
    """Return hypotheses at the aligned poses that no hypothesis explains as well as the null hypothesis does.

    `log_undetected`: logarithm of the null hypothesis' weight that may be anywhere on the map.
    """
    clutter = config.clutter_probability
    log_likelihood = np.logaddexp(math.log(clutter), math.log1p(-clutter) + poses.log_likelihood)
    log_weight = log_undetected + log_prior + log_likelihood
    explained = np.full(len(poses), -np.inf)
    seen = branches.corrected_by >= 0
    np.maximum.at(explained, branches.corrected_by[seen], branches.mixture.log_weight[seen])
    late = _late_detection(branches.mixture, log_likelihood, config)
    if late is not None:
        log_weight = np.where(np.isneginf(explained), np.logaddexp(log_weight, late), log_weight)
    rows = np.flatnonzero(log_weight > explained)
    return new_hypotheses(
        poses.grid[rows], poses.heading_rad[rows], poses.covariance[rows], log_weight[rows], config,
        log_likelihood[rows] - config.null_log_likelihood,
    )  # fmt: skip


def _late_detection(mixture: Mixture, log_likelihood: Float64Array, config: FusionConfig) -> Float64Array | None:
    """Return log weights (m,) of poses as if each had been the robot's all the time, missed until this scan.

    Such a pose lacks the evidence of the spots before, and would have fitted there as it does here. So it is granted
    what the likeliest hypothesis has accumulated, in proportion to how well it fits, times the probability of having
    been missed by all scans before. None where nothing was accumulated.
    """
    if not len(mixture):
        return None
    leader = int(np.argmax(mixture.log_weight))
    mean, accumulated = float(mixture.mean_log_likelihood[leader]), float(mixture.accumulated[leader])
    explained_m = float(mixture.explained_m[leader])
    if not (mean > 0.0 and accumulated > 0.0 and math.isfinite(explained_m)):
        return None
    own = log_likelihood - config.null_log_likelihood
    short = accumulated * (np.clip(own / mean, 0.0, 1.0) - 1.0) + own - mean
    missed = explained_m / config.novelty_m * math.log1p(-config.detection_probability)
    return np.asarray(float(mixture.log_weight[leader]) + short + missed)


def _spot_evidence(before: Mixture, evidence: Float64Array, novelty: float) -> tuple[Mixture, Float64Array]:
    """Return the hypotheses with the evidence (n,) of a scan taken in, and what it adds to each log weight (n,).

    The scans of one spot count once, by their mean; the mean is accumulated as the robot drives on. With the novelty v
    of a scan: count' = 1 + (1 - v) count, mean' = mean + (evidence - mean) / count', and the log weight gains
    (mean' - mean) + v mean.
    """
    count = 1.0 + (1.0 - novelty) * np.minimum(before.scan_count, _SPOT_SCANS - 1.0)
    mean = before.mean_log_likelihood + (evidence - before.mean_log_likelihood) / count
    added = novelty * before.mean_log_likelihood
    gain = mean - before.mean_log_likelihood + added
    moved_on = dataclasses.replace(
        before, mean_log_likelihood=mean, scan_count=count, accumulated=before.accumulated + added
    )
    return moved_on, gain
