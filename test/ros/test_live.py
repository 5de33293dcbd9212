"""The demo's engine: the localizer as a process, a recording played into it, its outputs as estimates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.evaluation.drives.estimates import read_estimates
from crossloc3d_ros.formats import bag, messages
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.replay.live import header_stamp_ns, localize_live
from crossloc3d_ros.ros.conversions import in_grid
from crossloc3d_ros.types import TrackState

START_NS = 1_700_000_000_000_000_000
STEP_NS = 250_000_000
SCANS = 12


def write_drive(path: Path, world: Any) -> Path:
    with bag.BagWriter(path) as writer:
        writer.add_topic("/lidar/points", bag.POINT_CLOUD, bag.OfferedQos("best_effort", "volatile", 5))
        for tick in range(SCANS * STEP_NS // 50_000_000):
            stamp_ns = START_NS + tick * 50_000_000
            place = (0.1 * tick, 0.0, 0.0)
            odometry = messages.odometry(stamp_ns, "wheels", "base_link", place, (0.0, 0.0, 0.0, 1.0))
            writer.write("/wheels", bag.ODOMETRY, stamp_ns, odometry)
        for place in range(SCANS):
            stamp_ns = START_NS + place * STEP_NS
            points = world.points(place) if place != 5 else np.full((100, 3), np.nan)
            cloud = messages.velodyne_cloud(stamp_ns, "velodyne", points, 1.0, 0, 0.0)
            writer.write("/lidar/points", bag.POINT_CLOUD, stamp_ns, cloud)
    return path


def test_outputs_of_the_node_become_estimates(world: Any, ros_environment: Any, domain: int, tmp_path: Path) -> None:
    parameters = {name: str(value) for name, value in world.parameters().items() if name != "map"}
    frame = AerialMap.load(world.map_path).frame
    calls: list[tuple[int, int]] = []
    with bag.open_bag(write_drive(tmp_path / "drive", world)) as reader:
        report = localize_live(
            reader,
            "/lidar/points",
            world.map_path,
            frame,
            tmp_path / "estimates.csv",
            odometry_topic="/wheels",
            parameters=parameters,
            program=(str(Path(__file__).with_name("standin.py")),),
            log_path=tmp_path / "localizer.log",
            domain=domain,
            progress=lambda done, total, _: calls.append((done, total)),
        )
    table = read_estimates(tmp_path / "estimates.csv")
    assert calls == [(i + 1, SCANS) for i in range(SCANS)]
    assert report.scans == SCANS
    assert table.stamp_ns.tolist() == [START_NS + i * STEP_NS for i in range(SCANS)]
    received = np.isfinite(table.latency_ms)
    assert report.estimates == received.sum() >= SCANS - 3  # a busy machine may drop some
    assert (table.latency_ms[received] > 0).all()
    assert received[5]
    assert not table.has_fix[5]
    assert table.candidate_ids[5, 0] == -1
    good = received & (np.arange(SCANS) != 5)
    assert table.has_fix[good].mean() > 0.7
    for i in np.flatnonzero(good):
        assert table.candidate_ids[i, 0] == i
        np.testing.assert_allclose(table.candidate_grid[i, 0], world.grid(i)[:2], atol=0.05)
        assert table.candidate_probabilities[i, 0] > table.candidate_probabilities[i, 1]
        if table.has_fix[i]:
            # The stand-in puts the robot 3 m east and 2 m south of the place, and rotates it by half a radian.
            made_up = np.array(world.grid(i)[:2]) + np.array([3.0, -2.0])
            np.testing.assert_allclose(table.grid[i, :2], made_up, atol=0.01)
            assert table.covariance[i, 0, 0] == pytest.approx(0.04)
            assert table.states[i] is TrackState.LOCALIZED
            assert table.probability[i] > 0.7
            _, heading = in_grid(frame, np.zeros((1, 3)), table.heading_rad[i : i + 1])
            assert heading[0] == pytest.approx(0.5, abs=1e-3)
            assert np.degrees(table.heading_std_rad[i]) == pytest.approx(np.degrees(0.01), abs=0.01)
            np.testing.assert_allclose(table.hypotheses.grid[i, 0], made_up, atol=0.02)
            np.testing.assert_allclose(table.hypotheses.probabilities[i, :2], [0.9, 0.06])
            np.testing.assert_allclose(table.aligned.grid[i, 0], made_up, atol=0.02)
            np.testing.assert_allclose(table.aligned.heading_rad[i, 0], 0.5, atol=1e-3)
            assert table.aligned_sources[i, 0] == 0
    moved = [reason for reason in table.reasons if "moved 0.50 0.00 0.000" in reason]
    assert len(moved) >= SCANS - 5, "the odometry reaches the localizer"
    for i in np.flatnonzero(~received):
        assert "no estimate" in table.reasons[i]


def test_a_node_that_does_not_come_up_says_why(world: Any, ros_environment: Any, domain: int, tmp_path: Path) -> None:
    frame = MapFrame("EPSG:32631", np.array([628_500.0, 5_804_000.0, 2.0]), None)
    with (
        bag.open_bag(write_drive(tmp_path / "drive", world)) as reader,
        pytest.raises(CrossLocError, match=r"the localizer ended with code 2: .*manifest\.json.*localizer\.log"),
    ):
        localize_live(
            reader,
            "/lidar/points",
            tmp_path,
            frame,
            tmp_path / "e.csv",
            parameters={"weights": str(world.weights_path)},
            log_path=tmp_path / "localizer.log",
            domain=domain,
        )
    assert not (tmp_path / "e.csv").exists()


def test_stamps_are_read_from_serialised_messages(tmp_path: Path) -> None:
    stamps = [1, 999_999_999, 1_700_000_000_123_456_789, 2_147_483_647_000_000_001]
    with bag.BagWriter(tmp_path / "drive") as writer:
        for stamp_ns in stamps:
            cloud = messages.velodyne_cloud(stamp_ns, "velodyne", np.zeros((1, 3)), 1.0, 0, 0.0)
            writer.write("/points", bag.POINT_CLOUD, stamp_ns, cloud)
    with bag.open_bag(tmp_path / "drive") as reader:
        assert [header_stamp_ns(message.cdr) for message in reader.raw_messages()] == stamps
