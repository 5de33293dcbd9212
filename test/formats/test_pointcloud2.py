"""PointCloud2: every layout that drivers send is read alike, and every broken one is named."""

from __future__ import annotations

import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.formats.pointcloud2 import pack_columns, scan_from_pointcloud2

POINTS = np.array([[1.5, -2.25, 0.125], [np.nan, 4.0, 5.0], [np.inf, -np.inf, 1e30], [-7.0, 8.0, -9.0]])
EXTRA = {"intensity": ("f4", 7), "ring": ("u2", 4), "t": ("f8", 8), "flag": ("i1", 1), "rgb": ("u4", 6)}


def message(
    points: np.ndarray = POINTS,
    *,
    names: tuple[str, ...] = ("x", "y", "z"),
    doubles: bool = False,
    big: bool = False,
    height: int = 1,
    gaps: tuple[int, ...] = (0,) * 12,
    row_padding: int = 0,
    wrap: Callable[[bytes], Any] = bytes,
) -> SimpleNamespace:
    """Lay points out as given; `gaps` are the unused bytes before each field and at the end."""
    order = ">" if big else "<"
    fields, dtype = [], {"names": [], "formats": [], "offsets": []}
    offset = 0
    for name, gap in zip(names, gaps, strict=False):
        code, number = (("f8", 8) if doubles else ("f4", 7)) if name in "xyz" else EXTRA[name]
        offset += gap
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=number, count=1))
        for key, value in zip(dtype, (name, order + code, offset), strict=True):
            dtype[key].append(value)
        offset += np.dtype(code).itemsize
    step = offset + gaps[len(names)]
    width = len(points) // height
    cloud = np.zeros(len(points), np.dtype({**dtype, "itemsize": step}))
    with np.errstate(over="ignore"):
        for k, axis in enumerate("xyz"):
            cloud[axis] = points[:, k]
    packed = cloud.tobytes()
    row = width * step
    data = b"".join(packed[r * row : (r + 1) * row] + b"\xff" * row_padding for r in range(height))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=1_700_000_000, nanosec=987_654_321), frame_id="velodyne"),
        height=height, width=width, fields=fields, is_bigendian=big, point_step=step, row_step=row + row_padding,
        data=wrap(data), is_dense=False,
    )  # fmt: skip


@given(
    names=st.permutations(["x", "y", "z", *EXTRA]).flatmap(
        lambda order: st.sets(st.sampled_from(sorted(EXTRA))).map(lambda drop: tuple(n for n in order if n not in drop))
    ),
    doubles=st.booleans(),
    big=st.booleans(),
    height=st.sampled_from([1, 2, 4]),
    gaps=st.tuples(*[st.integers(0, 5)] * 12),
    row_padding=st.integers(0, 9),
)
@settings(max_examples=150, deadline=None)
def test_every_layout_holds_the_same_points(**layout: Any) -> None:
    scan = scan_from_pointcloud2(message(**layout))
    assert scan.points.dtype == np.float32 and scan.points.flags.c_contiguous
    np.testing.assert_array_equal(scan.points, POINTS.astype(np.float32))
    assert scan.stamp_ns == 1_700_000_000_987_654_321
    assert scan.frame_id == "velodyne"


@pytest.mark.parametrize(
    "wrap",
    [bytes, bytearray, memoryview, list, lambda b: array.array("B", b), lambda b: np.frombuffer(b, np.uint8)],
    ids=["bytes", "bytearray", "memoryview", "list", "array.array", "ndarray"],
)
def test_every_kind_of_payload_is_read(wrap: Callable[[bytes], Any]) -> None:
    np.testing.assert_array_equal(scan_from_pointcloud2(message(wrap=wrap)).points, POINTS.astype(np.float32))


def test_a_scan_does_not_change_with_the_message_it_came_from() -> None:
    buffer = bytearray(message().data)
    msg = message(wrap=lambda _: buffer)
    scan = scan_from_pointcloud2(msg)
    buffer[:] = bytes(len(buffer))
    np.testing.assert_array_equal(scan.points, POINTS.astype(np.float32))


def test_doubles_beyond_float32_become_infinite_without_a_warning(recwarn: pytest.WarningsRecorder) -> None:
    points = np.array([[1e300, 0.0, -1e300]])
    np.testing.assert_array_equal(scan_from_pointcloud2(message(points, doubles=True)).points, [[np.inf, 0, -np.inf]])
    assert not recwarn.list


@pytest.mark.parametrize(("height", "width"), [(0, 0), (1, 0), (0, 5)])
def test_a_cloud_without_points_is_an_empty_scan(height: int, width: int) -> None:
    msg = message()
    msg.height, msg.width, msg.data = height, width, b""
    assert scan_from_pointcloud2(msg).points.shape == (0, 3)


def test_a_single_row_needs_no_row_step() -> None:
    msg = message()
    msg.row_step = 0
    assert len(scan_from_pointcloud2(msg).points) == 4


def test_the_last_row_needs_no_padding() -> None:
    msg = message(height=2, row_padding=6)
    msg.data = msg.data[:-6]
    assert len(scan_from_pointcloud2(msg).points) == 4


def broken(**changes: Any) -> SimpleNamespace:
    msg = message(height=2)
    for name, value in changes.items():
        setattr(msg, name, value)
    return msg


def with_field(axis: str, **changes: Any) -> SimpleNamespace:
    msg = message()
    field = next(f for f in msg.fields if f.name == axis)
    for name, value in changes.items():
        setattr(field, name, value)
    return msg


