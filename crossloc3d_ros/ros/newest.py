"""A thread that works on the newest item only: a machine slower than the sensor drops scans and never falls behind."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class NewestWorker(Generic[T]):
    """Work on the newest item handed over, one at a time, in a thread of its own."""

    def __init__(self, work: Callable[[T], None], name: str) -> None:
        """Prepare a worker that calls `work`, which must not raise; nothing runs before `start`."""
        self._work = work
        self._name = name
        self._changed = threading.Condition()
        self._waiting: T | None = None
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

    def offer(self, item: T) -> bool:
        """Hand over an item and return whether it pushed out one that nobody had begun to work on."""
        with self._changed:
            pushed_out = self._waiting is not None
            self._waiting = item
            self._changed.notify()
        return pushed_out

    def discard(self) -> bool:
        """Forget the item that waits and return whether there was one."""
        with self._changed:
            waiting, self._waiting = self._waiting, None
        return waiting is not None

    def stop(self, timeout_s: float = 3.0) -> bool:
        """Let the item at work end, drop the one that waits, and return whether the thread has ended."""
        with self._changed:
            thread, self._thread = self._thread, None
            self._waiting = None
            self._changed.notify()
        if thread is None:
            return True
        thread.join(timeout_s)
        return not thread.is_alive()

    def _loop(self) -> None:
        me = threading.current_thread()
        while True:
            with self._changed:
                while self._thread is me and self._waiting is None:
                    self._changed.wait()
                # Told to stop, or given up on while it hung, and another thread has taken its place.
                if self._thread is not me:
                    return
                item, self._waiting = self._waiting, None
            if item is not None:
                self._work(item)
