"""From an aerial survey to a map: the builder's settings."""

from __future__ import annotations

from dataclasses import dataclass

from crossloc3d_ros.config.settings import option


@dataclass(frozen=True)
class BuildConfig:
    """From an aerial survey to a map."""

    spacing_m: float = option(19.0, "distance between the centres of neighbouring submaps", low=1.0, high=1000.0)
    cell_m: float = option(1.0, "cell of the height rasters", low=0.1, high=10.0)
    tile_m: float = option(380.0, "side of the tiles in which the area is processed", low=50.0, high=5000.0)
    min_coverage: float = option(0.75, "share of a submap's area that the survey must cover", low=0.0, high=1.0)
    chunk_points: int = option(1_000_000, "points read from a file at once", low=1000, high=100_000_000)
    workers: int = option(1, "processes on this machine", low=1, high=256)
