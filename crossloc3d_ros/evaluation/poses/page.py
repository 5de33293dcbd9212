"""The pose benchmark as one HTML page that needs nothing but itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from crossloc3d_ros.evaluation.poses.errors import AMONG_M, WITHIN_DEG, WITHIN_M, WRONG_M
from crossloc3d_ros.evaluation.poses.measures import Measure, verdicts
from crossloc3d_ros.evaluation.poses.results import interval_of, shown, wanted
from crossloc3d_ros.evaluation.poses.scores import SIGMAS, PoseScores, expected_inside
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.render import render_page


@dataclass(frozen=True)
class Figure:
    """A measure, and its figures as they are shown in its unit."""

    measure: Measure
    value: str
    interval: str
    floor: str
    goal: str


@dataclass(frozen=True)
class PosePage:
    """What the template of the page knows."""

    title: str
    facts: Mapping[str, str]
    words: Sequence[str]
    """Sentences about the data, for the end."""
    footer: str
    scores: PoseScores
    figures: Mapping[str, Figure]
    """The measures by their keys."""
    families: Sequence[Figure]
    verdicts: Mapping[str, int]
    error_chart: Markup
    belief_chart: Markup
    sigma_chart: Markup
    within_m: float = WITHIN_M
    within_deg: float = WITHIN_DEG
    wrong_m: float = WRONG_M
    among_m: float = AMONG_M


def write_pose_page(
    path: Path, scores: PoseScores, title: str, facts: Mapping[str, str], words: Sequence[str], footer: str
) -> None:
    """Write the page; CrossLocError where it cannot be written. `words`: sentences about the data, for its end."""
    page = PosePage(
        title=title,
        facts=facts,
        words=words,
        footer=footer,
        scores=scores,
        figures={measure.key: figure_of(measure) for measure in scores.measures},
        families=[figure_of(measure) for measure in scores.families],
        verdicts=verdicts(scores.measures),
        error_chart=_error_chart(scores),
        belief_chart=_belief_chart(scores),
        sigma_chart=_sigma_chart(scores),
    )
    write_atomically(path, render_page("poses.html.j2", page))


def figure_of(measure: Measure) -> Figure:
    """Return a measure as a page shows it."""
    return Figure(
        measure=measure,
        value=shown(measure),
        interval=interval_of(measure),
        floor=wanted(measure, measure.floor, measure.floor_high),
        goal=wanted(measure, measure.goal, measure.goal_high),
    )


def _error_chart(scores: PoseScores) -> Markup:
    chart = charts.Chart(
        charts.distance_axis(1000.0, "horizontal error", low_m=0.1),
        charts.share_axis("share at most so large"),
        "Cumulative distribution of the horizontal error",
        width=1080.0,
        height=330.0,
    )
    at = np.geomspace(0.1, 1000.0, 240)
    return chart.render(
        [
            chart.line(at, charts.cumulative(errors, len(errors), at), f"c-{number}")
            for number, errors in enumerate(scores.errors_m.values())
            if len(errors)
        ]
    )


def _belief_chart(scores: PoseScores) -> Markup:
    chart = charts.Chart(
        charts.Axis(0.0, 1.0, "estimated probability", [(i / 4, f"{25 * i} %") for i in range(5)]),
        charts.share_axis("right"),
        "Estimated probability against the share that was right",
        height=330.0,
    )
    marks = [chart.line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "s-chance")]
    for number, each in enumerate(scores.calibrations):
        marks.append(chart.line(each.believed, each.right, f"c-{number}"))
        marks.append(chart.dots(each.believed, each.right, [f"dot d-{number}"] * len(each.right), 4.0))
    return chart.render(marks)


def _sigma_chart(scores: PoseScores) -> Markup:
    chart = charts.Chart(
        charts.Axis(0.0, 4.0, "of the stated standard deviation", [(float(k), f"{k} σ") for k in range(5)]),
        charts.share_axis("errors inside"),
        "Share of the errors inside of k sigma",
        height=330.0,
    )
    marks = []
    for number, (name, curve) in enumerate(scores.inside.items(), len(scores.calibrations)):
        marks.append(chart.line(SIGMAS, expected_inside(name), "s-chance"))
        marks.append(chart.line(SIGMAS, curve, f"c-{number}"))
    return chart.render(marks)
