"""Rasters as GeoTIFF, which every GIS opens: written tile by tile, read window by window; the only user of rasterio."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import RasterioError
from rasterio.transform import from_origin
from rasterio.windows import Window

from crossloc3d_ros.clouds.raster import Bounds, Raster
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.types import Float32Array

BLOCK = 256
"""Side of the blocks in which the files are stored, pixels."""


def write_geotiff(
    path: Path,
    bounds: Bounds,
    cell_m: float,
    crs: str,
    block_values: Callable[[Bounds], Float32Array],
    description: str,
) -> None:
    """Write a raster of float32 metres over `bounds`, NaN where nothing is known.

    `block_values` gives the cells (H, W), row 0 in the north, of one block's bounds at a time, so that a raster of
    any size is written in bounded memory. The file is read back and compared: a full disk makes GDAL lose blocks
    without a word. Raises OSError then.
    """
    west, south, east, north = bounds
    width, height = round((east - west) / cell_m), round((north - south) / cell_m)
    profile = {
        "driver": "GTiff", "dtype": "float32", "count": 1, "width": width, "height": height, "crs": crs,
        "transform": from_origin(west, north, cell_m, cell_m), "nodata": float("nan"), "tiled": True,
        "blockxsize": BLOCK, "blockysize": BLOCK, "compress": "deflate", "predictor": 3, "bigtiff": "if_safer",
        "sparse_ok": True,
    }  # fmt: skip
    windows = _windows(width, height)
    checksum = 0
    try:
        with rasterio.open(path, "w", **profile) as file:
            file.set_band_description(1, description)
            file.units = ("metre",)
            for window in windows:
                left, top = west + window.col_off * cell_m, north - window.row_off * cell_m
                values = block_values((left, top - window.height * cell_m, left + window.width * cell_m, top))
                # One bit pattern for every NaN, so that the checksum of a block that is not stored at all agrees.
                values = np.where(np.isnan(values), np.float32("nan"), values)
                checksum = zlib.crc32(values.tobytes(), checksum)
                if not np.isnan(values).all():
                    file.write(values, 1, window=window)
        found = _checksum(path, windows)
    except RasterioError as error:
        raise OSError(f"{path} could not be written: {error}") from error
    if found != checksum:
        raise OSError(f"{path} was not written whole; is the disk full?")


def _windows(width: int, height: int) -> list[Window]:
    return [
        Window(column, row, min(BLOCK, width - column), min(BLOCK, height - row))
        for row in range(0, height, BLOCK)
        for column in range(0, width, BLOCK)
    ]


def _checksum(path: Path, windows: Sequence[Window]) -> int:
    checksum = 0
    with rasterio.open(path) as file:
        for window in windows:
            checksum = zlib.crc32(file.read(1, window=window).tobytes(), checksum)
    return checksum


def read_geotiff(path: Path, bounds: Bounds | None = None) -> Raster:
    """Return the raster, or the part of it that covers `bounds` (NaN where it reaches beyond the file)."""
    try:
        with rasterio.open(path) as file:
            cell_m, west, north = file.transform.a, file.transform.c, file.transform.f
            if bounds is None:
                return Raster(file.read(1), west, north, cell_m)
            column, row = math.floor((bounds[0] - west) / cell_m), math.floor((north - bounds[3]) / cell_m)
            width = math.ceil((bounds[2] - west) / cell_m) - column
            height = math.ceil((north - bounds[1]) / cell_m) - row
            window = Window(column, row, width, height)
            values = file.read(1, window=window, boundless=True, fill_value=float("nan"))
            return Raster(values, west + column * cell_m, north - row * cell_m, cell_m)
    except RasterioError as error:
        raise MapError(f"the raster {path} is damaged or missing; copy the map again or build it anew") from error
