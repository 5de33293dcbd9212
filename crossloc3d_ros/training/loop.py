"""The training run: batches in, weights out, in pieces that may be killed at any moment."""

from __future__ import annotations

import copy
import dataclasses
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import nn

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.ahead import BatchesAhead
from crossloc3d_ros.training.curve import write_curve
from crossloc3d_ros.training.gradients import batch_loss, tensors
from crossloc3d_ros.training.initial import Initial, read_initial, take_over
from crossloc3d_ros.training.loss import InfoNCE
from crossloc3d_ros.training.material import Material, read_material
from crossloc3d_ros.training.memory import keep_freed_memory
from crossloc3d_ros.training.mining import mine
from crossloc3d_ros.training.model_card import model_card
from crossloc3d_ros.training.sampling import HardPlaces, Sampler
from crossloc3d_ros.training.schedule import Budget, learning_rate
from crossloc3d_ros.training.shards import ValidationTown
from crossloc3d_ros.training.state import RunState, average, grow_batches, new_state
from crossloc3d_ros.training.validation import Validation, validate
from crossloc3d_ros.types import Float32Array

logger = logging.getLogger(__name__)

_ENCODE_BATCH = 32  # clouds without a graph at once; bounds the memory
_NORM_BATCHES = 8  # enough for means and variances of every channel
_NORM_STEP = 2**40  # batches for the norm statistics come from beyond any run's own
_MOST_BAD_STEPS = 20  # so many losses in a row that are not finite do not recover


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
class Trainer:
    """One run over folders of places, in a folder of its own."""

    config: TrainConfig
    places: Sequence[Path]
    folder: Path
    budget: Budget
    initial: Path | None = None
    """Weights to begin with; a resumed run has its own."""
    preset: str | None = None
    """Kind of a dataset, where `places` is one whose files do not name it."""
    report: Callable[[Progress], None] = field(default=lambda progress: None)
    clock: Callable[[], float] = time.monotonic

    def run(self, *, resume: bool = False) -> Validation:
        """Train until the budget is used, validate, write the weights and return the last validation.

        A folder that holds a run already is refused unless `resume`; resuming goes on with the saved state, and with
        a budget in steps it ends with the same weights as a run that was never stopped. The budget of a resumed run
        may be another one.
        """
        config = self.config
        if config.device == "cuda" and not torch.cuda.is_available():
            raise TrainingError("device 'cuda': this machine's torch sees no GPU; use cpu")
        torch.set_num_threads(config.threads)
        keep_freed_memory()
        material = read_material(self.places, config.preprocessing, self.preset)
        initial = None if self.initial is None else read_initial(self.initial, config.model)
        initial = run_folder.prepare(self.folder, config, material, initial, resume=resume)
        sampler = material.sampler(config)
        held_out = material.validation_towns(config)
        log, state = self._begin(initial, resume=resume)
        with _drawn_ahead(sampler, config.workers) as batches:
            self._learn(state, batches, held_out, log)
        averaged = with_fresh_norms(state.averaged, sampler, config)
        validation = self._validate(state, held_out, log, averaged)
        run_folder.save_state(self.folder, state.to_dict())  # before anything else can fail for want of space
        self._export(state, averaged, validation, run_folder.FINAL)
        run_folder.save_state(self.folder, state.to_dict())  # with the best recall
        self._draw(live=False)
        return validation

    def check(self) -> None:
        """Raise TrainingError where the folder holds no run, or one with other settings, places or beginning."""
        material = read_material(self.places, self.config.preprocessing, self.preset)
        run_folder.check(self.folder, self.config, material)

    def write_card(self) -> Path:
        """Write the model card of the run into its folder and return its path."""
        path = self.folder / run_folder.MODEL_CARD
        card = model_card(self.folder, read_material(self.places, preset=self.preset))
        write_atomically(path, card, TrainingError, synced=True)
        return path

    def _begin(self, initial: Initial | None, *, resume: bool) -> tuple[run_folder.Log, RunState]:
        """Return the state to go on from and the log: the saved state, or the one that the run begins with."""
        state = new_state(self.config)
        saved = run_folder.load_state(self.folder) if resume else None
        if saved is not None:
            state.load_dict(saved)
        log = run_folder.Log(self.folder, -1 if saved is None else state.step)
        if saved is None and initial is not None:
            taken = take_over(state.model, initial)
            state.averaged.load_state_dict(state.model.state_dict())
            logger.info("%s: %s", initial.path, taken.sentence())
            log.write("initial", step=0, weights=str(initial.path), **asdict(taken))
        log.write(
            "start", step=state.step, elapsed_s=round(state.elapsed_s, 1), budget=self.budget.option(),
            **run_folder.machine(self.config),
        )  # fmt: skip
        return log, state

    def _learn(
        self, state: RunState, sampler: Sampler, held_out: Sequence[ValidationTown], log: run_folder.Log
    ) -> None:
        """Take steps until the budget is used; log, validate and save now and then."""
        config = self.config
        started = self.clock() - state.elapsed_s
        last_saved = state.elapsed_s
        meter = _Meter(state)
        while (share := self.budget.share(state.elapsed_s, state.step)) < 1.0:
            if config.hard_share > 0.0 and state.step > 0 and state.step % config.mine_steps == 0:
                state.hard = self._mine(state, sampler, log)
            rate = learning_rate(share, config)
            loss = take_step(state, sampler, rate, config)
            meter.add(loss)
            state.elapsed_s = self.clock() - started
            if state.step % config.log_steps == 0:
                self._log_step(state, meter, rate, log)
                meter = _Meter(state, meter.bad_steps)
            if state.elapsed_s - state.last_validation_s >= 60.0 * config.validation_minutes:
                state.last_validation_s = state.elapsed_s
                averaged = with_fresh_norms(state.averaged, sampler, config)
                validation = self._validate(state, held_out, log, averaged)
                self._export(state, averaged, validation, f"step_{state.step:06d}.safetensors")
                self.report(Progress(state.step, share, loss, rate, 0.0, 0.0, validation))
                self._draw(live=True)
                state.elapsed_s = self.clock() - started
                meter = _Meter(state, meter.bad_steps)
            if state.elapsed_s - last_saved >= 60.0 * config.save_minutes:
                last_saved = state.elapsed_s
                run_folder.save_state(self.folder, state.to_dict())

    def _log_step(self, state: RunState, meter: _Meter, rate: float, log: run_folder.Log) -> None:
        """Report and log the progress of the run."""
        samples, loss = meter.clouds_per_second(state), meter.mean()
        used = max(self.budget.share(state.elapsed_s, state.step), 1e-9)
        remaining_s = max(0.0, state.elapsed_s * (1.0 / used - 1.0))
        self.report(Progress(state.step, used, loss, rate, samples, remaining_s))
        log.write(
            "step", step=state.step, elapsed_s=round(state.elapsed_s, 1), loss=round(loss, 5), rate=rate,
            samples_per_s=round(samples, 2), clouds=state.clouds, pairs=state.pairs, scale=_scale(state.criterion),
        )  # fmt: skip

    def _export(self, state: RunState, averaged: Network, validation: Validation, name: str) -> None:
        """Write weights that were just validated, also as the best ones where they are."""
        history = run_folder.history(self.folder)
        notes = run_folder.metadata(self.config, state.step, state.elapsed_s, validation, history)
        run_folder.export(self.folder / name, averaged, self.config, notes)
        recall = validation.recall("R@1", 100.0).share.value
        if recall > state.best_recall:
            state.best_recall = recall
            run_folder.export(self.folder / run_folder.BEST, averaged, self.config, notes)

    def _draw(self, *, live: bool) -> None:
        """Write the page on how the run goes, once there is something to draw."""
        if any(entry["kind"] == "step" for entry in run_folder.read_log(self.folder)):
            write_curve(self.folder, live=live)

    def _mine(self, state: RunState, sampler: Sampler, log: run_folder.Log) -> HardPlaces:
        began = time.monotonic()
        model = with_fresh_norms(state.averaged, sampler, self.config)
        hard = mine(sampler, lambda clouds: encode(model, clouds, self.config.device), self.config, state.step)
        log.write("mining", step=state.step, places=len(hard.town), seconds=round(time.monotonic() - began, 1))
        return hard

    def _validate(
        self, state: RunState, held_out: Sequence[ValidationTown], log: run_folder.Log, model: Network
    ) -> Validation:
        began = time.monotonic()
        config = self.config
        validation = validate(held_out, lambda c: encode(model, c, config.device), config.headings, config.rotations)
        log.write(
            "validation", step=state.step, elapsed_s=round(state.elapsed_s, 1),
            seconds=round(time.monotonic() - began, 1), **validation.stored(),
        )  # fmt: skip
        return validation


