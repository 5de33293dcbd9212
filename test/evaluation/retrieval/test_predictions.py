"""Searching answers what the descriptors say, whatever the order, and writes it down as it was."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.evaluation.retrieval.encoding import EncodingJob
from crossloc3d_ros.evaluation.retrieval.predictions import (
    About,
    Plan,
    Predictions,
    check_set,
    database_of,
    load_predictions,
    nearest,
    nearest_by,
    predict_all,
    save_predictions,
    way_of,
)
from crossloc3d_ros.evaluation.retrieval.scores import score
from crossloc3d_ros.localization.retrieval.candidates import search_headings

TOWN_M = 400.0
APART_M = 1e3
"""More than towns measure, so that no place is taken for one of another town or direction; and so little that squared
distances keep their metres in float32, whether they are summed from differences or from norms and products."""


class Oracle:
    """Reads a place's position and area from its patch: the best encoder that there can be."""

    fingerprint = "oracle"
    descriptor_size = 3
    preprocessing = PreprocessingConfig()

    def encode(self, points: np.ndarray) -> np.ndarray:
        return self.encode_batch([points])[0]

    def encode_batch(self, clouds: list[np.ndarray]) -> np.ndarray:
        return np.array([cloud[:3, 2] * (1.0, 1.0, APART_M) for cloud in clouds], np.float32)

    def warm_up(self) -> None:
        pass


class Lot(Oracle):
    """Draws random descriptors."""

    fingerprint = "lot"

    def encode_batch(self, clouds: list[np.ndarray]) -> np.ndarray:
        seeds = [np.frombuffer(cloud.tobytes(), np.uint32) for cloud in clouds]
        return np.array([np.random.default_rng(seed).normal(size=3) for seed in seeds], np.float32)


class Compass(Oracle):
    """Knows places that look north, and takes others for places far away: the direction of the fourth point counts."""

    fingerprint = "compass"

    def encode_batch(self, clouds: list[np.ndarray]) -> np.ndarray:
        aside = [APART_M * np.array([*(cloud[3, :2] - (0.0, 1.0)), 0.0]) for cloud in clouds]
        return (super().encode_batch(clouds) + aside).astype(np.float32)


class Measured(Oracle):
    """The oracle with a distance of its own: the sum of the differences."""

    def distances(self, queries: np.ndarray, database: np.ndarray) -> np.ndarray:
        return np.abs(queries[:, None] - database[None]).sum(axis=2)


def place_set(xy_m: np.ndarray, area: np.ndarray, heading_rad: np.ndarray) -> PlaceSet:
    """Return places whose patches tell where they are: x, y and area as heights, then a point to the north."""
    patches = []
    for (x, y), number, heading in zip(xy_m, area, heading_rad, strict=True):
        north = np.array([0.0, 1.0, 0.0])
        points = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [0.0, 0.0, number], north], np.float32)
        patches.append(rotate_about_z(points, -float(heading)))  # seen along the robot's heading
    return PlaceSet(patches, area, xy_m, heading_rad)


def town_set(towns: int = 4, queries: int = 200, ground: int = 0, seed: int = 0) -> EvaluationSet:
    """Return towns with a submap every 19 m and queries anywhere, their headings multiples of 45 degrees."""
    rng = np.random.default_rng(seed)
    axis = np.arange(0.0, TOWN_M, 19.0)
    grid = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    area = np.repeat(np.arange(towns), len(grid))
    submaps = place_set(np.tile(grid, (towns, 1)), area, np.zeros(len(area)))

    def scans(count: int) -> PlaceSet:
        return place_set(
            rng.uniform(10, TOWN_M - 30, (count, 2)), rng.integers(towns, size=count),
            rng.integers(1, 8, count) * np.pi / 4,
        )  # fmt: skip

    families = tuple("campus" if town % 2 else "wood" for town in range(towns))
    asked = scans(queries)
    groups = tuple("odd" if town % 2 else "even" for town in asked.area)
    return EvaluationSet(
        "towns", asked, submaps, scans(ground) if ground else None, tuple(f"town {i}" for i in range(towns)), families,
        groups,
    )  # fmt: skip


