"""What a run learns from and is validated on: towns of one or several folders, or a dataset of clouds."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from crossloc3d_ros.config import PreprocessingConfig, TrainConfig, from_dict, to_dict
from crossloc3d_ros.errors import ConfigError, DatasetError, TrainingError
from crossloc3d_ros.formats.cs_campus3d import preset_of
from crossloc3d_ros.training import own_data
from crossloc3d_ros.training.sampling import BatchSampler, Sampler
from crossloc3d_ros.training.shards import (
    MANIFEST,
    TRAINING,
    VALIDATION,
    Manifest,
    ValidationTown,
    read_manifest,
    read_training_town,
    read_validation_town,
)


class Material(Protocol):
    """What a run learns from, on disk; it is read on demand."""

    @property
    def folders(self) -> tuple[Path, ...]:
        """Its folder."""
        ...

    @property
    def preset(self) -> str | None:
        """Kind of the dataset; None for towns of make-places."""
        ...

    def sampler(self, config: TrainConfig) -> Sampler:
        """Return what draws batches; TrainingError where there is nothing to learn from."""
        ...

    def validation_towns(self, config: TrainConfig) -> list[ValidationTown]:
        """Return what is validated on, none of it learned from; TrainingError where there is nothing."""
        ...

    def sha256(self) -> str:
        """Identify the material."""
        ...


@dataclass(frozen=True)
class Towns:
    """Towns in folders of make-places; those of different folders are different towns."""

    folders: tuple[Path, ...]
    manifests: tuple[Manifest, ...]
    preset: None = None

    def sampler(self, config: TrainConfig) -> BatchSampler:
        """See `Material.sampler`."""
        return BatchSampler([read_training_town(path) for path in self._files(TRAINING)], config)

    def validation_towns(self, config: TrainConfig) -> list[ValidationTown]:
        """See `Material.validation_towns`."""
        towns = [read_validation_town(path) for path in self._files(VALIDATION)]
        if not towns or not any(len(t.query_xy_m) for t in towns) or not any(len(t.submap_xy_m) for t in towns):
            names = ", ".join(map(str, self.folders))
            raise TrainingError(f"{names} holds no towns to validate on; make them with `--validation-towns`")
        return towns

    def sha256(self) -> str:
        """See `Material.sha256`: by how the towns were made."""
        hashes = [_manifest_hash(manifest) for manifest in self.manifests]
        return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()

    def _files(self, role: str) -> list[Path]:
        pairs = zip(self.folders, self.manifests, strict=True)
        return [folder / town.file for folder, manifest in pairs for town in manifest.of_role(role)]


@dataclass(frozen=True)
class Dataset:
    """A dataset in the layout of CS-Campus3D: a user's own or a published one."""

    folder: Path
    preset: str

    @property
    def folders(self) -> tuple[Path, ...]:
        """See `Material.folders`."""
        return (self.folder,)

    def sampler(self, config: TrainConfig) -> Sampler:
        """See `Material.sampler`."""
        return own_data.load_training(self.folder, self.preset, config)

    def validation_towns(self, config: TrainConfig) -> list[ValidationTown]:
        """See `Material.validation_towns`."""
        return own_data.load_validation(self.folder, self.preset, config)

    def sha256(self) -> str:
        """See `Material.sha256`: by the lists of its clouds."""
        return own_data.fingerprint(self.folder, self.preset)


def read_material(
    folders: Sequence[Path], preprocessing: PreprocessingConfig | None = None, preset: str | None = None
) -> Material:
    """Return the material in folders of make-places, or in one folder of a dataset.

    `preset`: the dataset's kind, where it is not the one that its files suggest. Raises TrainingError for a folder
    that is named twice, is damaged or holds neither, and where places were made for another `preprocessing`: their
    validation patches would not be those that the weights were trained on.
    """
    if not folders:
        raise TrainingError("name a folder of places to learn from")
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise TrainingError(f"a folder of places is named twice: {', '.join(map(str, folders))}")
    datasets = [folder for folder in folders if preset is not None or _is_dataset(folder)]
    if datasets:
        if len(folders) > 1:
            raise TrainingError(f"{datasets[0]} is a dataset: it can be learned from alone, not with other folders")
        return Dataset(datasets[0], preset_of(datasets[0], preset).name)
    manifests = tuple(read_manifest(folder) for folder in folders)
    if preprocessing is not None:
        for folder, manifest in zip(folders, manifests, strict=True):
            _check_preprocessing(folder, manifest, preprocessing)
    return Towns(tuple(folders), manifests)


def _is_dataset(folder: Path) -> bool:
    if (folder / MANIFEST).exists():
        return False
    try:
        preset_of(folder)
    except DatasetError:
        return False
    return True


def _check_preprocessing(folder: Path, manifest: Manifest, preprocessing: PreprocessingConfig) -> None:
    made_for = manifest.settings.get("preprocessing")
    if made_for is None:
        return
    try:
        theirs = to_dict(from_dict(PreprocessingConfig, made_for))
    except (ConfigError, AttributeError) as error:
        raise TrainingError(f"{folder}: the manifest's preprocessing cannot be used ({error})") from error
    other = [
        f"{key} {theirs[key]}, not {value}" for key, value in to_dict(preprocessing).items() if theirs[key] != value
    ]
    if other:
        raise TrainingError(
            f"the places in {folder} were made for another preprocessing ({'; '.join(other)}): make them anew with "
            "these settings, or train with theirs"
        )


def _manifest_hash(manifest: Manifest) -> str:
    towns = [(t.file, t.role, t.scans, t.submaps) for t in manifest.towns]
    text = json.dumps([dict(manifest.settings), towns], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
