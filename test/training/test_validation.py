"""Recall against counts made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.training.validation import Places, ground_distances, score


def places(town: list[int], xy: list[tuple[float, float]]) -> Places:
    return Places(np.array(town, dtype=np.int64), np.array(xy, dtype=np.float64))


def test_places_of_different_towns_are_never_near() -> None:
    metres = ground_distances(places([0], [(0.0, 0.0)]), places([0, 1], [(3.0, 4.0), (0.0, 0.0)]))
    assert metres.tolist() == [[5.0, math.inf]]


def test_recall_counts_the_queries_whose_nearest_descriptors_hold_a_near_place() -> None:
    metres = np.array([[10.0, 30.0, 90.0, 500.0], [500.0, 20.0, 500.0, 500.0]])
    descriptors = np.array([[3.0, 2.0, 1.0, 9.0], [1.0, 4.0, 2.0, 3.0]])
    result = score(descriptors, metres)
    assert result.recall("R@1", 100.0).value == 0.5  # query 0 finds the place 90 m away, query 1 a wrong one
    assert result.recall("R@1", 50.0).value == 0.0
    assert result.recall("R@5", 25.0).value == 1.0
    assert result.recall("R@1", 100.0).chance == pytest.approx((3 / 4 + 1 / 4) / 2)
    assert result.true_distances[4] == pytest.approx(np.median([3.0, 4.0]))
    assert result.false_distances[4] == pytest.approx(np.median([9.0, 1.0]))


def test_chance_is_what_random_descriptors_reach() -> None:
    rng = np.random.default_rng(0)
    metres = rng.uniform(0.0, 1000.0, (4000, 60))
    result = score(rng.random((4000, 60)), metres)
    for recall in result.recalls:
        assert recall.value == pytest.approx(recall.chance, abs=0.03), recall


def test_the_true_one_per_cent_grows_with_the_database() -> None:
    result = score(np.random.default_rng(0).random((3, 730)), np.full((3, 730), 10.0))
    assert result.recall("R@1%", 100.0).count == 8