def predict(
    evaluation_set: EvaluationSet, encoder: Oracle, folder: Path, plan: Plan | None = None
) -> dict[str, Predictions]:
    job = EncodingJob(encoder, lambda: encoder, folder)
    made = predict_all(evaluation_set, job, plan or Plan(settings=("aerial",)), encoder.fingerprint)
    return {each.about.name: each for each in made}


def test_an_encoder_that_knows_the_place_is_always_right(tmp_path: Path) -> None:
    towns = town_set(ground=30)
    for name, made in predict(towns, Oracle(), tmp_path, Plan()).items():
        scores = score(made, towns)
        assert all(figure.share.value == 1.0 for figure in scores.overall.recalls), name
        assert (np.diff(made.distances, axis=1) >= 0).all()


def test_an_encoder_that_draws_at_random_reaches_the_chance_level(tmp_path: Path) -> None:
    towns = town_set(towns=12, queries=1500)
    (made,) = predict(towns, Lot(), tmp_path, Plan(settings=("aerial",), headings=("aligned",))).values()
    scores = score(made, towns)
    for figure in scores.overall.recalls:
        sigma = np.sqrt(figure.chance * (1 - figure.chance) / scores.overall.counted[figure.radius_m])
        assert abs(figure.share.value - figure.chance) < 4 * sigma + 1e-9, figure
    curve = scores.curves[0]
    assert np.abs(curve.recall - curve.chance).max() < 0.05


def test_a_query_of_unknown_heading_is_found_where_one_of_its_headings_fits(tmp_path: Path) -> None:
    towns = town_set()
    plan = Plan(settings=("aerial",), query_headings=(1, 2, 8), invariant=False)
    made = predict(towns, Compass(), tmp_path, plan)
    assert sorted(made) == ["aerial_aligned", "aerial_random", "aerial_random_2-nearest", "aerial_random_8-nearest"]
    recall = {name: score(each, towns).overall.recall("R@1", 25.0).share.value for name, each in made.items()}
    assert recall["aerial_aligned"] == recall["aerial_random_8-nearest"] == 1.0
    # One query in seven looks south, where the second of two headings fits; none looks north.
    assert recall["aerial_random"] < 0.05
    assert 0.08 < recall["aerial_random_2-nearest"] < 0.25
    errors = score(made["aerial_random_8-nearest"], towns).heading
    assert errors is not None
    assert (errors.queries, errors.step_deg) == (len(towns.queries), 45.0)
    assert errors.median_deg == pytest.approx(0.0, abs=1e-3)
    assert score(made["aerial_random"], towns).heading is None
    # The number of the heading is the robot's own: 1 = 45 degrees, and so on.
    numbers = made["aerial_random_8-nearest"].headings[:, 0]
    np.testing.assert_array_equal(numbers, np.rint(towns.queries.heading_rad / (np.pi / 4)).astype(int) % 8)


def test_aligned_datasets_are_turned_by_lot_for_the_random_heading(tmp_path: Path) -> None:
    towns = town_set()
    unknown = place_set(towns.queries.xy_m, towns.queries.area, np.zeros(len(towns.queries)))
    for heading in (0.0, np.nan):
        queries = dataclasses.replace(unknown, heading_rad=np.full(len(unknown), heading))
        made = predict(dataclasses.replace(towns, queries=queries), Compass(), tmp_path)
        aligned, random = (
            score(made[name], dataclasses.replace(towns, queries=queries)).overall.recall("R@1", 25.0).share.value
            for name in ("aerial_aligned", "aerial_random")
        )
        assert aligned == 1.0
        assert random < 0.5


