"""Where in the map, and in which heading, the evidence of a scan fits: exhaustive on coarse cells, then finer.

The score of a pose is the sum of the log likelihood ratios of all the evidence laid into the map at that pose. On a
coarse level it is taken for every cell of the area and every heading, row by row, so that one addition serves many
poses at once; what scores best is looked at again on the next level, and at last at will in fine cells.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit

from crossloc3d_ros.localization.evidence import CELL_M, LAYERS, Evidence
from crossloc3d_ros.localization.likelihood import QUANTA, Int16Array, Level, MapLikelihood, UInt16Array
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int64Array

_STEPS = ((1.0, math.radians(2.0)), (0.5, math.radians(1.0)), (0.25, math.radians(0.5)), (0.12, math.radians(0.25)))
_MOVES = 6  # at most so many moves on each step of the climb


@dataclass(frozen=True, eq=False)
class Peaks:
    """Poses at which the evidence fits, best first."""

    poses: Float64Array
    """(p, 3) metres east and north of the likelihood's south-west corner, heading in radians from east."""
    scores: Float64Array
    """(p,) nats."""


def search_cells(
    evidence: Evidence, level: Level, cells: BoolArray, headings: int, most: int, apart_m: float, threads: int = 1
) -> Peaks:
    """Return the best poses with the base in one of the marked cells (H, W) of a level, at least `apart_m` apart.

    `evidence` is in cells of the level, its passages in blocks of 2 x 2. Marked cells must be so far from the edge of
    the level that the evidence stays inside. A cell has one heading, its best of `headings` evenly over the circle.
    """
    runs = _runs(cells)
    if not len(runs) or not len(evidence):
        return Peaks(np.empty((0, 3)), np.empty(0))
    angles = 2.0 * math.pi * np.arange(headings) / headings
    xy, channel = np.ascontiguousarray(evidence.xy_m), evidence.channel

    def part(which: Int64Array) -> tuple[Int16Array, Int16Array]:
        best, heading = _correlate(level.ratios, xy, channel, level.cell_m, angles[which], runs, LAYERS)
        return best, which[heading].astype(np.int16)

    # In order, so that the first of several best headings is taken, by however many threads.
    parts = np.array_split(np.arange(headings), min(threads, headings))
    if len(parts) == 1:
        results = [part(parts[0])]
    else:
        with ThreadPoolExecutor(len(parts)) as pool:
            results = list(pool.map(part, parts))
    best, heading = results[0]
    for other, its_heading in results[1:]:
        better = other > best
        best, heading = np.where(better, other, best), np.where(better, its_heading, heading)
    rows = np.repeat(runs[:, 0], runs[:, 2])
    columns = np.concatenate([np.arange(start, start + count) for start, count in runs[:, 1:]])
    ways = np.column_stack([columns + 0.5, rows + 0.5]) * level.cell_m
    chosen = _apart(ways, best.astype(np.float64), most, apart_m)
    poses = np.column_stack([ways[chosen], angles[heading[chosen]]])
    return Peaks(poses, best[chosen] / QUANTA)


def climb(
    evidence: Evidence, likelihood: MapLikelihood, poses: Float64Array, *, reach_m: float, steps: int = len(_STEPS)
) -> tuple[Peaks, BoolArray]:
    """Climb from each pose (p, 3) to the best one around it in the fine cells, in smaller and smaller steps.

    Returns the poses in their order and whether each came to rest within `reach_m` of where it began. `steps`: how
    many of the step sizes are taken, from 1 m and 2 degrees on.
    """
    found, scores, rested = _climb(
        likelihood.classes, likelihood.model.log_ratios, np.ascontiguousarray(evidence.xy_m), evidence.channel,
        np.ascontiguousarray(poses, np.float64), reach_m, np.array(_STEPS[:steps]), _MOVES, CELL_M,
    )  # fmt: skip
    return Peaks(found, scores), rested


def scores_at(evidence: Evidence, likelihood: MapLikelihood, poses: Float64Array) -> Float64Array:
    """Return the scores (p,) of poses (p, 3) in the fine cells, nats."""
    scores: Float64Array = _scores(
        likelihood.classes, likelihood.model.log_ratios, np.ascontiguousarray(evidence.xy_m), evidence.channel,
        np.ascontiguousarray(poses, np.float64), CELL_M,
    )  # fmt: skip
    return scores


def local_search(
    evidence: Evidence, level: Level, poses: Float64Array, reach_m: float, turn_rad: float, turns: int
) -> Peaks:
    """Return the best pose within `reach_m` and `turn_rad` of each pose (p, 3), on the grid of a level, in their order.

    `turns` steps of the heading to either side.
    """
    found, scores = _local(
        level.ratios, np.ascontiguousarray(evidence.xy_m), evidence.channel, level.cell_m,
        np.ascontiguousarray(poses, np.float64), round(reach_m / level.cell_m), turn_rad / max(turns, 1), turns, LAYERS,
    )  # fmt: skip
    return Peaks(found, scores / QUANTA)


