"""A town of boxes that stand askew, its aerial map, and scans of it with no error but those of the cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.aerial_map.geotiff import write_geotiff
from crossloc3d_ros.aerial_map.store import AerialMap, BuildCounts, Manifest, SubmapTable
from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import Float32Array, Float64Array, ScanCounts

CRS = "EPSG:32631"
WEST, SOUTH, SIDE_M = 628_000.0, 5_803_000.0, 280.0
SENSOR_HEIGHT_M = 1.3


@dataclass(frozen=True)
class BoxTown:
    """Boxes on a plane at the height 5 m."""

    boxes: Float64Array
    """(B, 6) easting and northing of the middle from the south-west corner, half length, half width, angle, height."""

    def height(self, x: Float64Array, y: Float64Array) -> Float64Array:
        """Return how high the boxes stand at places (N,), 0 on the street."""
        highest = np.zeros(x.shape)
        for bx, by, a, b, angle, height in self.boxes:
            c, s = np.cos(angle), np.sin(angle)
            u, v = c * (x - bx) + s * (y - by), -s * (x - bx) + c * (y - by)
            highest[(abs(u) <= a) & (abs(v) <= b)] = height
        return highest

    def street(self, rng: np.random.Generator, clear_m: float = 4.0, border_m: float = 60.0) -> tuple[float, float]:
        """Return a place that no box is near, metres from the south-west corner."""
        ring = clear_m * np.exp(1j * np.linspace(0, 2 * np.pi, 16))
        while True:
            x, y = rng.uniform(border_m, SIDE_M - border_m, 2)
            if self.height(np.append(x + ring.real, x), np.append(y + ring.imag, y)).max() == 0.0:
                return float(x), float(y)

    def place(self, x: float, y: float, heading: float, rng: np.random.Generator | None = None) -> Float32Array:
        """Return what 16 rings see from (x, y), without noise: x forward, y left, z above the ground."""
        start = 0.0 if rng is None else float(rng.uniform(0, 1))
        azimuth = 2 * np.pi * (np.arange(900) + start) / 900
        elevation = np.radians(np.arange(-15.0, 16.0, 2.0))
        a, e = (v.ravel() for v in np.meshgrid(azimuth, elevation, indexing="ij"))
        rays = np.column_stack([np.cos(e) * np.cos(a + heading), np.cos(e) * np.sin(a + heading), np.sin(e)])
        nearest = np.full(len(rays), np.inf)
        down = rays[:, 2] < 0
        nearest[down] = -SENSOR_HEIGHT_M / rays[down, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            for bx, by, half, width, angle, height in self.boxes:
                c, s = np.cos(angle), np.sin(angle)
                origin = np.array([c * (x - bx) + s * (y - by), -s * (x - bx) + c * (y - by), SENSOR_HEIGHT_M])
                turned = rays @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
                t0 = (np.array([-half, -width, -1.0]) - origin) / turned
                t1 = (np.array([half, width, height]) - origin) / turned
                enter, leave = np.minimum(t0, t1).max(axis=1), np.maximum(t0, t1).min(axis=1)
                hit = (enter < leave) & (enter > 0)
                nearest[hit] = np.minimum(nearest[hit], enter[hit])
        seen = nearest < 100.0
        c, s = np.cos(heading), np.sin(heading)
        points = nearest[seen, None] * rays[seen] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        points[:, 2] += SENSOR_HEIGHT_M
        return points.astype(np.float32)

    def scan(self, x: float, y: float, heading: float, rng: np.random.Generator | None = None) -> PreparedScan:
        """Return the same as the localizer prepares it."""
        place = self.place(x, y, heading, rng)
        return PreparedScan(None, ScanCounts(), "", place, place[:, 2].copy(), SENSOR_HEIGHT_M)

    def surface(self, cell_m: float = 1.0) -> Float32Array:
        """Return the highest of 16 points of each cell (H, W), row 0 in the north, metres above the sea."""
        return self._points(cell_m).max(axis=(1, 3))

    def lowest(self, cell_m: float = 1.0) -> Float32Array:
        """Return the lowest of them."""
        return self._points(cell_m).min(axis=(1, 3))

    def _points(self, cell_m: float) -> Float32Array:
        cells, fine = round(SIDE_M / cell_m), (np.arange(4 * round(SIDE_M / cell_m)) + 0.5) * cell_m / 4
        x, y = np.meshgrid(fine, fine[::-1])
        return (self.height(x.ravel(), y.ravel()) + 5.0).reshape(cells, 4, cells, 4).astype(np.float32)


def make_map(
    folder: Path, terrain: Float32Array, surface: Float32Array, west: float = WEST, south: float = SOUTH,
    cell_m: float = 1.0, lowest: Float32Array | None = None,
) -> AerialMap:  # fmt: skip
    """Write rasters (H, W), row 0 in the north, as a map without any submap worth the name.

    Without `lowest` no pulse gets through what stands above the terrain.
    """
    folder.mkdir(parents=True, exist_ok=True)
    bounds = (west, south, west + terrain.shape[1] * cell_m, south + terrain.shape[0] * cell_m)
    north = bounds[3]
    for name, values in (("terrain", terrain), ("surface", surface), ("lowest", surface if lowest is None else lowest)):

        def block(part: tuple[float, float, float, float], values: Float32Array = values) -> Float32Array:
            row, column = round((north - part[3]) / cell_m), round((part[0] - west) / cell_m)
            height, width = round((part[3] - part[1]) / cell_m), round((part[2] - part[0]) / cell_m)
            return values[row : row + height, column : column + width]

        write_geotiff(folder / f"{name}.tif", bounds, cell_m, CRS, block, name)
    manifest = Manifest(
        crs=CRS, origin=(west, south, 2.0), bounds=bounds, vertical_reference="unknown", geoid_separation_m=None,
        encoder_fingerprint="none", descriptor_size=1, preprocessing=PreprocessingConfig(), build=BuildConfig(),
        ground="classes", counts=BuildCounts(), sources=(), files=(), created="", software="",
    )  # fmt: skip
    frame = MapFrame(CRS, np.array(manifest.origin))
    submaps = SubmapTable(np.array([[west, south, 5.0]]), np.ones(1, np.int32))
    index = DescriptorMap(np.zeros((1, 1), np.float32))
    rasters = (folder / f"{name}.tif" for name in ("terrain", "surface", "lowest"))
    return AerialMap(folder, manifest, frame, submaps, index, *rasters)


@pytest.fixture(scope="session")
def box_town() -> BoxTown:
    """Build some fifty boxes, each at an angle of its own."""
    rng = np.random.default_rng(12)
    boxes: list[list[float]] = []
    while len(boxes) < 50:
        box = [*rng.uniform(10, SIDE_M - 10, 2), *rng.uniform(3, 9, 2), rng.uniform(0, np.pi), rng.uniform(3, 14)]
        if all(np.hypot(box[0] - b[0], box[1] - b[1]) > 20.0 for b in boxes):
            boxes.append(box)
    return BoxTown(np.array(boxes))


@pytest.fixture(scope="session")
def box_map(box_town: BoxTown, tmp_path_factory: pytest.TempPathFactory) -> AerialMap:
    """Map the boxes as a survey would."""
    surface = box_town.surface()
    return make_map(tmp_path_factory.mktemp("box_town"), np.full_like(surface, 5.0), surface, lowest=box_town.lowest())


@pytest.fixture(scope="session")
def map_of() -> Callable[..., AerialMap]:
    """Give the maker of maps."""
    return make_map
