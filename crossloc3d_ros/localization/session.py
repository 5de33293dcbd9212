"""One robot's run: scans, odometry, accelerations and priors in, one outcome a scan out.

The node, the replay and the pose benchmark feed the localizer through this one object, so that the same inputs give the
same estimates in all three. It has no threads and no locks: whoever owns it feeds it in the order of the inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from crossloc3d_ros.clouds.filters import mounting_matrix, transform_points
from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.localization.estimates import no_estimate
from crossloc3d_ros.localization.fusion.gravity import GravityFilter
from crossloc3d_ros.localization.fusion.odometry import Motion, OdometryBuffer, ScanOdometry
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.inputs import check_stamp
from crossloc3d_ros.localization.motion_compensation import MotionCompensation, SteadyMotion
from crossloc3d_ros.localization.scan_checks import ScanChecks
from crossloc3d_ros.types import Estimate, Float64Array, Scan, TrackState

OdometryKind = Literal["topic", "scan", "none"]
"""What measures the motion between scans: samples of odometry, the scans themselves by KISS-ICP, or nothing."""
SAME_CLOCK_NS = 10_000_000_000
"""A prior stamped farther from the next scan was stamped by another clock: it is taken to hold at that scan."""
LOST_AFTER_NS, LOST_AFTER_SCANS = 1_000_000_000, 10
"""A robot that was localized is lost when no scan has counted for longer, or so many in a row have not."""
MAX_HEADING_AGE_NS = 500_000_000
"""An older heading of a compass says nothing about a robot that may have turned since."""


@dataclass(frozen=True)
class Outcome:
    """The result of one scan."""

    estimate: Estimate
    is_fault: bool = False
    """The scan could not be used: it could not be read, or localizing it failed. The estimate has no fix."""
    within_turn: str = ""
    """What was done with the motion within a turn, and why not more; empty where the scan did not get that far."""


@dataclass(frozen=True, eq=False)
class PreparedInput:
    """A scan with what had been measured beside it when it arrived."""

    scan: Scan
    T_base_lidar: Float64Array
    """(4, 4) mounting of the lidar."""
    up_base: Float64Array | None
    """(3,) unit vector that points up, base frame; None where it is not known."""
    heading: PosePrior | None
    """The newest heading of a compass; None where there is none."""
    fault: str = ""
    """Why the scan cannot be used already: what is wrong with the lidar by it; or empty."""


class ScanLocalizer(Protocol):
    """What a session feeds; `localization.localizer.Localizer` is the one that ships."""

    config: LocalizerConfig

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last scan that counted, where the next motion begins; None before the first."""

    def localize(
        self,
        scan: Scan,
        gravity_base: Float64Array | None = None,
        T_base_lidar: Float64Array | None = None,
        motion: Motion | Callable[[], Motion | None] | None = None,
    ) -> Estimate:
        """Return where a scan was taken."""

    def set_prior(self, prior: PosePrior) -> None:
        """Take in what is known of the pose from outside."""

    def reset(self) -> None:
        """Forget every hypothesis."""

    def reconfigure(self, config: LocalizerConfig) -> None:
        """Use other settings from the next scan on."""


