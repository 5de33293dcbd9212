"""LAS, LAZ and COPC files in and LAZ files out; the only module that imports laspy.

Files are read in chunks, never whole. Coordinates come out in the file's own CRS and units: `geodesy.Projection` makes
metres of them.
"""

from __future__ import annotations

import glob as shell_glob
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import lazrs  # type: ignore[import-untyped]
import numpy as np

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.formats.las_crs import Record, crs_of_records
from crossloc3d_ros.formats.las_repair import count_note, find_repairs, open_repaired, true_count
from crossloc3d_ros.geodesy import parse_crs
from crossloc3d_ros.placement import names_heights, with_vertical
from crossloc3d_ros.types import AerialChunk, Float64Array, UInt8Array

SUFFIXES = (".las", ".laz")
"""What counts as an aerial file when a folder is given; COPC files end in .copc.laz."""

GROUND, LOW_NOISE, HIGH_NOISE = 2, 7, 18
"""ASPRS classes that the map cares about."""

# laspy and lazrs let the errors of their parts through when a file is damaged; lazrs may also panic.
_READ_ERRORS = (laspy.errors.LaspyException, lazrs.LazrsError, OSError, EOFError, ValueError, struct.error, MemoryError)

_SAMPLE_PLACES, _SAMPLE_POINTS = 9, 50
"""Places in a file, and points there, that tell where it lies whatever the box in its header says."""


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
    """(3,) in the file's units, as the header has it: it may be false."""
    maximum: Float64Array
    """(3,) in the file's units, as the header has it: it may be false."""
    metres_per_unit: float | None = None
    """Of x and y, set where the header names it apart from its CRS."""
    sample: Float64Array = field(default_factory=lambda: np.empty((0, 3)))
    """(N, 3) some points, from all over the file, in its units; empty where none could be read."""
    notes: tuple[str, ...] = ()
    """What is false in the header and was read around, a sentence each."""


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
    """Return the header of a file; `crs` replaces the CRS in it, but a unit of heights or a vertical CRS that only the
    file names is kept.

    Raises AerialDataError where the file cannot be read, or has no CRS and none is given.
    """
    try:
        with _open(path, laspy.LazBackend.Lazrs) as opened:
            header, notes = opened.reader.header, opened.notes
            point_count, minimum, maximum = opened.point_count, header.mins, header.maxs
            said = crs_of_records(_projection_records(opened.reader))
            sample = _sample(opened)
        size_bytes = path.stat().st_size
    except _READ_ERRORS as error:
        raise AerialDataError(f"{path} cannot be read as LAS or LAZ: {_reason(error)}") from error
    vertical_metres_per_unit, metres_per_unit = said.vertical_metres_per_unit, said.metres_per_unit
    if crs is not None:
        parse_crs(crs)
        vertical_metres_per_unit, metres_per_unit = said.heights_m, None
        if said.crs is not None:
            crs = with_vertical(crs, said.crs)
        if names_heights(crs):
            vertical_metres_per_unit = None
    elif said.crs is None:
        example = "" if "header" in said.problem else ", for instance --crs EPSG:28992"
        raise AerialDataError(f"{path} {said.problem}; set it with --crs{example}")
    return AerialHeader(
        path=path,
        point_count=point_count,
        size_bytes=size_bytes,
        crs=crs or said.crs or "",
        vertical_metres_per_unit=vertical_metres_per_unit,
        minimum=np.array(minimum, dtype=np.float64),
        maximum=np.array(maximum, dtype=np.float64),
        metres_per_unit=metres_per_unit,
        sample=sample,
        notes=notes + said.notes,
    )


def iter_chunks(path: Path, chunk_points: int = 1_000_000, *, threads: bool = True) -> Iterator[AerialChunk]:
    """Yield the file's points in its own units and order, `chunk_points` at a time, without the withheld ones.

    `threads` lets the decompressor use every core; leave it off where processes already do. Raises AerialDataError
    where the file is damaged or ends too early, naming how many of its points could be read.
    """
    backend = laspy.LazBackend.LazrsParallel if threads else laspy.LazBackend.Lazrs
    read, expected = 0, 0
    try:
        with _open(path, backend) as opened:
            expected = opened.point_count
            for record in opened.reader.chunk_iterator(chunk_points):
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


@dataclass(frozen=True)
class _Opened:
    """A file opened with what is false in its header read around."""

    reader: laspy.LasReader
    point_count: int
    chunks: list[tuple[int, int]] | None
    """Points and bytes of each chunk of a LAZ file; None where there is no table of them."""
    notes: tuple[str, ...]


@contextmanager
def _open(path: Path, backend: laspy.LazBackend) -> Iterator[_Opened]:
    repairs = find_repairs(path)
    with laspy.open(open_repaired(path, repairs), laz_backend=backend) as reader:
        chunks, chunk_points = _chunk_table(path, reader)
        point_count = int(reader.header.point_count)
        notes: tuple[str, ...] = ()
        if repairs is not None:
            point_count = true_count(path, repairs, chunks, chunk_points)
            note = count_note(repairs, point_count)
            notes = repairs.notes + ((note,) if note else ())
        reader.header.point_count = point_count
        yield _Opened(reader, point_count, chunks, notes)


def _chunk_table(path: Path, reader: laspy.LasReader) -> tuple[list[tuple[int, int]] | None, int | None]:
    """Return points and bytes of each chunk of a LAZ file, and the points of all but the last where they are equal.

    (None, None) where there is no table, as in a file whose writer was stopped; reading says what can be read then.
    """
    if not reader.header.are_points_compressed:
        return None, None
    try:
        vlr = lazrs.LazVlr(reader.header.vlrs.get("LasZipVlr")[0].record_data)
        with path.open("rb") as file:
            file.seek(reader.header.offset_to_point_data)
            chunks = [(int(points), int(size)) for points, size in lazrs.read_chunk_table(file, vlr)]
    except BaseException as error:
        if not isinstance(error, (*_READ_ERRORS, IndexError)) and type(error).__name__ != "PanicException":
            raise
        return None, None
    return chunks, None if vlr.uses_variable_size_chunks() else int(vlr.chunk_size())


def _sample(opened: _Opened) -> Float64Array:
    """Return some points (N, 3) from all over a file, none where it is damaged: reading it says so."""
    count = opened.point_count
    starts = [i * count // _SAMPLE_PLACES for i in range(_SAMPLE_PLACES)]
    if opened.chunks is not None:
        # Only the first points of a chunk come without decompressing those before them.
        edges = np.cumsum([0, *(points for points, _ in opened.chunks[:-1])])
        chosen = np.linspace(0, len(edges) - 1, min(len(edges), _SAMPLE_PLACES)).astype(int)
        starts = [int(edges[i]) for i in chosen] if len(edges) >= _SAMPLE_PLACES // 2 else starts[::4]
    found: list[Float64Array] = [np.empty((0, 3))]
    try:
        for start in dict.fromkeys(starts):
            if start < count:
                opened.reader.seek(start)
                record = opened.reader.read_points(_SAMPLE_POINTS)
                found.append(np.column_stack([np.asarray(record.x), np.asarray(record.y), np.asarray(record.z)]))
    except BaseException as error:
        if not isinstance(error, _READ_ERRORS) and type(error).__name__ != "PanicException":
            raise
    return np.concatenate(found)


def _projection_records(reader: laspy.LasReader) -> list[Record]:
    records = [*reader.header.vlrs, *(reader.evlrs or ())]
    return [Record(r.record_id, r.record_data_bytes()) for r in records if r.user_id == "LASF_Projection"]


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


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
