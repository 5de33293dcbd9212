"""The map as likelihoods: coarse levels by hand, parts as the whole, rasters of other cells, the map's edge."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS, REACH_M, evidence_of
from crossloc3d_ros.localization.alignment.likelihood import LEVELS_M, QUANTA, MapLikelihood, coarse_ratios
from crossloc3d_ros.localization.alignment.observation_model import (
    CLASSES,
    MARGIN_CELLS,
    MEASURES,
    UNKNOWN,
    ObservationModel,
    surface_classes,
)
from crossloc3d_ros.localization.alignment.pose_search import inside
from crossloc3d_ros.types import Float32Array

_RATIOS = np.random.default_rng(0).uniform(-3, 3, (2, CHANNELS, CLASSES)).astype(np.float32)
_RATIOS[:, :, UNKNOWN] = 0.0
MODEL = ObservationModel(*_RATIOS, np.full(LAYERS, 0.5), np.zeros(len(MEASURES) + 1))
Maker = Callable[..., AerialMap]


def ratio_by_hand(log_ratios: Float32Array, classes: np.ndarray, cell: int, channel: int, row: int, column: int) -> int:
    def mean(r: int, c: int) -> float:
        return float(log_ratios[channel, classes[r * cell : (r + 1) * cell, c * cell : (c + 1) * cell]].mean())

    if channel < LAYERS:
        block = classes[row * cell : (row + 1) * cell, column * cell : (column + 1) * cell]
        value = max(float(log_ratios[channel, k]) for k in block.ravel())
    else:
        value = sum(mean(row + i, column + j) for i in (0, 1) for j in (0, 1))
    return max(min(round(value * QUANTA), 100), -100)


@pytest.mark.parametrize("cell", [int(cell) for cell in LEVELS_M])
def test_coarse_cells_are_the_likeliest_and_the_mean_of_their_fine_ones(cell: int) -> None:
    rng = np.random.default_rng(2)
    log_ratios = rng.uniform(-4, 4, (CHANNELS, CLASSES)).astype(np.float32)
    log_ratios[:, UNKNOWN] = 0.0
    classes = rng.integers(0, CLASSES, (10 * cell, 12 * cell)).astype(np.int32)
    classes[: 3 * cell, : 4 * cell] = UNKNOWN
    ratios = coarse_ratios(log_ratios, classes, cell)
    assert ratios.shape == (CHANNELS, 10, 12)
    assert ratios.dtype == np.int16
    for channel in range(CHANNELS):
        expected = [[ratio_by_hand(log_ratios, classes, cell, channel, r, c) for c in range(11)] for r in range(9)]
        assert np.abs(ratios[channel, :9, :11] - expected).max() <= (channel >= LAYERS), "but for rounding"
    assert (ratios[:, :2, :3] == 0).all(), "what is not known says nothing"


def heights(rows: int, columns: int, seed: int = 0) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return a rolling terrain, boxes and bushes on it with holes, and lowest echoes: of some, pulses get through."""
    rng = np.random.default_rng(seed)
    north, east = np.mgrid[0:rows, 0:columns]
    terrain = 5.0 + 3.0 * np.sin(east / 37.0) + 2.0 * np.cos(north / 23.0)
    boxes = rng.choice([0.0, 0.0, 3.0, 7.0, 12.0], (rows // 8 + 1, columns // 8 + 1))
    above = np.kron(boxes, np.ones((8, 8)))[:rows, :columns]
    above += rng.exponential(1.0, (rows, columns)) * (rng.random((rows, columns)) < 0.1)
    surface = terrain + above
    surface[rng.random((rows, columns)) < 0.03] = np.nan
    lowest = np.where(rng.random((rows, columns)) < 0.05, np.fmin(surface, terrain), surface)
    return terrain.astype(np.float32), surface.astype(np.float32), lowest.astype(np.float32)


@pytest.fixture(scope="module")
def wide_map(map_of: Maker, tmp_path_factory: pytest.TempPathFactory) -> AerialMap:
    """Map 700 x 420 m: several tiles, none of whose borders are the map's."""
    terrain, surface, lowest = heights(420, 700)
    return map_of(tmp_path_factory.mktemp("wide"), terrain, surface, lowest=lowest)


@pytest.fixture(scope="module")
def whole(wide_map: AerialMap) -> MapLikelihood:
    likelihood = MapLikelihood(wide_map, MODEL)
    likelihood.prepare()
    return likelihood


def test_tiles_are_seamless(wide_map: AerialMap, whole: MapLikelihood) -> None:
    rasters = [np.flipud(raster.values) for raster in (wide_map.terrain(), wide_map.surface(), wide_map.lowest())]
    rows, columns = whole.classes.shape
    south, west = round(wide_map.bounds[1] - whole.south_m), round(wide_map.bounds[0] - whole.west_m)
    held = [np.full((rows, columns), np.nan, np.float32) for _ in range(3)]
    for values, into in zip(rasters, held, strict=True):
        into[south : south + 420, west : west + 700] = values
    expected = surface_classes(*held)
    np.testing.assert_array_equal(whole.classes, expected)
    for level in whole.levels:
        by_hand = coarse_ratios(MODEL.search_ratios, expected, int(level.cell_m))
        # The last row and column of free space have no neighbour to the north and east.
        np.testing.assert_array_equal(level.ratios[:, :-1, :-1], by_hand[:, :-1, :-1])


def test_parts_are_prepared_as_the_whole_is(wide_map: AerialMap, whole: MapLikelihood) -> None:
    lazy = MapLikelihood(wide_map, MODEL)
    west, south, east, north = wide_map.bounds
    rng = np.random.default_rng(1)
    for easting, northing in [
        (west + 1, south + 1),
        (east - 1, north - 1),
        *rng.uniform((west, south), (east, north), (3, 2)),
    ]:
        lazy.prepare((easting - 22, northing - 22, easting + 22, northing + 22))
        low = np.floor([northing - 22 - REACH_M - lazy.south_m, easting - 22 - REACH_M - lazy.west_m]).astype(int)
        high = np.ceil([northing + 22 + REACH_M - lazy.south_m, easting + 22 + REACH_M - lazy.west_m]).astype(int)
        part = slice(max(low[0], 0), high[0]), slice(max(low[1], 0), high[1])
        np.testing.assert_array_equal(lazy.classes[part], whole.classes[part])
        for mine, its in zip(lazy.levels, whole.levels, strict=True):
            cell = int(mine.cell_m)
            coarse = tuple(slice(s.start // cell, s.stop // cell) for s in part)
            np.testing.assert_array_equal(mine.ratios[:, *coarse], its.ratios[:, *coarse])
    lazy.prepare()
    np.testing.assert_array_equal(lazy.classes, whole.classes)
    for mine, its in zip(lazy.levels, whole.levels, strict=True):
        np.testing.assert_array_equal(mine.ratios, its.ratios)


def test_only_what_is_asked_for_is_read(wide_map: AerialMap, monkeypatch: pytest.MonkeyPatch) -> None:
    lazy = MapLikelihood(wide_map, MODEL)
    read: list[tuple[int, int]] = []
    fill = lazy._fill
    monkeypatch.setattr(lazy, "_fill", lambda row, column: (read.append((row, column)), fill(row, column)))
    west, south = wide_map.bounds[:2]
    near = (west + 5, south + 5, west + 20, south + 20)
    threads = [threading.Thread(target=lazy.prepare, args=(near,)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(read) == [(0, 0)], "once, whoever asks"
    lazy.prepare()
    tiles = lazy.classes.size // 256**2
    assert len(read) == len(set(read)) == tiles > 4


def test_off_the_map_nothing_is_known(wide_map: AerialMap, whole: MapLikelihood) -> None:
    west, south, east, north = wide_map.bounds
    rows, columns = whole.classes.shape
    northing, easting = whole.south_m + np.arange(rows) + 0.5, whole.west_m + np.arange(columns) + 0.5
    off = ((northing < south) | (northing > north))[:, None] | ((easting < west) | (easting > east))[None]
    assert (whole.classes[off] == UNKNOWN).all()
    assert (whole.classes[~off] != UNKNOWN).mean() > 0.9
    for low, high, first, last in ((west, east, easting[0], easting[-1]), (south, north, northing[0], northing[-1])):
        assert first < low - REACH_M and last > high + REACH_M, "evidence placed at the edge stays inside"


def test_terrain_heights_are_those_of_the_map(wide_map: AerialMap, whole: MapLikelihood) -> None:
    west, south, east, north = wide_map.bounds
    terrain = wide_map.terrain()
    for easting, northing in np.random.default_rng(5).uniform((west + 1, south + 1), (east - 1, north - 1), (20, 2)):
        expected = float(terrain.sample(math.floor(easting) + 0.5, math.floor(northing) + 0.5))
        assert whole.terrain_height(easting, northing) == pytest.approx(expected, abs=1e-4)
    for place in (
        (west - 5.0, south + 5.0),
        (0.0, 0.0),
        (whole.west_m - 0.5, south + 5.0),
        (1e12, 1e12),
        (math.nan, south),
    ):
        assert math.isnan(whole.terrain_height(*place))


@pytest.mark.parametrize("cell_m", [0.5, 2.0])
def test_rasters_of_other_cells_are_compared_in_metres(map_of: Maker, tmp_path: Path, cell_m: float) -> None:
    """A roof of 24 x 16 m lies where it does, whatever the raster's cells and however its corner."""
    west, south, size = 628_000.0 + 0.5 * cell_m, 5_803_000.0, round(60 / cell_m)
    x = west + (np.arange(size) + 0.5) * cell_m
    y = (south + (np.arange(size) + 0.5) * cell_m)[::-1]
    on = (abs(x - west - 30.0) < 12.0)[None] & (abs(y - south - 26.0) < 8.0)[:, None]
    terrain = np.full((size, size), 4.0, np.float32)
    surface = terrain + np.float32(7.0) * on
    likelihood = MapLikelihood(map_of(tmp_path / "map", terrain, surface, west, south, cell_m), MODEL)
    likelihood.prepare()
    roof = np.argwhere(likelihood.classes == surface_classes(np.zeros((9, 9)), *np.full((2, 9, 9), 7.0))[4, 4])
    middle = roof.mean(axis=0) + 0.5 + [likelihood.south_m, likelihood.west_m]
    np.testing.assert_allclose(middle, [south + 26.0, west + 30.0], atol=0.6)
    # Two cells away from the ground it is a roof of which no pulse got through: its rim of two cells is missing.
    np.testing.assert_allclose(roof.max(axis=0) - roof.min(axis=0) + 1, [16 - 4, 24 - 4], atol=1.01)


@pytest.mark.parametrize("parts", [2, 4])
def test_of_a_finer_raster_the_highest_and_the_lowest_count(map_of: Maker, tmp_path: Path, parts: int) -> None:
    """A map of finer cells is the same map: nothing is shifted by half a cell, and no thin wall is lost."""
    rng = np.random.default_rng(9)
    size = 80 * parts
    fine = np.where(rng.random((size, size)) < 0.1 / parts, rng.uniform(1.0, 12.0, (size, size)), 0.0) + 5.0
    fine[rng.random((size, size)) < 0.05] = np.nan
    with np.errstate(invalid="ignore"):
        whole = np.fmax.reduce(np.fmax.reduce(fine.reshape(80, parts, 80, parts), axis=3), axis=1)
        least = np.fmin.reduce(np.fmin.reduce(fine.reshape(80, parts, 80, parts), axis=3), axis=1)
    classes = []
    for name, surface, lowest in (("fine", fine, fine), ("whole", whole, least)):
        surface, lowest = surface.astype(np.float32), lowest.astype(np.float32)
        cell_m = 80.0 / len(surface)
        corner = (628_000.0, 5_803_000.0)
        made = map_of(tmp_path / name, np.full_like(surface, 5.0), surface, *corner, cell_m, lowest)
        likelihood = MapLikelihood(made, MODEL)
        likelihood.prepare()
        classes.append(likelihood.classes)
    np.testing.assert_array_equal(*classes)


def test_maps_that_lack_half_are_known_in_the_other(map_of: Maker, tmp_path: Path) -> None:
    terrain, surface, _ = heights(100, 220)
    full = MapLikelihood(map_of(tmp_path / "full", terrain, surface), MODEL)
    for name, values in (("terrain", terrain), ("surface", surface)):
        values = values.copy()
        values[:, 110:] = np.nan
        halves = {"terrain": terrain, "surface": surface, name: values}
        half = MapLikelihood(map_of(tmp_path / name, halves["terrain"], halves["surface"]), MODEL)
        for likelihood in (full, half):
            likelihood.prepare()
        middle = round(half.aerial_map.bounds[0] - half.west_m) + 110
        assert (half.classes[:, middle:] == UNKNOWN).all()
        np.testing.assert_array_equal(
            half.classes[:, : middle - MARGIN_CELLS], full.classes[:, : middle - MARGIN_CELLS]
        )
        assert all(np.abs(level.ratios).max() <= 100 for level in half.levels)


def test_a_town_of_boxes_is_open_on_its_streets(box_map: AerialMap, box_town: Any) -> None:
    shipped = ObservationModel.load()
    likelihood = MapLikelihood(box_map, shipped)
    likelihood.prepare()
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(3, 277), np.arange(3, 277)))
    classes = likelihood.classes[112 + 3 : 112 + 277, 112 + 3 : 112 + 277].ravel()
    high = box_town.height(x, y) > 2.5
    low_hit = shipped.search_ratios[1, classes]
    assert low_hit[high].mean() > 0.5
    assert low_hit[~high].mean() < -1.0


def test_evidence_placed_at_the_map_s_edge_stays_inside_of_the_levels(box_map: AerialMap) -> None:
    """The search reads memory at offsets that nobody checks again."""
    likelihood = MapLikelihood(box_map, MODEL)
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    far = np.column_stack([140.0 * np.cos(angle), 140.0 * np.sin(angle), np.full(720, 2.0)]).astype(np.float32)
    for sensor_xy in ((0.0, 0.0), (20.0, -20.0)):
        seen = evidence_of(far, 1.2, sensor_xy)
        for level in likelihood.levels:
            evidence = seen.coarser(level.cell_m, 10**6, 10**6)
            reach = np.hypot(*evidence.xy_m.T).max() / level.cell_m
            assert reach > 85.0 / level.cell_m
            runs = inside(likelihood, level)
            rows, columns = runs[:, 0], np.concatenate([runs[:, 1], runs[:, 1] + runs[:, 2] - 1])
            _, height, width = level.ratios.shape
            for low, high, size in ((rows.min(), rows.max(), height), (columns.min(), columns.max(), width)):
                assert low + math.floor(-reach) >= 0
                assert high + math.floor(reach + 0.5) < size
