"""The player against a real subscriber: another process, over DDS, in a domain of its own."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from crossloc3d_ros.errors import BagError, CrossLocError
from crossloc3d_ros.formats import bag, messages
from crossloc3d_ros.formats.bag import BagTopic, OfferedQos

pytest.importorskip("rclpy")

START_NS = 1_700_000_000_000_000_000
STEP_NS = 50_000_000
SCANS = 30

SUBSCRIBER = """
import hashlib, json, sys, time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy, DurabilityPolicy, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import NavSatFix, PointCloud2
from rclpy.serialization import deserialize_message

seconds, scans = float(sys.argv[1]), int(sys.argv[2])
rclpy.init()
node = rclpy.create_node("listener")
clouds, fixes, clocks = [], [], []
def on_cloud(data):
    clouds.append((time.monotonic_ns(), data))
node.create_subscription(PointCloud2, "/velodyne_points", on_cloud, qos_profile_sensor_data, raw=True)
latched = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(NavSatFix, "/gnss", lambda m: fixes.append(m.latitude), latched)
best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
node.create_subscription(Clock, "/clock", lambda m: clocks.append(m.clock.sec * 10**9 + m.clock.nanosec), best_effort)
end = time.monotonic() + seconds
while time.monotonic() < end and len(clouds) < scans:
    rclpy.spin_once(node, timeout_sec=0.05)
until = time.monotonic() + 0.3
while time.monotonic() < until:
    rclpy.spin_once(node, timeout_sec=0.05)
