"""A picture of the aerial map to draw upon: relief shaded from the north-west, roofs and trees lighter than streets."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy import ndimage

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.raster import Bounds, Raster
from crossloc3d_ros.types import Float32Array, Float64Array, UInt8Array

_PIXELS = 1400
"""Longer side of the picture at most."""
_WIDEST_M = 4000.0
"""A drive's surroundings are drawn up to this side; of a larger map the rest is cut off."""
_MARGIN_M = 120.0
# Colours of heights above the ground: street, first floor, eaves, towers.
_HEIGHTS_M = np.array([0.0, 2.0, 8.0, 16.0, 30.0, 60.0])
_COLOURS = np.array(
    [[84, 93, 106], [108, 116, 126], [156, 156, 154], [184, 180, 172], [206, 200, 188], [228, 224, 214]], np.float64
)
_NO_RETURN = np.array([42.0, 57.0, 78.0])


@dataclass(frozen=True)
class Backdrop:
    """A picture and the part of the grid that it shows."""

    data_uri: str
    bounds: Bounds
    """Min easting, min northing, max easting, max northing, metres."""


def draw_backdrop(aerial_map: AerialMap, places: Float64Array) -> Backdrop:
    """Draw the map around places (n, 2 or more) of its grid, or all of it where it is small."""
    bounds = view_of(aerial_map.bounds, places)
    surface, terrain = aerial_map.surface(bounds), aerial_map.terrain(bounds)
    height, width = surface.values.shape
    shown = (
        surface.west_m,
        surface.north_m - height * surface.cell_m,
        surface.west_m + width * surface.cell_m,
        surface.north_m,
    )
    return Backdrop(_png_uri(shade(surface, terrain)), shown)


def view_of(bounds: Bounds, places: Float64Array) -> Bounds:
    """Return the part of the map to show: all of it, or the surroundings of the places where that is too much."""
    west, south, east, north = bounds
    if max(east - west, north - south) <= _WIDEST_M:
        return bounds
    known = places[np.isfinite(places[:, :2]).all(axis=1), :2]
    centre = np.median(known, axis=0) if len(known) else np.array([(west + east) / 2, (south + north) / 2])
    near = known[np.abs(known - centre).max(axis=1) <= _WIDEST_M / 2] if len(known) else centre[None]
    low, high = near.min(axis=0) - _MARGIN_M, near.max(axis=0) + _MARGIN_M
    return (
        max(west, float(low[0])),
        max(south, float(low[1])),
        min(east, float(high[0])),
        min(north, float(high[1])),
    )


def shade(surface: Raster, terrain: Raster) -> UInt8Array:
    """Return the picture (H, W, 3) of a surface over its terrain, rasters of one shape; NaN is drawn as water."""
    heights = _without_pinholes(surface.values)
    empty = ~np.isfinite(heights)
    ground = np.where(np.isfinite(terrain.values), terrain.values, np.nanmin(heights) if (~empty).any() else 0.0)
    filled = np.where(empty, ground, heights).astype(np.float64)
    above = np.clip(filled - ground, 0.0, _HEIGHTS_M[-1])
    colours = np.stack([np.interp(above, _HEIGHTS_M, _COLOURS[:, c]) for c in range(3)], axis=-1)
    colours[empty] = _NO_RETURN
    light = _hillshade(filled, surface.cell_m)
    light[ndimage.binary_erosion(empty, iterations=2)] = 1.0
    picture = np.clip(colours * light[..., None], 0, 255).astype(np.uint8)
    step = math.ceil(max(picture.shape[:2]) / _PIXELS)
    return picture[::step, ::step]


def _hillshade(heights: Float64Array, cell_m: float) -> Float64Array:
    """Return the brightness (H, W), about 1 on flat ground, under a sun in the north-west at 45 degrees."""
    smooth = ndimage.gaussian_filter(heights, 0.6)
    to_south, to_east = np.gradient(smooth, cell_m)
    # Roofs are far steeper than hills: their slope is compressed, or walls would be all that is seen.
    slope = np.hypot(to_east, to_south)
    scale = np.divide(np.tanh(slope * 0.55), slope, out=np.full_like(slope, 0.55), where=slope > 1e-9)
    lit = (to_south + to_east) * scale / math.sqrt(2.0)  # a slope that rises to the south-east faces the sun
    result: Float64Array = np.clip(1.0 + 0.45 * lit, 0.45, 1.5)
    return result


def _without_pinholes(values: Float32Array) -> Float32Array:
    """Fill lone cells that no pulse happened to hit; wider holes, such as canals, stay."""
    empty = ~np.isfinite(values)
    if not empty.any() or empty.all():
        return values
    wide = ndimage.binary_opening(empty, structure=np.ones((3, 3)), border_value=1)
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    filled = values[tuple(nearest)]
    return np.where(empty & wide, np.float32(np.nan), filled)


def _png_uri(picture: UInt8Array) -> str:
    buffer = io.BytesIO()
    # A palette of 128 greys and browns is a quarter of the size and looks the same under the marks.
    image = Image.fromarray(picture).quantize(128, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.FLOYDSTEINBERG)
    image.save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
