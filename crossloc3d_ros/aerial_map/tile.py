"""One tile of the map: points in, rasters, submaps and descriptors out. Tiles do not need one another's results."""

from __future__ import annotations

import dataclasses
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import ndimage

from crossloc3d_ros.aerial_map.coverage import FLOWN_REACH_M, TileCoverage, tile_coverage
from crossloc3d_ros.aerial_map.spool import TileKey, read_points, tile_bounds
from crossloc3d_ros.aerial_map.store import SUBMAP_DTYPE, GroundMethod
from crossloc3d_ros.clouds.raster import Bounds, Raster, count_raster, lowest_raster, surface_raster, terrain_raster
from crossloc3d_ros.clouds.survey_ground import classify_ground
from crossloc3d_ros.clouds.tiling import SubmapCutter, submap_centres
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.formats.las import GROUND
from crossloc3d_ros.stopwatch import Stopwatch
from crossloc3d_ros.types import BoolArray, DescriptorEncoder, Float32Array, Float64Array, UInt8Array

BATCH = 32
"""Patches encoded together: enough to keep the matrix products busy, few enough to stay in the caches."""

_MARGIN_M = 60.0
"""At least this much is looked at around a tile, so that ground and rasters are the same on both sides of an edge."""
_TERRAIN_REACH_M = 50.0
"""The terrain is continued this far where there are no points, such as canals, and no farther."""


@dataclass(frozen=True)
class TileTask:
    """One tile to be worked on."""

    key: TileKey
    sources: tuple[tuple[Path, TileKey, bool], ...]
    """Folder in the spool, tile, and whether that file is classified: of the tile and of those around it."""
    result: Path
    config: BuildConfig
    preprocessing: PreprocessingConfig


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
    coverage: TileCoverage = field(default_factory=TileCoverage)


@dataclass(frozen=True, eq=False)
class TileResult:
    """What a tile adds to the map."""

    report: TileReport
    submaps: np.ndarray[tuple[int], np.dtype[np.void]]
    """(K,) rows of SUBMAP_DTYPE."""
    submap_values: Float32Array
    """(K, D) descriptors, or (K, n, 3) patches where the submaps were only cut."""
    terrain: Float32Array
    """(H, W), row 0 in the north, the tile alone."""
    surface: Float32Array
    lowest: Float32Array
    support: Float32Array
    """Points of each cell."""


def margin_m(half_extent_m: float, cell_m: float) -> float:
    """Return how much is looked at around a tile, whole cells."""
    return math.ceil(max(half_extent_m + cell_m, _MARGIN_M) / cell_m) * cell_m


def build_tile(task: TileTask, encoder: DescriptorEncoder, advance: Callable[[int], None] | None = None) -> TileReport:
    """Cut the submaps of a tile, encode them and write the result file; `advance` counts the submaps."""
    return _make_tile(task, encoder.encode_batch, (encoder.descriptor_size,), advance or _ignore)


def cut_tile(task: TileTask, advance: Callable[[int], None] | None = None) -> TileReport:
    """Cut the submaps of a tile and write them with their patches; `advance` counts the submaps."""
    return _make_tile(task, np.stack, (task.preprocessing.n_points, 3), advance or _ignore)


def _ignore(_: int) -> None:
    """Count nothing."""


def _make_tile(
    task: TileTask,
    encode: Callable[[list[Float32Array]], Float32Array],
    shape: tuple[int, ...],
    advance: Callable[[int], None],
) -> TileReport:
    """Write what `encode` makes of the tile's patches, an array of `shape` each."""
    watch = Stopwatch()
    read = _read_points(task)
    read_s = watch.lap()
    is_ground, ground = ground_points(read.points, read.classes, read.is_classified)
    ground_s = watch.lap()
    layers = _Layers.of(read.points, is_ground, read.bounds, task.config.cell_m)
    heights = read.points[:, 2] - layers.terrain.sample(read.points[:, 0], read.points[:, 1])
    raster_s = watch.lap()
    cutter = SubmapCutter(np.column_stack([read.points[:, :2], heights]), task.preprocessing)
    centres, outside = _submap_centres(task, layers)
    advance(outside)
    cut_s, encode_s = watch.lap(), 0.0
    submaps: list[tuple[float, ...]] = []
    values = [np.empty((0, *shape), np.float32)]
    for start in range(0, len(centres), BATCH):
        batch = centres[start : start + BATCH]
        cut = [(centre, patch) for centre in batch if (patch := cutter.cut(centre[:2])) is not None]
        cut_s += watch.lap()
        if cut:
            values.append(encode([patch.points for _, patch in cut]))
        submaps += [(*centre.tolist(), patch.source_count) for centre, patch in cut]
        encode_s += watch.lap()
        advance(len(batch))
    terrain, surface, lowest, support = layers.of_tile(task)
    report = TileReport(
        key=task.key,
        submaps=len(submaps),
        too_few_points=len(centres) - len(submaps),
        outside_survey=outside,
        ground=ground,
        data_bounds=_data_bounds(surface, tile_bounds(task.key, task.config.tile_m), task.config.cell_m),
        times=TileTimes(read_s, ground_s, raster_s, cut_s, encode_s),
        coverage=layers.coverage(task),
    )
    rasters = (terrain, surface, lowest, support)
    write_result(task.result, TileResult(report, np.array(submaps, SUBMAP_DTYPE), np.concatenate(values), *rasters))
    return report


