"""Rasters as GeoTIFF, which every GIS opens: written tile by tile, read window by window; the only user of rasterio."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio.errors import RasterioError
from rasterio.transform import from_origin
from rasterio.windows import Window

from crossloc3d_ros.clouds.raster import Bounds, Raster
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.types import Float32Array

UInt16Array = npt.NDArray[np.uint16]

BLOCK = 256
"""Side of the blocks in which the files are stored, pixels."""


def write_geotiff(
    path: Path,
    bounds: Bounds,
    cell_m: float,
    crs: str,
    block_values: Callable[[Bounds], Float32Array],
    description: str,
    kind: Literal["heights", "counts"] = "heights",
) -> None:
    """Write a raster over `bounds`: heights in metres, float32, NaN where nothing is known, or counts.

    Counts are kept as uint16; what is larger becomes the largest that this holds.

    `block_values` gives the cells (H, W), row 0 in the north, of one block's bounds at a time, so that a raster of
    any size is written in bounded memory. The file is read back and compared: a full disk makes GDAL lose blocks
    without a word. Raises OSError then.
    """
    west, south, east, north = bounds
    width, height = round((east - west) / cell_m), round((north - south) / cell_m)
    of_kind = {
        "heights": {"dtype": "float32", "nodata": float("nan"), "predictor": 3},
        "counts": {"dtype": "uint16", "nodata": 0, "predictor": 2},
    }[kind]
    profile = {
        "driver": "GTiff", "count": 1, "width": width, "height": height, "crs": crs,
        "transform": from_origin(west, north, cell_m, cell_m), "tiled": True, "blockxsize": BLOCK, "blockysize": BLOCK,
        "compress": "deflate", "bigtiff": "if_safer", "sparse_ok": True, **of_kind,
    }  # fmt: skip
    windows = _windows(width, height)
    checksum = 0
    try:
        with rasterio.open(path, "w", **profile) as file:
            file.set_band_description(1, description)
            if kind == "heights":
                file.units = ("metre",)
            for window in windows:
                left, top = west + window.col_off * cell_m, north - window.row_off * cell_m
                values = block_values((left, top - window.height * cell_m, left + window.width * cell_m, top))
                stored, is_empty = _as_stored(values, kind)
                checksum = zlib.crc32(stored.tobytes(), checksum)
                if not is_empty:
                    file.write(stored, 1, window=window)
        found = _checksum(path, windows)
    except RasterioError as error:
        raise OSError(f"{path} could not be written: {error}") from error
    if found != checksum:
        raise OSError(f"{path} was not written whole; is the disk full?")


def write_bands(path: Path, rasters: Mapping[str, Raster], crs: str) -> None:
    """Write rasters of one grid as the bands of one file, float32, NaN where nothing is known, with their names.

    Raises OSError where that fails.
    """
    grid = next(iter(rasters.values()))
    height, width = grid.values.shape
    profile = {
        "driver": "GTiff", "count": len(rasters), "width": width, "height": height, "crs": crs, "dtype": "float32",
        "transform": from_origin(grid.west_m, grid.north_m, grid.cell_m, grid.cell_m), "nodata": float("nan"),
        "compress": "deflate", "predictor": 3,
    }  # fmt: skip
    try:
        with rasterio.open(path, "w", **profile) as file:
            for band, (description, raster) in enumerate(rasters.items(), start=1):
                file.write(raster.values.astype(np.float32), band)
                file.set_band_description(band, description)
    except RasterioError as error:
        raise OSError(f"{path} could not be written: {error}") from error


def _as_stored(values: Float32Array, kind: Literal["heights", "counts"]) -> tuple[Float32Array | UInt16Array, bool]:
    """Return a block as the file holds it, and whether it need not be stored at all."""
    if kind == "counts":
        counts = np.clip(values, 0, np.iinfo(np.uint16).max).astype(np.uint16)
        return counts, not counts.any()
    # One bit pattern for every NaN, so that the checksum of a block that is not stored at all agrees.
    heights = np.where(np.isnan(values), np.float32("nan"), values)
    return heights, bool(np.isnan(heights).all())


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


@dataclass(frozen=True)
class Placement:
    """Where a raster lies."""

    crs: str
    """Such as EPSG:32631; empty where the file names none."""
    bounds: Bounds
    cell_m: float


def read_placement(path: Path) -> Placement:
    """Return where a raster lies, without reading its cells; MapError where it is damaged or lies askew."""
    try:
        with rasterio.open(path) as file:
            transform, box = file.transform, file.bounds
            if transform.b or transform.d or transform.a != -transform.e:
                raise MapError(f"the raster {path} lies askew or has cells that are no squares; build the map anew")
            crs = file.crs.to_string() if file.crs else ""
            return Placement(crs, (box.left, box.bottom, box.right, box.top), float(transform.a))
    except RasterioError as error:
        raise MapError(f"the raster {path} is damaged or missing; copy the map again or build it anew") from error


def read_geotiff(path: Path, bounds: Bounds | None = None) -> Raster:
    """Return the raster, or the part of it that covers `bounds`: where this reaches beyond the file, NaN.

    A raster of counts comes as float32 too, 0 beyond the file.
    """
    try:
        with rasterio.open(path) as file:
            cell_m, west, north = file.transform.a, file.transform.c, file.transform.f
            if bounds is None:
                return Raster(file.read(1).astype(np.float32), west, north, cell_m)
            column, row = math.floor((bounds[0] - west) / cell_m), math.floor((north - bounds[3]) / cell_m)
            width = math.ceil((bounds[2] - west) / cell_m) - column
            height = math.ceil((north - bounds[1]) / cell_m) - row
            window = Window(column, row, width, height)
            values = file.read(1, window=window, boundless=True, fill_value=file.nodata)
            return Raster(values.astype(np.float32), west + column * cell_m, north - row * cell_m, cell_m)
    except RasterioError as error:
        raise MapError(f"the raster {path} is damaged or missing; copy the map again or build it anew") from error
