"""LAS, LAZ and COPC files in and LAZ files out; the only module that imports laspy.

Files are read in chunks, never whole. Coordinates come out in the file's own CRS and units: `geodesy.Projection` makes
metres of them.
"""

from __future__ import annotations

import glob as shell_glob
import logging
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import lazrs  # type: ignore[import-untyped]
import numpy as np
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.geodesy import crs_text, parse_crs
from crossloc3d_ros.types import AerialChunk, Float64Array, UInt8Array

_log = logging.getLogger(__name__)

SUFFIXES = (".las", ".laz")
"""What counts as an aerial file when a folder is given; COPC files end in .copc.laz."""

GROUND, LOW_NOISE, HIGH_NOISE = 2, 7, 18
"""ASPRS classes that the map cares about."""

# laspy and lazrs let the errors of their parts through when a file is damaged; lazrs may also panic.
_READ_ERRORS = (laspy.errors.LaspyException, lazrs.LazrsError, OSError, EOFError, ValueError, struct.error, MemoryError)

# GeoTIFF keys that hold the CRS in LAS 1.0 to 1.3, and the codes of their vertical units.
_GEOGRAPHIC_KEY, _PROJECTED_KEY, _VERTICAL_KEY, _VERTICAL_UNITS_KEY = 2048, 3072, 4096, 4099
_UNIT_METRES = {9001: 1.0, 9002: 0.3048, 9003: 1200.0 / 3937.0}
_ELLIPSOID_CODES = range(5001, 5034)


@dataclass(frozen=True, eq=False)
class AerialHeader:
    """The header of an aerial file."""

    path: Path
    point_count: int
    size_bytes: int
    crs: str
    """As `geodesy.parse_crs` takes it."""
    vertical_metres_per_unit: float | None
    """Set where the header names a vertical unit apart from its CRS."""
    minimum: Float64Array
    """(3,) in the file's units."""
    maximum: Float64Array
    """(3,) in the file's units."""


def expand_inputs(inputs: Sequence[str | Path]) -> list[Path]:
    """Return the files that `inputs` name, sorted, each once: files, folders (searched to the bottom), globs.

    Raises AerialDataError where an input names nothing, or names a file that is neither LAS nor LAZ.
    """
    found: dict[Path, None] = {}
    for item in inputs:
        path = Path(item)
        if path.is_dir():
            files = [p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()]
            if not files:
                raise AerialDataError(f"the folder {path} holds no .las or .laz file")
        elif path.is_file():
            files = [path]
        else:
            pattern = str(item)
            files = [p for p in map(Path, shell_glob.glob(pattern, recursive=True)) if p.is_file()]  # noqa: PTH207
            if not files:
                raise AerialDataError(f"no such file or folder: {item}")
        for file in files:
            if file.suffix.lower() not in SUFFIXES:
                raise AerialDataError(f"{file} is not an aerial file: its name ends neither in .las nor in .laz")
            found[file.absolute()] = None
    return sorted(found)


def read_header(path: Path, crs: str | None = None) -> AerialHeader:
    """Return the header of a file; `crs` replaces the CRS in it.

    Raises AerialDataError where the file cannot be read, or has no CRS and none is given.
    """
    try:
        with laspy.open(path) as reader:
            header = reader.header
            point_count, minimum, maximum = int(header.point_count), header.mins, header.maxs
            records = list(header.vlrs.get_by_id("LASF_Projection"))
            if reader.evlrs is not None:
                records += reader.evlrs.get_by_id("LASF_Projection")
        size_bytes = path.stat().st_size
    except _READ_ERRORS as error:
        raise AerialDataError(f"{path} cannot be read as LAS or LAZ: {_reason(error)}") from error
    vertical_metres_per_unit: float | None = None
    if crs is None:
        crs, vertical_metres_per_unit = _crs_of(path, records)
    else:
        parse_crs(crs)
    return AerialHeader(
        path=path,
        point_count=point_count,
        size_bytes=size_bytes,
        crs=crs,
        vertical_metres_per_unit=vertical_metres_per_unit,
        minimum=np.array(minimum, dtype=np.float64),
        maximum=np.array(maximum, dtype=np.float64),
    )


def iter_chunks(path: Path, chunk_points: int = 1_000_000, *, threads: bool = True) -> Iterator[AerialChunk]:
    """Yield the file's points in its own units and order, `chunk_points` at a time, without the withheld ones.

    `threads` lets the decompressor use every core; leave it off where processes already do. Raises AerialDataError
    where the file is damaged or ends too early, naming how many of its points could be read.
    """
    backend = laspy.LazBackend.LazrsParallel if threads else laspy.LazBackend.Lazrs
    read, expected = 0, 0
    try:
        with laspy.open(path, laz_backend=backend) as reader:
            expected = int(reader.header.point_count)
            for record in reader.chunk_iterator(chunk_points):
                read += len(record)
                yield _chunk(record)
    except BaseException as error:
        if not isinstance(error, _READ_ERRORS) and type(error).__name__ != "PanicException":
            raise
        raise AerialDataError(
            f"{path} is damaged: {read:,} of {expected:,} points could be read ({_reason(error)}); fetch it again"
        ) from error
    if read < expected:
        raise AerialDataError(f"{path} is truncated: it holds {read:,} of {expected:,} points; fetch it again")


