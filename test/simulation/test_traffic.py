"""Cars and people under way: where they may go, and what a ray sees of them."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.route import Route, plan_route
from crossloc3d_ros.simulation.scene import Hits, Label, Scene
from crossloc3d_ros.simulation.town import Town, make_town
from crossloc3d_ros.simulation.traffic import Movers, Traffic, TrafficConfig
from crossloc3d_ros.simulation.vlp16 import Vlp16


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(9, "old_town", 260.0)


@pytest.fixture(scope="module")
def route(town: Town) -> Route:
    return plan_route(town, 60.0, np.random.default_rng(0))


@pytest.fixture(scope="module")
def traffic(town: Town, route: Route) -> Traffic:
    return Traffic.draw(town, route, np.random.default_rng(1), TrafficConfig(people=30.0, cars=10.0))


def boxes(rng: np.random.Generator, count: int) -> Movers:
    return Movers(
        rng.uniform(-15, 15, (count, 3)), rng.uniform(0.5, 5.0, (count, 3)), rng.uniform(0, 7, count),
        rng.uniform(-5, 5, (count, 2)),
    )  # fmt: skip


def scene_of(movers: Movers, moved_s: float) -> Scene:
    """Return the boxes as triangles, where they are at a time."""
    middle = movers.centre_m[:, :2] + moved_s * movers.velocity_m_s
    quads = mesh.oriented_boxes(middle, movers.size_m[:, 0], movers.size_m[:, 1], movers.yaw_rad)
    low, high = (movers.centre_m[:, 2] + sign * movers.size_m[:, 2] / 2 for sign in (-1, 1))
    count = len(quads)
    return mesh.scene_from([mesh.prisms(quads, low, high, high, np.zeros(count), np.full(count, 2, np.uint8))])


def nothing(count: int) -> Hits:
    return Hits(
        np.full(count, np.inf, np.float32), np.zeros(count, np.uint8), np.zeros(count, np.float32),
        np.full(count, -1, np.int32),
    )  # fmt: skip


@pytest.mark.parametrize("moved_s", [0.0, -0.07])
def test_rays_meet_the_boxes_as_they_meet_their_triangles(moved_s: float) -> None:
    rng = np.random.default_rng(2)
    movers = boxes(rng, 12)
    origins = np.tile(np.float32([[22.0, 2.0, 1.0]]), (60_000, 1))
    directions = rng.standard_normal((60_000, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = scene_of(movers, moved_s).cast(origins, directions)
    hits = movers.before(nothing(60_000), origins, directions, np.full(60_000, moved_s))
    both = expected.mask & hits.mask
    assert both.sum() > 300
    assert (expected.mask != hits.mask).mean() < 2e-4  # a ray along an edge may go either way
    np.testing.assert_allclose(hits.distance_m[both], expected.distance_m[both], atol=2e-3)
    assert np.mean(np.abs(hits.incidence_cos[both] - expected.incidence_cos[both]) < 1e-3) > 0.99
    assert (hits.label[hits.mask] == Label.STRUCTURE).all()


def test_what_stands_in_front_hides_a_box() -> None:
    movers = Movers(np.array([[10.0, 0, 0]]), np.ones((1, 3)), np.zeros(1), np.zeros((1, 2)))
    origins, directions = np.zeros((2, 3), np.float32), np.float32([[1, 0, 0], [1, 0, 0]])
    near = Hits(np.float32([4.0, 30.0]), np.uint8([1, 1]), np.ones(2, np.float32), np.int32([7, 7]))
    hits = movers.before(near, origins, directions, np.zeros(2))
    np.testing.assert_allclose(hits.distance_m, [4.0, 9.5])
    assert hits.face[0] == 7 and hits.label[0] == 1
    assert hits.face[1] > 1_000_000 and hits.label[1] == Label.STRUCTURE


def test_nobody_walks_through_walls_and_cars_keep_to_streets(town: Town, traffic: Traffic) -> None:
    def cell(values: np.ndarray, places: np.ndarray) -> np.ndarray:
        raster = town.clearance
        row = np.floor((raster.north_m - places[:, 1]) / raster.cell_m).astype(int)
        return values[row, np.floor((places[:, 0] - raster.west_m) / raster.cell_m).astype(int)]

    for cars, clearance, preference in ((False, 0.5, 0.1), (True, 1.3, 0.9)):
        places = traffic.track_m[traffic.is_car == cars].reshape(-1, 3)
        places = places[np.isfinite(places[:, 0])]
        assert len(places) > 1000
        assert cell(town.clearance.values, places).min() >= clearance
        assert cell(town.preference.values, places).min() >= preference
        np.testing.assert_allclose(places[:, 2], town.terrain_height(places), atol=1e-9)


def test_they_get_on_at_their_own_speed(traffic: Traffic) -> None:
    steps = np.hypot(*np.moveaxis(np.diff(traffic.track_m[..., :2], axis=1), -1, 0)) / 0.2
    people, cars = (group[np.isfinite(group)] for group in (steps[~traffic.is_car], steps[traffic.is_car]))
    assert people.max() < 1.7 and cars.max() < 9.1
    assert np.mean(people > 0.6) > 0.8 and np.mean(cars > 2.9) > 0.6


def test_as_many_are_about_as_was_asked_for(route: Route, traffic: Traffic) -> None:
    times = np.linspace(2.0, route.duration_s - 2.0, 20)
    counts = []
    for time in times:
        movers = traffic.at(float(time), route.at(time)[0, :2, 3])
        counts.append(int((movers.size_m[:, 0] == 0.3).sum()))
        distance = np.hypot(*(movers.centre_m[:, :2] - route.at(time)[0, :2, 3]).T)
        assert distance.min(initial=9.0) > 1.3
    assert 12 < np.mean(counts) < 45


def test_no_traffic_changes_nothing_and_some_changes_only_what_it_hides(
    town: Town, route: Route, traffic: Traffic
) -> None:
    pose = route.at(8.0)[0] @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.2], [0, 0, 0, 1.0]])
    none = Traffic.draw(town, route, np.random.default_rng(1), TrafficConfig(0.0, 0.0)).at(8.0, pose[:2, 3])
    some = traffic.at(8.0, pose[:2, 3])
    assert len(none.centre_m) == 0 < len(some.centre_m)
    still, empty, full = (
        Vlp16().scan(town.scene, pose, np.random.default_rng(4), None, movers) for movers in (None, none, some)
    )
    np.testing.assert_array_equal(still.points, empty.points)
    assert not np.array_equal(still.points, full.points)
    # What the full street shows that the empty one does not lies on the boxes.
    key = np.round(full.time * 1e7).astype(np.int64) * 16 + full.ring
    before = np.round(still.time * 1e7).astype(np.int64) * 16 + still.ring
    new = ~np.isin(key, before)
    at = {int(k): i for i, k in enumerate(before)}
    for i in np.flatnonzero(~new):
        new[i] = np.linalg.norm(full.points[i] - still.points[at[int(key[i])]]) > 0.5
    shown = full.points[new] @ pose[:3, :3].T + pose[:3, 3]
    gap = np.hypot(*np.moveaxis(shown[:, None, :2] - some.centre_m[None, :, :2], -1, 0)).min(axis=1)
    assert len(shown) > 20
    assert np.percentile(gap, 95) < 3.5
