"""Statistics that all evaluations share: recall, chance level, shares and quantiles with intervals, reliability.

Pure functions over arrays. Positions are horizontal, in metres of one grid; Q queries (scans), K places of each, best
first; NaN where there is no such place.

An interval holds the true value in 95 of 100 such samples. Queries of one town are alike, so towns are the independent
pieces of evidence, not queries: the bootstrap draws whole towns with replacement (2,000 times, fixed seed, percentiles
2.5 and 97.5). With fewer than eight towns, squares of 50 m inside of them take their place. A bootstrap of few and
lucky towns is too narrow, at 0 and 100 % it has no width at all: a share's interval is widened to hold Wilson's for as
many trials as there are places at least 25 m apart.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

RADII_M = (100.0, 50.0, 25.0)
INDEPENDENT_M = 25.0
"""Scans nearer to each other than this see much the same, so they are one piece of evidence, not several."""
CHI2_2D_95 = -2.0 * float(np.log(0.05))
"""95 % quantile of chi-squared with two degrees of freedom."""
_RESAMPLED = 2000
_SEED = 12_345
_LEAST_CLUSTERS = 8
_BLOCK_M = 50.0


@dataclass(frozen=True)
class Share:
    """A share between 0 and 1 with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Recall:
    """How often one of the first `rank` places lies within `radius_m` of the truth."""

    rank: int
    radius_m: float
    share: Share
    chance: float
    """What `rank` different places drawn at random would reach."""
    label: str
    """`R@5`, or `R@1%` where the rank is that share of the database."""


@dataclass(frozen=True)
class ReliabilityBin:
    """How often a probability of one range was right."""

    low: float
    high: float
    scans: int
    mean_belief: float
    right: Share


# ---------------------------------------------------------------------------
# Recall and chance level
# ---------------------------------------------------------------------------


def find_recall(recalls: Iterable[Recall], label: str, radius_m: float) -> Recall:
    """Return one recall, as `find_recall(recalls, "R@1", 100.0)`; KeyError where there is none."""
    for recall in recalls:
        if recall.label == label and recall.radius_m == radius_m:
            return recall
    raise KeyError(f"no {label} within {radius_m} m")


def one_per_cent(database: int, *, rounded_up: bool) -> int:
    """Return how many places one per cent of a database is, at least 1.

    The released evaluators round to the nearest integer; validation during training rounds up.
    """
    return max(1, math.ceil(database / 100) if rounded_up else round(database / 100.0))


def horizontal_distances(positions: Float64Array, truth: Float64Array) -> Float64Array:
    """Return (Q, K) metres between positions (Q, K, 2 or more) and the truth (Q, 2 or more), same frame."""
    offsets = np.asarray(positions)[..., :2] - np.asarray(truth)[:, None, :2]
    return np.hypot(offsets[..., 0], offsets[..., 1])


def hits(distances_m: Float64Array, rank: int, radius_m: float) -> BoolArray:
    """Return (Q,) whether one of the first `rank` places (Q, K) lies within the radius; NaN never does."""
    return np.asarray((np.asarray(distances_m)[:, :rank] <= radius_m).any(axis=1), dtype=np.bool_)


def recall_at(distances_m: Float64Array, rank: int, radius_m: float) -> float:
    """Return AR@rank: the share of queries with a hit; NaN without queries."""
    found = hits(distances_m, rank, radius_m)
    return float(found.mean()) if len(found) else float("nan")


def submaps_within(submaps: Float64Array, truth: Float64Array, radius_m: float) -> Int64Array:
    """Count (Q,) the submaps (M, 2 or more) whose centres lie within the radius of the truth (Q, 2 or more)."""
    counts = np.empty(len(truth), dtype=np.int64)
    for row, place in enumerate(np.asarray(truth)):  # a row at a time: a whole state's map would not fit as a matrix
        counts[row] = np.count_nonzero(np.hypot(submaps[:, 0] - place[0], submaps[:, 1] - place[1]) <= radius_m)
    return counts


