"""A kill while a file is written, a full disk, files of something else: reported clearly, and nothing is lost."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
import yaml

from crossloc3d_ros.cli import train
from crossloc3d_ros.config import TrainConfig, to_dict
from crossloc3d_ros.encoder.checkpoint import load_checkpoint, save_checkpoint
from crossloc3d_ros.encoder.networks import make_network
from crossloc3d_ros.errors import CheckpointError, CrossLocError, TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.loop import Trainer
from crossloc3d_ros.training.schedule import Budget
from crossloc3d_ros.training.state import new_state

KILLED_WHILE_SAVING = """
import itertools, os, signal, sys
from pathlib import Path
import torch
from crossloc3d_ros.config import TrainConfig, from_dict
from crossloc3d_ros.training.loop import Trainer
from crossloc3d_ros.training.schedule import Budget
import json

places, folder, settings = sys.argv[1:]
write = torch.save
saves = itertools.count(1)

def cut_off(content, file):
    if next(saves) == 3:
        file.write(b"half a state")
        file.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    write(content, file)

torch.save = cut_off
seconds = itertools.count()
config = from_dict(TrainConfig, json.loads(settings))
Trainer(config, [Path(places)], Path(folder), Budget(steps=6), clock=lambda: float(next(seconds))).run()
"""


def test_a_run_killed_while_it_writes_its_state_ends_with_the_same_weights(
    places: Path, tmp_path: Path, tiny: TrainConfig
) -> None:
    config = dataclasses.replace(tiny, save_minutes=0.01)
    folder = tmp_path / "killed"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    arguments = [str(places), str(folder), json.dumps(to_dict(config))]
    killed = subprocess.run(
        [sys.executable, "-c", KILLED_WHILE_SAVING, *arguments], env=environment, capture_output=True, check=False
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert list(folder.glob(".*.partial"))
    saved = run_folder.load_state(folder)
    assert saved is not None and 0 < saved["step"] < 6

    Trainer(config, [places], folder, Budget(steps=6)).run(resume=True)
    Trainer(config, [places], tmp_path / "straight", Budget(steps=6)).run()
    assert not list(folder.glob(".*.partial"))
    resumed, straight = (load_checkpoint(f / run_folder.FINAL) for f in (folder, tmp_path / "straight"))
    assert resumed.fingerprint == straight.fingerprint


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Refuse every file to grow beyond `size` bytes: writing fails as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_reported_and_costs_nothing(finished: Path, places: Path, tiny: TrainConfig) -> None:
    before = {path.name: path.read_bytes() for path in finished.iterdir() if path.suffix != ".jsonl"}
    content = run_folder.load_state(finished)
    assert content is not None
    with disk_of(20_000), pytest.raises(TrainingError, match=r"large.*--resume"):
        Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)
    assert {path.name: path.read_bytes() for path in finished.iterdir() if path.suffix != ".jsonl"} == before
    with disk_of(20_000), pytest.raises(CheckpointError, match=r"cannot write .*large"):
        run_folder.export(finished / run_folder.BEST, new_state(tiny).averaged, tiny, {})
    with disk_of(100), pytest.raises(TrainingError, match="large"):
        run_folder.Log(finished, 2).write("step", step=2, words="x" * 100)
    assert not list(finished.glob(".*.partial"))
    Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)
    after = run_folder.load_state(finished)
    assert after is not None and after["step"] == 3


def test_no_space_left_is_reported_in_those_words(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (finished / run_folder.STATE).read_bytes()

    def fill_up(state: object, file: object) -> None:
        file.write(b"half a state")  # type: ignore[attr-defined]
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", fill_up)
    with pytest.raises(TrainingError, match="No space left"):
        run_folder.save_state(finished, {})
    assert (finished / run_folder.STATE).read_bytes() == before
    assert not list(finished.glob(".*.partial"))


def test_the_state_of_another_model_is_refused(finished: Path, places: Path, tiny: TrainConfig) -> None:
    other = dataclasses.replace(tiny, model=dataclasses.replace(tiny.model, descriptor_size=48))
    torch.save(new_state(other).to_dict(), finished / run_folder.STATE)
    with pytest.raises(TrainingError, match="not that of this run's network"):
        Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)
    torch.save({"model": {}}, finished / run_folder.STATE)
    with pytest.raises(TrainingError, match="not that of this run's network"):
        Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)
    with pytest.raises(TrainingError, match="'model'"):
        Trainer(other, [places], finished, Budget(steps=3)).run(resume=True)


def test_a_state_with_code_in_it_is_not_run(finished: Path, places: Path, tiny: TrainConfig) -> None:
    class Code:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.system, ("touch " + str(finished / "ran"),)

    torch.save({"model": Code()}, finished / run_folder.STATE)
    with pytest.raises(TrainingError, match="cannot be read"):
        Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)
    assert not (finished / "ran").exists()


def test_damaged_settings_are_named(finished: Path, places: Path, tiny: TrainConfig) -> None:
    (finished / run_folder.SETTINGS).write_text("{}")
    with pytest.raises(TrainingError, match=r"run\.json is damaged"):
        Trainer(tiny, [places], finished, Budget(steps=3)).run(resume=True)
    (finished / run_folder.SETTINGS).unlink()
    with pytest.raises(TrainingError, match="holds no training run"):
        Trainer(tiny, [places], finished, Budget(steps=3)).check()


def test_a_gpu_that_is_not_there_is_reported(places: Path, tmp_path: Path, tiny: TrainConfig) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is one")
    config = dataclasses.replace(tiny, device="cuda")
    with pytest.raises(CrossLocError, match="no GPU"):
        Trainer(config, [places], tmp_path / "run", Budget(steps=1)).run()
    assert not (tmp_path / "run").exists()


def test_the_command_says_in_one_line_that_weights_are_another_model_s(
    places: Path, tmp_path: Path, tiny: TrainConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "train.yaml"
    settings.write_text(yaml.safe_dump({"train": json.loads(json.dumps(to_dict(tiny)))}))
    arguments = ["run", "--places", str(places), "--config", str(settings), "--output", str(tmp_path / "run")]
    arguments += ["--budget-steps", "1"]
    assert train.main([*arguments, "--initial", str(places / "train_0.npz")]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and "train_0.npz cannot be read as safetensors" in printed
    other = tmp_path / "other.safetensors"
    model = make_network(dataclasses.replace(tiny.model, network="pointnetvlad"))
    save_checkpoint(other, model, tiny.preprocessing)
    assert train.main([*arguments, "--initial", str(other)]) == 2
    assert "network 'pointnetvlad', the run trains 'crossloc3d'" in capsys.readouterr().err