def test_the_mean_of_all_headings_is_offered_for_invariant_encoders_only(tmp_path: Path) -> None:
    for invariant in (True, False):
        plan = Plan(("aerial",), ("random",), (4,), invariant)
        made = predict(town_set(), Oracle(), tmp_path, plan)
        assert ("aerial_random_4-mean" in made) == invariant


def test_the_order_of_places_does_not_matter(tmp_path: Path) -> None:
    towns = town_set(queries=100)
    rng = np.random.default_rng(5)

    def shuffled(places: PlaceSet, order: np.ndarray) -> PlaceSet:
        return PlaceSet(
            [places.patches[i] for i in order], places.area[order], places.xy_m[order], places.heading_rad[order]
        )

    asked, there = rng.permutation(len(towns.queries)), rng.permutation(len(towns.aerial))
    other = dataclasses.replace(
        towns, queries=shuffled(towns.queries, asked), aerial=shuffled(towns.aerial, there),
        query_groups=tuple(towns.query_groups[i] for i in asked),
    )  # fmt: skip
    (first,) = predict(towns, Lot(), tmp_path, Plan(("aerial",), ("aligned",))).values()
    (second,) = predict(other, Lot(), tmp_path, Plan(("aerial",), ("aligned",))).values()
    np.testing.assert_array_equal(there[second.ids], first.ids[asked])
    one, two = score(first, towns), score(second, other)
    assert one.overall == two.overall
    assert {group.name: group for group in one.groups} == {group.name: group for group in two.groups}


def test_searching_in_blocks_is_searching_one_by_one() -> None:
    """Whole numbers: float32 holds their squared distances exactly, however they are summed, and none are equal."""
    rng = np.random.default_rng(0)
    database, queries = rng.integers(-700, 701, (300, 8)), rng.integers(-700, 701, (70, 3, 8))
    squares = ((queries[:, :, None] - database[None, None]) ** 2).sum(axis=3)
    assert squares.max() < 1 << 24 and np.diff(np.sort(squares, axis=1)[:, :2], axis=1).min() > 0
    brute = squares.min(axis=1)
    assert np.diff(np.sort(brute, axis=1)[:, :21], axis=1).min() > 0
    index, queries = DescriptorMap(database.astype(np.float32)), queries.astype(np.float32)
    ids, distances, numbers = nearest(index, queries, 20)
    for row in range(len(queries)):
        one = search_headings(index, queries[row], 20)
        np.testing.assert_array_equal(ids[row], one[0])
        np.testing.assert_allclose(distances[row], one[1], rtol=1e-4)
        np.testing.assert_array_equal(numbers[row], one[2])
    np.testing.assert_array_equal(ids, np.argsort(brute, axis=1)[:, :20])


def test_a_distance_of_ones_own_is_used() -> None:
    rng = np.random.default_rng(1)
    database, queries = rng.normal(size=(90, 3)).astype(np.float32), rng.normal(size=(70, 2, 3)).astype(np.float32)
    ids, distances, numbers = nearest_by(Measured(), database, queries, 5)
    apart = np.abs(queries[:, :, None] - database[None, None]).sum(axis=3)
    np.testing.assert_array_equal(ids, np.argsort(apart.min(axis=1), axis=1)[:, :5])
    np.testing.assert_array_equal(numbers, np.take_along_axis(apart.argmin(axis=1), ids, axis=1))
    np.testing.assert_allclose(distances, np.sort(apart.min(axis=1), axis=1)[:, :5])


def test_a_distance_of_ones_own_goes_through_the_whole_protocol(tmp_path: Path) -> None:
    towns = town_set(queries=50, ground=20)
    for each in predict(towns, Measured(), tmp_path, Plan(query_headings=(2,))).values():
        assert score(each, towns).overall.recall("R@1", 25.0).share.value == 1.0


def test_enough_answers_are_kept_for_one_per_cent(tmp_path: Path) -> None:
    small, large = town_set(towns=1, queries=5), town_set(towns=30, queries=5)
    for towns, kept in ((small, 100), (large, round(len(large.aerial) / 100))):
        (made,) = predict(towns, Oracle(), tmp_path, Plan(("aerial",), ("aligned",))).values()
        assert made.ids.shape == (5, kept)


