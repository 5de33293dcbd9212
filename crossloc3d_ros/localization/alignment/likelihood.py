"""The aerial map as what a scan is compared with: classes of 1 m cells, and log likelihood ratios in coarser ones.

In a coarse cell a hit is as likely as in the likeliest of its fine cells, because a wall fills only a part of it; free
space is averaged. So the right pose loses little from fine to coarse, and a search that begins on the coarse level
rarely misses it.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.raster import Bounds, Raster
from crossloc3d_ros.localization.alignment.evidence import CELL_M, CHANNELS, LAYERS, REACH_M
from crossloc3d_ros.localization.alignment.observation_model import (
    MARGIN_CELLS,
    UNKNOWN,
    ObservationModel,
    surface_classes,
)
from crossloc3d_ros.types import BoolArray, Float32Array, Int32Array

Int16Array = npt.NDArray[np.int16]
UInt16Array = npt.NDArray[np.uint16]

LEVELS_M = (4.0, 2.0)
"""Cells of the levels: the whole map in the first takes seconds, candidates in both some tens of milliseconds."""
QUANTA = 8.0
"""Numbers of a level in one nat."""
_MARGIN_M = REACH_M + 12.0  # around the map: evidence, a sensor beside the base, and the cells of a level
_TILE_M = 256  # read at once: a multiple of all cells, some milliseconds each


@dataclass(frozen=True, eq=False)
class Level:
    """Log likelihood ratios in coarse cells."""

    cell_m: float
    ratios: Int16Array
    """(CHANNELS, H, W) in `QUANTA` a nat; free space of the 2 x 2 cells whose lower left is this one."""


class MapLikelihood:
    """An aerial map as far as scans were compared with it; other parts are read on demand.

    Row 0 is the south here, so that rows and columns grow with northing and easting.
    """

    def __init__(self, aerial_map: AerialMap, model: ObservationModel) -> None:
        """Reserve the memory; it is taken from the system where `prepare` fills it."""
        self.aerial_map, self.model = aerial_map, model
        west, south, east, north = aerial_map.bounds
        self.west_m, self.south_m = math.floor(west) - _MARGIN_M, math.floor(south) - _MARGIN_M
        columns = math.ceil((east + _MARGIN_M - self.west_m) / _TILE_M) * _TILE_M
        rows = math.ceil((north + _MARGIN_M - self.south_m) / _TILE_M) * _TILE_M
        self._terrain: Float32Array = np.zeros((rows, columns), np.float32)
        self.classes: UInt16Array = np.zeros((rows, columns), np.uint16)
        self.levels = tuple(
            Level(cell, np.zeros((CHANNELS, int(rows / cell), int(columns / cell)), np.int16)) for cell in LEVELS_M
        )
        self._filled: BoolArray = np.zeros((rows // _TILE_M, columns // _TILE_M), np.bool_)
        self._lock = threading.Lock()

    def prepare(self, bounds: Bounds | None = None) -> None:
        """Fill what scans from inside of `bounds` see (min easting, min northing, max ...; None = all the map)."""
        west, south, east, north = self.aerial_map.bounds if bounds is None else bounds
        rows = self._tiles(south - _MARGIN_M - self.south_m, north + _MARGIN_M - self.south_m, 0)
        columns = self._tiles(west - _MARGIN_M - self.west_m, east + _MARGIN_M - self.west_m, 1)
        if self._filled[rows, columns].all():
            return
        with self._lock:
            for row in range(rows.start, rows.stop):
                for column in range(columns.start, columns.stop):
                    if not self._filled[row, column]:
                        self._fill(row * _TILE_M, column * _TILE_M)
                        self._filled[row, column] = True

    def terrain_height(self, easting: float, northing: float) -> float:
        """Return the height of the terrain in the cell that holds a place, metres; NaN where it is not known."""
        y, x = northing - self.south_m, easting - self.west_m
        if not (0.0 <= y < self._terrain.shape[0] and 0.0 <= x < self._terrain.shape[1]):
            return math.nan
        return float(self._terrain[int(y), int(x)])

    def _tiles(self, low_m: float, high_m: float, axis: int) -> slice:
        count = self._filled.shape[axis]
        first = min(max(math.floor(low_m / _TILE_M), 0), count - 1)
        return slice(first, min(max(math.ceil(high_m / _TILE_M), first + 1), count))

    def _fill(self, row: int, column: int) -> None:
        """Fill one tile of all levels; the coarse ones depend on a cell beyond it."""
        reach = MARGIN_CELLS + int(LEVELS_M[0])
        terrain, surface, lowest = self._heights(row - reach, column - reach, _TILE_M + 2 * reach)
        classes = surface_classes(terrain, surface, lowest)
        inner = slice(reach, reach + _TILE_M)
        self._terrain[row : row + _TILE_M, column : column + _TILE_M] = terrain[inner, inner]
        self.classes[row : row + _TILE_M, column : column + _TILE_M] = classes[inner, inner]
        wide = classes[reach : reach + _TILE_M + int(LEVELS_M[0]), reach : reach + _TILE_M + int(LEVELS_M[0])]
        for level in self.levels:
            cell, tile = int(level.cell_m), _TILE_M // int(level.cell_m)
            ratios = coarse_ratios(self.model.search_ratios, wide, cell)[:, :tile, :tile]
            r, c = row // cell, column // cell
            level.ratios[:, r : r + tile, c : c + tile] = ratios

    def _heights(self, row: int, column: int, cells: int) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Return terrain, surface and lowest echoes (cells, cells), row 0 in the south, NaN off the map."""
        west, south = self.west_m + column * CELL_M, self.south_m + row * CELL_M
        bounds = (west, south, west + cells * CELL_M, south + cells * CELL_M)
        low_e, low_n, high_e, high_n = self.aerial_map.bounds
        if bounds[0] >= high_e or bounds[2] <= low_e or bounds[1] >= high_n or bounds[3] <= low_n:
            nothing = np.full((cells, cells), np.nan, np.float32)
            return nothing, nothing, nothing
        inside = (max(bounds[0], low_e), max(bounds[1], low_n), min(bounds[2], high_e), min(bounds[3], high_n))
        middles = (np.arange(cells) + 0.5) * CELL_M
        terrain = self.aerial_map.terrain(inside).sample(*np.meshgrid(west + middles, south + middles))
        surface, lowest = self.aerial_map.surface(inside), self.aerial_map.lowest(inside)
        return terrain, _extreme(surface, np.fmax, west, south, cells), _extreme(lowest, np.fmin, west, south, cells)


