"""The localizer as a real process over DDS: what goes in, what comes out, and what must not stop it."""

from __future__ import annotations

import itertools
import math
import shutil
import signal
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus, PointCloud2
from std_srvs.srv import Empty

from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.ros import conversions
from crossloc3d_ros.ros.conversions import header_message, in_map, matrix_from_transform

if TYPE_CHECKING:
    from conftest import NodeProcess, Robot, StartNode, World


TABLE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("latitude", "<f8"), ("longitude", "<f8"),
     ("descriptor_distance", "<f4"), ("probability", "<f4"), ("submap_id", "<i4"),
     ("aligned_x", "<f4"), ("aligned_y", "<f4"), ("aligned_yaw", "<f4"), ("aligned_probability", "<f4")]
)  # fmt: skip


@pytest.fixture(scope="module")
def localizer(start_stand_in: StartNode, world: World) -> Iterator[NodeProcess]:
    """One node for all tests that leave it as they find it: active, with its own settings, TF and all inputs."""
    own = {"tf_broadcast": True, "use_imu_heading": True, "stall_s": 2.0}
    node = start_stand_in({**world.parameters(), **own}, environment={"STANDIN_TF2": "1"})
    node.wait_for_output("listening on /points")
    yield node
    assert node.is_alive, f"a test has ended the node:\n{node.output}"
    assert node.stop() == 0
    assert "Traceback" not in node.output


@pytest.fixture
def active(localizer: NodeProcess, robot: Robot) -> Robot:
    robot.wait_for_localizer()
    robot.forget()
    return robot


def in_grid(frame: MapFrame, enu: np.ndarray, yaw: float) -> tuple[np.ndarray, float]:
    grid, heading = conversions.in_grid(frame, enu[None], np.array([yaw]))
    return grid[0], float(heading[0])


def frame_of(world: World) -> MapFrame:
    return MapFrame("EPSG:32631", np.array(world.grid(0)), 0.0)


def made_up(world: World, place: int) -> np.ndarray:
    """Grid position (1, 3) of what the stand-in makes up at a place."""
    return np.array([world.grid(place)]) + np.array([3.0, -2.0, 0.0])


def pose_in_map(world: World, place: int) -> tuple[np.ndarray, float]:
    """Position and yaw in the map of what the stand-in makes up at a place."""
    enu, yaw = in_map(frame_of(world), made_up(world, place), np.array([0.5]))
    return enu[0], float(yaw[0])


def test_a_cloud_becomes_a_fix_by_every_convention(active: Robot, world: World) -> None:
    message = active.message(world.points(7))
    fix = active.localize(message)
    assert fix.status.status == NavSatStatus.STATUS_FIX
    assert fix.header.stamp == message.header.stamp
    assert fix.header.frame_id == "base_link", "the frame whose position is given, not the map's"
    latitude, longitude, altitude = frame_of(world).to_geographic(made_up(world, 7))
    assert fix.latitude == pytest.approx(latitude[0], abs=1e-8)
    assert fix.longitude == pytest.approx(longitude[0], abs=1e-8)
    assert fix.altitude == pytest.approx(altitude[0], abs=0.01)
    assert fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_APPROXIMATED
    np.testing.assert_allclose(np.diag(np.array(fix.position_covariance).reshape(3, 3)), [0.04, 0.09, 0.25])


def test_the_pose_lies_in_the_map_frame_whose_origin_is_latched(active: Robot, world: World) -> None:
    active.wait_until(lambda: active.origins, what="for the map's origin")
    origin = active.origins[-1]
    assert origin.header.frame_id == "map"
    fix = active.localize(world.points(8))
    active.wait_until(lambda: active.poses and active.poses[-1].header.stamp == fix.header.stamp, what="for the pose")
    pose = active.poses[-1]
    assert pose.header.frame_id == "map"
    frame = frame_of(world)
    at_origin = frame.from_geographic(np.array([origin.latitude]), np.array([origin.longitude]))
    np.testing.assert_allclose(at_origin[0, :2], world.grid(0)[:2], atol=1e-3)
    T = pose_matrix(pose.pose.pose)
    position, yaw = pose_in_map(world, 8)
    np.testing.assert_allclose(T[:3, 3], position, atol=0.001)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(yaw, abs=1e-6)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    np.testing.assert_allclose(covariance, np.diag([0.04, 0.09, 0.25, 0.001, 0.002, 0.0001]))


