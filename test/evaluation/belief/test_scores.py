"""Scores of belief: what is counted, on which side of the map, and what is enough."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.evaluation.belief.goals import LEAST_PLACES
from crossloc3d_ros.evaluation.belief.pieces import PieceAbout
from crossloc3d_ros.evaluation.belief.predictions import BeliefAbout, BeliefPredictions
from crossloc3d_ros.evaluation.belief.report import write_report
from crossloc3d_ros.evaluation.belief.results import as_csv, as_json, as_markdown
from crossloc3d_ros.evaluation.belief.scores import BeliefScores, belief_alone, is_lost, score_belief
from crossloc3d_ros.evaluation.poses.predictions import ALIGNED, CANDIDATES, SINGLE, PosePredictions, join

ABOUT = BeliefAbout("test", "f" * 16, "c" * 16, {}, 1, ("a", "b", "c"))
TOWNS = 10


def rows_of(count: int, seed: int, journey: int = SINGLE, *, believed: float = 0.9999, fix: bool = False):
    """Return answers that are right by a few centimetres, in ten towns."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack([rng.uniform(0, 600, (count, 2)), np.zeros(count), rng.uniform(-3, 3, count)])
    sigma = np.array([0.1, 0.1, 0.002])
    pose = truth.copy()
    pose[:, [0, 1, 3]] += rng.normal(0, 1, (count, 3)) * sigma
    aligned = np.full((count, ALIGNED, 3), np.nan)
    aligned[:, 0] = pose[:, [0, 1, 3]]
    unknown = np.full((count, ALIGNED), np.nan)
    probability = unknown.copy()
    probability[:, 0] = believed
    return PosePredictions(
        journey=np.full(count, journey), leg=np.zeros(count, np.int64), area=np.arange(count) % TOWNS,
        group=np.zeros(count, np.int64), stamp_ns=np.arange(count) * 500_000_000, travelled_m=np.arange(count) * 1.0,
        truth=truth, has_fix=np.full(count, fix), state=np.zeros(count, np.int64),
        probability=np.full(count, believed), pose=pose, covariance=np.tile(np.diag(sigma**2), (count, 1, 1)),
        candidates=np.full((count, CANDIDATES, 2), np.nan), aligned=aligned,
        aligned_source=np.zeros((count, ALIGNED), np.int64), aligned_probability=probability,
        aligned_log_likelihood=unknown, aligned_covariance=np.tile(np.diag(sigma**2), (count, 1, 1)),
        milliseconds=np.full((count, 5), 10.0),
    )  # fmt: skip


def about_of(on_map: bool, learned: bool = False, condition: str = "as delivered", map_name: str = "") -> PieceAbout:
    towns = tuple(f"town {i}" for i in range(TOWNS))
    name = map_name or ("simulated" if on_map else "woods")
    return PieceAbout("piece", on_map, name, "simulated", condition, "a drive", towns, learned, False)


def scored(*parts: tuple[PieceAbout, PosePredictions]) -> BeliefScores:
    """Score pieces; their journeys are numbered by the pieces, as `load_pieces` does."""
    rows = [dataclasses.replace(p, journey=np.where(p.journey >= 0, i, p.journey)) for i, (_, p) in enumerate(parts)]
    joined = join(rows)
    piece = np.repeat(np.arange(len(parts)), [len(p) for _, p in parts])
    climbed = np.full((len(joined), 2), np.nan)
    return score_belief(BeliefPredictions(joined, piece, climbed, tuple(about for about, _ in parts), 0), ABOUT)


def measure(scores: BeliefScores, key: str):
    return next(each for each in scores.measures if each.key == key)


def moved(rows: PosePredictions, metres: float, count: int) -> PosePredictions:
    """Return the answers with the first of them that far away."""
    pose, aligned = rows.pose.copy(), rows.aligned.copy()
    pose[:count, 0] += metres
    aligned[:count, 0, 0] += metres
    return dataclasses.replace(rows, pose=pose, aligned=aligned)


def test_belief_of_a_scan_counts_poses_within_ten_metres_together() -> None:
    rows = rows_of(3, 0, believed=0.4)
    rows.aligned[:, 1] = rows.aligned[:, 0] + [6.0, 0.0, 1.0]
    rows.aligned[:, 2] = rows.aligned[:, 0] + [11.0, 0.0, 0.0]
    rows.aligned_probability[:, 1:3] = [0.3, 0.2]
    rows.aligned[2] = np.nan
    rows.aligned_probability[2] = np.nan
    np.testing.assert_allclose(belief_alone(rows), [0.7, 0.7, 0.0])


def test_a_pose_is_lost_where_the_answer_is_wrong_and_the_truth_scores_higher() -> None:
    rows = moved(rows_of(6, 1), 50.0, 4)
    climbed = np.array([[7.4, 3.9], [3.9, 7.4], [5.0, 4.9999], [2.0, math.nan], [7.4, 3.9], [math.nan, math.nan]])
    assert is_lost(rows, climbed).tolist() == [True, False, False, True, False, False]


def test_calibration_of_honest_beliefs_is_zero_and_of_bold_ones_what_they_lack() -> None:
    bold = moved(rows_of(1000, 2, believed=0.95), 50.0, 300)
    scores = scored((about_of(True), bold), (about_of(True, condition="aged"), moved(bold, 0.0, 0)))
    assert scores.sets[0].measures["calibration"].value == pytest.approx(0.25, abs=1e-9)
    honest = moved(rows_of(1000, 2, believed=0.75), 50.0, 250)
    assert scored((about_of(True), honest)).sets[0].measures["calibration"].value == pytest.approx(0.0, abs=1e-9)


