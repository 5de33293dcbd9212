"""Scores of belief as tables for the terminal."""

from __future__ import annotations

from rich.table import Table

from crossloc3d_ros.evaluation.belief.results import MAP_COLUMNS, SET_COLUMNS, map_cells, set_cells
from crossloc3d_ros.evaluation.belief.scores import BeliefScores
from crossloc3d_ros.evaluation.poses.terminal import goal_table
from crossloc3d_ros.pages.terminal import plain_table

_NAME_WIDTH = 24
WIDTH = 150
"""Columns that the tables need where the output goes to a file."""


def belief_tables(scores: BeliefScores) -> list[Table]:
    """Return what the terminal shows of belief: the goals, each set on its map, each map with drives from elsewhere."""
    goals = goal_table("Belief", scores.measures)
    goals.caption = "✓ goal, – floor, … reached but too few are counted, ✗ neither; ∞: not within the drive"
    if scores.missing:
        goals.caption += f"; {scores.missing:,} of {len(scores.about.pieces):,} pieces are missing"
    on_map = plain_table("On the map", SET_COLUMNS)
    for each in scores.sets:
        on_map.add_row(*set_cells(each))
    off_map = plain_table("Off the map", MAP_COLUMNS)
    for pair in scores.maps:
        off_map.add_row(*map_cells(pair))
    for table in (on_map, off_map):
        table.columns[0].min_width = _NAME_WIDTH
        table.columns[0].overflow = "fold"
    return [goals, on_map, off_map]
