"""Scores of belief as text: for programs (CSV, JSON), for people (tables)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence

from crossloc3d_ros.evaluation.belief.scores import ORDER, BeliefScores, PairScores, SetScores
from crossloc3d_ros.evaluation.poses.results import (
    finite,
    interval_of,
    measure_as_plain,
    measures_as_csv,
    measures_as_markdown,
    shown,
)

SET_COLUMNS = (
    "set and condition", "scans", "right", "sure", "calibration", "lost", "until", "without fix", "2σ", "fixes",
    "wrong",
)  # fmt: skip
"""Of the table of sets; their long names are in `LEGEND`."""
LEGEND = (
    "Right: single scans within 2 m and 5°. Sure: right ones (within 10 m) believed above 99 %. Calibration: expected "
    "calibration error of single scans, 10 bins. Lost: a pose refined from the truth scores higher than a wrong "
    "answer. Until: distance until localized, median. Without fix: scans once localized. 2σ: errors inside. Wrong: "
    "fixes by more than 10 m. Learned from: in no total."
)
MAP_COLUMNS = ("map", "drives of", "scans", "with a fix", "above 99 %", "one scan above 99 %", "most believed")
LEARNED = " (learned from)"


def set_cells(each: SetScores) -> tuple[str, ...]:
    """Return the row of a set on its map."""
    keys = ("right", "sure", "calibration", "lost", "until_median", "without_fix", "inside_2_sigma")
    return (
        each.name + LEARNED * each.is_learned,
        f"{each.singles:,}",
        *(shown(each.measures[key]) for key in keys),
        f"{each.fixes:,}",
        shown(each.measures["wrong"]),
    )


def map_cells(pair: PairScores) -> tuple[str, ...]:
    """Return the row of a map with the drives of a set, or with one drive."""
    return (
        pair.map_name + LEARNED * pair.is_learned,
        pair.drive or pair.set_name,
        f"{pair.scans:,}",
        f"{pair.fixes:,}",
        f"{pair.sure:,}",
        f"{pair.sure_alone:,}",
        f"{pair.most_believed:.6f}",
    )


def as_markdown(scores: BeliefScores) -> str:
    """Return the tables as Markdown."""
    sets = _table(SET_COLUMNS, [set_cells(each) for each in scores.sets])
    maps = _table(MAP_COLUMNS, [map_cells(pair) for pair in scores.maps])
    return f"{measures_as_markdown('belief', scores.measures)}\n{sets}\n{LEGEND}\n\n{maps}"


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def as_csv(scores: BeliefScores) -> str:
    """Return every measure as CSV text."""
    weights = scores.about.weights
    totals = [each for each in scores.measures if not any(each in of.measures.values() for of in scores.sets)]
    sets = [(each.name, weights, "learned from" if each.is_learned else "set", list(each.measures.values()))
            for each in scores.sets]  # fmt: skip
    return measures_as_csv([("all", weights, "total", totals), *sets])


def as_json(scores: BeliefScores) -> str:
    """Return everything as JSON text; NaN becomes null, infinity the word `infinite`."""
    content = {
        "about": dataclasses.asdict(scores.about),
        "missing_pieces": scores.missing,
        "table": [{**measure_as_plain(each), "interval": interval_of(each)} for each in scores.measures],
        "sets": [
            {
                "set": each.set_name,
                "condition": each.condition,
                "learned_from": each.is_learned,
                "singles": each.singles,
                "fixes": each.fixes,
                "measures": [measure_as_plain(each.measures[key]) for key in ORDER if key in each.measures],
                "calibration": {
                    "believed": each.calibration.believed.tolist(),
                    "right": each.calibration.right.tolist(),
                    "count": each.calibration.count.tolist(),
                },
            }
            for each in scores.sets
        ],
        "pairs": [dataclasses.asdict(pair) for pair in scores.pairs],
        "maps": [dataclasses.asdict(pair) for pair in scores.maps],
    }
    return json.dumps(finite(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
