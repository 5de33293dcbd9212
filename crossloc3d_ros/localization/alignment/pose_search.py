"""Where in the map, and in which heading, the evidence of a scan fits: exhaustive on coarse cells, then finer.

The score of a pose is the sum of the log likelihood ratios of all the evidence, placed on the map at that pose. On a
coarse level it is computed for every cell of the area and every heading, row by row, so that one addition serves many
poses at once; the best are refined on the next level, and at last by hill climbing in fine cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from scipy import ndimage

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.localization.alignment.evidence import CELL_M, LAYERS, Evidence
from crossloc3d_ros.localization.alignment.likelihood import QUANTA, Int16Array, Level, MapLikelihood, UInt16Array
from crossloc3d_ros.localization.alignment.surroundings import TURNED
from crossloc3d_ros.localization.alignment.thread_pool import SERIAL, ThreadPool
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int64Array

# Of the climb, metres and radians: from half a cell of the finest level down to the error of the map.
_STEPS = ((1.0, math.radians(2.0)), (0.5, math.radians(1.0)), (0.25, math.radians(0.5)), (0.12, math.radians(0.25)))
_MOVES = 6  # at most so many moves of each size: together they reach farther than a cell of that level
_AROUND_M = 52.0  # side of the surroundings of a cell: wider than a street, smaller than a quarter of one kind
_CONSIDERED = 400  # times as many cells as peaks are compared in full: neighbours of a peak score nearly as high


@dataclass(frozen=True, eq=False)
class Peaks:
    """Poses at which the evidence fits."""

    poses: Float64Array
    """(p, 3) metres east and north of the likelihood's south-west corner, heading in radians from east."""
    scores: Float64Array
    """(p,) nats."""
    prominence: Float64Array
    """(p,) how many standard deviations the score lies above the mean of the surroundings; 0 where not computed."""

    def join(self, other: Peaks) -> Peaks:
        """Return these peaks and then the others."""
        return Peaks(*map(np.concatenate, zip(vars(self).values(), vars(other).values(), strict=True)))

    def by_both(self) -> Int64Array:
        """Return the rows in turns by score and by prominence, best first."""
        ranks = [np.argsort(np.argsort(-values, kind="stable")) for values in (self.scores, self.prominence)]
        return np.argsort(np.minimum(2 * ranks[0], 2 * ranks[1] + 1), kind="stable")


def no_peaks() -> Peaks:
    """Return no peak."""
    return Peaks(np.empty((0, 3)), np.empty(0), np.empty(0))


