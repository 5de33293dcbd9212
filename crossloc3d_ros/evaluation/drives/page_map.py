"""The map of a drive's page, and the data from which its script draws the chosen scan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from crossloc3d_ros.datasets.truth import jumped
from crossloc3d_ros.evaluation.drives.charts import STATE_WORDS, WORST, class_of, error_classes, seconds_of
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable, PoseLists
from crossloc3d_ros.evaluation.statistics import CHI2_2D_95
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.pages.backdrop import Backdrop
from crossloc3d_ros.pages.wording import rounded
from crossloc3d_ros.types import WHOLE_MAP, BoolArray, Float64Array

SHOWN_CANDIDATES = 10
SHOWN_POSES = 6


@dataclass(frozen=True)
class MapView:
    """The map of a drive, in metres right of and below the upper left corner of its picture."""

    picture_uri: str
    width_m: float
    height_m: float
    pixel_m: float
    """About a pixel on a desk; the script keeps it exact."""
    scale_m: int
    """Length of the scale bar."""
    path: str
    """The path driven, as commands of an SVG path."""
    fixes: tuple[tuple[str, float, float], ...]
    """The class of each fix in the style sheet, and where it lies."""


def map_view(table: EstimateTable, backdrop: Backdrop, chosen: list[int]) -> MapView:
    """Return the picture, the path that was driven, and a dot for each fix."""
    west, south, east, north = backdrop.bounds
    width, height = east - west, north - south
    truth = to_view(table.truth_grid[chosen], backdrop)
    places = to_view(table.grid[chosen, :2], backdrop)
    errors, classes = table.error_m[chosen], error_classes(table)
    kidnapped = jumped(np.hypot(*np.diff(truth, axis=0).T), np.diff(seconds_of(table)[chosen]))
    return MapView(
        picture_uri=backdrop.data_uri,
        width_m=width,
        height_m=height,
        pixel_m=width / 700.0,
        scale_m=max(v for v in (10, 20, 50, 100, 200, 500, 1000, 2000) if v <= max(10.0, width / 4)),
        path=_path(np.insert(truth, np.flatnonzero(kidnapped) + 1, np.nan, axis=0)),
        fixes=tuple(
            (class_of(float(error), classes), float(x), float(y))
            for (x, y), error, is_fix in zip(places, errors, table.has_fix[chosen], strict=True)
            if is_fix and math.isfinite(x)
        ),
    )


def page_data(table: EstimateTable, backdrop: Backdrop, chosen: list[int], frame: MapFrame) -> dict[str, Any]:
    """Return what the page's script needs: metres right of and below the map's corner, headings on the map."""
    seconds = seconds_of(table)
    truth, fixes = to_view(table.truth_grid, backdrop), to_view(table.grid[:, :2], backdrop)
    errors, latency = table.error_m, table.latency_ms
    turn = grid_turn_rad(table, frame)
    reasons: dict[str, int] = {}
    scans: list[dict[str, Any]] = []
    for i in chosen:
        is_fix = bool(table.has_fix[i])
        count = int(np.isfinite(table.candidate_grid[i]).all(axis=1).sum())
        places = to_view(table.candidate_grid[i, : min(count, SHOWN_CANDIDATES)], backdrop)
        scan: dict[str, Any] = {
            "number": i,
            "t": round(float(seconds[i]), 3),
            "fix": is_fix,
            "at": _pair(fixes[i]) if is_fix else None,
            "truth": _pair(truth[i]),
            "error": rounded(errors[i], 2) if is_fix else None,
            "ellipse": _ellipse(table.covariance[i, :2, :2]) if is_fix else None,
            "latency": rounded(latency[i], 2),
            "reason": reasons.setdefault(table.reasons[i], len(reasons)),
            "candidates": [
                [
                    *(_pair(place) or [0.0, 0.0]),
                    rounded(table.candidate_distances[i, rank], 4),
                    rounded(table.candidate_probabilities[i, rank], 4),
                ]
                for rank, place in enumerate(places)
            ],
        }
        if table.has_track:
            state = table.states[i]
            scan |= {
                "state": "" if state is None else state.value,
                "belief": rounded(table.probability[i], 6),
                "heading": rounded(math.degrees(table.heading_rad[i] + turn[i]), 2) if is_fix else None,
                "trueHeading": rounded(math.degrees(table.truth_heading_rad[i] + turn[i]), 2),
                "turned": rounded(math.degrees(table.heading_error_rad[i]), 2) if is_fix else None,
                "headingStd": rounded(math.degrees(table.heading_std_rad[i]), 2) if is_fix else None,
                "aligned": [
                    [*row, int(source)]
                    for row, source in zip(
                        _poses(table.aligned, i, backdrop, with_ellipse=False), table.aligned_sources[i], strict=False
                    )
                ],
                "hypotheses": _poses(table.hypotheses, i, backdrop, with_ellipse=True),
            }
        scans.append(scan)
    limits = [{"limit": limit, "name": css} for limit, css in error_classes(table)]
    top = int((table.candidate_ids >= 0).sum(axis=1).max(initial=0))
    return {
        "scans": scans,
        "reasons": list(reasons),
        "classes": [*limits, {"limit": None, "name": WORST}],
        "states": {state.value: words for state, words in STATE_WORDS.items()},
        "exhaustive": WHOLE_MAP,
        "tracked": table.has_track,
        "shown": SHOWN_CANDIDATES,
        "top": top,
        "more": top > SHOWN_CANDIDATES,
        "duration": round(float(seconds[-1]), 3) if len(seconds) else 0.0,
        "start": _first_shown(table, scans),
    }


def to_view(grid: Float64Array, backdrop: Backdrop) -> Float64Array:
    """Return (n, 2) metres right of and below the picture's upper left corner."""
    west, _, _, north = backdrop.bounds
    return np.column_stack([grid[:, 0] - west, north - grid[:, 1]])


