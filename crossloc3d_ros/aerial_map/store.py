"""The aerial map on disk: a folder that describes itself, and is either whole or not there.

manifest.json      what the map is, how it was made, and the checksum of every other file
descriptors.faiss  one descriptor a submap
submaps.npy        one row a submap: easting, northing, ground height, number of points
terrain.tif        the ground as GeoTIFF, holes filled
surface.tif        the highest point of each cell as GeoTIFF
lowest.tif         the lowest point of each cell as GeoTIFF: whether pulses got through to the ground
support.tif        the number of points of each cell as GeoTIFF; maps of before this file was written lack it

Beside them may lie what `localizability` leaves: see `aerial_map.calibration`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from crossloc3d_ros.aerial_map.calibration import MapCalibration, manifest_digest, read_calibration
from crossloc3d_ros.aerial_map.consistency import check_echoes, check_placement, check_submaps
from crossloc3d_ros.aerial_map.coverage import Coverage
from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.aerial_map.geotiff import read_geotiff
from crossloc3d_ros.clouds.raster import Bounds, Raster
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig, from_dict
from crossloc3d_ros.errors import ConfigError, MapError
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.placement import DatumAccuracy
from crossloc3d_ros.types import Float64Array, Int32Array

FORMAT = "crossloc3d map"
FORMAT_VERSION = 2  # raised when the files change in a way that older readers cannot read

MANIFEST, DESCRIPTORS, SUBMAPS = "manifest.json", "descriptors.faiss", "submaps.npy"
TERRAIN, SURFACE, LOWEST = "terrain.tif", "surface.tif", "lowest.tif"
DATA_FILES = (DESCRIPTORS, SUBMAPS, TERRAIN, SURFACE, LOWEST)
SUPPORT = "support.tif"
OPTIONAL_FILES = (SUPPORT,)
"""Files that a map may lack; where its manifest names them they must be there, and whole."""

SUBMAP_DTYPE = np.dtype([("easting", "<f8"), ("northing", "<f8"), ("ground_height", "<f8"), ("points", "<i4")])

GroundMethod = Literal["classes", "filter", "classes and filter"]


@dataclass(frozen=True)
class BuildCounts:
    """What became of the survey's points and of the centres on the submaps' grid."""

    points_in_files: int = 0
    points_withheld: int = 0
    points_noise: int = 0
    """ASPRS classes 7 and 18."""
    points_stray: int = 0
    """Coordinates that are no place on Earth, or that lie alone far from everything else."""
    points_used: int = 0
    tiles: int = 0
    submaps: int = 0
    submaps_with_too_few_points: int = 0
    """Left out: less than `min_points` above the ground, such as fields and water."""
    submaps_outside_survey: int = 0
    """Left out: less than `min_coverage` of the submap was flown over."""


@dataclass(frozen=True)
class SourceRecord:
    """One file that the map was made from."""

    name: str
    size_bytes: int
    points: int
    crs: str
    ground: GroundMethod
    """Where its ground points come from."""


@dataclass(frozen=True)
class FileRecord:
    """One file of the map."""

    name: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """What a map is and how it was made."""

    crs: str
    """The UTM zone, such as EPSG:32631."""
    origin: tuple[float, ...]
    """Easting, northing, height of the origin of the ENU frame `map`, metres."""
    bounds: tuple[float, ...]
    """Min easting, min northing, max easting, max northing of the rasters, metres."""
    vertical_reference: str
    """The survey's vertical reference; `unknown` where its files name none."""
    geoid_separation_m: float | None
    """Ellipsoidal height minus the map's height; null where not known."""
    encoder_fingerprint: str
    descriptor_size: int
    preprocessing: PreprocessingConfig
    build: BuildConfig
    ground: GroundMethod
    counts: BuildCounts
    sources: tuple[SourceRecord, ...]
    files: tuple[FileRecord, ...]
    created: str
    """UTC, ISO 8601."""
    software: str
    coverage: Coverage | None = None
    """How densely and how completely the survey covers the map; null in maps that were not asked."""
    datum: DatumAccuracy | None = None
    """How well places in the survey's CRS are known in WGS84; null in maps that were not asked."""
    format: str = FORMAT
    format_version: int = FORMAT_VERSION


