"""Places to learn from: simulated towns, flown over at one epoch and driven through at another."""

from __future__ import annotations

import dataclasses
import json
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.clouds.patch import choose_points
from crossloc3d_ros.clouds.raster import terrain_raster
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.clouds.tiling import SubmapCutter, submap_centres
from crossloc3d_ros.config import MountingConfig, PlacesConfig, PreprocessingConfig, ScanConfig, to_dict
from crossloc3d_ros.errors import ConfigError, TrainingError
from crossloc3d_ros.simulation.families import FAMILIES, HELD_OUT_FAMILIES, TRAINING_FAMILIES
from crossloc3d_ros.simulation.real_world import BUILDING, GROUND, WATER, world_from_points
from crossloc3d_ros.simulation.survey import SurveyConfig, fly
from crossloc3d_ros.simulation.town import Town, make_town
from crossloc3d_ros.simulation.vlp16 import Vlp16
from crossloc3d_ros.simulation.world import Bounds, World
from crossloc3d_ros.training.shards import (
    MANIFEST,
    TRAINING,
    VALIDATION,
    Manifest,
    TownEntry,
    TrainingTown,
    ValidationTown,
    read_manifest,
    write_manifest,
    write_town,
)
from crossloc3d_ros.types import Float32Array, Float64Array, Scan, UInt8Array

_UNCLASSIFIED = 1  # ASPRS class
_SEEDS_A_SET = 100_000  # towns of one set's seed never meet those of another
_VALIDATION_SEEDS = 50_000  # from here on a set's seeds are for validation
_DIAGONAL = 2.0**0.5 + 0.01  # of a square over its side, and a hair for rounding
_MOST_SCAN_POINTS = 30_000  # more than one revolution of the sensor has: every point is kept
_SURFACE_STREAM = 11  # the random numbers of surfaces, apart from those of scans
SURFACE_CLEARANCE_M = 1.5
"""As a route through a real survey keeps by default."""


@dataclass(frozen=True)
class TownTask:
    """One town to be made."""

    file: str
    role: str
    family: str
    seed: int


@dataclass(frozen=True)
class Made:
    """How far the making is, for whoever shows it."""

    done: int
    total: int
    town: TownEntry
    remaining_s: float


def plan_towns(seed: int, towns: int, validation_towns: int, families: Sequence[str]) -> list[TownTask]:
    """Return the towns of a set, validation first, families in rotation; more towns extend a set without changing it.

    A family may be named more than once; without any, all are taken but those held out for the benchmark. Raises
    ConfigError for unknown families and for a held-out one among those to learn from.
    """
    if towns < 0 or validation_towns < 0 or max(towns, validation_towns) > _VALIDATION_SEEDS:
        raise ConfigError(
            f"a set holds 0 to {_VALIDATION_SEEDS:,} towns of each role, not {towns} and {validation_towns}"
        )
    unknown = sorted(set(families) - set(FAMILIES))
    if unknown:
        raise ConfigError(f"unknown families: {', '.join(unknown)}; known are: {', '.join(sorted(FAMILIES))}")
    held_out = sorted(set(families) & set(HELD_OUT_FAMILIES))
    if held_out and towns:
        raise ConfigError(f"held out for the benchmark, not to be learned from: {', '.join(held_out)}")
    names = families or TRAINING_FAMILIES
    tasks = []
    for role, count, first in ((VALIDATION, validation_towns, _VALIDATION_SEEDS), (TRAINING, towns, 0)):
        for i in range(count):
            town_seed = seed * _SEEDS_A_SET + first + i
            family = names[i % len(names)]
            tasks.append(TownTask(f"{role}_{town_seed}_{family}.npz", role, family, town_seed))
    return tasks


