"""One robot's inputs through one session: what each of them changes, and when settings take effect."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.config import FusionConfig, LocalizerConfig, MountingConfig, ScanConfig
from crossloc3d_ros.errors import CloudError, PoseError
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.localization.session import Session
from crossloc3d_ros.types import Candidates, Estimate, FixStatus, Float64Array, PointTimes, Scan, TrackState

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000


class Listener:
    """Stands in for the localizer, and remembers what it was given."""

    def __init__(self, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self.stamp_ns: int | None = None
        self.motions: list[Motion | None] = []
        self.ups: list[Float64Array | None] = []
        self.mountings: list[Float64Array | None] = []
        self.priors: list[PosePrior] = []
        self.state = TrackState.AMBIGUOUS
        self.finds_candidates = True
        self.during: Callable[[], None] = lambda: None
        self.ranges: list[float] = []
        self.scans: list[Scan] = []

    def localize(
        self,
        scan: Scan,
        gravity_base: Float64Array | None = None,
        T_base_lidar: Float64Array | None = None,
        motion: Motion | Callable[[], Motion | None] | None = None,
    ) -> Estimate:
        if not len(scan.points):
            raise CloudError("the cloud is empty")
        self.motions.append(motion() if callable(motion) else motion)
        self.ups.append(gravity_base)
        self.mountings.append(T_base_lidar)
        self.scans.append(scan)
        self.during()
        self.ranges.append(self.config.scan.max_range_m)
        self.stamp_ns = scan.stamp_ns
        estimate = dataclasses.replace(no_estimate(scan.stamp_ns, "stand-in"), state=self.state)
        if not self.finds_candidates:
            return dataclasses.replace(estimate, state=TrackState.SEARCHING)
        one = Candidates(np.zeros(1, np.int64), np.zeros(1, np.float32), np.ones(1), np.zeros((1, 3)))
        return dataclasses.replace(estimate, candidates=one)

    def set_prior(self, prior: PosePrior) -> None:
        self.priors.append(prior)

    def reset(self) -> None:
        self.stamp_ns = None

    def reconfigure(self, config: LocalizerConfig) -> None:
        self.config = config


def room(x_m: float = 0.0, near: bool = False) -> np.ndarray:
    """Points (N, 3) of a room with a column, seen from `x_m` along it; `near` adds the robot's own rack."""
    rng = np.random.default_rng(7)
    y, z = rng.uniform(-10, 10, 4000), rng.uniform(-1, 5, 4000)
    walls = [np.column_stack([np.full(4000, side), y, z]) for side in (-15.0, 18.0)]
    walls += [np.column_stack([rng.uniform(-15, 18, 4000), np.full(4000, side), z]) for side in (-10.0, 10.0)]
    column = np.column_stack([rng.uniform(4, 5, 1500), rng.uniform(3, 4, 1500), rng.uniform(-1, 5, 1500)])
    points = np.vstack([*walls, column]) - np.array([x_m, 0.0, 0.0])
    if near:
        rack = rng.uniform(-0.4, 0.4, (9000, 3))
        points = np.vstack([points, rack])
    return points.astype(np.float32)


def scan_at(number: int, points: np.ndarray | None = None) -> Scan:
    seen = room() if points is None else points
    # A lidar that repeats a scan is frozen.
    return Scan(seen + np.float32(2e-3 * number), START_NS + number * STEP_NS, "velodyne")


