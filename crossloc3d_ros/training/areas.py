"""Areas to learn from, to validate and to test on: no two of them see a square metre in common."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.types import Float64Array

TRAINING, VALIDATION, TEST = "train", "validation", "test"
NONE = ""
"""The role of what lies across a border: its surroundings reach into two areas."""

_BORDER_SHARES = np.linspace(0.025, 0.975, 39)

Roles = npt.NDArray[np.str_]


@dataclass(frozen=True)
class Areas:
    """Rectangles to validate and to test on; everything else is to learn from."""

    boxes: tuple[tuple[str, Bounds], ...]
    """Role and west, south, east, north in metres; infinite where there is no border."""

    def __post_init__(self) -> None:
        """Refuse rectangles that are none or that overlap."""
        for role, (west, south, east, north) in self.boxes:
            if role not in (VALIDATION, TEST) or not (west < east and south < north):
                raise DatasetError(
                    f"the {role} area {(west, south, east, north)} is no rectangle west, south, east, north"
                )
        for (first, a), (second, b) in itertools.combinations(self.boxes, 2):
            if a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]:
                raise DatasetError(f"the {first} area {a} and the {second} area {b} overlap")

    def roles(self, xy_m: Float64Array, reach_m: float) -> Roles:
        """Return the role (N,) of places (N, 2) that see the square of `reach_m` around them; '' across a border."""
        roles = np.full(len(xy_m), TRAINING, dtype="<U10")
        low, high = xy_m - reach_m, xy_m + reach_m
        for role, (west, south, east, north) in self.boxes:
            corner, opposite = np.array([west, south]), np.array([east, north])
            inside = ((low >= corner) & (high <= opposite)).all(axis=1)
            touching = ((high > corner) & (low < opposite)).all(axis=1)
            roles[touching] = NONE
            roles[inside] = role
        return roles

    def to_json(self) -> list[dict[str, Any]]:
        """Return the rectangles for JSON, null where there is no border."""
        return [
            {"role": role, "west_south_east_north": [v if math.isfinite(v) else None for v in box]}
            for role, box in self.boxes
        ]


def cut_areas(xy_m: Float64Array, reach_m: float, shares: Mapping[str, float]) -> Areas:
    """Return adjacent areas with about `shares` of the scans (N, 2), each of which reaches `reach_m` around it.

    The borders run north-south or east-west, in the order of areas and at the places that leave the area that comes off
    worst the most of its share, and then the fewest scans across a border. Raises DatasetError where every cut leaves
    an area without a scan.
    """
    wanted = [role for role in (TRAINING, VALIDATION, TEST) if shares.get(role, 0.0) > 0.0]
    best: tuple[float, int] = (0.0, 0)
    chosen: Areas | None = None
    for axis in (0, 1):
        along = np.sort(xy_m[:, axis])
        inner = np.unique(np.round(np.quantile(along, _BORDER_SHARES), 1)) if len(along) else np.empty(0)
        borders = np.array([-math.inf, *inner, math.inf])
        first = np.searchsorted(along, borders + reach_m, side="left")
        last = np.searchsorted(along, borders - reach_m, side="right")
        between = np.maximum(last[None, :] - first[:, None], 0).tolist()
        for cut in itertools.combinations(range(1, len(borders) - 1), len(wanted) - 1):
            at = (0, *cut, len(borders) - 1)
            counts = [between[low][high] for low, high in itertools.pairwise(at)]
            if not all(counts):
                continue
            for order in itertools.permutations(wanted):
                full = min(
                    min(1.0, count / (shares[role] * len(along))) for role, count in zip(order, counts, strict=True)
                )
                if (round(full, 2), sum(counts)) > best:
                    best = round(full, 2), sum(counts)
                    chosen = _side_by_side(axis, order, [float(borders[i]) for i in at])
    if chosen is None:
        extent = np.ptp(xy_m, axis=0) if len(xy_m) else np.zeros(2)
        raise DatasetError(
            f"{len(xy_m):,} scans over {extent[0]:.0f} x {extent[1]:.0f} m cannot be split into areas to "
            f"{_and(wanted)} that are {2 * reach_m:.0f} m apart: record more, give a share of 0 to an area that is not "
            "needed, or name the areas"
        )
    return chosen


def _side_by_side(axis: int, order: Sequence[str], borders: Sequence[float]) -> Areas:
    boxes: list[tuple[str, Bounds]] = []
    for role, low, high in zip(order, borders[:-1], borders[1:], strict=True):
        if role != TRAINING:
            boxes.append((role, (low, -math.inf, high, math.inf) if axis == 0 else (-math.inf, low, math.inf, high)))
    return Areas(tuple(boxes))


def _and(roles: Sequence[str]) -> str:
    names = {TRAINING: "learn from", VALIDATION: "validate on", TEST: "test on"}
    return " and ".join(names[role] for role in roles)
