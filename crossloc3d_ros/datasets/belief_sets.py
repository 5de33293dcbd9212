"""What belief is evaluated on: sets of scans and drives on their own maps, and maps on which they are not.

    sets = open_belief_sets("simulated", Path("out/benchmark"), load_encoder, surveys=..., aerial=[...], learned=[...])
    sets.on_map     # each set under each of its conditions, with the map of that condition
    sets.maps       # every map, for drives from everywhere else

Maps and sets lie in `data`, beside the pose sets; a call that was stopped goes on where it was.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.store import AerialMap, sha256
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.datasets import benchmarks as benchmark
from crossloc3d_ros.datasets.aged import HOUSES_GONE, TREES_GONE, aged
from crossloc3d_ros.datasets.belief_conditions import CONDITIONS, DELIVERED, Condition
from crossloc3d_ros.datasets.halves import open_halves
from crossloc3d_ros.datasets.made import is_made, mark_made, whole
from crossloc3d_ros.datasets.pose_drives import (
    DRIVES,
    DrivePlan,
    RawDrive,
    drive_plans,
    load_drives,
    open_drives,
    record_drive,
    settings_of_plan,
)
from crossloc3d_ros.datasets.pose_sets import (
    ALL,
    POSE_SETS,
    SURVEY,
    PoseSet,
    SimulatedPoses,
    load_pose_set,
    open_pose_set,
    placed_town,
    scans_of_town,
    write_manifest,
)
from crossloc3d_ros.datasets.raw_scans import save_scans
from crossloc3d_ros.datasets.set_maps import Progress, make_map
from crossloc3d_ros.datasets.survey_parts import density_per_m2, write_part
from crossloc3d_ros.simulation.lidar import Lidar, LidarProfile
from crossloc3d_ros.simulation.profiles import PROFILES
from crossloc3d_ros.simulation.vlp16 import VLP16
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Float64Array
from crossloc3d_ros.workers import EncoderLoader

VERSION = 2
"""Raised where maps or scans come out otherwise though no setting has changed, as by another ground filter."""
_TOWN_SURVEY = "town.laz"
_OTHER_DRIVE, _LONGER = 500_000, 4.0 / 3.0
"""Added to the seed of a drive and times its length, for drives through aged towns; no other drive has such a seed."""
_APART_DEG = 0.002
"""A robot that is some 200 m away from a map sees nothing of it."""


@dataclass(frozen=True)
class BeliefMap:
    """A map on which drives from elsewhere are evaluated."""

    name: str
    folder: Path
    is_learned: bool
    """Whether something was learned or tuned on its survey."""


@dataclass(frozen=True, eq=False)
class BeliefSet:
    """Scans and drives, and their own map, under one condition."""

    name: str
    condition: Condition
    pose_set: PoseSet
    drives: tuple[RawDrive, ...]
    is_learned: bool = False
    """Whether something was learned or tuned on it."""


@dataclass(frozen=True, eq=False)
class BeliefSets:
    """Everything that is evaluated."""

    on_map: tuple[BeliefSet, ...]
    maps: tuple[BeliefMap, ...]


@dataclass(frozen=True)
class BeliefRequest:
    """Which sets and maps are wanted."""

    names: tuple[str, ...]
    """Of `POSE_SETS`."""
    data: Path
    surveys: Path | None = None
    """Folder of the two surveys of Amsterdam."""
    aerial: tuple[Path, ...] = ()
    """Further surveys, a file each: maps, and where they are dense enough, drives through one half of them."""
    learned: tuple[Path, ...] = ()
    """The same, of surveys that something was learned on."""


def open_belief_sets(
    request: BeliefRequest, loader: EncoderLoader, *, workers: int = 1, progress: Progress | None = None
) -> BeliefSets:
    """Return what is evaluated, making what is not there yet.

    Raises ConfigError for an unknown name and EvaluationError for what cannot be made or written.
    """
    report = progress or (lambda stage, done, total, unit: None)
    on_map: list[BeliefSet] = []
    maps: list[BeliefMap] = []
    for name in request.names:
        surveys = request.surveys if name == "amsterdam" else None
        pose_set = open_pose_set(name, request.data, loader, workers=workers, surveys=surveys, progress=report)
        drives = tuple(open_drives(pose_set, workers=workers, surveys=surveys, progress=report))
        poses = POSE_SETS[name]
        is_tuned = name == "fitting"
        maps.append(BeliefMap(name, pose_set.map_folder, is_tuned))
        if isinstance(poses, SimulatedPoses):
            conditions = _Conditions(pose_set, poses, drives, request.data, loader, workers, report)
            on_map += [dataclasses.replace(conditions.of(each), is_learned=is_tuned) for each in CONDITIONS]
        else:
            on_map.append(BeliefSet(name, DELIVERED, pose_set, drives))
    for path, is_learned in [*((p, False) for p in request.aerial), *((p, True) for p in request.learned)]:
        maps.append(BeliefMap(path.stem, _survey_map(path, request.data, loader, workers, report), is_learned))
        halves = open_halves(path, request.data, loader, progress=report)
        if halves is not None:
            on_map.append(BeliefSet(path.stem, DELIVERED, halves, tuple(load_drives(halves.folder)), is_learned))
    return BeliefSets(tuple(on_map), tuple(maps))


def are_apart(aerial_map: AerialMap, frame_map: AerialMap, T_grid_base: Float64Array) -> bool:
    """Return whether poses (S, 4, 4), which lie in the grid of `frame_map`, keep off another map altogether."""
    west, south, east, north = aerial_map.bounds
    corners = np.array([[e, n, 0.0] for e in (west, east) for n in (south, north)])
    low, high = _geographic_box(aerial_map, corners)
    first, last = _geographic_box(frame_map, T_grid_base[:, :3, 3])
    return bool(((first > high + _APART_DEG) | (last < low - _APART_DEG)).any())


def _geographic_box(aerial_map: AerialMap, grid: Float64Array) -> tuple[Float64Array, Float64Array]:
    latitude, longitude, _ = aerial_map.frame.to_geographic(grid)
    degrees = np.column_stack([latitude, longitude])
    return degrees.min(axis=0), degrees.max(axis=0)


def _survey_map(path: Path, data: Path, loader: EncoderLoader, workers: int, report: Progress) -> Path:
    settings = benchmark.plain({"survey": sha256(path), **_build_settings(BuildConfig())})
    folder = benchmark.folder_of(data, f"map-{path.stem}", settings)
    with benchmark.alone(folder):
        folder.mkdir(exist_ok=True)
        return make_map(folder, [path], BuildConfig(), loader, workers, report)


def _build_settings(build: BuildConfig) -> dict[str, Any]:
    settings = dataclasses.asdict(build)
    for name in ("workers", "chunk_points"):  # how the builder works, not what comes out
        del settings[name]
    return {"version": VERSION, "format": store.FORMAT_VERSION, "build": settings}


@dataclass(frozen=True)
class _Part:
    """Something of one town that is made for a condition."""

    folder: Path
    settings: dict[str, Any]
    poses: SimulatedPoses
    area: int
    survey: Path
    """Folder of the town's LAZ tiles."""
    share: float = 1.0
    """Of the survey's points."""
    plan: DrivePlan | None = None
    """The drive that is recorded; None: single scans, or a thinner survey."""
    condition: Condition | None = None
    """Under which it is scanned; None: a thinner survey."""

    @property
    def lidar(self) -> LidarProfile:
        """What it is scanned with."""
        return PROFILES[(self.condition or DELIVERED).lidar]


