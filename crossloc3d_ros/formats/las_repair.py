"""What is false in the header of a LAS or LAZ file although its points are whole: found, said, and read around.

laspy believes the header: a false number of records makes it read for minutes, text that is not UTF-8 makes it refuse
the file, and of the points it reads as many as the header counts.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from crossloc3d_ros.errors import AerialDataError

_HEADER = struct.Struct("<4s20x2B68xHIIBHI5I3d3d")
"""Signature, version, header size, offset to points, records, format, point size, count, counts by return, scales,
offsets."""
_LEGACY = _HEADER.size + 48
"""Size of the headers of LAS 1.0 to 1.2: six bounds follow."""
_WAVEFORM_AT, _EXTENDED_AT, _COUNT_AT = 227, 235, 247
_RECORD, _EXTENDED_RECORD = struct.Struct("<2x16sHH32s"), struct.Struct("<2x16sHQ32s")
_EXTRA_BYTES = (b"LASF_Spec", 4)
_INTERNAL_WAVEFORMS = 2
_MOST_HEADER_BYTES = 1 << 26


@dataclass(frozen=True)
class RawHeader:
    """The parts of a header that its file can contradict."""

    version_minor: int
    header_size: int
    points_at: int
    records: int
    is_compressed: bool
    point_size: int
    count: int
    legacy_count: int
    counted_by_return: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    extended_at: int
    extended_records: int
    points_end: int
    """Where the points of a file that is not compressed end at the latest."""


@dataclass(frozen=True)
class Repairs:
    """What was found in a file, and what has to be read instead."""

    header: RawHeader
    overlays: tuple[tuple[int, bytes], ...]
    """Places in the file and the bytes that belong there."""
    notes: tuple[str, ...]
    """What a user must know, a sentence each."""

    @property
    def point_count(self) -> int:
        """Points by the header; in LAS 1.4 of the old field where the new one is empty."""
        return self.header.count or self.header.legacy_count


def find_repairs(path: Path) -> Repairs | None:
    """Return what is false in a file's header; None where it is no LAS file at all, which laspy explains.

    Raises AerialDataError where the header cannot be read around.
    """
    with path.open("rb") as file:
        header = _read_raw(file, path)
        if header is None:
            return None
        _check_numbers(path, header)
        overlays, notes = list(_records(file, header)), []
        kept = sum(1 for _ in _walk(file, header, extended=False))
        if kept < header.records:
            overlays.append((100, struct.pack("<I", kept)))
            notes.append(f"its header counts {header.records:,} records, {kept:,} are there")
        kept = sum(1 for _ in _walk(file, header, extended=True))
        if kept < header.extended_records:
            overlays.append((243, struct.pack("<I", kept)))
            notes.append(f"its header counts {header.extended_records:,} extended records, {kept:,} are there")
    return Repairs(header, tuple(overlays), tuple(notes))


def open_repaired(path: Path, repairs: Repairs | None) -> BinaryIO:
    """Open a file for reading, with what belongs there in place of what is false."""
    if repairs is None or not repairs.overlays:
        return path.open("rb")
    return io.BufferedReader(_Overlaid(path, repairs.overlays), 1 << 20)


def true_count(path: Path, repairs: Repairs, chunks: list[tuple[int, int]] | None, chunk_points: int | None) -> int:
    """Return how many points a file holds, whatever its header counts.

    `chunks`: points and bytes of each chunk of a LAZ file; `chunk_points` in all but the last of them, None where they
    differ. Raises AerialDataError where that cannot be told.
    """
    header, counted = repairs.header, repairs.point_count
    if not header.is_compressed:
        return _count_in_las(path, header, counted)
    if chunks is None:
        return counted
    if chunk_points is None:
        return sum(points for points, _ in chunks)
    if not chunks and counted == 0:
        return 0
    least, most = (len(chunks) - 1) * chunk_points + 1, len(chunks) * chunk_points
    for count in (counted, header.legacy_count, header.counted_by_return):
        if least <= count <= most:
            return count
    if counted > most:
        return counted  # the file ends early, and reading says so
    raise AerialDataError(
        f"the header of {path} counts {counted:,} points, its table of chunks holds {least:,} to {most:,}: write it "
        "anew with the tool that made it, for instance 'las2las -i FILE -o NEW', or fetch it again"
    )


def _count_in_las(path: Path, header: RawHeader, counted: int) -> int:
    there, rest = divmod(header.points_end - header.points_at, header.point_size)
    if there <= counted:
        return counted  # less than counted: reading says that the file ends early
    if rest and counted == 0:
        raise AerialDataError(
            f"the header of {path} counts no points, and the {header.points_end - header.points_at:,} bytes behind it "
            f"are no whole number of points of {header.point_size} bytes: the file is damaged; fetch it again"
        )
    return counted if rest else there


def count_note(repairs: Repairs, true: int) -> str:
    """Return what there is to say of the number of points, or ''."""
    header = repairs.header
    if true != header.count:
        field = "" if header.count or not header.legacy_count else " in the field of LAS 1.4"
        return f"its header counts {header.count:,} points{field}, {true:,} are there and read"
    surplus = header.points_end - header.points_at - true * header.point_size
    if not header.is_compressed and surplus >= header.point_size:
        return f"{surplus:,} bytes follow its last point, which are no points by its header, and are left unread"
    if header.counted_by_return > true:
        return f"its header counts {true:,} points and {header.counted_by_return:,} by return; {true:,} are read"
    return ""


def _read_raw(file: BinaryIO, path: Path) -> RawHeader | None:
    head = file.read(375)
    if len(head) < _LEGACY or head[:4] != b"LASF":
        return None
    _, _, minor, header_size, points_at, records, kind, point_size, count, *rest = _HEADER.unpack_from(head)
    size = path.stat().st_size
    points_end, legacy, by_return = size, count, sum(rest[:5])
    extended_at = extended = 0
    if minor >= 3 and len(head) >= _EXTENDED_AT:
        (waveforms_at,) = struct.unpack_from("<Q", head, _WAVEFORM_AT)
        if head[6] & _INTERNAL_WAVEFORMS and waveforms_at > points_at:
            points_end = min(points_end, waveforms_at)
    if minor >= 4 and len(head) >= 375:
        extended_at, extended, count = struct.unpack_from("<QIQ", head, _EXTENDED_AT)
        by_return = max(by_return, sum(struct.unpack_from("<15Q", head, _COUNT_AT + 8)))
        if extended and extended_at > points_at:
            points_end = min(points_end, extended_at)
    return RawHeader(
        version_minor=minor, header_size=header_size, points_at=points_at, records=records,
        is_compressed=bool(kind & 0x80), point_size=point_size, count=count, legacy_count=legacy,
        counted_by_return=by_return, scales=tuple(rest[5:8]), offsets=tuple(rest[8:11]),
        extended_at=extended_at, extended_records=extended, points_end=points_end,
    )  # fmt: skip


def _check_numbers(path: Path, header: RawHeader) -> None:
    for name, values in (("scale", header.scales), ("offset", header.offsets)):
        if not np.isfinite(values).all() or (name == "scale" and 0.0 in values):
            numbers = ", ".join(f"{value:g}" for value in values)
            raise AerialDataError(
                f"the header of {path} has the {name} {numbers} for x, y, z: its coordinates are lost; fetch the file "
                "again, or have it written anew from its source"
            )
    if header.point_size == 0 or header.points_at > _MOST_HEADER_BYTES:
        raise AerialDataError(
            f"the header of {path} is damaged: points of {header.point_size} bytes from byte {header.points_at:,} on; "
            "fetch the file again"
        )


def _walk(file: BinaryIO, header: RawHeader, *, extended: bool) -> Iterator[tuple[int, bytes, int]]:
    """Yield place, user id and record id of the records that are there in whole."""
    form = _EXTENDED_RECORD if extended else _RECORD
    size = file.seek(0, io.SEEK_END)
    at = header.extended_at if extended else header.header_size
    end = size if extended else min(header.points_at, size)
    for _ in range(header.extended_records if extended else header.records):
        file.seek(at)
        head = file.read(form.size)
        if len(head) < form.size:
            return
        user, record_id, length, _ = form.unpack(head)
        if at + form.size + length > end:
            return
        yield at, user, record_id
        at += form.size + length


def _records(file: BinaryIO, header: RawHeader) -> Iterator[tuple[int, bytes]]:
    """Yield what to put in place of text in the records that is neither ASCII nor read by anybody here."""
    for extended in (False, True):
        form = _EXTENDED_RECORD if extended else _RECORD
        for at, user, record_id in _walk(file, header, extended=extended):
            if not user.isascii():
                yield at + 2, _ascii(user)
            if (user.rstrip(b"\0"), record_id) == _EXTRA_BYTES:
                file.seek(at + form.size)
                body = file.read(form.unpack(_at(file, at, form.size))[2])
                for start in range(0, len(body) // 192 * 192, 192):
                    for low, high in ((start + 4, start + 36), (start + 160, start + 192)):
                        if not body[low:high].isascii():
                            yield at + form.size + low, _ascii(body[low:high])


def _at(file: BinaryIO, at: int, size: int) -> bytes:
    file.seek(at)
    return file.read(size)


def _ascii(text: bytes) -> bytes:
    return bytes(letter if letter < 128 else ord("?") for letter in text)


class _Overlaid(io.RawIOBase):
    """A file in which some bytes read as others."""

    def __init__(self, path: Path, overlays: tuple[tuple[int, bytes], ...]) -> None:
        self._file = path.open("rb", buffering=0)
        self._overlays = overlays

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        start = self._file.tell()
        read = self._file.readinto(buffer)
        for at, content in self._overlays:
            low, high = max(at, start), min(at + len(content), start + read)
            if low < high:
                buffer[low - start : high - start] = content[low - at : high - at]
        return read

    def close(self) -> None:
        self._file.close()
        super().close()
