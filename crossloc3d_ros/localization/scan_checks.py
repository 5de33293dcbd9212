"""What is wrong with a lidar by its scans: covered, mounted otherwise than configured, frozen, or mirrored."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.clouds.plausibility import implausible, same_points
from crossloc3d_ros.config import ScanConfig
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.localization.turn_direction import TurnDirection
from crossloc3d_ros.types import Float32Array, Float64Array, Scan

MOST_REPEATS = 5
"""A live lidar never repeats its noise; a driver that sends a turn twice or thrice after a stall is no reason yet."""
REMEMBERED = 8
"""Scans that one is compared with: a buffer that is sent round and round holds no more."""
_MOVED_M, _TURNED_RAD = 0.1, math.radians(2.0)
"""A robot that has moved so far, by odometry, sees something else."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """A scan that may come again."""

    points: Float32Array
    stamp_ns: int
    """When it came first."""


class ScanChecks:
    """Look at each scan, and compare it with those before."""

    def __init__(self, config: ScanConfig) -> None:
        """Have seen nothing; compile, so that the first scan is as fast as the others."""
        self._seen: deque[_Seen] = deque(maxlen=REMEMBERED)
        self._last_ns: int | None = None
        self._repeats = 0
        self._turns = TurnDirection()
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
        reason = self._frozen(scan, motion) or implausible(scan.points, T_base_lidar, config)
        if reason or motion is None:
            return reason
        return self._turns.fault(scan, T_base_lidar, config, motion)

    def _frozen(self, scan: Scan, motion: Callable[[int, int], Motion] | None) -> str:
        last_ns, self._last_ns = self._last_ns, scan.stamp_ns
        if last_ns is not None and scan.stamp_ns < last_ns:  # a recording from its start
            self._seen.clear()
        earlier = next((seen for seen in self._seen if same_points(scan.points, seen.points)), None)
        if earlier is None:
            self._seen.append(_Seen(scan.points, scan.stamp_ns))
            self._repeats = 0
            return ""
        if scan.stamp_ns == last_ns:  # a message that came twice
            return ""
        self._repeats += 1
        seconds = (scan.stamp_ns - earlier.stamp_ns) * 1e-9
        moved = None if motion is None else motion(earlier.stamp_ns, scan.stamp_ns)
        if moved is not None and moved.is_known:
            distance_m, turn_rad = moved.distance_m, abs(float(moved.delta[2]))
            if distance_m > _MOVED_M or turn_rad > _TURNED_RAD:
                return (
                    f"the lidar is frozen: it repeats a scan of {seconds:.1f} s ago, while the robot moved by "
                    f"{distance_m:.1f} m and {math.degrees(turn_rad):.0f} degrees; restart its driver"
                )
        if self._repeats >= MOST_REPEATS:
            return (
                f"the lidar is frozen: its last {self._repeats} scans repeat those of up to {seconds:.1f} s ago; "
                "restart its driver"
            )
        return ""
