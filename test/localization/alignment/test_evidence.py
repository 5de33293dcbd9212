"""Evidence: every beam followed one at a time, in plain Python."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.localization.alignment.evidence import (
    CELL_M,
    CHANNELS,
    LAYERS,
    LAYERS_M,
    REACH_M,
    Evidence,
    evidence_of,
)
from crossloc3d_ros.types import Float32Array

Seen = set[tuple[int, float, float]]


def seen_by(evidence: Evidence) -> Seen:
    return {(int(c), float(x), float(y)) for c, (x, y) in zip(evidence.channel, evidence.xy_m, strict=True)}


def cell_of(x: float, y: float) -> tuple[float, float]:
    return (math.floor(x / CELL_M) + 0.5) * CELL_M, (math.floor(y / CELL_M) + 0.5) * CELL_M


def layer_of(height: float) -> int | None:
    layers = [i for i in range(LAYERS) if LAYERS_M[i] <= height < LAYERS_M[i + 1]]
    return layers[0] if layers else None


def traced(place: Float32Array, sensor_height: float) -> Seen:
    """Follow each beam in steps of a cell up to the last metre before its end."""
    hits: Seen = set()
    free: Seen = set()
    for x, y, z in place.astype(float):
        away = math.hypot(x, y)
        step = 1
        while away >= 1.0 and step <= away - 1.0:
            share = step / away
            layer = layer_of(sensor_height + share * (z - sensor_height))
            cell = cell_of(share * x, share * y)
            if layer is not None and max(abs(cell[0]), abs(cell[1])) < REACH_M:
                free.add((LAYERS + layer, *cell))
            step += 1
        layer = layer_of(z)
        if layer is not None and away >= 1.0 and max(abs(x), abs(y)) < REACH_M:
            hits.add((layer, *cell_of(x, y)))
    return hits | {(c, x, y) for c, x, y in free if (c - LAYERS, x, y) not in hits}


@pytest.mark.parametrize("sensor_height", [0.3, 1.2, 2.9])
def test_evidence_is_what_each_beam_hit_and_passed_through(sensor_height: float) -> None:
    rng = np.random.default_rng(3)
    angle, away = rng.uniform(0, 2 * np.pi, 300), rng.uniform(0.2, 99.0, 300)
    place = np.column_stack([away * np.cos(angle), away * np.sin(angle), rng.uniform(-1.0, 14.0, 300)])
    place = place.astype(np.float32)
    found, expected = seen_by(evidence_of(place, sensor_height)), traced(place, sensor_height)
    # A step that ends on the border of two cells or layers may be rounded to either.
    assert len(found ^ expected) <= 0.002 * len(expected)
    assert {c for c, _, _ in expected} == set(range(CHANNELS))


def test_the_last_metre_and_the_cell_of_a_hit_are_not_free() -> None:
    evidence = evidence_of(np.array([[10.5, 0.5, 1.2]], np.float32), 1.2)
    hits, free = evidence.channel < LAYERS, evidence.channel >= LAYERS
    assert evidence.xy_m[hits].tolist() == [[10.5, 0.5]]
    assert evidence.channel[hits].tolist() == [0]
    assert sorted(evidence.xy_m[free, 0]) == [0.5 + i for i in range(9)]
    assert set(evidence.channel[free]) == {LAYERS}
    wall = np.array([[10.5, 0.5, 1.2], [40.5, 0.7, 1.2]], np.float32)  # another beam passes through the same cell
    both = evidence_of(wall, 1.2)
    assert not (both.xy_m[both.channel == LAYERS] == [10.5, 0.5]).all(axis=1).any(), "a cell that was hit is not free"


def test_what_is_no_place_says_nothing() -> None:
    nan = float("nan")
    bad = [[nan, 1, 1], [1, nan, 1], [5, 5, nan], [math.inf, 5, 1], [5, 5, math.inf], [0.1, 0.2, 1.0], [3e8, 0, 2.0]]
    assert len(evidence_of(np.array(bad, np.float32), 1.2)) == 0
    assert len(evidence_of(np.empty((0, 3), np.float32), 1.2)) == 0
    below = np.array([[20.0, 0.0, 0.2], [0.0, 30.0, 60.0]], np.float32)
    assert (evidence_of(below, 1.2).channel >= LAYERS).all(), "the ground and the sky are no hits"


def test_the_sensor_s_place_on_the_base_moves_the_evidence() -> None:
    rng = np.random.default_rng(4)
    place = np.column_stack([rng.uniform(-40, 40, (200, 2)), rng.uniform(0, 9, 200)]).astype(np.float32)
    plain, moved = evidence_of(place, 1.2), evidence_of(place, 1.2, (0.7, -2.3))
    np.testing.assert_array_equal(moved.channel, plain.channel)
    np.testing.assert_allclose(moved.xy_m - plain.xy_m, np.tile([0.7, -2.3], (len(plain), 1)))


def test_no_evidence_lies_farther_from_the_base_than_maps_are_prepared_for() -> None:
    far = [[x, y, 2.0] for x in (-99.0, 99.0) for y in (-99.0, 99.0)] + [[95.0, 0.0, 2.0]]
    evidence = evidence_of(np.array(far, np.float32), 1.2, (20.0, 20.0))
    assert len(evidence)
    assert np.hypot(*evidence.xy_m.T).max() <= REACH_M + CELL_M


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_a_turned_scan_gives_turned_evidence(box_town: Any, quarter: int) -> None:
    place = box_town.place(140.0, 140.0, 0.4)
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
    R = np.array([[c, -s], [s, c]], float)
    turned = place.copy()
    turned[:, :2] = place[:, :2] @ R.T
    straight, found = evidence_of(place, 1.3), seen_by(evidence_of(turned, 1.3))
    expected = seen_by(Evidence(straight.xy_m @ R.T, straight.channel))
    assert len(found ^ expected) <= 0.005 * len(expected)


def coarse_by_hand(evidence: Evidence, cell_m: float) -> Seen:
    """Collect cells of `cell_m`, and blocks of 2 x 2 of them of which half or more were passed through."""
    hits: Seen = set()
    passed: dict[tuple[int, int, int], set[tuple[int, int]]] = {}
    for channel, (x, y) in zip(evidence.channel, evidence.xy_m, strict=True):
        column, row = math.floor(x / cell_m), math.floor(y / cell_m)
        if channel < LAYERS:
            hits.add((int(channel), (column + 0.5) * cell_m, (row + 0.5) * cell_m))
        else:
            passed.setdefault((int(channel), column // 2, row // 2), set()).add((column, row))
    blocks = {(c, (2 * u + 1) * cell_m, (2 * v + 1) * cell_m) for (c, u, v), cells in passed.items() if len(cells) >= 2}
    return hits | blocks


@pytest.mark.parametrize("cell_m", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("sensor_xy", [(0.0, 0.0), (0.6, -1.7)])
def test_coarser_evidence_is_that_of_the_blocks(box_town: Any, cell_m: float, sensor_xy: tuple[float, float]) -> None:
    evidence = evidence_of(box_town.place(130.0, 150.0, 1.0), 1.3, sensor_xy)
    assert seen_by(evidence.coarser(cell_m, 10**6, 10**6)) == coarse_by_hand(evidence, cell_m)


def test_so_many_are_drawn_as_asked_for_and_always_the_same(box_town: Any) -> None:
    evidence = evidence_of(box_town.place(130.0, 150.0, 1.0), 1.3)
    for fewer, most in ((evidence.sample(50, 70), evidence), (evidence.coarser(2.0, 50, 70), None)):
        assert (fewer.channel < LAYERS).sum() == 50
        assert (fewer.channel >= LAYERS).sum() == 70
        assert most is None or seen_by(fewer) <= seen_by(most)
        assert len(seen_by(fewer)) == 120, "each once"
    again = evidence.sample(50, 70)
    np.testing.assert_array_equal(again.xy_m, evidence.sample(50, 70).xy_m)
    everything = evidence.sample(10**6, 10**6)
    np.testing.assert_array_equal(np.sort(everything.channel), np.sort(evidence.channel))
    np.testing.assert_array_equal(evidence.counts(), [(evidence.channel == c).sum() for c in range(CHANNELS)])
