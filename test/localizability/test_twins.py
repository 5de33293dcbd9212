"""Twin streets: which pairs of places are one, and what is said of them."""

from __future__ import annotations

import math

from crossloc3d_ros.localizability.driving import DrivenPlace, Rival
from crossloc3d_ros.localizability.raster import NEVER, distance_class
from crossloc3d_ros.localizability.twins import twins_of


def place(easting: float, *rivals: tuple[float, float], localized_m: float = math.inf) -> DrivenPlace:
    return DrivenPlace(
        easting, 0.0, 0.0, False, 0.0, tuple(Rival(x, 0.0, p) for x, p in rivals), localized_m, had_wrong_fix=False
    )


def test_pairs_with_near_ends_are_one_and_the_likeliest_is_told() -> None:
    twins = twins_of([place(0.0, (500.0, 0.3)), place(10.0, (510.0, 0.6), (900.0, 0.1))])
    assert [(twin.probability, twin.scans, twin.is_mutual) for twin in twins] == [(0.6, 2, False), (0.1, 1, False)]
    assert twins[0].here == (10.0, 0.0) and twins[0].there == (510.0, 0.0) and twins[0].apart_m == 500.0


def test_a_pair_is_mutual_where_scans_at_both_ends_are_taken_for_the_other() -> None:
    (twin,) = twins_of([place(0.0, (500.0, 0.3)), place(505.0, (5.0, 0.2))])
    assert twin.is_mutual and twin.scans == 2


def test_a_place_beside_itself_is_no_twin() -> None:
    assert twins_of([place(0.0, (15.0, 0.9))]) == []


def test_distances_have_four_classes() -> None:
    classes = [distance_class(place(0.0, localized_m=metres)) for metres in (0.0, 12.0, 20.0, 20.1, 100.0, math.inf)]
    assert classes == [0.0, 20.0, 20.0, 100.0, 100.0, NEVER]
