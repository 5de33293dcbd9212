"""A localizer that needs no training, on the map of the made-up town."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from crossloc3d_ros.config import (
    AlignmentConfig,
    BuildConfig,
    CalibrationConfig,
    CredibilityConfig,
    LocalizerConfig,
    PreprocessingConfig,
)
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.places.builder import build_map
from crossloc3d_ros.places.store import AerialMap


class RingHistogram:
    """How many points lie how far from the centre and how high: the same from every heading."""

    fingerprint = "ring-histogram"
    descriptor_size = 80
    preprocessing = PreprocessingConfig(
        half_extent_m=30.0, scan_half_extent_m=30.0, n_points=2048, min_points=40, thin_m=1.0
    )
    calibration = CalibrationConfig(temperature=0.01, none_distance=0.2, none_scale=0.02)

    def encode(self, points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        radius = np.hypot(points[:, 0], points[:, 1])
        counts, _, _ = np.histogram2d(radius, points[:, 2], bins=(10, 8), range=((0, 1.0), (0, 0.8)))
        return (counts.ravel() / max(counts.sum(), 1)).astype(np.float32)

    def encode_batch(self, clouds: Sequence[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        pass


@pytest.fixture(scope="session")
def town_map(town_drive, tmp_path_factory: pytest.TempPathFactory) -> AerialMap:
    folder = tmp_path_factory.mktemp("maps") / "town"
    build_map([town_drive.survey], folder, RingHistogram(), BuildConfig(spacing_m=10.0), geoid_separation_m=43.0)
    return AerialMap.load(folder, RingHistogram.fingerprint)


@pytest.fixture(scope="session")
def localizer(town_map: AerialMap) -> Localizer:
    """Places by retrieval alone: scans in any heading, 8 m and half a second apart, are no drive to be followed."""
    credibility, alignment = CredibilityConfig(min_probability=0.3), AlignmentConfig(search="off")
    return Localizer(town_map, RingHistogram(), LocalizerConfig(credibility=credibility, alignment=alignment))
