"""The real node on drives through a simulated town: a good one, and one on which everything fails for a while."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.datasets.truth import read_truth
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable, read_estimates
from crossloc3d_ros.formats import bag
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.replay.live import localize_live
from crossloc3d_ros.replay.recorded import OdometrySource, localize_bag
from crossloc3d_ros.simulation.drive import DriveConfig, drive
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.simulation.survey import SurveyConfig, fly, write_survey
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.types import Float64Array, Int64Array

SEED = 150_321
CLOUDS, ODOM = "/velodyne_points", "/odom"
BEFORE_NS = 1_000_000_000_000


@dataclass(frozen=True)
class Phase:
    """A stretch of the drive."""

    name: str
    end_s: float


PHASES = (
    Phase("good", 16.0),
    Phase("upside down", 19.0),
    Phase("good again", 27.0),
    Phase("odometry stops", 30.0),
    Phase("odometry again", 38.0),
    Phase("every scan twice", 41.0),
    Phase("time begins anew", 55.0),
)


@dataclass(frozen=True)
class Drive:
    """The map, the recording, and where the robot was."""

    map_path: Path
    bag_path: Path
    start_ns: int
    stamps_ns: Int64Array
    grid: Float64Array


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A surveyed and mapped town."""
    folder = tmp_path_factory.mktemp("town")
    town = make_town(SEED, "old_town", 300.0)
    survey = fly(town, SurveyConfig(), np.random.default_rng([SEED, 0]))
    build_map(write_survey(town, survey, folder / "survey"), folder / "map", load_encoder(threads=1))
    return folder


def record_drive(folder: Path, name: str, length_m: float) -> None:
    """Drive through the town as it is a year later."""
    world = make_town(SEED, "old_town", 300.0, 1)
    route = plan_route(world, length_m, np.random.default_rng([SEED, 1]), speed_m_s=2.0)
    drive(world, route, folder / name, DriveConfig(scan_every=4), seed=SEED)


def test_node_and_replay_give_the_same_estimates_and_no_wrong_fix(
    folder: Path, ros_environment: Any, domain: int, tmp_path: Path
) -> None:
    """One recording over DDS into the real node in a process of its own, and straight through the localizer here."""
    record_drive(folder, "short", 36.0)
    aerial_map = AerialMap.load(folder / "map")
    with bag.open_bag(folder / "short") as reader:
        report = localize_live(
            reader, CLOUDS, folder / "map", aerial_map.frame, tmp_path / "live.csv",
            # Nothing may depend on how busy this machine is: no scan is dropped, none goes without its odometry.
            parameters={"queue_depth": "100", "odometry_timeout_s": "1.0"},
            log_path=tmp_path / "localizer.log", domain=domain,
        )  # fmt: skip
        assert report.estimates == report.scans, (tmp_path / "localizer.log").read_text()
        localizer = Localizer(aerial_map, load_encoder(), LocalizerNodeConfig())
        localizer.warm_up()
        localize_bag(reader, CLOUDS, localizer, tmp_path / "replay.csv", odometry=OdometrySource(ODOM))
        truth = read_truth(reader, "/ground_truth/fix", aerial_map.frame)
    assert "Traceback" not in (tmp_path / "localizer.log").read_text()
    live, replayed = read_estimates(tmp_path / "live.csv"), read_estimates(tmp_path / "replay.csv")
    np.testing.assert_array_equal(live.stamp_ns, replayed.stamp_ns)
    np.testing.assert_array_equal(live.has_fix, replayed.has_fix)
    assert list(live.states) == list(replayed.states)
    fixes = live.has_fix
    assert fixes.sum() >= 5, "a drive that tests something"
    np.testing.assert_allclose(live.grid[fixes, :2], replayed.grid[fixes, :2], atol=0.01)
    # Without the geoid's separation the topic has no altitude, and a variance that shows it.
    plane = np.ix_(fixes, [0, 1], [0, 1])
    np.testing.assert_allclose(live.covariance[plane], replayed.covariance[plane], rtol=0.01, atol=1e-4)
    error = np.hypot(*(live.grid[fixes, :2] - truth.at(live.stamp_ns[fixes])[:, :2]).T)
    assert np.nanmax(error) < 10.0
    assert np.nanmedian(error) < 1.0


