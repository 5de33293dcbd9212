"""Worlds made from surveys: of a made-up place that is known to the centimetre, and of a real one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.formats.las import write_laz
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.vlp16 import Vlp16
from crossloc3d_ros.simulation.world import World

CORNER = np.array([500_000.0, 5_400_000.0, 0.0])
DOWN = np.float32([[0, 0, -1]])


def small_survey(*, classified: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return points and classes of 120 x 100 m: flat at 3 m, a house 9 m high, a tree, a canal along the south."""
    rng = np.random.default_rng(0)
    xy = rng.uniform([0, 0], [120, 100], (60_000, 2))
    canal = (xy[:, 1] > 20) & (xy[:, 1] < 34)
    house = (np.abs(xy - [40, 60]) < [8, 12]).all(axis=1)
    points = np.column_stack([xy, np.full(len(xy), 3.0)])
    classes = np.full(len(xy), 2, dtype=np.uint8)
    points[house, 2] = 12.0
    classes[house] = 6 if classified else 1
    crown = np.column_stack([rng.normal([90, 70], 1.5, (400, 2)), rng.uniform(6, 11, 400)])
    points, classes = points[~canal], classes[~canal]
    return np.concatenate([points, crown]) + CORNER, np.concatenate([classes, np.full(400, 1, np.uint8)])


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> World:
    path = tmp_path_factory.mktemp("survey") / "small.laz"
    write_laz(path, *small_survey(), "EPSG:32631")
    return world_from_survey([path])


def look(world: World, origin: tuple[float, float, float], direction: tuple[float, float, float]) -> tuple[float, int]:
    start = np.float32([origin]) + (CORNER - world.origin_grid).astype(np.float32)
    hits = world.scene.cast(start, np.float32([direction]))
    return float(hits.distance_m[0]), int(hits.label[0])


def test_roof_ground_and_walls_stand_where_they_were_surveyed(small: World) -> None:
    distance, label = look(small, (40, 60, 50), (0, 0, -1))
    assert (distance, label) == (pytest.approx(38.0, abs=0.02), Label.BUILDING)
    distance, label = look(small, (10, 80, 50), (0, 0, -1))
    assert (distance, label) == (pytest.approx(47.0, abs=0.02), Label.GROUND)
    for height in (4.0, 7.0, 11.0):
        # From the west towards the wall at x = 32: a wall down to the ground, half a cell of doubt.
        distance, label = look(small, (12, 60, height), (1, 0, 0))
        assert label == Label.BUILDING
        assert distance == pytest.approx(20.0, abs=0.6)


def test_crowns_let_beams_pass_and_stop_some(small: World) -> None:
    heights = np.linspace(6.5, 10.5, 200)
    labels = [look(small, (75, 70 + 0.01 * i, z), (1, 0, 0))[1] for i, z in enumerate(heights)]
    share = np.mean(np.array(labels) == Label.VEGETATION)
    assert 0.5 < share <= 1.0
    below = [look(small, (75, 70 + 0.01 * i, 4.2), (1, 0, 0))[1] for i in range(100)]
    assert np.mean(np.array(below) == Label.VEGETATION) < 0.3


def test_canals_are_water_that_nobody_drives_on(small: World) -> None:
    distance, label = look(small, (60, 27, 50), (0, 0, -1))
    assert label == Label.WATER
    assert distance > 47.5
    east, north = (CORNER - small.origin_grid)[:2]
    assert small.clearance.sample(east + 60, north + 27) == 0.0


def test_free_ground_keeps_off_the_house_and_the_edge(small: World) -> None:
    poses = small.sample_poses(500, np.random.default_rng(0), border_m=0.0, clearance_m=1.5)
    xy = poses[:, :2, 3] + small.origin_grid[:2] - CORNER[:2]
    outside = np.maximum(np.abs(xy - [40, 60]) - [8, 12], 0)
    assert np.linalg.norm(outside, axis=1).min() > 1.0
    assert (xy[:, 1] > 34.5).all()
    assert xy.min(axis=0)[0] > 20
    np.testing.assert_allclose(poses[:, 2, 3], 3.0, atol=0.03)


