"""The submaps of a survey as patches on disk, cut by the map builder itself, so that they are those of a map."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.builder import ProgressCallback, build_map
from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.aerial_map.store import AerialMap, Manifest
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig, to_dict
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array


class PatchEncoder:
    """Describes a patch by its own points: a map built with it holds the submaps' patches in place of descriptors."""

    def __init__(self, preprocessing: PreprocessingConfig) -> None:
        self._preprocessing = preprocessing

    @property
    def fingerprint(self) -> str:
        """Identify the preprocessing."""
        text = json.dumps(to_dict(self._preprocessing), sort_keys=True)
        return hashlib.sha256(f"patches {text}".encode()).hexdigest()

    @property
    def descriptor_size(self) -> int:
        """Numbers in a patch."""
        return 3 * self._preprocessing.n_points

    @property
    def preprocessing(self) -> PreprocessingConfig:
        """Return how the patches are made."""
        return self._preprocessing

    def encode(self, points: Float32Array) -> Float32Array:
        """Return the points (n, 3) of a patch in a row (3 n,)."""
        return np.asarray(points, np.float32).reshape(-1)

    def encode_batch(self, clouds: Sequence[Float32Array]) -> Float32Array:
        """Return the points of B patches, (B, 3 n)."""
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        """Do nothing."""


@dataclass(frozen=True, eq=False)
class AerialPatches:
    """The submaps of a survey."""

    manifest: Manifest
    grid: Float64Array
    """(M, 3) easting, northing, ground height of the centres, metres, UTM."""
    index: DescriptorMap

    def __len__(self) -> int:
        return len(self.grid)

    def patches(self, rows: Int64Array) -> Float32Array:
        """Return the patches (len(rows), n, 3)."""
        points = self.index.descriptors(rows)
        return points.reshape(len(rows), -1, 3)


def cut_aerial(
    inputs: Sequence[str | Path],
    folder: Path,
    config: BuildConfig,
    preprocessing: PreprocessingConfig,
    *,
    crs: str | None = None,
    progress: ProgressCallback | None = None,
) -> AerialPatches:
    """Cut the submaps of aerial files on the grid of `config.spacing_m` and keep them in `folder`.

    What was cut into the folder before is taken as it is; an interrupted call goes on. Raises as `build_map`.
    """
    encoder = PatchEncoder(preprocessing)
    if not folder.exists():
        loader = functools.partial(PatchEncoder, preprocessing)
        build_map(inputs, folder, loader, config, crs=crs, progress=progress)
    aerial_map = AerialMap.load(folder, encoder.fingerprint)
    return AerialPatches(aerial_map.manifest, aerial_map.submaps.grid, aerial_map.index)
