"""Motion within a turn: a scan of a moving robot becomes the scan of one that stands, or it is said why not."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.clouds.deskew import deskew
from crossloc3d_ros.clouds.filters import mounting_matrix, transform_points
from crossloc3d_ros.config import LocalizerConfig, MountingConfig, ScanConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.formats.messages import lidar_cloud
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.localization.fusion.odometry import OdometryBuffer, ScanOdometry
from crossloc3d_ros.localization.motion_compensation import MotionCompensation, SteadyMotion
from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.lidar import Lidar, LidarScan
from crossloc3d_ros.simulation.profiles import PROFILES
from crossloc3d_ros.simulation.scene import Scene
from crossloc3d_ros.types import Scan

END_NS = 1_700_000_000_100_000_000
SPEED_M_S, TURN_RAD_S = 3.0, 1.0
MOUNTING = MountingConfig(x_m=0.4, y_m=-0.1, z_m=1.2, yaw_deg=30.0)
T_BASE_LIDAR = mounting_matrix(MOUNTING)
HALF_M = 12.0
NAMES = ["vlp-16", "os1-32", "xt32", "avia"]


def hall() -> Scene:
    """Return a square hall whose walls stand `HALF_M` from the origin."""
    one = np.ones(1)
    box = mesh.oriented_boxes(np.zeros((1, 2)), 2 * HALF_M, 2 * HALF_M, 0.0)
    return mesh.scene_from([mesh.prisms(box, -80 * one, 80 * one, 80 * one, 0 * one, np.array([2], np.uint8))])


def base_at(since_end_s: float) -> np.ndarray:
    """Return the pose of the base so long after the turn's end, where it is at the origin; a circle."""
    yaw, radius = TURN_RAD_S * since_end_s, SPEED_M_S / TURN_RAD_S
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = radius * np.sin(yaw), radius * (1.0 - np.cos(yaw))
    return T


def turn_of(name: str, moving: bool = True) -> LidarScan:
    """Return the turn of a lidar on the robot that drives the circle."""
    profile = PROFILES[name]
    config = dataclasses.replace(profile.config, range_error_m=0.0, echo_limit=0.0, random_dropout=0.0, body=())
    R, arm = T_BASE_LIDAR[:3, :3], T_BASE_LIDAR[:3, 3]
    rate = np.array([0.0, 0.0, TURN_RAD_S])
    twist = np.concatenate([R.T @ (np.array([SPEED_M_S, 0.0, 0.0]) + np.cross(rate, arm)), R.T @ rate])
    sensor = Lidar(profile, config)
    return sensor.scan(hall(), T_BASE_LIDAR, np.random.default_rng(1), twist if moving else np.zeros(6))


def sent(name: str, turn: LidarScan) -> Scan:
    """Return a turn as it comes out of the message of the lidar's driver."""
    profile = PROFILES[name]
    until_end_s = 0.1 * (1.0 - profile.stamped_at)
    stamp_ns = END_NS - round(until_end_s * 1e9)
    time_s = turn.time.astype(np.float64) + until_end_s
    cloud = lidar_cloud(profile.layout, stamp_ns, "lidar", turn.points, turn.intensity, turn.ring, time_s)
    return scan_from_pointcloud2(cloud)


def odometry(until_s: float = 0.0) -> OdometryBuffer:
    buffer = OdometryBuffer(LocalizerConfig().fusion)
    for since_end_s in np.arange(-0.3, until_s + 1e-6, 0.02):
        buffer.add(END_NS + round(since_end_s * 1e9), base_at(float(since_end_s)))
    return buffer


def compensation(**scan: Any) -> MotionCompensation:
    return MotionCompensation(LocalizerConfig(scan=ScanConfig(mounting=MOUNTING, **scan)))


def off_the_walls(scan: Scan, since_end_s: float) -> np.ndarray:
    """Return how far points lie from the walls of the hall, if all were measured at one moment."""
    points = transform_points(base_at(since_end_s) @ T_BASE_LIDAR, scan.points.astype(np.float64))
    return np.abs(np.abs(points[:, :2]).max(axis=1) - HALF_M)


@pytest.mark.parametrize("name", NAMES)
def test_a_scan_of_a_turning_and_driving_robot_becomes_a_static_one(name: str) -> None:
    scan = sent(name, turn_of(name))
    stamp_s = (scan.stamp_ns - END_NS) * 1e-9
    assert np.quantile(off_the_walls(scan, stamp_s), 0.95) > 0.3, "the motion is felt"
    made = compensation(stamped_at=PROFILES[name].stamped_at)
    static = made(scan, T_BASE_LIDAR, odometry())
    assert made.words.startswith("compensated"), made.words
    assert static.is_at_stamp
    assert off_the_walls(static, stamp_s).max() < 0.03