def test_the_candidates_come_as_poses_as_a_table_and_as_markers(active: Robot, world: World) -> None:
    fix = active.localize(world.points(9))
    outputs = (active.candidates, active.tables, active.hypotheses)
    active.wait_until(lambda: all(o and o[-1].header.stamp == fix.header.stamp for o in outputs), what="for candidates")
    table = active.tables[-1]
    assert [(f.name, f.offset) for f in table.fields] == [(n, TABLE.fields[n][1]) for n in TABLE.names]
    rows = np.frombuffer(bytes(table.data), TABLE)
    assert len(rows) == table.width == 25
    assert (np.diff(rows["descriptor_distance"]) >= 0).all()
    assert rows["submap_id"][0] == 9
    assert rows["probability"].sum() == pytest.approx(1.0, abs=0.01)
    assert rows["latitude"][0] == pytest.approx(world.latitude_longitude(9)[0], abs=1e-9)
    # Two poses fit around the first candidate, of which the likelier is published, none around the last.
    position, yaw = pose_in_map(world, 9)
    np.testing.assert_allclose([rows["aligned_x"][0], rows["aligned_y"][0]], position[:2], atol=1e-3)
    assert rows["aligned_yaw"][0] == pytest.approx(yaw, abs=1e-5)
    assert rows["aligned_probability"][0] == rows["probability"][0]
    assert np.isfinite(rows["aligned_yaw"]).tolist() == [True] + [True] * 23 + [False]
    poses, hypotheses = active.candidates[-1], active.hypotheses[-1]
    assert poses.header.frame_id == table.header.frame_id == hypotheses.header.frame_id == "map"
    np.testing.assert_allclose([p.position.x for p in poses.poses], rows["x"], atol=1e-3)
    assert len(hypotheses.poses) == 2
    T = pose_matrix(hypotheses.poses[0])
    np.testing.assert_allclose(T[:3, 3], position, atol=1e-3)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(yaw, abs=1e-6)
    active.wait_until(lambda: active.markers, what="for markers")
    assert len(active.markers[-1].markers) == 1 + 25 + 2 + 2
    assert any("probability 100%" in m.text for m in active.markers[-1].markers)


def test_the_state_is_latched_and_says_why(active: Robot, world: World) -> None:
    level, message, values = active.report(active.message(world.points(10)))
    assert level == 0
    assert message.startswith("localized: probability 100%")
    assert values["fix"] == "yes"
    assert values["hypotheses"] == "0.9 0.06"
    assert values["deviation (m, m, deg)"] == "0.20 0.30 0.57"
    late: list[DiagnosticStatus] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = active.node.create_subscription(DiagnosticStatus, "/localizer/state", late.append, latched)
    active.wait_until(lambda: late, what="for the latched state")
    assert late[0].message == message
    level, message, values = active.report(active.message(np.full((20_000, 3), np.nan)))
    assert level == 1
    assert message.startswith("localized: 0 of 20,000 points left"), "such a scan changes nothing that is known"
    assert values["fix"] == "no"
    # Who joins in a silence shall not take an old state for the present.
    active.wait_until(lambda: late[-1].level == DiagnosticStatus.STALE, what="for the state to be stale")
    assert late[-1].message.startswith("localized when last seen: no cloud on /points for")
    active.node.destroy_subscription(subscription)


