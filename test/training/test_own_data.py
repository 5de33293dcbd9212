"""Batches out of a dataset's clouds: matching places, headings, what is ignored, and what cannot be learned from."""

from __future__ import annotations

import dataclasses
import math
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.config import ModelConfig, PreprocessingConfig, TrainConfig
from crossloc3d_ros.datasets.published import open_source
from crossloc3d_ros.errors import DatasetError, TrainingError
from crossloc3d_ros.formats.cs_campus3d import PRESETS, CloudTable, QueryTable, read_training
from crossloc3d_ros.formats.cs_campus3d_writer import (
    write_cloud,
    write_database,
    write_info,
    write_queries,
    write_training,
)
from crossloc3d_ros.training.loop import Trainer, export_run
from crossloc3d_ros.training.own_data import PatchSampler, fingerprint, load_training, load_validation
from crossloc3d_ros.training.sampling import HardPlaces
from crossloc3d_ros.training.schedule import Budget

PATCH = PreprocessingConfig(half_extent_m=20.0, scan_half_extent_m=20.0, n_points=64, min_points=8)
CONFIG = TrainConfig(pairs=8, preprocessing=PATCH, keep_points=1.0, sector_share=0.0, near_share=0.0, neighbour_m=30.0)
PLAIN, CAMPUS, OXFORD = PRESETS["plain"], PRESETS["campus"], PRESETS["oxford"]
SCANS = 40


def landmark(number: int, turned_rad: float = 0.0) -> np.ndarray:
    """Return the cloud (64, 3) of a place: a pole, its height the place's number, two thirds out along the x axis."""
    cloud = np.zeros((64, 3))
    cloud[:, 0] = 0.6 * math.cos(turned_rad)
    cloud[:, 1] = 0.6 * math.sin(turned_rad)
    cloud[:, 2] = np.linspace(0.1, 0.1 + 0.02 * number, 64)
    return cloud


def number_of(patch: np.ndarray) -> int:
    """Return the number of the place that a patch shows."""
    return round((float(patch[:, 2].max()) - 0.1) / 0.02)


@pytest.fixture
def dataset(tmp_path: Path) -> Callable[..., Path]:
    """Give the writer of a dataset of a drive to the east, a scan and a submap every 40 m."""

    def write(*, positives: bool = True, headings: bool = True, validation: bool = True) -> Path:
        rng = np.random.default_rng(0)
        numbers = np.arange(SCANS)
        xy = np.column_stack([500_000.0 + 40.0 * numbers, np.full(SCANS, 5_000_000.0)])
        heading = rng.uniform(-3, 3, SCANS) if headings else np.full(SCANS, np.nan)
        aerial = CloudTable(
            tuple(f"clouds/aerial/{i}.bin" for i in numbers), xy + 3.0, np.zeros(SCANS), np.zeros(SCANS, np.bool_)
        )
        ground = CloudTable(tuple(f"clouds/ground_00/{i}.bin" for i in numbers), xy, heading, np.ones(SCANS, np.bool_))
        for i in numbers:
            write_cloud(tmp_path, aerial.files[i], landmark(i))
            write_cloud(tmp_path, ground.files[i], landmark(i, -heading[i] if headings else 0.0))
        both = CloudTable(
            aerial.files + ground.files, np.vstack([aerial.xy_m, ground.xy_m]),
            np.concatenate([aerial.heading_rad, heading]), np.arange(2 * SCANS) >= SCANS,
        )  # fmt: skip
        pairs = [
            ([(i + SCANS) % (2 * SCANS)] if positives else [], [j for j in range(2 * SCANS) if j % SCANS != i % SCANS])
            for i in range(2 * SCANS)
        ]
        write_info(tmp_path, {"points": 64, "half_extent_m": 20.0, "scan_half_extent_m": 20.0})
        write_training(tmp_path / PLAIN.training, both, iter(pairs))
        count = SCANS if validation else 0
        held, queries = aerial.rows(numbers < count), ground.rows(numbers < count)
        write_database(tmp_path / "umd_validation_database.pickle", [held, held])
        right = tuple({0: np.array([i]), 1: np.array([i])} for i in range(count))
        write_queries(tmp_path / "umd_validation_query.pickle", [QueryTable(queries, right)])
        return tmp_path

    return write


