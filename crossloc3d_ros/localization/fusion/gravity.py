"""The direction of gravity, from an accelerometer."""

from __future__ import annotations

import math

import numpy as np

from crossloc3d_ros.localization.inputs import check_stamp
from crossloc3d_ros.types import Float64Array

PLAUSIBLE_MPS2 = (5.0, 15.0)
"""An accelerometer at rest shows 9.8; what lies outside is a shock, another unit or a broken sensor."""
STALE_NS = 1_000_000_000
"""A mean without samples for so long is no longer valid: the robot may have tilted."""


def is_gravity(acceleration: Float64Array) -> bool:
    """Return whether a specific force (3,), m/s2, can be that of gravity; one that is not a number cannot."""
    low, high = PLAUSIBLE_MPS2
    return np.shape(acceleration) == (3,) and low <= float(np.linalg.norm(acceleration)) <= high


class GravityFilter:
    """Low-pass a stream of specific forces (m/s2, base frame, +z up at rest) into the direction that points up."""

    def __init__(self, time_constant_s: float) -> None:
        self._time_constant_ns = time_constant_s * 1e9
        self._mean: Float64Array | None = None
        self._stamp_ns = 0

    def reset(self) -> None:
        """Forget everything seen so far."""
        self._mean = None

    def update(self, stamp_ns: int, acceleration: Float64Array) -> bool:
        """Take in one sample (3,) and return whether it was plausible; a stamp that goes backwards starts anew."""
        check_stamp(stamp_ns, "the stamp of an acceleration")
        if not is_gravity(acceleration):
            return False
        elapsed_ns = stamp_ns - self._stamp_ns
        if self._mean is None or not 0 <= elapsed_ns <= STALE_NS:
            self._mean = np.asarray(acceleration, dtype=np.float64)
        else:
            gain = 1.0 - math.exp(-elapsed_ns / self._time_constant_ns)
            self._mean = self._mean + gain * (acceleration - self._mean)
        self._stamp_ns = stamp_ns
        return True

    def up(self, stamp_ns: int) -> Float64Array | None:
        """Return the unit vector (3,) that points up in the base frame; None without a recent sample."""
        if self._mean is None or abs(stamp_ns - self._stamp_ns) > STALE_NS:
            return None
        return np.asarray(self._mean / np.linalg.norm(self._mean))
