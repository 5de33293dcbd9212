"""Submaps of an aerial survey: where their centres lie and the patch at each."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.clouds.filters import check_points
from crossloc3d_ros.clouds.patch import crop_above_ground, patch_of_cropped
from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array, Patch

_BIN_M = 5.0  # a submap reads whole bins: small beside it, and many points each
_MOST_BINS = 4_000_000  # bounds the memory where stray points stretch the area
_FARTHEST_M = 4e7  # the circumference of the Earth: beyond it is no coordinate


def submap_centres(bounds: tuple[float, float, float, float], spacing_m: float) -> Float64Array:
    """Return the centres (M, 2) easting, northing inside `bounds` (min_e, min_n, max_e, max_n), metres.

    They lie on the global grid of multiples of `spacing_m`. The upper bounds are exclusive, so that tiles that share
    an edge never share a centre. South to north, west to east within a row.
    """
    min_e, min_n, max_e, max_n = bounds
    if not all(map(math.isfinite, bounds)) or not spacing_m > 0:
        raise CloudError(f"bounds {bounds} and spacing {spacing_m} m do not span a grid")

    def axis(low: float, high: float) -> Float64Array:
        return np.arange(math.ceil(low / spacing_m), math.ceil(high / spacing_m), dtype=np.float64) * spacing_m

    northing, easting = np.meshgrid(axis(min_n, max_n), axis(min_e, max_e), indexing="ij")
    return np.column_stack([easting.ravel(), northing.ravel()])


def cut_submap(points: Float64Array, centre: npt.ArrayLike, preprocessing: PreprocessingConfig) -> Patch | None:
    """Return the patch around `centre` (2,), or None where too few points stand above the ground.

    Points (N, 3): easting, northing, height above the ground, metres. For many centres use `SubmapCutter`, which
    returns the same patches.
    """
    check_points(points)
    centre_en = _as_centre(centre)
    around = np.empty((len(points), 3), np.float32)
    # float64 until the centre is subtracted: a UTM northing in float32 has steps of half a metre.
    around[:, :2] = points[:, :2] - centre_en
    around[:, 2] = points[:, 2]
    return _patch_around(around, preprocessing)


class SubmapCutter:
    """Cuts many overlapping submaps out of one tile, whose points are sorted into bins once.

    Points (N, 3): easting, northing, height above the ground, metres; not kept, only sorted copies are.
    Safe to use from several threads.
    """

    def __init__(self, points: Float64Array, preprocessing: PreprocessingConfig) -> None:
        check_points(points)
        self._preprocessing = preprocessing
        clearance = preprocessing.ground_clearance_m
        # Compared in float32, as the crop will do, or a point on the edge would be kept there and lost here.
        lowest = np.float32(clearance if clearance > 0 else -np.inf)
        bounds = _bounds(points, lowest)
        self._origin = np.array(bounds[:2])
        span = np.array(bounds[2:]) - bounds[:2]
        self._bin_m = max(_BIN_M, float(np.sqrt(span[0] * span[1] / _MOST_BINS)), float(span.max()) / _MOST_BINS)
        self._columns, self._rows = (int(v) + 1 for v in span // self._bin_m)
        self._points, self._starts = _sort_into_bins(
            points, lowest, self._origin, self._bin_m, self._columns, self._rows
        )

    def cut(self, centre: npt.ArrayLike) -> Patch | None:
        """Return the patch around `centre` (2,) easting, northing, or None where too few points stand there."""
        around = _gather(
            self._points, self._starts, self._origin, self._bin_m, self._columns, self._rows,
            _as_centre(centre), self._preprocessing.half_extent_m,
        )  # fmt: skip
        return _patch_around(around, self._preprocessing)


def _as_centre(centre: npt.ArrayLike) -> Float64Array:
    centre_en = np.asarray(centre, dtype=np.float64)
    if centre_en.shape != (2,) or not np.isfinite(centre_en).all():
        raise CloudError(f"a submap's centre must be two finite numbers, got {centre!r}")
    return centre_en


def _patch_around(around: Float32Array, preprocessing: PreprocessingConfig) -> Patch | None:
    half_extent_m = preprocessing.half_extent_m
    cropped = crop_above_ground(around, half_extent_m, preprocessing)
    origin = "bounding_box" if preprocessing.submap_origin == "bounding_box" else "given"
    return patch_of_cropped(cropped, half_extent_m, preprocessing, origin=origin)  # type: ignore[arg-type]


@njit(cache=True, nogil=True)
def _may_stand(points: Float64Array, i: int, lowest: float) -> bool:
    """Return whether a point can be in any submap; no map grid reaches farther than the earth's girth."""
    inside = abs(points[i, 0]) < _FARTHEST_M and abs(points[i, 1]) < _FARTHEST_M
    return bool(inside and np.isfinite(points[i, 2]) and np.float32(points[i, 2]) >= lowest)


