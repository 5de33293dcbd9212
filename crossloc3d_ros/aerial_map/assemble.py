"""From finished tiles to a map folder: index, table, rasters, manifest."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from crossloc3d_ros import __version__
from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.coverage import Coverage, survey_coverage
from crossloc3d_ros.aerial_map.descriptor_map import write_descriptors
from crossloc3d_ros.aerial_map.geotiff import write_geotiff
from crossloc3d_ros.aerial_map.spool import TileKey, tile_bounds, tiles_touched
from crossloc3d_ros.aerial_map.store import BuildCounts, GroundMethod, Manifest, SourceRecord
from crossloc3d_ros.aerial_map.survey import Survey
from crossloc3d_ros.aerial_map.tile import TileResult, read_result
from crossloc3d_ros.aerial_map.tiles import BuiltTiles
from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig
from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.files import sync
from crossloc3d_ros.types import DescriptorEncoder, Float32Array

_TILES_IN_MEMORY = 16


def write_map(
    folder: Path,
    survey: Survey,
    built: BuiltTiles,
    encoder: DescriptorEncoder,
    config: BuildConfig,
    geoid_separation_m: float | None,
    advance: Callable[[int], None],
) -> Manifest:
    """Write all files of the map into `folder`, which must not be in use, and return its manifest.

    `advance` counts the files. Raises AerialDataError where no tile has a submap.
    """
    counts = build_counts(built)
    coverage = survey_coverage(report.coverage for report in built.reports)
    check_submaps(counts, encoder.preprocessing, coverage)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    descriptors = (result.submap_values for result in results(built))
    write_descriptors(folder / store.DESCRIPTORS, descriptors, counts.submaps, encoder.descriptor_size)
    advance(1)
    ground_heights = write_submaps(folder / store.SUBMAPS, built, counts.submaps)
    advance(1)
    bounds = survey_bounds(built)
    _write_rasters(folder, built, bounds, survey.map_crs, config, advance)
    origin_height_m = round(float(np.median(ground_heights)), 1)
    manifest = _manifest(folder, survey, built, encoder, config, geoid_separation_m, bounds, origin_height_m)
    store.write_manifest(folder, manifest)
    sync(folder)  # before the rename that publishes it
    return manifest


def _manifest(
    folder: Path, survey: Survey, built: BuiltTiles, encoder: DescriptorEncoder, config: BuildConfig,
    geoid_separation_m: float | None, bounds: Bounds, origin_height_m: float,
) -> Manifest:  # fmt: skip
    sources = source_records(survey, built)
    methods = {source.ground for source in sources}
    return Manifest(
        crs=survey.map_crs,
        origin=(
            float(round((bounds[0] + bounds[2]) / 2.0)),
            float(round((bounds[1] + bounds[3]) / 2.0)),
            origin_height_m,
        ),
        bounds=bounds,
        vertical_reference=survey.vertical.name,
        geoid_separation_m=geoid_separation_m,
        encoder_fingerprint=encoder.fingerprint,
        descriptor_size=encoder.descriptor_size,
        preprocessing=encoder.preprocessing,
        build=config,
        ground=methods.pop() if len(methods) == 1 else "classes and filter",
        counts=build_counts(built),
        sources=tuple(sources),
        files=store.file_records(folder),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        software=f"crossloc3d_ros {__version__}",
        coverage=survey_coverage(report.coverage for report in built.reports),
        datum=survey.datum,
    )


def check_submaps(counts: BuildCounts, preprocessing: PreprocessingConfig, coverage: Coverage) -> None:
    """Raise AerialDataError where the survey has no submap, with what it has instead."""
    if counts.submaps == 0:
        raise AerialDataError(
            f"the area is empty: of its {counts.points_used:,} points nowhere at least "
            f"{preprocessing.min_points} stand above the ground within one submap ({_what_is_there(coverage)}); "
            "no map was made"
        )


def _what_is_there(coverage: Coverage) -> str:
    """Return how the survey covers the area, in half a sentence."""
    gaps = f", and {coverage.gap_share:.0%} of the area have no echo, as water" if coverage.gap_share > 0.2 else ""
    return f"{coverage.points_per_m2:.2g} points/m2{gaps}"


def results(built: BuiltTiles) -> Iterator[TileResult]:
    """Yield the results of the tiles that have submaps, row by row."""
    for report, path in sorted(built.tiles, key=lambda item: (item[0].key[1], item[0].key[0])):
        if report.submaps:
            yield read_result(path)


def survey_bounds(built: BuiltTiles) -> Bounds:
    """Return the bounds of all cells that hold points, in the map's CRS."""
    west, south, east, north = np.array([r.data_bounds for r in built.reports if r.data_bounds is not None]).T
    return float(west.min()), float(south.min()), float(east.max()), float(north.max())


