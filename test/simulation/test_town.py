"""Towns: the same from the same seed, changed a little by time, and with room to drive."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.simulation.families import FAMILIES, FAMILIES_BY_SEED, HELD_OUT_FAMILIES, TRAINING_FAMILIES
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.town import Town, make_town

DOWN = np.float32([[0, 0, -1]])


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(11, "suburb", 240.0)


def test_a_seed_makes_the_same_town_in_another_process(town: Town) -> None:
    program = "from crossloc3d_ros.simulation.town import make_town; print(make_town(11, 'suburb', 240.0).digest())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=120)
    assert done.stdout.strip().splitlines()[-1] == town.digest()


FROZEN = {
    ("canal_town", 0): "1a14bd6d6191c60b", ("canal_town", 1): "0ef03349f614ea80",
    ("harbour", 0): "1b95b60961e07a91", ("harbour", 1): "47b22a9850db488e",
    ("village", 0): "36a97a93eaa23550", ("village", 1): "e288b4fcfddea662",
    ("campus", 0): "5e83bdfa799cfc68", ("campus", 1): "8d2c72211bd9422b",
    ("estate", 0): "d368995e31568f2b", ("estate", 1): "3d2e29a1fa25b13a",
    ("industry", 0): "bb9ea6487be2d68e", ("industry", 1): "c580f428af4be924",
    ("old_town", 0): "af3230732ef02c16", ("old_town", 1): "8e3cc2a56632a1a7",
    ("park_edge", 0): "ec7d4b49026f947e", ("park_edge", 1): "346fd7f36d9177c7",
    ("suburb", 0): "30fea5818bfed1b7", ("suburb", 1): "2da1889b95ddd198",
}  # fmt: skip


@pytest.mark.parametrize(("family", "epoch"), FROZEN)
def test_towns_of_training_and_benchmark_stay_what_they_were(family: str, epoch: int) -> None:
    """Model cards and figures name seeds: with them anybody makes the same towns again."""
    assert make_town(100_007, family, 160.0, epoch).digest()[:16] == FROZEN[family, epoch]


def test_a_seed_alone_stays_the_same_family() -> None:
    assert [make_town(seed, None, 100.0).family for seed in (5, 6, 7)] == ["park_edge", "industry", "suburb"]
    assert set(FAMILIES) == {family for family, _ in FROZEN}
    assert set(FAMILIES_BY_SEED) < set(FAMILIES)


def test_held_out_families_are_not_for_training() -> None:
    assert len(HELD_OUT_FAMILIES) >= 2
    assert not set(HELD_OUT_FAMILIES) & set(TRAINING_FAMILIES)
    assert set(HELD_OUT_FAMILIES) | set(TRAINING_FAMILIES) == set(FAMILIES)


def test_seeds_make_different_towns(town: Town) -> None:
    assert make_town(12, "suburb", 240.0).digest() != town.digest()


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_every_family_has_ground_houses_things_and_room(family: str) -> None:
    made = make_town(4, family, 300.0)
    counts = np.bincount(made.scene.labels, minlength=6)
    assert (counts[[Label.GROUND, Label.BUILDING, Label.VEGETATION, Label.STRUCTURE]] > 100).all()
    poses = made.sample_poses(200, np.random.default_rng(0))
    assert (np.abs(poses[:, :2, 3]).max(axis=1) < 150.0 - 39.0).all()


def test_epochs_differ_in_cars_and_little_else(town: Town) -> None:
    later = make_town(11, "suburb", 240.0, epoch=1)
    x = np.arange(-110.0, 110.0, 1.5)
    origins = np.stack([*(g.ravel() for g in np.meshgrid(x, x)), np.full(len(x) ** 2, 300.0)], -1).astype(np.float32)
    before, after = (w.scene.cast(origins, np.repeat(DOWN, len(origins), 0)) for w in (town, later))
    roofs = (before.label == Label.BUILDING) | (after.label == Label.BUILDING)
    same = np.abs(before.distance_m - after.distance_m) < 0.05
    # Crowns hide some roofs at one epoch and others at the next.
    assert 0.8 < same[roofs].mean() < 1.0
    assert later.digest() != town.digest()


def test_poses_stand_on_the_ground_in_the_open(town: Town) -> None:
    poses = town.sample_poses(300, np.random.default_rng(1), tilt_deg=0.0)
    above = poses[:, :3, 3] + [0.0, 0.0, 0.3]
    down = town.scene.cast(above.astype(np.float32), np.repeat(DOWN, 300, 0))
    np.testing.assert_array_equal(down.label, Label.GROUND)
    # The ground is triangles of 3 m, the terrain that poses stand on has no facets.
    np.testing.assert_allclose(down.distance_m, 0.3, atol=0.05)
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1).astype(np.float32)
    waist = np.repeat(above, 16, axis=0)
    waist[:, 2] += 0.5
    around = town.scene.cast(waist.astype(np.float32), np.tile(directions, (300, 1)))
    solid = np.isin(around.label, [Label.BUILDING, Label.STRUCTURE])
    assert around.distance_m[solid].min() > 0.8


def test_poses_head_everywhere_and_tilt_with_the_slope(town: Town) -> None:
    poses = town.sample_poses(2000, np.random.default_rng(2), tilt_deg=0.0)
    np.testing.assert_allclose(poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), np.tile(np.eye(3), (2000, 1, 1)),
                               atol=1e-12)  # fmt: skip
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    assert np.histogram(yaw, 8, (-np.pi, np.pi))[0].min() > 150
    xy, step = poses[:, :2, 3], 0.5
    ahead = town.terrain_height(xy + step * poses[:, :2, 0]) - town.terrain_height(xy - step * poses[:, :2, 0])
    np.testing.assert_allclose(poses[:, 2, 0], ahead / (2 * step), atol=0.01)


def test_sampling_is_repeatable(town: Town) -> None:
    first, second = (town.sample_poses(20, np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_houses_are_higher_than_trees_hide(town: Town) -> None:
    """The terrain under roofs is the terrain: roofs stand 2 to 60 m above it."""
    rng = np.random.default_rng(4)
    origins = np.column_stack([rng.uniform(-100, 100, (4000, 2)), np.full(4000, 300.0)]).astype(np.float32)
    hits = town.scene.cast(origins, np.repeat(DOWN, 4000, 0))
    height = 300.0 - hits.distance_m - town.terrain_height(origins[:, :2])
    roofs = hits.label == Label.BUILDING
    assert roofs.sum() > 100
    assert np.percentile(height[roofs], 2) > 1.5
    assert height[roofs].max() < 80.0
    ground = hits.label == Label.GROUND
    np.testing.assert_allclose(height[ground], 0.0, atol=0.06)


def test_origins_of_towns_do_not_overlap() -> None:
    origins = np.array([make_town(seed, "industry", 100.0).origin_grid[:2] for seed in (0, 1, 79, 80, 81)])
    distance = np.abs(origins[:, None] - origins[None]).max(axis=2)
    assert distance[~np.eye(len(origins), dtype=bool)].min() >= 2000.0


@pytest.mark.parametrize(("arguments", "what"), [
    ({"family": "atlantis"}, "unknown family 'atlantis'"), ({"size_m": 20.0}, "size_m"), ({"epoch": -1}, "epoch"),
])  # fmt: skip
def test_impossible_towns_are_refused(arguments: dict[str, object], what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        make_town(1, **arguments)  # type: ignore[arg-type]


def test_a_border_wider_than_the_town_leaves_no_place(town: Town) -> None:
    with pytest.raises(ValueError, match="no free ground"):
        town.sample_poses(1, np.random.default_rng(0), border_m=200.0)
