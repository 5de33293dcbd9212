"""What is wrong with a lidar by its scans alone: covered, mounted otherwise than configured, or frozen."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from crossloc3d_ros.clouds.plausibility import implausible, same_points
from crossloc3d_ros.config import ScanConfig
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.types import Float64Array, Scan

MOST_REPEATS = 5
"""A live lidar never repeats its noise; a driver that sends a turn twice or thrice after a stall is no reason yet."""
_MOVED_M, _TURNED_RAD = 0.1, math.radians(2.0)
"""A robot that has moved so far, by odometry, sees something else."""


class ScanChecks:
    """Look at each scan, and compare it with the one before."""

    def __init__(self, config: ScanConfig) -> None:
        """Have seen nothing; compile, so that the first scan is as fast as the others."""
        self._last: Scan | None = None
        self._since_ns = 0
        self._repeats = 0
        implausible(np.zeros((1, 3), np.float32), np.eye(4), config)

    def fault(
        self,
        scan: Scan,
        T_base_lidar: Float64Array,
        config: ScanConfig,
        motion: Callable[[int, int], Motion] | None = None,
    ) -> str:
        """Return why a scan cannot be used; empty where it can. Each scan once, in the order of arrival.

        `motion(from_ns, to_ns)` returns how the base moved by odometry, where there is one.
        """
        return self._frozen(scan, motion) or implausible(scan.points, T_base_lidar, config)

    def _frozen(self, scan: Scan, motion: Callable[[int, int], Motion] | None) -> str:
        last, self._last = self._last, scan
        is_back = last is not None and scan.stamp_ns < last.stamp_ns  # a recording from its start
        if last is None or is_back or not len(scan.points) or not same_points(scan.points, last.points):
            self._since_ns, self._repeats = scan.stamp_ns, 0
            return ""
        if scan.stamp_ns == last.stamp_ns:  # a message that came twice
            return ""
        self._repeats += 1
        seconds = (scan.stamp_ns - self._since_ns) * 1e-9
        moved = None if motion is None else motion(self._since_ns, scan.stamp_ns)
        if moved is not None and moved.is_known:
            distance_m, turn_rad = moved.distance_m, abs(float(moved.delta[2]))
            if distance_m > _MOVED_M or turn_rad > _TURNED_RAD:
                return (
                    f"the lidar is frozen: it has repeated one scan, bit for bit, for {seconds:.1f} s, while the robot "
                    f"moved by {distance_m:.1f} m and {math.degrees(turn_rad):.0f} degrees; restart its driver"
                )
        if self._repeats >= MOST_REPEATS:
            return (
                f"the lidar is frozen: it has repeated one scan, bit for bit, {self._repeats} times in "
                f"{seconds:.1f} s; restart its driver"
            )
        return ""
