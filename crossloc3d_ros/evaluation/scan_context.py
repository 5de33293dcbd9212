"""Place recognition without learning: polar height maps, compared in every heading (after Scan Context, IROS 2018).

A patch becomes rings x sectors around its centre, each cell the greatest height above the ground. Turning the robot
moves the columns on, so the distance of two maps is the least over all shifts of the columns, and the shift is the
heading. All shifts come at once by the Fourier transform along the sectors, and every place of the database is
compared: there is no preselection by ring keys to lose a place in.

Two distances. `cosine` is the published one: the mean over the sectors of one minus the cosine of two columns. It takes
both clouds for scans of one sensor. `masked` is for a scan that looks for itself in a survey from above, and differs:

* Heights are cut off where a beam `top_deg` above the horizon passes: the survey sees the roof, the robot does not.
* Only cells that the scan knows about count: those that it hit, and the free ones before the first hit of a sector.
  What lies behind a wall is unknown to the robot and known to the survey.
* The distance is the root mean square difference of heights over those cells.
* The survey's maps are smoothed over `smooth` neighbouring sectors and rings.

The submap's centre is not where the robot stands, so a scan is looked for from nine centres, `shift_m` apart (the
paper's root shifting); a descriptor holds the maps around all of them, of which the database's places need the first.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.config import PreprocessingConfig, option, to_dict
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import DescriptorEncoder, Float32Array, Float64Array, Int64Array

VERSION = 1
"""Raised when the descriptors change: those kept on disk are stale then."""
_BLOCK_BYTES = 1 << 28
_SENSOR_M = 1.2

Complex64Array = npt.NDArray[np.complex64]


@dataclass(frozen=True)
class ScanContextConfig:
    """How patches become polar maps and how those are compared."""

    rings: int = option(16, "rings from the centre to the patch's edge", low=1, high=200)
    sectors: int = option(48, "sectors of the full circle: 48 = headings in steps of 7.5 degrees", low=4, high=720)
    distance: Literal["masked", "cosine"] = option("masked", "for scans against surveys, or as published")
    top_deg: float = option(15.0, "the sensor's highest beam above the horizon", low=0.0, high=89.0)
    smooth: int = option(1, "cells on either side that the survey's maps are smoothed over", low=0, high=10)
    shift_m: float = option(6.0, "distance between the nine centres of a scan; 0 = one centre", low=0.0, high=50.0)


class ScanContext(DescriptorEncoder):
    """Polar height maps in the place of an encoder; their distance is its own."""

    def __init__(
        self, preprocessing: PreprocessingConfig | None = None, config: ScanContextConfig | None = None
    ) -> None:
        self._preprocessing = preprocessing or PreprocessingConfig()
        self._config = config or ScanContextConfig()
        self._database: Float32Array | None = None
        self._spectra: Complex64Array | None = None

    @property
    def config(self) -> ScanContextConfig:
        """Return how maps are made and compared."""
        return self._config

    @property
    def fingerprint(self) -> str:
        """Identify what decides a descriptor."""
        settings = {"version": VERSION, **to_dict(self._config), **to_dict(self._preprocessing)}
        return "scan_context_" + hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def descriptor_size(self) -> int:
        """Cells of all maps."""
        return len(self._centres()) * self._config.rings * self._config.sectors

    @property
    def preprocessing(self) -> PreprocessingConfig:
        """Return the preprocessing that patches must have."""
        return self._preprocessing

    def encode(self, points: Float32Array) -> Float32Array:
        """Return the maps (centres * rings * sectors,) of a patch's points (n, 3): greatest heights, patch units.

        Ring by ring from the centre, 0 where nothing stands; sectors counter-clockwise from x. Points beyond the unit
        circle do not count.
        """
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise CloudError(f"a patch must be an array (n, 3) with n > 0, got {points.shape}")
        cloud = np.ascontiguousarray(points, np.float32)
        maps: Float32Array = _polar_maxima(cloud, self._centres(), self._config.rings, self._config.sectors)
        return maps.ravel()

    def encode_batch(self, clouds: Sequence[Float32Array]) -> Float32Array:
        """Return the maps (B, centres * rings * sectors) of B patches."""
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        """Compile what is compiled."""
        self.encode(np.zeros((1, 3), np.float32))

    def distances(self, queries: Float32Array, database: Float32Array) -> Float32Array:
        """Return the distances (Q, M) of maps (Q, D) from maps (M, D), the least over all headings.

        `masked`: metres over half the patch's extent; `cosine`: 0 to 1.
        """
        return self.compare(queries, database)[0]

    def compare(self, queries: Float32Array, database: Float32Array) -> tuple[Float32Array, Float64Array]:
        """Return distances (Q, M) and headings (Q, M), radians in [0, 2 pi).

        The heading is the angle by which the query must be turned counter-clockwise to lie as the database's map.
        """
        sectors, centres = self._config.sectors, len(self._centres())
        spectra = self._database_spectra(database)
        best = np.empty((len(queries), len(database)), np.float32)
        shifts = np.empty(best.shape, np.int64)
        block = max(1, _BLOCK_BYTES // (8 * sectors * centres * max(1, len(database))))
        for start in range(0, len(queries), block):
            part = slice(start, start + block)
            maps = self._maps(queries[part])
            apart, turns = self._compare_block(maps.reshape(-1, *maps.shape[2:]), spectra)
            apart = apart.reshape(len(maps), centres, -1)
            centre = apart.argmin(axis=1)[:, None]
            best[part] = np.take_along_axis(apart, centre, axis=1)[:, 0]
            shifts[part] = np.take_along_axis(turns.reshape(apart.shape), centre, axis=1)[:, 0]
        return best, np.asarray(shifts * (2.0 * math.pi / sectors), np.float64)

    def _centres(self) -> Float32Array:
        """Return (K, 2) the centres of a patch's maps in patch units, its own first."""
        step = self._config.shift_m / self._preprocessing.half_extent_m
        if step == 0:
            return np.zeros((1, 2), np.float32)
        grid = np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)])
        return (step * grid).astype(np.float32)

    def _maps(self, descriptors: Float32Array) -> Float32Array:
        """Return (N, centres, rings, sectors)."""
        config = self._config
        maps: Float32Array = descriptors.reshape(len(descriptors), -1, config.rings, config.sectors)
        if config.distance == "masked":
            middle_m = (np.arange(config.rings) + 0.5) / config.rings * self._preprocessing.half_extent_m
            highest_m = _SENSOR_M + middle_m * math.tan(math.radians(config.top_deg))
            ceiling = (highest_m / self._preprocessing.half_extent_m).astype(np.float32)
            maps = np.minimum(maps, ceiling[:, None])
        return maps

    def _database_spectra(self, database: Float32Array) -> Complex64Array:
        """Return the transforms (F, 2 rings, M) that queries are compared with; those of the last database are kept."""
        if self._spectra is None or self._database is not database:
            maps = self._maps(database[:, : self._config.rings * self._config.sectors])[:, 0]
            if self._config.distance == "masked":
                smoothed = self._smoothed(maps)
                parts = np.concatenate((smoothed, smoothed**2), axis=1)
            else:
                parts = np.concatenate((_unit_columns(maps), _filled(maps)[:, None]), axis=1)
            self._spectra = _spectra(parts)
            self._database = database
        return self._spectra

    def _smoothed(self, maps: Float32Array) -> Float32Array:
        """Return maps (N, rings, sectors) averaged over their neighbours; the circle closes, the rings end."""
        reach = self._config.smooth
        if reach == 0:
            return maps
        turned = [np.roll(maps, step, axis=2) for step in range(-reach, reach + 1)]
        around = np.stack(turned).mean(axis=0)
        total, count = np.zeros_like(maps), np.zeros((1, maps.shape[1], 1), np.float32)
        for step in range(-reach, reach + 1):
            to, of = _overlap(maps.shape[1], step)
            total[:, to] += around[:, of]
            count[:, to] += 1.0
        return np.asarray(total / count, np.float32)

    def _compare_block(self, maps: Float32Array, spectra: Complex64Array) -> tuple[Float32Array, Int64Array]:
        if self._config.distance == "masked":
            known = _known(maps)
            weight = known.sum(axis=(1, 2))
            parts = np.concatenate((-2.0 * known * maps, known), axis=1)
            sums = self._correlate(_spectra(parts), spectra)  # (Q, M, S)
            sums += (known * maps**2).sum(axis=(1, 2))[:, None, None]
            sums /= np.maximum(weight, 1.0)[:, None, None]
            apart = np.sqrt(np.maximum(sums, 0.0, out=sums), out=sums)
            apart[weight == 0] = np.inf  # a scan that saw nothing is like nothing
        else:
            alike = self._correlate(_spectra(_unit_columns(maps)), spectra[:, :-1])
            both = self._correlate(_spectra(_filled(maps)[:, None]), spectra[:, -1:])
            apart = np.where(both > 0.5, 1.0 - alike / np.maximum(both, 0.5), 1.0)
        shifts = apart.argmin(axis=2)
        return np.take_along_axis(apart, shifts[..., None], axis=2)[..., 0], shifts

    def _correlate(self, queries: Complex64Array, database: Complex64Array) -> Float32Array:
        """Return (Q, M, S): the sum over rings and sectors c of query[c] database[c + s], for all shifts s."""
        products = np.matmul(queries.conj().transpose(0, 2, 1), database)  # (F, Q, M)
        sums = np.fft.irfft(products.transpose(1, 2, 0), self._config.sectors, axis=2)
        return np.asarray(sums, np.float32)


