"""Retrieval: from a patch to the submaps of the aerial map with the nearest descriptors."""

from __future__ import annotations

import math

import numpy as np

from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import CalibrationConfig
from crossloc3d_ros.localization.retrieval.place_belief import candidate_probabilities
from crossloc3d_ros.types import (
    Candidates,
    DescriptorEncoder,
    Float32Array,
    Float64Array,
    HeadingEncoder,
    Int64Array,
)


def heading_angles(count: int) -> Float64Array:
    """Return (count,) angles in radians, counter-clockwise from 0, evenly over the circle."""
    return 2.0 * math.pi * np.arange(count) / count


def encode_query(encoder: DescriptorEncoder, points: Float32Array) -> Float32Array:
    """Return the descriptors (H, D) under which the place of a patch (n, 3) may be found on the map.

    One for each heading of the robot, where the encoder distinguishes headings: submaps are encoded facing north.
    Otherwise one alone, averaged over the encoder's test-time rotations.
    """
    headings, rotations = (encoder.headings, encoder.rotations) if isinstance(encoder, HeadingEncoder) else (1, 1)
    if headings * rotations == 1:
        return encoder.encode(points)[None]
    count = headings if headings > 1 else rotations
    descriptors = encoder.encode_batch([rotate_about_z(points, float(angle)) for angle in heading_angles(count)])
    return descriptors if headings > 1 else descriptors.mean(axis=0, keepdims=True)


def search_headings(
    index: DescriptorMap, descriptors: Float32Array, k: int
) -> tuple[Int64Array, Float32Array, Int64Array]:
    """Return ids, distances and heading numbers (k,) of the submaps nearest to any of the descriptors (H, D)."""
    ids, distances = index.search_many(descriptors, k)
    order = np.argsort(distances, axis=None, kind="stable")
    flat = ids.reshape(-1)[order]
    # A submap counts once, where it is nearest; `first` keeps the order of the distances.
    first = np.sort(np.unique(flat, return_index=True)[1])[:k]
    best = order[first]
    return flat[first], distances.reshape(-1)[best], best // ids.shape[1]


def retrieve(
    descriptors: Float32Array, aerial_map: AerialMap, top_k: int, calibration: CalibrationConfig
) -> Candidates:
    """Return the `top_k` submaps, fewer on a small map, with the descriptors nearest to a query, best first.

    `descriptors` (H, D) are those of `encode_query`; a submap is as near as the nearest of them.
    """
    submap_ids, distances, numbers = search_headings(aerial_map.index, descriptors, top_k)
    headings = len(descriptors)
    return Candidates(
        submap_ids=submap_ids,
        descriptor_distances=distances,
        probabilities=candidate_probabilities(distances, calibration),
        grid=aerial_map.submaps.grid[submap_ids],
        heading_rad=heading_angles(headings)[numbers] if headings > 1 else np.empty(0),
    )