def test_every_pair_shows_one_place_and_a_batch_no_place_twice(dataset: Callable[..., Path]) -> None:
    sampler = load_training(dataset(), None, CONFIG)
    assert len(sampler) == SCANS
    for step in range(10):
        batch = sampler.batch(step)
        scans, submaps = [number_of(s) for s in batch.scans], [number_of(s) for s in batch.submaps]
        assert scans == submaps
        assert len(set(scans)) == len(scans) == 8
        assert not batch.ignored.any()
        np.testing.assert_array_equal(batch.matches, np.eye(8, dtype=bool))


def test_a_batch_is_a_function_of_seed_and_step(dataset: Callable[..., Path]) -> None:
    folder = dataset()
    first, second = (load_training(folder, "plain", CONFIG).batch(7) for _ in range(2))
    for a, b in zip([*first.scans, *first.submaps], [*second.scans, *second.submaps], strict=True):
        np.testing.assert_array_equal(a, b)
    other = load_training(folder, "plain", dataclasses.replace(CONFIG, seed=2)).batch(7)
    assert any(number_of(a) != number_of(b) for a, b in zip(first.scans, other.scans, strict=True))


def bearings(patches: list[np.ndarray]) -> np.ndarray:
    """Return where each patch's landmark stands, radians."""
    return np.array([math.atan2(p[0, 1], p[0, 0]) for p in patches])


def test_with_one_heading_scans_lie_at_any_angle_to_submaps_in_quarters(dataset: Callable[..., Path]) -> None:
    sampler = load_training(dataset(), None, CONFIG)
    batches = [sampler.batch(step) for step in range(40)]
    scans = np.concatenate([bearings(batch.scans) for batch in batches])
    submaps = np.concatenate([bearings(batch.submaps) for batch in batches])
    quarters = submaps / (math.pi / 2.0)
    np.testing.assert_allclose(quarters, np.round(quarters), atol=1e-5)
    assert len(set(np.round(quarters).astype(int) % 4)) == 4
    counts, _ = np.histogram(np.mod(scans - submaps, 2.0 * math.pi), bins=8, range=(0, 2.0 * math.pi))
    assert counts.min() > 0.5 * len(scans) / 8


def test_with_several_headings_scans_lie_nearly_as_their_submaps(dataset: Callable[..., Path]) -> None:
    sampler = load_training(dataset(), None, dataclasses.replace(CONFIG, headings=8))
    error = []
    for step in range(20):
        batch = sampler.batch(step)
        error.append(np.angle(np.exp(1j * (bearings(batch.scans) - bearings(batch.submaps)))))
    limit = 1.25 * math.pi / 8.0
    assert np.abs(error).max() <= limit + 1e-5
    assert np.abs(error).max() > 0.8 * limit


def test_several_headings_need_scans_whose_heading_is_known(dataset: Callable[..., Path]) -> None:
    folder = dataset(headings=False)
    assert len(load_training(folder, None, CONFIG)) == SCANS
    with pytest.raises(TrainingError, match="holds no headings of its scans"):
        load_training(folder, None, dataclasses.replace(CONFIG, headings=8))


def test_near_places_are_neither_match_nor_mismatch(dataset: Callable[..., Path]) -> None:
    config = dataclasses.replace(CONFIG, pairs=SCANS, neighbour_m=90.0, match_m=50.0)
    sampler = load_training(dataset(), None, config)
    batch = sampler.batch(0)
    numbers = np.array([number_of(s) for s in batch.scans])
    metres = np.hypot(40.0 * (numbers[:, None] - numbers[None]) - 3.0, 3.0)
    matches = (metres < 50.0) | np.eye(SCANS, dtype=bool)
    np.testing.assert_array_equal(batch.matches, matches)
    np.testing.assert_array_equal(batch.ignored, (metres < 90.0) & ~matches)


