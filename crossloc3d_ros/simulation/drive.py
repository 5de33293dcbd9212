"""A robot with a lidar drives a route and records what a robot records.

`drive(world, route, path)` writes a rosbag2 with

    /velodyne_points     sensor_msgs/PointCloud2   10 Hz, as Velodyne's driver sends it, stamped at the end of the turn;
                                                   of other lidars as their drivers name, lay out and stamp it
    /gnss                sensor_msgs/NavSatFix     position of base_link with wandering errors, covariance, outages
    /odom                nav_msgs/Odometry         wheel odometry that drifts, odom -> base_link
    /imu                 sensor_msgs/Imu           turn rate, specific force and attitude, axes as base_link
    /ground_truth/fix    sensor_msgs/NavSatFix     the true position of base_link at the stamp of each scan
    /ground_truth/odom   nav_msgs/Odometry         the true pose then, in an ENU frame

The altitude is NaN where the world's geoid is not known, as for heights above NAP.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.config import MountingConfig, option
from crossloc3d_ros.formats import bag, messages
from crossloc3d_ros.formats.messages import CloudLayout
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.simulation.lidar import Lidar, LidarConfig, LidarProfile
from crossloc3d_ros.simulation.route import Route, RouteError
from crossloc3d_ros.simulation.traffic import Traffic, TrafficConfig
from crossloc3d_ros.simulation.vlp16 import VLP16
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Float64Array

_GRAVITY_M_S2 = 9.81
_START_NS = 1_700_000_000_000_000_000
_TOPICS_AND_FRAMES: dict[CloudLayout, tuple[str, str]] = {
    "velodyne": ("/velodyne_points", "velodyne"),
    "ouster": ("/ouster/points", "os_lidar"),
    "hesai": ("/lidar_points", "hesai_lidar"),
    "livox": ("/livox/lidar", "livox_frame"),
}
"""What the drivers call their clouds and the lidar's frame."""


@dataclass(frozen=True)
class DriveConfig:
    """What the robot carries and how well it works."""

    scan_every: int = option(1, "record each turn of the sensor, or every n-th", low=1, high=1000)
    gnss_rate_hz: float = option(2.0, "fixes a second", low=0.1, high=20.0)
    gnss_error_m: float = option(0.8, "one sigma of a horizontal coordinate; the height is twice as bad", low=0.0)
    gnss_outages: int = option(1, "times without a fix", low=0, high=100)
    gnss_outage_s: float = option(8.0, "how long each lasts", low=0.0, high=1000.0)
    odometry_rate_hz: float = option(50.0, "messages a second", low=1.0, high=200.0)
    odometry_scale_error: float = option(0.01, "one sigma of the wheels' scale", low=0.0, high=0.5)
    odometry_yaw_drift_deg_s: float = option(0.05, "one sigma of the constant yaw drift", low=0.0, high=10.0)
    imu_rate_hz: float = option(100.0, "messages a second", low=1.0, high=500.0)
    mounting: MountingConfig = field(default_factory=MountingConfig, metadata={"text": "pose of the lidar"})
    traffic: TrafficConfig = field(default_factory=TrafficConfig, metadata={"text": "what moves around the robot"})
    sensor: LidarConfig = field(default_factory=LidarConfig, metadata={"text": "the lidar"})


@dataclass(frozen=True)
class DriveReport:
    """What a recorded drive holds."""

    scans: int
    points: int
    duration_s: float
    length_m: float


class _Event(NamedTuple):
    stamp_ns: int
    order: int
    topic: str
    msgtype: str
    message: object


def drive(
    world: World,
    route: Route,
    path: Path | str,
    config: DriveConfig | None = None,
    *,
    seed: int = 0,
    profile: LidarProfile = VLP16,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    frame: MapFrame | None = None,
    start_ns: int = _START_NS,
    progress: Callable[[str, float, float, str], None] | None = None,
) -> DriveReport:
    """Drive the route through the world and write the recording to the new folder `path`.

    `profile` is the lidar, which `config.sensor` describes further. `frame` is the ENU frame of `/ground_truth/odom`,
    by default at the world's origin; `progress` is called with stage, done, total and unit. Raises BagError where the
    folder exists or cannot be written, RouteError where the route is shorter than one turn of the sensor; an
    interrupted drive leaves no bag.
    """
    config = config or DriveConfig()
    if route.duration_s <= 1.0 / config.sensor.rate_hz:
        raise RouteError(f"the route lasts {route.duration_s:.2f} s, less than one turn of the lidar")
    robot = _Robot(world, route, config, profile, frame, start_ns)
    streams = [
        robot.scans(seed, progress),
        robot.gnss(np.random.default_rng([seed, 2])),
        robot.odometry(np.random.default_rng([seed, 3])),
        robot.imu(np.random.default_rng([seed, 4])),
    ]
    scans = points = 0
    with bag.BagWriter(path, storage) as writer:
        for topic, msgtype, qos in robot.topics():
            writer.add_topic(topic, msgtype, qos)
        for event in _merged(streams):
            writer.write(event.topic, event.msgtype, event.stamp_ns, event.message)
            if event.topic == robot.cloud_topic:
                scans += 1
                points += int(event.message.width)  # type: ignore[attr-defined]
    return DriveReport(scans, points, route.duration_s, route.length_m)