def test_the_share_of_sure_scans_is_one_of_the_right_ones() -> None:
    rows = moved(rows_of(100, 3), 50.0, 50)
    rows.aligned_probability[50:75, 0] = 0.98
    sure = scored((about_of(True, condition="8 points/m2"), rows)).sets[0].measures["sure"]
    assert (sure.value, sure.count) == (0.5, 50)
    assert sure.verdict == "below"


def test_every_fix_off_the_map_counts_and_none_of_them_is_one_on_the_map() -> None:
    off = rows_of(60, 4, 0)
    off.has_fix[:7] = True
    off.probability[:9] = 0.995
    off.probability[9:] = np.nan
    on = rows_of(200, 5, 0, fix=True)
    scores = scored((about_of(False), off), (about_of(True), on))
    assert [measure(scores, key).value for key in ("away", "away_sure", "wrong")] == [7.0, 9.0, 0.0]
    assert measure(scores, "away").verdict == "below"
    (pair,) = scores.maps
    assert (pair.map_name, pair.scans, pair.fixes, pair.sure, pair.most_believed) == ("woods", 60, 7, 9, 0.995)
    assert len(scores.sets) == 1


def test_zero_is_no_goal_before_enough_is_counted() -> None:
    few = scored((about_of(False), rows_of(500, 6, 0)), (about_of(True), rows_of(500, 7, 0, fix=True)))
    assert measure(few, "away").verdict == "few"
    assert measure(few, "wrong").verdict == "few"
    enough = dataclasses.replace(measure(few, "away"), count=20_000)
    assert enough.verdict == "floor"
    assert dataclasses.replace(enough, count=100_000).verdict == "goal"
    assert dataclasses.replace(enough, count=100_000, value=1.0).verdict == "below"


def test_many_fixes_of_few_places_are_not_enough() -> None:
    one_place = rows_of(30_000, 8, 0, fix=True)
    for column in (one_place.truth, one_place.pose):
        column[:, :2] = 3.0
    wrong = measure(scored((about_of(True), one_place)), "wrong")
    assert wrong.count == 30_000 and wrong.value == 0.0
    assert TOWNS < LEAST_PLACES
    assert wrong.verdict == "few"


def test_where_nothing_was_counted_the_bound_is_three_over_the_places() -> None:
    places = 40
    drive = rows_of(4 * places, 9, 0)
    drive.area[:] = 0
    drive.truth[:, 0], drive.truth[:, 1] = np.repeat(np.arange(places) * 30.0, 4), 0.0
    one = measure(scored((about_of(False), drive)), "away_share")
    assert (one.value, one.high) == (0.0, pytest.approx(3.0 / places))
    two = scored((about_of(False), drive), (about_of(False, map_name="fields"), drive))
    assert measure(two, "away_share").high == pytest.approx(3.0 / (2 * places))


def test_surveys_learned_from_are_shown_and_in_no_total_on_the_map() -> None:
    wrong = moved(rows_of(100, 10, 0, fix=True), 50.0, 100)
    off = dataclasses.replace(rows_of(30, 11, 0), has_fix=np.full(30, True))
    towns = about_of(True)
    learned = dataclasses.replace(towns, set_name="pines", map_name="pines", map_is_learned=True, set_is_learned=True)
    scores = scored((towns, rows_of(100, 12, 0, fix=True)), (learned, wrong), (about_of(False, True), off))
    assert measure(scores, "wrong").value == 0.0
    assert measure(scores, "away").value == 30.0
    assert math.isnan(measure(scores, "away_unlearned").value)
    assert [each.is_learned for each in scores.sets] == [False, True]
    assert scores.sets[1].measures["wrong"].value == 1.0
    assert all(each.goal is None for each in scores.sets[1].measures.values())


def test_the_files_hold_the_figures(tmp_path: Path) -> None:
    singles = rows_of(300, 13)
    away = about_of(False, True)
    scores = scored(
        (about_of(True), singles), (about_of(True), rows_of(300, 14, 0, fix=True)), (away, rows_of(9, 15, 0))
    )
    assert "| map | drives of |" in as_markdown(scores)
    assert "woods (learned from)" in as_markdown(scores)
    content = json.loads(as_json(scores))
    assert [each["set"] for each in content["sets"]] == ["simulated"]
    assert content["pairs"][0]["scans"] == 9
    lines = as_csv(scores).splitlines()
    assert len(lines) == len(set(lines)) and sum(",away," in line for line in lines) == 1
    write_report(tmp_path, scores, 609)
    page = (tmp_path / "index.html").read_text()
    assert "{{" not in page
    assert all(f"{each.count:,} {each.counted}" in page for each in scores.measures)
    assert "http" not in page.replace("http://www.w3.org", "")


def test_nothing_but_failures_can_be_scored(tmp_path: Path) -> None:
    rows = rows_of(20, 16)
    for name in ("pose", "aligned", "aligned_probability", "probability"):
        getattr(rows, name)[:] = np.nan
    write_report(tmp_path, scored((about_of(True), rows)), 20)
    assert "0 %" in (tmp_path / "index.html").read_text()
