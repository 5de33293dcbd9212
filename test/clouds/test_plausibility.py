"""A lidar that is mounted otherwise than configured, or covered, is told by its scan; a good one never is."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.clouds.plausibility import implausible, same_points
from crossloc3d_ros.config import MountingConfig, ScanConfig
from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2
from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.lidar import Lidar
from crossloc3d_ros.simulation.profiles import PROFILES
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.simulation.scene import Label, Scene
from crossloc3d_ros.simulation.town import Town, make_town

CONFIG = ScanConfig()
UPRIGHT = mounting_matrix(CONFIG.mounting)
BAGS = ["einride_vlp16_pointcloud2_mcap", "nebula_vlp16_pointcloud2_mcap", "tepic_vlp16_outdoor_1scan_pointcloud2_mcap"]


def poses_in(seed: int, family: str) -> tuple[Town, Any]:
    town = make_town(seed, family, 250.0)
    route = plan_route(town, 80.0, np.random.default_rng(0))
    return town, route.at(np.linspace(2.0, route.duration_s - 2.0, 8))


@pytest.fixture(scope="module")
def street() -> tuple[Town, Any]:
    return poses_in(159_000, "old_town")


@pytest.fixture(scope="module")
def square() -> tuple[Town, Any]:
    return poses_in(159_020, "campus")


def scans(street: tuple[Town, Any], name: str, **mounted: float) -> list[Any]:
    """Return scans along a street by a lidar that is mounted as told, without a body in its way."""
    town, poses = street
    lidar = Lidar(PROFILES[name], dataclasses.replace(PROFILES[name].config, body=()))
    T, rng = mounting_matrix(MountingConfig(**mounted)), np.random.default_rng(1)  # type: ignore[arg-type]
    return [lidar.scan(town.scene, pose @ T, rng).points for pose in poses]


def reasons(points: list[Any], T_base_lidar: Any = UPRIGHT) -> list[str]:
    return [implausible(p, T_base_lidar, CONFIG) for p in points]


@pytest.mark.parametrize("name", ["vlp-16", "hdl-32e", "os0-32", "os1-128", "xt32", "qt64", "avia"])
def test_upright_lidars_are_plausible_and_those_upside_down_are_not(street: tuple[Town, Any], name: str) -> None:
    for height_m in (0.4, 2.5):
        T = mounting_matrix(MountingConfig(z_m=height_m))
        assert reasons(scans(street, name, z_m=height_m), T) == [""] * 8
    assert all(
        "is upside down: the ground lies above it" in told for told in reasons(scans(street, name, roll_deg=180))
    )


@pytest.mark.parametrize(
    ("mounted", "words"),
    [
        ({"pitch_deg": 90.0}, "turned by 90 degrees in pitch: the ground stands upright ahead of it"),
        ({"pitch_deg": -90.0}, "turned by 90 degrees in pitch: the ground stands upright behind it"),
        ({"roll_deg": 90.0}, "turned by 90 degrees in roll: the ground stands upright to its right"),
        ({"roll_deg": -90.0}, "turned by 90 degrees in roll: the ground stands upright to its left"),
    ],
)
def test_a_lidar_that_lies_on_its_side_is_told_which(
    square: tuple[Town, Any], mounted: dict[str, float], words: str
) -> None:
    told = reasons(scans(square, "os1-64", **mounted))
    assert sum(words in reason for reason in told) >= 6
    assert all(words in reason for reason in told if reason)
    # Configured as it is mounted, all is well: the same ground lies below.
    assert reasons(scans(square, "os1-64", **mounted), mounting_matrix(MountingConfig(**mounted))) == [""] * 8  # type: ignore[arg-type]


@pytest.mark.parametrize("turn", [{"pitch_deg": 90.0}, {"roll_deg": 90.0}, {"roll_deg": 180.0}])
def test_in_a_narrow_street_no_other_mounting_is_told(street: tuple[Town, Any], turn: dict[str, float]) -> None:
    """Across it little ground is seen; the walls are none."""
    right = {90.0: ("ahead of it", "to its right"), 180.0: ("above it",)}[max(turn.values())]
    for reason in reasons(scans(street, "os1-64", **turn)):
        assert reason == "" or any(where in reason for where in right)


def test_a_lidar_of_128_beams_is_looked_at_by_a_part_of_its_columns(street: tuple[Town, Any]) -> None:
    points = scans(street, "os1-128", roll_deg=180)[0]
    assert len(points) > 40_000
    assert implausible(points, UPRIGHT, CONFIG)


def box(length_m: float, width_m: float, height_m: float) -> Scene:
    """Return a closed room, seen from inside."""
    one = np.ones(1)
    plan = mesh.oriented_boxes(np.zeros((1, 2)), length_m, width_m, 0.0)
    room = mesh.prisms(plan, 0 * one, height_m * one, height_m * one, 0 * one, np.array([2], np.uint8))
    floor = mesh.height_grid(np.zeros((2, 2)), -100.0, -100.0, 200.0, Label.GROUND)
    return mesh.scene_from([room, floor])


@pytest.mark.parametrize("size", [(8.0, 6.0, 2.6), (60.0, 40.0, 3.5), (80.0, 2.4, 2.4)])
@pytest.mark.parametrize("name", ["vlp-16", "os0-32"])
def test_rooms_halls_and_corridors_are_not_called_upside_down(size: tuple[float, float, float], name: str) -> None:
    lidar = Lidar(PROFILES[name], dataclasses.replace(PROFILES[name].config, body=()))
    assert implausible(lidar.scan(box(*size), UPRIGHT, np.random.default_rng(0)).points, UPRIGHT, CONFIG) == ""


def test_a_path_between_a_long_wall_and_water_is_plausible() -> None:
    one = np.ones(1)
    wall = mesh.prisms(
        mesh.oriented_boxes(np.array([[0.0, 4.0]]), 120.0, 4.0, 0.0), 0 * one, 12 * one, 12 * one, 0 * one,
        np.array([2], np.uint8),
    )  # fmt: skip
    ground = mesh.height_grid(np.zeros((2, 2)), -100.0, -1.0, 200.0, Label.GROUND)
    lidar = Lidar(PROFILES["vlp-16"], dataclasses.replace(PROFILES["vlp-16"].config, body=()))
    scan = lidar.scan(mesh.scene_from([wall, ground]), UPRIGHT, np.random.default_rng(0))
    assert implausible(scan.points, UPRIGHT, CONFIG) == ""


def test_a_lidar_that_sees_two_metres_is_blocked(street: tuple[Town, Any]) -> None:
    rng = np.random.default_rng(0)
    cover = rng.normal(size=(5000, 3))
    cover = (cover / np.linalg.norm(cover, axis=1, keepdims=True) * rng.uniform(0.7, 1.9, (5000, 1))).astype(np.float32)
    assert "covered or blocked: 100% of what it sees" in implausible(cover, UPRIGHT, CONFIG)
    # What sees its own robot only, as on open water, is not; nor is one beside which something stands.
    body = rng.uniform((-0.5, -0.4, -1.5), (0.5, 0.4, 0.5), (5000, 3)).astype(np.float32)
    assert implausible(body, UPRIGHT, CONFIG) == ""
    for points in scans(street, "vlp-16"):
        beside = points[np.linalg.norm(points, axis=1) > 2.0]
        assert implausible(np.vstack([cover, beside]), UPRIGHT, CONFIG) == ""


def test_no_echoes_are_no_points(street: tuple[Town, Any]) -> None:
    points = scans(street, "vlp-16")[0]
    nothing = np.zeros((60_000, 3), np.float32)
    nothing[::2] = np.nan
    assert implausible(np.vstack([points, nothing]), UPRIGHT, CONFIG) == ""
    assert implausible(nothing, UPRIGHT, CONFIG) == ""
    assert implausible(np.empty((0, 3), np.float32), UPRIGHT, CONFIG) == ""


@pytest.mark.parametrize("bag", BAGS)
def test_real_scans_are_plausible(shared: Callable[[str], Any], bag: str) -> None:
    with open_bag(shared(f"data/vlp16/{bag}")) as reader:
        clouds = [record.message for record in reader.messages(["/velodyne_points"])]
    assert {implausible(scan_from_pointcloud2(cloud).points, UPRIGHT, CONFIG) for cloud in clouds} == {""}


def test_points_are_the_same_to_a_millimetre() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-50, 50, (1000, 3)).astype(np.float32)
    points[::10] = np.nan
    assert same_points(points, points.copy())
    assert same_points(points, points + rng.normal(0, 1e-5, points.shape).astype(np.float32))
    assert not same_points(points, points + rng.normal(0, 0.01, points.shape).astype(np.float32))
    assert not same_points(points, points[:-1])
    assert not same_points(points, np.where(np.arange(1000)[:, None] % 5, points, np.float32(np.nan)))


@pytest.mark.parametrize("value", [np.nan, 0.0, np.inf, 1e30])
def test_of_clouds_without_echoes_nothing_is_concluded(value: float) -> None:
    points = np.full((1000, 3), value, np.float32)
    assert not same_points(points, points.copy())


@pytest.mark.parametrize("bag", BAGS)
def test_real_scans_one_after_the_other_are_not_the_same(shared: Callable[[str], Any], bag: str) -> None:
    with open_bag(shared(f"data/vlp16/{bag}")) as reader:
        clouds = [scan_from_pointcloud2(r.message).points for r in reader.messages(["/velodyne_points"])]
    assert not any(same_points(one, other) for one, other in itertools.pairwise(clouds))
