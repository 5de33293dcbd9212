"""The real localizer node as a process of its own, a recording played into it over DDS, and what it answers."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import NavSatFix, NavSatStatus, PointCloud2
from visualization_msgs.msg import MarkerArray

from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.evaluation.estimates import EstimateWriter
from crossloc3d_ros.formats.bag import BagReader, RawMessage
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.ros.player import Player, PlayerConfig, PlayReport
from crossloc3d_ros.ros.shared_memory import prepare_for_large_clouds
from crossloc3d_ros.types import Candidates, Estimate, FixStatus, Float64Array, ScanCounts

log = logging.getLogger(__name__)

NODE_NAME = "localizer"
_QUIET_S = 3.0
"""The node has answered everything that it will when so long nothing has come."""
_STOP_S = 15.0
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class Answer(NamedTuple):
    """What the node said to one scan."""

    fix: NavSatFix
    arrived_ns: int
    """Monotonic clock."""


@dataclass(frozen=True)
class LiveReport:
    """How a live run went."""

    play: PlayReport
    scans: int
    answers: int
    startup_s: float
    """From starting the process to its subscription: loading, compiling, warming up."""


class Recorder:
    """Collect a localizer's answers by the stamp of the scan that they answer; the callbacks run in another thread."""

    def __init__(self, node: Node, localizer: str = NODE_NAME) -> None:
        """Subscribe to the outputs of the node `localizer`."""
        self.answers: dict[int, Answer] = {}
        self.tables: dict[int, PointCloud2] = {}
        self.reasons: dict[int, str] = {}
        self.heard_at = time.monotonic()
        node.create_subscription(NavSatFix, f"/{localizer}/fix", self._on_fix, 100)
        node.create_subscription(PointCloud2, f"/{localizer}/candidate_table", self._on_table, 100)
        node.create_subscription(MarkerArray, f"/{localizer}/markers", self._on_markers, 100)

    def _on_fix(self, message: NavSatFix) -> None:
        arrived_ns = time.monotonic_ns()
        self.answers[_stamp_ns(message)] = Answer(message, arrived_ns)
        self.heard_at = time.monotonic()

    def _on_table(self, message: PointCloud2) -> None:
        self.tables[_stamp_ns(message)] = message
        self.heard_at = time.monotonic()

    def _on_markers(self, message: MarkerArray) -> None:
        for marker in message.markers:
            if marker.ns == "reason":
                self.reasons[_stamp_ns(marker)] = marker.text

    def estimate(self, stamp_ns: int, frame: MapFrame) -> Estimate:
        """Return what the node said to the scan of that stamp."""
        answer = self.answers.get(stamp_ns)
        if answer is None:
            return no_estimate(stamp_ns, "the node gave no answer: the scan was dropped or lost")
        fix = answer.fix
        is_fix = fix.status.status >= NavSatStatus.STATUS_FIX
        reason = self.reasons.get(stamp_ns, "" if is_fix else "no candidate")
        candidates = _candidates(self.tables.get(stamp_ns), frame)
        nothing = no_estimate(stamp_ns, reason)
        if not is_fix:
            return replace(nothing, candidates=candidates)
        grid = frame.from_geographic(*(np.array([float(v)]) for v in (fix.latitude, fix.longitude, fix.altitude)))[0]
        return Estimate(
            stamp_ns=stamp_ns,
            status=FixStatus.FIX,
            reason=reason,
            grid=grid,
            enu=np.full(3, np.nan),
            latitude_deg=float(fix.latitude),
            longitude_deg=float(fix.longitude),
            altitude_m=float(fix.altitude),
            covariance=np.array(fix.position_covariance, dtype=np.float64).reshape(3, 3),
            candidates=candidates,
            counts=ScanCounts(),
        )


