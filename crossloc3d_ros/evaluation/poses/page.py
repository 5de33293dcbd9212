"""The pose benchmark as one HTML page that needs nothing but itself."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from crossloc3d_ros.evaluation.poses.errors import AMONG_M, WITHIN_DEG, WITHIN_M, WRONG_M
from crossloc3d_ros.evaluation.poses.measures import Measure, verdicts
from crossloc3d_ros.evaluation.poses.results import interval_of, shown, wanted
from crossloc3d_ros.evaluation.poses.scores import SIGMAS, PoseScores, Stage, expected_inside
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.wording import percent

_MARKS = {"goal": ("✓ goal", "right"), "floor": ("– floor", "fair"), "below": ("✗ below", "miss"), "": ("", "")}


def write_pose_page(
    path: Path, scores: PoseScores, title: str, facts: Mapping[str, str], words: Sequence[str], footer: str
) -> None:
    """Write the page; CrossLocError where it cannot be written. `words`: sentences about the data, for its end."""
    parts = {
        "title": escape(title),
        "verdict": _verdict(scores),
        "facts": "".join(f"<li>{escape(name)} <b>{escape(value)}</b></li>" for name, value in facts.items()),
        "table": _table(scores.measures),
        "stages": _stages(scores),
        "errors": _error_chart(scores),
        "belief": _belief_charts(scores),
        "families": _families(scores.families),
        "words": _words(scores, words),
        "footer": escape(footer),
        "style": _page_file("page.css") + _page_file("benchmark.css") + _page_file("pose.css"),
    }
    page = re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _page_file("pose.html"))
    write_atomically(path, page)


def _page_file(name: str) -> str:
    return (resources.files("crossloc3d_ros.pages") / "assets" / name).read_text(encoding="utf-8")


def _verdict(scores: PoseScores) -> str:
    one, counts = scores.measure("end_to_end"), verdicts(scores.measures)
    until, after, wrong = (scores.measure(key) for key in ("until_median", "after_median", "wrong"))
    moved = (
        "and no drive is localized in the median"
        if math.isinf(until.value)
        else f"driving, a fix comes after <b>{shown(until)}</b> in the median, and is good to <b>{shown(after)}</b>"
    )
    return (
        f"One scan alone gives the pose to {WITHIN_M:g} m and {WITHIN_DEG:g}° in <b>{shown(one)}</b> of "
        f"{one.count:,} cases on a map of {scores.about.map_km2:.1f} km²; {moved}. "
        f"Of {wrong.count:,} fixes, <b>{shown(wrong)}</b> are wrong by more than {WRONG_M:g} m. "
        f"{counts['goal']} of {sum(counts.values())} rows reach their goal, {counts['floor']} their floor alone, "
        f"{counts['below']} neither."
    )


def _table(measures: Sequence[Measure]) -> str:
    rows = []
    for each in measures:
        mark, css = _MARKS[each.verdict]
        interval = interval_of(each)
        rows.append(
            f"<tr><th scope='row'>{escape(each.text)}</th><td><b>{escape(shown(each))}</b>"
            f"<small>{escape(interval)}</small></td>"
            f"<td>{escape(wanted(each, each.floor, each.floor_high))}</td>"
            f"<td>{escape(wanted(each, each.goal, each.goal_high))}</td>"
            f"<td><span class='mark {css}'>{mark}</span></td><td>{each.count:,} {escape(each.counted)}</td></tr>"
        )
    return (
        '<div class="scroll"><table class="recall"><thead><tr><th scope="col"></th><th scope="col">measured'
        "<small>95 % interval</small></th><th scope='col'>floor</th><th scope='col'>goal</th><th scope='col'></th>"
        f"<th scope='col'>of</th></tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _stages(scores: PoseScores) -> str:
    parts = []
    for title, stages in (("Single scans, from nothing", scores.stages), ("Scans along drives", scores.drive_stages)):
        if stages:
            parts.append(_stage_table(title, stages))
    return "".join(parts)


def _stage_table(title: str, stages: Sequence[Stage]) -> str:
    rows = []
    for each in stages:
        middle = f"{each.median_m:,.1f} m" if math.isfinite(each.median_m) else "–"
        interval = f"{100 * each.within_low:.0f} to {100 * each.within_high:.0f} %"
        rows.append(
            f"<tr><th scope='row'>{escape(each.name)}<small>{each.scans:,} scans</small></th>"
            f"<td><b>{percent(each.within, 1)}</b><div class='gauge'><i style='width:{_width(each.within)}%'></i></div>"
            f"<small>{interval}</small></td><td>{percent(each.within_10_m, 1)}</td>"
            f"<td>{percent(each.within_50_m, 1)}</td><td>{middle}</td></tr>"
        )
    return (
        f'<div class="scroll"><table class="recall"><caption>{escape(title)}</caption><thead><tr><th scope="col">'
        f"chain up to</th><th scope='col'>within {WITHIN_M:g} m and {WITHIN_DEG:g}°</th>"
        "<th scope='col'>within 10 m</th><th scope='col'>within 50 m</th><th scope='col'>median error</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _error_chart(scores: PoseScores) -> str:
    chart = charts.Chart(
        charts.distance_axis(1000.0, "horizontal error", low_m=0.1),
        charts.share_axis("share at most so large"),
        "Cumulative distribution of the horizontal error",
        width=1080.0,
        height=330.0,
    )
    at = np.geomspace(0.1, 1000.0, 240)
    marks, keys = [], []
    for number, (name, errors) in enumerate(scores.errors_m.items()):
        if not len(errors):
            continue
        marks.append(chart.line(at, charts.cumulative(errors, len(errors), at), f"c-{number}"))
        keys.append(f'<span><i class="key stroke k-{number}"></i>{escape(name)} ({len(errors):,})</span>')
    return chart.render(marks) + f'<p class="below">{"".join(keys)}</p>'


def _belief_charts(scores: PoseScores) -> str:
    belief = charts.Chart(
        charts.Axis(0.0, 1.0, "believed", [(i / 4, f"{25 * i} %") for i in range(5)]),
        charts.share_axis("right"),
        "Believed probability against the share that was right",
        height=330.0,
    )
    marks = [belief.line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "s-chance")]
    keys = ['<span><i class="key stroke lot"></i>honest</span>']
    for number, each in enumerate(scores.calibrations):
        css = f"c-{number}"
        marks.append(belief.line(each.believed, each.right, css))
        marks.append(belief.dots(each.believed, each.right, [f"dot d-{number}"] * len(each.right), 4.0))
        keys.append(
            f'<span><i class="key stroke k-{number}"></i>{escape(each.name)} ({int(each.count.sum()):,})</span>'
        )
    ticks = [(float(k), f"{k} σ") for k in range(5)]
    sigma = charts.Chart(
        charts.Axis(0.0, 4.0, "of the stated standard deviation", ticks),
        charts.share_axis("errors inside"),
        "Share of the errors inside of k sigma",
        height=330.0,
    )
    inside = []
    for number, (name, curve) in enumerate(scores.inside.items()):
        inside.append(sigma.line(SIGMAS, expected_inside(name), "s-chance"))
        inside.append(sigma.line(SIGMAS, curve, f"c-{number + 2}"))
        keys.append(f'<span><i class="key stroke k-{number + 2}"></i>{escape(name)}, fixes once localized</span>')
    return (
        f'<div class="pair"><div>{belief.render(marks)}</div><div>{sigma.render(inside)}</div></div>'
        f'<p class="below">{"".join(keys)}</p>{_belief_tables(scores)}'
    )


def _belief_tables(scores: PoseScores) -> str:
    """Return what the chart has no room for: the beliefs near to certainty."""
    tables = []
    for each in scores.calibrations:
        rows = "".join(
            f"<tr><td>{_fine_percent(believed)}</td><td>{_fine_percent(right)}</td><td>{count:,}</td></tr>"
            for believed, right, count in zip(each.believed, each.right, each.count, strict=True)
        )
        tables.append(
            f'<div class="scroll"><table class="recall beliefs"><caption>{escape(each.name)}</caption><thead><tr>'
            "<th scope='col'>believed</th><th scope='col'>right</th><th scope='col'>scans</th></tr></thead>"
            f"<tbody>{rows}</tbody></table></div>"
        )
    return f'<div class="pair">{"".join(tables)}</div>'


def _fine_percent(share: float) -> str:
    """Return a share with the digits that distinguish 99.9 from 99.99 %."""
    return f"{100 * share:.3g} %" if share < 0.99 else f"{100 * share:.2f} %"


def _families(measures: Sequence[Measure]) -> str:
    if not measures:
        return "<p>The set is not divided.</p>"
    rows = [
        f"<tr><th scope='row'>{escape(each.text.replace('_', ' '))}<small>{each.count:,} scans</small></th>"
        f"<td><b>{escape(shown(each))}</b><div class='gauge'><i style='width:{_width(each.value)}%'></i></div>"
        f"<small>{escape(interval_of(each))}</small></td></tr>"
        for each in measures
    ]
    return (
        '<div class="scroll"><table class="recall"><thead><tr><th scope="col">scans</th><th scope="col">one scan, end '
        f"to end, within {WITHIN_M:g} m and {WITHIN_DEG:g}°</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _words(scores: PoseScores, words: Sequence[str]) -> str:
    paragraphs = [
        "<h3>One scan</h3><p>Each scan is localized from nothing: no pose before, no heading, no odometry. Its "
        "prediction is the pose that fits best, whether or not it is believed; a scan without a pose counts as wrong. "
        f"The true place is among the candidates where the centre of one of the 25 lies within {AMONG_M:g} m of the "
        "robot.</p>",
        f"<h3>Drives</h3><p>Localized is a robot at its first fix that is right to {WRONG_M:g} m; a drive on which "
        "that does not happen counts as infinitely long (∞). Errors afterwards are those of all fixes from then on, "
        "right ones and wrong ones. Then it is kidnapped: moved to another town while its wheels stand still. "
        "Wrong fixes are counted over everything: before, afterwards, while kidnapped, and off the map, where every "
        "fix is wrong.</p>",
        "<h3>Two sigma</h3><p>The ellipse of the stated covariance that holds 95.4 % of an honest estimate's errors. "
        "The dashed lines are what honest covariances would show.</p>",
        "<h3>Stages</h3><p>“Retrieval alone” is the first candidate's centre, which has no heading. “+ alignment” is "
        "the best pose within 50 m of the foremost candidate that has one, “+ re-ranking” the best of all. "
        "Along drives the same scans, each fifth, are localized alone and with all that came before.</p>",
        "<h3>Intervals</h3><p>Scans of one town are alike, so towns, not scans, are resampled with replacement; "
        "where fewer than eight were evaluated, squares of 50 m stand in for them. The interval holds 95 % of these "
        "draws, for shares widened to hold Wilson's for as many trials as there are places at least 25 m apart.</p>",
        *(f"<p>{escape(sentence)}</p>" for sentence in words),
    ]
    return "".join(paragraphs)


def _width(share: float) -> str:
    return f"{100 * share:.1f}" if math.isfinite(share) else "0"
