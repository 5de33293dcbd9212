"""Scores of poses: what is counted, and what is not."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.evaluation.poses import results as pose_results
from crossloc3d_ros.evaluation.poses.errors import STAGES, localized_before
from crossloc3d_ros.evaluation.poses.predictions import (
    ALIGNED,
    CANDIDATES,
    SINGLE,
    PoseAbout,
    PosePredictions,
    join,
)
from crossloc3d_ros.evaluation.poses.scores import (
    SIGMAS,
    calibration_of,
    expected_inside,
    score_poses,
)
from crossloc3d_ros.evaluation.poses.store import load_predictions, save_predictions
from crossloc3d_ros.types import WHOLE_MAP

TOWNS = 10
ABOUT = PoseAbout(
    "simulated", "pose-simulated-0", "test", "f" * 16, tuple(f"town {i}" for i in range(TOWNS + 1)),
    ("old_town", "village") * 5 + ("suburb",), (True,) * TOWNS + (False,), ("drawn by lot",), 5.76, 1000,
)  # fmt: skip
ALONE = -2


def answers(count: int, seed: int = 0, *, journey: int = SINGLE, area: int | None = None) -> PosePredictions:
    """Return answers that are right by a few centimetres, with covariances that say so."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack([rng.uniform(0, 600, (count, 2)), np.zeros(count), rng.uniform(-3, 3, count)])
    sigma = np.array([0.1, 0.1, 0.002])
    error = rng.normal(0, 1, (count, 3)) * sigma
    pose = truth.copy()
    pose[:, [0, 1, 3]] += error
    aligned = np.full((count, ALIGNED, 3), np.nan)
    aligned[:, 0] = pose[:, [0, 1, 3]]
    candidates = np.full((count, CANDIDATES, 2), np.nan)
    candidates[:, 0] = truth[:, :2] + 5.0
    unlikely = np.full((count, ALIGNED), np.nan)
    likely = unlikely.copy()
    likely[:, 0] = 0.9999
    return PosePredictions(
        journey=np.full(count, journey), leg=np.zeros(count, np.int64),
        area=np.arange(count) % TOWNS if area is None else np.full(count, area), group=np.zeros(count, np.int64),
        stamp_ns=np.arange(count) * 500_000_000, travelled_m=np.arange(count) * 1.0, truth=truth,
        has_fix=np.full(count, journey >= 0), state=np.zeros(count, np.int64), probability=np.full(count, 0.9999),
        pose=pose, covariance=np.tile(np.diag(sigma**2), (count, 1, 1)), candidates=candidates, aligned=aligned,
        aligned_source=np.zeros((count, ALIGNED), np.int64), aligned_probability=likely,
        aligned_log_likelihood=unlikely, aligned_covariance=np.tile(np.diag(sigma**2), (count, 1, 1)),
        milliseconds=np.full((count, 5), 10.0),
    )  # fmt: skip


def drives(count: int, steps: int = 100) -> list[PosePredictions]:
    return [answers(steps, 10 + i, journey=i, area=i % TOWNS) for i in range(count)]


def away(fixes: int = 0) -> PosePredictions:
    rows = answers(60, 5, journey=99, area=TOWNS)
    has_fix = np.arange(60) < fixes
    pose = rows.pose + np.array([1e5, 0.0, 0.0, 0.0])
    return dataclasses.replace(rows, has_fix=has_fix, pose=pose, probability=np.zeros(60))


def test_perfect_answers_reach_every_goal() -> None:
    scores = score_poses(join([answers(100), *drives(TOWNS), away()]), ABOUT)
    assert {m.key: m.verdict for m in scores.measures if m.verdict not in ("goal", "")} == {}
    assert scores.measure("end_to_end").value == 1.0
    assert scores.measure("until_median").value == 0.0
    assert scores.measure("away_fixes").value == 0
    assert scores.measure("carried_median").count == 0


def test_a_pose_must_be_right_in_place_and_in_heading() -> None:
    rows = answers(40)
    rows.aligned[:10, 0, 0] += 3.0
    rows.aligned[10:20, 0, 2] += math.radians(8.0)
    assert score_poses(rows, ABOUT).measure("end_to_end").value == pytest.approx(0.5)


def test_headings_are_compared_around_the_circle() -> None:
    rows = answers(20)
    rows.aligned[:, 0, 2] += 2 * math.pi
    assert score_poses(rows, ABOUT).measure("end_to_end").value == 1.0


def test_a_scan_without_an_answer_is_wrong_and_not_left_out() -> None:
    rows = answers(20)
    rows.aligned[:5] = np.nan
    scores = score_poses(rows, ABOUT)
    assert scores.measure("end_to_end").value == pytest.approx(0.75)
    assert scores.measure("end_to_end").count == 20


