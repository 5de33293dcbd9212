"""Drives of a pose set: what a robot with a lidar, wheels and perhaps an IMU has recorded, and where it truly was.

    drives = open_drives(pose_set, data)
    for journey in journeys_of(pose_set, drives): ...

Every drive is recorded by `simulation.drive` as a bag, and kept as what the localizer takes of it. A `Journey` plays
one or more of them after each other as if the robot had been kidnapped from the end of one to the begin of the next:
its clock and its wheels' odometry go on and know nothing of it.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.config import MountingConfig
from crossloc3d_ros.datasets import amsterdam
from crossloc3d_ros.datasets import benchmarks as benchmark
from crossloc3d_ros.datasets.amsterdam import AmsterdamBenchmark
from crossloc3d_ros.datasets.made import how_made, is_made, mark_made, whole
from crossloc3d_ros.datasets.pose_sets import (
    AWAY,
    POSE_SETS,
    PoseSet,
    SimulatedPoses,
    placed_town,
    to_grid,
)
from crossloc3d_ros.datasets.raw_scans import RawScan, RawScans, load_scans, save_scans
from crossloc3d_ros.datasets.set_maps import Progress
from crossloc3d_ros.datasets.simulated import sources_digest
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.formats.bag import POINT_CLOUD, open_bag, stamp_ns_of
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.localization.fusion.gravity import GravityFilter
from crossloc3d_ros.simulation import drive as recording
from crossloc3d_ros.simulation import lidar, route, traffic, vlp16
from crossloc3d_ros.simulation.drive import DriveConfig, drive
from crossloc3d_ros.simulation.lidar import LidarProfile
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.route import Route, plan_route
from crossloc3d_ros.simulation.vlp16 import VLP16
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Float64Array, Int64Array

VERSION = 1
_START_NS = 1_700_000_000_000_000_000
_SAMPLE_NS = 20_000_000
DRIVES, ODOMETRY = "drives", "odometry.npz"
KIDNAPPED_NS = 10_000_000_000
"""How long it takes to carry a robot away."""
_IMU_TIME_CONSTANT_S = 1.0


@dataclass(frozen=True)
class DrivePlan:
    """One drive that is to be recorded."""

    name: str
    area: int
    """Number of the set's area."""
    length_m: float
    speed_m_s: float
    scan_every: int
    """Each n-th turn of the sensor is kept."""
    seed: int
    has_imu: bool
    height_m: float
    """Of the lidar above the ground."""
    border_m: float
    clearance_m: float = 1.5


@dataclass(frozen=True, eq=False)
class RawDrive:
    """One drive as it was recorded."""

    plan: DrivePlan
    scans: RawScans
    """With stamps, in their order."""
    odometry_ns: Int64Array
    """(M,) stamps of the wheel odometry, increasing."""
    odometry: Float64Array
    """(M, 3) x, y, metres, heading, radians, in the frame odom."""

    @property
    def travelled_m(self) -> Float64Array:
        """Metres (S,) driven truly until each scan, from the first."""
        steps = np.diff(self.scans.T_grid_base[:, :2, 3], axis=0)
        return np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])


@dataclass(frozen=True)
class Leg:
    """A stretch of a drive."""

    drive: int
    """Row of the drives."""
    from_m: float = 0.0
    """Where on the drive the stretch begins, metres from its first scan."""
    to_m: float = math.inf
    """And where it ends."""


@dataclass(frozen=True)
class Journey:
    """Stretches of drives, between which the robot is kidnapped; before the first it knows nothing."""

    legs: tuple[Leg, ...]


@dataclass(frozen=True, eq=False)
class JourneyStep:
    """One scan of a journey, and the odometry that arrives between the scan before and this one."""

    drive: int
    """Row of the drives."""
    row: int
    """Of the drive's scans."""
    stamp_ns: int
    """By the journey's clock, as are those of the odometry."""
    odometry_ns: Int64Array
    """(M,)"""
    odometry: Float64Array
    """(M, 3) x, y, metres, heading, radians, in the frame odom."""
    leg: int
    """Number of the leg."""
    travelled_m: float
    """Metres driven truly since the leg began."""


