"""Scores of poses as text: for programs (CSV, JSON), for people (one line a figure)."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Sequence
from typing import Any

from crossloc3d_ros.evaluation.poses.measures import Measure
from crossloc3d_ros.evaluation.poses.scores import SIGMAS, PoseScores

_COLUMNS = (
    "set", "weights", "kind", "measure", "text", "unit", "value", "low", "high", "count", "counted", "floor",
    "floor_high", "goal", "goal_high", "verdict",
)  # fmt: skip


def shown(measure: Measure, value: float | None = None) -> str:
    """Return a measure's value, or another in its unit, for people; ∞ is what did not happen within the drive."""
    number = measure.value if value is None else value
    if math.isnan(number):
        return "–"
    if math.isinf(number):
        return "∞"
    if measure.unit == "%":
        return f"{_digits(100 * number)} %"
    if measure.unit in ("fixes", "scans"):
        return f"{number:,.0f}"
    unit = "°" if measure.unit == "degrees" else f" {measure.unit}"
    return f"{number:.0f}{unit}" if measure.unit == "ms" else f"{_digits(number)}{unit}"


def _digits(number: float) -> str:
    if number == 0 or number >= 99.95:
        return f"{number:.0f}"
    return f"{number:.1f}" if number >= 10 else f"{number:.2f}"


def interval_of(measure: Measure) -> str:
    """Return a measure's interval for people; empty where it has none."""
    if math.isnan(measure.low) or measure.unit in ("fixes", "scans", "ms"):
        return ""
    ends = []
    for end in (measure.low, measure.high):
        if math.isinf(end):
            ends.append("∞")
        else:
            ends.append(_digits(100 * end if measure.unit == "%" else end))
    return f"{ends[0]} to {ends[1]}"


def wanted(measure: Measure, low: float | None, high: float | None) -> str:
    """Return a floor or goal of a measure for people; empty where there is none."""
    if low is None:
        return ""
    unit = {"degrees": "°", "fixes": "", "scans": ""}.get(measure.unit, f" {measure.unit}")
    factor = 100.0 if measure.unit == "%" else 1.0
    ends = [f"{factor * end:g}" for end in (low, high) if end is not None]
    return f"{'–'.join(ends)}{unit}"


def as_markdown(scores: PoseScores) -> str:
    """Return the table as Markdown."""
    return measures_as_markdown(scores.about.pose_set, scores.measures)


def measures_as_markdown(title: str, measures: Sequence[Measure]) -> str:
    """Return measures with floors and goals as a Markdown table: bold what reaches its goal, italic what is below."""
    lines = [f"| {title} | | 95 % interval | floor | goal | of |", "|---|---|---|---|---|---|"]
    for each in measures:
        floor, goal = wanted(each, each.floor, each.floor_high), wanted(each, each.goal, each.goal_high)
        mark = {"goal": "**", "floor": "", "few": "", "below": "_", "": ""}[each.verdict]
        lines.append(
            f"| {each.text} | {mark}{shown(each)}{mark} | {interval_of(each)} | {floor} | {goal} | "
            f"{each.count:,} {each.counted} |"
        )
    return "\n".join(lines) + "\n"


def as_csv(scores: PoseScores) -> str:
    """Return every figure as CSV text."""
    about = scores.about
    kinds = (("table", scores.measures), ("family", scores.families))
    return measures_as_csv([(about.pose_set, about.weights, kind, measures) for kind, measures in kinds])


def measures_as_csv(parts: Sequence[tuple[str, str, str, Sequence[Measure]]]) -> str:
    """Return measures as CSV text; each part is a set, its weights, a kind and the measures."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    for name, weights, kind, measures in parts:
        for each in measures:
            writer.writerow({"set": name, "weights": weights, "kind": kind, **measure_as_plain(each)})
    return text.getvalue()


def as_json(scores: PoseScores) -> str:
    """Return everything as JSON text; NaN becomes null, infinity the word `infinite`."""
    content = {
        "about": dataclasses.asdict(scores.about),
        "table": [measure_as_plain(each) for each in scores.measures],
        "families": [measure_as_plain(each) for each in scores.families],
        "stages": {
            "single scans": [dataclasses.asdict(stage) for stage in scores.stages],
            "drives": [dataclasses.asdict(stage) for stage in scores.drive_stages],
        },
        "calibration": [
            {"name": c.name, "believed": c.believed.tolist(), "right": c.right.tolist(), "count": c.count.tolist()}
            for c in scores.calibrations
        ],
        "inside_k_sigma": {"k": SIGMAS.tolist(), **{name: c.tolist() for name, c in scores.inside.items()}},
    }
    return json.dumps(finite(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def measure_as_plain(each: Measure) -> dict[str, Any]:
    """Return a measure as plain values."""
    return {
        "measure": each.key,
        "text": each.text,
        "unit": each.unit,
        "value": each.value,
        "low": each.low,
        "high": each.high,
        "count": each.count,
        "counted": each.counted,
        "floor": each.floor,
        "floor_high": each.floor_high,
        "goal": each.goal,
        "goal_high": each.goal_high,
        "verdict": each.verdict,
    }


def finite(value: Any) -> Any:
    """Return plain values as JSON holds them: rounded, NaN as null, infinity as a word."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, float):
        if math.isinf(value):
            return "infinite"
        return None if math.isnan(value) else round(value, 6)
    return value
