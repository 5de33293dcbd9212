"""The offset that calibrates the belief in single scans on one map.

A scan has aligned poses of log odds z_i to the null hypothesis, log likelihood and prior together. With an offset d,
its probabilities are those of a conditional logit: exp(z_i + d) / (1 + S exp(d)) of pose i and 1 / (1 + S exp(d)) of
the null hypothesis, S the sum of all exp(z_i). The likelihood of d depends on the scans by S alone, and on how many of
them have their right pose among the aligned ones. Beside it stands a normal prior around 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit

from crossloc3d_ros.types import AlignedPoses, Float64Array

PRIOR_STD = 2.0
"""Nats: so far off the shipped observation model may be, on a map and with a lidar that it was not learned from."""
MOST_OFF_MAP = 0.99
"""No simulated scan off the map may be believed above this, with the offset."""
_LARGEST = 40.0  # nats to either side that are searched


@dataclass(frozen=True)
class ScanOdds:
    """What the fit needs to know of one scan."""

    log_odds: float
    """Natural logarithm of the odds of all its poses together to the null hypothesis; -inf without any."""
    has_right: bool
    """Whether the right pose is among them; never off the map."""
    on_map: bool


@dataclass(frozen=True)
class FittedOffset:
    """The offset, and what limits it."""

    offset: float
    """Nats, to be added to log likelihoods; never above 0."""
    unlimited: float
    """The most probable one of the conditional logit with its prior, without these limits."""
    std: float
    """Standard deviation of `unlimited`, nats."""
    off_map_belief: float
    """Largest belief in a scan off the map, with the offset."""


def odds_of(aligned: AlignedPoses) -> float:
    """Return the log odds of the aligned poses of one scan together to the null hypothesis; -inf without any."""
    counted = aligned.probabilities > 0.0  # a pose that is there twice counts once
    log_odds = aligned.log_likelihood[counted] + aligned.log_prior
    return float(np.logaddexp.reduce(log_odds)) if len(log_odds) else -math.inf


def fit_offset(scans: Sequence[ScanOdds]) -> FittedOffset:
    """Return the most probable offset, but none above 0, lowered until no stranger is believed above `MOST_OFF_MAP`.

    Scans on the map and off it count the same together, as the prior of the localizer has it. Simulated scans of a
    map's own surface fit it better than real ones will: that they stand out is no reason to believe more.
    """
    log_odds, right, weight = _columns(scans)

    def slope(offset: float) -> float:
        return float(weight @ (right - expit(log_odds + offset)) - offset / PRIOR_STD**2)

    # Falls everywhere: its only zero is the maximum.
    unlimited = float(brentq(slope, -_LARGEST, _LARGEST, xtol=1e-6))
    belief = expit(log_odds + unlimited)
    std = 1.0 / math.sqrt(float(weight @ (belief * (1.0 - belief))) + PRIOR_STD**-2)
    strangers = [scan.log_odds for scan in scans if not scan.on_map]
    likest = max(strangers, default=-math.inf)
    offset = min(unlimited, 0.0, math.log(MOST_OFF_MAP / (1.0 - MOST_OFF_MAP)) - likest)
    return FittedOffset(offset, unlimited, std, float(expit(likest + offset)))


def _columns(scans: Sequence[ScanOdds]) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return of each scan (n,) its log odds, whether its right pose was found, and its weight."""
    on_map = np.array([scan.on_map for scan in scans], np.bool_)
    share = np.where(on_map, max(on_map.sum(), 1), max((~on_map).sum(), 1))
    sides = float(on_map.any()) + float((~on_map).any())
    log_odds = np.array([scan.log_odds for scan in scans], np.float64)
    right = np.array([scan.has_right for scan in scans], np.float64)
    return log_odds, right, len(scans) / (max(sides, 1.0) * share)
