"""The localizer as a lifecycle node: clouds and odometry in, fixes out."""

from __future__ import annotations

import copy
import logging
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Imu, NavSatFix, PointCloud2
from std_srvs.srv import Empty
from visualization_msgs.msg import MarkerArray

from crossloc3d_ros.aerial_map.store import AerialMap, read_manifest
from crossloc3d_ros.clouds.filters import mounting_matrix, transform_points
from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.errors import CloudError, ConfigError, CrossLocError, PoseError
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.gravity import GravityFilter
from crossloc3d_ros.localization.fusion.odometry import Motion, OdometryBuffer, ScanOdometry
from crossloc3d_ros.localization.fusion.tracking import PosePrior
from crossloc3d_ros.localization.localizer import Localizer, no_estimate
from crossloc3d_ros.ros.conversions import (
    candidate_table_message,
    candidates_message,
    fix_message,
    hypotheses_message,
    markers_message,
    origin_message,
    pose_message,
    stale_message,
    state_message,
)
from crossloc3d_ros.ros.diagnostics import (
    SILENCE_S,
    Outcome,
    Statistics,
    diagnostic_message,
    judge_health,
    snapshot_values,
)
from crossloc3d_ros.ros.odometry_input import OdometryInput, odometry_complaint
from crossloc3d_ros.ros.parameters import ConfigParameters
from crossloc3d_ros.ros.poses import EARTH_FRAME_ID, heading_prior, initial_pose, stamp_of
from crossloc3d_ros.ros.transforms import MapTransform, TransformSource
from crossloc3d_ros.ros.worker import Worker
from crossloc3d_ros.types import Estimate, FixStatus, Float64Array, Scan, TrackState

ODOMETRY_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Hears reliable publishers too; deep, because a second of 200 Hz may pile up while this process has no time."""
COMMAND_QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DIAGNOSTICS_PERIOD_S = 1.0
REPEAT_REASON_S = 10.0
SPIN_S = 0.1
"""How long the executor waits at most before the process notices a signal."""
EXIT_ERROR = 2

TF_ANSWERS_S = 3.0
"""How long an initial pose waits for TF to explain its frame: a listener that has just begun knows nothing yet."""
TF_PERIOD_S = 0.1
SAME_CLOCK_NS = 10_000_000_000
"""An initial pose whose stamp lies farther from the next cloud's is taken for that cloud: another clock stamped it."""
HEADING_AGE_NS = 500_000_000
SETTINGS_OF_LOCALIZE = ("top_k", "scan.", "retrieval.", "alignment.", "fusion.")
"""Parameters that a running node takes up at once; the others need a new configuration of the node."""


def load_localizer(config: LocalizerNodeConfig) -> Localizer:
    """Load weights and map and bring them together; raises CrossLocError saying what is missing."""
    if not config.map:
        raise ConfigError("parameter 'map' is empty: give the folder of an aerial map, as build_map writes it")
    read_manifest(Path(config.map))  # a wrong folder is told before the seconds that it takes to load torch
    from crossloc3d_ros.encoder.checkpoint import load_encoder

    weights = Path(config.weights) if config.weights else None
    encoder = load_encoder(weights, device=config.device, threads=config.threads or None)
    return Localizer(AerialMap.load(Path(config.map), encoder.fingerprint), encoder, config)


class HeadingSample(NamedTuple):
    """An IMU's message and how its axes lie on the base."""

    message: Imu
    R_base_imu: Float64Array


@dataclass(frozen=True, eq=False)
class Arrival:
    """A cloud and when it came in."""

    message: PointCloud2
    received_s: float
    """Monotonic clock."""
    up_base: Float64Array | None
    """(3,) where up was by then; None where no IMU tells it."""
    heading: HeadingSample | None
    """What the IMU had said of the heading by then."""


