"""Calibrations on disk: read as they were written, and left aside with a sentence where they belong elsewhere."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from crossloc3d_ros.aerial_map.calibration import (
    CALIBRATION,
    LocalizabilityCounts,
    MapCalibration,
    read_calibration,
    write_calibration,
)
from crossloc3d_ros.errors import MapError

MADE = MapCalibration(
    offset=-1.25, unlimited_offset=0.5, offset_std=0.3, off_map_belief=0.99, lidar="os1-64", lidar_height_m=1.8, seed=3,
    counts=LocalizabilityCounts(places=4, right=3, off_map=7, never=4), manifest_sha256="ab" * 32,
    observation_model="0123456789abcdef", created="2026-01-01T00:00:00+00:00", software="crossloc3d_ros 0.1.0",
)  # fmt: skip


def test_what_was_written_is_read(tmp_path: Path) -> None:
    write_calibration(tmp_path, MADE)
    assert read_calibration(tmp_path, MADE.manifest_sha256) == MADE


def test_a_map_that_was_never_calibrated_has_none(tmp_path: Path) -> None:
    assert read_calibration(tmp_path, MADE.manifest_sha256) is None


def test_a_calibration_of_another_map_is_refused(tmp_path: Path) -> None:
    write_calibration(tmp_path, MADE)
    with pytest.raises(MapError, match=r"another map, .* calibrate the map again with 'calibrate_map "):
        read_calibration(tmp_path, "cd" * 32)


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"format": "something"}, "is no crossloc3d localizability"),
        ({"format_version": 2}, "has format version 2, this is for 1"),
        ({"offset": "much"}, "'offset' must be"),
        ({"offset": 0.5}, "'offset' must lie between -50 and 0 nats"),
        ({"offset": -51.0}, "'offset' must lie between -50 and 0 nats"),
        ({"offset": float("nan")}, "'offset' must lie between -50 and 0 nats"),
        ({"offset_std": -1.0}, "must be finite"),
        ({"off_map_belief": 1.5}, "must be a probability"),
        ({"lidar_height_m": 0.0}, "must be positive"),
        ({"counts": {"places": -1}}, "must not be negative"),
        ({"surprise": 1}, "unknown setting 'surprise'"),
    ],
)
def test_what_no_calibration_holds_is_refused(tmp_path: Path, changed: dict[str, Any], complaint: str) -> None:
    values = {**dataclasses.asdict(MADE), **changed}
    (tmp_path / CALIBRATION).write_text(json.dumps(values))
    with pytest.raises(MapError, match=complaint):
        read_calibration(tmp_path, MADE.manifest_sha256)


@pytest.mark.parametrize("text", ["", "[1, 2]", '{"format": "crossloc3d localizability"', "\x00"])
def test_a_file_that_is_no_calibration_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / CALIBRATION).write_text(text)
    with pytest.raises(MapError, match=CALIBRATION):
        read_calibration(tmp_path, MADE.manifest_sha256)


def test_a_calibration_that_lacks_numbers_is_refused(tmp_path: Path) -> None:
    values = dataclasses.asdict(MADE)
    del values["offset"]
    (tmp_path / CALIBRATION).write_text(json.dumps(values))
    with pytest.raises(MapError, match="is damaged"):
        read_calibration(tmp_path, MADE.manifest_sha256)
