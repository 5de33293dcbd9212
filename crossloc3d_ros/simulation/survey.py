"""An airborne laser scan of a world, with the errors and classes that a delivered survey has.

`fly(world, config, rng)` returns the points of the world's bounds in local metres; `height_above_ground` gives them
over the true terrain, ready for `clouds.tiling.SubmapCutter`; `write_survey` writes LAZ tiles with the world's CRS.
A town of 600 x 600 m at 0.5 m takes about two seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.config import option
from crossloc3d_ros.simulation.scene import ASPRS_CLASS, Label, Scene
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Float32Array, Float64Array, UInt8Array

_RAYS_AT_ONCE = 400_000


@dataclass(frozen=True)
class SurveyConfig:
    """How the area is flown."""

    spacing_m: float = option(0.35, "distance between neighbouring pulses of one flight line", low=0.05, high=5.0)
    altitude_m: float = option(500.0, "above the ground", low=50.0, high=5000.0)
    scan_angle_deg: float = option(25.0, "to either side of the nadir", low=1.0, high=45.0)
    overlap: float = option(0.3, "share of a swath that its neighbour covers too", low=0.0, high=0.9)
    horizontal_error_m: float = option(0.1, "one sigma, two thirds of it common to a flight line", low=0.0, high=2.0)
    vertical_error_m: float = option(0.3, "one sigma, most of it common to a flight line", low=0.0, high=2.0)
    returns: int = option(4, "most returns of a pulse", low=1, high=15)
    heading_deg: float | None = option(None, "of the flight lines, from east counter-clockwise; none: random")
    water_return: float = option(0.08, "chance that water answers", low=0.0, high=1.0)


@dataclass(frozen=True, eq=False)
class Survey:
    """Points of an airborne survey."""

    points: Float64Array
    """(N, 3) local metres."""
    classification: UInt8Array
    """(N,) ASPRS: 1 unclassified (trees, cars, walls), 2 ground, 6 building, 9 water."""
    return_number: UInt8Array
    """(N,) from 1."""
    flight_line: UInt8Array
    """(N,) from 1."""

    def height_above_ground(self, world: World) -> Float64Array:
        """Return (N, 3) local x, y and the height above the world's terrain."""
        above = self.points.copy()
        above[:, 2] -= world.terrain_height(self.points)
        return above


