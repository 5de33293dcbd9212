"""A localizer as a process of its own, a robot that talks to it over DDS, and the small map that both know."""

from __future__ import annotations

import functools
import itertools
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

# Read when the messages are imported: an int in a float64 field is an error then, not garbage.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Imu, NavSatFix, PointCloud2, PointField
from visualization_msgs.msg import MarkerArray

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.aerial_map.geotiff import write_geotiff
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import BuildConfig, LocalizerConfig, ModelConfig, PreprocessingConfig
from crossloc3d_ros.encoder.checkpoint import load_encoder, save_checkpoint
from crossloc3d_ros.encoder.model import CrossLoc3D
from crossloc3d_ros.formats.pointcloud2 import pack_columns
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.ros.conversions import header_message
from crossloc3d_ros.ros.shared_memory import prepare_for_large_clouds
from crossloc3d_ros.types import Scan

Array = npt.NDArray[np.floating[Any]]

CRS = "EPSG:32631"
ORIGIN = (628_500.0, 5_804_000.0, 2.0)
PLACES = 30
STAMPS_NS = itertools.count(1_700_000_000_000_000_000, 100_000_000)
SMALL_MODEL = ModelConfig(
    voxel_sizes=(0.1, 0.4), channels=32, fused_channels=64, clusters=32, descriptor_size=32, sub_steps=1,
    memory_sizes=(32, 32),
)  # fmt: skip
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
FIRST_ANSWER_S = 240.0
"""What a node may need until its first output: on a busy machine numba compiles for minutes when it first runs."""


def points_of_place(seed: int, points: int = 14_400) -> npt.NDArray[np.float32]:
    """A level street and a few walls around the sensor, 1.2 m above the ground; the place is the seed."""
    rng = np.random.default_rng(seed)
    n = points // 12
    floor = np.column_stack([rng.uniform(-40, 40, (6 * n, 2)), rng.normal(-1.2, 0.01, 6 * n)])
    walls = []
    for _ in range(6):
        direction, far = rng.uniform(0, 2 * np.pi), rng.uniform(8, 35)
        along, height, run = rng.uniform(0, np.pi), rng.uniform(2, 15), rng.uniform(-6, 6, n)
        x, y = far * np.cos(direction) + run * np.cos(along), far * np.sin(direction) + run * np.sin(along)
        walls.append(np.column_stack([x, y, rng.uniform(-1.2, height - 1.2, n)]))
    return np.vstack([floor, *walls]).astype(np.float32)


def cloud_message(points: Array, stamp_ns: int, frame_id: str = "velodyne") -> PointCloud2:
    """The points as a VLP-16 driver sends them."""
    points = np.asarray(points, dtype=np.float32)
    packed = pack_columns(
        {
            "x": points[:, 0], "y": points[:, 1], "z": points[:, 2], "intensity": np.ones(len(points), np.float32),
            "ring": np.zeros(len(points), np.uint16), "time": np.zeros(len(points), np.float32),
        }
    )  # fmt: skip
    return PointCloud2(
        header=header_message(stamp_ns, frame_id), height=1, width=len(points),
        fields=[PointField(name=n, offset=o, datatype=d, count=c) for n, o, d, c in packed.fields],
        is_bigendian=False, point_step=packed.point_step, row_step=packed.point_step * len(points),
        data=packed.data, is_dense=False,
    )  # fmt: skip


