"""Angles on the circle."""

from __future__ import annotations

import math
from typing import overload

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.types import Float64Array


@overload
def wrap(angle_rad: float) -> float: ...
@overload
def wrap(angle_rad: Float64Array) -> Float64Array: ...
def wrap(angle_rad: float | npt.NDArray[np.float64]) -> float | Float64Array:
    """Return the angle, or each angle of an array, in [-pi, pi), radians."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi
