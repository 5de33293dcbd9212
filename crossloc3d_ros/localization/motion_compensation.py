"""Motion within a turn of the lidar, taken out of a scan where points carry times and odometry tells the motion."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

import numpy as np

from crossloc3d_ros.clouds.deskew import deskew
from crossloc3d_ros.clouds.point_times import PointClock
from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.localization.fusion.odometry import Motion, plausible_motion
from crossloc3d_ros.types import Float32Array, Float64Array, Scan

_KNOT_S = 0.0125
"""Odometry is asked so often: at 120 degrees a second a point 100 m away is interpolated to 1 cm."""

_STEADY_NS = 500_000_000


class MotionSource(Protocol):
    """What measures how the base moves."""

    def motion(self, from_ns: int, to_ns: int) -> Motion:
        """Return how the base moved between two stamps."""


class SteadyMotion:
    """The motion that goes on as over the last half second, for odometry whose single steps are rough.

    KISS-ICP knows the turn at hand only afterwards, and from one scan to the next it errs by centimetres.
    """

    def __init__(self, source: MotionSource) -> None:
        """Continue the motion of `source`."""
        self._source = source

    def motion(self, from_ns: int, to_ns: int) -> Motion:
        """Return how the base moves between two stamps, by its motion before the first; unknown where that is."""
        before = self._source.motion(from_ns - _STEADY_NS, from_ns)
        if not before.is_known:
            return before
        share = (to_ns - from_ns) / _STEADY_NS
        forward, left, turn = before.delta
        # Along an arc: the chord of a part of it is shorter, and turned by less of the angle.
        direction = math.atan2(left, forward) - 0.5 * turn + 0.5 * share * turn
        chord_m = share * math.hypot(forward, left)
        delta = np.array([chord_m * math.cos(direction), chord_m * math.sin(direction), share * turn])
        return replace(before, delta=delta, covariance=share**2 * before.covariance)


class MotionCompensation:
    """Bring the points of scans to the moment of their stamps, and say whether that was possible."""

    def __init__(self, config: LocalizerConfig) -> None:
        """Know nothing yet of the clouds' times; compile, so that the first scan is as fast as the others."""
        self.reconfigure(config)
        self.words = ""
        """For people: what was done with the last scan, and why not more."""
        one = np.zeros((1, 3), np.float32)
        deskew(one, one[:, 0].copy(), np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)), np.eye(4), config.scan)

    def reconfigure(self, config: LocalizerConfig) -> None:
        """Use other settings from the next scan on; the clouds' times are judged anew."""
        self._config = config
        self._clock = PointClock(config.scan.period_s, config.scan.stamped_at)

    def needs_motion(self, scan: Scan) -> bool:
        """Return whether the motion of a scan's turn would be used."""
        return scan.times is not None and self._config.scan.deskew != "off"

    def __call__(self, scan: Scan, T_base_lidar: Float64Array, source: MotionSource | None) -> Scan:
        """Return the scan at the moment of its stamp; as it is where times or motion are missing or `deskew` is off."""
        if self._config.scan.deskew == "off":
            return self._left(scan, "scan.deskew is off")
        times = self._clock.read(scan)
        if times.seconds is None:
            return self._left(scan, times.reason)
        if source is None:
            return self._left(scan, "there is no odometry")
        path = self._path(scan.stamp_ns, times.seconds, source)
        if isinstance(path, str):
            return self._left(scan, path)
        self.words = f"compensated: {times.words}"
        points = deskew(scan.points, times.seconds, *path, T_base_lidar, self._config.scan)
        return replace(scan, points=points, times=None, is_at_stamp=True)

    def _left(self, scan: Scan, why: str) -> Scan:
        self.words = f"not compensated: {why}"
        return scan

    def _path(
        self, stamp_ns: int, times_s: Float32Array, source: MotionSource
    ) -> tuple[Float64Array, Float64Array] | str:
        """Return times (K,), seconds from the stamp, and the poses (K, 4, 4) of the base in its frame at the stamp.

        Or why these are not known.
        """
        first_s, last_s = float(np.nanmin(times_s)), float(np.nanmax(times_s))
        knots_s = np.linspace(first_s, max(last_s, first_s + 1e-3), max(2, math.ceil((last_s - first_s) / _KNOT_S) + 1))
        poses = np.tile(np.eye(4), (len(knots_s), 1, 1))
        for T, knot_s in zip(poses, knots_s, strict=True):
            since_ns = 1000 * round(knot_s * 1e6)  # float32 keeps no nanoseconds of a tenth of a second
            if since_ns == 0:
                continue
            begin_ns, end_ns = sorted((stamp_ns, stamp_ns + since_ns))
            motion = plausible_motion(source.motion(begin_ns, end_ns), abs(knot_s), self._config.fusion)
            if not motion.is_known:
                return motion.reason
            T[:] = _pose(motion.delta) if since_ns > 0 else np.linalg.inv(_pose(motion.delta))
        return knots_s, poses


def _pose(delta: Float64Array) -> Float64Array:
    """Return forward, left and turn as a pose (4, 4)."""
    T = np.eye(4)
    cosine, sine = math.cos(delta[2]), math.sin(delta[2])
    T[:2, :2] = [[cosine, -sine], [sine, cosine]]
    T[:2, 3] = delta[:2]
    return T
