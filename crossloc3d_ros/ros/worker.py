"""A thread that owns the localizer: everything that changes it passes through here, in the order of arrival.

Scans may wait, so that one that takes long costs none of the others. Where more come than are worked off, all that wait
but the newest are dropped: a machine slower than the sensor drops scans, and its output stays recent.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from crossloc3d_ros.errors import ConfigError

log = logging.getLogger(__name__)

MAX_WAITING = 20_000
"""Tasks kept for a worker that hangs: a hundred seconds of an IMU at 200 Hz. Beyond, the oldest samples are dropped."""

Task = Callable[[], object]


class _Kind(Enum):
    SCAN = "scan"
    """Dropped where too many wait."""
    SAMPLE = "sample"
    """Of a sensor beside the scans: the oldest are dropped where a worker hangs."""
    COMMAND = "command"
    """Never dropped."""


class _Waiting(NamedTuple):
    task: Task
    kind: _Kind


@dataclass(frozen=True)
class WorkerHealth:
    """What the worker's thread is doing at one moment."""

    is_alive: bool
    """Whether the thread runs; True before the start."""
    busy_s: float
    """How long the task at work has taken so far; 0 where there is none."""
    failure: str
    """Why the thread has ended by itself; empty where it has not."""


class Worker:
    """Run tasks one at a time in a thread of its own: scans, of which some may be dropped, and commands."""

    def __init__(self, name: str, queue_depth: int = 1) -> None:
        """Prepare a worker on which at most `queue_depth` scans wait; nothing runs before `start`."""
        self._name = name
        self._queue_depth = queue_depth
        self._changed = threading.Condition()
        self._waiting: deque[_Waiting] = deque()
        self._thread: threading.Thread | None = None
        self._abandoned: threading.Thread | None = None
        self._busy_since: float | None = None
        self._failure = ""

    def start(self, prepare: Task) -> None:
        """Start the thread, let it run `prepare` first, and wait for that; what `prepare` raises is raised here.

        ConfigError while a thread that `stop` gave up on still runs: two would work on the same localizer.
        """
        if self._abandoned is not None and self._abandoned.is_alive():
            raise ConfigError("the scan at work when the node was deactivated does not end: clean the node up first")
        prepared = threading.Event()
        failures: list[BaseException] = []

        def body() -> None:
            try:
                prepare()
            except BaseException as failure:
                failures.append(failure)
                return
            finally:
                prepared.set()
            self._loop()

        # A daemon, so that a computation that hangs cannot keep the process alive; `stop` joins it all the same.
        self._thread = thread = threading.Thread(target=body, name=self._name, daemon=True)
        thread.start()
        prepared.wait()
        if failures:
            self.stop()
            raise failures[0]

    def offer(self, scan: Task) -> int:
        """Hand over the work on a scan; return how many waiting scans were dropped for it."""
        with self._changed:
            waiting = sum(item.kind is _Kind.SCAN for item in self._waiting)
            dropped = waiting if waiting >= self._queue_depth else 0
            if dropped:
                self._drop_scans()
            self._put(_Waiting(scan, _Kind.SCAN))
        return dropped

    def post(self, command: Task, *, is_sample: bool = False) -> None:
        """Hand over a command: it runs after the scans that came before it, and is not dropped with them.

        `is_sample`: the sample of a sensor, of which the oldest are dropped where `MAX_WAITING` tasks wait.
        """
        with self._changed:
            if is_sample and len(self._waiting) >= MAX_WAITING:
                self._drop_oldest_sample()
            self._put(_Waiting(command, _Kind.SAMPLE if is_sample else _Kind.COMMAND))

    def drop_scans(self) -> int:
        """Drop the scans that wait and return how many there were."""
        with self._changed:
            return self._drop_scans()

    def health(self) -> WorkerHealth:
        """Return what the thread is doing."""
        with self._changed:
            thread, since = self._thread, self._busy_since
            busy_s = 0.0 if since is None else time.monotonic() - since
            return WorkerHealth(thread is None or thread.is_alive(), busy_s, self._failure)

    def stop(self, timeout_s: float = 3.0) -> bool:
        """Let the task at work end, drop those that wait, and return whether the thread has ended."""
        with self._changed:
            thread, self._thread = self._thread, None
            self._waiting.clear()
            self._changed.notify()
        if thread is None:
            return self._abandoned is None or not self._abandoned.is_alive()
        thread.join(timeout_s)
        self._abandoned = thread
        return not thread.is_alive()

    def _put(self, item: _Waiting) -> None:
        self._waiting.append(item)
        self._changed.notify()

    def _drop_oldest_sample(self) -> None:
        oldest = next((i for i, item in enumerate(self._waiting) if item.kind is _Kind.SAMPLE), None)
        if oldest is not None:
            del self._waiting[oldest]

    def _drop_scans(self) -> int:
        others = [item for item in self._waiting if item.kind is not _Kind.SCAN]
        dropped = len(self._waiting) - len(others)
        self._waiting = deque(others)
        return dropped

    def _loop(self) -> None:
        me = threading.current_thread()
        while True:
            with self._changed:
                while self._thread is me and not self._waiting:
                    self._changed.wait()
                if self._thread is not me:
                    return
                task = self._waiting.popleft().task
                self._busy_since = time.monotonic()
            try:
                task()
            except Exception:
                # One scan, or one command, is lost; the thread must outlive it.
                log.exception("a task of the thread '%s' failed", self._name)
            except BaseException as failure:
                with self._changed:
                    self._failure = f"{type(failure).__name__}: {failure}"
                raise
            finally:
                with self._changed:
                    self._busy_since = None
