"""Seconds from lap to lap."""

from __future__ import annotations

import time


class Stopwatch:
    """Measures the time since the lap before."""

    def __init__(self) -> None:
        self._since = time.perf_counter()

    def lap(self) -> float:
        """Return the seconds since the last lap, or since the start, and begin a new one."""
        before, self._since = self._since, time.perf_counter()
        return self._since - before
