"""The real localizer node as a process of its own: a recording is played into it over DDS, its estimates are kept."""

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
import numpy.typing as npt
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import NavSatFix, NavSatStatus, PointCloud2

from crossloc3d_ros.config import PlayerConfig
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.evaluation.drives.estimates import EstimateWriter
from crossloc3d_ros.formats.bag import BagReader, RawMessage
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.formats.pointcloud2 import POINT_FIELD_TYPES
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.ros.conversions import in_grid
from crossloc3d_ros.ros.player import Player, PlayReport
from crossloc3d_ros.ros.shared_memory import prepare_for_large_clouds
from crossloc3d_ros.types import (
    AlignedPoses,
    Candidates,
    Estimate,
    FixStatus,
    Float64Array,
    Hypotheses,
    TrackState,
    no_aligned_poses,
    no_hypotheses,
)

log = logging.getLogger(__name__)

NODE_NAME = "localizer"
PROGRAM = ("-m", "crossloc3d_ros.cli.localizer")
_QUIET_S = 3.0
"""After so long without a message no further estimate is expected."""
_STOP_S = 15.0


class ReceivedFix(NamedTuple):
    """The fix of one scan."""

    fix: NavSatFix
    arrived_ns: int
    """Monotonic clock."""


@dataclass(frozen=True)
class LiveReport:
    """How a live run went."""

    play: PlayReport
    scans: int
    estimates: int
    """Scans whose estimate was received."""
    startup_s: float
    """From starting the process to its subscription: loading, compiling, warming up."""


class Recorder:
    """Collect a localizer's outputs by the stamp of their scan; the callbacks run in another thread."""

    def __init__(self, node: Node, localizer: str = NODE_NAME) -> None:
        """Subscribe to the outputs of the node `localizer`."""
        self.fixes: dict[int, ReceivedFix] = {}
        self.poses: dict[int, PoseWithCovarianceStamped] = {}
        self.tables: dict[int, PointCloud2] = {}
        self.hypotheses: dict[int, PoseArray] = {}
        self.states: dict[int, DiagnosticStatus] = {}
        self.received_at = time.monotonic()
        node.create_subscription(NavSatFix, f"/{localizer}/fix", self._on_fix, 100)
        for kind, topic, kept in (
            (PoseWithCovarianceStamped, "pose", self.poses),
            (PointCloud2, "candidate_table", self.tables),
            (PoseArray, "hypotheses", self.hypotheses),
        ):
            node.create_subscription(kind, f"/{localizer}/{topic}", self._keeper(kept), 100)
        node.create_subscription(DiagnosticStatus, f"/{localizer}/state", self._on_state, 100)

    def _on_fix(self, message: NavSatFix) -> None:
        arrived_ns = time.monotonic_ns()
        self.fixes[_stamp_ns(message)] = ReceivedFix(message, arrived_ns)
        self.received_at = time.monotonic()

    def _keeper(self, kept: dict[int, Any]) -> Callable[[Any], None]:
        def keep(message: Any) -> None:
            kept[_stamp_ns(message)] = message
            self.received_at = time.monotonic()

        return keep

    def _on_state(self, message: DiagnosticStatus) -> None:
        stamp = _values(message).get("stamp_ns")
        if stamp is not None:  # a state that is stale belongs to no scan
            self.states[int(stamp)] = message

    def estimate(self, stamp_ns: int, frame: MapFrame) -> Estimate:
        """Return the node's estimate of the scan of that stamp."""
        received = self.fixes.get(stamp_ns)
        if received is None:
            return no_estimate(stamp_ns, "the node published no estimate: the scan was dropped or lost")
        fix = received.fix
        is_fix = fix.status.status >= NavSatStatus.STATUS_FIX
        state, reason, probability = _state(self.states.get(stamp_ns))
        table = self.tables.get(stamp_ns)
        known = replace(
            no_estimate(stamp_ns, reason),
            state=state,
            probability=probability,
            candidates=_candidates(table, frame),
            aligned=_aligned(table, frame),
            hypotheses=_hypotheses(self.hypotheses.get(stamp_ns), self.states.get(stamp_ns), frame),
        )
        if not is_fix:
            return known
        grid = frame.from_geographic(*(np.array([float(v)]) for v in (fix.latitude, fix.longitude, fix.altitude)))[0]
        known = replace(
            known,
            status=FixStatus.FIX,
            grid=grid,
            latitude_deg=float(fix.latitude),
            longitude_deg=float(fix.longitude),
            altitude_m=float(fix.altitude),
            covariance=np.array(fix.position_covariance, dtype=np.float64).reshape(3, 3),
        )
        pose = self.poses.get(stamp_ns)
        if pose is None:
            return known
        T_map_base = pose_matrix(pose.pose.pose)
        covariance = np.array(pose.pose.covariance, dtype=np.float64).reshape(6, 6)
        return replace(known, enu=T_map_base[:3, 3], T_map_base=T_map_base, pose_covariance=covariance)

    def write(self, path: Path, published: Mapping[int, int], frame: MapFrame) -> None:
        """Write the estimates of the scans {stamp: when published, ns} and their latencies to a CSV file."""
        with EstimateWriter(path) as writer:
            for stamp_ns, published_ns in sorted(published.items()):
                received = self.fixes.get(stamp_ns)
                latency_ms = float("nan") if received is None else (received.arrived_ns - published_ns) / 1e6
                writer.write(self.estimate(stamp_ns, frame), latency_ms)


