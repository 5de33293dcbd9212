"""What the workers do: scan a square of the map, scan a town off it, drive through a square."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.calibration import MapCalibration
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import LocalizabilityConfig
from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.evaluation.poses.errors import right_aligned
from crossloc3d_ros.localizability.driving import (
    DrivenPlace,
    Sensor,
    drive_from,
    plan_way,
    starts_of,
    steps_from,
)
from crossloc3d_ros.localizability.fit import ScanOdds, odds_of
from crossloc3d_ros.localizability.squares import Square
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.localization.session import Session
from crossloc3d_ros.simulation.map_world import world_of_map
from crossloc3d_ros.simulation.route import Route
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import DescriptorEncoder

TOWN_SEEDS = 700_000
"""Towns off the map have seeds from here on: none that is learned from, and none of a benchmark."""
FAMILIES = ("old_town", "suburb", "campus", "industry", "estate", "canal_town", "park_edge")
_TOWN_M = 260.0

Advance = Callable[[int], None]


@dataclass(frozen=True)
class SquareTask:
    """A square to be scanned or driven."""

    map_folder: Path
    square: Square
    config: LocalizabilityConfig
    calibration: MapCalibration | None = None
    """That the localizer uses; None while it is being sought."""


@dataclass(frozen=True)
class TownTask:
    """A town off the map to be scanned."""

    map_folder: Path
    number: int
    scans: int
    config: LocalizabilityConfig


def town_tasks(map_folder: Path, config: LocalizabilityConfig) -> list[TownTask]:
    """Return a town of each family, with its share of the scans."""
    counts = np.diff(np.round(np.linspace(0.0, config.off_map_scans, len(FAMILIES) + 1))).astype(int).tolist()
    return [TownTask(map_folder, i, count, config) for i, count in enumerate(counts) if count]


def scan_square(task: SquareTask, encoder: DescriptorEncoder, advance: Advance | None) -> list[ScanOdds]:
    """Return what the first scans of the drives of a square say, each by itself on the whole map."""
    opened = _open(task)
    if opened is None:
        return []
    world, way, sensor = opened
    localizer = _localizer(task.map_folder, encoder, task.config, None)
    scans = []
    for start_m in starts_of(way, task.square.places).tolist():
        _, estimate, truth = next(steps_from(way, world, sensor, localizer, start_m, task.config.seed))
        scans.append(
            ScanOdds(odds_of(estimate.aligned), bool(right_aligned(estimate.aligned, truth).any()), on_map=True)
        )
        if advance is not None:
            advance(1)
    return scans


def scan_town(task: TownTask, encoder: DescriptorEncoder, advance: Advance | None) -> list[ScanOdds]:
    """Return what scans of a town that lies on no map say."""
    config, family = task.config, FAMILIES[task.number]
    world = make_town(TOWN_SEEDS + 10 * (config.seed % 10_000) + task.number, family, _TOWN_M)
    sensor, rng = Sensor(config), np.random.default_rng([config.seed, 25, task.number])
    session = Session(_localizer(task.map_folder, encoder, config, None))
    scans = []
    for pose in world.sample_poses(task.scans, rng, border_m=20.0):
        session.reset()
        estimate = session.localize(session.receive(sensor.scan(world, pose, rng, None, 0))).estimate
        scans.append(ScanOdds(odds_of(estimate.aligned), has_right=False, on_map=False))
        if advance is not None:
            advance(1)
    return scans


def drive_square(task: SquareTask, encoder: DescriptorEncoder, advance: Advance | None) -> list[DrivenPlace]:
    """Return what becomes of the drives of a square."""
    opened = _open(task)
    if opened is None:
        return []
    world, way, sensor = opened
    localizer = _localizer(task.map_folder, encoder, task.config, task.calibration)
    places = []
    for start_m in starts_of(way, task.square.places).tolist():
        places.append(drive_from(way, world, sensor, localizer, start_m, task.config.seed))
        if advance is not None:
            advance(1)
    return places


def _open(task: SquareTask) -> tuple[World, Route, Sensor] | None:
    """Return the world of a square, the way through it and the sensor; None where nobody can drive there."""
    seed = 1000 * task.config.seed + task.square.number
    aerial_map = _map(task.map_folder)
    try:
        world = world_of_map(aerial_map, task.square.bounds, seed)
    except AerialDataError:
        return None
    way = plan_way(world, task.square.places, seed)
    return None if way is None else (world, way, Sensor(task.config))


_maps: dict[Path, AerialMap] = {}
_localizers: dict[tuple[Path, str, LocalizabilityConfig, MapCalibration | None], Localizer] = {}


def _map(folder: Path) -> AerialMap:
    """Return this process's map: a worker does many tasks on one."""
    if folder not in _maps:
        _maps.clear()
        _maps[folder] = AerialMap.load(folder)
    return _maps[folder]


def _localizer(
    folder: Path, encoder: DescriptorEncoder, config: LocalizabilityConfig, calibration: MapCalibration | None
) -> Localizer:
    """Return this process's localizer; before there is a calibration, one that searches as much as it can."""
    key = (folder, encoder.fingerprint, config, calibration)
    if key not in _localizers:
        _localizers.clear()
        aerial_map = dataclasses.replace(_map(folder), calibration=calibration, calibration_fault="")
        settings = Sensor(config).localizer_config()
        localizer = Localizer(aerial_map, encoder, settings)
        if calibration is None and localizer.searches_map:
            # Whatever the candidates' poses seem to be worth: that is what is being sought.
            localizer.reconfigure(
                dataclasses.replace(settings, alignment=dataclasses.replace(settings.alignment, scope="map"))
            )
        localizer.warm_up()
        _localizers[key] = localizer
    return _localizers[key]


def forget() -> None:
    """Let go of maps and localizers that this process keeps."""
    _maps.clear()
    _localizers.clear()