class _Conditions:
    """The conditions of one simulated set."""

    def __init__(
        self, pose_set: PoseSet, poses: SimulatedPoses, drives: tuple[RawDrive, ...], data: Path,
        loader: EncoderLoader, workers: int, report: Progress,
    ) -> None:  # fmt: skip
        self._pose_set, self._poses, self._drives = pose_set, poses, drives
        self._loader, self._workers, self._report = loader, workers, report
        self._settings = benchmark.plain(
            {"set": pose_set.folder.name, "gone": [TREES_GONE, HOUSES_GONE], **_build_settings(poses.examined.build)}
        )
        self._folder = benchmark.folder_of(data, f"belief-{pose_set.name}", self._settings)
        towns = poses.examined.towns
        self._surveys = [pose_set.folder / f"{town.family}_{town.seed}" / SURVEY for town in towns]

    def of(self, condition: Condition) -> BeliefSet:
        """Return the set under a condition."""
        pose_set, drives = self._pose_set, self._drives
        if condition.is_recorded_anew:
            pose_set = self._recorded(condition)
            drives = tuple(load_drives(pose_set.folder))
        if condition.density_per_m2 is not None:
            pose_set = dataclasses.replace(pose_set, map_folder=self._thinned(condition.density_per_m2))
        return BeliefSet(self._pose_set.name, condition, pose_set, drives)

    def _thinned(self, density: float) -> Path:
        """Return the map of the survey with so many points on a square metre."""
        folder = self._folder / f"thinned-{density:g}"
        with benchmark.alone(self._folder):
            names = [survey.parent.name for survey in self._surveys]
            settings = {**self._settings, "density": density}
            if not all(is_made(folder / name, settings) for name in names):
                share = min(density / density_per_m2(self._surveys), 1.0)
                self._make(
                    [
                        _Part(folder / name, settings, self._poses, area, self._surveys[area], share=share)
                        for area, name in enumerate(names)
                    ],
                    f"thinning to {density:g}/m2",
                )
            inputs = [folder / name for name in names]
            return make_map(folder, inputs, self._poses.examined.build, self._loader, self._workers, self._report)

    def _recorded(self, condition: Condition) -> PoseSet:
        """Return the set with scans and drives recorded under a condition, on the map as it was delivered."""
        folder = self._folder / condition.name
        sensor = benchmark.plain({"lidar": dataclasses.asdict(PROFILES[condition.lidar])})
        parts, recordings = [], []
        plans = drive_plans(self._pose_set.name)
        for area, survey in enumerate(self._surveys):
            parts.append(
                _Part(
                    folder / survey.parent.name, {**self._settings, **sensor}, self._poses, area, survey,
                    condition=condition,
                )
            )  # fmt: skip
            plan = _elsewhere(next(each for each in plans if each.area == area))
            settings = {**settings_of_plan(plan), **sensor}
            recordings.append(
                _Part(
                    folder / DRIVES / f"{area:02d}", settings, self._poses, area, survey, plan=plan, condition=condition
                )
            )
        with benchmark.alone(self._folder):
            self._make([*recordings, *parts], f"recording, {condition.name}")
            towns = self._poses.examined.towns
            write_manifest(
                folder,
                {
                    "name": self._pose_set.name,
                    "parts": [part.folder.name for part in parts],
                    "areas": [town.name for town in towns],
                    "families": [town.family for town in towns],
                    "on_map": [True] * len(towns),
                    "groups": [ALL],
                    "settings": self._settings,
                },
            )
        return load_pose_set(folder, self._pose_set.map_folder)

    def _make(self, parts: Sequence[_Part], stage: str) -> None:
        missing = [part for part in parts if not is_made(part.folder, part.settings)]
        done = len(parts) - len(missing)

        def advance(count: int) -> None:
            nonlocal done
            done += count
            self._report(stage, done, len(parts), "parts")

        if missing:
            self._folder.mkdir(exist_ok=True)
            advance(0)
            benchmark.without_encoder(_make_part, missing, self._workers, self._folder, advance)