def pose(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def localize(session: Session, scan: Scan, **how: Any) -> Any:
    return session.localize(session.receive(scan), **how)


def test_motion_is_that_since_the_last_scan_that_counted() -> None:
    listener = Listener()
    session = Session(listener, "topic")
    for i in range(5):
        session.add_odometry(START_NS + i * STEP_NS, pose(0.5 * i))
    localize(session, scan_at(0))
    localize(session, scan_at(2))
    assert listener.motions[0] is None
    assert listener.motions[1] is not None
    np.testing.assert_allclose(listener.motions[1].delta, [1.0, 0.0, 0.0], atol=1e-9)


def test_a_scan_waits_for_odometry_that_is_missing_and_for_none_that_is_there() -> None:
    session, waited = Session(Listener(), "topic"), []

    def wait(stamp_ns: int) -> None:
        waited.append(stamp_ns)
        for i in range(3):
            session.add_odometry(START_NS + i * STEP_NS, pose(float(i) / 10))

    localize(session, scan_at(0), wait_for_odometry=wait)
    assert waited == [], "of the first scan no motion is needed"
    localize(session, scan_at(1), wait_for_odometry=wait)
    localize(session, scan_at(2), wait_for_odometry=wait)
    assert waited == [START_NS + STEP_NS], "also where nothing had come at all"
    assert session.localizer.motions[-1].is_known  # type: ignore[attr-defined]


def test_odometry_that_is_refused_is_the_reason() -> None:
    session = Session(Listener(), "topic")
    session.add_odometry(START_NS, np.full((4, 4), np.nan))
    localize(session, scan_at(0))
    localize(session, scan_at(1))
    assert "is not a pose" in session.localizer.motions[-1].reason  # type: ignore[attr-defined]


def test_settings_of_odometry_hold_while_it_runs() -> None:
    """Both halves: what the localizer takes, and what the buffer of the odometry takes."""
    session = Session(Listener(), "topic")
    for i in range(3):
        session.add_odometry(START_NS + i * STEP_NS, pose(0.5 * i))
    localize(session, scan_at(0))
    slow = LocalizerConfig(fusion=FusionConfig(max_speed_mps=1.0))
    session.reconfigure(slow)
    assert session.localizer.config is slow
    localize(session, scan_at(1))
    assert "jumps by" in session.localizer.motions[-1].reason  # type: ignore[attr-defined]


def test_a_scan_ends_with_the_settings_that_it_began_with() -> None:
    """Whoever owns the session reconfigures it between two scans, never within one."""
    listener = Listener()
    session = Session(listener)
    posted: list[LocalizerConfig] = []
    listener.during = lambda: posted.append(LocalizerConfig(scan=ScanConfig(max_range_m=42.0)))
    localize(session, scan_at(0))
    session.reconfigure(posted.pop())
    localize(session, scan_at(1))
    assert listener.ranges == [100.0, 42.0]


def test_scans_measure_the_motion_without_the_robots_own_rack() -> None:
    """Points nearer than `scan.min_range_m` move with the robot: they would hold its motion back."""
    pytest.importorskip("kiss_icp")
    motions = []
    for near in (False, True):
        listener = Listener()
        session = Session(listener, "scan")
        for i in range(6):
            localize(session, scan_at(i, room(0.2 * i, near=near)))
        known = [motion for motion in listener.motions if motion is not None]
        assert all(motion.is_known for motion in known)
        motions.append(sum(motion.delta[0] for motion in known))
    assert motions[0] == pytest.approx(1.0, abs=0.1)
    assert motions[1] == pytest.approx(motions[0], abs=0.02)


def test_another_range_or_mounting_begins_the_odometry_from_scan_to_scan_anew() -> None:
    pytest.importorskip("kiss_icp")
    for changed in (
        ScanConfig(mounting=MountingConfig(x_m=0.5, yaw_deg=5.0)),
        ScanConfig(max_range_m=30.0),
    ):
        listener = Listener()
        session = Session(listener, "scan")
        for i in range(4):
            localize(session, scan_at(i))
        session.reconfigure(LocalizerConfig(scan=changed))
        localize(session, scan_at(4))
        last = listener.motions[-1]
        assert last is not None
        assert not last.is_known, "the robot stands: a motion between two base frames would be false"
        localize(session, scan_at(5))
        assert np.abs(listener.motions[-1].delta).max() < 0.02  # type: ignore[union-attr]


def test_priors_are_handed_over_once_and_a_foreign_clock_is_not_trusted() -> None:
    listener = Listener()
    session = Session(listener)
    near, foreign = (
        PosePrior(np.zeros(3), 0.0, np.eye(3), stamp_ns) for stamp_ns in (START_NS, START_NS - 3_600_000_000_000)
    )
    session.add_prior(near)
    session.add_prior(foreign)
    localize(session, scan_at(1))
    localize(session, scan_at(2))
    assert [prior.stamp_ns for prior in listener.priors] == [START_NS, 0]


def test_a_compass_counts_while_it_is_fresh_and_nothing_better_is_known() -> None:
    listener = Listener()
    session = Session(listener)
    heading = PosePrior(None, 1.0, np.eye(3), START_NS)
    session.add_heading(heading)
    localize(session, scan_at(1))
    localize(session, scan_at(9))
    assert listener.priors == [heading]
    listener.state = TrackState.LOCALIZED
    localize(session, scan_at(10))
    session.add_heading(dataclasses.replace(heading, stamp_ns=START_NS + 11 * STEP_NS))
    localize(session, scan_at(11))
    assert len(listener.priors) == 1


def test_a_scan_that_cannot_be_used_keeps_the_state_and_says_why() -> None:
    listener = Listener()
    session = Session(listener)
    listener.state = TrackState.LOCALIZED
    localize(session, scan_at(0))
    outcome = localize(session, scan_at(1, np.empty((0, 3), np.float32)))
    assert outcome.is_fault
    assert (outcome.estimate.state, outcome.estimate.reason) == (TrackState.LOCALIZED, "the cloud is empty")
    listener.finds_candidates = False
    assert localize(session, scan_at(2)).estimate.state is TrackState.LOCALIZED


def test_gravity_is_that_of_the_scans_time_or_the_one_that_is_given() -> None:
    listener = Listener()
    session = Session(listener)
    assert session.add_acceleration(START_NS, np.array([0.0, 0.0, 9.81]))
    localize(session, scan_at(0))
    tilted = np.array([0.6, 0.0, 0.8])
    session.localize(session.receive(scan_at(1), up_base=tilted))
    localize(session, scan_at(60))
    assert listener.ups[0] is not None
    np.testing.assert_allclose(listener.ups[0], [0.0, 0.0, 1.0])
    assert listener.ups[1] is tilted
    assert listener.ups[2] is None, "six seconds later nothing measures it"
    session.reset()
    localize(session, scan_at(0))
    assert listener.ups[3] is None


def ground(upside_down: bool) -> np.ndarray:
    """Points (N, 3) of a level square, seen from 1.2 m above it."""
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-24, 24, (20_000, 2)), rng.normal(-1.2, 0.01, 20_000)])
    return (points * (1, -1, -1 if upside_down else 1)).astype(np.float32)