class LocalizerNode(LifecycleNode):
    """Subscribe to clouds, localize them, publish the fix and what led to it."""

    def __init__(self, load: Callable[[LocalizerNodeConfig], Localizer] = load_localizer) -> None:
        """Declare the parameters; `load` makes the localizer at configuration. Raises ConfigError."""
        super().__init__("localizer", automatically_declare_parameters_from_overrides=True)
        self._load = load
        self._points_topic = self.resolve_topic_name("points")
        self._configuration = ConfigParameters(
            self,
            LocalizerNodeConfig,
            topics=tuple(map(self.resolve_topic_name, ("points", "imu", "odom", "initialpose"))),
            why_fixed=self._why_fixed,
            on_change=self._take_up_settings,
        )
        self._config = self._configuration.config
        self._localizer: Localizer | None = None
        self._transforms: TransformSource | None = None
        self._map_transform: MapTransform | None = None
        self._gravity = GravityFilter(self._config.imu_time_constant_s)
        self._heading: HeadingSample | None = None
        self._odometry: OdometryInput | None = None
        self._scan_odometry: ScanOdometry | None = None
        self._orders: deque[Callable[[Localizer, int], None]] = deque()
        """What the worker does before the next scan, given its stamp: nobody else touches the hypotheses."""
        self._initial_pose = ""
        self._initial_pose_timer: Any = None
        self._worker = Worker(self._process, "localize", self._config.queue_depth)
        self._statistics = Statistics()
        self._complaint = ""
        self._last_status: FixStatus | None = None
        self._state = TrackState.SEARCHING
        self._is_stale = False
        self._outputs: dict[str, Any] = {}
        self._inputs: list[Any] = []
        self.failure = ""
        """Why the node could not start by itself; empty as long as it can."""

        # Not held up by a simulated clock that stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._diagnostics_timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics, clock=steady)
        self.create_service(Empty, "reinitialize_global_localization", self._reinitialize)
        if self._config.autostart:
            self._autostart_timer = self.create_timer(0.0, self._autostart, clock=steady)

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load weights and map and announce the outputs."""
        result = self._attempt(self._configure)
        if result != TransitionCallbackReturn.SUCCESS:
            self._release()
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Warm up, publish the map's origin and begin to listen."""
        result = self._attempt(self._activate)
        return super().on_activate(state) if result == TransitionCallbackReturn.SUCCESS else result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening and let the scan at work end."""
        self._stop_listening()
        self._complaint = ""
        self._tell_stale("inactive")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of weights and map."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good."""
        self._stop_listening()
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall back to unconfigured, from where a lifecycle manager can try again."""
        self._stop_listening()
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _autostart(self) -> None:
        self.destroy_timer(self._autostart_timer)
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                self.failure = self._complaint or "the transition failed"
                return

    def _attempt(self, step: Callable[[], None]) -> TransitionCallbackReturn:
        """Run a step of the lifecycle; what goes wrong is logged, where rclpy would swallow it."""
        self._complaint = ""
        try:
            step()
        except CrossLocError as error:
            self._complaint = " ".join(str(error).split())
        except Exception as error:
            self._complaint = f"{type(error).__name__}: {error}"
            logging.getLogger(__name__).exception("the localizer could not start")
        else:
            return TransitionCallbackReturn.SUCCESS
        self.get_logger().error(self._complaint)
        self._stop_listening()
        return TransitionCallbackReturn.FAILURE

    def _configure(self) -> None:
        self._config = config = self._configuration.config
        started = time.monotonic()
        if config.mounting_from_tf:
            if not config.base_frame_id:
                raise ConfigError("mounting_from_tf needs a base_frame_id")
            self._transforms = TransformSource(self, config.base_frame_id)
        if config.tf_broadcast:
            if config.odometry != "topic":
                raise ConfigError("tf_broadcast needs odometry from a topic: that is the frame whose pose it publishes")
            self._map_transform = MapTransform(self, config.global_frame_id, round(1e9 * config.transform_tolerance))
        if config.odometry == "topic":
            on_base = None if self._transforms is None else self._transforms.pose_on_base
            self._odometry = OdometryInput(
                OdometryBuffer(config.fusion), config.base_frame_id, config.odometry_timeout_s, on_base
            )
        elif config.odometry == "scan":
            self._scan_odometry = ScanOdometry(config.fusion, config.scan.max_range_m)
        self._gravity = GravityFilter(config.imu_time_constant_s)
        self._localizer = localizer = self._load(config)
        self._worker = Worker(self._process, "localize", config.queue_depth)
        self._outputs = {
            "fix": self.create_lifecycle_publisher(NavSatFix, "~/fix", 10),
            "pose": self.create_lifecycle_publisher(PoseWithCovarianceStamped, "~/pose", LATCHED),
            "candidates": self.create_lifecycle_publisher(PoseArray, "~/candidates", 10),
            "candidate_table": self.create_lifecycle_publisher(PointCloud2, "~/candidate_table", 10),
            "hypotheses": self.create_lifecycle_publisher(PoseArray, "~/hypotheses", 10),
            "state": self.create_lifecycle_publisher(DiagnosticStatus, "~/state", LATCHED),
            "markers": self.create_lifecycle_publisher(MarkerArray, "~/markers", 1),
        }
        # Not managed: who joins while the node is inactive shall learn of the origin too.
        self._outputs["map_origin"] = self.create_publisher(NavSatFix, "~/map_origin", LATCHED)
        stamp_ns = self.get_clock().now().nanoseconds
        origin = origin_message(localizer.aerial_map.frame, stamp_ns, config.global_frame_id)
        self._outputs["map_origin"].publish(origin)
        self.get_logger().info(
            f"map '{config.map}': {len(localizer.aerial_map.submaps.grid):,} submaps, "
            f"origin {origin.latitude:.6f}, {origin.longitude:.6f}; "
            f"weights {localizer.encoder.fingerprint[:12]}; loaded in {time.monotonic() - started:.1f} s"
        )

    def _activate(self) -> None:
        started = time.monotonic()
        localizer = self._localizer
        if localizer is None:
            raise ConfigError("the node is not configured")
        self.get_logger().info("warming up; the first start on a machine compiles for a while")
        # In the worker's own thread, because numerical libraries keep state for each thread.
        self._worker.start(localizer.warm_up)
        self._statistics.reset()
        self._forget()
        events = SubscriptionEventCallbacks(
            incompatible_qos=self._on_incompatible_qos, message_lost=self._on_message_lost
        )
        if self._odometry is not None:
            self._listen(Odometry, "odom", self._receive_odometry, ODOMETRY_QOS)
        if self._config.use_imu or self._config.use_imu_heading:
            self._listen(Imu, "imu", self._receive_imu, qos_profile_sensor_data)
        self._listen(PoseWithCovarianceStamped, "initialpose", self._receive_initial_pose, COMMAND_QOS)
        self._listen(PointCloud2, "points", self._receive, qos_profile_sensor_data, events)
        self.get_logger().info(f"warm after {time.monotonic() - started:.1f} s; listening on {self._points_topic}")

    def _listen(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        profile: QoSProfile,
        events: SubscriptionEventCallbacks | None = None,
    ) -> None:
        """Subscribe with `profile`, or as the user has overridden it."""
        options = QoSOverridingOptions.with_default_policies()
        try:
            subscription = self.create_subscription(
                kind,
                topic,
                callback,
                copy.copy(profile),  # rclpy writes the overrides into the profile that it is given
                qos_overriding_options=options,
                event_callbacks=events,
            )
        except (InvalidQosOverridesError, RuntimeError, TypeError, ValueError) as error:
            raise ConfigError(f"qos_overrides.{self.resolve_topic_name(topic)}.subscription: {error}") from error
        self._inputs.append(subscription)

    def _stop_listening(self) -> bool:
        """Take no more clouds and wait for the worker; return whether it has ended."""
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._inputs = []
        self._stop_waiting_for_tf()
        ended = self._worker.stop()
        if not ended:
            self.get_logger().error("the scan at work does not end")
        return ended

    def _release(self) -> None:
        for name, publisher in self._outputs.items():
            if name == "map_origin":
                self.destroy_publisher(publisher)
            else:
                self.destroy_lifecycle_publisher(publisher)
        self._outputs = {}
        for tf in (self._transforms, self._map_transform):
            if tf is not None:
                tf.close()
        self._transforms = self._map_transform = None
        self._odometry = self._scan_odometry = None
        self._localizer = None

    # Parameters

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set the parameters, all or none; a refusal says which one and why."""
        try:
            admitted = self._configuration.admit(parameter_list)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(admitted)

    def _why_fixed(self, name: str) -> str | None:
        if name == "autostart":
            return "is read once, at the start"
        if self._localizer is None or name.startswith(SETTINGS_OF_LOCALIZE):
            return None
        return "is read when the node is configured: clean the node up first"

    def _take_up_settings(self) -> None:
        """Give the running localizer new settings, and no hypotheses; the scan at work ends with the old ones."""
        if self._localizer is not None:
            self._config = self._configuration.config
            self._localizer = type(self._localizer)(self._localizer.aerial_map, self._localizer.encoder, self._config)
            self._forget()
            self.get_logger().info("localizing anew, with other settings")

    # Input

    def _receive(self, message: PointCloud2) -> None:
        self._statistics.received()
        up_base = self._gravity.up(stamp_of(message)) if self._config.use_imu else None
        arrival = Arrival(message, time.monotonic(), up_base, self._heading)
        self._statistics.dropped(self._worker.offer(arrival))

    def _receive_odometry(self, message: Odometry) -> None:
        if self._odometry is None:
            return
        try:
            self._odometry.take(message)
        except CrossLocError as error:
            self.get_logger().warning(f"odometry is not used: {error}", throttle_duration_sec=REPEAT_REASON_S)

    def _receive_imu(self, message: Imu) -> None:
        force = message.linear_acceleration
        acceleration = np.array([force.x, force.y, force.z])
        R_base_imu = np.eye(3)
        if self._transforms is not None:
            try:
                R_base_imu = self._transforms.pose_on_base(message.header.frame_id)[:3, :3]
            except CrossLocError as error:
                self.get_logger().warning(f"IMU: {error}", throttle_duration_sec=REPEAT_REASON_S)
                return
        acceleration = R_base_imu @ acceleration
        if not self._gravity.update(stamp_of(message), acceleration):
            self.get_logger().warning(
                f"IMU: acceleration {np.round(acceleration, 2).tolist()} m/s2 is no gravity; sample left out",
                throttle_duration_sec=REPEAT_REASON_S,
            )
            return
        if acceleration[2] < 0.0:
            self.get_logger().warning(
                f"IMU: acceleration {np.round(acceleration, 2).tolist()} m/s2 points down: at rest it must be +9.8 "
                "upwards, in the axes of the base (REP-145)",
                throttle_duration_sec=REPEAT_REASON_S,
            )
        if self._config.use_imu_heading:
            self._heading = HeadingSample(message, R_base_imu)

    def _receive_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Take up a first guess; TF is asked for as long as it may need, and only about frames that it must explain."""
        localizer, config = self._localizer, self._config
        self._stop_waiting_for_tf()
        if localizer is None:
            return
        frame_id = message.header.frame_id
        if frame_id == config.global_frame_id:
            self._take_initial_pose(message, np.eye(4))
        elif frame_id == EARTH_FRAME_ID:
            self._take_initial_pose(message, np.asarray(np.linalg.inv(localizer.aerial_map.frame.pose_on_earth)))
        elif not frame_id:
            self._refuse_initial_pose("it names no frame")
        else:
            self._ask_tf(message)

    def _ask_tf(self, message: PoseWithCovarianceStamped) -> None:
        frame_id, config = message.header.frame_id, self._config
        try:
            source = self._transforms = self._transforms or TransformSource(self, config.base_frame_id)
        except ConfigError:
            self._refuse_initial_pose(
                f"it is given in '{frame_id}': without tf2_ros only '{config.global_frame_id}' and "
                f"'{EARTH_FRAME_ID}' can be explained"
            )
            return
        deadline = time.monotonic() + TF_ANSWERS_S

        def look() -> None:
            try:
                T_map_frame = source.pose_in(config.global_frame_id, frame_id)
            except PoseError as error:
                if time.monotonic() > deadline:
                    self._stop_waiting_for_tf()
                    self._refuse_initial_pose(str(error))
                return
            self._stop_waiting_for_tf()
            self._take_initial_pose(message, T_map_frame)

        self._initial_pose_timer = self.create_timer(TF_PERIOD_S, look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _stop_waiting_for_tf(self) -> None:
        if self._initial_pose_timer is not None:
            self.destroy_timer(self._initial_pose_timer)
        self._initial_pose_timer = None

    def _take_initial_pose(self, message: PoseWithCovarianceStamped, T_map_frame: Float64Array) -> None:
        localizer = self._localizer
        if localizer is None:
            return
        aerial_map = localizer.aerial_map
        try:
            prior = initial_pose(message.pose, stamp_of(message), T_map_frame, aerial_map.frame, aerial_map.bounds)
        except PoseError as error:
            self._refuse_initial_pose(str(error))
            return

        def order(localizer: Localizer, stamp_ns: int) -> None:
            same_clock = abs(prior.stamp_ns - stamp_ns) < SAME_CLOCK_NS
            localizer.set_prior(prior if same_clock else replace(prior, stamp_ns=0))

        self._orders.append(order)
        self._initial_pose = f"taken: {_described(prior)}"
        self.get_logger().info(f"initial pose {self._initial_pose}")

    def _refuse_initial_pose(self, reason: str) -> None:
        self._initial_pose = f"refused: {reason}"
        self.get_logger().error(f"initial pose {self._initial_pose}")

    def _reinitialize(self, request: Empty.Request, response: Empty.Response) -> Empty.Response:
        """Forget everything that earlier messages left behind."""
        self._statistics.dropped(self._worker.discard())
        self._gravity.reset()
        self._forget()
        self.get_logger().info("localizing anew")
        return response

    def _forget(self) -> None:
        """Let the worker begin anew with its next scan."""
        self._orders.clear()
        self._orders.append(self._reset_localizer)
        self._heading = None
        self._initial_pose = ""
        self._last_status = None

    def _reset_localizer(self, localizer: Localizer, stamp_ns: int) -> None:
        localizer.reset()
        self._state = TrackState.SEARCHING
        if self._scan_odometry is not None:
            self._scan_odometry.reset()

    def _on_incompatible_qos(self, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        self._complaint = (
            f"a publisher on {self._points_topic} offers an incompatible {policy}, so its clouds never arrive: "
            f"set qos_overrides.{self._points_topic}.subscription.*"
        )
        self.get_logger().error(self._complaint)

    def _on_message_lost(self, event: Any) -> None:
        self._statistics.lost(int(event.total_count))

    # One scan, in the worker's thread

    def _process(self, arrival: Arrival) -> None:
        outcome = self._localize(arrival)
        try:
            self._publish(outcome.estimate)
        except Exception:
            # The worker must outlive whatever happens; publishing fails when the node is being torn down.
            logging.getLogger(__name__).exception("the estimate could not be published")
        self._statistics.processed(outcome, 1e3 * (time.monotonic() - arrival.received_s))
        self._tell(outcome)

    def _localize(self, arrival: Arrival) -> Outcome:
        """Return what comes of a message; every failure becomes an estimate without a fix, with its reason."""
        localizer, message = self._localizer, arrival.message
        stamp_ns = stamp_of(message)
        try:
            if localizer is None:
                raise CloudError("the node is being cleaned up")
            scan = scan_from_pointcloud2(message)
            T_base_lidar = None if self._transforms is None else self._transforms.pose_on_base(scan.frame_id)
            while self._orders:
                self._orders.popleft()(localizer, stamp_ns)
            self._guess_heading(localizer, arrival.heading, stamp_ns)
            if self._scan_odometry is not None:
                self._take_scan(scan, T_base_lidar)

            def motion() -> Motion | None:
                return self._motion(localizer.stamp_ns, scan.stamp_ns)

            estimate = localizer.localize(scan, arrival.up_base, T_base_lidar, motion)
            if not len(estimate.candidates):  # nothing that could have changed what is known
                estimate = replace(estimate, state=self._state)
            self._state = estimate.state
            return Outcome(estimate, is_fault=False)
        except CrossLocError as error:
            return self._fault(stamp_ns, str(error))
        except Exception as error:
            logging.getLogger(__name__).exception("localizing failed")
            return self._fault(stamp_ns, f"{type(error).__name__}: {error}")

    def _fault(self, stamp_ns: int, reason: str) -> Outcome:
        """Return what comes of a message that says nothing: no fix, and no other state than before."""
        return Outcome(replace(no_estimate(stamp_ns, reason), state=self._state), is_fault=True)

    def _take_scan(self, scan: Scan, T_base_lidar: Float64Array | None) -> None:
        """Let the odometry from scan to scan see a scan."""
        assert self._scan_odometry is not None
        config = self._config.scan
        T = mounting_matrix(config.mounting) if T_base_lidar is None else T_base_lidar
        ranges = np.linalg.norm(scan.points, axis=1)
        used = (ranges >= config.min_range_m) & (ranges <= config.max_range_m)  # and so finite
        self._scan_odometry.add(scan.stamp_ns, transform_points(T, scan.points[used]).astype(np.float64))

    def _motion(self, from_ns: int | None, to_ns: int) -> Motion | None:
        """Return how the robot moved from the scan that the hypotheses stand at; None where there is none, or no
        odometry."""
        source = self._odometry or self._scan_odometry
        return None if source is None or from_ns is None else source.motion(from_ns, to_ns)

    def _guess_heading(self, localizer: Localizer, sample: HeadingSample | None, stamp_ns: int) -> None:
        """Hand on what the IMU says of the heading, as long as nothing better is known."""
        config = self._config
        if sample is None or self._state is TrackState.LOCALIZED:
            return
        if abs(stamp_ns - stamp_of(sample.message)) > HEADING_AGE_NS:
            return
        std_rad, offset_rad = np.radians([config.imu_heading_std_deg, config.imu_heading_offset_deg])
        try:
            prior = heading_prior(
                sample.message, sample.R_base_imu, localizer.aerial_map.frame, float(std_rad), float(offset_rad)
            )
        except PoseError as error:
            self.get_logger().warning(f"IMU: {error}", throttle_duration_sec=REPEAT_REASON_S)
            return
        if prior is None:
            self.get_logger().warning("IMU: its messages carry no orientation", throttle_duration_sec=REPEAT_REASON_S)
        else:
            localizer.set_prior(prior)

    def _publish(self, estimate: Estimate) -> None:
        outputs, config, localizer = self._outputs, self._config, self._localizer
        outputs["fix"].publish(fix_message(estimate, config.base_frame_id))
        outputs["state"].publish(state_message(estimate, self._status_name))
        self._is_stale = False
        if estimate.status is FixStatus.FIX:
            outputs["pose"].publish(pose_message(estimate, config.global_frame_id))
            self._publish_transform(estimate)
        if localizer is None:
            return
        frame, global_frame_id = localizer.aerial_map.frame, config.global_frame_id
        makers: dict[str, Callable[[Estimate, MapFrame, str], Any]] = {
            "hypotheses": hypotheses_message,
            "candidates": candidates_message,
            "candidate_table": candidate_table_message,
            "markers": markers_message,
        }
        for name, make in makers.items():
            if outputs[name].get_subscription_count() > 0:
                outputs[name].publish(make(estimate, frame, global_frame_id))

    def _publish_transform(self, estimate: Estimate) -> None:
        """Say where the odometry's frame lies, as long as the odometry knows the robot's pose at the scan's stamp."""
        if self._map_transform is None or self._odometry is None or estimate.state is not TrackState.LOCALIZED:
            return
        child_frame_id = self._odometry.frame_id
        if child_frame_id in ("", self._config.global_frame_id):
            self.get_logger().warning(
                f"no transform is published: the odometry names '{child_frame_id}' as its frame, which must be one of "
                "its own (REP-105)",
                throttle_duration_sec=REPEAT_REASON_S,
            )
            return
        T_odom_base = self._odometry.pose_at(estimate.stamp_ns)
        if T_odom_base is None or not np.isfinite(estimate.T_map_base).all():
            return
        T_map_odom = estimate.T_map_base @ np.linalg.inv(T_odom_base)
        self._map_transform.send(estimate.stamp_ns, T_map_odom, child_frame_id)

    def _tell(self, outcome: Outcome) -> None:
        """Log the first result, every change between fix and no fix, and now and then why there is no fix."""
        estimate, log = outcome.estimate, self.get_logger()
        changed = estimate.status is not self._last_status
        self._last_status = estimate.status
        if estimate.status is FixStatus.FIX:
            if changed:
                log.info(f"fix at {estimate.latitude_deg:.6f}, {estimate.longitude_deg:.6f}: {estimate.reason}")
        elif outcome.is_fault:
            log.error(estimate.reason, throttle_duration_sec=REPEAT_REASON_S)
        else:
            log.warning(f"no fix: {estimate.reason}", throttle_duration_sec=REPEAT_REASON_S)

    # Diagnostics

    def _publish_diagnostics(self) -> None:
        snapshot = self._statistics.snapshot()
        localizer, config = self._localizer, self._config
        values = snapshot_values(snapshot)
        values["map"] = config.map
        if localizer is not None:
            values["submaps"] = str(len(localizer.aerial_map.submaps.grid))
            values["encoder"] = localizer.encoder.fingerprint
        if self._inputs:
            publishers = self.count_publishers(self._points_topic)
            complaint = self._odometry_complaint()
            if self._odometry is not None:
                values["odometry"] = complaint or f"{self._odometry.state().messages} messages"
            level, message = judge_health(snapshot, self._points_topic, publishers, self._complaint, complaint)
            if snapshot.silent_s > SILENCE_S:
                self._tell_stale(message)
        elif self._complaint:
            level, message = DiagnosticStatus.ERROR, self._complaint
        else:
            level = DiagnosticStatus.OK
            message = "inactive" if localizer is not None else "not configured"
        if config.use_imu and self._inputs:
            now_ns = self._now_ns(snapshot.last)
            tilt = self._gravity.up(now_ns)
            values["imu"] = "no recent sample" if tilt is None else f"up is {np.round(tilt, 3).tolist()} in base"
        if self._initial_pose:
            values["initial pose"] = self._initial_pose
        name = self._status_name
        stamp_ns = self.get_clock().now().nanoseconds
        self._diagnostics.publish(diagnostic_message(name, stamp_ns, level, message, values))

    @property
    def _status_name(self) -> str:
        return f"{self.get_fully_qualified_name().lstrip('/')}: localization"

    def _odometry_complaint(self) -> str:
        if self._odometry is None:
            return ""
        topic = self.resolve_topic_name("odom")
        return odometry_complaint(self._odometry.state(), topic, self.count_publishers(topic))

    def _tell_stale(self, reason: str) -> None:
        """Say once on the latched topic that what was said last is no longer fresh."""
        if not self._is_stale and "state" in self._outputs:
            self._outputs["state"].publish(stale_message(self._state, reason, self._status_name))
            self._is_stale = True

    def _now_ns(self, last: Outcome | None) -> int:
        """Return the time on the sensors' clock, as far as a scan has told it."""
        return self.get_clock().now().nanoseconds if last is None else last.estimate.stamp_ns

    def close(self) -> bool:
        """Let go of everything, whatever the state, before `destroy_node`; return whether the worker has ended."""
        ended = self._stop_listening()
        self._release()
        return ended


