"""LPD-Net (ICCV 2019): points with hand-made local features, two neighbourhood graphs, then NetVLAD.

Ten features of each point's neighbourhood are joined to its transformed coordinates; a graph of neighbours in feature
space and then one of neighbours in space are each summarised by a small network and a maximum; NetVLAD pools.

What differs from the release: points are the mean points of voxels of `voxel_sizes[0]`, for a graph of all 4,096 is out
of a CPU's reach; neighbourhoods have a fixed size of 20 where the paper chooses one for each point; there is no feature
transform, which in the release decides neighbours alone and so never learns. Published widths where `channels` is 64.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.baselines.pointnet import Layer, PointVlad, TransformNet

NEIGHBOURS = 20  # the release chooses a number for each point; see above
FEATURES = 10  # as published
_NIL = 1e-12  # keeps logarithms and quotients of flat neighbourhoods finite


class Neighbourhood(nn.Module):
    """Two layers over the edges of a graph and the maximum of each point's edges.

    Where `relative`, an edge's input is (x_j - x_i, x_i), else x_j. The first layer is linear, so it is applied to the
    points before they are gathered along the edges.
    """

    def __init__(self, channels: int, *, relative: bool) -> None:
        super().__init__()
        self.neighbour = nn.Linear(channels, channels, bias=False)
        self.centre = nn.Linear(channels, channels, bias=False) if relative else None
        self.norm = nn.BatchNorm1d(channels)
        self.second = Layer(channels, channels)

    def forward(self, x: Tensor, neighbours: Tensor) -> Tensor:
        """Return (N, C) for features x (N, C) and each point's neighbours (N, k), rows of x."""
        edges = self.neighbour(x).index_select(0, neighbours.flatten())
        if self.centre is not None:
            edges = edges + (self.centre(x) - self.neighbour(x)).repeat_interleave(neighbours.shape[1], dim=0)
        y = self.second(F.relu(self.norm(edges), inplace=True))
        highest: Tensor = y.view(*neighbours.shape, -1).amax(dim=1)
        return highest


class LpdNet(Network):
    """The serial variant of the release: feature graph, then spatial graph."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        width = config.channels
        self.input_transform = TransformNet(3, width)
        self.early = nn.Sequential(Layer(3 + FEATURES, width), Layer(width, width))
        self.in_features = Neighbourhood(width, relative=True)
        self.in_space = Neighbourhood(width, relative=False)
        self.late = PointVlad(config)

    def forward(self, clouds: Sequence[Tensor] | Tensor) -> Tensor:
        """Return the descriptors (B, D) of clouds (B, n, 3), or of B clouds (n_i, 3) of any sizes."""
        if self.training:
            return self._describe(clouds)
        # One at a time: a product's last digits depend on its size, and they may decide who is whose neighbour.
        return torch.cat([self._describe(clouds[i : i + 1]) for i in range(len(clouds))])

    def _describe(self, clouds: Sequence[Tensor] | Tensor) -> Tensor:
        thinned = [voxel_means(cloud, self.config.voxel_sizes[0]) for cloud in clouds]
        counts = [len(cloud) for cloud in thinned]
        with torch.no_grad():
            spatial = [nearest(cloud) for cloud in thinned]
            features = [local_features(c, n) for c, n in zip(thinned, spatial, strict=True)]
        points = self.input_transform(torch.cat(thinned), counts)
        x = self.early(torch.cat((points, torch.cat(features)), dim=1))
        with torch.no_grad():
            alike = [nearest(part) for part in torch.split(x.detach(), counts)]
        x = self.in_features(x, _joined(alike, counts))
        x = self.in_space(x, _joined(spatial, counts))
        descriptors: Tensor = self.late(x, counts)
        return descriptors


def voxel_means(points: Tensor, size: float) -> Tensor:
    """Return (m, 3) the mean point of each occupied voxel, sorted by voxel, whatever the order of the points (n, 3)."""
    voxels = torch.floor(points[:, :3] / torch.tensor(size, dtype=torch.float32, device=points.device)).long()
    _, owner = torch.unique(voxels, dim=0, return_inverse=True)
    count = int(owner.max()) + 1
    # float64, so that no order of the summands shows in a float32
    total = torch.zeros(count, 3, dtype=torch.float64, device=points.device)
    total.index_add_(0, owner, points[:, :3].double())
    return (total / torch.bincount(owner, minlength=count).unsqueeze(1)).to(torch.float32)


def nearest(x: Tensor) -> Tensor:
    """Return (n, k) the rows of x (n, C) that are nearest to each row, itself among them; k is 20 or n if less."""
    squares = x.square().sum(dim=1)
    closeness = 2.0 * (x @ x.t()) - squares  # minus the squared distance, up to a constant for each row
    return closeness.topk(min(NEIGHBOURS, len(x)), dim=1).indices


def local_features(points: Tensor, neighbours: Tensor) -> Tensor:
    """Return (n, 10) of the neighbourhoods (n, k) of points (n, 3), the paper's in its order.

    Curvature, omnivariance, linearity, entropy and density of the eigenvalues in space; scattering and linearity of
    those on the ground; the normal's vertical part; the height's range and standard deviation. The density is
    log(k / radius^3), in tens, for its own range is not fit for a network.
    """
    near = points.index_select(0, neighbours.flatten()).view(*neighbours.shape, 3)
    offsets = near - near.mean(dim=1, keepdim=True)
    covariance = offsets.transpose(1, 2) @ offsets / neighbours.shape[1]
    values, vectors = torch.linalg.eigh(covariance)  # ascending
    low, middle, high = values.clamp_min(0.0).unbind(1)
    total = low + middle + high + _NIL
    shares = torch.stack((low, middle, high), dim=1) / total.unsqueeze(1)
    entropy = -(shares * (shares + _NIL).log()).sum(dim=1)
    radius = (near - points.unsqueeze(1)).norm(dim=2).amax(dim=1)
    density = (neighbours.shape[1] / (radius**3 + 1e-6)).log() / 10.0
    flat = covariance[:, :2, :2]
    trace = flat[:, 0, 0] + flat[:, 1, 1]
    spread = ((flat[:, 0, 0] - flat[:, 1, 1]).square() + 4.0 * flat[:, 0, 1].square()).sqrt()
    heights = near[..., 2]
    columns = (
        low / total,
        (low * middle * high + _NIL**3).pow(1.0 / 3.0) / total,
        (high - middle) / (high + _NIL),
        entropy,
        density,
        trace,
        (trace - spread) / (trace + spread + _NIL),
        vectors[:, 2, 0].abs(),
        heights.amax(dim=1) - heights.amin(dim=1),
        heights.std(dim=1, unbiased=False),
    )
    return torch.stack(columns, dim=1)


def _joined(graphs: list[Tensor], counts: list[int]) -> Tensor:
    """Return the clouds' graphs as one, with the rows of each moved behind those before it.

    A cloud of fewer points than neighbours names its nearest again: that changes no maximum.
    """
    widest = max(graph.shape[1] for graph in graphs)
    moved, first = [], 0
    for graph, count in zip(graphs, counts, strict=True):
        missing = graph[:, :1].expand(-1, widest - graph.shape[1])
        moved.append(torch.cat((graph, missing), dim=1) + first)
        first += count
    return torch.cat(moved)
