"""Scores of place recognition: pure functions over arrays, no files, no maps.

S scans, K candidates of each, best first; distances are horizontal, in metres, NaN where there is no such candidate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

RANKS = (1, 5, 25)
RADII_M = (100.0, 50.0, 25.0)
# Scans nearer to each other than this see much the same, so they are one piece of evidence, not several.
INDEPENDENT_M = 25.0


@dataclass(frozen=True)
class Share:
    """A share of scans, with the interval that holds the true share in 95 of 100 such drives."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Recall:
    """How often one of the first `rank` candidates lies within `radius_m` of the truth."""

    rank: int
    radius_m: float
    share: Share
    chance: float
    """What `rank` different submaps drawn by lot would reach on the same drive and map."""


@dataclass(frozen=True)
class ErrorSummary:
    """Horizontal distances between fixes and truth, metres; NaN without a fix to measure."""

    count: int
    median_m: float
    p95_m: float
    within_ellipse: float
    """Share of fixes whose own 95 % ellipse holds the truth; an honest covariance gives 0.95. NaN without one."""


@dataclass(frozen=True)
class Scores:
    """Everything that a drive's estimates are worth."""

    scans: int
    scored: int
    """Scans for which the truth is known."""
    places: int
    """Independent pieces of evidence among them, see `independent_places`."""
    no_fix: Share
    """Share of all scans for which no fix was given."""
    reachable: float
    """Share of scored scans with a submap within the largest radius: no method can do better."""
    recalls: tuple[Recall, ...]
    fix_error: ErrorSummary
    best_candidate_error: ErrorSummary
    """The same for the first candidate of every scan, whether or not it was credible enough for a fix."""

    def recall(self, rank: int, radius_m: float) -> Recall:
        """Return one cell of the table."""
        for recall in self.recalls:
            if recall.rank == rank and recall.radius_m == radius_m:
                return recall
        raise KeyError(f"no recall at rank {rank} within {radius_m} m")


def horizontal_distances(positions: Float64Array, truth: Float64Array) -> Float64Array:
    """Return (S, K) metres between positions (S, K, 2 or more) and the truth (S, 2 or more), same frame."""
    offsets = np.asarray(positions)[..., :2] - np.asarray(truth)[:, None, :2]
    return np.hypot(offsets[..., 0], offsets[..., 1])


def hits(distances_m: Float64Array, rank: int, radius_m: float) -> BoolArray:
    """Return (S,) whether one of the first `rank` candidates lies within the radius; NaN never does."""
    return np.asarray((np.asarray(distances_m)[:, :rank] <= radius_m).any(axis=1), dtype=np.bool_)


def recall_at(distances_m: Float64Array, rank: int, radius_m: float) -> float:
    """Return AR@rank: the share of scans with a hit; NaN without scans."""
    found = hits(distances_m, rank, radius_m)
    return float(found.mean()) if len(found) else float("nan")


def chance_of_hit(submaps_within: Int64Array, submaps: int, rank: int) -> Float64Array:
    """Return (S,) the probability that `rank` different submaps drawn by lot hold one of those within the radius.

    `submaps_within` (S,) counts the map's submaps within the radius of each scan, of `submaps` in all.
    """
    within = np.asarray(submaps_within, dtype=np.float64)
    miss = np.ones_like(within)
    for drawn in range(min(rank, submaps)):
        miss *= np.clip(submaps - within - drawn, 0.0, None) / (submaps - drawn)
    return 1.0 - miss


def submaps_within(submaps: Float64Array, truth: Float64Array, radius_m: float) -> Int64Array:
    """Count (S,) the submaps (M, 2 or more) whose centres lie within the radius of the truth (S, 2 or more)."""
    counts = np.empty(len(truth), dtype=np.int64)
    for row, place in enumerate(np.asarray(truth)):  # a row at a time: a whole state's map would not fit as a matrix
        counts[row] = np.count_nonzero(np.hypot(submaps[:, 0] - place[0], submaps[:, 1] - place[1]) <= radius_m)
    return counts


def independent_places(truth: Float64Array, apart_m: float = INDEPENDENT_M) -> int:
    """Count places at least `apart_m` from each other along the drive (S, 2 or more): a stop adds none."""
    places = np.asarray(truth, dtype=np.float64)[:, :2]
    chosen = np.empty_like(places)
    count = 0
    for place in places:
        offsets = chosen[:count] - place
        if not np.any(np.hypot(offsets[:, 0], offsets[:, 1]) < apart_m):
            chosen[count] = place
            count += 1
    return count


