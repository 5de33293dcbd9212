"""The charts of a drive's page: errors, headings, states and belief over time, calibration, latency."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from scipy.stats import chi2

from crossloc3d_ros.evaluation.drives.estimates import EstimateTable
from crossloc3d_ros.evaluation.drives.place_scores import RANKS, Scores
from crossloc3d_ros.evaluation.drives.track_scores import SIGMAS, WRONG_M, TrackScores, believed_error_m, contents
from crossloc3d_ros.evaluation.statistics import horizontal_distances, submaps_within
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.wording import percent_range
from crossloc3d_ros.types import Float64Array, TrackState

_PLACE_TARGET_MS, _POSE_TARGET_MS = 40.0, 100.0
PLACE_CLASSES = ((25.0, "near"), (50.0, "fair"), (100.0, "far"))
POSE_CLASSES = ((1.0, "near"), (3.0, "fair"), (WRONG_M, "far"))
WORST = "wrong"
_WIDE = 1160.0
_LOW_M = 0.02
_STATE_HOLDS_S = 2.0
"""A state is drawn for so long after its scan, where no other scan has one."""
_STEPS = ("prepare", "encode", "search", "align", "fuse")
STATE_WORDS = {
    TrackState.SEARCHING: "searching",
    TrackState.AMBIGUOUS: "several places",
    TrackState.LOCALIZED: "localized",
    TrackState.LOST: "lost",
}

Classes = tuple[tuple[float, str], ...]
"""Upper limit of the error in metres, name in the style sheet."""


@dataclass(frozen=True)
class StateStrip:
    """The state over time."""

    chart: Markup
    seen: tuple[str, ...]
    """The states that occur."""


@dataclass(frozen=True)
class Distribution:
    """Cumulative errors."""

    chart: Markup
    has_fixes: bool
    has_aligned: bool


@dataclass(frozen=True, eq=False)
class Latency:
    """Time from scan to estimate, milliseconds."""

    values_ms: Float64Array
    """Of the scans that were measured."""
    median_ms: float
    p95_ms: float
    max_ms: float
    goal_ms: float
    shown_ms: float
    """Where the histogram ends."""
    beyond: int
    """Scans that took longer."""
    steps_ms: Mapping[str, float]
    """Median of each step that was measured."""


def error_classes(table: EstimateTable) -> Classes:
    """Return the classes by which fixes are coloured: finer where poses are known."""
    return POSE_CLASSES if table.has_track else PLACE_CLASSES


def class_of(error_m: float, classes: Classes) -> str:
    """Return the name of an error's colour."""
    if not math.isfinite(error_m):
        return "unscored"
    return next((css for limit, css in classes if error_m <= limit), WORST)


def seconds_of(table: EstimateTable) -> Float64Array:
    """Return the seconds (S,) since the first scan."""
    return (table.stamp_ns - table.stamp_ns[0]) / 1e9 if len(table) else np.empty(0)


def two_sigma_m(table: EstimateTable) -> Float64Array:
    """Return the long half-axis (S,) of the ellipse that should hold the truth in 95.4 of 100 cases; NaN without."""
    covariance = table.covariance[:, :2, :2]
    whole = np.isfinite(covariance).all(axis=(1, 2))
    result = np.full(len(table), np.nan)
    largest = np.linalg.eigvalsh(covariance[whole])[:, -1]
    result[whole] = np.sqrt(np.maximum(largest, 0.0) * chi2.ppf(chi2.cdf(4.0, 1), 2))
    return result


def duration_s(table: EstimateTable) -> float:
    """Return the seconds from the first to the last scan."""
    return float(table.stamp_ns[-1] - table.stamp_ns[0]) / 1e9 if len(table) else 0.0


def _time_axis(table: EstimateTable) -> charts.Axis:
    return charts.linear_axis(0.0, max(duration_s(table), 1e-3), "seconds since the first scan", suffix=" s", steps=10)


def state_strip(table: EstimateTable) -> StateStrip | None:
    """Return a strip with a segment for each stretch of one state; None of places."""
    if not table.has_track:
        return None
    seconds = seconds_of(table)
    chart = charts.Chart(
        charts.Axis(0.0, max(duration_s(table), 1e-3), "", []),
        charts.Axis(0.0, 1.0, "", []),
        "State over time",
        width=_WIDE,
        height=50.0,
        foot=8.0,
    )
    states = table.states
    known = [i for i, state in enumerate(states) if state is not None]
    marks, begin = [], 0
    for j in range(1, len(known) + 1):
        first, last = known[begin], known[j - 1]
        following = known[j] if j < len(known) else last
        is_gap = seconds[following] - seconds[last] > _STATE_HOLDS_S
        if j < len(known) and states[following] is states[first] and not is_gap:
            continue
        state, until = states[first], seconds[last] if is_gap else seconds[following]
        if state is not None:
            left, right = chart.x_px(seconds[first]), chart.x_px(until)
            marks.append(
                f'<rect class="state-{state.value}" x="{left:.2f}" y="{chart.y_px(1.0):g}" '
                f'width="{max(0.7, right - left):.2f}" height="{chart.y_px(0.0) - chart.y_px(1.0):g}">'
                f"<title>{STATE_WORDS[state]}, {seconds[first]:.1f} to {until:.1f} s</title></rect>"
            )
        begin = j
    seen = tuple(state.value for state in TrackState if state in states)
    return StateStrip(chart.render(marks, "states", "timeline bare"), seen)


