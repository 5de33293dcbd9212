"""The frame that a cloud names decides what the mounting of the lidar does to it."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.clouds.filters import mounting_matrix, transform_points
from crossloc3d_ros.clouds.frames import CloudFrames
from crossloc3d_ros.config import MountingConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import Scan

MOUNTING = MountingConfig(x_m=1.5, z_m=1.2, yaw_deg=30.0)
POINTS = np.random.default_rng(0).normal(0, 20, (50, 3)).astype(np.float32)


def scan(frame_id: str) -> Scan:
    return Scan(POINTS, 1, frame_id)


def test_a_cloud_of_the_lidar_is_moved_by_its_mounting_alone() -> None:
    frames = CloudFrames(MOUNTING)
    np.testing.assert_array_equal(frames(scan("velodyne")).points, POINTS)


@pytest.mark.parametrize("frame_id", ["base_link", "/base_link", "base_footprint", "robot"])
def test_a_cloud_in_the_base_stays_where_it_is(frame_id: str, caplog: pytest.LogCaptureFixture) -> None:
    frames = CloudFrames(MOUNTING, "robot")
    for _ in range(2):
        mounted = transform_points(mounting_matrix(MOUNTING), frames(scan(frame_id)).points)
        np.testing.assert_allclose(mounted, POINTS, atol=1e-4)
    assert caplog.text.count("already") == 1


def test_two_lidars_on_one_topic_are_told_by_name() -> None:
    frames = CloudFrames(MOUNTING)
    for _ in range(2):
        frames(scan("front"))
        with pytest.raises(CloudError, match=r"two frames, 'front' and 'rear'.*a topic of its own"):
            frames(scan("rear"))
