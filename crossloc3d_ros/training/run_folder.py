"""What a training run leaves on disk: its settings, its log, the state to go on from, and the weights.

Every file is written beside its place and moved into it, so that a kill or a full disk never costs the one before.
"""

from __future__ import annotations

import json
import os
import pickle
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from crossloc3d_ros.config import TrainConfig, from_dict, to_dict
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.checkpoint import save_checkpoint
from crossloc3d_ros.encoder.runtime import stored_calibration
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.files import atomic_path, remove_leftovers, write_atomically
from crossloc3d_ros.training.initial import HISTORY, Initial, read_initial
from crossloc3d_ros.training.material import Material
from crossloc3d_ros.training.validation import QUANTILES, Validation

SETTINGS = "run.json"
STATE = "state.pt"
LOG = "log.jsonl"
BEST = "best.safetensors"
FINAL = "final.safetensors"
MODEL_CARD = "MODEL_CARD.md"
CURVE = "progress.html"

_FREE_TO_CHANGE = {"threads", "workers", "device", "save_minutes", "validation_minutes", "log_steps", "rotations"}
"""Settings that a resumed run may change: they do not touch the weights."""


@dataclass(frozen=True)
class Settings:
    """What a run was begun with."""

    config: dict[str, Any]
    places: tuple[str, ...]
    places_sha256: str
    preset: str | None
    """Kind of the dataset; None for places."""
    initial: dict[str, Any] | None
    """Weights that it began with: `path`, `fingerprint`, and `history`, the chain up to and with them."""


def prepare(
    folder: Path, config: TrainConfig, material: Material, initial: Initial | None, *, resume: bool
) -> Initial | None:
    """Make the folder of a new run, or check that the one to resume has the same settings, places and beginning.

    Returns the weights that the run begins with: a run that was killed before it saved anything begins once more.
    """
    path = folder / SETTINGS
    noted = None
    if initial is not None:
        noted = {
            "path": str(initial.path),
            "fingerprint": initial.checkpoint.fingerprint,
            "history": initial.history,
        }
    if not resume:
        settings = Settings(
            to_dict(config), tuple(map(str, material.folders)), material.sha256(), material.preset, noted
        )
        if path.exists():
            raise TrainingError(f"{folder} holds a run already: go on with it by `--resume`, or name another folder")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TrainingError(f"cannot make {folder}: {error.strerror or error}") from error
        write_atomically(path, json.dumps(asdict(settings), indent=1) + "\n", TrainingError, synced=True)
        return initial
    before = check(folder, config, material)
    remove_leftovers(folder)
    if noted is not None and (before.initial or {}).get("fingerprint") != noted["fingerprint"]:
        raise TrainingError(f"the run in {folder} began with other weights; resume it without --initial")
    if initial is None and before.initial is not None and not (folder / STATE).exists():
        initial = read_initial(Path(before.initial["path"]), config.model)
        if initial.checkpoint.fingerprint != before.initial["fingerprint"]:
            raise TrainingError(f"{initial.path} no longer holds the weights that the run in {folder} began with")
    return initial


def check(folder: Path, config: TrainConfig, material: Material) -> Settings:
    """Return the settings of the run in a folder; raises TrainingError where they or its material are others."""
    before = read_settings(folder)
    if before.places_sha256 != material.sha256():
        raise TrainingError(f"the run in {folder} learned from other places than those named")
    old = to_dict(read_config(folder))  # a setting that did not exist yet has its default
    for key, value in to_dict(config).items():
        if key not in _FREE_TO_CHANGE and old[key] != value:
            raise TrainingError(
                f"the run in {folder} has '{key}' {old[key]}, not {value}: a resumed run keeps its settings"
            )
    return before


def read_settings(folder: Path) -> Settings:
    """Return what `prepare` wrote; raises TrainingError where the folder holds no run."""
    path = folder / SETTINGS
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        places = content["places"]
        return Settings(
            content["config"],
            (places,) if isinstance(places, str) else tuple(places),  # a run of one folder, as once written
            content["places_sha256"],
            content.get("preset"),
            content.get("initial"),
        )
    except FileNotFoundError as error:
        raise TrainingError(f"{folder} holds no training run") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"{path} is damaged ({error})") from error


