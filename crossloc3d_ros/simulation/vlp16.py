"""A Velodyne VLP-16: 16 beams from -15 to +15 degrees, 10 turns a second; the sensor of the benchmarks and of training.

    scan = Vlp16().scan(world.scene, T_world_lidar, np.random.default_rng(1))
    scan.points            # (N, 3) float32, lidar frame, N up to 28,900

A scan takes about 10 ms.
"""

from __future__ import annotations

from crossloc3d_ros.simulation.lidar import Lidar, LidarConfig, LidarProfile

# VLP-16 User Manual 63-9243 Rev. D: 16 lasers fire in 55.296 us, one in 2.304 us; range errors of up to 3 cm.
VLP16 = LidarProfile(
    "vlp-16",
    elevations_deg=(-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15),
    column_s=55.296e-6,
    firing_s=2.304e-6,
)


class Vlp16(Lidar):
    """A VLP-16."""

    def __init__(self, config: LidarConfig | None = None) -> None:
        """Set up the sensor; `config` in place of its own."""
        super().__init__(VLP16, config)