@dataclass(frozen=True, eq=False)
class SubmapTable:
    """Where the submaps are; row i belongs to descriptor i."""

    grid: Float64Array
    """(M, 3) easting, northing, ground height of the centres, metres, grid frame."""
    point_counts: Int32Array
    """(M,) points above the ground that each submap was chosen from."""

    def __len__(self) -> int:
        return len(self.grid)


@dataclass(frozen=True, eq=False)
class AerialMap:
    """A map, ready to be searched."""

    path: Path
    manifest: Manifest
    frame: MapFrame
    submaps: SubmapTable
    index: DescriptorMap
    terrain_path: Path = field(default_factory=Path)
    surface_path: Path = field(default_factory=Path)
    lowest_path: Path = field(default_factory=Path)
    support_path: Path | None = None
    """None where the map has no such file."""
    calibration: MapCalibration | None = None
    """What log likelihoods mean on it; None where it was not calibrated, or the calibration cannot be used."""
    calibration_fault: str = ""
    """Why the calibration in its folder cannot be used; empty where there is none, or nothing is wrong with it."""

    @property
    def bounds(self) -> Bounds:
        """Min easting, min northing, max easting, max northing, metres."""
        west, south, east, north = self.manifest.bounds
        return west, south, east, north

    @property
    def preprocessing(self) -> PreprocessingConfig:
        """The preprocessing that its submaps were made with."""
        return self.manifest.preprocessing

    def terrain(self, bounds: Bounds | None = None) -> Raster:
        """Read the terrain, or a part of it."""
        return read_geotiff(self.terrain_path, bounds)

    def surface(self, bounds: Bounds | None = None) -> Raster:
        """Read the surface, or a part of it."""
        return read_geotiff(self.surface_path, bounds)

    def lowest(self, bounds: Bounds | None = None) -> Raster:
        """Read the lowest echoes, or a part of them."""
        return read_geotiff(self.lowest_path, bounds)

    def support(self, bounds: Bounds | None = None) -> Raster | None:
        """Read how many echoes each cell has, or a part of it: 0 where there is none; None where the map lacks it."""
        return None if self.support_path is None else read_geotiff(self.support_path, bounds)

    @classmethod
    def load(cls, path: str | Path, encoder_fingerprint: str | None = None) -> AerialMap:
        """Open a map folder, checking version, checksums, that it agrees with itself, and, where given, its encoder.

        Raises MapError with a sentence that says what to do.
        """
        folder = Path(path)
        manifest = read_manifest(folder)
        if encoder_fingerprint is not None and manifest.encoder_fingerprint != encoder_fingerprint:
            raise MapError(
                f"the map {folder} was made by other weights (encoder {manifest.encoder_fingerprint[:12]}, these are "
                f"{encoder_fingerprint[:12]}): give the weights that made it, or build it again with "
                f"'build_map FILES... --output {folder} --overwrite' and these weights"
            )
        check_files(folder, manifest)
        submaps = read_submaps(folder / SUBMAPS)
        index = DescriptorMap.load(folder / DESCRIPTORS)
        if len(index) != len(submaps) or index.descriptor_size != manifest.descriptor_size:
            raise MapError(
                f"the map {folder} does not agree with itself: {len(submaps)} submaps and {len(index)} descriptors; "
                "build it again"
            )
        frame = MapFrame(manifest.crs, np.array(manifest.origin), manifest.geoid_separation_m)
        support = folder / SUPPORT if any(record.name == SUPPORT for record in manifest.files) else None
        rasters = (folder / TERRAIN, folder / SURFACE, folder / LOWEST, support)
        opened = cls(folder, manifest, frame, submaps, index, *rasters, *_calibration_of(folder))
        opened._check()
        return opened

    def _check(self) -> None:
        """Raise MapError where manifest, rasters and submaps are not of one map."""
        manifest, grid = self.manifest, self.submaps.grid
        rasters = [self.terrain_path, self.surface_path, self.lowest_path]
        rasters += [] if self.support_path is None else [self.support_path]
        check_placement(self.path, manifest.crs, self.bounds, manifest.build.cell_m, manifest.origin, rasters)
        check_submaps(self.path, grid, self.bounds, manifest.preprocessing.half_extent_m, self.terrain_path)
        check_echoes(self.path, grid, self.surface_path, self.lowest_path, self.support_path)


