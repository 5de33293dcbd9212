"""A drive's results as one HTML page that needs nothing but itself: map, track, fixes, candidates, plots, words."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.evaluation import charts
from crossloc3d_ros.evaluation.backdrop import Backdrop, draw_backdrop
from crossloc3d_ros.evaluation.estimates import EstimateTable, write_atomically
from crossloc3d_ros.evaluation.recall import (
    CHI2_2D_95,
    INDEPENDENT_M,
    RADII_M,
    RANKS,
    Scores,
    Share,
    horizontal_distances,
    submaps_within,
)
from crossloc3d_ros.evaluation.replay import Evaluation
from crossloc3d_ros.places.store import AerialMap
from crossloc3d_ros.types import Float64Array

SHOWN_CANDIDATES = 10
_MOST_SCANS = 3000
"""A longer drive is thinned evenly on the page, not in the figures."""
_TARGET_MS = 40.0
_CLASSES = ((25.0, "near", "fix within 25 m"), (50.0, "fair", "within 50 m"), (100.0, "far", "within 100 m"))
_WORST = ("wrong", "farther off")


@dataclass(frozen=True)
class About:
    """What the page says of where the figures come from."""

    title: str
    facts: Mapping[str, str]
    """Short names and values: bag, map, weights, how it was run."""
    notes: tuple[str, ...] = ()
    """Sentences that the reader must not miss."""
    footer: str = ""
    latency_is: str = "from handing a scan to the localizer to its estimate"
    extra_words: tuple[str, ...] = field(default=())


def write_report(path: Path, evaluation: Evaluation, aerial_map: AerialMap, about: About) -> None:
    """Write the page; CrossLocError where it cannot be written."""
    table, scores = evaluation.table, evaluation.scores
    places = np.concatenate([table.truth_grid, table.grid[table.has_fix, :2]])
    backdrop = draw_backdrop(aerial_map, places)
    chosen = _chosen_scans(len(table))
    parts = {
        "title": escape(about.title),
        "verdict": _verdict(table, scores),
        "notes": "".join(f'<p class="note">{escape(note)}</p>' for note in about.notes),
        "facts": "".join(f"<li>{escape(name)} <b>{escape(value)}</b></li>" for name, value in about.facts.items()),
        "tiles": _tiles(table, scores),
        "map": _map(table, backdrop, chosen),
        "legend": _legend(scores is not None),
        "error_chart": _error_chart(table, chosen),
        "cdf_chart": _cdf_chart(table, scores, aerial_map.submaps.grid),
        "latency_chart": _latency_chart(table, about),
        "recall": _recall_table(scores, len(aerial_map.submaps)),
        "words": _words(evaluation, aerial_map, about),
        "footer": escape(about.footer),
        "data": _data(table, backdrop, chosen),
        "style": _page_file("page.css"),
        "script": _page_file("page.js"),
    }
    # In one pass, so that nothing is looked for in what was filled in.
    page = re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _page_file("page.html"))
    write_atomically(path, page)


def _page_file(name: str) -> str:
    return (resources.files("crossloc3d_ros.evaluation") / "page" / name).read_text(encoding="utf-8")


def _chosen_scans(count: int) -> list[int]:
    step = max(1, math.ceil(count / _MOST_SCANS))
    return list(range(0, count, step))


# Words and figures


def _verdict(table: EstimateTable, scores: Scores | None) -> str:
    scans, fixes = len(table), int(table.has_fix.sum())
    given = f"Of <b>{scans:,}</b> scans, <b>{fixes:,}</b> ({_percent(fixes / max(scans, 1))}) led to a fix"
    if scores is None:
        return f"{given}. The recording says nothing of where the robot really was, so none of them could be checked."
    five = scores.recall(5, 50.0)
    text = f"Without being told where to start: {given[0].lower()}{given[1:]}"
    if 0 < scores.fix_error.count < 20:
        text += f", off by <b>{_metres(scores.fix_error.median_m)}</b> in the median"
    elif scores.fix_error.count:
        text += (
            f", half of these within <b>{_metres(scores.fix_error.median_m)}</b> of the truth "
            f"and 95 % within {_metres(scores.fix_error.p95_m)}"
        )
    text += (
        ". A submap within 50 m of the robot was among the first five candidates in "
        f"<b>{_percent(five.share.value)}</b> of the scans; drawing five submaps by lot would do so in "
        f"{_percent(five.chance)}."
    )
    return text


def _tiles(table: EstimateTable, scores: Scores | None) -> str:
    fixes = int(table.has_fix.sum())
    tiles = [("Fixes given", _percent(fixes / max(len(table), 1)), f"{fixes:,} of {len(table):,} scans")]
    if scores is not None:
        error, first = scores.fix_error, scores.best_candidate_error
        if error.count:
            tiles.append(("Median error of a fix", _metres(error.median_m), f"95 % within {_metres(error.p95_m)}"))
        tiles.append(
            ("First candidate, median", _metres(first.median_m), "over all scans, also those that gave no fix")
        )
        for rank, name in ((1, "Right place first"), (5, "Among the first five")):
            cell = scores.recall(rank, 50.0)
            tiles.append((name, _percent(cell.share.value), f"within 50 m; by lot {_percent(cell.chance)}"))
    latency = table.latency_ms
    latency = latency[np.isfinite(latency)]
    if len(latency):
        detail = f"median; 95 % within {np.percentile(latency, 95):.0f} ms"
        tiles.append(("Time a scan", f"{np.median(latency):.0f} ms", detail))
    return "".join(
        f'<div class="tile"><span class="what">{escape(what)}</span><span class="value">{value}</span>'
        f'<span class="detail">{escape(detail)}</span></div>'
        for what, value, detail in tiles
    )


def _recall_table(scores: Scores | None, submaps: int) -> str:
    if scores is None:
        return "<p>Not known: the recording has no position to compare with.</p>"
    head = "".join(f"<th scope='col'>within {radius:g} m</th>" for radius in RADII_M)
    rows = []
    for rank in RANKS:
        cells = []
        for radius in RADII_M:
            cell = scores.recall(rank, radius)
            cells.append(
                f"<td><b>{_percent(cell.share.value)}</b>"
                f'<div class="gauge"><i style="width:{100 * _finite(cell.share.value):.1f}%"></i>'
                f'<s style="left:{100 * _finite(cell.chance):.1f}%"></s></div>'
                f"<small>{_interval(cell.share)}</small><small>by lot {_percent(cell.chance)}</small></td>"
            )
        name = "the first candidate" if rank == 1 else f"one of the first {rank}"
        rows.append(f"<tr><th scope='row'>AR@{rank}<small>{name}</small></th>{''.join(cells)}</tr>")
    return (
        f'<div class="scroll"><table class="recall"><thead><tr><th scope="col">Average recall</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
        f'<p class="below">The bar is what was reached, the tick what as many submaps drawn by lot from the '
        f"{submaps:,} of this map would reach on the same drive. Below: the range that holds the true share in 95 of "
        f"100 such drives, counting the {scores.places:,} places along the drive that lie at least "
        f"{INDEPENDENT_M:g} m apart, not the {scores.scored:,} scans.</p>"
    )


def _words(evaluation: Evaluation, aerial_map: AerialMap, about: About) -> str:
    scores, manifest = evaluation.scores, aerial_map.manifest
    half_m = manifest.preprocessing.half_extent_m
    spacing_m = manifest.build.spacing_m
    width_m, height_m = _extent(aerial_map)
    paragraphs = [
        "<h3>What happens to a scan</h3>"
        f"<p>The points above the ground within {half_m:g} m of the robot become one descriptor: a row of numbers that "
        "says what the place looks like. The map holds such a descriptor for a square of "
        f"{2 * half_m:g} × {2 * half_m:g} m every {spacing_m:g} m, {len(aerial_map.submaps):,} in all. The candidates "
        "are the squares whose descriptors are nearest. No odometry, no earlier fix, no compass and no satellite "
        "takes part: every scan is answered as if the robot had just been switched on.</p>",
        "<h3>What an error of some tens of metres means</h3>"
        f"<p>A candidate is a square of {2 * half_m:g} m, not a point. Its centre lies up to "
        f"{spacing_m / math.sqrt(2):.0f} m from the robot even when it is the best there is, so fixes cannot be much "
        "better than that. This is enough to start a local matcher or a particle filter at the right corner; it is "
        "not enough to drive by.</p>",
    ]
    if scores is not None:
        paragraphs.append(
            "<h3>How to read the recall</h3>"
            f"<p>AR@5 within 50 m is the share of scans for which one of the first five squares is centred within 50 m "
            f"of the robot. The map measures {width_m:,.0f} × {height_m:,.0f} m, so guessing already succeeds now and "
            "then: always compare with the tick. On a larger map the same encoder will score lower, because more "
            "places look alike; figures from maps of different size cannot be compared. Candidates crowd together, "
            "because neighbouring squares look alike, while lots fall everywhere: at high ranks and wide radii drawing "
            "by lot may come out ahead of a localizer that is far better at naming one place. "
            + (
                f"For {_percent(1.0 - scores.reachable)} of the scans the map has no square within "
                f"{max(RADII_M):g} m at all, and no method could have found one."
                if scores.reachable < 0.9995
                else "Every scan of this drive has a square of the map within reach."
            )
            + "</p>"
        )
        paragraphs.append(_covariance_words(scores))
    else:
        paragraphs.append(
            "<h3>Why there is no error</h3><p>The recording holds no usable GNSS position at the time of the scans. "
            "The fixes are drawn as they were given; whether they are right cannot be told from here.</p>"
        )
    if evaluation.truth is not None:
        truth = evaluation.truth
        paragraphs.append(
            "<h3>What counts as the truth</h3>"
            f"<p>Topic <code>{escape(truth.topic)}</code>, interpolated at the stamp of each scan: {len(truth):,} "
            f"positions were used and {truth.dropped:,} left out because the receiver had no fix or doubted it by more "
            "than 10 m. The antenna is taken for the robot. Errors are horizontal; heights are not scored.</p>"
        )
    limits = [
        "Heading is not estimated: the answer is a place, not a pose.",
        "Scans taken less than a few metres apart fail and succeed together. A second drive along another street "
        "would say more than ten times as many scans of this one.",
        *about.extra_words,
    ]
    paragraphs.append(
        "<h3>What these figures do not say</h3><ul>" + "".join(f"<li>{escape(item)}</li>" for item in limits) + "</ul>"
    )
    return "".join(paragraphs)


def _covariance_words(scores: Scores) -> str:
    error = scores.fix_error
    if error.count == 0:
        return (
            "<h3>Why there is no fix</h3><p>No scan had a place credible enough for a fix. Step through the scans "
            "above: each says its reason, and its candidates are listed all the same.</p>"
        )
    inside = error.within_ellipse
    if inside >= 0.9:
        judgement = "so the covariance may be believed, at least on drives like this one."
    elif inside >= 0.75:
        judgement = "so the covariance is somewhat too small: whoever fuses these fixes should gate them."
    else:
        judgement = "so the covariance promises too much: a filter that trusts it will be led astray by wrong fixes."
    return (
        "<h3>Can the covariance be trusted?</h3>"
        f"<p>The 95 % ellipses of the fixes held the truth in {_percent(inside)} of {error.count:,} cases, {judgement} "
        "A fix in the wrong street cannot be told from a right one by its error ellipse alone; look at the spread of "
        "the candidates.</p>"
    )


# Map


def _map(table: EstimateTable, backdrop: Backdrop, chosen: list[int]) -> str:
    west, south, east, north = backdrop.bounds
    width, height = east - west, north - south
    unit = width / 700.0  # about a pixel on a desk; scripts keep it exact
    truth = _to_view(table.truth_grid[chosen], backdrop)
    fixes = _to_view(table.grid[chosen, :2], backdrop)
    errors = table.error_m[chosen]
    path = _path(truth)
    marks = [
        f'<path class="truthcase" stroke-width="{4.6 * unit:.2f}" d="{path}"/>'
        f'<path class="truthline" stroke-width="{2.2 * unit:.2f}" d="{path}"/>'
    ]
    for i, (x, y) in enumerate(fixes):
        if table.has_fix[chosen[i]] and math.isfinite(x):
            marks.append(
                f'<circle class="fixdot {_class_of(float(errors[i]))}" cx="{x:.1f}" cy="{y:.1f}" r="{3.6 * unit:.2f}"/>'
            )
    return (
        f'<svg id="map" viewBox="0 0 {width:.1f} {height:.1f}" role="img" aria-label="Map with track and fixes">'
        f'<image href="{backdrop.data_uri}" x="0" y="0" width="{width:.1f}" height="{height:.1f}" '
        f'preserveAspectRatio="none"/><g id="marks" style="--px:{unit:.3f}">{"".join(marks)}</g>'
        f'<g id="overlay"></g>{_scale_bar(width, height)}</svg>'
    )


def _scale_bar(width: float, height: float) -> str:
    length = max(v for v in (10, 20, 50, 100, 200, 500, 1000, 2000) if v <= max(10.0, width / 4))
    unit = width / 700.0
    left, base = 14 * unit, height - 14 * unit
    path = f"M{left:.1f} {base - 6 * unit:.1f}v{6 * unit:.1f}h{length}v{-6 * unit:.1f}"
    return (
        f'<path d="{path}" fill="none" stroke="#fff" stroke-width="{2 * unit:.2f}"/>'
        f'<text x="{left + length / 2:.1f}" y="{base - 5 * unit:.1f}" font-size="{12 * unit:.1f}" '
        f'stroke-width="{3 * unit:.2f}" text-anchor="middle">{length} m</text>'
        f'<text x="{width - 18 * unit:.1f}" y="{height - 14 * unit:.1f}" font-size="{13 * unit:.1f}" '
        f'stroke-width="{3 * unit:.2f}" text-anchor="middle">N ↑</text>'
    )


def _legend(scored: bool) -> str:
    items = []
    if scored:
        items.append('<span><i class="key stroke" style="border-color:#888"></i>where the robot was</span>')
        items += [f'<span><i class="key {css}"></i>{text}</span>' for _, css, text in _CLASSES]
        items.append(f'<span><i class="key {_WORST[0]}"></i>{_WORST[1]}</span>')
    else:
        items.append('<span><i class="key unscored"></i>fix, not checked</span>')
    items.append('<span><i class="key square marked"></i>candidates of the chosen scan</span>')
    items.append('<span><i class="key square empty"></i>no laser return: water, or not flown</span>')
    items.append("<span>Click a place on the track or a fix to choose its scan; Ctrl + wheel zooms.</span>")
    return "".join(items)


# Charts


def _seconds(table: EstimateTable) -> Float64Array:
    return (table.stamp_ns - table.stamp_ns[0]) / 1e9 if len(table) else np.empty(0)


def _error_chart(table: EstimateTable, chosen: list[int]) -> str:
    errors = table.error_m
    first = _candidate_errors(table)[:, :1].min(axis=1, initial=np.inf)
    known = np.isfinite(first) | np.isfinite(errors)
    if not known.any():
        return "<p>Not known: the recording has no position to compare with.</p>"
    seconds = _seconds(table)
    largest = max(float(np.max(values[np.isfinite(values)], initial=1.0)) for values in (errors, first))
    chart = charts.Chart(
        charts.linear_axis(0.0, max(float(seconds[-1]), 1e-3), "seconds since the first scan", suffix=" s"),
        charts.distance_axis(largest, "metres off"),
        "Error of each fix and of each scan's first candidate over time",
        width=1160.0,
        height=340.0,
    )
    low = chart.y.low
    fixes = np.where(table.has_fix, np.maximum(errors, low), np.nan)
    marks = [
        chart.dots(
            seconds[chosen],
            np.where(np.isfinite(first), np.maximum(first, low), np.nan)[chosen],
            ["first"] * len(chosen),
            2.0,
        ),
        chart.dots(seconds[chosen], fixes[chosen], [_class_of(float(errors[i])) for i in chosen], 3.2),
    ]
    return f'<div class="scroll">{chart.render(marks, "errors")}</div>' + (
        '<p class="below"><span><i class="key near"></i><i class="key fair"></i><i class="key far"></i>'
        '<i class="key wrong"></i>fixes, coloured as on the map</span><span><i class="key none"></i>first candidate of '
        "every scan, fix or not</span><span>The scale is logarithmic. Click to choose a scan.</span></p>"
    )


def _cdf_chart(table: EstimateTable, scores: Scores | None, submaps: Float64Array) -> str:
    if scores is None:
        return "<p>Not known: the recording has no position to compare with.</p>"
    scored = np.isfinite(table.truth_grid).all(axis=1)
    distances = _candidate_errors(table)[scored]
    fixes = table.error_m[scored & table.has_fix]
    widest = float(np.max(distances[np.isfinite(distances)], initial=250.0))
    chart = charts.Chart(
        charts.distance_axis(min(widest, 2500.0), "distance from the truth", low_m=5.0),
        charts.share_axis("share at most so far off"),
        "Cumulative share of fixes and candidates over their distance from the truth",
    )
    at = np.geomspace(chart.x.low, chart.x.high, 160)
    marks = [chart.line(at, _chance_curve(table.truth_grid[scored], submaps, at), "s-chance")]
    for rank in reversed(RANKS):
        best = np.fmin.reduce(distances[:, :rank], axis=1) if distances.shape[1] else np.full(len(distances), np.nan)
        marks.append(chart.line(at, charts.cumulative(best, len(distances), at), f"s-{rank}"))
    if len(fixes):
        marks.append(chart.line(at, charts.cumulative(fixes, len(fixes), at), "s-fix"))
    keys = [
        ("near", "fixes, of those given"),
        ("wrong", "first candidate"),
        ("far", "best of five"),
        ("fair", "best of 25"),
    ]
    legend = "".join(
        f'<span><i class="key stroke" style="background:none;border-color:var(--{css})"></i>{text}</span>'
        for css, text in keys
    )
    lot = '<span><i class="key stroke lot"></i>one submap by lot</span>'
    return chart.render(marks) + f'<p class="below">{legend}{lot}</p>'


def _latency_chart(table: EstimateTable, about: About) -> str:
    latency = table.latency_ms
    latency = latency[np.isfinite(latency)]
    if not len(latency):
        return "<p>Not measured.</p>"
    high = max(float(np.percentile(latency, 99.5)) * 1.15, _TARGET_MS * 1.25)
    edges = np.linspace(0.0, high, 51)
    counts, _ = np.histogram(np.minimum(latency, high), edges)
    shares = counts / len(latency)
    chart = charts.Chart(
        charts.linear_axis(0.0, high, "milliseconds a scan"),
        charts.linear_axis(0.0, 100 * float(shares.max()), "% of scans", steps=4),
        "Histogram of the time from scan to estimate",
    )
    marks = [chart.bar(edges[i], edges[i + 1], 100 * share, "bar") for i, share in enumerate(shares) if share > 0]
    marks.append(chart.mark_x(_TARGET_MS, "limit", f"goal {_TARGET_MS:g} ms"))
    marks.append(chart.mark_x(float(np.median(latency)), "median", f"median {np.median(latency):.1f} ms", row=1))
    beyond = int((latency > high).sum())
    steps = table.timings_ms[:, :3]
    text = f"Measured {about.latency_is}."
    if np.isfinite(steps).any():
        prepare, encode, search = np.nanmedian(steps, axis=0)
        text += f" Median parts: preparing {prepare:.1f} ms, encoding {encode:.1f} ms, searching {search:.1f} ms."
    if beyond:
        text += f" {beyond} scans took longer than shown, {latency.max():.0f} ms at most."
    return chart.render(marks) + f'<p class="below">{escape(text)}</p>'


def _chance_curve(truth: Float64Array, submaps: Float64Array, at: Float64Array) -> Float64Array:
    some = truth[:: max(1, len(truth) // 200)]
    return np.array([submaps_within(submaps, some, radius).mean() / max(len(submaps), 1) for radius in at])


def _candidate_errors(table: EstimateTable) -> Float64Array:
    return horizontal_distances(table.candidate_grid, table.truth_grid)


# Data for the script


def _data(table: EstimateTable, backdrop: Backdrop, chosen: list[int]) -> str:
    seconds = _seconds(table)
    truth, fixes = _to_view(table.truth_grid, backdrop), _to_view(table.grid[:, :2], backdrop)
    errors, latency = table.error_m, table.latency_ms
    reasons: dict[str, int] = {}
    scans: list[dict[str, Any]] = []
    for i in chosen:
        is_fix = bool(table.has_fix[i])
        count = int(np.isfinite(table.candidate_grid[i]).all(axis=1).sum())
        places = _to_view(table.candidate_grid[i, : min(count, SHOWN_CANDIDATES)], backdrop)
        scans.append(
            {
                "number": i,
                "t": round(float(seconds[i]), 3),
                "fix": is_fix,
                "at": _pair(fixes[i]) if is_fix else None,
                "truth": _pair(truth[i]),
                "error": _rounded(errors[i], 1) if is_fix else None,
                "ellipse": _ellipse(table.covariance[i, :2, :2]) if is_fix else None,
                "latency": _rounded(latency[i], 2),
                "reason": reasons.setdefault(table.reasons[i], len(reasons)),
                "candidates": [
                    [
                        *(_pair(place) or [0.0, 0.0]),
                        _rounded(table.candidate_distances[i, rank], 4),
                        _rounded(table.candidate_probabilities[i, rank], 4),
                    ]
                    for rank, place in enumerate(places)
                ],
            }
        )
    limits = [{"limit": limit, "name": css} for limit, css, _ in _CLASSES] + [{"limit": None, "name": _WORST[0]}]
    top = int((table.candidate_ids >= 0).sum(axis=1).max(initial=0))
    fixed = [j for j, scan in enumerate(scans) if scan["fix"]]
    content = {
        "scans": scans,
        "reasons": list(reasons),
        "classes": limits,
        "shown": SHOWN_CANDIDATES,
        "top": top,
        "more": top > SHOWN_CANDIDATES,
        "duration": round(float(seconds[-1]), 3) if len(seconds) else 0.0,
        "start": fixed[len(fixed) // 2] if fixed else 0,
    }
    # "</" would end the script element in the middle of the data.
    return json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")


def _ellipse(covariance: Float64Array) -> list[float] | None:
    """Return semi-axes in metres and angle in the picture, degrees clockwise, of the 95 % ellipse."""
    if not np.isfinite(covariance).all():
        return None
    values, axes = np.linalg.eigh(covariance)
    minor, major = np.sqrt(np.maximum(values, 0.0) * CHI2_2D_95)
    angle = math.degrees(math.atan2(-axes[1, 1], axes[0, 1]))
    return [round(float(major), 1), round(float(minor), 1), round(angle, 1)]


def _to_view(grid: Float64Array, backdrop: Backdrop) -> Float64Array:
    """Return (n, 2) metres right of and below the picture's upper left corner."""
    west, _, _, north = backdrop.bounds
    return np.column_stack([grid[:, 0] - west, north - grid[:, 1]])


def _path(points: Float64Array) -> str:
    commands, pen_down = [], False
    for x, y in points:
        if not math.isfinite(x):
            pen_down = False
            continue
        commands.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
        pen_down = True
    return "".join(commands)


def _pair(point: Float64Array) -> list[float] | None:
    return [round(float(point[0]), 1), round(float(point[1]), 1)] if np.isfinite(point).all() else None


def _class_of(error_m: float) -> str:
    if not math.isfinite(error_m):
        return "unscored"
    return next((css for limit, css, _ in _CLASSES if error_m <= limit), _WORST[0])


def _rounded(value: float, digits: int) -> float | None:
    return round(float(value), digits) if math.isfinite(value) else None


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _percent(share: float) -> str:
    if not math.isfinite(share):
        return "–"
    percent = 100 * share
    return f"{percent:.0f} %" if percent >= 10 or percent == 0 else f"{percent:.1f} %"


def _metres(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value / 1000:.1f} km" if value >= 1000 else f"{value:.0f} m"


def _interval(share: Share) -> str:
    return f"{100 * share.low:.0f} to {100 * share.high:.0f} %"


def _extent(aerial_map: AerialMap) -> tuple[float, float]:
    west, south, east, north = aerial_map.bounds
    return east - west, north - south
