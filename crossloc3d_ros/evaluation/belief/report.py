"""The files of scored belief: CSV, JSON, Markdown and the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from crossloc3d_ros.evaluation import set_words
from crossloc3d_ros.evaluation.belief.results import (
    LEGEND,
    MAP_COLUMNS,
    SET_COLUMNS,
    as_csv,
    as_json,
    as_markdown,
    map_cells,
    set_cells,
)
from crossloc3d_ros.evaluation.belief.scores import BINS, BeliefScores
from crossloc3d_ros.evaluation.poses.measures import verdicts
from crossloc3d_ros.evaluation.poses.page import Figure, figure_of
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.render import render_page
from crossloc3d_ros.pages.wording import written_by

PAGE, CSV, JSON, MARKDOWN = "index.html", "results.csv", "results.json", "table.md"


@dataclass(frozen=True)
class Table:
    """Columns and rows of text."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class CalibrationChart:
    """The calibration of one set."""

    name: str
    scans: int
    chart: Markup


@dataclass(frozen=True)
class BeliefPage:
    """What the template of the page knows."""

    title: str
    facts: Mapping[str, str]
    words: Sequence[str]
    footer: str
    figures: Mapping[str, Figure]
    """The measures of the table of goals."""
    verdicts: Mapping[str, int]
    sets: Table
    maps: Table
    pairs: Table
    calibrations: Sequence[CalibrationChart]
    legend: str = LEGEND


def write_report(folder: Path, scores: BeliefScores, scans: int) -> None:
    """Write the files of the scores of so many scans into a folder; CrossLocError where one cannot be written."""
    write_atomically(folder / CSV, as_csv(scores))
    write_atomically(folder / JSON, as_json(scores))
    write_atomically(folder / MARKDOWN, as_markdown(scores))
    about = scores.about
    facts = {
        "scans": f"{scans:,}",
        "on the map": f"{len(scores.sets):,} sets and conditions",
        "off the map": f"{len(scores.pairs):,} pairs of map and drive",
        "weights": f"{about.weights} ({about.encoder[:12]})",
        "code": about.code,
    }
    if scores.missing:
        facts["incomplete"] = f"{scores.missing:,} of {len(about.pieces):,} pieces are missing"
    if about.every > 1:
        facts["a quick look"] = f"one scan, journey and pair of {about.every}"
    page = BeliefPage(
        title=f"Belief: {about.weights}",
        facts=facts,
        words=(set_words.SIMULATED, set_words.AMSTERDAM),
        footer=written_by(),
        figures={str(i): figure_of(measure) for i, measure in enumerate(scores.measures)},
        verdicts=verdicts(scores.measures),
        sets=Table(SET_COLUMNS, [set_cells(each) for each in scores.sets]),
        maps=Table(MAP_COLUMNS, [map_cells(pair) for pair in scores.maps]),
        pairs=Table(MAP_COLUMNS, [map_cells(pair) for pair in scores.pairs]),
        calibrations=[
            CalibrationChart(
                each.name, each.singles, _calibration_chart(each.calibration.believed, each.calibration.right)
            )
            for each in scores.sets
        ],
    )
    write_atomically(folder / PAGE, render_page("belief.html.j2", page))


def _calibration_chart(believed: np.ndarray, right: np.ndarray) -> Markup:
    chart = charts.Chart(
        charts.Axis(0.0, 1.0, "estimated probability", [(i / 4, f"{25 * i} %") for i in range(5)]),
        charts.share_axis("right"),
        f"Estimated probability of single scans against the share that was right, {BINS} bins",
        height=250.0,
    )
    return chart.render(
        [
            chart.line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "s-chance"),
            chart.line(believed, right, "c-0"),
            chart.dots(believed, right, ["dot d-0"] * len(right), 4.0),
        ]
    )
