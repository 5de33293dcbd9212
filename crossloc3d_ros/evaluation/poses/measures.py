"""The figures of the pose benchmark, and what is wanted of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from crossloc3d_ros.evaluation.poses.predictions import PoseAbout

Unit = Literal["%", "m", "degrees", "fixes", "scans", "ms"]
Verdict = Literal["goal", "floor", "few", "below", ""]


@dataclass(frozen=True)
class Measure:
    """One figure with its interval, and what was wanted of it."""

    key: str
    text: str
    unit: Unit
    value: float
    """A share lies between 0 and 1; infinite: not within the drive; NaN: nothing was counted."""
    low: float
    high: float
    count: int
    """Of what it is a figure: scans, fixes, drives."""
    counted: str
    """Their name."""
    floor: float | None = None
    """Worse than this is not enough; the second number of a range is `ceiling`."""
    goal: float | None = None
    floor_high: float | None = None
    goal_high: float | None = None
    higher_is_better: bool = True
    floor_count: int = 0
    """So many must have been counted for the floor, ..."""
    goal_count: int = 0
    """... so many for the goal."""

    @property
    def verdict(self) -> Verdict:
        """Say which of goal and floor the value reaches; `few` where more have to be counted for it.

        Empty where there is neither.
        """
        if self.goal is None or math.isnan(self.value):
            return ""
        few = False
        ends: tuple[tuple[Verdict, float | None, float | None, int], ...] = (
            ("goal", self.goal, self.goal_high, self.goal_count),
            ("floor", self.floor, self.floor_high, self.floor_count),
        )
        for name, low, high, least in ends:
            if low is None:
                continue
            if high is not None:
                reached = low <= self.value <= high
            else:
                reached = self.value >= low if self.higher_is_better else self.value <= low
            if reached and self.count >= least:
                return name
            few |= reached
        return "few" if few else "below"


@dataclass(frozen=True)
class Goals:
    """What is wanted of each measure: floor, goal, and the upper ends where they are ranges."""

    wanted: dict[str, tuple[float | None, float, float | None, float | None, bool]]

    def measure(
        self, key: str, text: str, unit: Unit, value: float, low: float, high: float, count: int, counted: str
    ) -> Measure:
        """Return a measure with its goals, where it has any."""
        if key not in self.wanted:
            return Measure(key, text, unit, value, low, high, count, counted)
        floor, goal, floor_high, goal_high, higher = self.wanted[key]
        return Measure(key, text, unit, value, low, high, count, counted, floor, goal, floor_high, goal_high, higher)


def goals_of(about: PoseAbout) -> Goals:
    """Return the goals of a pose set."""
    real = about.pose_set == "amsterdam"
    at_least: dict[str, tuple[float, float]] = {"end_to_end": (0.60, 0.90) if real else (0.80, 0.97)}
    if not real:
        at_least["among"] = (0.95, 0.995)
    at_most: dict[str, tuple[float | None, float]] = {
        "until_median": (60.0, 15.0),
        "until_95": (None, 60.0),
        "after_median": (1.0, 0.3),
        "after_95": (3.0, 1.0),
        "heading_median": (1.0, 0.3),
        "heading_95": (4.0, 1.0),
        "wrong": (0.005, 0.0005),
        "carried_median": (100.0, 20.0),
        "away_fixes": (0.0, 0.0),
    }
    return Goals(
        {key: (floor, goal, None, None, True) for key, (floor, goal) in at_least.items()}
        | {key: (floor, goal, None, None, False) for key, (floor, goal) in at_most.items()}
        | {"inside_2_sigma": (0.90, 0.94, 0.99, 0.97, True)}
    )


def verdicts(measures: Sequence[Measure]) -> dict[str, int]:
    """Count how many measures reach their goal, their floor alone, and neither."""
    counts = {"goal": 0, "floor": 0, "few": 0, "below": 0}
    for measure in measures:
        if measure.verdict:
            counts[measure.verdict] += 1
    return counts