class LazWriter:
    """Writes a LAZ file chunk by chunk (LAS where the name ends in .las), as a context manager.

    `scale` is the step of the stored coordinates in the CRS's units, 1e-7 for instance for degrees; heights beside
    degrees are stored to the millimetre. `offset` (3,) is subtracted before storing, by default the corner of the
    first chunk. `crs` None writes a file without CRS. The file appears under its name when it is whole, and not at
    all where the context ends with an error.
    """

    def __init__(
        self,
        path: Path,
        crs: str | None,
        *,
        scale: float = 0.01,
        offset: Float64Array | None = None,
        point_format: int = 6,
        version: str = "1.4",
    ) -> None:
        self._path = path
        self._header = laspy.LasHeader(point_format=point_format, version=version)
        self._header.generating_software = "crossloc3d_ros"
        steps = np.full(3, scale)
        if crs is not None:
            parsed = parse_crs(crs)
            self._header.add_crs(parsed, keep_compatibility=False)
            if parsed.is_geographic:
                steps[2] = max(scale, 0.001)
        self._header.scales = steps
        self._offset = offset
        self._writer: laspy.LasWriter | None = None
        self._open_files = ExitStack()

    def __enter__(self) -> LazWriter:
        self._partial = self._open_files.enter_context(atomic_path(self._path, None))
        self._open_files.push(self._close)
        return self

    def __exit__(self, *raised: Any) -> None:
        self._open_files.__exit__(*raised)

    def _close(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._writer is None and kind is None:
            self._open(np.zeros((1, 3)))
        if self._writer is not None:
            self._writer.close()

    def write(self, points: Float64Array, classification: UInt8Array) -> None:
        """Append points (N, 3) and their classes (N,)."""
        if len(points) == 0:
            return
        if self._writer is None:
            self._open(points)
        record = laspy.ScaleAwarePointRecord.zeros(len(points), header=self._header)
        record.x, record.y, record.z = points[:, 0], points[:, 1], points[:, 2]
        record.classification = classification
        self._writer.write_points(record)  # type: ignore[union-attr]

    def _open(self, points: Float64Array) -> None:
        self._header.offsets = np.floor(points.min(axis=0)) if self._offset is None else self._offset
        compress = self._path.suffix.lower() == ".laz"
        self._writer = laspy.open(self._partial, mode="w", header=self._header, do_compress=compress)


def write_laz(
    path: Path,
    points: Float64Array,
    classification: UInt8Array,
    crs: str | None,
    *,
    scale: float = 0.01,
    point_format: int = 6,
    version: str = "1.4",
) -> None:
    """Write points (N, 3) and their classes (N,) as one file; see `LazWriter`."""
    with LazWriter(path, crs, scale=scale, point_format=point_format, version=version) as writer:
        writer.write(points, classification)


def _chunk(record: Any) -> AerialChunk:
    points = np.column_stack([np.asarray(record.x), np.asarray(record.y), np.asarray(record.z)])
    classification = np.array(record.classification, dtype=np.uint8)
    withheld = np.asarray(record.withheld, dtype=bool)
    if withheld.any():
        points, classification = points[~withheld], classification[~withheld]
    return AerialChunk(points, classification)


def _crs_of(path: Path, records: list[Any]) -> tuple[str, float | None]:
    """Return the CRS of a file's records and, where they name one apart, its metres per vertical unit."""
    for record in records:
        if isinstance(record, WktCoordinateSystemVlr) and record.string.strip("\0 \n"):
            try:
                return crs_text(parse_crs(record.string.strip("\0 \n"))), None
            except AerialDataError as error:
                raise AerialDataError(f"the header of {path}: {error}; set it with --crs") from error
    for record in records:
        if isinstance(record, GeoKeyDirectoryVlr):
            return _crs_of_geokeys(path, record)
    raise AerialDataError(f"{path} names no CRS; set it with --crs, for instance --crs EPSG:28992")


def _crs_of_geokeys(path: Path, record: GeoKeyDirectoryVlr) -> tuple[str, float | None]:
    keys = {int(k.id): int(k.value_offset) for k in record.geo_keys if k.tiff_tag_location == 0}
    horizontal = next((c for c in (keys.get(_PROJECTED_KEY), keys.get(_GEOGRAPHIC_KEY)) if _is_epsg(c)), None)
    if horizontal is None or keys.get(_PROJECTED_KEY, 0) == 32767:
        raise AerialDataError(f"the header of {path} describes a CRS without an EPSG code; set it with --crs")
    unit = _UNIT_METRES.get(keys.get(_VERTICAL_UNITS_KEY, 0))
    vertical = keys.get(_VERTICAL_KEY)
    try:
        crs = parse_crs(f"EPSG:{horizontal}")
    except AerialDataError as error:
        raise AerialDataError(f"the header of {path}: {error}; set it with --crs") from error
    if vertical is None or not _is_epsg(vertical):
        return crs_text(crs), unit
    try:
        return crs_text(parse_crs(f"EPSG:{horizontal}+{vertical}")), unit
    except AerialDataError:
        if vertical in _ELLIPSOID_CODES:
            return crs_text(crs.to_3d()), unit
        _log.warning("the vertical CRS %d in the header of %s is unknown and left aside", vertical, path)
        return crs_text(crs), unit


def _is_epsg(code: int | None) -> bool:
    return code is not None and 1024 <= code <= 32766


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
