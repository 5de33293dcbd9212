"""Scores of poses as text: for programs (CSV, JSON), for people (one line a figure)."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
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
    if measure.unit == "fixes":
        return f"{number:,.0f}"
    unit = "°" if measure.unit == "degrees" else f" {measure.unit}"
    return f"{number:.0f}{unit}" if measure.unit == "ms" else f"{_digits(number)}{unit}"


def _digits(number: float) -> str:
    if number == 0 or number >= 99.95:
        return f"{number:.0f}"
    return f"{number:.1f}" if number >= 10 else f"{number:.2f}"


def interval_of(measure: Measure) -> str:
    """Return a measure's interval for people; empty where it has none."""
    if math.isnan(measure.low) or measure.unit in ("fixes", "ms"):
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
    unit = {"degrees": "°", "fixes": ""}.get(measure.unit, f" {measure.unit}")
    factor = 100.0 if measure.unit == "%" else 1.0
    ends = [f"{factor * end:g}" for end in (low, high) if end is not None]
    return f"{'–'.join(ends)}{unit}"


def as_markdown(scores: PoseScores) -> str:
    """Return the table as Markdown."""
    about = scores.about
    lines = [f"| {about.pose_set} | | 95 % interval | floor | goal | of |", "|---|---|---|---|---|---|"]
    for each in scores.measures:
        floor, goal = wanted(each, each.floor, each.floor_high), wanted(each, each.goal, each.goal_high)
        mark = {"goal": "**", "floor": "", "below": "_", "": ""}[each.verdict]
        lines.append(
            f"| {each.text} | {mark}{shown(each)}{mark} | {interval_of(each)} | {floor} | {goal} | "
            f"{each.count:,} {each.counted} |"
        )
    return "\n".join(lines) + "\n"


def as_csv(scores: PoseScores) -> str:
    """Return every figure as CSV text."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    for kind, measures in (("table", scores.measures), ("family", scores.families)):
        for each in measures:
            writer.writerow({"set": scores.about.pose_set, "weights": scores.about.weights, "kind": kind,
                             **_measure(each)})  # fmt: skip
    return text.getvalue()


def as_json(scores: PoseScores) -> str:
    """Return everything as JSON text; NaN becomes null, infinity the word `infinite`."""
    content = {
        "about": dataclasses.asdict(scores.about),
        "table": [_measure(each) for each in scores.measures],
        "families": [_measure(each) for each in scores.families],
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
    return json.dumps(_finite(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _measure(each: Measure) -> dict[str, Any]:
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


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        if math.isinf(value):
            return "infinite"
        return None if math.isnan(value) else round(value, 6)
    return value