def chance_level(within: Int64Array, database: int, ranks: int) -> Float64Array:
    """Return (ranks,) the mean probability that N = 1.. different places drawn at random hold one of those within.

    `within` (Q,) counts the places within the radius of each query, of `database` in all; NaN without queries.
    """
    if len(within) == 0:
        return np.full(ranks, np.nan)
    counts, rows = np.unique(within, return_inverse=True)
    miss = np.ones((ranks, len(counts)))
    for drawn in range(ranks):
        before = miss[drawn - 1] if drawn else 1.0
        left = database - drawn
        miss[drawn] = before * (np.clip(left - counts, 0.0, None) / left) if left > 0 else before
    return np.array([hit[rows.reshape(-1)].mean() for hit in 1.0 - miss])


# ---------------------------------------------------------------------------
# Shares and quantiles with intervals
# ---------------------------------------------------------------------------


def independent_places(truth: Float64Array, apart_m: float = INDEPENDENT_M) -> int:
    """Count places at least `apart_m` from each other along the drive (Q, 2 or more): a stop adds none."""
    places = np.asarray(truth, dtype=np.float64)[:, :2]
    chosen = np.empty_like(places)
    count = 0
    for place in places:
        offsets = chosen[:count] - place
        if not np.any(np.hypot(offsets[:, 0], offsets[:, 1]) < apart_m):
            chosen[count] = place
            count += 1
    return count


def independent_places_in_areas(area: Int64Array, xy_m: Float64Array) -> int:
    """Count the same over all areas (Q,) of positions (Q, 2)."""
    return sum(independent_places(xy_m[area == each]) for each in np.unique(area))


