"""Scores against plain definitions, and properties that any score must have."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.evaluation.drives import place_scores
from crossloc3d_ros.evaluation.statistics import RADII_M

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


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_recall_grows_with_rank_and_radius(seed: int) -> None:
    scores = place_scores.score(**drive(seed))
    for radius_m in RADII_M:
        shares = [scores.recall(rank, radius_m).share.value for rank in place_scores.RANKS]
        assert shares == sorted(shares)
    for rank in place_scores.RANKS:
        shares = [scores.recall(rank, radius_m).share.value for radius_m in RADII_M]
        assert shares == sorted(shares, reverse=True)


def test_scores_do_not_depend_on_where_the_origin_is() -> None:
    here, there = drive(), drive()
    for name in ("truth", "fixes", "candidates", "submaps"):
        there[name] = there[name] - ORIGIN
    assert place_scores.score(**here).recalls == place_scores.score(**there).recalls


def test_random_candidates_score_at_chance() -> None:
    world = drive(scans=400, candidates=0)
    rng = np.random.default_rng(5)
    chosen = np.stack([rng.permutation(len(world["submaps"]))[:25] for _ in range(400)])
    scores = place_scores.score(**(world | {"candidates": world["submaps"][chosen]}))
    for cell in scores.recalls:
        assert cell.share.value == pytest.approx(cell.chance, abs=0.06)


def test_more_scans_of_the_same_drive_do_not_narrow_the_interval() -> None:
    coarse = drive(scans=40)
    dense = {name: values if name == "submaps" else np.repeat(values, 10, axis=0) for name, values in coarse.items()}
    assert place_scores.score(**coarse).recall(5, 50.0).share == place_scores.score(**dense).recall(5, 50.0).share


def test_an_honest_covariance_holds_the_truth_in_95_of_100() -> None:
    rng = np.random.default_rng(1)
    covariance = np.array([[900.0, 300.0], [300.0, 400.0]])
    offsets = rng.multivariate_normal([0, 0], covariance, 20_000)
    summary = place_scores.summarise_errors(offsets, np.tile(covariance, (20_000, 1, 1)))
    assert summary.within_ellipse == pytest.approx(0.95, abs=0.005)
    boastful = place_scores.summarise_errors(offsets, np.tile(covariance / 9, (20_000, 1, 1)))
    assert boastful.within_ellipse < 0.4


def test_a_covariance_that_is_none_holds_nothing() -> None:
    offsets = np.ones((3, 2))
    covariance = np.stack([np.zeros((2, 2)), np.full((2, 2), np.nan), np.diag([1.0, -1.0])])
    assert place_scores.summarise_errors(offsets, covariance).within_ellipse == 0.0


def test_errors_are_of_fixes_with_known_truth_alone() -> None:
    world = drive(scans=4)
    world["has_fix"] = np.array([True, True, False, True])
    world["truth"][1] = np.nan
    world["fixes"] = world["truth"] + [[3.0, 4.0], [0.0, 0.0], [1000.0, 0.0], [30.0, 40.0]]
    scores = place_scores.score(**world)
    assert scores.fix_error.count == 2
    assert scores.fix_error.median_m == pytest.approx((5 + 50) / 2)
    assert scores.no_fix.value == 1 / 4
    assert (scores.scans, scores.scored) == (4, 3)


def test_nothing_to_score_is_no_crash() -> None:
    world = drive(scans=5, candidates=0)
    world["fixes"] = np.full((5, 2), np.nan)
    world["has_fix"] = np.zeros(5, dtype=bool)
    scores = place_scores.score(**world)
    assert scores.fix_error.count == scores.best_candidate_error.count == 0
    assert all(cell.share.value == 0.0 for cell in scores.recalls)
    assert scores.no_fix.value == 1.0
    world["truth"] = np.full((5, 2), np.nan)
    assert np.isnan(place_scores.score(**world).recall(1, 25.0).share.value)