class _RosLogHandler(logging.Handler):
    """Show what the libraries of this package log through the node's logger."""

    def __init__(self, node: LocalizerNode) -> None:
        super().__init__()
        self._log = node.get_logger().get_child("library")
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        # A call site of a ROS logger has one severity for good: one line each.
        text = self.format(record)
        if record.levelno >= logging.ERROR:
            self._log.error(text)
        elif record.levelno >= logging.WARNING:
            self._log.warning(text)
        elif record.levelno >= logging.INFO:
            self._log.info(text)
        else:
            self._log.debug(text)


def run_localizer(arguments: Sequence[str], load: Callable[[LocalizerNodeConfig], Localizer] = load_localizer) -> int:
    """Run the node until it is told to stop, and return the exit code; `load` makes its localizer.

    0 after SIGINT or SIGTERM, as ROS 2 launch expects it; 2 where it could not start by itself, which the log
    explains. Raises CrossLocError for arguments and parameters that are wrong.
    """
    # The handlers are ours, so that the worker ends and the node says good-bye while the context still lives.
    signal.signal(signal.SIGTERM, _interrupt)
    signal.signal(signal.SIGINT, _interrupt)
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # the client library has no common base for malformed arguments
        raise ConfigError(str(error)) from error
    executor = SingleThreadedExecutor()
    node: LocalizerNode | None = None
    handler: logging.Handler | None = None
    code = EXIT_ERROR
    try:
        surplus = remove_ros_args(["localizer", *arguments])[1:]
        if surplus:
            raise ConfigError(f"unknown argument '{surplus[0]}'; parameters follow --ros-args, as -p name:=value")
        node = LocalizerNode(load)
        handler = _RosLogHandler(node)
        logging.getLogger("crossloc3d_ros").addHandler(handler)
        logging.getLogger("crossloc3d_ros").propagate = False
        executor.add_node(node)
        while not node.failure:
            executor.spin_once(timeout_sec=SPIN_S)
    except KeyboardInterrupt:
        code = 0
    finally:
        # From here on a second signal would only tear what is being put away in order.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        ended = node is None or node.close()
        if handler is not None:
            logging.getLogger("crossloc3d_ros").removeHandler(handler)
        executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        if not ended:
            # A thread that hangs in compiled code makes the interpreter crash at exit; everything else is put away.
            os._exit(code)
    return code


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def _described(prior: PosePrior) -> str:
    parts = []
    if prior.grid is not None:
        std_m = float(np.sqrt(np.trace(prior.covariance[:2, :2]) / 2.0))
        parts.append(f"{prior.grid[0]:.1f} E, {prior.grid[1]:.1f} N, give or take {std_m:.1f} m")
    if prior.heading_rad is not None:
        std_deg = float(np.degrees(np.sqrt(prior.covariance[2, 2])))
        parts.append(f"heading {np.degrees(prior.heading_rad):.0f} degrees from east, give or take {std_deg:.0f}")
    return "; ".join(parts)