def merge(peaks: Peaks, apart_m: float, apart_rad: float) -> Int64Array:
    """Return which peaks to keep, best first: one of those nearer than both to a better one."""
    kept: list[int] = []
    for i in np.argsort(-peaks.scores, kind="stable"):
        if not any(are_near(peaks.poses[i], peaks.poses[j], apart_m, apart_rad) for j in kept):
            kept.append(int(i))
    return np.array(kept, np.int64)


def are_near(first: Float64Array, second: Float64Array, apart_m: float, apart_rad: float) -> bool:
    """Return whether two poses (3,) are nearer to each other than both bounds."""
    turned = abs(wrapped(float(first[2] - second[2])))
    return math.hypot(*(first[:2] - second[:2])) < apart_m and turned < apart_rad


def wrapped(angle: float) -> float:
    """Return an angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


def around(likelihood: MapLikelihood, level: Level, places: Float64Array, radius_m: float) -> BoolArray:
    """Mark the cells (H, W) of a level within `radius_m` of any place (k, 2), metres from the south-west corner."""
    marked = np.zeros(level.ratios.shape[1:], np.bool_)
    reach = math.ceil(radius_m / level.cell_m)
    for x, y in places[np.isfinite(places).all(axis=1)]:
        row, column = int(y / level.cell_m), int(x / level.cell_m)
        low_r, low_c = max(row - reach, 0), max(column - reach, 0)
        window = marked[low_r : row + reach + 1, low_c : column + reach + 1]
        rows, columns = np.ogrid[low_r : low_r + window.shape[0], low_c : low_c + window.shape[1]]
        away = ((rows + 0.5) * level.cell_m - y) ** 2 + ((columns + 0.5) * level.cell_m - x) ** 2
        window |= away <= radius_m**2
    return marked & inside(likelihood, level)


def inside(likelihood: MapLikelihood, level: Level) -> BoolArray:
    """Mark the cells (H, W) of a level whose middles lie on the map."""
    west, south, east, north = likelihood.aerial_map.bounds
    rows, columns = level.ratios.shape[1:]
    x = likelihood.west_m + (np.arange(columns) + 0.5) * level.cell_m
    y = likelihood.south_m + (np.arange(rows) + 0.5) * level.cell_m
    return ((y > south) & (y < north))[:, None] & ((x > west) & (x < east))[None, :]


def _runs(cells: BoolArray) -> Int64Array:
    """Return row, first column and length (R, 3) of the runs of marked cells."""
    edges = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    starts, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    return np.column_stack([starts, ends[:, 1] - starts[:, 1]]).astype(np.int64)


def _apart(ways: Float64Array, scores: Float64Array, most: int, apart_m: float) -> Int64Array:
    """Return the best of the ways (n, 2), greedily, each `apart_m` from those before."""
    candidates = min(len(scores), 400 * most)
    order = np.argpartition(-scores, candidates - 1)[:candidates]
    order = order[np.argsort(-scores[order], kind="stable")]
    chosen: Int64Array = _greedy(np.ascontiguousarray(ways[order]), most, apart_m)
    return order[chosen]


@njit(cache=True, nogil=True)
def _greedy(ways: Float64Array, most: int, apart_m: float) -> Int64Array:
    chosen = np.empty(most, np.int64)
    count = 0
    for i in range(len(ways)):
        free = True
        for j in range(count):
            dx, dy = ways[i, 0] - ways[chosen[j], 0], ways[i, 1] - ways[chosen[j], 1]
            if dx * dx + dy * dy < apart_m * apart_m:
                free = False
                break
        if free:
            chosen[count] = i
            count += 1
            if count == most:
                break
    return chosen[:count]


@njit(cache=True, nogil=True)
def _correlate(  # type: ignore[no-untyped-def]
    ratios: Int16Array, xy: Float64Array, channel: Int64Array, cell: float, angles: Float64Array, runs: Int64Array,
    layers: int,
):  # fmt: skip
    """Return the best score and its heading's number for every cell of the runs, one after the other."""
    _, rows, columns = ratios.shape
    flat = ratios.reshape(-1)
    total = 0
    widest = 0
    for k in range(len(runs)):
        total += runs[k, 2]
        widest = max(widest, runs[k, 2])
    best = np.full(total, -32768, np.int16)
    heading = np.zeros(total, np.int16)
    sums = np.zeros(widest, np.int16)
    offsets = np.empty(len(channel), np.int64)
    for h in range(len(angles)):
        c, s = math.cos(angles[h]), math.sin(angles[h])
        for e in range(len(channel)):
            u, v = (c * xy[e, 0] - s * xy[e, 1]) / cell, (s * xy[e, 0] + c * xy[e, 1]) / cell
            # From the middle of the base's cell; a block of passages is named by its lower left cell.
            middle = 0.5 if channel[e] < layers else 0.0
            column, row = math.floor(u + middle), math.floor(v + middle)
            offsets[e] = (channel[e] * rows + row) * columns + column
        at = 0
        for k in range(len(runs)):
            width = runs[k, 2]
            first = runs[k, 0] * columns + runs[k, 1]
            for j in range(width):
                sums[j] = 0
            for e in range(len(offsets)):
                start = first + offsets[e]
                line = flat[start : start + width]
                for j in range(width):
                    sums[j] += line[j]
            for j in range(width):
                if sums[j] > best[at + j]:
                    best[at + j] = sums[j]
                    heading[at + j] = h
            at += width
    return best, heading