def test_near_places_are_drawn_as_hard_negatives(dataset: Callable[..., Path]) -> None:
    def gaps(near_share: float) -> float:
        config = dataclasses.replace(CONFIG, near_share=near_share, near_m=60.0)
        sampler = load_training(dataset(), None, config)
        found = []
        for step in range(10):
            numbers = np.array([number_of(s) for s in sampler.batch(step).scans])
            apart = np.abs(numbers[:, None] - numbers[None]) + 1000 * np.eye(8)
            found.append(float((apart.min(axis=1) == 1).mean()))
        return float(np.mean(found))

    assert gaps(1.0) > 0.9
    assert gaps(0.0) < 0.6


def test_hard_places_are_part_of_a_batch(dataset: Callable[..., Path]) -> None:
    sampler = load_training(dataset(), None, dataclasses.replace(CONFIG, hard_share=0.5))
    town, scan, xy = sampler.places
    assert (town == 0).all()
    assert xy.shape == (SCANS, 2)
    submap = sampler.submap(0, 5)
    assert submap is not None
    assert number_of(submap) == 5
    neighbours = np.arange(SCANS)[:, None] + np.array([10, 20, 30])
    batch = sampler.batch(3, hard=HardPlaces(town, scan, neighbours % SCANS))
    hard = np.array([number_of(s) for s in batch.scans[4:]])
    assert ((hard - hard[0]) % 10 == 0).all()
    assert len(sampler.batch(3, pairs=5).scans) == 5


def test_the_papers_augmentation_keeps_headings(dataset: Callable[..., Path]) -> None:
    batch = load_training(dataset(headings=False), None, dataclasses.replace(CONFIG, augmentation="paper")).batch(1)
    assert len(batch.scans) == 8
    rotated = np.abs(np.sin(bearings(batch.submaps)))
    assert rotated.max() < math.sin(math.radians(5.0)) + 0.1


def test_a_training_area_without_positives_is_named(dataset: Callable[..., Path]) -> None:
    with pytest.raises(
        TrainingError,
        match=r"training area of .*easting 500000 to 501563.*40 scans and none of them has an aerial submap",
    ):
        load_training(dataset(positives=False), None, CONFIG)


def test_clouds_too_poor_for_patches_are_reported(dataset: Callable[..., Path]) -> None:
    folder = dataset()
    config = dataclasses.replace(
        CONFIG, preprocessing=dataclasses.replace(PATCH, half_extent_m=21.0, min_points=65, thin_m=0.0)
    )
    with pytest.raises(TrainingError, match="60 scans in a row gave no pair"):
        load_training(folder, None, config).batch(0)


def test_the_validation_area_is_the_datasets_own(dataset: Callable[..., Path]) -> None:
    (town,) = load_validation(dataset(), None, CONFIG)
    assert [number_of(p) for p in town.query_patches] == [number_of(p) for p in town.submap_patches]
    np.testing.assert_allclose(town.submap_xy_m - town.query_xy_m, 3.0)


def test_a_dataset_without_a_validation_area_says_how_to_get_one(dataset: Callable[..., Path]) -> None:
    with pytest.raises(TrainingError, match="--validation-share above 0"):
        load_validation(dataset(validation=False), None, CONFIG)


def as_published(folder: Path, preset: str) -> None:
    """Turn our dataset into one of another preset: plain clouds of 4096 points, its names, no `dataset.json`."""
    tuples = read_training(folder, PLAIN)
    clouds = tuples.clouds
    files = list(clouds.files)
    if preset == "oxford":
        files = [f"oxford/run{i // SCANS}/pointcloud_20m_10overlap/{i % SCANS}.bin" for i in range(2 * SCANS)]
    for old, new in zip(clouds.files, files, strict=True):
        cloud = np.fromfile(folder / old).reshape(-1, 3)
        write_cloud(folder, new, np.repeat(cloud, 64, axis=0) * (1.0 if preset == "oxford" else 0.2))
    entries = {
        i: {
            "query": files[i],
            "positives": tuples.positives[i].tolist(),
            "negatives": np.flatnonzero(tuples.is_negative(i, np.arange(2 * SCANS))).tolist(),
            "easting": np.float64(clouds.xy_m[i, 0]),
            "northing": np.float64(clouds.xy_m[i, 1]),
        }
        for i in range(2 * SCANS)
    }
    (folder / PRESETS[preset].training).write_bytes(pickle.dumps(entries, 4))
    (folder / "dataset.json").unlink()


