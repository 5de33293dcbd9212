"""The localizer: a scan in, an estimate out."""

from __future__ import annotations

import time

import numpy as np

from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.localization.credibility import effective_calibration, judge
from crossloc3d_ros.localization.retrieval import encode_query, retrieve
from crossloc3d_ros.places.store import AerialMap
from crossloc3d_ros.types import (
    Candidates,
    DescriptorEncoder,
    Estimate,
    FixStatus,
    Float64Array,
    Scan,
    ScanCounts,
    Timings,
)


class Localizer:
    """Tell where on an aerial map a LiDAR scan was taken, without an initial pose."""

    def __init__(self, aerial_map: AerialMap, encoder: DescriptorEncoder, config: LocalizerConfig) -> None:
        """Bring map and encoder together; they must belong to each other, as `AerialMap.load` ensures."""
        self.aerial_map = aerial_map
        self.encoder = encoder
        self.config = config
        self.calibration = effective_calibration(config.credibility, encoder)

    def localize(
        self, scan: Scan, gravity_base: Float64Array | None = None, T_base_lidar: Float64Array | None = None
    ) -> Estimate:
        """Return where `scan` was taken.

        `gravity_base` (3,) is the unit vector that points up, measured in the base frame, where an IMU gives one;
        `T_base_lidar` (4, 4) replaces the mounting of the configuration, where TF gives it.
        """
        started = time.perf_counter()
        prepared = prepare_scan(scan, self.config.scan, self.encoder.preprocessing, gravity_base, T_base_lidar)
        prepared_at = time.perf_counter()
        if prepared.patch is None:
            timings = Timings(prepare_ms=1e3 * (prepared_at - started))
            return no_estimate(scan.stamp_ns, prepared.reason, prepared.counts, timings)
        descriptors = encode_query(self.encoder, prepared.patch.points)
        encoded_at = time.perf_counter()
        candidates = retrieve(descriptors, self.aerial_map, self.config.top_k, self.calibration)
        frame = self.aerial_map.frame
        belief = judge(candidates, frame.to_enu(candidates.grid), self.config.credibility)
        grid = frame.from_enu(belief.enu[None])
        latitude, longitude, altitude = frame.to_geographic(grid)
        searched_at = time.perf_counter()
        return Estimate(
            stamp_ns=scan.stamp_ns,
            status=belief.status,
            reason=belief.reason,
            grid=grid[0],
            enu=belief.enu,
            latitude_deg=float(latitude[0]),
            longitude_deg=float(longitude[0]),
            altitude_m=float(altitude[0]),
            covariance=belief.covariance,
            candidates=candidates,
            counts=prepared.counts,
            timings=Timings(
                prepare_ms=1e3 * (prepared_at - started),
                encode_ms=1e3 * (encoded_at - prepared_at),
                search_ms=1e3 * (searched_at - encoded_at),
            ),
        )

    def warm_up(self) -> None:
        """Run every step once, so that the first scan is as fast as the others.

        Call it in the thread that localizes: numerical libraries keep state for each thread.
        """
        self.encoder.warm_up()
        rng = np.random.default_rng(0)
        ground = np.column_stack([rng.uniform(-30, 30, (8000, 2)), np.full(8000, -self.config.scan.mounting.z_m)])
        walls = np.column_stack([rng.uniform(-30, 30, 8000), np.full(8000, 12.0), rng.uniform(0, 8, 8000)])
        points = np.vstack([ground, walls]).astype(np.float32)
        up = np.array([0.0, 0.0, 1.0])
        for gravity_base in (None, up):
            self.localize(Scan(points, stamp_ns=0, frame_id="warm_up"), gravity_base)


def no_estimate(
    stamp_ns: int, reason: str, counts: ScanCounts | None = None, timings: Timings | None = None
) -> Estimate:
    """Return the estimate of a scan that led to no candidate at all, with the reason."""
    return Estimate(
        stamp_ns=stamp_ns,
        status=FixStatus.NO_FIX,
        reason=reason,
        grid=np.full(3, np.nan),
        enu=np.full(3, np.nan),
        latitude_deg=float("nan"),
        longitude_deg=float("nan"),
        altitude_m=float("nan"),
        covariance=np.full((3, 3), np.nan),
        candidates=Candidates(
            submap_ids=np.empty(0, dtype=np.int64),
            descriptor_distances=np.empty(0, dtype=np.float32),
            probabilities=np.empty(0),
            grid=np.empty((0, 3)),
        ),
        counts=counts or ScanCounts(),
        timings=timings or Timings(),
    )
