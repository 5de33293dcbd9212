"""Geodesy: round trips, independent oracles, units."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
import utm
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.geodesy import (
    MapFrame,
    Projection,
    crs_text,
    parse_crs,
    same_crs,
    utm_crs_for,
    utm_crs_of,
    vertical_reference,
)

AMSTERDAM = MapFrame("EPSG:32631", np.array([628_500.0, 5_803_200.0, 1.0]), 43.0)
SYDNEY = MapFrame("EPSG:32756", np.array([334_000.0, 6_250_000.0, 30.0]), None)

offsets = st.tuples(st.floats(-20_000, 20_000), st.floats(-20_000, 20_000), st.floats(-100, 4000))


@pytest.mark.parametrize(
    ("longitude", "latitude", "code"),
    [
        (4.9, 52.4, 32631), (-122.4, 37.8, 32610), (151.2, -33.9, 32756), (179.99, 10.0, 32660), (-180.0, 10.0, 32601),
        (5.3, 60.4, 32632),  # Bergen lies in the widened zone 32
        (15.6, 78.2, 32633),  # Svalbard
        (0.0, 0.0, 32631),
    ],
)  # fmt: skip
def test_utm_zone_follows_the_rules_with_their_exceptions(longitude: float, latitude: float, code: int) -> None:
    assert utm_crs_for(longitude, latitude).to_epsg() == code


@pytest.mark.parametrize("place", [(0.0, 85.0), (0.0, -81.0), (400.0, 10.0), (float("nan"), 0.0)])
def test_places_outside_utm_are_refused(place: tuple[float, float]) -> None:
    with pytest.raises(AerialDataError, match="outside UTM"):
        utm_crs_for(*place)


def test_utm_zone_of_a_place_in_another_crs() -> None:
    assert utm_crs_of("EPSG:28992", 121_000.0, 486_000.0).to_epsg() == 32631
    with pytest.raises(AerialDataError, match="do not fit the CRS"):
        utm_crs_of("EPSG:4326", 121_000.0, 486_000.0)


@settings(max_examples=30, deadline=None)
@given(st.lists(offsets, min_size=1, max_size=5))
def test_every_frame_comes_back(offset: list[tuple[float, float, float]]) -> None:
    for frame in (AMSTERDAM, SYDNEY):
        grid = frame.origin + np.array(offset)
        np.testing.assert_allclose(frame.from_enu(frame.to_enu(grid)), grid, atol=1e-6)
        latitude, longitude, altitude = frame.to_geographic(grid)
        back = frame.from_geographic(latitude, longitude, altitude)
        np.testing.assert_allclose(back[:, :2], grid[:, :2], atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(offsets)
def test_enu_agrees_with_projs_topocentric_frame(offset: tuple[float, float, float]) -> None:
    grid = (AMSTERDAM.origin + np.array(offset))[None]
    latitude, longitude, height = (float(v[0]) for v in AMSTERDAM.to_geographic(grid))
    lat0, lon0, h0 = (float(v[0]) for v in AMSTERDAM.to_geographic(AMSTERDAM.origin[None]))
    pipeline = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={lon0!r} +lat_0={lat0!r} +h_0={h0!r}"
    )
    expected = pipeline.transform(longitude, latitude, height)
    np.testing.assert_allclose(AMSTERDAM.to_enu(grid)[0], expected, atol=1e-5)


@pytest.mark.parametrize("frame", [AMSTERDAM, SYDNEY])
def test_the_pose_of_the_map_on_earth_takes_its_points_to_ecef(frame: MapFrame) -> None:
    grid = frame.origin + np.array([[0.0, 0.0, 0.0], [4_000.0, -700.0, 25.0]])
    separation = frame.geoid_separation_m or 0.0
    longitude, latitude = pyproj.Transformer.from_crs(frame.crs, 4979, always_xy=True).transform(*grid[:, :2].T)
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    expected = np.stack(to_ecef.transform(longitude, latitude, grid[:, 2] + separation), axis=-1)
    T = frame.pose_on_earth
    np.testing.assert_allclose(frame.to_enu(grid) @ T[:3, :3].T + T[:3, 3], expected, atol=1e-6)


def test_enu_is_metric_where_the_grid_is_not() -> None:
    grid = np.array([[166_021.0, 0.0, 0.0], [167_021.0, 0.0, 0.0]])  # the edge of a zone at the equator
    frame = MapFrame("EPSG:32631", grid[0], 0.0)
    enu = frame.to_enu(grid)
    geod = pyproj.Geod(ellps="WGS84")
    latitude, longitude, _ = frame.to_geographic(grid)
    true = geod.inv(longitude[0], latitude[0], longitude[1], latitude[1])[2]
    np.testing.assert_allclose(np.linalg.norm(enu[1]), true, atol=1e-4)
    assert abs(true - 1000.0) > 0.5


@pytest.mark.parametrize("frame", [AMSTERDAM, SYDNEY])
def test_convergence_is_the_angle_between_the_norths(frame: MapFrame) -> None:
    origin = frame.origin[None]
    east, north, _ = frame.to_enu(origin + np.array([0.0, 10.0, 0.0]))[0]
    np.testing.assert_allclose(frame.convergence_rad(origin)[0], np.arctan2(east, north), atol=1e-6)
    assert abs(np.arctan2(east, north)) > 0.01


@settings(max_examples=30, deadline=None)
@given(st.floats(50.8, 53.5), st.floats(3.4, 5.9))
def test_grid_agrees_with_the_utm_package(latitude: float, longitude: float) -> None:
    easting, northing, _, _ = utm.from_latlon(latitude, longitude, force_zone_number=31)
    grid = AMSTERDAM.from_geographic(np.array([latitude]), np.array([longitude]))
    np.testing.assert_allclose(grid[0, :2], [easting, northing], atol=5e-3)


def test_altitude_is_known_only_with_the_geoid() -> None:
    grid = AMSTERDAM.origin[None]
    assert AMSTERDAM.to_geographic(grid)[2][0] == pytest.approx(44.0)
    assert np.isnan(SYDNEY.to_geographic(SYDNEY.origin[None])[2]).all()
    known = AMSTERDAM.from_geographic(np.array([52.0]), np.array([4.9]), np.array([50.0]))
    assert known[0, 2] == pytest.approx(7.0)
    assert np.isnan(SYDNEY.from_geographic(np.array([-33.0]), np.array([151.0]), np.array([50.0]))[0, 2])


@pytest.mark.parametrize(
    ("crs", "unit", "vertical", "ellipsoidal"),
    [
        ("EPSG:28992", 1.0, "unknown", False),
        ("EPSG:7415", 1.0, "NAP height", False),
        ("EPSG:2263", 1200 / 3937, "unknown", False),  # heights in the horizontal unit
        ("EPSG:2263+6360", 1200 / 3937, "NAVD88 height (ftUS)", False),
        ("EPSG:2263+5703", 1.0, "NAVD88 height", False),
        ("EPSG:2913+8228", 0.3048, "NAVD88 height (ft)", False),
        ("EPSG:4326", 1.0, "unknown", False),
        ("EPSG:4979", 1.0, "ellipsoid of WGS 84", True),
    ],
)
def test_vertical_part_of_a_crs(crs: str, unit: float, vertical: str, ellipsoidal: bool) -> None:
    reference = vertical_reference(crs)
    assert reference.metres_per_unit == pytest.approx(unit, rel=1e-9)
    assert (reference.name, reference.ellipsoidal) == (vertical, ellipsoidal)


def test_a_named_vertical_unit_wins() -> None:
    assert vertical_reference("EPSG:26910", 0.3048).metres_per_unit == 0.3048


@pytest.mark.parametrize(
    ("feet_crs", "metre_crs", "foot"),
    [("EPSG:2913", "EPSG:2838", 0.3048), ("EPSG:2263", "EPSG:32118", 1200 / 3937)],  # international, US survey
)
def test_feet_and_metres_of_one_projection_meet(feet_crs: str, metre_crs: str, foot: float) -> None:
    target = crs_text(utm_crs_for(*parse_crs(metre_crs).area_of_use.bounds[:2]))
    centre = pyproj.Transformer.from_crs("EPSG:4326", metre_crs, always_xy=True)
    area = parse_crs(metre_crs).area_of_use
    x, y = centre.transform((area.west + area.east) / 2, (area.south + area.north) / 2)
    metres = np.array([[x, y, 100.0]])
    np.testing.assert_allclose(
        Projection(feet_crs, target)(metres / foot), Projection(metre_crs, target)(metres), atol=1e-4
    )


@pytest.mark.parametrize(
    ("source", "corner", "extent"),
    [
        ("EPSG:28992", (121_000.0, 486_000.0), 1_000.0),
        ("EPSG:28992", (121_000.0, 486_000.0), 60_000.0),
        ("EPSG:4326", (4.8, 52.3), 0.05),
        ("EPSG:4326", (0.0, 45.0), 8.0),  # too curved for a cubic
    ],
)
def test_many_points_are_projected_as_each_alone(source: str, corner: tuple[float, float], extent: float) -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0, extent, (20_000, 2)) + corner, rng.uniform(0, 50, 20_000)])
    projection = Projection(source, "EPSG:32631")
    x, y = pyproj.Transformer.from_crs(source, "EPSG:32631", always_xy=True).transform(points[:, 0], points[:, 1])
    np.testing.assert_allclose(projection(points), np.column_stack([x, y, points[:, 2]]), atol=2e-3, rtol=0)


def test_an_outlier_does_not_spoil_its_neighbours() -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(0, 500, (5_000, 2)) + np.array([121_000, 486_000]), np.zeros(5_000)])
    projection = Projection("EPSG:28992", "EPSG:32631")
    clean = projection(points)
    spoiled = points.copy()
    spoiled[[7, 8, 9]] = [[1e30, 0, 0], [np.nan, 0, 0], [0, 486_000, np.inf]]
    result = projection(spoiled)
    assert np.isnan(result[7:10]).all()
    np.testing.assert_allclose(np.delete(result, [7, 8, 9], axis=0), np.delete(clean, [7, 8, 9], axis=0), atol=2e-3)


def test_heights_are_never_moved_to_another_datum() -> None:
    point = np.array([[121_000.0, 486_000.0, 5.0]])
    plain = Projection("EPSG:28992", "EPSG:32631")(point)
    compound = Projection("EPSG:7415", "EPSG:32631")(point)
    np.testing.assert_allclose(plain, compound, atol=1e-6)
    assert compound[0, 2] == 5.0


@pytest.mark.parametrize("text", ["EPSG:99999999", "somewhere", "", "EPSG:5773"])
def test_a_crs_that_does_not_serve_is_refused(text: str) -> None:
    with pytest.raises(AerialDataError, match="CRS"):
        parse_crs(text)


@pytest.mark.parametrize("text", ["EPSG:28992", "EPSG:7415", "EPSG:2263+5703", "+proj=utm +zone=31 +datum=WGS84"])
def test_the_text_of_a_crs_reads_back(text: str) -> None:
    again = crs_text(parse_crs(text))
    assert same_crs(text, again)
    assert not same_crs(again, "EPSG:32756")
