"""Sparse convolution on voxel grids: the one module that chooses and owns the backend.

On the CPU in float32 the compiled kernels of `kernels.py` do the work; otherwise (CUDA, other number types, odd
widths) plain torch operations do the same, pair list by pair list. Both have a backward pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from crossloc3d_ros.encoder import kernels
from crossloc3d_ros.encoder.sites import cell_key, kernel_map, key_cell


@dataclass(frozen=True)
class KernelMap:
    """Which input site meets which output site under each kernel index.

    Kernel index k = ix + K iy + K^2 iz (x fastest), offset (ix - K // 2, ...) times the stride of the input grid.
    """

    in_rows: Tensor
    """(P,) int64, sorted by kernel, then by output row."""
    out_rows: Tensor
    """(P,) int64."""
    first: tuple[int, ...]
    """(K^3 + 1,) where each kernel's pairs begin."""
    n_inputs: int
    n_outputs: int


@dataclass
class VoxelGrid:
    """The occupied sites of a batch of clouds on one grid, cloud by cloud, sorted by (z, y, x) within each."""

    coords: Tensor
    """(N, 3) int32 x, y, z, in units of the finest grid; multiples of `stride`."""
    starts: Tensor
    """(B + 1,) int64, on the CPU: where each cloud's sites begin."""
    stride: int = 1
    _maps: dict[tuple[int, int], KernelMap] = field(default_factory=dict, repr=False)

    @property
    def batch(self) -> Tensor:
        """Return (N,) int64, the cloud that each site belongs to."""
        counts = (self.starts[1:] - self.starts[:-1]).to(self.coords.device)
        return torch.repeat_interleave(torch.arange(len(counts), device=self.coords.device), counts)

    def kernel_map(self, kernel_size: int, output: VoxelGrid | None = None) -> KernelMap:
        """Return the (cached) kernel map from this grid to `output`, by default to itself."""
        target = self if output is None else output
        key = (kernel_size, id(target))
        if key not in self._maps:
            self._maps[key] = _build_map(self, target, kernel_size)
        return self._maps[key]

    def downsample(self) -> VoxelGrid:
        """Return the grid of twice the stride, whose sites are the unique `floor(c / 2s) * 2s`."""
        step = 2 * self.stride
        coarse = torch.div(self.coords, step, rounding_mode="floor") * step
        return _unique_sites(coarse.to(torch.int32), self.batch, len(self.starts) - 1, step)


def voxelize(clouds: Sequence[Tensor], size: float) -> VoxelGrid:
    """Return the voxels that the points (n_i, 3) of each cloud fall into: `floor(x / size)`, without duplicates.

    The division is a float32 division by float32(size): multiplying by the inverse, or float64, puts up to some
    percent of the points that lie on voxel borders in other voxels than the published network does.
    """
    counts = torch.tensor([len(cloud) for cloud in clouds])
    points = torch.cat([cloud[:, :3] for cloud in clouds]).to(torch.float32)
    coords = torch.floor(points / torch.tensor(size, dtype=torch.float32, device=points.device)).to(torch.int32)
    batch = torch.repeat_interleave(torch.arange(len(clouds)), counts).to(points.device)
    return _unique_sites(coords, batch, len(clouds), 1)


def _unique_sites(coords: Tensor, batch: Tensor, n_clouds: int, stride: int) -> VoxelGrid:
    """Sort sites by (cloud, z, y, x) and drop the duplicates."""
    wide = coords.to(torch.int64)
    low = wide.amin(dim=0)
    extent = wide.amax(dim=0) - low + 1
    x, y, layer = key_cell(torch.unique(_batch_keys(wide - low, batch, extent)), extent)
    sites = (torch.stack((x, y, layer % extent[2]), dim=1) + low).to(torch.int32)
    counts = torch.bincount(layer // extent[2], minlength=n_clouds)
    starts = torch.zeros(n_clouds + 1, dtype=torch.int64)
    starts[1:] = torch.cumsum(counts, 0).cpu()
    return VoxelGrid(sites, starts, stride)


def _batch_keys(cells: Tensor, batch: Tensor, extent: Tensor) -> Tensor:
    """Return the keys (N,) of cells (N, 3) int64 where the boxes of all clouds are stacked along z."""
    key: Tensor = cell_key(cells[:, 0], cells[:, 1], batch * extent[2] + cells[:, 2], extent)
    return key


def _build_map(source: VoxelGrid, target: VoxelGrid, kernel_size: int) -> KernelMap:
    if source.coords.device.type == "cpu":
        in_rows, out_rows, first = kernel_map(
            source.coords.numpy(),
            source.starts.numpy(),
            target.coords.numpy(),
            target.starts.numpy(),
            kernel_size,
            source.stride,
        )
        pairs = torch.from_numpy(in_rows).long(), torch.from_numpy(out_rows).long()
        return KernelMap(*pairs, tuple(first.tolist()), len(source.coords), len(target.coords))
    return search_map(source, target, kernel_size)


def search_map(source: VoxelGrid, target: VoxelGrid, kernel_size: int) -> KernelMap:
    """Build the kernel map by binary search with torch alone: the way on CUDA, the oracle on the CPU."""
    radius = kernel_size // 2 * source.stride
    low = torch.minimum(source.coords.amin(0), target.coords.amin(0)).long() - radius
    extent = torch.maximum(source.coords.amax(0), target.coords.amax(0)).long() + radius - low + 1
    sorted_keys, queries = (_batch_keys(grid.coords.long() - low, grid.batch, extent) for grid in (source, target))
    ins: list[Tensor] = []
    outs: list[Tensor] = []
    first = [0]
    steps = range(-radius, radius + 1, source.stride)
    for dz in steps:
        for dy in steps:
            for dx in steps:
                wanted = queries + cell_key(dx, dy, dz, extent)
                at = torch.searchsorted(sorted_keys, wanted).clamp_(max=len(sorted_keys) - 1)
                hit = torch.nonzero(sorted_keys[at] == wanted).squeeze(1)
                ins.append(at[hit])
                outs.append(hit)
                first.append(first[-1] + len(hit))
    return KernelMap(torch.cat(ins), torch.cat(outs), tuple(first), len(source.coords), len(target.coords))


def _accumulate(x: Tensor, weight: Tensor, in_rows: Tensor, out_rows: Tensor, first: tuple[int, ...], n: int) -> Tensor:
    """Return `out[o] = sum_k x[i] @ weight[k]` over the pairs of each kernel k; out (n, Cout), at least float32."""
    out = x.new_zeros(n, weight.shape[2], dtype=torch.promote_types(x.dtype, torch.float32))
    if _is_compiled(x, weight):
        bounds = np.asarray(first)
        kernels.gather_product(
            x.detach().contiguous().numpy(),
            kernels.pack_weights(weight.detach().contiguous().numpy()),
            in_rows.numpy(),
            out_rows.numpy(),
            bounds[:-1],
            bounds[1:],
            out.numpy(),
        )
        return out
    for k in range(len(first) - 1):
        begin, end = first[k], first[k + 1]
        if begin < end:
            out.index_add_(0, out_rows[begin:end], (x.index_select(0, in_rows[begin:end]) @ weight[k]).to(out.dtype))
    return out


def _weight_gradient(x: Tensor, grad: Tensor, weight: Tensor, pairs: KernelMap) -> Tensor:
    """Return `sum x[i].T @ grad[o]` over the pairs of each kernel; the shape of the weight, at least float32."""
    wide = torch.promote_types(weight.dtype, torch.float32)
    out = torch.zeros_like(weight, dtype=wide, memory_format=torch.contiguous_format)
    if _is_compiled(x, weight):
        kernels.gather_outer(
            x.detach().contiguous().numpy(),
            grad.numpy(),
            pairs.in_rows.numpy(),
            pairs.out_rows.numpy(),
            np.asarray(pairs.first),
            out.numpy(),
        )
        return out
    for k in range(len(pairs.first) - 1):
        begin, end = pairs.first[k], pairs.first[k + 1]
        if begin < end:
            inputs = x.index_select(0, pairs.in_rows[begin:end])
            out[k] = inputs.t() @ grad.index_select(0, pairs.out_rows[begin:end])
    return out


def _is_compiled(x: Tensor, weight: Tensor) -> bool:
    """Return whether the compiled kernels can do the work."""
    return x.device.type == "cpu" and x.dtype == torch.float32 and weight.shape[2] % kernels.COLUMNS == 0


class _SparseConvolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, pairs: KernelMap) -> Tensor:
        if torch.is_autocast_enabled(x.device.type):  # products in the narrow type, sums in float32
            narrow = torch.get_autocast_dtype(x.device.type)
            x, weight = x.to(narrow), weight.to(narrow)
        ctx.save_for_backward(x, weight)
        ctx.pairs = pairs
        return _accumulate(x, weight, pairs.in_rows, pairs.out_rows, pairs.first, pairs.n_outputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        (grad,) = grads
        x, weight = ctx.saved_tensors
        pairs: KernelMap = ctx.pairs
        grad = grad.to(x.dtype).contiguous()
        grad_x = grad_weight = None
        if ctx.needs_input_grad[0]:
            transposed = weight.transpose(1, 2).contiguous()
            grad_x = _accumulate(grad, transposed, pairs.out_rows, pairs.in_rows, pairs.first, pairs.n_inputs)
        if ctx.needs_input_grad[1]:
            grad_weight = _weight_gradient(x, grad, weight, pairs)
        return grad_x, grad_weight, None


def sparse_convolution(x: Tensor, weight: Tensor, pairs: KernelMap) -> Tensor:
    """Convolve the features x (N, Cin) of the input sites with weight (K^3, Cin, Cout); returns (M, Cout).

    `out[u] = sum_k x[u + offset_k] @ weight[k]`; absent neighbours add nothing.
    """
    result: Tensor = _SparseConvolution.apply(x, weight, pairs)  # type: ignore[no-untyped-call]
    return result
