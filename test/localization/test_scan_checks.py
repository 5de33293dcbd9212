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
    assert all("the lidar is frozen: its last" in reason for reason in told[MOST_REPEATS:])


@pytest.mark.parametrize("source", [odometry(2.0), odometry(0.0, 0.5)])
def test_a_scan_that_repeats_while_the_robot_moves_is_frozen_at_once(source: OdometryBuffer) -> None:
    told = faults([scan_at(i) for i in range(4)], source)
    assert told[0] == ""
    assert all("frozen" in reason and "while the robot moved by" in reason for reason in told[1:])


def test_a_live_lidar_is_never_frozen_and_one_that_thaws_is_used_again() -> None:
    noisy = [POINTS + np.float32(2e-3 * i) for i in range(20)]
    assert faults([scan_at(i, points) for i, points in enumerate(noisy)], odometry(2.0)) == [""] * 20
    assert faults([*(scan_at(i) for i in range(9)), scan_at(9, noisy[1]), scan_at(10, noisy[2])])[-2:] == ["", ""]


def test_the_same_message_again_and_a_recording_from_its_start_are_not_frozen() -> None:
    assert faults([scan_at(0)] * 20, odometry(2.0)) == [""] * 20
    assert faults([scan_at(number) for _ in range(20) for number in (1, 0)]) == [""] * 40


def test_clouds_without_points_are_not_frozen() -> None:
    assert faults([scan_at(i, np.empty((0, 3), np.float32)) for i in range(20)]) == [""] * 20


def cycle(length: int, noise_m: float, count: int) -> list[Scan]:
    """A buffer of some scans that is sent round and round, perhaps with the rounding of a conversion on the way."""
    rng = np.random.default_rng(1)
    kept = [POINTS + rng.normal(0.0, 0.02, POINTS.shape) for _ in range(length)]
    return [
        scan_at(i, (kept[i % length] + rng.normal(0.0, noise_m, POINTS.shape)).astype(np.float32)) for i in range(count)
    ]


@pytest.mark.parametrize("length", [1, 2, 3, 5])
@pytest.mark.parametrize("noise_m", [0.0, 1e-6, 1e-5])
def test_scans_that_come_again_with_rounding_or_in_turns_are_frozen(length: int, noise_m: float) -> None:
    scans = cycle(length, noise_m, 25)
    moving = faults(scans, odometry(2.0))
    assert moving[:length] == [""] * length
    assert all("while the robot moved by" in reason for reason in moving[length:])
    standing = faults(scans, odometry(0.0))
    assert all("frozen" in reason for reason in standing[length + MOST_REPEATS :])


def test_a_lidar_that_was_frozen_for_long_is_used_again_at_once() -> None:
    source = OdometryBuffer(LocalizerConfig().fusion)
    for i in range(400):
        T = np.eye(4)
        T[0, 3] = 0.2 * i
        source.add(START_NS + i * STEP_NS, T)
    rng = np.random.default_rng(2)
    live = [(POINTS + rng.normal(0.0, 0.02, POINTS.shape)).astype(np.float32) for _ in range(40)]
    points = [*live[:20], *[live[19]] * 300, *live[20:]]
    told = faults([scan_at(i, each) for i, each in enumerate(points)], source)
    assert told[:20] == [""] * 20
    assert all("frozen" in reason for reason in told[20:320])
    assert told[320:] == [""] * 20


# Mirrored

BLOCKS = np.random.default_rng(3).uniform([-40, -40, 2], [40, 40, 6], (60, 3))


def town_seen_from(heading_rad: float) -> np.ndarray:
    """Points (N, 3), lidar frame, of blocks around a robot that stands and turns."""
    rng = np.random.default_rng(round(heading_rad * 1000) % 1000)
    near = BLOCKS[np.hypot(BLOCKS[:, 0], BLOCKS[:, 1]) > 4.0]
    walls = near[:, None, :2] + rng.uniform(-1.5, 1.5, (len(near), 80, 2))
    z = rng.uniform(-1.0, 1.0, walls.shape[:2]) * near[:, None, 2]
    c, s = np.cos(-heading_rad), np.sin(-heading_rad)
    turned = np.stack([c * walls[..., 0] - s * walls[..., 1], s * walls[..., 0] + c * walls[..., 1], z], axis=-1)
    return turned.reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("turn_rad_s", [0.6, -0.6])
@pytest.mark.parametrize("mirrored", [None, 0, 1])
def test_a_mirrored_lidar_turns_the_other_way_than_odometry(turn_rad_s: float, mirrored: int | None) -> None:
    source = OdometryBuffer(LocalizerConfig().fusion)
    scans = []
    for i in range(60):
        yaw = 0.1 * i * turn_rad_s
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        source.add(START_NS + i * STEP_NS, T)
        points = town_seen_from(yaw)
        if mirrored is not None:
            points[:, mirrored] *= -1
        scans.append(scan_at(i, points))
    told = faults(scans, source)
    if mirrored is None:
        assert told == [""] * 60
    else:
        assert "the scans turn the other way than the odometry" in told[-1]
        assert "(REP-103)" in told[-1]
        assert told[:10] == [""] * 10, "one pair may mislead"


def test_without_odometry_nothing_is_said_of_a_mirrored_lidar() -> None:
    assert faults([scan_at(i, town_seen_from(0.06 * i) * np.float32([1, -1, 1])) for i in range(60)]) == [""] * 60
