"""From an aerial survey to a map: `build_map` reads as the list of its steps.

The work lies in a folder beside the output, `NAME.build`: what has been read (`spool`), the tiles that are done
(`tiles`) and the map while it is put together (`map`). Every piece appears under its name when it is whole, so a build
may be stopped at any moment, and the same call goes on where it stopped. The map itself appears in one rename.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import logging
import math
import shutil
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map import spool, store, tile
from crossloc3d_ros.aerial_map.assemble import write_map
from crossloc3d_ros.aerial_map.spool import POINT_DTYPE, SpoolReport, SpoolTask, TileKey, spool_file
from crossloc3d_ros.aerial_map.store import BuildCounts, GroundMethod, Manifest, SourceRecord
from crossloc3d_ros.aerial_map.tile import TileReport, TileTask, TileTimes, build_tile
from crossloc3d_ros.clouds.tiling import submap_centres
from crossloc3d_ros.config import BuildConfig, to_dict
from crossloc3d_ros.errors import AerialDataError, ConfigError, MapError
from crossloc3d_ros.files import publish, remove_leftovers, restore, size_of, work_lock, write_atomically
from crossloc3d_ros.formats.las import AerialHeader, expand_inputs, read_header
from crossloc3d_ros.geodesy import crs_name, crs_text, metres_per_unit, same_crs, utm_crs_of, vertical_reference
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import EncoderLoader, Workers, open_workers

_log = logging.getLogger(__name__)
_MOST_AREA_A_POINT_M2 = 25.0

_WORK_VERSION = 2
"""Raised when the files of the work folder change: an older half-done build is started anew then."""


@dataclass(frozen=True)
class BuildProgress:
    """How far a build is."""

    stage: str
    """`reading`, `encoding` or `writing`."""
    done: int
    total: int
    unit: str
    """`points`, `places` or `files`."""


@dataclass(frozen=True)
class BuildReport:
    """What a build came to."""

    output: Path
    manifest: Manifest
    resumed: bool
    """Whether an earlier, interrupted build was continued."""
    points_read: int
    """In this run."""
    places_encoded: int
    """Submaps made in this run."""
    reading_s: float
    encoding_s: float
    writing_s: float
    times: TileTimes
    """Seconds of each step, summed over the tiles of this run and over its workers."""

    @property
    def points_per_s(self) -> float:
        """Points read a second, 0 where none were."""
        return self.points_read / self.reading_s if self.reading_s > 0 else 0.0

    @property
    def submaps_per_s(self) -> float:
        """Submaps made a second, 0 where none were."""
        return self.places_encoded / self.encoding_s if self.encoding_s > 0 else 0.0


ProgressCallback = Callable[[BuildProgress], None]


def build_map(
    inputs: Sequence[str | Path],
    output: str | Path,
    encoder: DescriptorEncoder | EncoderLoader,
    config: BuildConfig | None = None,
    *,
    crs: str | None = None,
    geoid_separation_m: float | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> BuildReport:
    """Build the map folder `output` from aerial files, folders and globs.

    `encoder`: an encoder, or the function that loads one, which several workers need. `crs` replaces what the files
    say. `geoid_separation_m`: ellipsoidal height minus the survey's height, where somebody knows it. `scheduler`: the
    address of a Dask cluster whose machines see inputs and output under the same paths.

    Raises AerialDataError for inputs that cannot be used, MapError for an output that cannot be written, ConfigError
    for settings that do not fit. Whatever happens, what is done stays in the work folder, and the same call goes on.
    """
    config = config or BuildConfig()
    output = Path(output).absolute()
    _check_config(config)
    loader, encoder = _encoder_and_loader(encoder)
    restore(output)
    check_output(output, overwrite)
    headers = read_headers(expand_inputs(inputs), crs)
    source_crs = headers[0].crs
    target_crs = _utm_crs(headers)
    vertical = vertical_reference(source_crs, headers[0].vertical_metres_per_unit)
    report = progress or (lambda _: None)

    work = work_folder(output)
    with _disk_full_explained(work, headers, config, encoder), work_lock(work, MapError, "build"):
        resumed = _continue_or_start(work, _job(headers, target_crs, config, encoder))
        with open_workers(loader, encoder, config.workers, scheduler, work) as workers:
            started = time.perf_counter()
            spooled, points_read = _read_survey(work, headers, target_crs, config, workers, report)
            read_at = time.perf_counter()
            plan = _plan_tiles(work, spooled, config, encoder)
            tiles, fresh = _build_tiles(plan, workers, report)
            built_at = time.perf_counter()
        manifest = write_map(
            work / "map",
            [(tile_report, plan.result(tile_report.key)) for tile_report in tiles],
            crs=target_crs,
            vertical_reference=vertical.name,
            geoid_separation_m=0.0 if vertical.ellipsoidal else geoid_separation_m,
            encoder=encoder,
            config=config,
            counts=_counts(spooled, tiles, plan.stray_points),
            sources=_sources(headers, spooled, tiles),
            advance=_Counter("writing", 0, len(store.DATA_FILES), "files", report),
        )
        publish(work / "map", output)
        written_at = time.perf_counter()
        shutil.rmtree(work, ignore_errors=True)
    return BuildReport(
        output=output,
        manifest=manifest,
        resumed=resumed,
        points_read=points_read,
        places_encoded=sum(r.submaps for r in fresh),
        reading_s=read_at - started,
        encoding_s=built_at - read_at,
        writing_s=written_at - built_at,
        times=sum((r.times for r in fresh), TileTimes()),
    )


def work_folder(output: Path) -> Path:
    """Return where the unfinished work of a map lies."""
    return output.with_name(f"{output.name}.build")


def check_output(output: Path, overwrite: bool) -> None:
    """Raise MapError where `output` may not be written: it exists, or is something else than a map."""
    if not output.exists():
        return
    is_map = (output / store.MANIFEST).is_file()
    if not is_map and not (output.is_dir() and not any(output.iterdir())):
        raise MapError(f"{output} exists and is no map: give --output another name")
    if is_map and not overwrite:
        raise MapError(f"the map {output} exists: give --overwrite to replace it, or --output another name")


def read_headers(paths: Sequence[Path], crs: str | None) -> list[AerialHeader]:
    """Return the headers of the files that hold points; AerialDataError where they do not belong together."""
    headers = [read_header(path, crs) for path in paths]
    for header in headers:
        if header.point_count == 0:
            _log.warning("%s holds no points and is left out", header.path)
    headers = [header for header in headers if header.point_count > 0]
    if not headers:
        raise AerialDataError(f"the area is empty: none of the {len(paths)} files holds a point")
    groups: list[list[AerialHeader]] = []
    for header in headers:
        for group in groups:
            if same_crs(group[0].crs, header.crs) and (
                group[0].vertical_metres_per_unit == header.vertical_metres_per_unit
            ):
                group.append(header)
                break
        else:
            groups.append([header])
    if len(groups) > 1:
        raise AerialDataError(
            f"the files of one build must share one CRS; here are {len(groups)}: "
            + "; ".join(_described(group) for group in groups)
            + ". Build a map of each, or, where headers are wrong, say the right CRS with --crs"
        )
    return [dataclasses.replace(header, crs=headers[0].crs) for header in headers]


def _described(group: Sequence[AerialHeader]) -> str:
    names = ", ".join(header.path.name for header in group[:3])
    more = f" and {len(group) - 3} more" if len(group) > 3 else ""
    unit = group[0].vertical_metres_per_unit
    heights = "" if unit is None else f", heights in units of {unit:.7g} m"
    return f"{crs_name(group[0].crs)}{heights} in {names}{more}"


def _check_config(config: BuildConfig) -> None:
    cells = config.tile_m / config.cell_m
    if abs(cells - round(cells)) > 1e-6:
        raise ConfigError(f"'tile_m' must be a multiple of 'cell_m', got {config.tile_m} and {config.cell_m}")


def _encoder_and_loader(encoder: DescriptorEncoder | EncoderLoader) -> tuple[EncoderLoader, DescriptorEncoder]:
    if callable(encoder):
        return encoder, encoder()
    given = encoder
    return (lambda: given), given


def _utm_crs(headers: Sequence[AerialHeader]) -> str:
    """Return the UTM zone of the survey's middle, each file weighed by its points."""
    weights = np.array([header.point_count for header in headers], dtype=np.float64)
    centres = np.array([(header.minimum[:2] + header.maximum[:2]) / 2.0 for header in headers])
    x, y = (weights / weights.sum()) @ centres
    return crs_text(utm_crs_of(headers[0].crs, float(x), float(y)))


