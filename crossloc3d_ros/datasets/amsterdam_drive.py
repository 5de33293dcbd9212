"""The map and the recorded drive of the demo, made once and kept while what they are made from is the same."""

from __future__ import annotations

import functools
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros import __version__
from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.store import AerialMap, sha256
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.formats.bag import POINT_CLOUD, open_bag
from crossloc3d_ros.simulation.drive import DriveConfig, drive
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.route import plan_route

GEOID_SEPARATION_M = 43.0
"""Ellipsoidal height minus NAP in Amsterdam, rounded to the metre."""
TOPIC, ODOMETRY_TOPIC = "/velodyne_points", "/odom"

Say = Callable[[str], None]
"""Take a sentence for people."""
Progress = Callable[[str, float, float, str], None]
"""Take what is being done, how much is done of how much, and the unit."""


@dataclass(frozen=True)
class DemoDrive:
    """The drive: long enough for some twenty different places, short enough to be watched."""

    length_m: float = 600.0
    speed_m_s: float = 5.0
    clearance_m: float = 1.5
    seed: int = 3


def make_map(survey: Path, folder: Path, weights: Path | None, fingerprint: str, say: Say, progress: Progress) -> None:
    """Build the map, unless the one that is there was made by these weights from this file with these settings."""
    cores = min(os.cpu_count() or 1, 4)
    config = BuildConfig()
    stamp = _stamp_of(folder)
    made_from = {
        "survey": sha256(survey),
        "encoder": fingerprint,
        "config": asdict(config),
        "geoid_separation_m": GEOID_SEPARATION_M,
        "software": __version__,
    }
    if folder.is_dir() and _is_made_from(stamp, made_from):
        try:
            AerialMap.load(folder, fingerprint)
        except MapError as error:
            say(f"built again: {error}")
            shutil.rmtree(folder)
        else:
            say("current, not built again (--fresh does)")
            return
    folder.parent.mkdir(parents=True, exist_ok=True)
    build_map(
        [survey],
        folder,
        functools.partial(load_encoder, weights, threads=1),
        replace(config, workers=cores),  # what a worker's threads would do is better done by more workers
        geoid_separation_m=GEOID_SEPARATION_M,
        overwrite=True,
        progress=lambda p: progress(p.stage, p.done, p.total, p.unit),
    )
    write_atomically(stamp, json.dumps(made_from, indent=2))


def make_drive(survey: Path, bag_path: Path, plan: DemoDrive, say: Say, progress: Progress) -> None:
    """Record the drive, unless the bag that is there is of this survey and plan."""
    config = DriveConfig()
    stamp = _stamp_of(bag_path)
    made_from = {"survey": sha256(survey), "plan": asdict(plan), "config": asdict(config), "software": __version__}
    if bag_path.is_dir() and _is_made_from(stamp, made_from):
        say("current, not driven again (--fresh does)")
    else:
        shutil.rmtree(bag_path, ignore_errors=True)
        world = world_from_survey([survey], seed=plan.seed, progress=progress)
        rng = np.random.default_rng([plan.seed, 1])
        route = plan_route(world, plan.length_m, rng, clearance_m=plan.clearance_m, speed_m_s=plan.speed_m_s)
        drive(world, route, bag_path, config, seed=plan.seed, progress=progress)
        write_atomically(stamp, json.dumps(made_from, indent=2))
    with open_bag(bag_path) as bag:
        scans = bag.topic(TOPIC, POINT_CLOUD).count
        say(f"{bag_path}: {scans:,} scans in {(bag.end_ns - bag.start_ns) / 1e9:.0f} s")


def remove(folder: Path) -> None:
    """Remove a map or a drive, so that it is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    _stamp_of(folder).unlink(missing_ok=True)


def _stamp_of(folder: Path) -> Path:
    """Return the file that says what a folder was made from."""
    return folder.with_name(f"{folder.name}.made-from.json")


def _is_made_from(stamp: Path, made_from: Mapping[str, Any]) -> bool:
    try:
        found = json.loads(stamp.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return bool(found == json.loads(json.dumps(made_from)))
