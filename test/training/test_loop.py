"""The training run: it learns, it goes on after a kill as if nothing had happened, it refuses what does not fit."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from crossloc3d_ros.cli import train
from crossloc3d_ros.config import ModelConfig, PlacesConfig, TrainConfig, from_dict
from crossloc3d_ros.encoder.checkpoint import load_checkpoint, load_encoder
from crossloc3d_ros.errors import ConfigError, TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.loop import Progress, Trainer, export_run
from crossloc3d_ros.training.schedule import Budget, learning_rate
from crossloc3d_ros.training.shards import MANIFEST, read_manifest
from crossloc3d_ros.training.state import average, new_state

REPOSITORY = Path(__file__).resolve().parents[2]


class KilledError(Exception):
    """Stands for SIGKILL: nothing of the run's own code handles it."""


def weights(folder: Path) -> dict[str, torch.Tensor]:
    state = run_folder.load_state(folder)
    assert state is not None
    return {**{f"m.{k}": v for k, v in state["model"].items()}, **{f"a.{k}": v for k, v in state["averaged"].items()}}


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"loss": "smooth_ap", "chunk_pairs": 4, "hard_share": 0.5, "mine_steps": 2, "mined_places": 40},
        {
            "loss": "batch_hard",
            "augmentation": "paper",
            "most_pairs": 12,
            "growth_steps": 2,
            "growth_below": 1.0,
            "workers": 1,
        },
    ],
    ids=["plain", "average precision, chunks, hard places", "the paper's, growing"],
)
def test_a_run_killed_and_resumed_ends_with_the_same_weights(
    places: Path, tmp_path: Path, tiny: TrainConfig, settings: dict[str, Any]
) -> None:
    config = dataclasses.replace(tiny, save_minutes=0.01, **settings)
    budget = Budget(steps=8)
    seconds = iter(float(i) for i in range(10_000))
    Trainer(config, [places], tmp_path / "straight", budget, clock=lambda: next(seconds)).run()

    def kill(progress: Progress) -> None:
        if progress.step == 6:
            raise KilledError

    folder = tmp_path / "killed"
    with pytest.raises(KilledError):
        Trainer(config, [places], folder, budget, report=kill, clock=lambda: next(seconds)).run()
    saved = run_folder.load_state(folder)
    assert saved is not None and 0 < saved["step"] < 8
    Trainer(dataclasses.replace(config, workers=2), [places], folder, budget).run(resume=True)

    logged = [entry for entry in run_folder.read_log(folder) if entry["kind"] == "step"]
    assert (logged[-1]["pairs"] > tiny.pairs) == ("most_pairs" in settings)
    straight, resumed = weights(tmp_path / "straight"), weights(folder)
    assert straight.keys() == resumed.keys()
    for key, value in straight.items():
        assert torch.equal(value, resumed[key]), key


def test_learning_lowers_the_loss_and_beats_chance_on_an_unseen_town(
    places: Path, tmp_path: Path, tiny: TrainConfig
) -> None:
    losses: list[float] = []
    trainer = Trainer(tiny, [places], tmp_path / "run", Budget(steps=80), report=lambda p: losses.append(p.loss))
    recall = trainer.run().recall("R@1", 50.0)
    assert sum(losses[-5:]) < 0.75 * sum(losses[:5])
    assert recall.share.value > recall.chance


def test_a_finished_run_leaves_weights_that_load_with_their_calibration_and_a_card(
    finished: Path, tiny: TrainConfig
) -> None:
    checkpoint = load_checkpoint(finished / run_folder.FINAL)
    assert checkpoint.model.config == tiny.model
    assert checkpoint.preprocessing == tiny.preprocessing
    distances = json.loads(checkpoint.metadata["distances"])
    assert len(distances["true_match"]) == len(distances["quantiles"])
    calibration = load_encoder(finished / run_folder.FINAL).calibration
    assert calibration is not None
    assert calibration.temperature > 0.0
    card = (finished / run_folder.MODEL_CARD).read_text()
    for words in ("R@1", "chance", "--budget-steps 2", "seed 1", "What it cannot do"):
        assert words in card


def test_a_run_is_exported_as_it_was_saved(finished: Path, tmp_path: Path, places: Path) -> None:
    output = tmp_path / "shipped" / "weights.safetensors"
    card = export_run(finished, output, [places])
    exported, final = load_checkpoint(output), load_checkpoint(finished / run_folder.FINAL)
    assert exported.fingerprint == final.fingerprint
    assert card.exists()


