"""One tile of the map: points in, rasters, submaps and descriptors out. Tiles do not need one another's results."""

from __future__ import annotations

import dataclasses
import json
import math
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import ndimage

from crossloc3d_ros.aerial_map.spool import TileKey, read_points, tile_bounds
from crossloc3d_ros.aerial_map.store import SUBMAP_DTYPE, GroundMethod
from crossloc3d_ros.clouds.ground import classify_ground
from crossloc3d_ros.clouds.raster import Bounds, Raster, lowest_raster, surface_raster, terrain_raster
from crossloc3d_ros.clouds.tiling import SubmapCutter, submap_centres
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.formats.las import GROUND
from crossloc3d_ros.types import BoolArray, DescriptorEncoder, Float32Array, Float64Array, Patch, UInt8Array

BATCH = 32
"""Patches encoded together: enough to keep the matrix products busy, few enough to stay in the caches."""

_MARGIN_M = 60.0
"""At least this much is looked at around a tile, so that ground and rasters are the same on both sides of an edge."""
_TERRAIN_REACH_M = 50.0
"""The terrain is carried this far over places without points, such as canals, and no farther."""
_FLOWN_REACH_M = 5.0
"""A cell this near to a point counts as flown over."""


@dataclass(frozen=True)
class TileTask:
    """One tile to be worked on."""

    key: TileKey
    sources: tuple[tuple[Path, TileKey, bool], ...]
    """Folder in the spool, tile, and whether that file is classified: of the tile and of those around it."""
    result: Path
    config: BuildConfig


@dataclass(frozen=True)
class TileTimes:
    """Seconds that each step of a tile took."""

    read_s: float = 0.0
    ground_s: float = 0.0
    raster_s: float = 0.0
    cut_s: float = 0.0
    encode_s: float = 0.0

    def __add__(self, other: TileTimes) -> TileTimes:
        sums = (a + b for a, b in zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True))
        return TileTimes(*sums)


@dataclass(frozen=True)
class TileReport:
    """What a tile came to."""

    key: TileKey
    submaps: int
    too_few_points: int
    outside_survey: int
    ground: GroundMethod
    data_bounds: Bounds | None
    """Bounds of the cells that hold points, None where there is none."""
    times: TileTimes = field(default_factory=TileTimes)


@dataclass(frozen=True, eq=False)
class TileResult:
    """What a tile adds to the map."""

    report: TileReport
    submaps: np.ndarray[tuple[int], np.dtype[np.void]]
    """(K,) rows of SUBMAP_DTYPE."""
    descriptors: Float32Array
    """(K, D)."""
    terrain: Float32Array
    """(H, W), row 0 in the north, the tile alone."""
    surface: Float32Array
    lowest: Float32Array


def margin_m(half_extent_m: float, cell_m: float) -> float:
    """Return how much is looked at around a tile, whole cells."""
    return math.ceil(max(half_extent_m + cell_m, _MARGIN_M) / cell_m) * cell_m


def build_tile(task: TileTask, encoder: DescriptorEncoder, advance: Callable[[int], None] | None = None) -> TileReport:
    """Work on one tile and write its result file; `advance` is told of submaps as they are done."""
    config, preprocessing = task.config, encoder.preprocessing
    inner = tile_bounds(task.key, config.tile_m)
    margin = margin_m(preprocessing.half_extent_m, config.cell_m)
    outer = (inner[0] - margin, inner[1] - margin, inner[2] + margin, inner[3] + margin)

    started = time.perf_counter()
    points, classes, source = read_points([s[:2] for s in task.sources], outer, config.tile_m)
    read_at = time.perf_counter()
    is_ground, ground = ground_points(points, classes, np.array([s[2] for s in task.sources], dtype=bool)[source])
    ground_at = time.perf_counter()
    terrain = terrain_raster(points, is_ground, outer, config.cell_m)
    surface = surface_raster(points, outer, config.cell_m)
    lowest = lowest_raster(points, outer, config.cell_m)
    distance_m = distance_to_points(surface)
    heights = points[:, 2] - terrain.sample(points[:, 0], points[:, 1])
    raster_at = time.perf_counter()

    cutter = SubmapCutter(np.column_stack([points[:, :2], heights]), preprocessing)
    centres = submap_centres(inner, config.spacing_m)
    covered = coverage(distance_m, surface, centres, preprocessing.half_extent_m) >= config.min_coverage
    heights_m = ground_heights(terrain, centres)
    covered &= np.isfinite(heights_m)
    if advance is not None:
        advance(int((~covered).sum()))
    cut_s = time.perf_counter() - raster_at
    encode_s = 0.0
    places, descriptors = [], [np.empty((0, encoder.descriptor_size), np.float32)]
    inside = np.flatnonzero(covered)
    for start in range(0, len(inside), BATCH):
        batch = inside[start : start + BATCH]
        cut_from = time.perf_counter()
        cut = [(i, cutter.cut(centres[i])) for i in batch]
        patches: list[tuple[int, Patch]] = [(int(i), patch) for i, patch in cut if patch is not None]
        encode_from = time.perf_counter()
        if patches:
            descriptors.append(encoder.encode_batch([patch.points for _, patch in patches]))
        for i, patch in patches:
            places.append((centres[i, 0], centres[i, 1], heights_m[i], patch.source_count))
        cut_s += encode_from - cut_from
        encode_s += time.perf_counter() - encode_from
        if advance is not None:
            advance(len(batch))

    within = _inner_cells(surface, inner)
    known = np.where(distance_m <= _TERRAIN_REACH_M, terrain.values, np.float32(np.nan))
    report = TileReport(
        key=task.key,
        submaps=len(places),
        too_few_points=len(inside) - len(places),
        outside_survey=int((~covered).sum()),
        ground=ground,
        data_bounds=_data_bounds(surface.values[within], inner, config.cell_m),
        times=TileTimes(read_at - started, ground_at - read_at, raster_at - ground_at, cut_s, encode_s),
    )
    write_result(
        task.result,
        TileResult(
            report=report,
            submaps=np.array(places, dtype=SUBMAP_DTYPE),
            descriptors=np.concatenate(descriptors),
            terrain=known[within],
            surface=surface.values[within],
            lowest=lowest.values[within],
        ),
    )
    return report


