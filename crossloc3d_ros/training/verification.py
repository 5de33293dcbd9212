"""Fit how much the height maps' distance counts beside the descriptors', on towns that were held out of training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp

from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet, join_sets
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.evaluation.retrieval.encoding import EncodingJob
from crossloc3d_ros.evaluation.retrieval.predictions import Plan, metres_of, predict_all, way_of
from crossloc3d_ros.evaluation.retrieval.verification import compare, scores_of, temperature_of
from crossloc3d_ros.evaluation.statistics import RADII_M
from crossloc3d_ros.training.shards import ValidationTown
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int64Array

RIGHT_M = 25.0
"""A place is right within this."""
_NEAREST_COUNT = 1e-3  # pull of both logarithms towards 0: keeps them finite where one distance decides everything

Progress = Callable[[str, float, float, str], None]


@dataclass(frozen=True)
class FittedVerification:
    """The fitted weight, and the recalls that it reaches on towns it was not fitted to."""

    weight: float
    """Of all towns."""
    town_weights: tuple[float, ...]
    """Each fitted without one of the towns."""
    towns: int
    queries: int
    submaps: int
    retrieval: tuple[float, ...]
    """R@1 within each of `RADII_M` by the descriptors alone."""
    verified: tuple[float, ...]
    """The same with height maps, every town by the weight fitted to the others."""


def fit_verification(
    towns: Sequence[ValidationTown], job: EncodingJob, candidates: int, threads: int = 1
) -> FittedVerification:
    """Retrieve the queries of held-out towns among all of them as `evaluate` does, and fit the weight to the places.

    `candidates` is how many places of each query are compared. Raises TrainingError where there are fewer than two
    towns, or no query has a right place among those found and a wrong one; EvaluationError where the encoder has no
    calibration.
    """
    if len(towns) < 2:
        raise TrainingError("the weight of height maps is evaluated on one town at a time: at least two are needed")
    places = evaluation_set_of(towns)
    temperature, half_extent_m = temperature_of(job.encoder), job.encoder.preprocessing.half_extent_m
    count, way = way_of(job.encoder)
    plan = Plan(("aerial",), ("random",), (count,), invariant=way == "mean", kept=candidates)
    predictions = next(made for made in predict_all(places, job, plan, "fitted") if made.about.way == way)
    fits = compare(predictions, places, half_extent_m, candidates, threads=threads, progress=job.progress).distances
    distances = predictions.distances[:, : fits.shape[1]]
    metres = metres_of(predictions, places)[:, : fits.shape[1]]
    right = np.asarray(metres <= RIGHT_M, np.bool_)
    area = places.queries.area
    verified = np.full(len(area), np.inf)
    town_weights = []
    for town in np.unique(area):
        weight = fit_weight(distances[area != town], fits[area != town], temperature, right[area != town])
        town_weights.append(weight)
        scores = scores_of(distances[area == town], fits[area == town], temperature, weight)
        best = np.argsort(scores, axis=1, kind="stable")[:, :1]
        verified[area == town] = np.take_along_axis(metres[area == town], best, axis=1)[:, 0]
    return FittedVerification(
        weight=fit_weight(distances, fits, temperature, right),
        town_weights=tuple(town_weights),
        towns=len(towns),
        queries=len(area),
        submaps=len(places.aerial),
        retrieval=_shares(metres[:, 0]),
        verified=_shares(verified),
    )


def fit_weight(distances: Float32Array, fits: Float32Array, temperature: float, right: BoolArray) -> float:
    """Return the weight under which the right places are likeliest, for `evaluation.verification.scores_of`.

    `distances` and `fits` (Q, N) are those of descriptors and of height maps. A place's odds fall by
    exp(-a d / temperature - b m), as in a conditional logit; a and b are those of the greatest likelihood, the weight
    is b / a.
    Queries without a right place, or without a wrong one, or without any height, are left out; TrainingError where no
    other is left.
    """
    usable = right.any(axis=1) & ~right.all(axis=1) & np.isfinite(fits).all(axis=1)
    if not usable.any():
        raise TrainingError("no query has a right and a wrong place among those found: nothing to learn from")
    learned, seen, hits = distances[usable] / np.float64(temperature), fits[usable].astype(np.float64), right[usable]
    unit = float(np.mean(seen.std(axis=1))) or 1.0  # so that both parameters are of the order of 1

    def loss(x: Float64Array) -> float:
        score = -np.exp(x[0]) * learned - np.exp(x[1]) / unit * seen
        losses = logsumexp(score, axis=1) - logsumexp(np.where(hits, score, -np.inf), axis=1)
        return float(losses.mean() + _NEAREST_COUNT * (x**2).sum())

    best = minimize(loss, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-9}).x
    return float(np.exp(best[1] - best[0]) / unit)


def evaluation_set_of(towns: Sequence[ValidationTown]) -> EvaluationSet:
    """Return held-out towns as one set with one database; which heading the scans have is not known."""
    return join_sets(
        "validation towns",
        [
            EvaluationSet(
                town.name,
                _places(town.query_patches, town.query_xy_m, np.nan),
                _places(town.submap_patches, town.submap_xy_m, 0.0),
                None,
                (town.name,),
                ("",),
            )
            for town in towns
        ],
    )


def _places(patches: Float32Array, xy_m: Float64Array, heading_rad: float) -> PlaceSet:
    area: Int64Array = np.zeros(len(xy_m), np.int64)
    return PlaceSet(patches, area, xy_m, np.full(len(xy_m), heading_rad))


def _shares(metres: Float64Array) -> tuple[float, ...]:
    return tuple(float((metres <= radius).mean()) for radius in RADII_M)
