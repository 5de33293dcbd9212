"""Recall against counts made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.training.shards import ValidationTown
from crossloc3d_ros.training.validation import Places, ground_distances, score, validate
from crossloc3d_ros.types import Float32Array


def places(town: list[int], xy: list[tuple[float, float]]) -> Places:
    return Places(np.array(town, dtype=np.int64), np.array(xy, dtype=np.float64))


def test_places_of_different_towns_are_never_near() -> None:
    metres = ground_distances(places([0], [(0.0, 0.0)]), places([0, 1], [(3.0, 4.0), (0.0, 0.0)]))
    assert metres.tolist() == [[5.0, math.inf]]


def test_recall_counts_the_queries_whose_nearest_descriptors_hold_a_near_place() -> None:
    metres = np.array([[10.0, 30.0, 90.0, 500.0], [500.0, 20.0, 500.0, 500.0]])
    descriptors = np.array([[3.0, 2.0, 1.0, 9.0], [1.0, 4.0, 2.0, 3.0]])
    result = score(descriptors, metres)
    assert result.recall("R@1", 100.0).share.value == 0.5  # query 0 finds the place 90 m away, query 1 a wrong one
    assert result.recall("R@1", 50.0).share.value == 0.0
    assert result.recall("R@5", 25.0).share.value == 1.0
    assert result.recall("R@1", 100.0).chance == pytest.approx((3 / 4 + 1 / 4) / 2)
    assert result.true_distances[4] == pytest.approx(np.median([3.0, 4.0]))
    assert result.false_distances[4] == pytest.approx(np.median([9.0, 1.0]))


def test_chance_is_what_random_descriptors_reach() -> None:
    rng = np.random.default_rng(0)
    metres = rng.uniform(0.0, 1000.0, (4000, 60))
    result = score(rng.random((4000, 60)), metres)
    for recall in result.recalls:
        assert recall.share.value == pytest.approx(recall.chance, abs=0.03), recall


def test_the_true_one_per_cent_grows_with_the_database() -> None:
    result = score(np.random.default_rng(0).random((3, 730)), np.full((3, 730), 10.0))
    assert result.recall("R@1%", 100.0).rank == 8


def test_a_query_rotated_by_steps_finds_the_submap_that_a_heading_sensitive_code_gives_only_aligned() -> None:
    rng = np.random.default_rng(3)
    submaps = rng.uniform(-1, 1, (40, 64, 3)).astype(np.float32)
    headings = 2 * np.pi * rng.integers(0, 8, 40) / 8
    queries = np.stack([rotate_about_z(cloud, angle) for cloud, angle in zip(submaps, headings, strict=True)])
    xy_m = np.column_stack([500.0 * np.arange(40.0), np.zeros(40)])
    town = ValidationTown("town", xy_m, queries, xy_m, submaps)

    def encode(clouds: list[Float32Array]) -> Float32Array:
        return np.stack([cloud[:, :2].ravel() for cloud in clouds])  # as sensitive to heading as can be

    assert validate([town], encode, 8).recall("R@1", 25.0).share.value == 1.0
    assert validate([town], encode, 1).recall("R@1", 25.0).share.value < 0.6
    assert max(validate([town], encode, 8).true_distances) < 1e-4
