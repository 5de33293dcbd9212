"""Scores of the places along a drive: pure functions over arrays, no files, no maps.

S scans, K candidates of each, best first; distances are horizontal, in metres, NaN where there is no such candidate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.evaluation.statistics import (
    CHI2_2D_95,
    RADII_M,
    Recall,
    Share,
    chance_level,
    find_recall,
    horizontal_distances,
    independent_places,
    recall_at,
    squared_mahalanobis,
    submaps_within,
    wilson_share,
)
from crossloc3d_ros.types import BoolArray, Float64Array

RANKS = (1, 5, 25)


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
        """Return one recall; KeyError where there is none."""
        return find_recall(self.recalls, f"R@{rank}", radius_m)


def summarise_errors(offsets_m: Float64Array, covariance: Float64Array | None = None) -> ErrorSummary:
    """Summarise horizontal offsets (n, 2) from the truth, under covariances (n, 2, 2) where there are any."""
    if len(offsets_m) == 0:
        return ErrorSummary(0, float("nan"), float("nan"), float("nan"))
    distances = np.hypot(offsets_m[:, 0], offsets_m[:, 1])
    inside = float("nan")
    if covariance is not None:
        inside = float(np.mean(squared_mahalanobis(offsets_m, covariance) <= CHI2_2D_95))
    return ErrorSummary(len(offsets_m), float(np.median(distances)), float(np.percentile(distances, 95)), inside)


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
        chance = chance_level(submaps_within(submaps, place, radius_m), len(submaps), max(RANKS))
        for rank in RANKS:
            share = wilson_share(recall_at(distances, rank, radius_m), places)
            recalls.append(Recall(rank, radius_m, share, float(chance[rank - 1]), f"R@{rank}"))
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