def stamp_ns_of(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def drive_between(robot: Robot, first: PointCloud2, second: PointCloud2, metres: float, **how: Any) -> None:
    """Publish odometry at 100 Hz from one scan to the next, and wait until the node has it."""
    begin_ns, end_ns = stamp_ns_of(first), stamp_ns_of(second)
    stamps = np.arange(begin_ns, end_ns + 1, 10_000_000)
    for stamp_ns in stamps:
        robot.drive(int(stamp_ns), 500.0 + metres * (int(stamp_ns) - begin_ns) / (end_ns - begin_ns), **how)
    robot.spin(0.1)


def test_odometry_reaches_the_localizer_as_the_way_from_scan_to_scan(active: Robot, world: World) -> None:
    active.call(Empty, "/reinitialize_global_localization", Empty.Request())
    first, second, third = (active.message(world.points(place)) for place in (11, 12, 13))
    drive_between(active, first, second, 0.7)
    assert active.report(first)[1].endswith("no motion")
    assert active.report(second)[1].endswith("moved 0.70 0.00 0.000")
    # The same stamp again, and one that comes late: no motion that odometry could measure.
    assert active.report(second)[1].endswith("moved 0.00 0.00 0.000")
    assert "unknown motion (time goes backwards" in active.report(first)[1]
    drive_between(active, second, third, 40.0)
    assert "unknown motion (the odometry jumps by" in active.report(third)[1]


def test_odometry_of_another_frame_is_refused_and_diagnosed(active: Robot, world: World) -> None:
    for _ in range(10):
        next(active.stamps_ns)  # a second: too long to go on from the odometry of earlier tests
    first, second = (active.message(world.points(place)) for place in (11, 12))
    drive_between(active, first, second, 0.7, child_frame_id="imu_link")
    active.localize(first)
    assert "unknown motion (the odometry has stopped" in active.report(second)[1]
    level, message, values = active.diagnosis("'imu_link'")
    assert level == 1
    assert "odometry on /odom is not used: it is the pose of 'imu_link', not of 'base_link'" in message
    assert values["odometry"] in message


def test_frames_with_the_leading_slash_of_ros_1_are_the_same_frames(active: Robot, world: World) -> None:
    for _ in range(10):
        next(active.stamps_ns)
    first, second = (active.message(world.points(place)) for place in (11, 12))
    drive_between(active, first, second, 0.7, child_frame_id="/base_link")
    active.localize(first)
    assert active.report(second)[1].endswith("moved 0.70 0.00 0.000")


def test_tf_holds_where_the_odometrys_frame_lies_but_only_while_localized(active: Robot, world: World) -> None:
    sent: list[TransformStamped] = []
    subscription = active.node.create_subscription(TransformStamped, "/tf_sent", sent.append, 100)
    active.wait_until(lambda: active.node.count_publishers("/tf_sent") > 0, what="for TF")
    active.spin(0.3)
    first, second = (active.message(world.points(place)) for place in (14, 15))
    drive_between(active, first, second, 0.9)
    # Between two samples of the odometry: its pose is interpolated.
    scan = active.message(world.points(15))
    scan.header.stamp = header_message(stamp_ns_of(first) + 55_000_000, "").stamp
    active.localize(scan)
    active.wait_until(lambda: sent, what="for the transform")
    transform = sent[-1]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    assert stamp_ns_of(transform) == stamp_ns_of(scan) + 200_000_000
    T_odom_base = np.eye(4)
    T_odom_base[0, 3] = 500.0 + 0.9 * 0.55
    T_map_base = matrix_from_transform(transform.transform) @ T_odom_base
    position, yaw = pose_in_map(world, 15)
    np.testing.assert_allclose(T_map_base[:3, 3], position, atol=1e-3)
    assert math.atan2(T_map_base[1, 0], T_map_base[0, 0]) == pytest.approx(yaw, abs=1e-6)
    count = len(sent)
    active.localize(spoil(second, "all NaN"))
    active.spin(0.3)
    assert len(sent) == count
    active.node.destroy_subscription(subscription)


def guess(frame_id: str, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> PoseWithCovarianceStamped:
    message = PoseWithCovarianceStamped(header=header_message(5_000_000_000, frame_id))
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = float(x), float(y), float(z)
    orientation.z, orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    message.pose.covariance = [float(v) for v in np.diag([4.0, 9.0, 1e6, 1e6, 1e6, 0.01]).flat]
    return message


def test_an_initial_pose_reaches_the_localizer_in_the_grid(active: Robot, world: World) -> None:
    active.guesses.publish(guess("map", 12.0, 15.0, yaw=1.0))
    _, _, values = active.diagnosis_with("initial pose", "taken")
    grid, heading = in_grid(frame_of(world), np.array([12.0, 15.0, 0.0]), 1.0)
    assert f"{grid[0]:.1f} E, {grid[1]:.1f} N" in values["initial pose"]
    _, message, _ = active.report(active.message(world.points(20)))
    assert f"prior at {grid[0]:.1f} {grid[1]:.1f} to {heading:.3f} give or take" in message
    # TF explains a frame that lies at (100, 50) and is rotated by a quarter.
    active.guesses.publish(guess("odom_far", -40.0, 90.0, yaw=0.5))
    grid, heading = in_grid(frame_of(world), np.array([10.0, 10.0, 0.0]), 0.5 + math.pi / 2)
    active.diagnosis_with("initial pose", f"{grid[0]:.1f} E, {grid[1]:.1f} N")
    _, message, _ = active.report(active.message(world.points(21)))
    assert f"prior at {grid[0]:.1f} {grid[1]:.1f} to {heading:.3f} give or take 2.999 2.001 0.100" in message, (
        "its north is west"
    )


def test_an_initial_pose_in_the_frame_of_the_odometry_is_where_the_last_fix_puts_it(
    active: Robot, world: World
) -> None:
    """The node publishes that transform, so it knows it without TF; frames of ROS 1 begin with a slash."""
    first, second = (active.message(world.points(place)) for place in (22, 23))
    drive_between(active, first, second, 0.9)
    active.localize(first)
    assert active.localize(second).status.status == NavSatStatus.STATUS_FIX
    # The odometry stands 500.9 m along x at the second scan.
    T_odom_guess, T_odom_base, T_map_base = np.eye(4), np.eye(4), np.eye(4)
    T_odom_guess[:2, 3], T_odom_base[0, 3] = (505.9, 2.0), 500.9
    position, yaw = pose_in_map(world, 23)
    T_map_base[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T_map_base[:3, 3] = position
    T_map_guess = T_map_base @ np.linalg.inv(T_odom_base) @ T_odom_guess
    for frame_id in ("odom", "/odom"):
        active.guesses.publish(guess(frame_id, 505.9, 2.0))
        grid, _ = in_grid(frame_of(world), T_map_guess[:3, 3], yaw)
        active.diagnosis_with("initial pose", f"taken: {grid[0]:.1f} E, {grid[1]:.1f} N")
    active.call(Empty, "/reinitialize_global_localization", Empty.Request())
    active.guesses.publish(guess("odom", 505.9, 2.0))
    active.diagnosis_with("initial pose", "refused: TF has no pose of 'odom' in 'map'")


def test_an_initial_pose_that_tf_explains_leaves_the_mounting_of_the_lidar_alone(active: Robot, world: World) -> None:
    """Where mounting_from_tf is false: TF has the frame of the clouds too, in another place than the settings."""
    for _ in range(10):
        next(active.stamps_ns)  # no odometry, by which the robot would have moved and seen something else
    before = best_candidate(active, world, 18)
    active.guesses.publish(guess("odom_far", -40.0, 90.0))
    active.diagnosis_with("initial pose", "taken")
    active.localize(world.points(19))  # or the same scan again would be that of a frozen lidar
    assert best_candidate(active, world, 18) == before


def best_candidate(active: Robot, world: World, place: int) -> tuple[float, float, str]:
    """Return position and descriptor distance of a scan's fix."""
    scan = active.message(world.points(place))
    scan.header.frame_id = "elsewhere"  # where TF has it, which is not where the settings have it
    fix = active.localize(scan)
    _, _, values = active.diagnosis_with("last best descriptor distance", "")
    return fix.latitude, fix.longitude, values["last best descriptor distance"]


def test_an_initial_pose_that_nothing_explains_is_refused_with_the_reason(active: Robot, world: World) -> None:
    for message, reason in (
        (guess("map", 5_000.0, 0.0), "outside of the map"),
        (guess("", 0.0, 0.0), "names no frame"),
        (guess("moon", 0.0, 0.0), "TF has no pose of 'moon' in 'map'"),
    ):
        active.guesses.publish(message)
        active.diagnosis_with("initial pose", reason)
    assert active.localize(world.points(24)).status.status == NavSatStatus.STATUS_FIX


def test_the_imu_gives_the_heading_until_something_better_does(active: Robot, world: World) -> None:
    active.call(Empty, "/reinitialize_global_localization", Empty.Request())
    active.localize(active.message(world.points(17)))

    def after(yaw: float) -> str:
        # Of another place than any, so that the stand-in is not sure.
        scan = active.message(world.points(999))
        sample = Imu(header=scan.header)
        sample.linear_acceleration.z = 9.81
        sample.orientation.z, sample.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        active.imu.publish(sample)
        active.spin(0.2)
        return active.report(scan)[1]

    _, heading = in_grid(frame_of(world), np.zeros(3), 0.8)
    assert "prior" not in after(0.8), "it is localized still"
    assert f"prior at nowhere to {heading:.3f} give or take inf inf {math.radians(15):.3f}" in after(0.8)


def spoil(message: PointCloud2, how: str) -> PointCloud2:
    """Make a good cloud bad."""
    xyz = slice(0, 12)
    raw = np.frombuffer(bytes(message.data), np.uint8).reshape(message.width, message.point_step).copy()
    if how == "a field of integers":
        message.fields[0].datatype = 5
    elif how == "no z":
        message.fields[2].name = "height"
    elif how == "cut short":
        raw = raw[:-100]
    elif how == "empty":
        message.width, message.row_step = 0, 0
        raw = raw[:0]
    elif how == "twelve points":
        message.width, message.row_step = 12, 12 * message.point_step
        raw = raw[:12]
    elif how == "all NaN":
        raw[:, xyz] = np.full(3, np.nan, np.float32).view(np.uint8)
    elif how == "points 1e30 m away":
        raw[:, xyz] = np.full(3, 1e30, np.float32).view(np.uint8)
    message.data = raw.tobytes()
    return message


@pytest.mark.parametrize(
    ("how", "level", "reason"),
    [
        ("empty", 1, "the scan is empty"),
        ("twelve points", 1, "12 of 12 points left"),
        ("all NaN", 1, "0 of 14,400 points left after filtering"),
        ("points 1e30 m away", 1, "0 of 14,400 points left after filtering"),
        ("a field of integers", 2, "field 'x' is int32"),
        ("no z", 2, "no field 'z'"),
        ("cut short", 2, "cut short"),
    ],
)
def test_a_bad_cloud_gives_no_fix_a_reason_and_no_harm(
    active: Robot, world: World, how: str, level: int, reason: str
) -> None:
    fix = active.localize(spoil(active.message(world.points(1)), how))
    assert fix.status.status == NavSatStatus.STATUS_NO_FIX
    assert math.isnan(fix.latitude)
    assert math.isnan(fix.longitude)
    assert fix.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN
    found, message, values = active.diagnosis(reason)
    assert found == level
    assert message.startswith(values["last reason"])
    assert not [p for p in active.poses if p.header.stamp == fix.header.stamp], "a pose without a fix"
    assert active.localize(world.points(1)).status.status == NavSatStatus.STATUS_FIX


@pytest.mark.parametrize(
    "bag",
    ["einride_vlp16_pointcloud2_mcap", "nebula_vlp16_pointcloud2_mcap", "tepic_vlp16_outdoor_1scan_pointcloud2_mcap"],
)
def test_real_velodyne_messages_are_read_and_found_nowhere(active: Robot, shared: Any, bag: str) -> None:
    with open_bag(shared(f"data/vlp16/{bag}")) as reader:
        topic = reader.only_topic("sensor_msgs/msg/PointCloud2", "")
        raw = next(iter(reader.raw_messages([topic.name])))
        recorded = next(iter(reader.messages([topic.name]))).message
    publisher = active.clouds
    deadline = time.monotonic() + 15.0
    stamp = recorded.header.stamp
    found: list[NavSatFix] = []
    while not found and time.monotonic() < deadline:
        publisher.publish(bytes(raw.cdr))
        active.spin(0.3)
        found = [f for f in active.fixes if (f.header.stamp.sec, f.header.stamp.nanosec) == (stamp.sec, stamp.nanosec)]
    assert found, "no estimate of a real cloud"
    assert found[-1].status.status == NavSatStatus.STATUS_NO_FIX
    points = len(scan_from_pointcloud2(recorded).points)
    active.wait_until(lambda: f"received {points}," in active.diagnosis()[2]["last points"], what="for the count")
    assert active.diagnosis()[0] == 1


def test_what_is_dropped_is_counted_and_the_newest_is_worked_on(active: Robot, world: World) -> None:
    before = active.diagnosis()[2]
    messages = [active.message(world.points(place)) for place in range(20)] * 3
    for message in messages:
        active.clouds.publish(message)
    last = messages[-1].header.stamp
    active.wait_until(lambda: any(f.header.stamp == last for f in active.fixes), what="for the newest scan")
    active.spin(1.1)
    after = active.diagnosis()[2]
    received, processed, dropped = (
        int(after[name]) - int(before[name]) for name in ("clouds received", "clouds processed", "clouds dropped")
    )
    assert received == processed + dropped
    assert dropped > 0
    assert processed < len(messages)


def test_the_diagnostics_report_what_the_node_works_with(active: Robot, world: World) -> None:
    message = active.message(world.points(2))
    active.localize(message)
    stamps = itertools.count(stamp_ns_of(message), 10_000_000)

    def has_no_complaint() -> bool:
        active.drive(next(stamps), 0.0)
        return bool(active.diagnostics) and active.diagnostics[-1].status[0].level[0] == 0

    active.wait_until(has_no_complaint, what="for diagnostics without complaint")
    status = active.diagnostics[-1].status[0]
    reason, values = status.message, {v.key: v.value for v in status.values}
    assert reason.startswith("probability 100%")
    assert values["map"] == str(world.map_path)
    assert values["submaps"] == "30"
    assert len(values["encoder"]) == 16
    assert values["calibration"] == "none"
    assert values["motion within a turn"] == "not compensated: field 'time' gives all points the same time"
    assert 0 < float(values["latency median (ms)"]) <= float(values["latency max (ms)"])
    level, _, _ = active.diagnosis("no cloud on /points for")
    assert level == 1


def test_localizing_anew_is_a_service(active: Robot, world: World) -> None:
    assert active.call(Empty, "/reinitialize_global_localization", Empty.Request()) is not None
    assert active.localize(world.points(3)).status.status == NavSatStatus.STATUS_FIX


def set_parameter(robot: Robot, name: str, value: ParameterValue) -> tuple[bool, str]:
    request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
    result = robot.call(SetParameters, "/localizer/set_parameters", request).results[0]
    return result.successful, result.reason


def integer(value: int) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=int(value))


def double(value: float) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float(value))


def double_array(*values: float) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=list(values))


