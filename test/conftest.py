"""Fixtures that several packages' tests share."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import (
    AlignmentConfig,
    BuildConfig,
    CalibrationConfig,
    LocalizerConfig,
    PreprocessingConfig,
    RetrievalConfig,
)
from crossloc3d_ros.localization.localizer import Localizer

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_configure() -> None:
    """Listen to Ctrl-C also in the background: a shell makes its jobs deaf to it, and their children inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def shared_path(relative: str) -> Path:
    """Return a file of the shared reference data, or skip the test where it is not at hand."""
    root = Path(os.environ.get("CROSSLOC3D_SHARED", REPOSITORY.parent / "shared"))
    path = root / relative
    if not path.exists():
        pytest.skip(f"reference data not found: {path} (set CROSSLOC3D_SHARED to its folder)")
    return path


@pytest.fixture(scope="session")
def shared() -> object:
    """Give the function that finds shared reference data."""
    return shared_path


@dataclass(frozen=True)
class TownDrive:
    """A made-up block of houses: a survey of it and a recorded drive through it, whatever the encoder."""

    survey: Path
    bag: Path
    crs: str
    truth: np.ndarray
    """(S, 3) easting, northing, ground height of each scan, metres."""
    stamps_ns: np.ndarray
    """(S,)"""


@pytest.fixture(scope="session")
def town_drive(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    """Write survey and drive: scans every 8 m, in any heading, with GNSS at 2 Hz and two doubtful fixes."""
    from crossloc3d_ros.formats import bag, messages
    from crossloc3d_ros.formats.las import write_laz
    from crossloc3d_ros.geodesy import MapFrame

    west, south, side, crs = 628_000.0, 5_803_000.0, 260.0, "EPSG:32631"
    rng = np.random.default_rng(7)
    e, n = rng.uniform(0, side, (2, 250_000))
    z = np.zeros_like(e)
    for _ in range(60):  # houses of all sizes, none on the street along the middle
        x, y, w, d = rng.uniform(0, side), rng.uniform(0, side), rng.uniform(6, 24), rng.uniform(6, 18)
        if abs(y - side / 2) < d / 2 + 7:
            continue
        inside = (abs(e - x) < w / 2) & (abs(n - y) < d / 2)
        z[inside] = rng.uniform(4, 20)
    house = z > 0
    z = z + 2.0 + np.where(house, 0.0, rng.normal(0, 0.02, len(z)))
    points = np.column_stack([e + west, n + south, z])
    folder = tmp_path_factory.mktemp("town_drive")
    write_laz(folder / "town.laz", points, np.where(house, 6, 2).astype(np.uint8), crs, scale=0.001)

    frame = MapFrame(crs, np.array([west, south, 2.0]), None)
    start_ns, step_ns = 1_700_000_000_000_000_000, 500_000_000
    along = np.arange(50.0, side - 50.0, 8.0)
    truth = np.column_stack([west + along, np.full(len(along), south + side / 2), np.full(len(along), 2.0)])
    stamps_ns = start_ns + step_ns * np.arange(len(along)) + 100_000_000
    latitude, longitude, _ = frame.to_geographic(truth - [0.2 * 16, 0, 0])  # 16 m/s, at the fix 0.1 s before the scan
    with bag.BagWriter(folder / "drive", "sqlite3") as writer:
        for i, place in enumerate(truth):
            fix_ns = int(stamps_ns[i]) - 200_000_000
            doubtful = i in (5, 6)
            fix = messages.nav_sat_fix(
                fix_ns, "gnss", latitude[i] + 0.01 * doubtful, longitude[i], float("nan"),
                np.eye(3) * (40.0 if doubtful else 1.0) ** 2,
            )  # fmt: skip
            writer.write("/gnss", bag.NAV_SAT_FIX, fix_ns, fix)
            near = points[np.abs(points[:, :2] - place[:2]).max(axis=1) < 30.0] - place
            yaw = rng.uniform(0, 2 * np.pi)
            turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
            xyz = np.column_stack([near[:, :2] @ turn.T, near[:, 2] - 1.2])
            cloud = messages.velodyne_cloud(int(stamps_ns[i]), "velodyne", xyz, 1.0, 0, 0.0)
            writer.write("/velodyne_points", bag.POINT_CLOUD, int(stamps_ns[i]), cloud)
    return TownDrive(folder / "town.laz", folder / "drive", crs, truth, stamps_ns)


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of a tiny network of the real kind: another process can load them, unlike a class of a test."""
    from crossloc3d_ros.config import ModelConfig, PreprocessingConfig
    from crossloc3d_ros.encoder.checkpoint import save_checkpoint
    from crossloc3d_ros.encoder.model import CrossLoc3D

    model = CrossLoc3D(
        ModelConfig(
            voxel_sizes=(0.2,), kept_branches=0, refinement="none", channels=16, fused_channels=32, clusters=4,
            descriptor_size=8,
        )
    )  # fmt: skip
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_checkpoint(path, model, PreprocessingConfig(half_extent_m=20.0, n_points=256, min_points=40), dtype="float32")
    return path


@dataclass(frozen=True)
class RecordedArea:
    """A made-up strip of houses: a survey of it and recordings of two drives through it, there and back."""

    survey: Path
    bags: tuple[Path, Path]
    crs: str
    west: float
    south: float
    truth: tuple[np.ndarray, np.ndarray]
    """Of each drive (S, 4): easting, northing, heading, stamp in seconds from the first one."""
    start_ns: int


@pytest.fixture(scope="session")
def recorded_area(tmp_path_factory: pytest.TempPathFactory) -> RecordedArea:
    """Write survey and drives: scans every 2 m, GNSS at 2 Hz between them, odometry at 10 Hz.

    In the first drive the receiver begins at 2 s, is lost from 40 to 46 s, doubts itself from 60 to 64 s and falls
    silent from 80 to 86 s.
    """
    from crossloc3d_ros.formats import bag, messages
    from crossloc3d_ros.formats.las import write_laz
    from crossloc3d_ros.geodesy import MapFrame

    west, south, length, width, crs = 628_000.0, 5_803_000.0, 480.0, 120.0, "EPSG:32631"
    rng = np.random.default_rng(11)
    e, n = np.sort(rng.uniform(0, length, 160_000)), rng.uniform(0, width, 160_000)
    z = np.zeros_like(e)
    for _ in range(220):
        x, y, w, d = rng.uniform(0, length), rng.uniform(0, width), rng.uniform(5, 16), rng.uniform(5, 14)
        if abs(y - width / 2) > d / 2 + 6:
            z[(abs(e - x) < w / 2) & (abs(n - y) < d / 2)] = rng.uniform(3, 15)
    house = z > 0
    points = np.column_stack([e + west, n + south, z + 2.0 + np.where(house, 0.0, rng.normal(0, 0.02, len(z)))])
    folder = tmp_path_factory.mktemp("recorded_area")
    write_laz(folder / "strip.laz", points, np.where(house, 6, 2).astype(np.uint8), crs, scale=0.001)

    frame = MapFrame(crs, np.array([west, south, 2.0]), None)
    start_ns, speed = 1_700_000_000_000_000_000, 4.0
    bags, truths = [], []
    for number, (heading, lane) in enumerate(((0.0, -2.0), (np.pi, 2.0))):
        path = folder / f"drive {number}"
        times = np.arange(0.5, 110.5, 0.5)

        def place(t: float, heading: float = heading, lane: float = lane) -> np.ndarray:
            along = 20.0 + speed * t if heading == 0.0 else length - 20.0 - speed * t
            return np.array([[west + along, south + width / 2 + lane, 2.0]])

        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        pose = np.zeros(3)
        with bag.BagWriter(path) as writer:
            for tick in range(1, 1105):
                t = tick / 10.0
                stamp = start_ns + tick * 100_000_000
                drifted = 0.3 + 0.002 * t  # the odometry's frame points somewhere else and drifts
                pose += 0.1 * speed * np.array([np.cos(drifted), np.sin(drifted), 0.0])
                quaternion = [0.0, 0.0, np.sin(drifted / 2), np.cos(drifted / 2)]
                writer.write(
                    "/odom", bag.ODOMETRY, stamp, messages.odometry(stamp, "odom", "base_link", pose, quaternion)
                )
                if tick % 5 == 2 and not (number == 0 and (80.0 < t < 86.0 or t < 2.0)):
                    latitude, longitude, _ = frame.to_geographic(place(t))
                    lost = number == 0 and 40.0 < t < 46.0
                    std = 12.0 if number == 0 and 60.0 < t < 64.0 else 0.5
                    fix = messages.nav_sat_fix(
                        stamp, "gnss", latitude[0], longitude[0], float("nan"), np.eye(3) * std**2, has_fix=not lost
                    )
                    writer.write("/gnss", bag.NAV_SAT_FIX, stamp, fix)
                if tick % 5 == 0:
                    low, high = np.searchsorted(e, place(t)[0, 0] - west + np.array([-24.0, 24.0]))
                    near = points[low:high] - place(t)
                    near = near[np.abs(near[:, 1]) < 24.0]
                    xyz = np.column_stack([near[:, :2] @ turn, near[:, 2] - 1.2])
                    cloud = messages.velodyne_cloud(stamp, "velodyne", xyz, 1.0, 0, 0.0)
                    writer.write("/points", bag.POINT_CLOUD, stamp, cloud)
        places = np.concatenate([place(float(t)) for t in times])
        truths.append(np.column_stack([places[:, :2], np.full(len(times), heading), times]))
        bags.append(path)
    return RecordedArea(folder / "strip.laz", (bags[0], bags[1]), crs, west, south, (truths[0], truths[1]), start_ns)


class HeightHistogram:
    """Stands in for the network: how many points lie how far from the centre and how high, from whatever heading."""

    fingerprint = "height-histogram"
    descriptor_size = 80

    def __init__(self) -> None:
        from crossloc3d_ros.config import CalibrationConfig, PreprocessingConfig

        self.preprocessing = PreprocessingConfig()
        self.calibration = CalibrationConfig(temperature=0.01, null_distance=0.2, null_scale=0.02)

    def encode(self, points: np.ndarray) -> np.ndarray:
        radius = np.hypot(points[:, 0], points[:, 1])
        counts, _, _ = np.histogram2d(radius, points[:, 2], bins=(10, 8), range=((0, 1.0), (0, 0.8)))
        return (counts.ravel() / max(counts.sum(), 1)).astype(np.float32)

    def encode_batch(self, clouds: list[np.ndarray]) -> np.ndarray:
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        pass


@pytest.fixture(scope="session")
def simulated_town(tmp_path_factory: pytest.TempPathFactory) -> object:
    """Simulate a town, fly over it, map it, and scan it four years later; three scans are from another town.

    Returns the pose set and the encoder of its map.
    """
    from crossloc3d_ros.config import BuildConfig
    from crossloc3d_ros.datasets.pose_sets import SimulatedPoses, make_pose_set
    from crossloc3d_ros.datasets.simulated import BenchmarkTown, SimulatedBenchmark
    from crossloc3d_ros.simulation.survey import SurveyConfig

    poses = SimulatedPoses(
        SimulatedBenchmark(
            (BenchmarkTown("estate", 990_112, False),), town_size_m=300.0, queries=7, ground=0,
            flight=SurveyConfig(spacing_m=0.8), build=BuildConfig(spacing_m=30.0),
        ),
        columns=1,
        off_map=(BenchmarkTown("suburb", 990_113, False),),
        off_map_scans=3,
    )  # fmt: skip
    encoder = HeightHistogram()
    return make_pose_set("town", poses, tmp_path_factory.mktemp("simulated_town"), lambda: encoder), encoder


class RingHistogram:
    """How many points lie how far from the centre and how high: the same from every heading."""

    fingerprint = "ring-histogram"
    descriptor_size = 80
    preprocessing = PreprocessingConfig(
        half_extent_m=30.0, scan_half_extent_m=30.0, n_points=2048, min_points=40, thin_m=1.0
    )
    calibration = CalibrationConfig(temperature=0.01, null_distance=0.2, null_scale=0.02)

    def encode(self, points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        radius = np.hypot(points[:, 0], points[:, 1])
        counts, _, _ = np.histogram2d(radius, points[:, 2], bins=(10, 8), range=((0, 1.0), (0, 0.8)))
        return (counts.ravel() / max(counts.sum(), 1)).astype(np.float32)

    def encode_batch(self, clouds: Sequence[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        pass


@pytest.fixture(scope="session")
def town_map(town_drive, tmp_path_factory: pytest.TempPathFactory) -> AerialMap:
    folder = tmp_path_factory.mktemp("maps") / "town"
    build_map([town_drive.survey], folder, RingHistogram(), BuildConfig(spacing_m=10.0), geoid_separation_m=43.0)
    return AerialMap.load(folder, RingHistogram.fingerprint)


@pytest.fixture(scope="session")
def localizer(town_map: AerialMap) -> Localizer:
    """Places by retrieval alone: scans in any heading, 8 m and half a second apart, are no drive to be followed."""
    credibility, alignment = RetrievalConfig(min_probability=0.3), AlignmentConfig(scope="none")
    return Localizer(town_map, RingHistogram(), LocalizerConfig(retrieval=credibility, alignment=alignment))
