"""Whether the odometry agrees with the map, by the distances between fixes and by the filter's own estimates."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.mixture import ODOMETRY_DRIFT, ODOMETRY_SCALE, Mixture
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.types import Float64Array

_FIXES = 12  # between the first and last of so many the distance is compared: some metres at walking pace
_FACTOR, _SLACK_M = 4.0 / 3.0, 2.0  # the map's distance may exceed the odometry's by so much: errors of two fixes
_SIGNIFICANT = 3.0  # standard deviations: an error of scale or drift that is no chance
_MAX_NIS = 2.5  # above, the innovations of some ten scans are inconsistent


class OdometryMonitor:
    """Compare the distances that the odometry reports with those between fixes."""

    def __init__(self) -> None:
        self._reported_m = 0.0
        self._without_fix = 0
        # The distance reported until each fix, and the fix' position.
        self._fixes: deque[tuple[float, Float64Array]] = deque(maxlen=_FIXES)

    def add_motion(self, motion: Motion) -> None:
        """Take in a motion; an unknown one ends the comparison."""
        if motion.is_known:
            self._reported_m += motion.distance_m
        else:
            self._fixes.clear()

    def add_fix(self, xy: Float64Array, right_within_m: float) -> None:
        """Take in the position (2,) of a fix."""
        if self._fixes:
            reported_m, before = self._fixes[-1]
            if np.hypot(*(xy - before)) > right_within_m + self._reported_m - reported_m:
                self._fixes.clear()  # a kidnapped robot, or a wrong fix before: it did not drive there
        self._fixes.append((self._reported_m, xy))
        self._without_fix = 0

    def add_no_fix(self) -> None:
        """Take in that a scan gave no fix; the fixes before a long row of these no longer count."""
        self._without_fix += 1
        if self._without_fix > _FIXES // 2:
            self._fixes.clear()

    def fault(self, mixture: Mixture, leader: int, config: FusionConfig) -> str:
        """Return what is wrong with the odometry, as a clause that follows a sentence; empty where nothing is."""
        scale = float(mixture.mean[leader, ODOMETRY_SCALE])
        drift_deg = math.degrees(mixture.mean[leader, ODOMETRY_DRIFT])
        if abs(scale) > _SIGNIFICANT * config.odometry_relative_std:
            kind = "short" if scale > 0.0 else "long"
            return f"; the odometry's distances are {abs(scale) / (1.0 + scale):.0%} too {kind}"
        if abs(drift_deg) > _SIGNIFICANT * config.odometry_drift_deg_per_m:
            return f"; the odometry's heading drifts by {-drift_deg:+.1f} degrees per metre"
        if len(self._fixes) == _FIXES:
            (first_m, first), (last_m, last) = self._fixes[0], self._fixes[-1]
            moved_m, reported_m = float(np.hypot(*(last - first))), last_m - first_m
            if moved_m > reported_m * _FACTOR + _SLACK_M:
                return f"; odometry and map disagree: it reports {reported_m:.1f} m of the last {moved_m:.1f} m"
        nis = float(mixture.nis[leader])
        if nis > _MAX_NIS:
            return f"; odometry and map disagree: innovations are {math.sqrt(nis):.1f} times as large as expected"
        return ""