def text(value: str) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("scan.min_range_m", double(-1.0), "scan.min_range_m"),
        ("scan.min_rage_m", double(1.0), "unknown parameter 'scan.min_rage_m': did you mean 'scan.min_range_m'?"),
        ("scan.min_range_m", text("near"), "'scan.min_range_m' must be of type float"),
        ("qos_overrides./points.subscription.depth", integer(3), "qos_overrides./points.subscription.depth"),
        ("scan.body_min_m", double_array(1.0), "'scan.body_min_m' must hold 3 values"),
        ("map", text("/elsewhere"), "clean the node up first"),
        ("autostart", ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=False), "at the start"),
    ],
)  # fmt: skip
def test_a_parameter_that_cannot_be_is_refused_with_its_name(
    active: Robot, name: str, value: ParameterValue, reason: str
) -> None:
    successful, why = set_parameter(active, name, value)
    assert not successful
    assert reason in why


def test_a_setting_of_the_localizer_takes_effect_while_it_runs(active: Robot, world: World) -> None:
    assert set_parameter(active, "scan.max_range_m", double(5.0)) == (True, "")
    assert active.localize(world.points(5)).status.status == NavSatStatus.STATUS_NO_FIX
    active.diagnosis("outside 1 to 5 m")
    assert set_parameter(active, "scan.max_range_m", double(100.0)) == (True, "")
    assert active.localize(world.points(5)).status.status == NavSatStatus.STATUS_FIX


