"""Augmentation: a place differs each time that it is drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.types import Float32Array

_HEADING_MARGIN = 1.25
"""How far beyond half the step between two headings the weights learn to follow."""
_THING_RADIUS_M = (1.0, 6.0)  # cars, huts and trees that come or go (`TrainConfig.changes`)
_THING_HEIGHT_M = (1.5, 12.0)  # of the same
_THING_POINTS = (20, 300)  # of the same, in a survey
_PAPER_DROP = 0.1  # this and the following: the published recipe, see `paper_cloud` and `paper_batch`
_PAPER_SHIFT = 0.01
_PAPER_CUBOID_SHARE = 0.4
_PAPER_CUBOID_AREA = (0.02, 0.33)
_PAPER_ASPECT = (0.3, 1.0 / 0.3)
_PAPER_TURN_RAD = math.radians(5.0)
_PAPER_MIRROR_SHARE = 0.25


def occlude(points: Float32Array, rng: np.random.Generator, config: TrainConfig) -> Float32Array:
    """Return a copy without some of the points: dropouts, and at times a sector that something large blocks."""
    kept = rng.random(len(points)) < rng.uniform(config.keep_points, 1.0)
    if rng.random() < config.sector_share:
        bearing = np.arctan2(points[:, 1], points[:, 0])
        width = rng.uniform(0.0, math.pi / 2.0)
        kept &= np.mod(bearing - rng.uniform(0.0, 2.0 * math.pi), 2.0 * math.pi) >= width
    return points[kept]


def heading_error(rng: np.random.Generator, config: TrainConfig) -> float:
    """Return the rotation of a scan against its submap, radians.

    One heading: any angle, so that the weights learn to be invariant. Several: within one of the rotated queries.
    """
    most = math.pi if config.headings == 1 else _HEADING_MARGIN * math.pi / config.headings
    return float(rng.uniform(-most, most))


def change(points: Float32Array, half_extent_m: float, rng: np.random.Generator, config: TrainConfig) -> Float32Array:
    """Return the points (n, 3) of a place, in metres, as another day and another sensor would have them.

    Fewer of them, each a little displaced, some things gone and others come: what a survey years old, flown with
    another density, never shares with a scan of today. `config` sets how much of each.
    """
    kept = rng.random(len(points)) < rng.uniform(config.keep_survey, 1.0)
    for _ in range(rng.poisson(config.changes)):
        middle = rng.uniform(-half_extent_m, half_extent_m, 2)
        kept &= np.hypot(*(points[:, :2] - middle).T) > rng.uniform(*_THING_RADIUS_M)
    parts = [points[kept]]
    for _ in range(rng.poisson(config.changes)):
        count = int(rng.integers(*_THING_POINTS))
        radius, top = rng.uniform(*_THING_RADIUS_M), rng.uniform(*_THING_HEIGHT_M)
        middle = rng.uniform(-half_extent_m, half_extent_m, 2)
        thing = np.column_stack([rng.normal(middle, 0.5 * radius, (count, 2)), rng.uniform(0.0, top, count)])
        parts.append(thing.astype(np.float32))
    changed = np.concatenate(parts)
    if config.displacement_m > 0.0:
        sigma = rng.uniform(0.0, config.displacement_m)
        changed = changed + rng.normal(0.0, sigma, changed.shape).astype(np.float32)
        changed[:, 2] += np.float32(rng.normal(0.0, config.displacement_m))
    return changed


def paper_cloud(points: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Return a patch (n, 3) as the published recipe changes each cloud.

    Up to 10 % of the points dropped, a translation of 0.01 (standard deviation, patch units), and with probability
    0.4 an upright cuboid emptied, of 2 to 33 % of the area and sides of 1:3.3 at most.
    """
    kept = rng.random(len(points)) >= rng.uniform(0.0, _PAPER_DROP)
    if rng.random() < _PAPER_CUBOID_SHARE:
        kept &= ~_in_cuboid(points, rng)
    if not kept.any():  # all of it in one corner
        kept[:] = True
    return points[kept] + rng.normal(0.0, _PAPER_SHIFT, 3).astype(np.float32)


def paper_batch(
    sides: Sequence[list[Float32Array]], rng: np.random.Generator
) -> tuple[list[Float32Array], list[Float32Array]]:
    """Return scans and submaps as the published recipe changes a batch: all alike.

    Rotated about z by up to 5 degrees, mirrored in x and in y with probability 1/4 each.
    """
    angle = float(rng.uniform(-_PAPER_TURN_RAD, _PAPER_TURN_RAD))
    signs = np.ones(3, np.float32)
    signs[:2] -= 2.0 * (rng.random(2) < _PAPER_MIRROR_SHARE)
    scans, submaps = ([rotate_about_z(points, angle) * signs for points in clouds] for clouds in sides)
    return scans, submaps


def _in_cuboid(points: Float32Array, rng: np.random.Generator) -> np.ndarray:
    """Return which points lie in a random upright cuboid over the square that the cloud covers."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    share = rng.uniform(*_PAPER_CUBOID_AREA)
    aspect = math.exp(rng.uniform(*np.log(_PAPER_ASPECT)))
    sides = np.minimum((high - low) * np.sqrt([share * aspect, share / aspect]), high - low)
    corner = low + rng.random(2) * (high - low - sides)
    inside: np.ndarray = ((points[:, :2] >= corner) & (points[:, :2] <= corner + sides)).all(axis=1)
    return inside