@njit(cache=True, nogil=True)
def _bounds(points: Float64Array, lowest: float):  # type: ignore[no-untyped-def]
    """Return min easting, min northing, max easting, max northing of the points that count; zeros without any."""
    west, south, east, north = np.inf, np.inf, -np.inf, -np.inf
    for i in range(points.shape[0]):
        if _may_stand(points, i, lowest):
            west, east = min(west, points[i, 0]), max(east, points[i, 0])
            south, north = min(south, points[i, 1]), max(north, points[i, 1])
    if west > east:
        return 0.0, 0.0, 0.0, 0.0
    return west, south, east, north


@njit(cache=True, nogil=True)
def _sort_into_bins(  # type: ignore[no-untyped-def]
    points: Float64Array, lowest: float, origin: Float64Array, bin_m: float, columns: int, rows: int
):
    """Return the points that count in the order of their bins (row by row) and where each bin starts."""
    n = points.shape[0]
    bins = np.full(n, -1, np.int64)
    starts = np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        if _may_stand(points, i, lowest):
            column = min(columns - 1, int((points[i, 0] - origin[0]) / bin_m))
            row = min(rows - 1, int((points[i, 1] - origin[1]) / bin_m))
            bins[i] = row * columns + column
            starts[bins[i] + 1] += 1
    for b in range(columns * rows):
        starts[b + 1] += starts[b]
    ordered = np.empty((starts[-1], 3))
    cursor = starts[:-1].copy()
    for i in range(n):
        if bins[i] >= 0:
            place = cursor[bins[i]]
            cursor[bins[i]] += 1
            for axis in range(3):
                ordered[place, axis] = points[i, axis]
    return ordered, starts


@njit(cache=True, nogil=True)
def _gather(
    points: Float64Array, starts: Int64Array, origin: Float64Array, bin_m: float, columns: int, rows: int,
    centre: Float64Array, half_extent: float,
) -> Float32Array:  # fmt: skip
    """Copy the points of all bins that the square touches, centred and in float32."""
    reach = half_extent + 1e-3  # the crop decides about the edge in float32, after the subtraction
    first_column = max(0, int(np.floor((centre[0] - reach - origin[0]) / bin_m)))
    last_column = min(columns - 1, int(np.floor((centre[0] + reach - origin[0]) / bin_m)))
    first_row = max(0, int(np.floor((centre[1] - reach - origin[1]) / bin_m)))
    last_row = min(rows - 1, int(np.floor((centre[1] + reach - origin[1]) / bin_m)))
    total = 0
    if first_column <= last_column:
        for row in range(first_row, last_row + 1):
            total += starts[row * columns + last_column + 1] - starts[row * columns + first_column]
    around = np.empty((total, 3), np.float32)
    place = 0
    if total > 0:
        for row in range(first_row, last_row + 1):
            for i in range(starts[row * columns + first_column], starts[row * columns + last_column + 1]):
                around[place, 0] = points[i, 0] - centre[0]
                around[place, 1] = points[i, 1] - centre[1]
                around[place, 2] = points[i, 2]
                place += 1
    return around
