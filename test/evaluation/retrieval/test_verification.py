"""Height maps order the first answers anew: by the formula, whatever the unit, the turn or the number of threads."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.clouds.height_map import HeightMatcher, height_raster
from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import CalibrationConfig, HeightMapConfig, PreprocessingConfig, VerificationConfig, from_dict
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.evaluation.retrieval.page import describe, describe_briefly
from crossloc3d_ros.evaluation.retrieval.predictions import About, Predictions, load_predictions, save_predictions
from crossloc3d_ros.evaluation.retrieval.results import as_csv, headline
from crossloc3d_ros.evaluation.retrieval.scores import score
from crossloc3d_ros.evaluation.retrieval.verification import verify

HALF_M, TEMPERATURE = 50.0, 0.5
PLACES, QUERIES, KEPT = 30, 12, 24
CONFIG = VerificationConfig(candidates=16, weight=300.0)


class Calibrated:
    """What made the predictions; it is asked for its calibration and the unit of the patches alone."""

    fingerprint = "e"
    descriptor_size = 3
    preprocessing = PreprocessingConfig(half_extent_m=HALF_M)
    calibration: CalibrationConfig | None = CalibrationConfig(temperature=TEMPERATURE)

    def encode(self, points: np.ndarray) -> np.ndarray:
        raise AssertionError("nothing is to be encoded")

    def encode_batch(self, clouds: list[np.ndarray]) -> np.ndarray:
        raise AssertionError("nothing is to be encoded")

    def warm_up(self) -> None:
        pass


def blocks(seed: int, points: int = 3000) -> np.ndarray:
    """Return blocks of some height around a free centre, in patch units."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-0.8, 0.8, (14, 2))
    middle = middle[np.hypot(*middle.T) > 0.3]
    height = rng.uniform(0.05, 0.2, len(middle))
    owner = rng.integers(0, len(middle), points)
    xy = middle[owner] + rng.uniform(-0.08, 0.08, (points, 2))
    return np.column_stack((xy, rng.uniform(0.5, 1.0, points) * height[owner])).astype(np.float32)


@pytest.fixture(scope="module")
def towns() -> EvaluationSet:
    """Return places 200 m apart and a query in each of the first, a little beside it, in a heading of its own."""
    rng = np.random.default_rng(3)
    xy_m = np.column_stack((np.arange(PLACES) * 200.0, np.zeros(PLACES)))
    places = [blocks(seed) for seed in range(PLACES)]
    aside_m = rng.uniform(-5.0, 5.0, (QUERIES, 2))
    headings = rng.uniform(0.1, 6.2, QUERIES)
    seen = []
    for place, aside, heading in zip(places, aside_m, headings, strict=False):
        moved = place - np.append(aside / HALF_M, 0.0).astype(np.float32)
        seen.append(rotate_about_z(moved + rng.normal(0.0, 0.002, moved.shape).astype(np.float32), -float(heading)))
    return EvaluationSet(
        "towns",
        PlaceSet(seen, np.zeros(QUERIES, np.int64), xy_m[:QUERIES] + aside_m, headings),
        PlaceSet(places, np.zeros(PLACES, np.int64), xy_m, np.zeros(PLACES)),
        None, ("town",), ("town",),
    )  # fmt: skip


def retrieved(towns: EvaluationSet, seed: int = 5) -> Predictions:
    """Return answers in which the right one stands anywhere among the first ten."""
    rng = np.random.default_rng(seed)
    ids = np.array([rng.permutation(np.delete(np.arange(PLACES), row))[:KEPT] for row in range(len(towns.queries))])
    ids[np.arange(len(ids)), rng.integers(0, 10, len(ids))] = np.arange(len(ids))
    about = About("towns", towns.fingerprint(), "w", "e", "aerial", "random", database=PLACES, encode_ms=3.0)
    distances = np.sort(rng.uniform(3.0, 4.0, ids.shape), axis=1).astype(np.float32)
    return Predictions(about, ids, distances, np.zeros(ids.shape, np.int64))