def test_predictions_come_back_from_disk(tmp_path: Path) -> None:
    towns = town_set(queries=20)
    (made,) = predict(towns, Oracle(), tmp_path, Plan(("aerial",), ("random",))).values()
    save_predictions(tmp_path / "p" / "made.npz", made)
    read = load_predictions(tmp_path / "p" / "made.npz")
    assert read.about == made.about
    for name in ("ids", "distances", "headings"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    assert score(read, towns).overall == score(made, towns).overall


@pytest.mark.parametrize("damage", [lambda b: b[:-30], lambda b: b"nonsense", lambda b: b""])
def test_damaged_predictions_are_told(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    (made,) = predict(town_set(queries=5), Oracle(), tmp_path, Plan(("aerial",), ("random",))).values()
    path = tmp_path / "made.npz"
    save_predictions(path, made)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(EvaluationError, match="damaged"):
        load_predictions(path)
    with pytest.raises(EvaluationError, match="no such"):
        load_predictions(tmp_path / "missing.npz")


def test_predictions_of_another_set_are_refused(tmp_path: Path) -> None:
    towns = town_set(queries=5)
    (made,) = predict(towns, Oracle(), tmp_path, Plan(("aerial",), ("random",))).values()
    with pytest.raises(EvaluationError, match="another set"):
        score(made, town_set(queries=5, seed=1))
    beyond = dataclasses.replace(made, ids=made.ids + len(towns.aerial))
    with pytest.raises(EvaluationError, match="does not have"):
        score(beyond, towns)


def test_sets_that_tell_nothing_are_refused(tmp_path: Path) -> None:
    towns = town_set(queries=20)
    in_one = towns.aerial.area == 1
    submaps = PlaceSet(
        [p for p, kept in zip(towns.aerial.patches, in_one, strict=True) if kept], towns.aerial.area[in_one],
        towns.aerial.xy_m[in_one], towns.aerial.heading_rad[in_one],
    )  # fmt: skip
    with pytest.raises(EvaluationError, match=r"without any aerial submap: town 0, town 2"):
        predict(dataclasses.replace(towns, aerial=submaps), Oracle(), tmp_path)
    nothing = PlaceSet([], np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0))
    with pytest.raises(EvaluationError, match="no query"):
        check_set(dataclasses.replace(towns, queries=nothing, query_groups=()))
    with pytest.raises(EvaluationError, match="no aerial"):
        check_set(dataclasses.replace(towns, aerial=nothing))
    with pytest.raises(EvaluationError, match="no ground database"):
        database_of(towns, "aerial+ground")
    with pytest.raises(EvaluationError, match="no ground database"):
        predict(towns, Oracle(), tmp_path, Plan())


def test_a_plan_without_anything_to_do_is_refused() -> None:
    with pytest.raises(ConfigError):
        Plan(settings=())
    with pytest.raises(ConfigError, match="query_headings"):
        Plan(query_headings=(0,))


def test_a_query_is_tried_as_the_localizer_tries_it() -> None:
    class Knows(Oracle):
        headings, rotations = 8, 1

    class Averages(Oracle):
        headings, rotations = 1, 4

    assert way_of(Oracle()) == (1, "nearest")
    assert way_of(Knows()) == (8, "nearest")
    assert way_of(Averages()) == (4, "mean")


def test_names_tell_predictions_apart() -> None:
    base = About("b", "d", "w", "e", "aerial", "random")
    names = {
        dataclasses.replace(base, **change).name  # type: ignore[arg-type]
        for change in (
            {}, {"setting": "aerial+ground"}, {"heading": "aligned"}, {"query_headings": 8},
            {"query_headings": 8, "way": "mean"}, {"query_headings": 4},
        )
    }  # fmt: skip
    assert len(names) == 6
