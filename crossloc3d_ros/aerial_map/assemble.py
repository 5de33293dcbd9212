"""From finished tiles to a map folder: index, table, rasters, manifest."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from crossloc3d_ros import __version__
from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.descriptor_map import write_descriptors
from crossloc3d_ros.aerial_map.geotiff import write_geotiff
from crossloc3d_ros.aerial_map.spool import TileKey, tile_bounds, tiles_touched
from crossloc3d_ros.aerial_map.store import BuildCounts, Manifest, SourceRecord
from crossloc3d_ros.aerial_map.tile import TileReport, TileResult, read_result
from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.files import sync
from crossloc3d_ros.types import DescriptorEncoder, Float32Array

_TILES_IN_MEMORY = 16


def write_map(
    folder: Path,
    tiles: Sequence[tuple[TileReport, Path]],
    *,
    crs: str,
    vertical_reference: str,
    geoid_separation_m: float | None,
    encoder: DescriptorEncoder,
    config: BuildConfig,
    counts: BuildCounts,
    sources: Sequence[SourceRecord],
    advance: Callable[[int], None],
) -> Manifest:
    """Write all files of the map into `folder`, which must not be in use, and return its manifest.

    `advance` is told of each file. Raises AerialDataError where no tile has a submap.
    """
    ordered = sorted(tiles, key=lambda item: (item[0].key[1], item[0].key[0]))
    count = sum(report.submaps for report, _ in ordered)
    if count == 0:
        raise AerialDataError(
            f"the area is empty: of its {counts.points_used:,} points nowhere at least "
            f"{encoder.preprocessing.min_points} stand above the ground within one submap; no map was made"
        )
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)

    def results() -> Iterator[TileResult]:
        for report, path in ordered:
            if report.submaps:
                yield read_result(path)

    write_descriptors(
        folder / store.DESCRIPTORS, (result.descriptors for result in results()), count, encoder.descriptor_size
    )
    advance(1)
    ground_heights = _write_submaps(folder / store.SUBMAPS, results(), count)
    advance(1)
    bounds = _union([report.data_bounds for report, _ in ordered if report.data_bounds is not None])
    rasters = _TileRasters({report.key: path for report, path in ordered}, config)
    write_geotiff(folder / store.TERRAIN, bounds, config.cell_m, crs, rasters.terrain, "terrain height")
    advance(1)
    write_geotiff(folder / store.SURFACE, bounds, config.cell_m, crs, rasters.surface, "surface height")
    advance(1)
    write_geotiff(folder / store.LOWEST, bounds, config.cell_m, crs, rasters.lowest, "lowest echo")
    advance(1)
    methods = {source.ground for source in sources}
    manifest = Manifest(
        crs=crs,
        origin=(
            float(round((bounds[0] + bounds[2]) / 2.0)),
            float(round((bounds[1] + bounds[3]) / 2.0)),
            round(float(np.median(ground_heights)), 1),
        ),
        bounds=bounds,
        vertical_reference=vertical_reference,
        geoid_separation_m=geoid_separation_m,
        encoder_fingerprint=encoder.fingerprint,
        descriptor_size=encoder.descriptor_size,
        preprocessing=encoder.preprocessing,
        build=config,
        ground=methods.pop() if len(methods) == 1 else "classes and filter",
        counts=counts,
        sources=tuple(sources),
        files=store.file_records(folder),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"crossloc3d_ros {__version__}",
    )
    store.write_manifest(folder, manifest)
    sync(folder)  # before the rename that publishes it
    return manifest


def _write_submaps(path: Path, results: Iterator[TileResult], count: int) -> Float32Array:
    """Write the table of submaps and return the ground heights (count,)."""
    heights = np.empty(count, dtype=np.float32)
    written = 0
    with path.open("wb") as file:
        header = {"descr": np.lib.format.dtype_to_descr(store.SUBMAP_DTYPE), "fortran_order": False, "shape": (count,)}
        np.lib.format.write_array_header_1_0(file, header)
        for result in results:
            file.write(result.submaps.tobytes())
            heights[written : written + len(result.submaps)] = result.submaps["ground_height"]
            written += len(result.submaps)
    return heights


class _TileRasters:
    """Gives any part of the rasters out of the tiles' results, of which it holds a few."""

    def __init__(self, paths: dict[TileKey, Path], config: BuildConfig) -> None:
        self._paths = paths
        self._config = config
        self._result = functools.lru_cache(maxsize=_TILES_IN_MEMORY)(read_result)

    def terrain(self, bounds: Bounds) -> Float32Array:
        return self._gather(bounds, "terrain")

    def surface(self, bounds: Bounds) -> Float32Array:
        return self._gather(bounds, "surface")

    def lowest(self, bounds: Bounds) -> Float32Array:
        return self._gather(bounds, "lowest")

    def _gather(self, bounds: Bounds, layer: str) -> Float32Array:
        cell_m, tile_m = self._config.cell_m, self._config.tile_m
        west, south, east, north = (round(v / cell_m) for v in bounds)
        values = np.full((north - south, east - west), np.nan, dtype=np.float32)
        for key in tiles_touched(bounds, tile_m):
            if key not in self._paths:
                continue
            tile: Float32Array = getattr(self._result(self._paths[key]), layer)
            t_west, t_south, t_east, t_north = (round(v / cell_m) for v in tile_bounds(key, tile_m))
            left, right = max(west, t_west), min(east, t_east)
            bottom, top = max(south, t_south), min(north, t_north)
            if left < right and bottom < top:
                values[north - top : north - bottom, left - west : right - west] = tile[
                    t_north - top : t_north - bottom, left - t_west : right - t_west
                ]
        return values


def _union(bounds: Sequence[Bounds]) -> Bounds:
    west, south, east, north = np.array(bounds).T
    return float(west.min()), float(south.min()), float(east.max()), float(north.max())
