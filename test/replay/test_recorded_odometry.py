"""What a localizer is given of the robot's motion between the scans of a recording."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import LocalizerConfig, MountingConfig, ScanConfig
from crossloc3d_ros.errors import BagError
from crossloc3d_ros.evaluation.drives.estimates import read_estimates
from crossloc3d_ros.evaluation.drives.evaluation import ESTIMATES, SUMMARY, evaluate, write_summary
from crossloc3d_ros.evaluation.drives.page import About, write_report
from crossloc3d_ros.formats import bag, messages
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.replay.recorded import HELD_NS, OdometrySource, localize_bag
from crossloc3d_ros.types import Estimate, FixStatus, Float64Array, Scan, TrackState

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000


@dataclass
class Listener:
    """Stands in for the localizer, and records what it was given."""

    config: LocalizerConfig = field(default_factory=LocalizerConfig)
    stamps_ns: list[int] = field(default_factory=list)
    motions: list[Motion | None] = field(default_factory=list)

    @property
    def stamp_ns(self) -> int | None:
        return self.stamps_ns[-1] if self.stamps_ns else None

    def localize(
        self,
        scan: Scan,
        gravity_base: Float64Array | None = None,
        T_base_lidar: Float64Array | None = None,
        motion: Motion | Callable[[], Motion | None] | None = None,
    ) -> Estimate:
        self.motions.append(motion() if callable(motion) else motion)
        self.stamps_ns.append(scan.stamp_ns)
        return no_estimate(scan.stamp_ns, "stand-in")


def room(x_m: float, heading_rad: float) -> np.ndarray:
    """Return what a lidar 1.2 m above the ground sees of a room with corners and columns."""
    rng = np.random.default_rng(5)
    along = rng.uniform(-1, 1, (4, 6000))
    up = rng.uniform(0, 6, (4, 6000))
    walls = [
        np.column_stack([along[0] * 30, np.full(6000, 14.0), up[0]]),
        np.column_stack([along[1] * 30, np.full(6000, -11.0), up[1]]),
        np.column_stack([np.full(6000, 30.0), along[2] * 14, up[2]]),
        np.column_stack([np.full(6000, -26.0), along[3] * 14, up[3]]),
    ]
    ground = np.column_stack([rng.uniform(-26, 30, 8000), rng.uniform(-11, 14, 8000), np.zeros(8000)])
    columns = np.column_stack([rng.choice([-18.0, -7.0, 3.0, 12.0, 21.0], 4000) + rng.normal(0, 0.1, 4000),
                               rng.choice([-7.0, 5.0, 9.0], 4000) + rng.normal(0, 0.1, 4000),
                               rng.uniform(0, 5, 4000)])  # fmt: skip
    points = np.concatenate([*walls, ground, columns]) - [x_m, 0.0, 1.2]
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    return points @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def cloud(stamp_ns: int, x_m: float = 0.0, heading_rad: float = 0.0, small: bool = True) -> Any:
    points = room(x_m, heading_rad)
    points += np.random.default_rng(stamp_ns).normal(0.0, 1e-4, points.shape)  # a lidar without noise is a frozen one
    return messages.velodyne_cloud(stamp_ns, "velodyne", points[::40] if small else points, 1.0, 0, 0.0)


def odometry(stamp_ns: int, x_m: float, y_m: float = 0.0, heading_rad: float = 0.0, child: str = "base_link") -> Any:
    half = heading_rad / 2
    return messages.odometry(stamp_ns, "odom", child, (x_m, y_m, 0.0), (0, 0, np.sin(half), np.cos(half)))


def record(path: Path, recorded: list[tuple[str, str, int, Any]]) -> Path:
    with bag.BagWriter(path) as writer:
        for topic, kind, recorded_ns, message in sorted(recorded, key=lambda m: m[2]):
            writer.write(topic, kind, recorded_ns, message)
    return path


def replayed(path: Path, odometry_topic: str | None = "/odom", **options: Any) -> Listener:
    listener = Listener()
    source = OdometrySource(odometry_topic)
    with bag.open_bag(path) as reader:
        localize_bag(reader, "/points", listener, path.parent / "e.csv", odometry=source, **options)
    return listener


def drive(path: Path, *, scans: int = 6, late_ns: int = 0) -> Path:
    """Record a drive along an arc at 2 m/s: odometry at 20 Hz, a scan each half second, between two samples."""
    recorded: list[tuple[str, str, int, Any]] = []
    for tick in range(20 * scans // 2 + 5):
        t = tick / 20
        stamp = START + round(t * SECOND)
        turn = 0.2 * t
        message = odometry(stamp, 10 * np.sin(turn), 10 * (1 - np.cos(turn)), turn)
        recorded.append(("/odom", bag.ODOMETRY, stamp + late_ns, message))
    for i in range(scans):
        stamp = START + i * SECOND // 2 + 20_000_000
        recorded.append(("/points", bag.POINT_CLOUD, stamp, cloud(stamp)))
    return record(path, recorded)


@pytest.mark.parametrize("late_ns", [0, 120_000_000])
def test_motion_is_that_between_the_stamps_even_where_odometry_comes_late(tmp_path: Path, late_ns: int) -> None:
    listener = replayed(drive(tmp_path / "drive", late_ns=late_ns))
    assert len(listener.motions) == 6
    assert listener.motions[0] is None
    for motion in listener.motions[1:]:
        assert motion is not None
        assert motion.is_known
        np.testing.assert_allclose(motion.delta, [10 * np.sin(0.1), 10 * (1 - np.cos(0.1)), 0.1], atol=2e-3)
    assert read_estimates(tmp_path / "e.csv").stamp_ns.tolist() == listener.stamps_ns


def test_of_every_second_scan_the_motion_is_that_since_the_last_one_used(tmp_path: Path) -> None:
    listener = replayed(drive(tmp_path / "drive"), every=2)
    assert len(listener.motions) == 3
    for motion in listener.motions[1:]:
        assert motion is not None
        np.testing.assert_allclose(motion.delta, [10 * np.sin(0.2), 10 * (1 - np.cos(0.2)), 0.2], atol=2e-3)


def test_without_odometry_nothing_is_given(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive")
    listener = Listener()
    with bag.open_bag(path) as reader:
        localize_bag(reader, "/points", listener, tmp_path / "e.csv")
    assert listener.motions == [None] * 6


def test_a_cloud_that_cannot_be_used_is_bridged(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive")
    with bag.open_bag(path) as reader:
        recorded = [(t, bag.ODOMETRY if t == "/odom" else bag.POINT_CLOUD, ns, m) for t, ns, m in reader.messages()]
    third = [m for m in recorded if m[0] == "/points"][2][3]
    third.data = third.data[:50]
    listener = replayed(record(tmp_path / "broken", recorded))
    table = read_estimates(tmp_path / "e.csv")
    assert len(table) == 6
    assert len(listener.motions) == 5
    assert table.reasons[2] != "stand-in"
    assert listener.motions[2] is not None
    np.testing.assert_allclose(listener.motions[2].delta, [10 * np.sin(0.2), 10 * (1 - np.cos(0.2)), 0.2], atol=2e-3)


def test_odometry_that_stops_holds_no_scan_for_ever(tmp_path: Path) -> None:
    recorded = [("/odom", bag.ODOMETRY, START + i * 50_000_000, odometry(START + i * 50_000_000, 0.1 * i))
                for i in range(41)]  # fmt: skip
    for i in range(12):
        stamp = START + i * SECOND // 2
        recorded.append(("/points", bag.POINT_CLOUD, stamp + 1, cloud(stamp)))
    listener = replayed(record(tmp_path / "drive", recorded))
    assert listener.stamps_ns == [START + i * SECOND // 2 for i in range(12)]
    known = [motion is not None and motion.is_known for motion in listener.motions]
    assert known[1:5] == [True] * 4
    assert not any(known[6:])
    last = listener.motions[-1]
    assert last is not None
    assert "odometry" in last.reason
    assert HELD_NS <= SECOND


def test_poses_that_are_none_are_left_out(tmp_path: Path) -> None:
    path = drive(tmp_path / "drive")
    with bag.open_bag(path) as reader:
        recorded = [(t, bag.ODOMETRY if t == "/odom" else bag.POINT_CLOUD, ns, m) for t, ns, m in reader.messages()]
    for number, (_, _, _, message) in enumerate([m for m in recorded if m[0] == "/odom"]):
        if number % 4 == 1:
            message.pose.pose.position.x = float("nan")
        if number % 4 == 3:
            message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
    listener = replayed(record(tmp_path / "broken", recorded))
    for motion in listener.motions[1:]:
        assert motion is not None
        assert motion.is_known
        np.testing.assert_allclose(motion.delta, [10 * np.sin(0.1), 10 * (1 - np.cos(0.1)), 0.1], atol=0.01)


def test_odometry_of_another_frame_is_used_and_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorded: list[tuple[str, str, int, Any]] = [
        ("/odom", bag.ODOMETRY, START + i, odometry(START + i, 0.0, child="base_footprint")) for i in range(3)
    ]
    recorded.append(("/points", bag.POINT_CLOUD, START + 1, cloud(START + 1)))
    replayed(record(tmp_path / "drive", recorded))
    assert caplog.text.count("gives the pose of 'base_footprint'") == 1


def test_of_a_damaged_recording_the_scans_that_wait_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = drive(tmp_path / "drive", late_ns=120_000_000)
    whole = bag.BagReader.messages

    def breaking(self: bag.BagReader, topics: Any = None) -> Any:
        for number, message in enumerate(whole(self, topics)):
            if message.topic == "/points" and number > 40:
                yield message
                raise BagError("readable up to here")
            yield message

    monkeypatch.setattr(bag.BagReader, "messages", breaking)
    with pytest.raises(BagError, match="readable up to here"):
        replayed(path)
    seen = read_estimates(tmp_path / "e.csv").stamp_ns
    assert seen[-1] == START + (len(seen) - 1) * SECOND // 2 + 20_000_000
    assert 2 < len(seen) < 6


def test_scans_measure_the_motion_themselves(tmp_path: Path) -> None:
    """All of them, also those that are not localized; on a lidar that faces left, in the axes of the base."""
    pytest.importorskip("kiss_icp")
    recorded: list[tuple[str, str, int, Any]] = []
    for i in range(9):
        stamp = START + i * SECOND // 10
        recorded.append(("/points", bag.POINT_CLOUD, stamp, cloud(stamp, 0.25 * i, np.pi / 2, small=False)))
    path = record(tmp_path / "drive", recorded)
    mounting = MountingConfig(z_m=1.2, yaw_deg=90.0)
    listener = Listener(LocalizerConfig(scan=ScanConfig(mounting=mounting)))
    with bag.open_bag(path) as reader:
        localize_bag(reader, "/points", listener, tmp_path / "e.csv", every=4, odometry=OdometrySource())
    assert len(listener.motions) == 3
    last = listener.motions[-1]
    assert last is not None
    assert last.is_known
    np.testing.assert_allclose(last.delta, [1.0, 0.0, 0.0], atol=0.08)


class Oracle(Listener):
    """Stands in for a localizer that is 0.3 m and 2 degrees off all the time."""

    def __init__(self, frame: MapFrame, truth: dict[int, tuple[float, float, float]]) -> None:
        super().__init__()
        self.frame, self.truth = frame, truth

    def localize(
        self,
        scan: Scan,
        gravity_base: Float64Array | None = None,
        T_base_lidar: Float64Array | None = None,
        motion: Motion | None = None,
    ) -> Estimate:
        easting, northing, yaw = self.truth[scan.stamp_ns]
        grid = np.array([easting + 0.3, northing, 0.0])
        latitude, longitude, altitude = self.frame.to_geographic(grid[None])
        yaw += np.radians(2.0)
        T_map_base = np.eye(4)
        T_map_base[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        return replace(
            no_estimate(scan.stamp_ns, "stand-in"),
            status=FixStatus.FIX,
            grid=grid,
            latitude_deg=float(latitude[0]),
            longitude_deg=float(longitude[0]),
            altitude_m=float(altitude[0]),
            covariance=np.eye(3) * 0.04,
            state=TrackState.LOCALIZED,
            probability=0.9995,
            T_map_base=T_map_base,
            pose_covariance=np.diag([0.04, 0.04, 1.0, 1e-3, 1e-3, np.radians(1.5) ** 2]),
        )


def test_poses_are_held_against_the_true_ones_of_the_recording(town_map: AerialMap, tmp_path: Path) -> None:
    frame = town_map.frame
    west, south, _, _ = town_map.bounds
    recorded: list[tuple[str, str, int, Any]] = []
    truth = {}
    for i in range(20):
        stamp = START + i * SECOND // 5
        yaw = 3.0 + 0.02 * i  # across the seam at half a turn
        place = np.array([[west + 150.0 - 4.0 * i, south + 80.0, 2.0]])
        truth[stamp] = (place[0, 0], place[0, 1], yaw)
        latitude, longitude, _ = frame.to_geographic(place)
        fix = messages.nav_sat_fix(stamp, "base_link", latitude[0], longitude[0], float("nan"), np.zeros((3, 3)))
        recorded.append(("/ground_truth/fix", bag.NAV_SAT_FIX, stamp, fix))
        x, y, _ = frame.to_enu(place)[0]
        message = messages.odometry(stamp, "world", "base_link", (x, y, 0), (0, 0, np.sin(yaw / 2), np.cos(yaw / 2)))
        recorded.append(("/ground_truth/odom", bag.ODOMETRY, stamp, message))
        recorded.append(("/points", bag.POINT_CLOUD, stamp, cloud(stamp)))
    with bag.open_bag(record(tmp_path / "drive", recorded)) as reader:
        localize_bag(reader, "/points", Oracle(frame, truth), tmp_path / ESTIMATES)
        evaluation = evaluate(reader, tmp_path, town_map)
    assert evaluation.heading_topic == "/ground_truth/odom"
    np.testing.assert_allclose(np.degrees(evaluation.table.heading_error_rad), 2.0, atol=1e-3)
    assert evaluation.track is not None
    assert evaluation.track.errors.median_m == pytest.approx(0.3, abs=2e-3)
    assert evaluation.track.errors.median_deg == pytest.approx(2.0, abs=1e-3)
    one, two, _ = evaluation.track.coverage
    assert (one.position, two.position) == (1.0, 1.0)
    assert (one.heading, two.heading) == (0.0, 1.0)
    write_summary(tmp_path, evaluation, {})
    summary = json.loads((tmp_path / SUMMARY).read_text(), parse_constant=pytest.fail)
    assert summary["track"]["errors"]["wrong"] == 0
    assert summary["track"]["searches"][0]["cause"] == "from nothing"
    write_report(tmp_path / "page.html", evaluation, town_map, About("A drive", {}))
    assert "0.30 m" in (tmp_path / "page.html").read_text()


def test_clouds_of_a_second_lidar_are_rows_with_its_name(tmp_path: Path) -> None:
    recorded: list[tuple[str, str, int, Any]] = []
    for i in range(6):
        message = cloud(START + i * SECOND // 2)
        message.header.frame_id = "rear" if i % 2 else "front"
        recorded.append(("/points", bag.POINT_CLOUD, START + i * SECOND // 2, message))
    path = record(tmp_path / "two", recorded)
    listener = Listener()
    with bag.open_bag(path) as reader:
        localize_bag(reader, "/points", listener, tmp_path / "e.csv")
    assert listener.stamps_ns == [START, START + SECOND, START + 2 * SECOND]
    reasons = read_estimates(tmp_path / "e.csv").reasons
    assert [("'front' and 'rear'" in reason) for reason in reasons] == [False, True] * 3
