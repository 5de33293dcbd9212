"""From predictions to figures: pure functions of the predicted places and the true ones.

Which queries count: as in the released evaluators, those with at least one database place within the radius; others
cannot be localized and are left out of that radius, their number is reported.

Intervals are those of `statistics`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from crossloc3d_ros.config import HeightMapConfig
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.evaluation.retrieval.predictions import (
    About,
    Predictions,
    database_of,
    driven_angles,
    metres_of,
)
from crossloc3d_ros.evaluation.statistics import (
    RADII_M,
    Recall,
    Share,
    chance_level,
    clustered_mean,
    clustered_share,
    clusters_of,
    find_recall,
    hits,
    independent_places_in_areas,
    one_per_cent,
)
from crossloc3d_ros.localization.retrieval.candidates import heading_angles
from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

RANKS = (1, 5, 10, 25)
CURVE = 100
"""Ranks of the AR@N curves."""
PUBLISHED_ONE_PER_CENT = 25
"""What the released evaluators call AR@1%: they retrieve 25 results, whatever the size of the database."""


@dataclass(frozen=True, eq=False)
class Curve:
    """AR@N over N = 1 to 100 for one radius."""

    radius_m: float
    recall: Float64Array
    """(100,)"""
    chance: Float64Array
    """(100,)"""


@dataclass(frozen=True)
class GroupScores:
    """The figures of some of the queries."""

    name: str
    queries: int
    areas: int
    recalls: tuple[Recall, ...]
    counted: Mapping[float, int]
    """Queries with a place within each radius, of which the recalls are."""

    def recall(self, label: str, radius_m: float) -> Recall:
        """Return one recall, as `recall("R@1", 100.0)`; KeyError where there is none."""
        return find_recall(self.recalls, label, radius_m)


@dataclass(frozen=True)
class HeadingErrors:
    """How well the heading in which a query was found fits the robot's, over first places within 100 m."""

    queries: int
    step_deg: float
    """Between the headings tried."""
    median_deg: float
    within_step: float
    """Share of the errors of at most one step."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Everything that predictions are worth."""

    about: About
    overall: GroupScores
    groups: tuple[GroupScores, ...]
    """By the set's own groups, such as held-out families."""
    families: tuple[GroupScores, ...]
    areas: tuple[GroupScores, ...]
    curves: tuple[Curve, ...]
    first_m: Float64Array
    """(Q,) metres from each query to its first place, infinite in another area."""
    heading: HeadingErrors | None = None
    """None where a query was tried in one heading alone, or none was found."""

    def tables(self) -> Mapping[str, Sequence[GroupScores]]:
        """Return the groups of figures by what they are divided by."""
        return {"all": [self.overall], "group": self.groups, "family": self.families, "area": self.areas}


def score(predictions: Predictions, evaluation_set: EvaluationSet) -> Scores:
    """Score predictions; EvaluationError where they were made of another set."""
    queries = evaluation_set.queries
    database = database_of(evaluation_set, predictions.about.setting)
    metres = metres_of(predictions, evaluation_set)
    truths = [_Truth.of(metres, queries, database, radius) for radius in RADII_M]
    everything = np.ones(len(queries), np.bool_)

    def of(name: str, chosen: BoolArray) -> GroupScores:
        return _group(name, chosen, truths, queries, len(database))

    family_of = np.array(evaluation_set.families)[queries.area]
    group_of = np.array(evaluation_set.query_groups or [""] * len(queries))
    families = list(dict.fromkeys(evaluation_set.families))
    groups = list(dict.fromkeys(evaluation_set.query_groups))
    areas = sorted(set(queries.area.tolist()))
    return Scores(
        about=predictions.about,
        overall=of("all", everything),
        groups=tuple(of(name, group_of == name) for name in groups),
        families=tuple(of(name, family_of == name) for name in families if (family_of == name).any()),
        areas=tuple(of(evaluation_set.area_names[area], queries.area == area) for area in areas),
        curves=tuple(_curve(truth, len(database)) for truth in truths),
        first_m=metres[:, 0],
        heading=_heading_errors(predictions, queries, np.asarray(metres[:, 0] <= max(RADII_M), dtype=np.bool_)),
    )


