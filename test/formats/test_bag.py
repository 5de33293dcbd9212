"""Recordings: what is written is read again, in both formats and from ROS 1, and damage is named."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats import bag, messages

START_NS = 1_700_000_000_123_456_789
STEP_NS = 100_000_000
JAZZY = get_typestore(Stores.ROS2_JAZZY)


def cloud_columns(seed: int, count: int = 500) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "points": rng.normal(0, 20, (count, 3)).astype(np.float32),
        "intensity": rng.uniform(0, 255, count).astype(np.float32),
        "ring": rng.integers(0, 16, count).astype(np.uint16),
        "time_s": rng.uniform(-0.1, 0, count).astype(np.float32),
    }


def write_bag(path: Path, storage: bag.Storage = "mcap", scans: int = 6, points: int = 500) -> Path:
    with bag.BagWriter(path, storage) as writer:
        writer.add_topic("/velodyne_points", bag.POINT_CLOUD, bag.OfferedQos("best_effort", "volatile", 5))
        for i in range(scans):
            stamp_ns = START_NS + i * STEP_NS
            cloud = messages.velodyne_cloud(stamp_ns, "velodyne", **cloud_columns(i, points))
            writer.write("/velodyne_points", bag.POINT_CLOUD, stamp_ns, cloud)
            fix = messages.nav_sat_fix(stamp_ns, "gnss", 52.0 + i, 4.0, 43.0, np.diag([1.0, 2.0, 3.0]))
            writer.write("/gnss", bag.NAV_SAT_FIX, stamp_ns, fix)
    return path


def write_ros1_bag(path: Path, scans: int = 3) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    cls = store.types
    with Ros1Writer(path) as writer:
        connection = writer.add_connection("/velodyne_points", bag.POINT_CLOUD, typestore=store)
        latched = writer.add_connection("/gnss", bag.NAV_SAT_FIX, typestore=store, latching=1)
        for i in range(scans):
            stamp_ns = START_NS + i * STEP_NS
            new = messages.velodyne_cloud(stamp_ns, "velodyne", **cloud_columns(i))
            head = cls["std_msgs/msg/Header"](
                seq=i,
                stamp=cls["builtin_interfaces/msg/Time"](new.header.stamp.sec, new.header.stamp.nanosec),
                frame_id="velodyne",
            )
            fields = [cls["sensor_msgs/msg/PointField"](f.name, f.offset, f.datatype, f.count) for f in new.fields]
            old = cls[bag.POINT_CLOUD](
                head, new.height, new.width, fields, False, new.point_step, new.row_step, new.data, True
            )
            writer.write(connection, stamp_ns, store.serialize_ros1(old, bag.POINT_CLOUD))
            status = cls["sensor_msgs/msg/NavSatStatus"](0, 1)
            fix = cls[bag.NAV_SAT_FIX](head, status, 52.0 + i, 4.0, 43.0, np.diag([1.0, 2.0, 3.0]).reshape(9), 3)
            writer.write(latched, stamp_ns, store.serialize_ros1(fix, bag.NAV_SAT_FIX))
    return path


def assert_is_cloud(message: object, seed: int) -> None:
    columns = cloud_columns(seed)
    table = np.frombuffer(bytes(message.data), dtype=messages.VELODYNE_POINT)
    np.testing.assert_array_equal(np.column_stack([table["x"], table["y"], table["z"]]), columns["points"])
    np.testing.assert_array_equal(table["intensity"], columns["intensity"])
    np.testing.assert_array_equal(table["ring"], columns["ring"])
    np.testing.assert_array_equal(table["time"], columns["time_s"])
    assert (message.point_step, message.width, message.height) == (22, len(table), 1)
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("intensity", 12, 7, 1),
        ("ring", 16, 4, 1),
        ("time", 18, 7, 1),
    ]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_what_was_written_is_read_again(tmp_path: Path, storage: bag.Storage) -> None:
    path = write_bag(tmp_path / "drive", storage)
    with bag.open_bag(path) as reader:
        assert {name: topic.count for name, topic in reader.topics().items()} == {"/gnss": 6, "/velodyne_points": 6}
        assert (reader.start_ns, reader.end_ns) == (START_NS, START_NS + 5 * STEP_NS)
        clouds = list(reader.messages(["/velodyne_points"]))
        fixes = list(reader.messages(["/gnss"]))
    assert [message.t_ns for message in clouds] == [START_NS + i * STEP_NS for i in range(6)]
    for i, message in enumerate(clouds):
        assert_is_cloud(message.message, i)
        assert bag.stamp_ns_of(message.message, 0) == START_NS + i * STEP_NS
        assert message.message.header.frame_id == "velodyne"
    assert [fix.message.latitude for fix in fixes] == [52.0 + i for i in range(6)]
    np.testing.assert_array_equal(fixes[0].message.position_covariance.reshape(3, 3), np.diag([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_file_alone_reads_as_the_folder_does(tmp_path: Path, storage: bag.Storage) -> None:
    path = write_bag(tmp_path / "drive", storage)
    (file,) = (p for p in path.iterdir() if p.suffix in {".mcap", ".db3"})
    with bag.open_bag(path) as of_folder, bag.open_bag(file) as of_file:
        assert list(of_folder.raw_messages()) == list(of_file.raw_messages())


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_offered_qos_survives(tmp_path: Path, storage: bag.Storage) -> None:
    with bag.open_bag(write_bag(tmp_path / "drive", storage)) as reader:
        topics = reader.topics()
    assert topics["/velodyne_points"].offered_qos_profiles == (bag.OfferedQos("best_effort", "volatile", 5),)
    assert topics["/gnss"].offered_qos_profiles == ()


def test_a_ros_1_bag_reads_like_a_ros_2_bag(tmp_path: Path) -> None:
    with bag.open_bag(write_ros1_bag(tmp_path / "drive.bag")) as reader:
        topics = reader.topics()
        clouds = list(reader.messages(["/velodyne_points"]))
        raw = list(reader.raw_messages())
    assert topics["/velodyne_points"].msgtype == bag.POINT_CLOUD
    assert topics["/gnss"].offered_qos_profiles[0].durability == "transient_local"
    for i, message in enumerate(clouds):
        assert_is_cloud(message.message, i)
        assert bag.stamp_ns_of(message.message, 0) == START_NS + i * STEP_NS
    # The bytes for DDS are those of a Jazzy message: no `seq` in the header.
    again = [JAZZY.deserialize_cdr(m.cdr, m.msgtype) for m in raw if m.topic == "/velodyne_points"]
    for i, message in enumerate(again):
        assert_is_cloud(message, i)
        assert message.header.frame_id == "velodyne"


def test_raw_messages_are_the_recorded_ones(tmp_path: Path) -> None:
    with bag.open_bag(write_bag(tmp_path / "drive")) as reader:
        raw = list(reader.raw_messages(["/velodyne_points"]))
    assert {type(m.cdr) for m in raw} == {bytes}  # rclpy publishes nothing else
    for i, message in enumerate(raw):
        assert_is_cloud(JAZZY.deserialize_cdr(message.cdr, message.msgtype), i)


@pytest.mark.parametrize(
    ("name", "scans"),
    [
        ("einride_vlp16_pointcloud2_mcap", 13),
        ("einride_vlp16_pointcloud2_sqlite3", 13),
        ("nebula_vlp16_pointcloud2_mcap", 4),
        ("tepic_vlp16_outdoor_1scan_pointcloud2_mcap", 1),
    ],
)
def test_real_recordings_are_read(shared, name: str, scans: int) -> None:
    with bag.open_bag(shared(f"data/vlp16/{name}")) as reader:
        topic = reader.only_topic(bag.POINT_CLOUD, "")
        messages = list(reader.messages([topic.name]))
    assert (topic.name, topic.count, len(messages)) == ("/velodyne_points", scans, scans)
    for message in messages:
        assert message.message.header.frame_id == "velodyne"
        assert len(message.message.data) == 22 * message.message.width * message.message.height > 0


def test_no_topics_chosen_means_none(tmp_path: Path) -> None:
    with bag.open_bag(write_bag(tmp_path / "drive")) as reader:
        assert list(reader.messages([])) == []
        assert list(reader.messages(["/nothing"])) == []


def test_a_missing_topic_lists_the_topics_there_are(tmp_path: Path) -> None:
    with bag.open_bag(write_bag(tmp_path / "drive")) as reader:
        with pytest.raises(BagError, match=r"no topic '/points'.*/gnss \(.*NavSatFix, 6 .*/velodyne_points"):
            reader.topic("/points", bag.POINT_CLOUD)
        with pytest.raises(BagError, match=r"'/gnss' .* holds sensor_msgs/msg/NavSatFix, not .*PointCloud2"):
            reader.topic("/gnss", bag.POINT_CLOUD)
        with pytest.raises(BagError, match=r"no topic of type sensor_msgs/msg/Imu; its topics are: /gnss"):
            reader.only_topic(bag.IMU, "choose one")


def test_several_topics_of_a_type_are_not_guessed_between(tmp_path: Path) -> None:
    with bag.BagWriter(tmp_path / "two") as writer:
        for topic in ("/front", "/rear"):
            writer.write(topic, bag.POINT_CLOUD, 1, messages.velodyne_cloud(1, "lidar", **cloud_columns(0)))
    with (
        bag.open_bag(tmp_path / "two") as reader,
        pytest.raises(BagError, match=r"/front, /rear\); choose with --topic"),
    ):
        reader.only_topic(bag.POINT_CLOUD, "choose with --topic")


def read_everything(path: Path) -> int:
    with bag.open_bag(path) as reader:
        return sum(1 for _ in reader.messages())


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.6, 0.9, 0.999])
def test_a_truncated_bag_is_named(tmp_path: Path, storage: bag.Storage, share: float) -> None:
    path = write_bag(tmp_path / "drive", storage, points=5000)
    (file,) = (p for p in path.iterdir() if p.suffix in {".mcap", ".db3"})
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(BagError, match=file.name):
        read_everything(path)
    with pytest.raises(BagError, match=file.name):
        read_everything(file)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.95])
def test_a_truncated_ros_1_bag_is_named(tmp_path: Path, share: float) -> None:
    path = write_ros1_bag(tmp_path / "drive.bag")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(BagError, match=r"drive\.bag.*rosbag reindex"):
        read_everything(path)


@pytest.mark.parametrize("name", ["noise.db3", "noise.mcap", "noise.bag"])
def test_noise_is_no_bag(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(np.random.default_rng(0).bytes(100_000))
    with pytest.raises(BagError, match=name):
        read_everything(path)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("seed", range(5))
def test_bytes_overwritten_in_the_middle_do_no_harm_unnamed(tmp_path: Path, storage: bag.Storage, seed: int) -> None:
    path = write_bag(tmp_path / "drive", storage, points=2000)
    (file,) = (p for p in path.iterdir() if p.suffix in {".mcap", ".db3"})
    rng = np.random.default_rng(seed)
    content = bytearray(file.read_bytes())
    at = int(rng.integers(0, len(content) - 2000))
    content[at : at + 2000] = rng.bytes(2000)
    file.write_bytes(content)
    try:  # values inside a message may change unseen; whatever is noticed must come as our error
        count = read_everything(path)
    except BagError as error:
        assert file.name in str(error)
    else:
        assert 0 < count <= 12


def test_unfinished_missing_and_foreign_paths_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="does not exist"):
        read_everything(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match=r"neither metadata\.yaml nor"):
        read_everything(tmp_path / "empty")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(BagError, match=r"notes\.txt is not a recording"):
        read_everything(tmp_path / "notes.txt")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: None, "missing"),
        (lambda text: "", "Invalid bag metadata"),
        (lambda text: text[: len(text) // 2], ""),
        (lambda text: text.replace("depth: 5", "depth: 7"), "QoS of /velodyne_points"),
        (lambda text: text.replace("name: /gnss", "name: /other"), "does not name the topic /gnss"),
        (
            lambda text: text.replace("  message_count: 12", "  message_count: 6"),
            "counts 6 messages, the files hold 12",
        ),
    ],
)
def test_metadata_that_are_false_lose_no_message(
    tmp_path: Path, storage: bag.Storage, change: Callable[[str], str | None], reason: str, caplog
) -> None:
    path = write_bag(tmp_path / "drive", storage)
    file = path / "metadata.yaml"
    text = file.read_text()
    changed = change(text)
    assert changed != text
    if changed is None:
        file.unlink()
    else:
        file.write_text(changed)
    with bag.open_bag(path) as reader:
        assert {name: topic.count for name, topic in reader.topics().items()} == {"/gnss": 6, "/velodyne_points": 6}
        assert reader.topics()["/velodyne_points"].offered_qos_profiles == (
            bag.OfferedQos("best_effort", "volatile", 5),
        )
        assert len(list(reader.messages())) == len(list(reader.raw_messages())) == reader.message_count == 12
    assert "metadata.yaml is left aside" in caplog.text
    assert reason in caplog.text


def test_sound_metadata_are_followed_without_a_word(tmp_path: Path, caplog) -> None:
    assert read_everything(write_bag(tmp_path / "drive")) == 12
    assert not caplog.records


def test_a_damaged_file_beside_broken_metadata_is_the_one_that_is_blamed(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive")
    (path / "metadata.yaml").write_text("")
    (path / "drive.mcap").write_bytes((path / "drive.mcap").read_bytes()[:-200])
    with pytest.raises(BagError, match=r"cannot read .*drive\.mcap: .*mcap recover") as caught:
        read_everything(path)
    assert "reindex" not in str(caught.value)  # that would write metadata over those that may be saved


@pytest.mark.parametrize("in_folder", [False, True])
def test_messages_that_sqlite_has_not_merged_are_read(tmp_path: Path, in_folder: bool, caplog) -> None:
    path = write_bag(tmp_path / "drive", "sqlite3")
    (whole,) = path.glob("*.db3")
    live = tmp_path / "live"
    live.mkdir()
    database, source = sqlite3.connect(live / "live.db3"), sqlite3.connect(whole)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    statements = [line for line in source.iterdump() if not line.startswith(("BEGIN", "COMMIT"))]
    late = [line for line in statements if line.startswith('INSERT INTO "messages"')][6:]
    for line in (line for line in statements if line not in late):
        database.execute(line)
    database.commit()
    database.execute("PRAGMA wal_checkpoint(FULL)")
    for line in late:
        database.execute(line)
    database.commit()
    killed = tmp_path / "killed"
    killed.mkdir()
    for name in ("live.db3", "live.db3-wal"):
        (killed / name).write_bytes((live / name).read_bytes())
    source.close()
    database.close()
    before = {file.name: file.read_bytes() for file in killed.iterdir()}
    with bag.open_bag(killed if in_folder else killed / "live.db3") as reader:
        assert {name: topic.count for name, topic in reader.topics().items()} == {"/gnss": 6, "/velodyne_points": 6}
        assert len(list(reader.messages())) == 12
    assert "live.db3-wal is merged" in caplog.text
    assert {file.name: file.read_bytes() for file in killed.iterdir()} == before


def test_an_interrupted_writer_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), bag.BagWriter(tmp_path / "drive") as writer:
        writer.write("/gnss", bag.NAV_SAT_FIX, 1, messages.nav_sat_fix(1, "gnss", 52.0, 4.0, 43.0))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_bag_is_never_overwritten(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive")
    with pytest.raises(BagError, match="exists already"), bag.BagWriter(path):
        pass
    assert read_everything(path) == 12


def test_odometry_imu_and_pose_keep_their_numbers(tmp_path: Path) -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    with bag.BagWriter(tmp_path / "drive") as writer:
        odometry = messages.odometry(
            7, "odom", "base_link", [1, 2, 3], [0, 0, 0.6, 0.8], [4, 0, 0], [0, 0, 0.5], covariance
        )
        writer.write("/odom", bag.ODOMETRY, 7, odometry)
        writer.write("/imu", bag.IMU, 8, messages.imu(8, "imu", [0.1, 0.2, 0.3], [0, 0, 9.81]))
        writer.write("/pose", bag.POSE_STAMPED, 9, messages.pose_stamped(9, "map", [1, 2, 3], [0, 0, 0, 1]))
    with bag.open_bag(tmp_path / "drive") as reader:
        odom, imu, pose = (m.message for m in reader.messages())
    assert (odom.pose.pose.position.x, odom.pose.pose.orientation.w, odom.twist.twist.linear.x) == (1.0, 0.8, 4.0)
    assert odom.child_frame_id == "base_link"
    np.testing.assert_array_equal(odom.pose.covariance.reshape(6, 6), covariance)
    assert (imu.linear_acceleration.z, imu.angular_velocity.y) == (9.81, 0.2)
    assert imu.orientation_covariance[0] == -1.0  # REP-145: no orientation is given
    assert (pose.pose.position.z, pose.header.frame_id) == (3.0, "map")


FILL_THE_DISK = """
import resource, sys
import numpy as np
from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats import bag, messages
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
cloud = messages.velodyne_cloud(1, "velodyne", np.zeros((20_000, 3)), 1.0, 3, 0.0)
try:
    with bag.BagWriter(sys.argv[1], sys.argv[2]) as writer:
        for i in range(20):
            writer.write("/points", bag.POINT_CLOUD, i, cloud)
except BagError as error:
    print(error)
"""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path: Path, storage: bag.Storage) -> None:
    path = tmp_path / "drive"
    done = subprocess.run(
        [sys.executable, "-c", FILL_THE_DISK, str(path), storage], capture_output=True, text=True, timeout=120
    )
    assert done.stdout.startswith(f"cannot write {path}: "), done.stderr
    assert list(tmp_path.iterdir()) == []
