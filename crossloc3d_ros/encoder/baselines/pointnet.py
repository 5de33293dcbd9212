"""PointNetVLAD (CVPR 2018): every point on its own through a shared network, then NetVLAD over the points.

As in its release there is an input transform (3 x 3) and a feature transform (channels x channels), each predicted by
a small PointNet from the cloud; the maximum of PointNet gives way to NetVLAD. Points enter as they are: nothing is
quantised, and a point that stands twice in a patch counts twice. Batch norm follows every layer, where the release
has it in the transforms and the pooling only.

Published: 64, 64 | 64, 128, 1024 channels, 64 clusters, descriptors of 256 numbers. Here the widths are so where
`channels` is 64 and go with it; `clusters` and `descriptor_size` are read too.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.model import NetVlad

DEEP = 16
"""Width of a point's last features, over `channels`."""


class Layer(nn.Module):
    """A linear layer without bias, batch norm and ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.norm(self.linear(x)), inplace=True)


class TransformNet(nn.Module):
    """Predict one matrix (k, k) a cloud from its points' features; the identity to begin with."""

    def __init__(self, size: int, channels: int) -> None:
        super().__init__()
        self.size = size
        self.shared = nn.Sequential(
            Layer(size, channels), Layer(channels, 2 * channels), Layer(2 * channels, DEEP * channels)
        )
        self.joint = nn.Sequential(Layer(DEEP * channels, 8 * channels), Layer(8 * channels, 4 * channels))
        self.matrix = nn.Linear(4 * channels, size * size)
        nn.init.zeros_(self.matrix.weight)
        with torch.no_grad():
            self.matrix.bias.copy_(torch.eye(size).flatten())

    def forward(self, x: Tensor, counts: list[int]) -> Tensor:
        """Return x (N, k) with each cloud's rows multiplied by its own matrix."""
        deepest = torch.stack([part.amax(dim=0) for part in torch.split(self.shared(x), counts)])
        matrices = self.matrix(self.joint(deepest)).view(-1, self.size, self.size)
        return torch.cat([part @ matrix for part, matrix in zip(torch.split(x, counts), matrices, strict=True)])


class PointVlad(nn.Module):
    """The last layers of a point network: features (N, C) -> directions -> NetVLAD -> descriptors of one length.

    The release gives all descriptors length 1; here it is sqrt(D), the length that the other networks' descriptors
    have about, so that the same loss serves all. The ranking is the same.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        width = config.channels
        self.layers = nn.Sequential(Layer(width, width), Layer(width, 2 * width), Layer(2 * width, DEEP * width))
        self.pooling = NetVlad(DEEP * width, config.clusters, config.descriptor_size)
        self.length = config.descriptor_size**0.5

    def forward(self, x: Tensor, counts: list[int]) -> Tensor:
        directions = F.normalize(self.layers(x), dim=1, eps=1e-12)
        starts = torch.cumsum(torch.tensor([0, *counts]), 0)
        descriptors: Tensor = self.length * F.normalize(self.pooling(directions, starts), dim=1, eps=1e-12)
        return descriptors


class PointNetVlad(Network):
    """PointNet with input and feature transform, and NetVLAD."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        width = config.channels
        self.input_transform = TransformNet(3, width)
        self.early = nn.Sequential(Layer(3, width), Layer(width, width))
        self.feature_transform = TransformNet(width, width)
        self.late = PointVlad(config)

    def forward(self, clouds: Sequence[Tensor] | Tensor) -> Tensor:
        """Return the descriptors (B, D) of clouds (B, n, 3), or of B clouds (n_i, 3) of any sizes."""
        counts = [len(cloud) for cloud in clouds]
        points = torch.cat([cloud[:, :3] for cloud in clouds])
        x = self.early(self.input_transform(points, counts))
        descriptors: Tensor = self.late(self.feature_transform(x, counts), counts)
        return descriptors
