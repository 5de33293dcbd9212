"""From a descriptor to the places in the aerial map that look like it."""

from __future__ import annotations

from crossloc3d_ros.config import CalibrationConfig
from crossloc3d_ros.localization.credibility import candidate_probabilities
from crossloc3d_ros.places.store import AerialMap
from crossloc3d_ros.types import Candidates, Float32Array


def retrieve(descriptor: Float32Array, aerial_map: AerialMap, top_k: int, calibration: CalibrationConfig) -> Candidates:
    """Return the `top_k` submaps, fewer on a small map, that look most like `descriptor` (D,), best first."""
    submap_ids, distances = aerial_map.index.search(descriptor, top_k)
    return Candidates(
        submap_ids=submap_ids,
        descriptor_distances=distances,
        probabilities=candidate_probabilities(distances, calibration),
        grid=aerial_map.submaps.grid[submap_ids],
    )
