"""Which frame the clouds of a recording are in, where no TF is at hand: its name decides."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from crossloc3d_ros.clouds.filters import mounting_matrix, transform_points
from crossloc3d_ros.config import MountingConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import Float64Array, Scan

_log = logging.getLogger(__name__)

_BASE_FRAMES = ("base_link", "base_footprint")
"""REP-105, REP-120."""


class CloudFrames:
    """Bring the clouds of one topic into the frame of the lidar, where the mounting holds for them."""

    def __init__(self, mounting: MountingConfig, base_frame_id: str = "base_link") -> None:
        """Take the clouds of `base_frame_id`, or of a frame that conventions name so, for moved into it already."""
        self._T_lidar_base: Float64Array = np.asarray(np.linalg.inv(mounting_matrix(mounting)), np.float64)
        self._bases = {base_frame_id.strip("/"), *_BASE_FRAMES}
        self._frame_id: str | None = None

    def __call__(self, scan: Scan) -> Scan:
        """Return a scan in the lidar's frame; CloudError where it is of another frame than the first one."""
        frame_id = scan.frame_id.strip("/")
        if self._frame_id is None:
            self._frame_id = frame_id
            if frame_id in self._bases:
                _log.warning(
                    "the clouds are in '%s' already, so the mounting of the lidar moves none of their points: it only "
                    "says where the beams begin",
                    frame_id,
                )
        if frame_id != self._frame_id:
            raise CloudError(
                f"the topic holds clouds of two frames, '{self._frame_id}' and '{frame_id}', and one mounting cannot "
                "hold for both: those of the first are used; give each lidar a topic of its own, or run the node with "
                "mounting_from_tf"
            )
        if frame_id not in self._bases:
            return scan
        points = transform_points(self._T_lidar_base, scan.points)
        return replace(scan, points=np.asarray(points, np.float32))
