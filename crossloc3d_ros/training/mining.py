"""Find the places that the weights take for each other, across all towns."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.evaluation.statistics import RADII_M
from crossloc3d_ros.training.sampling import HardPlaces, Sampler
from crossloc3d_ros.training.validation import euclidean_distances
from crossloc3d_ros.types import Float32Array

_NEIGHBOURS = 8  # a place's most similar ones; a batch holds a few of them
_ROWS = 1024  # rows of the distance matrix held at once


def mine(
    sampler: Sampler, encode: Callable[[list[Float32Array]], Float32Array], config: TrainConfig, step: int
) -> HardPlaces:
    """Compare the submaps around places of all towns and return the most similar other places of each.

    `config.mined_places` of the places are drawn, by the seed and the step alone; other places are in
    another town, or more than 100 m away. All submaps are north up. Raises TrainingError where there is too little
    to compare.
    """
    town, scan, xy_m = sampler.places
    rng = np.random.default_rng((config.seed, step, 1))
    drawn = rng.permutation(len(town))[: config.mined_places]
    patches = [sampler.submap(int(town[i]), int(scan[i])) for i in drawn]
    drawn = drawn[[patch is not None for patch in patches]]
    town, scan, xy_m = town[drawn], scan[drawn], xy_m[drawn]
    apart = len(np.unique(town)) > 1 or (len(xy_m) and np.ptp(xy_m, axis=0).max() > max(RADII_M))
    if not apart:
        raise TrainingError("there are no places of different towns to compare; train without hard_share")
    descriptors = encode([patch for patch in patches if patch is not None])
    neighbours = []
    for first in range(0, len(drawn), _ROWS):
        rows = slice(first, first + _ROWS)
        distances = euclidean_distances(descriptors[rows], descriptors)
        metres = np.hypot(*(xy_m[rows, None] - xy_m[None]).transpose(2, 0, 1))
        distances[(town[rows, None] == town[None]) & (metres <= max(RADII_M))] = math.inf
        neighbours.append(_nearest(distances))
    return HardPlaces(town, scan, np.concatenate(neighbours))


def _nearest(distances: np.ndarray) -> np.ndarray:
    """Return the columns of the least distances of each row; the nearest once more in place of infinite ones."""
    order = np.argsort(distances, axis=1, kind="stable")[:, :_NEIGHBOURS]
    far = np.isinf(np.take_along_axis(distances, order, axis=1))
    nearest: np.ndarray = np.where(far, order[:, :1], order)
    return nearest
