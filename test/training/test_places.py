"""Simulated places: the same for the same seed, kept when they are there, refused when they do not fit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.config import PlacesConfig, PreprocessingConfig
from crossloc3d_ros.errors import ConfigError, TrainingError
from crossloc3d_ros.simulation.families import FAMILIES, HELD_OUT_FAMILIES
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.training.places import make_places, make_town_places, plan_towns, surveyed_world
from crossloc3d_ros.training.sampling import PointField
from crossloc3d_ros.training.shards import (
    MANIFEST,
    TrainingTown,
    read_manifest,
    read_training_town,
    read_validation_town,
    write_manifest,
    write_town,
)

SMALL = PlacesConfig(
    families=("suburb",), town_size_m=200.0, scans=4, validation_scans=3, survey_spacing_m=0.7, spacing_m=38.0
)
PREPROCESSING = PreprocessingConfig()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("places")
    make_places(folder, towns=1, validation_towns=1, seed=3, config=SMALL, preprocessing=PREPROCESSING)
    return folder


def test_training_validation_and_other_seeds_never_share_a_town() -> None:
    seeds = [task.seed for seed in (1, 2) for task in plan_towns(seed, 50, 10, ())]
    assert len(seeds) == len(set(seeds)) == 120


def test_more_towns_extend_a_set() -> None:
    assert set(plan_towns(1, 5, 2, ())) < set(plan_towns(1, 9, 3, ()))


def test_a_seed_makes_the_same_town_again(made: Path) -> None:
    task = next(task for task in plan_towns(3, 1, 1, ("suburb",)) if task.role == "train")
    again = make_town_places(task, SMALL, PREPROCESSING)
    town = read_training_town(made / task.file)
    assert isinstance(again, TrainingTown)
    assert np.array_equal(again.scan_points_cm, town.scan_points_cm)
    assert np.array_equal(again.survey_points, town.survey_points)


def test_scan_and_survey_show_the_same_things(made: Path) -> None:
    """Rotated to its heading, a scan lies on the survey: the frames and signs of both are the same."""
    entry = read_manifest(made).of_role("train")[0]
    town = read_training_town(made / entry.file)
    field = PointField(town.survey_points)
    agreement = []
    for i in range(2):
        scan = town.scan_points(i)
        scan = scan[(np.hypot(scan[:, 0], scan[:, 1]) < 35.0) & (scan[:, 2] > 1.0)]
        shares = []
        for heading in np.radians(np.arange(0.0, 360.0, 4.0)):
            seen = field.cut(town.scan_xy_m[i], heading, 40.0)
            occupied = {tuple(cell) for cell in np.floor(seen[:, :2]).astype(int)}
            cells = {tuple(cell) for cell in np.floor(scan[:, :2]).astype(int)}
            shares.append(len(cells & occupied) / max(1, len(cells)))
        agreement.append(max(shares) - float(np.median(shares)))
    assert max(agreement) > 0.15


def test_validation_patches_are_whole(made: Path) -> None:
    entry = read_manifest(made).of_role("validation")[0]
    town = read_validation_town(made / entry.file)
    assert town.query_patches.shape[1:] == town.submap_patches.shape[1:] == (PREPROCESSING.n_points, 3)
    assert len(town.query_xy_m) == entry.scans and len(town.submap_xy_m) == entry.submaps > 0
    assert np.abs(town.submap_patches).max() <= 1.0


def test_finished_towns_are_kept_and_a_lost_one_is_made_again(made: Path) -> None:
    files = {file.name: file.stat().st_mtime_ns for file in made.glob("*.npz")}
    lost = next(made.glob("train_*.npz"))
    lost.unlink()
    make_places(made, towns=1, validation_towns=1, seed=3, config=SMALL, preprocessing=PREPROCESSING)
    now = {file.name: file.stat().st_mtime_ns for file in made.glob("*.npz")}
    assert now.keys() == files.keys()
    assert {name for name in files if files[name] != now[name]} == {lost.name}


def test_places_of_other_settings_are_refused(made: Path) -> None:
    other = dataclasses.replace(SMALL, scans=5)
    with pytest.raises(TrainingError, match="another 'places'"):
        make_places(made, towns=1, validation_towns=1, seed=3, config=other, preprocessing=PREPROCESSING)


def test_the_manifest_names_every_family_and_none_that_is_held_out(tmp_path: Path) -> None:
    config = dataclasses.replace(SMALL, families=())
    manifest = make_places(tmp_path, towns=0, validation_towns=0, seed=3, config=config, preprocessing=PREPROCESSING)
    families = manifest.settings["places"]["families"]
    assert sorted(families) == sorted(set(FAMILIES) - set(HELD_OUT_FAMILIES))
    assert {task.family for task in plan_towns(1, 50, 10, ())} == set(families)


def test_a_held_out_family_is_not_learned_from() -> None:
    with pytest.raises(ConfigError, match=r"held out for the benchmark.*village"):
        plan_towns(1, 1, 0, ("suburb", "village"))


def test_a_family_may_be_named_twice() -> None:
    assert [task.family for task in plan_towns(1, 4, 0, ("suburb", "campus", "suburb"))] == [
        "suburb", "campus", "suburb", "suburb",
    ]  # fmt: skip


def test_scans_in_a_surveyed_surface_leave_the_others_as_they_are() -> None:
    """With a share of them every scan is still a place of the town, and the rest are those without the share."""
    task = plan_towns(3, 1, 0, ("suburb",))[0]
    config = dataclasses.replace(SMALL, town_size_m=300.0, scans=8)
    exact = make_town_places(task, config, PREPROCESSING)
    mixed = make_town_places(task, dataclasses.replace(config, surface_share=0.5), PREPROCESSING)
    assert isinstance(exact, TrainingTown) and isinstance(mixed, TrainingTown)
    assert np.array_equal(exact.survey_points, mixed.survey_points)
    kept = {tuple(place) for place in exact.scan_xy_m} & {tuple(place) for place in mixed.scan_xy_m}
    assert 0 < len(kept) < len(exact)


def test_a_surveyed_town_stands_where_the_town_stands() -> None:
    town = make_town(300_000, "suburb", 200.0)
    surface = surveyed_world(town, PlacesConfig(survey_spacing_m=0.5))
    poses = surface.sample_poses(40, np.random.default_rng(0), border_m=30.0, clearance_m=1.5, tilt_deg=0.0)
    np.testing.assert_allclose(poses[:, 2, 3], town.terrain_height(poses[:, :2, 3]), atol=0.3)
    rng = np.random.default_rng(1)
    over = np.column_stack([rng.uniform(-90, 90, (3000, 2)), np.full(3000, 200.0)]).astype(np.float32)
    down = np.tile(np.float32([[0, 0, -1]]), (3000, 1))
    exact, seen = town.scene.cast(over, down), surface.scene.cast(over, down)
    roofs = exact.label == Label.BUILDING
    near = np.abs(exact.distance_m - seen.distance_m) < 0.6
    assert near[roofs].mean() > 0.75
    assert near[exact.label == Label.GROUND].mean() > 0.9


def test_an_unknown_family_is_named() -> None:
    with pytest.raises(ConfigError, match="atlantis"):
        plan_towns(1, 1, 1, ("atlantis",))


def test_a_damaged_or_missing_town_says_what_to_do(tmp_path: Path) -> None:
    damaged = tmp_path / "town.npz"
    damaged.write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(TrainingError, match="damaged"):
        read_training_town(damaged)
    with pytest.raises(TrainingError, match="make-places"):
        read_training_town(tmp_path / "nothing.npz")


def test_a_folder_without_or_with_a_damaged_manifest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="make-places"):
        read_manifest(tmp_path)
    (tmp_path / MANIFEST).write_text('{"format": 1, "settings"')
    with pytest.raises(TrainingError, match="damaged"):
        read_manifest(tmp_path)
    (tmp_path / MANIFEST).write_text('{"format": 99}')
    with pytest.raises(TrainingError, match="format 99"):
        read_manifest(tmp_path)


def test_a_full_disk_leaves_the_town_before(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    town = read_training_town(next(made.glob("train_*.npz")))
    path = tmp_path / "town.npz"
    write_town(path, town)
    before = path.read_bytes()

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(TrainingError, match="No space left"):
        write_town(path, town)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["town.npz"]


def test_a_manifest_comes_back_as_it_was(made: Path, tmp_path: Path) -> None:
    manifest = read_manifest(made)
    write_manifest(tmp_path, manifest)
    assert read_manifest(tmp_path) == manifest
