"""What the localizer is told along a journey, and what is kept of what it answers."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.datasets.pose_drives import DrivePlan, Journey, Leg, RawDrive
from crossloc3d_ros.datasets.raw_scans import RawScan, RawScans
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.evaluation.poses.page import write_pose_page
from crossloc3d_ros.evaluation.poses.predictions import (
    ALIGNED,
    SINGLE,
    PoseAbout,
    grid_pose,
    join,
    number_of_alone,
    predict_journey,
    predict_singles,
)
from crossloc3d_ros.evaluation.poses.scores import score_poses
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.types import AlignedPoses, Candidates, Estimate, FixStatus, Float64Array, Scan, TrackState

FRAME = MapFrame("EPSG:32631", np.array([628_400.0, 5_803_200.0, 0.0]), 43.0)
"""East of its zone's middle: grid north and true north differ by more than a degree."""


def pose_at(x: float, y: float, heading: float) -> Float64Array:
    cosine, sine = math.cos(heading), math.sin(heading)
    T = np.eye(4)
    T[:2, :2] = [[cosine, -sine], [sine, cosine]]
    T[:3, 3] = [628_400.0 + x, 5_803_200.0 + y, 1.0]
    return T


def estimate_of(T_grid_base: Float64Array, stamp_ns: int, fix: bool = True) -> Estimate:
    """Return the estimate of one who knows the pose, in the frame map as the localizer gives it."""
    grid = T_grid_base[None, :3, 3]
    turn = float(FRAME.convergence_rad(grid)[0])
    heading = math.atan2(T_grid_base[1, 0], T_grid_base[0, 0])
    T = np.eye(4)
    cosine, sine = math.cos(heading - turn), math.sin(heading - turn)
    T[:2, :2] = [[cosine, -sine], [sine, cosine]]
    T[:3, 3] = FRAME.to_enu(grid)[0]
    covariance = np.diag([0.01, 0.04, 1.0, 1.0, 1.0, 1e-4])
    aligned = AlignedPoses(
        grid, np.array([heading]), np.diag([0.01, 0.04, 1e-4])[None], np.array([20.0]), np.array([0.99]),
        np.array([0.9]), np.array([True]), np.array([0]), -10.0,
    )  # fmt: skip
    candidates = Candidates(
        np.array([1]), np.array([0.1], np.float32), np.array([0.9]), grid + np.array([10.0, 0.0, 0.0])
    )
    return dataclasses.replace(
        no_estimate(stamp_ns, "known"), status=FixStatus.FIX if fix else FixStatus.NO_FIX, grid=grid[0],
        candidates=candidates, state=TrackState.LOCALIZED, probability=0.9999, T_map_base=T,
        pose_covariance=covariance, aligned=aligned,
    )  # fmt: skip


class Knowing:
    """A localizer that is told the poses of the scans by their points, and writes down what it is asked."""

    def __init__(self) -> None:
        self.config = LocalizerConfig()
        self.asked: list[tuple[str, object]] = []
        self.stamp_ns: int | None = None

    def localize(self, scan: Scan, gravity_base=None, T_base_lidar=None, motion=None) -> Estimate:
        if not len(scan.points):
            raise CloudError("the cloud is empty")
        motion = motion() if callable(motion) else motion
        self.asked.append(("scan", (scan.stamp_ns, gravity_base, T_base_lidar, motion)))
        self.stamp_ns = scan.stamp_ns
        x, y, heading = scan.points[0].astype(np.float64)
        return estimate_of(pose_at(x, y, heading), scan.stamp_ns)

    def reset(self) -> None:
        self.asked.append(("reset", None))
        self.stamp_ns = None


def scan_at(x: float, y: float, heading: float, stamp_ns: int = 0, area: int = 0) -> RawScan:
    points = np.array([[x, y, heading]], np.float32)
    mounting = np.eye(4)
    mounting[2, 3] = 1.3
    return RawScan(points, pose_at(x, y, np.float32(heading)), mounting, np.array([0.0, 0.0, 1.0]), stamp_ns, area)


