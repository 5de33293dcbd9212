"""Poses of messages as matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.formats import messages
from crossloc3d_ros.formats.odometry import pose_matrix


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
