"""The CrossLoc3D network (ICCV 2023), top to bottom: grains, selection, iterative refinement, fusion, NetVLAD.

| the paper's network figure | here |
|---|---|
| multi-grained voxelization into V_1 (fine) to V_L (coarse), L grains | `voxelize`, a `Grain` for each voxel size |
| multi-scale sparse convolution with the kernel sizes k_s, s the scale | `SelectionBlock.KERNELS`, a branch a scale |
| feature selection: K scales are kept, F^_l is what remains of V_l | `SelectionBlock`, `kept_branches` |
| iterative refinement from F^_L to F^_1 | `Refinement`, of `RefinementLayer`s, `sub_steps` a grain |
| time T_l and its embedding e(t) | `TimeEmbedding` |
| fused features F- | `CrossLoc3D.fusion` of the stages that `Refinement` returns |
| NetVLAD and the global descriptor F_g | `NetVlad` |

Where it leaves the figure, following the code that its authors released, or for a reason of its own:

* Order of t: it counts the layers, from 0 at the coarsest grain upwards; every sub-step has its own, not every grain.
* Gating: what is kept is weighted by a softmax over all scales, for each voxel and channel, without renormalising.
* Masking instead of indexing: all scales are computed, and those that are not kept count with weight 0.
* Batches: every sum over a cloud runs over that cloud's own sites instead of clouds padded to one length, so that a
  descriptor does not depend on the others of its batch.
* `PositionEmbedding` is not in the paper; without it (the default) the network is the published one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.sparse import VoxelGrid, sparse_convolution, voxelize
from crossloc3d_ros.errors import ConfigError

CAMPUS = ModelConfig()
"""The published network for CS-Campus3D: 15,348,401 parameters."""

OXFORD = ModelConfig(
    voxel_sizes=(0.01, 0.12, 0.2),
    sub_steps=2,
    memory_sizes=(256, 128, 128, 64, 64, 32),
    descriptor_size=512,
)
"""The published variant for Oxford RobotCar; the release's memory sizes for two sub-steps are not known."""

PRESETS = {"campus": CAMPUS, "oxford": OXFORD}


class ConvolutionNorm(nn.Module):
    """A sparse convolution without bias, followed by batch norm."""

    def __init__(self, inputs: int, outputs: int, kernel_size: int) -> None:
        super().__init__()
        self.kernel_size = kernel_size
        self.weight = nn.Parameter(torch.empty(kernel_size**3, inputs, outputs))
        nn.init.normal_(self.weight, std=math.sqrt(2.0 / (inputs * max(1.0, kernel_size**3 / 4))))
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Tensor, grid: VoxelGrid, output: VoxelGrid | None = None) -> Tensor:
        if self.kernel_size == 1:
            x = x @ self.weight[0]
        else:
            x = sparse_convolution(x, self.weight, grid.kernel_map(self.kernel_size, output))
        normed: Tensor = self.norm(x)
        return normed


