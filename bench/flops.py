"""Count the work of one descriptor over the pairs that exist, multiplications and additions each as one."""

from __future__ import annotations

import torch

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.model import SelectionBlock
from crossloc3d_ros.encoder.sparse import voxelize
from crossloc3d_ros.types import Float32Array


def descriptor_flops(points: Float32Array, config: ModelConfig) -> float:
    """Return the floating-point operations of the matrix products for one cloud (n, 3)."""
    width = config.channels
    products = 0
    sites = []
    for size in reversed(config.voxel_sizes):
        fine = voxelize([torch.from_numpy(points)], size)
        coarse = fine.downsample()
        n = len(coarse.coords)
        sites.append(n)
        pairs = {1: n, 3: coarse.kernel_map(3).first[-1], 5: coarse.kernel_map(5).first[-1]}
        products += fine.kernel_map(5).first[-1] * width  # the first convolution has one input channel
        products += fine.kernel_map(3, coarse).first[-1] * width**2
        products += sum(pairs[size] for kernels in SelectionBlock.KERNELS for size in kernels) * width**2
        products += n * (10 + len(SelectionBlock.KERNELS)) * width**2  # transforms and gate
    for step, memory in enumerate(config.memory_sizes[: len(sites) * config.sub_steps]):
        rows = sum(sites[: step // config.sub_steps + 1])
        products += rows * (2 * width**2 + 2 * width * memory)
    total = sum(sites)
    products += total * (len(sites) + 1) * width * config.fused_channels
    products += 2 * total * config.fused_channels * config.clusters
    products += config.fused_channels * config.clusters * config.descriptor_size + config.descriptor_size**2
    return 2.0 * products