def straight_drive(area: int = 0, count: int = 12) -> RawDrive:
    stamps = 2_000_000_000 + 500_000_000 * np.arange(count)
    scans = RawScans.of(scan_at(float(i), 50.0 * area, 0.0, int(stamps[i]), area) for i in range(count))
    times = np.arange(stamps[0] - 100_000_000, stamps[-1] + 100_000_000, 20_000_000)
    odometry = np.column_stack([(times - stamps[0]) / 500e6, np.zeros((len(times), 2))])
    return RawDrive(DrivePlan("straight", area, 12.0, 2.0, 5, 0, True, 1.3, 0.0), scans, times, odometry)


def test_a_pose_in_the_frame_map_is_one_in_the_grid() -> None:
    assert abs(math.degrees(float(FRAME.convergence_rad(np.array([[628_400.0, 5_803_200.0, 0.0]]))[0]))) > 1.0
    for heading in (-3.0, -1.0, 0.0, 0.4, 3.1):
        T = pose_at(120.0, -40.0, heading)
        pose, covariance = grid_pose(estimate_of(T, 0), FRAME)
        np.testing.assert_allclose(pose[:3], T[:3, 3], atol=1e-3)
        assert pose[3] == pytest.approx(heading, abs=1e-6)
        assert np.trace(covariance[:2, :2]) == pytest.approx(0.05)
        assert covariance[0, 1] != 0.0  # turned with the axes
        assert covariance[2, 2] == pytest.approx(1e-4)


def test_a_place_without_a_pose_is_kept_as_a_place() -> None:
    estimate = dataclasses.replace(
        estimate_of(pose_at(1, 2, 0.0), 0), T_map_base=np.full((4, 4), np.nan), covariance=np.eye(3) * 9.0
    )
    pose, covariance = grid_pose(estimate, FRAME)
    np.testing.assert_allclose(pose[:2], [628_401.0, 5_803_202.0])
    assert math.isnan(pose[3])
    assert covariance[0, 0] == 9.0


def test_single_scans_are_asked_from_nothing() -> None:
    localizer = Knowing()
    scans = [scan_at(1.0, 2.0, 0.5), scan_at(3.0, 4.0, -2.0)]
    rows = predict_singles(scans, localizer, FRAME)
    assert [what for what, _ in localizer.asked] == ["reset", "scan", "reset", "scan"]
    for _, told in localizer.asked[1::2]:
        assert told[3] is None
        assert told[2][2, 3] == pytest.approx(1.3)
    assert (rows.journey == SINGLE).all()
    np.testing.assert_allclose(rows.pose, rows.truth, atol=1e-3)
    np.testing.assert_allclose(rows.aligned[:, 0], rows.truth[:, [0, 1, 3]], atol=1e-3)
    assert np.isnan(rows.aligned[:, 1:]).all()
    assert rows.aligned.shape == (2, ALIGNED, 3)


def test_a_cloud_that_cannot_be_used_is_an_answer_without_a_pose() -> None:
    empty = dataclasses.replace(scan_at(1.0, 2.0, 0.5), points=np.zeros((0, 3), np.float32))
    rows = predict_singles([empty], Knowing(), FRAME)
    assert np.isnan(rows.pose).all()
    assert not rows.has_fix.any()


