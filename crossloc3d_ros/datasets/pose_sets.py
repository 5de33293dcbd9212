"""The sets on which poses are fitted and evaluated: an aerial map, and raw scans with the true pose of each.

    pose_set = open_pose_set("simulated_small", Path("out/benchmark"), load_encoder)
    scan = pose_set.scans[0]
    estimate = localizer.localize(scan.as_scan(), scan.up_base, scan.T_base_lidar)
    scan.T_grid_base            # where it truly was

A simulated set is a mosaic: every town is flown as a square, the squares lie side by side in one CRS, and one map is
built of all by `build_map` itself. Robots keep 60 m away from the seams, because no town knows of its neighbour.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.datasets import amsterdam
from crossloc3d_ros.datasets import benchmarks as benchmark
from crossloc3d_ros.datasets.amsterdam import AMSTERDAM, AmsterdamBenchmark
from crossloc3d_ros.datasets.made import is_made, mark_made, whole
from crossloc3d_ros.datasets.raw_scans import RawScan, RawScans, load_scans, save_scans
from crossloc3d_ros.datasets.set_maps import Progress, make_map
from crossloc3d_ros.datasets.simulated import SIMULATED, BenchmarkTown, SimulatedBenchmark, raw_scans, sources_digest
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.simulation import lidar, survey, vlp16
from crossloc3d_ros.simulation.lidar import Lidar
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.survey import fly, write_survey
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.simulation.world import Bounds, World
from crossloc3d_ros.types import Float64Array
from crossloc3d_ros.workers import EncoderLoader

_log = logging.getLogger(__name__)

VERSION = 1
MANIFEST = "pose_set.json"
SURVEY = "survey"
"""The folder of a town's LAZ tiles beside its scans."""
ALL = "drawn by lot"
SEAM_M = 60.0
"""How far robots stay inside of their town's square: beyond it the map shows another town."""
_MOSAIC_ORIGIN = np.array([500_000.0, 5_800_000.0, 0.0])
"""South-western corner of every mosaic, EPSG:32631."""
_TOWN_BEYOND_M, _BEYOND_FLOWN_M = 60.0, 20.0
"""How far a simulated town goes on beyond the bounds that are given; how much wider it is than what is flown."""


@dataclass(frozen=True)
class SimulatedPoses:
    """A mosaic of simulated towns, and others that lie off its map."""

    examined: SimulatedBenchmark
    """The towns of the map, the side of the square flown of each, and how scans are taken (`queries` a town)."""
    columns: int
    """Towns beside each other; the rows follow from it, from the south."""
    off_map: tuple[BenchmarkTown, ...] = ()
    """Towns that are driven through but not flown: nothing there may be taken for a place of the map."""
    off_map_scans: int = 0
    """Scans in each of them."""

    def corner(self, town: int) -> tuple[float, float]:
        """Return the south-western corner of a town's square, metres from the mosaic's."""
        row, column = divmod(town, self.columns)
        return column * self.examined.town_size_m, row * self.examined.town_size_m


@dataclass(frozen=True, eq=False)
class PoseSet:
    """A map and raw scans with true poses, in the map's grid."""

    name: str
    map_folder: Path
    scans: RawScans
    area_names: tuple[str, ...]
    """Of each area, such as a town."""
    families: tuple[str, ...]
    """What kind of town each area is."""
    on_map: tuple[bool, ...]
    """Whether the map shows the area."""
    groups: tuple[str, ...]
    """Names of the groups that `RawScan.group` counts."""
    folder: Path
    """Where all of it lies."""


def _town(family: str, seed: int) -> BenchmarkTown:
    return BenchmarkTown(family, seed, family in ("village", "harbour"))


def _some_of(families: dict[str, int]) -> tuple[BenchmarkTown, ...]:
    """Return the first towns of each family of the retrieval benchmark."""
    counts = dict(families)
    chosen = []
    for town in SIMULATED.towns:
        if counts.get(town.family, 0) > 0:
            counts[town.family] -= 1
            chosen.append(town)
    return tuple(chosen)


