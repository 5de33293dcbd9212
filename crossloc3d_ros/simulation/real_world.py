"""A world made from a real aerial survey, so that the simulated robot drives through real geometry.

`world_from_survey(paths)` reads LAS or LAZ files into a `World` in the UTM zone of the area:

* terrain and roofs are one surface over a half-metre grid; where a roof ends, the surface falls to the ground within
  one cell, which closes the house with a wall;
* trees, cars and whatever else is unclassified stays what the survey saw of it, a loose leaf around each point, with
  some more below in tall crowns, so that beams pass between;
* where the survey saw nothing (canals, missing tiles) there is water below the level of the quays, which sends
  nothing back and cannot be driven on.

Surveys without building class (AHN2) have their roofs told from crowns by what lies below: a crown lets pulses through.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from crossloc3d_ros.aerial_map.survey import read_survey as survey_headers
from crossloc3d_ros.clouds.raster import Raster, fill_holes, surface_raster, terrain_raster
from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.formats.las import iter_chunks
from crossloc3d_ros.geodesy import Projection
from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.world import Bounds, World, free_space
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, UInt8Array

GROUND, BUILDING, WATER, BRIDGE = 2, 6, 9, 26
_NOISE = (7, 18)
_FREE_CELL_M = 1.0
_ROBOT_HEIGHT_M = 2.0
_WIDEST_WATER_M = 60.0
_EDGE_M = 25.0
"""How far from the end of the survey a robot keeps."""


@dataclass(frozen=True, eq=False)
class LocalSurvey:
    """A survey in memory."""

    name: str
    points: Float64Array
    """(N, 3) metres from `origin_grid`."""
    classes: UInt8Array
    """(N,) ASPRS."""
    bounds: Bounds
    crs: str
    """UTM zone of the area."""
    origin_grid: Float64Array
    """(3,) easting, northing, height in `crs`."""


def read_survey(
    paths: Sequence[str | Path],
    *,
    crs: str | None = None,
    progress: Callable[[str, float, float, str], None] | None = None,
) -> LocalSurvey:
    """Read a survey whole, without its noise; the arguments and errors are those of `world_from_survey`."""
    points, classes, grid_crs = _read(paths, crs, progress)
    low, high = points.min(axis=0), points.max(axis=0)
    if float(np.prod(high[:2] - low[:2])) > 9e6:
        raise AerialDataError("the survey covers more than 9 square kilometres; name fewer files")
    origin = np.array([np.round((low[0] + high[0]) / 2), np.round((low[1] + high[1]) / 2), 0.0])
    bounds = Bounds(*_snap(low[:2] - origin[:2], high[:2] - origin[:2]))
    return LocalSurvey(Path(paths[0]).stem, points - origin, classes, bounds, grid_crs, origin)


def world_from_survey(
    paths: Sequence[str | Path],
    *,
    crs: str | None = None,
    cell_m: float = 0.5,
    seed: int = 0,
    progress: Callable[[str, float, float, str], None] | None = None,
) -> World:
    """Return the world that a survey shows.

    `paths` files, folders or globs; `crs` where the headers name none; `cell_m` grid of the surface; `seed` of the
    crowns' leaves; `progress` is called with stage, done, total and unit. The whole survey is held in memory: meant
    for a few square kilometres. Raises AerialDataError for unusable files, for an area without ground points and for
    one that is too large.
    """
    survey = read_survey(paths, crs=crs, progress=progress)
    return world_from_points(
        survey.points, survey.classes, survey.bounds, name=survey.name, crs=survey.crs,
        origin_grid=survey.origin_grid, cell_m=cell_m, seed=seed, progress=progress,
    )  # fmt: skip


def world_from_points(
    local: Float64Array,
    classes: UInt8Array,
    bounds: Bounds,
    *,
    name: str,
    crs: str,
    origin_grid: Float64Array,
    cell_m: float = 0.5,
    seed: int = 0,
    least_share: float = 0.999,
    progress: Callable[[str, float, float, str], None] | None = None,
) -> World:
    """Return the world that a survey's points show.

    `local` (N, 3) metres from `origin_grid` (3,) in `crs`, `classes` (N,) ASPRS, `bounds` on whole metres;
    `least_share` of the largest connected free ground that another needs to be driven on; the rest as for
    `world_from_survey`. Raises AerialDataError where hardly a point is classified as ground.
    """
    ground = np.isin(classes, (GROUND, BRIDGE))
    if int(ground.sum()) < 100:
        raise AerialDataError(
            f"only {int(ground.sum())} of {len(local):,} points are classified as ground; a world needs classified "
            "surveys (class 2)"
        )
    if progress is not None:
        progress("surface", 0, 3, "steps")
    terrain = _terrain(local, ground, bounds)
    height = local[:, 2] - _sample(terrain, local)
    roofs = _roof_points(local, height, classes, bounds)
    surface, roof_mask = _solid_surface(local, roofs, terrain, bounds, cell_m)
    seen = _seen(local, bounds, cell_m)
    if progress is not None:
        progress("surface", 1, 3, "steps")
    loose = ~roofs & ~ground & (classes != WATER) & (height > 0.25) & (height < 60.0)
    rng = np.random.Generator(np.random.PCG64(seed))
    parts = [_solid_mesh(surface, roof_mask, seen, bounds, cell_m), *_crowns(local[loose], height[loose], rng)]
    scene = mesh.scene_from(parts)
    if progress is not None:
        progress("surface", 2, 3, "steps")
    clearance, preference = _free(local, height, loose, roof_mask, seen, bounds, cell_m, least_share)
    if progress is not None:
        progress("surface", 3, 3, "steps")
    return World(
        name=name, scene=scene, terrain=terrain, clearance=clearance, preference=preference,
        bounds=bounds, crs=crs, origin_grid=origin_grid, geoid_separation_m=None,
    )  # fmt: skip


def _read(
    paths: Sequence[str | Path], crs: str | None, progress: Callable[[str, float, float, str], None] | None
) -> tuple[Float64Array, UInt8Array, str]:
    """Return all points in the UTM zone of the survey, their classes, and the zone."""
    survey = survey_headers(paths, crs)
    points: list[Float64Array] = []
    classes: list[UInt8Array] = []
    done = 0
    for header in survey.headers:
        to_grid = Projection(header.crs, survey.map_crs, header.vertical_metres_per_unit)
        for chunk in iter_chunks(header.path):
            done += len(chunk.points)
            projected = to_grid(chunk.points)
            usable = np.isfinite(projected).all(axis=1) & ~np.isin(chunk.classification, _NOISE)
            points.append(projected[usable])
            classes.append(chunk.classification[usable])
            if progress is not None:
                progress("reading", done, survey.points, "points")
    if sum(len(part) for part in points) == 0:
        raise AerialDataError(f"{survey.headers[0].path} holds no usable point")
    return np.concatenate(points), np.concatenate(classes), survey.map_crs


def _snap(low: Float64Array, high: Float64Array) -> tuple[float, float, float, float]:
    """Return bounds on whole metres, so that grids of every cell fit."""
    return (float(np.floor(low[0])), float(np.floor(low[1])), float(np.ceil(high[0])), float(np.ceil(high[1])))


def _sample(raster: Raster, points: npt.NDArray[np.floating]) -> Float64Array:
    return np.asarray(raster.sample(points[:, 0], points[:, 1]), dtype=np.float64)


def _terrain(local: Float64Array, ground: BoolArray, bounds: Bounds) -> Raster:
    """Return a terrain without the ranging noise: at 3 degrees of grazing, 5 cm make walls of a pavement."""
    raster = terrain_raster(local, ground, bounds, 1.0)
    return Raster(ndimage.gaussian_filter(raster.values, 1.2, mode="nearest"), raster.west_m, raster.north_m, 1.0)


def _roof_points(local: Float64Array, height: Float64Array, classes: UInt8Array, bounds: Bounds) -> BoolArray:
    """Return which points lie on roofs: the survey's class, or a guess where it has no such class."""
    if np.any(classes == BUILDING):
        return np.asarray((classes == BUILDING) & (height > 1.0))
    high = (height > 2.2) & ~np.isin(classes, (GROUND, BRIDGE, WATER))
    cell = 1.0
    column = np.floor((local[:, 0] - bounds.min_x) / cell).astype(np.int64)
    row = np.floor((local[:, 1] - bounds.min_y) / cell).astype(np.int64)
    shape = (int(bounds.max_y - bounds.min_y) + 1, int(bounds.max_x - bounds.min_x) + 1)
    index = row * shape[1] + column
    size = shape[0] * shape[1]
    top = np.full(size, -np.inf)
    np.maximum.at(top, index[high], height[high])
    above = np.bincount(index[high], minlength=size)
    # Deep below the top of its cell: pulses that got through. A facade has such points too, but in one row of cells.
    below = np.bincount(index[height < top[index] - 2.0], minlength=size)
    mean = np.bincount(index[high], height[high], minlength=size) / np.maximum(above, 1)
    spread = np.bincount(index[high], (height[high] - mean[index[high]]) ** 2, minlength=size) / np.maximum(above, 1)
    compact = (above > 0) & (below <= 0.15 * above) & (spread < 0.6)
    votes = ndimage.uniform_filter(compact.reshape(shape).astype(np.float32), 5)
    occupied = ndimage.uniform_filter((above > 0).reshape(shape).astype(np.float32), 5)
    roof = (votes > 0.6 * occupied) & (above > 0).reshape(shape)
    roof = ndimage.binary_opening(roof, np.ones((2, 2)))
    regions, count = ndimage.label(roof)
    large = np.bincount(regions.ravel(), minlength=count + 1) >= 20
    large[0] = False
    return np.asarray(high & large[regions].ravel()[index])


