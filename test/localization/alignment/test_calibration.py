"""The offset of a map's calibration: added once to every pose, or left aside with a sentence."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.calibration import LocalizabilityCounts, MapCalibration
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.localization.alignment.aligner import Aligner
from crossloc3d_ros.localization.alignment.observation_model import ObservationModel
from crossloc3d_ros.types import AlignedPoses, Hypotheses, no_candidates


def calibrated(aerial_map: AerialMap, offset: float, model: str | None = None) -> AerialMap:
    made = MapCalibration(
        offset, offset, 0.1, 0.5, "vlp-16", 1.2, 0, LocalizabilityCounts(), "",
        ObservationModel.load().fingerprint if model is None else model, "", "",
    )  # fmt: skip
    return dataclasses.replace(aerial_map, calibration=made)


@pytest.fixture(scope="module")
def scan(box_town: Any) -> PreparedScan:
    place = (*box_town.street(np.random.default_rng(31)), 0.7)
    found: PreparedScan = box_town.scan(*place)
    return found


def aligned(aerial_map: AerialMap, scan: PreparedScan, config: AlignmentConfig | None = None) -> AlignedPoses:
    """Align on the whole map and at a hypothesis: what comes of either is shifted."""
    west, south, east, north = aerial_map.bounds
    middle = np.array([[(west + east) / 2, (south + north) / 2, 0.0]])
    tracked = Hypotheses(middle, np.zeros(1), np.eye(3)[None], np.array([0.5]))
    with closing(Aligner(aerial_map, config or AlignmentConfig(), threads=1)) as aligner:
        return aligner.align(scan, (0.0, 0.0), no_candidates(), tracked, search_map=True)


def test_the_offset_is_added_once_to_every_pose(box_map: AerialMap, scan: PreparedScan) -> None:
    plain, shifted = aligned(box_map, scan), aligned(calibrated(box_map, -2.5), scan)
    np.testing.assert_array_equal(shifted.grid, plain.grid)
    np.testing.assert_allclose(shifted.log_likelihood, plain.log_likelihood - 2.5, atol=1e-9)
    assert shifted.log_prior == plain.log_prior
    odds_plain, odds_shifted = (p.probabilities.sum() / (1.0 - p.probabilities.sum()) for p in (plain, shifted))
    assert np.log(odds_shifted) == pytest.approx(np.log(odds_plain) - 2.5, abs=1e-3)


def test_it_can_be_turned_off_while_running(box_map: AerialMap) -> None:
    with closing(Aligner(calibrated(box_map, -2.5), AlignmentConfig(), threads=1)) as aligner:
        assert aligner.offset == -2.5
        assert aligner.calibration_words == "calibrated for a vlp-16 at 1.2 m: -2.50 on log likelihoods"
        aligner.reconfigure(AlignmentConfig(use_calibration=False))
        assert aligner.offset == 0.0 and "alignment.use_calibration is false" in aligner.calibration_words


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m, ""),
        (lambda m: dataclasses.replace(m, calibration_fault="it is damaged"), "not used: it is damaged"),
        (lambda m: calibrated(m, -2.5, "another"), "another observation model; calibrate the map again"),
    ],
)
def test_what_cannot_be_used_changes_nothing(box_map: AerialMap, change: Any, words: str) -> None:
    with closing(Aligner(change(box_map), AlignmentConfig(), threads=1)) as aligner:
        assert aligner.offset == 0.0
        assert words in aligner.calibration_words and bool(words) == bool(aligner.calibration_words)


def test_the_fingerprint_changes_with_any_number() -> None:
    model = ObservationModel.load()
    assert model.fingerprint == ObservationModel.load().fingerprint
    weights = model.weights.copy()
    weights[0] += 1e-9
    assert dataclasses.replace(model, weights=weights).fingerprint != model.fingerprint
