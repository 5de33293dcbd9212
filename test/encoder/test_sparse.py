"""Sparse convolution against a dense oracle, forward and backward, and the kernel maps against a plain search."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from crossloc3d_ros.encoder import kernels, sites, stages
from crossloc3d_ros.encoder.sparse import VoxelGrid, search_map, sparse_convolution, voxelize


def clouds(seed: int, *sizes: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(size, 3, generator=generator) * 2 - 1 for size in sizes]


@pytest.mark.parametrize("size", [0.05, 0.12, 0.4])
def test_voxels_are_the_distinct_floors_of_a_float32_division(size: float) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (4096, 3)).astype(np.float32)
    points[:200] = (np.round(points[:200] / size) * size).astype(np.float32)  # on the borders, where rounding decides
    expected = {tuple(v) for v in np.floor(points / np.float32(size)).astype(int)}
    grid = voxelize([torch.from_numpy(points)], size)
    assert {tuple(v) for v in grid.coords.tolist()} == expected
    assert len(grid.coords) == len(expected)
    assert np.array_equal(sites.voxels(points, np.float32(size)), grid.coords.numpy())


def test_the_coarse_grid_floors_negative_numbers() -> None:
    grid = VoxelGrid(torch.tensor([[-3, -1, 0], [3, 1, -2]], dtype=torch.int32), torch.tensor([0, 2]))
    assert {tuple(v) for v in grid.downsample().coords.tolist()} == {(-4, -2, 0), (2, 0, -2)}
    assert {tuple(v) for v in sites.coarser(grid.coords.numpy()).tolist()} == {(-4, -2, 0), (2, 0, -2)}


@pytest.mark.parametrize("kernel_size", [1, 3, 5])
def test_kernel_maps_agree_with_a_search(kernel_size: int) -> None:
    grid = voxelize(clouds(1, 900, 30, 400), 0.12)
    coarse = grid.downsample()
    for source, target in ((grid, grid), (grid, coarse), (coarse, coarse)):
        fast, slow = source.kernel_map(kernel_size, target), search_map(source, target, kernel_size)
        assert fast.first == slow.first
        assert torch.equal(fast.in_rows, slow.in_rows)
        assert torch.equal(fast.out_rows, slow.out_rows)


def test_a_box_too_large_for_a_table_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = voxelize([torch.tensor([[0.0, 0.0, 0.0], [0.001, 0, 0], [900.0, 900, 900], [-900.0, 5, 7]])], 0.001)
    assert grid.kernel_map(3).first == search_map(grid, grid, 3).first
    assert len(sites.occupancy(grid.coords.numpy(), 3)[0]) == 0


@pytest.mark.parametrize("kernel_size", [3, 5])
def test_sparse_convolution_is_the_dense_one_at_the_occupied_sites(kernel_size: int) -> None:
    grid = voxelize(clouds(2, 300), 0.2)
    x = torch.randn(len(grid.coords), 16)
    weight = torch.randn(kernel_size**3, 16, 32)
    dense = torch.zeros(1, 16, 14, 14, 14)
    z, y, xs = (grid.coords[:, axis].long() + 7 for axis in (2, 1, 0))
    dense[0, :, z, y, xs] = x.t()
    kernel = weight.view(kernel_size, kernel_size, kernel_size, 16, 32).permute(4, 3, 0, 1, 2)
    expected = torch.nn.functional.conv3d(dense, kernel, padding=kernel_size // 2)[0, :, z, y, xs].t()
    result = sparse_convolution(x, weight, grid.kernel_map(kernel_size))
    assert torch.allclose(result, expected, atol=1e-3)


def test_gradients_are_right() -> None:
    grid = voxelize(clouds(3, 25, 20), 0.5)
    pairs = grid.kernel_map(3, grid.downsample())
    x = torch.randn(len(grid.coords), 3, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(27, 3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: sparse_convolution(a, b, pairs), (x, weight))


def test_the_compiled_gradient_is_the_plain_one() -> None:
    grid = voxelize(clouds(4, 500, 100), 0.1)
    pairs = grid.kernel_map(5)
    x, weight = torch.randn(len(grid.coords), 32), torch.randn(125, 32, 16)
    results = []
    for dtype in (torch.float32, torch.float64):  # float64 takes the plain way
        a, b = (t.detach().clone().to(dtype).requires_grad_() for t in (x, weight))
        out = sparse_convolution(a, b, pairs)
        out.sin().sum().backward()
        assert a.grad is not None
        assert b.grad is not None
        results.append((out.detach().double(), a.grad.double(), b.grad.double()))
    for fast, plain in zip(*results, strict=True):
        assert torch.allclose(fast, plain, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("rows", [1, 2, 3, 5, 6, 7, 13, 64])
@pytest.mark.parametrize("depth", [1, 3, 16, 66])
def test_the_register_tile_multiplies(rows: int, depth: int) -> None:
    rng = np.random.default_rng(rows)
    x = rng.standard_normal((rows, depth)).astype(np.float32)
    weights = rng.standard_normal((1, depth, 32)).astype(np.float32)
    packed = kernels.pack_weights(weights)
    out = np.ones((rows, 32), np.float32)
    kernels.dense_product(x, packed[0], out, 0, rows)
    assert np.allclose(out, 1 + x @ weights[0], atol=1e-4)
    gathered = np.ones((rows, 32), np.float32)
    order = rng.permutation(rows).astype(np.int32)
    identity = np.arange(rows, dtype=np.int32)
    kernels.gather_product(x, packed, order, identity, np.array([0]), np.array([rows]), gathered)
    assert np.allclose(gathered, 1 + x[order] @ weights[0], atol=1e-4)


def test_the_vector_exponential_is_accurate() -> None:
    logits = np.linspace(-20, 20, 4001, dtype=np.float32)
    row = logits.copy()
    stages._softmax(row)
    expected = np.exp(logits.astype(np.float64) - 20)
    expected /= expected.sum()
    assert np.abs(row / expected - 1).max() < 1e-5


def test_under_autocast_products_are_narrow_and_sums_are_not() -> None:
    grid = voxelize(clouds(2, 500, 300), 0.2)
    pairs = grid.kernel_map(3)
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(len(grid.coords), 16, generator=generator, requires_grad=True)
    weight = torch.randn(27, 16, 32, generator=generator, requires_grad=True)
    grad = torch.randn(len(grid.coords), 32, generator=generator)
    found = []
    for narrow in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=narrow):
            out = sparse_convolution(x, weight, pairs)
        found.append((out.detach(), *torch.autograd.grad(out, (x, weight), grad)))
    for exact, rounded in zip(*found, strict=True):
        assert rounded.dtype == torch.float32
        error = float((exact - rounded).norm() / exact.norm())
        assert 0.0 < error < 0.01
