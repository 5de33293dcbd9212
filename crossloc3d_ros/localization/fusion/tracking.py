"""Where the robot is, from the aligned poses of scan after scan and the way driven between them.

A Gaussian mixture over the poses that the robot may have, beside the belief in none of them. Each scan: move every
hypothesis by odometry (`predict`), branch it over the aligned poses that it explains and correct it by each (`update`),
let aligned poses that no hypothesis explains be born out of the belief in none, merge, prune.

Three things keep the belief honest. What a scan tells of a place becomes news only by driving on: the scans of one spot
count once, by their average. The errors of aligned poses are alike over some metres: each hypothesis carries the error
that they have in common as part of its state. And the robot may be carried away at any time, unnoticed by its odometry.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.odometry import Motion, unknown_motion
from crossloc3d_ros.types import (
    EXHAUSTIVE,
    AlignedPoses,
    BoolArray,
    Float64Array,
    Hypotheses,
    Int64Array,
    TrackState,
    no_hypotheses,
)

RIGHT_WITHIN_M = 10.0
"""An estimate is right where its horizontal error is below."""

_GATE = 16.27  # chi-square of three degrees of freedom, 99.9 %
_SAME = 1.0  # poses this near, in squared standard deviations, are one
_STATE = 8  # numbers of a hypothesis' state
_ODOMETRY_M = 200.0  # way over which the systematic error of odometry changes
_SPOT_SCANS = 20.0  # scans of a spot that the average of its evidence remembers
_LEAST_LOG_WEIGHT = math.log(1e-9)  # lighter hypotheses are dropped
_LEAST_LOG_NONE = -1e4  # the belief in none falls no lower: what is carried away comes back by itself
_LARGEST_STD_M = 150.0  # wider ones tell nothing
_ANY_HEADING = math.pi**2 / 3.0  # variance of a heading of which nothing is known
_TRAIL = 12  # fixes whose way is compared with that of the odometry
_TRAIL_M = 2.0  # by how much more than a third they may differ
_STALE_SHARE = 0.97  # what a further scan of a spot that finds no pose leaves of the hope to find one there


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of the pose from outside: an operator's initial pose, a compass."""

    grid: Float64Array | None
    """(3,) easting, northing, height, metres, grid frame; None where only the heading is known."""
    heading_rad: float | None
    """Counter-clockwise from grid east; None where only the position is known."""
    covariance: Float64Array
    """(3, 3) of easting, northing, heading: m2, m rad, rad2; infinite where unknown."""
    stamp_ns: int
    """When it held; 0 = now."""


@dataclass(frozen=True, eq=False)
class Belief:
    """What the tracker believes after a scan."""

    state: TrackState
    reason: str
    """One sentence for people."""
    probability: float
    """That the horizontal error of `grid` is below 10 m."""
    grid: Float64Array
    """(3,) easting, northing, height of base, metres, grid frame; NaN where nothing is believed."""
    heading_rad: float
    """Counter-clockwise from grid east; NaN where nothing is believed."""
    covariance: Float64Array
    """(3, 3) of easting, northing, heading: m2, m rad, rad2; NaN where nothing is believed."""
    hypotheses: Hypotheses
    is_fix: bool
    """Whether the estimate may be driven by."""


@dataclass(frozen=True, eq=False)
class _Mixture:
    """n weighted Gaussians over the pose and the errors that last."""

    mean: Float64Array
    """(n, 8): easting, northing, heading; the error that aligned poses have in common, in units of its standard
    deviation (3); by which share the odometry is too short, and by how many radians a metre it turns too little."""
    covariance: Float64Array
    """(n, 8, 8)."""
    height: Float64Array
    """(n,) metres, grid frame."""
    log_weight: Float64Array
    """(n,) natural logarithms, beside that of the belief in none."""
    average: Float64Array
    """(n,) average log likelihood of the scans of the present spot."""
    looks: Float64Array
    """(n,) how many scans of the spot that average stands for."""
    banked: Float64Array
    """(n,) log likelihood of the spots before, since it was born."""
    followed_m: Float64Array
    """(n,) way over which it explained the scans, since it was born or since the motion was unknown."""
    misfit: Float64Array
    """(n,) running mean of the squared innovations over what was expected: 1 where the odometry is as it should."""
    unrest: Float64Array
    """(n,) factor on the odometry's covariance: 1 where it is as it should."""

    def __len__(self) -> int:
        return len(self.height)

    def take(self, rows: Int64Array | BoolArray) -> _Mixture:
        return _Mixture(*(values[rows] for values in vars(self).values()))

    def join(self, other: _Mixture) -> _Mixture:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Mixture(*(np.concatenate(pair) for pair in pairs))