def _heading_errors(predictions: Predictions, queries: PlaceSet, found: BoolArray) -> HeadingErrors | None:
    about = predictions.about
    if about.heading != "random":
        return None
    if predictions.fit_headings_rad is not None:
        tried, step_deg = predictions.fit_headings_rad[:, 0].astype(np.float64), 360.0 / HeightMapConfig().sectors
    elif about.way == "nearest" and about.query_headings > 1:
        tried, step_deg = heading_angles(about.query_headings)[predictions.headings[:, 0]], 360.0 / about.query_headings
    else:
        return None
    driven = found & (driven_angles(queries)[:, 0] == 0.0)  # of the others the heading is not known
    if not driven.any():
        return None
    apart = np.degrees(np.abs(np.angle(np.exp(1j * (tried - queries.heading_rad)[driven]))))
    return HeadingErrors(int(driven.sum()), step_deg, float(np.median(apart)), float(np.mean(apart <= step_deg)))


@dataclass(frozen=True, eq=False)
class _Truth:
    """Which places are right within a radius."""

    radius_m: float
    first_hit: Int64Array
    """(Q,) place of the first right one from 0; beyond every rank where there is none."""
    within: Int64Array
    """(Q,) places of the database within the radius."""

    @classmethod
    def of(cls, metres: Float64Array, queries: PlaceSet, database: PlaceSet, radius_m: float) -> _Truth:
        right = metres <= radius_m
        first = np.where(right.any(axis=1), right.argmax(axis=1), np.iinfo(np.int64).max)
        return cls(radius_m, first.astype(np.int64), places_within(queries, database, radius_m))


def places_within(queries: PlaceSet, database: PlaceSet, radius_m: float) -> Int64Array:
    """Count (Q,) the database's places of a query's area within the radius of it."""
    counts = np.zeros(len(queries), np.int64)
    for area in np.unique(queries.area):
        here, there = queries.area == area, database.area == area
        if there.any():
            found = cKDTree(database.xy_m[there]).query_ball_point(queries.xy_m[here], radius_m, return_length=True)
            counts[here] = found
    return counts


def difference(
    one: Predictions, other: Predictions, evaluation_set: EvaluationSet, rank: int = 1, radius_m: float = 100.0
) -> Share:
    """Return by how much the recall of `one` exceeds that of `other` on the same queries, with its 95 % interval.

    The bootstrap draws whole areas, the same for both, so that what is hard about a town cancels. An interval without 0
    says that one method is ahead. Both must be of the same set and setting.
    """
    if one.about.setting != other.about.setting:
        raise ValueError(f"settings differ: {one.about.setting} and {other.about.setting}")
    queries, database = evaluation_set.queries, database_of(evaluation_set, one.about.setting)
    counted = np.asarray(places_within(queries, database, radius_m) > 0, dtype=np.bool_)
    hit, other_hit = (hits(metres_of(each, evaluation_set)[counted], rank, radius_m) for each in (one, other))
    ahead = hit.astype(np.float64) - other_hit
    if len(ahead) == 0:
        return Share(float("nan"), -1.0, 1.0)
    return clustered_mean(ahead, clusters_of(queries.area[counted], queries.xy_m[counted]))


def _group(name: str, chosen: BoolArray, truths: Sequence[_Truth], queries: PlaceSet, database: int) -> GroupScores:
    ranks = [*((f"R@{rank}", rank) for rank in RANKS), ("R@1%", one_per_cent(database, rounded_up=False))]
    recalls, counts = [], {}
    for truth in truths:
        counted = chosen & (truth.within > 0)
        area, xy_m = queries.area[counted], queries.xy_m[counted]
        clusters, places = clusters_of(area, xy_m), independent_places_in_areas(area, xy_m)
        chance = _chance(truth.within[counted], database, max(rank for _, rank in ranks))
        counts[truth.radius_m] = int(counted.sum())
        for label, rank in ranks:
            share = clustered_share(truth.first_hit[counted] < rank, clusters, places)
            recalls.append(Recall(rank, truth.radius_m, share, float(chance[rank - 1]), label))
    return GroupScores(name, int(chosen.sum()), len(np.unique(queries.area[chosen])), tuple(recalls), counts)


def _curve(truth: _Truth, database: int) -> Curve:
    counted = truth.within > 0
    first = truth.first_hit[counted]
    reached = np.array([(first < rank).mean() if len(first) else np.nan for rank in range(1, CURVE + 1)])
    return Curve(truth.radius_m, reached, _chance(truth.within[counted], database, CURVE))


def _chance(within: Int64Array, database: int, ranks: int) -> Float64Array:
    return chance_level(np.sort(within), database, ranks)  # sorted: the sum rounds alike whatever the queries' order
