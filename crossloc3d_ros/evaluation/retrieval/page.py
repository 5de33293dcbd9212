"""A benchmark's scores as one HTML page that needs nothing but itself: tables, curves, pictures, words."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from crossloc3d_ros.evaluation.retrieval.gallery import TOP, Picture, Row
from crossloc3d_ros.evaluation.retrieval.predictions import About
from crossloc3d_ros.evaluation.retrieval.results import label_of
from crossloc3d_ros.evaluation.retrieval.scores import CURVE, GroupScores, Scores
from crossloc3d_ros.evaluation.statistics import RADII_M, Recall
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.wording import interval, percent

_MOST_LINES = 8
_CURVE_RADII_M = (100.0, 25.0)


@dataclass(frozen=True)
class PageTexts:
    """What the page says besides its figures."""

    title: str
    facts: Mapping[str, str]
    footer: str
    cloud_width_m: float = 100.0
    words: tuple[str, ...] = ()
    """Sentences about the data, for the end."""


def write_page(
    path: Path, scores: Sequence[Scores], main: Scores, pictures: tuple[list[Row], list[Row]], texts: PageTexts
) -> None:
    """Write the page; CrossLocError where it cannot be written.

    `main`: the scores that stand for the method. `pictures`: the rows of `gallery`, right ones and wrong ones.
    """
    parts = {
        "title": escape(texts.title),
        "verdict": _verdict(main),
        "facts": "".join(f"<li>{escape(name)} <b>{escape(value)}</b></li>" for name, value in texts.facts.items()),
        "tiles": _tiles(main),
        "recall": "".join(_recall_table(scores, main, radius) for radius in RADII_M),
        "curves": "".join(f"<div>{_curve_chart(scores, main, radius)}</div>" for radius in _CURVE_RADII_M),
        "curve_legend": _curve_legend(scores, main),
        "gallery": _gallery(pictures, main, texts.cloud_width_m),
        "divided": _divided_table(main),
        "words": _words(scores, main, texts),
        "footer": escape(texts.footer),
        "style": _page_file("page.css") + _page_file("benchmark.css"),
    }
    # In one pass, so that nothing is looked for in what was filled in.
    page = re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _page_file("benchmark.html"))
    write_atomically(path, page)


def describe(about: About) -> str:
    """Return in a few words how the predictions were made."""
    heading = "north-aligned" if about.heading == "aligned" else "random heading"
    how = ""
    if about.query_headings > 1:
        kept = "nearest kept" if about.way == "nearest" else "mean descriptor"
        how = f", {about.query_headings} headings tried, {kept}"
    again = f", {about.kind} ({about.verified:,})" if about.verified else ""
    return f"{about.setting}, {heading}{how}{again}"


def describe_briefly(about: About) -> str:
    """Return the same for narrow tables, in which verified predictions follow those that they are made of."""
    if about.verified:
        return f"  + {about.verified} height maps"
    heading = "north" if about.heading == "aligned" else "random"
    tried = f", {about.query_headings} {about.way}" if about.query_headings > 1 else ""
    return f"{about.setting}, {heading}{tried}"


def _page_file(name: str) -> str:
    return (resources.files("crossloc3d_ros.pages") / "assets" / name).read_text(encoding="utf-8")


def _verdict(main: Scores) -> str:
    best, near = main.overall.recall("R@1", 100.0), main.overall.recall("R@1", 25.0)
    return (
        f"For <b>{main.overall.queries:,}</b> ground scans, queried among "
        f"<b>{main.about.database:,}</b> places ({escape(describe(main.about))}), <b>{escape(main.about.weights)}</b> "
        f"names one within 100 m first in <b>{percent(best.share.value, 1)}</b> of the cases (95 % interval "
        f"{interval(best.share)}, chance level {percent(best.chance, 1)}), one within 25 m in "
        f"<b>{percent(near.share.value, 1)}</b>."
    )


def _tiles(main: Scores) -> str:
    tiles = []
    for label, radius, what in (
        ("R@1", 100.0, "First place within 100 m"),
        ("R@1", 25.0, "First place within 25 m"),
        ("R@25", 100.0, "Within 100 m among 25"),
        ("R@1%", 100.0, "In the first per cent"),
    ):
        figure = main.overall.recall(label, radius)
        tiles.append(
            (
                what,
                percent(figure.share.value, 1),
                f"{interval(figure.share)}; chance level {percent(figure.chance, 1)}",
            )
        )
    about = main.about
    once = "one descriptor" if about.query_headings == 1 else f"{about.query_headings} descriptors"
    again = f", height maps {about.verify_ms:.1f} ms ({about.verified:,} places)" if about.verified else ""
    detail = f"encoding {about.encode_ms:.1f} ms ({once}), searching {about.search_ms:.1f} ms{again}; median"
    tiles.append(("Time a query", f"{about.query_ms:.0f} ms", detail))
    return "".join(
        f'<div class="tile"><span class="what">{escape(what)}</span><span class="value">{value}</span>'
        f'<span class="detail">{escape(detail)}</span></div>'
        for what, value, detail in tiles
    )


def _recall_table(scores: Sequence[Scores], main: Scores, radius_m: float) -> str:
    labels = [figure for figure in main.overall.recalls if figure.radius_m == radius_m]
    head = "".join(f"<th scope='col'>{escape(label_of(figure))}</th>" for figure in labels)
    rows = []
    for each in scores:
        cells = "".join(_cell(each.overall.recall(figure.label, radius_m)) for figure in labels)
        css = ' class="headline"' if each is main else ""
        counted = each.overall.counted[radius_m]
        note = f"<small>{counted:,} queries, {each.about.database:,} places; by {each.about.kind}</small>"
        rows.append(f"<tr{css}><th scope='row'>{escape(describe(each.about))}{note}</th>{cells}</tr>")
    return (
        f'<div class="scroll"><table class="recall"><caption>A place counts within {radius_m:g} m</caption>'
        f'<thead><tr><th scope="col">database and heading</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _cell(figure: Recall) -> str:
    if np.isnan(figure.share.value):  # no query has a place so near
        return "<td>–</td>"
    return (
        f"<td><b>{percent(figure.share.value, 1)}</b>"
        f'<div class="gauge"><i style="width:{100 * figure.share.value:.1f}%"></i>'
        f'<s style="left:{100 * figure.chance:.1f}%"></s></div>'
        f"<small>{interval(figure.share)}</small><small>chance level {percent(figure.chance, 1)}</small></td>"
    )


def _lines(scores: Sequence[Scores], main: Scores) -> list[Scores]:
    """Return the scores to draw, the main ones first."""
    return [main, *(each for each in scores if each is not main)][:_MOST_LINES]


def _curve_chart(scores: Sequence[Scores], main: Scores, radius_m: float) -> str:
    ticks = [(float(n), str(n)) for n in (1, 2, 5, 10, 25, 50, 100)]
    chart = charts.Chart(
        charts.Axis(1.0, float(CURVE), "places retrieved, N", ticks, log=True),
        charts.share_axis(f"AR@N within {radius_m:g} m"),
        f"Average recall within {radius_m:g} metres over the number of places retrieved",
        height=330.0,
    )
    ranks = np.arange(1.0, CURVE + 1)
    marks = []
    for setting in dict.fromkeys(each.about.setting for each in scores):
        shown = next(each for each in scores if each.about.setting == setting)
        curve = next(curve for curve in shown.curves if curve.radius_m == radius_m)
        marks.append(chart.line(ranks, curve.chance, "s-chance"))
    for number, each in reversed(list(enumerate(_lines(scores, main)))):
        curve = next(curve for curve in each.curves if curve.radius_m == radius_m)
        marks.append(chart.line(ranks, curve.recall, f"c-{number}"))
    return chart.render(marks)


def _curve_legend(scores: Sequence[Scores], main: Scores) -> str:
    keys = "".join(
        f'<span><i class="key stroke k-{number}"></i>{escape(describe(each.about))}</span>'
        for number, each in enumerate(_lines(scores, main))
    )
    left = len(scores) - len(_lines(scores, main))
    more = f"<span>{left} more are in the tables alone.</span>" if left else ""
    return f'<p class="below">{keys}<span><i class="key stroke lot"></i>chance level, each database</span>{more}</p>'


def _gallery(pictures: tuple[list[Row], list[Row]], main: Scores, width_m: float) -> str:
    right, wrong = pictures
    share = main.overall.recall("R@1", 100.0)
    reached = int((main.first_m <= 100.0).sum())
    text = (
        f"<p>Clouds seen from above, {width_m:g} m wide, north up; brighter is higher. Left the scan, beside it the "
        f"first {TOP} places with their distance from the robot: framed green within 100 m, red beyond. The scan is "
        "drawn north up only so that eyes can compare. Shown are queries chosen at random with a "
        f"fixed seed, {len(right)} of the {reached:,} whose first place is right and {len(wrong)} of the "
        f"{main.overall.queries - reached:,} where it is wrong: half and half here, {percent(share.share.value, 1)} "
        "right in truth.</p>"
    )
    parts = [text]
    for title, rows in (("The first place is right", right), ("The first place is wrong", wrong)):
        if not rows:
            continue
        head = "".join(f'<div class="head">{name}</div>' for name in ("scan", *(f"{i + 1}." for i in range(TOP))))
        cells = "".join(_figure(picture) for row in rows for picture in (row.query, *row.retrieved))
        parts.append(f'<h3>{title}</h3><div class="gallery">{head}{cells}</div>')
    return "".join(parts)


def _figure(picture: Picture) -> str:
    css = "query" if picture.right is None else "right" if picture.right else "miss"
    mark = "" if picture.right is None else "✓ " if picture.right else "✗ "
    alt = "scan" if picture.right is None else "right place" if picture.right else "wrong place"
    return (
        f'<figure class="{css}"><img src="{picture.data_uri}" alt="{alt}, {escape(picture.caption)}">'
        f"<figcaption>{mark}{escape(picture.caption)}</figcaption></figure>"
    )


def _divided_table(main: Scores) -> str:
    columns = [("R@1", 100.0), ("R@1", 50.0), ("R@1", 25.0), ("R@25", 100.0), ("R@1%", 100.0)]
    head = "".join(f"<th scope='col'>{label} within {radius:g} m</th>" for label, radius in columns)
    rows = []
    for css, groups in (("", main.families), ("total", main.groups), ("total", [main.overall])):
        if css == "" and len(groups) < 2:
            continue
        for i, group in enumerate(groups):
            rows.append(_divided_row(group, columns, css if i == 0 else ""))
    return (
        f"<p>{escape(describe(main.about)).capitalize()}. Every single area is in <code>results.csv</code>.</p>"
        f'<div class="scroll"><table class="recall"><thead><tr><th scope="col">queries</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _divided_row(group: GroupScores, columns: Sequence[tuple[str, float]], css: str) -> str:
    cells = "".join(_cell(group.recall(label, radius)) for label, radius in columns)
    areas = f"{group.areas} area{'s' * (group.areas != 1)}"
    note = f"<small>{group.queries:,} queries in {areas}</small>"
    return f"<tr class='{css}'><th scope='row'>{escape(group.name.replace('_', ' '))}{note}</th>{cells}</tr>"


def _words(scores: Sequence[Scores], main: Scores, texts: PageTexts) -> str:
    one_per_cent = main.overall.recall("R@1%", 100.0).rank
    paragraphs = [
        "<h3>Recall</h3><p>R@N within a radius is the share of queries for which one of the first N places is centred "
        "within the radius of the true place. Queries without any place of the database within the radius cannot be "
        "answered and do not count, as in the released evaluators. The tick on each bar is the chance level, what as "
        "many different places drawn at random would reach: figures of databases of different size, or of different "
        "spacing, cannot be "
        "compared without it.</p>",
        f"<h3>Two one per cents</h3><p>R@1% counts {one_per_cent:,} places here, one per cent of "
        f"{main.about.database:,} places. What was published as AR@1% for CS-Campus3D is R@25: the released evaluators "
        "retrieve 25 places, whatever the size of the database. Both are given.</p>",
        "<h3>Headings</h3><p>“North-aligned” turns each query to north by its true heading, as a perfect compass "
        "would. “Random heading” leaves it as the robot stood. Submaps always lie north up.</p>",
        "<h3>Intervals</h3><p>Queries of one town are alike, so towns, not queries, are resampled with replacement "
        "2,000 times; where fewer than eight towns were queried, squares of 50 m stand in for them. The interval holds "
        "95 % of these draws and is widened to hold Wilson's interval for as many trials as there are places at least "
        "25 m apart.</p>",
        *_verification_words(scores),
        *_heading_words(main),
        *(f"<p>{escape(sentence)}</p>" for sentence in texts.words),
    ]
    return "".join(paragraphs)


def _verification_words(scores: Sequence[Scores]) -> list[str]:
    about = next((each.about for each in scores if each.about.verified), None)
    if about is None:
        return []
    return [
        f"<h3>Height maps</h3><p>“Retrieval” orders all places by their descriptors. “{escape(about.kind)}” compares "
        f"the scan's height map with those of the first {about.verified:,} places, in every heading and at the offset "
        "that fits best, and orders these anew by both distances; those behind keep their order. The distance of the "
        "descriptors counts in units of the weights' calibration (its temperature), that of the height maps (square "
        f"roots of heights, in patch units) with the weight {about.verification_weight:g}, fitted on other towns. "
        f"It takes {about.verify_ms:.0f} ms a query besides, in one thread.</p>"
    ]


def _heading_words(main: Scores) -> list[str]:
    if main.heading is None:
        return []
    errors = main.heading
    return [
        f"<h3>The heading that comes with a place</h3><p>Each query was tried every {errors.step_deg:g} degrees. Of "
        f"the {errors.queries:,} first places within 100 m, the heading in which the query lay nearest was off by "
        f"{errors.median_deg:.0f} degrees in the median, and by at most one step in "
        f"{percent(errors.within_step, 1)}.</p>"
    ]