def test_a_setting_that_contradicts_another_is_refused_and_the_node_lives(active: Robot, world: World) -> None:
    successful, why = set_parameter(active, "scan.min_range_m", double(100.0))
    assert not successful
    assert "'min_range_m' (100.0) must be below 'max_range_m' (100.0)" in why
    assert active.localize(world.points(5)).status.status == NavSatStatus.STATUS_FIX


def test_a_setting_that_changes_keeps_an_initial_pose_and_what_is_known(active: Robot, world: World) -> None:
    resets = active.report(active.message(world.points(16)))[1].split("resets ")[1].split(",")[0].split(";")[0]
    active.guesses.publish(guess("map", 13.0, 14.0, yaw=1.0))
    _, _, values = active.diagnosis_with("initial pose", "taken")
    assert set_parameter(active, "fusion.max_speed_mps", double(11.0)) == (True, "")
    message = active.report(active.message(world.points(16)))[1]
    grid, _ = in_grid(frame_of(world), np.array([13.0, 14.0, 0.0]), 1.0)
    assert f"prior at {grid[0]:.1f} {grid[1]:.1f}" in message
    assert f"resets {resets}" in message
    assert active.diagnosis_with("initial pose", "taken")[2]["initial pose"] == values["initial pose"]
    assert set_parameter(active, "fusion.max_speed_mps", double(10.0)) == (True, "")