def test_late_odometry_is_continued_over_the_rest_of_the_turn() -> None:
    scan = sent("vlp-16", turn_of("vlp-16"))
    assert off_the_walls(compensation()(scan, T_BASE_LIDAR, odometry(until_s=-0.04)), 0.0).max() < 0.05


def test_without_motion_nothing_moves() -> None:
    scan = sent("vlp-16", turn_of("vlp-16", moving=False))
    buffer = OdometryBuffer(LocalizerConfig().fusion)
    for i in range(20, -1, -1):
        buffer.add(END_NS - i * 20_000_000, np.eye(4))
    np.testing.assert_allclose(compensation()(scan, T_BASE_LIDAR, buffer).points, scan.points, atol=1e-5)


def test_what_moves_with_the_robot_stays_where_it_is() -> None:
    """Its own body, which is removed afterwards by where it is."""
    body = np.array([[-0.5, 0.0, -0.3], [0.2, -0.3, -0.9], [0.6, 0.0, 0.0]], np.float32)
    turn = turn_of("vlp-16")
    points = np.vstack([body, turn.points[:100]])
    times = np.concatenate([np.full(3, -0.1, np.float32), turn.time[:100]])
    knots_s = np.linspace(-0.1, 0.0, 9)
    poses = np.stack([base_at(float(knot)) for knot in knots_s])
    moved = deskew(points, times, knots_s, poses, T_BASE_LIDAR, ScanConfig())
    np.testing.assert_array_equal(moved[:3], body)
    assert np.linalg.norm(moved[3:] - points[3:], axis=1).min() > 0.05


def test_points_without_a_time_are_no_points_and_those_that_are_none_stay_so() -> None:
    points = np.array([[5, 0, 0], [np.nan, 0, 0], [5, 0, 0]], np.float32)
    times = np.array([np.nan, -0.05, -0.05], np.float32)
    poses = np.stack([base_at(-0.1), base_at(0.0)])
    moved = deskew(points, times, np.array([-0.1, 0.0]), poses, T_BASE_LIDAR, ScanConfig())
    assert np.isnan(moved[0]).all()
    assert np.isnan(moved[1, 0])
    assert np.isfinite(moved[2]).all()
    with pytest.raises(CloudError, match="shape"):
        deskew(points, times[:2], np.array([-0.1, 0.0]), poses, T_BASE_LIDAR, ScanConfig())


@pytest.mark.parametrize(
    ("changed", "source", "words"),
    [
        ({"deskew": "off"}, odometry(), "scan.deskew is off"),
        ({}, None, "no odometry"),
        ({}, OdometryBuffer(LocalizerConfig().fusion), "no odometry"),
        ({"period_s": 1.0}, odometry(), "no turn of 1 s"),
    ],
)
def test_where_it_cannot_be_done_the_scan_stays_and_it_is_said(
    changed: dict[str, Any], source: Any, words: str
) -> None:
    scan, made = sent("vlp-16", turn_of("vlp-16")), compensation(**changed)
    assert made(scan, T_BASE_LIDAR, source) is scan
    assert made.words.startswith("not compensated")
    assert words in made.words


def test_a_cloud_without_times_is_said() -> None:
    made = compensation()
    made(Scan(np.ones((10, 3), np.float32), END_NS, "lidar"), T_BASE_LIDAR, odometry())
    assert made.words == "not compensated: the cloud carries no time per point"


def test_odometry_from_scan_to_scan_takes_the_motion_out_of_the_next_scan() -> None:
    """KISS-ICP on scans that are at their stamps' moments: as it goes on, so the next turn is taken to have gone."""
    pytest.importorskip("kiss_icp")
    source = ScanOdometry(LocalizerConfig().fusion)
    made, config = compensation(), dataclasses.replace(PROFILES["vlp-16"].config, range_error_m=0.0, body=())
    R, rng = T_BASE_LIDAR[:3, :3], np.random.default_rng(1)
    twist = np.concatenate([R.T @ np.array([SPEED_M_S, 0.0, 0.0]), np.zeros(3)])
    off = []
    for i in range(14):
        T_hall_base = np.eye(4)
        T_hall_base[0, 3] = -4.0 + SPEED_M_S * 0.1 * i
        turn = Lidar(PROFILES["vlp-16"], config).scan(hall(), T_hall_base @ T_BASE_LIDAR, rng, twist)
        scan = made(turn.as_scan(END_NS + i * 100_000_000), T_BASE_LIDAR, SteadyMotion(source))
        source.add(scan.stamp_ns, transform_points(T_BASE_LIDAR, scan.points))
        points = transform_points(T_hall_base @ T_BASE_LIDAR, scan.points.astype(np.float64))
        off.append(np.quantile(np.abs(np.abs(points[:, :2]).max(axis=1) - HALF_M), 0.95))
    assert made.words.startswith("compensated"), made.words
    assert off[0] > 0.2
    assert np.median(off[-6:]) < 0.25 * off[0]  # KISS-ICP errs by centimetres from scan to scan
