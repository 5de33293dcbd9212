"""How densely and how completely a survey covers its area: measured tile by tile, summed up for the map, judged."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array

FLOWN_REACH_M = 5.0
"""A cell this near to an echo counts as flown over."""
SPARSE_PER_M2 = 2.0
"""Below this density a survey is called sparse."""
_TOO_SPARSE_PER_M2 = 0.2  # a submap of 100 x 100 m has then less than half of the points that a patch is made of
_SQUARE_M = 50.0  # densities are compared between squares of about this side
_BRIDGED_M = 25.0  # what has echoes within this distance on both sides lies inside of the survey
_CROWN_M = 2.0  # echoes higher than this stand on something
_ROUGH_M = 1.5  # off the plane through those around: crowns, and the rims of roofs, but no roof
_CROWN_REACH_M = 2.5  # the neighbourhood of such a plane: some ten echoes where there are 0.5 a square metre
_MOSTLY_WOOD = 0.8  # of the area: hardly anything stands there that is not a crown
_MOSTLY_EMPTY = 0.5  # of the area in gaps: more water than land


@dataclass(frozen=True)
class TileCoverage:
    """How a tile is covered; cells are those of the map's rasters."""

    densities: tuple[float, ...] = ()
    """Points per square metre of the tile's squares of about 50 m, over what was flown of them."""
    inside: int = 0
    """Cells inside of the survey."""
    empty: int = 0
    """Of these, cells without an echo."""
    gaps: int = 0
    """Of these, cells without one within 5 m: between strips, or on water."""
    widest_gap_m: float = 0.0
    wooded: int = 0
    """Cells inside of the survey in or near crowns."""


@dataclass(frozen=True)
class Coverage:
    """How a survey covers its area."""

    points_per_m2: float
    """Median over squares of about 50 m, points of all returns per square metre flown."""
    points_per_m2_low: float
    """5 % quantile over the same squares."""
    empty_share: float
    """Of the cells inside of the survey: without an echo."""
    gap_share: float
    """Of the cells inside of the survey: without an echo within 5 m, in gaps between strips or on water."""
    widest_gap_m: float
    """Up to 50 m; what is wider lies outside of the survey."""
    wood_share: float
    """Of the cells inside of the survey: in or near crowns."""


def tile_coverage(
    support: Float32Array,
    distance_m: Float32Array,
    highest_m: Float32Array,
    within: tuple[slice, slice],
    cell_m: float,
) -> TileCoverage:
    """Measure how a tile is covered.

    All rasters (H, W) reach beyond the tile, which is their part `within`: `support`, points of each cell;
    `distance_m`, from each cell to the nearest one with a point; `highest_m`, the highest point of each cell above the
    terrain, NaN where there is none.
    """
    if not np.isfinite(distance_m).any():
        return TileCoverage()
    inside = _closed(distance_m, cell_m)[within]
    flown = inside & (distance_m[within] <= FLOWN_REACH_M)
    gaps = inside & ~flown
    wooded = _wooded(highest_m, cell_m)[within] & inside
    return TileCoverage(
        densities=_densities(support[within], flown, cell_m),
        inside=int(inside.sum()),
        empty=int((inside & (support[within] == 0)).sum()),
        gaps=int(gaps.sum()),
        widest_gap_m=2.0 * float(distance_m[within][gaps].max()) if gaps.any() else 0.0,
        wooded=int(wooded.sum()),
    )


def _closed(distance_m: Float32Array, cell_m: float) -> BoolArray:
    """Return the cells that the survey surrounds (morphological closing)."""
    near = distance_m <= _BRIDGED_M
    if near.all():
        return near
    closed: BoolArray = ndimage.distance_transform_edt(near) * cell_m > _BRIDGED_M
    return closed


