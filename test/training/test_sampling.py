"""Batches: matching, repeatable, apart."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from crossloc3d_ros.clouds.tiling import cut_submap
from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training.sampling import BatchSampler, PointField
from crossloc3d_ros.training.shards import TrainingTown


def test_a_step_has_one_batch_whoever_asks(make_training_town: Callable[..., TrainingTown], tiny: TrainConfig) -> None:
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
    # A scan's patch is turned as a query's is: its corners leave the cube.
    assert max(np.hypot(patch[:, 0], patch[:, 1]).max() for patch in batch.scans) <= np.sqrt(2.0) + 1e-6


def test_a_cut_without_turn_is_the_map_builder_s(
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


def test_a_turned_cut_holds_the_turned_square(make_training_town: Callable[..., TrainingTown]) -> None:
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


def test_nothing_to_learn_from_is_said(make_training_town: Callable[..., TrainingTown], tiny: TrainConfig) -> None:
    with pytest.raises(TrainingError, match="no scan to learn from"):
        BatchSampler([], tiny)
    without_positives = dataclasses.replace(make_training_town(0), survey_points=np.zeros((1, 3), np.float32))
    with pytest.raises(TrainingError, match="gave no pair of patches"):
        BatchSampler([without_positives], tiny).batch(0)
