"""The charts of a drive's page: errors, headings, states and belief over time, calibration, latency."""

from __future__ import annotations

import math
from html import escape

import numpy as np
from scipy.stats import chi2

from crossloc3d_ros.evaluation.drives.estimates import EstimateTable
from crossloc3d_ros.evaluation.drives.track_scores import SIGMAS, WRONG_M, TrackScores, believed_error_m, contents
from crossloc3d_ros.evaluation.recall import RANKS, Scores, horizontal_distances, submaps_within
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.wording import count, percent
from crossloc3d_ros.types import Float64Array, TrackState

TARGET_MS = 40.0
_POSE_TARGET_MS = 100.0
PLACE_CLASSES = ((25.0, "near", "fix within 25 m"), (50.0, "fair", "within 50 m"), (100.0, "far", "within 100 m"))
POSE_CLASSES = ((1.0, "near", "fix within 1 m"), (3.0, "fair", "within 3 m"), (WRONG_M, "far", "within 10 m"))
WORST = ("wrong", "farther off")
_WIDE = 1160.0
_LOW_M = 0.02
_STATE_HOLDS_S = 2.0
"""So long a state is drawn on after the scan that told it, where no other scan tells one."""
_NOT_KNOWN = "<p>Not known: the recording has no position to compare with.</p>"
STATE_WORDS = {
    TrackState.SEARCHING: "searching",
    TrackState.AMBIGUOUS: "several places",
    TrackState.LOCALIZED: "localized",
    TrackState.LOST: "lost",
}

Classes = tuple[tuple[float, str, str], ...]
"""Upper limit of the error in metres, name in the style sheet, words."""


def error_classes(table: EstimateTable) -> Classes:
    """Return the classes by which fixes are coloured: finer where poses are known."""
    return POSE_CLASSES if table.has_track else PLACE_CLASSES


def class_of(error_m: float, classes: Classes) -> str:
    """Return the name of an error's colour."""
    if not math.isfinite(error_m):
        return "unscored"
    return next((css for limit, css, _ in classes if error_m <= limit), WORST[0])


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


def timeline(table: EstimateTable, chosen: list[int]) -> str:
    """Return state, error, heading and belief over the drive, below each other on one axis of time."""
    if not table.has_track:
        return error_chart(table, chosen)
    parts = [_state_strip(table), error_chart(table, chosen)]
    if np.isfinite(table.heading_error_rad).any():
        parts.append(_heading_chart(table, chosen))
    if np.isfinite(table.probability).any():
        parts.append(_belief_chart(table, chosen))
    return "".join(parts)


def _time_axis(table: EstimateTable) -> charts.Axis:
    seconds = seconds_of(table)
    last = float(seconds[-1]) if len(seconds) else 0.0
    return charts.linear_axis(0.0, max(last, 1e-3), "seconds since the first scan", suffix=" s", steps=10)


