"""The evidence of the last scans, brought together along odometry: a local map that is aligned as one scan is.

A street with a twin is told apart by what came before it, a parked lorry hides what the scan before has seen, and a
sparse sensor fills its gaps as it moves. So a scan is kept every few metres, moved along by odometry into the frame of
the newest, and the scans that saw a cell are counted: a cell where some share of them hit something is a hit, so that
what drives by does not stay.

A scan that contradicts what was seen before tells that the robot was carried away, or that the odometry is wrong: what
was before is forgotten.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numba import njit

from crossloc3d_ros.localization.alignment.evidence import CELL_M, CHANNELS, LAYERS, REACH_M, Evidence
from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array, UInt8Array

SPACING_M = 2.0
"""One scan is kept every so many metres."""
_HIT_SHARE = 0.25  # of the scans that saw a cell: beams pass beside a trunk or through a hedge more often than not
_LEAST_AGREEMENT = 0.85  # on a way of its own a scan has 0.92 and more, on another one mostly 0.3
_LEAST_COMPARED = 50  # cells that a scan hit and others saw: of fewer, their share says nothing
_HALF = math.ceil(REACH_M / CELL_M)  # what lies farther away is left out: around a place, maps are prepared so far


class LocalMap:
    """Keep the evidence of the scans along the last metres."""

    def __init__(self, length_m: float) -> None:
        """Keep the scans of the last `length_m` metres; 0 = none."""
        self.length_m = length_m
        self.clear()

    def clear(self) -> None:
        """Forget all scans."""
        self._scans: deque[Evidence] = deque()
        self._poses = np.empty((0, 3))  # of the kept scans, in the frame of the newest: metres, radians
        self._ago_m: deque[float] = deque()

    @property
    def extent_m(self) -> float:
        """Distance driven since the oldest scan that is kept, metres."""
        return self._ago_m[0] if self._ago_m else 0.0

    def move(self, delta: Float64Array | None) -> None:
        """Move on by the motion (3,) since the last scan: forward, left, metres, and a turn, radians.

        None, an unknown motion, forgets all scans.
        """
        if delta is None:
            self.clear()
            return
        distance_m = math.hypot(delta[0], delta[1])
        self._ago_m = deque(ago + distance_m for ago in self._ago_m)
        while self._ago_m and self._ago_m[0] > self.length_m:
            self._ago_m.popleft()
            self._scans.popleft()
            self._poses = self._poses[1:]
        c, s = math.cos(delta[2]), math.sin(delta[2])
        moved = (self._poses[:, :2] - delta[:2]) @ np.array([[c, -s], [s, c]])
        self._poses = np.column_stack([moved, self._poses[:, 2] - delta[2]])

    def add(self, evidence: Evidence) -> Evidence:
        """Return the evidence of a scan and of those before it, in its frame; keep the scan where one is due."""
        together = evidence
        if self._scans:
            counts = np.zeros((CHANNELS, 2 * _HALF, 2 * _HALF), np.uint8)
            for before, pose in zip(self._scans, self._poses, strict=True):
                _count(counts, before, pose)
            if self._agreement(counts, evidence) < _LEAST_AGREEMENT:
                self.clear()
            else:
                _count(counts, evidence, np.zeros(3))
                together = _evidence_of(counts)
        if self.length_m > 0.0 and (not self._scans or self._ago_m[-1] >= SPACING_M):
            self._scans.append(evidence)
            self._poses = np.concatenate([self._poses, np.zeros((1, 3))])
            self._ago_m.append(0.0)
        return together

    def _agreement(self, counts: UInt8Array, evidence: Evidence) -> float:
        """Return which share of a scan's hits, where others saw something, they hit too, in the cell or beside it.

        1 where there is too little to compare.
        """
        hits = _decided(counts, LAYERS, _HIT_SHARE)
        same, other = _compared(hits, evidence.xy_m, evidence.channel, LAYERS, _HALF, CELL_M)
        return same / (same + other) if same + other >= _LEAST_COMPARED else 1.0


def _count(counts: UInt8Array, evidence: Evidence, pose: Float64Array) -> None:
    """Add a scan's evidence at a pose (3,) to how many scans saw each cell (CHANNELS, 2 half, 2 half)."""
    _lay(counts, np.ascontiguousarray(evidence.xy_m), evidence.channel, np.ascontiguousarray(pose), _HALF, CELL_M)


def _evidence_of(counts: UInt8Array) -> Evidence:
    channel, row, column = np.nonzero(_decided(counts, LAYERS, _HIT_SHARE))
    xy = (np.column_stack([column, row]) + 0.5 - _HALF) * CELL_M
    near = np.hypot(xy[:, 0], xy[:, 1]) <= REACH_M + CELL_M
    return Evidence(xy[near], channel[near].astype(np.int64))


@njit(cache=True, nogil=True)
def _lay(counts: UInt8Array, xy: Float64Array, channel: Int64Array, pose: Float64Array, half: int, cell: float) -> None:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for e in range(len(channel)):
        column = math.floor((pose[0] + c * xy[e, 0] - s * xy[e, 1]) / cell) + half
        row = math.floor((pose[1] + s * xy[e, 0] + c * xy[e, 1]) / cell) + half
        if 0 <= row < 2 * half and 0 <= column < 2 * half and counts[channel[e], row, column] < 255:
            counts[channel[e], row, column] += 1


@njit(cache=True, nogil=True)
def _decided(counts: UInt8Array, layers: int, hit_share: float) -> BoolArray:
    """Return (CHANNELS, H, W) what each cell is, from how many scans hit it and how many saw it free."""
    found = np.zeros(counts.shape, np.bool_)
    for layer in range(layers):
        for row in range(counts.shape[1]):
            for column in range(counts.shape[2]):
                hits, free = np.int64(counts[layer, row, column]), np.int64(counts[layers + layer, row, column])
                if hits + free:
                    found[layer + (0 if hits >= hit_share * (hits + free) else layers), row, column] = True
    return found


@njit(cache=True, nogil=True)
def _compared(
    found: BoolArray, xy: Float64Array, channel: Int64Array, layers: int, half: int, cell: float
) -> tuple[int, int]:
    """Return how many hits fall on or beside a hit, and on free space far from any."""
    same, other = 0, 0
    for e in range(len(channel)):
        if channel[e] >= layers:
            continue
        column, row = math.floor(xy[e, 0] / cell) + half, math.floor(xy[e, 1] / cell) + half
        if not (1 <= row < 2 * half - 1 and 1 <= column < 2 * half - 1):
            continue
        near = False
        for i in range(-1, 2):
            for j in range(-1, 2):
                near = near or found[channel[e], row + i, column + j]
        if near:
            same += 1
        elif found[layers + channel[e], row, column]:
            other += 1
    return same, other
