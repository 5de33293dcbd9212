"""Simulated towns on disk: one file a town, and a manifest of how they were made."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.files import atomic_path, write_atomically
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

MANIFEST = "manifest.json"
FORMAT = 2  # of stored material; a reader refuses others
TRAINING = "train"
VALIDATION = "validation"

Int16Array = npt.NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class TrainingTown:
    """A town as material: every scan and the survey whole, so that patches can be cut at any place and heading."""

    name: str
    scan_xy_m: Float64Array
    """(S, 2) where the scans were taken, town frame."""
    scan_heading_rad: Float64Array
    """(S,) the robot's true heading, counter-clockwise from east."""
    scan_points_cm: Int16Array
    """(N, 3) above-ground points of all scans, one scan after the other: from the sensor along the robot's heading,
    z above the ground, centimetres."""
    scan_starts: Int64Array
    """(S + 1,) first point of each scan, and the end."""
    survey_points: Float32Array
    """(M, 3) above-ground points of the survey of the other epoch: town frame, z above the ground, metres."""

    def __len__(self) -> int:
        return len(self.scan_xy_m)

    def scan_points(self, index: int) -> Float32Array:
        """Return the points (n, 3) of one scan in metres."""
        points = self.scan_points_cm[self.scan_starts[index] : self.scan_starts[index + 1]]
        return points.astype(np.float32) * np.float32(0.01)


@dataclass(frozen=True, eq=False)
class ValidationTown:
    """A town as an examination: the patches that the localizer and the map builder would make."""

    name: str
    query_xy_m: Float64Array
    """(Q, 2) where the scans were taken, town frame."""
    query_patches: Float32Array
    """(Q, n, 3) in patch units."""
    submap_xy_m: Float64Array
    """(M, 2) centres of the submaps, town frame."""
    submap_patches: Float32Array
    """(M, n, 3) in patch units."""


@dataclass(frozen=True)
class TownEntry:
    """One town's entry of the manifest."""

    file: str
    role: str
    family: str
    seed: int
    scans: int
    submaps: int
    seconds: float


@dataclass(frozen=True)
class Manifest:
    """How a set of places was made."""

    settings: Mapping[str, Any]
    """Seed, counts, places and preprocessing configuration: two sets with equal settings hold equal towns."""
    towns: tuple[TownEntry, ...]

    def of_role(self, role: str) -> list[TownEntry]:
        """Return the towns to learn from or to validate on."""
        return [town for town in self.towns if town.role == role]


def write_town(path: Path, town: TrainingTown | ValidationTown) -> None:
    """Write one town, whole or not at all."""
    arrays: dict[str, Any] = {key: value for key, value in vars(town).items() if isinstance(value, np.ndarray)}
    with atomic_path(path, TrainingError) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def read_training_town(path: Path) -> TrainingTown:
    """Read one town; a missing or damaged file raises TrainingError."""
    arrays = _read_arrays(path, ("scan_xy_m", "scan_heading_rad", "scan_points_cm", "scan_starts", "survey_points"))
    return TrainingTown(name=path.stem, **arrays)


def read_validation_town(path: Path) -> ValidationTown:
    """Read one town; a missing or damaged file raises TrainingError."""
    arrays = _read_arrays(path, ("query_xy_m", "query_patches", "submap_xy_m", "submap_patches"))
    return ValidationTown(name=path.stem, **arrays)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest, whole or not at all."""
    content = {
        "format": FORMAT,
        "settings": dict(manifest.settings),
        "towns": [vars(town) for town in manifest.towns],
    }
    write_atomically(folder / MANIFEST, json.dumps(content, indent=1) + "\n", TrainingError, synced=True)


def read_manifest(folder: Path) -> Manifest:
    """Read a folder's manifest; raise TrainingError where there is none or it is of another version."""
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text())
        if content["format"] != FORMAT:
            raise TrainingError(f"{path} is of format {content['format']}, this version reads {FORMAT}: make it anew")
        return Manifest(content["settings"], tuple(TownEntry(**town) for town in content["towns"]))
    except FileNotFoundError as error:
        raise TrainingError(f"{folder} holds no training places; make them with `train make-places`") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"{path} is damaged ({error}): make the places anew") from error


def _read_arrays(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        with np.load(path) as archive:
            return {name: archive[name] for name in names}
    except FileNotFoundError as error:
        raise TrainingError(f"{path} is missing: run `train make-places` again, it makes what is not there") from error
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise TrainingError(f"{path} is damaged ({error}): remove it and run `train make-places` again") from error