class _Meter:
    """What happened since the last line of the log."""

    def __init__(self, state: RunState, bad_steps: int = 0) -> None:
        self._elapsed_s, self._clouds = state.elapsed_s, state.clouds
        self._losses: list[float] = []
        self.bad_steps = bad_steps
        """Steps in a row, up to the last one, whose loss was not finite."""

    def add(self, loss: float) -> None:
        """Count a step; raises TrainingError where too many in a row went wrong."""
        if math.isfinite(loss):
            self._losses.append(loss)
            self.bad_steps = 0
            return
        self.bad_steps += 1
        if self.bad_steps >= _MOST_BAD_STEPS:
            raise TrainingError(f"the loss was not finite {self.bad_steps} times in a row; lower the learning rate")

    def mean(self) -> float:
        """Return the mean of the finite losses; NaN where there was none."""
        return float(np.mean(self._losses)) if self._losses else math.nan

    def clouds_per_second(self, state: RunState) -> float:
        """Return the rate up to `state`."""
        return (state.clouds - self._clouds) / max(state.elapsed_s - self._elapsed_s, 1e-9)


def export_run(folder: Path, output: Path, places: Sequence[Path] = ()) -> Path:
    """Write the weights of a run as it was last saved, with their card beside them; return the card's path.

    The run may have ended, been killed or still be going on. The weights are validated first, so that the card and
    the calibration in the weights are those of just these weights. `places`: where the run's places are now.
    """
    config = run_folder.read_config(folder)
    if not torch.cuda.is_available():
        config = dataclasses.replace(config, device="cpu", precision="float32")
    torch.set_num_threads(config.threads)
    settings = run_folder.read_settings(folder)
    material = read_material(places or [Path(name) for name in settings.places], preset=settings.preset)
    if material.sha256() != settings.places_sha256:
        raise TrainingError(f"the run in {folder} learned from other places than those named")
    saved = run_folder.load_state(folder)
    if saved is None:
        raise TrainingError(f"the run in {folder} has not saved a state yet")
    state = new_state(config)
    state.load_dict(saved)
    model = with_fresh_norms(state.averaged, material.sampler(config), config)
    held_out = material.validation_towns(config)
    validation = validate(held_out, lambda c: encode(model, c, config.device), config.headings, config.rotations)
    output.parent.mkdir(parents=True, exist_ok=True)
    notes = run_folder.metadata(config, state.step, state.elapsed_s, validation, run_folder.history(folder))
    run_folder.export(output, model, config, notes)
    return write_card(folder, output, material)


