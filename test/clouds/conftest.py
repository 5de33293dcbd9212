"""A small world of slopes, boxes and one VLP-16 in it, with the truth beside every point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

SENSOR_HEIGHT_M = 1.2
Array = npt.NDArray[np.float64]
Terrain = Callable[[Array, Array], Array]
Box = tuple[float, float, float, float, float]
"""centre x, centre y, length in x, width in y, height above the ground at its centre; the walls reach far down."""


@dataclass(frozen=True)
class Cast:
    """One revolution in the levelled base frame."""

    points: npt.NDArray[np.float32]
    height_m: Array
    """(N,) true height above the terrain."""
    on_ground: npt.NDArray[np.bool_]


def cast_vlp16(
    terrain: Terrain,
    boxes: Sequence[Box] = (),
    *,
    columns: int = 1800,
    max_range_m: float = 100.0,
    noise_m: float = 0.02,
    tilt: Array | None = None,
) -> Cast:
    """Cast 16 rings from 1.2 m above the terrain at the origin; `tilt` (3, 3) rotates the sensor, not the result."""
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    elevation = np.radians(np.arange(-15, 16, 2))
    a, e = (v.ravel() for v in np.meshgrid(azimuth, elevation, indexing="ij"))
    rays = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    if tilt is not None:
        rays = rays @ tilt.T
    z0 = float(terrain(np.zeros(1), np.zeros(1))[0])
    origin = np.array([0.0, 0.0, z0 + SENSOR_HEIGHT_M])

    ground = np.full(len(rays), np.inf)
    open_rays = np.arange(len(rays))
    near = np.full(len(rays), 0.5)
    for far in np.geomspace(0.6, max_range_m, 160):
        at = origin + far * rays[open_rays]
        hit = at[:, 2] < terrain(at[:, 0], at[:, 1])
        struck = open_rays[hit]
        low, high = near[struck], np.full(len(struck), far)
        for _ in range(25):
            middle = (low + high) / 2
            p = origin + middle[:, None] * rays[struck]
            under = p[:, 2] < terrain(p[:, 0], p[:, 1])
            low, high = np.where(under, low, middle), np.where(under, middle, high)
        ground[struck] = high
        open_rays = open_rays[~hit]
        near[open_rays] = far

    nearest = ground.copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        for x, y, length, width, height in boxes:
            base = float(terrain(np.array([x]), np.array([y]))[0])
            lower = np.array([x - length / 2, y - width / 2, base - 20.0])
            upper = np.array([x + length / 2, y + width / 2, base + height])
            t0, t1 = (lower - origin) / rays, (upper - origin) / rays
            enter, leave = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
            hit = (enter < leave) & (enter > 0.3)
            nearest[hit] = np.minimum(nearest[hit], enter[hit])
    seen = nearest < max_range_m
    distance = nearest[seen] + np.random.default_rng(1).normal(0, noise_m, int(seen.sum()))
    points = origin + distance[:, None] * rays[seen]
    height = points[:, 2] - terrain(points[:, 0], points[:, 1])
    points[:, 2] -= z0  # the base stands at z = 0
    return Cast(points.astype(np.float32), height, ground[seen] <= nearest[seen])


@pytest.fixture(scope="session")
def cast() -> Callable[..., Cast]:
    """Give the caster."""
    return cast_vlp16
