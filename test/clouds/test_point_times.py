"""The times of points: what drivers send is understood, and what cannot be a turn is refused."""

from __future__ import annotations

import re

import numpy as np
import pytest

from crossloc3d_ros.clouds.point_times import PointClock
from crossloc3d_ros.types import PointTimes, Scan

STAMP_NS = 1_700_000_000_123_456_789
AFTER_S = np.linspace(0.0, 0.0999, 2000)


def scan(field: str, values: np.ndarray, stamp_ns: int = STAMP_NS) -> Scan:
    return Scan(np.ones((len(values), 3), np.float32), stamp_ns, "lidar", PointTimes(field, values))


AFTER_NS = np.rint(AFTER_S * 1e9).astype(np.int64)
SENT = {
    "velodyne": (scan("time", (AFTER_S - 0.1).astype(np.float32)), AFTER_S - 0.1),
    "ouster": (scan("t", AFTER_NS.astype(np.uint32)), AFTER_S),
    "hesai": (scan("timestamp", STAMP_NS * 1e-9 + AFTER_S), AFTER_S),
    "livox": (scan("offset_time", AFTER_NS.astype(np.uint32)), AFTER_S),
    "livox, absolute": (scan("timestamp", STAMP_NS + AFTER_S * 1e9), AFTER_S),
    "ns since 1970": (scan("t", (STAMP_NS + AFTER_NS).astype(np.uint64)), AFTER_S),
    "us": (scan("time", (AFTER_S * 1e6).astype(np.float32)), AFTER_S),
    "us since 1970": (scan("timestamp", (STAMP_NS + AFTER_NS) // 1000), AFTER_S),
    "ms": (scan("time", AFTER_S * 1e3 - 100.0), AFTER_S - 0.1),
}


@pytest.mark.parametrize("driver", SENT)
def test_units_and_origins_are_recognised(driver: str) -> None:
    sent, truth = SENT[driver]
    times = PointClock(0.1, 0.0 if truth.max() > 0 else 1.0).read(sent)
    assert times.seconds is not None, times.reason
    # A float64 of seconds since 1970 has steps of 0.24 us, of nanoseconds 256 ns.
    np.testing.assert_allclose(times.seconds, truth, atol=1.5e-6)
    assert "stamped_at" not in times.words


def test_times_that_contradict_the_stamps_moment_are_believed_and_it_is_said() -> None:
    times = PointClock(0.1, stamped_at=1.0).read(SENT["ouster"][0])
    assert times.seconds is not None
    assert "moment 0.0 of the turn, and not 1" in times.words


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros(2000, np.float32), "the same time"),
        (np.full(2000, np.nan), "no number"),
        (AFTER_S * 1e-2, "no turn of 0.1 s"),
        (AFTER_S * 30.0, "no turn of 0.1 s"),
        (AFTER_S + 0.5, "0.5 to 0.5999 s from the stamp"),
        (1.6e9 + AFTER_S, "from the stamp"),
        ((1.7e9 + AFTER_S).astype(np.float32), "the same time|no turn"),
    ],
)
def test_what_is_no_turn_is_refused_with_the_reason(values: np.ndarray, words: str) -> None:
    times = PointClock(0.1, 1.0).read(scan("time", values))
    assert times.seconds is None
    assert re.search(words, times.reason)


def test_the_unit_is_chosen_once_and_every_cloud_is_held_to_it() -> None:
    clock = PointClock(0.1, 0.0)
    assert clock.read(SENT["ouster"][0]).seconds is not None
    # A sector of the turn, as a filter leaves it: too short to tell a unit from, but the unit is known.
    few = clock.read(scan("t", AFTER_NS[1000:1010].astype(np.uint32)))
    assert few.seconds is not None
    np.testing.assert_allclose(few.seconds, AFTER_S[1000:1010], atol=1e-6)
    assert PointClock(0.1, 0.0).read(scan("t", AFTER_NS[1000:1010].astype(np.uint32))).seconds is None
    # The same field in microseconds all of a sudden lies within the turn, but in seconds it does not.
    assert clock.read(scan("t", (AFTER_NS * 1000))).seconds is None, "another type: judged anew, and no turn"
    assert clock.read(scan("t", AFTER_NS.astype(np.uint32) * np.uint32(30))).seconds is None
    assert "the same time" in clock.read(scan("t", np.zeros(2000, np.uint32))).reason, "the driver has lost them"
    assert clock.read(SENT["ouster"][0]).seconds is not None


def test_without_times_or_without_a_turn_it_is_said() -> None:
    assert "no time per point" in PointClock(0.1, 1.0).read(Scan(np.ones((3, 3), np.float32), 0, "")).reason
    assert "period_s is 0" in PointClock(0.0, 1.0).read(SENT["ouster"][0]).reason