def error_chart(table: EstimateTable, chosen: list[int]) -> Markup | None:
    """Return the error of each fix and of each scan's first candidate over time, with the 2 sigma of poses.

    None where no truth is known.
    """
    errors = table.error_m
    first = _candidate_errors(table)[:, :1].min(axis=1, initial=np.inf)
    known = np.isfinite(first) | np.isfinite(errors)
    if not known.any():
        return None
    seconds, tracked = seconds_of(table), table.has_track
    classes = error_classes(table)
    largest = max(float(np.max(values[np.isfinite(values)], initial=1.0)) for values in (errors, first))
    low = _LOW_M if tracked else 2.0
    chart = charts.Chart(
        _time_axis(table),
        charts.distance_axis(largest, "metres off", low),
        "Error of each fix and of each scan's first candidate over time",
        width=_WIDE,
        height=340.0,
    )
    fixes = np.where(table.has_fix, np.maximum(errors, low), np.nan)
    marks = []
    if tracked:
        sigma = np.where(table.has_fix, two_sigma_m(table), np.nan)[chosen]
        marks.append(chart.band(seconds[chosen], np.full(len(chosen), low), np.maximum(sigma, low), "inside"))
    marks += [
        chart.dots(
            seconds[chosen],
            np.where(np.isfinite(first), np.maximum(first, low), np.nan)[chosen],
            ["first"] * len(chosen),
            1.5 if tracked else 2.0,
        ),
        chart.dots(
            seconds[chosen],
            fixes[chosen],
            [class_of(float(errors[i]), classes) for i in chosen],
            2.4 if tracked else 3.2,
        ),
    ]
    return chart.render(marks, "errors", "timeline")


def heading_chart(table: EstimateTable, chosen: list[int]) -> Markup | None:
    """Return the heading error of each fix over time; None where none is known."""
    if not np.isfinite(table.heading_error_rad).any():
        return None
    seconds = seconds_of(table)
    chart = charts.Chart(
        _time_axis(table),
        charts.angle_axis("degrees off"),
        "Heading error of each fix over time",
        width=_WIDE,
        height=250.0,
    )
    low = chart.y.low
    off = np.where(table.has_fix, np.maximum(np.degrees(np.abs(table.heading_error_rad)), low), np.nan)
    sigma = np.where(table.has_fix, 2.0 * np.degrees(table.heading_std_rad), np.nan)
    marks = [
        chart.band(seconds[chosen], np.full(len(chosen), low), np.clip(sigma[chosen], low, 180.0), "inside"),
        chart.dots(seconds[chosen], off[chosen], ["heading"] * len(chosen), 2.0),
    ]
    return chart.render(marks, "headings", "timeline")


def belief_chart(table: EstimateTable, chosen: list[int]) -> Markup | None:
    """Return the belief of each scan over time; None where there is none."""
    if not np.isfinite(table.probability).any():
        return None
    seconds = seconds_of(table)
    chart = charts.Chart(
        _time_axis(table),
        charts.doubt_axis("probability, %"),
        "Probability of an error below ten metres, over time",
        width=_WIDE,
        height=210.0,
    )
    doubt = -np.log10(np.clip(1.0 - table.probability, 10.0**-chart.y.high, 1.0))
    off_m = believed_error_m(table)
    css = ["right" if off_m[i] < WRONG_M else "wrong" if math.isfinite(off_m[i]) else "unscored" for i in chosen]
    marks = [chart.dots(seconds[chosen], doubt[chosen], css, 2.0)]
    return chart.render(marks, "beliefs", "timeline")


# Calibration


def belief_calibration(track: TrackScores) -> Markup | None:
    """Return how often a belief was right, beside how often it said it would be; None without any."""
    rows = track.beliefs
    if not rows:
        return None
    chart = charts.Chart(
        charts.Axis(
            0.0,
            float(len(rows)),
            f"estimated probability of an error below {WRONG_M:g} m",
            [(i + 0.5, percent_range(row.low, row.high)) for i, row in enumerate(rows)],
        ),
        charts.share_axis("right"),
        "Estimated probability against the share that was right",
        height=300.0,
    )
    marks = []
    for i, row in enumerate(rows):
        x = i + 0.5
        marks.append(chart.level(i + 0.16, i + 0.84, row.mean_belief, "belief"))
        marks.append(chart.whisker(x, row.right.low, row.right.high, "whisker"))
        marks.append(chart.dots(np.array([x]), np.array([row.right.value]), ["share"], 5.0))
    return chart.render(marks, "belief-calibration")


