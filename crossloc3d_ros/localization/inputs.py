"""Checks of what is handed over from outside, before it can change anything."""

from __future__ import annotations

from typing import Any

import numpy as np

from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.types import Float64Array


def float_array(values: Any, shape: tuple[int, ...] | None, name: str) -> Float64Array:
    """Return an own copy of the values as floats; PoseError where they are no numbers, or of another shape."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PoseError(f"{name} must be numbers, got {values!r}") from error
    if shape is not None and array.shape != shape:
        raise PoseError(f"{name} must have the shape {shape}, got {array.shape}")
    return array


def check_stamp(stamp_ns: Any, name: str) -> None:
    """Raise PoseError where a stamp is no integer, nanoseconds: times are compared, and one NaN would halt them."""
    if not isinstance(stamp_ns, (int, np.integer)) or isinstance(stamp_ns, bool):
        raise PoseError(f"{name} must be an integer, nanoseconds, got {stamp_ns!r}")
