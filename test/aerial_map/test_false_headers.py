"""Surveys whose headers are false: the right map with a warning, or a refusal that names the fault."""

from __future__ import annotations

import logging
import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer

from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.survey import Survey, read_survey
from crossloc3d_ros.cli.build_map import summary
from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.formats.las import iter_chunks, read_header
from crossloc3d_ros.geodesy import Projection

FOOT_M = 1200 / 3937
UTM33 = np.array([500_000.0, 5_700_000.0, 50.0])


def points(count: int = 400, seed: int = 0) -> np.ndarray:
    """Return points (N, 3) of a square of 100 m, metres from its corner."""
    return np.random.default_rng(seed).uniform(0, 100, (count, 3))


def write(
    path: Path, xyz: np.ndarray, *, keys: dict[int, int] | None = None, wkt: bytes | None = None,
    version: str = "1.2", point_format: int = 1, records: tuple[laspy.VLR, ...] = (), offset: float | None = None,
) -> Path:  # fmt: skip
    """Write a file that names its CRS by GeoTIFF keys or by the bytes of a WKT."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = (
        np.full(3, 0.001),
        np.floor(xyz.min(axis=0)) if offset is None else np.full(3, offset),
    )
    if offset is not None:
        header.scales = np.full(3, 0.01)
    for record in records:
        header.vlrs.append(record)
    if keys is not None:
        body = struct.pack("<4H", 1, 1, 0, len(keys)) + b"".join(
            struct.pack("<4H", k, 0, 1, v) for k, v in keys.items()
        )
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "keys", body))
    if wkt is not None:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "wkt", wkt))
    data = laspy.LasData(header)
    data.x, data.y, data.z = xyz.T
    data.classification = np.full(len(xyz), 2, np.uint8)
    data.return_number = np.ones(len(xyz), np.uint8)
    data.write(path)
    return path


def patch(path: Path, at: int, form: str, *values: Any) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, at, *values)
    path.write_bytes(content)


def read(path: Path) -> np.ndarray:
    return np.concatenate([np.empty((0, 3)), *(chunk.points for chunk in iter_chunks(path, 150))])


def geographic(survey: Survey) -> np.ndarray:
    """Return longitude, latitude and height (N, 3) of all points of a survey, as a map would have them."""
    parts = []
    for header in survey.headers:
        to_map = Projection(header.crs, survey.map_crs, header.vertical_metres_per_unit)
        parts.append(to_map(np.concatenate([chunk.points for chunk in iter_chunks(header.path)])))
    grid = np.concatenate(parts)
    longitude, latitude = Transformer.from_crs(survey.map_crs, 4326, always_xy=True).transform(grid[:, 0], grid[:, 1])
    return np.column_stack([longitude, latitude, grid[:, 2]])


def assert_places(survey: Survey, crs: str, metres: np.ndarray) -> None:
    longitude, latitude = Transformer.from_crs(crs, 4326, always_xy=True).transform(metres[:, 0], metres[:, 1])
    np.testing.assert_allclose(geographic(survey), np.column_stack([longitude, latitude, metres[:, 2]]), atol=2e-3)
    np.testing.assert_allclose(geographic(survey)[:, :2], np.column_stack([longitude, latitude]), atol=1e-7)


def corner_of(crs: str, longitude: float, latitude: float) -> np.ndarray:
    return np.array([*np.round(Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude)), 50.0])


def test_coordinates_in_feet_of_a_metric_crs_are_where_they_were_flown(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    metres = points() + corner_of("EPSG:32119", -78.6, 35.8)
    write(tmp_path / "a.las", metres / FOOT_M, keys={1024: 1, 3072: 32119, 3076: 9003})
    with caplog.at_level(logging.WARNING):
        survey = read_survey([tmp_path])
    assert_places(survey, "EPSG:32119", metres)
    assert "US survey foot" in caplog.text


def test_a_unit_that_cannot_be_told_is_refused_with_both_names(tmp_path: Path) -> None:
    write(tmp_path / "a.las", points() + np.array([500_000, 1_000_000, 0]), keys={1024: 1, 3072: 3857, 3076: 9002})
    with pytest.raises(AerialDataError, match=r"a\.las.*metre.*foot.*--crs"):
        read_survey([tmp_path])
    assert read_survey([tmp_path], "EPSG:3857").map_crs == "EPSG:32631"


def test_a_unit_that_contradicts_a_crs_that_fits_is_left_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    metres = points() + np.array([121_000, 487_000, 0])
    write(tmp_path / "a.las", metres, keys={1024: 1, 3072: 28992, 3076: 9002})
    with caplog.at_level(logging.WARNING):
        assert_places(read_survey([tmp_path]), "EPSG:28992", metres)
    assert "foot" in caplog.text


@pytest.mark.parametrize("crs", [None, "EPSG:26917"])
def test_a_unit_of_heights_said_in_two_ways_is_one_unit(tmp_path: Path, crs: str | None) -> None:
    metres = points() + UTM33
    feet = metres / [1, 1, FOOT_M]
    write(tmp_path / "a.las", feet, keys={1024: 1, 3072: 26917, 4096: 6360})
    write(tmp_path / "b.laz", feet, keys={1024: 1, 3072: 26917, 4099: 9003})
    survey = read_survey([tmp_path], crs)
    assert_places(survey, "EPSG:26917", np.concatenate([metres, metres]))
    assert "NAVD88" in survey.vertical.name


def test_a_given_vertical_crs_goes_before_the_files_unit(tmp_path: Path) -> None:
    write(tmp_path / "a.las", points() + UTM33, keys={1024: 1, 3072: 26917, 4099: 9003})
    assert read_survey([tmp_path], "EPSG:26917+5703").vertical.metres_per_unit == 1.0


def test_heights_of_two_units_are_refused_by_name(tmp_path: Path) -> None:
    write(tmp_path / "a.las", points() + UTM33, keys={1024: 1, 3072: 26917, 4096: 6360})
    write(tmp_path / "b.las", points() + UTM33, keys={1024: 1, 3072: 26917, 4096: 5703})
    with pytest.raises(AerialDataError, match=r"0\.3048006 m in a\.las; .*units of 1 m in b\.las"):
        read_survey([tmp_path])


def test_the_zone_is_that_of_the_points_whatever_one_stray_point_says(tmp_path: Path) -> None:
    xyz = points() + UTM33
    xyz[0] = [5e6, 1e7, 0]
    write(tmp_path / "a.las", xyz, keys={1024: 1, 3072: 32633}, offset=0.0)
    assert read_survey([tmp_path]).map_crs == "EPSG:32633"


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 1e300])
def test_the_zone_is_that_of_the_points_whatever_the_box_says(
    tmp_path: Path, value: float, caplog: pytest.LogCaptureFixture
) -> None:
    metres = points() + corner_of("EPSG:31467", 9.0, 51.0)
    path = write(tmp_path / "a.las", metres, keys={1024: 1, 3072: 31467})
    patch(path, 179, "<6d", *[value] * 6)
    survey = read_survey([path])
    assert survey.map_crs == "EPSG:32632"
    assert 0 < survey.area_m2 < 1e5
    np.testing.assert_allclose(survey.minimum[:2], metres.min(axis=0)[:2], atol=20)
    assert "box" in caplog.text


@pytest.mark.parametrize("point_format", [1, 6])
@pytest.mark.parametrize("counted", [0, 200, 399])
def test_points_that_the_header_does_not_count_are_read(
    tmp_path: Path, counted: int, point_format: int, caplog: pytest.LogCaptureFixture
) -> None:
    xyz = points() + UTM33
    version = "1.2" if point_format == 1 else "1.4"
    path = write(tmp_path / "a.las", xyz, keys={1024: 1, 3072: 32633}, version=version, point_format=point_format)
    if point_format == 1:
        patch(path, 107, "<I", counted)
    else:
        patch(path, 247, "<Q", counted)
    np.testing.assert_allclose(read(path), xyz, atol=1e-3)
    assert read_survey([path]).points == 400
    assert f"counts {counted:,} points" in caplog.text
    assert "400" in caplog.text


def test_a_count_in_the_old_field_alone_counts(tmp_path: Path) -> None:
    for name in ("a.las", "a.laz"):
        path = write(tmp_path / name, points() + UTM33, keys={1024: 1, 3072: 32633}, version="1.4")
        patch(path, 107, "<I", 400)
        patch(path, 247, "<Q", 0)
        assert len(read(path)) == read_header(path).point_count == 400


def test_a_compressed_file_is_held_to_its_table_of_chunks(tmp_path: Path) -> None:
    count = 120_000  # three chunks of 50,000
    xyz = np.column_stack([np.arange(count) % 1000, np.arange(count) // 1000, np.zeros(count)]) + UTM33
    path = write(tmp_path / "a.laz", xyz, keys={1024: 1, 3072: 32633})
    patch(path, 107, "<I", 60_000)
    assert read_header(path).point_count == count  # by the numbers of returns
    patch(path, 111, "<5I", 0, 0, 0, 0, 0)
    with pytest.raises(AerialDataError, match=r"a\.laz counts 60,000 points.*100,001 to 150,000"):
        read_header(path)


def test_what_follows_the_points_is_said_and_not_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write(tmp_path / "a.las", points() + UTM33, keys={1024: 1, 3072: 32633})
    path.write_bytes(path.read_bytes() + b"appended by somebody, and no point, as is easily seen")
    assert len(read(path)) == read_survey([path]).points == 400
    assert "follow its last point" in caplog.text


@pytest.mark.parametrize(("version", "at"), [("1.2", 100), ("1.4", 100), ("1.4", 243)])
def test_an_absurd_number_of_records_is_read_around(
    tmp_path: Path, version: str, at: int, caplog: pytest.LogCaptureFixture
) -> None:
    path = write(tmp_path / "a.laz", points() + UTM33, keys={1024: 1, 3072: 32633}, version=version)
    patch(path, at, "<I", 2**32 - 1)
    survey = read_survey([path])
    assert (survey.crs, survey.points, len(read(path))) == ("EPSG:32633", 400, 400)
    assert "4,294,967,295" in caplog.text


def test_a_name_that_is_not_utf_8_is_a_name(tmp_path: Path) -> None:
    wkt = CRS(32633).to_wkt("WKT1_GDAL").replace("WGS 84 / UTM zone 33N", "Befliegung Süd, 33N")
    path = write(tmp_path / "a.las", points() + UTM33, wkt=wkt.encode("latin-1") + b"\0", version="1.4", point_format=6)
    assert "Befliegung Süd" in read_header(path).crs
    assert_places(read_survey([path]), "EPSG:32633", points() + UTM33)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_a_foreign_record_does_not_refuse_the_file(tmp_path: Path, name: str) -> None:
    foreign = laspy.VLR("XXXXXX", 7, "made by somebody", b"\xe9" * 40)
    path = write(tmp_path / name, points() + UTM33, keys={1024: 1, 3072: 32633}, records=(foreign,))
    path.write_bytes(path.read_bytes().replace(b"XXXXXX", "Büro".encode("latin-1") + b"\0\0"))
    assert read_header(path).crs == "EPSG:32633"
    np.testing.assert_allclose(read(path), points() + UTM33, atol=1e-3)


@pytest.mark.parametrize(
    ("at", "value", "name"), [(131, 0.0, "scale"), (147, np.nan, "scale"), (155, np.inf, "offset")]
)
def test_lost_coordinates_are_refused(tmp_path: Path, at: int, value: float, name: str) -> None:
    path = write(tmp_path / "a.las", points() + UTM33, keys={1024: 1, 3072: 32633})
    patch(path, at, "<d", value)
    with pytest.raises(AerialDataError, match=rf"a\.las has the {name}"):
        read_header(path)


@pytest.mark.parametrize(("code", "longitude", "latitude"), [(2053, 28.9, -26.2), (5513, 14.4, 50.08)])
@pytest.mark.parametrize("turned", [False, True])
def test_axes_to_south_and_west_are_read_as_they_were_written(
    tmp_path: Path, code: int, longitude: float, latitude: float, turned: bool
) -> None:
    # Krovak's first axis is the one to the south; delivered with x to the east it is -5513 with the axes exchanged.
    declared = corner_of(f"EPSG:{code}", longitude, latitude)[:2]
    east_north = -(declared[::-1] if code == 5513 else declared)
    corner = np.array([*(east_north if turned else declared), 0.0])
    write(tmp_path / "a.las", points() + corner, keys={1024: 1, 3072: code})
    at = geographic(read_survey([tmp_path])).mean(axis=0)
    assert at[:2] == pytest.approx([longitude, latitude], abs=0.01)


def test_points_outside_of_the_area_of_their_crs_are_refused_and_near_it_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path / "a.las", points() + np.array([121_000, 487_000, 0]), keys={1024: 1, 3072: 2154})
    with pytest.raises(AerialDataError, match=r"a\.las.*lie at 2\.84\d\d S, 0\.75\d\d W by RGF93.*France.*--crs"):
        read_survey([tmp_path])
    assert read_survey([tmp_path], "EPSG:28992").map_crs == "EPSG:32631"
    write(tmp_path / "a.las", points() + corner_of("EPSG:25833", 5.3, 60.4), keys={1024: 1, 3072: 25833})
    assert read_survey([tmp_path]).map_crs == "EPSG:32632"
    assert "outside of the area" in caplog.text


def test_the_summary_shows_where_the_map_is_and_how_well_that_is_known(
    tmp_path: Path, survey: Any, encoder: Any
) -> None:
    # The survey of the other tests in London, in the British grid, whose exact way to WGS84 needs a grid.
    xyz = survey.points - [628_000, 5_803_000, 0] + corner_of("EPSG:27700", -0.1, 51.5)
    write(tmp_path / "a.las", xyz, keys={1024: 1, 3072: 27700})
    report = build_map([tmp_path / "a.las"], tmp_path / "map", encoder)
    text = summary(report)
    assert "place     51.50" in text
    assert "https://www.openstreetmap.org/?mlat=51.50" in text
    assert "&mlon=-0.0" in text
    assert "British National Grid (EPSG:27700); unit of x and y: metre, of heights: metre" in text
    datum = report.manifest.datum
    assert datum is not None
    assert f"within {datum.metres:g} m in WGS84" in text
    if datum.missing_grids:  # they may be installed
        assert (datum.metres, datum.metres_with_grids) == (2.0, 1.0)
        assert (
            "warning   without the grid uk_os_OSTN15_NTv2_OSGBtoETRS.tif the error of the survey's datum is 2 m" in text
        )
