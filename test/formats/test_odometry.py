"""Poses of messages as matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.formats import messages
from crossloc3d_ros.formats.odometry import OdometryPoses, pose_matrix


def test_a_pose_is_the_matrix_that_its_numbers_say() -> None:
    rotation = Rotation.from_euler("ZYX", [0.7, -0.1, 0.2])
    message = messages.odometry(1, "odom", "base_link", (3.0, -2.0, 0.5), rotation.as_quat())
    T = pose_matrix(message.pose.pose)
    np.testing.assert_allclose(T[:3, :3], rotation.as_matrix(), atol=1e-12)
    assert T[:, 3].tolist() == [3.0, -2.0, 0.5, 1.0]
    assert T[3].tolist() == [0.0, 0.0, 0.0, 1.0]


def test_a_rounded_quaternion_is_still_a_rotation() -> None:
    message = messages.odometry(1, "odom", "base_link", (0, 0, 0), (0.0, 0.0, 0.706, 0.71))
    R = pose_matrix(message.pose.pose)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("position", "orientation", "why"),
    [
        ((0, 0, 0), (0, 0, 0, 0), "no rotation"),
        ((0, 0, 0), (0, 0, 2, 2), "no rotation"),
        ((np.nan, 0, 0), (0, 0, 0, 1), "not finite"),
        ((0, 0, 0), (0, 0, np.inf, 1), "not finite"),
    ],
)
def test_what_is_no_pose_is_refused(position: tuple[float, ...], orientation: tuple[float, ...], why: str) -> None:
    message = messages.odometry(1, "odom", "base_link", position, orientation)
    with pytest.raises(PoseError, match=why):
        pose_matrix(message.pose.pose)


STEP_NS = 50_000_000


def wheels(orientation: tuple[float, ...], seconds: float = 10.0) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the poses of a driver that fills in twists alone, 2 m/s with 0.2 rad/s, and the true one at the end."""
    poses = OdometryPoses("/odom")
    found = []
    for tick in range(round(seconds / 0.05) + 1):
        twist = ((2.0, 0.0, 0.0), (0.0, 0.0, 0.2))
        message = messages.odometry(tick * STEP_NS, "odom", "base_link", (0, 0, 0), orientation, *twist)
        found.append(poses.pose(message, tick * STEP_NS))
    turn = 0.2 * seconds
    return found, np.array([10.0 * np.sin(turn), 10.0 * (1.0 - np.cos(turn)), turn])


@pytest.mark.parametrize("orientation", [(0, 0, 0, 1), (0, 0, 0, 0)])
def test_twists_without_poses_are_integrated(orientation: tuple[float, ...], caplog: pytest.LogCaptureFixture) -> None:
    found, _ = wheels(orientation)
    start = next(i for i, T in enumerate(found) if not np.allclose(T, np.eye(4))) - 1
    assert start * 0.05 * 2.0 == pytest.approx(1.0, abs=0.15)  # what stands still until then has no pose
    _, (x, y, turn) = wheels((0, 0, 0, 1), (len(found) - 1 - start) * 0.05)
    np.testing.assert_allclose(found[-1][:2, 3], [x, y], atol=0.01)
    assert np.arctan2(found[-1][1, 0], found[-1][0, 0]) == pytest.approx(turn, abs=1e-6)
    assert caplog.text.count("'/odom' gives twists and no pose") == 2  # once a topic


def test_poses_go_before_twists(caplog: pytest.LogCaptureFixture) -> None:
    poses = OdometryPoses("/odom")
    for tick in range(100):
        message = messages.odometry(
            tick * STEP_NS, "odom", "base_link", (0.1 * tick, 0, 0), (0, 0, 0, 1), (9.0, 0, 0), (0, 0, 1.0)
        )
        assert poses.pose(message, tick * STEP_NS)[0, 3] == pytest.approx(0.1 * tick)
    assert not caplog.records


def test_a_robot_that_stands_has_a_pose() -> None:
    poses = OdometryPoses("/odom")
    for tick in range(100):
        message = messages.odometry(tick * STEP_NS, "odom", "base_link", (3, 4, 0), (0, 0, 0, 1))
        np.testing.assert_array_equal(poses.pose(message, tick * STEP_NS)[:3, 3], [3, 4, 0])
