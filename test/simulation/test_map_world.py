"""Worlds of a map's own rasters: ground, houses and open space lie where the map has them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.simulation.map_world import UNCHANGED, Change, open_ground, world_of_map
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.world import Bounds, World

DOWN = np.array([0.0, 0.0, -1.0], np.float32)


@pytest.fixture(scope="module")
def square(town_map: AerialMap) -> Bounds:
    west, south, _, _ = town_map.bounds
    return Bounds(west + 20, south + 20, west + 240, south + 240)


@pytest.fixture(scope="module")
def world(town_map: AerialMap, square: Bounds) -> World:
    return world_of_map(town_map, square, 0, UNCHANGED)


def seen_from_above(world: World, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and labels (n,) of what a ray from above meets at local places (n, 2)."""
    origins = np.column_stack([places, np.full(len(places), 200.0)]).astype(np.float32)
    hits = world.scene.cast(origins, np.tile(DOWN, (len(places), 1)))
    return 200.0 - hits.distance_m, hits.label


def test_the_world_is_as_high_as_the_map(town_map: AerialMap, square: Bounds, world: World) -> None:
    rng = np.random.default_rng(0)
    grid = rng.uniform([square.min_x, square.min_y], [square.max_x, square.max_y], (4000, 2))
    heights, labels = seen_from_above(world, grid - world.origin_grid[:2])
    surface = town_map.surface().nearest(grid[:, 0], grid[:, 1])
    terrain = town_map.terrain().nearest(grid[:, 0], grid[:, 1])
    known = np.isfinite(surface)
    assert np.mean(np.abs(heights - surface)[known] < 0.3) > 0.85, "walls and their cells' halves are the rest"
    high, low = known & (surface - terrain > 3.0), known & (surface - terrain < 0.3)
    assert np.mean(labels[high] == Label.BUILDING) > 0.8
    assert np.mean(labels[low] == Label.GROUND) > 0.95


def test_houses_of_a_sparse_survey_are_houses(
    town_map: AerialMap, square: Bounds, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two cells in five have no echo: roofs are still told from crowns, and nobody drives through them."""
    full, rng = town_map.surface(), np.random.default_rng(3)
    places = rng.uniform([square.min_x, square.min_y], [square.max_x, square.max_y], (4000, 2))
    high = full.nearest(*places.T) - town_map.terrain().nearest(*places.T) > 3.0

    def thinned(read: Any) -> Any:
        def with_gaps(self: AerialMap, bounds: Any = None) -> Any:
            raster = read(self, bounds)
            gaps = np.random.default_rng(4).random(raster.values.shape) < 0.4
            return dataclasses.replace(raster, values=np.where(gaps, np.float32(np.nan), raster.values))

        return with_gaps

    for name in ("surface", "lowest"):
        monkeypatch.setattr(AerialMap, name, thinned(getattr(AerialMap, name)))
    sparse = world_of_map(town_map, square, 0, UNCHANGED)
    _, labels = seen_from_above(sparse, places - sparse.origin_grid[:2])
    assert np.mean(labels[high] == Label.BUILDING) > 0.75


def test_robots_drive_on_open_ground_inside_of_the_square(town_map: AerialMap, square: Bounds, world: World) -> None:
    poses = world.sample_poses(50, np.random.default_rng(1), border_m=0.0)
    grid = world.to_grid(poses[:, :3, 3])
    assert (grid[:, 0] > square.min_x).all() and (grid[:, 0] < square.max_x).all()
    above = town_map.surface().nearest(*grid[:, :2].T) - town_map.terrain().nearest(*grid[:, :2].T)
    assert (above[np.isfinite(above)] < 0.5).all()


def test_years_take_houses_and_bring_others(town_map: AerialMap, square: Bounds, world: World) -> None:
    grid = np.random.default_rng(2).uniform([square.min_x, square.min_y], [square.max_x, square.max_y], (6000, 2))
    local = grid - world.origin_grid[:2]
    later = world_of_map(town_map, square, 0, Change(loose_gone=0.0, houses_gone=0.4))
    before, after = (seen_from_above(each, local)[1] == Label.BUILDING for each in (world, later))
    gone, new = (before & ~after).sum() / before.sum(), (~before & after).sum() / before.sum()
    assert 0.1 < gone < 0.7 and new > 0.02


def test_a_low_echo_by_itself_is_open_ground_and_a_hedge_is_not() -> None:
    above = np.zeros((9, 9), np.float32)
    above[2, 2] = 0.7
    above[5:8, 1:8] = 0.7
    above[0, 8] = np.nan
    found = open_ground(above)
    assert found[2, 2] and not found[6, 2:7].any()
    assert not found[0, 8] and found[:4, :8].all()