def read_config(folder: Path) -> TrainConfig:
    """Return the configuration of a run."""
    return from_dict(TrainConfig, read_settings(folder).config)


def history(folder: Path) -> list[dict[str, Any]]:
    """Return the chain of weights that the run in `folder` began with, oldest first; empty where it began anew."""
    initial = read_settings(folder).initial
    return list(initial["history"]) if initial else []


def save_state(folder: Path, state: dict[str, Any]) -> None:
    """Write the state, whole or not at all."""
    try:
        with atomic_path(folder / STATE, None, synced=True) as partial, partial.open("wb") as file:
            torch.save(state, file)
    except (OSError, RuntimeError) as error:  # torch reports a full disk as RuntimeError
        reason = error.__context__ if isinstance(error.__context__, OSError) else error
        raise TrainingError(
            f"cannot write the state of the run into {folder}: {reason}; the one before is kept, go on by `--resume`"
        ) from error


def load_state(folder: Path) -> dict[str, Any] | None:
    """Read the state; None where a run was killed before its first one was written."""
    path = folder / STATE
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        return None
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise TrainingError(f"{path} cannot be read ({error}); start the run anew in another folder") from error
    return content


class Log:
    """The run's log, one JSON object a line: what happened, at which step, after how many seconds."""

    def __init__(self, folder: Path, step: int) -> None:
        """Open the log for appending; lines beyond `step` belong to work that was lost by a kill and go."""
        self._path = folder / LOG
        lines = [json.dumps(entry) for entry in read_log(folder) if entry["step"] <= step]
        if lines or self._path.exists():
            write_atomically(self._path, "".join(f"{line}\n" for line in lines), TrainingError, synced=True)

    def write(self, kind: str, **values: Any) -> None:
        """Append one entry."""
        try:
            with self._path.open("a") as file:
                file.write(json.dumps({"kind": kind, **values}) + "\n")
        except OSError as error:
            raise TrainingError(f"cannot write {self._path}: {error.strerror or error}") from error


def read_log(folder: Path) -> list[dict[str, Any]]:
    """Return the entries of a run's log; a last line that a kill cut off is left out."""
    path = folder / LOG
    entries = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            entries.append(json.loads(line))
        except ValueError:
            continue
    return entries


def machine(config: TrainConfig) -> dict[str, str]:
    """Return what the run is done on and with."""
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        processor = names[0] if names else processor
    return {
        "processor": processor,
        "cores": str(os.cpu_count()),
        "threads": str(config.threads),
        "accelerator": torch.cuda.get_device_name() if config.device == "cuda" else "none",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }


def metadata(
    config: TrainConfig, step: int, elapsed_s: float, validation: Validation, chain: list[dict[str, Any]]
) -> dict[str, str]:
    """Return what travels with the weights beside model and preprocessing: how they came about, and the distances.

    `examined` is the whole validation; `headings` and `turns` (test-time rotations) are how a query is encoded,
    `history` which weights the run began with (`chain`). `distances` holds the quantiles of the descriptor
    distance to the right submap and to the nearest wrong one on the held-out towns, `credibility` the calibration of
    the localizer.
    """
    distances = {
        "quantiles": QUANTILES,
        "true_match": validation.true_distances,
        "best_false_match": validation.false_distances,
        "queries": validation.queries,
        "submaps": validation.submaps,
    }
    recalls = {f"{r.label}@{r.radius_m:.0f}m": round(r.share.value, 4) for r in validation.recalls}
    training = {"steps": step, "hours": round(elapsed_s / 3600.0, 3), "pairs": config.pairs, "seed": config.seed}
    return {
        "credibility": stored_calibration(validation.calibration),
        "distances": json.dumps(distances),
        "validation": json.dumps(recalls),
        "training": json.dumps({**training, "loss": config.loss}),
        "examined": json.dumps({"kind": "validation", "step": step, "elapsed_s": elapsed_s, **validation.stored()}),
        "headings": str(config.headings),
        "turns": str(config.rotations),
        HISTORY: json.dumps(chain),
    }


def export(path: Path, model: Network, config: TrainConfig, extra: dict[str, str]) -> None:
    """Write weights as float16 safetensors with model, preprocessing and `extra` inside, whole or not at all."""
    save_checkpoint(path, model, config.preprocessing, extra, dtype="float16")
