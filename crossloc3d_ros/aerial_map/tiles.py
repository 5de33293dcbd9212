"""From a survey to finished tiles: read its points into the spool, plan the tiles, cut their submaps and encode them.

The work lies in one folder: what has been read (`spool`) and the tiles that are done (`tiles`). Every piece appears
under its name when it is whole, so the work may be stopped at any moment, and the same call goes on where it stopped.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crossloc3d_ros.aerial_map import spool, tile
from crossloc3d_ros.aerial_map.progress import Counter, ProgressCallback
from crossloc3d_ros.aerial_map.spool import SpoolReport, SpoolTask, TileKey, spool_file
from crossloc3d_ros.aerial_map.survey import Survey
from crossloc3d_ros.aerial_map.tile import TileReport, TileTask, build_tile, cut_tile
from crossloc3d_ros.clouds.tiling import submap_centres
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig, to_dict
from crossloc3d_ros.errors import AerialDataError, ConfigError, MapError
from crossloc3d_ros.files import remove_leftovers, write_atomically
from crossloc3d_ros.stopwatch import Stopwatch
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import Workers

_log = logging.getLogger(__name__)

_WORK_VERSION = 4
"""Raised when the files of the work folder change: an older half-done build is started anew then."""


@dataclass(frozen=True)
class TileJob:
    """What the tiles of a survey are made of, and how."""

    work: Path
    survey: Survey
    config: BuildConfig
    preprocessing: PreprocessingConfig
    encoder: DescriptorEncoder | None
    """None: the submaps are cut, and their patches kept in place of descriptors."""

    def spool(self, index: int) -> Path:
        """Return where the points of a file are sorted into tiles."""
        return self.work / "spool" / f"{index:06d}"

    def identity(self) -> dict[str, Any]:
        """Return what a half-done build must agree in to be continued."""
        parameters = to_dict(self.config)
        for name in ("workers", "chunk_points"):  # how the work is done, not what comes out
            del parameters[name]
        return {
            "work_version": _WORK_VERSION,
            "inputs": [[str(h.path), h.size_bytes, h.path.stat().st_mtime_ns] for h in self.survey.headers],
            "source_crs": self.survey.crs,
            "vertical_metres_per_unit": self.survey.vertical_metres_per_unit,
            "target_crs": self.survey.map_crs,
            "parameters": parameters,
            "encoder": self.encoder.fingerprint if self.encoder else None,
            "preprocessing": json.loads(json.dumps(to_dict(self.preprocessing))),
        }


@dataclass(frozen=True, eq=False)
class BuiltTiles:
    """The tiles of a survey, built in this run or before."""

    spooled: tuple[SpoolReport, ...]
    """What reading each file came to."""
    points_read: int
    """In this run."""
    tiles: tuple[tuple[TileReport, Path], ...]
    """Reports of all tiles and their files."""
    fresh: tuple[TileReport, ...]
    """Of the tiles built in this run."""
    stray_points: int
    reading_s: float
    encoding_s: float

    @property
    def reports(self) -> list[TileReport]:
        """The reports of all tiles."""
        return [report for report, _ in self.tiles]


def check_config(config: BuildConfig) -> None:
    """Raise ConfigError where cells do not fit into tiles."""
    cells = config.tile_m / config.cell_m
    if abs(cells - round(cells)) > 1e-6:
        raise ConfigError(f"'tile_m' must be a multiple of 'cell_m', got {config.tile_m} and {config.cell_m}")


def build_tiles(job: TileJob, workers: Workers, progress: ProgressCallback) -> BuiltTiles:
    """Read the survey and build its tiles, leaving out what an earlier run of the same job has done."""
    watch = Stopwatch()
    spooled, points_read = _read_points(job, workers, progress)
    reading_s = watch.lap()
    plan = _plan_tiles(job, spooled)
    reports, fresh = _build_planned(plan, workers, progress)
    return BuiltTiles(
        spooled=tuple(spooled),
        points_read=points_read,
        tiles=tuple((report, plan.result(report.key)) for report in reports),
        fresh=tuple(fresh),
        stray_points=plan.stray_points,
        reading_s=reading_s,
        encoding_s=watch.lap(),
    )


def continue_or_start(tile_job: TileJob) -> bool:
    """Say whether the work folder holds a half-done build of the same job; otherwise empty it for a new one."""
    work, job = tile_job.work, tile_job.identity()
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
    for name in ("spool", "tiles", "result"):
        shutil.rmtree(work / name, ignore_errors=True)
    write_atomically(file, json.dumps(job, indent=1), MapError)
    return False


def _read_points(job: TileJob, workers: Workers, progress: ProgressCallback) -> tuple[list[SpoolReport], int]:
    """Sort the points of every file into tiles; return the reports and how many points were read in this run."""
    survey, config = job.survey, job.config
    missing = {i: header for i, header in enumerate(survey.headers) if spool.read_report(job.spool(i)) is None}
    to_read = sum(header.point_count for header in missing.values())
    advance = Counter("reading", survey.points - to_read, survey.points, "points", progress)
    tasks = (
        SpoolTask(
            source=header.path,
            folder=job.spool(index),
            point_count=header.point_count,
            source_crs=header.crs,
            vertical_metres_per_unit=header.vertical_metres_per_unit,
            target_crs=survey.map_crs,
            tile_m=config.tile_m,
            chunk_points=config.chunk_points,
            threads=workers.shared_threads,
        )
        # The largest first, so that no worker is left alone with it at the end.
        for index, header in sorted(missing.items(), key=lambda item: -item[1].point_count)
    )
    for _ in workers.run(spool_file, ((task, task.point_count) for task in tasks), advance):
        pass
    reports = [spool.read_report(job.spool(index)) for index in range(len(survey.headers))]
    if not all(reports):
        raise MapError(f"the work folder {job.work} was changed by somebody else; delete it and build again")
    return [report for report in reports if report is not None], to_read


@dataclass(frozen=True, eq=False)
class _TilePlan:
    """Which tiles there are and what each is made from."""

    job: TileJob
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
        return self.job.work / "tiles" / f"{key[0]}_{key[1]}.npz"

    def centres(self, key: TileKey) -> int:
        return len(submap_centres(spool.tile_bounds(key, self.job.config.tile_m), self.job.config.spacing_m))

    def task(self, key: TileKey) -> TileTask:
        sources = tuple(
            (self.job.spool(index), near, self.classified[index])
            for near in _around(key, self.reach)
            for index in self.files.get(near, ())
        )
        return TileTask(key, sources, self.result(key), self.job.config, self.job.preprocessing)


def _plan_tiles(job: TileJob, spooled: Sequence[SpoolReport]) -> _TilePlan:
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
    enough = {key for key, count in counts.items() if count >= job.preprocessing.min_points}
    kept = [key for key in counts if any(near in enough for near in _around(key, 1))]
    points = sum(counts.values())
    if not kept:
        raise AerialDataError(
            f"the area is empty: {points:,} of {sum(r.points_in_file for r in spooled):,} points are left without "
            f"noise and withheld points, and nowhere do enough of them ({job.preprocessing.min_points}) lie together "
            "for a submap, as on water, which gives no echo"
        )
    return _TilePlan(
        job=job,
        reach=math.ceil(tile.margin_m(job.preprocessing.half_extent_m, job.config.cell_m) / job.config.tile_m),
        files=files,
        classified=[report.classified for report in spooled],
        keys=sorted(kept, key=lambda key: (-counts[key], key)),
        stray_points=points - sum(counts[key] for key in kept),
    )


def _around(key: TileKey, reach: int) -> list[TileKey]:
    steps = range(-reach, reach + 1)
    return [(key[0] + column, key[1] + row) for row in steps for column in steps]


def _build_planned(
    plan: _TilePlan, workers: Workers, progress: ProgressCallback
) -> tuple[list[TileReport], list[TileReport]]:
    """Build the tiles that are not built yet; return the reports of all, and of those built in this run."""
    (plan.job.work / "tiles").mkdir(exist_ok=True)
    done = [report for key in plan.keys if (report := tile.read_report(plan.result(key))) is not None]
    done_keys = {report.key for report in done}
    tasks = ((plan.task(key), plan.centres(key)) for key in plan.keys if key not in done_keys)
    total = sum(plan.centres(key) for key in plan.keys)
    stage = "encoding" if plan.job.encoder else "cutting"
    advance = Counter(stage, sum(plan.centres(report.key) for report in done), total, "submaps", progress)
    if plan.job.encoder:
        fresh = list(workers.run_encoding(build_tile, tasks, advance))
    else:
        fresh = list(workers.run(cut_tile, tasks, advance))
    return done + fresh, fresh
