"""A benchmark's scores as one HTML page that needs nothing but itself: tables, curves, pictures, explanations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from crossloc3d_ros.evaluation.retrieval.gallery import TOP, Row
from crossloc3d_ros.evaluation.retrieval.predictions import About
from crossloc3d_ros.evaluation.retrieval.scores import CURVE, PUBLISHED_ONE_PER_CENT, Scores
from crossloc3d_ros.evaluation.statistics import RADII_M
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.render import render_page

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


@dataclass(frozen=True)
class RetrievalPage:
    """What the template of the page knows."""

    texts: PageTexts
    all_scores: Sequence[Scores]
    main: Scores
    """Those that stand for the method."""
    describe: Callable[[About], str]
    drawn: Sequence[Scores]
    """Those that the curves show, in the order of their colours."""
    curve_charts: Sequence[Markup]
    right_rows: Sequence[Row]
    """Of the gallery: queries whose first place is right."""
    wrong_rows: Sequence[Row]
    right_queries: int
    """Queries whose first place lies within 100 m, of all."""
    verified: About | None
    """How predictions were verified; None where none were."""
    radii_m: tuple[float, ...] = RADII_M
    published_rank: int = PUBLISHED_ONE_PER_CENT
    shown_places: int = TOP


def write_page(
    path: Path, scores: Sequence[Scores], main: Scores, pictures: tuple[list[Row], list[Row]], texts: PageTexts
) -> None:
    """Write the page; CrossLocError where it cannot be written.

    `main`: the scores that stand for the method. `pictures`: the rows of `gallery`, right ones and wrong ones.
    """
    page = RetrievalPage(
        texts=texts,
        all_scores=scores,
        main=main,
        describe=describe,
        drawn=_lines(scores, main),
        curve_charts=[_curve_chart(scores, main, radius) for radius in _CURVE_RADII_M],
        right_rows=pictures[0],
        wrong_rows=pictures[1],
        right_queries=int((main.first_m <= 100.0).sum()),
        verified=next((each.about for each in scores if each.about.verified), None),
    )
    write_atomically(path, render_page("retrieval.html.j2", page))


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


def _lines(scores: Sequence[Scores], main: Scores) -> list[Scores]:
    """Return the scores to draw, the main ones first."""
    return [main, *(each for each in scores if each is not main)][:_MOST_LINES]


def _curve_chart(scores: Sequence[Scores], main: Scores, radius_m: float) -> Markup:
    ticks = [(float(n), str(n)) for n in (1, 2, 5, 10, 25, 50, 100)]
    chart = charts.Chart(
        charts.Axis(1.0, float(CURVE), "retrieved places, N", ticks, log=True),
        charts.share_axis(f"AR@N within {radius_m:g} m"),
        f"Average recall within {radius_m:g} metres over the number of retrieved places",
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