def make_places(
    output: Path,
    *,
    towns: int,
    validation_towns: int,
    seed: int,
    config: PlacesConfig,
    preprocessing: PreprocessingConfig,
    workers: int = 1,
    report: Callable[[Made], None] = lambda made: None,
) -> Manifest:
    """Make the towns that `output` does not hold yet and return the manifest of all.

    A folder that holds places of other settings raises TrainingError. Stopped at any moment, the next call goes on.
    """
    config = dataclasses.replace(config, families=config.families or TRAINING_FAMILIES)
    tasks = plan_towns(seed, towns, validation_towns, config.families)
    settings = {
        "seed": seed,
        "towns": towns,
        "validation_towns": validation_towns,
        "places": to_dict(config),
        "preprocessing": to_dict(preprocessing),
    }
    made = already_made(output, settings)
    missing = [task for task in tasks if task.file not in made]
    started = time.monotonic()
    for done, entry in enumerate(_make_all(output, missing, config, preprocessing, workers), start=1):
        made[entry.file] = entry
        write_manifest(output, _manifest(settings, tasks, made))
        remaining_s = (time.monotonic() - started) / done * (len(missing) - done)
        report(Made(len(made), len(tasks), entry, remaining_s))
    manifest = _manifest(settings, tasks, made)
    write_manifest(output, manifest)
    return manifest


def already_made(output: Path, settings: Mapping[str, object]) -> dict[str, TownEntry]:
    """Make the folder and return the towns that it holds by file; TrainingError where it holds others' places."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(f"cannot make {output}: {error.strerror or error}") from error
    if not (output / MANIFEST).exists():
        return {}
    before = read_manifest(output)
    _check_same(output, dict(before.settings), settings)
    return {town.file: town for town in before.towns if (output / town.file).exists()}


def make_town_file(folder: Path, task: TownTask, config: PlacesConfig, preprocessing: PreprocessingConfig) -> TownEntry:
    """Make one town and write its file."""
    started = time.perf_counter()
    town = make_town_places(task, config, preprocessing)
    write_town(folder / task.file, town)
    seconds = round(time.perf_counter() - started, 2)
    if isinstance(town, TrainingTown):
        return TownEntry(task.file, task.role, task.family, task.seed, len(town), 0, seconds)
    counts = len(town.query_xy_m), len(town.submap_xy_m)
    return TownEntry(task.file, task.role, task.family, task.seed, *counts, seconds)


def make_town_places(
    task: TownTask, config: PlacesConfig, preprocessing: PreprocessingConfig
) -> TrainingTown | ValidationTown:
    """Simulate one town: its survey at one epoch, scans anywhere in it, at any heading, at the other."""
    rng = np.random.default_rng(task.seed)
    flown_epoch = int(rng.integers(2))
    flown = make_town(task.seed, task.family, config.town_size_m, flown_epoch)
    driven = make_town(task.seed, task.family, config.town_size_m, 1 - flown_epoch)
    above_ground = survey_above_ground(flown, config, rng)
    validating = task.role == VALIDATION
    count = config.validation_scans if validating else config.scans
    border_m = preprocessing.half_extent_m + 10.0
    poses = driven.sample_poses(count, rng, border_m=border_m, tilt_deg=config.tilt_deg)
    if validating:
        return _validation_town(task, driven, poses, above_ground, config, preprocessing, rng)
    worlds: list[World] = [driven] * len(poses)
    if config.surface_share > 0:
        poses, worlds = _partly_surveyed(driven, poses, config, preprocessing)
    return training_town(task.file, poses, worlds, above_ground, config, preprocessing, rng)


def surveyed_world(town: Town, config: PlacesConfig) -> World:
    """Return what an airborne survey shows of a town as a world to drive through, as if it were a real survey.

    Half of the towns have no points of class building, as some national surveys, so that roofs are guessed.
    """
    rng = np.random.default_rng([town.seed, town.epoch, _SURFACE_STREAM])
    survey = fly(town, _flight(config), rng)
    classes = survey.classification
    if rng.random() < 0.5:
        classes = np.where(classes == BUILDING, np.uint8(_UNCLASSIFIED), classes)
    # A water's few echoes would make ground of it.
    dry = classes != WATER
    return world_from_points(
        survey.points[dry], classes[dry], town.bounds, name=town.name, crs=town.crs, origin_grid=town.origin_grid,
        seed=town.seed, least_share=0.25,
    )  # fmt: skip


def _flight(config: PlacesConfig) -> SurveyConfig:
    return SurveyConfig(spacing_m=config.survey_spacing_m, vertical_error_m=config.survey_vertical_error_m)


def survey_above_ground(town: Town, config: PlacesConfig, rng: np.random.Generator) -> Float64Array:
    """Fly over a town and return the points (N, 3) x, y and height above the terrain, as the map's builder has them.

    The terrain is made from the points of class ground, not taken from the simulator: the same errors as in a map.
    """
    survey = fly(town, _flight(config), rng)
    return above_terrain(survey.points, survey.classification, town.bounds, config.cell_m)


def above_terrain(points: Float64Array, classes: UInt8Array, bounds: Bounds, cell_m: float) -> Float64Array:
    """Return points (N, 3) with the height above the terrain, made from those of class ground, for z."""
    terrain = terrain_raster(points, classes == GROUND, bounds, cell_m)
    return np.column_stack([points[:, :2], points[:, 2] - terrain.sample(points[:, 0], points[:, 1])])


def scan_town(
    world: World, T_world_base: Float64Array, config: PlacesConfig, rng: np.random.Generator
) -> tuple[Scan, ScanConfig, Float64Array | None]:
    """Scan a world from a pose (4, 4) of the robot; return the scan, its settings and the IMU's "up", at times none."""
    mounting = MountingConfig(z_m=float(rng.uniform(*config.sensor_height_m)))
    T_base_lidar = mounting_matrix(mounting)
    twist = np.array([rng.uniform(0.0, 2.0), 0.0, 0.0, 0.0, 0.0, rng.uniform(-0.5, 0.5)])
    scan = Vlp16().scan(world.scene, T_world_base @ T_base_lidar, rng, twist).as_scan()
    up = None
    if rng.random() < config.imu_share:
        up = T_world_base[2, :3] + rng.normal(0.0, 0.004, 3)
    return scan, ScanConfig(mounting=mounting), up


