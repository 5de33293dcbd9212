"""How well a scan fits a submap, without learning: heights around both, compared in every heading and near the centre.

A patch becomes a square raster of the greatest heights above the ground. To match, rasters are read in rings and
sectors around a centre. A rotation of the robot shifts the sectors, so all headings come at once by the Fourier
transform along them; the scan is read around several centres, for the submap's centre is not where the robot stands.
What fits best gives a distance, a heading and an offset. The idea is that of Scan Context (IROS 2018); the differences
come from retrieving a scan from a survey that was made from above:

* Heights are cut off where a beam `top_deg` above the horizon passes: the survey sees the roof, the robot does not.
* Only cells that the scan observes count: those that it hit, and the free ones before the first hit of a sector.
  What lies behind a wall is unknown to the robot and known to the survey.
* The distance is the root mean square difference of the heights' square roots over those cells: whether something
  stands there matters more than how high it is.
* The survey's map is smoothed over neighbouring sectors and rings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.config import HeightMapConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

SENSOR_M = 1.2
"""Height of the sensor above the ground, for the highest beam."""
_BLOCK_CELLS = 1 << 25  # results held at once, about 256 MiB in float64

Complex64Array = npt.NDArray[np.complex64]


class Match(NamedTuple):
    """How Q scans fit M submaps."""

    distances: Float32Array
    """(Q, M) square roots of heights, in patch units; infinite for a scan without anything to go by."""
    headings_rad: Float64Array
    """(Q, M) the counter-clockwise rotation that takes the scan to the submap, in [0, 2 pi)."""
    offsets_m: Float64Array
    """(Q, M, 2) where the robot stands from the submap's centre, along the submap's axes."""


def height_raster(points: Float32Array, cells: int) -> Float32Array:
    """Return (cells, cells) the greatest height of the points (n, 3) in each cell, patch units; 0 = nothing.

    Row 0 is the lowest y, column 0 the lowest x.
    """
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise CloudError(f"a patch must be an array (n, 3) with n > 0, got {points.shape}")
    raster: Float32Array = _raster(np.ascontiguousarray(points, np.float32), cells)
    return raster


class HeightMatcher:
    """Compares height rasters of patches of one extent."""

    def __init__(self, config: HeightMapConfig, half_extent_m: float) -> None:
        self._config = config
        self._half_extent_m = half_extent_m
        middle_m = (np.arange(config.rings) + 0.5) / config.rings * half_extent_m
        highest_m = SENSOR_M + middle_m * math.tan(math.radians(config.top_deg))
        self._ceiling = (highest_m / half_extent_m).astype(np.float32)[:, None]
        steps = np.arange(-config.reach, config.reach + 1) * config.step_m / half_extent_m
        self._centres = np.array([(x, y) for y in steps for x in steps], np.float32)

    def match(self, scans: Float32Array, submaps: Float32Array) -> Match:
        """Return how scans (Q, n, n) fit submaps (M, n, n), all as `height_raster` makes them."""
        return self.match_prepared(scans, self.prepare(submaps))

    def prepare(self, submaps: Float32Array) -> Complex64Array:
        """Return what submaps (M, n, n) are compared by, (F, 2 rings, M), to be kept where many scans are compared."""
        maps = self._smoothed(self._polar(submaps, np.zeros((1, 2), np.float32))[:, 0])
        return _spectra(np.concatenate((maps, maps**2), axis=1))

    def match_prepared(self, scans: Float32Array, spectra: Complex64Array) -> Match:
        """Do what `match` does with submaps that are prepared."""
        shape = (len(scans), spectra.shape[2])
        best = np.full(shape, np.inf, np.float32)
        centre, shift = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
        for row, maps in enumerate(self._polar(scans, self._centres)):
            for part in self._blocks(shape[1]):
                best[row, part], centre[row, part], shift[row, part] = self._fit(maps, spectra[:, :, part])
        headings = np.asarray(shift * (2.0 * math.pi / self._config.sectors), np.float64)
        ahead = self._centres[centre].astype(np.float64) * -self._half_extent_m
        cosine, sine = np.cos(headings), np.sin(headings)
        x, y = ahead[..., 0], ahead[..., 1]
        return Match(best, headings, np.stack((cosine * x - sine * y, sine * x + cosine * y), axis=-1))

    def _fit(self, maps: Float32Array, spectra: Complex64Array) -> tuple[Float32Array, Int64Array, Int64Array]:
        """Return distance, centre and shift (M,) of one scan's maps (C, rings, sectors)."""
        known = known_cells(maps)
        weight = known.sum(axis=(1, 2))
        products = np.matmul(
            _spectra(np.concatenate((-2.0 * known * maps, known), axis=1)).conj().transpose(0, 2, 1), spectra
        )
        squares = np.fft.irfft(products.transpose(1, 2, 0), self._config.sectors, axis=2)  # (C, M, sectors)
        squares += (known * maps**2).sum(axis=(1, 2))[:, None, None]
        squares /= np.maximum(weight, 1.0)[:, None, None]
        squares[weight == 0] = np.inf
        flat = squares.transpose(1, 0, 2).reshape(spectra.shape[2], -1)
        at = flat.argmin(axis=1)
        distances = np.sqrt(np.maximum(np.take_along_axis(flat, at[:, None], axis=1)[:, 0], 0.0))
        return distances.astype(np.float32), at // self._config.sectors, at % self._config.sectors

    def _blocks(self, submaps: int) -> Iterator[slice]:
        step = max(1, _BLOCK_CELLS // (self._config.sectors * len(self._centres)))
        return (slice(start, start + step) for start in range(0, submaps, step))

    def _polar(self, rasters: Float32Array, centres: Float32Array) -> Float32Array:
        """Return (N, C, rings, sectors) the square roots of the heights that a beam can reach."""
        maps: Float32Array = _polar_of_rasters(
            np.ascontiguousarray(rasters, np.float32), centres, self._config.rings, self._config.sectors
        )
        reached: Float32Array = np.sqrt(np.minimum(maps, self._ceiling))
        return reached

    def _smoothed(self, maps: Float32Array) -> Float32Array:
        """Return maps (N, rings, sectors) averaged over their neighbours; the circle closes, the edge repeats."""
        reach = self._config.smooth
        around = np.stack([np.roll(maps, step, axis=2) for step in range(-reach, reach + 1)]).mean(axis=0)
        wide = np.pad(around, ((0, 0), (reach, reach), (0, 0)), mode="edge")
        rings = maps.shape[1]
        return np.asarray(np.stack([wide[:, k : k + rings] for k in range(2 * reach + 1)]).mean(axis=0), np.float32)


def known_cells(maps: Float32Array) -> Float32Array:
    """Return (N, rings, sectors) 1 where a scan observes the height: a hit, or free before the sector's first hit."""
    hit = maps > 0
    first = np.where(hit.any(axis=1), hit.argmax(axis=1), 0)  # a sector without a hit observes nothing
    before = np.arange(maps.shape[1])[None, :, None] < first[:, None, :]
    return np.asarray(hit | before, np.float32)


def polar_maxima(points: Float32Array, rings: int, sectors: int) -> Float32Array:
    """Return (rings, sectors) the greatest height of the points (n, 3) in each cell around the origin; 0 = nothing.

    Sectors counter-clockwise from x; points beyond the unit circle do not count.
    """
    centre = np.zeros((1, 2), np.float32)
    around: Float32Array = _polar_of_points(np.ascontiguousarray(points, np.float32), centre, rings, sectors)[0]
    return around


def _spectra(maps: Float32Array) -> Complex64Array:
    """Return the transforms along the sectors (F, rings, N) of maps (N, rings, sectors)."""
    transformed = np.fft.rfft(maps, axis=2).astype(np.complex64)
    return np.ascontiguousarray(transformed.transpose(2, 1, 0))


@njit(cache=True, nogil=True)
def _raster(points: Float32Array, cells: int) -> Float32Array:
    raster = np.zeros((cells, cells), np.float32)
    for i in range(len(points)):
        column = min(cells - 1, max(0, int((points[i, 0] + 1.0) * 0.5 * cells)))
        row = min(cells - 1, max(0, int((points[i, 1] + 1.0) * 0.5 * cells)))
        raster[row, column] = max(raster[row, column], points[i, 2])
    return raster


@njit(cache=True, nogil=True)
def _polar_of_points(points: Float32Array, centres: Float32Array, rings: int, sectors: int) -> Float32Array:
    polar = np.zeros((len(centres), rings, sectors), np.float32)
    for k in range(len(centres)):
        for i in range(len(points)):
            x, y, z = points[i, 0] - centres[k, 0], points[i, 1] - centres[k, 1], points[i, 2]
            ring = int(np.sqrt(x * x + y * y) * rings)
            if ring < rings:
                revolutions = np.arctan2(y, x) / (2.0 * np.pi)
                sector = int(np.floor(revolutions * sectors)) % sectors
                polar[k, ring, sector] = max(polar[k, ring, sector], z)
    return polar


@njit(cache=True, nogil=True)
def _polar_of_rasters(rasters: Float32Array, centres: Float32Array, rings: int, sectors: int) -> Float32Array:
    """Return (N, C, rings, sectors): each cell that holds something is a point in its middle."""
    count, cells, _ = rasters.shape
    polar = np.zeros((count, len(centres), rings, sectors), np.float32)
    points = np.empty((cells * cells, 3), np.float32)
    for n in range(count):
        found = 0
        for row in range(cells):
            for column in range(cells):
                if rasters[n, row, column] > 0.0:
                    points[found, 0] = (column + 0.5) / cells * 2.0 - 1.0
                    points[found, 1] = (row + 0.5) / cells * 2.0 - 1.0
                    points[found, 2] = rasters[n, row, column]
                    found += 1
        polar[n] = _polar_of_points(points[:found], centres, rings, sectors)
    return polar
