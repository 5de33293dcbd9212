"""One line of the benchmark's table, and how it is timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Figure:
    """One measured number."""

    name: str
    value: float
    unit: str
    target: str = ""
    share_of_peak: float | None = None
    note: str = ""


def median_ms(action: Callable[[], Any], runs: int) -> float:
    """Return the median of `runs` timings of a warm action, in milliseconds."""
    for _ in range(3):
        action()
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        action()
        times.append(time.perf_counter() - began)
    return 1e3 * float(np.median(times))
