"""A recording straight through the localizer: export first, then score what was exported."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.errors import BagError, CloudError
from crossloc3d_ros.evaluation.estimates import (
    EstimateTable,
    EstimateWriter,
    add_truth,
    read_estimates,
    write_atomically,
    write_geojson,
)
from crossloc3d_ros.evaluation.recall import Scores, score
from crossloc3d_ros.evaluation.truth import TruthTrack, find_truth_topic, read_truth
from crossloc3d_ros.formats.bag import IMU, POINT_CLOUD, BagReader, stamp_ns_of
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.localization.gravity import GravityFilter
from crossloc3d_ros.localization.localizer import Localizer, no_estimate
from crossloc3d_ros.places.store import AerialMap
from crossloc3d_ros.types import Estimate

log = logging.getLogger(__name__)

ESTIMATES = "estimates.csv"
GEOJSON = "estimates.geojson"
SUMMARY = "summary.json"

Progress = Callable[[int, int, Estimate], None]
"""Scans done, scans to do, the newest estimate."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A scored drive."""

    table: EstimateTable
    truth: TruthTrack | None
    scores: Scores | None
    """None where nothing is known of the truth."""


def localize_bag(
    bag: BagReader,
    topic: str,
    localizer: Localizer,
    output: Path,
    *,
    every: int = 1,
    imu_topic: str | None = None,
    imu_time_constant_s: float = 1.0,
    progress: Progress | None = None,
) -> int:
    """Localize every `every`-th scan of a bag, write the estimates to the CSV file `output` and return their number.

    `imu_topic` levels the scans by accelerations in the axes of the base. A cloud that cannot be used becomes a row
    without a fix that says why; a bag that breaks off raises BagError when the rows before the break are written.
    """
    gravity = GravityFilter(imu_time_constant_s)
    topics = [topic] if imu_topic is None else [topic, bag.topic(imu_topic, IMU).name]
    total = math.ceil(bag.topic(topic, POINT_CLOUD).count / every)
    seen = done = 0
    with EstimateWriter(output) as writer:
        for name, recorded_ns, message in bag.messages(topics):
            if name != topic:
                acceleration = message.linear_acceleration
                gravity.update(
                    stamp_ns_of(message, recorded_ns), np.array([acceleration.x, acceleration.y, acceleration.z])
                )
                continue
            seen += 1
            if (seen - 1) % every:
                continue
            stamp_ns = stamp_ns_of(message, recorded_ns)
            try:
                scan = replace(scan_from_pointcloud2(message), stamp_ns=stamp_ns)
                estimate = localizer.localize(scan, gravity.up(stamp_ns))
            except CloudError as error:
                estimate = no_estimate(stamp_ns, str(error))
            writer.write(estimate)
            done += 1
            if progress is not None:
                progress(done, max(total, done), estimate)
    if done == 0:
        raise BagError(f"topic '{topic}' of {bag.path} holds no message")
    return done


def evaluate(bag: BagReader, folder: Path, aerial_map: AerialMap, gnss_topic: str | None = None) -> Evaluation:
    """Score the estimates in `folder` against the bag's GNSS; write truth, errors, GeoJSON and summary beside them."""
    path = folder / ESTIMATES
    truth_topic = find_truth_topic(bag, gnss_topic)
    truth = None if truth_topic is None else read_truth(bag, truth_topic, aerial_map.frame)
    table = read_estimates(path)
    if truth is not None:
        table = add_truth(path, truth.at(table.stamp_ns), aerial_map.frame)
        if not np.isfinite(table.truth_grid).any():
            log.warning(
                "'%s' gives no position at the time of any scan (%d fixes kept, %d dropped): nothing is scored",
                truth.topic,
                len(truth),
                truth.dropped,
            )
    evaluation = Evaluation(table, truth, score_table(table, aerial_map))
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
        "scores": None if evaluation.scores is None else asdict(evaluation.scores),
        "latency_ms": latency_summary(evaluation.table),
    }
    write_atomically(folder / SUMMARY, json.dumps(_without_nan(summary), indent=2, allow_nan=False) + "\n")


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
