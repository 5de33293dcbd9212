"""The training run: batches in, weights out, in pieces that may be killed at any moment."""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.model import CrossLoc3D
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.loss import BatchHardTriplet, InfoNCE
from crossloc3d_ros.training.memory import keep_freed_memory
from crossloc3d_ros.training.model_card import model_card
from crossloc3d_ros.training.sampling import BatchSampler
from crossloc3d_ros.training.shards import (
    TRAINING,
    VALIDATION,
    Manifest,
    ValidationTown,
    read_manifest,
    read_training_town,
    read_validation_town,
    write_text,
)
from crossloc3d_ros.training.validation import Validation, validate
from crossloc3d_ros.types import Float32Array

logger = logging.getLogger(__name__)

_ENCODE_BATCH = 32
_NORM_BATCHES = 8
_NORM_STEP = 2**40  # batches for the norm statistics come from beyond any run's own
_MOST_BAD_STEPS = 20


@dataclass(frozen=True)
class Budget:
    """How long to learn: minutes on the clock, or a number of steps, which makes a run repeatable to the bit."""

    minutes: float | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.steps is None):
            raise TrainingError("give the training either minutes or steps")
        if (self.minutes or self.steps or 0) <= 0:
            raise TrainingError("the training's budget must be positive")

    def option(self) -> str:
        """Return the budget as it is said on the command line."""
        return f"--budget-steps {self.steps}" if self.steps is not None else f"--budget-minutes {self.minutes:g}"

    def share(self, elapsed_s: float, step: int) -> float:
        """Return how much of the budget is used, 1 at its end."""
        if self.steps is not None:
            return step / self.steps
        assert self.minutes is not None
        return elapsed_s / (60.0 * self.minutes)


@dataclass(frozen=True)
class Progress:
    """Where a run stands, for whoever shows it."""

    step: int
    share: float
    loss: float
    learning_rate: float
    samples_per_second: float
    remaining_s: float
    validation: Validation | None = None