def test_along_a_journey_the_motion_since_the_last_scan_is_told() -> None:
    localizer = Knowing()
    drives = [straight_drive(0), straight_drive(1)]
    rows = predict_journey(3, Journey((Leg(0), Leg(1, 6.0))), drives, localizer, FRAME)
    alone = number_of_alone(rows) == 3
    assert alone.sum() == 3  # each fifth of twelve
    first = localizer.asked[: 1 + 12 + 6]
    assert [what for what, _ in first] == ["reset"] + ["scan"] * 18
    told = [values for what, values in first if what == "scan"]
    assert told[0][3] is None
    stamps = [values[0] for values in told]
    assert stamps == sorted(set(stamps))
    for i, values in enumerate(told[1:], 1):
        motion = values[3]
        assert motion.is_known
        expected = 1.0 if i != 12 else 0.0  # carried: the wheels have not seen it
        assert motion.delta[0] == pytest.approx(expected, abs=0.25)
        assert motion.delta[1] == pytest.approx(0.0, abs=1e-6)
    track = rows.journey == 3
    assert rows.leg[track].tolist() == [0] * 12 + [1] * 6
    assert rows.area[track].tolist() == [0] * 12 + [1] * 6
    np.testing.assert_allclose(rows.pose[track], rows.truth[track], atol=1e-3)


def test_without_odometry_no_motion_is_told() -> None:
    localizer = Knowing()
    drives = [straight_drive(0), straight_drive(1)]
    predict_journey(0, Journey((Leg(0), Leg(1))), drives, localizer, FRAME, "none")
    assert {values[3] for what, values in localizer.asked if what == "scan"} == {None}


def test_a_scan_that_does_not_count_is_no_beginning_of_a_motion() -> None:
    """The motion to the scan after a bad one leads from the last good one."""
    localizer = Knowing()
    drive = straight_drive(0)
    scans = [drive.scans[i] for i in range(len(drive.scans))]
    scans[4] = dataclasses.replace(scans[4], points=np.zeros((0, 3), np.float32))
    drive = dataclasses.replace(drive, scans=RawScans.of(scans))
    rows = predict_journey(0, Journey((Leg(0),)), [drive], localizer, FRAME)
    motions = [values[3] for what, values in localizer.asked[1:12] if what == "scan"]
    assert [round(motion.delta[0]) for motion in motions[1:]] == [1, 1, 1, 2, 1, 1, 1, 1, 1, 1]
    assert np.isnan(rows.pose[4]).all()


def test_scans_asked_again_stand_beside_those_of_the_track(tmp_path: Path) -> None:
    drives = [straight_drive(0), straight_drive(1)]
    localizer = Knowing()
    journeys = (Journey((Leg(0), Leg(1))), Journey((Leg(1), Leg(0))))
    rows = join(
        [
            *(predict_journey(i, j, drives, localizer, FRAME) for i, j in enumerate(journeys)),
            predict_singles([scan_at(0.0, 1.0, 2.0)], localizer, FRAME),
        ]
    )
    about = PoseAbout("simulated", "data", "w", "e", ("a", "b"), ("x", "y"), (True, True), ("g",), 1.0, 10)
    scores = score_poses(rows, about)
    assert [stage.scans for stage in scores.drive_stages] == [6] * 5
    assert scores.drive_stages[0].within == 0.0
    assert scores.drive_stages[3].within == 1.0
    assert scores.measure("carried_median").count == 2
    write_pose_page(tmp_path / "index.html", scores, "A <title>", {"map": "1 km²"}, ["Simulated & held out."], "end")
    page = (tmp_path / "index.html").read_text()
    assert "A &lt;title&gt;" in page
    assert "Simulated &amp; held out." in page
    assert "{{" not in page
    assert all(f"{measure.count:,} {measure.counted}" in page for measure in scores.measures)
    assert "http" not in page.replace("http://www.w3.org", "")


def test_a_page_can_be_written_of_nothing_but_failures(tmp_path: Path) -> None:
    empty = dataclasses.replace(scan_at(1.0, 2.0, 0.5), points=np.zeros((0, 3), np.float32))
    rows = predict_singles([empty, empty], Knowing(), FRAME)
    about = PoseAbout("amsterdam", "data", "w", "e", ("a",), ("x",), (True,), ("g", "h"), 1.0, 10)
    write_pose_page(tmp_path / "index.html", score_poses(rows, about), "Failures", {}, [], "")
    assert "0 %" in (tmp_path / "index.html").read_text()
