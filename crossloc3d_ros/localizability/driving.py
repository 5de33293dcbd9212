"""Short drives through a map as it may have become: what the localizer makes of them.

A robot follows the streets of a square. Every some metres along its way is a place: a drive that begins there, knowing
nothing, is localized by the session and the tracker that the node has, until it has a right fix or has gone 100 m.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.config import LocalizabilityConfig, LocalizerConfig, MountingConfig
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.evaluation.poses.errors import right_aligned
from crossloc3d_ros.localizability.fit import MOST_OFF_MAP
from crossloc3d_ros.localization.fusion.decision import RIGHT_WITHIN_M
from crossloc3d_ros.localization.fusion.odometry import planar_pose
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.localization.session import Session
from crossloc3d_ros.simulation.drive import DriveConfig
from crossloc3d_ros.simulation.lidar import Lidar
from crossloc3d_ros.simulation.profiles import PROFILES
from crossloc3d_ros.simulation.route import Route, RouteError, plan_route
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Estimate, FixStatus, Float64Array, Scan

FAR_M, NEAR_M = 100.0, 20.0
"""How far a drive goes at most, and what "soon" means."""
SCAN_EVERY_M = 4.0
_LEAST_RIVAL = 0.02  # probability: what is less is no place that a scan is taken for
_SPEED_M_S = 2.0
_SAMPLES_HZ = 20.0
_EDGE_M = 5.0  # so far from the edge of its square a robot keeps
_STEP_M = 22.0  # from place to place along the way, where the square has room
_FIRST_M = 2.0
_CLEARANCE_M = 1.5


@dataclass(frozen=True)
class Rival:
    """A wrong pose that a scan may be taken for."""

    easting: float
    northing: float
    probability: float


@dataclass(frozen=True, eq=False)
class DrivenPlace:
    """A place of the map, and what the localizer makes of a drive that begins there."""

    easting: float
    northing: float
    heading_rad: float
    is_right: bool
    """Whether the likeliest pose of its first scan is the right one."""
    probability: float
    """Of the right pose, from the first scan alone; 0 where it was not found."""
    rivals: tuple[Rival, ...]
    """The wrong poses of the first scan that have some probability, likeliest first."""
    localized_m: float
    """Metres until the first right fix; infinite where there is none. 0: it came within 20 m, and the first scan alone
    had given the right pose more belief than any scan off the map may have."""
    had_wrong_fix: bool
    """Whether a fix was off by more than 10 m."""


class Sensor:
    """The simulated lidar on its robot."""

    def __init__(self, config: LocalizabilityConfig) -> None:
        """Set it up; ConfigError for a lidar that is not known."""
        if config.lidar not in PROFILES:
            raise ConfigError(f"unknown lidar '{config.lidar}'; known are: {', '.join(sorted(PROFILES))}")
        self.profile = PROFILES[config.lidar]
        self._lidar = Lidar(self.profile)
        self.mounting = MountingConfig(z_m=config.lidar_height_m)
        self._T_base_lidar = mounting_matrix(self.mounting)

    def localizer_config(self, base: LocalizerConfig | None = None) -> LocalizerConfig:
        """Return the localizer's settings, by default its own, for scans of this sensor."""
        base = base or LocalizerConfig()
        scan = dataclasses.replace(
            base.scan, mounting=self.mounting, period_s=1.0 / self.profile.config.rate_hz, stamped_at=1.0
        )
        return dataclasses.replace(base, scan=scan)

    def scan(
        self, world: World, T_world_base: Float64Array, rng: np.random.Generator, twist: Float64Array | None,
        stamp_ns: int,
    ) -> Scan:  # fmt: skip
        """Return the turn that ends where the base is at `T_world_base` (4, 4), moving by `twist` (6,)."""
        in_lidar = None
        if twist is not None:
            # The mounting is a shift along z alone: of a base that rolls or pitches that adds to the speed.
            in_lidar = twist.copy()
            in_lidar[:3] += np.cross(twist[3:], self._T_base_lidar[:3, 3])
        return self._lidar.scan(world.scene, T_world_base @ self._T_base_lidar, rng, in_lidar).as_scan(stamp_ns)


def plan_way(world: World, places: int, seed: int) -> Route | None:
    """Return a way along the streets of a world from which so many drives begin; None where there is no room."""
    rng = np.random.default_rng([seed, 22])
    try:
        return plan_route(
            world, FAR_M + _STEP_M * places, rng, clearance_m=_CLEARANCE_M, border_m=_EDGE_M, speed_m_s=_SPEED_M_S
        )
    except RouteError:
        return None


def starts_of(way: Route, places: int) -> Float64Array:
    """Return metres (places,) along a way at which drives begin; the last has 100 m left, if the way is as long."""
    # Not at its very beginning: the points of a turn are older than its stamp.
    return np.linspace(_FIRST_M, max(way.length_m - FAR_M - SCAN_EVERY_M, _FIRST_M), places)


