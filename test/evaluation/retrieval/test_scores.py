"""Scores say what was answered: chance, intervals, divisions."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.evaluation.retrieval.predictions import About, Predictions
from crossloc3d_ros.evaluation.retrieval.results import as_csv, as_json, headline
from crossloc3d_ros.evaluation.retrieval.scores import (
    Scores,
    difference,
    places_within,
    score,
)


def places(xy_m: list[tuple[float, float]], area: list[int]) -> PlaceSet:
    count = len(xy_m)
    patches = np.zeros((count, 1, 3), np.float32)
    return PlaceSet(patches, np.array(area, np.int64), np.array(xy_m, np.float64).reshape(-1, 2), np.zeros(count))


def made(evaluation_set: EvaluationSet, ids: list[list[int]], **about: object) -> Predictions:
    settings = {"setting": "aerial", "heading": "random", **about}
    said = About("b", evaluation_set.fingerprint(), "w", "e", database=len(evaluation_set.aerial), **settings)  # type: ignore[arg-type]
    shape = np.shape(ids)
    return Predictions(said, np.array(ids), np.zeros(shape, np.float32), np.zeros(shape, np.int64))


@pytest.fixture
def line() -> EvaluationSet:
    """Two towns, submaps every 40 m along a line in each, a query at each end."""
    submaps = places([(40.0 * i, 0.0) for i in range(10)] * 2, [0] * 10 + [1] * 10)
    queries = places([(0.0, 0.0), (360.0, 0.0), (0.0, 0.0), (900.0, 0.0)], [0, 0, 1, 1])
    return EvaluationSet("line", queries, submaps, None, ("one", "two"), ("campus", "wood"), ("a", "b", "b", "b"))


def test_hits_are_counted_by_distance_rank_and_town(line: EvaluationSet) -> None:
    # The first answer of query 0 is 80 m off, the second right; query 1: in the other town, then 40 m off; query 2:
    # right at once. Query 3 has no submap within 100 m and does not count.
    scores = score(made(line, [[2, 0], [19, 8], [10, 11], [19, 18]]), line)
    values = {
        (f.label, f.radius_m): (f.share.value, scores.overall.counted[f.radius_m]) for f in scores.overall.recalls
    }
    assert values["R@1", 100.0] == (pytest.approx(2 / 3), 3)
    assert values["R@5", 100.0] == (1.0, 3)
    assert values["R@1", 25.0] == (pytest.approx(1 / 3), 3)
    assert values["R@5", 50.0] == (1.0, 3)
    assert values["R@5", 25.0] == (pytest.approx(2 / 3), 3)
    np.testing.assert_allclose(scores.first_m, [80.0, np.inf, 0.0, 540.0])
    assert [curve.recall[0] for curve in scores.curves] == pytest.approx([2 / 3, 1 / 3, 1 / 3])
    assert scores.curves[2].recall[1] == pytest.approx(2 / 3)
    by_name = {group.name: group for group in (*scores.groups, *scores.families, *scores.areas)}
    assert by_name["a"].recall("R@1", 100.0).share.value == 1.0
    assert by_name["b"].recall("R@1", 100.0).share.value == 0.5
    assert by_name["one"].queries == by_name["campus"].queries == 2
    assert by_name["wood"].recall("R@1", 25.0).share.value == 1.0
    with pytest.raises(KeyError):
        scores.overall.recall("R@3", 100.0)


def test_one_per_cent_is_a_rank_of_the_database(line: EvaluationSet) -> None:
    many = dataclasses.replace(line, aerial=places([(10.0 * i, 0.0) for i in range(400)], [0] * 200 + [1] * 200))
    ids = [[399, 398, 397, 0], [399] * 4, [0] * 4, [0] * 4]
    figures = {f.label: f for f in score(made(many, ids), many).overall.recalls if f.radius_m == 25.0}
    assert figures["R@1%"].rank == 4
    assert figures["R@1%"].share.value > figures["R@1"].share.value


def test_places_within_are_those_of_the_same_town(line: EvaluationSet) -> None:
    assert places_within(line.queries, line.aerial, 100.0).tolist() == [3, 3, 3, 0]
    assert places_within(line.queries, line.aerial, 40.0).tolist() == [2, 2, 2, 0]


def test_the_difference_of_two_methods_is_that_of_the_same_queries() -> None:
    rng = np.random.default_rng(3)
    towns, each = 12, 40
    area = np.repeat(np.arange(towns), each).tolist()
    queries = places([(0.0, 0.0)] * len(area), area)
    submaps = places([(0.0, 0.0), (500.0, 0.0)] * towns, np.repeat(np.arange(towns), 2).tolist())
    names = tuple(map(str, range(towns)))
    evaluation_set = EvaluationSet("t", queries, submaps, None, names, names)
    hard = rng.uniform(0.1, 0.9, towns)[area]  # towns differ far more than the methods do
    luck = rng.random(len(area))
    right = 2 * np.array(area)

    def answers(bonus: float) -> Predictions:
        return made(evaluation_set, np.where(luck < hard + bonus, right, right + 1)[:, None].tolist())

    worse, better = answers(0.0), answers(0.1)
    ahead = difference(better, worse, evaluation_set)
    assert ahead.value == pytest.approx(0.1, abs=0.04)
    assert 0.0 < ahead.low < ahead.high < 0.2
    assert difference(worse, worse, evaluation_set).value == 0.0
    single = score(better, evaluation_set).overall.recall("R@1", 100.0).share
    assert single.high - single.low > 2 * (ahead.high - ahead.low)
    with pytest.raises(ValueError, match="settings"):
        difference(better, dataclasses.replace(worse, about=dataclasses.replace(worse.about, setting="aerial+ground")),
                   evaluation_set)  # fmt: skip


def test_the_headline_is_what_the_localizer_does(line: EvaluationSet) -> None:
    def of(**about: object) -> Scores:
        return score(made(line, [[0, 1]] * 4, **about), line)

    aligned, once, eight, mean = (
        of(heading="aligned"), of(), of(query_headings=8), of(query_headings=8, way="mean"),
    )  # fmt: skip
    scores = [aligned, once, eight, mean]
    assert headline(scores, 1, "nearest") is once
    assert headline(scores, 8, "nearest") is eight
    assert headline(scores, 8, "mean") is mean
    assert headline(scores[:1], 8, "nearest") is aligned


def test_tables_hold_every_figure(line: EvaluationSet, tmp_path: Path) -> None:
    import csv
    import json

    scores = score(made(line, [[2, 0], [19, 8], [10, 11], [19, 18]]), line)
    rows = list(csv.DictReader(as_csv([scores]).splitlines()))
    assert len(rows) == (1 + 2 + 2 + 2) * 15
    (row,) = (r for r in rows if r["name"] == "b" and r["measure"] == "R@1" and r["radius_m"] == "100.0")
    assert (float(row["recall"]), row["counted"], row["queries"]) == (0.5, "2", "3")
    content = json.loads(as_json([scores]))
    assert content[0]["about"]["setting"] == "aerial"
    assert len(content[0]["curves"][0]["recall"]) == 100
