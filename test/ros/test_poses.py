"""Poses from messages and to messages: frames, covariances, refusals, waiting."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovariance
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from crossloc3d_ros.errors import CloudError, ConfigError, PoseError
from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.ros import conversions
from crossloc3d_ros.ros.conversions import (
    candidate_table_message,
    candidates_message,
    fix_message,
    header_message,
    hypotheses_message,
    in_map,
    markers_message,
    pose_of_matrix,
    stale_message,
    state_message,
    transform_message,
)
from crossloc3d_ros.ros.odometry_input import OdometryInput, OdometrySample, OdometryState, odometry_complaint
from crossloc3d_ros.ros.poses import heading_prior, initial_pose
from crossloc3d_ros.ros.transforms import MapTransform
from crossloc3d_ros.types import FixStatus, TrackState

# Three degrees west of the zone's middle, so that grid north is not north.
FRAME = MapFrame("EPSG:32632", np.array([295_000.0, 5_804_000.0, 2.0]), 43.0)
BOUNDS = (294_000.0, 5_803_000.0, 296_000.0, 5_805_000.0)
STAMP_NS = 1_700_000_000_000_000_000

angles = st.floats(-3.1, 3.1)
metres = st.floats(-900.0, 900.0)


def in_grid(frame: MapFrame, enu: np.ndarray, yaw: float) -> tuple[np.ndarray, float]:
    grid, heading = conversions.in_grid(frame, enu[None], np.array([yaw]))
    return grid[0], float(heading[0])


def pose_message(T: np.ndarray, covariance: np.ndarray) -> PoseWithCovariance:
    return PoseWithCovariance(pose=pose_of_matrix(T), covariance=[float(v) for v in covariance.flat])


def motion(x: float, y: float, z: float, yaw: float, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    T[:3, 3] = x, y, z
    return T


# Frames


@given(metres, metres, angles)
def test_a_pose_in_the_map_is_one_in_the_grid_and_back(x: float, y: float, yaw: float) -> None:
    enu = np.array([x, y, 3.0])
    grid, heading = in_grid(FRAME, enu, yaw)
    back, yaws = in_map(FRAME, grid[None], np.array([heading]))
    np.testing.assert_allclose(back[0], enu, atol=1e-6)
    assert math.remainder(yaws[0] - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    # At the map's origin the frames differ by the convergence, here more than two degrees.
    convergence = float(FRAME.convergence_rad(FRAME.origin[None])[0])
    assert abs(convergence) > math.radians(2.0)
    assert math.remainder(heading - yaw - convergence, 2 * math.pi) == pytest.approx(0.0, abs=5e-4)


@settings(max_examples=30)
@given(metres, metres, angles, st.integers(0, 1000))
def test_an_initial_pose_is_the_same_in_whatever_frame_it_is_given(x: float, y: float, yaw: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * np.array([3.0, 2.0, 1.0, 0.02, 0.02, 0.2])[:, None]
    covariance = root @ root.T + np.diag([1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-2])
    T_map_base = motion(x, y, 1.0, yaw)
    plain = initial_pose(pose_message(T_map_base, covariance), STAMP_NS, np.eye(4), FRAME, BOUNDS)
    T_map_earth = np.linalg.inv(FRAME.pose_on_earth)
    R = np.kron(np.eye(2), T_map_earth[:3, :3])
    rotated = pose_message(FRAME.pose_on_earth @ T_map_base, R.T @ covariance @ R)
    other = initial_pose(rotated, STAMP_NS, T_map_earth, FRAME, BOUNDS)
    for prior in (plain, other):
        grid, heading = in_grid(FRAME, T_map_base[:3, 3], yaw)
        assert prior.grid is not None
        assert prior.heading_rad is not None
        np.testing.assert_allclose(prior.grid, grid, atol=1e-5)
        assert math.remainder(prior.heading_rad - heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-7)
    np.testing.assert_allclose(plain.covariance, other.covariance, atol=1e-5)
    # East and north of the grid are those of the map but for the convergence; the heading's variance stays.
    np.testing.assert_allclose(np.trace(plain.covariance[:2, :2]), np.trace(covariance[:2, :2]), rtol=1e-6)
    assert plain.covariance[2, 2] == pytest.approx(covariance[5, 5])


def test_an_initial_pose_marks_what_it_does_not_know() -> None:
    known = np.diag([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])

    def prior(covariance: np.ndarray) -> Any:
        return initial_pose(pose_message(motion(5, 6, 0, 1.0), covariance), STAMP_NS, np.eye(4), FRAME, BOUNDS)

    no_heading = known.copy()
    no_heading[5, 5] = 1e6
    assert prior(no_heading).heading_rad is None
    np.testing.assert_allclose(np.diag(prior(no_heading).covariance)[:2], 1.0, rtol=1e-6)
    assert np.isinf(prior(no_heading).covariance[2, 2])
    no_place = known.copy()
    no_place[0, 0] = no_place[1, 1] = np.inf
    assert prior(no_place).grid is None
    assert prior(no_place).covariance[2, 2] == pytest.approx(0.01)
    # Zeros mean that they were not filled in, and no better value is known.
    assert math.sqrt(prior(np.zeros((6, 6))).covariance[0, 0]) == pytest.approx(2.0)
    assert math.sqrt(prior(known * 1e-9).covariance[0, 0]) == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize(
    ("T", "covariance", "reason"),
    [
        (motion(4_000.0, 0, 0, 0), np.eye(6), "2,9.. m outside of the map"),
        (motion(1e12, 0, 0, 0), np.eye(6), "outside of the map"),
        (motion(0, 0, 0, 0, roll=math.pi), np.eye(6), "z must point up"),
        (motion(0, 0, 0, 0), -np.eye(6), "variances must not be negative"),
        (motion(0, 0, 0, 0), np.full((6, 6), np.nan), "its covariance is none"),
        (motion(0, 0, 0, 0), 2.0 * np.ones((6, 6)) - np.eye(6), "correlations exceed 1"),
        (motion(0, 0, 0, 0), np.diag(np.full(6, np.inf)), "neither position nor heading"),
    ],
)
def test_an_initial_pose_that_is_none_is_refused(T: np.ndarray, covariance: np.ndarray, reason: str) -> None:
    with pytest.raises(PoseError, match=reason):
        initial_pose(pose_message(T, covariance), STAMP_NS, np.eye(4), FRAME, BOUNDS)


def test_an_initial_pose_that_is_not_a_number_is_refused() -> None:
    message = pose_message(np.eye(4), np.eye(6))
    message.pose.position.x = math.nan
    with pytest.raises(PoseError, match="not finite"):
        initial_pose(message, STAMP_NS, np.eye(4), FRAME, BOUNDS)
    message = pose_message(np.eye(4), np.eye(6))
    message.pose.orientation.w = 0.0
    with pytest.raises(PoseError, match="no rotation"):
        initial_pose(message, STAMP_NS, np.eye(4), FRAME, BOUNDS)


# The heading of an IMU


def imu_message(R_world_imu: Rotation, R_ned: np.ndarray | None = None) -> Imu:
    """An IMU at rest: its orientation in ENU, or in the frame that `R_ned` rotates ENU to."""
    message = Imu(header=header_message(STAMP_NS, "imu"))
    force = R_world_imu.inv().apply([0.0, 0.0, 9.81])
    message.linear_acceleration.x, message.linear_acceleration.y, message.linear_acceleration.z = map(float, force)
    orientation = R_world_imu if R_ned is None else Rotation.from_matrix(R_ned) * R_world_imu
    q = message.orientation
    q.x, q.y, q.z, q.w = (float(v) for v in orientation.as_quat())
    return message


@given(angles, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), angles, st.floats(-180, 180))
def test_the_heading_is_that_of_the_base_in_the_grid(
    yaw: float, pitch: float, roll: float, rotated: float, offset_deg: float
) -> None:
    R_world_base = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    R_base_imu = Rotation.from_euler("ZYX", [rotated, 0.1, 3.0])  # mounted upside down and aslant
    message = imu_message(R_world_base * R_base_imu)
    offset_rad = math.radians(offset_deg)
    prior = heading_prior(message, R_base_imu.as_matrix(), FRAME, math.radians(15.0), offset_rad)
    assert prior is not None
    assert prior.grid is None
    assert prior.heading_rad is not None
    _, heading = in_grid(FRAME, np.zeros(3), yaw + offset_rad)
    assert math.remainder(prior.heading_rad - heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    assert math.sqrt(prior.covariance[2, 2]) == pytest.approx(math.radians(15.0))
    assert np.isinf(prior.covariance[[0, 1], [0, 1]]).all()


def test_an_orientation_of_another_convention_is_refused() -> None:
    R_ned_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    with pytest.raises(PoseError, match=r"does not point up: .*east, north, up \(REP-145\)"):
        heading_prior(imu_message(Rotation.identity(), R_ned_enu), np.eye(3), FRAME, 0.2, 0.0)
    none = imu_message(Rotation.identity())
    none.orientation_covariance[0] = -1.0
    assert heading_prior(none, np.eye(3), FRAME, 0.2, 0.0) is None
    with pytest.raises(PoseError, match="lies on its side"):
        heading_prior(imu_message(Rotation.from_euler("x", 90, degrees=True)), np.eye(3), FRAME, 0.2, 0.0)


# Odometry


def odometry_message(stamp_ns: int, T: np.ndarray, child_frame_id: str = "base_link") -> Odometry:
    message = Odometry(header=header_message(stamp_ns, "odom"), child_frame_id=child_frame_id)
    message.pose.pose = pose_of_matrix(T)
    return message


def odometry_input(timeout_s: float = 0.5, odom_frame_id: str = "", **how: Any) -> OdometryInput:
    return OdometryInput("base_link", odom_frame_id, timeout_s, **how)


def fill(odometry: OdometryInput, seconds: float, step_s: float = 0.02, begin_s: float = 0.0) -> None:
    """A robot on a ramp, in a bend: 2 m/s."""
    for i in range(round(seconds / step_s) + 1):
        t = begin_s + i * step_s
        odometry.take(odometry_message(STAMP_NS + round(t * 1e9), on_the_ramp(t)))


def on_the_ramp(t: float) -> np.ndarray:
    return motion(2.0 * t, 0.0, 0.2 * t, 0.3 * t, pitch=-0.1, roll=0.02)


def test_a_scan_waits_for_the_odometry_of_its_stamp_but_not_for_a_silent_one(monkeypatch: pytest.MonkeyPatch) -> None:
    odometry, taken = odometry_input(timeout_s=5.0), []

    def add(sample: OdometrySample) -> bool:
        taken.append(sample.stamp_ns)
        return sample.stamp_ns >= STAMP_NS + 1_000_000_000

    fill(odometry, 0.5)
    late = threading.Timer(0.1, lambda: fill(odometry, 0.5, begin_s=0.52))
    late.start()
    odometry.wait(add)
    late.join()
    assert taken == [STAMP_NS + 20_000_000 * i for i in range(51)], "all in their order, and none beyond"
    assert [sample.stamp_ns for sample in odometry.drain()] == [STAMP_NS + 1_020_000_000], "what came later is kept"
    # Nothing comes any more: it gives up.
    begun = time.monotonic()
    odometry_input(timeout_s=0.05).wait(add)
    assert time.monotonic() - begun < 2.0
    now = time.monotonic()
    monkeypatch.setattr("crossloc3d_ros.ros.odometry_input.time.monotonic", lambda: now + 2.0)
    odometry.wait(add)  # and that without waiting, or this test would not end: its clock stands


def test_odometry_without_scans_fills_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    odometry = odometry_input()
    fill(odometry, 500.0, step_s=0.02)
    samples = odometry.drain()
    assert len(samples) == 24_000
    assert samples[-1].stamp_ns == STAMP_NS + 500_000_000_000, "the newest are kept"


def test_odometry_in_another_frame_than_the_one_named_is_refused() -> None:
    odometry = odometry_input(odom_frame_id="odom_wheels")
    with pytest.raises(PoseError, match="given in 'odom', not in 'odom_wheels': set odom_frame_id to 'odom'"):
        odometry.take(odometry_message(STAMP_NS, np.eye(4)))
    odometry = odometry_input(odom_frame_id="odom")
    odometry.take(odometry_message(STAMP_NS, np.eye(4)))
    assert [sample.odom_frame_id for sample in odometry.drain()] == ["odom"]


def test_odometry_of_another_frame_is_brought_to_the_base_where_tf_relates_them() -> None:
    T_base_imu = motion(0.4, 0.1, 0.3, 2.0, pitch=0.2)
    odometry = odometry_input(pose_on_base=lambda frame: T_base_imu)
    odometry.take(odometry_message(STAMP_NS, on_the_ramp(0.0) @ T_base_imu, "imu_link"))
    (sample,) = odometry.drain()
    np.testing.assert_allclose(sample.T_odom_base, on_the_ramp(0.0), atol=1e-9)

    def nothing(frame: str) -> np.ndarray:
        raise CloudError(f"TF has no pose of '{frame}' on 'base_link'")

    for how, reason in (({}, "set base_frame_id to 'imu_link'"), ({"pose_on_base": nothing}, "TF has no pose")):
        odometry = odometry_input(**how)
        with pytest.raises((PoseError, CloudError), match=reason):
            odometry.take(odometry_message(STAMP_NS, np.eye(4), "imu_link"))
        assert reason in odometry.state().complaint
        odometry.take(odometry_message(STAMP_NS, np.eye(4)))
        assert odometry.state().complaint == "", "it is good again"


@pytest.mark.parametrize(
    ("state", "publishers", "words"),
    [
        (OdometryState(9, 0.1, ""), 1, ""),
        (OdometryState(9, 7.0, ""), 1, "has been silent for 7 s"),
        (OdometryState(0, 7.0, ""), 2, r"no odometry has come on /odom (2 publishers)"),
        (OdometryState(0, 7.0, ""), 0, "set odometry to scan or none"),
        (OdometryState(9, 0.1, "it is upside down"), 1, "is not used: it is upside down"),
    ],
)
def test_what_is_wrong_with_the_odometry_is_reported(state: OdometryState, publishers: int, words: str) -> None:
    complaint = odometry_complaint(state, "/odom", publishers)
    assert words in complaint
    assert bool(complaint) == bool(words)


# Messages of poses


def test_every_message_can_be_made_of_an_estimate_that_knows_nothing() -> None:
    estimate = no_estimate(STAMP_NS, "the scan is empty")
    assert math.isnan(fix_message(estimate, "base_link").latitude)
    assert candidates_message(estimate, FRAME, "map").poses == []
    assert hypotheses_message(estimate, FRAME, "map").poses == []
    assert candidate_table_message(estimate, FRAME, "map").width == 0
    texts = [marker.text for marker in markers_message(estimate, FRAME, "map").markers]
    assert texts[-1] == "the scan is empty"
    assert state_message(estimate, "localizer").message == "searching: the scan is empty"


@pytest.mark.parametrize(
    ("state", "status", "level"),
    [
        (TrackState.LOCALIZED, FixStatus.FIX, DiagnosticStatus.OK),
        (TrackState.LOCALIZED, FixStatus.NO_FIX, DiagnosticStatus.WARN),
        (TrackState.AMBIGUOUS, FixStatus.NO_FIX, DiagnosticStatus.WARN),
        (TrackState.SEARCHING, FixStatus.NO_FIX, DiagnosticStatus.WARN),
        (TrackState.LOST, FixStatus.NO_FIX, DiagnosticStatus.ERROR),
    ],
)
def test_only_a_fix_is_well(state: TrackState, status: FixStatus, level: bytes) -> None:
    estimate = replace(no_estimate(STAMP_NS, "because"), state=state, status=status)
    message = state_message(estimate, "localizer")
    assert message.level == level
    assert message.message == f"{state.value}: because"
    assert {v.key: v.value for v in message.values}["stamp_ns"] == str(STAMP_NS)
    assert stale_message(state, "silence", "localizer").level == DiagnosticStatus.STALE


@given(angles, st.floats(-1.5, 1.5), angles)
def test_a_pose_is_the_matrix_that_it_was_made_of(yaw: float, pitch: float, roll: float) -> None:
    T = motion(1.0, -2.0, 3.0, yaw, pitch, roll)
    np.testing.assert_allclose(pose_matrix(pose_of_matrix(T)), T, atol=1e-9)
    transform = transform_message(T, STAMP_NS, "map", "odom").transform
    assert (transform.translation.y, transform.rotation) == (-2.0, pose_of_matrix(T).orientation)


def test_tf_is_missed_by_name() -> None:
    with pytest.raises(ConfigError, match="tf_broadcast needs tf2_ros, which is not installed"):
        MapTransform(None, "map", 0)
