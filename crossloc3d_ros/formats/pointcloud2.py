"""`sensor_msgs/PointCloud2` to our scan and columns to its bytes; works on rclpy's and on rosbags' messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.types import PointTimes, Scan

POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy type of each number that `sensor_msgs/PointField` has for a type."""
TIME_FIELDS = ("time", "t", "timestamp", "offset_time")
"""What drivers call the time of a point: Velodyne, Ouster, Hesai, Livox."""
_NAMES = {1: "int8", 2: "uint8", 3: "int16", 4: "uint16", 5: "int32", 6: "uint32", 7: "float32", 8: "float64"}
POINT_FIELD_NUMBERS = {np.dtype(code): number for number, code in POINT_FIELD_TYPES.items()}


class _Stamp(Protocol):
    sec: int
    nanosec: int


class _Header(Protocol):
    @property
    def stamp(self) -> _Stamp: ...

    @property
    def frame_id(self) -> str: ...


class _Field(Protocol):
    name: str
    offset: int
    datatype: int
    count: int


class PointCloud2Like(Protocol):
    """What the messages of rclpy and of rosbags have in common."""

    height: int
    width: int
    is_bigendian: bool
    point_step: int
    row_step: int

    @property
    def header(self) -> _Header: ...

    @property
    def fields(self) -> Sequence[_Field]: ...

    @property
    def data(self) -> Any:
        """Bytes, array.array or ndarray of uint8."""


@dataclass(frozen=True, eq=False)
class PackedCloud:
    """The parts of a PointCloud2 that depend on its columns; little-endian, no padding."""

    fields: list[tuple[str, int, int, int]]
    """name, offset, datatype, count of each PointField."""
    point_step: int
    data: bytes


def scan_from_pointcloud2(msg: PointCloud2Like) -> Scan:
    """Return the message's points (N, 3) float32 in its own frame and order, NaN and all, with their times.

    Any field order, offset and padding, padded rows, float32 or float64 coordinates of either endianness, organised
    or not, further fields of any type. Raises CloudError that names what is wrong with the message.
    """
    point_step, row_step, width, height = (int(v) for v in (msg.point_step, msg.row_step, msg.width, msg.height))
    offsets, dtypes = zip(*[_coordinate(msg, axis) for axis in "xyz"], strict=True)
    if width < 0 or height < 0:
        raise CloudError(f"the cloud's size is negative: {height} x {width} points")
    stamp_ns = int(msg.header.stamp.sec) * 1_000_000_000 + int(msg.header.stamp.nanosec)
    if width == 0 or height == 0:
        return Scan(np.empty((0, 3), np.float32), stamp_ns, str(msg.header.frame_id))

    if height == 1:
        row_step = width * point_step  # some drivers leave row_step empty where there is one row only
    elif row_step < width * point_step:
        raise CloudError(f"row_step is {row_step} bytes, but {width} points of {point_step} bytes need more")
    buffer = _as_bytes(msg.data)
    needed = (height - 1) * row_step + width * point_step
    if len(buffer) < needed:
        raise CloudError(
            f"the cloud is cut short: {height} x {width} points need {needed:,} bytes, got {len(buffer):,}"
        )

    points = np.empty((height, width, 3), np.float32)
    together = dtypes[0].itemsize == 4 and offsets == (offsets[0], offsets[0] + 4, offsets[0] + 8)
    # One column of float32 triples is one strided copy instead of three.
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes infinite and is filtered later
        if together and dtypes[0] == dtypes[1] == dtypes[2]:
            points[:] = _column(buffer, dtypes[0], offsets[0], height, width, row_step, point_step, 3)
        else:
            for k in range(3):
                points[..., k] = _column(buffer, dtypes[k], offsets[k], height, width, row_step, point_step, 1)[..., 0]
    times = None
    field = next((f for name in TIME_FIELDS for f in msg.fields if f.name == name and int(f.count) <= 1), None)
    if field is not None and int(field.datatype) in POINT_FIELD_TYPES:
        offset, dtype = _place(msg, field)
        values = _column(buffer, dtype, offset, height, width, row_step, point_step, 1).reshape(-1)
        times = PointTimes(field.name, values.astype(dtype.newbyteorder("=")))
    return Scan(points.reshape(-1, 3), stamp_ns, str(msg.header.frame_id), times)


