"""The survey's points sorted into tiles on disk, so that a tile can be worked on without reading the survey again.

Each input file has a folder of its own in the spool, which appears under its name when the file was read to its end:
that is what makes the reading parallel, and what an interrupted build goes on from. In it lies one file a tile with
13 bytes a point: easting, northing from the tile's south-western corner and height as float32, and the class.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.formats.las import GROUND, HIGH_NOISE, LOW_NOISE, iter_chunks
from crossloc3d_ros.geodesy import Projection
from crossloc3d_ros.types import BoolArray, Float64Array, UInt8Array

POINT_DTYPE = np.dtype([("e", "<f4"), ("n", "<f4"), ("z", "<f4"), ("classification", "u1")])

TileKey = tuple[int, int]
"""Column and row: the tile reaches from (column, row) times its side to (column + 1, row + 1) times it."""

_REPORT = "report.json"

_CLASSIFIED_SHARE = 1e-3
"""A file whose points are ground to at least this share is taken as classified."""


@dataclass(frozen=True)
class SpoolTask:
    """One file to be read."""

    source: Path
    folder: Path
    point_count: int
    source_crs: str
    vertical_metres_per_unit: float | None
    target_crs: str
    tile_m: float
    chunk_points: int
    threads: bool
    """Whether the decompressor may use every core."""


@dataclass(frozen=True)
class SpoolReport:
    """What reading one file came to."""

    points_in_file: int
    points_withheld: int
    points_noise: int
    points_off_earth: int
    points_ground: int
    tiles: tuple[tuple[int, int, int], ...]
    """Column, row and number of points of each tile."""

    @property
    def points_kept(self) -> int:
        return sum(count for _, _, count in self.tiles)

    @property
    def classified(self) -> bool:
        """Whether the file has ground classes."""
        return self.points_ground > 0 and self.points_ground >= _CLASSIFIED_SHARE * self.points_kept


def spool_file(task: SpoolTask, advance: Callable[[int], None] | None = None) -> SpoolReport:
    """Read one file to its end and sort its points into tiles; `advance` counts the points read.

    Noise (classes 7 and 18), withheld points and coordinates off the Earth are dropped and counted.
    """
    with atomic_path(task.folder, None, parents=True) as partial:
        partial.mkdir()
        report = _spool_into(partial, task, advance or (lambda _: None))
        (partial / _REPORT).write_text(json.dumps(dataclasses.asdict(report)), encoding="utf-8")
    return report


def _spool_into(folder: Path, task: SpoolTask, advance: Callable[[int], None]) -> SpoolReport:
    projection = Projection(task.source_crs, task.target_crs, task.vertical_metres_per_unit)
    read = noise = off_earth = ground = 0
    tiles: dict[TileKey, int] = {}
    for chunk in iter_chunks(task.source, task.chunk_points, threads=task.threads):
        is_noise = (chunk.classification == LOW_NOISE) | (chunk.classification == HIGH_NOISE)
        points = projection(chunk.points)
        is_off_earth = np.isnan(points[:, 0]) & ~is_noise
        kept = ~(is_noise | is_off_earth)
        for key, rows in _split(points[kept], chunk.classification[kept], task.tile_m):
            with (folder / _file_name(key)).open("ab") as file:
                file.write(rows.tobytes())
            tiles[key] = tiles.get(key, 0) + len(rows)
        read += len(points)
        noise += int(is_noise.sum())
        off_earth += int(is_off_earth.sum())
        ground += int((chunk.classification[kept] == GROUND).sum())
        advance(len(points))
    return SpoolReport(
        points_in_file=task.point_count,
        points_withheld=task.point_count - read,
        points_noise=noise,
        points_off_earth=off_earth,
        points_ground=ground,
        tiles=tuple((column, row, count) for (column, row), count in sorted(tiles.items())),
    )


def read_report(folder: Path) -> SpoolReport | None:
    """Return what reading a file came to in an earlier run, or None where it was not read to its end."""
    try:
        values = json.loads((folder / _REPORT).read_text(encoding="utf-8"))
        report = SpoolReport(**{**values, "tiles": tuple((c, r, n) for c, r, n in values["tiles"])})
        for column, row, count in report.tiles:
            if (folder / _file_name((column, row))).stat().st_size != count * POINT_DTYPE.itemsize:
                return None
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return report


def tile_bounds(key: TileKey, tile_m: float) -> Bounds:
    """Return min easting, min northing, max easting, max northing of a tile."""
    return key[0] * tile_m, key[1] * tile_m, (key[0] + 1) * tile_m, (key[1] + 1) * tile_m


def tiles_touched(bounds: Bounds, tile_m: float) -> list[TileKey]:
    """Return the tiles that lie in bounds, wholly or in part, row by row."""
    columns = range(math.floor(bounds[0] / tile_m), math.ceil(bounds[2] / tile_m))
    rows = range(math.floor(bounds[1] / tile_m), math.ceil(bounds[3] / tile_m))
    return [(column, row) for row in rows for column in columns]


def read_points(
    sources: Sequence[tuple[Path, TileKey]], bounds: Bounds, tile_m: float
) -> tuple[Float64Array, UInt8Array, npt.NDArray[np.int32]]:
    """Return the spooled points inside bounds: (N, 3) grid coordinates, classes (N,), index of the source (N,).

    A source is an input file's folder in the spool and a tile.
    """
    points: list[Float64Array] = []
    classes: list[UInt8Array] = []
    origins: list[npt.NDArray[np.int32]] = []
    for index, (folder, key) in enumerate(sources):
        rows = np.fromfile(folder / _file_name(key), dtype=POINT_DTYPE)
        west, south = key[0] * tile_m, key[1] * tile_m
        e, n = rows["e"].astype(np.float64) + west, rows["n"].astype(np.float64) + south
        inside: BoolArray = (e >= bounds[0]) & (e < bounds[2]) & (n >= bounds[1]) & (n < bounds[3])
        points.append(np.column_stack([e[inside], n[inside], rows["z"][inside].astype(np.float64)]))
        classes.append(rows["classification"][inside])
        origins.append(np.full(np.count_nonzero(inside), index, dtype=np.int32))
    if not points:
        return np.empty((0, 3)), np.empty(0, np.uint8), np.empty(0, np.int32)
    return np.concatenate(points), np.concatenate(classes), np.concatenate(origins)


def _split(
    points: Float64Array, classification: UInt8Array, tile_m: float
) -> list[tuple[TileKey, npt.NDArray[np.void]]]:
    """Return the points of each tile as rows of the spool, in their order."""
    if len(points) == 0:
        return []
    cells = np.floor(points[:, :2] / tile_m).astype(np.int64)
    corner = cells.min(axis=0)
    span = cells[:, 0].max() - corner[0] + 1
    flat = (cells[:, 1] - corner[1]) * span + (cells[:, 0] - corner[0])
    order = np.argsort(flat, kind="stable")
    flat = flat[order]
    rows = np.empty(len(points), dtype=POINT_DTYPE)
    rows["e"] = (points[:, 0] - cells[:, 0] * tile_m)[order]
    rows["n"] = (points[:, 1] - cells[:, 1] * tile_m)[order]
    rows["z"] = points[order, 2]
    rows["classification"] = classification[order]
    starts = np.flatnonzero(np.diff(flat, prepend=-1))
    ends = np.append(starts[1:], len(flat))
    return [
        ((int(flat[a] % span + corner[0]), int(flat[a] // span + corner[1])), rows[a:b])
        for a, b in zip(starts, ends, strict=True)
    ]


def _file_name(key: TileKey) -> str:
    return f"{key[0]}_{key[1]}.bin"