@dataclass(frozen=True, eq=False)
class _TilePoints:
    """The points of a tile and of the margin around it."""

    bounds: Bounds
    points: Float64Array
    """(N, 3) map's CRS, metres."""
    classes: UInt8Array
    is_classified: BoolArray
    """(N,) whether the file of each point is classified."""


@dataclass(frozen=True, eq=False)
class _Layers:
    """The rasters of a tile and of the margin around it."""

    terrain: Raster
    surface: Raster
    lowest: Raster
    support: Raster
    distance_m: Float32Array
    """Of each cell to the nearest one that holds a point."""

    @classmethod
    def of(cls, points: Float64Array, is_ground: BoolArray, bounds: Bounds, cell_m: float) -> _Layers:
        surface = surface_raster(points, bounds, cell_m)
        return cls(
            terrain_raster(points, is_ground, bounds, cell_m),
            surface,
            lowest_raster(points, bounds, cell_m),
            count_raster(points, bounds, cell_m),
            distance_to_points(surface),
        )

    def of_tile(self, task: TileTask) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
        """Return terrain, surface, lowest echoes and support without the margin, the terrain as far as it is known."""
        within = _inner_cells(self.surface, tile_bounds(task.key, task.config.tile_m))
        known = np.where(self.distance_m <= _TERRAIN_REACH_M, self.terrain.values, np.float32(np.nan))
        layers = (self.surface, self.lowest, self.support)
        surface, lowest, support = (layer.values[within] for layer in layers)
        return known[within], surface, lowest, support

    def coverage(self, task: TileTask) -> TileCoverage:
        """Measure how the tile is covered."""
        within = _inner_cells(self.surface, tile_bounds(task.key, task.config.tile_m))
        highest_m = self.surface.values - self.terrain.values
        return tile_coverage(self.support.values, self.distance_m, highest_m, within, task.config.cell_m)


def _read_points(task: TileTask) -> _TilePoints:
    west, south, east, north = tile_bounds(task.key, task.config.tile_m)
    margin = margin_m(task.preprocessing.half_extent_m, task.config.cell_m)
    bounds = (west - margin, south - margin, east + margin, north + margin)
    points, classes, source = read_points([s[:2] for s in task.sources], bounds, task.config.tile_m)
    return _TilePoints(bounds, points, classes, np.array([s[2] for s in task.sources], dtype=bool)[source])


def _submap_centres(task: TileTask, layers: _Layers) -> tuple[Float64Array, int]:
    """Return easting, northing and ground height (K, 3) of the centres inside the survey; how many lie outside."""
    config, half_extent_m = task.config, task.preprocessing.half_extent_m
    centres = submap_centres(tile_bounds(task.key, config.tile_m), config.spacing_m)
    heights_m = ground_heights(layers.terrain, centres)
    inside = coverage(layers.distance_m, layers.surface, centres, half_extent_m) >= config.min_coverage
    inside &= np.isfinite(heights_m)
    return np.column_stack([centres, heights_m])[inside], int((~inside).sum())


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
            submap_values=result.submap_values,
            terrain=result.terrain,
            surface=result.surface,
            lowest=result.lowest,
            support=result.support,
        )


def read_result(path: Path) -> TileResult:
    """Return a tile's result."""
    with np.load(path, allow_pickle=False) as file:
        return TileResult(
            report=_report(file["report"]),
            submaps=file["submaps"],
            submap_values=file["submap_values"],
            terrain=file["terrain"],
            surface=file["surface"],
            lowest=file["lowest"],
            support=file["support"],
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
    coverage = values["coverage"]
    values["coverage"] = TileCoverage(**{**coverage, "densities": tuple(coverage["densities"])})
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
    flown = (distance_m <= FLOWN_REACH_M).astype(np.float32)
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
