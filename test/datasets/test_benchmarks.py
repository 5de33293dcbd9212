"""The benchmarks are what they are defined to be, are made as maps are built, and are never taken for another."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from crossloc3d_ros.config import BuildConfig, PlacesConfig, PreprocessingConfig
from crossloc3d_ros.datasets import benchmarks
from crossloc3d_ros.datasets.amsterdam import AMSTERDAM, built_submaps
from crossloc3d_ros.datasets.amsterdam_drive import DemoDrive
from crossloc3d_ros.datasets.benchmarks import open_benchmark
from crossloc3d_ros.datasets.simulated import (
    HELD_OUT,
    SEEN,
    SIMULATED,
    SIMULATED_SMALL,
    BenchmarkTown,
    SimulatedBenchmark,
    make_town_set,
    sources_digest,
)
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.formats.las import write_laz
from crossloc3d_ros.simulation.families import FAMILIES, HELD_OUT_FAMILIES
from crossloc3d_ros.simulation.survey import SurveyConfig, fly
from crossloc3d_ros.simulation.town import make_town

PREPROCESSING = PreprocessingConfig(n_points=256, min_points=64)
TINY = SimulatedBenchmark(
    (BenchmarkTown("suburb", 990_001, False), BenchmarkTown("campus", 990_002, True)),
    town_size_m=160.0, queries=3, ground=2, border_m=40.0, flight=SurveyConfig(spacing_m=1.0),
    build=BuildConfig(spacing_m=38.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def suburb() -> tuple[BenchmarkTown, benchmarks.EvaluationSet]:
    return TINY.towns[0], make_town_set(TINY.towns[0], TINY, PREPROCESSING)


def test_the_definition_is_frozen() -> None:
    large, small = ({town.seed for town in b.towns} for b in (SIMULATED, SIMULATED_SMALL))
    assert (len(large), len(small)) == (32, 8)
    assert not large & small
    assert min(large | small) >= 900_000  # training and validation towns stay below
    for town in (*SIMULATED.towns, *SIMULATED_SMALL.towns):
        assert town.family in FAMILIES
        assert town.held_out == (town.family in HELD_OUT_FAMILIES)
    assert {town.family for town in SIMULATED.towns} >= set(HELD_OUT_FAMILIES)
    assert sum(benchmark.queries * len(benchmark.towns) for benchmark in (SIMULATED,)) == 1536


def test_the_towns_of_training_are_others() -> None:
    from crossloc3d_ros.training.places import plan_towns

    asked = {town.seed for town in (*SIMULATED.towns, *SIMULATED_SMALL.towns)}
    for seed in range(1, 9):
        assert not asked & {task.seed for task in plan_towns(seed, 1000, 1000, PlacesConfig().families)}


def test_the_drive_is_the_demos() -> None:
    demo = DemoDrive()
    assert (AMSTERDAM.drive_length_m, AMSTERDAM.drive_speed_m_s) == (demo.length_m, demo.speed_m_s)
    assert (AMSTERDAM.drive_seed, AMSTERDAM.clearance_m) == (demo.seed, demo.clearance_m)


def test_submaps_are_cut_as_the_builder_cuts_them(
    suburb: tuple[BenchmarkTown, benchmarks.EvaluationSet], tmp_path: Path
) -> None:
    town, made = suburb
    world = make_town(town.seed, town.family, TINY.town_size_m, town.seed % 2)
    flown = fly(world, TINY.flight, np.random.default_rng([town.seed, 1]))
    # Shifted by whole steps of the submaps' grid, which starts at the origin of the map's grid.
    shift = np.array([38.0 * 13_200, 38.0 * 140_000, 0.0])
    write_laz(tmp_path / "town.laz", flown.points + shift, flown.classification, "EPSG:32631", scale=0.001)
    built, crs = built_submaps([tmp_path / "town.laz"], TINY.build, PREPROCESSING, tmp_path, lambda *_: None)
    assert crs == "EPSG:32631"
    order, other = (np.lexsort(np.round(xy).T) for xy in (made.aerial.xy_m, built.xy_m))
    assert len(order) == len(other) > 4
    np.testing.assert_allclose(built.xy_m[other], made.aerial.xy_m[order] + shift[:2])
    for i, j in zip(order, other, strict=True):
        one, two = np.asarray(made.aerial.patches[i]), np.asarray(built.patches[j])
        # The file keeps millimetres: a few points change their cube and with it the choice.
        kept = {tuple(p) for p in np.round(one * 500).astype(int)} & {tuple(p) for p in np.round(two * 500).astype(int)}
        assert len(kept) > 0.8 * len(np.unique(np.round(one * 500), axis=0))


def test_queries_tell_where_the_robot_stood_and_how(suburb: tuple[BenchmarkTown, benchmarks.EvaluationSet]) -> None:
    _, made = suburb
    assert 1 <= len(made.queries) <= 3
    assert (np.abs(made.queries.xy_m) <= TINY.town_size_m / 2 - TINY.border_m).all()
    assert len(np.unique(made.queries.heading_rad)) == len(made.queries)
    assert (made.aerial.heading_rad == 0).all()
    assert made.ground is not None
    assert not {tuple(xy) for xy in made.ground.xy_m} & {tuple(xy) for xy in made.queries.xy_m}
    assert made.query_groups == (SEEN,) * len(made.queries)


def test_a_town_is_the_same_at_every_making(suburb: tuple[BenchmarkTown, benchmarks.EvaluationSet]) -> None:
    town, made = suburb
    assert make_town_set(town, TINY, PREPROCESSING).fingerprint() == made.fingerprint()


def sets_in(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.is_dir()]


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(benchmarks.BENCHMARKS, "tiny", TINY)


@pytest.mark.usefixtures("tiny")
def test_a_benchmark_is_made_once_and_completed_where_it_lacks_a_town(tmp_path: Path) -> None:
    made: list[float] = []

    def open_tiny() -> benchmarks.EvaluationSet:
        made.clear()
        return open_benchmark("tiny", tmp_path, PREPROCESSING, progress=lambda s, done, t, u: made.append(done))

    first = open_tiny()
    assert made == [0, 1, 2]
    assert first.area_names == ("suburb 990001", "campus 990002")
    assert set(first.query_groups) == {SEEN, HELD_OUT}
    assert open_tiny().fingerprint() == first.fingerprint()
    assert made == []
    (folder,) = sets_in(tmp_path)
    points = folder / "campus_990002" / "aerial_points.npy"
    points.write_bytes(points.read_bytes()[:-1] + b"x")  # a town with one byte changed is made anew
    assert open_tiny().fingerprint() == first.fingerprint()
    assert made == [1, 2]


def test_other_settings_are_another_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one_town = dataclasses.replace(TINY, towns=TINY.towns[:1])
    monkeypatch.setitem(benchmarks.BENCHMARKS, "tiny", one_town)
    first = open_benchmark("tiny", tmp_path, PREPROCESSING)
    other = open_benchmark("tiny", tmp_path, dataclasses.replace(PREPROCESSING, n_points=128))
    assert len(sets_in(tmp_path)) == 2
    assert {len(patch) for patch in other.aerial.patches} == {128}
    monkeypatch.setitem(benchmarks.BENCHMARKS, "tiny", dataclasses.replace(one_town, queries=2))
    assert len(open_benchmark("tiny", tmp_path, PREPROCESSING).queries) < len(first.queries)
    assert len(sets_in(tmp_path)) == 3


def test_another_simulator_is_noticed() -> None:
    def module(source: str, name: str) -> ModuleType:
        import linecache

        made = ModuleType(name)
        made.__file__ = f"<{name}>"
        linecache.cache[made.__file__] = (len(source), None, [source], made.__file__)
        return made

    assert sources_digest(module("a = 1\n", "one")) != sources_digest(module("a = 2\n", "two"))
    assert sources_digest(benchmarks) == sources_digest(benchmarks)


def test_bad_requests_are_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown benchmark"):
        open_benchmark("paris", tmp_path, PREPROCESSING)
    with pytest.raises(EvaluationError, match=r"ahn2_2010\.laz"):
        open_benchmark("amsterdam", tmp_path, PREPROCESSING, surveys=tmp_path)
    with pytest.raises(EvaluationError, match="needs the folder"):
        open_benchmark("amsterdam", tmp_path, PREPROCESSING)