def _elsewhere(plan: DrivePlan) -> DrivePlan:
    """Return another and longer drive through the same town: fixes of the same places say nothing new."""
    return dataclasses.replace(plan, seed=plan.seed + _OTHER_DRIVE, length_m=_LONGER * plan.length_m)


def _make_part(part: _Part, advance: Callable[[int], None] | None) -> None:
    examined = part.poses.examined
    town = examined.towns[part.area]
    if part.plan is not None:
        record_drive(part.folder, part.plan, _world_of(part), part.settings, part.lidar)
    else:
        with whole(part.folder) as partial:
            if part.condition is not None:
                sensor = None if part.lidar is VLP16 else Lidar(part.lidar)
                save_scans(partial, scans_of_town(_world_of(part), town, examined, examined.queries, sensor))
            else:
                write_part([part.survey], partial / _TOWN_SURVEY, 0.0, part.share)
            mark_made(partial, part.settings)
    if advance is not None:
        advance(1)


def _world_of(part: _Part) -> World:
    """Return the town that is scanned under the condition of a part."""
    town = part.poses.examined.towns[part.area]
    world, _ = placed_town(town, 1 - town.seed % 2, part.poses.examined.town_size_m, part.poses.corner(part.area))
    return aged(world, town.seed) if part.condition is not None and part.condition.is_aged else world
