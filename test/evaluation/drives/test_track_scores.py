"""Scores of a pose that is followed: held against drives whose errors are known by construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from crossloc3d_ros.evaluation.drives import track_scores
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable, PoseLists, no_pose_lists
from crossloc3d_ros.types import TrackState

WEST, SOUTH = 628_000.0, 5_803_000.0


def drive(
    offsets: np.ndarray,
    *,
    has_fix: Sequence[bool] | None = None,
    place: np.ndarray | None = None,
    covariance: np.ndarray | None = None,
    turned_rad: np.ndarray | None = None,
    heading_std_rad: float = 0.01,
    probability: np.ndarray | None = None,
    step_m: float = 0.5,
) -> EstimateTable:
    """Return the table of a drive eastwards at 10 Hz whose estimates are off by `offsets` (S, 2)."""
    scans = len(offsets)
    if place is None:
        place = np.column_stack([WEST + step_m * np.arange(scans), np.full(scans, SOUTH)])
    fix = np.ones(scans, bool) if has_fix is None else np.array(has_fix, bool)
    turned = np.zeros(scans) if turned_rad is None else turned_rad
    matrix = np.tile(np.eye(3) * 0.25, (scans, 1, 1)) if covariance is None else covariance
    return EstimateTable(
        stamp_ns=1_700_000_000_000_000_000 + np.arange(scans) * 100_000_000,
        has_fix=fix,
        geographic=np.full((scans, 3), np.nan),
        grid=np.column_stack([place + offsets, np.zeros(scans)]),
        covariance=matrix,
        timings_ms=np.full((scans, 6), np.nan),
        points=np.full((scans, 2), 4096),
        candidate_ids=np.empty((scans, 0), dtype=np.int64),
        candidate_distances=np.empty((scans, 0)),
        candidate_probabilities=np.empty((scans, 0)),
        candidate_grid=np.empty((scans, 0, 2)),
        truth_grid=place,
        truth_heading_rad=np.zeros(scans),
        states=tuple(TrackState.LOCALIZED if f else TrackState.SEARCHING for f in fix),
        probability=np.where(fix, 0.9995, 0.2) if probability is None else probability,
        heading_rad=turned,
        heading_std_rad=np.full(scans, heading_std_rad),
        aligned=no_pose_lists(scans),
        aligned_sources=np.empty((scans, 0), dtype=np.int64),
        hypotheses=no_pose_lists(scans),
        reasons=("",) * scans,
    )


def test_honest_covariances_hold_what_they_promise_and_too_small_ones_do_not() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4000, 2, 2)) + 1.5 * np.eye(2)
    covariance = np.zeros((4000, 3, 3))
    covariance[:, :2, :2] = root @ np.swapaxes(root, 1, 2)
    covariance[:, 2, 2] = 1.0
    offsets = np.einsum("nij,nj->ni", root, rng.normal(size=(4000, 2)))
    turned = rng.normal(0, 0.01, 4000)
    for scale, expected in ((1.0, (0.683, 0.954, 0.997)), (2.0, None)):
        rows = track_scores.coverage(drive(scale * offsets, covariance=covariance, turned_rad=scale * turned))
        assert [row.sigma for row in rows] == [1.0, 2.0, 3.0]
        for row in rows:
            if expected is not None:
                assert (row.position, row.heading) == pytest.approx((row.expected, row.expected), abs=0.03)
            else:
                assert max(row.position, row.heading) < row.expected - 0.05
    np.testing.assert_allclose([row.expected for row in rows], (0.683, 0.954, 0.997), atol=1e-3)


def test_a_missing_covariance_holds_nothing() -> None:
    covariance = np.full((5, 3, 3), np.nan)
    table = drive(np.zeros((5, 2)), covariance=covariance, heading_std_rad=float("nan"))
    assert [(row.position, row.heading) for row in track_scores.coverage(table)] == [(0.0, 0.0)] * 3


def test_errors_are_those_of_the_fixes_alone() -> None:
    offsets = np.array([[100.0, 0.0], [0.3, 0.4], [3.0, 4.0], [12.0, 0.0], [0.0, 0.0]])
    turned = np.radians([90.0, -1.0, 2.0, 3.0, 0.0])
    table = drive(offsets, has_fix=[False, True, True, True, True], turned_rad=turned)
    errors = track_scores.pose_errors(table)
    assert (errors.count, errors.headings, errors.wrong) == (4, 4, 1)
    assert errors.median_m == pytest.approx(2.75)
    assert errors.max_m == pytest.approx(12.0)
    assert errors.median_deg == pytest.approx(1.5)
    assert errors.wrong_share == 0.25


def test_beliefs_are_counted_by_range_whether_or_not_there_was_a_fix() -> None:
    scans = 400
    probability = np.tile([0.0, 0.005, 0.95, 0.9999], 100)
    offsets = np.zeros((scans, 2))
    offsets[0::4] = [np.nan, np.nan]  # no place at all is neither right nor wrong
    offsets[1::4] = [50.0, 0.0]
    offsets[2::40] = [50.0, 0.0]  # ten of the hundred that are believed by 95 %
    table = drive(offsets, has_fix=np.tile([False, False, False, True], 100), probability=probability)
    rows = track_scores.beliefs(table)
    assert [(row.low, row.scans) for row in rows] == [(0.0, 100), (0.9, 100), (0.999, 100)]
    assert [row.right.value for row in rows] == [0.0, 0.9, 1.0]
    assert rows[2].mean_belief == pytest.approx(0.9999)
    assert rows[1].right.low < 0.6  # 200 m of way are eight places, not a hundred


def test_without_a_fix_the_belief_is_that_in_the_likeliest_hypothesis() -> None:
    """So it comes over ROS, where a pose is published with a fix alone."""
    offsets = np.full((4, 2), np.nan)
    table = drive(offsets, has_fix=[False] * 4, probability=np.full(4, 0.6))
    held = np.stack([table.truth_grid + np.array([3.0, 0.0]), table.truth_grid], axis=1)
    held[3, 0] += 500.0
    rest = np.zeros((4, 2))
    poses = PoseLists(held, rest, np.zeros((4, 2, 2, 2)), rest, np.tile([0.6, 0.2], (4, 1)))
    (row,) = track_scores.beliefs(replace(table, hypotheses=poses))
    assert (row.scans, row.right.value) == (4, 0.75)
    assert track_scores.beliefs(table) == ()


def test_a_search_lasts_until_the_first_right_fix() -> None:
    offsets = np.zeros((100, 2))
    offsets[20:30] = [30.0, 0.0]  # fixes, but wrong ones
    has_fix = np.arange(100) >= 20
    scores = track_scores.score_track(drive(offsets, has_fix=has_fix))
    assert scores is not None
    (search,) = scores.searches
    assert (search.cause, search.start, search.end, search.wrong_fixes) == ("from nothing", 0, 30, 10)
    assert search.travelled_m == pytest.approx(15.0)
    assert search.seconds == pytest.approx(3.0)
    assert scores.travelled_m == pytest.approx(49.5)
    assert scores.states == {"searching": 20, "localized": 80}


def test_gaps_are_listed_where_the_robot_drove_on() -> None:
    has_fix = np.ones(100, bool)
    has_fix[30:35] = False  # 2.5 m
    has_fix[50:70] = False  # 10 m
    has_fix[90:] = False
    scores = track_scores.score_track(drive(np.zeros((100, 2)), has_fix=has_fix))
    assert scores is not None
    assert [(s.cause, s.start, s.end) for s in scores.searches] == [
        ("from nothing", 0, 0),
        ("in between", 50, 70),
        ("in between", 90, None),
    ]
    assert scores.short_gaps == 1


@pytest.mark.parametrize("notices", [True, False])
def test_being_carried_away_is_seen_in_the_truth_and_is_no_way_driven(notices: bool) -> None:
    place = np.column_stack([WEST + 0.5 * np.arange(200), np.full(200, SOUTH)])
    place[100:, 1] += 300.0
    offsets = np.zeros((200, 2))
    offsets[100:140, 1] = -300.0  # it believes that it is where it was
    has_fix = np.ones(200, bool)
    if notices:
        has_fix[100:140] = False
    scores = track_scores.score_track(drive(offsets, has_fix=has_fix, place=place))
    assert scores is not None
    first, carried = scores.searches
    assert (first.cause, first.end) == ("from nothing", 0)
    assert (carried.cause, carried.start, carried.end) == ("kidnapped", 100, 140)
    assert carried.travelled_m == pytest.approx(20.0)
    assert carried.wrong_fixes == (0 if notices else 40)
    assert scores.travelled_m == pytest.approx(99.0)


def test_carried_away_twice_before_it_was_found() -> None:
    place = np.column_stack([WEST + 0.5 * np.arange(90), np.full(90, SOUTH)])
    place[30:, 1] += 300.0
    place[60:, 1] += 300.0
    has_fix = np.arange(90) >= 80
    scores = track_scores.score_track(drive(np.zeros((90, 2)), has_fix=has_fix, place=place))
    assert scores is not None
    assert [(s.cause, s.start, s.end) for s in scores.searches] == [
        ("from nothing", 0, None),
        ("kidnapped", 30, None),
        ("kidnapped", 60, 80),
    ]


def test_scans_without_truth_neither_begin_nor_end_a_search() -> None:
    place = np.column_stack([WEST + 0.5 * np.arange(100), np.full(100, SOUTH)])
    table = drive(np.zeros((100, 2)), has_fix=(np.arange(100) < 40) | (np.arange(100) >= 60), place=place)
    place[40:60] = np.nan
    scores = track_scores.score_track(table)
    assert scores is not None
    assert [s.cause for s in scores.searches] == ["from nothing"]
    assert scores.scored == 80
    assert scores.travelled_m == pytest.approx(49.5)  # straight over the gap
    place[:] = np.nan
    assert track_scores.score_track(table) is None
