"""Motion between two stamps: from samples of odometry, and from scans."""

from __future__ import annotations

import math
import sys

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.localization.fusion.odometry import OdometryBuffer, ScanOdometry

Array = npt.NDArray[np.float64]

CONFIG = FusionConfig()
SECOND = 1_000_000_000
STEP_NS = SECOND // 50


def pose(x: float, y: float, heading: float, roll: float = 0.0, pitch: float = 0.0) -> Array:
    """T_odom_base (4, 4): heading about z, then pitch about y, then roll about x."""
    cz, sz, cy, sy, cx, sx = (f(a) for a in (heading, pitch, roll) for f in (math.cos, math.sin))
    T = np.eye(4)
    T[:3, :3] = (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    )
    T[:3, 3] = x, y, 0.3
    return T


def circle(stamp_ns: int, speed: float = 2.0, rate: float = 0.5, **tilt: float) -> Array:
    """Drive a circle: the pose at a stamp."""
    angle = rate * stamp_ns * 1e-9
    radius = speed / rate
    return pose(radius * math.sin(angle), radius * (1 - math.cos(angle)), angle, **tilt)


def filled(first_ns: int = 0, last_ns: int = 10 * SECOND, **tilt: float) -> OdometryBuffer:
    buffer = OdometryBuffer(CONFIG)
    for stamp_ns in range(first_ns, last_ns + 1, STEP_NS):
        assert buffer.add(stamp_ns, circle(stamp_ns, **tilt))
    return buffer


def relative(first: Array, second: Array) -> Array:
    T = np.linalg.inv(first) @ second
    return np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])


@given(st.integers(0, 10 * SECOND), st.integers(0, 10 * SECOND))
def test_the_motion_is_that_of_the_poses_at_both_stamps(one: int, other: int) -> None:
    begin, end = sorted((one, other))
    motion = BUFFER.motion(begin, end)
    assert motion.is_known
    expected = relative(circle(begin), circle(end))
    np.testing.assert_allclose(motion.delta[:2], expected[:2], atol=1e-3)
    # More than half a turn is told in full.
    assert motion.delta[2] == pytest.approx(0.5 * (end - begin) * 1e-9, abs=1e-6)


BUFFER = filled()


def test_motions_follow_each_other() -> None:
    first, second, both = BUFFER.motion(SECOND, 2 * SECOND), BUFFER.motion(2 * SECOND, 5 * SECOND), BUFFER.motion(
        SECOND, 5 * SECOND
    )  # fmt: skip
    cosine, sine = math.cos(first.delta[2]), math.sin(first.delta[2])
    turned = np.array([[cosine, -sine], [sine, cosine]]) @ second.delta[:2]
    np.testing.assert_allclose(first.delta[:2] + turned, both.delta[:2], atol=1e-9)


def test_a_tilted_base_moves_as_a_level_one() -> None:
    tilted = filled(roll=0.1, pitch=-0.2)
    np.testing.assert_allclose(
        tilted.motion(SECOND, 4 * SECOND).delta, BUFFER.motion(SECOND, 4 * SECOND).delta, atol=1e-9
    )


def test_the_covariance_grows_with_the_way_and_not_with_the_distance_alone() -> None:
    turn_ns = round(2 * math.pi / 0.5 * SECOND)
    buffer = filled(0, turn_ns + SECOND)
    around = buffer.motion(0, turn_ns)
    np.testing.assert_allclose(around.delta[:2], 0.0, atol=0.01)
    length = 2.0 * turn_ns * 1e-9
    assert math.sqrt(around.covariance[0, 0]) == pytest.approx(CONFIG.odometry_relative_std * length, rel=0.01)
    still = buffer.motion(SECOND, SECOND)
    assert 0 < still.covariance[0, 0] < 0.02**2, "no motion is free of error"
    np.testing.assert_allclose(still.delta, 0, atol=1e-12)


