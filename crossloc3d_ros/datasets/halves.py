"""A real survey divided into two halves without a point in common: one is mapped, the other is driven through.

A sparse survey is driven through as a whole. Ground that has no class is found by the filter of the map builder; the
map is built of the points as they were delivered.

The echoes are as many surveys of one day: what the map holds of a wall, another pulse has hit. It says how well a
place is known in real geometry of any country; changes between two epochs it doesn't show.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.store import sha256
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.datasets import benchmarks as benchmark
from crossloc3d_ros.datasets.made import is_made, mark_made, whole
from crossloc3d_ros.datasets.pose_drives import DRIVES, DrivePlan, record_drive, settings_of_plan
from crossloc3d_ros.datasets.pose_sets import ALL, PoseSet, load_pose_set, to_grid, write_manifest
from crossloc3d_ros.datasets.raw_scans import RawScans, save_scans
from crossloc3d_ros.datasets.set_maps import Progress, make_map
from crossloc3d_ros.datasets.simulated import SimulatedBenchmark, raw_scans, sources_digest
from crossloc3d_ros.datasets.survey_parts import classify_part, density_per_m2, write_part
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.simulation import mesh, real_world, vlp16, world
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.workers import EncoderLoader

_log = logging.getLogger(__name__)

VERSION = 3
LEAST_PER_M2 = 1.5
"""A world made of a sparser survey is not what a robot would see."""
DIVIDED_PER_M2 = 5.0
"""Half of a sparser survey shows neither roofs nor kerbs: it is driven through as a whole, and half of it is mapped."""
_SCANS, _DRIVES, _DRIVE_M = 200, 3, 200.0
_BORDER_M = 25.0
"""How far inside of the survey robots stay: half the reach of a submap, so that the map shows where they are."""
_MAP_HALF, _DRIVEN_HALF = "map.laz", "driven.laz"
_HEIGHT_M = 1.2
_SPEED_M_S, _EVERY = 2.5, 5


def open_halves(path: Path, data: Path, loader: EncoderLoader, *, progress: Progress | None = None) -> PoseSet | None:
    """Return scans and drives in one half of a survey's points, with the map of the other half.

    None, with a warning, where no robot can drive through the survey: it is too sparse, or has no
    free ground. Kept in `data/halves-NAME-HASH`. Raises EvaluationError for what cannot be written.
    """
    report = progress or (lambda stage, done, total, unit: None)
    settings = _settings_of(path)
    folder = benchmark.folder_of(data, f"halves-{path.stem}", settings)
    with benchmark.alone(folder):
        if not is_made(folder / "scans", settings):
            try:
                _make(folder, path, settings, report)
            except _NoWorldError as reason:
                _log.warning("%s is not driven through: %s", path.name, reason)
                return None
        map_folder = make_map(folder, [folder / "parts" / _MAP_HALF], BuildConfig(), loader, 1, report)
    return load_pose_set(folder, map_folder)


class _NoWorldError(Exception):
    """There is no ground to drive on."""


def _settings_of(path: Path) -> dict[str, Any]:
    return benchmark.plain(
        {
            "version": VERSION,
            "format": store.FORMAT_VERSION,
            "survey": sha256(path),
            "plans": [settings_of_plan(plan) for plan in _plans(path)],
            "scans": [_SCANS, LEAST_PER_M2, DIVIDED_PER_M2],
            "simulator": sources_digest(real_world, mesh, world, vlp16),
        }
    )


def _seed(path: Path) -> int:
    return int(sha256(path)[:7], 16)


def _plans(path: Path) -> tuple[DrivePlan, ...]:
    return tuple(
        DrivePlan(f"{path.stem}, drive {i + 1}", 0, _DRIVE_M, _SPEED_M_S, _EVERY, _seed(path) + i, i % 2 == 0,
                  _HEIGHT_M, _BORDER_M)
        for i in range(_DRIVES)
    )  # fmt: skip


def _make(folder: Path, path: Path, settings: dict[str, Any], report: Progress) -> None:
    density = density_per_m2([path])
    if density < LEAST_PER_M2:
        raise _NoWorldError(f"{density:.1f} points/m2 are too few to be divided (at least {LEAST_PER_M2:g})")
    with whole(folder / "parts") as partial:
        write_part([path], partial / _MAP_HALF, 0.0, 0.5)
        write_part([path], partial / _DRIVEN_HALF, 0.5 if density >= DIVIDED_PER_M2 else 0.0, 1.0)
        classify_part(partial / _DRIVEN_HALF)
    try:
        town = world_from_survey([folder / "parts" / _DRIVEN_HALF], seed=_seed(path), progress=report)
        for i, plan in enumerate(_plans(path)):
            record_drive(folder / DRIVES / f"{i:02d}", plan, town, settings_of_plan(plan))
            report("driving", i + 1, _DRIVES, "drives")
        scans = _spread(town, _seed(path))
    except (CrossLocError, ValueError) as error:
        raise _NoWorldError(str(error)) from error
    with whole(folder / "scans") as partial:
        save_scans(partial, scans)
        mark_made(partial, settings)
    write_manifest(
        folder,
        {
            "name": path.stem, "parts": ["scans"], "areas": [path.stem], "families": ["real survey"],
            "on_map": [True], "groups": [ALL], "settings": settings,
        },
    )  # fmt: skip


def _spread(town: World, seed: int) -> RawScans:
    """Return scans at random places and in random headings."""
    rng = np.random.default_rng([seed, 2])
    examined = SimulatedBenchmark((), 0.0, _SCANS, 0)
    local = town.sample_poses(_SCANS, rng, clearance_m=examined.clearance_m, border_m=_BORDER_M)
    return RawScans.of(to_grid(scan, town) for scan in raw_scans(town, local, examined, rng))
