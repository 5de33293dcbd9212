"""What a scan says about the ground plan around it: where its beams were returned, and what they passed through.

Everything is cut into cells of a horizontal grid and into layers of height above the ground. A beam that returned
from a layer of a cell is a return there; one that flew through it and returned from farther away is a passage. Both
are evidence: a return asks for something that stands there, a passage refutes what the map has there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

LAYERS_M = np.array([0.5, 1.5, 3.0, 6.0, 50.0], np.float32)
"""(L + 1,) heights above the ground between which the L layers lie."""
LAYERS = len(LAYERS_M) - 1
CHANNELS = 2 * LAYERS
"""Returns of each layer, then passages of each."""
CELL_M = 1.0
REACH_M = 100.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """The cells that a scan saw, each once a channel."""

    xy_m: Float64Array
    """(n, 2) middles of the cells, metres from the base, x along the robot's heading, y to its left."""
    channel: Int64Array
    """(n,) which of the `CHANNELS`."""

    def __len__(self) -> int:
        return len(self.channel)

    def coarser(self, cell_m: float, most_returns: int, most_passages: int) -> Evidence:
        """Return the evidence in cells of `cell_m`, the passages in blocks of 2 x 2 of them; at most so many of each.

        A block counts where beams passed through half of its cells or more. Which are left out, where there are more,
        is drawn by lot, the same at each call.
        """
        returns = _unique_cells(self.xy_m, self.channel, self.channel < LAYERS, cell_m, cell_m, 1)
        passages = _unique_cells(self.xy_m, self.channel, self.channel >= LAYERS, cell_m, 2.0 * cell_m, 2)
        parts = [_some(*returns, most_returns), _some(*passages, most_passages)]
        return Evidence(np.concatenate([xy for xy, _ in parts]), np.concatenate([channel for _, channel in parts]))

    def some(self, most_returns: int, most_passages: int) -> Evidence:
        """Return the evidence with at most so many returns and passages, drawn by lot, the same at each call."""
        is_return = self.channel < LAYERS
        parts = [
            _some(self.xy_m[which], self.channel[which], most)
            for which, most in ((is_return, most_returns), (~is_return, most_passages))
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


@njit(cache=True, nogil=True)
def _seen(place: Float32Array, sensor_height: float, layers: Float32Array, half: int, cell: float) -> np.ndarray:
    """Return (2 L, 2 half, 2 half) uint8 1 where a channel was seen; a cell with a return is no passage as well."""
    count = len(layers) - 1
    cells = 2 * half
    seen = np.zeros((2 * count, cells, cells), np.uint8)
    inverse = np.float32(1.0 / cell)
    for i in range(place.shape[0]):
        x, y, z = place[i, 0], place[i, 1], place[i, 2]
        away = math.sqrt(x * x + y * y)
        if not (away >= 1.0 and away < 1e4 and abs(z) < 1e4):
            continue
        # The last metre before a return is left to it: range noise, and walls that are not vertical.
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
        if not (abs(x) < half * cell and abs(y) < half * cell and z >= layers[0] and z < layers[count]):
            continue
        if x * x + y * y < 1.0:
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


def _some(xy_m: Float64Array, channel: Int64Array, most: int) -> tuple[Float64Array, Int64Array]:
    if len(channel) <= most:
        return xy_m, channel
    chosen = np.sort(np.random.default_rng(0).permutation(len(channel))[:most])
    return xy_m[chosen], channel[chosen]