_MAPPED = _some_of(
    {
        "old_town": 2, "suburb": 2, "campus": 1, "industry": 2, "park_edge": 1, "estate": 2, "canal_town": 2,
        "village": 2, "harbour": 2,
    }
)  # fmt: skip

AWAY = _town("canal_town", 900_063)
"""The town that the robot is in when it is not in Amsterdam: of all families the most alike."""

POSE_SETS: dict[str, SimulatedPoses | AmsterdamBenchmark] = {
    "simulated": SimulatedPoses(
        SimulatedBenchmark(_MAPPED, town_size_m=600.0, queries=30, ground=0),
        columns=4,
        off_map=(_town("old_town", 900_002), _town("canal_town", 900_063), _town("village", 900_074)),
        off_map_scans=30,
    ),
    "simulated_small": SimulatedPoses(
        SimulatedBenchmark(
            (_town("old_town", 950_000), _town("suburb", 950_010), _town("canal_town", 950_060),
             _town("village", 950_070)),
            town_size_m=400.0, queries=12, ground=0,
        ),
        columns=2,
        off_map=(_town("campus", 950_020),),
        off_map_scans=12,
    ),
    "fitting": SimulatedPoses(
        SimulatedBenchmark(
            tuple(_town(family, 159_000 + 10 * i) for i, family in enumerate(
                ("old_town", "suburb", "campus", "industry", "estate", "canal_town")
            )),
            town_size_m=400.0, queries=40, ground=0,
        ),
        columns=3,
        off_map=(_town("park_edge", 159_060), _town("old_town", 159_001)),
        off_map_scans=40,
    ),
    "amsterdam": AMSTERDAM,
}  # fmt: skip
"""`simulated`: 16 towns on 5.76 km2, of the families never learned from too. `fitting`: towns of other seeds, for
whatever has to be tuned. `amsterdam`: the map of 2010, scans in the survey of 2014."""


@dataclass(frozen=True)
class _Part:
    """One town of a set: where it is kept, how it is made."""

    folder: Path
    settings: dict[str, Any]
    poses: SimulatedPoses
    town: BenchmarkTown
    corner: tuple[float, float] | None
    """South-western corner of its square in the mosaic, metres; None off the map."""


def open_pose_set(
    name: str,
    data: Path,
    loader: EncoderLoader,
    *,
    workers: int = 1,
    surveys: Path | None = None,
    progress: Progress | None = None,
) -> PoseSet:
    """Return a set of `POSE_SETS`, making what is not there yet.

    It is kept in `data/pose-NAME-HASH`, its map beside it for the weights that `loader` loads. A call that was stopped
    goes on town by town, and the map tile by tile. `surveys`: the folder of the two surveys, for Amsterdam. Raises
    ConfigError for an unknown name and EvaluationError for what cannot be made or written.
    """
    if name not in POSE_SETS:
        raise ConfigError(f"unknown pose set '{name}'; known are: {', '.join(POSE_SETS)}")
    chosen, report = POSE_SETS[name], progress or (lambda stage, done, total, unit: None)
    if isinstance(chosen, SimulatedPoses):
        return make_pose_set(name, chosen, data, loader, workers=workers, progress=report)
    if surveys is None:
        raise EvaluationError(f"the pose set '{name}' needs the folder of its two surveys")
    return _make_amsterdam(name, chosen, data, surveys, loader, workers, report)