def drive_plans(name: str) -> tuple[DrivePlan, ...]:
    """Return the drives of a set of `POSE_SETS`."""
    chosen = POSE_SETS[name]
    if isinstance(chosen, AmsterdamBenchmark):
        demo = DrivePlan(
            "the demo's drive", 0, chosen.drive_length_m, chosen.drive_speed_m_s, 2, chosen.drive_seed, False,
            chosen.scan.mounting.z_m, 25.0, chosen.clearance_m,
        )  # fmt: skip
        others = (DrivePlan(f"drive {i}", 0, 250.0, 2.5, 5, 970_000 + i, i % 2 == 0, 1.2, 40.0) for i in range(1, 5))
        away = DrivePlan(f"{AWAY.name} (off the map)", 1, 600.0, 1.0, 20, AWAY.seed, False, 1.2, 0.0)
        return (demo, *others, away)
    heights = np.random.default_rng([chosen.examined.towns[0].seed, 9]).uniform(*chosen.examined.sensor_height_m, 99)
    small = name == "simulated_small"
    length_m = 90.0 if small else 120.0 if name == "fitting" else 180.0
    plans = [
        DrivePlan(town.name, i, length_m, 2.5, 5, town.seed, i % 2 == 0, round(float(heights[i]), 2), 0.0)
        for i, town in enumerate(chosen.examined.towns)
    ]
    first = len(plans)
    for i, town in enumerate(chosen.off_map):
        # Ten minutes at a metre a second, a scan every two seconds.
        length_m = 60.0 if small else 600.0
        plans.append(DrivePlan(f"{town.name} (off the map)", first + i, length_m, 1.0, 20, town.seed, i % 2 == 0,
                               round(float(heights[first + i]), 2), 0.0))  # fmt: skip
    return tuple(plans)


def open_drives(
    pose_set: PoseSet,
    *,
    workers: int = 1,
    surveys: Path | None = None,
    progress: Progress | None = None,
) -> list[RawDrive]:
    """Return the set's drives, recording those that are not there yet; they are kept in the set's folder.

    `surveys`: the folder of the two surveys, for Amsterdam. Raises EvaluationError for what cannot be made or written.
    """
    report = progress or (lambda stage, done, total, unit: None)
    plans, chosen = drive_plans(pose_set.name), POSE_SETS[pose_set.name]
    tasks = [_Task(pose_set.folder / DRIVES / f"{i:02d}", chosen, plan, surveys) for i, plan in enumerate(plans)]
    if isinstance(chosen, AmsterdamBenchmark) and surveys is None and not all(map(_is_recorded, tasks)):
        raise EvaluationError(f"the drives of '{pose_set.name}' need the folder of its two surveys")
    with benchmark.alone(pose_set.folder):
        missing = [task for task in tasks if not _is_recorded(task)]
        done = len(tasks) - len(missing)

        def advance(drives: int) -> None:
            nonlocal done
            done += drives
            report("driving", done, len(tasks), "drives")

        if missing:
            advance(0)
            benchmark.without_encoder(_record, missing, workers, pose_set.folder, advance)
    return [_load(task.folder) for task in tasks]


