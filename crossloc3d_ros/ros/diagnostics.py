"""What the localizer reports on /diagnostics: counts, latencies, the last reason, and what it works with."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from crossloc3d_ros.localization.session import Outcome
from crossloc3d_ros.ros.conversions import stamp_message, state_values
from crossloc3d_ros.ros.worker import WorkerHealth
from crossloc3d_ros.types import FixStatus

WINDOW = 300
"""Latencies are those of so many last scans: half a minute at 10 Hz."""
SILENCE_S = 3.0
LOST_SHARE, LOST_TOLERATED = 0.05, 10
"""More lost than this is no hiccup: clouds do not fit into the publisher's shared memory, or the network is slow."""


@dataclass(frozen=True)
class Snapshot:
    """The counters at one moment."""

    received: int
    processed: int
    dropped: int
    lost: int
    fixes: int
    faults: int
    latency_median_ms: float
    latency_max_ms: float
    silent_s: float
    """Since the last message, or since the start."""
    last: Outcome | None


class Statistics:
    """Count what happens to the clouds; the subscription and the worker write, the timer reads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Start counting anew."""
        with self._lock:
            self._received = self._processed = self._dropped = self._lost = self._fixes = self._faults = 0
            self._latencies_ms: deque[float] = deque(maxlen=WINDOW)
            self._last: Outcome | None = None
            self._heard_at = time.monotonic()

    def received(self) -> None:
        """Count a message that arrived."""
        with self._lock:
            self._received += 1
            self._heard_at = time.monotonic()

    def dropped(self, count: int = 1) -> None:
        """Count messages that a newer one pushed out."""
        with self._lock:
            self._dropped += count

    def lost(self, total: int) -> None:
        """Record how many messages the middleware reports as lost."""
        with self._lock:
            self._lost = total

    def processed(self, outcome: Outcome, latency_ms: float) -> None:
        """Count a message that was worked through, `latency_ms` after it arrived."""
        with self._lock:
            self._processed += 1
            self._fixes += outcome.estimate.status is FixStatus.FIX
            self._faults += outcome.is_fault
            self._latencies_ms.append(latency_ms)
            self._last = outcome

    def snapshot(self) -> Snapshot:
        """Return the counters as they stand."""
        with self._lock:
            latencies = np.array(self._latencies_ms) if self._latencies_ms else np.array([np.nan])
            return Snapshot(
                received=self._received,
                processed=self._processed,
                dropped=self._dropped,
                lost=self._lost,
                fixes=self._fixes,
                faults=self._faults,
                latency_median_ms=float(np.median(latencies)),
                latency_max_ms=float(latencies.max()),
                silent_s=time.monotonic() - self._heard_at,
                last=self._last,
            )


def worker_complaint(health: WorkerHealth, stall_s: float) -> str:
    """Return what is wrong with the thread that localizes, or an empty text: it has ended, or one task does not end."""
    if not health.is_alive:
        return f"the thread that localizes has ended ({health.failure or 'no reason known'}): restart the node"
    if health.busy_s > stall_s:
        return f"the scan at work has taken {health.busy_s:.0f} s and does not end: restart the node"
    return ""


def health_status(
    snapshot: Snapshot, topic: str, publishers: int, complaint: str, odometry: str = ""
) -> tuple[bytes, str]:
    """Return level and message of an active localizer.

    `complaint` is what the middleware found wrong, `odometry` what is wrong with that; or empty.
    """
    if snapshot.silent_s > SILENCE_S:
        if complaint:
            return DiagnosticStatus.ERROR, complaint
        if publishers == 0:
            return DiagnosticStatus.WARN, f"no publisher on {topic}"
        return DiagnosticStatus.WARN, f"no cloud on {topic} for {snapshot.silent_s:.0f} s ({publishers} publishers)"
    if snapshot.last is None:
        return DiagnosticStatus.OK, "waiting for the first result"
    if snapshot.last.is_fault:
        return DiagnosticStatus.ERROR, snapshot.last.estimate.reason
    if snapshot.last.estimate.status is FixStatus.NO_FIX:
        reasons = (snapshot.last.estimate.reason, odometry)
        return DiagnosticStatus.WARN, "; ".join(reason for reason in reasons if reason)
    if snapshot.lost > LOST_TOLERATED and snapshot.lost > LOST_SHARE * (snapshot.lost + snapshot.received):
        return DiagnosticStatus.WARN, (
            f"{snapshot.lost} of {snapshot.lost + snapshot.received} clouds on {topic} were lost in transport: give "
            "the publishing process a Fast DDS profile with more shared memory, or make both sides reliable"
        )
    if odometry:
        return DiagnosticStatus.WARN, odometry
    return DiagnosticStatus.OK, snapshot.last.estimate.reason


def snapshot_values(snapshot: Snapshot) -> dict[str, str]:
    """Return the counters, and the timings and counts of the last scan, as texts."""
    values = {
        "clouds received": str(snapshot.received),
        "clouds processed": str(snapshot.processed),
        "clouds dropped": str(snapshot.dropped),
        "clouds lost in transport": str(snapshot.lost),
        "clouds at fault": str(snapshot.faults),
        "fixes": str(snapshot.fixes),
        "latency median (ms)": f"{snapshot.latency_median_ms:.1f}",
        "latency max (ms)": f"{snapshot.latency_max_ms:.1f}",
    }
    if snapshot.last is not None:
        estimate = snapshot.last.estimate
        timings, counts = estimate.timings, estimate.counts
        values["last reason"] = estimate.reason
        if snapshot.last.within_turn:
            values["motion within a turn"] = snapshot.last.within_turn
        values.update(state_values(estimate))
        values["last steps (ms)"] = (
            f"prepare {timings.prepare_ms:.1f}, encode {timings.encode_ms:.1f}, search {timings.search_ms:.1f}, "
            f"align {timings.align_ms:.1f}, fuse {timings.fuse_ms:.1f}"
        )
        values["last points"] = (
            f"received {counts.received}, finite {counts.finite}, in range {counts.in_range}, "
            f"off body {counts.off_body}, above ground {counts.above_ground}, in patch {counts.in_patch}"
        )
        if len(estimate.candidates):
            values["last best descriptor distance"] = f"{estimate.candidates.descriptor_distances[0]:.4g}"
    return values


def diagnostic_message(
    name: str, stamp_ns: int, level: bytes, message: str, values: Mapping[str, str]
) -> DiagnosticArray:
    """Return the message for /diagnostics."""
    status = DiagnosticStatus(
        level=level,
        name=name,
        message=message,
        hardware_id="",
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
    array = DiagnosticArray(status=[status])
    array.header.stamp = stamp_message(stamp_ns)
    return array
