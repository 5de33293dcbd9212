"""The training run: it learns, it goes on after a kill as if nothing had happened, it refuses what does not fit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.checkpoint import load_checkpoint
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.loop import Budget, Progress, Trainer, learning_rate


class Killed(Exception):
    """Stands for SIGKILL: nothing of the run's own code handles it."""


def weights(folder: Path) -> dict[str, torch.Tensor]:
    state = run_folder.load_state(folder)
    assert state is not None
    return {**{f"m.{k}": v for k, v in state["model"].items()}, **{f"a.{k}": v for k, v in state["averaged"].items()}}


def test_a_run_killed_and_resumed_ends_with_the_same_weights(places: Path, tmp_path: Path, tiny: TrainConfig) -> None:
    config = dataclasses.replace(tiny, save_minutes=0.01)
    budget = Budget(steps=8)
    seconds = iter(float(i) for i in range(10_000))
    Trainer(config, places, tmp_path / "straight", budget, clock=lambda: next(seconds)).run()

    def kill(progress: Progress) -> None:
        if progress.step == 6:
            raise Killed

    folder = tmp_path / "killed"
    with pytest.raises(Killed):
        Trainer(config, places, folder, budget, report=kill, clock=lambda: next(seconds)).run()
    saved = run_folder.load_state(folder)
    assert saved is not None and 0 < saved["step"] < 8
    Trainer(config, places, folder, budget).run(resume=True)

    straight, resumed = weights(tmp_path / "straight"), weights(folder)
    assert straight.keys() == resumed.keys()
    for key, value in straight.items():
        assert torch.equal(value, resumed[key]), key


def test_learning_lowers_the_loss_and_beats_chance_on_an_unseen_town(
    places: Path, tmp_path: Path, tiny: TrainConfig
) -> None:
    losses: list[float] = []
    trainer = Trainer(tiny, places, tmp_path / "run", Budget(steps=80), report=lambda p: losses.append(p.loss))
    recall = trainer.run().recall("R@1", 50.0)
    assert sum(losses[-5:]) < 0.6 * sum(losses[:5])
    assert recall.value > recall.chance
