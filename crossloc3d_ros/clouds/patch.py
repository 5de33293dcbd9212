"""THE one normalisation: what a scan and an aerial submap have in common when they reach the encoder.

Crop, drop the ground, one point a cube, a seeded choice, divide by the half extent. Each point's place in the choice
is a hash of its cube and the seed, never of its position in the array, so that the patch is the same for every
order in which a sensor or a file happens to deliver the points.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numba import njit

from crossloc3d_ros.clouds.filters import check_points
from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.types import Float32Array, Patch

Origin = Literal["given", "mean", "bounding_box"]

_AXIS_BITS = 21  # three axes in one 64-bit key


@njit(cache=True, nogil=True)
def _mix(h: np.uint64) -> np.uint64:
    """Scramble 64 bits so that neighbouring keys share nothing (the finaliser of SplitMix64)."""
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@njit(cache=True, nogil=True)
def _crop(points: Float32Array, half_extent: float, z_low: float, z_high: float) -> Float32Array:
    """Return the points inside the box, in their order; NaN falls out of every comparison."""
    kept = np.empty_like(points)
    n = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if abs(x) <= half_extent and abs(y) <= half_extent and z >= z_low and z <= z_high:
            kept[n, 0] = x
            kept[n, 1] = y
            kept[n, 2] = z
            n += 1
    return kept[:n]


@njit(cache=True, nogil=True)
def _before(points: Float32Array, i: int, j: int) -> bool:
    """Order two points by their coordinates: the tie-break that no delivery order can change."""
    for axis in range(3):
        if points[i, axis] != points[j, axis]:
            return bool(points[i, axis] < points[j, axis])
    return False


@njit(cache=True, nogil=True)
def _one_a_cube(points: Float32Array, bits: np.ndarray, cube: float, seed: np.uint64):  # type: ignore[no-untyped-def]
    """Return, for each occupied cube, the index of one of its points and the cube's priority in the choice.

    `bits` is `points` seen as uint32. Without a cube (0) every point is its own cube.
    """
    n = points.shape[0]
    seed_hash = _mix(seed + np.uint64(0x9E3779B97F4A7C15))
    chosen = np.empty(n, np.int64)
    priority = np.empty(n, np.uint64)
    point_hash = np.empty(n, np.uint64)
    for i in range(n):
        h = _mix(seed_hash ^ np.uint64(bits[i, 0]) ^ (np.uint64(bits[i, 1]) << np.uint64(32)))
        point_hash[i] = _mix(h ^ np.uint64(bits[i, 2]))
    if cube <= 0.0:
        for i in range(n):
            chosen[i] = i
            priority[i] = point_hash[i]
        return chosen, priority

    size = 16
    while size < 2 * n:
        size *= 2
    slots = np.full(size, -1, np.int32)  # slot -> number of the cube
    keys = np.empty(n, np.uint64)  # cube -> key
    mask = np.uint64(size - 1)
    inverse = 1.0 / cube
    middle = np.int64(1 << (_AXIS_BITS - 1))
    m = 0
    for i in range(n):
        ix = np.uint64(np.int64(np.floor(points[i, 0] * inverse)) + middle)
        iy = np.uint64(np.int64(np.floor(points[i, 1] * inverse)) + middle)
        iz = np.uint64(np.int64(np.floor(points[i, 2] * inverse)) + middle)
        key = ix | (iy << np.uint64(_AXIS_BITS)) | (iz << np.uint64(2 * _AXIS_BITS))
        h = _mix(seed_hash ^ key)
        slot = h & mask
        while slots[slot] >= 0 and keys[slots[slot]] != key:
            slot = (slot + np.uint64(1)) & mask
        c = slots[slot]
        if c < 0:
            slots[slot] = m
            keys[m] = key
            chosen[m] = i
            priority[m] = h
            m += 1
        else:
            held = chosen[c]
            if point_hash[i] < point_hash[held] or (point_hash[i] == point_hash[held] and _before(points, i, held)):
                chosen[c] = i
    return chosen[:m], priority[:m]


def crop_above_ground(points: Float32Array, half_extent_m: float, config: PreprocessingConfig) -> Float32Array:
    """Return the points (M, 3) of a place that may enter its patch, in metres and in their order.

    Inside |x|, |y| <= `half_extent_m`; z, the height above the ground, from the clearance (0 keeps the ground and
    what lies below it) up to `half_extent_m`, so that nothing leaves [-1, 1] later. NaN and infinities are dropped.
    """
    z_low = config.ground_clearance_m if config.ground_clearance_m > 0 else -half_extent_m
    cropped: Float32Array = _crop(points, np.float32(half_extent_m), np.float32(z_low), np.float32(half_extent_m))
    return cropped


def choose_points(points: Float32Array, count: int, thin_m: float, seed: int) -> tuple[Float32Array, int]:
    """Return exactly `count` of the points (N, 3), one a cube of `thin_m`, and how many there were to choose from.

    With fewer cubes than `count` all are taken and repeated. N must not be 0.
    """
    widest = float(np.abs(points).max())
    cube = thin_m if widest < thin_m * (1 << (_AXIS_BITS - 1)) else 0.0  # finer than the key holds: nothing to thin
    chosen, priority = _one_a_cube(points, points.view(np.uint32), cube, np.uint64(seed))
    available = len(chosen)
    if available > count:
        best = np.argpartition(priority, count - 1)[:count]
        chosen, priority = chosen[best], priority[best]
    ordered = points[chosen[np.argsort(priority, kind="stable")]]
    if available < count:
        ordered = np.resize(ordered, (count, 3))
    return ordered, available


def make_patch(
    points: Float32Array, half_extent_m: float, config: PreprocessingConfig, *, origin: Origin = "given"
) -> Patch | None:
    """Make the patch of a place, or return None where fewer than `config.min_points` stand above the ground.

    Points (N, 3) float32: x and y from the centre, z above the local ground, metres. `origin` moves the cropped points
    onto their mean or the middle of their bounding box first. The same points, in any order, give the same patch.
    """
    check_points(points)
    points = np.ascontiguousarray(points, dtype=np.float32)
    return patch_of_cropped(crop_above_ground(points, half_extent_m, config), half_extent_m, config, origin=origin)


def patch_of_cropped(
    cropped: Float32Array, half_extent_m: float, config: PreprocessingConfig, *, origin: Origin = "given"
) -> Patch | None:
    """Make the patch of points (N, 3) float32 that `crop_above_ground` returned; None as in `make_patch`."""
    if len(cropped) < config.min_points:
        return None
    if origin != "given" or config.vertical_origin == "centre":
        cropped = _recentred(cropped, half_extent_m, config, origin)
        if len(cropped) < config.min_points:
            return None
    chosen, available = choose_points(cropped, config.n_points, config.thin_m, config.seed)
    return Patch(chosen / np.float32(half_extent_m), half_extent_m, available)


def rotate_about_z(points: Float32Array, angle_rad: float) -> Float32Array:
    """Return points (n, 3) rotated about z, counter-clockwise seen from above."""
    cosine, sine = np.float32(math.cos(angle_rad)), np.float32(math.sin(angle_rad))
    rotated = np.empty_like(points)
    rotated[:, 0] = cosine * points[:, 0] - sine * points[:, 1]
    rotated[:, 1] = sine * points[:, 0] + cosine * points[:, 1]
    rotated[:, 2] = points[:, 2]
    return rotated


def _recentred(points: Float32Array, half_extent_m: float, config: PreprocessingConfig, origin: Origin) -> Float32Array:
    """Move points onto the configured origin and crop what left the patch by it."""
    # Sums of a sorted column do not depend on the order of the points.
    mean = np.sort(points, axis=0).mean(axis=0, dtype=np.float64)
    middle = (points.min(axis=0).astype(np.float64) + points.max(axis=0)) / 2
    centre = mean if origin == "mean" else middle
    shift = np.zeros(3)
    if origin != "given":
        shift[:2] = centre[:2]
    if config.vertical_origin == "centre":
        shift[2] = centre[2]
    moved = (points - shift).astype(np.float32)
    inside: Float32Array = _crop(
        moved, np.float32(half_extent_m), np.float32(-half_extent_m), np.float32(half_extent_m)
    )
    return inside
