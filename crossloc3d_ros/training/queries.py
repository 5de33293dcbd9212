"""What an alignment is learned from: the evidence of single scans and of local maps, and where it was taken."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import FusionConfig, PreprocessingConfig, ScanConfig
from crossloc3d_ros.datasets.pose_drives import RawDrive
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.localization.alignment.evidence import Evidence, evidence_of_scan
from crossloc3d_ros.localization.alignment.local_map import LocalMap
from crossloc3d_ros.localization.fusion.odometry import OdometryBuffer, planar_pose, unknown_motion
from crossloc3d_ros.types import Float32Array, Float64Array, UInt8Array

EVERY_M = 10.0
"""Distance between the local maps that are taken of a drive."""


@dataclass(frozen=True, eq=False)
class Query:
    """Evidence to be aligned."""

    xy_m: Float32Array
    """(n, 2) as `Evidence` has it, in half of its size: thousands are kept in memory."""
    channel: UInt8Array
    """(n,)"""
    T_grid_base: Float64Array
    """(4, 4) true pose, as that of a `RawScan`."""
    area: int

    @property
    def evidence(self) -> Evidence:
        """The evidence, as the alignment takes it."""
        return Evidence(self.xy_m.astype(np.float64), self.channel.astype(np.int64))

    @property
    def heading_rad(self) -> float:
        """The robot's true heading, counter-clockwise from grid east."""
        return float(np.arctan2(self.T_grid_base[1, 0], self.T_grid_base[0, 0]))


def query_of(scan: RawScan) -> Query:
    """Return the query of a single scan."""
    return _query(_evidence(scan), scan)


def local_maps(drive: RawDrive, scans: Iterable[RawScan], length_m: float) -> list[Query]:
    """Return the local maps of `length_m` every `EVERY_M` along a drive, whose `scans` may be of fewer points."""
    odometry = OdometryBuffer(FusionConfig())
    for stamp_ns, (x, y, heading) in zip(drive.odometry_ns.tolist(), drive.odometry.tolist(), strict=True):
        odometry.add(stamp_ns, planar_pose(x, y, heading))
    local_map, since_m = LocalMap(length_m), 0.0
    motion, last_ns = unknown_motion("no scan yet"), 0
    queries = []
    for scan in scans:
        if last_ns:
            motion = odometry.motion(last_ns, scan.stamp_ns)
        last_ns = scan.stamp_ns
        local_map.move(motion.delta if motion.is_known else None)
        since_m += motion.distance_m
        together = local_map.add(_evidence(scan))
        if since_m >= EVERY_M:
            queries.append(_query(together, scan))
            since_m = 0.0
    return queries


def _evidence(scan: RawScan) -> Evidence:
    """Return the evidence of a raw scan, prepared as the localizer does it."""
    mounting = scan.T_base_lidar
    return evidence_of_scan(
        prepare_scan(scan.as_scan(), ScanConfig(), PreprocessingConfig(), scan.up_base, mounting), mounting
    )


def _query(evidence: Evidence, scan: RawScan) -> Query:
    xy, channel = evidence.xy_m.astype(np.float32), evidence.channel.astype(np.uint8)
    return Query(xy, channel, scan.T_grid_base, scan.area)