def _wooded(highest_m: Float32Array, cell_m: float) -> BoolArray:
    """Return the cells in or near crowns: echoes high up that lie on no common plane, as those of a roof do."""
    reach = math.ceil(_CROWN_REACH_M / cell_m)
    crown = np.nan_to_num(highest_m) > _CROWN_M
    crown &= _roughness(highest_m, 2 * reach + 1) > _ROUGH_M
    wooded: BoolArray = ndimage.maximum_filter(crown, size=2 * reach + 1)
    return wooded


def _roughness(heights: Float32Array, side: int) -> Float64Array:
    """Return the standard deviation of the known heights (H, W) around the plane through them, in squares of cells."""
    known = np.isfinite(heights)
    z = np.where(known, heights, 0.0).astype(np.float64)
    row, column = np.mgrid[0 : z.shape[0], 0 : z.shape[1]].astype(np.float64)
    count = np.maximum(ndimage.uniform_filter(known.astype(np.float64), side), 1e-9)

    def mean(values: Float64Array) -> Float64Array:
        return np.asarray(ndimage.uniform_filter(values * known, side) / count)

    x, y, h = mean(column), mean(row), mean(z)
    xx, yy, xy = mean(column**2) - x**2, mean(row**2) - y**2, mean(column * row) - x * y
    xz, yz, zz = mean(column * z) - x * h, mean(row * z) - y * h, mean(z**2) - h**2
    determinant = np.maximum(xx * yy - xy**2, 1e-6)  # one line of echoes: as if there were no slope across it
    along_x, along_y = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    return np.asarray(np.sqrt(np.maximum(zz - along_x * xz - along_y * yz, 0.0)))


def _densities(support: Float32Array, flown: BoolArray, cell_m: float) -> tuple[float, ...]:
    """Return points per square metre flown, of each square of which at least half was."""
    edges = [
        np.linspace(0, size, max(1, round(size * cell_m / _SQUARE_M)) + 1).round().astype(int) for size in support.shape
    ]
    densities = []
    for (top, bottom), (left, right) in itertools.product(*(itertools.pairwise(edge) for edge in edges)):
        cells = flown[top:bottom, left:right]
        if cells.mean() >= 0.5:
            area_m2 = float(cells.sum()) * cell_m**2
            densities.append(round(float(support[top:bottom, left:right].sum()) / area_m2, 4))
    return tuple(densities)


def survey_coverage(tiles: Iterable[TileCoverage]) -> Coverage:
    """Sum up the tiles of a survey."""
    tiles = list(tiles)
    densities = [density for tile in tiles for density in tile.densities] or [0.0]
    inside = max(1, sum(tile.inside for tile in tiles))
    low, median = np.quantile(densities, [0.05, 0.5])
    return Coverage(
        points_per_m2=round(float(median), 3),
        points_per_m2_low=round(float(low), 3),
        empty_share=round(sum(tile.empty for tile in tiles) / inside, 4),
        gap_share=round(sum(tile.gaps for tile in tiles) / inside, 4),
        widest_gap_m=round(max((tile.widest_gap_m for tile in tiles), default=0.0), 1),
        wood_share=round(sum(tile.wooded for tile in tiles) / inside, 4),
    )


def coverage_warnings(coverage: Coverage) -> tuple[str, ...]:
    """Return what a user must know before a robot relies on a map of this survey, a sentence each."""
    warnings = []
    if coverage.gap_share > _MOSTLY_EMPTY:
        warnings.append(
            f"{coverage.gap_share:.0%} of the area have no echo, as water or gaps between strips: "
            "a robot there has nothing to be localized by"
        )
    elif coverage.points_per_m2 < _TOO_SPARSE_PER_M2:
        warnings.append(
            f"the survey has {coverage.points_per_m2:.2g} points/m2, too few to tell places apart: "
            "most of what a robot sees is not in it; use a survey of at least 0.5 points/m2"
        )
    if coverage.wood_share > _MOSTLY_WOOD:
        warnings.append(
            f"{coverage.wood_share:.0%} of the area are wood: crowns look alike from everywhere, "
            "and the localizer will rarely be sure there"
        )
    return tuple(warnings)
