"""Losses on the Euclidean distance of descriptors that are not normalised: the distance that the map is searched by."""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor, nn


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Return the squared Euclidean distances (A, B) between two sets of descriptors (A, D) and (B, D)."""
    squares = a.square().sum(1)[:, None] + b.square().sum(1)[None, :] - 2.0 * (a @ b.T)
    return squares.clamp_min(0.0)


class Criterion(Protocol):
    """The interface of a loss; each is a torch module besides."""

    def __call__(self, scans: Tensor, submaps: Tensor, ignored: Tensor, matches: Tensor) -> Tensor:
        """Return the loss of P pairs, a number.

        `scans` and `submaps` are (P, D), row i of one belonging to row i of the other. `ignored` (P, P) marks scan i
        and submap j that are neither match nor mismatch, with nothing on its diagonal; `matches` (P, P) those that
        belong together, the diagonal among them.
        """
        ...


class InfoNCE(nn.Module):
    """Separate each scan's submap from all the others of the batch, and the other way round.

    L = -1/2P sum_i [log softmax_j(-s d_ij^2 / D)_ii + log softmax_i(-s d_ij^2 / D)_ii], with d the Euclidean
    distance, D the descriptor's size and s a learned scale.
    """

    def __init__(self, initial_scale: float = 10.0) -> None:
        super().__init__()
        self.log_scale = nn.Parameter(torch.tensor(math.log(initial_scale)))

    def forward(self, scans: Tensor, submaps: Tensor, ignored: Tensor, matches: Tensor) -> Tensor:
        """Return the loss of P pairs, see `Criterion`; a match off the diagonal has no part in it."""
        matches = matches & ~torch.eye(len(scans), dtype=torch.bool, device=scans.device)
        scale = self.log_scale.clamp(max=math.log(1000.0)).exp()
        logits = -scale * squared_distances(scans, submaps) / scans.shape[1]
        logits = logits.masked_fill(ignored | matches, -math.inf)
        target = torch.arange(len(scans), device=scans.device)
        cross_entropy = nn.functional.cross_entropy
        return 0.5 * (cross_entropy(logits, target) + cross_entropy(logits.T, target))


class BatchHardTriplet(nn.Module):
    """The published loss: hardest negative of the batch, margin, swap, mean over the triplets that are not zero."""

    def __init__(self, margin: float = 0.2) -> None:
        super().__init__()
        self.margin = margin
        self.active_share: Tensor | None = None
        """Share of the last batch's triplets that were not zero."""

    def forward(self, scans: Tensor, submaps: Tensor, ignored: Tensor, matches: Tensor) -> Tensor:
        """Return the loss of P pairs, see `Criterion`; a pair's own submap is its positive.

        An anchor's negative may be of either source. With swap the negative's distance is the smaller of
        anchor-negative and positive-negative.
        """
        pairs = len(scans)
        everything = torch.cat((scans, submaps))
        distances = (squared_distances(everything, everything) + 1e-12).sqrt()
        not_negative = (ignored | matches).repeat(2, 2)
        nearest = distances.masked_fill(not_negative, math.inf).amin(1)
        positive = distances.diagonal(pairs)
        swapped = torch.minimum(nearest[:pairs], nearest[pairs:])
        triplets = torch.relu(positive - swapped + self.margin).nan_to_num(0.0)
        active = (triplets > 0).sum()
        self.active_share = active.detach() / pairs
        return triplets.sum() / active.clamp_min(1)


class TruncatedSmoothAP(nn.Module):
    """Average precision over the whole batch, with a sigmoid for every comparison (Smooth-AP, ECCV 2020).

    A query's average precision, over its k nearest matches K among the matches M and the candidates C of the batch:
    AP = 1/|K| sum_{i in K} (1 + sum_{j in M\\i} G_ij) / (1 + sum_{j in C\\i} G_ij), G_ij = sigmoid((d_i - d_j) / t),
    with d the Euclidean distance over the square root of the descriptor's size. Scans query submaps and submaps
    scans; the loss is the mean of 1 - AP over both. Truncated to the nearest k as in MinkLoc3Dv2 (ICPR 2022): a match
    that no heading or occlusion lets come near does not pull the others.
    """

    def __init__(self, temperature: float = 0.05, positives: int = 4) -> None:
        super().__init__()
        self.temperature = temperature
        self.positives = positives

    def forward(self, scans: Tensor, submaps: Tensor, ignored: Tensor, matches: Tensor) -> Tensor:
        """Return the loss of P pairs, see `Criterion`."""
        distances = (squared_distances(scans, submaps) / scans.shape[1] + 1e-12).sqrt()
        candidates = ~ignored | matches
        forth = self.average_precision(distances, matches, candidates)
        back = self.average_precision(distances.T, matches.T, candidates.T)
        return 1.0 - 0.5 * (forth.mean() + back.mean())

    def average_precision(self, distances: Tensor, matches: Tensor, candidates: Tensor) -> Tensor:
        """Return the smooth average precision (Q,) of queries with distances (Q, C); each must have a match."""
        most = min(self.positives, int(matches.sum(1).max()))
        nearest = distances.detach().masked_fill(~matches, math.inf).topk(most, dim=1, largest=False).indices
        counted = matches.gather(1, nearest)  # (Q, k): not every query has k matches
        before = torch.sigmoid((distances.gather(1, nearest)[:, :, None] - distances[:, None, :]) / self.temperature)
        before = before.scatter(2, nearest[:, :, None], 0.0)  # (Q, k, C), without i itself
        among_matches = 1.0 + (before * matches[:, None, :]).sum(2)
        among_all = 1.0 + (before * candidates[:, None, :]).sum(2)
        precision = torch.where(counted, among_matches / among_all, 0.0)
        return precision.sum(1) / counted.sum(1)
