"""A drive's results as one HTML page that needs nothing but itself: map, track, hypotheses, charts, explanations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.angles import wrap
from crossloc3d_ros.datasets.truth import TruthTrack
from crossloc3d_ros.evaluation.drives import charts
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable
from crossloc3d_ros.evaluation.drives.evaluation import Evaluation
from crossloc3d_ros.evaluation.drives.page_map import MapView, grid_turn_rad, map_view, page_data
from crossloc3d_ros.evaluation.drives.place_scores import RANKS, Scores
from crossloc3d_ros.evaluation.drives.track_scores import FROM_NOTHING, KIDNAPPED, LOST, WRONG_M, Search, TrackScores
from crossloc3d_ros.evaluation.statistics import INDEPENDENT_M, RADII_M, horizontal_distances
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.pages.backdrop import draw_backdrop
from crossloc3d_ros.pages.render import render_page
from crossloc3d_ros.types import BoolArray, Float64Array

_MOST_SCANS = 3000
"""A longer drive is thinned evenly on the page, not in the figures."""
_MOST_SEARCHES = 8
"""Of the times when it was lost, the longest are listed."""
_LIMITS_M = (25.0, 10.0, 2.0)
_LIMIT_DEG = 5.0


@dataclass(frozen=True)
class About:
    """What the page says of where the figures come from."""

    title: str
    facts: Mapping[str, str]
    """Short names and values: bag, map, weights, how it was run."""
    notes: tuple[str, ...] = ()
    """Sentences that the reader must not miss."""
    footer: str = ""
    latency_is: str = "from handing a scan to the localizer to its estimate"
    extra_words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Step:
    """How many of some scans one step of the chain alone puts right."""

    scans: int
    shares: tuple[float | None, ...]
    """Within 25, 10 and 2 m, and within 2 m and 5 degrees; None where that cannot be said."""


@dataclass(frozen=True)
class Steps:
    """The steps of the chain, over all scans whose truth is known."""

    retrieval: Step
    alignment: Step
    fusion: Step


@dataclass(frozen=True)
class DrivePage:
    """What the template of the page knows."""

    about: About
    scans: int
    fixes: int
    duration_s: float
    tracked: bool
    """Whether the estimates are poses, not places."""
    scores: Scores | None
    track: TrackScores | None
    start: Search | None
    """From the first scan to the first right fix."""
    kidnappings: tuple[Search, ...]
    searches: tuple[Search, ...]
    """Those that are listed."""
    steps: Steps | None
    truth: TruthTrack | None
    heading_topic: str | None
    map: MapView
    states: charts.StateStrip | None
    error_chart: Markup | None
    heading_chart: Markup | None
    belief_chart: Markup | None
    calibration_chart: Markup | None
    coverage_chart: Markup | None
    distribution: charts.Distribution | None
    latency: charts.Latency | None
    latency_chart: Markup | None
    submaps: int
    half_extent_m: float
    """Half the side of a submap."""
    spacing_m: float
    width_m: float
    """Of the aerial map, west to east."""
    height_m: float
    """Of the aerial map, south to north."""
    data: dict[str, Any]
    """What the script needs."""
    radii_m: tuple[float, ...] = RADII_M
    ranks: tuple[int, ...] = RANKS
    independent_m: float = INDEPENDENT_M
    wrong_m: float = WRONG_M
    worst_class: str = charts.WORST
    error_classes: charts.Classes = ()


def write_report(path: Path, evaluation: Evaluation, aerial_map: AerialMap, about: About) -> None:
    """Write the page; CrossLocError where it cannot be written."""
    write_atomically(path, render_page("drive.html.j2", drive_page(evaluation, aerial_map, about)))


def drive_page(evaluation: Evaluation, aerial_map: AerialMap, about: About) -> DrivePage:
    """Return what the page of a drive shows."""
    table, track = evaluation.table, evaluation.track
    backdrop = draw_backdrop(aerial_map, np.concatenate([table.truth_grid, table.grid[table.has_fix, :2]]))
    chosen = list(range(0, len(table), max(1, math.ceil(len(table) / _MOST_SCANS))))
    searches = () if track is None else track.searches
    latency = charts.measure_latency(table)
    west, south, east, north = aerial_map.bounds
    return DrivePage(
        about=about,
        scans=len(table),
        fixes=int(table.has_fix.sum()),
        duration_s=charts.duration_s(table),
        tracked=table.has_track,
        scores=evaluation.scores,
        track=track,
        start=next((search for search in searches if search.cause == FROM_NOTHING), None),
        kidnappings=tuple(search for search in searches if search.cause == KIDNAPPED),
        searches=_listed(searches),
        steps=None if track is None else measure_steps(table, aerial_map.frame),
        truth=evaluation.truth,
        heading_topic=evaluation.heading_topic,
        map=map_view(table, backdrop, chosen),
        states=charts.state_strip(table),
        error_chart=charts.error_chart(table, chosen),
        heading_chart=charts.heading_chart(table, chosen),
        belief_chart=charts.belief_chart(table, chosen),
        calibration_chart=None if track is None else charts.belief_calibration(track),
        coverage_chart=None if track is None else charts.coverage_chart(table),
        distribution=charts.error_distribution(table, evaluation.scores, aerial_map.submaps.grid),
        latency=latency,
        latency_chart=None if latency is None else charts.latency_chart(latency),
        submaps=len(aerial_map.submaps),
        half_extent_m=aerial_map.manifest.preprocessing.half_extent_m,
        spacing_m=aerial_map.manifest.build.spacing_m,
        width_m=east - west,
        height_m=north - south,
        data=page_data(table, backdrop, chosen, aerial_map.frame),
        error_classes=charts.error_classes(table),
    )


def _listed(searches: tuple[Search, ...]) -> tuple[Search, ...]:
    """Return the first search, those after kidnappings, and the longest of the others."""
    longest = sorted((s.travelled_m for s in searches if s.cause == LOST), reverse=True)[:_MOST_SEARCHES]
    return tuple(s for s in searches if s.cause != LOST or s.travelled_m >= longest[-1])


def measure_steps(table: EstimateTable, frame: MapFrame) -> Steps:
    """Return how many scans each step alone puts right, of all scans whose truth is known."""
    known = np.asarray(np.isfinite(table.truth_grid).all(axis=1), np.bool_)
    candidates = horizontal_distances(table.candidate_grid, table.truth_grid)
    place, heading = table.first_aligned
    aligned = np.hypot(*(place - table.truth_grid).T)
    turned = np.abs(np.degrees(wrap(heading - table.truth_heading_rad - grid_turn_rad(table, frame))))
    nowhere = np.full(len(table), np.inf)
    retrieval = _step(known, candidates[:, 0] if candidates.shape[1] else nowhere, nowhere)
    return Steps(
        # A submap's centre is no position to two metres, and has no heading.
        retrieval=Step(retrieval.scans, (*retrieval.shares[:2], None, None)),
        alignment=_step(np.asarray(known & np.isfinite(aligned), np.bool_), aligned, turned),
        fusion=_step(
            known, np.where(table.has_fix, table.error_m, np.inf), np.abs(np.degrees(table.heading_error_rad))
        ),
    )


def _step(among: BoolArray, off_m: Float64Array, off_deg: Float64Array) -> Step:
    scans = int(among.sum())
    if not scans:
        return Step(0, (None,) * (len(_LIMITS_M) + 1))
    shares: list[float | None] = [float(np.mean(off_m[among] <= limit)) for limit in _LIMITS_M]
    both = (off_m <= _LIMITS_M[-1]) & (off_deg <= _LIMIT_DEG)
    shares.append(float(np.mean(both[among])) if np.isfinite(off_deg[among]).any() else None)
    return Step(scans, tuple(shares))