def _solid_surface(
    local: Float64Array, roofs: BoolArray, terrain: Raster, bounds: Bounds, cell_m: float
) -> tuple[Float32Array, BoolArray]:
    """Return the height of ground and roofs at the cell centres (row 0 = north) and where roofs are."""
    top = surface_raster(local[roofs], bounds, cell_m).values if roofs.any() else None
    rows = int(np.ceil((bounds.max_y - bounds.min_y) / cell_m - 1e-9))
    columns = int(np.ceil((bounds.max_x - bounds.min_x) / cell_m - 1e-9))
    x = bounds.min_x + (np.arange(columns) + 0.5) * cell_m
    y = bounds.max_y - (np.arange(rows) + 0.5) * cell_m
    ground = np.asarray(terrain.sample(*np.meshgrid(x, y)), dtype=np.float32)
    ground = fill_holes(ground) if not np.isfinite(ground).all() else ground
    if top is None:
        return ground, np.zeros(ground.shape, dtype=np.bool_)
    # Two points in three cells: a roof has holes that no house has.
    reach = max(1, round(1.0 / cell_m))
    mask = ndimage.binary_closing(np.isfinite(top), np.ones((3, 3)), iterations=reach) | np.isfinite(top)
    gaps = mask & ~np.isfinite(top)
    nearest = ndimage.distance_transform_edt(~np.isfinite(top), return_distances=False, return_indices=True)
    top = np.where(gaps, top[tuple(nearest)], top)
    # One echo of an aerial, of a facade or of a gutter makes no spike and no pit.
    middle = ndimage.median_filter(np.where(mask, top, ground), 3)
    top = np.where(mask & (np.abs(top - middle) > 1.5), middle, top)
    roof = mask & (top > ground + 1.0)
    return np.where(roof, top, ground).astype(np.float32), roof


