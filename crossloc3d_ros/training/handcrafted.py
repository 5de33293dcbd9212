"""Place recognition without learning: methods that stand in for an encoder and bring their own distance.

`ScanContext` is the published method (IROS 2018): greatest heights in rings x sectors, the mean over the sectors of one
minus the cosine of two columns, the least over all shifts. It takes both clouds for scans of one sensor. Every place is
compared in every heading; there is no preselection by ring keys to lose a place in.

`HeightMaps` is the same idea made for retrieving a scan from a survey; see `clouds.height_map`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.clouds.height_map import HeightMatcher, Match, height_raster, polar_maxima
from crossloc3d_ros.config import HeightMapConfig, PreprocessingConfig, to_dict
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import DescriptorEncoder, Float32Array, Float64Array

VERSION = 2
"""Raised when the descriptors change: those kept on disk are stale then."""
_BLOCK_BYTES = 1 << 28

Complex64Array = npt.NDArray[np.complex64]


class _Method(DescriptorEncoder):
    """What both methods share."""

    def __init__(self, preprocessing: PreprocessingConfig | None, settings: dict[str, Any]) -> None:
        self._preprocessing = preprocessing or PreprocessingConfig()
        self._settings = settings
        self._database: Float32Array | None = None
        self._spectra: Complex64Array | None = None

    @property
    def fingerprint(self) -> str:
        """Identify what decides a descriptor."""
        settings = {"version": VERSION, "method": type(self).__name__, **self._settings, **to_dict(self._preprocessing)}
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def preprocessing(self) -> PreprocessingConfig:
        """Return the preprocessing that patches must have."""
        return self._preprocessing

    def encode_batch(self, clouds: Sequence[Float32Array]) -> Float32Array:
        """Return the descriptors (B, D) of B patches."""
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        """Compile what is compiled."""
        self.encode(np.zeros((1, 3), np.float32))

    def _prepared(self, database: Float32Array) -> Complex64Array:
        """Return what the database is compared by; that of the last one is kept."""
        if self._spectra is None or self._database is not database:
            self._spectra, self._database = self._prepare(database), database
        return self._spectra

    def _prepare(self, database: Float32Array) -> Complex64Array:
        raise NotImplementedError


class HeightMaps(_Method):
    """Height rasters, matched in every heading and near the centre; the descriptor is the raster."""

    def __init__(self, preprocessing: PreprocessingConfig | None = None, config: HeightMapConfig | None = None) -> None:
        self._config = config or HeightMapConfig()
        super().__init__(preprocessing, to_dict(self._config))
        self._matcher = HeightMatcher(self._config, self._preprocessing.half_extent_m)

    @property
    def descriptor_size(self) -> int:
        """Cells of the raster."""
        return self._config.cells**2

    def encode(self, points: Float32Array) -> Float32Array:
        """Return the raster (D,) of a patch's points (n, 3), row by row."""
        return height_raster(points, self._config.cells).ravel()

    def distances(self, queries: Float32Array, database: Float32Array) -> Float32Array:
        """Return the distances (Q, M) of rasters (Q, D) from rasters (M, D), the least over headings and centres."""
        return self.compare(queries, database).distances

    def compare(self, queries: Float32Array, database: Float32Array) -> Match:
        """Return distances, headings and offsets of queries (Q, D) in a database (M, D)."""
        return self._matcher.match_prepared(self._rasters(queries), self._prepared(database))

    def _prepare(self, database: Float32Array) -> Complex64Array:
        return self._matcher.prepare(self._rasters(database))

    def _rasters(self, descriptors: Float32Array) -> Float32Array:
        return descriptors.reshape(-1, self._config.cells, self._config.cells)


class ScanContext(_Method):
    """Scan Context as published, searched in full; the descriptor is the polar map."""

    def __init__(self, preprocessing: PreprocessingConfig | None = None, rings: int = 20, sectors: int = 60) -> None:
        super().__init__(preprocessing, {"rings": rings, "sectors": sectors})
        self._rings, self._sectors = rings, sectors

    @property
    def descriptor_size(self) -> int:
        """Cells of the map."""
        return self._rings * self._sectors

    def encode(self, points: Float32Array) -> Float32Array:
        """Return the map (D,) of a patch's points (n, 3), ring by ring from the centre."""
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise CloudError(f"a patch must be an array (n, 3) with n > 0, got {points.shape}")
        return polar_maxima(points, self._rings, self._sectors).ravel()

    def distances(self, queries: Float32Array, database: Float32Array) -> Float32Array:
        """Return the distances (Q, M), 0 to 1, of maps (Q, D) from maps (M, D), the least over all headings."""
        return self.compare(queries, database)[0]

    def compare(self, queries: Float32Array, database: Float32Array) -> tuple[Float32Array, Float64Array]:
        """Return distances and headings (Q, M): radians, counter-clockwise, from query to submap."""
        spectra = self._prepared(database)
        best = np.empty((len(queries), len(database)), np.float32)
        shifts = np.empty(best.shape, np.int64)
        block = max(1, _BLOCK_BYTES // (8 * self._sectors * max(1, len(database))))
        for start in range(0, len(queries), block):
            part = slice(start, start + block)
            mine = self._prepare(queries[part])
            alike = self._correlate(mine[:, :-1], spectra[:, :-1])
            both = self._correlate(mine[:, -1:], spectra[:, -1:])  # sectors that neither has empty
            apart = np.where(both > 0.5, 1.0 - alike / np.maximum(both, 0.5), 1.0)
            shifts[part] = apart.argmin(axis=2)
            best[part] = apart.min(axis=2)
        return best, np.asarray(shifts * (2.0 * math.pi / self._sectors), np.float64)

    def _prepare(self, database: Float32Array) -> Complex64Array:
        """Return the transforms (F, rings + 1, M) of the columns at length 1, and of which are not empty."""
        maps = database.reshape(-1, self._rings, self._sectors)
        lengths = np.linalg.norm(maps, axis=1, keepdims=True)
        parts = np.concatenate((maps / np.maximum(lengths, 1e-12), lengths > 0), axis=1)
        return np.ascontiguousarray(np.fft.rfft(parts, axis=2).astype(np.complex64).transpose(2, 1, 0))

    def _correlate(self, queries: Complex64Array, database: Complex64Array) -> Float32Array:
        """Return (Q, M, S): the sum over rings and sectors c of query[c] database[c + s], for all shifts s."""
        products = np.matmul(queries.conj().transpose(0, 2, 1), database)  # (F, Q, M)
        return np.asarray(np.fft.irfft(products.transpose(1, 2, 0), self._sectors, axis=2), np.float32)