class Tracker:
    """Fuse aligned poses and odometry into one belief, starting from nothing, recovering from anything."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self.reset()

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last scan that counted, where the next motion has to begin; None before the first."""
        return self._stamp_ns

    @property
    def skips(self) -> bool:
        """Whether the scan that `predict` was told of changes nothing: it is late, or a repeated one."""
        return bool(self._skipped)

    def reconfigure(self, config: FusionConfig) -> None:
        """Use other settings from the next scan on; the hypotheses are kept."""
        self._config = config

    def reset(self) -> None:
        """Forget everything."""
        self._stamp_ns: int | None = None
        self._mixture = _empty(self._config)
        self._log_none = 0.0  # logarithm of the weight of the belief in none
        self._elsewhere = 1.0  # share of that belief that may still turn out to be a place of the map
        self._moved_m: float | None = None  # way since the last update; None = unknown
        self._carried = 0.0  # belief that the robot was carried away since the last update
        self._was_localized = False
        self._unknown_reason = ""
        self._without_fix = 0  # scans since the last fix
        self._told_m = 0.0  # way that the odometry has told
        self._trail: deque[tuple[float, Float64Array]] = deque(maxlen=_TRAIL)  # the same at the last fixes, and where
        self._skipped = ""
        self._priors: list[PosePrior] = []
        self._compass: PosePrior | None = None
        self._belief = Belief(
            TrackState.SEARCHING, "no scan yet", 0.0, np.full(3, np.nan), math.nan, np.full((3, 3), np.nan),
            no_hypotheses(), False,
        )  # fmt: skip

    def set_prior(self, prior: PosePrior) -> None:
        """Take in what is known of the pose from outside; it counts from the next scan on.

        A position (with or without a heading) becomes a hypothesis of `initial_pose_probability`. A heading alone makes
        hypotheses and aligned poses of other headings less likely.
        """
        if prior.grid is not None:
            self._priors.append(prior)
        elif prior.heading_rad is not None:
            self._compass = prior

    def predict(self, stamp_ns: int, motion: Motion | None) -> Hypotheses:
        """Move the belief to the stamp of a scan, and return where to look for its pose.

        `motion` leads from the last scan that counted (`stamp_ns` of this object) to this one; None = unknown. A
        repeated or late stamp changes nothing; one that lies back by more than `restart_s` forgets everything.
        """
        self._skipped = ""
        if self._stamp_ns is not None:
            elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
            if elapsed_s <= 0.0 and -elapsed_s <= self._config.restart_s:
                late = f"the scan is {-elapsed_s:.2g} s older than one before it"
                self._skipped = late if elapsed_s < 0.0 else "the scan has the same stamp as the one before it"
                return self._hypotheses()
            if elapsed_s < 0.0:
                priors, compass = self._priors, self._compass
                self.reset()
                self._priors, self._compass = priors, compass
            else:
                self._move(elapsed_s, motion)
        self._stamp_ns = stamp_ns
        self._take_in_priors(stamp_ns)
        order = np.argsort(-self._mixture.log_weight, kind="stable")
        self._mixture = self._mixture.take(order)
        return self._hypotheses()

    def update(self, aligned: AlignedPoses) -> Belief:
        """Weigh the hypotheses by how the scan fits at them, correct them, let new ones be born, and judge.

        `aligned` holds the poses found around the candidates and around the hypotheses that `predict` returned.
        """
        if self._skipped:
            return dataclasses.replace(self._belief, reason=self._skipped, is_fix=False)
        config = self._config
        news = self._news()
        poses = self._poses(aligned)
        before = self._mixture
        branches, evidence = self._branch(before, poses, news)
        # A robot that was carried away sees a new place, so that all of its scan is news.
        moved_on = before.log_weight + _tempered(evidence, before, news)[0]
        carried = math.log(self._carried) + _log_sum(moved_on - evidence) if self._carried and len(before) else -np.inf
        open_none = self._log_none + math.log(self._elsewhere)
        births = self._births(poses, np.logaddexp(open_none, carried), aligned.log_prior, branches)
        self._mixture = branches[0].join(births)
        # Where it was missed so far, it may yet be found, the less likely the more spots it was missed at.
        # A scan that was looked at around the hypotheses alone could not find it.
        searched = bool((aligned.source >= 0).any() or (aligned.source == EXHAUSTIVE).any())
        hope = self._elsewhere * ((1.0 - news * config.detection_probability) * _STALE_SHARE if searched else 1.0)
        hope += (1.0 - hope) * self._carried
        none = float(np.logaddexp(self._log_none, carried))
        self._elsewhere = max(float(np.exp(np.logaddexp(self._log_none + math.log(hope), carried) - none)), 1e-12)
        self._log_none, self._moved_m, self._carried = none, 0.0, 0.0
        self._normalize()
        self._mixture = _merge(self._mixture, config.max_hypotheses)
        self._normalize_none()
        self._belief = self._judge()
        return self._belief

    # Prediction

    def _move(self, elapsed_s: float, motion: Motion | None) -> None:
        config = self._config
        motion = _checked(motion, elapsed_s, config)
        carried = -math.expm1(-config.kidnapping_per_s * elapsed_s)
        if motion.is_known:
            self._mixture = _moved(self._mixture, motion, config)
            way_m = float(np.hypot(*motion.delta[:2]))
            self._told_m += way_m
            if self._moved_m is not None:
                self._moved_m += way_m
        else:
            self._mixture = _spread(self._mixture, elapsed_s, config)
            self._moved_m = None
            self._trail.clear()
            self._unknown_reason = motion.reason
            carried = 1.0 - (1.0 - carried) * math.exp(-elapsed_s / config.unknown_motion_decay_s)
            wide = self._mixture.covariance[:, [0, 1], [0, 1]].max(axis=1, initial=0.0) > _LARGEST_STD_M**2
            if wide.any():
                self._to_none(self._mixture.log_weight[wide])
                self._mixture = self._mixture.take(~wide)
        self._carried = 1.0 - (1.0 - self._carried) * (1.0 - carried)

    def _to_none(self, log_weights: Float64Array) -> None:
        """Give the belief in hypotheses that are dropped to none, as one that may still be anywhere on the map."""
        dropped = float(_log_sum(log_weights))
        none = float(np.logaddexp(self._log_none, dropped))
        self._elsewhere = float(self._elsewhere * np.exp(self._log_none - none) + np.exp(dropped - none))
        self._log_none = none

    def _take_in_priors(self, stamp_ns: int) -> None:
        for prior in self._priors:
            if prior.grid is None or not np.isfinite(prior.grid).all():
                continue
            covariance = np.array(prior.covariance, dtype=np.float64)
            heading = prior.heading_rad if prior.heading_rad is not None and math.isfinite(prior.heading_rad) else None
            if heading is None or not np.isfinite(covariance[2]).all():
                covariance[2, :] = covariance[:, 2] = 0.0
                covariance[2, 2] = _ANY_HEADING
            covariance = np.nan_to_num(covariance, nan=0.0, posinf=_LARGEST_STD_M**2, neginf=0.0)
            if prior.stamp_ns and stamp_ns > prior.stamp_ns:
                # Where it has driven since is not asked for: it may lie anywhere on that way.
                covariance[:2, :2] += np.eye(2) * (self._moved_m or 0.0) ** 2
            log_belief = math.log(self._config.initial_pose_probability)
            log_rest = math.log1p(-self._config.initial_pose_probability)
            self._log_none += log_rest
            rest = dataclasses.replace(self._mixture, log_weight=self._mixture.log_weight + log_rest)
            born = _born(
                prior.grid[None], np.array([heading or 0.0]), _at_least(covariance[None], 0.1, 0.5),
                np.array([log_belief]), self._config,
            )  # fmt: skip
            # Whoever gives a pose has confirmed it; the first scan is the first look at its spot.
            born = dataclasses.replace(born, followed_m=np.array([np.inf]), looks=np.zeros(1))
            self._mixture = rest.join(born)
            self._unknown_reason = ""
        self._priors = []

    # Update

    def _news(self) -> float:
        """Return which share of what the scan tells is news, in [0, 1]."""
        # Of an unknown way none is granted; the first look at a spot counts in full whatever it is.
        return -math.expm1(-(self._moved_m or 0.0) / self._config.novelty_m)

    def _poses(self, aligned: AlignedPoses) -> AlignedPoses:
        """Return the aligned poses that can be used, each once, with variances and likelihoods as configured."""
        config = self._config
        usable = (
            np.isfinite(aligned.grid).all(axis=1)
            & np.isfinite(aligned.heading_rad)
            & np.isfinite(aligned.covariance).all(axis=(1, 2))
            & np.isfinite(aligned.log_likelihood)
        )
        rows = np.flatnonzero(usable)
        rows = rows[np.argsort(-aligned.log_likelihood[rows], kind="stable")]
        covariance = _at_least(
            aligned.covariance[rows] * config.measurement_std_scale**2,
            config.measurement_min_std_m,
            config.measurement_min_std_deg,
        )
        offsets = _offsets(aligned.grid[rows, :2], aligned.heading_rad[rows])
        near = _squared(offsets, covariance[:, None] + covariance[None]) < _SAME
        kept: list[int] = []
        for i in range(len(rows)):
            if not near[i, kept].any():
                kept.append(i)
        rows, covariance = rows[kept], covariance[kept]
        log_likelihood = config.likelihood_weight * aligned.log_likelihood[rows]
        # However well a scan fits somewhere: a place that the map does not hold may look so, too.
        log_likelihood -= max(float(log_likelihood.max(initial=0.0)) - config.max_log_likelihood, 0.0)
        return AlignedPoses(
            grid=aligned.grid[rows],
            heading_rad=aligned.heading_rad[rows],
            covariance=covariance,
            log_likelihood=log_likelihood + self._of_compass(aligned.heading_rad[rows]),
            probabilities=aligned.probabilities[rows],
            inliers=aligned.inliers[rows],
            converged=aligned.converged[rows],
            source=aligned.source[rows],
            log_prior=aligned.log_prior,
        )

    def _of_compass(self, heading_rad: Float64Array) -> Float64Array:
        """Return how much likelier, as logarithms, a compass makes each heading than any."""
        compass = self._compass
        if compass is None or compass.heading_rad is None or self._stamp_ns is None:
            return np.zeros(len(heading_rad))
        variance = float(compass.covariance[2, 2])
        stale = bool(compass.stamp_ns) and abs(self._stamp_ns - compass.stamp_ns) > 1e9
        if stale or not np.isfinite(variance):
            return np.zeros(len(heading_rad))
        variance = max(variance, math.radians(1.0) ** 2)
        off = _wrap(heading_rad - compass.heading_rad)
        peak = 2.0 * math.pi / math.sqrt(2.0 * math.pi * variance)
        # One compass in ten stands beside iron.
        return np.asarray(np.log(0.1 + 0.9 * peak * np.exp(-0.5 * off**2 / variance)))

    def _branch(
        self, before: _Mixture, poses: AlignedPoses, news: float
    ) -> tuple[tuple[_Mixture, Int64Array], Float64Array]:
        """Return each hypothesis corrected by each pose that it explains, and uncorrected; and the evidence of each.

        The first comes with the row of the pose that each was corrected by, -1 for none.
        """
        config = self._config
        n, m = len(before), len(poses)
        if n == 0:
            return (before, np.empty(0, np.int64)), np.empty(0)
        blind = math.log(config.clutter_probability)
        fit = _fit(before, poses, config)
        told = math.log1p(-config.clutter_probability) + fit.log_likelihood
        evidence = _log_sum(np.concatenate([told, np.full((n, 1), blind)], axis=1), axis=1)
        gained, average, looks = _tempered(evidence, before, news)
        total = before.log_weight + gained
        banked = before.banked + news * before.average
        unseen = dataclasses.replace(
            before, log_weight=total + blind - evidence, average=average, looks=looks, banked=banked
        )
        h, i = np.nonzero(np.isfinite(told)) if m else (np.empty(0, np.int64), np.empty(0, np.int64))
        seen = dataclasses.replace(
            _corrected(before, poses, fit, h, i, self._moved_m, config),
            log_weight=(total[:, None] + told - evidence[:, None])[h, i],
            average=average[h],
            looks=looks[h],
            banked=banked[h],
        )
        return (unseen.join(seen), np.concatenate([np.full(n, -1), i])), evidence

    def _births(
        self, poses: AlignedPoses, log_open: float, log_prior: float, branches: tuple[_Mixture, Int64Array]
    ) -> _Mixture:
        """Return the aligned poses that no hypothesis explains as well.

        A place that is found late has missed the evidence of the spots before: it may be the one where the robot was
        all the time, and would have fitted there as it does here. So it is granted what the likeliest hypothesis has
        banked, in proportion to how well it fits, times the belief that the search has missed it all the way.
        """
        blind = self._config.clutter_probability
        log_likelihood = np.logaddexp(math.log(blind), math.log1p(-blind) + poses.log_likelihood)
        log_weight = log_open + log_prior + log_likelihood
        mixture, corrected_by = branches
        explained = np.full(len(poses), -np.inf)
        seen = corrected_by >= 0
        np.maximum.at(explained, corrected_by[seen], mixture.log_weight[seen])
        if len(mixture):
            leader = int(np.argmax(mixture.log_weight))
            average, banked = float(mixture.average[leader]), float(mixture.banked[leader])
            followed_m = float(mixture.followed_m[leader])
            if average > 0.0 and banked > 0.0 and math.isfinite(followed_m):
                short = banked * (np.clip(log_likelihood / average, 0.0, 1.0) - 1.0) + log_likelihood - average
                missed = followed_m / self._config.novelty_m * math.log1p(-self._config.detection_probability)
                late = float(mixture.log_weight[leader]) + short + missed
                log_weight = np.where(np.isneginf(explained), np.logaddexp(log_weight, late), log_weight)
        rows = np.flatnonzero(log_weight > explained)
        return _born(
            poses.grid[rows], poses.heading_rad[rows], poses.covariance[rows], log_weight[rows],
            self._config, log_likelihood[rows],
        )  # fmt: skip

    def _normalize(self) -> None:
        """Scale the weights so that they and the belief in none sum to 1, and drop the lightest hypotheses."""
        total = float(np.logaddexp(_log_sum(self._mixture.log_weight), self._log_none))
        self._log_none = max(self._log_none - total, _LEAST_LOG_NONE)
        log_weight = self._mixture.log_weight - total
        self._mixture = dataclasses.replace(self._mixture, log_weight=log_weight).take(log_weight > _LEAST_LOG_WEIGHT)

    def _normalize_none(self) -> None:
        """Give the belief in hypotheses that were dropped to none."""
        dropped = 1.0 - math.exp(self._log_none) - float(np.exp(self._mixture.log_weight).sum())
        if dropped > 1e-12:
            self._log_none = float(np.logaddexp(self._log_none, math.log(dropped)))

    # Judgement

    def _hypotheses(self) -> Hypotheses:
        mixture = self._mixture
        return Hypotheses(
            grid=np.column_stack([mixture.mean[:, :2], mixture.height]),
            heading_rad=_wrap(mixture.mean[:, 2]),
            covariance=mixture.covariance[:, :3, :3],
            probabilities=np.exp(mixture.log_weight),
        )

    def _judge(self) -> Belief:
        config, mixture = self._config, self._mixture
        none = math.exp(self._log_none)
        if not len(mixture):
            state = TrackState.LOST if self._was_localized else TrackState.SEARCHING
            reason = "nothing in the map fits the scan"
            nothing = np.full(3, np.nan)
            return Belief(state, reason, 0.0, nothing, math.nan, np.full((3, 3), np.nan), no_hypotheses(), False)
        weights = np.exp(mixture.log_weight)
        leader = int(np.argmax(weights))
        grid, heading, covariance, near = _estimate(mixture, weights, leader, config)
        off = np.hypot(*(mixture.mean[:, :2] - grid[:2]).T)
        spread = np.linalg.eigvalsh(mixture.covariance[:, :2, :2] + np.eye(2) * config.map_std_m**2)[:, 1]
        # A lower bound: a circle around each hypothesis that the circle around the estimate holds.
        inside = -np.expm1(-0.5 * np.maximum(RIGHT_WITHIN_M - off, 0.0) ** 2 / spread)
        probability = float(weights @ inside)
        followed = mixture.followed_m[near].max()
        enough = probability >= config.min_probability
        is_fix = enough and followed >= config.confirm_m
        belief = float(weights[near].sum())
        if is_fix:
            self._was_localized, self._unknown_reason = True, ""
            if self._trail:
                told_m, place = self._trail[-1]
                if np.hypot(*(grid[:2] - place)) > RIGHT_WITHIN_M + self._told_m - told_m:
                    self._trail.clear()  # another place, to which nobody has driven
            self._trail.append((self._told_m, grid[:2]))
            self._without_fix = 0
            state, reason = TrackState.LOCALIZED, f"one place is believed {_percent(probability)}"
            reason += _odometry_fault(mixture, leader, self._trail, config)
        else:
            if none < 0.5:
                state = TrackState.AMBIGUOUS
            else:
                state = TrackState.LOST if self._was_localized else TrackState.SEARCHING
            self._without_fix += 1
            if self._without_fix > _TRAIL // 2:
                self._trail.clear()  # it tells of another time
            reason = self._why_not(mixture, weights, near, probability, belief, none, enough, float(followed))
            if none < 0.5:
                reason += _odometry_fault(mixture, leader, self._trail, config)
            if self._unknown_reason:
                reason += f", since the motion was unknown: {self._unknown_reason}"
        return Belief(state, reason, probability, grid, heading, covariance, self._hypotheses(), is_fix)

    def _why_not(
        self,
        mixture: _Mixture,
        weights: Float64Array,
        near: BoolArray,
        probability: float,
        belief: float,
        none: float,
        enough: bool,
        followed_m: float,
    ) -> str:
        config = self._config
        if enough:
            return (
                f"one place is believed {_percent(probability)}, but has explained only {followed_m:.1f} m of the"
                f" {config.confirm_m:g} m needed"
            )
        if none >= 0.5:
            what = (
                "the place that was believed no longer fits the scans" if self._was_localized else "nothing fits well"
            )
            return f"{what}: {_percent(none)} of the belief is in no place of the map"
        rivals = np.flatnonzero(~near & (weights > 0.01 * belief))
        if len(rivals) and weights[rivals].sum() > 0.5 * (1.0 - belief):
            rival = rivals[np.argmax(weights[rivals])]
            leader = int(np.argmax(weights))
            apart = float(np.hypot(*(mixture.mean[leader] - mixture.mean[rival])[:2]))
            return (
                f"{1 + len(rivals)} places are believed, {_percent(belief)} the likeliest"
                f" and {_percent(weights[rival])} one {apart:.0f} m away"
            )
        if probability < 0.9 * belief:
            std = float(np.sqrt(np.linalg.eigvalsh(mixture.covariance[np.argmax(weights), :2, :2])[1]))
            return f"one place is believed {_percent(belief)}, but only to within {std:.1f} m (one sigma)"
        return f"one place is believed {_percent(probability)}, of {_percent(config.min_probability)} needed"