def make_pose_set(
    name: str,
    poses: SimulatedPoses,
    data: Path,
    loader: EncoderLoader,
    *,
    workers: int = 1,
    progress: Progress | None = None,
) -> PoseSet:
    """Make a simulated set, or what is missing of it, in `data/pose-NAME-HASH`, and load it."""
    report = progress or (lambda stage, done, total, unit: None)
    settings = settings_of(poses)
    folder = benchmark.folder_of(data, f"pose-{name}", settings)
    parts = _parts_of(poses, folder, settings)
    with benchmark.alone(folder):
        missing = [part for part in parts if not is_made(part.folder, part.settings)]
        done, total = len(parts) - len(missing), len(parts)

        def advance(towns: int) -> None:
            nonlocal done
            done += towns
            report("making", done, total, "towns")

        if missing:
            advance(0)
            benchmark.without_encoder(_make_part, missing, workers, folder, advance)
        towns = [*poses.examined.towns, *poses.off_map]
        map_folder = make_map(
            folder, [part.folder / SURVEY for part in parts if part.corner is not None], poses.examined.build, loader,
            workers, report,
        )  # fmt: skip
        write_manifest(
            folder,
            {
                "name": name,
                "parts": [part.folder.name for part in parts],
                "areas": [town.name for town in towns],
                "families": [town.family for town in towns],
                "on_map": [part.corner is not None for part in parts],
                "groups": [ALL],
                "settings": settings,
            },
        )
    return load_pose_set(folder, map_folder)


def load_pose_set(folder: Path, map_folder: Path | None = None) -> PoseSet:
    """Read a set that was made; `map_folder`: its map, by default the only one in the set's folder.

    Raises EvaluationError where it is missing, incomplete or damaged, and where several maps are to choose from.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        if map_folder is None:
            maps = sorted(path.parent for path in folder.glob(f"map-*/{store.MANIFEST}"))
            if len(maps) != 1:
                raise EvaluationError(f"{folder} holds {len(maps)} maps instead of one: say which")
            map_folder = maps[0]
        parts = [load_scans(folder / part) for part in manifest["parts"]]
        return PoseSet(
            str(manifest["name"]),
            map_folder,
            RawScans.join(parts, range(len(parts))),
            tuple(manifest["areas"]),
            tuple(manifest["families"]),
            tuple(manifest["on_map"]),
            tuple(manifest["groups"]),
            folder,
        )
    except FileNotFoundError as error:
        raise EvaluationError(f"{folder} holds no pose set") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError(f"{folder / MANIFEST} is damaged ({error}); make the set anew") from error


def settings_of(poses: SimulatedPoses) -> dict[str, Any]:
    """Return everything that decides what the set holds; the encoder is no part of it."""
    settings = dataclasses.asdict(poses)
    for name in ("workers", "chunk_points"):  # how the builder works, not what comes out
        del settings["examined"]["build"][name]
    probe = poses.examined.towns[0]
    digests = [make_town(probe.seed, probe.family, 200.0, epoch).digest() for epoch in range(2)]
    return benchmark.plain(
        {
            "version": VERSION,
            "poses": settings,
            "seam_m": SEAM_M,
            "towns": hashlib.sha256("".join(digests).encode()).hexdigest()[:16],
            "sensors": sources_digest(lidar, vlp16, survey),
        }
    )


def _parts_of(poses: SimulatedPoses, folder: Path, settings: dict[str, Any]) -> list[_Part]:
    parts = []
    for i, town in enumerate(poses.examined.towns):
        parts.append(_Part(folder / f"{town.family}_{town.seed}", settings, poses, town, poses.corner(i)))
    for town in poses.off_map:
        parts.append(_Part(folder / f"{town.family}_{town.seed}", settings, poses, town, None))
    return parts


def placed_town(
    town: BenchmarkTown, epoch: int, side_m: float, corner: tuple[float, float] | None
) -> tuple[World, Bounds]:
    """Return a town as it lies in the mosaic, and the square of it that is flown.

    The world's own bounds are where robots may drive. `corner`: south-western corner of its square in the mosaic;
    None puts it 100 km to the east, on no map.
    """
    made = make_town(town.seed, town.family, side_m - 2.0 * _TOWN_BEYOND_M + _BEYOND_FLOWN_M, epoch)
    x, y = corner if corner is not None else (100_000.0, 0.0)
    origin = _MOSAIC_ORIGIN + np.array([x + side_m / 2.0, y + side_m / 2.0, 0.0])
    half = side_m / 2.0
    driven = Bounds(-half + SEAM_M, -half + SEAM_M, half - SEAM_M, half - SEAM_M)
    return dataclasses.replace(made, origin_grid=origin, bounds=driven), Bounds(-half, -half, half, half)


def _make_part(part: _Part, advance: Callable[[int], None] | None) -> None:
    """Fly a town at one epoch where it is on the map, and scan it at the other."""
    examined, town = part.poses.examined, part.town
    epoch = town.seed % 2
    with whole(part.folder) as partial:
        if part.corner is not None:
            world, flown = placed_town(town, epoch, examined.town_size_m, part.corner)
            world = dataclasses.replace(world, bounds=flown)
            seen = fly(world, examined.flight, np.random.default_rng([town.seed, 1]))
            write_survey(world, seen, partial / SURVEY, tile_m=500.0)
        world, _ = placed_town(town, 1 - epoch, examined.town_size_m, part.corner)
        count = examined.queries if part.corner is not None else part.poses.off_map_scans
        save_scans(partial, scans_of_town(world, town, examined, count))
        mark_made(partial, part.settings)
    if advance is not None:
        advance(1)


def scans_of_town(
    world: World, town: BenchmarkTown, examined: SimulatedBenchmark, count: int, sensor: Lidar | None = None
) -> RawScans:
    """Return so many scans, with poses in the grid, of a town as it stands at the epoch that is not flown.

    `sensor`: in place of the benchmark's VLP-16, at the same places.
    """
    rng = np.random.default_rng([town.seed, 2, 1 - town.seed % 2])
    local = world.sample_poses(count, rng, clearance_m=examined.clearance_m, border_m=0.0, tilt_deg=examined.tilt_deg)
    return RawScans.of(to_grid(scan, world) for scan in raw_scans(world, local, examined, rng, sensor))


def to_grid(scan: RawScan, world: World, group: int = 0) -> RawScan:
    """Return a scan whose pose is local to a world with its pose in the world's grid."""
    pose: Float64Array = scan.T_grid_base.copy()
    pose[:3, 3] = world.to_grid(pose[None, :3, 3])[0]
    return dataclasses.replace(scan, T_grid_base=pose, group=group)