def _spectra(maps: Float32Array) -> Complex64Array:
    """Return the transforms along the sectors (F, rings, N) of maps (N, rings, sectors)."""
    transformed = np.fft.rfft(maps, axis=2).astype(np.complex64)
    return np.ascontiguousarray(transformed.transpose(2, 1, 0))


def _known(maps: Float32Array) -> Float32Array:
    """Return (N, rings, sectors) 1 where a scan knows the height: a hit, or free before the sector's first hit."""
    hit = maps > 0
    first = np.where(hit.any(axis=1), hit.argmax(axis=1), 0)  # a sector without a hit says nothing
    before = np.arange(maps.shape[1])[None, :, None] < first[:, None, :]
    return np.asarray(hit | before, np.float32)


def _unit_columns(maps: Float32Array) -> Float32Array:
    """Return maps (N, rings, sectors) with each sector's column at length 1, or 0 where it is empty."""
    return np.asarray(maps / np.maximum(np.linalg.norm(maps, axis=1, keepdims=True), 1e-12), np.float32)


def _filled(maps: Float32Array) -> Float32Array:
    """Return (N, sectors) 1 where a sector holds anything."""
    return np.asarray((maps > 0).any(axis=1), np.float32)


def _overlap(rings: int, step: int) -> tuple[slice, slice]:
    """Return the rings that have one `step` further out, and those."""
    return slice(max(0, -step), rings - max(0, step)), slice(max(0, step), rings - max(0, -step))


@njit(cache=True, nogil=True)
def _polar_maxima(points: Float32Array, centres: Float32Array, rings: int, sectors: int) -> Float32Array:
    polar = np.zeros((len(centres), rings, sectors), np.float32)
    for k in range(len(centres)):
        for i in range(len(points)):
            x, y, z = points[i, 0] - centres[k, 0], points[i, 1] - centres[k, 1], points[i, 2]
            ring = int(np.sqrt(x * x + y * y) * rings)
            if ring < rings:
                turn = np.arctan2(y, x) / (2.0 * np.pi)
                sector = int(np.floor(turn * sectors)) % sectors
                polar[k, ring, sector] = max(polar[k, ring, sector], z)
    return polar
