"""The one normalisation: what goes in, what comes out, and that order and repetition change nothing."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.clouds.patch import make_patch
from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.errors import CloudError

CONFIG = PreprocessingConfig()
Cloud = npt.NDArray[np.float32]


def a_place(count: int = 30_000, seed: int = 0, half: float = 60.0) -> Cloud:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-half, half, (count, 2)), rng.gamma(2.0, 4.0, count) - 1.0])
    return points.astype(np.float32)


def rows(points: Cloud) -> set[bytes]:
    return {p.tobytes() for p in np.ascontiguousarray(points)}


@given(st.integers(0, 2**32 - 1), st.integers(300, 20_000))
@settings(max_examples=20, deadline=None)
def test_a_patch_has_exactly_n_points_of_the_input_in_the_unit_box(seed: int, count: int) -> None:
    points = a_place(count, seed)
    patch = make_patch(points, 64.0, replace(CONFIG, half_extent_m=64.0))
    if patch is None:
        return
    assert patch.points.shape == (4096, 3)
    assert patch.points.dtype == np.float32
    assert np.abs(patch.points).max() <= 1.0
    assert patch.points[:, 2].min() >= np.float32(0.5 / 64)
    assert rows(patch.points * np.float32(64)) <= rows(points)  # 64 is a power of two: exact


def test_the_order_of_the_points_changes_nothing() -> None:
    points = a_place()
    points[:500] = points[500:1000]  # duplicates too
    first = make_patch(points, 50.0, CONFIG)
    second = make_patch(points[np.random.default_rng(1).permutation(len(points))], 50.0, CONFIG)
    assert first is not None and second is not None
    np.testing.assert_array_equal(first.points, second.points)
    assert first.source_count == second.source_count


def test_the_seed_decides_and_nothing_else_is_random() -> None:
    points = a_place()
    a, b, c = (make_patch(points, 50.0, replace(CONFIG, seed=s)) for s in (7, 7, 8))
    assert a is not None and b is not None and c is not None
    np.testing.assert_array_equal(a.points, b.points)
    shared = len(rows(a.points) & rows(c.points)) / 4096
    assert shared < 0.9


def test_one_point_a_cube_and_every_cube_while_there_is_room() -> None:
    points = a_place(60_000, half=20.0)
    patch = make_patch(points, 64.0, replace(CONFIG, n_points=100_000, thin_m=2.0))
    assert patch is not None
    inside = points[(points[:, 2] >= 0.5) & (points[:, 2] <= 64.0)]
    cubes = {tuple(c) for c in np.floor(inside / 2.0).astype(int)}
    taken = np.unique(patch.points, axis=0) * 64
    taken_cubes = [tuple(c) for c in np.floor(taken / 2.0).astype(int)]
    assert len(set(taken_cubes)) == len(taken_cubes)
    assert set(taken_cubes) == cubes
    assert patch.source_count == len(cubes)


@given(st.integers(20, 200), st.floats(0.0, 3.0))
@settings(max_examples=20, deadline=None)
def test_few_points_are_repeated_evenly(count: int, thin: float) -> None:
    points = a_place(400)
    points = points[points[:, 2] > 0.6][:count]
    patch = make_patch(points, 64.0, replace(CONFIG, min_points=1, n_points=1000, thin_m=thin))
    assert patch is not None
    _, times = np.unique(patch.points, axis=0, return_counts=True)
    assert len(times) == patch.source_count
    assert times.max() - times.min() <= 1
    assert times.sum() == 1000


def test_far_structure_survives_a_dense_neighbourhood() -> None:
    rng = np.random.default_rng(0)
    near = rng.uniform((-5, -5, 1), (5, 5, 4), (60_000, 3))
    wall = np.column_stack([np.full(1200, 45.0), rng.uniform(-45, 45, 1200), rng.uniform(1, 8, 1200)])
    points = np.vstack([near, wall]).astype(np.float32)
    patch = make_patch(points, 50.0, CONFIG)
    assert patch is not None
    # 2 % of the points; thinned the wall holds about a fifth of the occupied cubes, and it must get its share.
    assert np.mean(patch.points[:, 0] > 0.85) > 0.2


def test_without_thinning_the_choice_follows_the_density() -> None:
    rng = np.random.default_rng(0)
    near = rng.uniform((-5, -5, 1), (5, 5, 4), (30_000, 3))
    far = rng.uniform((30, -5, 1), (40, 5, 4), (10_000, 3))
    patch = make_patch(np.vstack([near, far]).astype(np.float32), 50.0, replace(CONFIG, thin_m=0.0))
    assert patch is not None
    assert np.mean(patch.points[:, 0] > 0.3) == pytest.approx(0.25, abs=0.03)  # 4 sigma of 4,096 draws
    assert len(np.unique(patch.points, axis=0)) == 4096


def test_cubes_too_fine_for_the_key_thin_nothing() -> None:
    points = a_place()
    fine = make_patch(points, 50.0, replace(CONFIG, thin_m=1e-6))
    none = make_patch(points, 50.0, replace(CONFIG, thin_m=0.0))
    assert fine is not None and none is not None
    np.testing.assert_array_equal(fine.points, none.points)


@pytest.mark.parametrize("height", [-3.0, 0.0, 0.49])
def test_the_ground_is_left_out(height: float) -> None:
    points = a_place()
    points[:, 2] = height
    assert make_patch(points, 50.0, CONFIG) is None


def test_no_clearance_keeps_the_ground() -> None:
    points = a_place()
    points[:, 2] = -0.05
    patch = make_patch(points, 50.0, replace(CONFIG, ground_clearance_m=0.0))
    assert patch is not None
    assert (patch.points[:, 2] < 0).all()


def test_min_points_is_the_border_of_a_patch() -> None:
    points = a_place(400)
    points = points[points[:, 2] > 0.5]
    points = points[(np.abs(points[:, :2]) < 50).all(axis=1)]
    assert make_patch(points, 50.0, replace(CONFIG, min_points=len(points))) is not None
    assert make_patch(points, 50.0, replace(CONFIG, min_points=len(points) + 1)) is None


@pytest.mark.parametrize("count", [0, 12])
def test_hardly_any_points_give_no_patch(count: int) -> None:
    assert make_patch(a_place(count), 50.0, CONFIG) is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30, -1e30])
def test_hopeless_points_are_dropped_and_change_nothing(bad: float) -> None:
    points = a_place()
    spoilt = np.vstack([points, np.full((50, 3), bad), [[0, 0, bad], [bad, 0, 3]]]).astype(np.float32)
    first, second = make_patch(points, 50.0, CONFIG), make_patch(spoilt, 50.0, CONFIG)
    assert first is not None and second is not None
    np.testing.assert_array_equal(first.points, second.points)
    assert make_patch(np.full((5000, 3), bad, np.float32), 50.0, CONFIG) is None


def test_bounding_box_origin_centres_the_box() -> None:
    points = a_place(half=20.0) + np.float32([7, -4, 0])
    patch = make_patch(points, 50.0, replace(CONFIG, n_points=60_000, thin_m=0.0), origin="bounding_box")
    assert patch is not None
    middle = (patch.points.max(axis=0) + patch.points.min(axis=0)) / 2
    np.testing.assert_allclose(middle[:2], 0, atol=1e-6)
    assert patch.points[:, 2].min() >= np.float32(0.5 / 50)  # heights stay heights


def test_mean_origin_centres_the_mean_and_ignores_where_it_was() -> None:
    points = np.round(a_place(half=10.0) * 64) / 64
    config = replace(CONFIG, n_points=60_000, thin_m=0.0, vertical_origin="centre")
    first = make_patch(points, 50.0, config, origin="mean")
    second = make_patch(points + np.float32([8, -16, 0]), 50.0, config, origin="mean")
    assert first is not None and second is not None
    inside = np.unique(first.points, axis=0)
    np.testing.assert_allclose(inside.mean(axis=0), 0, atol=1e-3)
    np.testing.assert_allclose(np.unique(second.points, axis=0), inside, atol=1e-5)


def test_vertical_centre_halves_the_heights_about_zero() -> None:
    patch = make_patch(a_place(), 50.0, replace(CONFIG, vertical_origin="centre", n_points=60_000, thin_m=0.0))
    assert patch is not None
    assert patch.points[:, 2].max() == pytest.approx(-patch.points[:, 2].min(), abs=1e-6)


@pytest.mark.parametrize("points", [np.zeros((5, 4), np.float32), np.zeros((5, 3), np.int64)])
def test_a_wrong_shape_or_type_is_refused(points: np.ndarray) -> None:
    with pytest.raises(CloudError, match="points must"):
        make_patch(points, 50.0, CONFIG)


def test_thirty_thousand_points_take_a_few_milliseconds() -> None:
    points = a_place()
    make_patch(points, 50.0, CONFIG)
    seconds = []
    for _ in range(10):
        start = time.thread_time()
        make_patch(points, 50.0, CONFIG)
        seconds.append(time.thread_time() - start)
    assert min(seconds) < 0.005