def fly(
    world: World,
    config: SurveyConfig,
    rng: np.random.Generator,
    progress: Callable[[float], None] | None = None,
) -> Survey:
    """Scan the world's bounds from parallel flight lines; `progress` is called with the share done."""
    min_x, min_y, max_x, max_y = world.bounds
    centre = np.array([(min_x + max_x) / 2, (min_y + max_y) / 2])
    heading = rng.uniform(0, np.pi) if config.heading_deg is None else math.radians(config.heading_deg)
    forward = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-forward[1], forward[0]])
    half = np.array([max_x - min_x, max_y - min_y]) / 2
    reach_along = float(half @ np.abs(forward))
    reach_across = float(half @ np.abs(left))
    ground = float(np.nanmean(world.terrain.values))
    half_swath = config.altitude_m * math.tan(math.radians(config.scan_angle_deg))
    pitch = 2 * half_swath * (1 - config.overlap)
    lines = max(1, math.ceil(2 * reach_across / pitch))
    offset = rng.uniform(-0.5, 0.5) * (lines * pitch - 2 * reach_across) if lines > 1 else 0.0
    gathered: list[tuple[Float64Array, UInt8Array, UInt8Array, int]] = []
    for line in range(lines):
        middle = (line - (lines - 1) / 2) * pitch + offset
        low, high = max(-reach_across, middle - half_swath), min(reach_across, middle + half_swath)
        across = np.arange(low, high, config.spacing_m)
        along = np.arange(-reach_along, reach_along, config.spacing_m)
        rows = max(1, _RAYS_AT_ONCE // max(len(across), 1))
        bias = rng.standard_normal(3) * _common(config)
        for start in range(0, len(along), rows):
            part = along[start : start + rows]
            a, b = (grid.ravel() for grid in np.meshgrid(part, across, indexing="ij"))
            a = a + config.spacing_m * rng.uniform(-0.45, 0.45, len(a))
            b = b + config.spacing_m * rng.uniform(-0.45, 0.45, len(b))
            aim = centre + a[:, None] * forward + b[:, None] * left
            # Aimed where the ray meets the mean ground; what stands or lies there moves the point as in a real scan.
            inside = (aim[:, 0] > min_x - 25) & (aim[:, 0] < max_x + 25)
            inside &= (aim[:, 1] > min_y - 25) & (aim[:, 1] < max_y + 25)
            a, b = a[inside], b[inside]
            sensor = np.empty((len(a), 3), dtype=np.float32)
            sensor[:, :2] = centre + a[:, None] * forward + middle * left
            sensor[:, 2] = ground + config.altitude_m
            ray = np.empty_like(sensor)
            ray[:, :2] = (b - middle)[:, None] * left
            ray[:, 2] = -config.altitude_m
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            points, label, number = _pulses(world.scene, sensor, ray, config, rng)
            points += bias + rng.standard_normal(points.shape) * _own(config)
            keep = (points[:, 0] >= min_x) & (points[:, 0] < max_x) & (points[:, 1] >= min_y) & (points[:, 1] < max_y)
            keep &= (label != Label.WATER) | (rng.random(len(label)) < config.water_return)
            gathered.append((points[keep], label[keep], number[keep], line + 1))
            if progress is not None:
                progress((line + min(start + rows, len(along)) / len(along)) / lines)
    return Survey(
        points=np.concatenate([g[0] for g in gathered]),
        classification=ASPRS_CLASS[np.concatenate([g[1] for g in gathered])],
        return_number=np.concatenate([g[2] for g in gathered]),
        flight_line=np.concatenate([np.full(len(g[0]), g[3], dtype=np.uint8) for g in gathered]),
    )


_ROUGHNESS_M = 0.1
"""Vertical error beyond which all of it is the flight line's: a survey may lie deep, but its streets are not rough."""


def _common(config: SurveyConfig) -> Float64Array:
    horizontal = config.horizontal_error_m * 2 / 3
    vertical = config.vertical_error_m
    if vertical <= _ROUGHNESS_M:
        return np.array([horizontal, horizontal, 0.5 * vertical])
    return np.array([horizontal, horizontal, math.sqrt(vertical**2 - _own(config)[2] ** 2)])


def _own(config: SurveyConfig) -> Float64Array:
    horizontal = config.horizontal_error_m * math.sqrt(1 - 4 / 9)
    return np.array([horizontal, horizontal, math.sqrt(0.75) * min(config.vertical_error_m, _ROUGHNESS_M)])


def _pulses(
    scene: Scene, origins: Float32Array, directions: Float32Array, config: SurveyConfig, rng: np.random.Generator
) -> tuple[Float64Array, UInt8Array, UInt8Array]:
    """Return points, labels and return numbers of the pulses' returns."""
    points: list[npt.NDArray[np.float64]] = []
    labels: list[UInt8Array] = []
    numbers: list[UInt8Array] = []
    for number in range(1, config.returns + 1):
        hits = scene.cast(origins, directions)
        met = hits.mask
        found = origins[met].astype(np.float64) + hits.distance_m[met, None].astype(np.float64) * directions[met]
        label = hits.label[met]
        # A part of the pulse goes on past a leaf; the leaf itself is at times too small to answer.
        leaf = label == Label.VEGETATION
        answered = ~leaf | (rng.random(len(leaf)) < 0.8)
        points.append(found[answered])
        labels.append(label[answered])
        numbers.append(np.full(int(answered.sum()), number, dtype=np.uint8))
        onward = leaf & (rng.random(len(leaf)) < 0.6)
        if not onward.any():
            break
        # Two returns of a pulse lie at least its length apart.
        directions = directions[met][onward]
        origins = (found[onward] + 0.4 * directions).astype(np.float32)
    return np.concatenate(points), np.concatenate(labels), np.concatenate(numbers)


def write_survey(
    world: World, survey: Survey, folder: Path, *, tile_m: float = 500.0, name: str = "tile"
) -> list[Path]:
    """Write the survey as LAZ tiles on the multiples of `tile_m` in the world's CRS and return their paths."""
    from crossloc3d_ros.formats.las import write_laz

    folder.mkdir(parents=True, exist_ok=True)
    grid = world.to_grid(survey.points)
    tile = np.floor(grid[:, :2] / tile_m).astype(np.int64)
    paths = []
    for east, north in np.unique(tile, axis=0):
        rows = (tile[:, 0] == east) & (tile[:, 1] == north)
        path = folder / f"{name}_{round(east * tile_m)}_{round(north * tile_m)}.laz"
        write_laz(path, grid[rows], survey.classification[rows], world.crs)
        paths.append(path)
    return paths
