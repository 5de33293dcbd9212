"""The search: against brute force, without half a cell lost between the levels, never worse than it began."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.localization.alignment import aligner as alignment
from crossloc3d_ros.localization.alignment import observation_model
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS, Evidence, evidence_of
from crossloc3d_ros.localization.alignment.likelihood import QUANTA, Level, MapLikelihood
from crossloc3d_ros.localization.alignment.observation_model import ObservationModel
from crossloc3d_ros.localization.alignment.pose_search import (
    around,
    climb,
    inside,
    local_search,
    merge,
    scores_at,
    search_cells,
)
from crossloc3d_ros.localization.alignment.thread_pool import ThreadPool

SHAPE = (40, 46)


@pytest.fixture(scope="module")
def likelihood(box_map: AerialMap) -> MapLikelihood:
    prepared = MapLikelihood(box_map, ObservationModel.load())
    prepared.prepare()
    return prepared


def some_level(cell_m: float, seed: int = 0) -> Level:
    rng = np.random.default_rng(seed)
    return Level(cell_m, rng.integers(-32, 33, (CHANNELS, *SHAPE)).astype(np.int16))


def some_evidence(cell_m: float, count: int = 60, reach: int = 8, seed: int = 1) -> Evidence:
    """Return evidence on the cells and blocks of a level, but a little beside their middles."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-reach * cell_m, reach * cell_m, (count, 2))
    return Evidence(xy, rng.integers(0, CHANNELS, count))


def index_of(level: Level, channel: int, x: float, y: float) -> tuple[int, int, int]:
    """Return the cell that holds a place, or the block of 2 x 2 cells whose middle is nearest, by its lower left."""
    column, row = x / level.cell_m, y / level.cell_m
    if channel >= LAYERS:
        column, row = column - 0.5, row - 0.5
    return channel, math.floor(row), math.floor(column)


def laid(evidence: Evidence, level: Level, x: float, y: float, angle: float) -> int:
    c, s = math.cos(angle), math.sin(angle)
    return sum(
        int(level.ratios[index_of(level, channel, x + c * u - s * v, y + s * u + c * v)])
        for channel, (u, v) in zip(evidence.channel, evidence.xy_m, strict=True)
    )


def runs_of(cells: np.ndarray) -> np.ndarray:
    """Return row, first column and length (R, 3) of the stretches of marked cells."""
    edges = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    starts, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    return np.column_stack([starts, ends[:, 1] - starts[:, 1]])