def test_a_folder_that_holds_a_run_is_not_overwritten(finished: Path, places: Path, tiny: TrainConfig) -> None:
    with pytest.raises(TrainingError, match="--resume"):
        Trainer(tiny, [places], finished, Budget(steps=2)).run()


def test_a_resumed_run_keeps_its_settings_and_its_places(finished: Path, places: Path, tiny: TrainConfig) -> None:
    other = dataclasses.replace(tiny, learning_rate=1e-4)
    with pytest.raises(TrainingError, match="'learning_rate'"):
        Trainer(other, [places], finished, Budget(steps=3)).run(resume=True)
    manifest = json.loads((places / MANIFEST).read_text())
    manifest["settings"]["seed"] = 99
    (places / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(TrainingError, match="other places"):
        Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)


def test_before_the_cooldown_a_run_may_get_another_budget_and_be_as_if_it_always_had_it(
    places: Path, tmp_path: Path, tiny: TrainConfig
) -> None:
    config = dataclasses.replace(tiny, warm_up=0.0, cooldown=0.25, save_minutes=0.01)
    seconds = iter(float(i) for i in range(10_000))

    def kill(progress: Progress) -> None:
        if progress.step == 4:
            raise KilledError

    folder = tmp_path / "killed"
    with pytest.raises(KilledError):
        Trainer(config, [places], folder, Budget(steps=40), report=kill, clock=lambda: next(seconds)).run()
    Trainer(config, [places], folder, Budget(steps=8)).run(resume=True)
    Trainer(config, [places], tmp_path / "straight", Budget(steps=8)).run()
    straight, resumed = weights(tmp_path / "straight"), weights(folder)
    assert all(torch.equal(value, resumed[key]) for key, value in straight.items())


def test_a_finished_run_goes_on_from_where_it_stopped(places: Path, tmp_path: Path, tiny: TrainConfig) -> None:
    config = dataclasses.replace(tiny, warm_up=0.0, cooldown=0.0)  # no rate depends on the end
    Trainer(config, [places], tmp_path / "twice", Budget(steps=2)).run()
    Trainer(config, [places], tmp_path / "twice", Budget(steps=4)).run(resume=True)
    Trainer(config, [places], tmp_path / "straight", Budget(steps=4)).run()
    straight, resumed = weights(tmp_path / "straight"), weights(tmp_path / "twice")
    assert all(torch.equal(value, resumed[key]) for key, value in straight.items())
    finals = [load_checkpoint(tmp_path / name / run_folder.FINAL) for name in ("twice", "straight")]
    assert finals[0].fingerprint == finals[1].fingerprint
    assert (tmp_path / "twice" / run_folder.BEST).exists()


def test_a_setting_that_an_older_run_does_not_know_has_its_default(
    finished: Path, places: Path, tiny: TrainConfig
) -> None:
    settings = json.loads((finished / run_folder.SETTINGS).read_text())
    del settings["config"]["cooldown"], settings["config"]["model"]["network"], settings["initial"]
    (finished / run_folder.SETTINGS).write_text(json.dumps(settings))
    Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)
    with pytest.raises(TrainingError, match="'cooldown'"):
        other = dataclasses.replace(tiny, cooldown=0.5)
        Trainer(other, [places], finished, Budget(steps=4)).run(resume=True)


def test_resuming_what_is_no_run_is_refused(places: Path, tmp_path: Path, tiny: TrainConfig) -> None:
    with pytest.raises(TrainingError, match="holds no training run"):
        Trainer(tiny, [places], tmp_path / "nothing", Budget(steps=2)).run(resume=True)


def test_a_damaged_state_is_named(finished: Path, places: Path, tiny: TrainConfig) -> None:
    state = finished / run_folder.STATE
    state.write_bytes(state.read_bytes()[:1000])
    with pytest.raises(TrainingError, match="cannot be read"):
        Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)


def test_places_without_held_out_towns_are_refused(places: Path, tmp_path: Path, tiny: TrainConfig) -> None:
    manifest = json.loads((places / MANIFEST).read_text())
    manifest["towns"] = [town for town in manifest["towns"] if town["role"] == "train"]
    (places / MANIFEST).write_text(json.dumps(manifest))
    assert read_manifest(places).of_role("validation") == []
    with pytest.raises(TrainingError, match="no towns to validate on"):
        Trainer(tiny, [places], tmp_path / "run", Budget(steps=2)).run()


