"""The parts of the node, each by itself."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import types
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from crossloc3d_ros.localization.session import Outcome
from crossloc3d_ros.ros.conversions import matrix_from_transform, stamp_message
from crossloc3d_ros.ros.diagnostics import Statistics, health_status, worker_complaint
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

    def on(self, item: int) -> Callable[[], None]:
        """Return the task of working on `item`."""

        def work() -> None:
            self.begun.set()
            self.gate.wait(10)
            self.done.append(item)

        return work

    def finish(self, count: int) -> None:
        """Open the gate and wait until so many items are done."""
        self.gate.set()
        wait_until(lambda: len(self.done) >= count)


def wait_until(condition: Callable[[], bool], timeout_s: float = 5.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)
    assert condition()


def started(queue_depth: int = 1) -> Worker:
    worker = Worker("test", queue_depth)
    worker.start(lambda: None)
    return worker


def test_only_the_newest_of_those_that_wait_is_worked_on(gate: threading.Event) -> None:
    work, worker = HeldWork(gate), started()
    assert worker.offer(work.on(0)) == 0
    assert work.begun.wait(5)
    assert [worker.offer(work.on(i)) for i in range(1, 6)] == [0, 1, 1, 1, 1]
    work.finish(2)
    assert worker.stop()
    assert work.done == [0, 5]


def test_a_few_may_wait_and_are_worked_on_in_their_order(gate: threading.Event) -> None:
    work, worker = HeldWork(gate), started(queue_depth=3)
    worker.offer(work.on(0))
    assert work.begun.wait(5)
    assert [worker.offer(work.on(i)) for i in range(1, 4)] == [0, 0, 0]
    assert worker.offer(work.on(4)) == 3, "more than may wait: the newest alone counts"
    assert [worker.offer(work.on(i)) for i in (5, 6)] == [0, 0]
    work.finish(4)
    assert worker.drop_scans() == 0
    assert worker.stop()
    assert work.done == [0, 4, 5, 6]


def test_commands_keep_their_place_between_scans_and_are_not_dropped_with_them(gate: threading.Event) -> None:
    work, worker = HeldWork(gate), started(queue_depth=2)
    worker.offer(work.on(0))
    assert work.begun.wait(5)
    worker.offer(work.on(1))
    worker.post(work.on(100))
    worker.offer(work.on(2))
    worker.post(work.on(101))
    assert worker.offer(work.on(3)) == 2, "the scans that waited; no command"
    assert worker.drop_scans() == 1
    worker.offer(work.on(4))
    work.finish(4)
    assert worker.stop()
    assert work.done == [0, 100, 101, 4]


def test_a_worker_that_hangs_keeps_no_more_than_it_can_use(gate: threading.Event, monkeypatch: Any) -> None:
    monkeypatch.setattr("crossloc3d_ros.ros.worker.MAX_WAITING", 50)
    work, worker = HeldWork(gate), started()
    worker.offer(work.on(-1))
    assert work.begun.wait(5)
    for i in range(200):
        worker.post(work.on(i), is_sample=True)
    worker.post(work.on(1000))
    for i in range(200, 300):
        worker.post(work.on(i), is_sample=True)
    work.finish(52)
    assert worker.stop()
    assert work.done == [-1, 1000, *range(250, 300)], "the newest samples, and every command"


def test_preparation_runs_in_the_workers_thread_and_its_error_comes_back() -> None:
    threads: list[str] = []
    worker = Worker("localize")
    worker.start(lambda: threads.append(threading.current_thread().name))
    assert threads == ["localize"]
    assert worker.stop()

    def fail() -> None:
        raise ConfigError("no such thing")

    with pytest.raises(ConfigError, match="no such thing"):
        worker.start(fail)
    worker.start(lambda: None)
    assert worker.stop()


def test_a_worker_that_hangs_is_reported_and_never_works_beside_another(gate: threading.Event) -> None:
    work, worker = HeldWork(gate), started()
    assert worker_complaint(worker.health(), 0.01) == ""
    worker.offer(work.on(0))
    assert work.begun.wait(5)
    time.sleep(0.05)
    assert worker.health().busy_s > 0.01
    assert "does not end" in worker_complaint(worker.health(), 0.01)
    assert worker_complaint(worker.health(), 60.0) == ""
    assert not worker.stop(timeout_s=0.05)
    assert not worker.stop(timeout_s=0.0), "and so at every further call"
    with pytest.raises(ConfigError, match="does not end: clean the node up"):
        worker.start(lambda: None)
    work.finish(1)
    wait_until(lambda: not [thread for thread in threading.enumerate() if thread.name == "test"])
    worker.start(lambda: None)
    assert worker.health().busy_s == 0.0
    assert worker.stop()


def test_a_task_that_fails_costs_itself_alone(gate: threading.Event) -> None:
    def fail() -> None:
        raise RuntimeError("a fault")

    work, worker = HeldWork(gate), started()
    worker.post(fail)
    worker.offer(work.on(1))
    work.finish(1)
    assert worker.health().is_alive
    assert worker.stop()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_worker_whose_thread_ends_says_why() -> None:
    def end() -> None:
        raise SystemExit("on purpose")

    worker = started()
    worker.post(end)
    wait_until(lambda: not worker.health().is_alive)
    assert "the thread that localizes has ended (SystemExit: on purpose)" in worker_complaint(worker.health(), 60.0)
    assert worker.stop()


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
        (0, "", DiagnosticStatus.WARN, "no publisher on /points"),
        (2, "", DiagnosticStatus.WARN, "(2 publishers)"),
        (1, "incompatible RELIABILITY", DiagnosticStatus.ERROR, "incompatible RELIABILITY"),
    ],
)
def test_silence_is_explained(
    monkeypatch: pytest.MonkeyPatch, publishers: int, complaint: str, level: bytes, words: str
) -> None:
    statistics = Statistics()
    now = time.monotonic()
    assert health_status(statistics.snapshot(), "/points", publishers, complaint)[0] == DiagnosticStatus.OK
    monkeypatch.setattr("crossloc3d_ros.ros.diagnostics.time.monotonic", lambda: now + 60)
    found, message = health_status(statistics.snapshot(), "/points", publishers, complaint)
    assert found == level
    assert words in message


@pytest.mark.parametrize(("lost", "level"), [(5, DiagnosticStatus.OK), (40, DiagnosticStatus.WARN)])
def test_clouds_that_get_lost_are_reported_even_with_a_fix(lost: int, level: bytes) -> None:
    statistics = Statistics()
    estimate = replace(no_estimate(0, "9 of 25 candidates lie at one place"), status=FixStatus.FIX)
    for _ in range(60):
        statistics.received()
    statistics.processed(Outcome(estimate, is_fault=False), latency_ms=20.0)
    statistics.lost(lost)
    found, message = health_status(statistics.snapshot(), "/points", 1, "")
    assert found == level
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


def test_a_transform_is_the_mounting_that_it_holds() -> None:
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
    with pytest.raises(CloudError, match="TF has no pose of 'lidar' on 'base_link'"):
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