@pytest.mark.parametrize(
    ("msg", "complaint"),
    [
        (broken(fields=[]), "no field 'x'; its fields are: none"),
        (message(names=("x", "y", "z", "ring")), None),
        (with_field("z", name="height"), "no field 'z'; its fields are: x, y, height"),
        (with_field("x", datatype=3), "field 'x' is int16; coordinates must be float32 or float64"),
        (with_field("y", datatype=6), "field 'y' is uint32"),
        (with_field("y", datatype=99), "field 'y' is unknown datatype 99"),
        (with_field("z", count=3), "field 'z' holds 3 values"),
        (with_field("z", offset=9), "field 'z' ends at byte 13, the point at 12"),
        (with_field("z", datatype=8), "field 'z' ends at byte 16, the point at 12"),
        (with_field("x", offset=-4), "field 'x'"),
        (broken(data=b""), "cut short"),
        (broken(data=message().data[:-1]), "2 x 2 points need 48 bytes, got 47"),
        (broken(width=2**31), "row_step"),
        (broken(width=2**31, row_step=2**40), "cut short"),
        (broken(row_step=23), "row_step is 23 bytes"),
        (broken(height=-1), "-1"),
        (broken(point_step=0), "field 'x' ends at byte 4, the point at 0"),
    ],
)
def test_what_is_broken_is_named(msg: SimpleNamespace, complaint: str | None) -> None:
    if complaint is None:
        assert len(scan_from_pointcloud2(msg).points) == 4
        return
    with pytest.raises(CloudError) as error:
        scan_from_pointcloud2(msg)
    assert complaint in str(error.value)


@given(
    st.integers(0, 50), st.lists(st.sampled_from(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", ">f4")), max_size=5)
)
@settings(max_examples=50, deadline=None)
def test_packed_columns_come_back(count: int, extra: list[str]) -> None:
    rng = np.random.default_rng(count)
    columns = {axis: rng.normal(size=count).astype(np.float32) for axis in "xyz"}
    columns |= {f"extra{i}": rng.integers(0, 100, count).astype(code) for i, code in enumerate(extra)}
    packed = pack_columns(columns)
    assert len(packed.data) == packed.point_step * count
    codes = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
    dtype = np.dtype(
        {
            "names": [f[0] for f in packed.fields],
            "formats": [codes[f[2]] for f in packed.fields],
            "offsets": [f[1] for f in packed.fields],
            "itemsize": packed.point_step,
        }
    )
    back = np.frombuffer(packed.data, dtype)
    for name, column in columns.items():
        np.testing.assert_array_equal(back[name], column)


def test_a_velodynes_point_is_22_bytes() -> None:
    n = 3
    packed = pack_columns(
        {axis: np.zeros(n, np.float32) for axis in ("x", "y", "z", "intensity")}
        | {"ring": np.zeros(n, np.uint16), "time": np.zeros(n, np.float32)}
    )
    assert packed.point_step == 22
    assert [f[1] for f in packed.fields] == [0, 4, 8, 12, 16, 18]


@pytest.mark.parametrize(
    "columns",
    [
        {},
        {"x": np.zeros(3), "y": np.zeros(4)},
        {"x": np.zeros((3, 2))},
        {"x": np.zeros(3, np.int64)},
        {"x": np.array(["a"])},
    ],
)
def test_columns_that_no_cloud_can_hold_are_refused(columns: dict[str, np.ndarray]) -> None:
    with pytest.raises(CloudError):
        pack_columns(columns)


@pytest.mark.parametrize(
    "bag",
    [
        "einride_vlp16_pointcloud2_mcap",
        "einride_vlp16_pointcloud2_sqlite3",
        "nebula_vlp16_pointcloud2_mcap",
        "tepic_vlp16_outdoor_1scan_pointcloud2_mcap",
    ],
)
def test_real_recordings_are_read(shared: Callable[[str], Any], bag: str) -> None:
    rosbags = pytest.importorskip("rosbags.highlevel")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    with rosbags.AnyReader([shared(f"data/vlp16/{bag}")], default_typestore=store) as reader:
        for connection, _, raw in reader.messages():
            msg = reader.deserialize(raw, connection.msgtype)
            scan = scan_from_pointcloud2(msg)
            assert scan.points.shape == (msg.width * msg.height, 3)
            assert scan.frame_id == "velodyne"
            ranges = np.linalg.norm(scan.points, axis=1)
            assert 0.3 < np.median(ranges) < 60 and ranges.max() < 130
            # A VLP-16's rings lie between -15 and +15 degrees: the bytes were read as what they are.
            elevation = np.degrees(np.arcsin(scan.points[ranges > 1, 2] / ranges[ranges > 1]))
            assert elevation.min() > -16 and elevation.max() < 16
            assert scan.stamp_ns == msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec


def test_ros_messages_are_read_as_they_are() -> None:
    messages = pytest.importorskip("sensor_msgs.msg")
    packed = pack_columns({axis: POINTS[:, k].astype(np.float32) for k, axis in enumerate("xyz")})
    msg = messages.PointCloud2()
    msg.header.frame_id = "velodyne"
    msg.header.stamp.sec, msg.header.stamp.nanosec = 12, 34
    msg.height, msg.width = 1, len(POINTS)
    msg.fields = [messages.PointField(name=n, offset=o, datatype=d, count=c) for n, o, d, c in packed.fields]
    msg.point_step, msg.row_step = packed.point_step, packed.point_step * len(POINTS)
    msg.data = array.array("B", packed.data)
    scan = scan_from_pointcloud2(msg)
    np.testing.assert_array_equal(scan.points, POINTS.astype(np.float32))
    assert scan.stamp_ns == 12_000_000_034
