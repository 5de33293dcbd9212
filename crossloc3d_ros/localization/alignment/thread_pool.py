"""The threads that work on one scan."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Part = TypeVar("Part")
Result = TypeVar("Result")


class ThreadPool:
    """Work in parallel on the parts of a task: one executor for all tasks, started by the first that has parts."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._executor: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()

    def map(self, work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
        """Return what `work` gives for each part, in their order; with one thread or part, in the caller's thread."""
        if self.threads == 1 or len(parts) < 2:
            return [work(part) for part in parts]
        with self._lock:
            # It ends with this object, if not closed before: idle threads end with their executor.
            executor = self._executor = self._executor or ThreadPoolExecutor(self.threads, "alignment")
        return list(executor.map(work, parts))

    def close(self) -> None:
        """End the threads; the next task would start them again."""
        with self._lock:
            executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown()


SERIAL = ThreadPool(1)
"""Works in the caller's thread alone."""
