"""Estimates as GeoJSON, for geographic information systems."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.evaluation.drives.estimates import EstimateTable
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.pages.wording import rounded
from crossloc3d_ros.types import Float64Array


def write_geojson(path: Path, table: EstimateTable, frame: MapFrame, candidates: int = 5) -> None:
    """Write truth, fixes and the first `candidates` of each scan as GeoJSON (RFC 7946: WGS84, longitude first)."""
    features: list[dict[str, Any]] = []
    truth = _geographic(frame, table.truth_grid)
    if np.isfinite(truth).any():
        features.append(
            {
                "type": "Feature",
                "geometry": _track(truth),
                "properties": {"kind": "truth"},
            }
        )
    errors = table.error_m
    for i in range(len(table)):
        place = table.geographic[i]
        features.append(
            {
                "type": "Feature",
                # RFC 7946 says null for a feature without a place.
                "geometry": {"type": "Point", "coordinates": _position(place)}
                if np.isfinite(place[:2]).all()
                else None,
                "properties": {
                    "kind": "fix" if table.has_fix[i] else "no fix",
                    "scan": i,
                    "stamp_ns": str(table.stamp_ns[i]),  # as text: nanoseconds do not fit JSON's double
                    "error_m": rounded(errors[i], 2),
                    "std_east_m": rounded(math.sqrt(max(0.0, table.covariance[i, 0, 0])), 2),
                    "std_north_m": rounded(math.sqrt(max(0.0, table.covariance[i, 1, 1])), 2),
                    **_pose_properties(table, i),
                    "reason": table.reasons[i],
                },
            }
        )
        found = table.candidate_grid[i, :candidates]
        found = found[np.isfinite(found).all(axis=1)]
        if len(found):
            features.append(
                {
                    "type": "Feature",
                    "geometry": {
                        "type": "MultiPoint",
                        "coordinates": [_position(p) for p in _geographic(frame, found)],
                    },
                    "properties": {
                        "kind": "candidates",
                        "scan": i,
                        "submaps": [int(j) for j in table.candidate_ids[i, : len(found)]],
                        "descriptor_distances": [
                            rounded(value, 4) for value in table.candidate_distances[i, : len(found)]
                        ],
                        "probabilities": [
                            rounded(value, 4) for value in table.candidate_probabilities[i, : len(found)]
                        ],
                    },
                }
            )
        held = table.hypotheses.grid[i, : min(table.hypotheses.count(i), candidates)]
        if len(held):
            features.append(
                {
                    "type": "Feature",
                    "geometry": {"type": "MultiPoint", "coordinates": [_position(p) for p in _geographic(frame, held)]},
                    "properties": {
                        "kind": "hypotheses",
                        "scan": i,
                        "probabilities": [
                            rounded(value, 4) for value in table.hypotheses.probabilities[i, : len(held)]
                        ],
                    },
                }
            )
    write_atomically(path, json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False))


def _pose_properties(table: EstimateTable, scan: int) -> dict[str, Any]:
    """Return what GeoJSON says of a pose; nothing where the file knows of places alone."""
    state = table.states[scan]
    if state is None:
        return {}
    return {
        "state": state.value,
        "probability": rounded(table.probability[scan], 4),
        "heading_deg": rounded(math.degrees(table.heading_rad[scan]), 2),
        "heading_std_deg": rounded(math.degrees(table.heading_std_rad[scan]), 2),
    }


def _geographic(frame: MapFrame, grid: Float64Array) -> Float64Array:
    """Return (n, 2) latitude and longitude of grid points (n, 2), NaN where these are."""
    result = np.full((len(grid), 2), np.nan)
    known = np.isfinite(grid).all(axis=1)
    if known.any():
        latitude, longitude, _ = frame.to_geographic(np.column_stack([grid[known], np.zeros(known.sum())]))
        result[known] = np.column_stack([latitude, longitude])
    return result


def _position(place: Float64Array) -> list[float]:
    position = [round(float(place[1]), 8), round(float(place[0]), 8)]
    if len(place) > 2 and math.isfinite(place[2]):
        position.append(round(float(place[2]), 2))
    return position


def _track(truth: Float64Array) -> dict[str, Any]:
    """Return the geometry of a track (n, 2): a line for each stretch without gaps, points for what stands alone."""
    known = np.asarray(np.isfinite(truth).all(axis=1), dtype=np.bool_)
    pieces = np.split(np.arange(len(truth)), np.flatnonzero(np.diff(known.astype(np.int8))) + 1)
    stretches = [[_position(truth[i]) for i in piece] for piece in pieces if known[piece[0]]]
    lines = [stretch for stretch in stretches if len(stretch) > 1]
    alone = [stretch[0] for stretch in stretches if len(stretch) == 1]
    if lines and not alone:
        if len(lines) == 1:
            return {"type": "LineString", "coordinates": lines[0]}
        return {"type": "MultiLineString", "coordinates": lines}
    if alone and not lines:
        return {"type": "MultiPoint", "coordinates": alone}
    return {
        "type": "GeometryCollection",
        "geometries": [
            {"type": "MultiLineString", "coordinates": lines},
            {"type": "MultiPoint", "coordinates": alone},
        ],
    }
