"""A small simulated map, calibrated: four drives on it, seven scans off it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from crossloc3d_ros.config import LocalizabilityConfig
from crossloc3d_ros.localizability.calibrate import Localizability, calibrate_map


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A map's folder, its encoder, and what its calibration found."""

    folder: Path
    encoder: Any
    config: LocalizabilityConfig
    found: Localizability
    stages: tuple[str, ...]


@pytest.fixture(scope="session")
def calibrated(simulated_town: Any, tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    pose_set, encoder = simulated_town
    folder = tmp_path_factory.mktemp("calibrated") / "town"
    shutil.copytree(pose_set.map_folder, folder)
    config, stages = LocalizabilityConfig(places=4, off_map_scans=7, seed=1), []
    found = calibrate_map(folder, encoder, config, progress=lambda p: stages.append(p.stage))
    return Calibrated(folder, encoder, config, found, tuple(dict.fromkeys(stages)))
