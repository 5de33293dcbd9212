"""The work of the node's second thread: what arrives becomes an estimate, is published, counted and logged."""

from __future__ import annotations

import logging
import time

from rclpy.impl.rcutils_logger import RcutilsLogger

from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.localization.session import Outcome, Session
from crossloc3d_ros.ros.diagnostics import Statistics
from crossloc3d_ros.ros.lidar_input import Arrival
from crossloc3d_ros.ros.odometry_input import OdometryInput, OdometrySample
from crossloc3d_ros.ros.outputs import Outputs
from crossloc3d_ros.ros.poses import stamp_of
from crossloc3d_ros.ros.subscriptions import REPEAT_REASON_S
from crossloc3d_ros.types import FixStatus


class Localizing:
    """Own a session: every method but `close` runs in the worker's thread, and nothing else changes it."""

    def __init__(
        self,
        session: Session,
        odometry: OdometryInput | None,
        outputs: Outputs,
        statistics: Statistics,
        log: RcutilsLogger,
    ) -> None:
        """Bring the parts together."""
        self._session = session
        self._odometry = odometry
        self._outputs = outputs
        self._statistics = statistics
        self._log = log
        self._odom_frame_id = ""
        self._last_status: FixStatus | None = None
        self._within_turn = ""
        self._is_closed = False

    def close(self) -> None:
        """Let a scan that still is at work go without a trace; called from the executor's thread."""
        self._is_closed = True

    def reset(self) -> None:
        """Localize anew: forget all but the odometry."""
        self._session.reset()
        self._outputs.forget_odometry()
        self._last_status = None

    def reconfigure(self, config: LocalizerConfig) -> None:
        """Use other settings from the next scan on."""
        self._session.reconfigure(config)

    def process(self, arrival: Arrival) -> None:
        """Localize one cloud, publish, count and log the outcome."""
        outcome = self._localize(arrival)
        if self._is_closed:
            return
        estimate = outcome.estimate
        T_odom_base = self._session.odometry_pose(estimate.stamp_ns)
        try:
            self._outputs.publish(estimate, T_odom_base, self._odom_frame_id)
        except Exception:
            # Publishing fails when the node is being torn down; the scan still counts.
            logging.getLogger(__name__).exception("the estimate could not be published")
        self._statistics.processed(outcome, 1e3 * (time.monotonic() - arrival.received_s))
        self._log_outcome(outcome)

    def _localize(self, arrival: Arrival) -> Outcome:
        """Return the outcome of a cloud; every failure becomes an estimate without a fix, with its reason."""
        session, stamp_ns = self._session, stamp_of(arrival.message)
        try:
            for sample in [] if self._odometry is None else self._odometry.drain():
                self._add_odometry(sample)
            if arrival.fault:
                return session.fault(stamp_ns, arrival.fault)
            received = session.receive(scan_from_pointcloud2(arrival.message), arrival.T_base_lidar)
            return session.localize(received, self._wait_for_odometry)
        except CrossLocError as error:
            return session.fault(stamp_ns, str(error))
        except Exception as error:
            logging.getLogger(__name__).exception("localizing failed")
            return session.fault(stamp_ns, f"{type(error).__name__}: {error}")

    def _add_odometry(self, sample: OdometrySample) -> None:
        self._odom_frame_id = sample.odom_frame_id
        self._session.add_odometry(sample.stamp_ns, sample.T_odom_base)

    def _wait_for_odometry(self, stamp_ns: int) -> None:
        if self._odometry is None:
            return

        def add(sample: OdometrySample) -> bool:
            self._add_odometry(sample)
            return self._session.has_odometry_until(stamp_ns)

        self._odometry.wait(add)

    def _log_outcome(self, outcome: Outcome) -> None:
        """Log every change between fix and no fix, and now and then why there is none.

        Also whether the motion within a turn is compensated, when that changes.
        """
        estimate = outcome.estimate
        compensated = outcome.within_turn.partition(":")[0]
        if compensated and compensated != self._within_turn:
            self._within_turn = compensated
            self._log.info(f"motion within a turn is {outcome.within_turn}")
        changed = estimate.status is not self._last_status
        self._last_status = estimate.status
        if estimate.status is FixStatus.FIX:
            if changed:
                position = f"{estimate.latitude_deg:.6f}, {estimate.longitude_deg:.6f}"
                self._log.info(f"fix at {position}: {estimate.reason}")
        elif outcome.is_fault:
            self._log.error(estimate.reason, throttle_duration_sec=REPEAT_REASON_S)
        else:
            self._log.warning(f"no fix: {estimate.reason}", throttle_duration_sec=REPEAT_REASON_S)