def training_town(
    file: str, poses: Float64Array, worlds: Sequence[World], above_ground: Float64Array, config: PlacesConfig,
    preprocessing: PreprocessingConfig, rng: np.random.Generator,
) -> TrainingTown:  # fmt: skip
    """Scan from poses (S, 4, 4), each in its world, and keep what has something to show beside the survey's points."""
    # As far as the corners of a rotated square, and with every point: the patch is made when the heading is known.
    reach_m = preprocessing.scan_half_extent_m * _DIAGONAL
    whole = dataclasses.replace(preprocessing, scan_half_extent_m=reach_m, n_points=_MOST_SCAN_POINTS)
    places: list[Float64Array] = []
    headings: list[float] = []
    scans: list[Float32Array] = []
    for world, pose in zip(worlds, poses, strict=True):
        scan, scan_config, up = scan_town(world, pose, config, rng)
        patch = prepare_scan(scan, scan_config, whole, up).patch
        if patch is not None:
            places.append(pose[:2, 3])
            headings.append(math.atan2(pose[1, 0], pose[0, 0]))
            scans.append(patch.points[: patch.source_count] * np.float32(100.0 * reach_m))
    above = above_ground[above_ground[:, 2] >= preprocessing.ground_clearance_m].astype(np.float32)
    if preprocessing.thin_m > 0 and len(above):
        kept, available = choose_points(above, len(above), preprocessing.thin_m, preprocessing.seed)
        above = kept[:available]
    return TrainingTown(
        name=Path(file).stem,
        scan_xy_m=np.array(places).reshape(-1, 2),
        scan_heading_rad=np.array(headings),
        scan_points_cm=np.rint(np.concatenate([np.empty((0, 3), np.float32), *scans])).astype(np.int16),
        scan_starts=np.cumsum([0, *(len(scan) for scan in scans)]).astype(np.int64),
        survey_points=above,
    )


