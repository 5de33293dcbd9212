"""The losses against sums written out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from crossloc3d_ros.training.loss import BatchHardTriplet, InfoNCE, TruncatedSmoothAP, squared_distances


def pairs(seed: int = 0, count: int = 6, size: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    scans = torch.randn(count, size, generator=generator)
    return scans, scans + 0.5 * torch.randn(count, size, generator=generator)


def nothing_ignored(count: int = 6) -> torch.Tensor:
    return torch.zeros(count, count, dtype=torch.bool)


def own(count: int = 6) -> torch.Tensor:
    return torch.eye(count, dtype=torch.bool)


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
    assert float(InfoNCE(10.0)(scans, submaps, nothing_ignored(), own()).detach()) == pytest.approx(by_hand, rel=1e-4)


def test_info_nce_of_perfect_pairs_is_nearly_zero_and_of_equal_descriptors_the_logarithm_of_the_batch() -> None:
    far_apart = 10.0 * torch.eye(6, 8)
    assert float(InfoNCE()(far_apart, far_apart, nothing_ignored(), own()).detach()) < 1e-6
    same = torch.ones(6, 8)
    assert float(InfoNCE()(same, same, nothing_ignored(), own()).detach()) == pytest.approx(math.log(6), rel=1e-5)


@pytest.mark.parametrize("criterion", [InfoNCE(), BatchHardTriplet(5.0), TruncatedSmoothAP(0.5)])
def test_an_ignored_pair_has_no_part_in_the_loss(criterion: torch.nn.Module) -> None:
    scans, submaps = pairs()
    ignored = nothing_ignored()
    ignored[0, 1:] = ignored[1:, 0] = True
    before = criterion(scans, submaps, ignored, own())
    # Moved together, pair 0 keeps its own distance and changes all the ignored ones.
    scans[0] += submaps[1] - submaps[0]
    submaps[0] = submaps[1]
    assert torch.allclose(before, criterion(scans, submaps, ignored, own()), rtol=1e-5)
    assert not torch.allclose(before, criterion(scans, submaps, nothing_ignored(), own()), rtol=1e-3)


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
    criterion = BatchHardTriplet(margin)
    assert float(criterion(scans, submaps, nothing_ignored(), own())) == pytest.approx(by_hand, rel=1e-4)


def test_a_batch_of_one_town_s_neighbours_gives_a_finite_triplet_loss_and_gradient() -> None:
    scans, submaps = pairs()
    scans.requires_grad_(True)
    loss = BatchHardTriplet()(scans, submaps, ~own(), own())
    loss.backward()
    assert loss.item() == 0.0
    assert scans.grad is not None and torch.isfinite(scans.grad).all()


def exact_average_precision(distances: np.ndarray, matches: np.ndarray, candidates: np.ndarray) -> float:
    """Walk down one query's ranked list."""
    order = [j for j in np.argsort(distances) if candidates[j] or matches[j]]
    found, total = 0, 0.0
    for rank, j in enumerate(order, start=1):
        if matches[j]:
            found += 1
            total += found / rank
    return total / int(matches.sum())


def test_at_a_low_temperature_the_smooth_average_precision_is_the_exact_one() -> None:
    rng = np.random.default_rng(5)
    scans, submaps = (torch.from_numpy(rng.normal(size=(12, 6))) for _ in range(2))
    matches = torch.from_numpy(rng.random((12, 12)) < 0.2) | own(12)
    ignored = torch.from_numpy(rng.random((12, 12)) < 0.2) & ~matches
    distances = torch.cdist(scans, submaps).numpy()
    expected = []
    for d, m, c in ((distances, matches, ~ignored), (distances.T, matches.T, ~ignored.T)):
        expected += [exact_average_precision(d[q], m[q].numpy(), c[q].numpy()) for q in range(12)]
    loss = TruncatedSmoothAP(1e-5, positives=12)(scans, submaps, ignored, matches)
    assert float(loss) == pytest.approx(1.0 - np.mean(expected), abs=1e-3)


def test_truncation_counts_the_nearest_matches_alone() -> None:
    distances = torch.tensor([[1.0, 2.0, 3.0, 4.0]])
    matches = torch.tensor([[True, False, False, True]])
    everything = torch.ones(1, 4, dtype=torch.bool)
    criterion = TruncatedSmoothAP(1e-4, positives=1)
    assert float(criterion.average_precision(distances, matches, everything)) == pytest.approx(1.0)
    criterion.positives = 2
    assert float(criterion.average_precision(distances, matches, everything)) == pytest.approx((1.0 + 2 / 4) / 2)


def test_following_its_gradient_ranks_the_right_submaps_first() -> None:
    scans, submaps = (torch.randn(20, 8, generator=torch.Generator().manual_seed(s)) for s in (1, 2))
    submaps.requires_grad_(True)
    criterion = TruncatedSmoothAP(0.1)
    optimizer = torch.optim.Adam([submaps], lr=0.1)
    losses = []
    for _ in range(60):
        loss = criterion(scans, submaps, nothing_ignored(20), own(20))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 0.5 and losses[-1] < 0.1
    assert (torch.cdist(scans, submaps).argmin(1) == torch.arange(20)).float().mean() > 0.9


def test_the_share_of_active_triplets_is_reported() -> None:
    criterion = BatchHardTriplet(0.1)
    apart = 100.0 * torch.eye(6, 8)
    criterion(apart, apart, nothing_ignored(), own())
    assert criterion.active_share == 0.0
    swapped = apart[torch.tensor([1, 0, 2, 3, 4, 5])]
    criterion(apart, swapped, nothing_ignored(), own())
    assert float(criterion.active_share) == pytest.approx(2 / 6)
