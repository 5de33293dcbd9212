"""Scans and drives of another lidar: at the places and times of the VLP-16's, with the points of its own beams."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from crossloc3d_ros.datasets.belief_conditions import CONDITIONS, DELIVERED
from crossloc3d_ros.datasets.made import how_made
from crossloc3d_ros.datasets.pose_drives import DRIVES, DrivePlan, RawDrive, load_drives, record_drive, settings_of_plan
from crossloc3d_ros.datasets.pose_sets import scans_of_town
from crossloc3d_ros.datasets.raw_scans import RawScans
from crossloc3d_ros.datasets.simulated import BenchmarkTown, SimulatedBenchmark
from crossloc3d_ros.evaluation.belief.goals import goals_of
from crossloc3d_ros.simulation.lidar import Lidar
from crossloc3d_ros.simulation.profiles import PROFILES
from crossloc3d_ros.simulation.scene import Scene
from crossloc3d_ros.simulation.town import Town, make_town
from crossloc3d_ros.simulation.vlp16 import VLP16, Vlp16

TOWN = BenchmarkTown("suburb", 990_041, False)
EXAMINED = SimulatedBenchmark((TOWN,), 200.0, 3, 0)
OS1_64 = PROFILES["os1-64"]
PLAN = DrivePlan("a drive", 0, 12.0, 2.5, 8, 3, True, 1.2, 0.0)


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(TOWN.seed, TOWN.family, 200.0, 1 - TOWN.seed % 2)


@pytest.fixture(scope="module")
def drives(town: Town, tmp_path_factory: pytest.TempPathFactory) -> tuple[RawDrive, RawDrive]:
    """Record one drive with a VLP-16 and with an OS1-64."""
    recorded = []
    for profile in (VLP16, OS1_64):
        folder = tmp_path_factory.mktemp(profile.name)
        settings = {**settings_of_plan(PLAN), "lidar": profile.name}
        record_drive(folder / DRIVES / "00", PLAN, town, settings, profile)
        assert how_made(folder / DRIVES / "00") == settings
        recorded += load_drives(folder)
    return recorded[0], recorded[1]


def beams_of(points: np.ndarray) -> float:
    """Return the highest elevation of the points, degrees."""
    return float(np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))).max())


def share_on_surfaces(scene: Scene, scans: RawScans, moved_s: float) -> float:
    """Return the share of points in whose direction something stands as far away, within 0.2 m.

    Each scan is taken as seen at once, from the pose that the robot has `moved_s` later by its own speed.
    """
    near = []
    for row in range(len(scans) - 1):
        scan, after = scans[row], scans[row + 1]
        speed = (after.T_grid_base[:3, 3] - scan.T_grid_base[:3, 3]) / (1e-9 * (after.stamp_ns - scan.stamp_ns))
        T = scan.T_grid_base @ scan.T_base_lidar
        T[:3, 3] += moved_s * speed
        points = scan.points[np.linalg.norm(scan.points, axis=1) > 3.0][::5]
        range_m = np.linalg.norm(points, axis=1)
        directions = (points / range_m[:, None]) @ T[:3, :3].T
        hits = scene.cast(np.tile(T[:3, 3], (len(points), 1)).astype(np.float32), directions.astype(np.float32))
        near.append(np.abs(hits.distance_m - range_m) < 0.2)
    return float(np.concatenate(near).mean())


def test_a_scan_of_more_beams_is_taken_where_that_of_the_vlp_16_is(town: Town) -> None:
    vlp = scans_of_town(town, TOWN, EXAMINED, 3)
    os1 = scans_of_town(town, TOWN, EXAMINED, 3, Lidar(OS1_64))
    np.testing.assert_array_equal(vlp.T_grid_base, os1.T_grid_base)
    for one, other in zip(vlp, os1, strict=True):
        assert len(other.points) > 1.5 * len(one.points)
        assert beams_of(one.points) < 15.5
        assert beams_of(other.points) > 17.0


def test_the_scans_of_the_vlp_16_are_those_of_the_benchmark(town: Town) -> None:
    default = scans_of_town(town, TOWN, EXAMINED, 3)
    for one, other in zip(default, scans_of_town(town, TOWN, EXAMINED, 3, Vlp16(EXAMINED.sensor)), strict=True):
        np.testing.assert_array_equal(one.points, other.points)


def test_a_drive_is_the_same_with_another_lidar(drives: tuple[RawDrive, RawDrive]) -> None:
    """Stamps are those of the end of a turn, also of a driver that stamps the start."""
    vlp, os1 = drives
    assert len(vlp.scans) == len(os1.scans) > 4
    assert np.abs(vlp.scans.stamp_ns - os1.scans.stamp_ns).max() <= 10
    np.testing.assert_allclose(vlp.scans.T_grid_base, os1.scans.T_grid_base, rtol=0, atol=1e-6)
    np.testing.assert_allclose(vlp.scans.up_base, os1.scans.up_base, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(vlp.odometry, os1.odometry)
    assert os1.scans.points.lengths.sum() > 1.5 * vlp.scans.points.lengths.sum()


@pytest.mark.parametrize("which", [0, 1])
def test_the_points_of_a_turn_were_seen_before_its_stamp(
    town: Town, drives: tuple[RawDrive, RawDrive], which: int
) -> None:
    """What was seen fits the pose half a turn before the stamp, and neither that at it nor that of a turn earlier."""
    drive = drives[which]
    local = dataclasses.replace(drive, scans=RawScans.of(dataclasses.replace(
        scan, T_grid_base=scan.T_grid_base - np.pad(town.origin_grid[:, None], ((0, 1), (3, 0)))
    ) for scan in drive.scans))  # fmt: skip
    shares = {moved_s: share_on_surfaces(town.scene, local.scans, moved_s) for moved_s in (-0.3, -0.05, 0.2)}
    assert shares[-0.05] > 0.8
    assert shares[-0.05] > max(shares[-0.3], shares[0.2]) + 0.02


def test_the_condition_of_64_beams_is_recorded_anew_and_has_its_goal() -> None:
    beams = next(condition for condition in CONDITIONS if condition.name == "64 beams")
    assert len(PROFILES[beams.lidar].elevations_deg) == 64
    assert beams.is_recorded_anew and not DELIVERED.is_recorded_anew
    assert len(PROFILES[DELIVERED.lidar].elevations_deg) == 16
    for condition in ("64 beams", "as delivered"):
        floor, goal, *_ = goals_of("simulated", condition, is_learned=False).wanted["calibration"]
        assert (floor, goal) == (0.03, 0.01)
    assert not goals_of("fitting", "64 beams", is_learned=True).wanted
