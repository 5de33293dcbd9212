"""A recording through a real localizer and map, scored against its GNSS."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.errors import BagError
from crossloc3d_ros.evaluation.drives import evaluation as drive_evaluation
from crossloc3d_ros.evaluation.drives.estimates import read_estimates
from crossloc3d_ros.evaluation.drives.page import About, write_report
from crossloc3d_ros.formats import bag, messages
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.replay import recorded as replay


@pytest.fixture(scope="module")
def folder(town_drive, localizer: Localizer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of the whole drive."""
    folder = tmp_path_factory.mktemp("replay")
    with bag.open_bag(town_drive.bag) as reader:
        replay.localize_bag(reader, "/velodyne_points", localizer, folder / drive_evaluation.ESTIMATES)
    return folder


@pytest.fixture(scope="module")
def evaluation(folder: Path, town_drive, town_map: AerialMap) -> drive_evaluation.Evaluation:
    with bag.open_bag(town_drive.bag) as reader:
        evaluation = drive_evaluation.evaluate(reader, folder, town_map)
    drive_evaluation.write_summary(folder, evaluation, {"bag": "drive"})
    return evaluation


def test_every_scan_gets_a_row_and_the_truth_is_where_it_was(
    town_drive, evaluation: drive_evaluation.Evaluation
) -> None:
    table = evaluation.table
    assert table.stamp_ns.tolist() == town_drive.stamps_ns.tolist()
    assert evaluation.truth is not None
    assert (len(evaluation.truth), evaluation.truth.dropped) == (len(table) - 2, 2)
    known = np.isfinite(table.truth_grid[:, 0])
    assert not known[-1]  # after the last fix nothing is known
    assert known[:-1].all()
    np.testing.assert_allclose(table.truth_grid[known], town_drive.truth[known, :2], atol=0.02)


def test_a_localizer_that_sees_well_scores_well(evaluation: drive_evaluation.Evaluation) -> None:
    scores = evaluation.scores
    assert scores is not None
    assert scores.scored == len(evaluation.table) - 1
    assert scores.recall(1, 25.0).share.value > 0.6
    assert scores.recall(1, 25.0).share.value > 4 * scores.recall(1, 25.0).chance
    assert scores.fix_error.count > 0
    assert scores.fix_error.median_m < 25.0
    assert scores.reachable == 1.0


def test_straight_through_is_what_the_localizer_returns(town_drive, localizer: Localizer, folder: Path) -> None:
    from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2

    table = read_estimates(folder / drive_evaluation.ESTIMATES)
    with bag.open_bag(town_drive.bag) as reader:
        message = next(m for i, (_, _, m) in enumerate(reader.messages(["/velodyne_points"])) if i == 3)
    estimate = localizer.localize(scan_from_pointcloud2(message))
    assert table.candidate_ids[3].tolist() == estimate.candidates.submap_ids.tolist()
    np.testing.assert_allclose(table.grid[3], estimate.grid, atol=1e-3)


def test_every_nth_scan(town_drive, localizer: Localizer, tmp_path: Path) -> None:
    calls = []
    with bag.open_bag(town_drive.bag) as reader:
        done = replay.localize_bag(
            reader, "/velodyne_points", localizer, tmp_path / "e.csv", every=7, progress=lambda *a: calls.append(a)
        )
    stamps = read_estimates(tmp_path / "e.csv").stamp_ns
    assert stamps.tolist() == town_drive.stamps_ns[::7].tolist()
    assert done == len(stamps)
    assert [(a, b) for a, b, _ in calls] == [(i + 1, done) for i in range(done)]


def test_a_bag_without_gnss_is_localized_and_not_scored(
    town_drive, localizer: Localizer, town_map: AerialMap, tmp_path: Path
) -> None:
    with bag.open_bag(town_drive.bag) as reader, bag.BagWriter(tmp_path / "blind") as writer:
        for _, t_ns, message in list(reader.messages(["/velodyne_points"]))[:3]:
            writer.write("/velodyne_points", bag.POINT_CLOUD, t_ns, message)
    with bag.open_bag(tmp_path / "blind") as reader:
        replay.localize_bag(reader, "/velodyne_points", localizer, tmp_path / drive_evaluation.ESTIMATES)
        evaluation = drive_evaluation.evaluate(reader, tmp_path, town_map)
    assert evaluation.scores is None
    assert evaluation.truth is None
    drive_evaluation.write_summary(tmp_path, evaluation, {})
    assert json.loads((tmp_path / drive_evaluation.SUMMARY).read_text())["scores"] is None
    write_report(tmp_path / "page.html", evaluation, town_map, About("Blind", {}))
    assert "could be checked" in (tmp_path / "page.html").read_text()


def clouds_that_are_none() -> Iterator[tuple[str, object]]:
    points = np.zeros((12, 3), np.float32)
    yield "empty", messages.velodyne_cloud(1, "velodyne", np.empty((0, 3)), 1.0, 0, 0.0)
    yield "twelve points", messages.velodyne_cloud(2, "velodyne", points, 1.0, 0, 0.0)
    yield "all NaN", messages.velodyne_cloud(3, "velodyne", np.full((5000, 3), np.nan), 1.0, 0, 0.0)
    yield "far away", messages.velodyne_cloud(4, "velodyne", np.full((5000, 3), 1e30), 1.0, 0, 0.0)
    wrong = np.zeros(12, dtype=[("x", "<u4"), ("y", "<u4"), ("z", "<u4")])
    yield "wrong type", messages.structured_cloud(5, "velodyne", wrong)
    flat = np.zeros(12, dtype=[("x", "<f4"), ("y", "<f4")])
    yield "no z", messages.structured_cloud(6, "velodyne", flat)
    short = messages.velodyne_cloud(7, "velodyne", points, 1.0, 0, 0.0)
    short.data = short.data[:100]
    yield "too short", short


