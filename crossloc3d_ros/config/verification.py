"""The comparison of height maps that reorders retrieved places."""

from __future__ import annotations

from dataclasses import dataclass

from crossloc3d_ros.config.settings import option


@dataclass(frozen=True)
class HeightMapConfig:
    """How height maps are made and compared."""

    cells: int = option(64, "cells along a side of the raster", low=4, high=1000)
    rings: int = option(20, "rings from a centre out to half the patch's side", low=1, high=200)
    sectors: int = option(60, "sectors of the full circle: 60 = headings in steps of 6 degrees", low=4, high=720)
    reach: int = option(2, "centres tried on either side of the robot along both axes: 2 = 25", low=0, high=10)
    step_m: float = option(3.5, "distance between neighbouring centres", low=0.1, high=50.0)
    top_deg: float = option(15.0, "elevation of the sensor's highest beam", low=0.0, high=89.0)
    smooth: int = option(1, "cells on either side that the survey's map is smoothed over", low=0, high=10)


@dataclass(frozen=True)
class VerificationConfig:
    """How many retrieved places are reordered, and how far each distance counts."""

    candidates: int = option(300, "retrieved submaps of a query that are compared by height maps", low=1, high=100_000)
    weight: float = option(293.0, "weight of the height maps' distance beside the descriptors'", low=0.0, high=1e6)