class ChannelAttention(nn.Module):
    """Efficient channel attention: the cloud's mean -> convolution along the channels -> sigmoid -> scale."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv1d(1, 1, kernel_size=3, padding=1, bias=False)

    def forward(self, x: Tensor, grid: VoxelGrid) -> Tensor:
        scale = torch.sigmoid(self.conv(cloud_mean(x, grid).unsqueeze(1)).squeeze(1))  # (B, C)
        return x * scale.index_select(0, grid.batch)


class SelectionBlock(nn.Module):
    """Five receptive fields on the same sites, of which each voxel and channel keeps the best few.

    Kernel sizes by branch: none, 1-3, 3-3, 1-5-3, 1-5-5. Gate = softmax over the branches; the `kept` largest stay,
    without renormalising. With `kept` 0 the branches are averaged and there is no gate.
    """

    KERNELS: tuple[tuple[int, ...], ...] = ((), (1, 3), (3, 3), (1, 5, 3), (1, 5, 5))

    def __init__(self, channels: int, kept: int) -> None:
        super().__init__()
        self.kept = kept
        self.branches = nn.ModuleList(
            nn.ModuleList(ConvolutionNorm(channels, channels, size) for size in sizes) for sizes in self.KERNELS
        )
        self.attentions = nn.ModuleList(ChannelAttention() for _ in self.KERNELS)
        if kept:
            self.transforms = nn.ModuleList(
                nn.ModuleList(ConvolutionNorm(channels, channels, 1) for _ in range(2)) for _ in self.KERNELS
            )
            self.gate = ConvolutionNorm(channels, channels * len(self.KERNELS), 1)

    def forward(self, x: Tensor, grid: VoxelGrid) -> Tensor:
        outputs = []
        for sizes, layers, attention in zip(self.KERNELS, self.branches, self.attentions, strict=True):
            y = x
            for i in range(len(sizes)):
                y = layers[i](F.relu(y) if i else y, grid)  # type: ignore[index]  # no ReLU at a branch's end
            outputs.append(attention(y, grid))
        stacked = torch.stack(outputs, dim=1)  # (N, 5, C)
        if not self.kept:
            return stacked.mean(dim=1)
        summed = torch.zeros_like(x)
        for pair, y in zip(self.transforms, outputs, strict=True):
            first, second = list(pair)  # type: ignore[call-overload]
            summed = summed + second(F.relu(first(y, grid)), grid)
        gate = torch.softmax(self.gate(summed, grid).view(stacked.shape), dim=1)
        if self.kept < len(self.KERNELS):
            least = gate.detach().topk(len(self.KERNELS) - self.kept, dim=1, largest=False).indices
            gate = gate.scatter(1, least, 0.0)
        return (gate * stacked).sum(dim=1)


class PositionEmbedding(nn.Module):
    """Embed the position of each voxel: waves of its coordinates -> Linear, zero at first.

    Convolutions and pooling are invariant to translation; with the embedding a descriptor depends on where in the
    patch a structure stands. `radial` embeds the distance from the centre and the height, which no rotation about z
    changes; `cartesian` x, y and z. Not in the published network.
    """

    WAVES = (0.5, 1.0, 2.0, 4.0)
    """Periods of each wave over the patch unit."""

    def __init__(self, kind: str, channels: int) -> None:
        super().__init__()
        self.kind = kind
        self.axes = 2 if kind == "radial" else 3
        self.linear = nn.Linear(self.axes * (1 + 2 * len(self.WAVES)), channels, bias=False)
        nn.init.zeros_(self.linear.weight)

    def forward(self, centres: Tensor) -> Tensor:
        """Return (N, C) for positions (N, 3) in patch units."""
        if self.kind == "radial":
            centres = torch.stack((centres[:, :2].norm(dim=1), centres[:, 2]), dim=1)
        angles = [math.pi * wave * centres for wave in self.WAVES]
        waves = torch.cat((centres, *(a.sin() for a in angles), *(a.cos() for a in angles)), dim=1)
        embedded: Tensor = self.linear(waves)
        return embedded


class Grain(nn.Module):
    """The encoder of one voxel size: points -> features (N, C) on the grid of stride 2."""

    def __init__(self, config: ModelConfig, voxel_size: float) -> None:
        super().__init__()
        self.voxel_size = voxel_size
        self.stem = ConvolutionNorm(1, config.channels, 5)
        self.down = ConvolutionNorm(config.channels, config.channels, 3)
        self.position = PositionEmbedding(config.position, config.channels) if config.position != "none" else None
        self.selection = SelectionBlock(config.channels, config.kept_branches)

    def forward(self, clouds: Sequence[Tensor]) -> tuple[Tensor, VoxelGrid]:
        grid = voxelize(clouds, self.voxel_size)
        ones = torch.ones(len(grid.coords), 1, device=grid.coords.device, dtype=self.stem.weight.dtype)
        coarse = grid.downsample()
        x = F.relu(self.stem(ones, grid))
        x = self.down(x, grid, coarse)
        if self.position is not None:
            x = x + self.position(site_centres(coarse, self.voxel_size).to(x))
        x = F.relu(x)
        return self.selection(x, coarse), coarse


class TimeEmbedding(nn.Module):
    """e(t) of the layer number t: [t, sin(2 pi t w), cos(2 pi t w)] -> Linear -> GELU -> Linear."""

    def __init__(self, channels: int, frequencies: int = 4) -> None:
        super().__init__()
        self.frequencies = nn.Parameter(torch.randn(frequencies))
        self.first = nn.Linear(2 * frequencies + 1, channels)
        self.second = nn.Linear(channels, channels)

    def forward(self, step: int) -> Tensor:
        t = self.frequencies.new_tensor([float(step)])
        angles = 2.0 * math.pi * t * self.frequencies
        embedded: Tensor = self.second(F.gelu(self.first(torch.cat((t, angles.sin(), angles.cos())))))
        return embedded


class RefinementLayer(nn.Module):
    """External attention to M learned centres, normalised over the centres and then over the cloud's points."""

    def __init__(self, channels: int, heads: int, memory: int) -> None:
        super().__init__()
        self.heads = heads
        self.centers = nn.Parameter(torch.randn(channels, memory) / math.sqrt(channels))
        self.query = nn.Linear(channels, channels, bias=False)
        self.value = nn.Linear(channels, channels)
        self.transform = nn.Linear(channels, channels)
        self.norm = nn.BatchNorm1d(channels)

    def forward(self, x: Tensor, batch: Tensor, n_clouds: int) -> Tensor:
        n, channels = x.shape
        memory = self.centers.shape[1]
        query = self.query(x).view(n, self.heads, -1)
        keys = self.centers.view(self.heads, -1, memory)
        values = self.value(self.centers.t()).view(memory, self.heads, -1)
        attention = torch.softmax(torch.einsum("nhd,hdm->nhm", query, keys), dim=2)
        sums = attention.new_zeros(n_clouds, self.heads, memory).index_add(0, batch, attention)
        attention = attention / (1e-9 + sums).index_select(0, batch)
        read = torch.einsum("nhm,mhd->nhd", attention, values).reshape(n, channels)
        refined: Tensor = x + F.relu(self.norm(self.transform(read - x)))
        return refined


