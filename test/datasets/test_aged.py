"""Aged towns: as many things gone as asked for, all others where they were."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.datasets.aged import aged
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.town import Town, make_town


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(990_201, "suburb", 200.0)


def test_houses_and_trees_go_and_nothing_else(town: Town) -> None:
    older = aged(town, 1, trees_gone=0.5, houses_gone=0.2)
    before, after = (np.bincount(world.scene.labels, minlength=6) for world in (town, older))
    assert 0.35 < 1 - after[Label.VEGETATION] / before[Label.VEGETATION] < 0.65
    assert 0.05 < 1 - after[Label.BUILDING] / before[Label.BUILDING] < 0.4
    for label in (Label.GROUND, Label.STRUCTURE, Label.WATER):
        assert after[label] == before[label]
    np.testing.assert_array_equal(older.clearance.values, town.clearance.values)


def test_a_house_goes_as_a_whole(town: Town) -> None:
    """No vertex of a house that stays has lost a face."""
    older = aged(town, 1, trees_gone=0.0, houses_gone=0.4)

    def faces_at_vertices(world: Town) -> np.ndarray:
        houses = world.scene.faces[world.scene.labels == Label.BUILDING]
        return np.bincount(houses.ravel(), minlength=len(world.scene.vertices))

    before, after = faces_at_vertices(town), faces_at_vertices(older)
    assert (after < before).any()
    assert ((after == before) | (after == 0)).all()


def test_the_seed_decides_and_nothing_goes_where_nothing_shall(town: Town) -> None:
    np.testing.assert_array_equal(aged(town, 4).scene.faces, aged(town, 4).scene.faces)
    assert not np.array_equal(aged(town, 4).scene.faces, aged(town, 5).scene.faces)
    np.testing.assert_array_equal(aged(town, 4, 0.0, 0.0).scene.faces, town.scene.faces)