def clusters_of(area: Int64Array, xy_m: Float64Array) -> Int64Array:
    """Return (Q,) which independent piece of evidence each query belongs to: its area, or a square of 50 m in it."""
    areas = np.unique(area)
    if len(areas) >= _LEAST_CLUSTERS:
        return np.searchsorted(areas, area).astype(np.int64)
    squares = np.column_stack([area, np.floor(xy_m / _BLOCK_M).astype(np.int64)])
    return np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def wilson_share(value: float, count: int, confidence: float = 0.95) -> Share:
    """Return a share with Wilson's score interval for `count` independent trials; it is sound at 0 and 1 too."""
    if count == 0 or not np.isfinite(value):
        return Share(float(value), 0.0, 1.0)
    z = float(norm.ppf(0.5 + confidence / 2))
    centre = (value + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(value * (1 - value) / count + z * z / (4 * count * count))
    return Share(float(value), float(max(0.0, centre - half)), float(min(1.0, centre + half)))


def clustered_share(hit: BoolArray, clusters: Int64Array, places: int) -> Share:
    """Return the share of hits (Q,) with its interval, as the module's docstring explains it.

    `clusters` (Q,): the independent piece of evidence that each query belongs to; `places`: how many places at least
    25 m apart the queries are.
    """
    if len(hit) == 0:
        return Share(float("nan"), 0.0, 1.0)
    share = clustered_mean(hit.astype(np.float64), clusters)
    wilson = wilson_share(share.value, places)
    return Share(share.value, min(share.low, wilson.low), max(share.high, wilson.high))


def clustered_mean(values: Float64Array, clusters: Int64Array) -> Share:
    """Return the mean of values (Q,), at least one, with its interval when whole clusters (Q,) are resampled."""
    numbers = np.unique(clusters, return_inverse=True)[1].reshape(-1)
    sums, counts = np.bincount(numbers, values), np.bincount(numbers)
    drawn = _bootstrap_draws(len(sums))
    low, high = np.percentile((drawn @ sums) / (drawn @ counts), [2.5, 97.5])
    return Share(float(values.mean()), float(low), float(high))


def quantile(values: Float64Array, q: float) -> float:
    """Return a quantile of values (Q,), interpolated; NaN without values."""
    return float(np.quantile(values, q)) if len(values) else math.nan


def clustered_quantile(values: Float64Array, clusters: Int64Array, q: float) -> tuple[float, float, float]:
    """Return a quantile of values (Q,), which may be infinite, and its interval when whole clusters are resampled."""
    if not len(values):
        return math.nan, math.nan, math.nan
    numbers = np.unique(clusters, return_inverse=True)[1].reshape(-1)
    order = np.argsort(values, kind="stable")
    ordered, drawn = values[order], _bootstrap_draws(int(numbers.max()) + 1)[:500]
    reached = np.cumsum(drawn[:, numbers[order]], axis=1)
    totals = reached[:, -1]
    chosen = (reached < q * totals[:, None]).sum(axis=1)
    resampled = np.sort(ordered[np.minimum(chosen, len(ordered) - 1)])
    plain = ordered[min(math.ceil(q * len(ordered)) - 1 if q > 0 else 0, len(ordered) - 1)]
    middle = float(np.median(values)) if q == 0.5 and np.isfinite(values).all() else float(plain)
    low, high = resampled[int(0.025 * len(resampled))], resampled[min(int(0.975 * len(resampled)), len(resampled) - 1)]
    return middle, min(float(low), middle), max(float(high), middle)


@functools.lru_cache(maxsize=16)
def _bootstrap_draws(count: int) -> Float64Array:
    """Return (resamplings, count) how often each of `count` clusters is drawn; always the same."""
    drawn = np.random.default_rng(_SEED).multinomial(count, np.full(count, 1.0 / count), _RESAMPLED)
    return np.asarray(drawn, dtype=np.float64)


# ---------------------------------------------------------------------------
# Probabilities and covariances against the truth
# ---------------------------------------------------------------------------


def reliability(
    probability: Float64Array,
    right: BoolArray,
    borders: Sequence[float],
    trials: Callable[[BoolArray], int] = np.count_nonzero,
) -> tuple[ReliabilityBin, ...]:
    """Compare probabilities (Q,) with what was right (Q,), in ranges between borders; ranges without any are left out.

    `trials` says of the chosen rows (Q,) how many independent trials they are, for Wilson's interval.
    """
    number = np.clip(np.searchsorted(borders, probability, side="right") - 1, 0, len(borders) - 2)
    bins = []
    for i in np.unique(number).tolist():
        inside = np.asarray(number == i, dtype=np.bool_)
        share = wilson_share(float(right[inside].mean()), int(trials(inside)))
        mean = float(probability[inside].mean())
        bins.append(ReliabilityBin(float(borders[i]), float(borders[i + 1]), int(inside.sum()), mean, share))
    return tuple(bins)


def clustered_calibration_error(
    probability: Float64Array, right: BoolArray, clusters: Int64Array, bins: int = 10
) -> Share:
    """Return the expected calibration error of probabilities (Q,), with its interval when clusters (Q,) are resampled.

    The mean over the queries of how far, in each of so many equally wide bins, the mean probability is from the share
    that was right (Naeini et al., AAAI 2015). Chance alone makes it larger than zero, the more the fewer queries a bin
    holds, and resampling adds to it: the interval is one of the errors that such samples show. NaN without queries.
    """
    if not len(right):
        return Share(math.nan, math.nan, math.nan)
    number = np.minimum((np.asarray(probability) * bins).astype(np.int64), bins - 1)
    cluster = np.unique(clusters, return_inverse=True)[1].reshape(-1)
    count = int(cluster.max()) + 1
    excess = np.bincount(cluster * bins + number, probability - right, minlength=count * bins).reshape(count, bins)
    sizes = np.bincount(cluster)
    value = float(np.abs(excess.sum(axis=0)).sum() / len(right))
    drawn = _bootstrap_draws(count)
    low, high = np.percentile(np.abs(drawn @ excess).sum(axis=1) / (drawn @ sizes), [2.5, 97.5])
    return Share(value, min(float(low), value), max(float(high), value))


def rule_of_three(trials: int) -> float:
    """Return the 95 % upper bound of a share of which so many independent trials have shown none; 1 without trials."""
    return min(1.0, 3.0 / trials) if trials else 1.0


def squared_mahalanobis(offsets_m: Float64Array, covariance: Float64Array) -> Float64Array:
    """Return (n,) squared Mahalanobis lengths; infinite where a covariance is singular or not finite."""
    lengths = np.full(len(offsets_m), np.inf)
    determinant = np.linalg.det(np.where(np.isfinite(covariance), covariance, 0.0))
    usable = np.isfinite(covariance).all(axis=(1, 2)) & (determinant > 0)
    solved = np.linalg.solve(covariance[usable], offsets_m[usable][..., None])[..., 0]
    lengths[usable] = np.einsum("ni,ni->n", offsets_m[usable], solved)
    return lengths
