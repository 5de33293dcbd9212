"""Where the ground is in an aerial survey without classes."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from crossloc3d_ros.clouds.filters import check_points
from crossloc3d_ros.clouds.raster import Raster, fill_holes, lowest_raster
from crossloc3d_ros.clouds.roofs import roof_cells
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import BoolArray, Float64Array

_TREND_M = 20.0  # smoothing of the terrain that the second pass takes away
_NOISE_M = 0.3  # an opening always lowers rough ground by this much
_SMALL_M = 10.0  # half the width of trees, cars and most houses: what must be gone before walls are looked for


def classify_ground(
    points: Float64Array,
    cell_m: float = 1.0,
    *,
    slope: float = 0.1,
    largest_window_m: float = 40.0,
    largest_roof_m2: float = 60_000.0,
    tolerance_m: float = 0.3,
) -> BoolArray:
    """Return the mask (N,) of ground points in an aerial survey without classes.

    Points (N, 3) easting, northing, height, metres. A progressive morphological filter after Zhang et al. (2003) and
    SMRF (Pingel et al. 2013): openings of the lowest-point raster with windows that grow up to `largest_window_m`
    either way. What one opening lowers by more than `slope` times its window, or all so far by half as much again, is
    an object. An opening cannot tell a roof wider than its window from a hill; so between the small windows and the
    large ones, regions up to `largest_roof_m2` that end in walls are taken out (`roof_cells`). A second pass sees the
    raster less the smooth terrain that the first one found, so that hills and hillsides do not count as slope. A point
    is ground within `tolerance_m` of the terrain that is left, plus what the terrain's own steepness adds within a
    cell.

    `docs/explanation/ground.md` compares it with larger windows and with CSF (Zhang et al. 2016).
    """
    check_points(points)
    if not (cell_m > 0 and slope > 0 and largest_window_m > 0 and tolerance_m > 0):
        raise CloudError("cell_m, slope, largest_window_m and tolerance_m must be positive")
    if not largest_roof_m2 >= 0:
        raise CloudError(f"largest_roof_m2 must be at least 0, got {largest_roof_m2}")
    mask = np.zeros(len(points), np.bool_)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        return mask
    easting, northing, z = np.asarray(points, np.float64)[finite].T
    # A rim of one cell keeps points on the upper edges inside.
    bounds = (easting.min(), northing.min(), easting.max() + cell_m, northing.max() + cell_m)
    lowest = lowest_raster(np.column_stack([easting, northing, z]), bounds, cell_m).values.astype(np.float64)
    lowest[_is_pit(lowest, cell_m)] = np.nan
    terrain = _terrain(lowest, slope, cell_m, largest_window_m, largest_roof_m2)
    steepness = np.hypot(*np.gradient(terrain, cell_m)) if min(terrain.shape) > 1 else np.zeros_like(terrain)
    below = Raster(terrain.astype(np.float32), bounds[0], bounds[3], cell_m).sample(easting, northing)
    steep = Raster(steepness.astype(np.float32), bounds[0], bounds[3], cell_m).sample(easting, northing)
    mask[finite] = np.abs(z - below) <= tolerance_m + 0.5 * steep * cell_m
    return mask


def _terrain(
    lowest: Float64Array, slope: float, cell_m: float, largest_window_m: float, largest_roof_m2: float
) -> Float64Array:
    """Return the terrain under the lowest points, NaN where a cell has none."""
    holes = np.isnan(lowest)
    surface = _filled(lowest)
    trend = np.zeros_like(surface)
    for _ in range(2):
        objects = _objects(surface - trend, slope, cell_m, cell_m, min(_SMALL_M, largest_window_m))
        objects |= roof_cells(surface, objects | holes, cell_m, largest_roof_m2)
        bare = _filled(np.where(objects | holes, np.nan, surface))
        if largest_window_m > _SMALL_M:
            objects |= _objects(bare - trend, slope, cell_m, _SMALL_M, largest_window_m)
        terrain = _filled(np.where(objects | holes, np.nan, surface))
        trend = ndimage.gaussian_filter(terrain, _TREND_M / cell_m, mode="nearest")
    return terrain


def _objects(surface: Float64Array, slope: float, cell_m: float, from_m: float, to_m: float) -> BoolArray:
    """Return the cells (H, W) that openings of the surface lower by more than terrain would be.

    The windows reach from `from_m` to `to_m` either way.
    """
    objects = np.zeros(surface.shape, np.bool_)
    opened = surface
    radius = max(1, int(from_m / cell_m))
    while True:
        lower = ndimage.grey_opening(opened, size=(2 * radius + 1, 2 * radius + 1))
        allowed = slope * radius * cell_m
        objects |= opened - lower > max(_NOISE_M, allowed)
        objects |= surface - lower > max(_NOISE_M, 1.5 * allowed)
        opened = lower
        if radius * cell_m >= to_m or 2 * radius >= max(surface.shape):
            return objects
        radius = max(radius + 1, int(radius * 1.3))


def _filled(values: Float64Array) -> Float64Array:
    """Return the raster (H, W) without holes."""
    return fill_holes(values.astype(np.float32)).astype(np.float64)


def _is_pit(raster: Float64Array, cell_m: float) -> BoolArray:
    """Return the cells that lie far below all their neighbours: reflections, not terrain."""
    filled = np.where(np.isfinite(raster), raster, np.inf)
    around = ndimage.minimum_filter(filled, footprint=np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]))
    pits: BoolArray = np.isfinite(around) & (filled < around - max(5.0 * cell_m, 2.0))
    return pits
