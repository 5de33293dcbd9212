"""A run may begin with weights that exist: what fits is taken over, and the chain is kept."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.checkpoint import load_checkpoint, save_checkpoint
from crossloc3d_ros.encoder.networks import make_network
from crossloc3d_ros.errors import CheckpointError, TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.initial import read_initial, take_over
from crossloc3d_ros.training.loop import Trainer
from crossloc3d_ros.training.schedule import Budget


@pytest.fixture
def weights(tmp_path: Path, tiny: TrainConfig) -> Path:
    torch.manual_seed(9)
    path = tmp_path / "before.safetensors"
    notes = {"training": json.dumps({"steps": 12, "hours": 0.5})}
    save_checkpoint(path, make_network(tiny.model), tiny.preprocessing, notes)
    return path


def test_what_fits_is_taken_over_and_what_does_not_is_named(weights: Path, tiny: TrainConfig) -> None:
    wider = dataclasses.replace(tiny.model, descriptor_size=48)
    torch.manual_seed(1)
    model = make_network(wider)
    fresh = {key: value.clone() for key, value in model.state_dict().items()}
    taken = take_over(model, read_initial(weights, wider))
    before = load_checkpoint(weights).model.state_dict()
    for key, value in model.state_dict().items():
        assert torch.equal(value, before[key] if key in taken.taken else fresh[key]), key
    assert "pooling.projection" in taken.new and "pooling.assignment" in taken.taken
    assert taken.unused == ()
    assert "pooling.gating" in taken.sentence()


def test_a_run_begins_with_the_weights_and_says_so(
    weights: Path, places: Path, tmp_path: Path, tiny: TrainConfig
) -> None:
    frozen = dataclasses.replace(tiny, learning_rate=1e-7, weight_decay=0.0)
    folder = tmp_path / "second"
    trainer = Trainer(frozen, [places], folder, Budget(steps=1), weights)
    trainer.run()
    before, after = load_checkpoint(weights), load_checkpoint(folder / run_folder.FINAL)
    for key, value in before.model.named_parameters():
        assert torch.allclose(after.model.get_parameter(key), value, atol=1e-3), key
    history = run_folder.history(folder)
    assert [entry["weights"] for entry in history] == ["before.safetensors"]
    assert history[0]["fingerprint"] == before.fingerprint and history[0]["training"]["steps"] == 12
    assert json.loads(after.metadata["history"]) == history

    third = tmp_path / "third"
    Trainer(frozen, [places], third, Budget(steps=1), folder / run_folder.FINAL).run()
    names = [entry["weights"] for entry in run_folder.history(third)]
    assert names == ["before.safetensors", "final.safetensors"]


def test_a_run_killed_before_its_first_state_begins_with_the_same_weights_again(
    weights: Path, places: Path, tmp_path: Path, tiny: TrainConfig
) -> None:
    for name in ("straight", "killed"):
        Trainer(tiny, [places], tmp_path / name, Budget(steps=2), weights).run()
    (tmp_path / "killed" / run_folder.STATE).unlink()
    Trainer(tiny, [places], tmp_path / "killed", Budget(steps=2)).run(resume=True)
    straight, resumed = (load_checkpoint(tmp_path / n / run_folder.FINAL) for n in ("straight", "killed"))
    assert straight.fingerprint == resumed.fingerprint
    (tmp_path / "killed" / run_folder.STATE).unlink()
    save_checkpoint(weights, make_network(tiny.model), tiny.preprocessing)
    with pytest.raises(TrainingError, match="no longer holds"):
        Trainer(tiny, [places], tmp_path / "killed", Budget(steps=2)).run(resume=True)


def test_a_resumed_run_keeps_its_beginning(weights: Path, places: Path, tmp_path: Path, tiny: TrainConfig) -> None:
    Trainer(tiny, [places], tmp_path / "run", Budget(steps=1)).run()
    with pytest.raises(TrainingError, match="other weights"):
        Trainer(tiny, [places], tmp_path / "run", Budget(steps=2), weights).run(resume=True)


def test_weights_of_another_model_are_refused(weights: Path, places: Path, tmp_path: Path, tiny: TrainConfig) -> None:
    nothing_fits = dataclasses.replace(
        tiny.model, channels=24, heads=2, voxel_sizes=(0.3,), refinement="none", fused_channels=40, clusters=4,
        descriptor_size=8,
    )  # fmt: skip
    model = make_network(nothing_fits)
    with torch.no_grad():
        initial = read_initial(weights, nothing_fits)
        for key in list(initial.checkpoint.model._modules):
            if key not in ("grains",):
                del initial.checkpoint.model._modules[key]
        initial.checkpoint.model.grains = torch.nn.ModuleList()
    with pytest.raises(TrainingError, match="another model's"):
        take_over(model, initial)
    config = dataclasses.replace(tiny, model=dataclasses.replace(tiny.model, network="pointnetvlad"))
    with pytest.raises(TrainingError, match="network 'crossloc3d'"):
        Trainer(config, [places], tmp_path / "run", Budget(steps=1), weights).run()
    assert not (tmp_path / "run").exists()
    weights.write_bytes(weights.read_bytes()[:500])
    with pytest.raises(CheckpointError, match="safetensors"):
        Trainer(tiny, [places], tmp_path / "run", Budget(steps=1), weights).run()
