"""What the alignment is learned from: strangers from elsewhere, scans by condition, folds that share no place."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.datasets.belief_conditions import DELIVERED, Condition
from crossloc3d_ros.datasets.belief_sets import BeliefMap, BeliefSet, BeliefSets
from crossloc3d_ros.datasets.pose_drives import DrivePlan, RawDrive
from crossloc3d_ros.datasets.pose_sets import PoseSet
from crossloc3d_ros.datasets.raw_scans import RawScan, RawScans
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training import learning_sets as module
from crossloc3d_ros.training.alignment import LearningSet
from crossloc3d_ros.training.learning_sets import learning_sets
from crossloc3d_ros.training.queries import Query, local_maps, query_of

FEW = Condition("few", every_point=4)
POINTS = 40


def scans_in(aerial_map: AerialMap, areas: int, count: int, seed: int) -> list[RawScan]:
    """Return scans at random places of a map, its areas beside each other from the west."""
    rng = np.random.default_rng(seed)
    west, south, east, north = aerial_map.bounds
    scans = []
    for i in range(count):
        pose, area = np.eye(4), i % areas
        share = (area + rng.uniform(0.0, 1.0)) / areas
        pose[:2, 3] = west + share * (east - west), rng.uniform(south, north)
        scans.append(RawScan(rng.normal(0, 9, (POINTS, 3)).astype(np.float32), pose, np.eye(4), area=area))
    return scans


def set_of(name: str, aerial_map: AerialMap, scans: Sequence[RawScan], areas: int) -> PoseSet:
    names = tuple(f"{name} {area}" for area in range(areas))
    return PoseSet(name, aerial_map.path, RawScans.of(scans), names, names, (True,) * areas, ("all",), Path())


@pytest.fixture(scope="module")
def sets(simulated_town: tuple[PoseSet, Any], town_map: AerialMap) -> BeliefSets:
    """Give a town with scans on its map and off it, and another of two areas, as delivered and with few points."""
    town = simulated_town[0]
    other = set_of("other", town_map, scans_in(town_map, 2, 30, 1), 2)
    return BeliefSets(
        (
            BeliefSet("town", DELIVERED, town, (), True),
            BeliefSet("other", DELIVERED, other, (), True),
            BeliefSet("other", FEW, other, (), True),
        ),
        (BeliefMap("town", town.map_folder, True), BeliefMap("other", town_map.path, True)),
    )


def places(scans: Sequence[Query]) -> np.ndarray:
    return np.array([scan.T_grid_base[:2, 3] for scan in scans]).reshape(-1, 2)


def lies_on(aerial_map: AerialMap, scans: Sequence[Query]) -> np.ndarray:
    west, south, east, north = aerial_map.bounds
    x, y = places(scans).T
    return (x > west) & (x < east) & (y > south) & (y < north)


def same(one: Sequence[LearningSet], other: Sequence[LearningSet]) -> bool:
    """Return whether two lists of sets hold the same scans in the same order."""

    def rows(sets: Sequence[LearningSet]) -> list[object]:
        return [(e.name, e.fold, places(e.on_map).tolist(), places(e.off_map).tolist()) for e in sets]

    return rows(one) == rows(other)


@pytest.fixture(autouse=True)
def everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take all queries that there are."""
    monkeypatch.setattr(module, "_QUERIES", 1000)
    monkeypatch.setattr(module, "_STRANGERS", 1000)


def test_strangers_never_come_from_the_places_of_a_map(sets: BeliefSets) -> None:
    for each in learning_sets(sets):
        aerial_map = AerialMap.load(each.map_folder)
        assert lies_on(aerial_map, each.on_map).all()
        assert len(each.off_map) > 0
        assert not lies_on(aerial_map, each.off_map).any()
    strangers = learning_sets(sets)[0].off_map  # on the town: those of its own other town, and those of both conditions
    assert len(strangers) == 3 + 2 * 30


def straight_drive() -> RawDrive:
    """Return a drive of 40 m eastwards, a scan every two metres, each of too few points to contradict another."""
    rng, scans = np.random.default_rng(3), []
    stamps_ns = 1_000_000_000 * np.arange(1, 22)
    for i, stamp_ns in enumerate(stamps_ns.tolist()):
        pose = np.eye(4)
        pose[0, 3] = 2.0 * i
        scans.append(RawScan(rng.normal(0, 9, (POINTS, 3)).astype(np.float32), pose, np.eye(4), stamp_ns=stamp_ns))
    plan = DrivePlan("straight", 0, 40.0, 2.0, 1, 0, False, 1.2, 0.0)
    times_s = np.arange(1.0, 21.05, 0.1)
    odometry = np.column_stack([2.0 * times_s, np.zeros((len(times_s), 2))])
    return RawDrive(plan, RawScans.of(scans), np.round(times_s * 1e9).astype(np.int64), odometry)


