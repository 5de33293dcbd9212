"""The fixed simulated benchmark: which towns, how they are flown and driven, and how one of them is made.

Every town is named here with its family and seed, so that no later change to the list of families moves one. Their
seeds belong to no set of training places, and two families are never learned from at all.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map.tile import coverage, distance_to_points, ground_heights, margin_m
from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.clouds.raster import surface_raster, terrain_raster
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.clouds.tiling import SubmapCutter, submap_centres
from crossloc3d_ros.config import BuildConfig, MountingConfig, PreprocessingConfig, ScanConfig, to_dict
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.formats.las import GROUND
from crossloc3d_ros.simulation import lidar, survey, vlp16
from crossloc3d_ros.simulation.lidar import Lidar, LidarConfig
from crossloc3d_ros.simulation.survey import SurveyConfig, fly
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.simulation.vlp16 import Vlp16
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Float32Array, Float64Array

VERSION = 1
"""Raised when the making changes in a way that the settings do not show: sets made before are stale then."""
SEEN, HELD_OUT = "families seen in training", "held-out families"


@dataclass(frozen=True)
class BenchmarkTown:
    """One town of a benchmark."""

    family: str
    seed: int
    held_out: bool
    """Whether training never sees a town of this family."""

    @property
    def name(self) -> str:
        """The town's name in tables."""
        return f"{self.family} {self.seed}"


@dataclass(frozen=True)
class SimulatedBenchmark:
    """A fixed set of towns and how they are evaluated."""

    towns: tuple[BenchmarkTown, ...]
    town_size_m: float
    queries: int
    """Queries a town; those without a patch fall away."""
    ground: int
    """Scans of the ground database a town: other places, another day."""
    border_m: float = 50.0
    """Scans are taken at least so far inside the survey."""
    clearance_m: float = 1.2
    tilt_deg: float = 1.0
    """Standard deviation of the robot's roll and pitch, added to the slope's."""
    imu_share: float = 0.5
    """Share of the scans that an IMU levels."""
    sensor_height_m: tuple[float, float] = (0.9, 1.6)
    flight: SurveyConfig = dataclasses.field(default_factory=SurveyConfig)
    sensor: LidarConfig = dataclasses.field(default_factory=LidarConfig)
    build: BuildConfig = dataclasses.field(default_factory=BuildConfig)
    """How the map's builder cuts submaps."""


def _towns(seeds: dict[str, range], held_out: tuple[str, ...]) -> tuple[BenchmarkTown, ...]:
    return tuple(
        BenchmarkTown(family, seed, family in held_out) for family, family_seeds in seeds.items()
        for seed in family_seeds
    )  # fmt: skip


SIMULATED = SimulatedBenchmark(
    _towns(
        {
            "old_town": range(900_000, 900_003),
            "suburb": range(900_010, 900_013),
            "campus": range(900_020, 900_023),
            "industry": range(900_030, 900_033),
            "park_edge": range(900_040, 900_043),
            "estate": range(900_050, 900_053),
            "canal_town": range(900_060, 900_064),
            "village": range(900_070, 900_075),
            "harbour": range(900_080, 900_085),
        },
        held_out=("village", "harbour"),
    ),
    town_size_m=600.0,
    queries=48,
    ground=120,
)
"""32 towns, about 27,000 submaps and 1,500 queries."""

SIMULATED_SMALL = SimulatedBenchmark(
    _towns(
        {
            "old_town": range(950_000, 950_001),
            "suburb": range(950_010, 950_011),
            "campus": range(950_020, 950_021),
            "industry": range(950_030, 950_031),
            "estate": range(950_050, 950_051),
            "canal_town": range(950_060, 950_061),
            "village": range(950_070, 950_071),
            "harbour": range(950_080, 950_081),
        },
        held_out=("village", "harbour"),
    ),
    town_size_m=440.0,
    queries=52,
    ground=60,
)
"""8 other towns, about 3,500 submaps and 400 queries, for ablations and comparisons."""


def settings_of(benchmark: SimulatedBenchmark, preprocessing: PreprocessingConfig) -> dict[str, Any]:
    """Return everything that decides what the set holds, as plain values.

    Two sets with equal settings hold the same places: a digest of one town as it is made now changes when the
    simulator builds other towns, and one of the sensors' sources when they see them otherwise.
    """
    probe = benchmark.towns[0]
    digests = [make_town(probe.seed, probe.family, benchmark.town_size_m, epoch).digest() for epoch in range(3)]
    settings = dataclasses.asdict(benchmark)
    for name in ("workers", "chunk_points"):  # how the builder works, not what comes out
        del settings["build"][name]
    return {
        "version": VERSION,
        "benchmark": settings,
        "preprocessing": to_dict(preprocessing),
        "towns": hashlib.sha256("".join(digests).encode()).hexdigest()[:16],
        "sensors": sources_digest(lidar, vlp16, survey),
    }


def sources_digest(*modules: ModuleType) -> str:
    """Return 16 hexadecimal digits that change with the source of any of the modules."""
    digest = hashlib.sha256()
    for module in modules:
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()[:16]


