"""Whether the scans turn the way that odometry turns: those of a mirrored lidar turn the other way.

What stands around the robot is seen at other bearings after a turn. Two scans some ten degrees apart are compared as
profiles, the nearest range of each bearing, at the turn that odometry reports and at the opposite one. One pair may
mislead beside a hedge or in a crowd; pair after pair does not.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from crossloc3d_ros.clouds.filters import transform_points
from crossloc3d_ros.config import ScanConfig
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.types import Float32Array, Float64Array, Scan

PAIRS, OPPOSED = 6, 4
"""Of the last pairs that tell anything so many must be opposed, and all of the last three: some 60 degrees of turns.

Of 200 pairs of simulated drives through real and made-up towns none is opposed, and mirrored each one is.
"""
_LEAST_TURN_RAD, _MOST_TURN_RAD = math.radians(12.0), math.radians(50.0)
_MOST_MOVED_M = 2.0
"""What has been passed looks otherwise."""
_BEARINGS = 360
_LEAST_HEIGHT_M, _MOST_HEIGHT_M = 0.4, 6.0  # off the ground, which looks alike on every side
_LEAST_SHARED = 60
_CLEAR = 0.75
"""The better turn explains the ranges this much better than the other, or the pair tells nothing."""


class TurnDirection:
    """Compare scans before and after turns."""

    def __init__(self) -> None:
        """Have seen nothing."""
        self._first: tuple[Scan, Float64Array] | None = None
        self._opposed: deque[bool] = deque(maxlen=PAIRS)

    def fault(
        self, scan: Scan, T_base_lidar: Float64Array, config: ScanConfig, motion: Callable[[int, int], Motion]
    ) -> str:
        """Return what is wrong by the scans until this one; empty where nothing is. Each scan once, in their order."""
        opposed = self._pair(scan, T_base_lidar, config, motion)
        if opposed is not None:
            self._opposed.append(opposed)
        verdicts = list(self._opposed)
        if sum(verdicts) < OPPOSED or not all(verdicts[-3:]):
            return ""
        return (
            "the scans turn the other way than the odometry: one of the two is mirrored; x must point forward, y to "
            "the left, z up, and a turn to the left count positive (REP-103), in the lidar's driver and in the odometry"
        )

    def _pair(
        self, scan: Scan, T_base_lidar: Float64Array, config: ScanConfig, motion: Callable[[int, int], Motion]
    ) -> bool | None:
        """Return whether this scan and the first of the pair are opposed to odometry; None where they do not tell."""
        if self._first is None:
            self._first = scan, T_base_lidar
            return None
        first, T_first = self._first
        moved = motion(first.stamp_ns, scan.stamp_ns)
        turn_rad = float(moved.delta[2])
        is_usable = moved.is_known and moved.distance_m <= _MOST_MOVED_M and abs(turn_rad) <= _MOST_TURN_RAD
        if is_usable and abs(turn_rad) < _LEAST_TURN_RAD:
            return None
        self._first = scan, T_base_lidar
        if not is_usable:
            return None
        before, after = _profile(first.points, T_first, config), _profile(scan.points, T_base_lidar, config)
        # A turn of the robot to the left moves what it sees to the right.
        agreed, opposed = _difference(before, after, -turn_rad), _difference(before, after, turn_rad)
        if math.isnan(agreed) or math.isnan(opposed) or min(agreed, opposed) > _CLEAR * max(agreed, opposed):
            return None
        return opposed < agreed


def _profile(points: Float32Array, T_base_lidar: Float64Array, config: ScanConfig) -> Float64Array:
    """Return the logarithm of the nearest range (`_BEARINGS`,) in each direction of the base; NaN where there is none.

    Of points (N, 3), lidar frame, that stand above the ground.
    """
    ranges = np.linalg.norm(points.astype(np.float64), axis=1)
    used = (ranges >= max(config.min_range_m, 1.0)) & (ranges <= config.max_range_m)  # and so finite
    seen = transform_points(T_base_lidar, points[used].astype(np.float64))
    seen = seen[(seen[:, 2] > _LEAST_HEIGHT_M) & (seen[:, 2] < _MOST_HEIGHT_M)]
    bearing = (np.arctan2(seen[:, 1], seen[:, 0]) * (_BEARINGS / (2.0 * math.pi))).astype(np.int64) % _BEARINGS
    nearest = np.full(_BEARINGS, np.inf)
    np.minimum.at(nearest, bearing, np.hypot(seen[:, 0], seen[:, 1]))
    return np.asarray(np.log(np.where(np.isfinite(nearest), np.maximum(nearest, 0.1), np.nan)))


def _difference(before: Float64Array, after: Float64Array, turn_rad: float) -> float:
    """Return the mean difference of two profiles, the first turned, give or take two degrees; NaN if unknown."""
    middle = round(turn_rad * _BEARINGS / (2.0 * math.pi))
    found = []
    for step in range(middle - 2, middle + 3):
        difference = np.abs(after - np.roll(before, step))
        known = difference[~np.isnan(difference)]
        if len(known) < _LEAST_SHARED:
            return math.nan
        found.append(float(np.minimum(known, 0.5).mean()))
    return min(found)
