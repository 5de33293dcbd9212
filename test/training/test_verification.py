"""The weight of height maps is that which makes the right places likeliest, whatever the unit of the descriptors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.special import softmax

from crossloc3d_ros.cli import train
from crossloc3d_ros.config import CalibrationConfig, PlacesConfig, PreprocessingConfig
from crossloc3d_ros.errors import EvaluationError, TrainingError
from crossloc3d_ros.evaluation.retrieval.encoding import EncodingJob
from crossloc3d_ros.training.places import make_town_places, plan_towns
from crossloc3d_ros.training.shards import ValidationTown, read_validation_town
from crossloc3d_ros.training.verification import evaluation_set_of, fit_verification, fit_weight
from crossloc3d_ros.types import Float32Array


class HeightHistogram:
    """How many points lie how high: the same from every heading, and not much."""

    fingerprint = "height-histogram"
    descriptor_size = 12
    preprocessing = PreprocessingConfig(n_points=256, min_points=32)
    calibration: CalibrationConfig | None = CalibrationConfig(temperature=0.02)

    def encode(self, points: Float32Array) -> Float32Array:
        counts, _ = np.histogram(points[:, 2], bins=self.descriptor_size, range=(0.0, 0.6))
        return (counts / max(1, counts.sum())).astype(np.float32)

    def encode_batch(self, clouds: Sequence[Float32Array]) -> Float32Array:
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        pass


@pytest.fixture
def validation_towns(make_places: Callable[..., Path], tmp_path: Path) -> list[ValidationTown]:
    folders = [make_places(tmp_path / f"places{seed}", towns=0, first_seed=seed) for seed in range(4)]
    return [read_validation_town(folder / "validation_1000.npz") for folder in folders]


def simulated(weight: float, queries: int = 4000, candidates: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distances, fits and which is right, drawn by the odds of the model itself: temperature 0.5."""
    rng = np.random.default_rng(1)
    distances = rng.normal(9.0, 1.0, (queries, candidates))
    fits = rng.normal(0.1, 0.01, (queries, candidates))
    odds = softmax(-(distances / 0.5 + weight * fits), axis=1)
    chosen = (odds.cumsum(axis=1) > rng.random((queries, 1))).argmax(axis=1)
    right = np.zeros(odds.shape, np.bool_)
    right[np.arange(queries), chosen] = True
    return distances.astype(np.float32), fits.astype(np.float32), right


@pytest.mark.parametrize("weight", [30.0, 300.0])
def test_the_weight_that_made_the_odds_is_found(weight: float) -> None:
    distances, fits, right = simulated(weight)
    assert fit_weight(distances, fits, 0.5, right) == pytest.approx(weight, rel=0.1)


def test_the_unit_of_the_descriptors_does_not_matter() -> None:
    distances, fits, right = simulated(100.0, queries=500)
    once = fit_weight(distances, fits, 0.5, right)
    assert fit_weight(distances * np.float32(16.0), fits, 8.0, right) == pytest.approx(once, rel=1e-3)


def test_a_distance_that_tells_nothing_gets_little() -> None:
    rng = np.random.default_rng(2)
    distances, fits, right = simulated(100.0, queries=1500)
    of_nothing = fit_weight(distances, rng.permuted(fits, axis=1), 0.5, right)
    of_everything = fit_weight(rng.permuted(distances, axis=1), fits, 0.5, right)
    assert of_nothing < 30.0 < 1000.0 < of_everything


def test_queries_that_teach_nothing_change_nothing() -> None:
    distances, fits, right = simulated(100.0, queries=300)
    more = np.concatenate((right, np.zeros((2, 20), np.bool_), np.ones((2, 20), np.bool_), right[:1]))
    blind = np.full((1, 20), np.inf, np.float32)
    again = fit_weight(
        np.concatenate((distances, distances[:5])), np.concatenate((fits, fits[:4], blind)), 0.5, more
    )  # fmt: skip
    assert again == fit_weight(distances, fits, 0.5, right)


def test_nothing_to_learn_from_is_reported() -> None:
    distances, fits, right = simulated(100.0, queries=4)
    for nothing in (np.zeros_like(right), np.ones_like(right)):
        with pytest.raises(TrainingError, match="nothing to learn"):
            fit_weight(distances, fits, 0.5, nothing)


def test_height_maps_help_a_poor_descriptor_in_towns_not_fitted_to(
    validation_towns: list[ValidationTown], tmp_path: Path
) -> None:
    encoder = HeightHistogram()
    job = EncodingJob(encoder, HeightHistogram, tmp_path)
    fitted = fit_verification(validation_towns, job, candidates=40)
    assert fitted.submaps == sum(len(town.submap_xy_m) for town in validation_towns)
    assert (fitted.towns, fitted.queries) == (len(validation_towns), sum(len(t.query_xy_m) for t in validation_towns))
    assert len(fitted.town_weights) == fitted.towns
    assert fitted.weight > 0
    assert fitted.verified[2] > fitted.retrieval[2] + 0.1
    assert fit_verification(validation_towns, job, candidates=40, threads=3) == fitted
    with pytest.raises(TrainingError, match="at least two"):
        fit_verification(validation_towns[:1], job, candidates=40)
    uncalibrated = HeightHistogram()
    uncalibrated.calibration = None
    with pytest.raises(EvaluationError, match="without a calibration"):
        fit_verification(validation_towns, dataclasses.replace(job, encoder=uncalibrated), candidates=40)


def test_height_maps_help_in_simulated_towns(tmp_path: Path) -> None:
    """A survey from above and scans from the ground, as in a benchmark, on another day."""
    config = PlacesConfig(town_size_m=300.0, validation_scans=12)
    tasks = plan_towns(7, 0, 2, ("suburb", "campus"))
    towns = [make_town_places(task, config, PreprocessingConfig()) for task in tasks]
    validation = [town for town in towns if isinstance(town, ValidationTown)]
    fitted = fit_verification(validation, EncodingJob(HeightHistogram(), HeightHistogram, tmp_path), candidates=300)
    assert fitted.verified[2] > fitted.retrieval[2] + 0.3


def test_towns_become_one_database_in_which_no_two_are_one(validation_towns: list[ValidationTown]) -> None:
    places = evaluation_set_of(validation_towns)
    assert len(places.aerial) == sum(len(town.submap_xy_m) for town in validation_towns)
    assert len(set(places.aerial.area.tolist())) == len(validation_towns)
    assert np.isnan(places.queries.heading_rad).all()


def test_bad_input_is_one_clear_line(tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def fails(*arguments: str) -> str:
        assert train.main(["verification", "--weights", str(weights), *arguments]) == 2
        return capsys.readouterr().err

    assert "--workers" in fails("--places", str(tmp_path), "--workers", "0")
    assert "candidates" in fails("--places", str(tmp_path), "--candidates", "0")
    assert "no training places" in fails("--places", str(tmp_path))
