"""Scores as tables for programs: CSV with one figure a row, JSON with everything."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

from crossloc3d_ros.evaluation.retrieval.predictions import Way
from crossloc3d_ros.evaluation.retrieval.scores import Scores

_COLUMNS = (
    "benchmark", "weights", "setting", "heading", "query_headings", "way", "kind", "verified", "divided_by", "name",
    "queries", "areas", "measure", "rank", "radius_m", "counted", "recall", "low", "high", "chance",
)  # fmt: skip


def headline(scores: Sequence[Scores], query_headings: int, way: Way) -> Scores:
    """Return the scores that stand for the method: aerial, random heading, queries tried as the localizer does it.

    Where there is none such, aerial and aligned, or the first. Verified predictions where there are any.
    """
    verified_first = sorted(scores, key=lambda each: -each.about.verified)
    for wanted in (("aerial", "random"), ("aerial", "aligned")):
        for each in verified_first:
            about = each.about
            tried = (1, "nearest") if about.heading == "aligned" else (query_headings, way)
            if (about.setting, about.heading) == wanted and (about.query_headings, about.way) == tried:
                return each
    return scores[0]


def as_csv(scores: Sequence[Scores]) -> str:
    """Return every figure of every division as CSV text."""
    text = io.StringIO()
    writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    for each in scores:
        writer.writerows(_rows(each))
    return text.getvalue()


def as_json(scores: Sequence[Scores]) -> str:
    """Return everything as JSON text: how it was made, every figure and the AR@N curves."""
    content = [
        {
            "about": dataclasses.asdict(each.about),
            "kind": each.about.kind,
            "figures": list(_rows(each)),
            "heading": None if each.heading is None else dataclasses.asdict(each.heading),
            "curves": [
                {
                    "radius_m": curve.radius_m,
                    "recall": [_number(v) for v in curve.recall],
                    "chance": [_number(v) for v in curve.chance],
                }
                for curve in each.curves
            ],
        }
        for each in scores
    ]
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _rows(scores: Scores) -> Iterator[dict[str, Any]]:
    about = scores.about
    for divided_by, groups in scores.tables().items():
        for group in groups:
            for recall in group.recalls:
                yield {
                    "benchmark": about.benchmark,
                    "weights": about.weights,
                    "setting": about.setting,
                    "heading": about.heading,
                    "query_headings": about.query_headings,
                    "way": about.way,
                    "kind": about.kind,
                    "verified": about.verified,
                    "divided_by": divided_by,
                    "name": group.name,
                    "queries": group.queries,
                    "areas": group.areas,
                    "measure": recall.label,
                    "rank": recall.rank,
                    "radius_m": recall.radius_m,
                    "counted": group.counted[recall.radius_m],
                    "recall": _number(recall.share.value),
                    "low": _number(recall.share.low),
                    "high": _number(recall.share.high),
                    "chance": _number(recall.chance),
                }


def _number(value: float) -> float | None:
    return round(float(value), 6) if math.isfinite(value) else None