def _extreme(raster: Raster, chosen: np.ufunc, west: float, south: float, cells: int) -> Float32Array:
    """Return (cells, cells) of a raster, row 0 in the south; of finer cells the extreme one, as one of 1 m would."""
    parts = max(math.ceil(CELL_M / raster.cell_m - 1e-6), 1)
    finer = (np.arange(parts * cells) + 0.5) * (CELL_M / parts)
    heights = raster.nearest(*np.meshgrid(west + finer, south + finer)).reshape(cells, parts, cells, parts)
    extreme: Float32Array = chosen.reduce(chosen.reduce(heights, axis=3), axis=1)
    return extreme


def coarse_ratios(log_ratios: Float32Array, classes: Int32Array, cell: int) -> Int16Array:
    """Return (CHANNELS, H // cell, W // cell) of classes (H, W): hits by the likeliest, free space of 2 x 2 cells."""
    rows, columns = classes.shape[0] // cell, classes.shape[1] // cell
    blocks = classes[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    out = np.empty((CHANNELS, rows, columns), np.float32)
    for channel in range(CHANNELS):
        values = log_ratios[channel][blocks]
        if channel < LAYERS:
            out[channel] = values.max(axis=(1, 3))
            out[channel][(blocks == UNKNOWN).all(axis=(1, 3))] = 0.0
        else:
            mean = values.mean(axis=(1, 3))
            around = np.pad(mean, ((0, 1), (0, 1)), mode="edge")
            out[channel] = mean + around[1:, :-1] + around[:-1, 1:] + around[1:, 1:]
    return np.rint(np.clip(out * QUANTA, -100, 100)).astype(np.int16)