def grid_turn_rad(table: EstimateTable, frame: MapFrame) -> Float64Array:
    """Return the angle (S,) that makes a heading from true east one from grid east."""
    places = np.where(np.isfinite(table.truth_grid), table.truth_grid, table.grid[:, :2])
    known: BoolArray = np.asarray(np.isfinite(places).all(axis=1))
    places = np.column_stack([np.where(known[:, None], places, frame.origin[:2]), np.full(len(table), frame.origin[2])])
    return frame.convergence_rad(places) if len(table) else np.empty(0)


def _first_shown(table: EstimateTable, scans: list[dict[str, Any]]) -> int:
    """Return the scan to begin with: of a track one with several hypotheses, else one in the middle of the fixes."""
    several = [
        j for j, scan in enumerate(scans) if len(scan.get("hypotheses", ())) > 1 and scan["state"] == "ambiguous"
    ]
    fixed = [j for j, scan in enumerate(scans) if scan["fix"]]
    if table.has_track and several:
        return several[len(several) // 2]
    return fixed[len(fixed) // 2] if fixed else 0


def _poses(poses: PoseLists, scan: int, backdrop: Backdrop, *, with_ellipse: bool) -> list[list[float | None]]:
    """Return x, y, heading, belief of a scan's first poses; with the half-axes and the angle of an ellipse."""
    shown = min(poses.count(scan), SHOWN_POSES)
    rows = []
    for rank, place in enumerate(to_view(poses.grid[scan, :shown], backdrop)):
        row: list[float | None] = [
            *(_pair(place) or [0.0, 0.0]),
            rounded(math.degrees(poses.heading_rad[scan, rank]), 1),
            rounded(poses.probabilities[scan, rank], 5),
        ]
        if with_ellipse:
            row += _ellipse(poses.covariance[scan, rank]) or [None] * 3
        rows.append(row)
    return rows


def _ellipse(covariance: Float64Array) -> list[float] | None:
    """Return semi-axes in metres and angle in the picture, degrees clockwise, of the 95 % ellipse."""
    if not np.isfinite(covariance).all():
        return None
    values, axes = np.linalg.eigh(covariance)
    minor, major = np.sqrt(np.maximum(values, 0.0) * CHI2_2D_95)
    angle = math.degrees(math.atan2(-axes[1, 1], axes[0, 1]))
    return [round(float(major), 2), round(float(minor), 2), round(angle, 1)]


def _path(points: Float64Array) -> str:
    commands, pen_down = [], False
    for x, y in points:
        if not math.isfinite(x):
            pen_down = False
            continue
        commands.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
        pen_down = True
    return "".join(commands)


def _pair(point: Float64Array) -> list[float] | None:
    return [round(float(point[0]), 2), round(float(point[1]), 2)] if np.isfinite(point).all() else None