def _merged(streams: list[Iterator[_Event]]) -> Iterator[_Event]:
    """Yield the streams' events by stamp, holding one message of each."""
    return heapq.merge(*streams, key=lambda event: (event.stamp_ns, event.order))


class _Robot:
    """The drive as streams of messages, each in the order of its stamps."""

    def __init__(
        self,
        world: World,
        route: Route,
        config: DriveConfig,
        profile: LidarProfile,
        frame: MapFrame | None,
        start_ns: int,
    ) -> None:
        self.world, self.route, self.config, self.profile, self.start_ns = world, route, config, profile, start_ns
        self.cloud_topic, self.lidar_frame_id = _TOPICS_AND_FRAMES[profile.layout]
        self.frame = frame or MapFrame(world.crs, world.origin_grid, world.geoid_separation_m)
        self.truth_frame_id = "map" if frame is not None else "world"

    def topics(self) -> list[tuple[str, str, bag.OfferedQos]]:
        sensor = bag.OfferedQos(reliability="best_effort", durability="volatile", depth=5)
        reliable = bag.OfferedQos(reliability="reliable", durability="volatile", depth=10)
        return [
            (self.cloud_topic, "sensor_msgs/msg/PointCloud2", sensor),
            ("/gnss", "sensor_msgs/msg/NavSatFix", sensor),
            ("/odom", "nav_msgs/msg/Odometry", reliable),
            ("/imu", "sensor_msgs/msg/Imu", sensor),
            ("/ground_truth/fix", "sensor_msgs/msg/NavSatFix", reliable),
            ("/ground_truth/odom", "nav_msgs/msg/Odometry", reliable),
        ]

    def stamp(self, time_s: float) -> int:
        return self.start_ns + round(time_s * 1e9)

    def enu(self, poses: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return positions (N, 3) and quaternions (N, 4) in the ENU frame of local poses."""
        grid = self.world.to_grid(poses[:, :3, 3])
        turn = Rotation.from_euler("z", -self.frame.convergence_rad(grid)[:, None])
        return self.frame.to_enu(grid), (turn * Rotation.from_matrix(poses[:, :3, :3])).as_quat()

    def scans(self, seed: int, progress: Callable[[str, float, float, str], None] | None) -> Iterator[_Event]:
        config = self.config
        rng = np.random.default_rng([seed, 1])
        sensor = Lidar(self.profile, config.sensor)
        T_base_lidar = mounting_matrix(config.mounting)
        period = 1.0 / config.sensor.rate_hz
        times = np.arange(period, self.route.duration_s, period)[:: config.scan_every]
        poses, twists = self.route.at(times), self.route.twist(times)
        until_end_s = period * (1.0 - self.profile.stamped_at)
        R = T_base_lidar[:3, :3]
        # A stream of its own: with more or less traffic all else stays the same.
        traffic = Traffic.draw(self.world, self.route, np.random.default_rng([seed, 5]), config.traffic)
        for i, time in enumerate(times):
            turn_rate = twists[i, 3:]
            velocity = twists[i, :3] + np.cross(turn_rate, T_base_lidar[:3, 3])
            twist = np.concatenate([R.T @ velocity, R.T @ turn_rate])
            movers = traffic.at(float(time), poses[i, :2, 3])
            scan = sensor.scan(self.world.scene, poses[i] @ T_base_lidar, rng, twist, movers)
            sent = self.stamp(time)  # when the turn ends, whatever moment of it the stamp gives
            cloud = messages.lidar_cloud(
                self.profile.layout, self.stamp(time - until_end_s), self.lidar_frame_id,
                scan.points, scan.intensity, scan.ring, scan.time.astype(np.float64) + until_end_s,
            )  # fmt: skip
            yield _Event(sent, 0, self.cloud_topic, "sensor_msgs/msg/PointCloud2", cloud)
            yield from self.truth(time - until_end_s, sent)
            if progress is not None:
                progress("driving", i + 1, len(times), "scans")

    def truth(self, time_s: float, sent_ns: int) -> Iterator[_Event]:
        """Yield the true pose at a time."""
        pose, twist, stamp = self.route.at(time_s), self.route.twist(time_s)[0], self.stamp(time_s)
        position, quaternion = self.enu(pose)
        latitude, longitude, altitude = self.frame.to_geographic(self.world.to_grid(pose[:, :3, 3]))
        fix = messages.nav_sat_fix(stamp, "base_link", latitude[0], longitude[0], altitude[0], np.zeros((3, 3)))
        yield _Event(sent_ns, 1, "/ground_truth/fix", "sensor_msgs/msg/NavSatFix", fix)
        odometry = messages.odometry(
            stamp, self.truth_frame_id, "base_link", position[0], quaternion[0], twist[:3], twist[3:]
        )
        yield _Event(sent_ns, 2, "/ground_truth/odom", "nav_msgs/msg/Odometry", odometry)

    def gnss(self, rng: np.random.Generator) -> Iterator[_Event]:
        config = self.config
        times = np.arange(0.1, self.route.duration_s, 1.0 / config.gnss_rate_hz)
        if len(times) == 0:
            return
        sigma = config.gnss_error_m * np.array([1.0, 1.0, 2.0])
        # Errors wander over some twenty seconds; receivers average the quick noise away.
        memory = math.exp(-1.0 / (20.0 * config.gnss_rate_hz))
        error = np.empty((len(times), 3))
        error[0] = rng.standard_normal(3)
        for i in range(1, len(times)):
            error[i] = memory * error[i - 1] + math.sqrt(1 - memory**2) * rng.standard_normal(3)
        outages = rng.uniform(0.1, 0.9, config.gnss_outages) * self.route.duration_s
        lost = [bool(np.any(np.abs(time - outages) < config.gnss_outage_s / 2)) for time in times]
        measured = self.world.to_grid(self.route.at(times)[:, :3, 3]) + error * sigma
        latitudes, longitudes, altitudes = self.frame.to_geographic(measured)
        for i, time in enumerate(times):
            stamp = self.stamp(time)
            if lost[i]:
                fix = messages.nav_sat_fix(stamp, "base_link", math.nan, math.nan, math.nan, has_fix=False)
            else:
                covariance = np.diag(sigma**2)
                fix = messages.nav_sat_fix(stamp, "base_link", latitudes[i], longitudes[i], altitudes[i], covariance)
            yield _Event(stamp, 3, "/gnss", "sensor_msgs/msg/NavSatFix", fix)

    def odometry(self, rng: np.random.Generator) -> Iterator[_Event]:
        config = self.config
        step = 1.0 / config.odometry_rate_hz
        times = np.arange(0.0, self.route.duration_s, step)
        twists = self.route.twist(times)
        scale = 1.0 + config.odometry_scale_error * rng.standard_normal()
        drift = math.radians(config.odometry_yaw_drift_deg_s) * rng.standard_normal()
        speed = twists[:, 0] * scale + 0.01 * rng.standard_normal(len(times)) * (np.abs(twists[:, 0]) > 0.01)
        turn = twists[:, 5] + drift + 0.005 * rng.standard_normal(len(times))
        yaw = np.concatenate([[0.0], np.cumsum(turn[:-1] * step)])
        x = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.cos(yaw[:-1]) * step)])
        y = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.sin(yaw[:-1]) * step)])
        covariance = np.diag([1e-4, 1e-4, 1e6, 1e6, 1e6, 1e-4])
        for i, time in enumerate(times):
            stamp = self.stamp(time)
            message = messages.odometry(
                stamp, "odom", "base_link", (x[i], y[i], 0.0), (0.0, 0.0, math.sin(yaw[i] / 2), math.cos(yaw[i] / 2)),
                (speed[i], 0.0, 0.0), (0.0, 0.0, turn[i]), None, covariance,
            )  # fmt: skip
            yield _Event(stamp, 4, "/odom", "nav_msgs/msg/Odometry", message)

    def imu(self, rng: np.random.Generator) -> Iterator[_Event]:
        config = self.config
        step = 1.0 / config.imu_rate_hz
        times = np.arange(0.0, self.route.duration_s, step)
        poses = self.route.at(times)
        twists = self.route.twist(times)
        _, quaternions = self.enu(poses)
        velocity = np.einsum("nij,nj->ni", poses[:, :3, :3], twists[:, :3])
        acceleration = np.gradient(velocity, step, axis=0) if len(times) > 1 else np.zeros_like(velocity)
        acceleration[:, 2] += _GRAVITY_M_S2
        force = np.einsum("nji,nj->ni", poses[:, :3, :3], acceleration)
        force += 0.02 * rng.standard_normal(3) + 0.03 * rng.standard_normal(force.shape)
        rate = twists[:, 3:] + 0.001 * rng.standard_normal(3) + 0.002 * rng.standard_normal(force.shape)
        wrong = Rotation.from_rotvec(np.radians(0.2) * rng.standard_normal((len(times), 3)))
        attitude = (Rotation.from_quat(quaternions) * wrong).as_quat()
        for i, time in enumerate(times):
            stamp = self.stamp(time)
            message = messages.imu(stamp, "imu", rate[i], force[i], attitude[i])
            yield _Event(stamp, 5, "/imu", "sensor_msgs/msg/Imu", message)
