"""From beliefs to estimates, in the frames that robots use: grid, ENU map frame, geographic."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from crossloc3d_ros.clouds.filters import levelling_matrix
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.decision import Belief
from crossloc3d_ros.localization.retrieval.place_belief import PlaceBelief
from crossloc3d_ros.stopwatch import Stopwatch
from crossloc3d_ros.types import (
    AlignedPoses,
    Candidates,
    Estimate,
    FixStatus,
    Float64Array,
    ScanCounts,
    Timings,
    TrackState,
    no_candidates,
)

HEIGHT_STD_M, TILT_STD_RAD = 0.5, math.radians(2.0)
"""Of the terrain under the base, and of its roll and pitch: of a wheeled robot on roads and paths."""


class Watch:
    """The times of the steps of one scan."""

    def __init__(self) -> None:
        self.timings = Timings()
        self._stopwatch = Stopwatch()

    def lap(self, name: str) -> None:
        """Record the time since the last lap as that of the step `name`, a field of `Timings`."""
        self.timings = dataclasses.replace(self.timings, **{name: 1e3 * self._stopwatch.lap()})


def no_estimate(
    stamp_ns: int, reason: str, counts: ScanCounts | None = None, timings: Timings | None = None
) -> Estimate:
    """Return the estimate of a scan that led to no candidate at all, with the reason."""
    return Estimate(
        stamp_ns=stamp_ns,
        status=FixStatus.NO_FIX,
        reason=reason,
        grid=np.full(3, np.nan),
        enu=np.full(3, np.nan),
        latitude_deg=float("nan"),
        longitude_deg=float("nan"),
        altitude_m=float("nan"),
        covariance=np.full((3, 3), np.nan),
        candidates=no_candidates(),
        counts=counts or ScanCounts(),
        timings=timings or Timings(),
    )


def placed_estimate(
    stamp_ns: int, frame: MapFrame, place: PlaceBelief, candidates: Candidates, counts: ScanCounts, watch: Watch
) -> Estimate:
    """Return the estimate by retrieval alone: a place of some tens of metres, no heading."""
    grid = frame.from_enu(place.enu[None])
    latitude, longitude, altitude = frame.to_geographic(grid)
    return Estimate(
        stamp_ns=stamp_ns,
        status=place.status,
        reason=place.reason,
        grid=grid[0],
        enu=place.enu,
        latitude_deg=float(latitude[0]),
        longitude_deg=float(longitude[0]),
        altitude_m=float(altitude[0]),
        covariance=place.covariance,
        candidates=candidates,
        counts=counts,
        timings=watch.timings,
        state=TrackState.LOCALIZED if place.status is FixStatus.FIX else TrackState.SEARCHING,
    )


def posed_estimate(
    stamp_ns: int,
    frame: MapFrame,
    place: PlaceBelief,
    candidates: Candidates,
    aligned: AlignedPoses,
    belief: Belief,
    gravity_base: Float64Array | None,
    counts: ScanCounts,
    watch: Watch,
) -> Estimate:
    """Return the estimate of a tracked pose; without any hypothesis the retrieved place, without a fix."""
    is_posed = bool(np.isfinite(belief.grid[:2]).all())
    placed = dataclasses.replace(
        placed_estimate(stamp_ns, frame, place, candidates, counts, watch),
        status=FixStatus.FIX if is_posed and belief.is_fix else FixStatus.NO_FIX,
        reason=belief.reason,
        state=belief.state,
        probability=belief.probability,
        aligned=aligned,
        hypotheses=belief.hypotheses,
    )
    if not is_posed:
        return placed
    height = belief.grid[2] if math.isfinite(belief.grid[2]) else placed.grid[2]
    grid = np.array([belief.grid[0], belief.grid[1], height])
    latitude, longitude, altitude = frame.to_geographic(grid[None])
    grid_to_true_north_rad = -float(frame.convergence_rad(grid[None])[0])
    T_map_base = np.eye(4)
    T_map_base[:3, :3] = _about_z(belief.heading_rad + grid_to_true_north_rad)
    if gravity_base is not None:
        T_map_base[:3, :3] = T_map_base[:3, :3] @ levelling_matrix(gravity_base)[:3, :3]
    T_map_base[:3, 3] = frame.to_enu(grid[None])[0]
    pose_covariance = _in_map(belief.covariance, grid_to_true_north_rad)
    return dataclasses.replace(
        placed, grid=grid, enu=T_map_base[:3, 3].copy(), latitude_deg=float(latitude[0]),
        longitude_deg=float(longitude[0]), altitude_m=float(altitude[0]), covariance=pose_covariance[:3, :3],
        T_map_base=T_map_base, pose_covariance=pose_covariance,
    )  # fmt: skip


def _about_z(angle: float) -> Float64Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _in_map(covariance: Float64Array, rotation_rad: float) -> Float64Array:
    """Return the covariance (6, 6) of x, y, z and the rotations about them from that of easting, northing, heading."""
    rotation = _about_z(rotation_rad)
    full = np.diag([0.0, 0.0, HEIGHT_STD_M**2, TILT_STD_RAD**2, TILT_STD_RAD**2, 0.0])
    rows = [0, 1, 5]
    full[np.ix_(rows, rows)] = rotation @ covariance @ rotation.T
    return full