def test_only_scans_whose_place_was_retrieved_count_among_the_candidates() -> None:
    rows = answers(40)
    rows.candidates[:20, 0] += 400.0
    rows.aligned[:20] = np.nan
    scores = score_poses(rows, ABOUT)
    assert scores.measure("among").value == 1.0
    assert scores.measure("among").count == 20
    assert scores.measure("place_found").value == pytest.approx(0.5)
    assert scores.measure("end_to_end").value == pytest.approx(0.5)


def test_a_drive_that_is_never_localized_counts_as_infinite() -> None:
    some = drives(TOWNS)
    lost = [dataclasses.replace(rows, has_fix=np.zeros(len(rows), np.bool_)) for rows in some[:6]]
    scores = score_poses(join([*lost, *some[6:]]), ABOUT)
    assert math.isinf(scores.measure("until_median").value)
    assert scores.measure("until_median").verdict == "below"
    assert scores.measure("until_median").count == TOWNS


def test_a_wrong_fix_localizes_nobody_and_is_counted() -> None:
    rows = drives(1)[0]
    rows.pose[:30, 0] += 50.0
    scores = score_poses(rows, ABOUT)
    assert scores.measure("until_median").value == 30.0
    assert scores.measure("wrong").value == pytest.approx(0.3)
    assert scores.measure("after_95").value < 1.0


def test_a_wrong_fix_after_a_right_one_is_an_error_afterwards() -> None:
    rows = drives(1)[0]
    rows.pose[50:, 0] += 50.0
    scores = score_poses(rows, ABOUT)
    assert scores.measure("until_median").value == 0.0
    assert scores.measure("after_95").value > 40.0
    assert scores.measure("inside_2_sigma").value < 0.6


def test_each_leg_must_be_localized_anew() -> None:
    rows = drives(1)[0]
    leg = (np.arange(100) >= 60).astype(np.int64)
    has_fix = (np.arange(100) < 60) | (np.arange(100) >= 80)
    rows = dataclasses.replace(rows, leg=leg, has_fix=has_fix, travelled_m=np.where(leg > 0, np.arange(100) - 60.0, 0))
    assert localized_before(rows).tolist() == [True] * 60 + [False] * 20 + [True] * 20
    scores = score_poses(rows, ABOUT)
    assert scores.measure("carried_median").value == 20.0
    assert scores.measure("carried_median").count == 1


@pytest.mark.parametrize("fixes", [0, 1, 7])
def test_every_fix_off_the_map_counts_and_is_wrong(fixes: int) -> None:
    scores = score_poses(join([*drives(2), away(fixes)]), ABOUT)
    assert scores.measure("away_fixes").value == fixes
    assert scores.measure("away_fixes").verdict == ("below" if fixes else "goal")
    assert scores.measure("wrong").value == pytest.approx(fixes / (200 + fixes))


def test_nothing_wrong_in_a_few_fixes_is_no_proof() -> None:
    few, many = (score_poses(join(drives(n)), ABOUT).measure("wrong") for n in (1, 10))
    assert few.value == many.value == 0.0
    assert few.high > many.high > 0.0


def test_honest_covariances_hold_what_they_promise_and_boasting_ones_do_not() -> None:
    honest = join(drives(TOWNS, 200))
    inside = score_poses(honest, ABOUT)
    assert inside.measure("inside_2_sigma").verdict == "goal"
    assert np.abs(inside.inside["position"] - expected_inside("position")).max() < 0.05
    assert np.abs(inside.inside["heading"] - expected_inside("heading")).max() < 0.05
    boasting = dataclasses.replace(honest, covariance=honest.covariance / 9.0)
    assert score_poses(boasting, ABOUT).measure("inside_2_sigma").verdict == "below"
    timid = dataclasses.replace(honest, covariance=honest.covariance * 25.0)
    assert score_poses(timid, ABOUT).measure("inside_2_sigma").verdict == "below"


def test_each_stage_answers_for_itself() -> None:
    rows = answers(20)
    wrong = rows.aligned[:, 0] + np.array([100.0, 0.0, 0.0])
    # The foremost candidate's pose is wrong, the best pose comes from the third; a hypothesis' lies between.
    rows.aligned[:, 1] = rows.aligned[:, 0] + np.array([50.0, 0.0, 0.0])
    rows.aligned[:, 2] = wrong
    rows.aligned_source[:, :3] = [3, -1, 0]
    rows.candidates[:, 2] = rows.candidates[:, 0]
    rows.candidates[:, 0] = wrong[:, :2] + 3.0
    rows.candidates[:, 1] = wrong[:, :2] + 300.0
    retrieval, aligned, ranked = score_poses(rows, ABOUT).stages
    assert (retrieval.name, aligned.name, ranked.name) == tuple(STAGES)
    assert retrieval.within == 0.0
    assert retrieval.median_m == pytest.approx(103.0, abs=1.0)
    assert aligned.within == 0.0
    assert aligned.median_m == pytest.approx(100.0, abs=1.0)
    assert ranked.within == 1.0


