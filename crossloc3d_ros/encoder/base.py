"""What every network is to its users, whichever paper it comes from."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from crossloc3d_ros.config import ModelConfig


class Network(nn.Module):
    """Clouds of points in [-1, 1]^3 to descriptors, each from its own cloud alone; distances are Euclidean."""

    config: ModelConfig

    def forward(self, clouds: Sequence[Tensor] | Tensor) -> Tensor:
        """Return the descriptors (B, D) of clouds (B, n, 3), or of B clouds (n_i, 3) of any sizes."""
        raise NotImplementedError
