"""A replayed drive scored: the estimates on disk beside the ground truth of its recording."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.datasets.truth import TruthTrack, find_heading_topic, find_truth_topic, read_heading, read_truth
from crossloc3d_ros.evaluation.drives.estimates import (
    EstimateTable,
    add_truth,
    read_estimates,
)
from crossloc3d_ros.evaluation.drives.geojson import write_geojson
from crossloc3d_ros.evaluation.drives.place_scores import Scores, score
from crossloc3d_ros.evaluation.drives.track_scores import TrackScores, score_track
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.formats.bag import BagReader

log = logging.getLogger(__name__)

ESTIMATES = "estimates.csv"
GEOJSON = "estimates.geojson"
SUMMARY = "summary.json"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A scored drive."""

    table: EstimateTable
    truth: TruthTrack | None
    scores: Scores | None
    """None where nothing is known of the truth."""
    track: TrackScores | None = None
    """None where the estimates are places and no poses, or nothing is known of the truth."""
    heading_topic: str | None = None
    """What measures the true headings; None where nothing does."""


def evaluate(bag: BagReader, folder: Path, aerial_map: AerialMap, gnss_topic: str | None = None) -> Evaluation:
    """Score the estimates in `folder` against the bag's GNSS; write truth, errors, GeoJSON and summary beside them."""
    path = folder / ESTIMATES
    truth_topic = find_truth_topic(bag, gnss_topic)
    truth = None if truth_topic is None else read_truth(bag, truth_topic, aerial_map.frame)
    table = read_estimates(path)
    headings = None
    if truth is not None:
        heading_topic = find_heading_topic(bag)
        headings = None if heading_topic is None else read_heading(bag, heading_topic, truth, aerial_map.frame)
        table = add_truth(
            path,
            truth.at(table.stamp_ns),
            aerial_map.frame,
            None if headings is None else headings.at(table.stamp_ns),
        )
        if not np.isfinite(table.truth_grid).any():
            log.warning(
                "'%s' gives no position at the time of any scan (%d fixes kept, %d dropped): nothing is scored",
                truth.topic,
                len(truth),
                truth.dropped,
            )
    evaluation = Evaluation(
        table,
        truth,
        score_table(table, aerial_map),
        score_track(table),
        None if headings is None else headings.topic,
    )
    write_geojson(folder / GEOJSON, table, aerial_map.frame)
    return evaluation


def score_table(table: EstimateTable, aerial_map: AerialMap) -> Scores | None:
    """Score estimates whose truth is known; None where it is known of none."""
    if not np.isfinite(table.truth_grid).all(axis=1).any():
        return None
    return score(
        table.truth_grid,
        table.has_fix,
        table.grid,
        table.covariance[:, :2, :2],
        table.candidate_grid,
        aerial_map.submaps.grid,
    )


def write_summary(folder: Path, evaluation: Evaluation, about: dict[str, Any]) -> None:
    """Write what was measured, on what, as JSON; NaN becomes null."""
    summary = {
        **about,
        "scans": len(evaluation.table),
        "fixes": int(evaluation.table.has_fix.sum()),
        "truth": None
        if evaluation.truth is None
        else {
            "topic": evaluation.truth.topic,
            "fixes": len(evaluation.truth),
            "dropped": evaluation.truth.dropped,
        },
        "scores": None if evaluation.scores is None else _stored(evaluation.scores),
        "track": None if evaluation.track is None else asdict(evaluation.track),
        "latency_ms": latency_summary(evaluation.table),
    }
    write_atomically(folder / SUMMARY, json.dumps(_without_nan(summary), indent=2, allow_nan=False) + "\n")


def _stored(scores: Scores) -> dict[str, Any]:
    content = asdict(scores)
    for recall in content["recalls"]:
        del recall["label"]  # the rank once more
    return content


def latency_summary(table: EstimateTable) -> dict[str, float]:
    """Return median, 95 % and maximum of the time from scan to estimate, milliseconds."""
    latency = table.latency_ms
    latency = latency[np.isfinite(latency)]
    if not len(latency):
        return {}
    return {
        "median": float(np.median(latency)),
        "p95": float(np.percentile(latency, 95)),
        "max": float(latency.max()),
    }


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
