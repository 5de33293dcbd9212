"""The gradient of a batch's loss, of batches larger too than a graph that fits into memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from torch import Tensor, nn

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.training.loss import Criterion
from crossloc3d_ros.training.sampling import Batch
from crossloc3d_ros.types import Float32Array


def batch_loss(model: Network, criterion: Criterion, batch: Batch, config: TrainConfig) -> Tensor:
    """Return the loss of a batch, and leave its gradients with the parameters where it is finite.

    With `config.chunk_pairs` the batch is encoded in chunks (multistage back-propagation, as MinkLoc3Dv2 does it):
    all descriptors without a graph; the loss and its gradient with regard to them; then chunk by chunk once more with
    a graph, into which the descriptors' gradients are led. Memory is that of a chunk, the loss that of the whole
    batch. A chunk's batch norms use the statistics of that chunk, in both passes, so that the gradients are those of
    the loss as it was computed; for a network without batch norm they are those of one large graph.
    """
    clouds = [tensors(patches, config.device) for patches in (batch.scans, batch.submaps)]
    pairs = len(batch.scans)
    ignored = torch.from_numpy(batch.ignored).to(config.device)
    matches = torch.from_numpy(batch.matches).to(config.device)
    chunks = _chunks(pairs, config.chunk_pairs)
    if len(chunks) == 1:
        with mixed_precision(config):
            encoded = model([*clouds[0], *clouds[1]])
        encoded = encoded.float()
        loss = criterion(encoded[:pairs], encoded[pairs:], ignored, matches)
        if torch.isfinite(loss):
            loss.backward()  # type: ignore[no-untyped-call]
        return loss.detach()
    return _loss_in_chunks(model, clouds, chunks, lambda x: criterion(x[:pairs], x[pairs:], ignored, matches), config)


def tensors(clouds: Sequence[Float32Array], device: str) -> list[Tensor]:
    """Return clouds (n, 3) as tensors on a device."""
    return [torch.from_numpy(cloud).to(device) for cloud in clouds]


def mixed_precision(config: TrainConfig) -> AbstractContextManager[object]:
    """Return the context in which the network computes: matrix products in bfloat16 where configured so."""
    if config.precision == "bfloat16":
        return torch.autocast(config.device, torch.bfloat16)
    return nullcontext()


def _loss_in_chunks(
    model: Network,
    clouds: Sequence[Sequence[Tensor]],
    chunks: Sequence[range],
    loss_of: Callable[[Tensor], Tensor],
    config: TrainConfig,
) -> Tensor:
    """Return the loss by multistage back-propagation; `loss_of` takes the descriptors (2 P, D) of scans and submaps."""
    pairs = len(clouds[0])

    def encode(rows: range) -> Tensor:
        with mixed_precision(config):
            encoded: Tensor = model([clouds[side][row] for side in (0, 1) for row in rows])
        return encoded.float()

    # The second pass draws the same random numbers, and it alone moves the running statistics.
    devices = [torch.cuda.current_device()] if config.device == "cuda" else []
    with torch.no_grad(), torch.random.fork_rng(devices), _still_norms(model):
        parts = [encode(rows) for rows in chunks]
    descriptors = parts[0].new_empty(2 * pairs, parts[0].shape[1])
    for rows, part in zip(chunks, parts, strict=True):
        descriptors[_both(rows, pairs)] = part
    descriptors.requires_grad_(True)
    loss = loss_of(descriptors)
    if torch.isfinite(loss):
        loss.backward()  # type: ignore[no-untyped-call]
        assert descriptors.grad is not None
        for rows in chunks:
            encode(rows).backward(descriptors.grad[_both(rows, pairs)])  # type: ignore[no-untyped-call]
    return loss.detach()


def _chunks(pairs: int, size: int) -> list[range]:
    """Return the rows of each chunk: every n-th, so that each chunk has pairs of all the batch's towns."""
    count = 1 if size == 0 else -(-pairs // size)
    return [range(first, pairs, count) for first in range(count)]


def _both(rows: range, pairs: int) -> list[int]:
    """Return where the scans and the submaps of a chunk lie among all descriptors."""
    return [*rows, *(row + pairs for row in rows)]


@contextmanager
def _still_norms(model: nn.Module) -> Iterator[None]:
    """Keep the running statistics of the batch norms as they are, while they go on using each chunk's own."""
    norms = [module for module in model.modules() if isinstance(module, nn.modules.batchnorm._BatchNorm)]
    momenta = [norm.momentum for norm in norms]
    counts = [None if norm.num_batches_tracked is None else norm.num_batches_tracked.clone() for norm in norms]
    try:
        for norm in norms:
            norm.momentum = 0.0
        yield
    finally:
        for norm, momentum, count in zip(norms, momenta, counts, strict=True):
            norm.momentum = momentum
            if norm.num_batches_tracked is not None and count is not None:
                norm.num_batches_tracked.copy_(count)
