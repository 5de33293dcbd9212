"""The simulated VLP-16 against its data sheet, against geometry and against a real one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.lidar import LidarConfig
from crossloc3d_ros.simulation.scene import Label, Scene
from crossloc3d_ros.simulation.vlp16 import Vlp16

CLEAN = LidarConfig(range_error_m=0.0, echo_limit=0.0, random_dropout=0.0, body=())


def plain(half_m: float = 300.0) -> Scene:
    return mesh.scene_from([mesh.height_grid(np.zeros((2, 2)), -half_m, -half_m, 2 * half_m, Label.GROUND)])


def room(half_m: float = 10.0) -> Scene:
    """Return a square hall whose walls stand `half_m` from the middle."""
    one = np.ones(1)
    box = mesh.oriented_boxes(np.zeros((1, 2)), 2 * half_m, 2 * half_m, 0.0)
    return mesh.scene_from([mesh.prisms(box, -20 * one, 20 * one, 20 * one, 0 * one, np.array([2], np.uint8))])


def lidar_at(height_m: float, yaw_rad: float = 0.0) -> Any:
    T = np.eye(4)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T[:2, :2] = [[c, -s], [s, c]]
    T[2, 3] = height_m
    return T


def test_flat_ground_gives_rings_at_height_over_tangent() -> None:
    scan = Vlp16(CLEAN).scan(plain(), lidar_at(1.2), np.random.default_rng(0))
    radius = np.linalg.norm(scan.points[:, :2], axis=1)
    for ring, elevation in enumerate(range(-15, 0, 2)):
        # The beams' order of rings is that of their angles.
        expected = 1.2 / np.tan(np.radians(-elevation))
        if expected < 100.0:
            np.testing.assert_allclose(radius[scan.ring == ring], expected, atol=2e-3 + 2e-3 * expected / 1.2)
    assert scan.ring.max() == 7
    np.testing.assert_allclose(scan.points[:, 2], -1.2, atol=1e-3)


def test_a_turn_has_the_sensors_angles_times_and_firing_order() -> None:
    scan = Vlp16(CLEAN).scan(room(), lidar_at(0.0), np.random.default_rng(0))
    assert len(scan.points) == 16 * 1808
    np.testing.assert_array_equal(scan.ring[:16], [0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])
    elevation = np.degrees(np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points, axis=1)))
    np.testing.assert_allclose(elevation, -15.0 + 2.0 * scan.ring, atol=0.01)
    assert (np.diff(scan.time.astype(np.float64)) > 0).all()
    assert scan.time[0] == pytest.approx(-0.1, abs=1e-6)
    assert -60e-6 < scan.time[-1] < 0
    azimuth = np.unwrap(np.arctan2(scan.points[::16, 1], scan.points[::16, 0]))
    np.testing.assert_allclose(np.degrees(np.diff(azimuth)), -0.199, atol=0.001)  # clockwise from above


def test_ranges_are_as_noisy_as_asked() -> None:
    config = LidarConfig(range_error_m=0.02, echo_limit=0.0, random_dropout=0.0, body=())
    clean = Vlp16(CLEAN).scan(room(), lidar_at(0.0), np.random.default_rng(5))
    noisy = Vlp16(config).scan(room(), lidar_at(0.0), np.random.default_rng(5))
    difference = np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(clean.points, axis=1)
    assert np.std(difference) == pytest.approx(0.02, rel=0.05)
    assert abs(np.mean(difference)) < 0.001


def test_echoes_end_with_range_and_grazing_incidence() -> None:
    config = LidarConfig(body=())
    scan = Vlp16(config).scan(plain(), lidar_at(1.2), np.random.default_rng(0))
    per_ring = np.bincount(scan.ring, minlength=16)
    assert (per_ring[:6] > 1500).all()  # down to 13 m all comes back
    assert per_ring[7] < 50  # one degree down, 69 m away on asphalt: nothing does
    near, far = (Vlp16(config).scan(room(h), lidar_at(0.0), np.random.default_rng(1)) for h in (10.0, 90.0))
    assert len(near.points) > 28_000
    assert len(far.points) < 0.8 * len(near.points)
    assert np.linalg.norm(far.points, axis=1).max() < 100.2


def test_the_own_body_hides_what_lies_behind() -> None:
    mast = (-0.6, -0.1, -1.0, -0.5, 0.1, 1.0)
    scan = Vlp16(LidarConfig(body=mast, random_dropout=0.0)).scan(room(), lidar_at(0.0), np.random.default_rng(0))
    distance = np.linalg.norm(scan.points, axis=1)
    behind = np.abs(np.abs(np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))) - 180.0) < 8.0
    assert behind.sum() > 500
    assert distance[behind].max() < 0.8
    assert distance[~behind & (distance > 0.8)].min() > 9.5


def test_standing_still_distorts_nothing() -> None:
    still = Vlp16(CLEAN).scan(room(), lidar_at(0.0), np.random.default_rng(3), twist=np.zeros(6))
    plain_scan = Vlp16(CLEAN).scan(room(), lidar_at(0.0), np.random.default_rng(3))
    np.testing.assert_array_equal(still.points, plain_scan.points)


def test_motion_distorts_as_the_twist_says() -> None:
    """Undoing the motion at each point's own time brings every point back onto the walls."""
    twist = np.array([3.0, 0.5, 0.0, 0.02, -0.03, 0.8])
    scan = Vlp16(CLEAN).scan(room(), lidar_at(0.0, 0.3), np.random.default_rng(4), twist)
    t = scan.time.astype(np.float64)
    rate = np.linalg.norm(twist[3:])
    axis = twist[3:] / rate
    p = scan.points.astype(np.float64)
    c, s = np.cos(rate * t)[:, None], np.sin(rate * t)[:, None]
    turned = p * c + np.cross(axis, p) * s + (p @ axis)[:, None] * axis * (1 - c)
    world = (turned + twist[:3] * t[:, None]) @ lidar_at(0.0, 0.3)[:3, :3].T
    off_wall = np.abs(np.abs(world[:, :2]).max(axis=1) - 10.0)
    assert np.percentile(off_wall, 99) < 0.01
    untouched = scan.points @ lidar_at(0.0, 0.3)[:3, :3].T.astype(np.float32)
    assert np.percentile(np.abs(np.abs(untouched[:, :2]).max(axis=1) - 10.0), 90) > 0.1