@pytest.mark.parametrize("preset", ["campus", "oxford"])
def test_of_a_published_dataset_a_strip_is_held_out(dataset: Callable[..., Path], preset: str) -> None:
    folder = dataset()
    as_published(folder, preset)
    if preset == "oxford":
        (folder / CAMPUS.training).unlink()
    config = dataclasses.replace(CONFIG, preprocessing=dataclasses.replace(PATCH, ground_clearance_m=0.0))
    sampler = load_training(folder, preset, config)
    (town,) = load_validation(folder, preset, config)
    _, _, learned = sampler.places
    reach = 25.0 if preset == "oxford" else 20.0
    for places in (town.query_xy_m, town.submap_xy_m):
        apart = np.abs(learned[:, None] - places[None]).max(axis=2)
        assert apart.min() >= 2.0 * reach - 4.0
    assert 0 < len(town.query_xy_m) < 0.3 * SCANS
    assert len(learned) > 0.6 * SCANS
    batch = sampler.batch(0)
    assert len(batch.scans) == 8
    assert not batch.ignored[np.eye(8, dtype=bool)].any()


def test_without_positions_what_is_not_negative_is_ignored(dataset: Callable[..., Path]) -> None:
    tuples = read_training(dataset(), PLAIN)
    unknown = dataclasses.replace(
        tuples, clouds=dataclasses.replace(tuples.clouds, xy_m=np.full_like(tuples.clouds.xy_m, np.nan))
    )
    source = open_source(dataset(), PLAIN, PATCH)
    sampler = PatchSampler(source, unknown, np.ones(2 * SCANS, np.bool_), dataclasses.replace(CONFIG, pairs=SCANS + 5))
    batch = sampler.batch(0)  # five places come twice
    numbers = np.array([number_of(s) for s in batch.scans])
    same = numbers[:, None] == numbers[None]
    np.testing.assert_array_equal(batch.ignored, same & ~np.eye(SCANS + 5, dtype=bool))
    with pytest.raises(TrainingError, match="holds no positions of its clouds"):
        _ = sampler.places


def test_a_dataset_without_positions_cannot_be_held_out(dataset: Callable[..., Path]) -> None:
    folder = dataset()
    as_published(folder, "oxford")
    entries = pickle.loads((folder / OXFORD.training).read_bytes())
    for entry in entries.values():
        del entry["northing"], entry["easting"]
    (folder / OXFORD.training).write_bytes(pickle.dumps(entries))
    with pytest.raises(TrainingError, match="holds no positions of its training clouds"):
        load_training(folder, "oxford", CONFIG)


def test_the_fingerprint_changes_with_the_lists(dataset: Callable[..., Path]) -> None:
    folder = dataset()
    before = fingerprint(folder)
    assert before == fingerprint(folder, "plain")
    dataset(headings=False)
    assert fingerprint(folder) != before
    (folder / PLAIN.training).unlink()
    with pytest.raises(DatasetError, match="is missing"):
        fingerprint(folder)


def test_a_run_learns_from_a_dataset(dataset: Callable[..., Path], made_places: Path, tmp_path: Path) -> None:
    folder = dataset()
    model = ModelConfig(
        voxel_sizes=(0.2,), kept_branches=0, refinement="none", channels=16, fused_channels=32, clusters=4,
        descriptor_size=8,
    )  # fmt: skip
    config = dataclasses.replace(CONFIG, model=model, hard_share=0.5, mine_steps=1, mined_places=30)
    trainer = Trainer(config, [folder], tmp_path / "run", Budget(steps=2))
    assert trainer.run().queries == SCANS
    assert "layout of CS-Campus3D, preset `plain`" in trainer.write_card().read_text()
    assert export_run(tmp_path / "run", tmp_path / "shipped" / "own.safetensors").exists()
    with pytest.raises(TrainingError, match="learned from alone"):
        Trainer(config, [made_places, folder], tmp_path / "other", Budget(steps=1)).run()
    training = folder / PLAIN.training
    training.write_bytes(pickle.dumps({}))
    with pytest.raises(TrainingError, match="other places"):
        Trainer(config, [folder], tmp_path / "run", Budget(steps=3)).run(resume=True)