@dataclass
class RunState:
    """Everything that a run needs in order to go on as if it had never stopped."""

    model: CrossLoc3D
    averaged: CrossLoc3D
    criterion: nn.Module
    optimizer: torch.optim.Optimizer
    step: int = 0
    elapsed_s: float = 0.0
    best_recall: float = -1.0
    last_validation_s: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the state as what `torch.load(weights_only=True)` reads back."""
        return {
            "model": self.model.state_dict(),
            "averaged": self.averaged.state_dict(),
            "criterion": self.criterion.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
            "elapsed_s": self.elapsed_s,
            "best_recall": self.best_recall,
            "last_validation_s": self.last_validation_s,
            "torch_rng": torch.get_rng_state(),
        }

    def load_dict(self, content: dict[str, Any]) -> None:
        """Take over a state; strict about every name and shape."""
        self.model.load_state_dict(content["model"])
        self.averaged.load_state_dict(content["averaged"])
        self.criterion.load_state_dict(content["criterion"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.step = content["step"]
        self.elapsed_s = content["elapsed_s"]
        self.best_recall = content["best_recall"]
        self.last_validation_s = content["last_validation_s"]
        torch.set_rng_state(content["torch_rng"])


@dataclass
class Trainer:
    """One run over one set of places in one folder."""

    config: TrainConfig
    places: Path
    folder: Path
    budget: Budget
    report: Callable[[Progress], None] = field(default=lambda progress: None)
    clock: Callable[[], float] = time.monotonic

    def run(self, *, resume: bool = False) -> Validation:
        """Train until the budget is used, validate, write the weights and return the last validation.

        A folder that holds a run already is refused unless `resume`; resuming goes on with the saved state, and with
        a budget in steps it ends with the same weights as a run that was never stopped.
        """
        config = self.config
        torch.set_num_threads(config.threads)
        keep_freed_memory()
        manifest = read_manifest(self.places)
        run_folder.prepare(self.folder, config, manifest, self.places, resume=resume)
        sampler = BatchSampler([read_training_town(self.places / t.file) for t in manifest.of_role(TRAINING)], config)
        held_out = load_validation(self.places, manifest)
        state = new_state(config)
        saved = run_folder.load_state(self.folder) if resume else None
        if saved is not None:
            state.load_dict(saved)
        log = run_folder.Log(self.folder, state.step)
        log.write(
            "start", step=state.step, elapsed_s=round(state.elapsed_s, 1), budget=self.budget.option(),
            **run_folder.machine(config),
        )  # fmt: skip
        self._learn(state, sampler, held_out, log)
        state.averaged = with_fresh_norms(state.averaged, sampler, config)
        validation = self._validate(state, held_out, log, state.averaged)
        run_folder.save_state(self.folder, state.to_dict())
        run_folder.export(self.folder / run_folder.FINAL, state.averaged, config, self._metadata(state, validation))
        return validation

    def write_card(self) -> Path:
        """Write the model card of the run into its folder and return its path."""
        path = self.folder / run_folder.MODEL_CARD
        write_text(path, model_card(self.folder, read_manifest(self.places)))
        return path

    def _learn(
        self, state: RunState, sampler: BatchSampler, held_out: Sequence[ValidationTown], log: run_folder.Log
    ) -> None:
        config = self.config
        started = self.clock() - state.elapsed_s
        last_saved = last_logged = state.elapsed_s
        logged_step = state.step
        losses: list[float] = []
        bad_steps = 0
        while (share := self.budget.share(state.elapsed_s, state.step)) < 1.0:
            rate = learning_rate(share, config)
            loss = take_step(state, sampler, rate, config)
            if math.isfinite(loss):
                losses.append(loss)
                bad_steps = 0
            else:
                bad_steps += 1
                if bad_steps >= _MOST_BAD_STEPS:
                    raise TrainingError(f"the loss was not finite {bad_steps} times in a row; lower the learning rate")
            state.step += 1
            state.elapsed_s = self.clock() - started

            if state.step % config.log_steps == 0:
                seconds = max(state.elapsed_s - last_logged, 1e-9)
                samples = 2 * config.pairs * (state.step - logged_step) / seconds
                mean = float(np.mean(losses)) if losses else math.nan
                used = max(self.budget.share(state.elapsed_s, state.step), 1e-9)
                remaining = state.elapsed_s * (1.0 / used - 1.0)
                self.report(Progress(state.step, used, mean, rate, samples, max(0.0, remaining)))
                log.write(
                    "step", step=state.step, elapsed_s=round(state.elapsed_s, 1), loss=round(mean, 5), rate=rate,
                    samples_per_s=round(samples, 2), scale=_scale(state.criterion),
                )  # fmt: skip
                losses.clear()
                last_logged, logged_step = state.elapsed_s, state.step
            if state.elapsed_s - state.last_validation_s >= 60.0 * config.validation_minutes:
                state.last_validation_s = state.elapsed_s
                averaged = with_fresh_norms(state.averaged, sampler, config)
                validation = self._validate(state, held_out, log, averaged)
                recall = validation.recall("R@1", 100.0).value
                metadata = self._metadata(state, validation)
                run_folder.export(self.folder / f"step_{state.step:06d}.safetensors", averaged, config, metadata)
                if recall > state.best_recall:
                    state.best_recall = recall
                    run_folder.export(self.folder / run_folder.BEST, averaged, config, metadata)
                self.report(Progress(state.step, share, loss, rate, 0.0, 0.0, validation))
                state.elapsed_s = self.clock() - started
                last_logged, logged_step = state.elapsed_s, state.step
            if state.elapsed_s - last_saved >= 60.0 * config.save_minutes:
                last_saved = state.elapsed_s
                run_folder.save_state(self.folder, state.to_dict())

    def _validate(
        self, state: RunState, held_out: Sequence[ValidationTown], log: run_folder.Log, model: CrossLoc3D
    ) -> Validation:
        began = time.monotonic()
        validation = validate(held_out, lambda clouds: encode(model, clouds, self.config.device))
        log.write(
            "validation", step=state.step, elapsed_s=round(state.elapsed_s, 1),
            seconds=round(time.monotonic() - began, 1), **asdict(validation),
        )  # fmt: skip
        return validation

    def _metadata(self, state: RunState, validation: Validation) -> dict[str, str]:
        return run_folder.metadata(self.config, state.step, state.elapsed_s, validation)


def export_run(folder: Path, output: Path, places: Path | None = None) -> Path:
    """Write the weights of a run as it was last saved, with their card beside them; return the card's path.

    The run may have ended, been killed or still be going on. The weights are validated first, so that the card and
    the calibration in the weights are those of just these weights.
    """
    config = run_folder.read_config(folder)
    torch.set_num_threads(config.threads)
    places = places or Path(run_folder.read_settings(folder)["places"])
    manifest = read_manifest(places)
    saved = run_folder.load_state(folder)
    if saved is None:
        raise TrainingError(f"the run in {folder} has not saved a state yet")
    state = new_state(config)
    state.load_dict(saved)
    sampler = BatchSampler([read_training_town(places / t.file) for t in manifest.of_role(TRAINING)], config)
    model = with_fresh_norms(state.averaged, sampler, config)
    validation = validate(load_validation(places, manifest), lambda clouds: encode(model, clouds, config.device))
    output.parent.mkdir(parents=True, exist_ok=True)
    run_folder.export(output, model, config, run_folder.metadata(config, state.step, state.elapsed_s, validation))
    result = {"kind": "validation", "step": state.step, "elapsed_s": state.elapsed_s, **asdict(validation)}
    card = output.parent / run_folder.MODEL_CARD
    write_text(card, model_card(folder, manifest, result))
    return card


def new_state(config: TrainConfig) -> RunState:
    """Return the state that a run begins with; the seed decides the weights."""
    torch.manual_seed(config.seed)
    model = CrossLoc3D(config.model).to(config.device).train()
    averaged = copy.deepcopy(model).eval().requires_grad_(False)
    criterion = (InfoNCE() if config.loss == "info_nce" else BatchHardTriplet(config.margin)).to(config.device)
    matrices = [p for p in model.parameters() if p.ndim > 1]
    others = [p for p in model.parameters() if p.ndim <= 1]
    groups = [
        {"params": matrices, "weight_decay": config.weight_decay},
        {"params": [*others, *criterion.parameters()], "weight_decay": 0.0},
    ]
    return RunState(model, averaged, criterion, torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, 0.99)))


def learning_rate(share: float, config: TrainConfig) -> float:
    """Return the learning rate at a share of the budget: linear warm-up, then half a cosine."""
    if share < config.warm_up:
        return config.learning_rate * (0.01 + 0.99 * share / config.warm_up)
    progress = min(1.0, (share - config.warm_up) / max(1e-9, 1.0 - config.warm_up))
    cosine = 0.5 * (1.0 + math.cos(math.pi * progress))
    return config.learning_rate * (config.final_share + (1.0 - config.final_share) * cosine)


def take_step(state: RunState, sampler: BatchSampler, rate: float, config: TrainConfig) -> float:
    """Learn from one batch and return its loss; weights stay as they are where it is not finite."""
    batch = sampler.batch(state.step)
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    descriptors = state.model(_tensors([*batch.scans, *batch.submaps], config.device))
    ignored = torch.from_numpy(batch.ignored).to(config.device)
    loss: Tensor = state.criterion(descriptors[: config.pairs], descriptors[config.pairs :], ignored)
    state.optimizer.zero_grad(set_to_none=True)
    if not torch.isfinite(loss):
        return loss.item()
    loss.backward()  # type: ignore[no-untyped-call]
    norm = nn.utils.clip_grad_norm_(state.model.parameters(), config.clip_norm or math.inf)
    if torch.isfinite(norm):
        state.optimizer.step()
        average(state.averaged, state.model, min(config.ema_decay, (1.0 + state.step) / (10.0 + state.step)))
    return loss.item()


@torch.no_grad()
def average(averaged: nn.Module, model: nn.Module, decay: float) -> None:
    """Move the averaged weights and statistics towards the model's: a = decay a + (1 - decay) w."""
    mine, theirs = averaged.state_dict(), model.state_dict()
    moving = [key for key, value in mine.items() if value.is_floating_point()]
    torch._foreach_lerp_([mine[key] for key in moving], [theirs[key] for key in moving], 1.0 - decay)
    for key in mine.keys() - set(moving):
        mine[key].copy_(theirs[key])


