"""Calibrate a map: scan it and other places, fit the offset, drive through it with that, and write what came of it."""

from __future__ import annotations

import dataclasses
import datetime
from collections import Counter as Tally
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from crossloc3d_ros import __version__
from crossloc3d_ros.aerial_map.calibration import (
    LocalizabilityCounts,
    MapCalibration,
    manifest_digest,
    write_calibration,
)
from crossloc3d_ros.aerial_map.progress import Counter, ProgressCallback
from crossloc3d_ros.aerial_map.store import MANIFEST, AerialMap
from crossloc3d_ros.config import LocalizabilityConfig
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.localizability.driving import FAR_M, NEAR_M, DrivenPlace, Sensor
from crossloc3d_ros.localizability.fit import FittedOffset, ScanOdds, fit_offset
from crossloc3d_ros.localizability.page import write_page
from crossloc3d_ros.localizability.raster import NEVER, distance_class, rasters_of, write_raster
from crossloc3d_ros.localizability.squares import Square, choose_squares
from crossloc3d_ros.localizability.tasks import (
    SquareTask,
    TownTask,
    drive_square,
    forget,
    scan_square,
    scan_town,
    town_tasks,
)
from crossloc3d_ros.localization.alignment.observation_model import ObservationModel
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import Advance, EncoderLoader, Workers, open_workers

Task = TypeVar("Task", SquareTask, TownTask)
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Localizability:
    """What a calibration found."""

    calibration: MapCalibration
    scans: tuple[ScanOdds, ...]
    """On the map and off it, without the offset."""
    places: tuple[DrivenPlace, ...]
    """With it."""


def calibrate_map(
    folder: str | Path,
    encoder: DescriptorEncoder | EncoderLoader,
    config: LocalizabilityConfig | None = None,
    *,
    progress: ProgressCallback | None = None,
) -> Localizability:
    """Find how well the map in `folder` can be localized in, and write it there: JSON, GeoTIFF and page.

    `encoder`: that of the map, or the function that loads it, which several workers need. Raises MapError for a map
    that cannot be used, calibrated or written to, and ConfigError for an unknown lidar.
    """
    config, folder = config or LocalizabilityConfig(), Path(folder).absolute()
    Sensor(config)  # an unknown lidar is reported before the long work begins
    loader: EncoderLoader = encoder if callable(encoder) else lambda: encoder
    loaded = loader()
    aerial_map = AerialMap.load(folder, loaded.fingerprint)
    squares = choose_squares(aerial_map, config.places, config.seed)
    report = progress or (lambda _: None)
    try:
        with open_workers(loader, loaded, config.workers, None, folder) as workers:
            scans = _scan(folder, squares, config, workers, report)
            calibration = _calibration(aerial_map, fit_offset(scans), config)
            tasks = [SquareTask(folder, square, config, calibration) for square in squares]
            places = _do(
                drive_square, tasks, [square.places for square in squares], "driving", "drives", workers, report
            )
    finally:
        forget()
    calibration = dataclasses.replace(calibration, counts=_counts(scans, places))
    distance, probability = rasters_of(aerial_map, squares, places)
    write_raster(folder, aerial_map, distance, probability)
    write_page(folder, aerial_map, calibration, places, distance)
    write_calibration(folder, calibration)  # last: it is what the localizer goes by
    return Localizability(calibration, tuple(scans), tuple(places))


def _scan(
    folder: Path, squares: Sequence[Square], config: LocalizabilityConfig, workers: Workers, report: ProgressCallback
) -> list[ScanOdds]:
    """Return what single scans on the map and off it say."""
    tasks = [SquareTask(folder, square, config) for square in squares]
    scans = _do(scan_square, tasks, [square.places for square in squares], "scanning", "scans", workers, report)
    if not scans:
        raise MapError(
            f"the map {folder} has no street to drive on: no connected open ground of some 100 m; "
            "it cannot be calibrated"
        )
    towns = town_tasks(folder, config)
    return scans + _do(scan_town, towns, [town.scans for town in towns], "off the map", "scans", workers, report)


def _do(
    function: Callable[[Task, DescriptorEncoder, Advance | None], list[Result]],
    tasks: Sequence[Task],
    sizes: Sequence[int],
    stage: str,
    unit: str,
    workers: Workers,
    report: ProgressCallback,
) -> list[Result]:
    """Return the results of tasks in an order that does not depend on the workers."""
    advance = Counter(stage, 0, sum(sizes), unit, report)
    numbered = [(_Numbered(function, i, task), size) for i, (task, size) in enumerate(zip(tasks, sizes, strict=True))]
    results: dict[int, list[Result]] = dict(workers.run_encoding(_do_numbered, numbered, advance))
    return [each for i in range(len(tasks)) for each in results[i]]


@dataclass(frozen=True)
class _Numbered(Generic[Task, Result]):
    """A task that is known again when it is done."""

    function: Callable[[Task, DescriptorEncoder, Advance | None], list[Result]]
    number: int
    task: Task


def _do_numbered(
    numbered: _Numbered[Task, Result], encoder: DescriptorEncoder, advance: Advance | None
) -> tuple[int, list[Result]]:
    return numbered.number, numbered.function(numbered.task, encoder, advance)


def _calibration(aerial_map: AerialMap, fitted: FittedOffset, config: LocalizabilityConfig) -> MapCalibration:
    return MapCalibration(
        offset=fitted.offset,
        unlimited_offset=fitted.unlimited,
        offset_std=fitted.std,
        off_map_belief=fitted.off_map_belief,
        lidar=config.lidar,
        lidar_height_m=config.lidar_height_m,
        seed=config.seed,
        counts=LocalizabilityCounts(),
        manifest_sha256=manifest_digest(aerial_map.path / MANIFEST),
        observation_model=ObservationModel.load().fingerprint,
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        software=f"crossloc3d_ros {__version__}",
    )


def _counts(scans: Sequence[ScanOdds], places: Sequence[DrivenPlace]) -> LocalizabilityCounts:
    classes = Tally(distance_class(place) for place in places)
    on_map = [scan for scan in scans if scan.on_map]
    return LocalizabilityCounts(
        places=len(places),
        right=sum(place.is_right for place in places),
        not_aligned=sum(scan.log_odds == -float("inf") for scan in on_map),
        off_map=len(scans) - len(on_map),
        at_once=classes[0.0],
        after_20_m=classes[NEAR_M],
        after_100_m=classes[FAR_M],
        never=classes[NEVER],
        wrong_fixes=sum(place.had_wrong_fix for place in places),
    )
