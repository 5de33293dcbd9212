"""A frozen lidar is told by its repeated scan; everything that is wrong with a lidar gives no fix and a reason."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.config import LocalizerConfig, ScanConfig
from crossloc3d_ros.localization.fusion.odometry import OdometryBuffer
from crossloc3d_ros.localization.scan_checks import MOST_REPEATS, ScanChecks
from crossloc3d_ros.types import Scan

START_NS, STEP_NS = 1_700_000_000_000_000_000, 100_000_000
RNG = np.random.default_rng(0)
POINTS = np.column_stack([RNG.uniform(-30, 30, (3000, 2)), RNG.normal(-1.2, 0.01, 3000)]).astype(np.float32)


def scan_at(number: int, points: np.ndarray = POINTS) -> Scan:
    return Scan(points, START_NS + number * STEP_NS, "velodyne")


def odometry(speed_m_s: float, turn_rad_s: float = 0.0) -> OdometryBuffer:
    buffer = OdometryBuffer(LocalizerConfig().fusion)
    for i in range(-5, 30):
        T, yaw = np.eye(4), turn_rad_s * 0.1 * i
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[0, 3] = speed_m_s * 0.1 * i
        buffer.add(START_NS + i * STEP_NS, T)
    return buffer


def faults(scans: list[Scan], source: OdometryBuffer | None = None) -> list[str]:
    checks, motion = ScanChecks(ScanConfig()), None if source is None else source.motion
    return [checks.fault(scan, np.eye(4), ScanConfig(), motion) for scan in scans]


@pytest.mark.parametrize("source", [None, odometry(0.0)])
def test_a_scan_that_repeats_is_frozen_after_some_repeats(source: OdometryBuffer | None) -> None:
    told = faults([scan_at(i) for i in range(10)], source)
    assert told[:MOST_REPEATS] == [""] * MOST_REPEATS
    assert all("the lidar is frozen: it has repeated one scan" in reason for reason in told[MOST_REPEATS:])


@pytest.mark.parametrize("source", [odometry(2.0), odometry(0.0, 0.5)])
def test_a_scan_that_repeats_while_the_robot_moves_is_frozen_at_once(source: OdometryBuffer) -> None:
    told = faults([scan_at(i) for i in range(4)], source)
    assert told[0] == ""
    assert all("frozen" in reason and "while the robot moved by" in reason for reason in told[1:])


def test_a_live_lidar_is_never_frozen_and_one_that_thaws_is_used_again() -> None:
    noisy = [POINTS + np.float32(1e-4 * i) for i in range(20)]
    assert faults([scan_at(i, points) for i, points in enumerate(noisy)], odometry(2.0)) == [""] * 20
    assert faults([*(scan_at(i) for i in range(9)), scan_at(9, noisy[1]), scan_at(10, noisy[2])])[-2:] == ["", ""]


def test_the_same_message_again_and_a_recording_from_its_start_are_not_frozen() -> None:
    assert faults([scan_at(0)] * 20, odometry(2.0)) == [""] * 20
    assert faults([scan_at(number) for _ in range(20) for number in (1, 0)]) == [""] * 40


def test_clouds_without_points_are_not_frozen() -> None:
    assert faults([scan_at(i, np.empty((0, 3), np.float32)) for i in range(20)]) == [""] * 20