def pack_columns(columns: Mapping[str, npt.NDArray[Any]]) -> PackedCloud:
    """Pack columns (N,) of integers or floats into the bytes and fields of a PointCloud2, in the mapping's order.

    Raises CloudError for columns of different lengths or of a type that PointField does not know.
    """
    if not columns:
        raise CloudError("a cloud needs at least one column")
    lengths = {name: np.shape(column) for name, column in columns.items()}
    if len(set(lengths.values())) != 1 or any(len(shape) != 1 for shape in lengths.values()):
        raise CloudError(f"columns must be one-dimensional and of one length, got {lengths}")
    fields = []
    dtypes = []
    offset = 0
    for name, column in columns.items():
        dtype = np.asarray(column).dtype.newbyteorder("<")
        number = POINT_FIELD_NUMBERS.get(dtype.newbyteorder("="))
        if number is None:
            raise CloudError(f"column '{name}' is {dtype}, which PointCloud2 cannot hold")
        fields.append((name, offset, number, 1))
        dtypes.append((name, dtype))
        offset += dtype.itemsize
    count = next(iter(lengths.values()))[0]
    packed = np.empty(count, np.dtype(dtypes))
    for name, column in columns.items():
        packed[name] = column
    return PackedCloud(fields, offset, packed.tobytes())


def _coordinate(msg: PointCloud2Like, axis: str) -> tuple[int, np.dtype[Any]]:
    """Return the byte offset and dtype of one coordinate."""
    field = next((f for f in msg.fields if f.name == axis), None)
    if field is None:
        known = ", ".join(f.name for f in msg.fields) or "none"
        raise CloudError(f"the cloud has no field '{axis}'; its fields are: {known}")
    datatype, count = int(field.datatype), int(field.count)
    if datatype not in (7, 8):
        kind = _NAMES.get(datatype, f"unknown datatype {datatype}")
        raise CloudError(f"field '{axis}' is {kind}; coordinates must be float32 or float64")
    if count > 1:
        raise CloudError(f"field '{axis}' holds {count} values a point; a coordinate is one")
    return _place(msg, field)


def _place(msg: PointCloud2Like, field: _Field) -> tuple[int, np.dtype[Any]]:
    """Return the byte offset and dtype of a field of numbers."""
    offset = int(field.offset)
    dtype = np.dtype(POINT_FIELD_TYPES[int(field.datatype)]).newbyteorder(">" if msg.is_bigendian else "<")
    if offset < 0:
        raise CloudError(f"field '{field.name}' begins before its point, at byte {offset}")
    if offset + dtype.itemsize > int(msg.point_step):
        raise CloudError(f"field '{field.name}' ends at byte {offset + dtype.itemsize}, the point at {msg.point_step}")
    return offset, dtype


def _as_bytes(data: Any) -> npt.NDArray[np.uint8]:
    """Return the payload as uint8 without copying where it has a buffer."""
    try:
        return np.frombuffer(data, dtype=np.uint8) if len(data) else np.empty(0, np.uint8)
    except TypeError:
        return np.asarray(data, dtype=np.uint8)


def _column(
    buffer: npt.NDArray[np.uint8], dtype: np.dtype[Any], offset: int, height: int, width: int, row_step: int,
    point_step: int, count: int,
) -> npt.NDArray[Any]:  # fmt: skip
    """Return a (height, width, count) view of `count` neighbouring values of each point."""
    strides = (row_step, point_step, dtype.itemsize)
    return np.ndarray((height, width, count), dtype, buffer=buffer, offset=offset, strides=strides)