def test_a_setting_that_changes_while_the_node_is_inactive_holds_when_it_is_active(active: Robot, world: World) -> None:
    active.localize(world.points(5))
    assert active.change_state(Transition.TRANSITION_DEACTIVATE)
    assert set_parameter(active, "scan.max_range_m", double(5.0)) == (True, "")
    assert active.change_state(Transition.TRANSITION_ACTIVATE)
    active.wait_for_localizer()
    # Other places each time: a scan that comes again is that of a frozen lidar.
    assert active.localize(world.points(7)).status.status == NavSatStatus.STATUS_NO_FIX
    assert set_parameter(active, "scan.max_range_m", double(100.0)) == (True, "")
    assert active.localize(world.points(8)).status.status == NavSatStatus.STATUS_FIX


def test_an_initial_pose_is_refused_where_no_pose_is_tracked(active: Robot) -> None:
    assert set_parameter(active, "alignment.scope", text("none")) == (True, "")
    active.guesses.publish(guess("map", 12.0, 15.0))
    active.diagnosis_with("initial pose", "refused: alignment.scope is none")
    assert set_parameter(active, "alignment.scope", text("auto")) == (True, "")


def test_a_scan_that_does_not_end_is_an_error_and_the_state_is_stale(active: Robot, world: World) -> None:
    active.localize(world.points(5))
    slow = active.message(world.points(6))
    slow.header.frame_id = "slow"
    active.clouds.publish(slow)
    level, message, _ = active.diagnosis("does not end")
    assert level == 2
    assert "the scan at work has taken" in message
    active.wait_until(lambda: any("localized when last seen" in state.message for state in active.states))
    assert active.localize(world.points(5)).status.status == NavSatStatus.STATUS_FIX, "it has ended after all"


def test_parameters_carry_description_and_range(active: Robot) -> None:
    names = ["scan.mounting.z_m", "top_k", "device"]
    request = DescribeParameters.Request(names=names)
    z, top_k, device = active.call(DescribeParameters, "/localizer/describe_parameters", request).descriptors
    assert z.description == "above the base frame, which stands on the ground"
    assert (z.floating_point_range[0].from_value, z.floating_point_range[0].to_value) == (-5.0, 20.0)
    assert (top_k.integer_range[0].from_value, top_k.integer_range[0].to_value) == (1, 1000)
    assert device.additional_constraints == "one of: cpu, cuda"


def test_the_lifecycle_goes_round(active: Robot, world: World) -> None:
    active.localize(world.points(6))
    assert active.change_state(Transition.TRANSITION_DEACTIVATE)
    assert active.state() == "inactive"
    active.wait_until(
        lambda: active.states and active.states[-1].message == "localized when last seen: inactive",
        what="for the state to be stale",
    )
    active.wait_until(lambda: active.clouds.get_subscription_count() == 0, what="for the node to stop listening")
    assert active.diagnosis()[:2] == (0, "inactive")
    assert active.change_state(Transition.TRANSITION_CLEANUP)
    assert active.node.count_publishers("/localizer/fix") == 0
    assert set_parameter(active, "map", text("/elsewhere"))[0], "unconfigured, the map may be chosen"
    assert not active.change_state(Transition.TRANSITION_CONFIGURE)
    assert active.state() == "unconfigured"
    level, message, _ = active.diagnosis()
    assert level == 2
    assert "/elsewhere does not exist" in message
    assert set_parameter(active, "map", text(str(world.map_path)))[0]
    assert active.change_state(Transition.TRANSITION_CONFIGURE)
    assert active.change_state(Transition.TRANSITION_ACTIVATE)
    active.wait_for_localizer()
    assert active.localize(world.points(6)).status.status == NavSatStatus.STATUS_FIX


# A second node, configured by a manager, in simulated time, with an IMU and a driver that is reliable.

TILT = np.radians(12.0)
R_TILT = np.array([[np.cos(TILT), 0, np.sin(TILT)], [0, 1, 0], [-np.sin(TILT), 0, np.cos(TILT)]])