def test_what_is_wrong_with_the_lidar_is_a_fault_that_never_reaches_the_localizer() -> None:
    listener = Listener()
    session = Session(listener, "topic")
    for i in range(30):
        session.add_odometry(START_NS + i * STEP_NS, pose(0.2 * i))
    good = localize(session, scan_at(0, ground(False) * np.float32(0.99)))
    assert not good.is_fault
    outcomes = [localize(session, scan_at(i, ground(True))) for i in (1, 2)]
    frozen = [localize(session, Scan(ground(False), START_NS + i * STEP_NS, "velodyne")) for i in (3, 4, 5)]
    for outcome, words in ((outcomes[0], "upside down"), (outcomes[1], "upside down"), (frozen[1], "frozen")):
        assert outcome.is_fault
        assert words in outcome.estimate.reason
        assert outcome.estimate.status is FixStatus.NO_FIX
        assert outcome.estimate.state is good.estimate.state, "what was known before still holds"
    assert listener.stamp_ns == START_NS + 3 * STEP_NS, "the first of the repeated scans is a scan"
    localize(session, scan_at(6, ground(False)))
    assert listener.stamp_ns == START_NS + 6 * STEP_NS


def known(number: int, how: str) -> Scan:
    """A scan that counts, or one that does not."""
    if how == "unreadable":
        return dataclasses.replace(scan_at(number), points=np.empty((0, 3), np.float32))
    return scan_at(number)


