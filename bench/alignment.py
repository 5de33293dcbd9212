"""How fast scans are aligned: around candidates, around one hypothesis, and on the whole of a map."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.figure import Figure, median_ms
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.localization.alignment.aligner import (
    COARSE_FREE,
    COARSE_HEADINGS,
    COARSE_HITS,
    MAP_COARSE_FACTOR,
    Aligner,
)
from crossloc3d_ros.localization.alignment.evidence import Evidence, evidence_of
from crossloc3d_ros.localization.alignment.pose_search import search_cells
from crossloc3d_ros.types import Candidates, Hypotheses, no_candidates

LARGE_KM2 = 5.5


def bench_alignment(aerial_map: AerialMap, scans: list[PreparedScan], runs: int) -> list[Figure]:
    """Time the alignment on the real map, and the coarse search that a larger one needs."""
    aligner = Aligner(aerial_map, AlignmentConfig())
    began = time.perf_counter()
    aligner.likelihood.prepare()
    figures = [
        Figure("alignment: read the map", time.perf_counter() - began, "s", note=f"{aligner.area_m2 / 1e6:.2f} km2")
    ]
    rng = np.random.default_rng(0)
    grid = aerial_map.submaps.grid
    turn = iter(range(10**9))

    def of(count: int) -> Callable[[], Any]:
        def action() -> None:
            ids = rng.choice(len(grid), count, replace=False)
            found = Candidates(ids, np.ones(count, np.float32), np.full(count, 0.5 / count), grid[ids])
            aligner.align(scans[next(turn) % len(scans)], (0.0, 0.0), found)

        return action

    def tracked() -> None:
        at = grid[rng.integers(0, len(grid), 1)]
        one = Hypotheses(at, np.zeros(1), np.eye(3)[None], np.ones(1))
        aligner.align(scans[next(turn) % len(scans)], (0.0, 0.0), no_candidates(), one, search_candidates=False)

    def everywhere() -> None:
        aligner.align(scans[next(turn) % len(scans)], (0.0, 0.0), no_candidates(), search_map=True)

    for count, target in ((25, "150, goal 60"), (100, "")):
        name = f"alignment: {count} candidates, {aligner.pool.threads} threads"
        figures.append(Figure(name, median_ms(of(count), runs), "ms", target, note="random places"))
    figures.append(Figure("alignment: one hypothesis", median_ms(tracked, runs), "ms"))
    figures.append(Figure("alignment: the whole map", median_ms(everywhere, max(runs // 4, 3)), "ms"))
    figures.append(_large(aligner, evidence_of(scans[0].place, scans[0].sensor_height_m)))
    return figures


def _large(aligner: Aligner, evidence: Evidence) -> Figure:
    """Time the search of every pose on coarse cells, and scale it to a larger map: it grows with the area."""
    level = aligner.likelihood.levels[0]
    most = MAP_COARSE_FACTOR * aligner.config.coarse_maxima
    coarse = evidence.coarser(level.cell_m, COARSE_HITS, COARSE_FREE)
    margin = int(120.0 / level.cell_m)
    rows, columns = level.ratios.shape[1:]
    along = np.arange(margin, rows - margin)
    runs = np.column_stack([along, np.full(len(along), margin), np.full(len(along), columns - 2 * margin)])
    times = []
    for _ in range(4):
        began = time.perf_counter()
        search_cells(coarse, level, runs, COARSE_HEADINGS, most, 8.0, aligner.pool)
        times.append(time.perf_counter() - began)
    area = runs[:, 2].sum() * level.cell_m**2 / 1e6
    seconds = float(np.median(times[1:])) * LARGE_KM2 / area
    return Figure(
        f"alignment: every pose of {LARGE_KM2:g} km2, coarse, {aligner.pool.threads} threads", seconds, "s", "3",
        note=f"from {area:.2f} km2",
    )  # fmt: skip