def _partly_surveyed(
    driven: Town, poses: Float64Array, config: PlacesConfig, preprocessing: PreprocessingConfig
) -> tuple[Float64Array, list[World]]:
    """Return poses, some of them chosen anew in what a survey shows of the town, and each one's world."""
    # A stream of its own: the other scans' places do not change with the share.
    rng = np.random.default_rng([driven.seed, _SURFACE_STREAM])
    chosen = np.flatnonzero(rng.random(len(poses)) < config.surface_share)
    worlds: list[World] = [driven] * len(poses)
    if len(chosen) == 0:
        return poses, worlds
    surface = surveyed_world(driven, config)
    border_m = preprocessing.half_extent_m + 10.0
    try:
        moved = surface.sample_poses(
            len(chosen), rng, clearance_m=SURFACE_CLEARANCE_M, border_m=border_m, tilt_deg=config.tilt_deg
        )
    except ValueError:  # the survey shows no room to drive
        return poses, worlds
    poses = poses.copy()
    poses[chosen] = moved
    for i in chosen:
        worlds[i] = surface
    return poses, worlds


def _validation_town(
    task: TownTask, driven: Town, poses: Float64Array, above_ground: Float64Array, config: PlacesConfig,
    preprocessing: PreprocessingConfig, rng: np.random.Generator,
) -> ValidationTown:  # fmt: skip
    n_points = preprocessing.n_points
    cutter = SubmapCutter(above_ground, preprocessing)
    # Submaps that reach a little beyond the survey, as the builder admits them.
    inset = 0.8 * preprocessing.half_extent_m
    low_x, low_y, high_x, high_y = driven.bounds
    centres = submap_centres((low_x + inset, low_y + inset, high_x - inset, high_y - inset), config.spacing_m)
    cut = [(centre, patch.points) for centre in centres if (patch := cutter.cut(centre)) is not None]
    queries = []
    for pose in poses:
        scan, scan_config, up = scan_town(driven, pose, config, rng)
        patch = prepare_scan(scan, scan_config, preprocessing, up).patch
        if patch is not None:
            queries.append((pose[:2, 3], patch.points))
    return ValidationTown(
        name=Path(task.file).stem,
        query_xy_m=np.array([place for place, _ in queries]).reshape(-1, 2),
        query_patches=np.array([points for _, points in queries], np.float32).reshape(-1, n_points, 3),
        submap_xy_m=np.array([centre for centre, _ in cut]).reshape(-1, 2),
        submap_patches=np.array([points for _, points in cut], np.float32).reshape(-1, n_points, 3),
    )


def _make_all(
    folder: Path, tasks: Sequence[TownTask], config: PlacesConfig, preprocessing: PreprocessingConfig, workers: int
) -> Iterator[TownEntry]:
    if workers <= 1:
        for task in tasks:
            yield make_town_file(folder, task, config, preprocessing)
        return
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(make_town_file, folder, task, config, preprocessing) for task in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _manifest(settings: dict[str, object], tasks: Sequence[TownTask], made: dict[str, TownEntry]) -> Manifest:
    return Manifest(settings, tuple(made[task.file] for task in tasks if task.file in made))


def _check_same(output: Path, before: dict[str, Any], now: Mapping[str, Any]) -> None:
    # A setting that came later has its default in sets made before.
    before["places"] = to_dict(PlacesConfig()) | before.get("places", {})
    for key in sorted(now.keys() - {"towns", "validation_towns"}):
        if json.dumps(before.get(key), sort_keys=True) != json.dumps(now[key], sort_keys=True):
            raise TrainingError(
                f"{output} holds places of another '{key}' ({before.get(key)}, now {now[key]}): name another folder"
            )