@pytest.fixture(scope="module")
def managed(start_stand_in: StartNode, world: World) -> Iterator[NodeProcess]:
    odometry = "none" if find_spec("kiss_icp") is None else "scan"
    own = {"autostart": False, "use_sim_time": True, "use_imu": True, "imu_time_constant_s": 0.01, "odometry": odometry}
    node = start_stand_in(
        {**world.parameters(), **own, "qos_overrides./rover/lidar.subscription.reliability": "reliable"},
        "-r", "__ns:=/rover", "-r", "points:=lidar",
    )  # fmt: skip
    yield node
    assert node.is_alive, f"a test has ended the node:\n{node.output}"
    assert node.stop(signal.SIGTERM) == 0
    assert "Traceback" not in node.output


def the_scans_measure_how_the_robot_moves(robot: Robot, world: World, clouds: Any) -> None:
    states: list[DiagnosticStatus] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.node.create_subscription(DiagnosticStatus, "/rover/localizer/state", states.append, latched)
    robot.wait_until(lambda: states, what="for the state")
    robot.call(Empty, "/rover/reinitialize_global_localization", Empty.Request())
    for forward_m in (0.0, 0.3, 0.7):
        message = robot.message(world.points(7) - np.array([forward_m, 0.0, 0.0], np.float32))
        stamp_ns = str(stamp_ns_of(message))
        clouds.publish(message)
        robot.wait_until(lambda stamp=stamp_ns: states[-1].values[0].value == stamp, what="for the state")
    assert "moved 0.40" in states[-1].message


def test_a_managed_node_in_a_namespace_levels_by_the_imu(
    managed: NodeProcess, robot: Robot, world: World, robot_context: rclpy.Context
) -> None:
    from lifecycle_msgs.srv import ChangeState

    clock = robot.node.create_publisher(Clock, "/clock", 1)
    assert robot.state("/rover/localizer") == "unconfigured"
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        request = ChangeState.Request(transition=Transition(id=int(transition)))
        assert robot.call(ChangeState, "/rover/localizer/change_state", request).success, managed.output
    assert robot.state("/rover/localizer") == "active"

    tables: list[PointCloud2] = []
    robot.node.create_subscription(PointCloud2, "/rover/localizer/candidate_table", tables.append, 10)
    reliable = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
    clouds = robot.node.create_publisher(PointCloud2, "/rover/lidar", reliable)
    imu = robot.node.create_publisher(Imu, "/rover/imu", 10)
    robot.wait_until(lambda: clouds.get_subscription_count() and imu.get_subscription_count(), what="for the inputs")
    table_topic = "/rover/localizer/candidate_table"
    robot.wait_until(lambda: robot.node.count_publishers(table_topic), what="for the candidates")
    robot.spin(0.5)  # the node must have found this subscription too, or it makes no table
    offered = robot.node.get_subscriptions_info_by_topic("/rover/lidar")[0].qos_profile.reliability
    assert offered == ReliabilityPolicy.RELIABLE, "the override must have reached the subscription"

    # The robot stands on a slope of 12 degrees: sensor and IMU are tilted alike, the town is not.
    sensor = np.array([0.0, 0.0, 1.2])
    level = world.points(7).astype(np.float64) + sensor
    tilted = (level @ R_TILT) - sensor
    up = np.array([0.0, 0.0, 9.81]) @ R_TILT

    def best_distance(force: np.ndarray | None) -> float:
        message = robot.message(tilted)
        if force is not None:
            sample = Imu(header=message.header)
            sample.linear_acceleration.x, sample.linear_acceleration.y, sample.linear_acceleration.z = map(float, force)
            imu.publish(sample)
            robot.spin(0.3)
        clouds.publish(message)
        robot.wait_until(lambda: tables and tables[-1].header.stamp == message.header.stamp, what="for candidates")
        return float(np.frombuffer(bytes(tables[-1].data), TABLE)["descriptor_distance"][0])

    with_imu = best_distance(up)
    for _ in range(100):
        next(robot.stamps_ns)  # ten seconds: the sample is too old then to be used
    assert with_imu < 0.7 * best_distance(None)

    # An IMU that reports gravity where others report the force against it.
    fixes: list[NavSatFix] = []
    robot.node.create_subscription(NavSatFix, "/rover/localizer/fix", fixes.append, 10)
    robot.wait_until(lambda: robot.node.count_publishers("/rover/localizer/fix"), what="for the fix")
    robot.spin(0.3)
    upside_down = robot.message(tilted)
    sample = Imu(header=upside_down.header)
    sample.linear_acceleration.z = -9.81
    imu.publish(sample)
    robot.spin(0.3)
    clouds.publish(upside_down)
    robot.wait_until(lambda: fixes and fixes[-1].header.stamp == upside_down.header.stamp, what="for the fix")
    assert fixes[-1].status.status == NavSatStatus.STATUS_NO_FIX
    assert "points down: at rest it must be +9.8 upwards" in managed.output
    managed.wait_for_output("by the measured gravity the robot lies on its side", 10.0)

    if find_spec("kiss_icp") is not None:
        the_scans_measure_how_the_robot_moves(robot, world, clouds)

    # A driver that is best effort never reaches a reliable subscription, and the node reports it.
    robot.node.create_publisher(PointCloud2, "/rover/lidar", qos_profile_sensor_data)
    managed.wait_for_output("a publisher on /rover/lidar offers an incompatible RELIABILITY", 15.0)

    now = Clock()
    now.clock.sec = 4321
    robot.wait_until(
        lambda: clock.publish(now) or any(d.header.stamp.sec == 4321 for d in robot.diagnostics),
        what="for diagnostics in simulated time",
    )
    names = {d.status[0].name for d in robot.diagnostics if d.header.stamp.sec == 4321}
    assert names == {"rover/localizer: localization"}


