"""Places of several folders are one material."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.checkpoint import load_checkpoint
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.loop import Trainer
from crossloc3d_ros.training.material import read_material
from crossloc3d_ros.training.schedule import Budget
from crossloc3d_ros.training.shards import MANIFEST


@pytest.fixture
def two(tmp_path: Path, make_places: Callable[..., Path]) -> list[Path]:
    return [make_places(tmp_path / "a", towns=2), make_places(tmp_path / "b", towns=3, first_seed=50)]


def change(folder: Path, change: Callable[[dict[str, object]], object]) -> None:
    content = json.loads((folder / MANIFEST).read_text())
    change(content["settings"])
    (folder / MANIFEST).write_text(json.dumps(content))


def test_a_run_learns_from_the_towns_of_all_folders(two: list[Path], tmp_path: Path, tiny: TrainConfig) -> None:
    material = read_material(two, tiny.preprocessing)
    towns, _, _ = material.sampler(tiny).places
    assert set(towns.tolist()) == set(range(5)) and len(material.validation_towns(tiny)) == 2
    alone = [read_material([folder]) for folder in two]
    trainer = Trainer(tiny, two, tmp_path / "run", Budget(steps=1))
    validation = trainer.run()
    assert validation.submaps == sum(len(t.submap_xy_m) for m in alone for t in m.validation_towns(tiny))
    card = trainer.write_card().read_text()
    assert card.count("make-places") == 2
    assert load_checkpoint(tmp_path / "run" / run_folder.FINAL).metadata["headings"] == "1"


def test_the_hash_covers_every_folder(two: list[Path], tmp_path: Path, tiny: TrainConfig) -> None:
    hashes = {read_material(folders).sha256() for folders in ([two[0]], [two[1]], two, two[::-1])}
    assert len(hashes) == 4
    Trainer(tiny, two, tmp_path / "run", Budget(steps=1)).run()
    change(two[1], lambda settings: settings.update(seed=77))
    with pytest.raises(TrainingError, match="other places"):
        Trainer(tiny, two, tmp_path / "run", Budget(steps=2)).run(resume=True)


def test_folders_that_cannot_be_joined_are_refused(two: list[Path], tmp_path: Path, tiny: TrainConfig) -> None:
    with pytest.raises(TrainingError, match="named twice"):
        read_material([two[0], tmp_path / "x" / ".." / "a"])
    with pytest.raises(TrainingError, match="name a folder"):
        read_material([])
    other = dataclasses.replace(tiny.preprocessing, n_points=128)
    with pytest.raises(TrainingError, match="another preprocessing"):
        read_material(two, other)
    change(two[0], lambda settings: settings.update(preprocessing={"n_pionts": 3}))
    with pytest.raises(TrainingError, match="n_pionts"):
        read_material(two, tiny.preprocessing)


def test_a_damaged_town_is_named(two: list[Path], tmp_path: Path, tiny: TrainConfig) -> None:
    path = two[1] / "train_51.npz"
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(TrainingError, match=r"train_51\.npz is damaged"):
        Trainer(tiny, two, tmp_path / "run", Budget(steps=1)).run()
    path.unlink()
    with pytest.raises(TrainingError, match=r"train_51\.npz is missing"):
        read_material(two).sampler(tiny)