def _job(
    headers: Sequence[AerialHeader], target_crs: str, config: BuildConfig, encoder: DescriptorEncoder
) -> dict[str, Any]:
    """Return what a half-done build must agree in to be continued."""
    parameters = to_dict(config)
    for name in ("workers", "chunk_points"):  # how the work is done, not what comes out
        del parameters[name]
    return {
        "work_version": _WORK_VERSION,
        "inputs": [[str(h.path), h.size_bytes, h.path.stat().st_mtime_ns] for h in headers],
        "source_crs": headers[0].crs,
        "vertical_metres_per_unit": headers[0].vertical_metres_per_unit,
        "target_crs": target_crs,
        "parameters": parameters,
        "encoder": encoder.fingerprint,
        "preprocessing": json.loads(json.dumps(to_dict(encoder.preprocessing))),
    }


def _continue_or_start(work: Path, job: dict[str, Any]) -> bool:
    """Say whether the work folder holds a half-done build of the same job; otherwise empty it for a new one."""
    file = work / "job.json"
    try:
        earlier = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        earlier = None
    if earlier == job:
        _log.info("continuing the build in %s", work)
        remove_leftovers(work / "spool")
        remove_leftovers(work / "tiles")
        return True
    if earlier is not None:
        changed = sorted(key for key in {*earlier, *job} if earlier.get(key) != job.get(key))
        _log.warning("starting anew: the half-done build in %s has other %s", work, ", ".join(changed))
    for name in ("spool", "tiles", "map"):
        shutil.rmtree(work / name, ignore_errors=True)
    write_atomically(file, json.dumps(job, indent=1), MapError)
    return False


