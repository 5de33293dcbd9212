"""From a configuration to its network."""

from __future__ import annotations

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.model import CrossLoc3D
from crossloc3d_ros.errors import ConfigError

PUBLISHED = {
    "pointnetvlad": ModelConfig(network="pointnetvlad"),
    "lpdnet": ModelConfig(network="lpdnet", voxel_sizes=(0.05,)),
    "minkloc3d": ModelConfig(network="minkloc3d", voxel_sizes=(0.01,)),
    "minkloc3dv2": ModelConfig(network="minkloc3dv2", voxel_sizes=(0.01,)),
    "minkloc3d_s": ModelConfig(network="minkloc3d_s", voxel_sizes=(0.05,)),
    "transloc3d": ModelConfig(network="transloc3d", voxel_sizes=(0.01,)),
}
"""The competitors in the sizes that their authors give; LPD-Net's and MinkLoc3D-S's voxels are 2.5 m of 50 m."""


def make_network(config: ModelConfig) -> Network:
    """Return the network that `config.network` names, with fresh weights; ConfigError where settings do not fit.

    The competitors read `voxel_sizes[0]`, `channels` and `descriptor_size`, and what else their modules name.
    """
    if config.network == "crossloc3d":
        return CrossLoc3D(config)
    if not config.voxel_sizes or min(config.voxel_sizes) <= 0.0:
        raise ConfigError(f"'voxel_sizes' must hold a positive size, got {config.voxel_sizes}")
    # imported here, for whoever localizes needs none of them
    if config.network == "pointnetvlad":
        from crossloc3d_ros.encoder.baselines.pointnet import PointNetVlad

        return PointNetVlad(config)
    if config.network == "lpdnet":
        from crossloc3d_ros.encoder.baselines.lpdnet import LpdNet

        return LpdNet(config)
    if config.network == "transloc3d":
        from crossloc3d_ros.encoder.baselines.transloc3d import TransLoc3D

        return TransLoc3D(config)
    from crossloc3d_ros.encoder.baselines.minkloc import MinkLoc3D

    return MinkLoc3D(config)