def ground_points(
    points: Float64Array, classes: UInt8Array, is_classified: BoolArray
) -> tuple[BoolArray, GroundMethod]:
    """Return which points (N,) are ground, and how that was found.

    Points of classified files count by their class 2. The others, or all where no class 2 is in sight (the middle of
    a forest, a block of houses), go through the filter.
    """
    by_class = is_classified & (classes == GROUND)
    if is_classified.all() and (by_class.any() or len(points) == 0):
        return by_class, "classes"
    unclassified = ~is_classified if by_class.any() else np.ones(len(points), dtype=bool)
    mask = by_class.copy()
    mask[unclassified] = classify_ground(points[unclassified])
    return mask, "classes and filter" if by_class.any() else "filter"


def write_result(path: Path, result: TileResult) -> None:
    """Write a tile's result; it appears under its name when it is whole."""
    with atomic_path(path, None) as partial, partial.open("wb") as file:
        np.savez(
            file,
            report=np.frombuffer(json.dumps(dataclasses.asdict(result.report)).encode(), dtype=np.uint8),
            submaps=result.submaps,
            descriptors=result.descriptors,
            terrain=result.terrain,
            surface=result.surface,
            lowest=result.lowest,
        )


def read_result(path: Path) -> TileResult:
    """Return a tile's result."""
    with np.load(path, allow_pickle=False) as file:
        return TileResult(
            report=_report(file["report"]),
            submaps=file["submaps"],
            descriptors=file["descriptors"],
            terrain=file["terrain"],
            surface=file["surface"],
            lowest=file["lowest"],
        )


def read_report(path: Path) -> TileReport | None:
    """Return what a tile came to in an earlier run, or None where it has to be done (again)."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return _report(file["report"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None


def _report(encoded: UInt8Array) -> TileReport:
    values = json.loads(encoded.tobytes())
    values["key"] = tuple(values["key"])
    values["data_bounds"] = tuple(values["data_bounds"]) if values["data_bounds"] else None
    values["times"] = TileTimes(**values["times"])
    return TileReport(**values)


def distance_to_points(surface: Raster) -> Float32Array:
    """Return each cell's distance to the nearest cell that holds a point, metres; infinite where there is none."""
    empty = np.isnan(surface.values)
    if empty.all():
        return np.full(empty.shape, np.inf, dtype=np.float32)
    distance = ndimage.distance_transform_edt(empty)
    return np.asarray(distance * surface.cell_m, dtype=np.float32)


def coverage(distance_m: Float32Array, surface: Raster, centres: Float64Array, half_extent_m: float) -> Float64Array:
    """Return the share (M,) of each submap's square that was flown over."""
    side = max(1, round(2.0 * half_extent_m / surface.cell_m))
    flown = (distance_m <= _FLOWN_REACH_M).astype(np.float32)
    share = ndimage.uniform_filter(flown, size=side, mode="constant")
    columns = np.floor((centres[:, 0] - surface.west_m) / surface.cell_m).astype(int)
    rows = np.floor((surface.north_m - centres[:, 1]) / surface.cell_m).astype(int)
    return np.asarray(share[rows, columns], dtype=np.float64)


def ground_heights(terrain: Raster, centres: Float64Array) -> Float64Array:
    """Return the ground's height (M,) at centres (M, 2), NaN beyond the raster."""
    return np.asarray(terrain.sample(centres[:, 0], centres[:, 1]), dtype=np.float64)


def _inner_cells(surface: Raster, inner: Bounds) -> tuple[slice, slice]:
    """Return the rows and columns of the tile without its margin."""
    row = round((surface.north_m - inner[3]) / surface.cell_m)
    column = round((inner[0] - surface.west_m) / surface.cell_m)
    height = round((inner[3] - inner[1]) / surface.cell_m)
    width = round((inner[2] - inner[0]) / surface.cell_m)
    return slice(row, row + height), slice(column, column + width)


def _data_bounds(surface: Float32Array, inner: Bounds, cell_m: float) -> Bounds | None:
    rows, columns = np.nonzero(~np.isnan(surface))
    if len(rows) == 0:
        return None
    west, north = inner[0], inner[3]
    return (
        west + float(columns.min()) * cell_m,
        north - float(rows.max() + 1) * cell_m,
        west + float(columns.max() + 1) * cell_m,
        north - float(rows.min()) * cell_m,
    )