def test_the_right_place_comes_first_with_its_heading(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    after = verify(before, towns, Calibrated(), CONFIG)
    assert score(before, towns).overall.recall("R@1", 25.0).share.value < 0.5
    scores = score(after, towns)
    assert scores.overall.recall("R@1", 25.0).share.value == 1.0
    assert scores.heading is not None
    assert scores.heading.queries == QUERIES
    assert scores.heading.median_deg < 6.0


def test_answers_are_ordered_by_both_distances_one_by_one(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    after = verify(before, towns, Calibrated(), CONFIG)
    matcher, first = HeightMatcher(HeightMapConfig(), HALF_M), CONFIG.candidates
    for row in range(QUERIES):
        query = np.asarray(towns.queries.patches[row])
        raster = height_raster(query[(np.abs(query[:, :2]) <= 1.0).all(axis=1)], 64)[None]
        near = before.distances[row, :first].astype(np.float64)
        fits = [
            matcher.match(raster, height_raster(np.asarray(towns.aerial.patches[place]), 64)[None]).distances[0, 0]
            for place in before.ids[row, :first]
        ]
        order = np.argsort(near / TEMPERATURE + CONFIG.weight * np.array(fits), kind="stable")
        np.testing.assert_array_equal(after.ids[row, :first], before.ids[row, :first][order])
        assert after.fits is not None
        np.testing.assert_allclose(after.fits[row, :first], np.array(fits)[order], rtol=1e-4)
        np.testing.assert_array_equal(after.distances[row, :first], before.distances[row, :first][order])


def test_answers_behind_keep_their_order(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    after = verify(before, towns, Calibrated(), CONFIG)
    first = CONFIG.candidates
    for name in ("ids", "distances", "headings"):
        np.testing.assert_array_equal(getattr(after, name)[:, first:], getattr(before, name)[:, first:])
    np.testing.assert_array_equal(np.sort(after.ids[:, :first]), np.sort(before.ids[:, :first]))
    assert after.fits is not None
    assert after.fit_headings_rad is not None
    assert np.isnan(after.fits[:, first:]).all()
    assert np.isnan(after.fit_headings_rad[:, first:]).all()
    assert np.isfinite(after.fits[:, :first]).all()


def test_threads_and_other_queries_change_nothing(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    alone = verify(before, towns, Calibrated(), CONFIG)
    together = verify(before, towns, Calibrated(), CONFIG, threads=4)
    for name in ("ids", "distances", "headings", "fits", "fit_headings_rad"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(together, name))
    some = [7, 2]
    asked = dataclasses.replace(
        towns, queries=PlaceSet([towns.queries.patches[i] for i in some], *(
            column[some] for column in (towns.queries.area, towns.queries.xy_m, towns.queries.heading_rad)
        ))
    )  # fmt: skip
    about = dataclasses.replace(before.about, data=asked.fingerprint())
    few = Predictions(about, before.ids[some], before.distances[some], before.headings[some])
    np.testing.assert_array_equal(verify(few, asked, Calibrated(), CONFIG).ids, alone.ids[some])


def test_the_unit_of_the_descriptors_does_not_matter(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    scaled = dataclasses.replace(before, distances=before.distances * np.float32(8.0))
    other = Calibrated()
    other.calibration = CalibrationConfig(temperature=8.0 * TEMPERATURE)
    once, again = verify(before, towns, Calibrated(), CONFIG), verify(scaled, towns, other, CONFIG)
    np.testing.assert_array_equal(once.ids, again.ids)


def test_a_turned_query_is_the_same_place_in_another_heading(towns: EvaluationSet) -> None:
    before, turned_by = retrieved(towns), 5 * 2 * math.pi / HeightMapConfig().sectors
    queries = towns.queries
    other = dataclasses.replace(
        towns,
        queries=PlaceSet(
            [rotate_about_z(np.asarray(patch), turned_by) for patch in queries.patches], queries.area, queries.xy_m,
            queries.heading_rad - turned_by,
        ),
    )  # fmt: skip
    about = dataclasses.replace(before.about, data=other.fingerprint())
    once, again = (
        verify(made, places, Calibrated(), CONFIG)
        for made, places in ((before, towns), (dataclasses.replace(before, about=about), other))
    )
    np.testing.assert_array_equal(once.ids[:, 0], again.ids[:, 0])
    assert once.fit_headings_rad is not None
    assert again.fit_headings_rad is not None
    less = (once.fit_headings_rad[:, 0] - again.fit_headings_rad[:, 0]).astype(np.float64)
    apart = np.abs(np.angle(np.exp(1j * (less - turned_by))))
    assert apart.max() <= 2 * math.pi / HeightMapConfig().sectors + 1e-5


def test_an_aligned_query_fits_without_a_turn(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    aligned = dataclasses.replace(before, about=dataclasses.replace(before.about, heading="aligned"))
    after = verify(aligned, towns, Calibrated(), CONFIG)
    assert score(after, towns).overall.recall("R@1", 25.0).share.value == 1.0
    assert after.fit_headings_rad is not None
    assert np.abs(np.angle(np.exp(1j * after.fit_headings_rad[:, 0]))).max() <= math.radians(6.0) + 1e-5


def test_weights_at_the_ends_leave_one_distance_alone(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    unchanged = verify(before, towns, Calibrated(), dataclasses.replace(CONFIG, weight=0.0))
    np.testing.assert_array_equal(unchanged.ids, before.ids)
    only = verify(before, towns, Calibrated(), dataclasses.replace(CONFIG, weight=1e6))
    assert only.fits is not None
    assert (np.diff(only.fits[:, : CONFIG.candidates], axis=1) >= 0).all()


def test_a_query_that_shows_nothing_keeps_its_order(towns: EvaluationSet) -> None:
    flat = np.array([[0.1, 0.1, 0.0]], np.float32)
    beyond = np.array([[1.3, 0.0, 0.2]], np.float32)
    patches = [flat, beyond, *(towns.queries.patches[i] for i in range(2, QUERIES))]
    other = dataclasses.replace(towns, queries=dataclasses.replace(towns.queries, patches=patches))
    before = retrieved(other)
    after = verify(before, other, Calibrated(), CONFIG)
    np.testing.assert_array_equal(after.ids[:2], before.ids[:2])
    assert (after.ids[2:, 0] == np.arange(2, QUERIES)).all()


def test_more_candidates_than_places_are_all_places(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    rest = [np.setdiff1d(np.arange(PLACES), row) for row in before.ids]
    ids = np.concatenate((before.ids, rest), axis=1)
    distances = np.sort(np.random.default_rng(0).random(ids.shape), axis=1).astype(np.float32)
    whole = Predictions(before.about, ids, distances, np.zeros(ids.shape, np.int64))
    after = verify(whole, towns, Calibrated(), VerificationConfig(candidates=1000, weight=300.0))
    assert after.about.verified == PLACES
    assert after.about.name.endswith(f"_verified-{PLACES}")


def test_what_does_not_belong_together_is_refused(towns: EvaluationSet) -> None:
    before = retrieved(towns)

    def changed(**about: object) -> Predictions:
        return dataclasses.replace(before, about=dataclasses.replace(before.about, **about))  # type: ignore[arg-type]

    with pytest.raises(EvaluationError, match="another set"):
        verify(changed(data="0123456789abcdef"), towns, Calibrated(), CONFIG)
    with pytest.raises(EvaluationError, match="name scans as places"):
        verify(changed(setting="aerial+ground"), towns, Calibrated(), CONFIG)
    with pytest.raises(EvaluationError, match="hold 24 places a query, 30 are to be"):
        verify(before, towns, Calibrated(), dataclasses.replace(CONFIG, candidates=300))
    with pytest.raises(EvaluationError, match="does not have"):
        verify(dataclasses.replace(before, ids=before.ids + PLACES), towns, Calibrated(), CONFIG)
    with pytest.raises(EvaluationError, match="before"):
        verify(verify(before, towns, Calibrated(), CONFIG), towns, Calibrated(), CONFIG)
    with pytest.raises(EvaluationError, match="not by e"):
        verify(changed(encoder="another"), towns, Calibrated(), CONFIG)
    uncalibrated = Calibrated()
    uncalibrated.calibration = None
    with pytest.raises(EvaluationError, match="without a calibration"):
        verify(before, towns, uncalibrated, CONFIG)
    for settings in ({"candidates": 0}, {"weight": -1.0}, {"weight": float("nan")}):
        with pytest.raises(ConfigError):
            from_dict(VerificationConfig, settings)


def test_files_hold_what_was_verified(towns: EvaluationSet, tmp_path: Path) -> None:
    after = verify(retrieved(towns), towns, Calibrated(), CONFIG)
    save_predictions(tmp_path / "a.npz", after)
    back = load_predictions(tmp_path / "a.npz")
    assert back.about == after.about
    for name in ("ids", "distances", "headings", "fits", "fit_headings_rad"):
        np.testing.assert_array_equal(getattr(back, name), getattr(after, name))
    save_predictions(tmp_path / "b.npz", dataclasses.replace(after, fits=None))
    with pytest.raises(EvaluationError, match="damaged"):
        load_predictions(tmp_path / "b.npz")


def test_tables_tell_both_kinds_apart(towns: EvaluationSet) -> None:
    before = retrieved(towns)
    after = verify(before, towns, Calibrated(), CONFIG)
    assert before.about.kind == "retrieval"
    assert after.about.kind == "retrieval + height maps"
    for words in (describe, describe_briefly):
        assert words(before.about) != words(after.about)
    both = [score(before, towns), score(after, towns)]
    assert headline(both, 1, "nearest") is both[1]
    rows = as_csv(both).splitlines()
    assert sum(",retrieval,0," in row for row in rows) == sum(",retrieval + height maps,16," in row for row in rows) > 0
    assert after.about.query_ms == pytest.approx(3.0 + after.about.verify_ms)
    assert after.about.verify_ms > 0