@dataclass(frozen=True, eq=False)
class _Fit:
    """How n hypotheses and m aligned poses fit each other."""

    log_likelihood: Float64Array
    """(n, m) of the scan, were the robot where the hypothesis expects it; -inf outside of the gate."""
    innovation: Float64Array
    """(n, m, 3)."""
    squared: Float64Array
    """(n, m) squared innovation in expected standard deviations, as the odometry promises."""
    slipped: BoolArray
    """(n, m) whether only an error of odometry beyond all bounds explains it."""
    observation: Float64Array
    """(m, 3, 8) derivative of an aligned pose by the state."""
    noise: Float64Array
    """(m, 3, 3) covariance of what is new in its error."""


def _fit(mixture: _Mixture, poses: AlignedPoses, config: FusionConfig) -> _Fit:
    n, m = len(mixture), len(poses)
    observation = np.zeros((m, 3, _STATE))
    observation[:, :, :3] = np.eye(3)
    observation[:, :, 3:6] = math.sqrt(config.measurement_error_correlation) * _root(poses.covariance)
    noise = (1.0 - config.measurement_error_correlation) * poses.covariance
    expected = np.einsum("mij,nj->nmi", observation, mixture.mean)
    innovation = np.column_stack([poses.grid[:, :2], poses.heading_rad])[None] - expected
    innovation[..., 2] = _wrap(innovation[..., 2])
    narrow = np.einsum("mij,njk,mlk->nmil", observation, mixture.covariance, observation) + noise[None]
    wide = narrow + np.diag([config.slip_std_m**2, config.slip_std_m**2, (0.1 * config.slip_std_m) ** 2])
    likelihood = np.full((n, m), -np.inf)
    squared = _squared(innovation, narrow)
    squared_wide = _squared(innovation, wide)
    held, slipped = squared <= _GATE, (squared > _GATE) & (squared_wide <= _GATE)
    if config.slip_probability <= 0.0:
        slipped = np.zeros_like(held)
    peak = np.log(_determinant(poses.covariance))
    # The likelihood at the peak, spread over as wide as the hypothesis is: a wide one fits everything, and badly.
    for which, covariance, distance, share in (
        (held, narrow, squared, 1.0 - config.slip_probability),
        (slipped, wide, squared_wide, config.slip_probability),
    ):
        if which.any():
            narrower = np.minimum(0.5 * (peak[None] - np.log(_determinant(covariance))), 0.0)
            value = poses.log_likelihood[None] + narrower - 0.5 * distance + math.log(max(share, 1e-12))
            likelihood[which] = value[which]
    return _Fit(likelihood, innovation, squared, slipped, observation, noise)


