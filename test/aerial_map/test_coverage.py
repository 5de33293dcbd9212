"""A survey's density, its gaps and its woods are measured, kept with the map, and warned about."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.coverage import (
    Coverage,
    TileCoverage,
    coverage_warnings,
    survey_coverage,
    tile_coverage,
)
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.aerial_map.tile import distance_to_points
from crossloc3d_ros.cli.build_map import summary
from crossloc3d_ros.clouds.raster import count_raster, surface_raster
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import AerialDataError, MapError
from crossloc3d_ros.formats.las import write_laz

SIZE_M = 200.0


def a_survey(density: float, seed: int = 0) -> np.ndarray:
    """Return points (N, 3) on a plain of 200 x 200 m, at heights above the ground."""
    rng = np.random.default_rng(seed)
    count = int(SIZE_M**2 * density)
    return np.column_stack([rng.uniform(0, SIZE_M, (count, 2)), np.zeros(count)])


def with_houses(points: np.ndarray) -> np.ndarray:
    """Houses of 10 x 10 m every 20 m, 6 m high."""
    house = (points[:, 0] % 20 < 10) & (points[:, 1] % 20 < 10)
    return np.column_stack([points[:, :2], np.where(house, 6.0, 0.0)])


def with_trees(points: np.ndarray) -> np.ndarray:
    """Crowns of 7 m, 16 m high, crown beside crown; a third of the pulses pass through them."""
    rng = np.random.default_rng(1)
    from_trunk = np.hypot(points[:, 0] % 7 - 3.5, points[:, 1] % 7 - 3.5)
    hit = rng.uniform(size=len(points)) < 0.67
    return np.column_stack([points[:, :2], np.where(hit, 16 - 2.5 * from_trunk, 0.0)])


def measured(points: np.ndarray, cell_m: float = 1.0) -> Coverage:
    """Return the coverage of a survey in one tile, looked at with 60 m around it."""
    bounds = (-60.0, -60.0, SIZE_M + 60, SIZE_M + 60)
    surface = surface_raster(points, bounds, cell_m)
    support = count_raster(points, bounds, cell_m)
    inner = slice(round(60 / cell_m), round((SIZE_M + 60) / cell_m))
    tile = tile_coverage(support.values, distance_to_points(surface), surface.values, (inner, inner), cell_m)
    return survey_coverage([tile])


@pytest.mark.parametrize("cell_m", [1.0, 2.0])
@pytest.mark.parametrize("density", [0.3, 2.0, 20.0])
def test_density_and_empty_cells_are_those_of_a_poisson_process(density: float, cell_m: float) -> None:
    coverage = measured(a_survey(density), cell_m)
    assert coverage.points_per_m2 == pytest.approx(density, rel=0.05)
    assert 0.7 * density < coverage.points_per_m2_low <= coverage.points_per_m2
    assert coverage.empty_share == pytest.approx(np.exp(-density * cell_m**2), abs=0.02)
    assert coverage.gap_share == 0.0 and coverage.widest_gap_m == 0.0


def test_a_gap_between_strips_is_measured_and_does_not_thin_the_survey() -> None:
    points = a_survey(4.0)
    coverage = measured(points[np.abs(points[:, 0] - 100) > 15])  # 30 m wide
    assert coverage.widest_gap_m == pytest.approx(30, abs=2.5)
    assert coverage.gap_share == pytest.approx(20 / 200, abs=0.015)  # but for 5 m on either side
    assert coverage.empty_share == pytest.approx(30 / 200 + 0.85 * np.exp(-4), abs=0.015)
    assert coverage.points_per_m2 == pytest.approx(4.0, rel=0.1)


def test_a_strip_flown_twice_shows_in_the_quantile() -> None:
    points = a_survey(1.0)
    twice = a_survey(3.0, seed=1)
    coverage = measured(np.concatenate([points, twice[twice[:, 0] > 100]]))
    assert coverage.points_per_m2_low == pytest.approx(1.0, rel=0.1)
    assert coverage.points_per_m2 > 2 * coverage.points_per_m2_low


def test_no_echo_at_all_is_nothing() -> None:
    nothing = measured(np.empty((0, 3)))
    assert nothing.points_per_m2 == 0.0 and nothing.gap_share == 0.0
    assert survey_coverage([]) == survey_coverage([TileCoverage()]) == nothing


@pytest.mark.parametrize("density", [0.5, 3.0, 20.0])
def test_wood_is_told_from_houses(density: float) -> None:
    assert measured(with_trees(a_survey(density))).wood_share > 0.9
    assert measured(with_houses(a_survey(density))).wood_share < 0.8
    assert measured(a_survey(density)).wood_share == 0.0


def test_each_hazard_has_its_sentence_and_a_good_survey_none() -> None:
    assert coverage_warnings(measured(with_houses(a_survey(4.0)))) == ()
    assert coverage_warnings(measured(with_houses(a_survey(0.4)))) == ()
    (sparse,) = coverage_warnings(measured(with_houses(a_survey(0.1))))
    assert "0.1 points/m2, too few to tell places apart" in sparse and "at least 0.5 points/m2" in sparse
    (wood,) = coverage_warnings(measured(with_trees(a_survey(5.0))))
    assert "of the area are wood" in wood and "rarely be sure" in wood
    (water,) = coverage_warnings(measured(a_survey(0.002)))
    assert "no echo, as water or gaps between strips" in water


CORNER = np.array([628_000.0, 5_803_000.0, 0.0])


def written(folder: Path, points: np.ndarray) -> Path:
    path = folder / "survey.laz"
    write_laz(path, points + CORNER, np.where(points[:, 2] > 0.5, 1, 2).astype(np.uint8), "EPSG:32631")
    return path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, town: Any) -> Path:
    """The map of a town of 1 point/m2 in several tiles."""
    folder = tmp_path_factory.mktemp("coverage")
    encoder = town.__globals__["PolarHistogram"]()
    build_map([written(folder, with_houses(a_survey(1.0)))], folder / "map", encoder, BuildConfig(tile_m=100.0))
    return folder / "map"


def test_the_support_counts_every_echo(built: Path) -> None:
    aerial = AerialMap.load(built)
    support, surface = aerial.support(), aerial.surface()
    assert support is not None
    assert support.values.sum() == aerial.manifest.counts.points_used
    np.testing.assert_array_equal(support.values > 0, np.isfinite(surface.values))
    expected = count_raster(with_houses(a_survey(1.0)) + CORNER, aerial.bounds, 1.0)
    assert (
        np.mean(support.values == expected.values) > 0.97
    )  # LAZ keeps centimetres: some points cross into the next cell
    west, south, _, _ = aerial.bounds
    part = aerial.support((west - 10, south, west + 20, south + 20))
    assert part is not None and part.values.shape == (20, 30)
    assert (part.values[:, :10] == 0).all()
    np.testing.assert_array_equal(part.values[:, 10:], support.values[-20:, :20])


def test_the_manifest_and_the_summary_say_how_the_area_is_covered(built: Path, encoder: Any, tmp_path: Path) -> None:
    coverage = store.read_manifest(built).coverage
    assert coverage is not None
    assert coverage.points_per_m2 == pytest.approx(1.0, rel=0.05)
    assert coverage.empty_share == pytest.approx(np.exp(-1), abs=0.02)
    file = written(tmp_path, with_houses(a_survey(0.15)))
    text = summary(build_map([file], tmp_path / "map", encoder, BuildConfig(spacing_m=50.0)))
    assert "0.15 points/m2" in text and "sparse, as all below 2" in text and "without an echo" in text
    assert "warning   the survey has 0.15 points/m2" in text


def without_support(values: dict[str, Any]) -> None:
    del values["coverage"]
    values["files"] = [record for record in values["files"] if record["name"] != store.SUPPORT]


def copied(built: Path, folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    folder.mkdir()
    for file in built.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    values = json.loads((folder / store.MANIFEST).read_text())
    change(values)
    (folder / store.MANIFEST).write_text(json.dumps(values))
    return folder


def test_a_map_of_before_loads_and_has_no_support(built: Path, tmp_path: Path) -> None:
    folder = copied(built, tmp_path / "map", without_support)
    (folder / store.SUPPORT).unlink()
    aerial = AerialMap.load(folder)
    assert aerial.support() is None and aerial.manifest.coverage is None
    assert aerial.manifest.format_version == 2


@pytest.mark.parametrize("damage", ["missing", "truncated", "changed"])
def test_support_that_the_manifest_names_is_checked(built: Path, tmp_path: Path, damage: str) -> None:
    folder = copied(built, tmp_path / "map", lambda _: None)
    file = folder / store.SUPPORT
    content = file.read_bytes()
    if damage == "missing":
        file.unlink()
    elif damage == "truncated":
        file.write_bytes(content[:-10])
    else:
        file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(MapError, match=r"support\.tif"):
        AerialMap.load(folder)


@pytest.mark.parametrize(
    ("density", "cause"),
    [(0.0008, "as on water, which gives no echo"), (4.0, "4 points/m2"), (0.01, "of the area have")],
)
def test_where_no_map_can_be_made_the_cause_is_named(tmp_path: Path, encoder: Any, density: float, cause: str) -> None:
    """Hardly an echo, a bare field, and a few echoes that stand on nothing."""
    with pytest.raises(AerialDataError, match=r"the area is empty") as raised:
        build_map([written(tmp_path, a_survey(density))], tmp_path / "map", encoder, BuildConfig())
    assert cause in str(raised.value)
