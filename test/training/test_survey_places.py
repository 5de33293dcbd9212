"""Places of a real survey: the sensor sees what the survey holds, in the survey's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import PlacesConfig, PreprocessingConfig, TrainConfig
from crossloc3d_ros.errors import AerialDataError, TrainingError
from crossloc3d_ros.formats.las import write_laz
from crossloc3d_ros.simulation.survey import SurveyConfig, fly
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.training.sampling import BatchSampler
from crossloc3d_ros.training.shards import TRAINING, read_manifest, read_training_town
from crossloc3d_ros.training.survey_places import make_survey_places

PREPROCESSING = PreprocessingConfig()
CORNER = np.array([629_000.0, 5_804_000.0, 0.0])


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    town = make_town(5, "suburb", 260.0, 0)
    flown = fly(town, SurveyConfig(spacing_m=0.7), np.random.default_rng(0))
    path = tmp_path_factory.mktemp("survey") / "tile.laz"
    write_laz(path, flown.points + CORNER, flown.classification, "EPSG:32631")
    return path


@pytest.fixture(scope="module")
def places(survey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("places")
    make_survey_places(folder, [survey], scans=40, seed=2, config=PlacesConfig(), preprocessing=PREPROCESSING)
    return folder


def test_scans_lie_on_the_survey_that_they_were_cast_in(places: Path) -> None:
    entries = read_manifest(places).of_role(TRAINING)
    assert sum(entry.scans for entry in entries) >= 20
    shares = []
    for entry in entries:
        town = read_training_town(places / entry.file)
        tree = KDTree(town.survey_points)
        for i in range(len(town)):
            seen = rotate_about_z(town.scan_points(i), float(town.scan_heading_rad[i]))
            seen[:, :2] += town.scan_xy_m[i].astype(np.float32)
            high = seen[seen[:, 2] > 1.0]
            if len(high) > 50:
                shares.append(np.mean(tree.query(high)[0] < 1.5))
    # Walls are seen from the side by one and from above by the other, so never all of it.
    assert np.median(shares) > 0.6


def test_sampler_learns_from_them(places: Path) -> None:
    manifest = read_manifest(places)
    towns = [read_training_town(places / entry.file) for entry in manifest.of_role(TRAINING)]
    batch = BatchSampler(towns, TrainConfig(pairs=4, towns_a_batch=1)).batch(0)
    assert len(batch.scans) == len(batch.submaps) == 4


def test_second_call_keeps_what_there_is_and_another_setting_is_refused(survey: Path, places: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in places.iterdir()}
    make_survey_places(places, [survey], scans=40, seed=2, config=PlacesConfig(), preprocessing=PREPROCESSING)
    assert {path.name: path.stat().st_mtime_ns for path in places.iterdir()} == before
    with pytest.raises(TrainingError, match="another 'scans'"):
        make_survey_places(places, [survey], scans=41, seed=2, config=PlacesConfig(), preprocessing=PREPROCESSING)


def test_survey_without_room_to_drive_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(0, 100, (8000, 2)), np.zeros(8000)]) + CORNER
    path = tmp_path / "field.laz"
    write_laz(path, ground, np.full(8000, 2, np.uint8), "EPSG:32631")
    with pytest.raises(AerialDataError, match=r"field: no ground to drive on 60 m inside"):
        make_survey_places(
            tmp_path / "out", [path], scans=10, seed=1, config=PlacesConfig(), preprocessing=PREPROCESSING
        )
