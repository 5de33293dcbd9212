"""The losses against sums written out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from crossloc3d_ros.training.loss import BatchHardTriplet, InfoNCE, squared_distances


def pairs(seed: int = 0, count: int = 6, size: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    scans = torch.randn(count, size, generator=generator)
    return scans, scans + 0.5 * torch.randn(count, size, generator=generator)


def nothing_ignored(count: int = 6) -> torch.Tensor:
    return torch.zeros(count, count, dtype=torch.bool)


def test_squared_distances_are_those_of_every_pair() -> None:
    a, b = pairs()
    assert torch.allclose(squared_distances(a, b[:4]), torch.cdist(a, b[:4]).square(), atol=1e-5)


def test_info_nce_is_the_mean_of_both_cross_entropies() -> None:
    scans, submaps = pairs()
    logits = -10.0 * torch.cdist(scans, submaps).square().numpy() / 8
    by_hand = 0.0
    for matrix in (logits, logits.T):
        for i in range(6):
            by_hand -= (matrix[i, i] - math.log(np.exp(matrix[i]).sum())) / 12
    assert float(InfoNCE(10.0)(scans, submaps, nothing_ignored()).detach()) == pytest.approx(by_hand, rel=1e-4)


def test_info_nce_of_perfect_pairs_is_nearly_zero_and_of_equal_descriptors_the_logarithm_of_the_batch() -> None:
    far_apart = 10.0 * torch.eye(6, 8)
    assert float(InfoNCE()(far_apart, far_apart, nothing_ignored()).detach()) < 1e-6
    same = torch.ones(6, 8)
    assert float(InfoNCE()(same, same, nothing_ignored()).detach()) == pytest.approx(math.log(6), rel=1e-5)


@pytest.mark.parametrize("criterion", [InfoNCE(), BatchHardTriplet(5.0)])
def test_an_ignored_pair_has_no_part_in_the_loss(criterion: torch.nn.Module) -> None:
    scans, submaps = pairs()
    ignored = nothing_ignored()
    ignored[0, 1:] = ignored[1:, 0] = True
    before = criterion(scans, submaps, ignored)
    # Moved together, pair 0 keeps its own distance and changes all the ignored ones.
    scans[0] += submaps[1] - submaps[0]
    submaps[0] = submaps[1]
    assert torch.allclose(before, criterion(scans, submaps, ignored), rtol=1e-5)
    assert not torch.allclose(before, criterion(scans, submaps, nothing_ignored()), rtol=1e-3)


def test_batch_hard_takes_the_nearest_negative_of_both_anchor_and_positive() -> None:
    scans, submaps = pairs(3)
    margin = 0.2
    everything = torch.cat((scans, submaps)).numpy()
    triplets = []
    for i in range(6):
        positive = np.linalg.norm(scans[i].numpy() - submaps[i].numpy())
        others = [j for j in range(12) if j % 6 != i]
        nearest = min(np.linalg.norm(everything[a] - everything[j]) for a in (i, i + 6) for j in others)
        triplets.append(max(0.0, positive - nearest + margin))
    nonzero = [t for t in triplets if t > 0]
    by_hand = sum(nonzero) / max(1, len(nonzero))
    assert float(BatchHardTriplet(margin)(scans, submaps, nothing_ignored())) == pytest.approx(by_hand, rel=1e-4)


def test_a_batch_of_one_town_s_neighbours_gives_a_finite_triplet_loss_and_gradient() -> None:
    scans, submaps = pairs()
    scans.requires_grad_(True)
    loss = BatchHardTriplet()(scans, submaps, ~torch.eye(6, dtype=torch.bool))
    loss.backward()
    assert loss.item() == 0.0
    assert scans.grad is not None and torch.isfinite(scans.grad).all()