def _read_survey(
    work: Path,
    headers: Sequence[AerialHeader],
    target_crs: str,
    config: BuildConfig,
    workers: Workers,
    progress: ProgressCallback,
) -> tuple[list[SpoolReport], int]:
    """Sort the points of every file into tiles; return the reports and how many points were read in this run."""
    total = sum(header.point_count for header in headers)
    missing = {
        index: header for index, header in enumerate(headers) if spool.read_report(_spool_of(work, index)) is None
    }
    to_read = sum(header.point_count for header in missing.values())
    advance = _Counter("reading", total - to_read, total, "points", progress)
    tasks = (
        SpoolTask(
            source=header.path,
            folder=_spool_of(work, index),
            point_count=header.point_count,
            source_crs=header.crs,
            vertical_metres_per_unit=header.vertical_metres_per_unit,
            target_crs=target_crs,
            tile_m=config.tile_m,
            chunk_points=config.chunk_points,
            threads=workers.shared_threads,
        )
        # The largest first, so that no worker is left alone with it at the end.
        for index, header in sorted(missing.items(), key=lambda item: -item[1].point_count)
    )
    for _ in workers.run(spool_file, ((task, task.point_count) for task in tasks), advance):
        pass
    reports = [spool.read_report(_spool_of(work, index)) for index in range(len(headers))]
    if not all(reports):
        raise MapError(f"the work folder {work} was changed by somebody else; delete it and build again")
    return [report for report in reports if report is not None], to_read


def _spool_of(work: Path, index: int) -> Path:
    return work / "spool" / f"{index:06d}"


@dataclass(frozen=True, eq=False)
class _TilePlan:
    """Which tiles there are and what each is made from."""

    work: Path
    config: BuildConfig
    reach: int
    """Rings of tiles around a tile that it looks into."""
    files: dict[TileKey, list[int]]
    """The spooled files that have points in a tile."""
    classified: list[bool]
    """Whether each spooled file has ground classes."""
    keys: list[TileKey]
    """The tiles to be built, those with the most points first, so that no worker is left alone with one at the end."""
    stray_points: int

    def result(self, key: TileKey) -> Path:
        return self.work / "tiles" / f"{key[0]}_{key[1]}.npz"

    def centres(self, key: TileKey) -> int:
        return len(submap_centres(spool.tile_bounds(key, self.config.tile_m), self.config.spacing_m))

    def task(self, key: TileKey) -> TileTask:
        sources = tuple(
            (_spool_of(self.work, index), near, self.classified[index])
            for near in _around(key, self.reach)
            for index in self.files.get(near, ())
        )
        return TileTask(key, sources, self.result(key), self.config)


def _plan_tiles(
    work: Path, spooled: Sequence[SpoolReport], config: BuildConfig, encoder: DescriptorEncoder
) -> _TilePlan:
    """Find the tiles to be built.

    Stray points are left aside: those in tiles with less than a submap's worth of points and none but such tiles
    around. An outlier a thousand kilometres away must not span the rasters.
    """
    files: dict[TileKey, list[int]] = defaultdict(list)
    counts: dict[TileKey, int] = defaultdict(int)
    for index, report in enumerate(spooled):
        for column, row, count in report.tiles:
            files[column, row].append(index)
            counts[column, row] += count
    enough = {key for key, count in counts.items() if count >= encoder.preprocessing.min_points}
    kept = [key for key in counts if any(near in enough for near in _around(key, 1))]
    points = sum(counts.values())
    if not kept:
        raise AerialDataError(
            f"the area is empty: {points:,} of {sum(r.points_in_file for r in spooled):,} points are left without "
            "noise and withheld points, and nowhere do enough of them lie together for a submap"
        )
    return _TilePlan(
        work=work,
        config=config,
        reach=math.ceil(tile.margin_m(encoder.preprocessing.half_extent_m, config.cell_m) / config.tile_m),
        files=files,
        classified=[report.classified for report in spooled],
        keys=sorted(kept, key=lambda key: (-counts[key], key)),
        stray_points=points - sum(counts[key] for key in kept),
    )


