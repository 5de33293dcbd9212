"""Start from weights that exist: what fits is taken over, what is new begins as it is initialised."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.checkpoint import Checkpoint, load_checkpoint
from crossloc3d_ros.errors import CheckpointError, TrainingError

HISTORY = "history"
"""Key of a weights file's metadata: the weights that its run began with, and theirs, oldest first (JSON)."""


@dataclass(frozen=True, eq=False)
class Initial:
    """Weights to begin with."""

    path: Path
    checkpoint: Checkpoint

    @property
    def history(self) -> list[dict[str, Any]]:
        """Return the chain of weights up to and with these, oldest first: file, fingerprint, and how learned."""
        notes = self.checkpoint.metadata
        try:
            before = json.loads(notes.get(HISTORY, "[]"))
            training = json.loads(notes.get("training", "{}"))
        except json.JSONDecodeError as error:
            raise CheckpointError(f"{self.path}: the notes on its training cannot be read ({error})") from error
        return [*before, {"weights": self.path.name, "fingerprint": self.checkpoint.fingerprint, "training": training}]


@dataclass(frozen=True)
class TakenOver:
    """Which tensors of a network came from the weights it began with."""

    taken: tuple[str, ...]
    new: tuple[str, ...]
    """Named in the network alone, or of another shape there."""
    unused: tuple[str, ...]
    """Named in the weights alone."""

    def sentence(self) -> str:
        """Return it as one line."""
        parts = [f"{len(self.taken)} of {len(self.taken) + len(self.new)} tensors taken over"]
        if self.new:
            parts.append(f"as initialised: {_names(self.new)}")
        if self.unused:
            parts.append(f"not used: {_names(self.unused)}")
        return "; ".join(parts)


def read_initial(path: Path, config: ModelConfig) -> Initial:
    """Read weights to begin with; raises CheckpointError for a damaged file, TrainingError for another network's."""
    checkpoint = load_checkpoint(path)
    theirs = checkpoint.model.config.network
    if theirs != config.network:
        raise TrainingError(f"{path} holds weights of the network '{theirs}', the run trains '{config.network}'")
    return Initial(path, checkpoint)


@torch.no_grad()
def take_over(model: nn.Module, initial: Initial) -> TakenOver:
    """Copy every tensor of the weights that fits the model by name and shape; raises TrainingError where none does."""
    mine, theirs = model.state_dict(), initial.checkpoint.model.state_dict()
    taken = [key for key, value in mine.items() if key in theirs and theirs[key].shape == value.shape]
    if not any(key in taken for key, _ in model.named_parameters()):
        raise TrainingError(f"no parameter in {initial.path} fits the network to train: is it another model's?")
    for key in taken:
        mine[key].copy_(theirs[key])
    return TakenOver(tuple(taken), tuple(sorted(mine.keys() - set(taken))), tuple(sorted(theirs.keys() - mine.keys())))


def _names(keys: tuple[str, ...], most: int = 6) -> str:
    """Return the first names of a list and how many more there are."""
    more = f" and {len(keys) - most} more" if len(keys) > most else ""
    return ", ".join(keys[:most]) + more
