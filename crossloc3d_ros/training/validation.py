"""Recall on towns that training never sees, and the distances that separate right from wrong."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import CalibrationConfig
from crossloc3d_ros.evaluation.statistics import (
    RADII_M,
    Recall,
    chance_level,
    find_recall,
    one_per_cent,
    wilson_share,
)
from crossloc3d_ros.localization.retrieval.candidates import heading_angles
from crossloc3d_ros.localization.retrieval.place_belief import calibrate
from crossloc3d_ros.training.shards import ValidationTown
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

TOP = (1, 5, 25)
QUANTILES = (0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)


@dataclass(frozen=True, eq=False)
class Places:
    """Positions of several towns in one database; places of different towns are never the same."""

    town: Int64Array
    """(N,) which town."""
    xy_m: Float64Array
    """(N, 2) in the town's own frame."""


@dataclass(frozen=True)
class Validation:
    """One evaluation on the held-out towns: aerial database, ground queries, headings over the full circle."""

    queries: int
    submaps: int
    recalls: tuple[Recall, ...]
    """With Wilson's intervals over the queries, as if these were independent."""
    true_distances: tuple[float, ...]
    """Quantiles (`QUANTILES`) of the descriptor distance from a scan to the submap that is centred nearest."""
    false_distances: tuple[float, ...]
    """The same to the nearest descriptor among the submaps more than 100 m away."""
    calibration: CalibrationConfig
    """What the localizer should make of the distances."""

    def recall(self, label: str, radius_m: float) -> Recall:
        """Return one recall, as `recall("R@1", 100.0)`; KeyError where there is none."""
        return find_recall(self.recalls, label, radius_m)

    def stored(self) -> dict[str, Any]:
        """Return what logs and weights keep of it."""
        recalls = [
            {
                "radius_m": recall.radius_m,
                "count": recall.rank,
                "label": recall.label,
                "value": recall.share.value,
                "chance": recall.chance,
                "low": recall.share.low,
                "high": recall.share.high,
            }
            for recall in self.recalls
        ]
        return {**dataclasses.asdict(self), "recalls": recalls}


def ground_distances(queries: Places, submaps: Places) -> Float64Array:
    """Return the distances (Q, M) in metres on the ground, infinite between towns."""
    offsets = queries.xy_m[:, None, :] - submaps.xy_m[None, :, :]
    distances: Float64Array = np.hypot(offsets[..., 0], offsets[..., 1])
    distances[queries.town[:, None] != submaps.town[None, :]] = math.inf
    return distances


def score(descriptor_distances: Float64Array, metres: Float64Array) -> Validation:
    """Return recall and distances from both (Q, M) matrices: descriptor units and metres on the ground.

    Queries without any submap within a radius do not count for that radius.
    """
    queries, submaps = metres.shape
    order = np.argsort(descriptor_distances, axis=1, kind="stable")
    ranked_metres = np.take_along_axis(metres, order, axis=1)
    recalls = []
    ranks = [*((f"R@{k}", k) for k in TOP), ("R@1%", one_per_cent(submaps, rounded_up=True))]
    for radius_m in RADII_M:
        right = ranked_metres <= radius_m
        possible = right.any(axis=1)
        right = right[possible]
        first = right.argmax(axis=1)
        chance = chance_level(right.sum(axis=1), submaps, max(rank for _, rank in ranks))
        for label, rank in ranks:
            share = wilson_share(int((first < rank).sum()) / max(1, len(first)), len(first))
            level = float(chance[rank - 1]) if len(first) else 0.0
            recalls.append(Recall(rank, radius_m, share, level, label))
    true = np.take_along_axis(descriptor_distances, metres.argmin(axis=1)[:, None], axis=1)[:, 0]
    false = np.where(metres > max(RADII_M), descriptor_distances, math.inf).min(axis=1)
    return Validation(
        queries=queries,
        submaps=submaps,
        recalls=tuple(recalls),
        true_distances=_quantiles(true),
        false_distances=_quantiles(false),
        calibration=fit_calibration(descriptor_distances, metres),
    )


def fit_calibration(descriptor_distances: Float64Array, metres: Float64Array) -> CalibrationConfig:
    """Fit the localizer's calibration to the same matrices.

    Every query counts twice: against the whole database, and against the database without its own town. The second
    is a robot outside of the map, for which low beliefs must be learned.
    """
    distances, separations_m = [], []
    for near, apart in zip(descriptor_distances, metres, strict=True):
        for allowed in (np.ones(len(apart), np.bool_), np.isinf(apart)):
            if allowed.any():
                best = np.argsort(near[allowed], kind="stable")[: max(TOP)]
                distances.append(near[allowed][best].astype(np.float32))
                separations_m.append(apart[allowed][best])
    return calibrate(distances, separations_m)


def validate(
    towns: Sequence[ValidationTown],
    encode: Callable[[list[Float32Array]], Float32Array],
    headings: int = 1,
    rotations: int = 1,
) -> Validation:
    """Encode all queries and submaps of the held-out towns into one database and score the retrieval.

    `encode` maps patches (n, 3) to descriptors (B, D). With `headings` H > 1 every query, whatever its heading, is
    encoded H times, rotated by 2 pi h / H, and its distance to a submap is the least of the H. With `rotations` T > 1
    and one heading its descriptor is the mean over T test-time rotations.
    """
    query_places = Places(_towns([len(t.query_xy_m) for t in towns]), np.concatenate([t.query_xy_m for t in towns]))
    submap_places = Places(_towns([len(t.submap_xy_m) for t in towns]), np.concatenate([t.submap_xy_m for t in towns]))
    patches = [patch for town in towns for patch in town.query_patches]
    submaps = encode([patch for town in towns for patch in town.submap_patches])
    angles = heading_angles(max(headings, rotations))
    encoded = [encode([rotate_about_z(patch, float(angle)) for patch in patches]) for angle in angles]
    queries = encoded if headings > 1 else [np.mean(encoded, axis=0)]
    nearest = np.min([euclidean_distances(q, submaps) for q in queries], axis=0)
    return score(nearest, ground_distances(query_places, submap_places))


def euclidean_distances(a: Float32Array, b: Float32Array) -> Float64Array:
    """Return the Euclidean distances (A, B) between descriptors (A, D) and (B, D)."""
    wide_a, wide_b = a.astype(np.float64), b.astype(np.float64)
    squares = (wide_a**2).sum(1)[:, None] + (wide_b**2).sum(1)[None, :] - 2.0 * wide_a @ wide_b.T
    distances: Float64Array = np.sqrt(np.maximum(squares, 0.0))
    return distances


def _quantiles(distances: Float64Array) -> tuple[float, ...]:
    """Return the quantiles of what is finite: small towns may have no submap that is far away."""
    finite = distances[np.isfinite(distances)]
    return tuple(np.quantile(finite, QUANTILES).round(5).tolist()) if len(finite) else ()


def _towns(counts: Sequence[int]) -> Int64Array:
    return np.repeat(np.arange(len(counts), dtype=np.int64), counts)