def _seen(local: Float64Array, bounds: Bounds, cell_m: float) -> BoolArray:
    """Return the cells (row 0 = north) within some two metres of a point: the rest is water or not surveyed."""
    rows = int(np.ceil((bounds.max_y - bounds.min_y) / cell_m - 1e-9))
    columns = int(np.ceil((bounds.max_x - bounds.min_x) / cell_m - 1e-9))
    row = np.clip(np.floor((bounds.max_y - local[:, 1]) / cell_m).astype(np.int64), 0, rows - 1)
    column = np.clip(np.floor((local[:, 0] - bounds.min_x) / cell_m).astype(np.int64), 0, columns - 1)
    hit = np.zeros((rows, columns), dtype=np.bool_)
    hit[row, column] = True
    reach = max(1, round(2.0 / cell_m))
    padded = np.pad(hit, reach)
    # Closing keeps the quay where it is and fills what the houses hid.
    closed = ndimage.distance_transform_edt(~padded) <= reach
    closed = ndimage.distance_transform_edt(closed) > reach
    return np.asarray((closed[reach:-reach, reach:-reach]) | hit)


def _solid_mesh(surface: Float32Array, roof: BoolArray, seen: BoolArray, bounds: Bounds, cell_m: float) -> mesh.Mesh:
    """Return ground, roofs, walls and water as one mesh over the cell centres."""
    heights = np.where(seen, surface, surface - 1.5)
    flipped = np.flipud(heights)
    south = bounds.max_y - (len(heights) - 0.5) * cell_m
    solid = mesh.height_grid(flipped, bounds.min_x + 0.5 * cell_m, south, cell_m, Label.GROUND)
    roof_corner = np.flipud(roof).ravel()[solid.faces]
    seen_corner = np.flipud(seen).ravel()[solid.faces]
    labels = np.full(len(solid.faces), Label.GROUND, dtype=np.uint8)
    labels[roof_corner.any(axis=1)] = Label.BUILDING
    labels[~seen_corner.any(axis=1)] = Label.WATER
    # Far from everything surveyed there is nothing at all; it only costs memory.
    far = ndimage.distance_transform_edt(~np.flipud(seen)).ravel() * cell_m > 120.0
    keep = ~far[solid.faces].all(axis=1)
    return mesh.Mesh(solid.vertices, solid.faces[keep], labels[keep])