def test_without_a_pose_near_a_candidate_the_next_candidate_s_counts() -> None:
    rows = answers(8)
    rows.candidates[:, 1] = rows.candidates[:, 0]
    rows.candidates[:, 0] += 500.0
    rows.aligned_source[:4, 0] = WHOLE_MAP
    assert score_poses(rows, ABOUT).stages[1].within == 1.0
    rows.aligned_source[4:, 0] = -1  # what a hypothesis has brought is not retrieval's
    assert score_poses(rows, ABOUT).stages[1].within == 0.5
    rows.candidates[:, 1] += 500.0
    assert score_poses(rows, ABOUT).stages[1].within == 0.0


def test_stages_along_drives_compare_the_same_scans() -> None:
    track = drives(1)[0]
    track.pose[:50] = np.nan
    alone = answers(100, 10, journey=ALONE, area=0)
    chosen = np.arange(0, 100, 5)
    alone = PosePredictions(**{f.name: getattr(alone, f.name)[chosen] for f in dataclasses.fields(alone)})
    alone.aligned[::2, 0] += 40.0
    stages = {stage.name: stage for stage in score_poses(join([track, alone]), ABOUT).drive_stages}
    assert stages["+ re-ranking"].scans == stages["+ fusion, from the first scan on"].scans == 20
    assert stages["+ re-ranking"].within == pytest.approx(0.5)
    assert stages["+ fusion, from the first scan on"].within == pytest.approx(0.5)
    # Scans that were asked again are no scans of the benchmark.
    assert score_poses(join([track, alone]), ABOUT).measure("end_to_end").count == 0


def test_families_that_training_has_not_seen_are_told_apart() -> None:
    rows = answers(40)
    rows.aligned[rows.area % 2 == 1] = np.nan
    scores = score_poses(rows, ABOUT)
    assert scores.measure("end_to_end/held-out families").value == 0.0
    assert scores.measure("end_to_end/families seen in training").value == 1.0


def test_a_calibration_finds_the_share_that_was_right() -> None:
    rng = np.random.default_rng(1)
    believed = rng.random(20_000)
    found = calibration_of("honest", believed, rng.random(20_000) < believed)
    assert np.abs(found.believed - found.right)[found.count > 500].max() < 0.03
    assert found.count.sum() == 20_000
    assert calibration_of("unknown", np.array([np.nan]), np.array([False])).believed.tolist() == [0.0]


def test_expected_shares_are_those_of_the_normal_distribution() -> None:
    two = int(np.argmin(np.abs(SIGMAS - 2.0)))
    assert expected_inside("heading")[two] == pytest.approx(0.9545, abs=1e-4)
    assert expected_inside("position")[two] == pytest.approx(0.8647, abs=1e-4)


def test_every_figure_is_in_every_table() -> None:
    scores = score_poses(join([answers(100), *drives(3), away()]), ABOUT)
    content = json.loads(pose_results.as_json(scores))
    assert [row["measure"] for row in content["table"]] == [m.key for m in scores.measures]
    assert pose_results.as_csv(scores).count("\n") == 1 + len(scores.measures) + len(scores.families)
    markdown = pose_results.as_markdown(scores)
    assert all(measure.text in markdown for measure in scores.measures)


def test_infinite_and_missing_figures_are_written_as_such() -> None:
    rows = dataclasses.replace(drives(1)[0], has_fix=np.zeros(100, np.bool_))
    scores = score_poses(rows, ABOUT)
    assert json.loads(pose_results.as_json(scores))["table"][3]["value"] == "infinite"
    assert "∞" in pose_results.as_markdown(scores)
    assert pose_results.shown(scores.measure("after_median")) == "–"


def test_predictions_come_back_as_they_were(tmp_path) -> None:
    rows = join([answers(5), away()])
    save_predictions(tmp_path / "predictions.npz", rows, ABOUT)
    read, about = load_predictions(tmp_path / "predictions.npz")
    assert about == ABOUT
    for item in dataclasses.fields(PosePredictions):
        np.testing.assert_array_equal(getattr(read, item.name), getattr(rows, item.name))


def test_damaged_and_missing_predictions_are_refused(tmp_path) -> None:
    path = tmp_path / "predictions.npz"
    with pytest.raises(EvaluationError, match="without --only-score"):
        load_predictions(path)
    save_predictions(path, answers(5), ABOUT)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(EvaluationError, match="damaged"):
        load_predictions(path)
    path.write_bytes(b"")
    with pytest.raises(EvaluationError, match="damaged"):
        load_predictions(path)
