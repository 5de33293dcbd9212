"""Rasters: cells where a GIS expects them, holes filled as a membrane would, bilinear samples."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.clouds.raster import Raster, fill_holes, lowest_raster, surface_raster, terrain_raster
from crossloc3d_ros.errors import CloudError

WEST, SOUTH = 120_600.0, 485_900.0


def scatter(count: int, side: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, side, (count, 2)) + np.array([WEST, SOUTH]), rng.normal(0, 2, count)])


def test_row_zero_is_north_and_cells_start_in_the_west() -> None:
    points = np.array([[WEST + 0.5, SOUTH + 29.5, 7.0], [WEST + 19.5, SOUTH + 0.5, 9.0]])
    raster = surface_raster(points, (WEST, SOUTH, WEST + 20, SOUTH + 30), 1.0)
    assert raster.values.shape == (30, 20)
    assert raster.values[0, 0] == 7.0
    assert raster.values[29, 19] == 9.0
    assert np.isnan(raster.values).sum() == 598


@given(st.integers(0, 2**31), st.sampled_from([0.5, 1.0, 3.0]))
@settings(max_examples=20, deadline=None)
def test_cells_hold_the_mean_of_the_ground_and_the_highest_and_the_lowest_of_all(seed: int, cell: float) -> None:
    points = scatter(2000, 30.0, seed)
    mask = points[:, 2] < 1.0
    bounds = (WEST, SOUTH, WEST + 30, SOUTH + 30)
    terrain, surface = terrain_raster(points, mask, bounds, cell), surface_raster(points, bounds, cell)
    lowest = lowest_raster(points, bounds, cell)
    column = ((points[:, 0] - WEST) // cell).astype(int)
    row = ((SOUTH + 30 - points[:, 1]) // cell).astype(int)
    for i in range(0, terrain.values.shape[0], 3):
        for j in range(0, terrain.values.shape[1], 3):
            here = (row == i) & (column == j)
            if (here & mask).any():
                assert terrain.values[i, j] == pytest.approx(points[here & mask, 2].mean(), abs=1e-5)
            if here.any():
                assert surface.values[i, j] == pytest.approx(points[here, 2].max(), abs=1e-6)
                assert lowest.values[i, j] == pytest.approx(points[here, 2].min(), abs=1e-6)
            else:
                assert np.isnan(surface.values[i, j]) and np.isnan(lowest.values[i, j])


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
@settings(max_examples=10, deadline=None)
def test_a_hole_in_a_hillside_is_filled_by_the_hillside(a: float, b: float) -> None:
    rows, columns = np.mgrid[0:80, 0:90]
    plane = (a * columns + b * rows + 5).astype(np.float32)
    holed = plane.copy()
    holed[20:55, 25:70] = np.nan
    np.testing.assert_allclose(fill_holes(holed), plane, atol=0.35)  # 15.75 m of relief across the hole at most


def test_filling_touches_nothing_that_is_known_and_stays_between_the_rims() -> None:
    rng = np.random.default_rng(0)
    values = rng.uniform(1.0, 4.0, (137, 211)).astype(np.float32)
    holes = rng.uniform(size=values.shape) < 0.5
    holes[40:100, 50:150] = True
    filled = fill_holes(np.where(holes, np.nan, values).astype(np.float32))
    np.testing.assert_array_equal(filled[~holes], values[~holes])
    assert np.isfinite(filled).all()
    assert filled.min() >= 1.0 and filled.max() <= 4.0  # a membrane has no extremes of its own


def test_a_canal_lies_between_its_quays_without_steps() -> None:
    values = np.full((100, 120), np.nan, np.float32)
    values[:, :45] = 1.0
    values[:, 75:] = 2.0
    filled = fill_holes(values)
    across = filled[50, 44:76]
    assert (np.diff(across) >= -1e-4).all()
    assert np.abs(np.diff(across)).max() < 0.12


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (2, 2), (3, 5)])
def test_small_grids_are_filled_too(shape: tuple[int, int]) -> None:
    values = np.full(shape, np.nan, np.float32)
    values[0, 0] = 3.0
    np.testing.assert_allclose(fill_holes(values), 3.0)


def test_without_any_ground_the_terrain_is_unknown() -> None:
    points = scatter(100, 10.0)
    raster = terrain_raster(points, np.zeros(100, bool), (WEST, SOUTH, WEST + 10, SOUTH + 10), 1.0)
    assert np.isnan(raster.values).all()
    assert np.isnan(raster.sample(WEST + 5, SOUTH + 5))
    empty = terrain_raster(np.empty((0, 3)), np.empty(0, bool), (WEST, SOUTH, WEST + 10, SOUTH + 10), 1.0)
    assert np.isnan(empty.values).all()


def test_samples_of_a_plane_are_the_plane() -> None:
    rows, columns = np.mgrid[0:40, 0:50]
    raster = Raster((0.1 * (columns + 0.5) - 0.2 * (rows + 0.5)).astype(np.float32), WEST, SOUTH + 40, 1.0)
    rng = np.random.default_rng(0)
    e, n = WEST + rng.uniform(0.5, 49.5, (3, 200)), SOUTH + rng.uniform(0.5, 39.5, (3, 200))
    heights = raster.sample(e, n)
    assert heights.shape == (3, 200) and heights.dtype == np.float32
    np.testing.assert_allclose(heights, 0.1 * (e - WEST) - 0.2 * (SOUTH + 40 - n), atol=1e-4)


def test_outside_is_unknown_and_the_rim_holds() -> None:
    raster = Raster(np.arange(12, dtype=np.float32).reshape(3, 4), 0.0, 3.0, 1.0)
    outside = raster.sample([-0.01, 4.01, 2.0, 2.0, np.nan, 1e30], [1.0, 1.0, -0.01, 3.01, 1.0, 1.0])
    assert np.isnan(outside).all()
    np.testing.assert_allclose(raster.sample([0.0, 4.0, 0.0, 4.0], [3.0, 3.0, 0.0, 0.0]), [0, 3, 8, 11])


def test_holes_are_unknown_and_their_neighbours_are_not_spoilt() -> None:
    values = np.ones((3, 3), np.float32)
    values[1, 1] = np.nan
    raster = Raster(values, 0.0, 3.0, 1.0)
    assert np.isnan(raster.sample(1.6, 1.6))
    assert raster.sample(0.9, 1.5) == 1.0


def test_points_outside_and_not_finite_are_ignored() -> None:
    points = scatter(3000, 30.0)
    bounds = (WEST, SOUTH, WEST + 30, SOUTH + 30)
    stray = np.array([[np.nan, SOUTH, 0], [WEST + 1, SOUTH + 1, np.nan], [1e30, SOUTH, 0], [WEST - 1, SOUTH, 500]])
    spoilt = np.vstack([points, stray])
    everything = np.ones(len(spoilt), bool)
    np.testing.assert_array_equal(
        terrain_raster(spoilt, everything, bounds, 1.0).values,
        terrain_raster(points, everything[:3000], bounds, 1.0).values,
    )
    np.testing.assert_array_equal(
        surface_raster(spoilt, bounds, 1.0).values, surface_raster(points, bounds, 1.0).values
    )


@pytest.mark.parametrize(
    ("bounds", "cell"),
    [((0, 0, 0, 1), 1.0), ((0, 0, np.nan, 1), 1.0), ((0, 0, 1, 1), 0.0), ((0, 0, 1e30, 1), 1.0), ((5, 0, 1, 1), 1.0)],
)
def test_bounds_that_span_no_raster_are_refused(bounds: tuple[float, float, float, float], cell: float) -> None:
    with pytest.raises(CloudError, match="cells"):
        surface_raster(np.zeros((1, 3)), bounds, cell)


def test_a_mask_of_another_length_is_refused() -> None:
    with pytest.raises(CloudError, match="ground_mask"):
        terrain_raster(np.zeros((3, 3)), np.ones(2, bool), (0, 0, 1, 1), 1.0)


def test_a_tile_with_canals_takes_well_under_a_second() -> None:
    points = scatter(750_000, 500.0)
    mask = np.sin((points[:, 0] - WEST) / 25) > -0.3
    bounds = (WEST, SOUTH, WEST + 500, SOUTH + 500)
    terrain_raster(points[:100], mask[:100], bounds, 1.0)
    start = time.thread_time()
    raster = terrain_raster(points, mask, bounds, 1.0)
    assert time.thread_time() - start < 1.0
    assert np.isfinite(raster.values).all()


@pytest.mark.parametrize("cell", [0.5, 1.0, 3.0])
def test_the_nearest_cell_is_the_one_that_holds_a_place(cell: float) -> None:
    points = scatter(400, 30.0, 8)
    highest = surface_raster(points, (WEST, SOUTH, WEST + 30, SOUTH + 30), cell)
    held = highest.nearest(points[:, 0], points[:, 1])
    assert held.dtype == np.float32
    assert (held >= points[:, 2].astype(np.float32)).all(), "each point lies in its cell, no higher than the highest"
    assert len(np.setdiff1d(held, points[:, 2].astype(np.float32))) == 0
    corners = highest.nearest([[WEST, WEST + 30 - 1e-6]], [[SOUTH], [SOUTH + 30 - 1e-6]])
    np.testing.assert_array_equal(corners, highest.values[[-1, 0]][:, [0, -1]])


@pytest.mark.filterwarnings("error")
def test_nearest_knows_nothing_outside_and_in_holes() -> None:
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    values[1, 2] = np.nan
    raster = Raster(values, WEST, SOUTH + 3.0, 1.0)
    nan, inf = float("nan"), float("inf")
    east = [WEST - 1e-6, WEST + 4.0, WEST + 1, WEST + 1, nan, WEST + 1, inf, 1e300, WEST + 2.5]
    north = [SOUTH + 1, SOUTH + 1, SOUTH - 1e-6, SOUTH + 3.1, SOUTH + 1, nan, SOUTH + 1, SOUTH + 1, SOUTH + 1.5]
    assert np.isnan(raster.nearest(east, north)).all()
    assert raster.nearest(WEST + 0.5, SOUTH + 2.5) == 0.0
    assert raster.nearest(np.empty((0, 2)), np.empty((0, 2))).shape == (0, 2)
