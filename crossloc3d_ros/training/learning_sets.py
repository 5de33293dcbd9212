"""What the alignment is learned from: simulated towns under all conditions, and real surveys driven through."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.datasets.belief_sets import BeliefSet, BeliefSets, are_apart
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training.alignment import LearningSet
from crossloc3d_ros.training.queries import Query, local_maps, query_of

_FOLDS_OF_TOWNS = 2  # simulated towns of one set: half of them teach what the other half is weighed by
_QUERIES = 40  # of each kind, of a set and fold, on its map: neighbours along a street say much the same
_STRANGERS = 60  # of each kind on each map, from off it: what is wrong has more ways to be so than what is right

_Kinds = tuple[list[Query], ...]
"""Single scans, and local maps."""


def learning_sets(sets: BeliefSets, seed: int = 0) -> list[LearningSet]:
    """Return the sets that an alignment is learned from: every set on its map, and strangers on every map.

    Of each set single scans and local maps count alike. Strangers are drawn from the queries of all places that are off
    a map. Sets of one pose set are one fold, or two where it has several areas; real surveys that lie beside each other
    are one fold. TrainingError for a set that is kept for evaluation.
    """
    kept = [each.name for each in sets.on_map if not each.is_learned]
    kept += [each.name for each in sets.maps if not each.is_learned]
    if kept:
        raise TrainingError(f"'{kept[0]}' is kept for evaluation: learn from the pose set 'fitting' and other surveys")
    rng = np.random.default_rng(seed)
    named = {each.pose_set.map_folder: each.name for each in sets.on_map}
    named |= {each.folder: each.name for each in sets.maps if each.folder not in named}
    maps = {folder: AerialMap.load(folder) for folder in named}
    regions, queries = _regions(named, maps), _queries(sets)
    learned = []
    for each in sets.on_map:
        map_folder = each.pose_set.map_folder
        strangers = _strangers(sets, queries, maps, map_folder)
        for fold, of_fold in _folds(each, queries[_key(each)], regions[map_folder]):
            name = f"{each.name}, {each.condition.name}"
            learned.append(
                LearningSet(name, fold, map_folder, _some(of_fold, _QUERIES, rng), _some(strangers, _STRANGERS, rng))
            )
    known = {each.pose_set.map_folder for each in sets.on_map}
    for other in sets.maps:
        if other.folder not in known:
            strangers = _strangers(sets, queries, maps, other.folder)
            learned.append(
                LearningSet(other.name, regions[other.folder], other.folder, (), _some(strangers, _STRANGERS, rng))
            )
    return learned


def _key(each: BeliefSet) -> tuple[Path, int, float]:
    """Return what the queries of a set depend on: not on the density of its map."""
    return each.pose_set.folder, each.condition.every_point, each.condition.max_range_m


def _queries(sets: BeliefSets) -> Mapping[tuple[Path, int, float], _Kinds]:
    length_m = AlignmentConfig().local_map_m
    found: dict[tuple[Path, int, float], _Kinds] = {}
    for each in sets.on_map:
        seen = each.condition.seen
        if _key(each) not in found:
            singles = [query_of(seen(scan)) for scan in each.pose_set.scans]
            along = [query for drive in each.drives for query in local_maps(drive, map(seen, drive.scans), length_m)]
            found[_key(each)] = singles, along
    return found


def _regions(named: Mapping[Path, str], maps: Mapping[Path, AerialMap]) -> dict[Path, str]:
    """Return a name for each map folder: the same for maps that show the same places, or places beside each other."""
    regions: dict[Path, str] = {}
    for folder, name in named.items():
        near = {regions[other] for other in regions if _touch(maps[folder], maps[other])}
        for other in regions:
            if regions[other] in near:  # what lies between two regions makes them one
                regions[other] = name
        regions[folder] = name
    return regions


def _touch(one: AerialMap, other: AerialMap) -> bool:
    west, south, east, north = one.bounds
    corners = np.tile(np.eye(4), (4, 1, 1))
    corners[:, :2, 3] = [(e, n) for e in (west, east) for n in (south, north)]
    return not are_apart(other, one, corners)


def _folds(each: BeliefSet, queries: _Kinds, region: str) -> Iterator[tuple[str, _Kinds]]:
    on_map = each.pose_set.on_map
    folds = _FOLDS_OF_TOWNS if sum(on_map) > 1 else 1
    for fold in range(folds):
        name = f"{region} {fold}" if folds > 1 else region
        yield name, tuple([q for q in kind if on_map[q.area] and q.area % folds == fold] for kind in queries)


def _strangers(
    sets: BeliefSets,
    queries: Mapping[tuple[Path, int, float], _Kinds],
    maps: Mapping[Path, AerialMap],
    map_folder: Path,
) -> _Kinds:
    """Return the queries, under all conditions, of areas that lie off a map."""
    strangers: _Kinds = ([], [])
    for each in {_key(each): each for each in sets.on_map}.values():
        frame_map = maps[each.pose_set.map_folder]
        kinds = queries[_key(each)]
        for area in range(len(each.pose_set.on_map)):
            chosen = [[query for query in kind if query.area == area] for kind in kinds]
            poses = np.array([query.T_grid_base for kind in chosen for query in kind])
            if len(poses) and are_apart(maps[map_folder], frame_map, poses):
                for kind, some in zip(strangers, chosen, strict=True):
                    kind += some
    return strangers


def _some(kinds: _Kinds, most: int, rng: np.random.Generator) -> list[Query]:
    """Return at most so many queries of each kind."""
    chosen: list[Query] = []
    for kind in kinds:
        rows = range(len(kind)) if len(kind) <= most else sorted(rng.choice(len(kind), most, replace=False).tolist())
        chosen += [kind[i] for i in rows]
    return chosen
