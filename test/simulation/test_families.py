"""What the families' towns are made of."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from crossloc3d_ros.simulation.families import FAMILIES, draw_block
from crossloc3d_ros.simulation.layout import Belt, Plan, Rect, draw_belt
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.survey import SurveyConfig, fly
from crossloc3d_ros.simulation.town import Town, make_town

BELT = FAMILIES["canal_town"].belt or Belt((1, 1), (1, 1), (1, 1), (1, 1), (1, 1), 0, 0)


@pytest.fixture(scope="module")
def canals() -> Town:
    return make_town(12, "canal_town", 300.0)


def overlap(a: Rect, b: Rect) -> float:
    wide, high = min(a.u1, b.u1) - max(a.u0, b.u0), min(a.v1, b.v1) - max(a.v0, b.v0)
    return max(wide, 0.0) * max(high, 0.0)


def from_above(town: Town, spacing: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return label and height over the ground of what lies at each place of a grid."""
    x = np.arange(-0.5 * (town.bounds.max_x - 20), 0.5 * (town.bounds.max_x - 20), spacing)
    origins = np.stack([*(g.ravel() for g in np.meshgrid(x, x)), np.full(len(x) ** 2, 300.0)], -1).astype(np.float32)
    hits = town.scene.cast(origins, np.tile(np.float32([[0, 0, -1]]), (len(origins), 1)))
    height = 300.0 - hits.distance_m - town.terrain_height(origins[:, :2])
    return hits.label.reshape(len(x), -1), height.reshape(len(x), -1)


@pytest.mark.parametrize("seed", range(6))
def test_a_belt_has_canals_of_the_width_asked_for_and_nothing_is_built_on_them(seed: int) -> None:
    belt = BELT._replace(broad=0.0)
    extent = Rect(-300.0, -300.0, 300.0, 300.0)
    blocks, streets = draw_belt(extent, belt, np.random.default_rng(seed))
    canals = [street for street in streets if street.quay_m > 0]
    assert len(canals) >= 4 and len(blocks) > 10
    for canal in canals:
        water = canal.width - 2 * canal.quay_m
        assert belt.water_m[0] <= water <= belt.water_m[1]
        assert belt.quay_m[0] <= canal.quay_m <= belt.quay_m[1]
    for block in blocks:
        assert block.width > 0 and block.height > 0
        assert max(overlap(block, street.rect) for street in streets) < 1e-6
    for i, block in enumerate(blocks):
        assert max((overlap(block, other) for other in blocks[i + 1 :]), default=0.0) < 1e-6


def test_canals_are_water_with_boats_on_it(canals: Town) -> None:
    label, height = from_above(canals)
    assert 0.05 < (label == Label.WATER).mean() < 0.5
    afloat = ndimage.binary_closing(label == Label.WATER, iterations=4) & (label == Label.STRUCTURE)
    assert afloat.sum() > 50
    assert np.median(height[afloat]) < 2.5


def test_bridges_join_the_quarters(canals: Town) -> None:
    """From the largest piece of ground a robot gets nearly everywhere, across the water too."""
    regions, _ = ndimage.label((canals.clearance.values >= 1.0) & (canals.preference.values > 0))
    sizes = np.bincount(regions.ravel())[1:]
    assert sizes.max() > 0.7 * sizes.sum()


def test_water_answers_an_aerial_survey_seldom(canals: Town) -> None:
    survey = fly(canals, SurveyConfig(spacing_m=0.7), np.random.default_rng(0))
    label, _ = from_above(canals)
    side = canals.bounds.max_x - canals.bounds.min_x
    water_m2 = (label == Label.WATER).mean() * side**2
    ground_m2 = (label == Label.GROUND).mean() * side**2
    density = np.array([(survey.classification == 9).sum() / water_m2, (survey.classification == 2).sum() / ground_m2])
    assert 0 < density[0] < 0.2 * density[1]


def test_what_is_turned_keeps_its_shape() -> None:
    plain, turned = Plan(), Plan()
    for plan, angle in ((plain, 0.0), (turned, 0.7)):
        plan.wing(plan.owner(0.0, 0.0), Rect(0.0, 0.0, 1.0, 1.0), 3.0)
        with plan.turned((10.0, 5.0), angle):
            plan.wing(plan.owner(12.0, 6.0), Rect(11.0, 4.0, 15.0, 7.0), 4.0)
            plan.tree(8.0, 2.0, np.random.default_rng(0))
            plan.poles.append((9.0, 9.0, 5.0, 0.1, 0.1, 4.0))
            plan.cars.append((6.0, 6.0, 0.2, 0.5, 0.5))
    assert plain.wings[0] == turned.wings[0]  # drawn before
    corners, moved = (np.array(plan.wings[1][:8]).reshape(4, 2) for plan in (plain, turned))
    matrix = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    np.testing.assert_allclose(moved, (corners - [10, 5]) @ matrix.T + [10, 5])
    for name in ("anchors", "trees", "poles", "cars"):
        before, after = (np.array(getattr(plan, name)[-1]) for plan in (plain, turned))
        np.testing.assert_allclose(after[:2], (before[:2] - [10, 5]) @ matrix.T + [10, 5])
    assert turned.cars[0][2] == pytest.approx(0.9)
    assert plain.wings[1][9:] == turned.wings[1][9:]


def test_a_robot_may_stand_under_an_arcade() -> None:
    """Somewhere in these towns there is a building overhead and room below it."""
    under = 0
    for seed in (1, 2, 3):
        town = make_town(seed, "campus", 300.0)
        poses = town.sample_poses(4000, np.random.default_rng(0))
        above = (poses[:, :3, 3] + [0.0, 0.0, 1.0]).astype(np.float32)
        up = town.scene.cast(above, np.tile(np.float32([[0, 0, 1]]), (4000, 1)))
        hung = up.label == Label.BUILDING
        assert (up.distance_m[hung] > 1.0).all()
        under += int(hung.sum())
    assert under > 0


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_every_kind_of_block_that_a_family_names_can_be_drawn(family: str) -> None:
    """On blocks of any size, also on smaller ones than most towns have."""
    for kind in FAMILIES[family].blocks:
        for seed in range(40):
            rng, plan = np.random.default_rng(seed), Plan()
            wide, high = rng.uniform(10.0, 150.0, 2)
            draw_block(kind, plan, Rect(0.0, 0.0, wide, high), rng)
            heights = np.array([row[9:11] for row in plan.wings]).reshape(-1, 2)
            assert (heights[:, 1] >= heights[:, 0]).all() and heights.max(initial=0.0) < 180.0
