"""What a run changes while it learns: weights, their average, the optimizer."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import nn

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.networks import make_network
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training.loss import BatchHardTriplet, Criterion, InfoNCE, TruncatedSmoothAP
from crossloc3d_ros.training.sampling import HardPlaces


@dataclass
class RunState:
    """Everything that a run needs in order to go on as if it had never stopped."""

    model: Network
    averaged: Network
    criterion: nn.Module
    optimizer: torch.optim.Optimizer
    pairs: int
    """Pairs in a batch, by now."""
    step: int = 0
    clouds: int = 0
    """Clouds learned from."""
    elapsed_s: float = 0.0
    best_recall: float = -1.0
    last_validation_s: float = 0.0
    active_share: float = 0.0
    """Sum of the shares of active triplets since the batches last grew or did not."""
    hard: HardPlaces | None = None
    """What the last search for confused places found."""

    @property
    def loss(self) -> Criterion:
        """The criterion as a function."""
        return cast(Criterion, self.criterion)

    def to_dict(self) -> dict[str, Any]:
        """Return the state as what `torch.load(weights_only=True)` reads back."""
        content = {
            "model": self.model.state_dict(),
            "averaged": self.averaged.state_dict(),
            "criterion": self.criterion.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "elapsed_s": self.elapsed_s,
            "best_recall": self.best_recall,
            "last_validation_s": self.last_validation_s,
            "pairs": self.pairs,
            "clouds": self.clouds,
            "active_share": self.active_share,
            "torch_rng": torch.get_rng_state(),
        }
        if self.hard is not None:
            content["hard"] = {key: torch.from_numpy(value) for key, value in vars(self.hard).items()}
        if torch.cuda.is_available():
            content["cuda_rng"] = torch.cuda.get_rng_state()
        return content

    def load_dict(self, content: dict[str, Any]) -> None:
        """Take over a state; raises TrainingError where it is not that of this network."""
        try:
            self.model.load_state_dict(content["model"])
            self.averaged.load_state_dict(content["averaged"])
            self.criterion.load_state_dict(content["criterion"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.step = content["step"]
            self.elapsed_s = content["elapsed_s"]
            self.best_recall = content["best_recall"]
            self.last_validation_s = content["last_validation_s"]
            self.pairs = content.get("pairs", self.pairs)  # the next three came later
            self.clouds = content.get("clouds", 2 * self.pairs * self.step)
            self.active_share = content.get("active_share", 0.0)
            if "hard" in content:
                self.hard = HardPlaces(**{key: value.numpy() for key, value in content["hard"].items()})
            torch.set_rng_state(content["torch_rng"])
            if "cuda_rng" in content and torch.cuda.is_available():
                torch.cuda.set_rng_state(content["cuda_rng"])
        except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise TrainingError(f"the saved state is not that of this run's network ({reason})") from error


def new_state(config: TrainConfig) -> RunState:
    """Return the state that a run begins with; the seed decides the weights."""
    torch.manual_seed(config.seed)
    model = make_network(config.model).to(config.device).train()
    averaged = copy.deepcopy(model).eval().requires_grad_(False)
    criterion = make_criterion(config).to(config.device)
    matrices = [p for p in model.parameters() if p.ndim > 1]
    others = [p for p in model.parameters() if p.ndim <= 1]
    groups = [
        {"params": matrices, "weight_decay": config.weight_decay},
        {"params": [*others, *criterion.parameters()], "weight_decay": 0.0},
    ]
    optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, config.beta2))
    return RunState(model, averaged, criterion, optimizer, config.pairs)


def make_criterion(config: TrainConfig) -> nn.Module:
    """Return the loss that the configuration names."""
    if config.loss == "smooth_ap":
        return TruncatedSmoothAP(config.temperature, config.positives)
    return InfoNCE() if config.loss == "info_nce" else BatchHardTriplet(config.margin)


def grow_batches(state: RunState, config: TrainConfig) -> None:
    """Enlarge the batches where the last ones had too few active triplets; call it after every step."""
    if not config.most_pairs or not isinstance(state.criterion, BatchHardTriplet):
        return
    if state.criterion.active_share is not None:
        state.active_share += float(state.criterion.active_share)
    if state.step % config.growth_steps == 0:
        if state.active_share / config.growth_steps < config.growth_below:
            state.pairs = min(int(state.pairs * config.growth), config.most_pairs)
        state.active_share = 0.0


@torch.no_grad()
def average(averaged: nn.Module, model: nn.Module, decay: float) -> None:
    """Move the averaged weights and statistics towards the model's: a = decay a + (1 - decay) w."""
    mine, theirs = averaged.state_dict(), model.state_dict()
    moving = [key for key, value in mine.items() if value.is_floating_point()]
    torch._foreach_lerp_([mine[key] for key in moving], [theirs[key] for key in moving], 1.0 - decay)
    for key in mine.keys() - set(moving):
        mine[key].copy_(theirs[key])
