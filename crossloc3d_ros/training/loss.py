"""Losses on the Euclidean distance of descriptors that are not normalised: the distance that the map is searched by."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Return the squared Euclidean distances (A, B) between two sets of descriptors (A, D) and (B, D)."""
    squares = a.square().sum(1)[:, None] + b.square().sum(1)[None, :] - 2.0 * (a @ b.T)
    return squares.clamp_min(0.0)


class InfoNCE(nn.Module):
    """Tell each scan's submap from all the others of the batch, and the other way round.

    L = -1/2P sum_i [log softmax_j(-s d_ij^2 / D)_ii + log softmax_i(-s d_ij^2 / D)_ii], with d the Euclidean
    distance, D the descriptor's size and s a learned scale.
    """

    def __init__(self, initial_scale: float = 10.0) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(math.log(initial_scale)))

    def forward(self, scans: Tensor, submaps: Tensor, ignored: Tensor) -> Tensor:
        """Return the loss of P pairs.

        `scans` and `submaps` are (P, D), row i of one belonging to row i of the other; `ignored` (P, P) marks the
        pairs that are neither match nor mismatch, with nothing on its diagonal.
        """
        scale = self.log_scale.clamp(max=math.log(1000.0)).exp()
        logits = -scale * squared_distances(scans, submaps) / scans.shape[1]
        logits = logits.masked_fill(ignored, -math.inf)
        target = torch.arange(len(scans), device=scans.device)
        cross_entropy = nn.functional.cross_entropy
        return 0.5 * (cross_entropy(logits, target) + cross_entropy(logits.T, target))


class BatchHardTriplet(nn.Module):
    """The published loss: hardest negative of the batch, margin, swap, mean over the triplets that are not zero."""

    def __init__(self, margin: float = 0.2) -> None:
        super().__init__()
        self.margin = margin

    def forward(self, scans: Tensor, submaps: Tensor, ignored: Tensor) -> Tensor:
        """Return the loss of P pairs; the arguments are those of `InfoNCE.forward`.

        An anchor's negative may be of either source. With swap the negative's distance is the smaller of
        anchor-negative and positive-negative.
        """
        pairs = len(scans)
        everything = torch.cat((scans, submaps))
        distances = (squared_distances(everything, everything) + 1e-12).sqrt()
        match = torch.eye(pairs, dtype=torch.bool, device=scans.device)
        not_negative = (ignored | match).repeat(2, 2)
        nearest = distances.masked_fill(not_negative, math.inf).amin(1)
        positive = distances.diagonal(pairs)
        swapped = torch.minimum(nearest[:pairs], nearest[pairs:])
        triplets = torch.relu(positive - swapped + self.margin).nan_to_num(0.0)
        return triplets.sum() / (triplets > 0).sum().clamp_min(1)
