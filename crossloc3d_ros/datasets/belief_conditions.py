"""Under which conditions the belief of the localizer is evaluated: other surveys, other scans, a changed world."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.datasets.pose_drives import Journey, RawDrive
from crossloc3d_ros.datasets.raw_scans import RawScan, RawScans
from crossloc3d_ros.simulation.vlp16 import VLP16


@dataclass(frozen=True)
class Condition:
    """One way in which a set is evaluated."""

    name: str
    density_per_m2: float | None = None
    """To how many points the survey of the map is thinned; None leaves it as it was delivered."""
    is_aged: bool = False
    """Whether trees and houses are gone from the world that is scanned; see `datasets.aged`."""
    lidar: str = VLP16.name
    """Of `simulation.profiles`: what scans and drives are recorded with."""
    every_point: int = 1
    """Each n-th point of a scan is kept, in the order in which the sensor sends them."""
    max_range_m: float = math.inf
    """Points farther away are dropped."""
    is_kidnapped: bool = False
    """Whether robots are kidnapped at the ends of their drives."""

    @property
    def is_recorded_anew(self) -> bool:
        """Whether scans and drives are others than those of the pose set."""
        return self.is_aged or self.lidar != VLP16.name

    @property
    def changes_scans(self) -> bool:
        """Whether scans are not taken as they were recorded."""
        return self.every_point > 1 or math.isfinite(self.max_range_m)

    def seen(self, scan: RawScan) -> RawScan:
        """Return a scan as the robot has it under this condition."""
        if not self.changes_scans:
            return scan
        points = scan.points[:: self.every_point]
        return dataclasses.replace(scan, points=points[np.linalg.norm(points, axis=1) <= self.max_range_m])

    def driven(self, drives: Sequence[RawDrive], journey: Journey) -> Sequence[RawDrive]:
        """Return the drives with the scans of those that a journey takes as they are under this condition."""
        if not self.changes_scans:
            return drives
        chosen = {leg.drive for leg in journey.legs}
        return [
            dataclasses.replace(each, scans=RawScans.of(self.seen(scan) for scan in each.scans))
            if i in chosen
            else each
            for i, each in enumerate(drives)
        ]

    def started(self, journey: Journey) -> Journey:
        """Return a journey as it is evaluated under this condition."""
        return journey if self.is_kidnapped else Journey(journey.legs[:1])


DELIVERED = Condition("as delivered", is_kidnapped=True)
CONDITIONS = (
    DELIVERED,
    Condition("8 points/m2", density_per_m2=8.0),
    Condition("2 points/m2", density_per_m2=2.0),
    Condition("0.5 points/m2", density_per_m2=0.5),
    Condition("aged", is_aged=True),
    Condition("64 beams", lidar="os1-64"),
    Condition("every 20th point", every_point=20),
    Condition("range 30 m", max_range_m=30.0),
)
"""Of the simulated towns. Densities of national surveys; a lidar that sends four times as many points as a VLP-16, in a
wider field; a sensor of some 1,500 points; fog, rain or a short sensor."""
