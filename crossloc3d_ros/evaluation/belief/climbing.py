"""Whether the search lost the right pose: what the aligner says of a pose refined from the truth, and of its answer."""

from __future__ import annotations

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.localization.alignment.aligner import Aligner
from crossloc3d_ros.localization.alignment.evidence import evidence_of_scan
from crossloc3d_ros.types import DescriptorEncoder, Estimate, Float64Array, Hypotheses

COLUMN = "climbed"


class Climber:
    """Compare poses by the scores of one map's aligner."""

    def __init__(self, aerial_map: AerialMap, encoder: DescriptorEncoder, config: LocalizerConfig) -> None:
        """Read nothing of the map yet; the settings are the localizer's."""
        self._aligner = Aligner(aerial_map, config.alignment)
        self._preprocessing, self._config = encoder.preprocessing, config

    def compare(self, scan: RawScan, estimate: Estimate) -> Float64Array:
        """Return (2,) the log likelihoods of the pose that a climb from the truth ends at, and of the best answer's.

        Both are refined as hypotheses of one alignment, with the candidates of the estimate, so that they differ in the
        pose alone. NaN for the answer where there is none, for both where the scan isn't aligned.
        """
        nothing = np.full(2, np.nan)
        mounting = scan.T_base_lidar
        prepared = prepare_scan(scan.as_scan(), self._config.scan, self._preprocessing, scan.up_base, mounting)
        if prepared.patch is None:
            return nothing
        alignment = self._aligner.begin(evidence_of_scan(prepared, mounting), estimate.candidates)
        if alignment is None:
            return nothing
        answer = estimate.aligned
        grid = np.concatenate([scan.T_grid_base[None, :3, 3], answer.grid[:1]])
        headings = np.concatenate([[scan.heading_rad], answer.heading_rad[:1]])
        spread = np.tile(np.diag([1.0, 1.0, 0.01]), (len(grid), 1, 1))
        alignment.refine_hypotheses(Hypotheses(grid, headings, spread, np.full(len(grid), 1.0 / len(grid))))
        found = alignment.result()
        for row, source in enumerate(found.source.tolist()):
            if source in (-1, -2):
                nothing[-1 - source] = found.log_likelihood[row]
        return nothing
