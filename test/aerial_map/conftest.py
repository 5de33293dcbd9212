"""A small survey of known shape, and a small encoder that sees it: the builder's world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.config import BuildConfig, PreprocessingConfig
from crossloc3d_ros.formats.las import write_laz
from crossloc3d_ros.types import Float32Array

WEST, SOUTH = 628_000.0, 5_803_000.0
"""South-western corner of the survey in UTM 31N."""
CRS = "EPSG:32631"


@dataclass
class PolarHistogram:
    """Stands in for the network: how many points lie how far from the centre and how high."""

    preprocessing: PreprocessingConfig = field(
        default_factory=lambda: PreprocessingConfig(half_extent_m=20.0, n_points=256, min_points=40)
    )
    fingerprint: str = "polar-histogram-1"
    descriptor_size: int = 32
    calls: int = 0

    def encode(self, points: Float32Array) -> Float32Array:
        return self.encode_batch([points])[0]

    def encode_batch(self, clouds: Sequence[Float32Array]) -> Float32Array:
        self.calls += len(clouds)
        rows = []
        for cloud in clouds:
            radius = np.hypot(cloud[:, 0], cloud[:, 1])
            histogram, _, _ = np.histogram2d(radius, cloud[:, 2], bins=(8, 4), range=((0, 1.5), (0, 1)))
            rows.append(histogram.ravel() / len(cloud))
        return np.array(rows, dtype=np.float32)

    def warm_up(self) -> None:
        pass


@dataclass(frozen=True)
class Survey:
    """A field that rises to the east with houses on it, seen from above."""

    points: np.ndarray
    classification: np.ndarray


def terrain_height(easting: np.ndarray, northing: np.ndarray) -> np.ndarray:
    """Return the ground of the survey: 2 % to the east, a gentle wave to the north."""
    return 3.0 + 0.02 * (easting - WEST) + 0.5 * np.sin((northing - SOUTH) / 40.0)


def make_survey(width_m: float = 160.0, height_m: float = 120.0, density: float = 3.0, seed: int = 0) -> Survey:
    """Return the survey in EPSG:32631: houses of 10 x 8 m, 6 m high, every 25 m; classes 2 and 6."""
    rng = np.random.default_rng(seed)
    count = int(width_m * height_m * density)
    e, n = rng.uniform(0, width_m, count), rng.uniform(0, height_m, count)
    house = (e % 25 < 10) & (n % 25 < 8)
    z = terrain_height(e + WEST, n + SOUTH) + np.where(house, 6.0 + (e // 25) % 3, rng.normal(0, 0.02, count))
    points = np.column_stack([e + WEST, n + SOUTH, z])
    return Survey(points, np.where(house, 6, 2).astype(np.uint8))


@pytest.fixture(scope="session")
def survey() -> Survey:
    return make_survey()


@pytest.fixture(scope="session")
def survey_file(survey: Survey, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One classified LAZ file of the survey."""
    path = tmp_path_factory.mktemp("survey") / "town.laz"
    write_laz(path, survey.points, survey.classification, CRS, scale=0.001)
    return path


@pytest.fixture
def encoder() -> PolarHistogram:
    return PolarHistogram()


@pytest.fixture(scope="session")
def small_tiles() -> BuildConfig:
    """Several tiles even in a small survey."""
    return BuildConfig(tile_m=76.0)


@pytest.fixture(scope="session")
def town() -> Callable[..., Survey]:
    """The function that makes surveys."""
    return make_survey


@pytest.fixture(scope="session")
def ground() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The true ground of every survey."""
    return terrain_height