@dataclass(frozen=True)
class World:
    """A map whose submaps are the very scans of its places, so that weights without training find them again."""

    map_path: Path
    weights_path: Path
    other_weights_path: Path
    null_distance: float
    """Half of what lies between the two places that are most similar."""

    def parameters(self) -> dict[str, object]:
        return {
            "map": str(self.map_path),
            "weights": str(self.weights_path),
            "threads": 1,
            "retrieval.null_distance": self.null_distance,
            "retrieval.null_scale": self.null_distance / 20,
            "retrieval.temperature": self.null_distance / 10,
        }

    @staticmethod
    def points(place: int) -> npt.NDArray[np.float32]:
        return points_of_place(place)

    @staticmethod
    def grid(place: int) -> tuple[float, float, float]:
        return ORIGIN[0] + 120.0 * (place % 6), ORIGIN[1] + 120.0 * (place // 6), ORIGIN[2] + 0.5 * place

    @staticmethod
    def latitude_longitude(place: int) -> tuple[float, float]:
        latitude, longitude, _ = MapFrame(CRS, np.array(ORIGIN)).to_geographic(np.array([World.grid(place)]))
        return float(latitude[0]), float(longitude[0])


def bare_ground(part: tuple[float, float, float, float]) -> npt.NDArray[np.float32]:
    """Heights (H, W) of cells of a metre, row 0 in the north: around each place that of the place."""
    east, north = np.arange(part[0], part[2]) + 0.5, np.arange(part[3], part[1], -1.0) - 0.5
    column, row = (east - ORIGIN[0] + 60.0) // 120.0, (north - ORIGIN[1] + 60.0) // 120.0
    return np.asarray(ORIGIN[2] + 0.5 * (6 * row[:, None] + column[None]), dtype=np.float32)


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    import torch

    folder = tmp_path_factory.mktemp("world")
    preprocessing = PreprocessingConfig(n_points=1024)
    for seed, name in ((1, "weights"), (2, "other")):
        torch.manual_seed(seed)
        save_checkpoint(folder / f"{name}.safetensors", CrossLoc3D(SMALL_MODEL), preprocessing, dtype="float32")
    encoder = load_encoder(folder / "weights.safetensors", threads=1)
    patches = []
    for place in range(PLACES):
        scan = Scan(points_of_place(place), 0, "velodyne")
        patch = prepare_scan(scan, LocalizerConfig().scan, preprocessing).patch
        assert patch is not None
        patches.append(patch.points)
    descriptors = np.concatenate([encoder.encode_batch([patch]) for patch in patches])
    gaps = np.linalg.norm(descriptors[:, None] - descriptors[None], axis=-1)
    null_distance = 0.5 * float(gaps[np.triu_indices(PLACES, 1)].min())
    assert null_distance > 1e-4, "weights without training must separate these places"

    map_path = folder / "map"
    map_path.mkdir()
    DescriptorMap(descriptors).save(map_path / store.DESCRIPTORS)
    rows = np.array([(*World.grid(place), 1024) for place in range(PLACES)], dtype=store.SUBMAP_DTYPE)
    np.save(map_path / store.SUBMAPS, rows)
    bounds = (ORIGIN[0] - 60.0, ORIGIN[1] - 60.0, ORIGIN[0] + 660.0, ORIGIN[1] + 540.0)
    for name in (store.TERRAIN, store.SURFACE, store.LOWEST):
        write_geotiff(map_path / name, bounds, 1.0, CRS, bare_ground, name)
    manifest = store.Manifest(
        crs=CRS, origin=ORIGIN, bounds=bounds, vertical_reference="ellipsoid", geoid_separation_m=0.0,
        encoder_fingerprint=encoder.fingerprint, descriptor_size=encoder.descriptor_size, preprocessing=preprocessing,
        build=BuildConfig(), ground="classes", counts=store.BuildCounts(submaps=PLACES), sources=(),
        files=store.file_records(map_path), created="2024-01-01T00:00:00Z", software="test",
    )  # fmt: skip
    store.write_manifest(map_path, manifest)
    return World(map_path, folder / "weights.safetensors", folder / "other.safetensors", null_distance)


@pytest.fixture(scope="session")
def domain() -> Iterator[int]:
    """A ROS domain that no other test run on this machine uses: who holds the port holds the domain."""
    for number in range(1, 101):
        lock = socket.socket()
        try:
            lock.bind(("127.0.0.1", 24_500 + number))
        except OSError:
            lock.close()
            continue
        yield number
        lock.close()
        return
    pytest.fail("no free ROS domain")


@pytest.fixture(scope="session")
def ros_environment(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment of this process and of those that it starts: an own domain, this machine only, checked fields."""
    own = {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("ros_log")),
        "OMP_NUM_THREADS": "1",
    }
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)
    prepare_for_large_clouds()
    # LD_LIBRARY_PATH and _ROS_WHEELS_BOOTSTRAP_COMPLETE stay together, as the wheels want it.
    yield dict(os.environ)
    for name, value in before.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


REAL = ("-m", "crossloc3d_ros.cli.localizer")
STAND_IN = (str(Path(__file__).with_name("standin.py")),)


class NodeProcess:
    """`localizer` in a process of its own."""

    def __init__(
        self, environment: Mapping[str, str], log: Path, arguments: list[str], program: tuple[str, ...] = REAL
    ) -> None:
        self.log = log
        with log.open("w") as file:
            self.process = subprocess.Popen(
                [sys.executable, *program, *arguments],
                env=dict(environment), stdout=file, stderr=subprocess.STDOUT,
            )  # fmt: skip

    @property
    def output(self) -> str:
        return self.log.read_text()

    @property
    def is_alive(self) -> bool:
        return self.process.poll() is None

    def wait(self, timeout_s: float = FIRST_ANSWER_S) -> int:
        return self.process.wait(timeout_s)

    def stop(self, number: signal.Signals = signal.SIGINT) -> int:
        """Send the signal and return the exit code."""
        self.process.send_signal(number)
        return self.wait(20.0)

    def wait_for_output(self, text: str, timeout_s: float = FIRST_ANSWER_S) -> None:
        deadline = time.monotonic() + timeout_s
        while text not in self.output:
            assert self.is_alive, f"the node has ended with {self.process.returncode}:\n{self.output}"
            assert time.monotonic() < deadline, f"'{text}' did not come:\n{self.output}"
            time.sleep(0.02)


StartNode = Callable[..., NodeProcess]


@pytest.fixture(scope="session")
def start_node(ros_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[StartNode]:
    """Start a localizer: parameters by name, further arguments as they are."""
    processes: list[NodeProcess] = []

    def start(
        parameters: Mapping[str, object],
        *arguments: str,
        environment: Mapping[str, str] = {},
        program: tuple[str, ...] = REAL,
    ) -> NodeProcess:
        given = []
        for name, value in parameters.items():
            given += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
        log = tmp_path_factory.mktemp("node") / "log.txt"
        command = ["--ros-args", *given, *arguments] if given or arguments else []
        processes.append(NodeProcess({**ros_environment, **environment}, log, command, program))
        return processes[-1]

    yield start
    for process in processes:
        if process.is_alive:
            process.process.kill()
            process.wait(10.0)


@pytest.fixture(scope="session")
def start_stand_in(start_node: StartNode) -> StartNode:
    """Start a node whose localizer is the stand-in: places are found, poses made up."""
    return functools.partial(start_node, program=STAND_IN)


@dataclass
class Robot:
    """The other side: publishes clouds, keeps what comes back."""

    node: Any
    executor: SingleThreadedExecutor
    clouds: Any
    odometry: Any
    imu: Any
    guesses: Any
    stamps_ns: Iterator[int]
    """Every stamp occurs once in a test run: what an earlier test left latched is no output of this one."""
    fixes: list[NavSatFix] = field(default_factory=list)
    poses: list[PoseWithCovarianceStamped] = field(default_factory=list)
    candidates: list[PoseArray] = field(default_factory=list)
    tables: list[PointCloud2] = field(default_factory=list)
    hypotheses: list[PoseArray] = field(default_factory=list)
    states: list[DiagnosticStatus] = field(default_factory=list)
    markers: list[MarkerArray] = field(default_factory=list)
    origins: list[NavSatFix] = field(default_factory=list)
    diagnostics: list[DiagnosticArray] = field(default_factory=list)

    def forget(self) -> None:
        """Drop what has come so far, but for what is latched."""
        for kept in (
            self.fixes, self.candidates, self.tables, self.hypotheses, self.states, self.markers, self.diagnostics
        ):  # fmt: skip
            kept.clear()

    def wait_until(self, condition: Callable[[], object], timeout_s: float = 15.0, what: str = "") -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"waited {timeout_s} s in vain {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def spin(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)

    def wait_for_localizer(self) -> None:
        """Wait until the node is active and receives from this robot, and the robot from it."""
        self.wait_until(lambda: self.state() == "active", FIRST_ANSWER_S, "for the node to be active")
        self.wait_until(lambda: self.clouds.get_subscription_count() > 0, what="for the subscription")
        self.wait_until(lambda: self.node.count_publishers("/localizer/fix") > 0, what="for the fix")

    def message(self, points: Array) -> PointCloud2:
        """The points as the next cloud of the sensor."""
        return cloud_message(points, next(self.stamps_ns))

    def drive(self, stamp_ns: int, x: float, yaw: float = 0.0, child_frame_id: str = "base_link") -> None:
        """Publish odometry: the robot stands `x` metres along its way."""
        message = Odometry(header=header_message(stamp_ns, "odom"), child_frame_id=child_frame_id)
        message.pose.pose.position.x = float(x)
        message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
        self.odometry.publish(message)

    def localize(self, cloud: PointCloud2 | Array, timeout_s: float = 15.0) -> NavSatFix:
        """Publish a cloud and return the fix with its stamp; a lost cloud is sent again with the same stamp."""
        message = cloud if isinstance(cloud, PointCloud2) else self.message(cloud)
        stamp = message.header.stamp
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            self.clouds.publish(message)
            again = time.monotonic() + 2.0
            while time.monotonic() < again:
                self.executor.spin_once(timeout_sec=0.02)
                for fix in reversed(self.fixes):
                    if fix.header.stamp == stamp:
                        return fix
        raise AssertionError("no fix came back")

    def report(self, message: PointCloud2) -> tuple[int, str, dict[str, str]]:
        """Level, message and values of the state after the scan; what the stand-in was handed stands in the message."""
        stamp = message.header.stamp
        stamp_ns = str(stamp.sec * 1_000_000_000 + stamp.nanosec)
        self.fixes.clear()  # the scan may be sent for a second time
        self.states.clear()
        self.localize(message)
        found: list[DiagnosticStatus] = []

        def has_come() -> bool:
            found[:] = [s for s in self.states if any(v.value == stamp_ns for v in s.values)]
            return bool(found)

        self.wait_until(has_come, what="for the state")
        return found[-1].level[0], found[-1].message, {v.key: v.value for v in found[-1].values}

    def call(self, kind: type, name: str, request: Any, timeout_s: float = FIRST_ANSWER_S) -> Any:
        client = self.node.create_client(kind, name)
        try:
            self.wait_until(client.service_is_ready, timeout_s, f"for service {name}")
            future = client.call_async(request)
            self.wait_until(future.done, timeout_s, f"for a response of {name}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def state(self, node: str = "/localizer", timeout_s: float = FIRST_ANSWER_S) -> str:
        """State of the lifecycle, requested again where the response is lost: discovery has two ends."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                response = self.call(GetState, f"{node}/get_state", GetState.Request(), 20.0)
                return str(response.current_state.label)
            except AssertionError:
                assert time.monotonic() < deadline, f"no response of {node}/get_state"

    def change_state(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=int(transition)))
        return bool(self.call(ChangeState, "/localizer/change_state", request).success)

    def diagnosis(self, words: str = "") -> tuple[int, str, dict[str, str]]:
        """Level, message and values of the next diagnostics whose message holds `words`."""
        seen = len(self.diagnostics)
        self.wait_until(
            lambda: len(self.diagnostics) > seen and words in self.diagnostics[-1].status[0].message,
            what=f"for diagnostics that hold '{words}'",
        )
        status = self.diagnostics[-1].status[0]
        return status.level[0], status.message, {v.key: v.value for v in status.values}

    def diagnosis_with(self, key: str, words: str) -> tuple[int, str, dict[str, str]]:
        """Level, message and values of the next diagnostics whose value of `key` holds `words`."""
        deadline = time.monotonic() + 15.0
        while time.monotonic() < deadline:
            found = self.diagnosis()
            if words in found[2].get(key, ""):
                return found
        raise AssertionError(f"no diagnostics hold '{words}' of '{key}': {found[2]}")


@pytest.fixture(scope="session")
def robot_context(ros_environment: dict[str, str], domain: int) -> Iterator[rclpy.Context]:
    context = rclpy.Context()
    context.init(domain_id=domain)
    yield context
    context.try_shutdown()


@pytest.fixture(scope="session")
def robot(robot_context: rclpy.Context) -> Iterator[Robot]:
    node = rclpy.create_node("robot", context=robot_context)
    executor = SingleThreadedExecutor(context=robot_context)
    executor.add_node(node)
    publisher = node.create_publisher(PointCloud2, "points", qos_profile_sensor_data)
    odometry = node.create_publisher(Odometry, "odom", 50)
    imu = node.create_publisher(Imu, "imu", 50)
    guesses = node.create_publisher(PoseWithCovarianceStamped, "initialpose", 5)
    robot = Robot(node, executor, publisher, odometry, imu, guesses, STAMPS_NS)
    node.create_subscription(NavSatFix, "/localizer/fix", robot.fixes.append, 50)
    node.create_subscription(PoseWithCovarianceStamped, "/localizer/pose", robot.poses.append, LATCHED)
    node.create_subscription(PoseArray, "/localizer/candidates", robot.candidates.append, 10)
    node.create_subscription(PointCloud2, "/localizer/candidate_table", robot.tables.append, 10)
    node.create_subscription(PoseArray, "/localizer/hypotheses", robot.hypotheses.append, 10)
    node.create_subscription(DiagnosticStatus, "/localizer/state", robot.states.append, LATCHED)
    node.create_subscription(MarkerArray, "/localizer/markers", robot.markers.append, 10)
    node.create_subscription(NavSatFix, "/localizer/map_origin", robot.origins.append, LATCHED)
    node.create_subscription(DiagnosticArray, "/diagnostics", robot.diagnostics.append, 10)
    yield robot
    executor.shutdown()
    node.destroy_node()