def test_hopeless_clouds_become_rows_without_a_fix_that_say_why(
    localizer: Localizer, town_map: AerialMap, tmp_path: Path
) -> None:
    clouds = list(clouds_that_are_none())
    with bag.BagWriter(tmp_path / "drive") as writer:
        for i, (_, cloud) in enumerate(clouds):
            writer.write("/points", bag.POINT_CLOUD, 1_700_000_000_000_000_000 + i, cloud)
    with bag.open_bag(tmp_path / "drive") as reader:
        replay.localize_bag(reader, "/points", localizer, tmp_path / drive_evaluation.ESTIMATES)
        evaluation = drive_evaluation.evaluate(reader, tmp_path, town_map)
    table = evaluation.table
    assert len(table) == len(clouds)
    assert not table.has_fix.any()
    assert all(table.reasons)
    assert "uint32" in table.reasons[4]
    write_report(tmp_path / "page.html", evaluation, town_map, About("Hopeless", {}))


def test_scans_without_a_stamp_take_the_time_of_recording(localizer: Localizer, tmp_path: Path) -> None:
    with bag.BagWriter(tmp_path / "drive") as writer:
        cloud = messages.velodyne_cloud(0, "velodyne", np.zeros((12, 3)), 1.0, 0, 0.0)
        writer.write("/points", bag.POINT_CLOUD, 1_234_567_890_123_456_789, cloud)
    with bag.open_bag(tmp_path / "drive") as reader:
        replay.localize_bag(reader, "/points", localizer, tmp_path / "e.csv")
    assert read_estimates(tmp_path / "e.csv").stamp_ns.tolist() == [1_234_567_890_123_456_789]


def test_a_topic_that_is_missing_or_empty_is_reported(town_drive, localizer: Localizer, tmp_path: Path) -> None:
    with bag.open_bag(town_drive.bag) as reader, pytest.raises(BagError, match="its topics are: /gnss"):
        replay.localize_bag(reader, "/points", localizer, tmp_path / "e.csv")
    with bag.BagWriter(tmp_path / "drive") as writer:
        writer.add_topic("/points", bag.POINT_CLOUD)
        writer.write("/gnss", bag.NAV_SAT_FIX, 1, messages.nav_sat_fix(1, "gnss", 52.0, 4.0, 0.0))
    with bag.open_bag(tmp_path / "drive") as reader, pytest.raises(BagError, match="holds no message"):
        replay.localize_bag(reader, "/points", localizer, tmp_path / "e.csv")


def test_an_imu_levels_the_scans(town_drive, localizer: Localizer, tmp_path: Path) -> None:
    """A robot that leans by 8 degrees and measures it finds what it finds upright."""
    lean = np.radians(8.0)
    turn = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
    mount = np.array([0.0, 0.0, 1.2])
    with bag.open_bag(town_drive.bag) as reader, bag.BagWriter(tmp_path / "leaning") as writer:
        for _, t_ns, cloud in list(reader.messages(["/velodyne_points"]))[:6]:
            table = np.frombuffer(bytes(cloud.data), dtype=messages.VELODYNE_POINT)
            xyz = (np.column_stack([table["x"], table["y"], table["z"]]) + mount) @ turn - mount
            force = turn.T @ [0.0, 0.0, 9.81]
            writer.write("/imu", bag.IMU, t_ns - 1, messages.imu(t_ns - 1, "imu", [0, 0, 0], force))
            writer.write(
                "/velodyne_points", bag.POINT_CLOUD, t_ns, messages.velodyne_cloud(t_ns, "velodyne", xyz, 1.0, 0, 0.0)
            )
    found = {}
    for imu_topic in (None, "/imu"):
        with bag.open_bag(tmp_path / "leaning") as reader:
            replay.localize_bag(reader, "/velodyne_points", localizer, tmp_path / "e.csv", imu_topic=imu_topic)
        table = read_estimates(tmp_path / "e.csv")
        found[imu_topic] = np.hypot(*(table.candidate_grid[:, 0] - town_drive.truth[: len(table), :2]).T)
    assert np.median(found["/imu"]) < 20.0
    assert np.median(found["/imu"]) < np.median(found[None])


def test_the_summary_holds_what_the_table_holds(folder: Path, evaluation: drive_evaluation.Evaluation) -> None:
    summary = json.loads((folder / drive_evaluation.SUMMARY).read_text())
    assert evaluation.scores is not None
    assert summary["scans"] == len(evaluation.table)
    assert summary["scores"]["scored"] == evaluation.scores.scored
    recalls = {(r["rank"], r["radius_m"]): r["share"]["value"] for r in summary["scores"]["recalls"]}
    assert recalls[(1, 25.0)] == evaluation.scores.recall(1, 25.0).share.value
    assert set(recalls) == {(n, r) for n in (1, 5, 25) for r in (100.0, 50.0, 25.0)}