def _corrected(
    mixture: _Mixture,
    poses: AlignedPoses,
    fit: _Fit,
    h: Int64Array,
    i: Int64Array,
    moved_m: float | None,
    config: FusionConfig,
) -> _Mixture:
    """Return hypotheses `h` (b,) corrected by poses `i` (b,): the Kalman filter's update, in Joseph's form."""
    rows = mixture.take(h)
    observation, noise, innovation = fit.observation[i], fit.noise[i], fit.innovation[h, i]
    prior = rows.covariance.copy()
    slip = np.array([config.slip_std_m**2, config.slip_std_m**2, (0.1 * config.slip_std_m) ** 2])
    prior[:, range(3), range(3)] += fit.slipped[h, i][:, None] * slip
    cross = prior @ observation.transpose(0, 2, 1)
    gain = np.linalg.solve(observation @ cross + noise, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    mean = rows.mean + np.einsum("bij,bj->bi", gain, innovation)
    mean[:, 2] = _wrap(mean[:, 2])
    kept = np.eye(_STATE) - gain @ observation
    covariance = kept @ prior @ kept.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
    ratio = np.minimum(fit.squared[h, i] / 3.0, 10.0)
    misfit = rows.misfit + 0.1 * (ratio - rows.misfit)
    # Odometry that is worse than it says is believed less, until the innovations are what they should be.
    unrest = np.clip(rows.unrest * np.exp(0.2 * np.clip(misfit - 1.3, -1.0, 2.0)), 1.0, 1e3)
    return dataclasses.replace(
        rows,
        mean=mean,
        covariance=0.5 * (covariance + covariance.transpose(0, 2, 1)),
        height=poses.grid[i, 2],
        followed_m=rows.followed_m + (moved_m or 0.0),
        misfit=misfit,
        unrest=unrest,
    )


def _tempered(
    evidence: Float64Array, mixture: _Mixture, news: float
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return what a scan's evidence (n,) adds to each log weight, and the new average of the spot and its count.

    The scans of one spot count once, by their average; the average is banked as the robot drives on. With the share of
    news v: looks' = 1 + (1 - v) looks, average' = average + (evidence - average) / looks', and the weight gains
    (average' - average) + v average.
    """
    looks = 1.0 + (1.0 - news) * np.minimum(mixture.looks, _SPOT_SCANS - 1.0)
    average = mixture.average + (evidence - mixture.average) / looks
    return average - mixture.average + news * mixture.average, average, looks


def _moved(mixture: _Mixture, motion: Motion, config: FusionConfig) -> _Mixture:
    """Return the hypotheses after a motion: exact moments of the way in an uncertain heading."""
    mean, covariance = mixture.mean.copy(), mixture.covariance
    length = float(np.hypot(*motion.delta[:2]))
    variance = covariance[:, 2, 2]
    shrink = np.exp(-0.5 * variance)
    cosine, sine = np.cos(mean[:, 2]), np.sin(mean[:, 2])
    forward, left = (1.0 + mean[:, 6]) * motion.delta[0], (1.0 + mean[:, 6]) * motion.delta[1]
    way = np.column_stack([cosine * forward - sine * left, sine * forward + cosine * left])
    across = np.column_stack([-way[:, 1], way[:, 0]])
    step = np.tile(np.eye(_STATE), (len(mixture), 1, 1))
    step[:, :2, 2] = shrink[:, None] * across
    step[:, :2, 6] = (shrink / (1.0 + mean[:, 6]))[:, None] * way
    step[:, 2, 7] = length
    mean[:, :2] += shrink[:, None] * way
    mean[:, 2] = _wrap(mean[:, 2] + motion.delta[2] + length * mean[:, 7])
    # Errors that last change along the way, and keep their size.
    kept = np.exp(-length / np.array([config.measurement_correlation_m] * 3 + [_ODOMETRY_M] * 2))
    lasting = _lasting(config)
    mean[:, 3:] *= kept
    step[:, range(3, _STATE), range(3, _STATE)] *= kept
    moved = step @ covariance @ step.transpose(0, 2, 1)
    moved[:, range(3, _STATE), range(3, _STATE)] += (1.0 - kept**2) * lasting
    # What the linear step leaves out where the heading is hardly known.
    along2 = 0.5 * (1.0 - np.exp(-variance)) ** 2
    across2 = 0.5 * (1.0 - np.exp(-2.0 * variance)) - variance * np.exp(-variance)
    moved[:, :2, :2] += along2[:, None, None] * way[:, :, None] * way[:, None, :]
    moved[:, :2, :2] += across2[:, None, None] * across[:, :, None] * across[:, None, :]
    rotation = np.zeros((len(mixture), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1] = cosine, -sine, sine, cosine
    rotation[:, 2, 2] = 1.0
    noise = rotation @ motion.covariance @ rotation.transpose(0, 2, 1)
    moved[:, :3, :3] += mixture.unrest[:, None, None] * noise
    return dataclasses.replace(mixture, mean=mean, covariance=_no_more_than_any_heading(moved))


def _spread(mixture: _Mixture, elapsed_s: float, config: FusionConfig) -> _Mixture:
    """Return the hypotheses after an unknown motion: as wide as the robot could drive."""
    covariance = mixture.covariance.copy()
    covariance[:, 3:6, :] = covariance[:, :, 3:6] = 0.0
    covariance[:, range(3, 6), range(3, 6)] = 1.0
    # A robot that may be anywhere up to the farthest point is half as far away, one sigma, each way.
    position = (0.5 * config.max_speed_mps * elapsed_s) ** 2
    heading = (0.5 * math.radians(config.max_turn_deg_per_s) * elapsed_s) ** 2
    covariance[:, range(3), range(3)] += np.array([position, position, heading])
    mean = mixture.mean.copy()
    mean[:, 3:6] = 0.0
    return dataclasses.replace(
        mixture, mean=mean, covariance=_no_more_than_any_heading(covariance), followed_m=np.zeros(len(mixture))
    )


def _no_more_than_any_heading(covariance: Float64Array) -> Float64Array:
    """Return covariances (n, 8, 8) of headings that are at most as uncertain as one of which nothing is known."""
    factor = np.sqrt(np.minimum(1.0, _ANY_HEADING / np.maximum(covariance[:, 2, 2], 1e-12)))
    covariance[:, 2, :] *= factor[:, None]
    covariance[:, :, 2] *= factor[:, None]
    return covariance


def _born(
    grid: Float64Array,
    heading_rad: Float64Array,
    covariance: Float64Array,
    log_weight: Float64Array,
    config: FusionConfig,
    log_likelihood: Float64Array | None = None,
) -> _Mixture:
    """Return hypotheses at poses (n, ...): aligned ones, where their `log_likelihood` (n,) is given.

    The errors of these are in part those that the next aligned poses will have.
    """
    n = len(grid)
    joint = np.zeros((n, _STATE, _STATE))
    joint[:, :3, :3] = covariance
    joint[:, range(3, _STATE), range(3, _STATE)] = _lasting(config)
    if log_likelihood is not None:
        # The pose is off by what the alignment is off, with the other sign.
        root = math.sqrt(config.measurement_error_correlation) * _root(covariance)
        joint[:, :3, 3:6], joint[:, 3:6, :3] = -root, -root
    return _Mixture(
        mean=np.column_stack([grid[:, :2], heading_rad, np.zeros((n, _STATE - 3))]),
        covariance=joint,
        height=grid[:, 2],
        log_weight=log_weight,
        average=np.zeros(n) if log_likelihood is None else log_likelihood,
        looks=np.ones(n),
        banked=np.zeros(n),
        followed_m=np.zeros(n),
        misfit=np.ones(n),
        unrest=np.ones(n),
    )


def _lasting(config: FusionConfig) -> Float64Array:
    """Return the variances (5,) of the errors that last, as they are where nothing is known of them."""
    turn = math.radians(config.odometry_drift_deg_per_m)
    return np.array([1.0, 1.0, 1.0, config.odometry_relative_std**2, turn**2])


def _empty(config: FusionConfig) -> _Mixture:
    none = np.empty(0)
    return _born(np.empty((0, 3)), none, np.empty((0, 3, 3)), none, config)


def _merge(mixture: _Mixture, most: int) -> _Mixture:
    """Return the mixture with components that are one told once, by their common moments, and the heaviest kept."""
    order = np.argsort(-mixture.log_weight, kind="stable")[: 4 * most]
    mixture = mixture.take(order)
    n = len(mixture)
    if n == 0:
        return mixture
    offsets = _offsets(mixture.mean[:, :2], mixture.mean[:, 2])
    covariance = mixture.covariance[:, :3, :3]
    floor = np.diag([0.1**2, 0.1**2, math.radians(0.5) ** 2])
    near = _squared(offsets, covariance[:, None] + covariance[None] + floor) < _SAME
    group = np.full(n, -1)
    for i in range(n):
        if group[i] < 0:
            group[near[i] & (group < 0)] = i
    leaders = np.unique(group)[:most]
    merged = mixture.take(leaders)
    member = leaders[:, None] == group[None]
    log_weight = _log_sum(np.where(member, mixture.log_weight, -np.inf), axis=1)
    shares = np.where(member, np.exp(mixture.log_weight - log_weight[:, None]), 0.0)
    off = mixture.mean[None] - merged.mean[:, None]
    off[..., 2] = _wrap(off[..., 2])
    middle = np.einsum("ln,lni->li", shares, off)
    rest = (off - middle[:, None]) * np.sqrt(shares)[..., None]
    joint = np.tensordot(shares, mixture.covariance, axes=1) + rest.transpose(0, 2, 1) @ rest
    followed_m = np.where(member, mixture.followed_m, 0.0).max(axis=1)
    return dataclasses.replace(
        merged, mean=merged.mean + middle, covariance=joint, log_weight=log_weight, followed_m=followed_m
    )


def _estimate(
    mixture: _Mixture, weights: Float64Array, leader: int, config: FusionConfig
) -> tuple[Float64Array, float, Float64Array, BoolArray]:
    """Return position (3,), heading and covariance (3, 3) of the place around the leader, and who belongs to it."""
    off = mixture.mean[:, :3] - mixture.mean[leader, :3]
    off[:, 2] = _wrap(off[:, 2])
    near: BoolArray = np.hypot(off[:, 0], off[:, 1]) < RIGHT_WITHIN_M
    shares = weights[near] / weights[near].sum()
    middle = shares @ off[near]
    rest = off[near] - middle
    covariance = np.einsum("b,bij->ij", shares, mixture.covariance[near, :3, :3]) + (rest * shares[:, None]).T @ rest
    lasting = (config.map_std_m, config.map_std_m, math.radians(config.map_std_deg))
    covariance += np.diag(np.square(lasting))
    pose = mixture.mean[leader, :3] + middle
    grid = np.array([pose[0], pose[1], float(shares @ mixture.height[near])])
    return grid, float(_wrap(pose[2])), covariance, near


def _odometry_fault(
    mixture: _Mixture, leader: int, trail: Sequence[tuple[float, Float64Array]], config: FusionConfig
) -> str:
    """Say what is wrong with the odometry, as a clause that follows a sentence; empty where nothing is."""
    scale, turn_deg = float(mixture.mean[leader, 6]), math.degrees(mixture.mean[leader, 7])
    if abs(scale) > 3.0 * config.odometry_relative_std:
        kind = "short" if scale > 0.0 else "long"
        return f"; the odometry's ways are {abs(scale) / (1.0 + scale):.0%} too {kind}"
    if abs(turn_deg) > 3.0 * config.odometry_drift_deg_per_m:
        return f"; the odometry turns {-turn_deg:+.1f} degrees a metre that the robot does not"
    if len(trail) == _TRAIL:
        moved_m, told_m = float(np.hypot(*(trail[-1][1] - trail[0][1]))), trail[-1][0] - trail[0][0]
        if moved_m > told_m * 4.0 / 3.0 + _TRAIL_M:
            return f"; odometry and map disagree: of the last {moved_m:.1f} m the odometry tells {told_m:.1f} m"
    if mixture.misfit[leader] > 2.5:
        return f"; odometry and map disagree {mixture.misfit[leader] ** 0.5:.1f} times as much as they should"
    return ""


def _checked(motion: Motion | None, elapsed_s: float, config: FusionConfig) -> Motion:
    """Return the motion, as unknown where it is missing, no number or faster than the robot."""
    if motion is None:
        return unknown_motion("there is no odometry")
    if not motion.is_known:
        return motion
    if not (np.isfinite(motion.delta).all() and np.isfinite(motion.covariance).all()):
        return unknown_motion("the odometry is not a number")
    length = float(np.hypot(*motion.delta[:2]))
    if length > config.max_speed_mps * (elapsed_s + 0.05) + 0.05:
        return unknown_motion(f"the odometry tells {length:.3g} m in {elapsed_s:.2g} s, faster than the robot")
    return motion


def _offsets(xy: Float64Array, heading_rad: Float64Array) -> Float64Array:
    """Return the differences (n, n, 3) between poses."""
    offsets = np.concatenate(
        [xy[:, None] - xy[None], _wrap(heading_rad[:, None] - heading_rad[None])[..., None]], axis=2
    )
    return np.asarray(offsets)


def _squared(offsets: Float64Array, covariance: Float64Array) -> Float64Array:
    """Return squared Mahalanobis lengths (...,) of offsets (..., 3) under covariances (..., 3, 3)."""
    # By the adjugate: some thousands of them in a fraction of the time of a solver.
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 0, 2]
    d, e, f = covariance[..., 1, 1], covariance[..., 1, 2], covariance[..., 2, 2]
    x, y, z = offsets[..., 0], offsets[..., 1], offsets[..., 2]
    xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
    yy, yz, zz = a * f - c * c, b * c - a * e, a * d - b * b
    form = xx * x * x + yy * y * y + zz * z * z + 2.0 * (xy * x * y + xz * x * z + yz * y * z)
    return np.asarray(form / (a * xx + b * xy + c * xz))


def _determinant(covariance: Float64Array) -> Float64Array:
    """Return the determinants (...,) of covariances (..., 3, 3)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 0, 2]
    d, e, f = covariance[..., 1, 1], covariance[..., 1, 2], covariance[..., 2, 2]
    return np.asarray(a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d))


def _log_sum(logarithms: Float64Array, axis: int | None = None) -> Any:
    """Return the logarithm of the sum of what the logarithms stand for, along an axis or of all."""
    values = logarithms if axis is not None else logarithms.reshape(-1)
    return np.logaddexp.reduce(values, axis=axis or 0, initial=-np.inf)


def _root(covariance: Float64Array) -> Float64Array:
    """Return the symmetric square roots (n, 3, 3) of covariances."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.transpose(0, 2, 1))


def _at_least(covariance: Float64Array, position_m: float, heading_deg: float) -> Float64Array:
    """Return covariances (n, 3, 3) made symmetric, proper, and at least as large as the floors."""
    scale = np.array([position_m, position_m, math.radians(heading_deg)])
    unit = 0.5 * (covariance + covariance.transpose(0, 2, 1)) / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(unit)
    return np.asarray(
        (vectors * np.maximum(values, 1.0)[:, None, :]) @ vectors.transpose(0, 2, 1) * np.outer(scale, scale)
    )


def _wrap(angle_rad: Float64Array) -> Float64Array:
    """Return angles in [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


def _percent(probability: float) -> str:
    """Write a probability so that 99.95 % and 100 % differ."""
    return (
        f"{100.0 * probability:.3g} %" if probability < 0.99 else f"{100.0 * math.floor(probability * 1e5) / 1e5:.5g} %"
    )
