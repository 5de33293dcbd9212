"""Rigid motions: the mounting's convention, round trips, levelling, and refusal of what is no motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crossloc3d_ros.clouds.filters import levelling_matrix, mounting_matrix, transform_points
from crossloc3d_ros.config import MountingConfig
from crossloc3d_ros.errors import CloudError

angles = st.floats(-180, 180)


@given(roll=angles, pitch=angles, yaw=angles)
@settings(max_examples=50, deadline=None)
def test_mounting_is_yaw_after_pitch_after_roll(roll: float, pitch: float, yaw: float) -> None:
    T = mounting_matrix(MountingConfig(x_m=1, y_m=2, z_m=3, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw))
    oracle = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    np.testing.assert_allclose(T[:3, :3], oracle, atol=1e-12)
    np.testing.assert_array_equal(T[:, 3], [1, 2, 3, 1])


def test_positive_pitch_points_the_nose_down() -> None:
    ahead = np.array([[10.0, 0.0, 0.0]])
    moved = transform_points(mounting_matrix(MountingConfig(z_m=0, pitch_deg=10)), ahead)
    assert moved[0, 2] < -1.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_there_and_back_is_the_identity_and_keeps_the_type(dtype: type) -> None:
    points = np.random.default_rng(0).normal(0, 30, (100, 3)).astype(dtype)
    T = mounting_matrix(MountingConfig(x_m=0.3, z_m=1.2, roll_deg=3, pitch_deg=-7, yaw_deg=120))
    back = transform_points(np.linalg.inv(T), transform_points(T, points))
    assert back.dtype == dtype
    np.testing.assert_allclose(back, points, atol=2e-5)


@given(st.floats(-60, 60), st.floats(-60, 60), st.floats(0.01, 20))
@settings(max_examples=50, deadline=None)
def test_levelling_rotates_up_to_z_whatever_its_length(roll: float, pitch: float, length: float) -> None:
    up = Rotation.from_euler("xy", [roll, pitch], degrees=True).apply([0, 0, 1.0])
    if up[2] < 0.21:
        return
    T = levelling_matrix(up * length)
    np.testing.assert_allclose(T[:3, :3] @ up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    # The smallest such rotation: its axis is level, so nothing is rotated about z.
    assert Rotation.from_matrix(T[:3, :3]).as_rotvec()[2] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("up", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1], [1, 0, 0], [0, 0, -9.8], [0, 1]])
def test_impossible_gravity_is_refused(up: list[float]) -> None:
    with pytest.raises(CloudError, match="gravity"):
        levelling_matrix(np.array(up))


@pytest.mark.parametrize(
    "T", [np.eye(3), np.zeros((4, 4)), np.full((4, 4), np.nan), 2 * np.eye(4), np.diag([1.0, 1, -1, 1])]
)
def test_what_is_no_rigid_motion_is_refused(T: np.ndarray) -> None:
    with pytest.raises(CloudError, match="T "):
        transform_points(T, np.zeros((1, 3)))


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((5, 2)), np.zeros((5, 3), np.int32), [[0, 0, 0]]])
def test_what_is_no_cloud_is_refused_by_name(points: np.ndarray) -> None:
    with pytest.raises(CloudError, match="points must"):
        transform_points(np.eye(4), points)