# Starts that must fail


def not_ros_parameters(folder: Path) -> Path:
    path = folder / "broken.yaml"
    path.write_text("localizer:\n  ros__parameters\n    - no\n  yes: {")
    return path


def unknown_parameter(folder: Path) -> Path:
    path = folder / "parameters.yaml"
    path.write_text("localizer:\n  ros__parameters:\n    scan:\n      mounting:\n        height_m: 1.5\n")
    return path


def truncated_map(folder: Path, world: World) -> Path:
    copy = folder / "truncated"
    shutil.copytree(world.map_path, copy)
    index = copy / "descriptors.faiss"
    index.write_bytes(index.read_bytes()[:-100])
    return copy


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"scan.min_rang_m": 2.0}, "unknown parameter 'scan.min_rang_m': did you mean 'scan.min_range_m'?"),
        ({"top_k": 0}, "'top_k' must lie between 1 and 1000"),
        ({"odom_frame_id": "/odom"}, "'odom_frame_id' must not begin with a slash, which tf2 refuses: set 'odom'"),
        ({"--params-file": "NOWHERE"}, "nowhere"),
        pytest.param({"map": '""'}, "parameter 'map' is empty", marks=pytest.mark.slow),
        ({"weights": "OTHER"}, "was made by other weights"),
        ({"map": "NOWHERE"}, "does not exist; build one with"),
        pytest.param({"map": "TRUNCATED"}, "is truncated", marks=pytest.mark.slow),
        ({"--params-file": "UNKNOWN"}, "unknown parameter 'scan.mounting.height_m'"),
        pytest.param({"--params-file": "BROKEN"}, "broken.yaml", marks=pytest.mark.slow),
        pytest.param({"scan.mounting.z_m": "high"}, "'scan.mounting.z_m' must be of type", marks=pytest.mark.slow),
        pytest.param({"weights": "NOWHERE"}, "no such weights file", marks=pytest.mark.slow),
        ({"tf_broadcast": True, "odometry": "none"}, "tf_broadcast needs odometry from a topic"),
        pytest.param({"tf_broadcast": True}, "tf_broadcast needs tf2_ros, which is not", marks=pytest.mark.slow),
        pytest.param({"mounting_from_tf": True}, "needs tf2_ros, which is not installed", marks=pytest.mark.slow),
        pytest.param(
            {"qos_overrides./points.subscription.reliability": "sometimes"}, "qos_overrides./points",
            marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_a_node_that_cannot_run_says_why_and_ends(
    start_node: StartNode, world: World, tmp_path: Path, parameters: dict[str, object], words: str
) -> None:
    made = {
        "OTHER": lambda: world.other_weights_path,
        "NOWHERE": lambda: tmp_path / "nowhere",
        "TRUNCATED": lambda: truncated_map(tmp_path, world),
        "UNKNOWN": lambda: unknown_parameter(tmp_path),
        "BROKEN": lambda: not_ros_parameters(tmp_path),
    }
    own = {name: made[value]() if str(value) in made else value for name, value in parameters.items()}
    file = ["--params-file", str(own.pop("--params-file"))] if "--params-file" in own else []
    node = start_node({**world.parameters(), **own}, *file)
    assert node.wait() == 2, node.output
    assert words in node.output
    assert "Traceback" not in node.output


@pytest.mark.parametrize(
    "library", ["_rclpy_pybind11", pytest.param("libtorch_cpu", marks=pytest.mark.slow)], ids=["importing", "loading"]
)
def test_ctrl_c_during_the_start_ends_cleanly(start_node: StartNode, world: World, library: str) -> None:
    node = start_node(world.parameters())
    memory = Path(f"/proc/{node.process.pid}/maps")
    while library not in memory.read_text():
        assert node.is_alive, node.output
        time.sleep(0.02)
    assert node.stop(signal.SIGINT) == 0, node.output
    assert "Traceback" not in node.output


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_ctrl_c_while_warming_up_ends_cleanly(start_node: StartNode, world: World, number: signal.Signals) -> None:
    node = start_node(world.parameters())
    node.wait_for_output("warming up")
    time.sleep(0.1)
    assert node.stop(number) == 0, node.output
    assert "Traceback" not in node.output
