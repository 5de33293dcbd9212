"""Areas: what one sees, no other sees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.training.areas import NONE, TEST, TRAINING, VALIDATION, Areas, cut_areas

PLACES = st.lists(st.tuples(st.floats(0, 2000), st.floats(0, 1500)), min_size=2, max_size=60).map(np.array)
SHARES = {TRAINING: 0.7, VALIDATION: 0.1, TEST: 0.2}


def overlap(a: np.ndarray, reach_a: float, b: np.ndarray, reach_b: float) -> bool:
    """Return whether two squares have some ground in common."""
    return bool((np.abs(a - b) < reach_a + reach_b - 1e-6).all())


@settings(deadline=None)
@given(PLACES, st.floats(1, 200), st.floats(1, 200), st.randoms(use_true_random=False))
def test_places_of_two_areas_never_see_the_same_ground(places, reach, other_reach, random) -> None:  # type: ignore[no-untyped-def]
    corners = [sorted(random.uniform(0, 2000) for _ in range(2)) for _ in range(4)]
    boxes = []
    for role, x, y in ((TEST, corners[0], corners[1]), (VALIDATION, corners[2], corners[3])):
        boxes.append((role, (x[0], y[0], x[1] + 1.0, y[1] + 1.0)))
    try:
        areas = Areas(tuple(boxes))
    except DatasetError:
        assume(False)
    roles, other_roles = areas.roles(places, reach), areas.roles(places, other_reach)
    for i, role in enumerate(roles):
        for j, other in enumerate(other_roles):
            if NONE not in (role, other) and role != other:
                assert not overlap(places[i], reach, places[j], other_reach)


@settings(max_examples=40, deadline=None)
@given(PLACES, st.floats(1, 150), st.floats(0.1, 0.4), st.floats(0.1, 0.4))
def test_cut_areas_are_apart_and_none_is_empty(places, reach, validation, test) -> None:  # type: ignore[no-untyped-def]
    shares = {TRAINING: 1.0 - validation - test, VALIDATION: validation, TEST: test}
    try:
        areas = cut_areas(places, reach, shares)
    except DatasetError as error:
        assert f"{2 * reach:.0f} m apart" in str(error)
        return
    roles = areas.roles(places, reach)
    for role in shares:
        assert (roles == role).any()
    for i, j in zip(*np.triu_indices(len(places)), strict=True):
        if NONE not in (roles[i], roles[j]) and roles[i] != roles[j]:
            assert not overlap(places[i], reach, places[j], reach)


def test_a_long_drive_is_cut_by_its_shares() -> None:
    places = np.column_stack([np.linspace(0, 10_000, 1000), np.zeros(1000)])
    roles = cut_areas(places, 70.0, SHARES).roles(places, 70.0)
    for role, share in SHARES.items():
        assert (roles == role).mean() == pytest.approx(share, abs=0.04)


def test_an_area_without_a_share_is_not_cut() -> None:
    places = np.column_stack([np.linspace(0, 1000, 100), np.zeros(100)])
    areas = cut_areas(places, 50.0, {TRAINING: 0.8, VALIDATION: 0.0, TEST: 0.2})
    assert {role for role, _ in areas.boxes} == {TEST}
    assert Areas(()).roles(places, 50.0).tolist() == [TRAINING] * 100


def test_too_short_a_drive_is_refused_saying_how_far_areas_lie_apart() -> None:
    places = np.column_stack([np.linspace(0, 100, 50), np.zeros(50)])
    with pytest.raises(DatasetError, match=r"50 scans over 100 x 0 m .*that are 141 m apart.*share of 0"):
        cut_areas(places, 50.0 * math.sqrt(2.0), SHARES)
    with pytest.raises(DatasetError, match="0 scans"):
        cut_areas(np.empty((0, 2)), 10.0, SHARES)


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        (((TEST, (0.0, 0.0, 0.0, 5.0)),), "no rectangle"),
        (((TEST, (0.0, 0.0, 5.0, math.nan)),), "no rectangle"),
        (((TEST, (0.0, 0.0, 5.0, 5.0)), (VALIDATION, (4.0, 4.0, 9.0, 9.0))), "overlap"),
        (((TRAINING, (0.0, 0.0, 5.0, 5.0)),), "no rectangle"),
    ],
)
def test_areas_that_are_none_are_refused(boxes, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DatasetError, match=message):
        Areas(boxes)


def test_rectangles_that_touch_do_not_overlap_and_open_borders_become_null() -> None:
    areas = Areas(((TEST, (-math.inf, -math.inf, 5.0, math.inf)), (VALIDATION, (5.0, 0.0, 9.0, 9.0))))
    assert areas.to_json()[0] == {"role": TEST, "west_south_east_north": [None, None, 5.0, None]}