def cells_of(queries: Sequence[Query]) -> list[bytes]:
    return sorted(query.xy_m.tobytes() + query.channel.tobytes() for query in queries)


def test_queries_are_of_the_scans_as_their_conditions_say(sets: BeliefSets) -> None:
    learned = learning_sets(sets)
    other = sets.on_map[1].pose_set
    for condition in (DELIVERED, FEW):
        of_both_folds = [q for each in learned if each.name == f"other, {condition.name}" for q in each.on_map]
        expected = [query_of(condition.seen(scan)) for scan in other.scans]
        assert cells_of(of_both_folds) == cells_of(expected)
        assert set(cells_of(expected)) <= set(cells_of(learned[0].off_map)), "strangers on the town"


def test_along_drives_local_maps_are_learned_from_too(sets: BeliefSets) -> None:
    town, drive = sets.on_map[0].pose_set, straight_drive()
    driven = BeliefSet("town", DELIVERED, town, (drive,), True)
    on_map = [query for each in learning_sets(BeliefSets((driven,), ())) for query in each.on_map]
    singles = [query_of(scan) for scan in town.scans if town.on_map[scan.area]]
    along = local_maps(drive, drive.scans, AlignmentConfig().local_map_m)
    assert cells_of(on_map) == cells_of([*singles, *along])
    assert [float(query.T_grid_base[0, 3]) for query in along] == pytest.approx([10.0, 20.0, 30.0, 40.0])
    # Each scan adds cells of its own, until the oldest are left behind.
    single = max(len(query_of(scan).channel) for scan in drive.scans)
    assert single < len(along[0].channel) < len(along[1].channel) < len(along[2].channel)


def test_folds_share_no_area(sets: BeliefSets) -> None:
    learned = learning_sets(sets)
    assert [each.fold for each in learned[:1]] == ["town"]
    folds = {fold: [e for e in learned if e.fold == fold] for fold in ("other 0", "other 1")}
    areas = [{scan.area for each in some for scan in each.on_map} for some in folds.values()]
    assert areas == [{0}, {1}]
    for some in folds.values():  # of both conditions, the same places
        assert [each.name for each in some] == ["other, as delivered", "other, few"]
        np.testing.assert_array_equal(places(some[0].on_map), places(some[1].on_map))
    assert sum(len(each.on_map) for each in learned if each.name == "other, few") == 30


def test_maps_of_the_same_places_are_one_fold(sets: BeliefSets, town_map: AerialMap, tmp_path: Path) -> None:
    """The half of a survey that is driven through teaches nothing that the whole of it is weighed by."""
    town = sets.on_map[0].pose_set
    halves = dataclasses.replace(sets.on_map[0], name="survey")
    other = dataclasses.replace(sets.on_map[1], pose_set=set_of("other", town_map, scans_in(town_map, 1, 5, 2), 1))
    copy = tmp_path / "map"
    copy.symlink_to(town.map_folder)
    maps = (BeliefMap("survey", copy, True), BeliefMap("neighbour", town_map.path, True))
    learned = learning_sets(BeliefSets((halves, other), maps))
    assert [(each.map_folder, len(each.on_map) > 0) for each in learned] == [
        (town.map_folder, True), (town_map.path, True), (copy, False),
    ]  # fmt: skip
    assert learned[0].fold == learned[2].fold != learned[1].fold
    assert not lies_on(AerialMap.load(copy), learned[2].off_map).any()


def test_a_seed_makes_the_same_sets_again(sets: BeliefSets, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_QUERIES", 4)
    monkeypatch.setattr(module, "_STRANGERS", 6)
    learned = learning_sets(sets, 1)
    assert {len(each.on_map) for each in learned} == {4}
    assert {len(each.off_map) for each in learned} == {6}
    assert same(learned, learning_sets(sets, 1))
    assert not same(learned, learning_sets(sets, 2))


def test_nothing_is_learned_from_what_is_kept_for_evaluation(sets: BeliefSets) -> None:
    test_set = dataclasses.replace(sets.on_map[1], is_learned=False)
    test_map = dataclasses.replace(sets.maps[1], is_learned=False)
    for kept in (BeliefSets((test_set,), ()), BeliefSets(sets.on_map, (test_map,))):
        with pytest.raises(TrainingError, match="'other' is kept for evaluation"):
            learning_sets(kept)
