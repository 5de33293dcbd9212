"""What a map knows of itself: the offset that calibrates the belief on it, and how that was found.

`localizability.json` lies in the map's folder beside the map's own files, and is no part of the map: a map without it,
or with one that cannot be used, is as good as before. It names the manifest and the observation model that it was made
for by their checksums, so that a calibration of another map or of another release is left aside.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from crossloc3d_ros.config import from_dict
from crossloc3d_ros.errors import ConfigError, MapError
from crossloc3d_ros.files import write_atomically

CALIBRATION = "localizability.json"
FORMAT, FORMAT_VERSION = "crossloc3d localizability", 1
LARGEST_OFFSET = 50.0
"""Nats; beyond this below 0, an offset says nothing but that the file is damaged."""


@dataclass(frozen=True)
class LocalizabilityCounts:
    """What was simulated, and what came of it."""

    places: int = 0
    """Scans on the map, each the first of a drive."""
    right: int = 0
    """Of these, scans whose likeliest pose is the right one."""
    not_aligned: int = 0
    """Scans on the map with too little evidence to be aligned."""
    off_map: int = 0
    """Scans of other places."""
    at_once: int = 0
    """Places that the first scan gives away, with a right fix within 20 m."""
    after_20_m: int = 0
    """Places with a right fix within 20 m, but not at once."""
    after_100_m: int = 0
    """Places with a right fix within 100 m, but not within 20 m."""
    never: int = 0
    """Places without a right fix within 100 m."""
    wrong_fixes: int = 0
    """Drives with a fix more than 10 m off."""


@dataclass(frozen=True)
class MapCalibration:
    """What the log likelihoods of scans mean on one map with one lidar."""

    offset: float
    """Nats, 0 or less, added to the log likelihood of every aligned pose."""
    unlimited_offset: float
    """The same without its limits: 0, and what scans off the map allow."""
    offset_std: float
    """Standard deviation of `unlimited_offset`, nats."""
    off_map_belief: float
    """Largest belief in a scan off the map, with the offset."""
    lidar: str
    lidar_height_m: float
    seed: int
    counts: LocalizabilityCounts
    manifest_sha256: str
    """Of the manifest of the map that it was made for."""
    observation_model: str
    """Fingerprint of the observation model that it was made with."""
    created: str
    """UTC, ISO 8601."""
    software: str
    format: str = FORMAT
    format_version: int = field(default=FORMAT_VERSION)


def manifest_digest(manifest: Path) -> str:
    """Return the checksum by which a calibration names the manifest of its map."""
    return hashlib.sha256(manifest.read_bytes()).hexdigest()


def write_calibration(folder: Path, calibration: MapCalibration) -> None:
    """Write the calibration of a map into its folder; MapError where that fails."""
    text = json.dumps(dataclasses.asdict(calibration), indent=2, allow_nan=False)
    write_atomically(folder / CALIBRATION, text + "\n", MapError)


def read_calibration(folder: Path, manifest_sha256: str) -> MapCalibration | None:
    """Return the calibration that lies in a map's folder; None where there is none.

    Raises MapError with a sentence where it is damaged, of another version, or was made for another map.
    """
    file = folder / CALIBRATION
    advice = f"calibrate the map again with 'calibrate_map {folder}'"
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise MapError(f"{file} is damaged ({error}); {advice}") from error
    if not isinstance(values, Mapping) or values.get("format") != FORMAT:
        raise MapError(f"{file} is no {FORMAT}; {advice}")
    if values.get("format_version") != FORMAT_VERSION:
        raise MapError(
            f"{file} has format version {values.get('format_version')}, this is for {FORMAT_VERSION}; {advice}"
        )
    try:
        calibration = from_dict(MapCalibration, values)
        _check(calibration)
    except (ConfigError, TypeError) as error:
        raise MapError(f"{file} is damaged ({error}); {advice}") from error
    if calibration.manifest_sha256 != manifest_sha256:
        raise MapError(f"{file} was made for another map, or for this one before it was built again; {advice}")
    return calibration


def _check(calibration: MapCalibration) -> None:
    """Raise ConfigError for numbers that no calibration has."""
    if not -LARGEST_OFFSET <= calibration.offset <= 0.0:
        raise ConfigError(f"'offset' must lie between -{LARGEST_OFFSET:g} and 0 nats, got {calibration.offset}")
    if not (math.isfinite(calibration.unlimited_offset) and 0.0 <= calibration.offset_std < math.inf):
        raise ConfigError("'unlimited_offset' and 'offset_std' must be finite")
    if not 0.0 <= calibration.off_map_belief <= 1.0:
        raise ConfigError(f"'off_map_belief' must be a probability, got {calibration.off_map_belief}")
    if not calibration.lidar_height_m > 0.0:
        raise ConfigError(f"'lidar_height_m' must be positive, got {calibration.lidar_height_m}")
    if any(count < 0 for count in dataclasses.astuple(calibration.counts)):
        raise ConfigError("'counts' must not be negative")