def wilson_share(value: float, count: int, confidence: float = 0.95) -> Share:
    """Return a share with Wilson's score interval for `count` independent trials; it is sound at 0 and 1 too."""
    if count == 0 or not np.isfinite(value):
        return Share(float(value), 0.0, 1.0)
    z = float(norm.ppf(0.5 + confidence / 2))
    centre = (value + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * np.sqrt(value * (1 - value) / count + z * z / (4 * count * count))
    return Share(float(value), float(max(0.0, centre - half)), float(min(1.0, centre + half)))


def summarise_errors(offsets_m: Float64Array, covariance: Float64Array | None = None) -> ErrorSummary:
    """Summarise horizontal offsets (n, 2) from the truth, under covariances (n, 2, 2) where there are any."""
    if len(offsets_m) == 0:
        return ErrorSummary(0, float("nan"), float("nan"), float("nan"))
    distances = np.hypot(offsets_m[:, 0], offsets_m[:, 1])
    inside = float("nan")
    if covariance is not None:
        inside = float(np.mean(squared_mahalanobis(offsets_m, covariance) <= CHI2_2D_95))
    return ErrorSummary(len(offsets_m), float(np.median(distances)), float(np.percentile(distances, 95)), inside)


# 95 % quantile of chi-squared with two degrees of freedom, -2 ln 0.05.
CHI2_2D_95 = -2.0 * float(np.log(0.05))


def squared_mahalanobis(offsets_m: Float64Array, covariance: Float64Array) -> Float64Array:
    """Return (n,) squared Mahalanobis lengths; infinite where a covariance is singular or not finite."""
    lengths = np.full(len(offsets_m), np.inf)
    determinant = np.linalg.det(np.where(np.isfinite(covariance), covariance, 0.0))
    usable = np.isfinite(covariance).all(axis=(1, 2)) & (determinant > 0)
    solved = np.linalg.solve(covariance[usable], offsets_m[usable][..., None])[..., 0]
    lengths[usable] = np.einsum("ni,ni->n", offsets_m[usable], solved)
    return lengths


def score(
    truth: Float64Array,
    has_fix: BoolArray,
    fixes: Float64Array,
    covariance: Float64Array,
    candidates: Float64Array,
    submaps: Float64Array,
) -> Scores:
    """Score a drive.

    Grid frame, metres: `truth` (S, 2+) with NaN where unknown, `fixes` (S, 2+), their `covariance` (S, 2, 2) and
    `candidates` (S, K, 2+), best first, NaN where there are fewer; `submaps` (M, 2+) are all centres of the map.
    Shares of scans carry Wilson's interval for `independent_places`, not for scans: ten scans a second are no ten
    pieces of evidence.
    """
    known = np.isfinite(truth[:, :2]).all(axis=1)
    place = truth[known]
    distances = horizontal_distances(candidates[known], place)
    places = independent_places(place)
    recalls = []
    for radius_m in RADII_M:
        within = submaps_within(submaps, place, radius_m)
        for rank in RANKS:
            chance = chance_of_hit(within, len(submaps), rank)
            share = wilson_share(recall_at(distances, rank, radius_m), places)
            recalls.append(Recall(rank, radius_m, share, float(chance.mean()) if len(chance) else float("nan")))
    reachable = submaps_within(submaps, place, max(RADII_M)) > 0
    fixed = known & has_fix
    first = candidates[:, 0, :2] if candidates.shape[1] else np.full((len(truth), 2), np.nan)
    proposed = known & np.isfinite(first).all(axis=1)
    no_fix = float(np.mean(~has_fix)) if len(has_fix) else float("nan")
    return Scores(
        scans=len(truth),
        scored=int(known.sum()),
        places=places,
        no_fix=wilson_share(no_fix, places),
        reachable=float(reachable.mean()) if len(reachable) else float("nan"),
        recalls=tuple(recalls),
        fix_error=summarise_errors((fixes[:, :2] - truth[:, :2])[fixed], covariance[fixed]),
        best_candidate_error=summarise_errors((first - truth[:, :2])[proposed]),
    )
