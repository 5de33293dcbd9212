"""What the alignment is learned from: simulated towns under all conditions, and real surveys driven through."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.datasets.belief_sets import BeliefSet, BeliefSets, are_apart
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training.alignment import LearningSet

_FOLDS_OF_TOWNS = 2  # simulated towns of one set: half of them teach what the other half is weighed by
_SCANS = 60  # of a set and fold on its map: neighbours along a street say much the same
_STRANGERS = 120  # on each map, from off it: what is wrong has more ways to be so than what is right


def learning_sets(sets: BeliefSets, seed: int = 0) -> list[LearningSet]:
    """Return the sets that an alignment is learned from: every set on its map, and strangers on every map.

    Strangers are drawn from the scans of all places that are off a map. Sets of one pose set are one fold, or two where
    it has several areas; real surveys that lie beside each other are one fold. TrainingError for a set that is kept for
    evaluation.
    """
    kept = [each.name for each in sets.on_map if not each.is_learned]
    kept += [each.name for each in sets.maps if not each.is_learned]
    if kept:
        raise TrainingError(f"'{kept[0]}' is kept for evaluation: learn from the pose set 'fitting' and other surveys")
    rng = np.random.default_rng(seed)
    regions = _regions(sets)
    learned = []
    for each in sets.on_map:
        map_folder = each.pose_set.map_folder
        strangers = _strangers(sets, map_folder)
        for fold, scans in _folds(each, regions[map_folder]):
            name = f"{each.name}, {each.condition.name}"
            learned.append(
                LearningSet(name, fold, map_folder, _some(scans, _SCANS, rng), _some(strangers, _STRANGERS, rng))
            )
    known = {each.pose_set.map_folder for each in sets.on_map}
    for other in sets.maps:
        if other.folder not in known:
            strangers = _some(_strangers(sets, other.folder), _STRANGERS, rng)
            learned.append(LearningSet(other.name, regions[other.folder], other.folder, (), strangers))
    return learned


def _regions(sets: BeliefSets) -> dict[Path, str]:
    """Return a name for each map folder: the same for maps that show the same places, or places beside each other."""
    named = {each.pose_set.map_folder: each.name for each in sets.on_map}
    named |= {each.folder: each.name for each in sets.maps if each.folder not in named}
    maps = {folder: AerialMap.load(folder) for folder in named}
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


def _folds(each: BeliefSet, region: str) -> Iterator[tuple[str, list[RawScan]]]:
    pose_set = each.pose_set
    on_map = [each.condition.seen(scan) for scan in pose_set.scans if pose_set.on_map[scan.area]]
    folds = _FOLDS_OF_TOWNS if sum(pose_set.on_map) > 1 else 1
    for fold in range(folds):
        name = f"{region} {fold}" if folds > 1 else region
        yield name, [scan for scan in on_map if scan.area % folds == fold]


def _strangers(sets: BeliefSets, map_folder: Path) -> list[RawScan]:
    """Return the scans, under all conditions, of areas that lie off a map."""
    aerial_map = AerialMap.load(map_folder)
    scans = []
    for each in sets.on_map:
        pose_set = each.pose_set
        frame_map = AerialMap.load(pose_set.map_folder)
        for area in range(len(pose_set.on_map)):
            rows = np.flatnonzero(pose_set.scans.area == area)
            if len(rows) and are_apart(aerial_map, frame_map, pose_set.scans.T_grid_base[rows]):
                scans += [each.condition.seen(pose_set.scans[int(row)]) for row in rows]
    return scans


def _some(scans: Sequence[RawScan], most: int, rng: np.random.Generator) -> list[RawScan]:
    if len(scans) <= most:
        return list(scans)
    return [scans[i] for i in sorted(rng.choice(len(scans), most, replace=False).tolist())]