def _state_strip(table: EstimateTable) -> str:
    """Return a strip with the state over time, a segment for each stretch of one state."""
    seconds = seconds_of(table)
    chart = charts.Chart(
        charts.Axis(0.0, max(float(seconds[-1]), 1e-3) if len(seconds) else 1e-3, "", []),
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
    seen = {state for state in states if state is not None}
    legend = "".join(
        f'<span><i class="key state-{state.value}"></i>{STATE_WORDS[state]}</span>'
        for state in TrackState
        if state in seen
    )
    return (
        f'<div class="scroll strip">{chart.render(marks, "states", "timeline bare")}</div><p class="below">{legend}</p>'
    )


def error_chart(table: EstimateTable, chosen: list[int]) -> str:
    """Return the error of each fix and of each scan's first candidate over time, with the 2 sigma of poses."""
    errors = table.error_m
    first = _candidate_errors(table)[:, :1].min(axis=1, initial=np.inf)
    known = np.isfinite(first) | np.isfinite(errors)
    if not known.any():
        return _NOT_KNOWN
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
    shade = (
        '<span><i class="key shade"></i>2 sigma: the long half-axis of the ellipse that should hold 95 % of the '
        "errors</span>"
        if tracked
        else ""
    )
    return f'<div class="scroll">{chart.render(marks, "errors", "timeline")}</div>' + (
        '<p class="below"><span><i class="key near"></i><i class="key fair"></i><i class="key far"></i>'
        f'<i class="key wrong"></i>fixes, coloured as on the map</span>{shade}<span><i class="key none"></i>first '
        "candidate of every scan, fix or not</span><span>The scale is logarithmic. Click to choose a scan.</span></p>"
    )


def _heading_chart(table: EstimateTable, chosen: list[int]) -> str:
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
    return f'<div class="scroll">{chart.render(marks, "headings", "timeline")}</div>' + (
        '<p class="below"><span><i class="key heading"></i>heading of each fix</span>'
        '<span><i class="key shade"></i>2 sigma: should hold 95 % of the errors</span></p>'
    )


def _belief_chart(table: EstimateTable, chosen: list[int]) -> str:
    seconds = seconds_of(table)
    chart = charts.Chart(
        _time_axis(table),
        charts.doubt_axis("% believed"),
        "Belief that the error is below ten metres, over time",
        width=_WIDE,
        height=210.0,
    )
    doubt = -np.log10(np.clip(1.0 - table.probability, 10.0**-chart.y.high, 1.0))
    off_m = believed_error_m(table)
    css = ["right" if off_m[i] < WRONG_M else "wrong" if math.isfinite(off_m[i]) else "unscored" for i in chosen]
    marks = [chart.dots(seconds[chosen], doubt[chosen], css, 2.0)]
    return f'<div class="scroll">{chart.render(marks, "beliefs", "timeline")}</div>' + (
        f'<p class="below"><span>Belief that the error is below {WRONG_M:g} m, fix or not</span>'
        '<span><i class="key right"></i>it was</span><span><i class="key wrong"></i>it was not</span></p>'
    )


# Calibration


def belief_calibration(track: TrackScores) -> str:
    """Return how often a belief was right, beside how often it said it would be."""
    rows = track.beliefs
    if not rows:
        return "<p>Not known: no belief has a truth beside it.</p>"
    chart = charts.Chart(
        charts.Axis(
            0.0,
            float(len(rows)),
            f"believed probability of an error below {WRONG_M:g} m",
            [(i + 0.5, _range_words(row.low, row.high)) for i, row in enumerate(rows)],
        ),
        charts.share_axis("was so"),
        "Believed probability against the share that was right",
        height=300.0,
    )
    marks = []
    for i, row in enumerate(rows):
        x = i + 0.5
        marks.append(chart.level(i + 0.16, i + 0.84, row.mean_belief, "belief"))
        marks.append(chart.whisker(x, row.right.low, row.right.high, "whisker"))
        marks.append(chart.dots(np.array([x]), np.array([row.right.value]), ["share"], 5.0))
    words = "".join(
        f"<tr><th scope='row'>{_range_words(row.low, row.high)}</th><td>{row.scans:,}</td>"
        f"<td>{_exact(row.mean_belief)}</td><td>{_exact(row.right.value)}</td></tr>"
        for row in rows
    )
    return (
        f'{chart.render(marks, "belief-calibration")}<p class="below"><span><i class="key share"></i>was so, with the '
        'range that holds the true share in 95 of 100 such drives</span><span><i class="key stroke"></i>said so: an '
        "honest belief has its dot on its line</span></p>"
        '<details><summary>The same in figures</summary><table class="small"><thead><tr><th scope="col">believed</th>'
        '<th scope="col">scans</th><th scope="col">mean belief</th><th scope="col">right</th></tr></thead>'
        f"<tbody>{words}</tbody></table></details>"
    )


def coverage_chart(table: EstimateTable, track: TrackScores) -> str:
    """Return which share of the errors lies inside of the region that should hold a given share."""
    positions, headings = contents(table)
    if not len(positions):
        return "<p>Not known: no fix has a truth beside it.</p>"
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
    keys = ['<span><i class="key stroke" style="background:none;border-color:var(--near)"></i>position</span>']
    if len(headings):
        marks.append(chart.line(at, charts.cumulative(headings, len(headings), at), "s-heading"))
        keys.append(
            '<span><i class="key stroke" style="background:none;border-color:var(--heading)"></i>heading</span>'
        )
    rows = "".join(
        f"<tr><th scope='row'>{row.sigma:g} sigma</th><td>{_exact(row.expected)}</td>"
        f"<td>{_exact(row.position)}</td><td>{_exact(row.heading)}</td></tr>"
        for row in track.coverage
    )
    return (
        f'{chart.render(marks, "coverage")}<p class="below">{"".join(keys)}<span>below the dashed line: the covariance '
        "promises too much</span></p>"
        '<table class="small"><thead><tr><th scope="col">inside of</th><th scope="col">should be</th>'
        f'<th scope="col">position</th><th scope="col">heading</th></tr></thead><tbody>{rows}</tbody></table>'
    )


def _range_words(low: float, high: float) -> str:
    if low <= 0.0:
        return f"< {100 * high:g} %"
    return f"≥ {100 * low:g} %" if high >= 1.0 else f"{100 * low:g}–{100 * high:g} %"


def _exact(share: float) -> str:
    if not math.isfinite(share) or share in (0.0, 1.0):
        return percent(share)
    return f"{100 * share:.1f} %" if share < 0.9995 else f"{100 * min(share, 0.9999):.2f} %"


# Altogether


def cdf_chart(table: EstimateTable, scores: Scores | None, submaps: Float64Array) -> str:
    """Return the cumulative errors of fixes, of aligned poses and of candidates."""
    if scores is None:
        return _NOT_KNOWN
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
    keys = [("wrong", "first candidate"), ("far", "best of five"), ("fair", "best of 25")]
    if len(aligned):
        marks.append(chart.line(at, charts.cumulative(aligned, len(aligned), at), "s-aligned"))
        keys.insert(0, ("aligned", "first aligned pose"))
    if len(fixes):
        marks.append(chart.line(at, charts.cumulative(fixes, len(fixes), at), "s-fix"))
        keys.insert(0, ("near", "fixes, of those given"))
    legend = "".join(
        f'<span><i class="key stroke" style="background:none;border-color:var(--{css})"></i>{text}</span>'
        for css, text in keys
    )
    lot = '<span><i class="key stroke lot"></i>one submap by lot</span>'
    return chart.render(marks) + f'<p class="below">{legend}{lot}</p>'


def latency_chart(table: EstimateTable, latency_is: str) -> str:
    """Return a histogram of the time from scan to estimate."""
    latency = table.latency_ms
    latency = latency[np.isfinite(latency)]
    if not len(latency):
        return "<p>Not measured.</p>"
    target = _POSE_TARGET_MS if table.has_track else TARGET_MS
    high = max(float(np.percentile(latency, 99.5)) * 1.15, target * 1.25)
    edges = np.linspace(0.0, high, 51)
    counts, _ = np.histogram(np.minimum(latency, high), edges)
    shares = counts / len(latency)
    chart = charts.Chart(
        charts.linear_axis(0.0, high, "milliseconds a scan"),
        charts.linear_axis(0.0, 100 * float(shares.max()), "% of scans", steps=4),
        "Histogram of the time from scan to estimate",
    )
    marks = [chart.bar(edges[i], edges[i + 1], 100 * share, "bar") for i, share in enumerate(shares) if share > 0]
    marks.append(chart.mark_x(target, "limit", f"goal {target:g} ms"))
    marks.append(chart.mark_x(float(np.median(latency)), "median", f"median {np.median(latency):.1f} ms", row=1))
    beyond = int((latency > high).sum())
    text = f"Measured {latency_is}."
    steps = table.timings_ms[:, :-1]
    names = ("preparing", "encoding", "searching", "aligning", "following")
    parts = [
        f"{name} {np.median(values):.1f} ms"
        for name, column in zip(names, steps.T, strict=True)
        if len(values := column[np.isfinite(column)]) and (values > 0).any()
    ]
    if parts:
        text += f" Median parts: {', '.join(parts)}."
    if beyond:
        text += f" {count(beyond, 'scan')} took longer than shown, {latency.max():.0f} ms at most."
    return chart.render(marks) + f'<p class="below">{escape(text)}</p>'


def _chance_curve(truth: Float64Array, submaps: Float64Array, at: Float64Array) -> Float64Array:
    some = truth[:: max(1, len(truth) // 200)]
    return np.array([submaps_within(submaps, some, radius).mean() / max(len(submaps), 1) for radius in at])


def _candidate_errors(table: EstimateTable) -> Float64Array:
    return horizontal_distances(table.candidate_grid, table.truth_grid)
