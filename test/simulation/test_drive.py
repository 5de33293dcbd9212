"""Recorded drives, read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import laspy
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crossloc3d_ros.cli.simulate import main
from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.simulation.drive import DriveConfig, drive
from crossloc3d_ros.simulation.route import Route, RouteError, plan_route
from crossloc3d_ros.simulation.town import Town, make_town

START_NS = 1_700_000_000_000_000_000
TOPICS = {
    "/velodyne_points": "sensor_msgs/msg/PointCloud2", "/gnss": "sensor_msgs/msg/NavSatFix",
    "/odom": "nav_msgs/msg/Odometry", "/imu": "sensor_msgs/msg/Imu", "/ground_truth/fix": "sensor_msgs/msg/NavSatFix",
    "/ground_truth/odom": "nav_msgs/msg/Odometry",
}  # fmt: skip


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(6, "campus", 250.0)


@pytest.fixture(scope="module")
def route(town: Town) -> Route:
    return plan_route(town, 30.0, np.random.default_rng(0))


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, town: Town, route: Route) -> Path:
    path = tmp_path_factory.mktemp("drive") / "bag"
    report = drive(town, route, path, DriveConfig(scan_every=10, gnss_outage_s=4.0), seed=1)
    assert report.scans == len(read(path, "/velodyne_points"))
    return path


def read(path: Path, topic: str) -> list[Any]:
    with open_bag(path) as reader:
        return [record.message for record in reader.messages([topic])]


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def positions(messages: list[Any]) -> np.ndarray:
    return np.array([[m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z] for m in messages])


def rotations(messages: list[Any]) -> Rotation:
    return Rotation.from_quat([[getattr(m.pose.pose.orientation, axis) for axis in "xyzw"] for m in messages])


def test_every_topic_is_there_in_the_order_of_time(bag: Path, route: Route) -> None:
    with open_bag(bag) as reader:
        assert {name: topic.msgtype for name, topic in reader.topics().items()} == TOPICS
        counts = {name: topic.count for name, topic in reader.topics().items()}
        times = np.array([record.t_ns for record in reader.raw_messages()])
    assert (np.diff(times) >= 0).all()
    assert times[0] == START_NS
    assert counts["/imu"] == pytest.approx(100 * route.duration_s, abs=2)
    assert counts["/odom"] == pytest.approx(50 * route.duration_s, abs=2)
    assert counts["/gnss"] == pytest.approx(2 * route.duration_s, abs=2)
    assert counts["/velodyne_points"] == counts["/ground_truth/fix"] == counts["/ground_truth/odom"]


def test_clouds_are_laid_out_as_velodynes_driver_does(bag: Path) -> None:
    clouds = read(bag, "/velodyne_points")
    first = clouds[0]
    assert first.point_step == 22
    assert first.header.frame_id == "velodyne"
    assert [(f.name, f.offset, f.datatype) for f in first.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7),
    ]  # fmt: skip
    assert len(first.data) == 22 * first.width
    assert stamp_ns(first) == START_NS + 100_000_000
    assert stamp_ns(clouds[1]) - stamp_ns(first) == 1_000_000_000  # every tenth turn
    assert len(scan_from_pointcloud2(first).points) > 5_000


def test_the_true_fix_and_the_true_pose_agree(bag: Path, town: Town, route: Route) -> None:
    fixes, odometry = read(bag, "/ground_truth/fix"), read(bag, "/ground_truth/odom")
    assert [stamp_ns(m) for m in fixes] == [stamp_ns(m) for m in odometry]
    frame = MapFrame(town.crs, town.origin_grid, 0.0)
    grid = frame.from_geographic(
        np.array([m.latitude for m in fixes]), np.array([m.longitude for m in fixes]),
        np.array([m.altitude for m in fixes]),
    )  # fmt: skip
    np.testing.assert_allclose(frame.to_enu(grid), positions(odometry), atol=0.002)
    times = np.array([stamp_ns(m) - START_NS for m in fixes]) / 1e9
    np.testing.assert_allclose(grid - town.origin_grid, route.at(times)[:, :3, 3], atol=0.002)


def test_the_true_heading_points_where_the_robot_goes(bag: Path) -> None:
    odometry = read(bag, "/ground_truth/odom")
    forward = rotations(odometry).apply([1.0, 0.0, 0.0])[:, :2]
    speed = np.array([m.twist.twist.linear.x for m in odometry])
    turn = np.abs([m.twist.twist.angular.z for m in odometry])
    velocity = np.gradient(positions(odometry)[:, :2], axis=0)
    straight = (speed > 1.5) & (turn < 0.05)
    straight[[0, -1]] = False
    assert straight.sum() >= 3
    along = (forward * velocity).sum(axis=1) / np.linalg.norm(velocity, axis=1).clip(1e-6)
    assert np.degrees(np.arccos(along[straight].clip(-1, 1))).max() < 5.0


def test_gnss_wanders_within_its_covariance_and_has_an_outage(bag: Path, town: Town, route: Route) -> None:
    fixes = read(bag, "/gnss")
    lost = np.array([m.status.status < 0 for m in fixes])
    assert 2 <= lost.sum() <= 10
    assert all(
        np.isnan(m.latitude) and m.position_covariance_type == 0 for m, gone in zip(fixes, lost, strict=True) if gone
    )
    good = [m for m, gone in zip(fixes, lost, strict=True) if not gone]
    frame = MapFrame(town.crs, town.origin_grid, 0.0)
    grid = frame.from_geographic(np.array([m.latitude for m in good]), np.array([m.longitude for m in good]))
    times = np.array([stamp_ns(m) - START_NS for m in good]) / 1e9
    error = (grid - town.to_grid(route.at(times)[:, :3, 3]))[:, :2]
    sigma = np.sqrt(good[0].position_covariance[0])
    assert sigma == pytest.approx(0.8)
    assert 0.1 * sigma < np.sqrt((error**2).mean()) < 3 * sigma
    assert np.abs(error).max() < 5 * sigma


def test_odometry_starts_at_zero_and_drifts_slowly(bag: Path, route: Route) -> None:
    wheels = read(bag, "/odom")
    path = positions(wheels)
    assert np.abs(path[0]).max() == 0.0
    length = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum()
    assert length == pytest.approx(route.length_m, rel=0.06)
    true_end = np.linalg.inv(route.poses[0]) @ route.poses[-1][:, 3]
    error = np.linalg.norm(path[-1, :2] - true_end[:2])
    assert 0.0 < error < 0.2 * route.length_m


def test_the_imu_feels_gravity_and_the_attitude_is_the_truths(bag: Path) -> None:
    inertial, truth = read(bag, "/imu"), read(bag, "/ground_truth/odom")
    force = np.array([[getattr(m.linear_acceleration, axis) for axis in "xyz"] for m in inertial])
    assert np.linalg.norm(force, axis=1).mean() == pytest.approx(9.81, abs=0.15)
    stamps = {stamp_ns(m): m for m in inertial}
    common = [(stamps[stamp_ns(m)], m) for m in truth if stamp_ns(m) in stamps]
    assert len(common) >= 3
    for measured, true in common:
        attitude = Rotation.from_quat([getattr(measured.orientation, axis) for axis in "xyzw"])
        assert np.degrees((rotations([true]).inv() * attitude).magnitude()[0]) < 2.0


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_same_seed_records_the_same_drive(town: Town, tmp_path: Path, storage: Literal["mcap", "sqlite3"]) -> None:
    short = plan_route(town, 4.0, np.random.default_rng(0))
    for name in ("a", "b"):
        drive(town, short, tmp_path / name, DriveConfig(scan_every=20), seed=5, storage=storage)
    with open_bag(tmp_path / "a") as a, open_bag(tmp_path / "b") as b:
        first, second = list(a.raw_messages()), list(b.raw_messages())
    assert [(r.topic, r.t_ns, bytes(r.cdr)) for r in first] == [(r.topic, r.t_ns, bytes(r.cdr)) for r in second]


def test_an_interrupted_drive_leaves_no_bag(town: Town, route: Route, tmp_path: Path) -> None:
    def stop(stage: str, done: float, total: float, unit: str) -> None:
        if done >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        drive(town, route, tmp_path / "bag", DriveConfig(scan_every=10), progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_overwritten(town: Town, route: Route, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="exists"):
        drive(town, route, tmp_path / "bag")


def test_a_route_shorter_than_a_turn_is_refused(town: Town, route: Route, tmp_path: Path) -> None:
    with pytest.raises(RouteError, match="less than one turn"):
        drive(town, Route(route.time_s[:3], route.poses[:3]), tmp_path / "bag")


def test_the_command_makes_a_town(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["town", "--seed", "2", "--family", "industry", "--size-m", "150", "--output", str(tmp_path / "t"),
                 "--length-m", "10", "--spacing-m", "1.5", "--scan-every", "20"]  # fmt: skip
    assert main(arguments) == 0
    assert "scans" in capsys.readouterr().out
    tiles = sorted((tmp_path / "t" / "survey").glob("*.laz"))
    assert sum(laspy.open(tile).header.point_count for tile in tiles) > 5_000
    assert len(read(tmp_path / "t" / "bag", "/velodyne_points")) >= 2
    assert main(arguments) == 2
    assert "exists already" in capsys.readouterr().err


def test_the_command_drives_through_a_survey(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    town_folder = tmp_path / "t"
    assert main(["town", "--seed", "8", "--family", "suburb", "--size-m", "200", "--output", str(town_folder),
                 "--length-m", "5", "--scan-every", "50", "--spacing-m", "0.7"]) == 0  # fmt: skip
    assert main(["drive", "--survey", str(town_folder / "survey"), "--bag", str(tmp_path / "bag"), "--length-m", "8",
                 "--scan-every", "10", "--clearance-m", "1.2"]) == 0  # fmt: skip
    assert len(read(tmp_path / "bag", "/ground_truth/fix")) >= 3
    capsys.readouterr()


@pytest.mark.parametrize(("arguments", "what"), [
    (["drive", "--survey", "nowhere.laz", "--bag", "b"], "nowhere.laz"),
    (["town", "--output", "t", "--length-m", "-3"], "--length-m must lie between"),
    (["town", "--output", "t", "--size-m", "5"], "size_m"),
    (["town", "--output", "t", "--spacing-m", "0"], "spacing_m"),
])  # fmt: skip
def test_the_command_says_what_is_wrong(
    arguments: list[str], what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert what in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
