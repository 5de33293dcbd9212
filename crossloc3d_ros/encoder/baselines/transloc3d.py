"""TransLoc3D (arXiv 2105.11605): adaptive receptive fields, external attention, NetVLAD; one grain.

A first 5^3 convolution, a halving, one block of five receptive fields with a soft choice per voxel and channel, six
layers of external attention whose outputs are all kept, a fusing layer and NetVLAD. CrossLoc3D grew out of it: block,
attention and pooling are the same modules.

Published: voxels of 0.01 of the patch unit, 64 channels, memories of 256, 128, 128, 64, 64, 64 centres, two heads, 512
fused channels, 64 clusters, descriptors of 256 numbers. Read here: `voxel_sizes[0]`, `channels` (the memories go with
it), `fused_channels`, `clusters`, `descriptor_size`. The release pads clouds with zeros that take part in everything;
here a cloud stands for itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.baselines.pyramid import Halving, halve
from crossloc3d_ros.encoder.model import ConvolutionNorm, NetVlad, RefinementLayer, SelectionBlock
from crossloc3d_ros.encoder.sparse import voxelize

MEMORIES = (4.0, 2.0, 2.0, 1.0, 1.0, 1.0)
"""Centres of each attention layer, over `channels`."""
HEADS = 2  # as published


class TransLoc3D(Network):
    """Adaptive receptive fields and external attention on one voxel grid."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        width = config.channels
        self.stem = ConvolutionNorm(1, width, 5)
        self.halving = Halving(width, width)
        self.fields = SelectionBlock(width, kept=len(SelectionBlock.KERNELS))
        self.entry = ConvolutionNorm(width, width, 1)
        self.layers = nn.ModuleList(RefinementLayer(width, HEADS, round(share * width)) for share in MEMORIES)
        self.fusion = ConvolutionNorm(width * (len(MEMORIES) + 1), config.fused_channels, 1)
        self.pooling = NetVlad(config.fused_channels, config.clusters, config.descriptor_size)

    def forward(self, clouds: Sequence[Tensor] | Tensor) -> Tensor:
        """Return the descriptors (B, D) of clouds (B, n, 3), or of B clouds (n_i, 3) of any sizes."""
        fine = voxelize(list(clouds), self.config.voxel_sizes[0])
        ones = torch.ones(len(fine.coords), 1, device=fine.coords.device, dtype=self.stem.weight.dtype)
        grid, pairs = halve(fine)
        x = F.relu(self.halving(F.relu(self.stem(ones, fine)), pairs))
        x = F.relu(self.entry(self.fields(x, grid), grid))
        batch, stages = grid.batch, [x]
        for layer in self.layers:
            stages.append(layer(stages[-1], batch, len(clouds)))
        fused = F.relu(self.fusion(torch.cat(stages, dim=1), grid))
        descriptors: Tensor = self.pooling(fused, grid.starts)
        return descriptors
