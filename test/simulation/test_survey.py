"""A survey against the town that it was flown over."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from crossloc3d_ros.formats.las import read_header
from crossloc3d_ros.simulation.survey import Survey, SurveyConfig, fly, write_survey
from crossloc3d_ros.simulation.town import Town, make_town


@pytest.fixture(scope="module")
def town() -> Town:
    return make_town(22, "park_edge", 200.0)  # without water, whose banks are lower than the terrain


@pytest.fixture(scope="module")
def survey(town: Town) -> Survey:
    return fly(town, SurveyConfig(spacing_m=0.7), np.random.default_rng(1))


def test_heights_are_the_towns_within_the_errors(town: Town) -> None:
    config = SurveyConfig(spacing_m=1.0, horizontal_error_m=0.0, vertical_error_m=0.0)
    exact = fly(town, config, np.random.default_rng(2))
    ground = exact.classification == 2
    above = exact.height_above_ground(town)[:, 2]
    assert np.median(np.abs(above[ground])) < 0.02
    assert np.percentile(np.abs(above[ground]), 97) < 0.1
    roofs = exact.points[exact.classification == 6]
    offsets = np.array([[0, 0], [0.03, 0], [-0.03, 0], [0, 0.03], [0, -0.03]])
    tops = []
    for dx, dy in offsets:
        start = (roofs * [1, 1, 0] + [dx, dy, 300.0]).astype(np.float32)
        tops.append(300.0 - town.scene.cast(start, np.tile(np.float32([[0, 0, -1]]), (len(start), 1))).distance_m)
    # What the oblique pulse met is the topmost surface there, except on walls and under crowns; never above it.
    assert np.mean(np.abs(tops[0] - roofs[:, 2]) < 0.1) > 0.75
    assert (roofs[:, 2] < np.max(tops, axis=0) + 0.1).all()


def test_errors_have_the_size_that_was_asked_for(town: Town) -> None:
    """A shallow error is mostly each point's own, a deep one mostly its flight line's: streets are never rough."""

    def heights(error: float, seed: int, spacing: float) -> np.ndarray:
        config = SurveyConfig(spacing_m=spacing, horizontal_error_m=0.0, vertical_error_m=error)
        noisy = fly(town, config, np.random.default_rng(seed))
        return noisy.height_above_ground(town)[noisy.classification == 2, 2]

    for error in (0.1, 0.3):
        assert np.std(heights(error, 3, 0.8)) == pytest.approx(0.1 * np.sqrt(0.75), rel=0.15)
    biases = [np.mean(heights(0.3, seed, 4.0)) for seed in range(24)]
    assert np.sqrt(np.mean(np.square(biases))) == pytest.approx(np.sqrt(0.3**2 - 0.75 * 0.1**2), rel=0.35)
    assert SurveyConfig().horizontal_error_m == 0.1 and SurveyConfig().vertical_error_m == 0.3  # the paper's figures


def test_density_follows_the_spacing(town: Town, survey: Survey) -> None:
    pulses = int((survey.return_number == 1).sum())
    single = pulses / (200.0 * 200.0)
    assert single == pytest.approx(1 / 0.7**2, rel=0.25)


def test_points_stay_inside_the_bounds(town: Town, survey: Survey) -> None:
    assert (np.abs(survey.points[:, :2]) <= 100.0).all()
    assert np.isfinite(survey.points).all()


def test_crowns_give_several_returns_and_roofs_one(survey: Survey) -> None:
    later = survey.return_number > 1
    assert later.sum() > 500
    assert later[survey.classification == 1].mean() > 0.15
    assert survey.return_number.max() <= SurveyConfig().returns
    assert set(np.unique(survey.classification)) <= {1, 2, 6, 9}


def test_ground_is_seen_below_the_crowns(town: Town, survey: Survey) -> None:
    assert ((survey.return_number > 1) & (survey.classification == 2)).sum() > 100


def test_wide_areas_take_several_overlapping_lines() -> None:
    wide = make_town(1, "industry", 400.0)
    config = SurveyConfig(spacing_m=2.0, altitude_m=200.0, scan_angle_deg=25.0, overlap=0.3, heading_deg=0.0)
    survey = fly(wide, config, np.random.default_rng(0))
    assert survey.flight_line.max() == 4  # 400 m over a pitch of 2 * 200 * tan(25) * 0.7 = 131 m
    strips = [survey.points[survey.flight_line == line, 1] for line in (1, 2)]
    assert strips[0].max() > strips[1].min()


def test_the_same_generator_flies_the_same_survey(town: Town) -> None:
    first, second = (fly(town, SurveyConfig(spacing_m=3.0), np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)


def test_tiles_hold_every_point_once_in_the_towns_crs(town: Town, survey: Survey, tmp_path: Path) -> None:
    paths = write_survey(town, survey, tmp_path / "tiles", tile_m=100.0)
    assert len(paths) >= 4
    read = [laspy.read(path) for path in paths]
    assert sum(len(las.points) for las in read) == len(survey.points)
    assert {read_header(path).crs for path in paths} == {"EPSG:32631"}
    points = np.concatenate([las.xyz for las in read]) - town.origin_grid
    assert np.linalg.norm(points.mean(axis=0) - survey.points.mean(axis=0)) < 0.02
    classes = np.bincount(np.concatenate([np.asarray(las.classification) for las in read]), minlength=10)
    np.testing.assert_array_equal(classes, np.bincount(survey.classification, minlength=10))
