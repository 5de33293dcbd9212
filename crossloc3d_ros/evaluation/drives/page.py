"""A drive's results as one HTML page that needs nothing but itself: map, track, hypotheses, plots, words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.datasets.truth import TruthTrack
from crossloc3d_ros.evaluation.drives import charts as replay_charts
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable, wrapped
from crossloc3d_ros.evaluation.drives.evaluation import Evaluation
from crossloc3d_ros.evaluation.drives.page_map import draw_map, grid_turn_rad, legend, page_data
from crossloc3d_ros.evaluation.drives.track_scores import CARRIED, FROM_NOTHING, LOST, WRONG_M, Search, TrackScores
from crossloc3d_ros.evaluation.recall import INDEPENDENT_M, RADII_M, RANKS, Scores, horizontal_distances
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.pages.backdrop import draw_backdrop
from crossloc3d_ros.pages.wording import count, degrees, finite, interval, metres, percent

_MOST_SCANS = 3000
"""A longer drive is thinned evenly on the page, not in the figures."""
_MOST_SEARCHES = 8
"""Of the times when it was lost, the longest are listed."""


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
    table, scores, track = evaluation.table, evaluation.scores, evaluation.track
    places = np.concatenate([table.truth_grid, table.grid[table.has_fix, :2]])
    backdrop = draw_backdrop(aerial_map, places)
    chosen = _chosen_scans(len(table))
    parts = {
        "title": escape(about.title),
        "verdict": _verdict(table, scores, track),
        "notes": "".join(f'<p class="note">{escape(note)}</p>' for note in about.notes),
        "facts": "".join(f"<li>{escape(name)} <b>{escape(value)}</b></li>" for name, value in about.facts.items()),
        "tiles": _tiles(table, scores, track),
        "map": draw_map(table, backdrop, chosen),
        "legend": legend(table, scored=scores is not None),
        "timeline": replay_charts.timeline(table, chosen),
        "track": "" if track is None else _track_sections(table, track, aerial_map.frame),
        "cdf_chart": replay_charts.cdf_chart(table, scores, aerial_map.submaps.grid),
        "latency_chart": replay_charts.latency_chart(table, about.latency_is),
        "recall": _recall_table(scores, len(aerial_map.submaps)),
        "words": _words(evaluation, aerial_map, about),
        "footer": escape(about.footer),
        "data": page_data(table, backdrop, chosen, aerial_map.frame),
        "style": _page_file("page.css"),
        "script": _page_file("page.js"),
    }
    # In one pass, so that nothing is looked for in what was filled in.
    page = re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _page_file("page.html"))
    write_atomically(path, page)


def _page_file(name: str) -> str:
    return (resources.files("crossloc3d_ros.pages") / "assets" / name).read_text(encoding="utf-8")


def _chosen_scans(count: int) -> list[int]:
    step = max(1, math.ceil(count / _MOST_SCANS))
    return list(range(0, count, step))


# Words and figures


def _verdict(table: EstimateTable, scores: Scores | None, track: TrackScores | None) -> str:
    if track is not None:
        return _track_verdict(table, track)
    scans, fixes = len(table), int(table.has_fix.sum())
    given = f"Of <b>{scans:,}</b> scans, <b>{fixes:,}</b> ({percent(fixes / max(scans, 1))}) led to a fix"
    if scores is None:
        return f"{given}. The recording says nothing of where the robot really was, so none of them could be checked."
    five = scores.recall(5, 50.0)
    text = f"Without being told where to start: {given[0].lower()}{given[1:]}"
    if 0 < scores.fix_error.count < 20:
        text += f", off by <b>{metres(scores.fix_error.median_m)}</b> in the median"
    elif scores.fix_error.count:
        text += (
            f", half of these within <b>{metres(scores.fix_error.median_m)}</b> of the truth "
            f"and 95 % within {metres(scores.fix_error.p95_m)}"
        )
    text += (
        ". A submap within 50 m of the robot was among the first five candidates in "
        f"<b>{percent(five.share.value)}</b> of the scans; drawing five submaps by lot would do so in "
        f"{percent(five.chance)}."
    )
    return text


def _track_verdict(table: EstimateTable, track: TrackScores) -> str:
    errors = track.errors
    duration = (table.stamp_ns[-1] - table.stamp_ns[0]) / 1e9
    text = (
        f"On a drive of <b>{metres(track.travelled_m)}</b> in {duration:,.0f} s, without being told where to start: "
        f"<b>{track.fixes:,}</b> of <b>{track.scans:,}</b> scans ({percent(track.fixes / max(track.scans, 1))}) led to "
        "a fix. "
    )
    first = _from_nothing(track)
    if first is not None and first.end is None:
        text += "It never found out where it was. "
    elif first is not None:
        text += f"It knew its place after <b>{metres(first.travelled_m)}</b> and {first.seconds:.1f} s. "
    for search in (s for s in track.searches if s.cause == CARRIED):
        text += (
            "Carried away, it never found its place again. "
            if search.end is None
            else f"Carried away, it had it again after <b>{metres(search.travelled_m)}</b>. "
        )
    if errors.count:
        text += (
            f"Half of the fixes are off by less than <b>{metres(errors.median_m)}</b>, 95 % by less than "
            f"{metres(errors.p95_m)}"
        )
        if errors.headings:
            text += f"; of the headings by <b>{degrees(errors.median_deg)}</b> and {degrees(errors.p95_deg)}"
        text += f". {_wrong_words(track)}"
    return text


def _wrong_words(track: TrackScores) -> str:
    errors = track.errors
    if errors.wrong == 0:
        return f"None of them is wrong by more than {WRONG_M:g} m."
    return f"<b>{errors.wrong:,} of them</b> ({percent(errors.wrong_share)}) are wrong by more than {WRONG_M:g} m."


def _from_nothing(track: TrackScores) -> Search | None:
    return next((search for search in track.searches if search.cause == FROM_NOTHING), None)


def _track_tiles(track: TrackScores) -> list[tuple[str, str, str]]:
    errors = track.errors
    tiles = [("Fixes given", percent(track.fixes / max(track.scans, 1)), f"{track.fixes:,} of {track.scans:,} scans")]
    first = _from_nothing(track)
    if first is not None:
        found = first.end is not None
        tiles.append(
            (
                "Until localized",
                metres(first.travelled_m) if found else "never",
                f"driven, in {first.seconds:.1f} s, from nothing" if found else f"in {first.seconds:.0f} s",
            )
        )
    if errors.count:
        tiles.append(("Error of a fix", metres(errors.median_m), f"median; 95 % within {metres(errors.p95_m)}"))
        if errors.headings:
            tiles.append(
                ("Heading", degrees(errors.median_deg), f"off in the median; 95 % within {degrees(errors.p95_deg)}")
            )
        tiles.append(
            ("Wrong fixes", percent(errors.wrong_share), f"{errors.wrong:,} of {errors.count:,} off by over 10 m")
        )
        two = track.coverage[1]
        tiles.append(("Inside 2 sigma", percent(two.position), f"of the errors; should be {percent(two.expected)}"))
    return tiles


def _track_sections(table: EstimateTable, track: TrackScores, frame: MapFrame) -> str:
    return (
        '<section class="pair"><div><h2>Was it as often right as it believed?</h2>'
        f"{replay_charts.belief_calibration(track)}</div><div><h2>Does the covariance hold what it promises?</h2>"
        f"{replay_charts.coverage_chart(table, track)}</div></section>"
        '<section aria-labelledby="search-title"><h2 id="search-title">When it did not know where it was</h2>'
        f"{_search_table(track)}</section>"
        '<section aria-labelledby="steps-title"><h2 id="steps-title">What each step brings</h2>'
        f"{_steps_table(table, frame)}</section>"
    )


def _search_table(track: TrackScores) -> str:
    longest = sorted((s.travelled_m for s in track.searches if s.cause == LOST), reverse=True)[:_MOST_SEARCHES]
    shown = [s for s in track.searches if s.cause != LOST or s.travelled_m >= longest[-1]]
    rows = []
    for search in shown:
        rows.append(
            f"<tr><th scope='row'>{escape(search.cause)}<small>at {search.start_s:.1f} s, scan {search.start + 1:,}"
            f"</small></th><td><b>{metres(search.travelled_m)}</b></td><td>{search.seconds:.1f} s</td>"
            f"<td>{'found' if search.end is not None else 'not found'}</td>"
            f"<td>{search.wrong_fixes:,}</td></tr>"
        )
    short = (
        f" {len(track.searches) - len(shown):,} shorter ones are left out." if len(shown) < len(track.searches) else ""
    )
    if track.short_gaps:
        are = "is" if track.short_gaps == 1 else "are"
        short += f" {count(track.short_gaps, 'gap')} of less than 5 m between right fixes {are} not listed."
    return (
        '<div class="scroll"><table class="recall"><thead><tr><th scope="col">Stretch without a right fix</th>'
        '<th scope="col">driven</th><th scope="col">time</th><th scope="col">how it ended</th>'
        f'<th scope="col">wrong fixes meanwhile</th></tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        f'<p class="below">A fix is right where it is off by at most {WRONG_M:g} m. Ways are driven ways: what the '
        f"robot was carried does not count.{short}</p>"
    )


def _steps_table(table: EstimateTable, frame: MapFrame) -> str:
    """Return how many scans each step alone puts right, of all scans whose truth is known."""
    known = np.isfinite(table.truth_grid).all(axis=1)
    candidates = horizontal_distances(table.candidate_grid, table.truth_grid)
    place, heading = table.first_aligned
    aligned = np.hypot(*(place - table.truth_grid).T)
    looked = known & np.isfinite(aligned)
    turn = np.abs(np.degrees(wrapped(heading - table.truth_heading_rad - grid_turn_rad(table, frame))))
    fix = np.where(table.has_fix, table.error_m, np.inf)
    fix_turn = np.abs(np.degrees(table.heading_error_rad))
    heads = ("within 25 m", "within 10 m", "within 2 m", "within 2 m and 5°")
    nothing = np.full(len(table), np.inf)
    steps = (
        (
            "retrieval",
            f"the first square, {known.sum():,} scans",
            known,
            candidates[:, 0] if candidates.shape[1] else nothing,
            nothing,
        ),
        ("+ alignment", f"the likeliest aligned pose, {looked.sum():,} scans", looked, aligned, turn),
        ("+ following", f"the fix, where one is given, {known.sum():,} scans", known, fix, fix_turn),
    )
    rows = []
    for name, what, among, off, turned in steps:
        cells = []
        for column, limit in enumerate((25.0, 10.0, 2.0, 2.0)):
            hit = (off <= limit) & ((turned <= 5.0) if column == 3 else True) & among
            share = float(hit.sum()) / max(int(among.sum()), 1)
            unknown = (
                not among.any()
                or (column == 3 and not np.isfinite(turned[among]).any())
                or (name == "retrieval" and limit < 10.0)
            )
            gauge = f'<div class="gauge"><i style="width:{100 * share:.1f}%"></i></div>'
            cells.append("<td>–</td>" if unknown else f"<td><b>{percent(share)}</b>{gauge}</td>")
        rows.append(f"<tr><th scope='row'>{name}<small>{what}</small></th>{''.join(cells)}</tr>")
    head = "".join(f"<th scope='col'>{text}</th>" for text in heads)
    return (
        f'<div class="scroll"><table class="recall"><thead><tr><th scope="col">Share of the scans</th>{head}</tr>'
        f"</thead><tbody>{''.join(rows)}</tbody></table></div>"
        '<p class="below">The first two rows look at one scan alone, as if the robot had just been switched on, '
        "believed or not; of aligned poses count those that were found around the candidates or on the whole map, "
        "which are looked for a few times a second, and less often once the place is known. The last row gives no fix "
        "where it is not sure.</p>"
    )


def _tiles(table: EstimateTable, scores: Scores | None, track: TrackScores | None) -> str:
    fixes = int(table.has_fix.sum())
    tiles = [("Fixes given", percent(fixes / max(len(table), 1)), f"{fixes:,} of {len(table):,} scans")]
    if track is not None:
        tiles = _track_tiles(track)
    elif scores is not None:
        error, first = scores.fix_error, scores.best_candidate_error
        if error.count:
            tiles.append(("Median error of a fix", metres(error.median_m), f"95 % within {metres(error.p95_m)}"))
        tiles.append(("First candidate, median", metres(first.median_m), "over all scans, also those that gave no fix"))
        for rank, name in ((1, "Right place first"), (5, "Among the first five")):
            cell = scores.recall(rank, 50.0)
            tiles.append((name, percent(cell.share.value), f"within 50 m; by lot {percent(cell.chance)}"))
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
                f"<td><b>{percent(cell.share.value)}</b>"
                f'<div class="gauge"><i style="width:{100 * finite(cell.share.value):.1f}%"></i>'
                f'<s style="left:{100 * finite(cell.chance):.1f}%"></s></div>'
                f"<small>{interval(cell.share)}</small><small>by lot {percent(cell.chance)}</small></td>"
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
    tracked = evaluation.table.has_track
    half_m = manifest.preprocessing.half_extent_m
    spacing_m = manifest.build.spacing_m
    width_m, height_m = _extent(aerial_map)
    retrieval = (
        f"The points above the ground within {half_m:g} m of the robot become one descriptor: a row of numbers that "
        "says what the place looks like. The map holds such a descriptor for a square of "
        f"{2 * half_m:g} × {2 * half_m:g} m every {spacing_m:g} m, {len(aerial_map.submaps):,} in all. The candidates "
        "are the squares whose descriptors are nearest."
    )
    if tracked:
        paragraphs = [_pose_words(retrieval)]
    else:
        paragraphs = [
            f"<h3>What happens to a scan</h3><p>{retrieval} No odometry, no earlier fix, no compass and no satellite "
            "takes part: every scan is answered as if the robot had just been switched on.</p>",
            "<h3>What an error of some tens of metres means</h3>"
            f"<p>A candidate is a square of {2 * half_m:g} m, not a point. Its centre lies up to "
            f"{spacing_m / math.sqrt(2):.0f} m from the robot even when it is the best there is, so fixes cannot be "
            "much better than that. This is enough to start a local matcher or a particle filter at the right corner; "
            "it is not enough to drive by.</p>",
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
                f"For {percent(1.0 - scores.reachable)} of the scans the map has no square within "
                f"{max(RADII_M):g} m at all, and no method could have found one."
                if scores.reachable < 0.9995
                else "Every scan of this drive has a square of the map within reach."
            )
            + "</p>"
        )
        if evaluation.track is None:
            paragraphs.append(_covariance_words(scores))
        else:
            paragraphs.append(_honesty_words(evaluation.track))
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
            "than 10 m. The antenna is taken for the robot. Errors are horizontal; heights are not scored."
            f"{_truth_heading_words(evaluation) if tracked else ''}"
            f"{_truth_error_words(truth) if tracked else ''}</p>"
        )
    limits = [
        *([] if tracked else ["Heading is not estimated: the answer is a place, not a pose."]),
        "Scans taken less than a few metres apart fail and succeed together. A second drive along another street "
        "would say more than ten times as many scans of this one.",
        *about.extra_words,
    ]
    paragraphs.append(
        "<h3>What these figures do not say</h3><ul>" + "".join(f"<li>{escape(item)}</li>" for item in limits) + "</ul>"
    )
    return "".join(paragraphs)


def _pose_words(retrieval: str) -> str:
    return (
        f"<h3>What happens to a scan</h3><p>{retrieval} In the surroundings of each of them, and of each pose that the "
        "robot may have, the scan is laid on the map in all directions and moved to where it fits best: an aligned "
        "pose.</p><h3>What happens over time</h3><p>Poses that the robot may have, hypotheses, are carried along by "
        "the odometry, gain belief where the scans go on fitting, and lose it where they do not. A new one is born "
        "where a scan fits and no hypothesis is. The robot is <b>searching</b> while nothing is believed, knows "
        "<b>several places</b> while more than one is, is <b>localized</b> when it believes one beyond reasonable "
        "doubt, which alone is a fix, and <b>lost</b> when what it sees no longer fits.</p>"
    )


def _honesty_words(track: TrackScores) -> str:
    two, errors = track.coverage[1], track.errors
    if not math.isfinite(two.position):
        return (
            "<h3>Why there is no fix</h3><p>No scan left so little doubt that a fix was given. Step through the scans "
            "above: each says its reason.</p>"
        )
    if two.position > 0.975:
        judgement = "so the covariance is somewhat too large: the fixes are better than they say."
    elif two.position >= 0.93:
        judgement = "so the covariance may be believed, at least on drives like this one."
    elif two.position >= 0.85:
        judgement = "so the covariance is somewhat too small: whoever fuses these fixes should gate them."
    else:
        judgement = "so the covariance promises too much: a filter that trusts it will be led astray."
    return (
        "<h3>How to read the calibration</h3>"
        f"<p>Inside of 2 sigma, the ellipse that should hold {percent(two.expected)} of the errors, lie "
        f"{percent(two.position)} of {errors.count:,} fixes, {judgement} Errors of neighbouring scans are much "
        "alike, so one drive says less of it than the number of scans suggests. Belief speaks of something else, the "
        f"error being below {WRONG_M:g} m: of a hundred scans that are believed by 90 %, ten should be wrong. A fix "
        f"needs more than that: {errors.wrong:,} of {errors.count:,} were wrong.</p>"
    )


def _truth_heading_words(evaluation: Evaluation) -> str:
    if evaluation.heading_topic is None:
        return " Nothing tells the true heading, so headings are not scored."
    return f" The true heading is that of <code>{escape(evaluation.heading_topic)}</code>."


def _truth_error_words(truth: TruthTrack) -> str:
    if not truth.std_m > 0.0:
        return ""
    return (
        f" The receiver itself doubts its positions by {metres(truth.std_m)} in the median: errors of that size, and "
        "what should lie inside of 2 sigma, are its own as much as the localizer's."
    )


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
        f"<p>The 95 % ellipses of the fixes held the truth in {percent(inside)} of {error.count:,} cases, {judgement} "
        "A fix in the wrong street cannot be told from a right one by its error ellipse alone; look at the spread of "
        "the candidates.</p>"
    )


def _extent(aerial_map: AerialMap) -> tuple[float, float]:
    west, south, east, north = aerial_map.bounds
    return east - west, north - south