def test_an_unclassified_roof_is_told_from_a_crown(tmp_path: Path) -> None:
    path = tmp_path / "two_classes.laz"
    write_laz(path, *small_survey(classified=False), "EPSG:32631")
    world = world_from_survey([path])
    assert look(world, (40, 60, 50), (0, 0, -1))[1] == Label.BUILDING
    assert look(world, (12, 60, 5.0), (1, 0, 0))[1] == Label.BUILDING
    crown = [look(world, (90 + dx, 70 + dy, 50), (0, 0, -1))[1] for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    assert Label.BUILDING not in crown


def test_the_crs_becomes_the_utm_zone(tmp_path: Path) -> None:
    points, classes = small_survey()
    path = tmp_path / "rd.laz"
    write_laz(path, points - CORNER + [121_000.0, 486_000.0, 0.0], classes, "EPSG:28992")
    world = world_from_survey([path])
    assert world.crs == "EPSG:32631"
    assert 5_800_000 < world.origin_grid[1] < 5_810_000


def test_surveys_without_ground_are_refused(tmp_path: Path) -> None:
    points, _ = small_survey()
    path = tmp_path / "raw.laz"
    write_laz(path, points, np.zeros(len(points), np.uint8), "EPSG:32631")
    with pytest.raises(AerialDataError, match="ground"):
        world_from_survey([path])


@pytest.fixture(scope="module")
def delft(tmp_path_factory: pytest.TempPathFactory, shared: Any) -> tuple[World, np.ndarray]:
    """Return the world of the northern part of the Delft tile, and its points in the world's frame."""
    las = laspy.read(shared("data/aerial/delft_AHN3_2014_EPSG28992.laz"))
    part = las.y > 447_500.0
    path = tmp_path_factory.mktemp("delft") / "delft.laz"
    write_laz(path, las.xyz[part], np.asarray(las.classification)[part], "EPSG:28992")
    world = world_from_survey([path])
    from crossloc3d_ros.geodesy import Projection

    return world, Projection("EPSG:28992", world.crs)(las.xyz[part]) - world.origin_grid


def test_the_surface_is_the_surveys(delft: tuple[World, np.ndarray]) -> None:
    """Looking straight down, the highest thing lies where the highest point lies."""
    world, points = delft
    rng = np.random.default_rng(1)
    chosen = points[rng.permutation(len(points))[:3000]]
    tree = cKDTree(points[:, :2])
    highest = np.array([points[near, 2].max() for near in tree.query_ball_point(chosen[:, :2], 0.6)])
    lowest = np.array([points[near, 2].min() for near in tree.query_ball_point(chosen[:, :2], 0.6)])
    origins = chosen.astype(np.float32)
    origins[:, 2] = 200.0
    seen = 200.0 - world.scene.cast(origins, np.repeat(DOWN, len(origins), 0)).distance_m
    inside = (seen < highest + 0.35) & (seen > lowest - 0.5)
    assert inside.mean() > 0.95


def test_scans_in_the_real_world_lie_on_its_points(delft: tuple[World, np.ndarray]) -> None:
    world, points = delft
    tree = cKDTree(points[:, :2])
    poses = world.sample_poses(8, np.random.default_rng(2), border_m=10.0)
    shares = []
    for pose in poses:
        T = pose.copy()
        T[:3, 3] += 1.2 * pose[:3, 2]
        scan = Vlp16().scan(world.scene, T, np.random.default_rng(3))
        assert len(scan.points) > 5_000
        far = scan.points[np.linalg.norm(scan.points, axis=1) > 1.5]
        hit = far[::20] @ T[:3, :3].T + T[:3, 3]
        # A wall's points stand above the ground and below the roof of the surveyed points around it.
        around = tree.query_ball_point(hit[:, :2], 1.0)
        fits = [
            len(near) > 0 and points[near, 2].min() - 0.6 < z < points[near, 2].max() + 0.6
            for near, z in zip(around, hit[:, 2], strict=True)
        ]
        shares.append(np.mean(fits))
    assert np.mean(shares) > 0.95