def test_the_log_forgets_the_steps_that_a_kill_lost(finished: Path) -> None:
    with (finished / run_folder.LOG).open("a") as file:
        file.write('{"kind": "step", "step": 7}\n{"kind": "st')
    run_folder.Log(finished, 2)
    assert max(entry["step"] for entry in run_folder.read_log(finished)) == 2


def test_the_learning_rate_rises_then_falls_to_its_last_share(tiny: TrainConfig) -> None:
    rates = [learning_rate(share / 100, tiny) for share in range(101)]
    top = rates.index(max(rates))
    assert top == round(100 * tiny.warm_up) and max(rates) == pytest.approx(tiny.learning_rate)
    assert rates[:top] == sorted(rates[:top]) and rates[top:] == sorted(rates[top:], reverse=True)
    assert rates[-1] == pytest.approx(tiny.final_share * tiny.learning_rate)


def test_until_the_cooldown_the_learning_rate_does_not_depend_on_how_long_the_run_will_be(tiny: TrainConfig) -> None:
    config = dataclasses.replace(tiny, warm_up=0.0, cooldown=0.25)
    short, long = Budget(minutes=100.0), Budget(minutes=1000.0)
    for minute in range(0, 75, 5):
        rates = {learning_rate(budget.share(60.0 * minute, 0), config) for budget in (short, long)}
        assert rates == {config.learning_rate}
    cooling = [learning_rate(short.share(60.0 * minute, 0), config) for minute in range(75, 101)]
    assert cooling == sorted(cooling, reverse=True)
    assert cooling[-1] == pytest.approx(config.final_share * config.learning_rate)


def test_at_each_milestone_the_learning_rate_falls_to_a_tenth(tiny: TrainConfig) -> None:
    config = dataclasses.replace(tiny, warm_up=0.0, milestones=(0.4, 0.6, 0.8))
    for share, tenths in ((0.0, 0), (0.39, 0), (0.4, 1), (0.7, 2), (0.99, 3)):
        assert learning_rate(share, config) == pytest.approx(config.learning_rate / 10**tenths)


@pytest.mark.parametrize("name", ["train.yaml", "train_paper.yaml"])
def test_the_settings_that_ship_can_be_read(name: str) -> None:
    document = yaml.safe_load((REPOSITORY / "config" / name).read_text())
    config = from_dict(TrainConfig, document["train"])
    from_dict(PlacesConfig, document["places"])
    assert config.model == ModelConfig() or name == "train.yaml"


@pytest.mark.parametrize(
    "settings",
    [
        {"most_pairs": 64},
        {"most_pairs": 8, "loss": "batch_hard"},
        {"milestones": (0.6, 0.4)},
        {"precision": "bfloat16"},
        {"augmentation": "paper", "headings": 8},
    ],
)
def test_settings_that_do_not_fit_each_other_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        TrainConfig(**settings)


def test_averaged_weights_lie_between_the_old_average_and_the_model(tiny: TrainConfig) -> None:
    state = new_state(tiny)
    with torch.no_grad():
        for parameter in state.model.parameters():
            parameter += 1.0
    before = {key: value.clone() for key, value in state.averaged.named_parameters()}
    average(state.averaged, state.model, 0.9)
    for key, value in state.averaged.named_parameters():
        assert torch.allclose(value, before[key] + 0.1, atol=1e-6), key


def test_a_budget_is_minutes_or_steps() -> None:
    assert Budget(minutes=2.0).share(60.0, 0) == 0.5
    assert Budget(steps=10).share(1e9, 5) == 0.5
    for wrong in ({}, {"minutes": 1.0, "steps": 2}, {"minutes": -1.0}):
        with pytest.raises(TrainingError):
            Budget(**wrong)  # type: ignore[arg-type]


def test_the_command_says_in_one_line_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "--places", str(tmp_path), "--output", str(tmp_path / "run"), "--budget-minutes", "1"]
    assert train.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and "make-places" in captured.err
    settings = tmp_path / "train.yaml"
    settings.write_text("train: {learning_rat: 0.1}\n")
    assert train.main([*arguments, "--config", str(settings)]) == 2
    assert "learning_rat" in capsys.readouterr().err
