"""Parts of surveys: nested, disjoint, complete, and the same on every machine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.datasets.survey_parts import classify_part, density_per_m2, numbers_of, write_part
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.formats.las import iter_chunks, write_laz
from crossloc3d_ros.geodesy import Projection


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write 8 points/m2 on 100 by 50 metres, in two files."""
    rng = np.random.default_rng(3)
    folder = tmp_path_factory.mktemp("survey")
    for i in range(2):
        points = rng.uniform([628_000 + 50 * i, 5_803_000, 0], [628_050 + 50 * i, 5_803_050, 9], (20_000, 3))
        write_laz(folder / f"{i}.laz", points, rng.choice([1, 2, 6], 20_000).astype(np.uint8), "EPSG:32631")
    return folder


def points_of(path: Path) -> set[tuple[int, ...]]:
    """Return the points in centimetres, with their classes."""
    found = set()
    for file in sorted(path.glob("*.laz")) if path.is_dir() else [path]:
        for chunk in iter_chunks(file):
            steps = np.rint(chunk.points * 100).astype(np.int64)
            found |= {(*step, int(kind)) for step, kind in zip(steps.tolist(), chunk.classification, strict=True)}
    return found


def test_numbers_are_uniform_and_know_nothing_of_the_place() -> None:
    grid = np.stack(np.meshgrid(np.arange(200) * 0.01, np.arange(200) * 0.01, [1.0, 1.01]), -1).reshape(-1, 3)
    numbers = numbers_of(grid + np.array([628_000.0, 5_803_000.0, 0.0]))
    assert numbers.min() >= 0.0 and numbers.max() < 1.0
    counts = np.histogram(numbers, 20, (0, 1))[0]
    assert np.abs(counts - len(grid) / 20).max() < 5 * np.sqrt(len(grid) / 20)
    # Neighbours along each axis have nothing in common.
    cube = numbers.reshape(200, 200, 2)
    for axis in range(3):
        one, other = np.take(cube, range(cube.shape[axis] - 1), axis), np.take(cube, range(1, cube.shape[axis]), axis)
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.02


def test_a_number_is_that_of_the_coordinates_alone() -> None:
    points = np.random.default_rng(1).uniform(0, 1e6, (50, 3))
    order = np.random.default_rng(2).permutation(50)
    np.testing.assert_array_equal(numbers_of(points)[order], numbers_of(points[order]))
    np.testing.assert_array_equal(numbers_of(points), numbers_of(np.nextafter(points, np.inf)))


def test_two_halves_have_all_points_and_none_in_common(survey: Path, tmp_path: Path) -> None:
    counts = [write_part([survey], tmp_path / f"{low}.laz", low, low + 0.5) for low in (0.0, 0.5)]
    halves = [points_of(tmp_path / f"{low}.laz") for low in (0.0, 0.5)]
    assert sum(counts) == 40_000
    assert abs(counts[0] - 20_000) < 500
    assert not halves[0] & halves[1]
    assert halves[0] | halves[1] == points_of(survey)


def test_a_thinner_survey_is_a_part_of_a_denser_one(survey: Path, tmp_path: Path) -> None:
    for share in (0.25, 0.0625):
        write_part([survey], tmp_path / f"{share}.laz", 0.0, share)
    assert points_of(tmp_path / "0.0625.laz") < points_of(tmp_path / "0.25.laz") < points_of(survey)
    assert density_per_m2([tmp_path / "0.25.laz"]) == pytest.approx(0.25 * density_per_m2([survey]), rel=0.05)


def test_density_is_that_of_the_area_covered(survey: Path) -> None:
    assert density_per_m2([survey]) == pytest.approx(8.0, rel=0.05)
    assert density_per_m2([survey / "0.laz"]) == pytest.approx(8.0, rel=0.05)


def test_a_part_without_points_is_refused(survey: Path, tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="none of the 40,000 points"):
        write_part([survey], tmp_path / "none.laz", 0.5, 0.5)
    assert not (tmp_path / "none.laz").exists()


def yard(crs: str, folder: Path, classes: tuple[int, int], noise: int = 7) -> tuple[Path, np.ndarray]:
    """Write lawns and huts of two classes and low noise, 6 points/m2; return the file and which points are lawn."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, 80, (38_400, 2))
    is_hut = (np.abs((xy + 10) % 20 - 10) < 4).all(axis=1)
    z = 100.0 + np.where(is_hut, 3.5, 0.0) + rng.normal(0, 0.02, len(xy))
    kinds = np.where(is_hut, classes[1], classes[0]).astype(np.uint8)
    kinds[:40], z[:40] = noise, 96.0
    # Feet are used in the USA, and a survey outside of its CRS's area of use is refused.
    zone, corner = ("EPSG:32610", (420_000, 4_500_000)) if crs == "EPSG:2225" else ("EPSG:32631", (628_000, 5_803_000))
    points = Projection(zone, crs)(np.column_stack([xy + np.array(corner), z]))
    path = folder / "yard.laz"
    write_laz(path, points, kinds, crs, scale=1e-8 if crs == "EPSG:4326" else 0.001)
    return path, ~is_hut & (kinds != noise)


def test_a_survey_that_has_ground_is_left_alone(tmp_path: Path) -> None:
    path, _ = yard("EPSG:32631", tmp_path, (2, 1))
    before = path.read_bytes()
    classify_part(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("crs", ["EPSG:32631", "EPSG:28992", "EPSG:4326", "EPSG:2225"])
def test_ground_is_found_where_none_has_its_class(crs: str, tmp_path: Path) -> None:
    """In metres, degrees and feet; what is no ground keeps its class, and no point is moved."""
    path, is_lawn = yard(crs, tmp_path, (1, 6))
    before = list(iter_chunks(path))
    classify_part(path)
    after = list(iter_chunks(path))
    points, classes = (
        np.concatenate([getattr(chunk, name) for chunk in after]) for name in ("points", "classification")
    )
    np.testing.assert_allclose(points, np.concatenate([chunk.points for chunk in before]), rtol=0, atol=1e-3)
    assert (classes[is_lawn] == 2).mean() > 0.98
    others = np.concatenate([chunk.classification for chunk in before])
    assert (classes[~is_lawn] == others[~is_lawn]).mean() > 0.98
    assert (classes[others == 7] == 7).all(), "noise is no ground"