def make_town_set(
    town: BenchmarkTown, benchmark: SimulatedBenchmark, preprocessing: PreprocessingConfig
) -> EvaluationSet:
    """Simulate one town: flown at one epoch, driven at the other, the ground database at a third; one area."""
    epoch = town.seed % 2
    submaps = _submaps(town, epoch, benchmark, preprocessing)
    queries = _scans(town, 1 - epoch, benchmark.queries, benchmark, preprocessing)
    ground = _scans(town, 2, benchmark.ground, benchmark, preprocessing) if benchmark.ground else None
    groups = (HELD_OUT if town.held_out else SEEN,) * len(queries)
    return EvaluationSet(town.name, queries, submaps, ground, (town.name,), (town.family,), groups)


def _submaps(
    town: BenchmarkTown, epoch: int, benchmark: SimulatedBenchmark, preprocessing: PreprocessingConfig
) -> PlaceSet:
    """Fly over the town and cut its submaps as the map's builder does, the terrain from the points of class ground."""
    world = make_town(town.seed, town.family, benchmark.town_size_m, epoch)
    flown = fly(world, benchmark.flight, np.random.default_rng([town.seed, 1]))
    cutter, centres = admitted_submaps(flown.points, flown.classification == GROUND, world, benchmark, preprocessing)
    cut = [(centre, patch.points) for centre in centres if (patch := cutter.cut(centre)) is not None]
    patches = np.array([points for _, points in cut], np.float32).reshape(-1, preprocessing.n_points, 3)
    xy_m = np.array([centre for centre, _ in cut]).reshape(-1, 2)
    return PlaceSet(patches, np.zeros(len(cut), np.int64), xy_m, np.zeros(len(cut)))


def admitted_submaps(
    points: Float64Array,
    is_ground: np.ndarray[Any, np.dtype[np.bool_]],
    world: World,
    benchmark: SimulatedBenchmark,
    preprocessing: PreprocessingConfig,
) -> tuple[SubmapCutter, Float64Array]:
    """Return what cuts submaps out of a survey (N, 3), and the centres (M, 2) of those that the builder admits."""
    config = benchmark.build
    margin = margin_m(preprocessing.half_extent_m, config.cell_m)
    low_x, low_y, high_x, high_y = world.bounds
    outer = (low_x - margin, low_y - margin, high_x + margin, high_y + margin)
    terrain = terrain_raster(points, is_ground, outer, config.cell_m)
    surface = surface_raster(points, outer, config.cell_m)
    heights = points[:, 2] - terrain.sample(points[:, 0], points[:, 1])
    centres = submap_centres(world.bounds, config.spacing_m)
    share = coverage(distance_to_points(surface), surface, centres, preprocessing.half_extent_m)
    admitted = (share >= config.min_coverage) & np.isfinite(ground_heights(terrain, centres))
    return SubmapCutter(np.column_stack([points[:, :2], heights]), preprocessing), centres[admitted]


def _scans(
    town: BenchmarkTown, epoch: int, count: int, benchmark: SimulatedBenchmark, preprocessing: PreprocessingConfig
) -> PlaceSet:
    """Scan the town from random places and in random headings, as the localizer prepares scans."""
    rng = np.random.default_rng([town.seed, 2, epoch])
    world = make_town(town.seed, town.family, benchmark.town_size_m, epoch)
    poses = world.sample_poses(
        count, rng, clearance_m=benchmark.clearance_m, border_m=benchmark.border_m, tilt_deg=benchmark.tilt_deg
    )
    prepared = []
    for raw in raw_scans(world, poses, benchmark, rng):
        mounting = MountingConfig(z_m=float(raw.T_base_lidar[2, 3]))
        patch = prepare_scan(raw.as_scan(), ScanConfig(mounting=mounting), preprocessing, raw.up_base).patch
        if patch is not None:
            prepared.append((raw.T_grid_base, patch.points))
    return scan_places(prepared, preprocessing)


def raw_scans(
    world: World,
    poses: Float64Array,
    benchmark: SimulatedBenchmark,
    rng: np.random.Generator,
    sensor: Lidar | None = None,
) -> Iterator[RawScan]:
    """Yield a scan of each local pose (S, 4, 4), by robots of different heights, with and without an IMU.

    The poses of the scans are those given, in the world's local frame. `sensor`: in place of the benchmark's VLP-16.
    """
    sensor = sensor or Vlp16(benchmark.sensor)
    for pose in poses:
        T_base_lidar = mounting_matrix(MountingConfig(z_m=float(rng.uniform(*benchmark.sensor_height_m))))
        twist = np.array([rng.uniform(0.0, 2.0), 0.0, 0.0, 0.0, 0.0, rng.uniform(-0.5, 0.5)])
        points = sensor.scan(world.scene, pose @ T_base_lidar, rng, twist).points
        levelled = rng.random() < benchmark.imu_share
        up = pose[2, :3] + rng.normal(0.0, 0.004, 3)
        yield RawScan(points, pose, T_base_lidar, up if levelled else None)


def scan_places(prepared: list[tuple[Float64Array, Float32Array]], preprocessing: PreprocessingConfig) -> PlaceSet:
    """Return the places of scans given as pose (4, 4) of the base and patch (n, 3), all in area 0."""
    return PlaceSet(
        np.array([points for _, points in prepared], np.float32).reshape(-1, preprocessing.n_points, 3),
        np.zeros(len(prepared), np.int64),
        np.array([pose[:2, 3] for pose, _ in prepared]).reshape(-1, 2),
        np.array([math.atan2(pose[1, 0], pose[0, 0]) for pose, _ in prepared], np.float64),
    )