def localize_live(
    bag: BagReader,
    topic: str,
    map_folder: Path,
    frame: MapFrame,
    output: Path,
    *,
    odometry_topic: str | None = None,
    parameters: Mapping[str, str] | None = None,
    program: Sequence[str] = PROGRAM,
    log_path: Path | None = None,
    startup_s: float = 300.0,
    domain: int | None = None,
    on_started: Callable[[float], None] = lambda _: None,
    progress: Callable[[int, int, Estimate | None], None] = lambda done, total, newest: None,
) -> LiveReport:
    """Start the localizer, play the bag into it, write its estimates to the CSV file `output`.

    `topic` holds the clouds, `odometry_topic` the odometry, by default what `odom` is; `frame` is the map's;
    `parameters` are the node's, besides `map`; `program` is what Python runs; what the node logs goes to `log_path`.
    A DDS domain of its own, confined to this machine, keeps other nodes out. `on_started` is called with the seconds
    that the start took, `progress` with scans played, scans in all and the newest estimate. Raises CrossLocError, with
    the end of the node's log, if it does not come up.
    """
    domain = 1 + os.getpid() % 100 if domain is None else domain
    published: dict[int, int] = {}
    total = bag.topics()[topic].count
    with (
        _environment({"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}),
        _localizer_process(_command(program, topic, odometry_topic, map_folder, parameters or {}), log_path) as process,
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
                newest = max(recorder.fixes, default=None)
                progress(len(published), total, None if newest is None else recorder.estimate(newest, frame))

        play = player.play(on_published)
        while len(recorder.fixes) < len(published) and time.monotonic() - recorder.received_at < _QUIET_S:
            time.sleep(0.05)
        time.sleep(0.2)  # the table of the last scan comes after its fix
    recorder.write(output, published, frame)
    return LiveReport(play, len(published), len(set(published) & set(recorder.fixes)), took_s)


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
            raise CrossLocError(f"the localizer ended with code {code}: {self._end_of_log()}")

    def stop(self) -> None:
        """End the node as Ctrl-C would, by force if it does not end."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if self._child.poll() is not None:
                break
            self._child.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                self._child.wait(_STOP_S)
        if not isinstance(self._log, int):
            self._log.close()

    def _end_of_log(self) -> str:
        if self._log_path is None:
            return "no log was kept"
        lines = self._log_path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f"{' | '.join(lines[-3:]) or 'its log is empty'} (all of it in {self._log_path})"


def _command(
    program: Sequence[str], topic: str, odometry_topic: str | None, map_folder: Path, parameters: Mapping[str, str]
) -> list[str]:
    settings = {"map": str(map_folder.resolve()), **parameters}
    pairs = [part for name, value in settings.items() for part in ("-p", f"{name}:={value}")]
    remaps = ["-r", f"points:={topic}"] + ([] if odometry_topic is None else ["-r", f"odom:={odometry_topic}"])
    return [sys.executable, *program, "--ros-args", *remaps, *pairs]


@contextmanager
def _localizer_process(command: Sequence[str], log_path: Path | None) -> Iterator[_Process]:
    process = _Process(command, log_path)
    try:
        yield process
    finally:
        process.stop()


@contextmanager
def _node(domain: int) -> Iterator[tuple[Node, Recorder]]:
    """Yield a node whose callbacks run in a thread, and the recorder in it."""
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


def _values(message: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in message.values}


def _state(message: DiagnosticStatus | None) -> tuple[TrackState, str, float]:
    """Return state, reason and probability."""
    if message is None:
        return TrackState.SEARCHING, "", float("nan")
    values = _values(message)
    state = TrackState(values["state"])
    return state, message.message.removeprefix(f"{state.value}: "), float(values["probability"])


def _rows(table: PointCloud2 | None) -> npt.NDArray[Any]:
    """Return the rows of a table as a structured array."""
    if table is None or table.width == 0:
        return np.empty(0, [(name, "f8") for name in ("latitude", "longitude", "aligned_yaw")])
    dtype = np.dtype(
        {
            "names": [field.name for field in table.fields],
            "formats": [POINT_FIELD_TYPES[field.datatype] for field in table.fields],
            "offsets": [field.offset for field in table.fields],
            "itemsize": table.point_step,
        }
    )
    return np.frombuffer(bytes(table.data), dtype=dtype)


def _candidates(table: PointCloud2 | None, frame: MapFrame) -> Candidates:
    rows = _rows(table)
    if len(rows) == 0:
        return no_estimate(0, "").candidates
    grid: Float64Array = frame.from_geographic(rows["latitude"], rows["longitude"])
    return Candidates(
        submap_ids=rows["submap_id"].astype(np.int64),
        descriptor_distances=rows["descriptor_distance"].astype(np.float32),
        probabilities=rows["probability"].astype(np.float64),
        grid=grid,
    )


def _aligned(table: PointCloud2 | None, frame: MapFrame) -> AlignedPoses:
    """Return the aligned poses that the table of candidates holds, likeliest first; what it does not hold is NaN."""
    rows = _rows(table)
    sources = np.flatnonzero(np.isfinite(rows["aligned_yaw"]))
    if len(sources) == 0:
        return no_aligned_poses()
    sources = sources[np.argsort(-rows["aligned_probability"][sources], kind="stable")]
    rows = rows[sources]
    n = len(rows)
    enu = np.column_stack([rows["aligned_x"], rows["aligned_y"], rows["z"]]).astype(np.float64)
    grid, heading = in_grid(frame, enu, rows["aligned_yaw"].astype(np.float64))
    unknown = np.full(n, np.nan)
    return AlignedPoses(
        grid=grid,
        heading_rad=heading,
        covariance=np.full((n, 3, 3), np.nan),
        log_likelihood=unknown,
        probabilities=rows["aligned_probability"].astype(np.float64),
        inliers=unknown,
        converged=np.ones(n, np.bool_),
        source=sources.astype(np.int64),
    )


def _hypotheses(message: PoseArray | None, state: DiagnosticStatus | None, frame: MapFrame) -> Hypotheses:
    """Return the hypotheses; what the messages do not hold is NaN."""
    if message is None or state is None or not message.poses:
        return no_hypotheses()
    probabilities = np.array(_values(state)["hypotheses"].split(), dtype=np.float64)
    T = np.stack([pose_matrix(pose) for pose in message.poses])
    if len(probabilities) != len(T):
        return no_hypotheses()
    grid, heading = in_grid(frame, T[:, :3, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    return Hypotheses(grid, heading, np.full((len(T), 3, 3), np.nan), probabilities)