def _crowns(points: Float64Array, height: Float64Array, rng: np.random.Generator) -> list[mesh.Mesh]:
    """Return loose leaves: one a point, and in tall crowns two more below, which the survey hardly reaches."""
    if len(points) == 0:
        return []
    label = np.where(height > _ROBOT_HEIGHT_M, Label.VEGETATION, Label.STRUCTURE)
    tall = np.flatnonzero(height > 4.0)
    below = np.repeat(points[tall], 2, axis=0)
    below[:, :2] += 0.5 * rng.standard_normal((len(below), 2))
    below[:, 2] -= rng.random(len(below)) * 0.45 * np.repeat(height[tall], 2)
    meshes = [
        mesh.leaves(points[label == kind], 0.55, int(kind), rng)
        for kind in (Label.VEGETATION, Label.STRUCTURE)
        if np.any(label == kind)
    ]
    if len(below):
        meshes.append(mesh.leaves(below, 0.5, Label.VEGETATION, rng))
    return meshes


def _free(
    local: Float64Array, height: Float64Array, loose: BoolArray, roof: BoolArray, seen: BoolArray, bounds: Bounds,
    cell_m: float, least_share: float,
) -> tuple[Raster, Raster]:  # fmt: skip
    """Return clearance and preference on metre cells."""
    rows, columns = round(bounds.max_y - bounds.min_y), round(bounds.max_x - bounds.min_x)
    obstacles = np.zeros((rows, columns), dtype=np.bool_)
    fine_row, fine_column = np.nonzero(roof | ~seen)
    obstacles[
        np.minimum((fine_row * cell_m).astype(np.int64), rows - 1),
        np.minimum((fine_column * cell_m).astype(np.int64), columns - 1),
    ] = True
    low = loose & (height > 0.4) & (height < _ROBOT_HEIGHT_M)
    row = np.clip(np.floor(bounds.max_y - local[low, 1]).astype(np.int64), 0, rows - 1)
    column = np.clip(np.floor(local[low, 0] - bounds.min_x).astype(np.int64), 0, columns - 1)
    counts = np.zeros((rows, columns), dtype=np.int64)
    np.add.at(counts, (row, column), 1)
    obstacles |= counts >= 2
    clearance, preference = free_space(
        obstacles, np.ones_like(obstacles), bounds.min_x, bounds.max_y, _FREE_CELL_M, least_share=least_share
    )
    # Wider than any canal: not surveyed. A scan from its edge would show half a place.
    unseen = np.ones((rows, columns), dtype=np.bool_)
    fine_row, fine_column = np.nonzero(seen)
    unseen[
        np.minimum((fine_row * cell_m).astype(np.int64), rows - 1),
        np.minimum((fine_column * cell_m).astype(np.int64), columns - 1),
    ] = False
    frame = np.pad(unseen, 60, constant_values=True)
    deep = ndimage.distance_transform_edt(frame) > _WIDEST_WATER_M / 2
    if deep.any():
        edge = ndimage.distance_transform_edt(~deep)[60:-60, 60:-60] - _WIDEST_WATER_M / 2
        preference = Raster(
            np.where(edge > _EDGE_M, preference.values, np.float32(0.0)), preference.west_m, preference.north_m,
            preference.cell_m,
        )  # fmt: skip
    return clearance, preference
