"""The Amsterdam benchmark: a map of the real survey of 2010, a simulated lidar in the real survey of 2014.

The submaps are cut as `build_map` cuts them. The queries are the
demo's drive, and scans spread over all streets of the survey, which say more than one drive does.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map.aerial_patches import cut_aerial
from crossloc3d_ros.aerial_map.store import sha256
from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig, ScanConfig, to_dict
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet, join_places
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.datasets.simulated import scan_places, sources_digest
from crossloc3d_ros.errors import EvaluationError, MapError
from crossloc3d_ros.simulation import lidar, mesh, real_world, route, scene, vlp16, world
from crossloc3d_ros.simulation.lidar import LidarConfig
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.simulation.vlp16 import Vlp16
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Float64Array

VERSION = 1
MAP_SURVEY, DRIVE_SURVEY = "ahn2_2010.laz", "ahn3_2014.laz"
DRIVE, SPREAD = "the demo's drive", "all streets"

Progress = Callable[[str, float, float, str], None]


@dataclass(frozen=True)
class AmsterdamBenchmark:
    """How the real survey is evaluated."""

    drive_length_m: float = 600.0
    drive_speed_m_s: float = 5.0
    drive_seed: int = 3
    """Length, speed and seed are the demo's, so that it is the same drive."""
    drive_every_m: float = 5.0
    """Between two queries."""
    spread: int = 300
    """Scans at random places and in random headings."""
    spread_seed: int = 960_000
    border_m: float = 50.0
    """The scans at random places lie at least so far inside the survey of 2014."""
    clearance_m: float = 1.5
    scan: ScanConfig = dataclasses.field(default_factory=ScanConfig)
    sensor: LidarConfig = dataclasses.field(default_factory=LidarConfig)
    build: BuildConfig = dataclasses.field(default_factory=BuildConfig)


def find_surveys(folder: Path | None) -> Path:
    """Return the folder with the two surveys: the given one, or the clone's `maps/amsterdam`; MapError otherwise."""
    choices = (
        [folder]
        if folder is not None
        else [Path("maps/amsterdam"), Path(__file__).resolve().parents[2] / "maps" / "amsterdam"]
    )
    for choice in choices:
        if all((choice / name).is_file() for name in (MAP_SURVEY, DRIVE_SURVEY)):
            return choice
    raise MapError(
        f"{choices[0]} does not hold {MAP_SURVEY} and {DRIVE_SURVEY}; run the demo in a clone of the repository, or "
        "name their folder with --surveys"
    )


AMSTERDAM = AmsterdamBenchmark()


def settings_of(benchmark: AmsterdamBenchmark, surveys: Path, preprocessing: PreprocessingConfig) -> dict[str, Any]:
    """Return everything that decides what the set holds, as plain values."""
    settings = dataclasses.asdict(benchmark)
    for name in ("workers", "chunk_points"):  # how the builder works, not what comes out
        del settings["build"][name]
    for name in ("period_s", "stamped_at", "deskew"):  # how stamps are read, not what is seen
        del settings["scan"][name]
    for name in (MAP_SURVEY, DRIVE_SURVEY):
        if not (surveys / name).is_file():
            raise EvaluationError(f"{surveys} does not hold {name}: name the folder of the two surveys")
    return {
        "version": VERSION,
        "benchmark": settings,
        "preprocessing": to_dict(preprocessing),
        "surveys": {name: sha256(surveys / name) for name in (MAP_SURVEY, DRIVE_SURVEY)},
        "simulator": sources_digest(real_world, mesh, world, route, scene, lidar, vlp16),
    }


def make_amsterdam_set(
    benchmark: AmsterdamBenchmark,
    surveys: Path,
    preprocessing: PreprocessingConfig,
    work: Path,
    progress: Progress | None = None,
) -> EvaluationSet:
    """Build the map and scan the town; `work` is a folder for what is needed in between. One area, two groups."""
    report = progress or (lambda stage, done, total, unit: None)
    submaps, crs = built_submaps([surveys / MAP_SURVEY], benchmark.build, preprocessing, work, report)
    town = world_from_survey([surveys / DRIVE_SURVEY], seed=benchmark.drive_seed, progress=report)
    if town.crs != crs:
        raise EvaluationError(f"the two surveys of {surveys} lie in different UTM zones ({crs}, {town.crs})")
    driven = _prepared(raw_drive(town, benchmark), benchmark, preprocessing)
    spread = _prepared(raw_spread(town, benchmark), benchmark, preprocessing)
    queries = join_places([_in_grid(driven, town), _in_grid(spread, town)], [0, 0])
    groups = (DRIVE,) * len(driven) + (SPREAD,) * len(spread)
    return EvaluationSet("amsterdam", queries, submaps, None, ("Amsterdam",), ("real old town",), groups)


