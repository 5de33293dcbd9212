"""How far a build is, counted over its tasks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class BuildProgress:
    """How far a build is."""

    stage: str
    """`reading`, `encoding` (or `cutting`, where submaps are only cut) or `writing`."""
    done: int
    total: int
    unit: str
    """`points`, `submaps` or `files`."""


ProgressCallback = Callable[[BuildProgress], None]


class Counter:
    """Adds up what the tasks report and passes it on."""

    def __init__(self, stage: str, done: int, total: int, unit: str, progress: ProgressCallback) -> None:
        self._stage, self._done, self._total, self._unit = stage, done, total, unit
        self._progress = progress
        self(0)

    def __call__(self, count: int) -> None:
        self._done = min(self._done + count, self._total)
        self._progress(BuildProgress(self._stage, self._done, self._total, self._unit))
