"""Aerial files: what is written is read, every way of saying a CRS is understood, damage is named."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.formats.las import LazWriter, expand_inputs, iter_chunks, read_header, write_laz
from crossloc3d_ros.geodesy import parse_crs, same_crs, vertical_reference

SURVEYS = [
    ("amsterdam_centre_AHN2_2010_EPSG28992.laz", 1_742_364, {1, 2}),
    ("amsterdam_centre_AHN3_2014_EPSG28992.laz", 715_273, {1, 2, 6, 9, 26}),
    ("delft_AHN3_2014_EPSG28992.laz", 848_942, {1, 2, 6, 9, 26}),
]


def cloud(count: int = 5_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 100, (count, 3)) + np.array([121_000.0, 486_000.0, -5.0])
    return points, rng.choice(np.array([1, 2, 6, 9, 26], dtype=np.uint8), count)


def read(path: Path, chunk_points: int = 1_000_000, *, threads: bool = True) -> tuple[np.ndarray, np.ndarray]:
    chunks = list(iter_chunks(path, chunk_points, threads=threads))
    return np.concatenate([c.points for c in chunks]), np.concatenate([c.classification for c in chunks])


@pytest.mark.parametrize("name", ["a.laz", "a.las", "a.LAZ"])
@pytest.mark.parametrize(("version", "point_format"), [("1.4", 6), ("1.2", 1), ("1.2", 3)])
def test_what_is_written_is_read(tmp_path: Path, name: str, version: str, point_format: int) -> None:
    points, classes = cloud()
    write_laz(tmp_path / name, points, classes, "EPSG:28992", version=version, point_format=point_format)
    got_points, got_classes = read(tmp_path / name)
    np.testing.assert_allclose(got_points, points, atol=0.005 + 1e-9)
    np.testing.assert_array_equal(got_classes, classes)
    header = read_header(tmp_path / name)
    assert (header.crs, header.point_count) == ("EPSG:28992", len(points))
    np.testing.assert_allclose(header.minimum, points.min(axis=0), atol=0.006)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("chunk_points", [1, 7, 4_999, 5_000, 1_000_000])
@pytest.mark.parametrize("threads", [True, False])
def test_chunks_do_not_change_the_points(tmp_path: Path, chunk_points: int, threads: bool) -> None:
    count = 60 if chunk_points == 1 else 5_000
    write_laz(tmp_path / "a.laz", *cloud(count), "EPSG:28992")
    for whole, chunked in zip(
        read(tmp_path / "a.laz"), read(tmp_path / "a.laz", chunk_points, threads=threads), strict=True
    ):
        np.testing.assert_array_equal(whole, chunked)
    assert all(len(c.points) <= chunk_points for c in iter_chunks(tmp_path / "a.laz", chunk_points))


def test_writing_in_pieces_is_writing_at_once(tmp_path: Path) -> None:
    points, classes = cloud()
    write_laz(tmp_path / "once.laz", points, classes, "EPSG:28992")
    with LazWriter(tmp_path / "pieces.laz", "EPSG:28992", offset=np.floor(points.min(axis=0))) as writer:
        for part in np.array_split(np.arange(len(points)), 7):
            writer.write(points[part], classes[part])
    for once, pieces in zip(read(tmp_path / "once.laz"), read(tmp_path / "pieces.laz"), strict=True):
        np.testing.assert_array_equal(once, pieces)


def test_a_writer_that_fails_leaves_nothing(tmp_path: Path) -> None:
    points, classes = cloud()
    with pytest.raises(KeyboardInterrupt), LazWriter(tmp_path / "a.laz", "EPSG:28992") as writer:
        writer.write(points, classes)
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_an_empty_file_is_a_file(tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", np.empty((0, 3)), np.empty(0, np.uint8), "EPSG:28992")
    assert read_header(tmp_path / "a.laz").point_count == 0
    assert sum(len(c.points) for c in iter_chunks(tmp_path / "a.laz")) == 0


def test_withheld_points_are_not_read(tmp_path: Path) -> None:
    points, classes = cloud(1_000)
    write_laz(tmp_path / "a.laz", points, classes, "EPSG:28992")
    data = laspy.read(tmp_path / "a.laz")
    withheld = np.arange(1_000) % 3 == 0
    data.withheld = withheld
    data.write(tmp_path / "a.laz")
    got, _ = read(tmp_path / "a.laz")
    np.testing.assert_allclose(got, points[~withheld], atol=0.006)


def test_degrees_keep_their_centimetres(tmp_path: Path) -> None:
    points = np.array([[4.881234567, 52.371234567, 1.234], [4.89, 52.38, 20.0]])
    write_laz(tmp_path / "a.laz", points, np.array([2, 6], np.uint8), "EPSG:4326", scale=1e-7)
    got, _ = read(tmp_path / "a.laz")
    np.testing.assert_allclose(got[:, :2], points[:, :2], atol=1e-7)
    np.testing.assert_allclose(got[:, 2], points[:, 2], atol=1e-3)


@pytest.mark.parametrize("crs", ["EPSG:28992", "EPSG:2263+6360", "EPSG:7415", "EPSG:4326", "EPSG:2913"])
def test_every_crs_comes_back(tmp_path: Path, crs: str) -> None:
    write_laz(tmp_path / "a.laz", *cloud(10), crs)
    header = read_header(tmp_path / "a.laz")
    assert same_crs(header.crs, crs)
    assert vertical_reference(header.crs) == vertical_reference(crs)


def with_geokeys(path: Path, keys: dict[int, int]) -> None:
    """Write a LAS 1.2 file that names its CRS by GeoTIFF keys, as most files older than 2013 do."""
    header = laspy.LasHeader(point_format=1, version="1.2")
    record = GeoKeyDirectoryVlr()
    record.geo_keys = [
        GeoKeyEntryStruct(id=key, tiff_tag_location=0, count=1, value_offset=value) for key, value in keys.items()
    ]
    record.geo_keys_header.number_of_keys = len(keys)
    header.vlrs.append(record)
    data = laspy.LasData(header)
    data.x, data.y, data.z = np.random.default_rng(0).uniform(0, 100, (3, 10))
    data.write(path)


@pytest.mark.parametrize(
    ("keys", "crs", "unit", "ellipsoidal"),
    [
        ({1024: 1, 3072: 28992}, "EPSG:28992", 1.0, False),
        ({1024: 2, 2048: 4326}, "EPSG:4326", 1.0, False),
        ({1024: 1, 2048: 4269, 3072: 2263}, "EPSG:2263", 1200 / 3937, False),
        ({1024: 1, 3072: 2263, 4096: 5703}, "EPSG:2263+5703", 1.0, False),
        ({1024: 1, 3072: 2263, 4096: 6360}, "EPSG:2263+6360", 1200 / 3937, False),
        ({1024: 1, 3072: 26910, 4099: 9003}, "EPSG:26910", 1200 / 3937, False),
        ({1024: 1, 3072: 26910, 4099: 9002}, "EPSG:26910", 0.3048, False),
        ({1024: 1, 3072: 2913, 4099: 9001}, "EPSG:2913", 1.0, False),
        ({1024: 1, 3072: 26910, 4096: 5103, 4099: 9003}, "EPSG:26910", 1200 / 3937, False),  # GeoTIFF's own NAVD88
        ({1024: 1, 3072: 32631, 4096: 5030}, None, 1.0, True),  # GeoTIFF's own WGS 84 ellipsoid
        ({1024: 1, 3072: 32631, 4096: 32767}, "EPSG:32631", 1.0, False),
    ],
)
def test_geotiff_keys_are_understood(
    tmp_path: Path, keys: dict[int, int], crs: str | None, unit: float, ellipsoidal: bool
) -> None:
    with_geokeys(tmp_path / "a.las", keys)
    header = read_header(tmp_path / "a.las")
    vertical = vertical_reference(header.crs, header.vertical_metres_per_unit)
    if crs is not None:
        assert same_crs(header.crs, crs)
    assert vertical.metres_per_unit == pytest.approx(unit, rel=1e-9)
    assert vertical.ellipsoidal == ellipsoidal


@pytest.mark.parametrize("keys", [{1024: 1, 3072: 32767}, {1024: 1}, {1024: 2, 2048: 1025}])
def test_geotiff_keys_without_a_known_code_need_the_crs(tmp_path: Path, keys: dict[int, int]) -> None:
    with_geokeys(tmp_path / "a.las", keys)
    with pytest.raises(AerialDataError, match=r"a\.las.*--crs"):
        read_header(tmp_path / "a.las")
    assert read_header(tmp_path / "a.las", "EPSG:28992").crs == "EPSG:28992"


def test_a_file_without_crs_needs_it(tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", *cloud(10), None)
    with pytest.raises(AerialDataError, match=r"a\.laz names no CRS.*--crs EPSG"):
        read_header(tmp_path / "a.laz")
    assert read_header(tmp_path / "a.laz", "EPSG:28992").crs == "EPSG:28992"
    with pytest.raises(AerialDataError, match="not understood"):
        read_header(tmp_path / "a.laz", "Amsterdam")


@pytest.mark.parametrize(("text", "message"), [("", "names no CRS"), ("\0\0", "names no CRS"), ("PROJCS[", "--crs")])
def test_a_broken_crs_record_needs_the_crs(tmp_path: Path, text: str, message: str) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.vlrs.append(WktCoordinateSystemVlr(text))
    laspy.LasData(header).write(tmp_path / "a.laz")
    with pytest.raises(AerialDataError, match=message):
        read_header(tmp_path / "a.laz")


def test_the_given_crs_replaces_the_files_own(tmp_path: Path) -> None:
    write_laz(tmp_path / "a.laz", *cloud(10), "EPSG:32631")
    assert read_header(tmp_path / "a.laz", "EPSG:28992").crs == "EPSG:28992"


@pytest.mark.parametrize("threads", [True, False])
@pytest.mark.parametrize("kept", [0.001, 0.02, 0.5, 0.98, 0.9999])
def test_a_truncated_file_is_named(tmp_path: Path, kept: float, threads: bool) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, *cloud(200_000), "EPSG:28992")
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * kept)])
    with pytest.raises(AerialDataError, match=r"a\.laz"):
        read_header(path)
        read(path, threads=threads)


@pytest.mark.parametrize("chunk_points", [1_000, 1_000_000])
def test_a_truncated_las_says_how_much_was_read(tmp_path: Path, chunk_points: int) -> None:
    path = tmp_path / "a.las"
    write_laz(path, *cloud(10_000), "EPSG:28992")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2 + 3])
    with pytest.raises(AerialDataError, match=r"10,000 points.*fetch it again"):
        read(path, chunk_points)


def test_a_truncated_las_at_a_points_edge_is_found_too(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    write_laz(path, *cloud(1_000), "EPSG:28992")
    size = laspy.open(path).header.point_format.size
    path.write_bytes(path.read_bytes()[: -100 * size])
    with pytest.raises(AerialDataError, match=r"900 of 1,000 points"):
        read(path)


@pytest.mark.parametrize("content", [b"", b"hello", b"LASF", b"LASF" + b"\0" * 400, b"\xff" * 1000])
def test_what_is_no_las_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(content)
    with pytest.raises(AerialDataError, match=r"a\.laz"):
        read_header(path)


@pytest.mark.parametrize("seed", range(6))
def test_random_damage_is_an_error_or_harmless_never_a_crash(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, *cloud(20_000), "EPSG:28992")
    content = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    place = int(rng.integers(0, len(content) - 64))
    content[place : place + 64] = rng.integers(0, 256, 64).astype(np.uint8).tobytes()
    path.write_bytes(content)
    try:
        read_header(path)
        points, classes = read(path, threads=bool(seed % 2))
        assert len(points) == len(classes)
    except AerialDataError as error:
        assert "a.laz" in str(error)


def test_inputs_are_files_folders_and_globs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deep" / "er").mkdir(parents=True)
    for name in ("b.laz", "a.las", "deep/C.LAZ", "deep/er/d.copc.laz", "deep/notes.txt"):
        (tmp_path / name).touch()
    everything = [tmp_path / n for n in ("a.las", "b.laz", "deep/C.LAZ", "deep/er/d.copc.laz")]
    assert expand_inputs([tmp_path]) == sorted(everything)
    assert expand_inputs([tmp_path / "b.laz", f"{tmp_path}/*.laz", tmp_path]) == sorted(everything)
    assert expand_inputs([f"{tmp_path}/**/*.laz"]) == sorted([everything[1], everything[3]])
    monkeypatch.chdir(tmp_path)
    assert expand_inputs(["./b.laz", "b.laz"]) == [tmp_path / "b.laz"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing.laz", "no such file"),
        ("*.laz", "no such file"),
        ("notes.txt", r"neither in \.las"),
        ("empty", "no .las"),
    ],
)
def test_inputs_that_name_nothing_are_refused(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "notes.txt").touch()
    (tmp_path / "empty").mkdir()
    with pytest.raises(AerialDataError, match=message):
        expand_inputs([tmp_path / name])


def test_copc_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.copc.laz"
    points, classes = cloud(3_000)
    write_copc(path, points, classes)
    assert laspy.CopcReader.open(str(path)).query(level=0).array.size == 3_000  # it is a COPC file indeed
    assert expand_inputs([tmp_path]) == [path]
    assert read_header(path).crs == "EPSG:28992"
    got_points, got_classes = read(path)
    np.testing.assert_allclose(got_points, points, atol=0.006)
    np.testing.assert_array_equal(got_classes, classes)


def write_copc(path: Path, points: np.ndarray, classes: np.ndarray) -> None:
    """Write a COPC file with one node, the root, that holds every point."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.floor(points.min(axis=0))
    header.vlrs.append(laspy.VLR("copc", 1, "COPC info", bytes(160)))
    header.add_crs(parse_crs("EPSG:28992"))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    data.classification = classes
    plain = path.with_name("plain.laz")
    data.write(plain)
    content = bytearray(plain.read_bytes())
    plain.unlink()
    offset_to_points = struct.unpack_from("<I", content, 96)[0]
    chunk_table = struct.unpack_from("<q", content, offset_to_points)[0]
    centre, half = (points.min(axis=0) + points.max(axis=0)) / 2, float(np.ptp(points, axis=0).max())
    hierarchy_at = len(content) + 60  # behind the header of the extended record that follows
    info = struct.pack("<5d2Q2d88x", *centre, half, half / 128, hierarchy_at, 32, 0.0, 0.0)
    content[375 + 54 : 375 + 54 + 160] = info  # the first record, behind a header of 375 bytes
    entry = struct.pack("<4iQii", 0, 0, 0, 0, offset_to_points + 8, chunk_table - offset_to_points - 8, len(points))
    record = struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(entry), b"hierarchy") + entry
    struct.pack_into("<QI", content, 235, len(content), 1)
    path.write_bytes(bytes(content) + record)


@pytest.mark.parametrize(("name", "count", "classes"), SURVEYS)
def test_the_real_surveys_are_read(shared: Callable[[str], Path], name: str, count: int, classes: set[int]) -> None:
    path = shared(f"data/aerial/{name}")
    header = read_header(path)
    assert (header.crs, header.point_count) == ("EPSG:28992", count)
    seen, total = set(), 0
    for chunk in iter_chunks(path, 300_000):
        total += len(chunk.points)
        seen |= set(np.unique(chunk.classification).tolist())
        assert (chunk.points >= header.minimum - 0.01).all() and (chunk.points <= header.maximum + 0.01).all()
    assert (total, seen) == (count, classes)