def test_water_sends_nothing_back() -> None:
    lake = mesh.scene_from([mesh.height_grid(np.zeros((2, 2)), -300, -300, 600, Label.WATER)])
    assert len(Vlp16(LidarConfig(body=())).scan(lake, lidar_at(1.2), np.random.default_rng(0)).points) == 0


def test_a_scan_looks_like_a_real_one(shared: Any) -> None:
    """Compare with a recording: 22 bytes a point, firing order, rings, density along a ring, ranges in 2 mm."""
    folder: Path = shared("data/vlp16/einride_vlp16_pointcloud2_mcap")
    with open_bag(folder) as reader:
        message = next(iter(reader.messages(["/velodyne_points"]))).message
    kind = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
    real = np.frombuffer(bytes(message.data), dtype=kind)
    made = Vlp16().scan(room(4.0), lidar_at(1.2), np.random.default_rng(0))
    real_elevation = np.degrees(np.arctan2(real["z"], np.hypot(real["x"], real["y"])))
    made_elevation = np.degrees(np.arcsin(made.points[:, 2] / np.linalg.norm(made.points, axis=1)))
    for ring in range(3, 16):
        expected = np.median(real_elevation[real["ring"] == ring])
        assert np.median(made_elevation[made.ring == ring]) == pytest.approx(expected, abs=0.6)
    real_step = np.median(np.abs(np.diff(real["time"][real["ring"] == 9])))
    made_step = np.median(np.abs(np.diff(made.time[made.ring == 9])))
    assert made_step == pytest.approx(real_step, rel=0.02)
    assert real["time"].min() == pytest.approx(made.time.min(), abs=0.002)
    assert made.intensity.max() <= 255
    assert abs(np.median(made.intensity) - np.median(real["intensity"])) < 40
