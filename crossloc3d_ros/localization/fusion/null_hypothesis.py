"""The null hypothesis, that the robot has none of the poses tracked: off the map, undetected on it, or kidnapped."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.linear_algebra import log_sum
from crossloc3d_ros.localization.fusion.mixture import Mixture
from crossloc3d_ros.types import Float64Array

_MIN_LOG_WEIGHT = -1e4  # it gets no less, so that a kidnapped robot's new pose can be born from it
_MIN_UNDETECTED = 1e-12  # for its logarithm
_MIN_LOG_PROBABILITY = math.log(1e-9)  # hypotheses of less are dropped
_REPEATED_MISS = 0.97  # undetected share left by a further scan of the same spot that finds no pose there


@dataclass(frozen=True)
class NullHypothesis:
    """Its weight beside those of the mixture, and what of it may still turn out to be a pose on the map."""

    log_weight: float = 0.0
    undetected: float = 1.0
    """Share of the weight that is undetected on the map; the rest is off the map."""
    kidnapping_probability: float = 0.0
    """That the robot was kidnapped since the last scan."""

    @property
    def log_undetected(self) -> float:
        """Logarithm of the weight that is undetected on the map."""
        return self.log_weight + math.log(self.undetected)

    def predict(self, elapsed_s: float, motion_is_known: bool, config: FusionConfig) -> NullHypothesis:
        """Return the null hypothesis after a time in which the robot may have been kidnapped."""
        kidnapped = -math.expm1(-config.kidnapping_per_s * elapsed_s)
        if not motion_is_known:
            kidnapped = 1.0 - (1.0 - kidnapped) * math.exp(-elapsed_s / config.unknown_motion_decay_s)
        either = 1.0 - (1.0 - self.kidnapping_probability) * (1.0 - kidnapped)
        return dataclasses.replace(self, kidnapping_probability=either)

    def scaled(self, log_factor: float) -> NullHypothesis:
        """Return it with its weight multiplied by a factor, given by its logarithm."""
        return dataclasses.replace(self, log_weight=self.log_weight + log_factor)

    def absorb(self, log_weights: Float64Array) -> NullHypothesis:
        """Return it with the weight of hypotheses (n,) that became too wide to track: anywhere on the map."""
        absorbed = float(log_sum(log_weights))
        log_weight = float(np.logaddexp(self.log_weight, absorbed))
        undetected = float(self.undetected * np.exp(self.log_weight - log_weight) + np.exp(absorbed - log_weight))
        return dataclasses.replace(self, log_weight=log_weight, undetected=undetected)

    def log_kidnapped(self, log_weights: Float64Array) -> float:
        """Return the weight that kidnapping takes from hypotheses of weights (n,), all as logarithms."""
        if not self.kidnapping_probability:
            return -math.inf
        return math.log(self.kidnapping_probability) + float(log_sum(log_weights))

    def update(self, log_kidnapped: float, novelty: float, was_searched: bool, config: FusionConfig) -> NullHypothesis:
        """Return it after a scan: an undetected pose could have been detected, where the scan was searched for it."""
        # The more spots a pose was missed at, the less likely it is on the map.
        missed = (1.0 - novelty * config.detection_probability) * _REPEATED_MISS if was_searched else 1.0
        share = self.undetected * missed
        share += (1.0 - share) * self.kidnapping_probability
        log_weight = float(np.logaddexp(self.log_weight, log_kidnapped))
        undetected = float(np.exp(np.logaddexp(self.log_weight + math.log(share), log_kidnapped) - log_weight))
        return NullHypothesis(log_weight, max(undetected, _MIN_UNDETECTED))


def normalize(mixture: Mixture, null: NullHypothesis) -> tuple[Mixture, NullHypothesis]:
    """Return both with weights that sum to 1, without the least likely hypotheses."""
    log_total = float(np.logaddexp(log_sum(mixture.log_weight), null.log_weight))
    mixture = mixture.scaled(-log_total)
    log_weight = max(null.log_weight - log_total, _MIN_LOG_WEIGHT)
    return mixture.take(mixture.log_weight > _MIN_LOG_PROBABILITY), dataclasses.replace(null, log_weight=log_weight)


def complement(mixture: Mixture, null: NullHypothesis) -> NullHypothesis:
    """Return the null hypothesis with the weight of the hypotheses that were dropped: it and `mixture` sum to 1."""
    dropped = 1.0 - math.exp(null.log_weight) - float(np.exp(mixture.log_weight).sum())
    if dropped <= 1e-12:
        return null
    return dataclasses.replace(null, log_weight=float(np.logaddexp(null.log_weight, math.log(dropped))))