def search_cells(
    evidence: Evidence,
    level: Level,
    runs: Int64Array,
    headings: int,
    most: int,
    apart_m: float,
    pool: ThreadPool = SERIAL,
) -> Peaks:
    """Return the best poses with the base in one of the cells of a level that `runs` names.

    They are at least `apart_m` apart. `runs` (R, 3): row, first column and length of stretches of cells, as `around`
    and `inside` give them; so far from the edge of the level that the evidence stays inside. `evidence` is in cells of
    the level, its free space in blocks of 2 x 2. A cell has one heading, its best of `headings` evenly over the circle.

    Half of them have the highest scores, half the highest prominence. Where a place would explain the scan from
    anywhere, as woods do, a high score is no evidence; where a survey is sparse or old, the right pose may score low,
    but still far above what is around it.
    """
    if not len(runs) or not len(evidence):
        return no_peaks()
    angles = 2.0 * math.pi * np.arange(headings) / headings
    xy, channel = np.ascontiguousarray(evidence.xy_m), evidence.channel

    def part(which: Int64Array) -> tuple[Int16Array, Int16Array, Float64Array, Float64Array]:
        found: tuple[Int16Array, Int16Array, Float64Array, Float64Array] = _correlate(
            level.ratios, xy, channel, level.cell_m, angles[which], runs, LAYERS
        )
        best, heading, total, squares = found
        return best, which[heading].astype(np.int16), total, squares

    # In order, so that the first of several best headings is taken, by however many threads.
    results = pool.map(part, np.array_split(np.arange(headings), min(pool.threads, headings)))
    best, heading, total, squares = results[0]
    for other, its_heading, its_total, its_squares in results[1:]:
        better = other > best
        best, heading = np.where(better, other, best), np.where(better, its_heading, heading)
        total, squares = total + its_total, squares + its_squares
    rows = np.repeat(runs[:, 0], runs[:, 2])
    columns = np.concatenate([np.arange(start, start + count) for start, count in runs[:, 1:]])
    mean, deviation = _around_cells(rows, columns, total / headings, squares / headings, level.cell_m)
    prominence = (best - mean) / np.maximum(deviation, QUANTA)
    middles = np.column_stack([columns + 0.5, rows + 0.5]) * level.cell_m
    highest = _apart(middles, best.astype(np.float64), (most + 1) // 2, apart_m)
    chosen = _apart(middles, prominence, most - len(highest), apart_m, highest)
    poses = np.column_stack([middles[chosen], angles[heading[chosen]]])
    return Peaks(poses, best[chosen] / QUANTA, prominence[chosen])


def _around_cells(
    rows: Int64Array, columns: Int64Array, mean: Float64Array, mean_square: Float64Array, cell_m: float
) -> tuple[Float64Array, Float64Array]:
    """Return mean and standard deviation (n,) of the scores in the square of `_AROUND_M` around each of n cells.

    `mean` and `mean_square` (n,): over all headings at each cell. Cells that were not searched count for nothing.
    """
    top, left = int(rows.min()), int(columns.min())
    shape = (3, int(rows.max()) - top + 1, int(columns.max()) - left + 1)
    grids = np.zeros(shape)
    at = (rows - top, columns - left)
    for grid, values in zip(grids, (np.ones(len(rows)), mean, mean_square), strict=True):
        grid[at] = values
    side = 2 * round(0.5 * _AROUND_M / cell_m) + 1
    count, first, second = (ndimage.uniform_filter(grid, side, mode="constant")[at] for grid in grids)
    average = np.asarray(first / count)
    return average, np.sqrt(np.maximum(second / count - average**2, 0.0))


def climb(
    evidence: Evidence, likelihood: MapLikelihood, poses: Float64Array, *, reach_m: float, pool: ThreadPool = SERIAL
) -> tuple[Peaks, BoolArray]:
    """Climb from each pose (p, 3) to the best one around it in the fine cells, in smaller and smaller steps.

    Returns the poses in their order and whether each converged within `reach_m` of where it began.
    """
    xy, steps = np.ascontiguousarray(evidence.xy_m), np.array(_STEPS)

    def part(some: Float64Array) -> tuple[Float64Array, Float64Array, BoolArray]:
        found: tuple[Float64Array, Float64Array, BoolArray] = _climb(
            likelihood.classes, likelihood.model.log_ratios, xy, evidence.channel, some, reach_m, steps, _MOVES, CELL_M
        )
        return found

    found, scores, converged = in_parts(part, poses, pool)
    return Peaks(found, scores, np.zeros(len(scores))), converged


def scores_at(
    evidence: Evidence, likelihood: MapLikelihood, poses: Float64Array, pool: ThreadPool = SERIAL
) -> Float64Array:
    """Return the scores (p,) of poses (p, 3) in the fine cells, nats."""
    xy = np.ascontiguousarray(evidence.xy_m)

    def part(some: Float64Array) -> tuple[Float64Array]:
        return (_scores(likelihood.classes, likelihood.model.log_ratios, xy, evidence.channel, some, CELL_M),)

    return np.asarray(in_parts(part, poses, pool)[0])


def local_search(
    evidence: Evidence,
    level: Level,
    poses: Float64Array,
    reach_m: float,
    reach_rad: float,
    heading_steps: int,
    pool: ThreadPool = SERIAL,
) -> Peaks:
    """Return the best pose within `reach_m` and `reach_rad` of each pose (p, 3), on the grid of a level, in order.

    `heading_steps`: headings that are tried to either side.
    """
    xy, reach = np.ascontiguousarray(evidence.xy_m), round(reach_m / level.cell_m)

    def part(some: Float64Array) -> tuple[Float64Array, Float64Array]:
        found: tuple[Float64Array, Float64Array] = _local(
            level.ratios,
            xy,
            evidence.channel,
            level.cell_m,
            some,
            reach,
            reach_rad / max(heading_steps, 1),
            heading_steps,
            LAYERS,
        )
        return found

    few, few_channels = np.ascontiguousarray(xy[::2]), evidence.channel[::2]  # half of it ranks them as well

    def part_of_few(some: Float64Array) -> tuple[Float64Array]:
        return (_level_scores(level.ratios, few, few_channels, level.cell_m, some, LAYERS),)

    if not len(poses):
        return no_peaks()
    found, scores = in_parts(part, poses, pool)
    compared = np.concatenate([np.zeros((1, 3)), TURNED])
    own, *around = in_parts(part_of_few, (found + compared[:, None]).reshape(-1, 3), pool)[0].reshape(-1, len(found))
    prominence = (own - np.mean(around, axis=0)) / np.maximum(np.std(around, axis=0), QUANTA)
    return Peaks(found, scores / QUANTA, prominence)


def merge(poses: Float64Array, order: Int64Array, apart_m: float, apart_rad: float) -> Int64Array:
    """Return which poses (p, 3) to keep, in an order, best first: none that is nearer than both to a better one."""
    near = are_near(poses, apart_m, apart_rad)
    kept: list[int] = []
    for i in order:
        if not near[i, kept].any():
            kept.append(int(i))
    return np.array(kept, np.int64)


def are_near(poses: Float64Array, apart_m: float, apart_rad: float) -> BoolArray:
    """Mark the pairs (n, n) of poses (n, 3) that are nearer to each other than both bounds."""
    off = poses[:, None] - poses[None]
    return np.asarray((np.hypot(off[..., 0], off[..., 1]) < apart_m) & (np.abs(wrap(off[..., 2])) < apart_rad))


def around(likelihood: MapLikelihood, level: Level, places: Float64Array, radius_m: float) -> Int64Array:
    """Return the runs (R, 3) of a level's cells on the map within `radius_m` of any place (k, 2), local metres."""
    whole = inside(likelihood, level)
    places = places[np.isfinite(places).all(axis=1)]
    if not len(whole) or not len(places):
        return np.empty((0, 3), np.int64)
    # Far outside nothing is near; clipped, it fits into whole numbers.
    side = level.cell_m * max(level.ratios.shape[1:])
    x, y = np.clip(places, -side - radius_m, 2.0 * side + radius_m).T / level.cell_m - 0.5
    reach = radius_m / level.cell_m
    rows = np.floor(y)[:, None] + np.arange(-math.ceil(reach), math.ceil(reach) + 2)
    half2 = reach**2 - (rows - y[:, None]) ** 2
    half = np.sqrt(np.maximum(half2, 0.0))
    first = np.maximum(np.ceil(x[:, None] - half), whole[0, 1])
    last = np.minimum(np.floor(x[:, None] + half), whole[0, 1] + whole[0, 2] - 1)
    some = (half2 >= 0.0) & (last >= first) & (rows >= whole[0, 0]) & (rows <= whole[-1, 0])
    # In one long line, row after row, the stretches are joined where they touch or lap over.
    columns = level.ratios.shape[2]
    starts, ends = (rows[some] * columns + first[some]).astype(np.int64), (rows[some] * columns + last[some] + 1)
    order = np.argsort(starts, kind="stable")
    starts, ends = starts[order], np.maximum.accumulate(ends[order].astype(np.int64))
    new = np.ones(len(starts), np.bool_)
    new[1:] = (starts[1:] > ends[:-1]) | (starts[1:] // columns != starts[:-1] // columns)
    starts, ends = starts[new], ends[np.append(np.flatnonzero(new)[1:] - 1, len(ends) - 1)] if len(ends) else ends
    return np.column_stack([starts // columns, starts % columns, ends - starts])


def inside(likelihood: MapLikelihood, level: Level) -> Int64Array:
    """Return the runs (R, 3) of a level's cells whose middles lie on the map: one for each row."""
    west, south, east, north = likelihood.aerial_map.bounds
    rows, columns = level.ratios.shape[1:]
    x = likelihood.west_m + (np.arange(columns) + 0.5) * level.cell_m
    y = likelihood.south_m + (np.arange(rows) + 0.5) * level.cell_m
    across, along = np.flatnonzero((x > west) & (x < east)), np.flatnonzero((y > south) & (y < north))
    if not len(across):
        return np.empty((0, 3), np.int64)
    return np.column_stack([along, np.full(len(along), across[0]), np.full(len(along), len(across))])


def in_parts(work: Callable[[Float64Array], tuple[Any, ...]], poses: Float64Array, pool: ThreadPool) -> tuple[Any, ...]:
    """Return what `work` gives for poses (p, 3), divided among the threads: arrays of p rows."""
    poses = np.ascontiguousarray(poses, np.float64)
    parts = np.array_split(poses, max(min(pool.threads, len(poses)), 1))
    return tuple(np.concatenate(results) for results in zip(*pool.map(work, parts), strict=True))


def _apart(
    middles: Float64Array, scores: Float64Array, most: int, apart_m: float, chosen: Int64Array | None = None
) -> Int64Array:
    """Return the best of the cells' middles (n, 2), greedily, each `apart_m` from those before, the `chosen` first."""
    candidates = min(len(scores), _CONSIDERED * most)
    order = np.argpartition(-scores, candidates - 1)[:candidates]
    order = order[np.argsort(-scores[order], kind="stable")]
    before = np.empty(0, np.int64) if chosen is None else chosen
    order = np.concatenate([before, order])
    found: Int64Array = _greedy(np.ascontiguousarray(middles[order]), len(before) + most, apart_m)
    return order[found]


@njit(cache=True, nogil=True)
def _greedy(middles: Float64Array, most: int, apart_m: float) -> Int64Array:
    chosen = np.empty(most, np.int64)
    count = 0
    for i in range(len(middles)):
        free = True
        for j in range(count):
            dx, dy = middles[i, 0] - middles[chosen[j], 0], middles[i, 1] - middles[chosen[j], 1]
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
    """Return for every cell of the runs, one after the other: the best score and its heading's number, sum and sum of
    squares over the headings."""
    _, rows, columns = ratios.shape
    flat = ratios.reshape(-1)
    cells, widest = 0, 0
    for k in range(len(runs)):
        cells += runs[k, 2]
        widest = max(widest, runs[k, 2])
    best = np.full(cells, -32768, np.int16)
    heading = np.zeros(cells, np.int16)
    total, squares = np.zeros(cells), np.zeros(cells)
    sums = np.zeros(widest, np.int16)
    offsets = np.empty(len(channel), np.int64)
    for h in range(len(angles)):
        c, s = math.cos(angles[h]), math.sin(angles[h])
        for e in range(len(channel)):
            u, v = (c * xy[e, 0] - s * xy[e, 1]) / cell, (s * xy[e, 0] + c * xy[e, 1]) / cell
            # From the middle of the base's cell; a block of free space is named by its lower left cell.
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
                score = sums[j]
                total[at + j] += score
                squares[at + j] += np.float64(score) * score
                if score > best[at + j]:
                    best[at + j] = score
                    heading[at + j] = h
            at += width
    return best, heading, total, squares


@njit(cache=True, nogil=True)
def _local(  # type: ignore[no-untyped-def]
    ratios: Int16Array, xy: Float64Array, channel: Int64Array, cell: float, poses: Float64Array, reach: int,
    heading_step: float, heading_steps: int, layers: int,
):  # fmt: skip
    _, rows, columns = ratios.shape
    found = poses.copy()
    scores = np.zeros(len(poses))
    side = 2 * reach + 1
    sums = np.empty((side, side), np.int32)
    for p in range(len(poses)):
        best = -(1 << 30)
        for t in range(-heading_steps, heading_steps + 1):
            angle = poses[p, 2] + t * heading_step
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
def _level_scores(  # type: ignore[no-untyped-def]
    ratios: Int16Array, xy: Float64Array, channel: Int64Array, cell: float, poses: Float64Array, layers: int
):  # fmt: skip
    """Return the scores (p,) of poses (p, 3) in the cells of a level, in its quanta."""
    _, rows, columns = ratios.shape
    scores = np.zeros(len(poses))
    for p in range(len(poses)):
        c, s = math.cos(poses[p, 2]), math.sin(poses[p, 2])
        total = 0
        for e in range(len(channel)):
            x, y = poses[p, 0] + c * xy[e, 0] - s * xy[e, 1], poses[p, 1] + s * xy[e, 0] + c * xy[e, 1]
            middle = 0.0 if channel[e] < layers else 0.5
            column, row = math.floor(x / cell - middle), math.floor(y / cell - middle)
            if 0 <= row < rows and 0 <= column < columns:
                total += ratios[channel[e], row, column]
        scores[p] = total
    return scores


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
    converged = np.ones(len(poses), np.bool_)
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
        converged[p] = math.hypot(x - poses[p, 0], y - poses[p, 1]) <= reach
    return found, scores, converged
