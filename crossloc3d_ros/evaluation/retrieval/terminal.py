"""Scores of retrieval as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from crossloc3d_ros.evaluation.retrieval.page import describe, describe_briefly
from crossloc3d_ros.evaluation.retrieval.scores import PUBLISHED_ONE_PER_CENT, Scores
from crossloc3d_ros.evaluation.statistics import RADII_M
from crossloc3d_ros.pages.terminal import plain_table
from crossloc3d_ros.pages.wording import percent


def tables(scores: Sequence[Scores], main_scores: Scores) -> list[Table]:
    """Return what the terminal shows: a table a radius, and the main scores divided by group and family."""
    shown = []
    for radius in RADII_M:
        figures = [figure for figure in main_scores.overall.recalls if figure.radius_m == radius]
        names = [f"{figure.label}*" if figure.rank == PUBLISHED_ONE_PER_CENT else figure.label for figure in figures]
        table = plain_table(f"Within {radius:g} m, %", ["", names[0], "95 %", "chance", *names[1:]])
        for each in scores:
            first, *others = (each.overall.recall(figure.label, radius) for figure in figures)
            table.add_row(
                describe_briefly(each.about),
                percent(first.share.value, 1, unit=""),
                f"{100 * first.share.low:.0f}–{100 * first.share.high:.0f}",
                percent(first.chance, 1, unit=""),
                *(percent(figure.share.value, 1, unit="") for figure in others),
            )
        shown.append(table)
    notes = ["* published as AR@1%: the released evaluators retrieve 25 places"]
    if any(each.about.query_headings > 1 for each in scores):
        notes.append("8 nearest: tried in 8 headings, the nearest kept; 8 mean: by the mean of their descriptors")
    again = max(each.about.verified for each in scores)
    if again:
        notes.append(f"+ {again} height maps: so many places ordered by retrieval + height maps; else by retrieval")
    shown[-1].caption = "\n".join(notes)
    divided = plain_table(
        f"{describe(main_scores.about)}, %", ["", "queries", *(f"R@1 {r:g} m" for r in RADII_M), "R@25 100 m"]
    )
    families = main_scores.families if len(main_scores.families) > 1 else ()
    for group in (*families, *main_scores.groups, main_scores.overall):
        values = [group.recall("R@1", radius) for radius in RADII_M] + [group.recall("R@25", 100.0)]
        divided.add_row(group.name, f"{group.queries:,}", *(percent(v.share.value, 1, unit="") for v in values))
    return [*shown, divided]