def travelled_of(way: Route) -> Float64Array:
    """Return metres (N,) driven until each moment of a way."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way.poses[:, :2, 3], axis=0).T))])


def grid_pose(T_world_base: Float64Array, world: World) -> Float64Array:
    """Return easting, northing and heading (3,) of a local pose."""
    place = world.to_grid(T_world_base[None, :3, 3])[0]
    return np.array([place[0], place[1], math.atan2(T_world_base[1, 0], T_world_base[0, 0])])


def rivals_of(estimate: Estimate, truth: Float64Array) -> tuple[Rival, ...]:
    """Return the wrong poses of an estimate that have some probability."""
    aligned = estimate.aligned
    off = np.hypot(aligned.grid[:, 0] - truth[0], aligned.grid[:, 1] - truth[1])
    rows = np.flatnonzero((aligned.probabilities >= _LEAST_RIVAL) & (off > RIGHT_WITHIN_M))
    return tuple(
        Rival(float(aligned.grid[i, 0]), float(aligned.grid[i, 1]), float(aligned.probabilities[i]))
        for i in rows[np.argsort(-aligned.probabilities[rows], kind="stable")]
    )


def drive_from(
    way: Route, world: World, sensor: Sensor, localizer: Localizer, start_m: float, seed: int
) -> DrivenPlace:
    """Localize a drive along a way from `start_m` on, from nothing, until its first right fix or its end."""
    first: tuple[Estimate, Float64Array] | None = None
    localized_m, had_wrong_fix, is_certain = math.inf, False, False
    for travelled_m, estimate, truth in steps_from(way, world, sensor, localizer, start_m, seed):
        off_m = float(np.hypot(*(estimate.grid[:2] - truth[:2])))
        if first is None:
            first = estimate, truth
            is_certain = (
                float(estimate.aligned.probabilities[right_aligned(estimate.aligned, truth)].sum()) >= MOST_OFF_MAP
            )
        if estimate.status is FixStatus.FIX:
            had_wrong_fix |= off_m > RIGHT_WITHIN_M
            if off_m <= RIGHT_WITHIN_M:
                localized_m = 0.0 if is_certain and travelled_m <= NEAR_M and not had_wrong_fix else travelled_m
                break
    assert first is not None  # the first step needs no room
    estimate, truth = first
    right = right_aligned(estimate.aligned, truth)
    return DrivenPlace(
        easting=float(truth[0]),
        northing=float(truth[1]),
        heading_rad=float(truth[2]),
        is_right=bool(right[:1].any()),
        probability=float(estimate.aligned.probabilities[right].sum()),
        rivals=rivals_of(estimate, truth),
        localized_m=localized_m,
        had_wrong_fix=had_wrong_fix,
    )


def steps_from(
    way: Route, world: World, sensor: Sensor, localizer: Localizer, start_m: float, seed: int
) -> Iterator[tuple[float, Estimate, Float64Array]]:
    """Yield metres driven, estimate and true pose (3,) in the grid, scan after scan of a drive that knew nothing."""
    localizer.reset()
    session = Session(localizer, "topic")
    travelled = travelled_of(way)
    start_s = float(np.interp(start_m, travelled, way.time_s))
    odometry = _wheel_odometry(way, start_s, np.random.default_rng([seed, 24, round(10.0 * start_m)]))
    rng = np.random.default_rng([seed, 23, round(10.0 * start_m)])
    for driven_m in np.arange(0.0, FAR_M + 0.5, SCAN_EVERY_M).tolist():
        if start_m + driven_m > travelled[-1]:
            return
        time_s = float(np.interp(start_m + driven_m, travelled, way.time_s))
        stamp_ns = round(1e9 * (time_s - start_s)) + _START_NS
        for stamp, T in odometry(stamp_ns):
            session.add_odometry(stamp, T)
        pose = way.at(time_s)[0]
        scan = sensor.scan(world, pose, rng, way.twist(time_s)[0], stamp_ns)
        yield driven_m, session.localize(session.receive(scan)).estimate, grid_pose(pose, world)


_START_NS = 1_000_000_000


def _wheel_odometry(
    way: Route, start_s: float, rng: np.random.Generator
) -> Callable[[int], Iterator[tuple[int, Float64Array]]]:
    """Return what yields the samples of wheels up to a stamp: planar, with errors of scale and a drift of the heading.

    The errors are those of `simulation.drive`, without its noise from sample to sample, which averages out.
    """
    config = DriveConfig()
    scale = 1.0 + config.odometry_scale_error * rng.standard_normal()
    drift = math.radians(config.odometry_yaw_drift_deg_s) * rng.standard_normal()
    times = np.arange(max(start_s - 0.5, 0.0), way.duration_s + 0.5 / _SAMPLES_HZ, 1.0 / _SAMPLES_HZ)
    poses = way.at(times)
    heading = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])) + drift * (times - times[0])
    steps = np.hypot(*np.diff(poses[:, :2, 3], axis=0).T) * scale
    x = np.concatenate([[0.0], np.cumsum(steps * np.cos(heading[:-1]))])
    y = np.concatenate([[0.0], np.cumsum(steps * np.sin(heading[:-1]))])
    stamps = np.round(1e9 * (times - start_s)).astype(np.int64) + _START_NS
    done = 0

    def until(stamp_ns: int) -> Iterator[tuple[int, Float64Array]]:
        nonlocal done
        # One sample beyond the stamp, so that its pose can be interpolated.
        while done < len(times) and (done == 0 or stamps[done - 1] < stamp_ns):
            yield int(stamps[done]), planar_pose(x[done], y[done], heading[done])
            done += 1

    return until
