"""Small made-up towns: boxes on a plain, seen from above and, in part, from within."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.clouds.patch import make_patch, rotate_about_z
from crossloc3d_ros.clouds.tiling import SubmapCutter, submap_centres
from crossloc3d_ros.config import ModelConfig, PreprocessingConfig, TrainConfig
from crossloc3d_ros.training.loop import Trainer
from crossloc3d_ros.training.schedule import Budget
from crossloc3d_ros.training.shards import (
    Manifest,
    TownEntry,
    TrainingTown,
    ValidationTown,
    write_manifest,
    write_town,
)
from crossloc3d_ros.types import Float32Array, Float64Array

SIZE_M = 220.0

TINY = ModelConfig(
    voxel_sizes=(0.12, 0.4), kept_branches=0, channels=16, sub_steps=1, memory_sizes=(16, 16), fused_channels=32,
    clusters=8, descriptor_size=32,
)  # fmt: skip
TINY_TRAINING = TrainConfig(
    pairs=6,
    towns_a_batch=4,
    learning_rate=3e-3,
    model=TINY,
    preprocessing=PreprocessingConfig(n_points=256, min_points=32),
    log_steps=2,
)


def boxes(rng: np.random.Generator, count: int = 14) -> Float32Array:
    """Return points (N, 3) on the walls of random boxes."""
    parts = []
    for _ in range(count):
        centre, half, height = rng.uniform(0, SIZE_M, 2), rng.uniform(3, 14, 2), rng.uniform(4, 25)
        wall = rng.uniform(-1, 1, (900, 2))
        wall[np.arange(900), rng.integers(0, 2, 900)] = rng.choice([-1.0, 1.0], 900)
        parts.append(np.column_stack([centre + wall * half, rng.uniform(0.6, height, 900)]))
    return np.concatenate(parts).astype(np.float32)


def scan_of(points: Float32Array, place: Float64Array, rng: np.random.Generator, heading_rad: float) -> Float32Array:
    """Return some of the points around a place, seen along a heading."""
    around = points - np.array([*place, 0.0], np.float32)
    around = around[np.hypot(around[:, 0], around[:, 1]) < 70.0]
    around = around[rng.random(len(around)) < 0.7]
    return rotate_about_z(around.astype(np.float32), -heading_rad)


def training_town(seed: int, scans: int = 30) -> TrainingTown:
    """Return a made-up town to learn from."""
    rng = np.random.default_rng(seed)
    points = boxes(rng)
    places = rng.uniform(55, SIZE_M - 55, (scans, 2))
    headings = rng.uniform(0, 2 * np.pi, scans)
    seen = [
        np.round(scan_of(points, place, rng, heading) * 100).astype(np.int16)
        for place, heading in zip(places, headings, strict=True)
    ]
    starts = np.cumsum([0, *(len(s) for s in seen)]).astype(np.int64)
    return TrainingTown(f"town{seed}", places, headings, np.concatenate(seen), starts, points)


def validation_town(seed: int, config: PreprocessingConfig, queries: int = 12) -> ValidationTown:
    """Return a made-up town to validate on."""
    rng = np.random.default_rng(seed)
    points = boxes(rng)
    cutter = SubmapCutter(points.astype(np.float64), config)
    centres = submap_centres((50.0, 50.0, SIZE_M - 50.0, SIZE_M - 50.0), 38.0)
    cut = [(c, patch.points) for c in centres if (patch := cutter.cut(c)) is not None]
    seen = []
    for place in rng.uniform(55, SIZE_M - 55, (queries, 2)):
        patch = make_patch(scan_of(points, place, rng, rng.uniform(0, 2 * np.pi)), config.scan_half_extent_m, config)
        if patch is not None:
            seen.append((place, patch.points))
    return ValidationTown(
        f"town{seed}",
        np.array([a for a, _ in seen]),
        np.array([p for _, p in seen]),
        np.array([c for c, _ in cut]),
        np.array([p for _, p in cut]),
    )


@pytest.fixture
def tiny() -> TrainConfig:
    """Give the settings of a run that takes seconds."""
    return TINY_TRAINING


@pytest.fixture(scope="session")
def made_places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the places once."""
    return write_places(tmp_path_factory.mktemp("made") / "places")


@pytest.fixture
def places(made_places: Path, tmp_path: Path) -> Path:
    """Give a folder of made-up places to change at will: four towns to learn from, one to validate on."""
    return shutil.copytree(made_places, tmp_path / "places")


@pytest.fixture(scope="session")
def finished_run(made_places: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train once, two steps."""
    trainer = Trainer(TINY_TRAINING, [made_places], tmp_path_factory.mktemp("run") / "finished", Budget(steps=2))
    trainer.run()
    trainer.write_card()
    return trainer.folder


@pytest.fixture
def finished(finished_run: Path, tmp_path: Path) -> Path:
    """Give the folder of a finished run, to change at will."""
    return shutil.copytree(finished_run, tmp_path / "finished")


def write_places(folder: Path, towns: int = 4, first_seed: int = 0) -> Path:
    """Write made-up places."""
    folder.mkdir()
    entries = []
    for seed in range(first_seed, first_seed + towns):
        town = training_town(seed)
        write_town(folder / f"train_{seed}.npz", town)
        entries.append(TownEntry(f"train_{seed}.npz", "train", "boxes", seed, len(town), 0, 1.0))
    held_out = validation_town(1000 + first_seed, TINY_TRAINING.preprocessing)
    write_town(folder / "validation_1000.npz", held_out)
    entries.append(
        TownEntry(
            "validation_1000.npz", "validation", "boxes", 1000, len(held_out.query_xy_m), len(held_out.submap_xy_m), 1.0
        )
    )
    settings = {
        "towns": towns,
        "validation_towns": 1,
        "seed": first_seed,
        "places": {},
        "preprocessing": dataclasses.asdict(TINY_TRAINING.preprocessing),
    }
    write_manifest(folder, Manifest(settings, tuple(entries)))
    return folder


@pytest.fixture
def make_places() -> Callable[..., Path]:
    """Give the writer of made-up places."""
    return write_places


@pytest.fixture
def make_training_town() -> Callable[..., TrainingTown]:
    """Give the maker of made-up towns."""
    return training_town
