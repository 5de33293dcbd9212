"""The parts of the node, each by itself."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import types
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3

from crossloc3d_ros.cli import localizer as command
from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.config import LocalizerNodeConfig, MountingConfig, settings_of
from crossloc3d_ros.errors import CloudError, ConfigError
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.ros.conversions import matrix_from_transform, stamp_message
from crossloc3d_ros.ros.diagnostics import Outcome, Statistics, judge_health
from crossloc3d_ros.ros.shared_memory import PROFILES_VARIABLE, SEGMENT_BYTES, prepare_for_large_clouds
from crossloc3d_ros.ros.transforms import TransformSource
from crossloc3d_ros.ros.worker import Worker
from crossloc3d_ros.types import FixStatus

# The worker


@pytest.fixture
def gate() -> Iterator[threading.Event]:
    """Opened at the end, whatever happens, so that no worker stays behind."""
    event = threading.Event()
    yield event
    event.set()


class HeldWork:
    """Work that does not end before its gate is opened."""

    def __init__(self, gate: threading.Event) -> None:
        self.gate, self.begun = gate, threading.Event()
        self.done: list[int] = []

    def __call__(self, item: int) -> None:
        self.begun.set()
        self.gate.wait(10)
        self.done.append(item)

    def finish(self, count: int) -> None:
        """Open the gate and wait until so many items are done."""
        self.gate.set()
        deadline = time.monotonic() + 5
        while len(self.done) < count and time.monotonic() < deadline:
            time.sleep(0.005)


def test_only_the_newest_of_those_that_wait_is_worked_on(gate: threading.Event) -> None:
    work = HeldWork(gate)
    worker = Worker(work, "test")
    worker.start(lambda: None)
    assert worker.offer(0) == 0
    assert work.begun.wait(5)
    assert [worker.offer(i) for i in range(1, 6)] == [0, 1, 1, 1, 1]
    work.finish(2)
    assert worker.stop()
    assert work.done == [0, 5]


def test_a_few_may_wait_and_are_worked_on_in_their_order(gate: threading.Event) -> None:
    work = HeldWork(gate)
    worker = Worker(work, "test", queue_depth=3)
    worker.start(lambda: None)
    worker.offer(0)
    assert work.begun.wait(5)
    assert [worker.offer(i) for i in range(1, 4)] == [0, 0, 0]
    assert worker.offer(4) == 3, "more than may wait: the newest alone counts"
    assert [worker.offer(i) for i in (5, 6)] == [0, 0]
    work.finish(4)
    assert worker.discard() == 0
    assert worker.stop()
    assert work.done == [0, 4, 5, 6]


def test_preparation_runs_in_the_workers_thread_and_its_error_comes_back() -> None:
    threads = []
    worker = Worker(lambda item: threads.append(threading.current_thread().name), "localize")
    worker.start(lambda: threads.append(threading.current_thread().name))
    assert threads == ["localize"]
    assert worker.stop()

    def fail() -> None:
        raise ConfigError("no such thing")

    with pytest.raises(ConfigError, match="no such thing"):
        worker.start(fail)
    worker.start(lambda: None)
    assert worker.stop()


def test_a_worker_that_hangs_is_reported_and_does_not_come_back(gate: threading.Event) -> None:
    done: list[int] = []
    begun = threading.Event()

    def work(item: int) -> None:
        begun.set()
        if item == 0:
            gate.wait(10)
        done.append(item)

    worker = Worker(work, "test")
    worker.start(lambda: None)
    worker.offer(0)
    assert begun.wait(5)
    assert not worker.stop(timeout_s=0.05)
    worker.start(lambda: None)
    gate.set()
    worker.offer(1)
    deadline = time.monotonic() + 5
    while len(done) < 2 and time.monotonic() < deadline:
        time.sleep(0.005)
    assert worker.stop()
    assert sorted(done) == [0, 1]
    assert not [t for t in threading.enumerate() if t.name == "test"], "the one that hung has ended too"


# Shared memory


def test_the_profile_is_set_once_and_gives_shared_memory_and_udp(tmp_path: Path) -> None:
    environment = {"XDG_CACHE_HOME": str(tmp_path)}
    path = prepare_for_large_clouds(environment)
    assert path is not None
    assert environment[PROFILES_VARIABLE] == str(path)
    namespace = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"
    tree = ElementTree.parse(path)
    assert [e.text for e in tree.iter(f"{namespace}type")] == ["SHM", "UDPv4"]
    assert [int(e.text or 0) for e in tree.iter(f"{namespace}segment_size")] == [SEGMENT_BYTES]
    written = path.stat().st_mtime_ns
    del environment[PROFILES_VARIABLE]
    assert prepare_for_large_clouds(environment) == path
    assert path.stat().st_mtime_ns == written, "a file that is right is left alone"


@pytest.mark.parametrize(
    "own", [{PROFILES_VARIABLE: "/mine.xml"}, {"FASTDDS_DEFAULT_PROFILES_FILE": "/mine.xml"},
            {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}],
)  # fmt: skip
def test_what_the_user_has_chosen_is_left_alone(own: dict[str, str], tmp_path: Path) -> None:
    environment = {"XDG_CACHE_HOME": str(tmp_path), **own}
    before = dict(environment)
    assert prepare_for_large_clouds(environment) is None
    assert environment == before
    assert not list(tmp_path.iterdir())


def test_a_home_that_cannot_be_written_is_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    occupied = tmp_path / "file"
    occupied.write_text("")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    paths = [prepare_for_large_clouds({"XDG_CACHE_HOME": str(occupied)}) for _ in range(2)]
    assert paths[0] is not None
    assert paths[0].is_file()
    assert paths[0] == paths[1], "not a new folder for every process"


# Diagnostics


@pytest.mark.parametrize(
    ("publishers", "complaint", "level", "words"),
    [
        (0, "", DiagnosticStatus.WARN, "nobody publishes on /points"),
        (2, "", DiagnosticStatus.WARN, "(2 publishers)"),
        (1, "incompatible RELIABILITY", DiagnosticStatus.ERROR, "incompatible RELIABILITY"),
    ],
)
def test_silence_is_explained(
    monkeypatch: pytest.MonkeyPatch, publishers: int, complaint: str, level: bytes, words: str
) -> None:
    statistics = Statistics()
    now = time.monotonic()
    assert judge_health(statistics.snapshot(), "/points", publishers, complaint)[0] == DiagnosticStatus.OK
    monkeypatch.setattr("crossloc3d_ros.ros.diagnostics.time.monotonic", lambda: now + 60)
    told, message = judge_health(statistics.snapshot(), "/points", publishers, complaint)
    assert told == level
    assert words in message


@pytest.mark.parametrize(("lost", "level"), [(5, DiagnosticStatus.OK), (40, DiagnosticStatus.WARN)])
def test_clouds_that_get_lost_are_told_even_with_a_fix(lost: int, level: bytes) -> None:
    statistics = Statistics()
    estimate = replace(no_estimate(0, "9 of 25 candidates lie at one place"), status=FixStatus.FIX)
    for _ in range(60):
        statistics.received()
    statistics.processed(Outcome(estimate, is_fault=False), latency_ms=20.0)
    statistics.lost(lost)
    told, message = judge_health(statistics.snapshot(), "/points", 1, "")
    assert told == level
    assert (f"{lost} of {60 + lost} clouds on /points were lost" in message) == (level == DiagnosticStatus.WARN)


def test_latencies_are_those_of_the_last_scans() -> None:
    statistics = Statistics()
    for i in range(1000):
        statistics.received()
        statistics.processed(Outcome(no_estimate(i, "nothing"), is_fault=i % 2 == 0), latency_ms=float(i))
    snapshot = statistics.snapshot()
    assert (snapshot.received, snapshot.processed, snapshot.faults, snapshot.fixes) == (1000, 1000, 500, 0)
    assert (snapshot.latency_median_ms, snapshot.latency_max_ms) == (849.5, 999.0)


# Conversions and TF


def test_a_stamp_keeps_every_nanosecond() -> None:
    stamp = stamp_message(1_700_000_000_123_456_789)
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 123_456_789)


def test_a_transform_is_the_mounting_that_it_says() -> None:
    mounting = MountingConfig(x_m=0.3, y_m=-0.2, z_m=1.4, yaw_deg=90.0)
    half = np.sqrt(0.5)
    transform = Transform(translation=Vector3(x=0.3, y=-0.2, z=1.4), rotation=Quaternion(x=0.0, y=0.0, z=half, w=half))
    np.testing.assert_allclose(matrix_from_transform(transform), mounting_matrix(mounting), atol=1e-12)


class FakeTf2(types.ModuleType):
    """The part of tf2_ros that is used, which is not in the package index."""

    class TransformException(Exception):  # noqa: N818 - tf2's own name
        pass

    class Buffer:
        def lookup_transform(self, target: str, source: str, when: object) -> TransformStamped:
            if (target, source) != ("base_link", "velodyne"):
                raise FakeTf2.TransformException(f'"{source}" passed to lookupTransform does not exist')
            stamped = TransformStamped()
            stamped.transform.translation.z = 1.7
            return stamped

    class TransformListener:
        def __init__(self, buffer: object, node: object, *, spin_thread: bool) -> None:
            assert not spin_thread, "the node's executor does the spinning"

        def unregister(self) -> None:
            pass


def test_the_mounting_comes_from_tf_or_is_missed_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", FakeTf2("tf2_ros"))
    source = TransformSource(node=None, base_frame_id="base_link")
    np.testing.assert_allclose(source.pose_on_base("velodyne")[:3, 3], [0, 0, 1.7])
    with pytest.raises(CloudError, match="TF knows no pose of 'lidar' on 'base_link'"):
        source.pose_on_base("lidar")
    source.close()


# The command


def test_help_names_every_parameter(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--help"]) == 0
    text = capsys.readouterr().out
    for setting in settings_of(LocalizerNodeConfig):
        assert f"  {setting.name} " in text


def test_without_ros_the_command_says_how_to_get_it() -> None:
    code = "import sys; sys.modules['rclpy'] = None; from crossloc3d_ros.cli.localizer import main; sys.exit(main([]))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=os.environ)
    assert result.returncode == 2
    assert "source /opt/ros/jazzy/setup.bash" in result.stderr
    assert "Traceback" not in result.stderr


def test_an_argument_that_is_no_ros_argument_is_refused(ros_environment: dict[str, str]) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "crossloc3d_ros.cli.localizer", "--map", "maps/amsterdam"],
        capture_output=True, text=True, timeout=240, env=ros_environment,
    )  # fmt: skip
    assert result.returncode == 2
    assert "unknown argument '--map'" in result.stderr
