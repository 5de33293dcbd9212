"""What augmentation makes of a place between two days and two sensors."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.training.augmentation import change
from crossloc3d_ros.types import Float32Array


@pytest.fixture
def place() -> Float32Array:
    return np.random.default_rng(0).uniform([-50, -50, 0.5], [50, 50, 8], (20_000, 3)).astype(np.float32)


def test_nothing_changes_by_default(place: Float32Array) -> None:
    assert np.array_equal(change(place, 50.0, np.random.default_rng(1), TrainConfig()), place)


def test_as_many_points_stay_as_set(place: Float32Array) -> None:
    config = TrainConfig(keep_survey=0.3)
    shares = [len(change(place, 50.0, np.random.default_rng(seed), config)) / len(place) for seed in range(40)]
    assert 0.28 < min(shares) < 0.45 and 0.85 < max(shares) <= 1.0


def test_things_go_and_others_come(place: Float32Array) -> None:
    changed = change(place, 50.0, np.random.default_rng(2), TrainConfig(changes=8.0))
    before, after = ({tuple(point) for point in points.tolist()} for points in (place, changed))
    gone, come = before - after, after - before
    assert gone and come
    middles = np.array(sorted(gone))[:, :2]
    # What goes are whole things, of metres: every lost point has lost neighbours.
    nearest = np.sort(np.hypot(*(middles[:, None] - middles[None]).transpose(2, 0, 1)), axis=1)[:, 1]
    assert np.quantile(nearest, 0.95) < 3.0
    assert min(point[2] for point in come) >= 0.0


def test_displacement_is_of_the_configured_size_and_of_the_seed(place: Float32Array) -> None:
    config = TrainConfig(displacement_m=0.2)
    moved = [change(place, 50.0, np.random.default_rng(seed), config) - place for seed in range(20)]
    assert 0.05 < np.mean([np.std(offsets[:, 0]) for offsets in moved]) < 0.2
    assert np.std([offsets[:, 2].mean() for offsets in moved]) > 0.1  # the whole survey lies higher or deeper
    again = change(place, 50.0, np.random.default_rng(0), config) - place
    assert np.array_equal(again, moved[0])