@torch.no_grad()
def with_fresh_norms(model: CrossLoc3D, sampler: BatchSampler, config: TrainConfig) -> CrossLoc3D:
    """Return a copy whose batch norms hold the statistics of its own weights, not an average of older ones'."""
    fresh = copy.deepcopy(model).train()
    norms = [module for module in fresh.modules() if isinstance(module, nn.BatchNorm1d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain mean over the batches
    for i in range(_NORM_BATCHES):
        batch = sampler.batch(_NORM_STEP + i)
        fresh(_tensors([*batch.scans, *batch.submaps], config.device))
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    return fresh.eval()


@torch.no_grad()
def encode(model: CrossLoc3D, clouds: Sequence[Float32Array], device: str) -> Float32Array:
    """Return the descriptors (B, D) of patches."""
    parts = [
        model(_tensors(clouds[i : i + _ENCODE_BATCH], device)).float().cpu().numpy()
        for i in range(0, len(clouds), _ENCODE_BATCH)
    ]
    return np.concatenate(parts)


def load_validation(places: Path, manifest: Manifest) -> list[ValidationTown]:
    """Read the held-out towns; raises TrainingError where there are none."""
    towns = [read_validation_town(places / town.file) for town in manifest.of_role(VALIDATION)]
    if not towns or not any(len(t.query_xy_m) for t in towns) or not any(len(t.submap_xy_m) for t in towns):
        raise TrainingError(f"{places} holds no towns to validate on; make them with `--validation-towns`")
    return towns


def _tensors(clouds: Sequence[Float32Array], device: str) -> list[Tensor]:
    return [torch.from_numpy(cloud).to(device) for cloud in clouds]


def _scale(criterion: nn.Module) -> float | None:
    return round(criterion.log_scale.exp().item(), 3) if isinstance(criterion, InfoNCE) else None