def test_beyond_the_newest_sample_it_goes_on_for_a_while() -> None:
    ahead = BUFFER.motion(9 * SECOND, 10 * SECOND + SECOND // 10)
    assert ahead.is_known
    expected = relative(circle(9 * SECOND), circle(10 * SECOND + SECOND // 10))
    np.testing.assert_allclose(ahead.delta, expected, atol=0.02)
    stopped = BUFFER.motion(9 * SECOND, 11 * SECOND)
    assert not stopped.is_known
    assert "has stopped 1 s before the scan" in stopped.reason


def without(buffer: OdometryBuffer, begin: int, end: int) -> OdometryBuffer:
    for stamp_ns in range(0, 10 * SECOND + 1, STEP_NS):
        if not begin < stamp_ns < end:
            buffer.add(stamp_ns, circle(stamp_ns))
    return buffer


def test_a_gap_makes_what_touches_it_unknown() -> None:
    buffer = without(OdometryBuffer(CONFIG), 4 * SECOND, 5 * SECOND)
    for begin, end in ((3.0, 6.0), (4.2, 4.4), (4.5, 8.0), (1.0, 4.1)):
        motion = buffer.motion(round(begin * SECOND), round(end * SECOND))
        assert not motion.is_known
        assert "has a gap of 1 s" in motion.reason
    assert buffer.motion(SECOND, 4 * SECOND).is_known
    assert buffer.motion(5 * SECOND, 9 * SECOND).is_known


@pytest.mark.parametrize(
    ("jump", "reason"), [((3.0, 0.0, 0.0), "jumps by 3 m"), ((0.0, 0.0, 1.0), "jumps by 57 degrees")]
)
def test_a_jump_makes_what_crosses_it_unknown(jump: tuple[float, float, float], reason: str) -> None:
    buffer = OdometryBuffer(CONFIG)
    for stamp_ns in range(0, 10 * SECOND + 1, STEP_NS):
        late = stamp_ns > 5 * SECOND
        buffer.add(stamp_ns, pose(*(j * late for j in jump)))
    crossing = buffer.motion(4 * SECOND, 6 * SECOND)
    assert not crossing.is_known
    assert reason in crossing.reason
    assert buffer.motion(SECOND, 5 * SECOND).is_known
    assert buffer.motion(6 * SECOND, 9 * SECOND).is_known


def test_before_the_first_sample_and_without_any_nothing_is_known() -> None:
    assert "there is no odometry" in OdometryBuffer(CONFIG).motion(0, SECOND).reason
    late = filled(2 * SECOND)
    assert "begins 1 s after the last scan" in late.motion(SECOND, 4 * SECOND).reason
    assert "time goes backwards by 1 s" in late.motion(5 * SECOND, 4 * SECOND).reason


def test_late_and_repeated_samples_change_nothing() -> None:
    buffer = filled()
    assert not buffer.add(10 * SECOND, pose(99, 99, 0))
    assert not buffer.add(9 * SECOND, pose(99, 99, 0))
    np.testing.assert_array_equal(buffer.motion(SECOND, 10 * SECOND).delta, BUFFER.motion(SECOND, 10 * SECOND).delta)


def test_a_recording_that_begins_anew_is_a_new_odometry() -> None:
    buffer = filled()
    assert buffer.add(0, circle(0))
    assert len(buffer) == 1
    assert not buffer.motion(5 * SECOND, 6 * SECOND).is_known
    for stamp_ns in range(STEP_NS, SECOND + 1, STEP_NS):
        buffer.add(stamp_ns, circle(stamp_ns))
    assert buffer.motion(0, SECOND).is_known


@pytest.mark.parametrize(
    "broken",
    [np.full((4, 4), np.nan), np.zeros((4, 4)), 2 * np.eye(4), np.eye(3), pose(0, 0, 0, pitch=math.pi / 2)],
)
def test_a_pose_that_is_none_is_refused(broken: Array) -> None:
    buffer = filled()
    assert not buffer.add(11 * SECOND, broken)
    assert buffer.newest_ns == 10 * SECOND
    motion = buffer.motion(10 * SECOND, 11 * SECOND)
    assert not motion.is_known
    assert "is not a pose" in motion.reason


def test_a_long_drive_keeps_what_is_needed_only() -> None:
    buffer = OdometryBuffer(CONFIG)
    for k in range(20_000):
        buffer.add(k * STEP_NS, pose(k * 0.01, 0, 0))
    assert len(buffer) < 15_000
    newest = buffer.newest_ns
    assert newest is not None
    np.testing.assert_allclose(buffer.motion(newest - 60 * SECOND, newest).delta, [30, 0, 0], atol=1e-9)


def test_without_the_library_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    with pytest.raises(ConfigError, match=r"pip install 'crossloc3d_ros\[odometry\]'"):
        ScanOdometry(CONFIG)


# From the scans


def room(at: Array) -> Array:
    """Return what a lidar at T_room_base sees of pillars and walls of a yard, (N, 3) in its own frame."""
    rng = np.random.default_rng(0)
    walls = [
        np.column_stack([rng.uniform(-40, 40, 6000), np.full(6000, side), rng.uniform(-1, 6, 6000)])
        for side in (-15.0, 15.0)
    ]
    ends = [
        np.column_stack([np.full(3000, side), rng.uniform(-15, 15, 3000), rng.uniform(-1, 6, 3000)])
        for side in (-40.0, 40.0)
    ]
    angles = rng.uniform(0, 2 * np.pi, (24, 300))
    middle = rng.uniform([-38, -13], [38, 13], (24, 2))
    pillars = np.stack(
        [middle[:, :1] + 0.4 * np.cos(angles), middle[:, 1:] + 0.4 * np.sin(angles), rng.uniform(-1, 4, (24, 300))], -1
    ).reshape(-1, 3)
    ground = np.column_stack([rng.uniform(-40, 40, 4000), rng.uniform(-15, 15, 4000), np.full(4000, -1.0)])
    points = np.vstack([*walls, *ends, pillars, ground])
    return np.asarray((points - at[:3, 3]) @ at[:3, :3])


def test_scans_tell_how_the_robot_moved() -> None:
    pytest.importorskip("kiss_icp")
    scans = ScanOdometry(CONFIG)
    path = [pose(-20 + 0.4 * k, 0.02 * k, 0.01 * k) for k in range(16)]
    for k, at in enumerate(path):
        assert scans.add(k * SECOND // 10, room(at))
    motion = scans.motion(5 * SECOND // 10, 15 * SECOND // 10)
    assert motion.is_known
    np.testing.assert_allclose(motion.delta, relative(path[5], path[15]), atol=0.1)


def test_scans_too_far_apart_in_time_tell_nothing_and_a_new_recording_begins_anew() -> None:
    pytest.importorskip("kiss_icp")
    scans = ScanOdometry(CONFIG)
    for k in range(3):
        scans.add(k * SECOND // 10, room(pose(0.2 * k, 0, 0)))
    scans.add(5 * SECOND, room(pose(2, 0, 0)))
    assert "has a gap of 4.8 s" in scans.motion(SECOND // 5, 5 * SECOND).reason
    assert not scans.add(5 * SECOND - 1, room(pose(2, 0, 0))), "late"
    assert scans.add(0, room(pose(2, 0, 0)))
    assert not scans.motion(SECOND // 5, 5 * SECOND).is_known
    points = room(pose(2.1, 0, 0))
    points[::7] = np.nan
    assert scans.add(SECOND // 10, points)
    np.testing.assert_allclose(scans.motion(0, SECOND // 10).delta, [0.1, 0, 0], atol=0.05)
    assert not scans.add(SECOND // 5, np.empty((0, 3))), "a scan without points"


# The pose at a stamp


def on_the_ramp(t: float) -> np.ndarray:
    """A robot on a ramp, in a bend: 2 m/s."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [0.3 * t, -0.1, 0.02]).as_matrix()
    T[:3, 3] = [2.0 * t, 0.0, 0.2 * t]
    return T


def fill(buffer: OdometryBuffer, seconds: float, step_s: float = 0.02, begin_s: float = 0.0) -> None:
    for i in range(round(seconds / step_s) + 1):
        t = begin_s + i * step_s
        buffer.add(START_NS + round(t * 1e9), on_the_ramp(t))


START_NS = 1_700_000_000_000_000_000


def test_the_whole_pose_is_interpolated() -> None:
    buffer = OdometryBuffer(FusionConfig())
    fill(buffer, 1.0)
    for t in np.random.default_rng(0).uniform(0.0, 1.0, 100):
        T = buffer.pose_at(START_NS + round(t * 1e9))
        assert T is not None
        np.testing.assert_allclose(T, on_the_ramp(t), atol=1e-4)


def test_no_pose_is_given_where_none_is_known() -> None:
    buffer = OdometryBuffer(FusionConfig())
    assert buffer.pose_at(START_NS) is None
    fill(buffer, 1.0)
    assert buffer.pose_at(START_NS - 1) is None
    assert buffer.pose_at(START_NS + 1_000_000_001) is None
    fill(buffer, 1.0, begin_s=5.0)
    assert buffer.pose_at(START_NS + 3_000_000_000) is None, "in a gap"
    jump = on_the_ramp(6.02)
    jump[0, 3] += 30.0
    buffer.add(START_NS + 6_020_000_000, jump)
    assert buffer.pose_at(START_NS + 6_010_000_000) is None, "in a jump"
    fill(buffer, 0.1)
    assert buffer.pose_at(START_NS + 50_000_000) is not None, "a recording that begins again"
    assert buffer.pose_at(START_NS + 5_500_000_000) is None


def test_whole_poses_are_kept_for_the_newest_samples_alone() -> None:
    buffer = OdometryBuffer(FusionConfig())
    fill(buffer, 50.0)
    assert buffer.pose_at(START_NS + 5_000_000_000) is None
    T = buffer.pose_at(START_NS + 45_010_000_000)
    assert T is not None
    np.testing.assert_allclose(T, on_the_ramp(45.01), atol=1e-4)
    assert buffer.motion(START_NS + 5_000_000_000, START_NS + 6_000_000_000).is_known


def test_other_settings_hold_for_the_samples_that_are_there_too() -> None:
    slow, fast = FusionConfig(max_speed_mps=1.0), FusionConfig(max_speed_mps=10.0)
    buffer = OdometryBuffer(fast)
    fill(buffer, 1.0, step_s=0.25)
    way = START_NS, START_NS + 1_000_000_000
    before = buffer.motion(*way)
    assert before.is_known
    buffer.reconfigure(slow)
    assert "jumps by" in buffer.motion(*way).reason
    buffer.reconfigure(fast)
    again = buffer.motion(*way)
    assert again.is_known
    np.testing.assert_array_equal(again.delta, before.delta)
    buffer.reconfigure(FusionConfig(odometry_max_gap_s=0.1))
    assert "gap" in buffer.motion(*way).reason
