"""A thread that works through items in their order, and never falls far behind.

A few may wait, so that one that takes long costs none of the others. Where more come than are worked off, all that wait
but the newest are given up: a machine slower than the sensor drops scans, and what it tells stays young.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Worker(Generic[T]):
    """Work on the items handed over, one at a time, in a thread of its own."""

    def __init__(self, work: Callable[[T], None], name: str, queue_depth: int = 1) -> None:
        """Prepare a worker that calls `work`, which must not raise; nothing runs before `start`."""
        self._work = work
        self._name = name
        self._most_waiting = queue_depth
        self._changed = threading.Condition()
        self._waiting: deque[T] = deque()
        self._thread: threading.Thread | None = None

    def start(self, prepare: Callable[[], None]) -> None:
        """Start the thread, let it call `prepare` first, and wait for that; what `prepare` raises is raised here."""
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

    def offer(self, item: T) -> int:
        """Hand over an item and return how many it pushed out that nobody had begun to work on."""
        with self._changed:
            pushed_out = 0
            if len(self._waiting) >= self._most_waiting:
                pushed_out = len(self._waiting)
                self._waiting.clear()
            self._waiting.append(item)
            self._changed.notify()
        return pushed_out

    def discard(self) -> int:
        """Forget the items that wait and return how many there were."""
        with self._changed:
            waiting = len(self._waiting)
            self._waiting.clear()
        return waiting

    def stop(self, timeout_s: float = 3.0) -> bool:
        """Let the item at work end, drop those that wait, and return whether the thread has ended."""
        with self._changed:
            thread, self._thread = self._thread, None
            self._waiting.clear()
            self._changed.notify()
        if thread is None:
            return True
        thread.join(timeout_s)
        return not thread.is_alive()

    def _loop(self) -> None:
        me = threading.current_thread()
        while True:
            with self._changed:
                while self._thread is me and not self._waiting:
                    self._changed.wait()
                # Told to stop, or given up on while it hung, and another thread has taken its place.
                if self._thread is not me:
                    return
                item = self._waiting.popleft()
            self._work(item)