messages = [(t, deserialize_message(data, PointCloud2)) for t, data in clouds]
print(json.dumps({
    "arrived_ns": [t for t, _ in messages],
    "stamps_ns": [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in messages],
    "digests": [hashlib.sha256(bytes(m.data)).hexdigest() for _, m in messages],
    "fixes": fixes,
    "clocks": clocks,
    "cloud_publishers": [str(i.qos_profile.reliability) for i in node.get_publishers_info_by_topic("/velodyne_points")],
}))
node.destroy_node()
rclpy.shutdown()
"""


@pytest.fixture
def own_domain(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def cloud_of(i: int, points: int) -> object:
    rng = np.random.default_rng(i)
    xyz = rng.normal(size=(points, 3)).astype(np.float32)
    return messages.velodyne_cloud(START_NS + i * STEP_NS, "velodyne", xyz, 1.0, 3, 0.0)


def digest_of(cloud: object) -> str:
    return hashlib.sha256(cloud.data.tobytes()).hexdigest()


def write_drive(path: Path, scans: int = SCANS, points: int = 30_000, storage: bag.Storage = "mcap") -> Path:
    with bag.BagWriter(path, storage) as writer:
        writer.add_topic("/velodyne_points", bag.POINT_CLOUD, OfferedQos("best_effort", "volatile", 5))
        writer.add_topic("/gnss", bag.NAV_SAT_FIX, OfferedQos("reliable", "transient_local", 1))
        writer.write("/gnss", bag.NAV_SAT_FIX, START_NS, messages.nav_sat_fix(START_NS, "gnss", 52.5, 4.0, 43.0))
        for i in range(scans):
            writer.write("/velodyne_points", bag.POINT_CLOUD, START_NS + i * STEP_NS, cloud_of(i, points))
    return path


def listen(seconds: float, scans: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SUBSCRIBER, str(seconds), str(scans)], stdout=subprocess.PIPE, text=True
    )


def received_by(process: subprocess.Popen[str]) -> dict[str, list]:
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return json.loads(output)


def player_process(path: Path, code: str) -> subprocess.Popen[str]:
    """Play in a process of its own: the Fast DDS profile has to be set before anything else of ROS has started."""
    script = (
        "from crossloc3d_ros.config import PlayerConfig\n"
        "from crossloc3d_ros.formats.bag import open_bag\n"
        "from crossloc3d_ros.ros.player import play_bag\n"
        f"with open_bag({str(path)!r}) as reader:\n    report = {code}\n"
        "print(report.messages, report.late_median_ms, report.late_p99_ms, report.duration_s)\n"
    )
    return subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_every_cloud_arrives_unchanged_on_time_with_the_clock(tmp_path: Path, own_domain: None) -> None:
    path = write_drive(tmp_path / "drive")
    listener = listen(30, SCANS)
    player = player_process(path, "play_bag(reader, PlayerConfig(clock=True))")
    received = received_by(listener)
    output, errors = player.communicate(timeout=30)
    assert player.returncode == 0, errors
    messages, late_median_ms, _, duration_s = (float(v) for v in output.split())
    assert messages == SCANS + 1
    # 660 KB each, best effort as recorded: without the shared-memory profile most would be lost.
    assert received["cloud_publishers"] == ["2"] or "BEST_EFFORT" in received["cloud_publishers"][0]
    assert received["stamps_ns"] == [START_NS + i * STEP_NS for i in range(SCANS)]
    assert received["digests"] == [digest_of(cloud_of(i, 30_000)) for i in range(SCANS)]
    assert received["fixes"] == [52.5]
    # Deadlines are absolute: over the whole drive the timing neither stretches nor shrinks.
    arrived = np.array(received["arrived_ns"])
    assert (arrived[-1] - arrived[0]) / 1e9 == pytest.approx((SCANS - 1) * STEP_NS / 1e9, abs=0.3)
    assert duration_s == pytest.approx((SCANS - 1) * STEP_NS / 1e9, abs=0.6)
    assert late_median_ms < 30.0  # 0.2 ms on a machine with nothing else to do
    # The clock stands at the start while the player waits, then runs at 40 Hz or more and never goes back.
    clocks = np.array(received["clocks"])
    assert clocks[0] < START_NS + 10 * STEP_NS
    assert (np.diff(clocks) >= 0).all()
    running = clocks[clocks > START_NS]
    assert len(running) >= 40 * 1.45
    assert running[-1] <= START_NS + (SCANS - 1) * STEP_NS


def test_a_real_recording_at_four_times_its_speed(own_domain: None, shared) -> None:
    path = shared("data/vlp16/einride_vlp16_pointcloud2_sqlite3")
    with bag.open_bag(path) as reader:
        recorded = [(t_ns, bag.stamp_ns_of(m, 0), digest_of(m)) for _, t_ns, m in reader.messages()]
    listener = listen(30, len(recorded))
    player = player_process(path, "play_bag(reader, PlayerConfig(rate=4.0))")
    received = received_by(listener)
    _, errors = player.communicate(timeout=30)
    assert player.returncode == 0, errors
    assert received["stamps_ns"] == [stamp_ns for _, stamp_ns, _ in recorded]
    assert received["digests"] == [digest for _, _, digest in recorded]
    arrived = np.array(received["arrived_ns"])
    seconds = (recorded[-1][0] - recorded[0][0]) / 1e9
    assert (arrived[-1] - arrived[0]) / 1e9 == pytest.approx(seconds / 4, abs=0.2)


def test_a_ros_1_bag_under_another_topic(tmp_path: Path, own_domain: None) -> None:
    path = tmp_path / "old.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    clouds = [cloud_of(i, 1000) for i in range(10)]
    with Ros1Writer(path) as writer:
        connection = writer.add_connection("/points_raw", bag.POINT_CLOUD, typestore=store)
        for number, cloud in enumerate(clouds):
            head = store.types["std_msgs/msg/Header"](number, cloud.header.stamp, cloud.header.frame_id)
            values = (cloud.height, cloud.width, cloud.fields, cloud.is_bigendian, cloud.point_step, cloud.row_step)
            message = store.types[bag.POINT_CLOUD](head, *values, cloud.data, cloud.is_dense)
            data = store.serialize_ros1(message, bag.POINT_CLOUD)
            writer.write(connection, START_NS + number * STEP_NS, data)
    listener = listen(30, len(clouds))
    player = player_process(
        path, "play_bag(reader, PlayerConfig(), ros_arguments=['-r', '/points_raw:=/velodyne_points'])"
    )
    received = received_by(listener)
    _, errors = player.communicate(timeout=30)
    assert player.returncode == 0, errors
    assert received["stamps_ns"] == [START_NS + i * STEP_NS for i in range(len(clouds))]
    assert received["digests"] == [digest_of(cloud) for cloud in clouds]


def test_no_subscriber_is_reported(tmp_path: Path, own_domain: None) -> None:
    path = write_drive(tmp_path / "drive", scans=2, points=10)
    player = player_process(path, "play_bag(reader, PlayerConfig(wait_s=0.5))")
    _, errors = player.communicate(timeout=30)
    assert player.returncode != 0
    assert "no node subscribed to /velodyne_points within 0.5 s" in errors


def test_ctrl_c_ends_the_player_cleanly(tmp_path: Path, own_domain: None) -> None:
    path = write_drive(tmp_path / "drive", scans=5, points=10)
    player = player_process(
        path, "play_bag(reader, PlayerConfig(loop=True, wait_s=0.0), on_ready=lambda: print('on', flush=True))"
    )
    assert player.stdout is not None
    assert player.stdout.readline().strip() == "on"
    time.sleep(1.0)
    assert player.poll() is None
    player.send_signal(signal.SIGINT)
    _, errors = player.communicate(timeout=10)
    assert errors.strip().endswith("KeyboardInterrupt")  # it passes through, and nothing aborts on the way out
    assert player.returncode == -signal.SIGINT


def test_a_bag_that_breaks_off_says_so_after_playing_what_is_whole(tmp_path: Path, own_domain: None) -> None:
    path = write_drive(tmp_path / "drive", points=5000, storage="sqlite3")
    (file,) = path.glob("*.db3")
    content = bytearray(file.read_bytes())
    at = len(content) // 2 // 4096 * 4096
    content[at : at + 200 * 4096] = np.random.default_rng(0).bytes(200 * 4096)
    file.write_bytes(content)
    player = player_process(path, "play_bag(reader, PlayerConfig(wait_s=0.0))")
    _, errors = player.communicate(timeout=30)
    assert player.returncode != 0
    assert "BagError" in errors
    assert file.name in errors


def test_offered_qos_is_the_recorded_one_and_reliable_where_unknown() -> None:
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    from crossloc3d_ros.ros.player import qos_of

    best_effort, latched = OfferedQos("best_effort", "volatile", 5), OfferedQos("reliable", "transient_local", 1)
    assert qos_of(BagTopic("/t", "m", 1, (best_effort,))).reliability == ReliabilityPolicy.BEST_EFFORT
    assert qos_of(BagTopic("/t", "m", 1, (latched, latched))).durability == DurabilityPolicy.TRANSIENT_LOCAL
    mixed = qos_of(BagTopic("/t", "m", 1, (latched, best_effort)))
    assert (mixed.reliability, mixed.durability) == (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
    assert qos_of(BagTopic("/t", "m", 1)).reliability == ReliabilityPolicy.RELIABLE


def test_what_cannot_be_played_is_reported(tmp_path: Path, own_domain: None) -> None:
    import rclpy
    from rclpy.node import Node

    from crossloc3d_ros.config import PlayerConfig
    from crossloc3d_ros.ros.player import Player

    path = write_drive(tmp_path / "drive", scans=1, points=10)
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node("player_under_test", context=context)
    try:
        with bag.open_bag(path) as reader, pytest.raises(BagError, match=r"no topic '/nothing'; its topics are: /gnss"):
            Player(reader, node, PlayerConfig(), topics=["/nothing"])
        with bag.open_bag(path) as reader, pytest.raises(BagError, match="nothing that could be played"):
            Player(reader, node, PlayerConfig(), topics=[])
        with bag.open_bag(path) as reader, pytest.raises(CrossLocError, match="no node subscribed"):
            Player(reader, node, PlayerConfig(wait_s=0.1)).wait_for_subscribers()
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
