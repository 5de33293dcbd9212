"""Whether a map agrees with itself: its manifest, its rasters and its submaps say the same of the same places.

Checksums tell that the files are those that the manifest was written for, not that they belong to one another. All
three echo rasters are made of the same echoes: a cell has a highest one where it has a lowest one and a count, and none
is below the lowest. That and the ground heights are compared around some of the submaps, whatever the size of the map.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.geotiff import read_geotiff, read_placement
from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.types import Float64Array

PLACES = 16
"""Submaps, evenly over the table, around which rasters are compared."""
_WINDOW_M = 40.0
_SAME_M = 0.01
_SAME_HEIGHT_M, _OTHER_HEIGHTS = 0.5, 0.25
_OTHER_CELLS = 0.01
_FARTHEST_ORIGIN_M = 100_000.0
"""Beyond, a local tangent frame says nothing of the map's places."""
_ADVICE = "copy the map again or build it anew"


def check_placement(
    folder: Path, crs: str, bounds: Bounds, cell_m: float, origin: tuple[float, ...], rasters: list[Path]
) -> None:
    """Raise MapError where a raster lies elsewhere than the manifest says, or the origin far off the map."""
    for path in rasters:
        placement = read_placement(path)
        if placement.crs != crs:
            raise MapError(
                f"the map {folder} does not agree with itself: by its manifest it lies in {crs}, by {path.name} in "
                f"{placement.crs or 'no CRS'}; {_ADVICE}"
            )
        if abs(placement.cell_m - cell_m) > 1e-6 or np.abs(np.subtract(placement.bounds, bounds)).max() > _SAME_M:
            raise MapError(
                f"the map {folder} does not agree with itself: by its manifest it covers {_area(bounds, cell_m)}, by "
                f"{path.name} {_area(placement.bounds, placement.cell_m)}; {_ADVICE}"
            )
    west, south, east, north = bounds
    away = math.hypot(max(west - origin[0], 0.0, origin[0] - east), max(south - origin[1], 0.0, origin[1] - north))
    if not away <= _FARTHEST_ORIGIN_M:
        raise MapError(
            f"the map {folder} does not agree with itself: its origin {origin[0]:.0f}, {origin[1]:.0f} lies "
            f"{away / 1000:,.0f} km off the area that it covers; {_ADVICE}"
        )


def check_submaps(folder: Path, grid: Float64Array, bounds: Bounds, half_extent_m: float, terrain_path: Path) -> None:
    """Raise MapError where submaps (M, 3) lie off the area covered, or at other heights than the terrain there."""
    west, south, east, north = bounds
    off = np.maximum.reduce([west - grid[:, 0], grid[:, 0] - east, south - grid[:, 1], grid[:, 1] - north])
    outside = int(np.count_nonzero(~(off <= half_extent_m)))
    if outside:
        raise MapError(
            f"the map {folder} does not agree with itself: {outside:,} of its {len(grid):,} submaps lie outside of "
            f"the area that it covers; {_ADVICE}"
        )
    places = grid[_some(len(grid))]
    heights = np.array([
        read_geotiff(terrain_path, _around(place, 2.0)).sample(place[None, 0], place[None, 1])[0] for place in places
    ])  # fmt: skip
    known = np.isfinite(heights)
    other = np.abs(heights - places[:, 2])[known] > _SAME_HEIGHT_M
    if len(other) and np.mean(other) > _OTHER_HEIGHTS:
        raise MapError(
            f"the map {folder} does not agree with itself: {np.count_nonzero(other)} of {len(other)} submaps looked at "
            f"have another ground height than {terrain_path.name}; {_ADVICE}"
        )


def check_echoes(folder: Path, grid: Float64Array, surface: Path, lowest: Path, support: Path | None) -> None:
    """Raise MapError where the rasters are not of the same echoes around the submaps (M, 3)."""
    cells = other = 0
    for window in (_around(place, _WINDOW_M) for place in grid[_some(len(grid))]):
        high, low = (read_geotiff(path, window).values for path in (surface, lowest))
        differs = (np.isnan(high) != np.isnan(low)) | (high < low - _SAME_M)
        if support is not None:
            echoes = read_geotiff(support, window).values
            differs |= np.isnan(high) != (echoes == 0)
            differs |= (echoes == 1) & (np.abs(high - low) > _SAME_M)
        cells += int(np.count_nonzero(~(np.isnan(high) & np.isnan(low))))
        other += int(np.count_nonzero(differs))
    if other > _OTHER_CELLS * cells:
        raise MapError(
            f"the map {folder} does not agree with itself: in {other:,} of {cells:,} cells looked at {surface.name} "
            f"and {lowest.name} are not of the same echoes, as if one were shifted; {_ADVICE}"
        )


def _some(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, PLACES)).astype(np.int64))


def _around(place: Float64Array, reach_m: float) -> Bounds:
    easting, northing = float(place[0]), float(place[1])
    return easting - reach_m, northing - reach_m, easting + reach_m, northing + reach_m


def _area(bounds: Bounds, cell_m: float) -> str:
    west, south, east, north = bounds
    return f"{west:.2f} to {east:.2f} E, {south:.2f} to {north:.2f} N in cells of {cell_m:g} m"
