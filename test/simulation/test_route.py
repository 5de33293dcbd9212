"""Routes: long enough, wide enough, and drivable by a robot."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.route import Route, RouteError, clearance_along, plan_route
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.town import Town, make_town
from crossloc3d_ros.simulation.world import Bounds, World, free_space


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(3, "old_town", 300.0)


@pytest.fixture(scope="module")
def route(town: Town) -> Route:
    return plan_route(town, 350.0, np.random.default_rng(1))


def street_world(width_m: float) -> World:
    """Return a flat world with one straight street of 200 m."""
    obstacles = np.ones((60, 240), dtype=np.bool_)
    half = int(width_m / 2)
    obstacles[30 - half : 30 + half, 20:220] = False
    clearance, preference = free_space(obstacles, ~obstacles, -120.0, 30.0, 1.0)
    flat = Raster(np.zeros((60, 240), np.float32), -120.0, 30.0, 1.0)
    scene = mesh.scene_from([mesh.height_grid(np.zeros((2, 2)), -150, -150, 300, Label.GROUND)])
    return World(
        "street", scene, flat, clearance, preference, Bounds(-120, -30, 120, 30), "EPSG:32631", np.zeros(3), 0.0
    )


def test_a_route_has_its_length_and_keeps_its_distance(town: Town, route: Route) -> None:
    assert route.length_m == pytest.approx(350.0, abs=2.0)
    assert clearance_along(route, town).min() >= 1.5 - 0.1
    assert (np.abs(route.poses[:, :2, 3]) < 150.0 - 24.0).all()


def test_the_robot_obeys_its_limits(route: Route) -> None:
    twist = route.twist(np.arange(0.1, route.duration_s - 0.1, 0.1))
    assert twist[:, 0].max() < 2.2
    assert twist[:, 0].min() > -0.05
    assert np.percentile(twist[:, 0], 50) > 1.5
    assert np.abs(twist[:, 1]).max() < 0.15  # wheels do not slide sideways
    assert np.abs(twist[:, 5]).max() < 1.1
    np.testing.assert_allclose(np.diff(route.time_s), 0.02, atol=1e-9)


def test_the_robot_stands_on_the_terrain(town: Town, route: Route) -> None:
    np.testing.assert_allclose(route.poses[:, 2, 3], town.terrain_height(route.poses[:, :2, 3]), atol=1e-6)
    assert np.degrees(np.arccos(route.poses[:, 2, 2])).max() < 12.0
    assert np.degrees(np.arccos(route.poses[:, 2, 2])).mean() > 0.2


def test_twist_integrates_to_the_poses(route: Route) -> None:
    times = np.arange(0.0, 20.0, 0.01)
    poses, twists = route.at(times), route.twist(times)
    moved = np.einsum("nij,nj->ni", poses[:, :3, :3], twists[:, :3])[:-1].sum(axis=0) * 0.01
    np.testing.assert_allclose(moved, poses[-1, :3, 3] - poses[0, :3, 3], atol=0.1)


def test_a_dead_end_is_left_again_without_leaving_the_street() -> None:
    world = street_world(8.0)
    route = plan_route(world, 500.0, np.random.default_rng(0))
    assert route.length_m == pytest.approx(500.0, abs=2.0)
    assert clearance_along(route, world).min() >= 1.4
    assert np.ptp(route.poses[:, 0, 3]) > 100.0


def test_the_middle_of_the_street_is_preferred() -> None:
    route = plan_route(street_world(16.0), 100.0, np.random.default_rng(0))
    assert np.abs(route.poses[:, 1, 3]).mean() < 3.0


def test_seeds_give_other_routes_and_the_same_seed_the_same(town: Town, route: Route) -> None:
    np.testing.assert_array_equal(plan_route(town, 350.0, np.random.default_rng(1)).poses, route.poses)
    other = plan_route(town, 350.0, np.random.default_rng(2))
    assert np.linalg.norm(other.poses[0, :2, 3] - route.poses[0, :2, 3]) > 1.0


def test_no_room_is_said_plainly() -> None:
    with pytest.raises(RouteError, match="'street' has no"):
        plan_route(street_world(4.0), 100.0, np.random.default_rng(0), clearance_m=3.0)