def localize_live(
    bag: BagReader,
    topic: str,
    map_folder: Path,
    frame: MapFrame,
    output: Path,
    *,
    parameters: Mapping[str, str] | None = None,
    log_path: Path | None = None,
    startup_s: float = 300.0,
    domain: int | None = None,
    on_started: Callable[[float], None] = lambda _: None,
    progress: Callable[[int, int, Estimate | None], None] = lambda done, total, newest: None,
) -> LiveReport:
    """Start the localizer, play the bag into it, write its answers to the CSV file `output`.

    `topic` holds the clouds; `frame` is the map's; `parameters` are the node's, besides `map`; what the node logs
    goes to `log_path`. A DDS domain of its own, confined to this machine, keeps other nodes out. `on_started` is
    called with the seconds that the start took, `progress` with scans played, scans in all and the newest answer.
    Raises CrossLocError, with the end of the node's log, if it does not come up.
    """
    domain = 1 + os.getpid() % 100 if domain is None else domain
    published: dict[int, int] = {}
    total = bag.topics()[topic].count
    with (
        _environment({"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}),
        _localizer_process(topic, map_folder, parameters or {}, log_path) as process,
        _node(domain) as (node, recorder),
    ):
        begun = time.monotonic()
        player = Player(bag, node, PlayerConfig(wait_s=startup_s))
        player.wait_for_subscribers(process.check)
        took_s = time.monotonic() - begun
        on_started(took_s)

        def on_published(message: RawMessage, published_ns: int) -> None:
            if message.topic == topic:
                published[header_stamp_ns(message.cdr)] = published_ns
                process.check()
                newest = max(recorder.answers, default=None)
                progress(len(published), total, None if newest is None else recorder.estimate(newest, frame))

        play = player.play(on_published)
        while len(recorder.answers) < len(published) and time.monotonic() - recorder.heard_at < _QUIET_S:
            time.sleep(0.05)
        time.sleep(0.2)  # the table of the last scan comes after its fix
    with EstimateWriter(output) as writer:
        for stamp_ns, published_ns in sorted(published.items()):
            answer = recorder.answers.get(stamp_ns)
            latency_ms = float("nan") if answer is None else (answer.arrived_ns - published_ns) / 1e6
            writer.write(recorder.estimate(stamp_ns, frame), latency_ms)
    return LiveReport(play, len(published), len(set(published) & set(recorder.answers)), took_s)


def header_stamp_ns(cdr: bytes) -> int:
    """Return the stamp of a serialised message that begins with a Header."""
    order = "little" if cdr[1] & 1 else "big"
    seconds = int.from_bytes(cdr[4:8], order, signed=True)  # type: ignore[arg-type]
    return seconds * 1_000_000_000 + int.from_bytes(cdr[8:12], order)  # type: ignore[arg-type]


class _Process:
    """The localizer as a child process."""

    def __init__(self, command: Sequence[str], log_path: Path | None) -> None:
        self._log_path = log_path
        self._log = subprocess.DEVNULL if log_path is None else log_path.open("wb")
        # A session of its own: Ctrl-C at the terminal reaches us alone, and we stop the node in order.
        self._child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=self._log, stderr=subprocess.STDOUT, start_new_session=True
        )

    def check(self) -> None:
        """Raise CrossLocError if the node has ended."""
        code = self._child.poll()
        if code is not None:
            raise CrossLocError(f"the localizer ended with code {code}: {self._last_words()}")

    def stop(self) -> None:
        """End the node as Ctrl-C would, by force if it does not listen."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if self._child.poll() is not None:
                break
            self._child.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                self._child.wait(_STOP_S)
        if not isinstance(self._log, int):
            self._log.close()

    def _last_words(self) -> str:
        if self._log_path is None:
            return "no log was kept"
        lines = self._log_path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f"{' | '.join(lines[-3:]) or 'it said nothing'} (all of it in {self._log_path})"


@contextmanager
def _localizer_process(
    topic: str, map_folder: Path, parameters: Mapping[str, str], log_path: Path | None
) -> Iterator[_Process]:
    settings = {"map": str(map_folder.resolve()), **parameters}
    pairs = [part for name, value in settings.items() for part in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", "crossloc3d_ros.cli.localizer", "--ros-args", "-r", f"points:={topic}", *pairs]
    process = _Process(command, log_path)
    try:
        yield process
    finally:
        process.stop()


@contextmanager
def _node(domain: int) -> Iterator[tuple[Node, Recorder]]:
    """Give a node whose callbacks run in a thread, and the recorder in it."""
    prepare_for_large_clouds()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = Node("crossloc3d_live", context=context, start_parameter_services=False, enable_rosout=False)
    recorder = Recorder(node)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin() -> None:
        with suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, name="record", daemon=True)
    thread.start()
    try:
        yield node, recorder
    finally:
        # In this order: a thread that still spins when the context goes aborts the process.
        executor.shutdown()
        thread.join(_STOP_S)
        node.destroy_node()
        rclpy.shutdown(context=context)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def _candidates(table: PointCloud2 | None, frame: MapFrame) -> Candidates:
    if table is None or table.width == 0:
        return no_estimate(0, "").candidates
    dtype = np.dtype(
        {
            "names": [field.name for field in table.fields],
            "formats": [_FIELD_TYPES[field.datatype] for field in table.fields],
            "offsets": [field.offset for field in table.fields],
            "itemsize": table.point_step,
        }
    )
    rows = np.frombuffer(bytes(table.data), dtype=dtype)
    grid: Float64Array = frame.from_geographic(rows["latitude"], rows["longitude"])
    return Candidates(
        submap_ids=rows["submap_id"].astype(np.int64),
        descriptor_distances=rows["descriptor_distance"].astype(np.float32),
        probabilities=rows["probability"].astype(np.float64),
        grid=grid,
    )