class Session:
    """Feed one localizer with one robot's inputs."""

    def __init__(
        self, localizer: ScanLocalizer, odometry: OdometryKind = "none", imu_time_constant_s: float = 1.0
    ) -> None:
        """Start with nothing received; ConfigError where KISS-ICP is needed and not installed."""
        self.localizer = localizer
        self.state = TrackState.SEARCHING
        """That of the last scan that counted."""
        self._counted_ns: int | None = None
        self._uncounted = 0
        config = localizer.config
        self._gravity = GravityFilter(imu_time_constant_s)
        self._heading: PosePrior | None = None
        self._priors: list[PosePrior] = []
        self._odometry = OdometryBuffer(config.fusion) if odometry == "topic" else None
        self._scan_odometry = ScanOdometry(config.fusion, config.scan.max_range_m) if odometry == "scan" else None
        self._compensation = MotionCompensation(config)
        self._checks = ScanChecks(config.scan)

    def reset(self) -> None:
        """Forget the hypotheses, the priors and what the IMU measured: the robot may be anywhere, in any attitude."""
        self.localizer.reset()
        self.state = TrackState.SEARCHING
        self._counted_ns, self._uncounted = None, 0
        self._gravity.reset()
        self._heading = None
        self._priors.clear()
        if self._scan_odometry is not None:
            self._scan_odometry.reset()

    def reconfigure(self, config: LocalizerConfig) -> None:
        """Use other settings from the next scan on; hypotheses, priors and the odometry received so far are kept."""
        mounting = self.localizer.config.scan.mounting
        self.localizer.reconfigure(config)
        self._compensation.reconfigure(config)
        if self._odometry is not None:
            self._odometry.reconfigure(config.fusion)
        if self._scan_odometry is not None:
            self._scan_odometry.reconfigure(config.fusion, config.scan.max_range_m)
            if config.scan.mounting != mounting:
                self._scan_odometry.reset()  # its map lies in the base frame as it was

    def add_odometry(self, stamp_ns: int, T_odom_base: Float64Array) -> bool:
        """Take in a pose (4, 4) of the base in the odometry's frame, and return whether it can be used."""
        return self._odometry is not None and self._odometry.add(stamp_ns, T_odom_base)

    def add_acceleration(self, stamp_ns: int, acceleration_base: Float64Array) -> bool:
        """Take in a specific force (3,), m/s2, base frame, +z up at rest; return whether it can be gravity."""
        return self._gravity.update(stamp_ns, acceleration_base)

    def add_heading(self, heading: PosePrior) -> None:
        """Take in a compass's heading; it counts for scans of its time while the robot is not localized."""
        self._heading = heading

    def add_prior(self, prior: PosePrior) -> None:
        """Take in a pose that is given from outside; it counts from the next scan on."""
        self._priors.append(prior)

    @property
    def registers_scans(self) -> bool:
        """Whether every scan has to be received, because the scans themselves are the odometry."""
        return self._scan_odometry is not None

    def odometry_pose(self, stamp_ns: int) -> Float64Array | None:
        """Return `T_odom_base` (4, 4) at a stamp; None where odometry from a topic does not give it."""
        return None if self._odometry is None else self._odometry.pose_at(stamp_ns)

    def has_odometry_until(self, stamp_ns: int) -> bool:
        """Return whether no sample of odometry is missing for a scan of this stamp."""
        newest_ns = None if self._odometry is None else self._odometry.newest_ns
        return self._odometry is None or (newest_ns is not None and newest_ns >= stamp_ns)

    def receive(
        self, scan: Scan, T_base_lidar: Float64Array | None = None, up_base: Float64Array | None = None
    ) -> PreparedInput:
        """Take in a scan, register it with the odometry from scan to scan, and note what else is known at its time.

        Each scan is received once, in the order of arrival, whether it will be localized or not. `T_base_lidar` (4, 4)
        replaces the mounting of the configuration, `up_base` (3,) the accelerations.
        """
        check_stamp(scan.stamp_ns, "the stamp of a scan")
        config = self.localizer.config.scan
        mounting = mounting_matrix(config.mounting) if T_base_lidar is None else T_base_lidar
        up = self._gravity.up(scan.stamp_ns) if up_base is None else up_base
        by_topic = None if self._odometry is None else self._odometry.motion
        fault = self._checks.fault(scan, mounting, config, by_topic)
        if fault:
            return PreparedInput(scan, mounting, up, self._heading, fault)
        if self._odometry is None:  # from a topic, the motion of this turn may arrive later
            steady = None if self._scan_odometry is None else SteadyMotion(self._scan_odometry)
            scan = self._compensation(scan, mounting, steady)
        if self._scan_odometry is not None:
            ranges = np.linalg.norm(scan.points, axis=1)
            used = (ranges >= config.min_range_m) & (ranges <= config.max_range_m)  # and so finite
            self._scan_odometry.add(scan.stamp_ns, transform_points(mounting, scan.points[used]).astype(np.float64))
        return PreparedInput(scan, mounting, up, self._heading)

    def localize(self, received: PreparedInput, wait_for_odometry: Callable[[int], None] | None = None) -> Outcome:
        """Return where a scan was taken; one that cannot be used is an outcome too, with the reason.

        `wait_for_odometry(stamp_ns)` is called when the motion is needed and the odometry of that stamp is missing.
        """
        scan, localizer = received.scan, self.localizer
        before_ns = localizer.stamp_ns
        if received.fault:
            return self.fault(scan.stamp_ns, received.fault)

        def motion() -> Motion | None:
            source = self._scan_odometry if self._odometry is None else self._odometry
            if source is None or localizer.stamp_ns is None:
                return None
            self._await_odometry(scan.stamp_ns, wait_for_odometry)
            return source.motion(localizer.stamp_ns, scan.stamp_ns)

        try:
            if self._odometry is not None:
                if self._compensation.needs_motion(scan):
                    self._await_odometry(scan.stamp_ns, wait_for_odometry)
                scan = self._compensation(scan, received.T_base_lidar, self._odometry)
            self._hand_over_priors(received)
            estimate = localizer.localize(scan, received.up_base, received.T_base_lidar, motion)
        except CrossLocError as error:
            return self.fault(scan.stamp_ns, str(error))
        is_compared = len(estimate.candidates) > 0 or not math.isnan(estimate.probability)
        is_skipped = localizer.stamp_ns is not None and localizer.stamp_ns == before_ns  # late, or a repeated stamp
        if is_compared and not is_skipped:
            self.state = estimate.state
            self._counted_ns, self._uncounted = scan.stamp_ns, 0
        else:
            estimate = replace(estimate, state=self._state_without(scan.stamp_ns))
        return Outcome(estimate, within_turn=self._compensation.words)

    def fault(self, stamp_ns: int, reason: str) -> Outcome:
        """Return the outcome of a scan that says nothing: no fix, and the state as it is known without it."""
        return Outcome(replace(no_estimate(stamp_ns, reason), state=self._state_without(stamp_ns)), is_fault=True)

    def _state_without(self, stamp_ns: int) -> TrackState:
        """Return the state after a scan that does not count: for a while what was known before still holds."""
        self._uncounted += 1
        since_ns = 0 if self._counted_ns is None else abs(stamp_ns - self._counted_ns)
        is_long = since_ns > LOST_AFTER_NS or self._uncounted >= LOST_AFTER_SCANS
        return TrackState.LOST if is_long and self.state is TrackState.LOCALIZED else self.state

    def _await_odometry(self, stamp_ns: int, wait: Callable[[int], None] | None) -> None:
        if wait is not None and not self.has_odometry_until(stamp_ns):
            wait(stamp_ns)

    def _hand_over_priors(self, received: PreparedInput) -> None:
        stamp_ns = received.scan.stamp_ns
        priors, self._priors = self._priors, []
        for prior in priors:
            same_clock = abs(prior.stamp_ns - stamp_ns) < SAME_CLOCK_NS
            self.localizer.set_prior(prior if same_clock else replace(prior, stamp_ns=0))
        heading = received.heading
        if heading is None or self.state is TrackState.LOCALIZED:
            return
        if abs(stamp_ns - heading.stamp_ns) <= MAX_HEADING_AGE_NS:
            self.localizer.set_prior(heading)
