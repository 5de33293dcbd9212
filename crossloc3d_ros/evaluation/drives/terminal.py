"""The results of a drive as tables for the terminal."""

from __future__ import annotations

import numpy as np
from rich import box
from rich.table import Table

from crossloc3d_ros.evaluation.drives.estimates import EstimateTable
from crossloc3d_ros.evaluation.drives.evaluation import Evaluation, latency_summary
from crossloc3d_ros.evaluation.drives.place_scores import RANKS
from crossloc3d_ros.evaluation.drives.track_scores import LOST, TrackScores
from crossloc3d_ros.evaluation.statistics import INDEPENDENT_M, RADII_M
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.pages.wording import UNKNOWN, degrees, metres, percent

_SHOWN_EVERY_S = 5.0


def result_tables(evaluation: Evaluation) -> list[Table]:
    """Return the scores of a drive for people."""
    table, scores = evaluation.table, evaluation.scores
    figures = Table(title="Results", title_justify="left", show_header=False, box=box.SIMPLE)
    figures.add_column(style="bold", no_wrap=True)
    figures.add_column()
    fixes = int(table.has_fix.sum())
    figures.add_row("scans", f"{len(table):,}, of which {fixes:,} led to a fix ({fixes / max(len(table), 1):.0%})")
    latency = latency_summary(table)
    if latency:
        figures.add_row("time a scan", f"median {latency['median']:.1f} ms, 95 % {latency['p95']:.1f} ms")
    if scores is None:
        figures.add_row("errors", "not known: the recording has no usable GNSS at the time of the scans")
        return [figures]
    error, first = scores.fix_error, scores.best_candidate_error
    if evaluation.track is not None:
        _add_track(figures, evaluation.track)
    elif error.count:
        figures.add_row("error of a fix", f"median {error.median_m:.0f} m, 95 % {error.p95_m:.0f} m")
        figures.add_row("truth in the 95 % ellipse", f"{error.within_ellipse:.0%} of the fixes")
    if first.count:
        figures.add_row("error of first candidate", f"median {first.median_m:.0f} m, 95 % {first.p95_m:.0f} m")
    figures.add_row("evidence", f"{scores.places} places at least {INDEPENDENT_M:g} m apart")
    recall = Table(title="Right place among the candidates", title_justify="left", box=box.SIMPLE)
    recall.add_column("", style="bold", no_wrap=True)
    for radius in RADII_M:
        recall.add_column(f"within {radius:g} m", justify="right", no_wrap=True)
    for rank in RANKS:
        cells = [scores.recall(rank, radius) for radius in RADII_M]
        recall.add_row(f"AR@{rank}", *(f"{cell.share.value:.0%} (chance {cell.chance:.0%})" for cell in cells))
    return [figures, recall]


def _add_track(figures: Table, track: TrackScores) -> None:
    """Add the rows of a pose that was tracked."""
    for search in track.searches:
        if search.cause != LOST:
            found = f"after {metres(search.travelled_m)} and {search.seconds:.1f} s"
            figures.add_row(f"localized, {search.cause}", found if search.end is not None else "never")
    lost = [search.travelled_m for search in track.searches if search.cause == LOST]
    if lost:
        longest = f", {metres(max(lost))} at most" if len(lost) > 1 else ""
        figures.add_row("afterwards without a fix", f"{len(lost)} times, {metres(sum(lost))} in all{longest}")
    errors = track.errors
    if errors.count:
        figures.add_row("error of a fix", f"median {metres(errors.median_m)}, 95 % {metres(errors.p95_m)}")
        if errors.headings:
            figures.add_row(
                "error of its heading", f"median {degrees(errors.median_deg)}, 95 % {degrees(errors.p95_deg)}"
            )
        figures.add_row("wrong by more than 10 m", f"{errors.wrong:,} of {errors.count:,} fixes")
        for row in track.coverage[1:2]:
            inside = f"{percent(row.position)} of the positions, {percent(row.heading)} of the headings"
            figures.add_row("errors inside 2 sigma", f"{inside} (should be {percent(row.expected)})")


def beside_the_truth(table: EstimateTable, frame: MapFrame) -> Table:
    """Return fixes and truth side by side, a scan every few seconds."""
    result = Table(title="Fixes beside the truth", title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    tracked = table.has_track
    last = ("turned", "belief", "state") if tracked else ("1st cand.", "belief", "latency")
    for name in ("time", "truth", "fix", "off by", *last):
        result.add_column(name, justify="right", no_wrap=True)
    if not len(table):
        return result
    seconds = (table.stamp_ns - table.stamp_ns[0]) / 1e9
    known = np.asarray(np.isfinite(table.truth_grid).all(axis=1), dtype=np.bool_)
    latitude, longitude = np.full(len(table), np.nan), np.full(len(table), np.nan)
    if known.any():
        places = np.column_stack([table.truth_grid[known], np.zeros(int(known.sum()))])
        latitude[known], longitude[known], _ = frame.to_geographic(places)
    errors, turned_deg = table.error_m, np.degrees(np.abs(table.heading_error_rad))
    first_errors, beliefs = np.full(len(table), np.nan), np.full(len(table), np.nan)
    if table.candidate_ids.shape[1]:
        first_errors = np.hypot(*(table.candidate_grid[:, 0] - table.truth_grid).T)
        beliefs = table.candidate_probabilities[:, 0]
    for moment in np.arange(0.0, seconds[-1] + 1e-9, _SHOWN_EVERY_S):
        i = int(np.searchsorted(seconds, moment - 1e-9))
        fixed, state, latency = table.has_fix[i], table.states[i], table.latency_ms[i]
        if tracked:
            cells = [
                degrees(turned_deg[i]) if fixed else UNKNOWN,
                percent(table.probability[i]),
                UNKNOWN if state is None else state.value,
            ]
        else:
            cells = [
                f"{first_errors[i]:.0f} m" if np.isfinite(first_errors[i]) else UNKNOWN,
                f"{beliefs[i]:.0%}" if np.isfinite(beliefs[i]) else UNKNOWN,
                f"{latency:.0f} ms" if np.isfinite(latency) else UNKNOWN,
            ]
        result.add_row(
            f"{seconds[i]:.1f} s",
            f"{latitude[i]:.5f}, {longitude[i]:.5f}" if known[i] else UNKNOWN,
            f"{table.geographic[i, 0]:.5f}, {table.geographic[i, 1]:.5f}" if fixed else "no fix",
            metres(errors[i]) if fixed else UNKNOWN,
            *cells,
        )
    return result