def _around(key: TileKey, reach: int) -> list[TileKey]:
    steps = range(-reach, reach + 1)
    return [(key[0] + column, key[1] + row) for row in steps for column in steps]


def _build_tiles(
    plan: _TilePlan, workers: Workers, progress: ProgressCallback
) -> tuple[list[TileReport], list[TileReport]]:
    """Build the tiles that are not built yet; return the reports of all, and of those built in this run."""
    (plan.work / "tiles").mkdir(exist_ok=True)
    done = [report for key in plan.keys if (report := tile.read_report(plan.result(key))) is not None]
    done_keys = {report.key for report in done}
    missing = [key for key in plan.keys if key not in done_keys]
    total = sum(plan.centres(key) for key in plan.keys)
    advance = _Counter("encoding", sum(plan.centres(r.key) for r in done), total, "places", progress)
    fresh = list(workers.run_encoding(build_tile, ((plan.task(key), plan.centres(key)) for key in missing), advance))
    return done + fresh, fresh


def _counts(spooled: Sequence[SpoolReport], tiles: Sequence[TileReport], stray: int) -> BuildCounts:
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


def _sources(
    headers: Sequence[AerialHeader],
    spooled: Sequence[SpoolReport],
    tiles: Sequence[TileReport],
) -> list[SourceRecord]:
    methods = {report.key: report.ground for report in tiles}
    records = []
    for header, report in zip(headers, spooled, strict=True):
        ground: GroundMethod = "filter"
        if report.classified:
            filtered = any(methods.get((column, row)) == "filter" for column, row, _ in report.tiles)
            ground = "classes and filter" if filtered else "classes"
        records.append(SourceRecord(header.path.name, header.size_bytes, header.point_count, header.crs, ground))
    return records


class _Counter:
    """Adds up what the tasks report and passes it on."""

    def __init__(self, stage: str, done: int, total: int, unit: str, progress: ProgressCallback) -> None:
        self._stage, self._done, self._total, self._unit = stage, done, total, unit
        self._progress = progress
        self(0)

    def __call__(self, count: int) -> None:
        self._done = min(self._done + count, self._total)
        self._progress(BuildProgress(self._stage, self._done, self._total, self._unit))


def bytes_needed(headers: Sequence[AerialHeader], config: BuildConfig, descriptor_size: int) -> int:
    """Return about how much disk a build takes while it runs: the spooled points, the tiles and the map."""
    points = sum(header.point_count for header in headers) * POINT_DTYPE.itemsize
    area_m2 = 0.0
    for header in headers:
        width, height = _extent_m(header)
        # The box of a header with a stray point, or a broken one, says nothing about the area.
        area_m2 += min(width * height, _MOST_AREA_A_POINT_M2 * header.point_count)
    rasters = 3 * 4 * area_m2 / config.cell_m**2
    submaps = area_m2 / config.spacing_m**2 * (4 * descriptor_size + store.SUBMAP_DTYPE.itemsize)
    return int(points + 2 * (rasters + submaps))


def _extent_m(header: AerialHeader) -> tuple[float, float]:
    unit_x, unit_y = metres_per_unit(header.crs, float(header.minimum[1]))
    width, height = (header.maximum - header.minimum)[:2]
    return max(float(width) * unit_x, 1.0), max(float(height) * unit_y, 1.0)


@contextmanager
def _disk_full_explained(
    work: Path, headers: Sequence[AerialHeader], config: BuildConfig, encoder: DescriptorEncoder
) -> Iterator[None]:
    """Say what to do when the disk is full, before the work where that can be foreseen."""
    needed = bytes_needed(headers, config, encoder.descriptor_size)
    existing = next(folder for folder in (work, *work.parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    begun = size_of(work)
    if free + begun < needed:
        raise MapError(
            f"the disk of {existing} has too little room: the build needs about {_size(needed)} there and "
            f"{_size(free + begun)} is free; make room or give --output on another disk"
        )
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT) or shutil.disk_usage(existing).free < 1_000_000:
            raise MapError(
                f"the disk of {work} is full: the build needs about {_size(needed)} there in all and "
                f"{_size(shutil.disk_usage(existing).free)} is free; what is done is kept, so make room and give the "
                "same command again"
            ) from error
        raise MapError(f"the build in {work} failed: {error}; what is done is kept") from error


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