def _make_amsterdam(
    name: str,
    examined: AmsterdamBenchmark,
    data: Path,
    surveys: Path,
    loader: EncoderLoader,
    workers: int,
    report: Progress,
) -> PoseSet:
    encoder = loader()
    settings = benchmark.plain(amsterdam.settings_of(examined, surveys, encoder.preprocessing))
    del settings["preprocessing"]  # raw scans do not depend on it
    folder = benchmark.folder_of(data, f"pose-{name}", settings)
    with benchmark.alone(folder):
        if not is_made(folder / "scans", settings):
            town = world_from_survey([surveys / amsterdam.DRIVE_SURVEY], seed=examined.drive_seed, progress=report)
            with whole(folder / "scans") as partial:
                driven = [to_grid(scan, town, 0) for scan in amsterdam.raw_drive(town, examined)]
                spread = [to_grid(scan, town, 1) for scan in amsterdam.raw_spread(town, examined)]
                save_scans(partial, RawScans.of([*driven, *spread]))
                mark_made(partial, settings)
        map_folder = make_map(folder, [surveys / amsterdam.MAP_SURVEY], examined.build, lambda: encoder, 1, report)
        write_manifest(
            folder,
            {
                "name": name,
                "parts": ["scans"],
                "areas": ["Amsterdam", AWAY.name],
                "families": ["real old town", AWAY.family],
                "on_map": [True, False],
                "groups": [amsterdam.DRIVE, amsterdam.SPREAD],
                "settings": settings,
            },
        )
    return load_pose_set(folder, map_folder)


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Write what `load_pose_set` reads of a set beside its scans."""
    write_atomically(folder / MANIFEST, json.dumps(manifest, indent=1) + "\n", EvaluationError)
