"""What a run learns from: the places of one or several folders, joined."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crossloc3d_ros.config import PreprocessingConfig, from_dict
from crossloc3d_ros.errors import ConfigError, TrainingError
from crossloc3d_ros.training.shards import (
    TRAINING,
    VALIDATION,
    Manifest,
    TrainingTown,
    ValidationTown,
    read_manifest,
    read_training_town,
    read_validation_town,
)


@dataclass(frozen=True)
class Material:
    """Folders of places and how each was made; towns of different folders are different towns."""

    folders: tuple[Path, ...]
    manifests: tuple[Manifest, ...]

    def training_towns(self) -> list[TrainingTown]:
        """Read the towns to learn from, folder by folder."""
        return [read_training_town(path) for path in self._files(TRAINING)]

    def validation_towns(self) -> list[ValidationTown]:
        """Read the held-out towns; raises TrainingError where there are none."""
        towns = [read_validation_town(path) for path in self._files(VALIDATION)]
        if not towns or not any(len(t.query_xy_m) for t in towns) or not any(len(t.submap_xy_m) for t in towns):
            names = ", ".join(map(str, self.folders))
            raise TrainingError(f"{names} holds no towns to validate on; make them with `--validation-towns`")
        return towns

    def sha256(self) -> str:
        """Identify the places by how they were made."""
        hashes = [_manifest_hash(manifest) for manifest in self.manifests]
        return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()

    def _files(self, role: str) -> list[Path]:
        pairs = zip(self.folders, self.manifests, strict=True)
        return [folder / town.file for folder, manifest in pairs for town in manifest.of_role(role)]


def read_material(folders: Sequence[Path], preprocessing: PreprocessingConfig | None = None) -> Material:
    """Read the manifests of folders of places; the towns themselves are read when they are asked for.

    Raises TrainingError for a folder that is named twice, that is damaged or that holds no places, and where the
    places were made for another `preprocessing`: their validation patches would examine what was not learned.
    """
    if not folders:
        raise TrainingError("name a folder of places to learn from")
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise TrainingError(f"a folder of places is named twice: {', '.join(map(str, folders))}")
    material = Material(tuple(folders), tuple(read_manifest(folder) for folder in folders))
    for folder, manifest in zip(folders, material.manifests, strict=True):
        made_for = manifest.settings.get("preprocessing")
        if preprocessing is None or made_for is None:
            continue
        try:
            same = from_dict(PreprocessingConfig, made_for) == preprocessing
        except (ConfigError, AttributeError) as error:
            raise TrainingError(f"{folder}: the manifest's preprocessing cannot be used ({error})") from error
        if not same:
            raise TrainingError(
                f"the places in {folder} were made for another preprocessing ({made_for}); make them anew with these "
                "settings, or train with theirs"
            )
    return material


def _manifest_hash(manifest: Manifest) -> str:
    towns = [(t.file, t.role, t.scans, t.submaps) for t in manifest.towns]
    text = json.dumps([dict(manifest.settings), towns], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
