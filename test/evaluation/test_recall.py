"""Scores against plain definitions, and properties that any score must have."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from crossloc3d_ros.evaluation import recall

ORIGIN = np.array([640_000.0, 5_800_000.0])


def drive(seed: int = 0, scans: int = 40, candidates: int = 30) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = np.column_stack([np.linspace(0, 400, scans), np.full(scans, 200.0)]) + ORIGIN
    found = truth[:, None] + rng.normal(0, 80, (scans, candidates, 2))
    east, north = np.meshgrid(np.arange(0, 401, 19.0), np.arange(0, 401, 19.0))
    return {
        "truth": truth,
        "has_fix": rng.uniform(size=scans) < 0.7,
        "fixes": truth + rng.normal(0, 80, (scans, 2)),
        "covariance": np.tile(np.eye(2) * 80.0**2, (scans, 1, 1)),
        "candidates": found,
        "submaps": np.column_stack([east.ravel(), north.ravel()]) + ORIGIN,
    }


def test_recall_is_the_share_of_scans_with_a_near_candidate_among_the_first() -> None:
    distances = np.array([[10.0, 3.0], [60.0, 20.0], [101.0, 99.0], [np.nan, np.nan]])
    assert recall.recall_at(distances, 1, 25.0) == 1 / 4
    assert recall.recall_at(distances, 1, 100.0) == 2 / 4
    assert recall.recall_at(distances, 2, 25.0) == 2 / 4
    assert recall.recall_at(distances, 2, 100.0) == 3 / 4
    assert recall.recall_at(distances, 25, 100.0) == 3 / 4
    assert recall.recall_at(np.array([[100.0]]), 1, 100.0) == 1.0  # "within" includes the circle


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_recall_grows_with_rank_and_radius(seed: int) -> None:
    scores = recall.score(**drive(seed))
    for radius_m in recall.RADII_M:
        shares = [scores.recall(rank, radius_m).share.value for rank in recall.RANKS]
        assert shares == sorted(shares)
    for rank in recall.RANKS:
        shares = [scores.recall(rank, radius_m).share.value for radius_m in recall.RADII_M]
        assert shares == sorted(shares, reverse=True)


def test_scores_do_not_depend_on_where_the_origin_is() -> None:
    here, there = drive(), drive()
    for name in ("truth", "fixes", "candidates", "submaps"):
        there[name] = there[name] - ORIGIN
    assert recall.score(**here).recalls == recall.score(**there).recalls


@pytest.mark.parametrize("rank", [1, 2, 3, 4])
def test_chance_is_the_share_of_draws_that_hit(rank: int) -> None:
    submaps = 6
    for within in range(submaps + 1):
        draws = list(itertools.combinations(range(submaps), rank))
        expected = sum(any(i < within for i in draw) for draw in draws) / len(draws)
        assert recall.chance_of_hit(np.array([within]), submaps, rank)[0] == pytest.approx(expected)


def test_chance_on_a_map_smaller_than_the_rank() -> None:
    np.testing.assert_allclose(recall.chance_of_hit(np.array([0, 1, 3]), 3, 25), [0.0, 1.0, 1.0])


def test_random_candidates_score_at_chance() -> None:
    world = drive(scans=400, candidates=0)
    rng = np.random.default_rng(5)
    chosen = np.stack([rng.permutation(len(world["submaps"]))[:25] for _ in range(400)])
    scores = recall.score(**(world | {"candidates": world["submaps"][chosen]}))
    for cell in scores.recalls:
        assert cell.share.value == pytest.approx(cell.chance, abs=0.06)


@pytest.mark.parametrize(("successes", "count"), [(0, 10), (10, 10), (3, 10), (37, 80)])
def test_interval_is_wilsons(successes: int, count: int) -> None:
    share = recall.wilson_share(successes / count, count)
    expected = binomtest(successes, count).proportion_ci(method="wilson")
    assert (share.low, share.high) == pytest.approx((expected.low, expected.high))


def test_standing_still_is_one_piece_of_evidence() -> None:
    still = np.tile([[5.0, 7.0]], (500, 1))
    assert recall.independent_places(still) == 1
    there_and_back = np.concatenate([np.linspace(0, 100, 400), np.linspace(100, 0, 400)])
    assert recall.independent_places(np.column_stack([there_and_back, np.zeros(800)]), 25.0) == 4
    assert recall.independent_places(np.empty((0, 2))) == 0


def test_more_scans_of_the_same_drive_do_not_narrow_the_interval() -> None:
    coarse = drive(scans=40)
    dense = {name: values if name == "submaps" else np.repeat(values, 10, axis=0) for name, values in coarse.items()}
    assert recall.score(**coarse).recall(5, 50.0).share == recall.score(**dense).recall(5, 50.0).share


def test_an_honest_covariance_holds_the_truth_in_95_of_100() -> None:
    rng = np.random.default_rng(1)
    covariance = np.array([[900.0, 300.0], [300.0, 400.0]])
    offsets = rng.multivariate_normal([0, 0], covariance, 20_000)
    summary = recall.summarise_errors(offsets, np.tile(covariance, (20_000, 1, 1)))
    assert summary.within_ellipse == pytest.approx(0.95, abs=0.005)
    boastful = recall.summarise_errors(offsets, np.tile(covariance / 9, (20_000, 1, 1)))
    assert boastful.within_ellipse < 0.4


def test_a_covariance_that_is_none_holds_nothing() -> None:
    offsets = np.ones((3, 2))
    covariance = np.stack([np.zeros((2, 2)), np.full((2, 2), np.nan), np.diag([1.0, -1.0])])
    assert recall.summarise_errors(offsets, covariance).within_ellipse == 0.0


def test_errors_are_of_fixes_with_known_truth_alone() -> None:
    world = drive(scans=4)
    world["has_fix"] = np.array([True, True, False, True])
    world["truth"][1] = np.nan
    world["fixes"] = world["truth"] + [[3.0, 4.0], [0.0, 0.0], [1000.0, 0.0], [30.0, 40.0]]
    scores = recall.score(**world)
    assert scores.fix_error.count == 2
    assert scores.fix_error.median_m == pytest.approx((5 + 50) / 2)
    assert scores.no_fix.value == 1 / 4
    assert (scores.scans, scores.scored) == (4, 3)


def test_nothing_to_score_is_no_crash() -> None:
    world = drive(scans=5, candidates=0)
    world["fixes"] = np.full((5, 2), np.nan)
    world["has_fix"] = np.zeros(5, dtype=bool)
    scores = recall.score(**world)
    assert scores.fix_error.count == scores.best_candidate_error.count == 0
    assert all(cell.share.value == 0.0 for cell in scores.recalls)
    assert scores.no_fix.value == 1.0
    world["truth"] = np.full((5, 2), np.nan)
    assert np.isnan(recall.score(**world).recall(1, 25.0).share.value)
