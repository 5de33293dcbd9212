"""MinkLoc3D (WACV 2021), MinkLoc3Dv2 (ICPR 2022) and MinkLoc3D-S (RA-L 2022): a sparse pyramid and a pooled mean.

A first 5^3 convolution; then levels of halving and a residual block; then from the coarsest level back down, doubling
and adding each level's own features; at last a generalised mean over the sites that are left.

Published: voxels of 0.01 of the patch unit, planes 32, 64, 64 and one step down (MinkLoc3D) or planes 64, 128, 64, 32,
two steps down and channel attention (v2), descriptors of 256 numbers. Here the planes are so wide where `channels` is
64 and go with it; `voxel_sizes[0]` is the voxel and `descriptor_size` the width of the way down.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.baselines.pyramid import Doubling, GeneralizedMean, Halving, ResidualBlock, halve
from crossloc3d_ros.encoder.model import ConvolutionNorm
from crossloc3d_ros.encoder.sparse import KernelMap, VoxelGrid, voxelize

SECTOR_DEG = 2.0
"""Step of the bearing in MinkLoc3D-S."""
ELEVATION_DEG = 1.875
"""Step of the angle from the vertical in MinkLoc3D-S."""


class PyramidShape(NamedTuple):
    """What distinguishes one MinkLoc3D from another."""

    planes: tuple[float, ...]
    """Width of each level, over `channels`."""
    steps_down: int
    attention: bool


MINKLOC3D = PyramidShape((0.5, 1.0, 1.0), steps_down=1, attention=False)
MINKLOC3D_V2 = PyramidShape((1.0, 2.0, 1.0, 0.5), steps_down=2, attention=True)


class Pyramid(nn.Module):
    """Occupied voxels to features (N, D) on the grid that the way down ends at."""

    def __init__(self, shape: PyramidShape, channels: int, outputs: int) -> None:
        super().__init__()
        planes = [max(1, round(share * channels)) for share in shape.planes]
        inputs = [planes[0], *planes[:-1]]
        self.steps_down = shape.steps_down
        self.stem = ConvolutionNorm(1, planes[0], 5)
        self.halvings = nn.ModuleList(Halving(width, width) for width in inputs)
        self.blocks = nn.ModuleList(
            ResidualBlock(narrow, wide, attention=shape.attention) for narrow, wide in zip(inputs, planes, strict=True)
        )
        levels = planes[::-1][: shape.steps_down + 1]  # the coarsest first
        self.laterals = nn.ModuleList(nn.Linear(width, outputs, bias=False) for width in levels)
        self.doublings = nn.ModuleList(Doubling(outputs, outputs) for _ in range(shape.steps_down))

    def forward(self, grid: VoxelGrid) -> tuple[Tensor, VoxelGrid]:
        ones = torch.ones(len(grid.coords), 1, device=grid.coords.device, dtype=self.stem.weight.dtype)
        x = F.relu(self.stem(ones, grid))
        levels: list[tuple[Tensor, VoxelGrid, KernelMap]] = []
        for halving, block in zip(self.halvings, self.blocks, strict=True):
            grid, pairs = halve(grid)
            x = block(F.relu(halving(x, pairs)), grid)
            levels.append((x, grid, pairs))
        x = self.laterals[0](x)
        for step, doubling in enumerate(self.doublings):
            pairs = levels[-1 - step][2]
            level, grid, _ = levels[-2 - step]
            x = doubling(x, pairs) + self.laterals[step + 1](level)
        return x, grid


class MinkLoc3D(Network):
    """MinkLoc3D, or v2, or -S, as named by `config.network`."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        shape = MINKLOC3D_V2 if config.network == "minkloc3dv2" else MINKLOC3D
        self.pyramid = Pyramid(shape, config.channels, config.descriptor_size)
        self.pooling = GeneralizedMean()

    def forward(self, clouds: Sequence[Tensor] | Tensor) -> Tensor:
        """Return the descriptors (B, D) of clouds (B, n, 3), or of B clouds (n_i, 3) of any sizes."""
        voxel_size = self.config.voxel_sizes[0]
        if self.config.network == "minkloc3d_s":
            grid = voxelize([spherical_steps(cloud, voxel_size) for cloud in clouds], 1.0)
        else:
            grid = voxelize(list(clouds), voxel_size)
        x, grid = self.pyramid(grid)
        pooled: Tensor = self.pooling(x, grid)
        return pooled


def spherical_steps(points: Tensor, range_step: float) -> Tensor:
    """Return (n, 3) range, bearing and angle from the vertical of points (n, 3), each in steps of its grid.

    The range's step is in patch units (published: 2.5 m, that is 0.05 for a patch of 50 m); bearings run from 0 to 360
    degrees, counter-clockwise from x, and the grid has a seam there, as published. The sensor is the centre.
    """
    x, y, z = points[:, :3].double().unbind(1)
    level = torch.hypot(x, y)
    bearing = torch.remainder(torch.atan2(y, x) * (180.0 / math.pi), 360.0)
    elevation = torch.atan2(level, z) * (180.0 / math.pi)
    steps = (torch.hypot(level, z) / range_step, bearing / SECTOR_DEG, elevation / ELEVATION_DEG)
    return torch.stack(steps, dim=1).to(torch.float32)
