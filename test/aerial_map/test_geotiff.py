"""Rasters on disk: what is written in blocks is read in windows, by anybody."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from crossloc3d_ros.aerial_map import geotiff
from crossloc3d_ros.aerial_map.geotiff import read_geotiff, write_geotiff
from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.errors import MapError

WEST, NORTH, CELL = 628_000.0, 5_803_000.0, 0.5


def write(path: Path, values: np.ndarray) -> Bounds:
    height, width = values.shape
    bounds = (WEST, NORTH - height * CELL, WEST + width * CELL, NORTH)

    def block(part: Bounds) -> np.ndarray:
        column, row = round((part[0] - WEST) / CELL), round((NORTH - part[3]) / CELL)
        return values[
            row : row + round((part[3] - part[1]) / CELL), column : column + round((part[2] - part[0]) / CELL)
        ]

    write_geotiff(path, bounds, CELL, "EPSG:32631", block, "height")
    return bounds


@pytest.fixture
def values() -> np.ndarray:
    rng = np.random.default_rng(0)
    values = rng.normal(5, 2, (600, 531)).astype(np.float32)
    values[rng.random(values.shape) < 0.1] = np.nan
    values[:256, :256] = np.nan  # a block with nothing in it
    values[300, 300] = -np.float32(np.nan)  # a NaN of another bit pattern
    return values


def test_what_is_written_is_read_by_anybody(tmp_path: Path, values: np.ndarray) -> None:
    bounds = write(tmp_path / "a.tif", values)
    with rasterio.open(tmp_path / "a.tif") as file:
        np.testing.assert_array_equal(file.read(1), values)
        assert file.crs.to_epsg() == 32631 and np.isnan(file.nodata)
        assert tuple(file.bounds) == bounds
        assert file.profile["tiled"] and file.profile["compress"] == "deflate"
        assert file.units == ("metre",) and file.descriptions == ("height",)
    raster = read_geotiff(tmp_path / "a.tif")
    np.testing.assert_array_equal(raster.values, values)
    assert (raster.west_m, raster.north_m, raster.cell_m) == (WEST, NORTH, CELL)


@pytest.mark.parametrize("rows", [(0, 10), (200, 333), (590, 600)])
@pytest.mark.parametrize("columns", [(0, 5), (250, 531)])
def test_a_window_is_that_part(
    tmp_path: Path, values: np.ndarray, rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    write(tmp_path / "a.tif", values)
    bounds = (WEST + columns[0] * CELL, NORTH - rows[1] * CELL, WEST + columns[1] * CELL, NORTH - rows[0] * CELL)
    window = read_geotiff(tmp_path / "a.tif", bounds)
    np.testing.assert_array_equal(window.values, values[slice(*rows), slice(*columns)])
    assert (window.west_m, window.north_m) == (bounds[0], bounds[3])


def test_beyond_the_edge_nothing_is_known(tmp_path: Path, values: np.ndarray) -> None:
    bounds = write(tmp_path / "a.tif", values)
    window = read_geotiff(tmp_path / "a.tif", (bounds[0] - 7.3, bounds[1] - 2, bounds[2] + 1, bounds[3] + 4))
    assert window.values.shape == (600 + 4 + 8, 531 + 15 + 2)
    np.testing.assert_array_equal(window.values[8:608, 15:546], values)
    assert np.isnan(window.values[:8]).all() and np.isnan(window.values[:, :15]).all()
    places = np.array([[WEST + 100.2, NORTH - 200.1], [WEST + 200.0, NORTH - 250.0]])
    np.testing.assert_allclose(window.sample(*places.T), read_geotiff(tmp_path / "a.tif").sample(*places.T), rtol=1e-6)


def test_a_block_that_the_disk_lost_is_noticed(
    tmp_path: Path, values: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = rasterio.io.DatasetWriter.write
    written = []

    def lose_the_third(self: object, block: np.ndarray, *args: object, **named: object) -> None:
        written.append(block)
        if len(written) != 3:
            real(self, block, *args, **named)

    monkeypatch.setattr(geotiff.rasterio.io.DatasetWriter, "write", lose_the_third)
    with pytest.raises(OSError, match="not written whole"):
        write(tmp_path / "a.tif", values)


def test_a_damaged_raster_is_named(tmp_path: Path, values: np.ndarray) -> None:
    write(tmp_path / "a.tif", values)
    (tmp_path / "a.tif").write_bytes(b"II*\0")
    with pytest.raises(MapError, match=r"a\.tif is damaged"):
        read_geotiff(tmp_path / "a.tif")
    with pytest.raises(MapError, match=r"b\.tif is damaged or missing"):
        read_geotiff(tmp_path / "b.tif")