def _calibration_of(folder: Path) -> tuple[MapCalibration | None, str]:
    """Return the calibration of a map, or why the one in its folder is left aside."""
    try:
        return read_calibration(folder, manifest_digest(folder / MANIFEST)), ""
    except MapError as error:
        return None, str(error)


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a map folder; MapError where there is none, or one of another version."""
    file = folder / MANIFEST
    if not file.is_file():
        what = "is no map: it has no manifest.json" if folder.is_dir() else "does not exist"
        raise MapError(f"the map folder {folder} {what}; build one with 'build_map FILES... --output {folder}'")
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise MapError(f"{file} is damaged ({error}); copy the map again or build it anew") from error
    if not isinstance(values, Mapping) or values.get("format") != FORMAT:
        raise MapError(f"{file} is not the manifest of a {FORMAT}")
    version = values.get("format_version")
    if version != FORMAT_VERSION:
        newer = isinstance(version, int) and version > FORMAT_VERSION
        advice = "update crossloc3d_ros" if newer else "build the map again"
        raise MapError(f"the map {folder} has format version {version}, this is for {FORMAT_VERSION}: {advice}")
    try:
        manifest = from_dict(Manifest, values)
    except (ConfigError, TypeError) as error:
        raise MapError(f"{file} is damaged ({error}); copy the map again or build it anew") from error
    if len(manifest.origin) != 3 or len(manifest.bounds) != 4:
        raise MapError(f"{file} is damaged (origin or bounds); copy the map again or build it anew")
    return manifest


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest into a map folder."""
    text = json.dumps(dataclasses.asdict(manifest), indent=2, allow_nan=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def file_records(folder: Path) -> tuple[FileRecord, ...]:
    """Return sizes and checksums of the data files of a map folder."""
    names = [*DATA_FILES, *(name for name in OPTIONAL_FILES if (folder / name).is_file())]
    return tuple(FileRecord(name, (folder / name).stat().st_size, sha256(folder / name)) for name in names)


def check_files(folder: Path, manifest: Manifest) -> None:
    """Raise MapError where a file of the map is missing, of another size or of another content than it was."""
    advice = "copy the map again or build it anew"
    records = {record.name: record for record in manifest.files}
    for name in (*DATA_FILES, *(name for name in OPTIONAL_FILES if name in records)):
        record, file = records.get(name), folder / name
        if record is None or not file.is_file():
            raise MapError(f"the map {folder} lacks its file {name}; {advice}")
        size = file.stat().st_size
        if size != record.size_bytes:
            kind = "truncated" if size < record.size_bytes else "damaged"
            raise MapError(f"{file} is {kind}: it has {size:,} bytes instead of {record.size_bytes:,}; {advice}")
        if sha256(file) != record.sha256:
            raise MapError(f"{file} is damaged: its checksum is not the one in the manifest; {advice}")


def sha256(path: Path) -> str:
    """Return the checksum of a file as 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_submaps(path: Path) -> SubmapTable:
    """Return the table of submaps; MapError where it is damaged."""
    try:
        rows: Any = np.load(path, allow_pickle=False)
    except (ValueError, OSError) as error:
        raise MapError(f"{path} is damaged ({error}); copy the map again or build it anew") from error
    if rows.dtype != SUBMAP_DTYPE:
        raise MapError(f"{path} is damaged (columns {rows.dtype}); copy the map again or build it anew")
    grid = np.column_stack([rows["easting"], rows["northing"], rows["ground_height"]])
    return SubmapTable(grid, rows["points"].astype(np.int32))
