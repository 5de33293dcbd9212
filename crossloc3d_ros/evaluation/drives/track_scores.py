"""Scores of a pose followed along a drive: pure functions over the columns of its estimates.

S scans in the order of their recording; metres, radians, seconds; NaN where something is not known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from crossloc3d_ros.datasets.truth import jumped
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable
from crossloc3d_ros.evaluation.statistics import (
    ReliabilityBin,
    independent_places,
    quantile,
    reliability,
    squared_mahalanobis,
)
from crossloc3d_ros.types import BoolArray, Float64Array

WRONG_M = 10.0
"""A fix farther off than this is wrong; it is also what `probability` speaks of."""
SIGMAS = (1.0, 2.0, 3.0)
BELIEFS = (0.0, 0.01, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0)
"""Borders of the ranges of belief for which it is counted how often it was right."""
FROM_NOTHING, KIDNAPPED, LOST = "from nothing", "kidnapped", "in between"
_SHORT_M = 5.0
"""A gap between right fixes that is shorter than this is counted, not listed."""


@dataclass(frozen=True)
class PoseErrors:
    """Errors of the fixes whose truth is known; NaN without one."""

    count: int
    median_m: float
    p95_m: float
    max_m: float
    headings: int
    """Fixes whose true heading is known."""
    median_deg: float
    p95_deg: float
    wrong: int
    """Fixes farther off than `WRONG_M`."""
    wrong_share: float


@dataclass(frozen=True)
class Coverage:
    """How many errors lie inside of k sigma, beside how many should."""

    sigma: float
    expected: float
    """What one number of a normal distribution gives: 68.3, 95.4, 99.7 %; of positions, the ellipse that holds as
    much."""
    position: float
    heading: float


@dataclass(frozen=True)
class Search:
    """A stretch of the drive without a right fix."""

    start: int
    """Scan at which it began."""
    end: int | None
    """Scan of the right fix that ended it; None where the drive ended first."""
    start_s: float
    seconds: float
    travelled_m: float
    cause: str
    """`FROM_NOTHING`, `KIDNAPPED` or `LOST`."""
    wrong_fixes: int
    """Fixes given meanwhile: wrong by more than `WRONG_M`."""


@dataclass(frozen=True)
class TrackScores:
    """What a drive's poses are worth."""

    scans: int
    scored: int
    """Scans for which the truth is known."""
    fixes: int
    errors: PoseErrors
    coverage: tuple[Coverage, ...]
    beliefs: tuple[ReliabilityBin, ...]
    searches: tuple[Search, ...]
    """The first from the start, those after the robot was kidnapped, and gaps of `_SHORT_M` and more."""
    short_gaps: int
    states: dict[str, int]
    """Scans in each state."""
    travelled_m: float
    """The whole way, jumps left out."""


def score_track(table: EstimateTable) -> TrackScores | None:
    """Score a drive's poses; None where the file knows none, or the truth is known of no scan."""
    known = np.isfinite(table.truth_grid).all(axis=1)
    if not table.has_track or not known.any():
        return None
    way_m, kidnapped = travelled(table)
    states: dict[str, int] = {}
    for state in table.states:
        if state is not None:
            states[state.value] = states.get(state.value, 0) + 1
    searches, short = find_searches(table, way_m, kidnapped)
    return TrackScores(
        scans=len(table),
        scored=int(known.sum()),
        fixes=int(table.has_fix.sum()),
        errors=pose_errors(table),
        coverage=coverage(table),
        beliefs=beliefs(table),
        searches=searches,
        short_gaps=short,
        states=states,
        travelled_m=float(way_m[-1]) if len(way_m) else 0.0,
    )


def travelled(table: EstimateTable) -> tuple[Float64Array, BoolArray]:
    """Return the metres (S,) driven up to each scan, and at which scans (S,) the robot had been kidnapped.

    Along the truth, straight over its gaps. What is too far for the time is no way driven.
    """
    way, kidnapped = np.zeros(len(table)), np.zeros(len(table), dtype=np.bool_)
    known = np.flatnonzero(np.isfinite(table.truth_grid).all(axis=1))
    if len(known) > 1:
        steps = np.hypot(*np.diff(table.truth_grid[known], axis=0).T)
        seconds = np.diff(table.stamp_ns[known]) / 1e9
        jumps = jumped(steps, seconds)
        way[known[1:]] = np.where(jumps, 0.0, steps)
        kidnapped[known[1:]] = jumps
    return np.cumsum(way), kidnapped


def is_right(table: EstimateTable) -> BoolArray:
    """Say (S,) which fixes are off by at most `WRONG_M`; false where the truth is not known."""
    return np.asarray(table.has_fix & (table.error_m <= WRONG_M), dtype=np.bool_)


