"""What travels with a network's weights: how a patch is made, what the network computes, what its distances mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from crossloc3d_ros.config.settings import option


@dataclass(frozen=True)
class PreprocessingConfig:
    """How metres become a patch; travels with the weights, because they were trained on it."""

    half_extent_m: float = option(50.0, "half the side of a submap, the unit of its patch", low=1.0, high=1000.0)
    scan_half_extent_m: float = option(50.0, "the same for a scan", low=1.0, high=1000.0)
    n_points: int = option(4096, "points of a patch", low=16, high=1_000_000)
    ground_clearance_m: float = option(0.5, "points lower above the ground are removed", low=0.0, high=10.0)
    thin_m: float = option(0.5, "one point per cube of this side before the random draw; 0 = all", low=0.0, high=10.0)
    min_points: int = option(256, "least number of points above the ground for a patch", low=1, high=1_000_000)
    scan_origin: Literal["sensor", "mean"] = option("sensor", "origin of a scan's patch")
    submap_origin: Literal["grid", "bounding_box"] = option("grid", "origin of a submap's patch")
    vertical_origin: Literal["ground", "centre"] = option("ground", "origin of z")
    seed: int = option(0, "seed of the random draw of points", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class ModelConfig:
    """Everything that the paper varies, and the networks that it is compared with."""

    network: Literal[
        "crossloc3d", "pointnetvlad", "lpdnet", "minkloc3d", "minkloc3dv2", "minkloc3d_s", "transloc3d"
    ] = option("crossloc3d", "architecture; the competitors use only the settings that they have")
    voxel_sizes: tuple[float, ...] = option(
        (0.05, 0.12, 0.4), "voxel sizes of the grains, fine to coarse, in patch units; 1 to 4"
    )
    kept_branches: int = option(3, "receptive fields kept of the five branches; 0 = no selection", low=0, high=5)
    refinement: Literal["coarse_to_fine", "fine_to_coarse", "none"] = option(
        "coarse_to_fine", "order of the iterative refinement; none = concatenation"
    )
    sub_steps: int = option(3, "refinement layers per grain", low=1, high=8)
    memory_sizes: tuple[int, ...] = option(
        (256, 128, 128, 128, 64, 64, 32, 32, 32), "memory size of each refinement layer"
    )
    time_embedding: bool = option(True, "add the time embedding e(t) to each refinement layer")
    position: Literal["none", "radial", "cartesian"] = option("none", "position embedding of a voxel")
    channels: int = option(64, "width of the backbone", low=8, high=512)
    heads: int = option(4, "attention heads", low=1, high=16)
    fused_channels: int = option(512, "width before the pooling", low=8, high=4096)
    clusters: int = option(64, "NetVLAD clusters", low=1, high=1024)
    descriptor_size: int = option(256, "length of a descriptor", low=2, high=4096)


@dataclass(frozen=True)
class CalibrationConfig:
    """What distances between descriptors mean; fitted on known places and stored with the weights."""

    temperature: float = option(0.1, "distance by which the odds of a candidate fall to 1/e", low=1e-6, high=1e6)
    null_distance: float = option(
        1.0, "best distance at which the null hypothesis has probability one half", low=1e-6, high=1e6
    )
    null_scale: float = option(0.1, "scale of the logistic function of the null hypothesis", low=1e-6, high=1e6)