def built_submaps(
    surveys: Sequence[Path], config: BuildConfig, preprocessing: PreprocessingConfig, work: Path, report: Progress
) -> tuple[PlaceSet, str]:
    """Return the submaps that `build_map` makes of surveys, in the map's grid frame, and the map's CRS."""
    with tempfile.TemporaryDirectory(dir=work) as folder:
        cut = cut_aerial(
            surveys,
            Path(folder) / "submaps",
            config,
            preprocessing,
            progress=lambda p: report(p.stage, p.done, p.total, p.unit),
        )
        patches = cut.patches(np.arange(len(cut)))
    places = PlaceSet(
        list(patches),
        np.zeros(len(cut), np.int64),
        np.ascontiguousarray(cut.grid[:, :2]),
        np.zeros(len(cut)),
    )
    return places, cut.crs


def raw_drive(town: World, benchmark: AmsterdamBenchmark) -> Iterator[RawScan]:
    """Yield scans along the demo's drive, with poses in the town's local frame."""
    rng = np.random.default_rng([benchmark.drive_seed, 1])
    way = plan_route(
        town,
        benchmark.drive_length_m,
        rng,
        clearance_m=benchmark.clearance_m,
        speed_m_s=benchmark.drive_speed_m_s,
    )
    poses = way.at(way.time_s)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2, 3], axis=0).T))])
    first = 1.0 / benchmark.sensor.rate_hz  # a whole turn of the sensor must lie behind
    every = np.arange(np.interp(first, way.time_s, along), along[-1], benchmark.drive_every_m)
    # Along a drive that stands still now and then, many times share one place: the first of them counts.
    moments = way.time_s[np.searchsorted(along, every)]
    return _raw_scans(town, way.at(moments), way.twist(moments), benchmark, benchmark.drive_seed)


def raw_spread(town: World, benchmark: AmsterdamBenchmark) -> Iterator[RawScan]:
    """Yield scans at random places and in random headings, with poses in the town's local frame."""
    rng = np.random.default_rng(benchmark.spread_seed)
    poses = town.sample_poses(benchmark.spread, rng, clearance_m=benchmark.clearance_m, border_m=benchmark.border_m)
    twists = np.zeros((len(poses), 6))
    twists[:, 0] = rng.uniform(0.0, 2.0, len(poses))
    twists[:, 5] = rng.uniform(-0.5, 0.5, len(poses))
    return _raw_scans(town, poses, twists, benchmark, benchmark.spread_seed)


def _raw_scans(
    town: World, poses: Float64Array, twists: Float64Array, benchmark: AmsterdamBenchmark, seed: int
) -> Iterator[RawScan]:
    """Scan from poses (S, 4, 4) at twists (S, 6) of the base."""
    rng = np.random.default_rng([seed, 2])
    sensor = Vlp16(benchmark.sensor)
    T_base_lidar = mounting_matrix(benchmark.scan.mounting)
    R = T_base_lidar[:3, :3]
    for pose, twist in zip(poses, twists, strict=True):
        velocity = twist[:3] + np.cross(twist[3:], T_base_lidar[:3, 3])
        lidar_twist = np.concatenate([R.T @ velocity, R.T @ twist[3:]])
        yield RawScan(sensor.scan(town.scene, pose @ T_base_lidar, rng, lidar_twist).points, pose, T_base_lidar)


def _prepared(scans: Iterable[RawScan], benchmark: AmsterdamBenchmark, preprocessing: PreprocessingConfig) -> PlaceSet:
    """Return the places of scans; those without a patch fall away."""
    patches = [(scan.T_grid_base, prepare_scan(scan.as_scan(), benchmark.scan, preprocessing).patch) for scan in scans]
    return scan_places([(pose, patch.points) for pose, patch in patches if patch is not None], preprocessing)


def _in_grid(places: PlaceSet, town: World) -> PlaceSet:
    return dataclasses.replace(places, xy_m=places.xy_m + town.origin_grid[:2])
