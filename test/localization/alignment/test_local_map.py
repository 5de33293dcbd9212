"""Scans brought together along odometry: where things stood, what drove by, and what contradicts it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.localization.alignment.evidence import LAYERS, Evidence
from crossloc3d_ros.localization.alignment.local_map import SPACING_M, LocalMap
from crossloc3d_ros.types import Float64Array, Int64Array

LENGTH_M = 30.0
AHEAD = np.array([2.0, 0.0, 0.0])


def town(seed: int) -> Float64Array:
    """Return the middles (400, 2) of cells in which something stands, some 60 m around."""
    rng = np.random.default_rng(seed)
    return np.unique(rng.integers(-60, 60, (400, 2)), axis=0) + 0.5


def seen_from(
    hits: Float64Array, x: float, y: float = 0.0, turns: int = 0, free: Float64Array | None = None
) -> Evidence:
    """Return what stands, and what is free, as a robot has it at (x, y), turned by quarter turns to the left."""
    free = np.empty((0, 2)) if free is None else free
    angle = -turns * math.pi / 2
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    xy = (np.concatenate([hits, free]) - [x, y]) @ rotation.T
    return Evidence(xy, np.repeat([1, LAYERS + 1], [len(hits), len(free)]).astype(np.int64))


def cells(evidence: Evidence) -> set[tuple[int, int, int]]:
    xy: Int64Array = np.floor(evidence.xy_m + 1e-6).astype(np.int64)
    return {(int(x), int(y), int(c)) for (x, y), c in zip(xy, evidence.channel, strict=True)}


def test_a_first_scan_is_all_there_is() -> None:
    scan = seen_from(town(1), 0.0)
    assert LocalMap(LENGTH_M).add(scan) is scan


def test_what_stands_is_in_one_place_however_often_it_was_seen() -> None:
    hits, local_map = town(2), LocalMap(LENGTH_M)
    local_map.add(seen_from(hits, 0.0))
    local_map.move(np.array([10.0, 4.0, math.pi / 2]))
    local_map.add(seen_from(hits, 10.0, 4.0, turns=1))
    local_map.move(np.array([6.0, 0.0, -math.pi / 2]))
    together = local_map.add(seen_from(hits, 10.0, 10.0))
    assert cells(together) == cells(seen_from(hits, 10.0, 10.0))


def test_what_only_the_scans_before_saw_stays() -> None:
    hits, local_map = town(3), LocalMap(LENGTH_M)
    west = hits[hits[:, 0] < 10.0]
    local_map.add(seen_from(west, 0.0))
    local_map.move(AHEAD)
    assert cells(local_map.add(seen_from(hits[hits[:, 0] > -10.0], 2.0))) == cells(seen_from(hits, 2.0))


def test_what_drives_by_does_not_stay() -> None:
    hits, local_map = town(4), LocalMap(LENGTH_M)
    way = np.column_stack([np.arange(-5.0, 15.0) + 0.5, np.full(20, 70.5)])
    for step in range(8):
        if step:
            local_map.move(AHEAD)
        passing, empty = (way[:3], way[3:]) if step == 3 else (way[:0], way)
        together = local_map.add(seen_from(np.concatenate([hits, passing]), 2.0 * step, free=empty))
    assert cells(together) == cells(seen_from(hits, 14.0, free=way))


def test_scans_are_forgotten_after_the_length_and_kept_as_often_as_is_due() -> None:
    local_map, hits = LocalMap(10.0), town(5)
    for step in range(100):
        if step:
            local_map.move(0.25 * AHEAD)
        # Each scan sees one cell of its own, straight ahead.
        own = np.array([[0.5 * step + 30.5, -80.5]])
        together = local_map.add(seen_from(np.concatenate([hits[:60], own]), 0.5 * step))
    assert local_map.extent_m == pytest.approx(10.0, abs=0.5 * SPACING_M)
    of_their_own = [cell for cell in cells(together) if cell[1] == -81]
    assert len(of_their_own) == 10.0 / SPACING_M + 1, "those that are kept, and the newest"


def test_after_unknown_motion_a_scan_stands_for_itself() -> None:
    local_map, hits = LocalMap(LENGTH_M), town(6)
    local_map.add(seen_from(hits, 0.0))
    local_map.move(None)
    scan = seen_from(hits[:50], 0.0)
    assert local_map.add(scan) is scan
    assert local_map.extent_m == 0.0


def test_a_scan_of_another_place_is_not_mixed_with_those_before() -> None:
    """A robot that was carried away, without its odometry knowing."""
    local_map, here, there = LocalMap(LENGTH_M), town(7), town(8)
    ground = np.stack(np.meshgrid(np.arange(-60, 60), np.arange(-60, 60), indexing="ij"), -1).reshape(-1, 2) + 0.5
    for step in range(6):
        local_map.move(AHEAD if step else None)
        local_map.add(seen_from(here, 2.0 * step, free=_without(ground, here)))
    local_map.move(AHEAD)
    scan = seen_from(there, 0.0, free=_without(ground, there))
    assert local_map.add(scan) is scan
    local_map.move(AHEAD)
    assert cells(local_map.add(seen_from(there, 2.0, free=_without(ground, there)))) == cells(
        seen_from(there, 2.0, free=_without(ground, there))
    )


def test_without_a_length_each_scan_stands_for_itself() -> None:
    local_map, hits = LocalMap(0.0), town(9)
    for step in range(4):
        local_map.move(np.zeros(3) if step else None)
        scan = seen_from(hits[: 100 + step], 0.0)
        assert local_map.add(scan) is scan


def test_evidence_stays_within_what_is_prepared_of_a_map() -> None:
    local_map, far = LocalMap(LENGTH_M), np.array([[95.5, 0.5], [-95.5, 0.5]])
    local_map.add(seen_from(far, 0.0))
    local_map.move(np.array([20.0, 0.0, 0.0]))
    assert cells(local_map.add(seen_from(far[:1], 20.0))) == {(75, 0, 1)}


def _without(cells_: Float64Array, some: Float64Array) -> Float64Array:
    taken = {tuple(row) for row in some.tolist()}
    return np.array([row for row in cells_.tolist() if tuple(row) not in taken])
