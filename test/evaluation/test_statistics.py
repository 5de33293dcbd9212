"""Statistics against plain definitions, and properties that they must have."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, hypergeom

from crossloc3d_ros.evaluation.statistics import (
    chance_level,
    clustered_quantile,
    clustered_share,
    clusters_of,
    independent_places,
    one_per_cent,
    recall_at,
    reliability,
    wilson_share,
)


def test_recall_is_the_share_of_scans_with_a_near_candidate_among_the_first() -> None:
    distances = np.array([[10.0, 3.0], [60.0, 20.0], [101.0, 99.0], [np.nan, np.nan]])
    assert recall_at(distances, 1, 25.0) == 1 / 4
    assert recall_at(distances, 1, 100.0) == 2 / 4
    assert recall_at(distances, 2, 25.0) == 2 / 4
    assert recall_at(distances, 2, 100.0) == 3 / 4
    assert recall_at(distances, 25, 100.0) == 3 / 4
    assert recall_at(np.array([[100.0]]), 1, 100.0) == 1.0  # "within" includes the circle


@pytest.mark.parametrize("rank", [1, 2, 3, 4])
def test_chance_is_the_share_of_draws_that_hit(rank: int) -> None:
    submaps = 6
    for within in range(submaps + 1):
        draws = list(itertools.combinations(range(submaps), rank))
        expected = sum(any(i < within for i in draw) for draw in draws) / len(draws)
        assert chance_level(np.array([within]), submaps, rank)[-1] == pytest.approx(expected)


def test_chance_on_a_map_smaller_than_the_rank() -> None:
    np.testing.assert_allclose([chance_level(np.array([within]), 3, 25)[-1] for within in (0, 1, 3)], [0.0, 1.0, 1.0])


def test_chance_is_that_of_drawing_without_replacement() -> None:
    within = np.array([1, 3, 3, 8])
    curve = chance_level(within, 20, 12)
    for rank in (1, 5, 12):
        assert curve[rank - 1] == pytest.approx(np.mean([hypergeom(20, count, rank).sf(0) for count in within]))
    rng = np.random.default_rng(0)
    drawn = np.array([rng.permutation(20)[:5] for _ in range(20_000)])
    simulated = np.mean([(drawn < count).any(axis=1).mean() for count in within])
    assert curve[4] == pytest.approx(simulated, abs=0.005)
    assert chance_level(np.array([2]), 3, 5).tolist() == pytest.approx([2 / 3, 1.0, 1.0, 1.0, 1.0])
    assert np.isnan(chance_level(np.zeros(0, np.int64), 20, 3)).all()


@pytest.mark.parametrize(("successes", "count"), [(0, 10), (10, 10), (3, 10), (37, 80)])
def test_interval_is_wilsons(successes: int, count: int) -> None:
    share = wilson_share(successes / count, count)
    expected = binomtest(successes, count).proportion_ci(method="wilson")
    assert (share.low, share.high) == pytest.approx((expected.low, expected.high))


def test_standing_still_is_one_piece_of_evidence() -> None:
    still = np.tile([[5.0, 7.0]], (500, 1))
    assert independent_places(still) == 1
    there_and_back = np.concatenate([np.linspace(0, 100, 400), np.linspace(100, 0, 400)])
    assert independent_places(np.column_stack([there_and_back, np.zeros(800)]), 25.0) == 4
    assert independent_places(np.empty((0, 2))) == 0


def test_an_interval_counts_towns_and_not_queries() -> None:
    towns = np.repeat(np.arange(10), 100)
    all_or_nothing = clustered_share(towns < 5, towns, 1000)
    assert all_or_nothing.value == 0.5
    assert all_or_nothing.low < 0.25
    assert all_or_nothing.high > 0.75
    mixed = clustered_share(np.arange(1000) % 2 == 0, towns, 1000)
    assert 0.46 < mixed.low < 0.5 < mixed.high < 0.54


def test_an_interval_of_nothing_but_hits_has_a_width() -> None:
    share = clustered_share(np.ones(50, np.bool_), np.repeat(np.arange(10), 5), 50)
    assert (share.value, share.high) == (1.0, 1.0)
    assert 0.9 < share.low < 0.95


def test_intervals_cover_the_truth_about_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        chance = np.clip(rng.normal(0.6, 0.15, 20), 0, 1)  # towns differ
        towns = np.repeat(np.arange(20), 40)
        share = clustered_share(rng.random(800) < chance[towns], towns, 800)
        covered += share.low <= 0.6 <= share.high
    assert 0.88 <= covered / 200 <= 0.99


def test_few_towns_are_divided_into_squares() -> None:
    ends = np.array([(0.0, 0.0), (360.0, 0.0), (0.0, 0.0), (900.0, 0.0)])
    assert len(set(clusters_of(np.array([0, 0, 1, 1]), ends).tolist())) == 4  # both ends of two towns
    many = np.tile([(0.0, 0.0), (500.0, 0.0)], (9, 1))
    assert len(set(clusters_of(np.arange(18) // 2, many).tolist())) == 9


@given(st.lists(st.floats(0, 100), min_size=1, max_size=40), st.sampled_from([0.5, 0.95]), st.integers(1, 12))
def test_a_quantile_lies_in_its_interval_and_among_the_values(values: list[float], q: float, clusters: int) -> None:
    array = np.array(values)
    value, low, high = clustered_quantile(array, np.arange(len(array)) % clusters, q)
    assert low <= value <= high
    assert array.min() <= low
    assert high <= array.max()


def test_the_interval_of_a_quantile_grows_with_fewer_towns() -> None:
    town = np.repeat(np.arange(20), 10)
    values = town + np.random.default_rng(0).random(200)
    one = clustered_quantile(values, np.arange(200), 0.5)
    other = clustered_quantile(values, town, 0.5)
    assert other[2] - other[1] > 2 * (one[2] - one[1])


def test_one_per_cent_is_rounded_as_published_or_up() -> None:
    assert [one_per_cent(count, rounded_up=False) for count in (3, 149, 151, 730)] == [1, 1, 2, 7]
    assert [one_per_cent(count, rounded_up=True) for count in (3, 149, 151, 730)] == [1, 2, 2, 8]


def test_reliability_counts_every_probability_once() -> None:
    probability, right = np.array([0.0, 0.1, 0.5, 0.999, 1.0]), np.array([False, True, True, False, True])
    bins = reliability(probability, right, (0.0, 0.1, 0.9, 1.0))
    assert [(each.low, each.high, each.scans) for each in bins] == [(0.0, 0.1, 1), (0.1, 0.9, 2), (0.9, 1.0, 2)]
    assert [each.right.value for each in bins] == [0.0, 1.0, 0.5]
    assert bins[1].mean_belief == pytest.approx(0.3)
    fewer = reliability(probability, right, (0.0, 0.1, 0.9, 1.0), lambda inside: 1)
    assert fewer[1].right.low < bins[1].right.low
