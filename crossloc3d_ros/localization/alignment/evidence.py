"""The evidence of a scan: the cells that its beams hit, and the free space that they passed through.

Space is divided into cells of a horizontal grid and into layers of height above the ground. A beam that ends in a layer
of a cell is a hit there; one that passes through it and ends farther away shows free space. Both are evidence: a hit is
likely where something stands on the map, free space where nothing does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

LAYERS_M = np.array([0.5, 1.5, 3.0, 6.0, 50.0], np.float32)
"""(L + 1,) heights above the ground between which the L layers lie: thinner near the ground, where robots see most."""
LAYERS = len(LAYERS_M) - 1
CHANNELS = 2 * LAYERS
"""Hits of each layer, then free space of each."""
CELL_M = 1.0
"""As the rasters of most surveys."""
REACH_M = 100.0
"""Range within which most lidars of robots hit anything."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """The cells that a scan hit or passed through, each once a channel."""

    xy_m: Float64Array
    """(n, 2) middles of the cells, metres from the base, x along the robot's heading, y to its left."""
    channel: Int64Array
    """(n,) which of the `CHANNELS`."""

    def __len__(self) -> int:
        return len(self.channel)

    def coarser(self, cell_m: float, max_hits: int, max_free: int) -> Evidence:
        """Return the evidence in cells of `cell_m`, free space in blocks of 2 x 2 of them; at most so many of each.

        A block is free where beams passed through half of its cells or more. Which are left out, where there are more,
        is random, and the same at each call.
        """
        hits = _unique_cells(self.xy_m, self.channel, self.channel < LAYERS, cell_m, cell_m, 1)
        free = _unique_cells(self.xy_m, self.channel, self.channel >= LAYERS, cell_m, 2.0 * cell_m, 2)
        parts = [_sample(*hits, max_hits), _sample(*free, max_free)]
        return Evidence(np.concatenate([xy for xy, _ in parts]), np.concatenate([channel for _, channel in parts]))

    def sample(self, max_hits: int, max_free: int) -> Evidence:
        """Return at most so many hits and free cells of the evidence: random ones, the same at each call."""
        is_hit = self.channel < LAYERS
        parts = [
            _sample(self.xy_m[which], self.channel[which], most)
            for which, most in ((is_hit, max_hits), (~is_hit, max_free))
        ]
        return Evidence(np.concatenate([xy for xy, _ in parts]), np.concatenate([channel for _, channel in parts]))

    def counts(self) -> Int64Array:
        """Return (CHANNELS,) how many cells there are of each channel."""
        return np.bincount(self.channel, minlength=CHANNELS).astype(np.int64)


def evidence_of(place: Float32Array, sensor_height_m: float, sensor_xy_m: tuple[float, float] = (0.0, 0.0)) -> Evidence:
    """Return the evidence of a prepared scan.

    `place` (N, 3): x, y from the sensor along the robot's heading, z above the ground, metres, as
    `clouds.scan.prepare_scan` gives it. `sensor_xy_m`: where the sensor is on the base. What lies farther from the base
    than `REACH_M` is left out: around a place, maps are prepared so far.
    """
    half = math.ceil(REACH_M / CELL_M)
    seen = _seen(np.ascontiguousarray(place, np.float32), np.float32(sensor_height_m), LAYERS_M, half, CELL_M)
    channel, row, column = np.nonzero(seen)
    cells = np.column_stack([column, row]).astype(np.float64)
    xy = (cells + 0.5 - half) * CELL_M + np.asarray(sensor_xy_m)
    near = np.hypot(xy[:, 0], xy[:, 1]) <= REACH_M + CELL_M
    return Evidence(xy[near], channel[near].astype(np.int64))


def evidence_of_scan(prepared: PreparedScan, T_base_lidar: Float64Array) -> Evidence:
    """Return the evidence of a prepared scan of a lidar that is mounted at `T_base_lidar` (4, 4)."""
    sensor_xy_m = float(T_base_lidar[0, 3]), float(T_base_lidar[1, 3])
    return evidence_of(prepared.place, prepared.sensor_height_m, sensor_xy_m)


@njit(cache=True, nogil=True)
def _seen(place: Float32Array, sensor_height: float, layers: Float32Array, half: int, cell: float) -> np.ndarray:
    """Return (2 L, 2 half, 2 half) uint8 1 where a channel was seen; a cell that was hit is not free."""
    count = len(layers) - 1
    cells = 2 * half
    seen = np.zeros((2 * count, cells, cells), np.uint8)
    inverse = np.float32(1.0 / cell)
    for i in range(place.shape[0]):
        x, y, z = place[i, 0], place[i, 1], place[i, 2]
        away = math.sqrt(x * x + y * y)
        if not (away >= 1.0 and away < 1e4 and abs(z) < 1e4):
            continue
        # The last metre before a hit does not count as free: range noise, and walls that are not vertical.
        steps = min(int((away - 1.0) * inverse), 2 * half)
        du, dv, dz = x / away, y / away, (z - sensor_height) / away * cell
        height = sensor_height
        layer = 0
        for step in range(1, steps + 1):
            height += dz
            if height < layers[0] or height >= layers[count]:
                continue
            while height >= layers[layer + 1]:
                layer += 1
            while height < layers[layer]:
                layer -= 1
            column, row = math.floor(du * step) + half, math.floor(dv * step) + half
            if 0 <= column < cells and 0 <= row < cells:
                seen[count + layer, row, column] = 1
    for i in range(place.shape[0]):
        x, y, z = place[i, 0], place[i, 1], place[i, 2]
        inside = abs(x) < half * cell and abs(y) < half * cell and z >= layers[0] and z < layers[count]
        if not inside or x * x + y * y < 1.0:
            continue
        layer = 0
        while z >= layers[layer + 1]:
            layer += 1
        column, row = math.floor(x * inverse) + half, math.floor(y * inverse) + half
        if 0 <= column < cells and 0 <= row < cells:
            seen[layer, row, column] = 1
            seen[count + layer, row, column] = 0
    return seen


def _unique_cells(
    xy_m: Float64Array,
    channel: Int64Array,
    which: np.ndarray,
    cell_m: float,
    block_m: float,
    least: int,
) -> tuple[Float64Array, Int64Array]:
    """Return middles (m, 2) and channels (m,) of the blocks that hold at least `least` of the cells."""
    cells = np.floor(xy_m[which] / cell_m).astype(np.int64)
    keys = _key(channel[which], cells)
    _, first = np.unique(keys, return_index=True)
    cells, layers = cells[first], channel[which][first]
    ratio = round(block_m / cell_m)
    blocks = cells // ratio
    _, first, counts = np.unique(_key(layers, blocks), return_index=True, return_counts=True)
    kept = first[counts >= least]
    return (blocks[kept] + 0.5) * block_m, layers[kept]


def _key(channel: Int64Array, cells: Int64Array) -> Int64Array:
    return (channel << 40) | ((cells[:, 1] + (1 << 19)) << 20) | (cells[:, 0] + (1 << 19))


def _sample(xy_m: Float64Array, channel: Int64Array, most: int) -> tuple[Float64Array, Int64Array]:
    if len(channel) <= most:
        return xy_m, channel
    chosen = np.sort(np.random.default_rng(0).permutation(len(channel))[:most])
    return xy_m[chosen], channel[chosen]
