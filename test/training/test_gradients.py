"""Multistage back-propagation gives the gradients of one large graph."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch import nn

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.networks import make_network
from crossloc3d_ros.training.gradients import batch_loss
from crossloc3d_ros.training.sampling import Batch, BatchSampler
from crossloc3d_ros.training.shards import TrainingTown
from crossloc3d_ros.training.state import make_criterion


@pytest.fixture
def batch(make_training_town: Callable[..., TrainingTown], tiny: TrainConfig) -> Batch:
    return BatchSampler([make_training_town(seed) for seed in range(2)], tiny).batch(0)


def without_norms(model: nn.Module) -> nn.Module:
    for name, child in model.named_children():
        if isinstance(child, nn.BatchNorm1d):
            setattr(model, name, nn.Identity())
        else:
            without_norms(child)
    return model


def gradients(model: nn.Module, batch: Batch, config: TrainConfig) -> tuple[float, dict[str, torch.Tensor]]:
    model, criterion = copy.deepcopy(model), make_criterion(config)
    loss = batch_loss(model, criterion, batch, config)  # type: ignore[arg-type]
    found = {**dict(model.named_parameters()), **dict(criterion.named_parameters())}
    return loss.item(), {key: value.grad for key, value in found.items() if value.grad is not None}


@pytest.mark.parametrize("loss", ["info_nce", "smooth_ap", "batch_hard"])
def test_without_batch_norm_chunks_give_the_gradients_of_one_graph(batch: Batch, tiny: TrainConfig, loss: str) -> None:
    torch.manual_seed(0)
    model = without_norms(make_network(tiny.model))
    config = dataclasses.replace(tiny, loss=loss)  # type: ignore[arg-type]
    whole, expected = gradients(model, batch, config)
    parts, found = gradients(model, batch, dataclasses.replace(config, chunk_pairs=4))
    assert parts == pytest.approx(whole, rel=1e-5)
    assert expected.keys() == found.keys()
    for key, value in expected.items():
        assert torch.allclose(found[key], value, rtol=1e-3, atol=1e-4 * float(value.abs().max()) + 1e-9), key


def test_one_chunk_is_the_plain_gradient_batch_norm_and_all(batch: Batch, tiny: TrainConfig) -> None:
    torch.manual_seed(0)
    model = make_network(tiny.model)
    whole, expected = gradients(model, batch, tiny)
    once, found = gradients(model, batch, dataclasses.replace(tiny, chunk_pairs=len(batch.scans)))
    assert once == whole
    assert all(torch.equal(found[key], value) for key, value in expected.items())


def test_with_batch_norm_the_gradients_are_those_of_the_loss_as_computed(batch: Batch, tiny: TrainConfig) -> None:
    """A step against them lowers that loss by what they promise."""
    torch.manual_seed(0)
    model = make_network(tiny.model)
    config = dataclasses.replace(tiny, chunk_pairs=2)
    before, found = gradients(model, batch, config)
    squared = sum(float(g.square().sum()) for key, g in found.items() if key != "log_scale")
    step = 1e-3 * before / squared
    with torch.no_grad():
        for key, parameter in model.named_parameters():
            parameter -= step * found[key]
    after, _ = gradients(model, batch, config)
    assert before - after == pytest.approx(step * squared, rel=0.2)


def test_the_running_statistics_move_once_a_chunk(batch: Batch, tiny: TrainConfig) -> None:
    torch.manual_seed(0)
    model = make_network(tiny.model)
    config = dataclasses.replace(tiny, chunk_pairs=2)
    batch_loss(model, make_criterion(config), batch, config)  # type: ignore[arg-type]
    counts = {int(m.num_batches_tracked) for m in model.modules() if isinstance(m, nn.BatchNorm1d)}
    assert counts == {3}


def test_the_network_learns_under_autocast(batch: Batch, tiny: TrainConfig) -> None:
    torch.manual_seed(0)
    model = make_network(tiny.model)
    _, expected = gradients(model, batch, tiny)
    with torch.autocast("cpu", torch.bfloat16):
        _, found = gradients(model, batch, tiny)
    flat = [torch.cat([value.float().flatten() for value in side.values()]) for side in (expected, found)]
    assert torch.isfinite(flat[1]).all()
    assert float(torch.nn.functional.cosine_similarity(*flat, dim=0)) > 0.7
