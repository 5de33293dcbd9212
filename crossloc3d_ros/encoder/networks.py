"""From a configuration to its network."""

from __future__ import annotations

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.model import CrossLoc3D
from crossloc3d_ros.errors import ConfigError


def make_network(config: ModelConfig) -> Network:
    """Return the network that `config.network` names, with fresh weights; ConfigError where settings do not fit."""
    if config.network == "crossloc3d":
        return CrossLoc3D(config)
    raise ConfigError(f"there is no network '{config.network}' yet")
