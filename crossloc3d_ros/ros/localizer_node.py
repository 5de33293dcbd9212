"""The localizer as a lifecycle node: its parameters and states; inputs, outputs and work are parts of their own.

Two threads: the executor's receives messages and runs the lifecycle, the worker's owns the localizer. What one has for
the other passes through the worker's queue; nothing is written by both.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Empty

from crossloc3d_ros.aerial_map.store import AerialMap, read_manifest
from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.errors import ConfigError, CrossLocError
from crossloc3d_ros.localization.fusion.odometry import require_kiss_icp
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.ros.diagnostics import (
    SILENCE_S,
    Snapshot,
    Statistics,
    diagnostic_message,
    health_status,
    snapshot_values,
    worker_complaint,
)
from crossloc3d_ros.ros.odometry_input import odometry_complaint
from crossloc3d_ros.ros.parameters import ConfigParameters
from crossloc3d_ros.ros.parts import Parts, Transforms, assemble
from crossloc3d_ros.ros.worker import Worker
from crossloc3d_ros.types import TrackState

DIAGNOSTICS_PERIOD_S = 1.0
SETTINGS_WHILE_RUNNING = ("top_k", "scan.", "retrieval.", "alignment.", "fusion.")
"""Parameters that a running node takes up with the next scan; the others need a new configuration of the node."""


def load_localizer(config: LocalizerNodeConfig) -> Localizer:
    """Load weights and map and bring them together; raises CrossLocError saying what is missing."""
    if not config.map:
        raise ConfigError("parameter 'map' is empty: give the folder of an aerial map, as build_map writes it")
    read_manifest(Path(config.map))  # a wrong folder is reported before the seconds that it takes to load torch
    from crossloc3d_ros.encoder.checkpoint import load_encoder

    weights = Path(config.weights) if config.weights else None
    encoder = load_encoder(weights, device=config.device, threads=config.threads or None)
    return Localizer(AerialMap.load(Path(config.map), encoder.fingerprint), encoder, config, threads=config.threads)


class LocalizerNode(LifecycleNode):
    """Subscribe to clouds, localize them, publish the fix and what led to it."""

    def __init__(self, load: Callable[[LocalizerNodeConfig], Localizer] = load_localizer) -> None:
        """Declare the parameters; `load` makes the localizer at configuration. Raises ConfigError."""
        super().__init__("localizer", automatically_declare_parameters_from_overrides=True)
        self._load = load
        self._parts: Parts | None = None
        self._subscriptions_of_parts: list[object] = []
        self._abandoned: list[Worker] = []
        """Of earlier configurations, whose scan at work did not end."""
        self._complaint = ""
        self._stale_after: int | None = None
        """Number of scans after which the state was reported as stale."""
        self.failure = ""
        """Why the node could not start by itself; empty as long as it can."""
        self._configuration = ConfigParameters(
            self,
            LocalizerNodeConfig,
            topics=tuple(map(self.resolve_topic_name, ("points", "imu", "odom", "initialpose"))),
            why_fixed=self._why_fixed,
            on_change=self._reconfigure,
        )

        # Not held up by a simulated clock that stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._diagnostics_timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics, clock=steady)
        self.create_service(Empty, "reinitialize_global_localization", self._reinitialize)
        if self._configuration.config.autostart:
            self._autostart_timer = self.create_timer(0.0, self._autostart, clock=steady)

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load weights and map and announce the outputs."""
        return self._attempt(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Warm up and begin to listen."""
        result = self._attempt(self._activate)
        return super().on_activate(state) if result == TransitionCallbackReturn.SUCCESS else result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening and let the scan at work end."""
        self._stop_listening()
        self._complaint = ""
        self._report_stale("inactive")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of weights and map."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good."""
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Fall back to unconfigured, from where a lifecycle manager can try again."""
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def close(self) -> bool:
        """Let go of everything, whatever the state, before `destroy_node`; return whether the worker has ended."""
        ended = self._stop_listening()
        self._release()
        return ended

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
        config = self._configuration.config
        started = time.monotonic()
        if config.odometry == "scan":
            require_kiss_icp()
        transforms = Transforms(self, config)
        try:
            localizer = self._load(config)
            self._parts = assemble(self, config, localizer, transforms, self._status_name, self._why_no_prior)
        except BaseException:
            transforms.close()
            raise
        origin = self._parts.outputs.origin
        self.get_logger().info(
            f"map '{config.map}': {len(localizer.aerial_map.submaps.grid):,} submaps, "
            f"origin {origin.latitude:.6f}, {origin.longitude:.6f}; "
            f"weights {localizer.encoder.fingerprint[:12]}; loaded in {time.monotonic() - started:.1f} s"
        )
        self._log_calibration(localizer)

    def _log_calibration(self, localizer: Localizer) -> None:
        """Say what the belief on this map is calibrated for: whether that is this robot's lidar, a node cannot know."""
        words = localizer.calibration_words
        if not words:
            self.get_logger().info("the map is not calibrated: 'calibrate_map' finds what scores mean on it")
        elif localizer.aerial_map.calibration is None:
            self.get_logger().warning(f"the map: {words}")
        else:
            self.get_logger().info(f"the map: {words}")

    def _activate(self) -> None:
        parts = self._parts
        if parts is None:
            raise ConfigError("the node is not configured")
        started = time.monotonic()
        self.get_logger().info("warming up; the first start on a machine compiles for a while")
        parts.statistics.reset()
        self._stale_after = None
        parts.initial_pose.reset()
        config = self._configuration.config

        def prepare() -> None:
            # In the worker's own thread, because numerical libraries keep state for each thread.
            parts.localizing.reconfigure(config)  # what has changed while no scan was processed
            parts.localizer.warm_up()
            parts.localizing.reset()

        parts.worker.start(prepare)
        for subscription in parts.subscribe(self):
            self._subscriptions_of_parts.append(subscription)
        topic = self.resolve_topic_name("points")
        self.get_logger().info(f"warm after {time.monotonic() - started:.1f} s; listening on {topic}")

    def _stop_listening(self) -> bool:
        """Take no more clouds and wait for the worker; return whether it has ended."""
        for subscription in self._subscriptions_of_parts:
            self.destroy_subscription(subscription)
        self._subscriptions_of_parts = []
        if self._parts is not None:
            self._parts.initial_pose.reset()
            if not self._parts.worker.stop():
                self.get_logger().error("the scan at work does not end")
                if self._parts.worker not in self._abandoned:
                    self._abandoned.append(self._parts.worker)
        self._abandoned = [worker for worker in self._abandoned if not worker.stop(0.0)]
        return not self._abandoned

    def _release(self) -> None:
        if self._parts is not None:
            self._parts.close()
        self._parts = None

    # Parameters and the service

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set the parameters, all or none; a refusal names the parameter and the reason."""
        try:
            changes = self._configuration.admit(parameter_list)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(changes) if changes else SetParametersResult(successful=True)

    def _why_fixed(self, name: str) -> str | None:
        if name == "autostart":
            return "is read once, at the start"
        if self._parts is None or name.startswith(SETTINGS_WHILE_RUNNING):
            return None
        return "is read when the node is configured: clean the node up first"

    def _why_no_prior(self) -> str:
        if self._configuration.config.alignment.scope == "none":
            return "alignment.scope is none, so that no pose is tracked"
        return ""

    def _reconfigure(self) -> None:
        """Give the localizer other settings from the next scan on; an inactive one takes them up when activated."""
        if self._parts is not None and self._subscriptions_of_parts:
            config, localizing = self._configuration.config, self._parts.localizing
            self._parts.worker.post(lambda: localizing.reconfigure(config))
            self.get_logger().info("other settings hold from the next scan on")

    def _reinitialize(self, request: Empty.Request, response: Empty.Response) -> Empty.Response:
        """Forget everything that earlier messages left behind."""
        if self._parts is not None:
            self._parts.statistics.dropped(self._parts.worker.drop_scans())
            self._parts.initial_pose.reset()
            self._parts.worker.post(self._parts.localizing.reset)
            self.get_logger().info("localizing anew")
        return response

    # Diagnostics

    @property
    def _status_name(self) -> str:
        return f"{self.get_fully_qualified_name().lstrip('/')}: localization"

    def _publish_diagnostics(self) -> None:
        values = snapshot_values(self._snapshot())
        values["map"] = self._configuration.config.map
        level, message = self._health(values)
        stamp_ns = self.get_clock().now().nanoseconds
        self._diagnostics.publish(diagnostic_message(self._status_name, stamp_ns, level, message, values))

    def _health(self, values: dict[str, str]) -> tuple[bytes, str]:
        """Return level and message of the diagnostics, and add to their values what the parts report."""
        parts, snapshot = self._parts, self._snapshot()
        if parts is not None:
            values["submaps"] = str(len(parts.localizer.aerial_map.submaps.grid))
            values["encoder"] = parts.localizer.encoder.fingerprint
            values["calibration"] = parts.localizer.calibration_words or "none"
            if parts.initial_pose.result:
                values["initial pose"] = parts.initial_pose.result
        if parts is None or not self._subscriptions_of_parts:
            if self._complaint:
                return DiagnosticStatus.ERROR, self._complaint
            if self._abandoned:
                return DiagnosticStatus.ERROR, "the scan that was at work does not end: restart the node"
            return DiagnosticStatus.OK, "not configured" if parts is None else "inactive"
        complaint = ""
        if parts.odometry is not None:
            state, topic = parts.odometry.state(), self.resolve_topic_name("odom")
            complaint = odometry_complaint(state, topic, self.count_publishers(topic))
            values["odometry"] = complaint or f"{state.messages} messages"
        if parts.config.use_imu:
            values["imu"] = parts.imu.state()
        points, worker = self.resolve_topic_name("points"), parts.worker.health()
        stall = worker_complaint(worker, parts.config.stall_s)
        if stall:
            self._report_stale(stall)
            return DiagnosticStatus.ERROR, stall
        level, message = health_status(
            snapshot, points, self.count_publishers(points), parts.lidar.complaint, complaint
        )
        if snapshot.silent_s > SILENCE_S:
            self._report_stale(message)
        return level, message

    def _snapshot(self) -> Snapshot:
        return (Statistics() if self._parts is None else self._parts.statistics).snapshot()

    def _report_stale(self, reason: str) -> None:
        """Report once, after the last scan, that the latched state is no longer current."""
        snapshot = self._snapshot()
        if self._parts is None or self._stale_after == snapshot.processed:
            return
        self._stale_after = snapshot.processed
        state = TrackState.SEARCHING if snapshot.last is None else snapshot.last.estimate.state
        self._parts.outputs.publish_stale(state, reason)
