"""How well a map can be localized in: the settings of its calibration."""

from __future__ import annotations

from dataclasses import dataclass

from crossloc3d_ros.config.settings import option


@dataclass(frozen=True)
class LocalizabilityConfig:
    """From a map to where, and after how many metres, a robot is localized on it."""

    lidar: str = option("vlp-16", "lidar that is simulated: a name that 'simulate --lidar' knows")
    lidar_height_m: float = option(1.2, "height of the lidar above the ground", low=0.1, high=10.0)
    places: int = option(300, "places of the map from which short drives begin", low=4, high=100_000)
    off_map_scans: int = option(150, "scans of simulated towns, which lie on no map", low=5, high=100_000)
    seed: int = option(0, "seed of places, changes of the map, and noise", low=0, high=1_000_000_000)
    workers: int = option(1, "processes on this machine", low=1, high=256)
