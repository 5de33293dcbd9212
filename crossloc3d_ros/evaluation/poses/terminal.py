"""Scores of poses as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.table import Table

from crossloc3d_ros.evaluation.poses.measures import Measure
from crossloc3d_ros.evaluation.poses.results import interval_of, shown, wanted
from crossloc3d_ros.evaluation.poses.scores import PoseScores
from crossloc3d_ros.pages.terminal import plain_table
from crossloc3d_ros.pages.wording import percent


def pose_tables(scores: PoseScores) -> list[Table]:
    """Return what the terminal shows of poses: the table of goals, and what each stage brings."""
    table = goal_table(f"Poses, {scores.about.pose_set}", scores.measures)
    table.caption = "✓ goal, – floor, ✗ neither; ∞: not within the drive"
    all_tables = [table]
    for title, stages in (("Single scans", scores.stages), ("Scans along drives", scores.drive_stages)):
        part = plain_table(title, ["", "scans", "2 m and 5°, %", "10 m", "50 m", "median, m"])
        for stage in stages:
            middle = f"{stage.median_m:.1f}" if math.isfinite(stage.median_m) else "–"
            shares = (stage.within, stage.within_10_m, stage.within_50_m)
            part.add_row(
                stage.name, f"{stage.scans:,}", *(percent(share, 1, unit="") for share in shares), middle
            )  # fmt: skip
        if stages:
            all_tables.append(part)
    return all_tables


def goal_table(title: str, measures: Sequence[Measure]) -> Table:
    """Return measures beside their floors and goals."""
    marks = {"goal": "✓ ", "floor": "– ", "few": "… ", "below": "✗ ", "": ""}
    table = plain_table(title, ["", "measured", "95 %", "floor", "goal", "of"])
    table.columns[0].min_width = 22
    table.columns[0].overflow = "fold"
    for each in measures:
        floor = wanted(each, each.floor, each.floor_high)
        goal = wanted(each, each.goal, each.goal_high)
        measured = marks[each.verdict] + shown(each)
        table.add_row(each.text, measured, interval_of(each), floor, goal, f"{each.count:,}")
    return table
