"""Submaps: a global grid of centres and patches that do not depend on how they were cut."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.clouds.patch import make_patch
from crossloc3d_ros.clouds.tiling import SubmapCutter, cut_submap, submap_centres
from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.errors import CloudError

CONFIG = PreprocessingConfig()
WEST, SOUTH = 628_416.0, 5_803_008.0
Points = npt.NDArray[np.float64]


def a_tile(side: float = 300.0, density: float = 2.0, seed: int = 0) -> Points:
    """Random towers on a grid of 1/64 m, so that sums and differences are exact."""
    rng = np.random.default_rng(seed)
    count = int(side * side * density)
    points = np.column_stack([rng.uniform(0, side, (count, 2)), rng.gamma(1.5, 4.0, count) - 1.0])
    return np.round(points * 64) / 64 + [WEST, SOUTH, 0]


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(1.0, 500.0), st.floats(1.0, 400.0))
@settings(max_examples=60, deadline=None)
def test_tiles_that_share_an_edge_share_no_centre_and_miss_none(
    west: float, south: float, side: float, cut: float
) -> None:
    spacing = 19.0
    whole = submap_centres((west, south, west + side, south + side), spacing)
    middle = min(west + cut, west + side)
    parts = [
        submap_centres((west, south, middle, south + side), spacing),
        submap_centres((middle, south, west + side, south + side), spacing),
    ]
    together = np.vstack(parts)
    assert {tuple(c) for c in whole} == {tuple(c) for c in together}
    assert len(together) == len(whole)
    np.testing.assert_array_equal(whole / spacing, np.round(whole / spacing))
    inside = (whole >= [west, south]) & (whole < [west + side, south + side])
    assert inside.all()


def test_every_multiple_inside_is_a_centre() -> None:
    centres = submap_centres((-20.0, 0.0, 39.0, 38.0), 19.0)
    assert sorted(map(tuple, centres)) == [(e, n) for e in (-19.0, 0.0, 19.0, 38.0) for n in (0.0, 19.0)]
    assert submap_centres((1.0, 1.0, 18.0, 500.0), 19.0).shape == (0, 2)


@pytest.mark.parametrize("bounds", [(0, 0, np.nan, 1), (0, 0, np.inf, 1)])
def test_bounds_must_be_finite(bounds: tuple[float, float, float, float]) -> None:
    with pytest.raises(CloudError, match="span"):
        submap_centres(bounds, 19.0)


@pytest.mark.parametrize("config", [CONFIG, replace(CONFIG, submap_origin="bounding_box", ground_clearance_m=0.0)])
def test_the_cutter_and_the_single_cut_agree_everywhere(config: PreprocessingConfig) -> None:
    points = a_tile()
    cutter = SubmapCutter(points, config)
    centres = submap_centres((WEST - 100, SOUTH - 100, WEST + 400, SOUTH + 400), 57.0)
    patches = [(cutter.cut(c), cut_submap(points, c, config)) for c in centres]
    assert any(a is None for a, _ in patches) and any(a is not None for a, _ in patches)
    for a, b in patches:
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            np.testing.assert_array_equal(a.points, b.points)
            assert a.source_count == b.source_count


def test_a_submap_is_the_patch_of_its_square() -> None:
    points = a_tile()
    centre = np.array([WEST + 150.0, SOUTH + 150.0])
    around = points - [*centre, 0.0]
    oracle = make_patch(around[(np.abs(around[:, :2]) <= 50).all(axis=1)].astype(np.float32), 50.0, CONFIG)
    patch = SubmapCutter(points, CONFIG).cut(centre)
    assert patch is not None and oracle is not None
    np.testing.assert_array_equal(patch.points, oracle.points)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (-WEST, -SOUTH), (1e6, 3e6)])
def test_where_on_earth_the_tile_lies_changes_nothing(offset: tuple[float, float]) -> None:
    points = a_tile(150.0)
    centre = np.array([WEST + 75.0, SOUTH + 75.0])
    here = SubmapCutter(points, CONFIG).cut(centre)
    there = SubmapCutter(points + np.array([*offset, 0.0]), CONFIG).cut(centre + offset)
    assert here is not None and there is not None
    np.testing.assert_array_equal(here.points, there.points)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_stray_points_change_nothing(bad: float) -> None:
    points = a_tile(150.0)
    spoilt = np.vstack([points, [[bad, SOUTH, 3.0], [WEST, bad, 3.0], [WEST + 75, SOUTH + 75, bad]]])
    centre = np.array([WEST + 75.0, SOUTH + 75.0])
    clean, dirty = SubmapCutter(points, CONFIG).cut(centre), SubmapCutter(spoilt, CONFIG).cut(centre)
    assert clean is not None and dirty is not None
    np.testing.assert_array_equal(clean.points, dirty.points)


@pytest.mark.parametrize("count", [0, 12])
def test_a_tile_without_points_has_no_patches(count: int) -> None:
    points = a_tile()[:count]
    assert SubmapCutter(points, CONFIG).cut((WEST, SOUTH)) is None
    assert cut_submap(points, (WEST, SOUTH), CONFIG) is None


def test_a_centre_is_two_finite_numbers() -> None:
    cutter = SubmapCutter(a_tile(20.0), CONFIG)
    for centre in ((1.0, np.nan), (1.0, 2.0, 3.0)):
        with pytest.raises(CloudError, match="centre"):
            cutter.cut(centre)


def test_a_submap_takes_a_few_milliseconds() -> None:
    cutter = SubmapCutter(a_tile(300.0, density=4.0), CONFIG)
    centres = submap_centres((WEST + 50, SOUTH + 50, WEST + 250, SOUTH + 250), 19.0)
    cutter.cut(centres[0])
    seconds = []
    for centre in centres[:40]:
        start = time.thread_time()
        assert cutter.cut(centre) is not None
        seconds.append(time.thread_time() - start)
    assert min(seconds) < 0.005