@pytest.fixture(scope="module")
def spoiled(folder: Path) -> Drive:
    """Spoil the recording of a drive."""
    record_drive(folder, "drive", 105.0)
    frame = AerialMap.load(folder / "map").frame
    truth: dict[int, Float64Array] = {}
    with bag.open_bag(folder / "drive") as reader, bag.BagWriter(folder / "spoiled") as writer:
        start_ns = reader.start_ns
        for topic, recorded_ns, message in reader.messages([CLOUDS, ODOM, "/ground_truth/fix"]):
            stamp_ns = bag.stamp_ns_of(message, recorded_ns)
            for changed in spoil(topic, (recorded_ns - start_ns) / 1e9, message):
                new_ns = bag.stamp_ns_of(changed, recorded_ns)
                if topic == "/ground_truth/fix":
                    place = (np.array([message.latitude]), np.array([message.longitude]))
                    truth[stamp_ns] = frame.from_geographic(*place)[0]
                    truth[stamp_ns - BEFORE_NS] = truth[stamp_ns]
                else:
                    kind = bag.POINT_CLOUD if topic == CLOUDS else bag.ODOMETRY
                    writer.write(topic, kind, recorded_ns, changed)
                    assert new_ns in (stamp_ns, stamp_ns - BEFORE_NS)
    stamps = np.array(sorted(truth), np.int64)
    return Drive(folder / "map", folder / "spoiled", start_ns, stamps, np.array([truth[s] for s in stamps.tolist()]))


def phase_of(seconds: float) -> str:
    return next((phase.name for phase in PHASES if seconds < phase.end_s), PHASES[-1].name)


def spoil(topic: str, seconds: float, message: Any) -> Iterator[Any]:
    """Yield what becomes of a message."""
    phase = phase_of(seconds)
    if phase == "upside down" and topic == CLOUDS:
        raw = np.frombuffer(bytes(message.data), np.uint8).reshape(-1, message.point_step).copy()
        xyz = raw[:, :12].copy().view(np.float32)
        raw[:, :12] = (xyz * np.array([1.0, -1.0, -1.0], np.float32)).view(np.uint8)
        message.data = raw.reshape(-1)
    elif phase == "odometry stops" and topic == ODOM:
        return
    elif phase == "time begins anew":
        message.header.stamp.sec -= BEFORE_NS // 1_000_000_000
    yield message
    if phase == "every scan twice" and topic == CLOUDS:
        yield message


@pytest.fixture(scope="module")
def estimates(spoiled: Drive, ros_environment: Any, domain: int, tmp_path_factory: Any) -> EstimateTable:
    folder = tmp_path_factory.mktemp("estimates")
    with bag.open_bag(spoiled.bag_path) as reader:
        localize_live(
            reader, CLOUDS, spoiled.map_path, AerialMap.load(spoiled.map_path).frame, folder / "estimates.csv",
            log_path=folder / "localizer.log", domain=domain,
        )  # fmt: skip
    assert "Traceback" not in (folder / "localizer.log").read_text()
    return read_estimates(folder / "estimates.csv")


@pytest.mark.slow
def test_no_fix_is_wrong_whatever_goes_wrong_and_each_time_it_comes_back(
    spoiled: Drive, estimates: EstimateTable
) -> None:
    truth = spoiled.grid[np.searchsorted(spoiled.stamps_ns, estimates.stamp_ns)]
    error = np.hypot(*(estimates.grid[:, :2] - truth[:, :2]).T)
    seconds = (estimates.stamp_ns - spoiled.start_ns) / 1e9
    seconds = np.where(seconds < 0, seconds + BEFORE_NS / 1e9, seconds)
    phases = np.array([phase_of(t) for t in seconds])
    fixes = estimates.has_fix
    course = "\n".join(
        f"{t:5.1f} {p:17} {s and s.value} {f} {e:6.2f} {r[:100]}"
        for t, p, s, f, e, r in zip(seconds, phases, estimates.states, fixes, error, estimates.reasons, strict=True)
    )
    assert error[fixes].max() < 10.0, course
    assert np.median(error[fixes]) < 1.0, course
    for phase in ("good", "good again", "odometry again", "time begins anew"):
        last = np.flatnonzero(phases == phase)[-8:]
        assert fixes[last].any(), f"no fix at the end of '{phase}':\n{course}"
    upside_down = np.flatnonzero(phases == "upside down")[1:]
    assert not fixes[upside_down].any(), course
