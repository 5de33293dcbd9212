"""What is known of the pose from outside: an operator's initial pose, a compass."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.errors import PoseError
from crossloc3d_ros.localization.fusion.filter import UNKNOWN_HEADING_VARIANCE
from crossloc3d_ros.localization.fusion.linear_algebra import at_least, why_no_covariance
from crossloc3d_ros.localization.fusion.mixture import Mixture, new_hypotheses
from crossloc3d_ros.localization.inputs import check_stamp, float_array
from crossloc3d_ros.types import Float64Array

LARGEST_STD_M = 150.0
"""A wider hypothesis is no more than that the robot is on the map: it is not tracked."""
_MIN_STD_M, _MIN_STD_DEG = 0.1, 0.5  # of an initial pose: nobody gives one more exactly
_FARTHEST_M = 1e8
_WIDEST_STD = 1e6  # what is wider overflows, and says no less
_COMPASS_STALE_NS = 1e9  # the robot may have turned since
_COMPASS_MIN_STD_RAD = math.radians(1.0)  # magnetometers do no better
_COMPASS_FAULT = 0.1  # one compass in ten stands beside iron


@dataclass(frozen=True, eq=False)
class PosePrior:
    """What is known of the pose from outside, at one time."""

    grid: Float64Array | None
    """(3,) easting, northing, height, metres, grid frame; None where only the heading is known."""
    heading_rad: float | None
    """Counter-clockwise from grid east; None where only the position is known."""
    covariance: Float64Array
    """(3, 3) of easting, northing, heading: m2, m rad, rad2; infinite where unknown."""
    stamp_ns: int
    """When it held; 0 = now."""

    def __post_init__(self) -> None:
        """Refuse, by PoseError, what is no prior: it would stay in the belief."""
        covariance = float_array(self.covariance, (3, 3), "the covariance of a prior")
        why = why_no_covariance(covariance)
        if why:
            raise PoseError(f"the covariance of a prior {why}: {np.round(covariance, 3).tolist()}")
        object.__setattr__(self, "covariance", covariance)
        if self.grid is not None:
            grid = float_array(self.grid, (3,), "the position of a prior")
            if not (np.abs(grid) <= _FARTHEST_M).all():
                raise PoseError(f"the position of a prior must be easting, northing, height in metres: {grid.tolist()}")
            object.__setattr__(self, "grid", grid)
        if self.heading_rad is not None:
            heading = float(float_array(self.heading_rad, (), "the heading of a prior"))
            if not math.isfinite(heading):
                raise PoseError(f"the heading of a prior must be a number, or None where it is not known: {heading}")
            object.__setattr__(self, "heading_rad", heading)
        check_stamp(self.stamp_ns, "the stamp of a prior")


class Priors:
    """The initial poses given since the last scan, and the last heading of a compass."""

    def __init__(self) -> None:
        self._poses: list[PosePrior] = []
        self._compass: PosePrior | None = None

    def add(self, prior: PosePrior) -> None:
        """Take in a prior; one without position and heading changes nothing."""
        if prior.grid is not None:
            self._poses.append(prior)
        elif prior.heading_rad is not None:
            self._compass = prior

    def take_poses(self, stamp_ns: int, travelled_m: float, config: FusionConfig) -> list[Mixture]:
        """Return a hypothesis for each initial pose given, each but once; `travelled_m` since the last scan."""
        poses, self._poses = self._poses, []
        return [
            _hypothesis(prior, prior.grid, travelled_m if prior.stamp_ns and stamp_ns > prior.stamp_ns else 0.0, config)
            for prior in poses
            if prior.grid is not None
        ]

    def log_likelihood_ratio(self, heading_rad: Float64Array, stamp_ns: int | None) -> Float64Array:
        """Return log likelihood ratios (n,) of headings by the compass: against a uniform one; 0 without a compass."""
        compass = self._compass
        if compass is None or compass.heading_rad is None or stamp_ns is None:
            return np.zeros(len(heading_rad))
        variance = float(compass.covariance[2, 2])
        stale = bool(compass.stamp_ns) and abs(stamp_ns - compass.stamp_ns) > _COMPASS_STALE_NS
        if stale or not np.isfinite(variance):
            return np.zeros(len(heading_rad))
        variance = max(variance, _COMPASS_MIN_STD_RAD**2)
        off = wrap(heading_rad - compass.heading_rad)
        peak = 2.0 * math.pi / math.sqrt(2.0 * math.pi * variance)
        return np.asarray(np.log(_COMPASS_FAULT + (1.0 - _COMPASS_FAULT) * peak * np.exp(-0.5 * off**2 / variance)))


def _hypothesis(prior: PosePrior, grid: Float64Array, travelled_m: float, config: FusionConfig) -> Mixture:
    """Return the hypothesis of an initial pose; it may have moved by up to `travelled_m` since."""
    covariance, heading = prior.covariance.copy(), prior.heading_rad
    if heading is None or not np.isfinite(covariance[2]).all():
        covariance[2, :] = covariance[:, 2] = 0.0
        covariance[2, 2] = UNKNOWN_HEADING_VARIANCE
    covariance = np.nan_to_num(covariance, posinf=LARGEST_STD_M**2)
    covariance *= np.outer(*2 * [np.minimum(1.0, _WIDEST_STD / np.sqrt(np.maximum(np.diag(covariance), 1e-12)))])
    covariance[:2, :2] += np.eye(2) * travelled_m**2
    born = new_hypotheses(
        grid[None], np.array([heading or 0.0]), at_least(covariance[None], _MIN_STD_M, _MIN_STD_DEG),
        np.array([math.log(config.initial_pose_probability)]), config,
    )  # fmt: skip
    # Whoever gives a pose has confirmed it; the first scan is the first of its spot.
    return dataclasses.replace(born, explained_m=np.array([np.inf]), scan_count=np.zeros(1))