def pose_errors(table: EstimateTable) -> PoseErrors:
    """Summarise the errors of the fixes."""
    errors = table.error_m[table.has_fix]
    errors = errors[np.isfinite(errors)]
    headings = np.degrees(np.abs(table.heading_error_rad[table.has_fix]))
    headings = headings[np.isfinite(headings)]
    wrong = int((errors > WRONG_M).sum())
    return PoseErrors(
        count=len(errors),
        median_m=quantile(errors, 0.5),
        p95_m=quantile(errors, 0.95),
        max_m=quantile(errors, 1.0),
        headings=len(headings),
        median_deg=quantile(headings, 0.5),
        p95_deg=quantile(headings, 0.95),
        wrong=wrong,
        wrong_share=wrong / len(errors) if len(errors) else math.nan,
    )


def contents(table: EstimateTable) -> tuple[Float64Array, Float64Array]:
    """Return which share of each fix's own distribution lies nearer than the truth: positions (n,), headings (m,).

    Of an honest covariance these are uniform between 0 and 1. Fixes without truth are left out; a covariance that is
    missing or singular gives 1, as if it left no room for the error.
    """
    chosen = table.has_fix & np.isfinite(table.error_m)
    offsets = (table.grid[:, :2] - table.truth_grid)[chosen]
    positions = chi2.cdf(squared_mahalanobis(offsets, table.covariance[chosen, :2, :2]), 2)
    turned = table.heading_error_rad[table.has_fix]
    std = table.heading_std_rad[table.has_fix]
    chosen = np.isfinite(turned)
    turned, std = turned[chosen], std[chosen]
    usable = np.isfinite(std) & (std > 0)
    ratio = np.divide(turned, std, out=np.full(len(turned), np.inf), where=usable)
    return np.asarray(positions, dtype=np.float64), np.asarray(chi2.cdf(ratio**2, 1), dtype=np.float64)


def coverage(table: EstimateTable) -> tuple[Coverage, ...]:
    """Return how many errors of fixes lie inside of k sigma."""
    positions, headings = contents(table)
    rows = []
    for sigma in SIGMAS:
        expected = float(chi2.cdf(sigma**2, 1))
        inside = [float((c <= expected).mean()) if len(c) else math.nan for c in (positions, headings)]
        rows.append(Coverage(sigma, expected, *inside))
    return tuple(rows)


def believed_error_m(table: EstimateTable) -> Float64Array:
    """Return how far off (S,) the place is that `probability` speaks of, fix or not; NaN where there is none.

    Over ROS a place comes with a fix alone; without one it is that of the likeliest hypothesis.
    """
    place = table.grid[:, :2]
    if table.hypotheses.grid.shape[1]:
        place = np.where(np.isfinite(place), place, table.hypotheses.grid[:, 0])
    return np.asarray(np.hypot(*(place - table.truth_grid).T))


def beliefs(table: EstimateTable, borders: Sequence[float] = BELIEFS) -> tuple[ReliabilityBin, ...]:
    """Return for ranges of believed probability, fix or not, how often the error was below `WRONG_M`.

    The intervals are for as many places, not scans.
    """
    off_m = believed_error_m(table)
    known = np.isfinite(table.probability) & np.isfinite(off_m)
    truth = table.truth_grid[known]
    right = np.asarray(off_m[known] < WRONG_M, dtype=np.bool_)
    return reliability(table.probability[known], right, borders, lambda inside: independent_places(truth[inside]))


def find_searches(table: EstimateTable, way_m: Float64Array, kidnapped: BoolArray) -> tuple[tuple[Search, ...], int]:
    """Return the stretches without a right fix, and how many more were shorter than `_SHORT_M` and are left out.

    Scans whose truth is not known neither begin nor end one.
    """
    right = is_right(table)
    known = np.isfinite(table.truth_grid).all(axis=1)
    seconds = (table.stamp_ns - table.stamp_ns[0]) / 1e9 if len(table) else np.empty(0)
    searches: list[Search] = []
    short = 0
    start: int | None = None
    cause = FROM_NOTHING
    for i in np.flatnonzero(known).tolist():
        if kidnapped[i]:
            if start is not None and start != i:
                searches.append(_search(table, way_m, seconds, start, i, cause, ended=False))
            start, cause = i, KIDNAPPED
        elif start is None and not right[i]:
            start = i
            cause = LOST if searches or right[:i].any() else FROM_NOTHING
        if right[i]:
            if start is None and not searches:
                start = i  # the very first fix was right
                cause = FROM_NOTHING
            if start is not None:
                search = _search(table, way_m, seconds, start, i, cause, ended=True)
                if cause == LOST and search.travelled_m < _SHORT_M:
                    short += 1
                else:
                    searches.append(search)
                start = None
    if start is not None:
        searches.append(_search(table, way_m, seconds, start, len(table) - 1, cause, ended=False))
    return tuple(searches), short


def _search(
    table: EstimateTable, way_m: Float64Array, seconds: Float64Array, start: int, end: int, cause: str, *, ended: bool
) -> Search:
    wrong = table.has_fix[start:end] & (table.error_m[start:end] > WRONG_M)
    return Search(
        start=start,
        end=end if ended else None,
        start_s=float(seconds[start]),
        seconds=float(seconds[end] - seconds[start]),
        travelled_m=float(way_m[end] - way_m[start]),
        cause=cause,
        wrong_fixes=int(wrong.sum()),
    )
