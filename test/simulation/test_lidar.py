"""Simulated lidars against their data sheets, and the VLP-16 against what it measured before there were others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.cli.simulate import main
from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.drive import DriveConfig, drive
from crossloc3d_ros.simulation.lidar import Lidar, LidarConfig
from crossloc3d_ros.simulation.profiles import PROFILES
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.simulation.scene import Label, Scene
from crossloc3d_ros.simulation.town import Town, make_town
from crossloc3d_ros.simulation.vlp16 import Vlp16

BEFORE = [
    (-0.1, 0, 3.099, 3.241, -1.201, 19), (-0.094802, 0, 3.981, 2.079, -1.204, 9),
    (-0.08963, 14, 8.149, 1.284, 1.904, 19), (-0.079411, 4, 8.765, -4.628, -1.217, 14),
    (-0.067802, 11, 7.429, -20.007, 2.62, 31), (-0.062599, 12, 0.642, -22.376, 3.545, 29),
    (-0.052888, 0, -2.464, -3.748, -1.202, 17), (-0.04457, 5, -12.158, -6.125, -1.191, 5),
    (-0.032802, 3, -7.311, 2.045, -1.202, 12), (-0.020918, 2, -3.237, 5.265, -1.201, 14),
    (-0.009015, 5, 2.67, 13.412, -1.196, 11),
]  # fmt: skip
"""Time, ring, x, y, z, intensity of each 1500th of the 16,204 points of `yard()`, as the VLP-16 saw it at first."""
CLEAN = {"range_error_m": 0.0, "echo_limit": 0.0, "random_dropout": 0.0, "body": ()}


def yard() -> Scene:
    """Return a plain with three houses."""
    one = np.ones(3)
    plan = mesh.oriented_boxes(np.array([[12.0, 5.0], [-20.0, -8.0], [3.0, -25.0]]), 10.0, 7.0, 0.3)
    houses = mesh.prisms(plan, 0 * one, 9 * one, 9 * one, 0 * one, np.array([1, 2, 1], np.uint8))
    ground = mesh.height_grid(np.zeros((2, 2)), -300.0, -300.0, 600.0, Label.GROUND)
    return mesh.scene_from([ground, houses])


def hall(half_m: float = 20.0) -> Scene:
    """Return a closed hall: every beam comes back."""
    one = np.ones(1)
    box = mesh.oriented_boxes(np.zeros((1, 2)), 2 * half_m, 2 * half_m, 0.0)
    return mesh.scene_from([mesh.prisms(box, -200 * one, 200 * one, 200 * one, 0 * one, np.array([2], np.uint8))])


def at(height_m: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = height_m
    return T


def test_the_vlp16_measures_what_it_measured_before() -> None:
    twist = np.array([2.0, 0.1, 0.0, 0.01, 0.02, 0.6])
    scan = Vlp16().scan(yard(), at(1.2), np.random.default_rng(11), twist)
    # Elsewhere the last bit of a ray may move a range by one step of 2 mm, or one weak echo across the limit.
    assert len(scan.points) == pytest.approx(16_204, abs=3)
    assert int(scan.ring.sum()) == pytest.approx(82_289, abs=45)
    np.testing.assert_allclose(np.linalg.norm(scan.points, axis=1).sum(dtype=np.float64), 176_055.946, atol=120.0)
    for time, ring, x, y, z, intensity in BEFORE:
        found = np.flatnonzero((np.abs(scan.time - time) < 1e-6) & (scan.ring == ring))
        assert len(found) == 1
        np.testing.assert_allclose(scan.points[found[0]], (x, y, z), atol=0.0035)
        assert scan.intensity[found[0]] == pytest.approx(intensity, abs=1)


@pytest.mark.parametrize(
    ("name", "beams", "lowest_deg", "highest_deg", "points_a_second"),
    [
        ("vlp-16", 16, -15.0, 15.0, 289_300),
        ("hdl-32e", 32, -30.67, 10.67, 694_400),
        ("os0-32", 32, -45.0, 45.0, 327_680),
        ("os0-128", 128, -45.0, 45.0, 1_310_720),
        ("os1-32", 32, -21.2, 21.2, 327_680),
        ("os1-64", 64, -21.2, 21.2, 655_360),
        ("os1-128", 128, -21.2, 21.2, 1_310_720),
        ("xt32", 32, -16.0, 15.0, 640_000),
        ("qt64", 64, -52.1, 52.1, 384_000),
        ("avia", 6, -38.6, 38.6, 240_000),
    ],
)
def test_beams_and_rates_are_those_of_the_data_sheet(
    name: str, beams: int, lowest_deg: float, highest_deg: float, points_a_second: float
) -> None:
    scan = Lidar(PROFILES[name], LidarConfig(max_range_m=200.0, **CLEAN)).scan(
        hall(), at(0.0), np.random.default_rng(0)
    )
    elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1])))
    assert elevation.min() == pytest.approx(lowest_deg, abs=0.3)
    assert elevation.max() == pytest.approx(highest_deg, abs=0.3)
    assert len(np.unique(scan.ring)) == beams
    assert 10 * len(scan.points) == pytest.approx(points_a_second, rel=2e-3)
    assert scan.time.min() == pytest.approx(-0.1, abs=1e-6)
    assert -1e-4 < scan.time.max() < 0.0
    if name != "avia":
        assert (np.diff([elevation[scan.ring == ring].mean() for ring in range(beams)]) > 0).all(), "0 is the lowest"


def test_the_solid_state_lidar_looks_ahead_and_fills_its_field_turn_by_turn() -> None:
    lidar, rng = Lidar(PROFILES["avia"], LidarConfig(max_range_m=200.0, **CLEAN)), np.random.default_rng(0)

    def seen(turns: int) -> np.ndarray:
        """Return which half degrees of the field are seen in so many turns."""
        points = np.vstack([lidar.scan(hall(), at(0.0), rng).points for _ in range(turns)])
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
        assert np.abs(azimuth).max() == pytest.approx(35.2, abs=0.3)
        return np.histogram2d(azimuth, elevation, [np.arange(-36, 36, 0.5), np.arange(-39, 39, 0.5)])[0] > 0

    one, five = seen(1).sum(), seen(5).sum()
    assert five > 1.3 * one


@pytest.mark.parametrize("name", ["os0-32", "os1-32", "xt32", "qt64", "avia"])
def test_dark_surfaces_are_seen_as_far_as_the_data_sheet_says(name: str) -> None:
    """Nine of ten echoes of 10 % reflectivity come back from the range given; from 1.5 times as far hardly any do."""
    rated_m = {"os0-32": 35.0, "os1-32": 90.0, "xt32": 80.0, "qt64": 20.0, "avia": 190.0}[name]
    config = PROFILES[name].config
    factor = 0.7 + 0.8 * np.random.default_rng(0).random(10_000)
    shares = [np.mean(0.1 / r**2 > config.echo_limit * factor) for r in (rated_m, 1.5 * rated_m)]
    assert shares[0] == pytest.approx(0.9, abs=0.02)
    assert shares[1] < 0.05


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(6, "campus", 250.0)


@pytest.mark.parametrize(
    ("name", "topic", "field", "datatype", "point_step"),
    [("os1-32", "/ouster/points", "t", 6, 48), ("xt32", "/lidar_points", "timestamp", 8, 26),
     ("avia", "/livox/lidar", "offset_time", 6, 22)],
)  # fmt: skip
def test_clouds_are_laid_out_and_stamped_as_the_makers_driver_does(
    town: Town, tmp_path: Path, name: str, topic: str, field: str, datatype: int, point_step: int
) -> None:
    route = plan_route(town, 12.0, np.random.default_rng(0))
    profile = PROFILES[name]
    drive(town, route, tmp_path / "bag", DriveConfig(scan_every=20, sensor=profile.config), seed=1, profile=profile)
    with open_bag(tmp_path / "bag") as reader:
        records = list(reader.messages([topic, "/ground_truth/odom"]))
    clouds = [record for record in records if record.topic == topic]
    truths = [record.message.header.stamp for record in records if record.topic != topic]
    assert [record.message.header.stamp for record in clouds] == truths
    cloud = clouds[0].message
    time = next(item for item in cloud.fields if item.name == field)
    assert (time.datatype, cloud.point_step) == (datatype, point_step)
    stamp_ns = cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec
    assert clouds[0].t_ns - stamp_ns == 100_000_000, "stamped when the turn begins, sent when it ends"
    table = np.frombuffer(
        cloud.data.tobytes(),
        np.dtype({"names": ["t"], "formats": [{6: "<u4", 8: "<f8"}[datatype]], "offsets": [time.offset],
                  "itemsize": point_step}),
    )["t"]  # fmt: skip
    since_s = table - stamp_ns * 1e-9 if field == "timestamp" else table * 1e-9
    assert since_s.min() == pytest.approx(0.0, abs=1e-3)
    assert since_s.max() == pytest.approx(0.1, abs=1e-3)


def test_the_command_knows_the_lidars(town: Town, tmp_path: Path) -> None:
    options = ["--output", str(tmp_path / "town"), "--size-m", "200", "--length-m", "8", "--scan-every", "20"]
    assert main(["town", *options, "--lidar", "qt64", "--lidar-height-m", "0.4", "--lidar-range-m", "30"]) == 0
    with open_bag(tmp_path / "town" / "bag") as reader:
        cloud = next(iter(reader.messages(["/lidar_points"]))).message
    xyz = np.frombuffer(cloud.data.tobytes(), np.uint8).reshape(-1, 26)[:, :12].copy().view("<f4")
    ranges = np.linalg.norm(xyz, axis=1)
    assert ranges.max() < 30.5
    # No part of the body lies below the ground on which the robot stands.
    assert (xyz[ranges < 0.7][:, 2] > -0.52).all()
    assert main(["town", *options, "--lidar-height-m", "9"]) != 0