def cells_of(runs: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the cells that runs name, after a look that none is named twice."""
    cells = np.zeros(shape, np.int64)
    for row, column, count in runs:
        assert count > 0 and column >= 0 and column + count <= shape[1]
        cells[row, column : column + count] += 1
    assert cells.max(initial=0) <= 1
    return cells > 0


@pytest.mark.parametrize("cell_m", [1.0, 4.0])
@pytest.mark.parametrize("headings", [1, 7])
def test_the_search_of_cells_finds_what_trying_all_poses_finds(cell_m: float, headings: int) -> None:
    level, evidence = some_level(cell_m), some_evidence(cell_m)
    cells = np.zeros(SHAPE, np.bool_)
    cells[13:21, 14:24] = np.random.default_rng(3).random((8, 10)) < 0.7
    found = search_cells(evidence, level, runs_of(cells), headings, 10**4, 0.1 * cell_m)
    table = {}
    for row, column in np.argwhere(cells):
        x, y = (column + 0.5) * cell_m, (row + 0.5) * cell_m
        scores = [laid(evidence, level, x, y, 2 * math.pi * h / headings) for h in range(headings)]
        table[x, y] = max(scores), 2 * math.pi * int(np.argmax(scores)) / headings
    assert len(found.poses) == len(table)
    for (x, y, angle), score in zip(found.poses, found.scores, strict=True):
        best, heading = table.pop((x, y))
        assert score * QUANTA == best
        assert angle == pytest.approx(heading)


def test_peaks_are_apart_and_no_better_one_is_left_out() -> None:
    level, evidence = some_level(4.0), some_evidence(4.0)
    cells = np.zeros(SHAPE, np.bool_)
    cells[12:28, 12:34] = True
    every = search_cells(evidence, level, runs_of(cells), 6, 10**4, 0.1)
    few = search_cells(evidence, level, runs_of(cells), 6, 9, 11.0)
    chosen: list[np.ndarray] = []
    for values, most in ((every.scores, 5), (every.prominence, 9)):
        for pose in every.poses[np.argsort(-values, kind="stable")]:
            if len(chosen) < most and all(np.hypot(*(pose[:2] - other[:2])) >= 11.0 for other in chosen):
                chosen.append(pose)
    np.testing.assert_array_equal(few.poses, chosen)


def test_prominence_is_the_height_over_the_cells_around_in_all_headings() -> None:
    level, evidence, headings = some_level(4.0), some_evidence(4.0), 5
    cells = np.zeros(SHAPE, np.bool_)
    cells[12:28, 12:34] = np.random.default_rng(3).random((16, 22)) < 0.8
    found = search_cells(evidence, level, runs_of(cells), headings, 10**4, 0.1)
    scores = {
        (row, column): [
            laid(evidence, level, 4.0 * (column + 0.5), 4.0 * (row + 0.5), 2 * math.pi * h / headings)
            for h in range(headings)
        ]
        for row, column in np.argwhere(cells).tolist()
    }
    for (x, y, _), score, prominence in zip(found.poses[:20], found.scores, found.prominence, strict=False):
        row, column = int(y // 4.0), int(x // 4.0)
        around = np.concatenate([v for (r, c), v in scores.items() if abs(r - row) <= 6 and abs(c - column) <= 6])
        assert prominence == pytest.approx((score * QUANTA - around.mean()) / max(around.std(), QUANTA), rel=1e-6)


def test_a_place_that_explains_everything_does_not_hide_one_that_fits() -> None:
    """Half of the area explains any evidence from anywhere; the one pose that fits lies in the other half."""
    rng = np.random.default_rng(0)
    level = Level(4.0, rng.integers(-9, 10, (CHANNELS, *SHAPE)).astype(np.int16))
    evidence = some_evidence(4.0, 120)
    cells = np.zeros(SHAPE, np.bool_)
    cells[10:30, 10:36] = True
    for channel, (x, y) in zip(evidence.channel, evidence.xy_m, strict=True):
        level.ratios[index_of(level, channel, 4.0 * 28.5 + x, 4.0 * 20.5 + y)] = 9
    level.ratios[:, :, :22] = 14 + rng.integers(-1, 2, level.ratios[:, :, :22].shape)
    found = search_cells(evidence, level, runs_of(cells), 12, 4, 8.0)
    assert (np.argsort(-found.scores)[:2] < 2).all(), "the first half is by score"
    fits = np.hypot(*(found.poses[:, :2] - [4.0 * 28.5, 4.0 * 20.5]).T) < 1.0
    assert not fits[:2].any() and fits[2], "the pose that fits is the most prominent one"
    assert found.by_both()[:2].tolist() == [0, 2], "by turns"


@pytest.mark.parametrize("threads", [2, 3, 16])
def test_threads_change_nothing(threads: int) -> None:
    level = some_level(2.0)
    level.ratios[:] = np.clip(level.ratios, -1, 1)  # many headings are equally good
    evidence, cells = some_evidence(2.0, 12), np.ones(SHAPE, np.bool_)
    cells[:12] = cells[-12:] = cells[:, :12] = cells[:, -12:] = False
    one, many = (
        search_cells(evidence, level, runs_of(cells), 11, 50, 3.0, ThreadPool(count)) for count in (1, threads)
    )
    np.testing.assert_array_equal(one.poses, many.poses)
    np.testing.assert_array_equal(one.scores, many.scores)
    np.testing.assert_array_equal(one.prominence, many.prominence)


@pytest.mark.parametrize("threads", [2, 5, 64])
def test_threads_share_poses_and_keep_their_order(likelihood: MapLikelihood, box_town: Any, threads: int) -> None:
    evidence = evidence_of(box_town.place(140.0, 120.0, 0.7), 1.3).sample(100, 100)
    rng = np.random.default_rng(6)
    poses = np.column_stack([rng.uniform(200, 300, (23, 2)), rng.uniform(-3, 3, 23)])
    level, pools = likelihood.levels[1], (ThreadPool(1), ThreadPool(threads))
    for few in (poses, poses[:1], poses[:0]):
        one, many = (local_search(evidence.coarser(2.0, 90, 90), level, few, 4.0, 0.1, 2, pool) for pool in pools)
        np.testing.assert_array_equal(one.poses, many.poses)
        np.testing.assert_array_equal(one.scores, many.scores)
        (one, converged), (many, all_converged) = (
            climb(evidence, likelihood, few, reach_m=3.0, pool=pool) for pool in pools
        )
        np.testing.assert_array_equal(one.poses, many.poses)
        np.testing.assert_array_equal(converged, all_converged)
        np.testing.assert_array_equal(one.scores, scores_at(evidence, likelihood, one.poses, pools[1]))


def test_nothing_marked_and_nothing_seen_find_nothing() -> None:
    level, cells = some_level(2.0), np.ones(SHAPE, np.bool_)
    nothing = Evidence(np.empty((0, 2)), np.empty(0, np.int64))
    assert len(search_cells(some_evidence(2.0), level, runs_of(np.zeros_like(cells)), 6, 5, 4.0).scores) == 0
    assert len(search_cells(nothing, level, runs_of(cells), 6, 5, 4.0).scores) == 0
    assert len(local_search(some_evidence(2.0), level, np.empty((0, 3)), 4.0, 0.1, 2).scores) == 0


def test_sums_of_coarse_ratios_fit_into_16_bits() -> None:
    hits = alignment.COARSE_HITS * math.ceil(QUANTA * observation_model._MAX_LOG_RATIO)
    assert hits + alignment.COARSE_FREE * 100 <= np.iinfo(np.int16).max


@pytest.mark.parametrize("cell_m", [1.0, 2.0])
def test_the_local_search_finds_what_trying_all_poses_finds(cell_m: float) -> None:
    level, evidence = some_level(cell_m, 4), some_evidence(cell_m)
    rng = np.random.default_rng(5)
    poses = np.column_stack([rng.uniform(16, 24, (6, 2)) * cell_m, rng.uniform(-4, 4, 6)])
    found = local_search(evidence, level, poses, 2.0 * cell_m, 0.2, 2)
    for pose, best, score in zip(poses, found.poses, found.scores, strict=True):
        tried = {
            (x, y, angle): laid(evidence, level, x, y, angle)
            for x in pose[0] + cell_m * np.arange(-2, 3)
            for y in pose[1] + cell_m * np.arange(-2, 3)
            for angle in pose[2] + 0.1 * np.arange(-2, 3)
        }
        assert score * QUANTA == max(tried.values())
        assert laid(evidence, level, *best) == max(tried.values())
        assert (np.abs(best - pose) <= [2 * cell_m + 1e-9, 2 * cell_m + 1e-9, 0.2 + 1e-9]).all()


def test_marked_cells_are_those_near_places_and_on_the_map(likelihood: MapLikelihood) -> None:
    level = likelihood.levels[0]
    rows, columns = np.indices(level.ratios.shape[1:])
    x, y = (columns + 0.5) * level.cell_m, (rows + 0.5) * level.cell_m
    on_map = (x > 112) & (x < 112 + 280) & (y > 112) & (y < 112 + 280)
    np.testing.assert_array_equal(cells_of(inside(likelihood, level), rows.shape), on_map)
    places = np.array([[150.0, 160.0], [161.0, 170.0], [113.0, 390.0], [-500.0, 200.0], [1e7, -1e7], [np.nan, 200.0]])
    rng = np.random.default_rng(0)
    for some in (places, *(rng.uniform(60.0, 440.0, (count, 2)) for count in (1, 3, 30, 300))):
        near = np.any([np.hypot(x - a, y - b) <= 22.0 for a, b in some], axis=0)
        found = around(likelihood, level, some, 22.0)
        np.testing.assert_array_equal(cells_of(found, rows.shape), near & on_map)
        np.testing.assert_array_equal(found, runs_of(near & on_map), err_msg="as few and as long as can be")
    for none in (np.empty((0, 2)), np.full((2, 2), np.nan), np.array([[1e12, 0.0], [-1e300, 1e300]])):
        assert len(around(likelihood, level, none, 22.0)) == 0


def test_the_climb_never_descends_and_says_how_far_it_went(likelihood: MapLikelihood, box_town: Any) -> None:
    evidence = evidence_of(box_town.place(140.0, 120.0, 0.7), 1.3).sample(300, 300)
    rng = np.random.default_rng(6)
    x, y = 112.0 + 140.0, 112.0 + 120.0
    poses = np.column_stack([x + rng.uniform(-9, 9, 20), y + rng.uniform(-9, 9, 20), 0.7 + rng.uniform(-0.3, 0.3, 20)])
    before = scores_at(evidence, likelihood, poses)
    found, converged = climb(evidence, likelihood, poses, reach_m=3.0)
    np.testing.assert_allclose(found.scores, scores_at(evidence, likelihood, found.poses), atol=1e-6)
    assert (found.scores >= before).all()
    assert (found.scores > before).any()
    moved = np.hypot(*(found.poses - poses)[:, :2].T)
    np.testing.assert_array_equal(converged, moved <= 3.0)
    assert converged.any() and not converged.all()


def test_scores_are_sums_over_the_cells_that_evidence_falls_on(likelihood: MapLikelihood, box_town: Any) -> None:
    evidence = evidence_of(box_town.place(140.0, 120.0, 0.7), 1.3).sample(200, 200)
    rows, columns = likelihood.classes.shape
    poses = np.array(
        [[250.3, 230.9, 0.4], [5.0, 7.0, 3.0], [columns - 3.0, 40.0, -2.0], [-1e6, 0.0, 0.0], [np.nan, 9.0, 0.0]]
    )
    expected = []
    for x, y, angle in poses:
        total, c, s = 0.0, math.cos(angle), math.sin(angle)
        for channel, (u, v) in zip(evidence.channel, evidence.xy_m, strict=True):
            place = np.floor([y + s * u + c * v, x + c * u - s * v])
            if (place >= 0).all() and (place < [rows, columns]).all():
                row, column = place.astype(int)
                total += float(likelihood.model.log_ratios[channel, likelihood.classes[row, column]])
        expected.append(total)
    np.testing.assert_allclose(scores_at(evidence, likelihood, poses), expected, atol=1e-6)
    assert expected[3] == expected[4] == 0.0


def test_poses_are_one_where_both_place_and_heading_are_near() -> None:
    poses = np.array([[0, 0, 3.1], [2.0, 0, -3.1], [2.0, 0, 0.0], [5.0, 0, 3.1], [0.5, 0, 3.0]], float)
    assert merge(poses, np.array([4, 0, 1, 2, 3]), 3.0, 0.2).tolist() == [4, 2, 3]
    assert merge(np.empty((0, 3)), np.empty(0, np.int64), 3.0, 0.2).tolist() == []


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_a_turned_world_gives_the_same_scores(
    likelihood: MapLikelihood, box_map: AerialMap, box_town: Any, map_of: Any, tmp_path: Path, quarter: int
) -> None:
    """Cells and blocks that were shifted by half a cell, to whatever side, would score otherwise in a turned world."""
    terrain, surface, lowest = (
        np.rot90(raster.values, quarter).copy() for raster in (box_map.terrain(), box_map.surface(), box_map.lowest())
    )
    turned = MapLikelihood(map_of(tmp_path, terrain, surface, lowest=lowest), likelihood.model)
    turned.prepare()
    rng = np.random.default_rng(8)
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
    middle = 112.0 + 140.0
    evidence = evidence_of(box_town.place(140.0, 120.0, 0.7), 1.3, (0.21, -0.13))
    poses = np.column_stack([rng.uniform(200, 300, (40, 2)), rng.uniform(-3, 3, 40)])
    offsets = (poses[:, :2] - middle) @ np.array([[c, s], [-s, c]])
    its_poses = np.column_stack([middle + offsets, poses[:, 2] + quarter * math.pi / 2])
    np.testing.assert_allclose(
        scores_at(evidence, likelihood, poses), scores_at(evidence, turned, its_poses), atol=1e-6
    )  # fmt: skip
    for level, its_level in zip(likelihood.levels, turned.levels, strict=True):
        coarse = evidence.coarser(level.cell_m, 300, 300)
        assert {int(e) for e in coarse.channel} == set(range(CHANNELS))
        np.testing.assert_array_equal(
            local_search(coarse, level, poses, 0.0, 0.0, 0).scores,
            local_search(coarse, its_level, its_poses, 0.0, 0.0, 0).scores,
        )


@pytest.mark.parametrize("which", [0, 1])
def test_levels_agree_on_where_a_pose_is(likelihood: MapLikelihood, box_town: Any, which: int) -> None:
    """What the search of cells scores at a cell's middle, the local search scores there, too."""
    level = likelihood.levels[which]
    evidence = evidence_of(box_town.place(140.0, 120.0, 0.7), 1.3, (0.21, -0.13)).coarser(level.cell_m, 100, 100)
    cells = cells_of(inside(likelihood, level), level.ratios.shape[1:]) & (
        np.random.default_rng(1).random(level.ratios.shape[1:]) < 0.02
    )
    peaks = search_cells(evidence, level, runs_of(cells), 23, 10**4, 0.1)
    assert len(peaks.poses) == cells.sum()
    off_axis = peaks.poses[:, 2] != 0.0  # else all evidence lies on the borders of cells
    here = local_search(evidence, level, peaks.poses, 0.0, 0.0, 0).scores
    np.testing.assert_array_equal(here[off_axis], peaks.scores[off_axis])