def build_counts(built: BuiltTiles) -> BuildCounts:
    """Return what became of the survey's points and of the centres on the submaps' grid."""
    spooled, tiles, stray = built.spooled, built.reports, built.stray_points
    kept = sum(report.points_kept for report in spooled)
    return BuildCounts(
        points_in_files=sum(report.points_in_file for report in spooled),
        points_withheld=sum(report.points_withheld for report in spooled),
        points_noise=sum(report.points_noise for report in spooled),
        points_stray=sum(report.points_off_earth for report in spooled) + stray,
        points_used=kept - stray,
        tiles=len(tiles),
        submaps=sum(report.submaps for report in tiles),
        submaps_with_too_few_points=sum(report.too_few_points for report in tiles),
        submaps_outside_survey=sum(report.outside_survey for report in tiles),
    )


def source_records(survey: Survey, built: BuiltTiles) -> list[SourceRecord]:
    """Return the files that the tiles were made from, and where their ground points come from."""
    methods = {report.key: report.ground for report in built.reports}
    records = []
    for header, report in zip(survey.headers, built.spooled, strict=True):
        ground: GroundMethod = "filter"
        if report.classified:
            filtered = any(methods.get((column, row)) == "filter" for column, row, _ in report.tiles)
            ground = "classes and filter" if filtered else "classes"
        records.append(SourceRecord(header.path.name, header.size_bytes, header.point_count, header.crs, ground))
    return records


def write_submaps(path: Path, built: BuiltTiles, count: int) -> Float32Array:
    """Write the table of submaps and return the ground heights (count,)."""
    heights = np.empty(count, dtype=np.float32)
    written = 0
    with path.open("wb") as file:
        header = {"descr": np.lib.format.dtype_to_descr(store.SUBMAP_DTYPE), "fortran_order": False, "shape": (count,)}
        np.lib.format.write_array_header_1_0(file, header)
        for result in results(built):
            file.write(result.submaps.tobytes())
            heights[written : written + len(result.submaps)] = result.submaps["ground_height"]
            written += len(result.submaps)
    return heights


def _write_rasters(
    folder: Path, built: BuiltTiles, bounds: Bounds, crs: str, config: BuildConfig, advance: Callable[[int], None]
) -> None:
    rasters = _TileRasters({report.key: path for report, path in built.tiles}, config)
    layers = (
        (store.TERRAIN, rasters.terrain, "terrain height"),
        (store.SURFACE, rasters.surface, "surface height"),
        (store.LOWEST, rasters.lowest, "lowest echo"),
    )
    for name, values, description in layers:
        write_geotiff(folder / name, bounds, config.cell_m, crs, values, description)
        advance(1)
    write_geotiff(folder / store.SUPPORT, bounds, config.cell_m, crs, rasters.support, "number of echoes", "counts")
    advance(1)


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

    def support(self, bounds: Bounds) -> Float32Array:
        return np.nan_to_num(self._gather(bounds, "support"))

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