def write_card(folder: Path, weights: Path, material: Material | None = None, results: Sequence[Path] = ()) -> Path:
    """Write the card of weights that were exported from the run in `folder` beside them, and return its path.

    `material`: what the run learned from, by default where it lay then; `results`: JSON files of `evaluate`, of these
    weights.
    """
    if material is None:
        settings = run_folder.read_settings(folder)
        material = read_material([Path(name) for name in settings.places], preset=settings.preset)
    card = weights.parent / run_folder.MODEL_CARD
    write_atomically(card, model_card(folder, material, weights=weights, results=results), TrainingError, synced=True)
    return card


def take_step(state: RunState, sampler: Sampler, rate: float, config: TrainConfig) -> float:
    """Learn from one batch and return its loss; weights stay as they are where it is not finite."""
    batch = sampler.batch(state.step, pairs=state.pairs, hard=state.hard)
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    state.optimizer.zero_grad(set_to_none=True)
    loss = batch_loss(state.model, state.loss, batch, config).item()
    if math.isfinite(loss):
        norm = nn.utils.clip_grad_norm_(state.model.parameters(), config.clip_norm or math.inf)
        if torch.isfinite(norm):
            state.optimizer.step()
            average(state.averaged, state.model, min(config.ema_decay, (1.0 + state.step) / (10.0 + state.step)))
    state.step += 1
    state.clouds += 2 * len(batch.scans)
    grow_batches(state, config)
    return loss


@torch.no_grad()
def with_fresh_norms(model: Network, sampler: Sampler, config: TrainConfig) -> Network:
    """Return a copy whose batch norms hold the statistics of its own weights, not an average of older ones'."""
    fresh = copy.deepcopy(model).train()
    norms = [module for module in fresh.modules() if isinstance(module, nn.modules.batchnorm._BatchNorm)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # a plain mean over the batches
    pairs = min(config.pairs, config.chunk_pairs or config.pairs)
    for i in range(_NORM_BATCHES):
        batch = sampler.batch(_NORM_STEP + i, pairs=pairs)
        fresh(tensors([*batch.scans, *batch.submaps], config.device))
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
    return fresh.eval()


@torch.no_grad()
def encode(model: Network, clouds: Sequence[Float32Array], device: str) -> Float32Array:
    """Return the descriptors (B, D) of patches."""
    parts = [
        model(tensors(clouds[i : i + _ENCODE_BATCH], device)).float().cpu().numpy()
        for i in range(0, len(clouds), _ENCODE_BATCH)
    ]
    return np.concatenate(parts)


@contextmanager
def _drawn_ahead(sampler: Sampler, workers: int) -> Iterator[Sampler]:
    """Give a sampler that draws ahead in threads, or the same one without threads."""
    if workers == 0:
        yield sampler
        return
    with closing(BatchesAhead(sampler, workers)) as batches:
        yield batches


def _scale(criterion: nn.Module) -> float | None:
    return round(criterion.log_scale.exp().item(), 3) if isinstance(criterion, InfoNCE) else None