class Refinement(nn.Module):
    """Refine the grains one after the other; returns the stages, concatenated along the channels.

    Stage s holds the grains that have been refined up to grain s, and the later ones as they came.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        grains = len(config.voxel_sizes)
        self.sub_steps = config.sub_steps
        self.time = TimeEmbedding(config.channels) if config.time_embedding else None
        self.layers = nn.ModuleList(
            RefinementLayer(config.channels, config.heads, memory)
            for memory in config.memory_sizes[: grains * config.sub_steps]
        )

    def forward(self, grains: list[Tensor], batches: list[Tensor], n_clouds: int) -> Tensor:
        stages = [torch.cat(grains)]
        x = grains[0][:0]
        batch = batches[0][:0]
        for step, layer in enumerate(self.layers):
            grain, sub_step = divmod(step, self.sub_steps)
            if sub_step == 0:
                x = torch.cat((x, grains[grain]))
                batch = torch.cat((batch, batches[grain]))
            if self.time is not None:
                x = x + self.time(step)
            x = layer(x, batch, n_clouds)
            if sub_step == self.sub_steps - 1:
                stages.append(torch.cat((x, *grains[grain + 1 :])))
        return torch.cat(stages, dim=1)


class NetVlad(nn.Module):
    """Soft-assign features to clusters, sum the residuals, project and gate: (N, C) -> (B, D)."""

    def __init__(self, channels: int, clusters: int, size: int) -> None:
        super().__init__()
        self.assignment = nn.Parameter(torch.randn(channels, clusters) / math.sqrt(channels))
        self.centers = nn.Parameter(torch.randn(channels, clusters) / math.sqrt(channels))
        self.projection = nn.Parameter(torch.randn(channels * clusters, size) / math.sqrt(channels))
        self.gating = nn.Parameter(torch.randn(size, size) / math.sqrt(size))
        self.assignment_norm = nn.BatchNorm1d(clusters)
        self.output_norm = nn.BatchNorm1d(size)
        self.gating_norm = nn.BatchNorm1d(size)

    def forward(self, x: Tensor, starts: Tensor) -> Tensor:
        soft = torch.softmax(self.assignment_norm(x @ self.assignment), dim=1)  # (N, K)
        counts = (starts[1:] - starts[:-1]).tolist()
        # split, not slices: the gradient of a slice is as large as the whole batch
        pooled = [
            y.t() @ a - a.sum(dim=0) * self.centers
            for y, a in zip(torch.split(x, counts), torch.split(soft, counts), strict=True)
        ]
        residuals = F.normalize(torch.stack(pooled), dim=1, eps=1e-12)  # (B, C, K), each cluster's column
        flat = F.normalize(residuals.flatten(1), dim=1, eps=1e-12)
        y = self.output_norm(flat @ self.projection)
        gated: Tensor = y * torch.sigmoid(self.gating_norm(y @ self.gating))
        return gated


class CrossLoc3D(Network):
    """Clouds of points in [-1, 1]^3 to descriptors; distances between descriptors are Euclidean."""

    def __init__(self, config: ModelConfig = CAMPUS) -> None:
        super().__init__()
        check_model(config)
        self.config = config
        self.grains = nn.ModuleList(Grain(config, size) for size in config.voxel_sizes)
        refined = config.refinement != "none"
        self.refinement = Refinement(config) if refined else None
        stages = len(config.voxel_sizes) + 1 if refined else 1
        self.fusion = nn.Linear(stages * config.channels, config.fused_channels, bias=False)
        self.fusion_norm = nn.BatchNorm1d(config.fused_channels)
        self.pooling = NetVlad(config.fused_channels, config.clusters, config.descriptor_size)

    def forward(self, clouds: Sequence[Tensor] | Tensor) -> Tensor:
        """Return the descriptors (B, D) of clouds (B, n, 3), or of B clouds (n_i, 3) of any sizes."""
        encoded = [grain(list(clouds)) for grain in self.grains]
        if self.config.refinement != "fine_to_coarse":
            encoded.reverse()  # voxel sizes are listed fine to coarse
        features = [x for x, _ in encoded]
        batches = [grid.batch for _, grid in encoded]
        n_clouds = len(clouds)
        fused_input = torch.cat(features) if self.refinement is None else self.refinement(features, batches, n_clouds)
        x = F.relu(self.fusion_norm(self.fusion(fused_input)))
        batch = torch.cat(batches)
        order = torch.argsort(batch, stable=True)
        starts = torch.zeros(n_clouds + 1, dtype=torch.int64)
        starts[1:] = torch.cumsum(torch.bincount(batch, minlength=n_clouds), 0).cpu()
        descriptors: Tensor = self.pooling(x[order], starts)
        return descriptors


def site_centres(grid: VoxelGrid, voxel_size: float) -> Tensor:
    """Return (N, 3), the middles of the sites in patch units."""
    return (grid.coords + 0.5 * grid.stride) * voxel_size


def cloud_mean(x: Tensor, grid: VoxelGrid) -> Tensor:
    """Return (B, C), the mean of the features over each cloud's sites."""
    counts = (grid.starts[1:] - grid.starts[:-1]).to(x)
    total = x.new_zeros(len(counts), x.shape[1]).index_add(0, grid.batch, x)
    return total / counts.unsqueeze(1)


def check_model(config: ModelConfig) -> None:
    """Raise ConfigError where the fields of the configuration do not fit each other."""
    grains = len(config.voxel_sizes)
    if not 1 <= grains <= 4:
        raise ConfigError(f"'voxel_sizes' must hold 1 to 4 sizes, got {grains}")
    if any(size <= 0.0 for size in config.voxel_sizes) or list(config.voxel_sizes) != sorted(config.voxel_sizes):
        raise ConfigError(f"'voxel_sizes' must be positive and ascend, got {config.voxel_sizes}")
    if config.refinement != "none" and len(config.memory_sizes) < grains * config.sub_steps:
        needed = grains * config.sub_steps
        raise ConfigError(
            f"'memory_sizes' must hold {needed} sizes (grains x sub-steps), got {len(config.memory_sizes)}"
        )
    if config.channels % config.heads:
        raise ConfigError(f"'channels' ({config.channels}) must be a multiple of 'heads' ({config.heads})")
