"""Halving and doubling a sparse grid, residual blocks on it, and generalised-mean pooling: what MinkLoc3D is made of.

Halving is a convolution with kernel 2 and stride 2: every site passes its features to the site of the coarse grid that
covers it, through the weight of its corner. Doubling is the same map read backwards, so that features come down to
the very sites that the grid had before.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crossloc3d_ros.encoder.model import ConvolutionNorm, cloud_mean
from crossloc3d_ros.encoder.sparse import KernelMap, VoxelGrid, sparse_convolution


def halve(grid: VoxelGrid) -> tuple[VoxelGrid, KernelMap]:
    """Return the grid of twice the stride and the map of a convolution with kernel 2 and stride 2 onto it.

    Kernel index k = ix + 2 iy + 4 iz is which of the eight corners of its coarse site a site is.
    """
    coarse = grid.downsample()
    step = coarse.stride
    low = coarse.coords.amin(0).long()
    extent = torch.div(coarse.coords.amax(0).long() - low, step, rounding_mode="floor") + 1

    def keys(corners: Tensor, batch: Tensor) -> Tensor:
        cell = torch.div(corners.long() - low, step, rounding_mode="floor")
        return ((batch * extent[2] + cell[:, 2]) * extent[1] + cell[:, 1]) * extent[0] + cell[:, 0]

    parents = torch.searchsorted(keys(coarse.coords, coarse.batch), keys(grid.coords, grid.batch))
    corner = torch.div(torch.remainder(grid.coords, step), grid.stride, rounding_mode="floor").long()
    kernel = corner[:, 0] + 2 * corner[:, 1] + 4 * corner[:, 2]
    order = torch.argsort(kernel, stable=True)
    first = [0, *torch.cumsum(torch.bincount(kernel, minlength=8), 0).tolist()]
    return coarse, KernelMap(order, parents[order], tuple(first), len(grid.coords), len(coarse.coords))


def reversed_map(pairs: KernelMap) -> KernelMap:
    """Return the map of the transposed convolution: from the outputs to the inputs."""
    return KernelMap(pairs.out_rows, pairs.in_rows, pairs.first, pairs.n_outputs, pairs.n_inputs)


class Halving(nn.Module):
    """A convolution with kernel 2 and stride 2 without bias, followed by batch norm."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(8, inputs, outputs))
        nn.init.normal_(self.weight, std=math.sqrt(1.0 / inputs))
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Tensor, pairs: KernelMap) -> Tensor:
        normed: Tensor = self.norm(sparse_convolution(x, self.weight, pairs))
        return normed


class Doubling(nn.Module):
    """The transposed convolution of a halving, without bias: features back onto the finer sites."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(8, inputs, outputs))
        nn.init.normal_(self.weight, std=math.sqrt(1.0 / inputs))

    def forward(self, x: Tensor, pairs: KernelMap) -> Tensor:
        """Return the features of the sites that the halving with the map `pairs` came from."""
        return sparse_convolution(x, self.weight, reversed_map(pairs))


class EfficientChannelAttention(nn.Module):
    """Scale each channel by its neighbours among the cloud's means (ECA-Net, CVPR 2020).

    The reach along the channels grows with their number: the odd number next to or above (log2 C + 1) / 2.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        reach = int((math.log2(channels) + 1.0) / 2.0)
        reach += 1 - reach % 2
        self.conv = nn.Conv1d(1, 1, reach, padding=reach // 2, bias=False)

    def forward(self, x: Tensor, grid: VoxelGrid) -> Tensor:
        scale = torch.sigmoid(self.conv(cloud_mean(x, grid).unsqueeze(1)).squeeze(1))  # (B, C)
        return x * scale.index_select(0, grid.batch)


class ResidualBlock(nn.Module):
    """Two 3^3 convolutions beside a shortcut; the shortcut is a 1^3 convolution where the widths differ."""

    def __init__(self, inputs: int, outputs: int, *, attention: bool) -> None:
        super().__init__()
        self.first = ConvolutionNorm(inputs, outputs, 3)
        self.second = ConvolutionNorm(outputs, outputs, 3)
        self.attention = EfficientChannelAttention(outputs) if attention else None
        self.shortcut = ConvolutionNorm(inputs, outputs, 1) if inputs != outputs else None

    def forward(self, x: Tensor, grid: VoxelGrid) -> Tensor:
        y = self.second(F.relu(self.first(x, grid)), grid)
        if self.attention is not None:
            y = self.attention(y, grid)
        return F.relu(y + (x if self.shortcut is None else self.shortcut(x, grid)))


class GeneralizedMean(nn.Module):
    """The mean of x^p over a cloud's sites, to the power 1/p; p is learned, and what is not positive counts as nil."""

    SMALLEST = 1e-6

    def __init__(self, power: float = 3.0) -> None:
        super().__init__()
        self.power = nn.Parameter(torch.tensor([power]))

    def forward(self, x: Tensor, grid: VoxelGrid) -> Tensor:
        pooled: Tensor = cloud_mean(x.clamp(min=self.SMALLEST).pow(self.power), grid).pow(1.0 / self.power)
        return pooled
