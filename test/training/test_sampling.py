"""Batches: matching, repeatable, apart."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.clouds.tiling import cut_submap
from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training.augmentation import paper_batch, paper_cloud
from crossloc3d_ros.training.mining import mine
from crossloc3d_ros.training.sampling import BatchSampler, HardPlaces, PointField
from crossloc3d_ros.training.shards import TrainingTown


def test_a_step_has_one_batch_whoever_calls(make_training_town: Callable[..., TrainingTown], tiny: TrainConfig) -> None:
    towns = [make_training_town(seed) for seed in range(3)]
    first, second = BatchSampler(towns, tiny), BatchSampler(towns, tiny)
    first.batch(1)
    a, b, other = first.batch(5), second.batch(5), first.batch(6)
    assert all(np.array_equal(x, y) for x, y in zip(a.scans + a.submaps, b.scans + b.submaps, strict=True))
    assert not np.array_equal(a.scans[0], other.scans[0])


def test_only_neighbours_of_one_town_are_ignored(
    make_training_town: Callable[..., TrainingTown], tiny: TrainConfig
) -> None:
    towns = [make_training_town(seed) for seed in range(2)]
    everything_near = dataclasses.replace(tiny, neighbour_m=1e4, towns_a_batch=2, pairs=6)
    ignored = BatchSampler(towns, everything_near).batch(0).ignored
    same_town = np.arange(6)[:, None] // 3 == np.arange(6)[None, :] // 3
    assert np.array_equal(ignored, same_town & ~np.eye(6, dtype=bool))
    nothing_near = dataclasses.replace(everything_near, neighbour_m=0.0)
    assert not BatchSampler(towns, nothing_near).batch(0).ignored.any()


def test_patches_stay_in_their_cube(make_training_town: Callable[..., TrainingTown], tiny: TrainConfig) -> None:
    batch = BatchSampler([make_training_town(0)], tiny).batch(0)
    for patch in batch.scans + batch.submaps:
        assert patch.shape == (tiny.preprocessing.n_points, 3) and patch.dtype == np.float32
        assert patch[:, 2].min() > 0.0 and patch[:, 2].max() <= 1.0
    assert max(np.abs(patch).max() for patch in batch.submaps) <= 1.0
    # A scan's patch is rotated as a query's is: its corners leave the cube.
    assert max(np.hypot(patch[:, 0], patch[:, 1]).max() for patch in batch.scans) <= np.sqrt(2.0) + 1e-6


def test_a_cut_without_rotation_is_the_map_builder_s(
    make_training_town: Callable[..., TrainingTown], tiny: TrainConfig
) -> None:
    town = make_training_town(4)
    centre = np.array([101.3, 93.7])
    preprocessing = dataclasses.replace(tiny.preprocessing, n_points=100_000, thin_m=0.0)
    cut = PointField(town.survey_points).cut(centre, 0.0, preprocessing.half_extent_m)
    patch = cut_submap(town.survey_points.astype(np.float64), centre, preprocessing)
    assert patch is not None
    expected = np.unique(np.round(patch.points * preprocessing.half_extent_m, 2), axis=0)
    # The points on the very edge may fall on either side of it.
    assert abs(len(np.unique(np.round(cut, 2), axis=0)) - len(expected)) <= 2


def test_a_rotated_cut_holds_the_rotated_square(make_training_town: Callable[..., TrainingTown]) -> None:
    points = make_training_town(5).survey_points
    centre, heading, half = np.array([120.0, 80.0]), 0.7, 30.0
    cut = PointField(points).cut(centre, heading, half)
    offset = points[:, :2] - centre
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-ahead[1], ahead[0]])
    inside = (np.abs(offset @ ahead) <= half) & (np.abs(offset @ left) <= half)
    assert abs(len(cut) - int(inside.sum())) <= 2
    assert np.allclose(np.sort(cut[:, 0])[5:-5], np.sort(offset[inside] @ ahead)[5:-5], atol=0.05)


def test_a_field_beyond_the_survey_is_empty(make_training_town: Callable[..., TrainingTown]) -> None:
    field = PointField(make_training_town(0).survey_points)
    assert field.cut(np.array([5000.0, 5000.0]), 0.3, 50.0).shape == (0, 3)


def test_nothing_to_learn_from_is_reported(make_training_town: Callable[..., TrainingTown], tiny: TrainConfig) -> None:
    with pytest.raises(TrainingError, match="no scan to learn from"):
        BatchSampler([], tiny)
    without_positives = dataclasses.replace(make_training_town(0), survey_points=np.zeros((1, 3), np.float32))
    with pytest.raises(TrainingError, match="gave no pair of patches"):
        BatchSampler([without_positives], tiny).batch(0)


def test_the_paper_s_batches_keep_the_headings_and_change_all_clouds_alike(
    make_training_town: Callable[..., TrainingTown], tiny: TrainConfig
) -> None:
    town = make_training_town(1)
    paper = dataclasses.replace(tiny, augmentation="paper", offset_m=0.0)
    batch = BatchSampler([town], paper).batch(2)
    sizes = [len(patch) for patch in batch.scans + batch.submaps]
    assert len(set(sizes)) > 3 and max(sizes) <= tiny.preprocessing.n_points
    again = BatchSampler([town], paper).batch(2)
    assert all(np.array_equal(x, y) for x, y in zip(batch.scans, again.scans, strict=True))
    # Scan and submap of a place, both brought to the north, cover the same walls: the nearest point is near.
    sampler = BatchSampler([town], dataclasses.replace(paper, pairs=2))
    for step in range(4):
        batch = sampler.batch(step)
        best = []
        for index in range(len(town)):
            scan = rotate_about_z(batch.scans[0], float(town.scan_heading_rad[index]))
            best.append(min(nearest(scan * sign, batch.submaps[0] * sign) for sign in mirrors()))
        assert min(best) < 0.12


def mirrors() -> list[np.ndarray]:
    return [np.array([x, 1, 1], np.float32) for x in (1, -1)]


def nearest(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1)))


def test_a_cloud_of_the_paper_s_loses_at_most_a_cuboid_and_a_tenth() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1, 1, (4000, 3)).astype(np.float32)
    kept = np.array([len(paper_cloud(cloud, rng)) / 4000 for _ in range(300)])
    assert kept.min() > 0.9 * 0.67 - 0.03 and kept.max() > 0.98
    assert 0.3 < (kept < 0.89).mean() < 0.5
    shifts = np.array([(paper_cloud(cloud, rng)[:, 2].mean() - cloud[:, 2].mean()) for _ in range(300)])
    assert 0.008 < shifts.std() < 0.016  # the translation, and a little from the choice of points


def test_a_batch_of_the_paper_s_is_rotated_by_five_degrees_and_mirrored_at_times() -> None:
    rng = np.random.default_rng(1)
    point = [np.array([[1.0, 0.5, 0.2]], np.float32)]
    rotated = [paper_batch((point, point), rng) for _ in range(400)]
    assert all(np.array_equal(scans[0], submaps[0]) for scans, submaps in rotated)
    xyz = np.array([scans[0][0] for scans, _ in rotated])
    assert np.allclose(xyz[:, 2], 0.2)
    assert 0.18 < (xyz[:, 0] < 0).mean() < 0.32 and 0.18 < (xyz[:, 1] < 0).mean() < 0.32
    bearing = np.degrees(np.arctan2(np.abs(xyz[:, 1]), np.abs(xyz[:, 0])) - np.arctan2(0.5, 1.0))
    assert 4.5 < np.abs(bearing).max() <= 5.001


def test_hard_places_fill_their_share_of_a_batch_in_groups(
    make_training_town: Callable[..., TrainingTown], tiny: TrainConfig
) -> None:
    towns = [make_training_town(seed) for seed in range(6)]
    config = dataclasses.replace(tiny, pairs=8, towns_a_batch=1, hard_share=0.5)
    sampler = BatchSampler(towns, config)
    first = [next(i for i in range(30) if sampler.submap(town, i) is not None) for town in range(6)]
    hard = HardPlaces(np.arange(6), np.array(first), np.array([[(row + k) % 6 for k in (1, 2, 3)] for row in range(6)]))
    plain, batch = sampler.batch(3), sampler.batch(3, hard=hard)
    assert not any(np.array_equal(x, y) for x, y in zip(plain.submaps[4:], batch.submaps[4:], strict=True))

    def town_of(patch: np.ndarray) -> int:
        heights = [town.survey_points[:, 2] / np.float32(50.0) for town in towns]  # no turn changes them
        return int(np.argmax([np.isin(patch[:, 2], own).mean() for own in heights]))

    assert len({town_of(patch) for patch in batch.submaps[:4]}) == 1
    assert len({town_of(patch) for patch in batch.submaps[4:]}) == 4
    assert not batch.ignored[4:, 4:].any() and batch.matches[4:, 4:].sum() == 4


GRID = np.linspace(0.05, 0.95, 19)


def test_mining_finds_the_twin_in_another_town(
    make_training_town: Callable[..., TrainingTown], tiny: TrainConfig
) -> None:
    towns = [make_training_town(seed) for seed in range(3)]
    twin = dataclasses.replace(towns[0], name="twin")
    sampler = BatchSampler([*towns, twin], tiny)

    def encode(clouds: list[np.ndarray]) -> np.ndarray:
        return np.stack([np.quantile(cloud[:, 2], GRID) for cloud in clouds]).astype(np.float32)

    hard = mine(sampler, encode, dataclasses.replace(tiny, mined_places=1000), 5)
    for row in np.flatnonzero(hard.town == 0):
        neighbour = hard.neighbours[row, 0]
        assert hard.town[neighbour] == 3 and hard.scan[neighbour] == hard.scan[row]
    metres = [
        np.hypot(*(towns[hard.town[a] % 3].scan_xy_m[hard.scan[a]] - towns[hard.town[b] % 3].scan_xy_m[hard.scan[b]]))
        for a, row in enumerate(hard.neighbours)
        for b in row
        if hard.town[a] == hard.town[b]
    ]
    assert not metres or min(metres) > 100.0
    few = mine(sampler, encode, dataclasses.replace(tiny, mined_places=20), 5)
    assert 10 < len(few.town) <= 20
    again = mine(sampler, encode, dataclasses.replace(tiny, mined_places=20), 5)
    assert np.array_equal(few.neighbours, again.neighbours) and np.array_equal(few.scan, again.scan)


def test_mining_needs_places_that_can_be_confused(
    make_training_town: Callable[..., TrainingTown], tiny: TrainConfig
) -> None:
    town = make_training_town(0)
    near = dataclasses.replace(town, scan_xy_m=100.0 + 0.1 * town.scan_xy_m)
    with pytest.raises(TrainingError, match="different towns"):
        mine(BatchSampler([near], tiny), lambda clouds: np.zeros((len(clouds), 2), np.float32), tiny, 0)