def coverage_chart(table: EstimateTable) -> Markup | None:
    """Return which share of the errors lies inside of the region that should hold a given share; None without any."""
    positions, headings = contents(table)
    if not len(positions):
        return None
    chart = charts.Chart(
        charts.Axis(0.0, 1.0, "should hold", [(i / 4, f"{25 * i} %") for i in range(5)]),
        charts.share_axis("held"),
        "Share of errors inside of a region against the share that it should hold",
        height=300.0,
    )
    at = np.linspace(0.0, 1.0, 101)
    marks = [chart.line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "s-chance")]
    for sigma in SIGMAS:
        content = float(chi2.cdf(sigma**2, 1))
        marks.append(chart.mark_x(content, "sigma"))
        if sigma < 3.0:  # the third leaves no room
            marks.append(chart.word(content - 0.055, 0.03, f"{sigma:g} sigma"))
    marks.append(chart.line(at, charts.cumulative(positions, len(positions), at), "s-fix"))
    if len(headings):
        marks.append(chart.line(at, charts.cumulative(headings, len(headings), at), "s-heading"))
    return chart.render(marks, "coverage")


# Altogether


def error_distribution(table: EstimateTable, scores: Scores | None, submaps: Float64Array) -> Distribution | None:
    """Return the cumulative errors of fixes, of aligned poses and of candidates; None where no truth is known."""
    if scores is None:
        return None
    scored = np.isfinite(table.truth_grid).all(axis=1)
    distances = _candidate_errors(table)[scored]
    fixes = table.error_m[scored & table.has_fix]
    aligned = np.hypot(*(table.first_aligned[0] - table.truth_grid).T)
    aligned = aligned[np.isfinite(aligned)]
    widest = float(np.max(distances[np.isfinite(distances)], initial=250.0))
    tracked = table.has_track
    chart = charts.Chart(
        charts.distance_axis(
            min(widest, 2500.0), "distance from the truth", low_m=0.05 if tracked else 5.0, most_ticks=8
        ),
        charts.share_axis("share at most so far off"),
        "Cumulative share of fixes and candidates over their distance from the truth",
    )
    at = np.geomspace(chart.x.low, chart.x.high, 200)
    marks = [chart.line(at, _chance_curve(table.truth_grid[scored], submaps, at), "s-chance")]
    for rank in reversed(RANKS):
        best = np.fmin.reduce(distances[:, :rank], axis=1) if distances.shape[1] else np.full(len(distances), np.nan)
        marks.append(chart.line(at, charts.cumulative(best, len(distances), at), f"s-{rank}"))
    if len(aligned):
        marks.append(chart.line(at, charts.cumulative(aligned, len(aligned), at), "s-aligned"))
    if len(fixes):
        marks.append(chart.line(at, charts.cumulative(fixes, len(fixes), at), "s-fix"))
    return Distribution(chart.render(marks), has_fixes=len(fixes) > 0, has_aligned=len(aligned) > 0)


def measure_latency(table: EstimateTable) -> Latency | None:
    """Return the time from scan to estimate; None where it was not measured."""
    values = table.latency_ms[np.isfinite(table.latency_ms)]
    if not len(values):
        return None
    goal = _POSE_TARGET_MS if table.has_track else _PLACE_TARGET_MS
    shown = max(float(np.percentile(values, 99.5)) * 1.15, goal * 1.25)
    steps = {name: column[np.isfinite(column)] for name, column in zip(_STEPS, table.timings_ms.T, strict=False)}
    return Latency(
        values_ms=values,
        median_ms=float(np.median(values)),
        p95_ms=float(np.percentile(values, 95)),
        max_ms=float(values.max()),
        goal_ms=goal,
        shown_ms=shown,
        beyond=int((values > shown).sum()),
        steps_ms={name: float(np.median(step)) for name, step in steps.items() if (step > 0).any()},
    )


def latency_chart(latency: Latency) -> Markup:
    """Return a histogram of the time from scan to estimate."""
    edges = np.linspace(0.0, latency.shown_ms, 51)
    counts, _ = np.histogram(np.minimum(latency.values_ms, latency.shown_ms), edges)
    shares = counts / len(latency.values_ms)
    chart = charts.Chart(
        charts.linear_axis(0.0, latency.shown_ms, "milliseconds a scan"),
        charts.linear_axis(0.0, 100 * float(shares.max()), "% of scans", steps=4),
        "Histogram of the time from scan to estimate",
    )
    marks = [chart.bar(edges[i], edges[i + 1], 100 * share, "bar") for i, share in enumerate(shares) if share > 0]
    marks.append(chart.mark_x(latency.goal_ms, "limit", f"goal {latency.goal_ms:g} ms"))
    marks.append(chart.mark_x(latency.median_ms, "median", f"median {latency.median_ms:.1f} ms", row=1))
    return chart.render(marks)


def _chance_curve(truth: Float64Array, submaps: Float64Array, at: Float64Array) -> Float64Array:
    some = truth[:: max(1, len(truth) // 200)]
    return np.array([submaps_within(submaps, some, radius).mean() / max(len(submaps), 1) for radius in at])


def _candidate_errors(table: EstimateTable) -> Float64Array:
    return horizontal_distances(table.candidate_grid, table.truth_grid)
