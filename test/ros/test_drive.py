"""The real node on a drive through a simulated town on which, for a while each, everything goes wrong."""

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
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable, read_estimates
from crossloc3d_ros.formats import bag
from crossloc3d_ros.replay.live import localize_live
from crossloc3d_ros.simulation.drive import DriveConfig, drive
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.simulation.survey import SurveyConfig, fly, write_survey
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.types import Float64Array, Int64Array

pytestmark = pytest.mark.slow

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
def spoiled(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """Survey a town, map it, drive through it a year later, and spoil the recording."""
    folder = tmp_path_factory.mktemp("town")
    town = make_town(SEED, "old_town", 300.0)
    survey = fly(town, SurveyConfig(), np.random.default_rng([SEED, 0]))
    build_map(write_survey(town, survey, folder / "survey"), folder / "map", load_encoder(threads=1))
    world = make_town(SEED, "old_town", 300.0, 1)
    route = plan_route(world, 105.0, np.random.default_rng([SEED, 1]), speed_m_s=2.0)
    drive(world, route, folder / "drive", DriveConfig(scan_every=4), seed=SEED)
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
def answers(spoiled: Drive, ros_environment: Any, domain: int, tmp_path_factory: Any) -> EstimateTable:
    folder = tmp_path_factory.mktemp("answers")
    with bag.open_bag(spoiled.bag_path) as reader:
        localize_live(
            reader, CLOUDS, spoiled.map_path, AerialMap.load(spoiled.map_path).frame, folder / "estimates.csv",
            log_path=folder / "localizer.log", domain=domain,
        )  # fmt: skip
    assert "Traceback" not in (folder / "localizer.log").read_text()
    return read_estimates(folder / "estimates.csv")


def test_no_fix_is_wrong_whatever_goes_wrong_and_each_time_it_comes_back(
    spoiled: Drive, answers: EstimateTable
) -> None:
    truth = spoiled.grid[np.searchsorted(spoiled.stamps_ns, answers.stamp_ns)]
    error = np.hypot(*(answers.grid[:, :2] - truth[:, :2]).T)
    seconds = (answers.stamp_ns - spoiled.start_ns) / 1e9
    seconds = np.where(seconds < 0, seconds + BEFORE_NS / 1e9, seconds)
    phases = np.array([phase_of(t) for t in seconds])
    fixes = answers.has_fix
    told = "\n".join(
        f"{t:5.1f} {p:17} {s and s.value} {f} {e:6.2f} {r[:100]}"
        for t, p, s, f, e, r in zip(seconds, phases, answers.states, fixes, error, answers.reasons, strict=True)
    )
    assert error[fixes].max() < 10.0, told
    assert np.median(error[fixes]) < 1.0, told
    for phase in ("good", "good again", "odometry again", "time begins anew"):
        last = np.flatnonzero(phases == phase)[-8:]
        assert fixes[last].any(), f"no fix at the end of '{phase}':\n{told}"
    upside_down = np.flatnonzero(phases == "upside down")[1:]
    assert not fixes[upside_down].any(), told