@pytest.mark.parametrize("how", ["unreadable", "says nothing", "of the same stamp", "refused before"])
def test_a_robot_is_lost_when_no_scan_has_counted_for_a_second_and_found_by_the_next_that_does(how: str) -> None:
    listener = Listener()
    listener.state = TrackState.LOCALIZED
    session = Session(listener)
    assert localize(session, scan_at(0)).estimate.state is TrackState.LOCALIZED
    listener.finds_candidates = how != "says nothing"
    states = []
    for i in range(1, 14):
        if how == "refused before":
            outcome = session.fault(scan_at(i).stamp_ns, "no pose of the lidar")
        elif how == "of the same stamp":
            outcome = localize(session, dataclasses.replace(scan_at(i), stamp_ns=START_NS))
        else:
            outcome = localize(session, known(i, how))
        states.append(outcome.estimate.state)
    assert states[:9] == [TrackState.LOCALIZED] * 9, "for a while what was known before still holds"
    assert states[10:] == [TrackState.LOST] * 3
    listener.finds_candidates = True
    assert localize(session, scan_at(20)).estimate.state is TrackState.LOCALIZED
    assert session.fault(scan_at(21).stamp_ns, "").estimate.state is TrackState.LOCALIZED


def test_a_prior_that_is_refused_is_refused_once(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = Listener()
    session = Session(listener)

    def refuse(prior: PosePrior) -> None:
        raise PoseError("not this one")

    monkeypatch.setattr(listener, "set_prior", refuse)
    session.add_prior(PosePrior(np.zeros(3), 0.0, np.eye(3), 0))
    assert localize(session, scan_at(0)).is_fault
    assert not localize(session, scan_at(1)).is_fault


@pytest.mark.parametrize("sample", [[0.0, 0.0, 0.0, 9.81], [9.81], [[0.0, 0.0, 9.81]]])
def test_an_acceleration_of_another_shape_is_none_and_spoils_nothing(sample: Any) -> None:
    listener = Listener()
    session = Session(listener)
    assert not session.add_acceleration(START_NS, np.array(sample))
    assert session.add_acceleration(START_NS, np.array([0.0, 0.0, 9.81]))
    assert not localize(session, scan_at(0)).is_fault


@pytest.mark.parametrize("stamp_ns", [float("nan"), None, 1.0])
def test_a_stamp_that_is_none_is_refused_and_spoils_nothing(stamp_ns: Any) -> None:
    session = Session(Listener(), "topic")
    with pytest.raises(PoseError, match="the stamp of a scan must be an integer"):
        session.receive(dataclasses.replace(scan_at(0), stamp_ns=stamp_ns))
    with pytest.raises(PoseError, match="the stamp of an odometry pose"):
        session.add_odometry(stamp_ns, pose(0.0))
    for i in range(3):
        assert session.add_odometry(START_NS + i * STEP_NS, pose(0.1 * i))
    assert not localize(session, scan_at(1)).is_fault


def test_a_scan_with_times_waits_for_the_motion_of_its_turn_and_comes_at_the_moment_of_its_stamp() -> None:
    listener = Listener()
    session = Session(listener, "topic")
    for i in range(-2, 1):
        session.add_odometry(START_NS + i * STEP_NS, pose(0.2 * i))
    times = PointTimes("time", np.linspace(-0.1, 0.0, len(room()), dtype=np.float32))

    def wait(stamp_ns: int) -> None:
        session.add_odometry(stamp_ns, pose(0.2))

    outcome = localize(session, dataclasses.replace(scan_at(1), times=times), wait_for_odometry=wait)
    assert outcome.within_turn == "compensated: field 'time' in s from the stamp"
    assert listener.scans[0].is_at_stamp
    moved = listener.scans[0].points - scan_at(1).points
    # The robot drives ahead: what it saw first is nearer by then.
    np.testing.assert_allclose(moved[:, 0], 2.0 * times.values, atol=1e-4)
    without = localize(session, scan_at(2))
    assert without.within_turn == "not compensated: the cloud carries no time per point"
    assert not listener.scans[1].is_at_stamp