def journeys_of(pose_set: PoseSet, drives: Sequence[RawDrive]) -> list[Journey]:
    """Return how the drives are evaluated.

    Each drive from nothing to its end; from there the robot is kidnapped to the latter two thirds of another town's
    drive. Those off the map stand for themselves. The long drive of the demo is evaluated as a whole, and with new
    starts each hundred metres.
    """
    on_map = [i for i, drive in enumerate(drives) if pose_set.on_map[drive.plan.area]]
    longest = max((drives[i].plan.length_m for i in on_map), default=0.0)
    shorter = [i for i in on_map if drives[i].plan.length_m < longest] or on_map
    # Far from the next: neighbours in the list are often of one family.
    step = max(1, len(shorter) // 2 - 1) if len(shorter) > 1 else 0
    journeys = []
    for i in range(len(drives)):
        legs = [Leg(i)]
        if i in shorter and step:
            other = shorter[(shorter.index(i) + step) % len(shorter)]
            legs.append(Leg(other, drives[other].plan.length_m / 3.0))
        journeys.append(Journey(tuple(legs)))
        if i in on_map and i not in shorter:
            starts = np.arange(100.0, drives[i].plan.length_m - 50.0, 100.0)
            journeys += [Journey((Leg(i, start, start + 100.0),)) for start in starts.tolist()]
    return journeys


def steps_of(journey: Journey, drives: Sequence[RawDrive]) -> list[JourneyStep]:
    """Return a journey scan by scan, by one clock and one odometry."""
    steps: list[JourneyStep] = []
    shift_ns, last_ns, last = 0, 0, np.zeros(3)
    for number, leg in enumerate(journey.legs):
        drive_ = drives[leg.drive]
        travelled = drive_.travelled_m
        rows = np.flatnonzero((travelled >= leg.from_m) & (travelled < leg.to_m))
        if not len(rows):
            continue
        at = int(np.searchsorted(drive_.odometry_ns, drive_.scans.stamp_ns[rows[0]] - _SAMPLE_NS))
        stamps_ns, odometry = drive_.odometry_ns[at:], drive_.odometry[at:]
        waiting_ns = np.empty(0, np.int64)
        if number:
            waiting_ns = np.arange(last_ns + _SAMPLE_NS, last_ns + KIDNAPPED_NS, _SAMPLE_NS)
            shift_ns = last_ns + KIDNAPPED_NS - int(stamps_ns[0])
            odometry = _continued(odometry, last)
        stamps_ns = np.concatenate([waiting_ns, stamps_ns + shift_ns])
        odometry = np.concatenate([np.broadcast_to(last, (len(waiting_ns), 3)), odometry])
        first = 0
        for row in rows.tolist():
            stamp_ns = int(drive_.scans.stamp_ns[row]) + shift_ns
            until = int(np.searchsorted(stamps_ns, stamp_ns + _SAMPLE_NS))
            steps.append(
                JourneyStep(
                    leg.drive, row, stamp_ns, stamps_ns[first:until], odometry[first:until], number,
                    float(travelled[row] - travelled[rows[0]]),
                )
            )  # fmt: skip
            first = until
        last_ns, last = max(int(stamps_ns[first - 1]), steps[-1].stamp_ns), odometry[first - 1]
    return steps


def _continued(odometry: Float64Array, last: Float64Array) -> Float64Array:
    """Return poses (M, 3) moved so that the first of them is `last` (3,)."""
    turn = last[2] - odometry[0, 2]
    way = (odometry[:, 0] + 1j * odometry[:, 1] - complex(odometry[0, 0], odometry[0, 1])) * np.exp(1j * turn)
    return np.column_stack([last[0] + way.real, last[1] + way.imag, odometry[:, 2] + turn])


@dataclass(frozen=True)
class _Task:
    """One drive to be recorded, and where."""

    folder: Path
    chosen: SimulatedPoses | AmsterdamBenchmark
    plan: DrivePlan
    surveys: Path | None

    @property
    def settings(self) -> dict[str, Any]:
        return settings_of_plan(self.plan)


def settings_of_plan(plan: DrivePlan) -> dict[str, Any]:
    """Return everything that decides what a recorded drive holds, apart from its world."""
    return benchmark.plain(
        {
            "version": VERSION,
            "plan": dataclasses.asdict(plan),
            "sources": sources_digest(recording, route, traffic, lidar, vlp16),
        }
    )


def _is_recorded(task: _Task) -> bool:
    return is_made(task.folder, task.settings)


def _world_of(task: _Task) -> World:
    chosen, plan = task.chosen, task.plan
    if isinstance(chosen, AmsterdamBenchmark):
        if plan.area > 0:
            return placed_town(AWAY, 1 - AWAY.seed % 2, 600.0, None)[0]
        if task.surveys is None:
            raise EvaluationError("the drives of Amsterdam need the folder of its two surveys")
        return world_from_survey([task.surveys / amsterdam.DRIVE_SURVEY], seed=chosen.drive_seed)
    towns = (*chosen.examined.towns, *chosen.off_map)
    town = towns[plan.area]
    corner = chosen.corner(plan.area) if plan.area < len(chosen.examined.towns) else None
    return placed_town(town, 1 - town.seed % 2, chosen.examined.town_size_m, corner)[0]


def _record(task: _Task, advance: Callable[[int], None] | None) -> None:
    record_drive(task.folder, task.plan, _world_of(task), task.settings)
    if advance is not None:
        advance(1)


def record_drive(
    folder: Path, plan: DrivePlan, world: World, settings: dict[str, Any], profile: LidarProfile = VLP16
) -> None:
    """Drive through a world, record a bag, and keep of it in `folder` what the localizer takes.

    `settings`: how it was made, as `settings_of_plan` gives them. Scans are stamped at the end of the turn, whatever
    moment the driver of the lidar gives, for their points carry no times. Raises RouteError where there is no room to
    drive.
    """
    way = plan_route(
        world, plan.length_m, np.random.default_rng([plan.seed, 1]),
        clearance_m=plan.clearance_m, border_m=plan.border_m, speed_m_s=plan.speed_m_s,
    )  # fmt: skip
    config = DriveConfig(scan_every=plan.scan_every, mounting=MountingConfig(z_m=plan.height_m), sensor=profile.config)
    with whole(folder) as partial, tempfile.TemporaryDirectory(dir=partial.parent) as work:
        drive(world, way, Path(work) / "bag", config, seed=plan.seed, profile=profile, start_ns=_START_NS)
        scans, odometry_ns, odometry = _recorded(Path(work) / "bag", plan, way, config.mounting, profile)
        save_scans(partial, RawScans.of(to_grid(scan, world) for scan in scans))
        np.savez(partial / ODOMETRY, stamps_ns=odometry_ns, odometry=odometry)
        mark_made(partial, settings)


def _recorded(
    path: Path, plan: DrivePlan, way: Route, mounting: MountingConfig, profile: LidarProfile
) -> tuple[list[RawScan], Int64Array, Float64Array]:
    """Return of a bag the scans with local poses, and stamps (M,) and poses (M, 3) of the odometry."""
    until_end_ns = round(1e9 * (1.0 - profile.stamped_at) / profile.config.rate_hz)
    gravity = GravityFilter(_IMU_TIME_CONSTANT_S)
    scans: list[RawScan] = []
    samples: list[tuple[int, float, float, float]] = []
    with open_bag(path) as bag:
        cloud_topic = bag.only_topic(POINT_CLOUD, "a drive has one lidar").name
        for topic, recorded_ns, message in bag.messages([cloud_topic, "/imu", "/odom"]):
            stamp_ns = stamp_ns_of(message, recorded_ns)
            if topic == "/imu":
                force = message.linear_acceleration
                gravity.update(stamp_ns, np.array([force.x, force.y, force.z]))
            elif topic == "/odom":
                pose = message.pose.pose
                heading = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
                samples.append((stamp_ns, pose.position.x, pose.position.y, heading))
            else:
                stamp_ns += until_end_ns
                true = way.at((stamp_ns - _START_NS) * 1e-9)[0]
                up = gravity.up(stamp_ns) if plan.has_imu else None
                points = scan_from_pointcloud2(message).points
                scans.append(RawScan(points, true, mounting_matrix(mounting), up, stamp_ns, plan.area))
    odometry = np.array([sample[1:] for sample in samples])
    odometry[:, 2] = np.unwrap(odometry[:, 2])
    return scans, np.array([sample[0] for sample in samples]), odometry


def load_drives(folder: Path) -> list[RawDrive]:
    """Read the drives that lie in a set's folder; EvaluationError where one is damaged."""
    return [_load(path.parent) for path in sorted((folder / DRIVES).glob(f"*/{ODOMETRY}"))]


def _load(folder: Path) -> RawDrive:
    try:
        plan = DrivePlan(**how_made(folder)["plan"])
        with np.load(folder / ODOMETRY, allow_pickle=False) as file:
            return RawDrive(plan, load_scans(folder), file["stamps_ns"], file["odometry"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise EvaluationError(f"{folder} is damaged ({error}); delete it and make it anew") from error