@njit(cache=True, nogil=True)
def _local(  # type: ignore[no-untyped-def]
    ratios: Int16Array, xy: Float64Array, channel: Int64Array, cell: float, poses: Float64Array, reach: int,
    turn: float, turns: int, layers: int,
):  # fmt: skip
    _, rows, columns = ratios.shape
    found = poses.copy()
    scores = np.zeros(len(poses))
    side = 2 * reach + 1
    sums = np.empty((side, side), np.int32)
    for p in range(len(poses)):
        best = -(1 << 30)
        for t in range(-turns, turns + 1):
            angle = poses[p, 2] + t * turn
            c, s = math.cos(angle), math.sin(angle)
            sums[:] = 0
            for e in range(len(channel)):
                x, y = poses[p, 0] + c * xy[e, 0] - s * xy[e, 1], poses[p, 1] + s * xy[e, 0] + c * xy[e, 1]
                middle = 0.0 if channel[e] < layers else 0.5
                column, row = math.floor(x / cell - middle) - reach, math.floor(y / cell - middle) - reach
                if row < 0 or column < 0 or row + side > rows or column + side > columns:
                    continue
                for i in range(side):
                    for j in range(side):
                        sums[i, j] += ratios[channel[e], row + i, column + j]
            for i in range(side):
                for j in range(side):
                    if sums[i, j] > best:
                        best = sums[i, j]
                        found[p, 0], found[p, 1] = poses[p, 0] + (j - reach) * cell, poses[p, 1] + (i - reach) * cell
                        found[p, 2] = angle
        scores[p] = best
    return found, scores


@njit(cache=True, nogil=True)
def _score(
    classes: UInt16Array, log_ratios: Float32Array, xy: Float64Array, channel: Int64Array, x: float, y: float,
    angle: float, cell: float,
) -> float:  # fmt: skip
    rows, columns = classes.shape
    c, s = math.cos(angle) / cell, math.sin(angle) / cell
    u0, v0 = x / cell, y / cell
    total = 0.0
    for e in range(len(channel)):
        column = int(u0 + c * xy[e, 0] - s * xy[e, 1])
        row = int(v0 + s * xy[e, 0] + c * xy[e, 1])
        if 0 <= row < rows and 0 <= column < columns:
            total += log_ratios[channel[e], classes[row, column]]
    return total


@njit(cache=True, nogil=True)
def _scores(
    classes: UInt16Array, log_ratios: Float32Array, xy: Float64Array, channel: Int64Array, poses: Float64Array,
    cell: float,
) -> Float64Array:  # fmt: skip
    scores = np.empty(len(poses))
    for p in range(len(poses)):
        scores[p] = _score(classes, log_ratios, xy, channel, poses[p, 0], poses[p, 1], poses[p, 2], cell)
    return scores


@njit(cache=True, nogil=True)
def _climb(  # type: ignore[no-untyped-def]
    classes: UInt16Array, log_ratios: Float32Array, xy: Float64Array, channel: Int64Array, poses: Float64Array,
    reach: float, steps: Float64Array, moves: int, cell: float,
):  # fmt: skip
    found = poses.copy()
    scores = np.empty(len(poses))
    rested = np.ones(len(poses), np.bool_)
    for p in range(len(poses)):
        x, y, angle = poses[p, 0], poses[p, 1], poses[p, 2]
        best = _score(classes, log_ratios, xy, channel, x, y, angle, cell)
        for k in range(len(steps)):
            for _ in range(moves):
                bx, by, ba = x, y, angle
                for dx in range(-1, 2):
                    for dy in range(-1, 2):
                        for da in range(-1, 2):
                            nx, ny, na = x + dx * steps[k, 0], y + dy * steps[k, 0], angle + da * steps[k, 1]
                            score = _score(classes, log_ratios, xy, channel, nx, ny, na, cell)
                            if score > best:
                                best, bx, by, ba = score, nx, ny, na
                if bx == x and by == y and ba == angle:
                    break
                x, y, angle = bx, by, ba
        found[p, 0], found[p, 1], found[p, 2] = x, y, angle
        scores[p] = best
        rested[p] = math.hypot(x - poses[p, 0], y - poses[p, 1]) <= reach
    return found, scores, rested
