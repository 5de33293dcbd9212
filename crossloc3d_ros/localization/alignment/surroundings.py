"""The poses around a pose at which its score is compared: the local null hypothesis of the alignment."""

from __future__ import annotations

import math

import numpy as np

from crossloc3d_ros.types import Float64Array

# Radii, metres: from where the peak of a right pose has ended to the width of a street and its houses.
_RADII_M = (8.0, 16.0, 30.0)
_DIRECTIONS = 8
_TURNS = 16
_NO_TURN_RAD = 0.35  # nearer to the pose's own heading the score is still that of the pose


def _shifts() -> Float64Array:
    """Return (n, 3) shifts in all directions; the rings are rotated against each other, so that no two are in line."""
    angles = [
        2.0 * math.pi * (k + ring / len(_RADII_M)) / _DIRECTIONS
        for ring in range(len(_RADII_M))
        for k in range(_DIRECTIONS)
    ]
    radii = np.repeat(_RADII_M, _DIRECTIONS)
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles), np.zeros(len(radii))])


SHIFTED = _shifts()
"""Poses around a pose, in its heading: metres east and north, and radians."""
_GOLDEN_RAD = math.pi * (3.0 - math.sqrt(5.0))  # multiples of it are spread evenly, whatever their number
TURNED = SHIFTED[::2] + np.column_stack(
    [np.zeros((len(SHIFTED[::2]), 2)), np.pi / 2 + _GOLDEN_RAD * np.arange(len(SHIFTED[::2])) % np.pi]
)
"""Every second of these places in another heading, at least a right angle away: a coarser measure for the search."""
SPUN = np.column_stack([np.zeros((_TURNS, 2)), np.linspace(_NO_TURN_RAD, 2.0 * math.pi - _NO_TURN_RAD, _TURNS)])
"""The pose turned in place."""
