"""A world made from an aerial map's own rasters, some years later: what a robot would see on that map.

`world_of_map(aerial_map, square, seed)` reads terrain, surface and lowest echoes, tells roofs from crowns, lets some of
the houses and some of what is loose (crowns, hedges, cars) go and others come, and gives the rest to
`real_world.world_from_points` as the points that a survey of that time would have.

Rasters hold less than the survey that they were made of: a cell of a metre is roof as a whole, what hides beneath a
crown is guessed, and walls stand at the edges of cells.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.simulation.real_world import BUILDING, GROUND, world_from_points
from crossloc3d_ros.simulation.world import Bounds, World
from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

SCENE_MARGIN_M = 110.0
"""So far beyond the square the world goes on: as far as most lidars reach."""
_UNCLASSIFIED = 1
_OPEN_M, _GRASS_M = 0.4, 1.0  # lower is open ground; lower by itself is too
_ROOF_M = 2.2  # lower is no roof
_FLAT_M = 1.6  # from the lowest to the highest echo of a cell of a roof, however steep
_LEAST_ROOF_M2 = 20.0
_GAP_CELLS = 2  # twice as wide gaps between echoes, as sparse surveys have them, hold what is beside them
_ECHOES = 4  # of a cell with something loose in it, where the map does not tell how many there were
_MOST_ECHOES = 4
_HOUSE_M = 20.0
"""Roofs hang together over whole blocks: what lies over one square of this size stands for one house."""
_TREE_M = 8.0
"""And what is loose over one square of this size for one tree, or one row of cars."""


@dataclass(frozen=True)
class Change:
    """What becomes of a place in the years between the survey and the robot."""

    loose_gone: float = 0.3
    """Share of the trees, hedges and cars; half as many stand elsewhere."""
    houses_gone: float = 0.05
    """Share of the houses; as many new ones stand where there was open ground."""


UNCHANGED = Change(0.0, 0.0)


@dataclass(frozen=True, eq=False)
class _Layers:
    """What the rasters show, cell by cell, row 0 in the north."""

    ground: Float64Array
    """(H, W) metres; NaN where nothing is known."""
    above: Float64Array
    """(H, W) height of the highest echo above the ground; NaN where there is no echo."""
    lowest: Float64Array
    """(H, W) the same of the lowest echo."""
    echoes: Int64Array
    """(H, W) how many points stand for what is loose in a cell."""
    roof: BoolArray
    """(H, W) cells of houses, their edges too."""

    @property
    def is_open(self) -> BoolArray:
        """(H, W) open ground."""
        return open_ground(self.above)

    @property
    def is_loose(self) -> BoolArray:
        """(H, W) neither roof nor open ground."""
        return np.asarray(np.isfinite(self.above) & ~self.roof & ~self.is_open)


def open_ground(above: npt.NDArray[np.floating]) -> BoolArray:
    """Return the cells (H, W) where nothing stands, from the heights of their highest echoes above the ground.

    A low echo by itself is grass, or the noise of the survey.
    """
    standing = above >= _OPEN_M  # NaN is not
    around = ndimage.uniform_filter(standing.astype(np.float32), 3, mode="nearest")
    return np.asarray((above < _OPEN_M) | ((above < _GRASS_M) & (around < 0.4)))


def world_of_map(aerial_map: AerialMap, square: Bounds, seed: int, change: Change | None = None) -> World:
    """Return the world of one square of a map, `change`d by the years that lie between.

    `square`: easting and northing in the map's grid; robots drive inside of it, the scene reaches 110 m beyond. The
    world's zero is the square's middle. Raises AerialDataError where hardly anything of it is ground.
    """
    rng = np.random.default_rng([seed, 21])
    m = SCENE_MARGIN_M
    window = (square.min_x - m, square.min_y - m, square.max_x + m, square.max_y + m)
    terrain = aerial_map.terrain(window)
    layers = changed(_read(aerial_map, window, terrain), change or Change(), terrain.cell_m, rng)
    origin = np.array([(square.min_x + square.max_x) / 2.0, (square.min_y + square.max_y) / 2.0, 0.0])
    points, classes = _points(layers, terrain, rng)
    world = world_from_points(
        points - origin, classes, Bounds(*_local(window, origin)), name=aerial_map.path.name,
        crs=aerial_map.manifest.crs, origin_grid=origin, cell_m=terrain.cell_m / 2.0, seed=seed, least_share=0.05,
    )  # fmt: skip
    return dataclasses.replace(world, bounds=Bounds(*_local(square, origin)))


def changed(layers: _Layers, change: Change, cell_m: float, rng: np.random.Generator) -> _Layers:
    """Return the layers some years later."""
    return _houses_changed(_loose_changed(layers, change, cell_m, rng), change, cell_m, rng)


def _local(bounds: tuple[float, float, float, float], origin: Float64Array) -> tuple[float, float, float, float]:
    x, y = float(origin[0]), float(origin[1])
    return bounds[0] - x, bounds[1] - y, bounds[2] - x, bounds[3] - y


def _read(aerial_map: AerialMap, window: tuple[float, float, float, float], terrain: Raster) -> _Layers:
    ground = terrain.values.astype(np.float64)
    above = _bridged(aerial_map.surface(window).values - ground)
    lowest = _bridged(aerial_map.lowest(window).values - ground)
    support = aerial_map.support(window)
    echoes = np.full(ground.shape, _ECHOES)
    if support is not None:
        echoes = np.clip(support.values, 1, _MOST_ECHOES).astype(np.int64)
    return _Layers(ground, above, lowest, echoes, _roofs(above, lowest, terrain.cell_m))


def _bridged(heights: Float64Array) -> Float64Array:
    """Return heights (H, W) whose narrow gaps hold the nearest echo: with holes in it, no roof is told from a crown."""
    known = np.isfinite(heights)
    if not known.any():
        return heights
    closed = ndimage.binary_closing(known, iterations=_GAP_CELLS)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.where(closed & ~known, heights[tuple(nearest)], heights)


def _roofs(above: Float64Array, lowest: Float64Array, cell_m: float) -> BoolArray:
    """Return the cells (H, W) of roofs: flat in themselves and beside each other, unlike crowns."""
    high = above > _ROOF_M  # NaN is not
    filled = np.where(high, above, 0.0)
    with np.errstate(invalid="ignore"):
        smooth = np.abs(filled - ndimage.median_filter(filled, 3)) < 1.0
        compact = high & smooth & (above - lowest < _FLAT_M)
    votes = ndimage.uniform_filter(compact.astype(np.float32), 5)
    occupied = ndimage.uniform_filter(high.astype(np.float32), 5)
    core = ndimage.binary_opening(compact & (votes > 0.6 * occupied), np.ones((2, 2)))
    regions, count = ndimage.label(core)
    large = np.bincount(regions.ravel(), minlength=count + 1) * cell_m**2 >= _LEAST_ROOF_M2
    large[0] = False
    # At the edges of a roof cells hold echoes of the ground too.
    near = ndimage.maximum_filter(np.where(large[regions], above, -np.inf), 3)
    with np.errstate(invalid="ignore"):
        return np.asarray(large[regions] | (high & (np.abs(above - near) < 2.0)))


def _pieces(mask: BoolArray, side: int) -> Int64Array:
    """Return (H, W) the number of the square of so many cells that each marked cell lies in; -1 elsewhere."""
    rows, columns = np.indices(mask.shape)
    number = (rows // side) * (mask.shape[1] // side + 1) + columns // side
    return np.where(mask, number, -1).astype(np.int64)


def _drawn(pieces: Int64Array, share: float, rng: np.random.Generator) -> tuple[BoolArray, Int64Array]:
    """Draw so large a share of the pieces: return their cells (H, W) and their numbers."""
    numbers = np.unique(pieces[pieces >= 0])
    gone = numbers[rng.random(len(numbers)) < share]
    return np.isin(pieces, gone), gone


def _loose_changed(layers: _Layers, change: Change, cell_m: float, rng: np.random.Generator) -> _Layers:
    """Let some of what is loose go; half of it stands elsewhere on open ground."""
    side = max(1, round(_TREE_M / cell_m))
    pieces = _pieces(layers.is_loose, side)
    gone, numbers = _drawn(pieces, change.loose_gone, rng)
    above, lowest = layers.above.copy(), layers.lowest.copy()
    above[gone], lowest[gone] = 0.0, 0.0
    free = np.argwhere(ndimage.binary_erosion(layers.is_open, np.ones((side, side))))
    moving = numbers[rng.random(len(numbers)) < 0.5] if len(free) else numbers[:0]
    rows, columns = np.nonzero(np.isin(pieces, moving))
    order = np.argsort(pieces[rows, columns], kind="stable")
    rows, columns = rows[order], columns[order]
    starts = np.searchsorted(pieces[rows, columns], moving)
    for cells in np.split(np.column_stack([rows, columns]), starts[1:]) if len(moving) else ():
        corner = free[rng.integers(len(free))] - side // 2
        moved = cells - cells.min(axis=0) + corner
        inside = ((moved >= 0) & (moved < above.shape)).all(axis=1)
        source, target = tuple(cells[inside].T), tuple(moved[inside].T)
        above[target], lowest[target] = layers.above[source], layers.lowest[source]
    return dataclasses.replace(layers, above=above, lowest=lowest)


def _houses_changed(layers: _Layers, change: Change, cell_m: float, rng: np.random.Generator) -> _Layers:
    """Let some houses go; as many new ones stand on open ground."""
    gone, numbers = _drawn(_pieces(layers.roof, max(1, round(_HOUSE_M / cell_m))), change.houses_gone, rng)
    above, lowest, roof = layers.above.copy(), layers.lowest.copy(), layers.roof & ~gone
    above[gone], lowest[gone] = 0.0, 0.0
    side = max(1, round(12.0 / cell_m))
    free = np.argwhere(ndimage.binary_erosion(layers.is_open, np.ones((side + 4, side + 4))))
    for _ in numbers if len(free) else ():
        row, column = free[rng.integers(len(free))] - side // 2
        width, depth = rng.integers(max(1, side // 2), side + 1, 2)
        cells = np.s_[max(row, 0) : max(row + depth, 0), max(column, 0) : max(column + width, 0)]
        roof[cells] = True
        above[cells] = lowest[cells] = rng.uniform(3.0, 12.0)
    return dataclasses.replace(layers, above=above, lowest=lowest, roof=roof)


def _points(layers: _Layers, terrain: Raster, rng: np.random.Generator) -> tuple[Float64Array, npt.NDArray[np.uint8]]:
    """Return points (N, 3) in the grid and their classes (N,): ground, roofs, and what is loose."""
    known = np.isfinite(layers.above) & np.isfinite(layers.ground)
    ground = _placed(np.argwhere(known), terrain, 0.5, 0.5, layers.ground[known])
    roofs = []
    # A cell at a roof's edge is half roof, on the side of the house: four points stand for one cell.
    fine = np.kron(layers.roof & (layers.lowest > 1.0), np.ones((2, 2), np.bool_))
    fine = ndimage.binary_dilation(fine, np.ones((3, 3))) & np.kron(layers.roof, np.ones((2, 2), np.bool_))
    for down in (0, 1):
        for right in (0, 1):
            covered = fine[down::2, right::2] & known
            height = (layers.ground + layers.above)[covered]
            roofs.append(_placed(np.argwhere(covered), terrain, 0.25 + 0.5 * down, 0.25 + 0.5 * right, height))
    cells = np.argwhere(layers.is_loose & known)
    cells = np.repeat(cells, layers.echoes[tuple(cells.T)], axis=0)
    at = tuple(cells.T)
    top = layers.above[at]
    # Below a crown's upper three metres a survey sees little.
    bottom = np.maximum(np.minimum(layers.lowest[at], top), np.maximum(top - 3.0, 0.0))
    height = layers.ground[at] + bottom + (top - bottom) * rng.random(len(cells))
    loose = _placed(cells, terrain, rng.random(len(cells)), rng.random(len(cells)), height)
    parts = [ground, np.concatenate(roofs), loose]
    classes = np.repeat(np.array([GROUND, BUILDING, _UNCLASSIFIED], np.uint8), [len(part) for part in parts])
    return np.concatenate(parts), classes


def _placed(
    cells: Int64Array, raster: Raster, down: Float64Array | float, right: Float64Array | float, height: Float64Array
) -> Float64Array:
    """Return points (n, 3) in cells (n, 2), so far (0 to 1) from their northern and western edges."""
    easting = raster.west_m + (cells[:, 1] + right) * raster.cell_m
    northing = raster.north_m - (cells[:, 0] + down) * raster.cell_m
    return np.column_stack([easting, northing, height])
