"""The ground is found under a robot in every street and slope it may stand on."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from crossloc3d_ros.clouds.ground import scan_heights
from crossloc3d_ros.errors import CloudError

Array = npt.NDArray[np.float64]
Cast = Callable[..., Any]
Box = tuple[float, float, float, float, float]
HEIGHT_M = 1.2
WATER_M = -1.6


def plane(a: float, b: float) -> Callable[[Array, Array], Array]:
    return lambda x, y: a * x + b * y


def arc(radius_m: float) -> Callable[[Array, Array], Array]:
    """A valley along y; a crest where the radius is negative."""
    return lambda x, y: radius_m * (np.sqrt(1 + (x / radius_m) ** 2) - 1)


def street(seed: int, *, half_width: float = 6.0) -> list[Box]:
    """Houses and parked cars on both sides, a car ahead and a van behind."""
    rng = np.random.default_rng(seed)
    boxes: list[Box] = [(9, 0.5, 4.3, 1.8, 1.5), (-14, -0.5, 6, 2.2, 2.6)]
    for side in (-1, 1):
        x = -100.0
        while x < 100:
            front = rng.uniform(8, 25)
            if rng.random() < 0.85:
                boxes.append((x + front / 2, side * (half_width + 6), front - 0.2, 12, rng.uniform(6, 15)))
            x += front
        boxes += [
            (x, side * (half_width - 2), 4.3, 1.8, 1.5)
            for x in np.arange(-60, 60, 5.5)
            if abs(x) > 3.5 and rng.random() < 0.75
        ]
    return boxes


def park(seed: int) -> list[Box]:
    """Trunks, and three houses far off."""
    rng = np.random.default_rng(seed)
    trunks = [(x, y, 0.6, 0.6, 8.0) for x, y in rng.uniform(-60, 60, (40, 2)) if np.hypot(x, y) > 4]
    return [*trunks, (35, 10, 12, 30, 6), (-20, -30, 20, 8, 5), (-40, 30, 10, 10, 9)]


def closed_in() -> list[Box]:
    """Walls around a courtyard: hardly any ground to be seen, none beyond."""
    return [(0, 8, 20, 2, 10), (0, -8, 20, 2, 10), (10, 0, 2, 18, 10), (-10, 0, 2, 18, 10)]


def among_cars() -> list[Box]:
    return [(6 * np.cos(a), 6 * np.sin(a), 3.0, 3.0, 1.5) for a in np.arange(8) * np.pi / 4] + park(5)


PARKED: list[Box] = [(x, -6.0, 4.3, 1.8, 1.5) for x in (-22, -15, -4, 3, 9, 21)]
WORLDS = {
    "nothing": (plane(0, 0), []),
    "a flat park": (plane(0, 0), park(0)),
    "a flat street": (plane(0, 0), street(1)),
    "a lane": (plane(0, 0), street(2, half_width=4.5)),
    "a courtyard": (plane(0, 0.05), closed_in()),
    "cars all around": (plane(0.03, 0.02), among_cars()),
    "10 % up the park": (plane(0.07, 0.07), park(1)),
    "20 % up the park": (plane(0.14, 0.14), park(1)),
    "20 % and nothing": (plane(0.2, 0.0), []),
    "10 % along the street": (plane(0.1, 0), street(3)),
    "20 % along the street": (plane(0.2, 0), street(3)),
    "20 % across the street": (plane(0, 0.2), street(4)),
    "14 % both ways in the street": (plane(0.1, -0.1), street(6)),
    "20 % down the lane": (plane(-0.2, 0), street(7, half_width=4.5)),
    "10 % across the lane": (plane(0, -0.1), street(8, half_width=4.5)),
    "a canal beside the street": (
        lambda x, y: np.where((y > 5) & (y < 25), WATER_M, 0.0),
        [(0, 40, 180, 12, 10), *PARKED],
    ),
    "hills": (lambda x, y: 3 * np.sin(x / 25 + 0.3) + 2 * np.cos(y / 18 + 1), street(9)),
    "a crest": (arc(-250.0), street(5)),
    "a valley": (arc(250.0), park(2)),
    "a ramp begins": (lambda x, y: np.where(x > 8, 0.15 * (x - 8), 0.0), park(4)),
}


@pytest.fixture(scope="module")
def scans(cast: Cast) -> dict[str, Any]:
    scans = {name: cast(*world, columns=900) for name, world in WORLDS.items()}  # as at 20 Hz
    canal = scans["a canal beside the street"]
    dry = canal.points[:, 2] > WATER_M + 0.1  # water mirrors the beam away
    scans["a canal beside the street"] = replace(
        canal, points=canal.points[dry], height_m=canal.height_m[dry], on_ground=canal.on_ground[dry]
    )
    return scans


@pytest.mark.parametrize("name", WORLDS)
def test_ground_goes_and_structure_stays(scans: dict[str, Any], name: str) -> None:
    scan = scans[name]
    heights = scan_heights(scan.points, HEIGHT_M)
    near = (np.abs(scan.points[:, :2]) < 50).all(axis=1)
    ground = near & scan.on_ground & (np.abs(scan.height_m) < 0.15)  # a canal's wall is neither
    structure = near & ~scan.on_ground & (scan.height_m > 1.0)
    assert np.mean(heights[ground] >= 0.5) < 0.03
    if structure.any():
        assert np.mean(heights[structure] < 0.5) < 0.01
        assert np.median(np.abs(heights - scan.height_m)[structure]) < 0.5


def test_the_slopes_are_out_of_a_flat_filters_reach(scans: dict[str, Any]) -> None:
    """The worlds above mean something: cutting at a height in the base frame fails in them."""
    scan = scans["20 % along the street"]
    near = (np.abs(scan.points[:, :2]) < 50).all(axis=1)
    assert np.mean(scan.points[near & scan.on_ground, 2] >= 0.5) > 0.2
    assert np.mean(scan.points[near & ~scan.on_ground & (scan.height_m > 1), 2] < 0.5) > 0.1


def test_car_roofs_and_walls_are_not_ground(scans: dict[str, Any]) -> None:
    scan = scans["cars all around"]
    heights = scan_heights(scan.points, HEIGHT_M)
    cars = ~scan.on_ground & (np.hypot(scan.points[:, 0], scan.points[:, 1]) < 9) & (scan.height_m > 0.6)
    assert cars.sum() > 1000
    assert np.abs(heights - scan.height_m)[cars].max() < 0.2


def test_a_roof_beside_a_high_sensor_is_not_ground() -> None:
    """A sensor at 2.4 m sees from above the roofs of the cars around it: flat, dense and 1.5 m up."""
    rng = np.random.default_rng(0)
    road = np.column_stack([rng.uniform(-40, 40, 4000), rng.uniform(-2, 2, 4000), rng.normal(0, 0.02, 4000)])
    roofs = np.vstack(
        [np.column_stack([rng.uniform(x, x + 4, 300), side * rng.uniform(3, 5, 300), rng.normal(1.5, 0.02, 300)])
         for x in range(-30, 30, 6) for side in (-1, 1)]
    )  # fmt: skip
    heights = scan_heights(np.vstack([road, roofs]).astype(np.float32), 2.4)
    assert np.abs(heights[:4000]).max() < 0.3
    assert heights[4000:].min() > 1.0


@pytest.mark.parametrize("turn_deg", [31.0, 90.0, 200.0])
def test_rotating_on_the_spot_changes_the_heights_little(scans: dict[str, Any], turn_deg: float) -> None:
    scan = scans["20 % along the street"]
    rotated = Rotation.from_euler("z", turn_deg, degrees=True).apply(scan.points).astype(np.float32)
    difference = scan_heights(rotated, HEIGHT_M) - scan_heights(scan.points, HEIGHT_M)
    near = np.hypot(scan.points[:, 0], scan.points[:, 1]) < 40
    assert np.percentile(np.abs(difference[near]), 95) < 0.25


def test_the_order_of_the_points_changes_nothing(scans: dict[str, Any]) -> None:
    points = scans["hills"].points
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_array_equal(scan_heights(points, HEIGHT_M)[order], scan_heights(points[order], HEIGHT_M))


def test_reflections_below_the_ground_do_not_pull_it_down(scans: dict[str, Any]) -> None:
    scan = scans["a flat street"]
    rng = np.random.default_rng(0)
    below = np.column_stack([rng.uniform(-40, 40, (60, 2)), rng.uniform(-8, -1, 60)])
    cluster = rng.normal((6.0, 1.0, -1.5), 0.2, (40, 3))
    heights = scan_heights(np.vstack([scan.points, below, cluster]).astype(np.float32), HEIGHT_M)[: len(scan.points)]
    near = (np.abs(scan.points[:, :2]) < 50).all(axis=1)
    assert np.mean(heights[near & scan.on_ground] >= 0.5) < 0.03


@pytest.mark.parametrize("error_m", [-0.4, 0.4])
def test_a_mounting_measured_badly_is_forgiven(scans: dict[str, Any], error_m: float) -> None:
    scan = scans["a flat park"]
    heights = scan_heights(scan.points + np.float32([0, 0, error_m]), HEIGHT_M + error_m)
    near = (np.abs(scan.points[:, :2]) < 50).all(axis=1)
    assert np.mean(heights[near & scan.on_ground] >= 0.5) < 0.03


def test_without_ground_in_sight_the_base_stands_on_it() -> None:
    """Only a wall from 1 m up: its height is counted from where the robot stands."""
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(2000, 20.0), rng.uniform(-15, 15, 2000), rng.uniform(1, 6, 2000)])
    heights = scan_heights(wall.astype(np.float32), HEIGHT_M)
    assert np.abs(heights - wall[:, 2]).max() < 0.8


@pytest.mark.parametrize("count", [0, 1, 12])
def test_a_handful_of_points_has_heights(count: int) -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (count, 3)).astype(np.float32)
    heights = scan_heights(points, HEIGHT_M)
    assert heights.shape == (count,) and heights.dtype == np.float32
    assert np.isfinite(heights).all()


def test_hopeless_points_spoil_nothing(scans: dict[str, Any]) -> None:
    points = scans["a lane"].points
    bad = np.array([[np.nan] * 3, [np.inf] * 3, [1e30] * 3, [-1e30] * 3, [0, 0, np.nan], [0, 0, -1e30], [1e30, 0, 0]])
    heights = scan_heights(np.vstack([points, bad]).astype(np.float32), HEIGHT_M)
    np.testing.assert_array_equal(heights[: len(points)], scan_heights(points, HEIGHT_M))
    assert np.isnan(heights[len(points)]) and np.isnan(heights[len(points) + 4])
    assert scan_heights(np.full((100, 3), np.nan, np.float32), HEIGHT_M).shape == (100,)


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(CloudError, match="points_base"):
        scan_heights(np.zeros((4, 2), np.float32), HEIGHT_M)
    with pytest.raises(CloudError, match="sensor_height_m"):
        scan_heights(np.zeros((4, 3), np.float32), float("nan"))


def test_a_scan_takes_a_few_milliseconds(cast: Cast) -> None:
    points = cast(*WORLDS["a courtyard"]).points
    assert len(points) == 28_800
    scan_heights(points, HEIGHT_M)
    seconds = []
    for _ in range(10):
        start = time.thread_time()
        scan_heights(points, HEIGHT_M)
        seconds.append(time.thread_time() - start)
    assert min(seconds) < 0.005
