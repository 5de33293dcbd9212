"""From any survey's CRS to the map's metres, and from there to WGS84 and the local tangent frame.

Three frames. `grid`: easting, northing, height in the map's UTM zone, metres. `geographic`: WGS84 latitude and
longitude in degrees, ellipsoidal height. `enu`: the tangent frame at the map's origin (REP-105's `map`), exact: a UTM
metre is not a ground metre and grid north is not true north, so grid differences are no ENU coordinates.

Heights keep the datum of the survey (NAP, NAVD88, ...): only their unit is converted. The ellipsoidal height is known
only where the survey's heights are ellipsoidal or the geoid separation is given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import utm
from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError, ProjError

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.types import BoolArray, Float64Array

_WGS84_3D = "EPSG:4979"
_WGS84_ECEF = "EPSG:4978"
_FARTHEST_M = 4.0e7
"""No projected coordinate on Earth is larger: its girth."""
_FIT_FROM_POINTS = 2000  # with fewer points the fit costs more than it saves
_FIT_TOLERANCE_M = 1e-3  # below what any survey resolves
_BLOCK = 8192  # points whose powers stay in the processor's cache


@lru_cache(maxsize=256)
def parse_crs(text: str) -> CRS:
    """Return the CRS that `text` names: `EPSG:28992`, horizontal and vertical as `EPSG:2263+6360`, WKT, PROJ.

    Raises AerialDataError where it cannot be understood or is neither projected nor geographic.
    """
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise AerialDataError(
            f"the CRS '{_shortened(text)}' is not understood; give it as EPSG:<code>, or EPSG:<horizontal>+<vertical>"
        ) from error
    horizontal = _horizontal(crs)
    if not (horizontal.is_projected or horizontal.is_geographic):
        raise AerialDataError(f"the CRS '{crs.name}' is neither projected nor geographic")
    return crs


def crs_text(crs: CRS) -> str:
    """Return the shortest text that `parse_crs` reads back as the same CRS: an EPSG code where there is one."""
    code = crs.to_epsg(min_confidence=100)
    if code is not None:
        return f"EPSG:{code}"
    return str(crs.to_wkt())


def crs_name(text: str) -> str:
    """Return the name of a CRS for messages, such as `Amersfoort / RD New (EPSG:28992)`."""
    crs = parse_crs(text)
    return f"{crs.name} ({text})" if len(text) < 40 else str(crs.name)


def utm_crs_for(longitude_deg: float, latitude_deg: float) -> CRS:
    """Return the UTM zone (WGS84) of a place, with the exceptions for Norway and Svalbard.

    Raises AerialDataError outside 80 S to 84 N, where UTM is not defined.
    """
    if not (-180.0 <= longitude_deg <= 180.0 and -80.0 <= latitude_deg <= 84.0):
        raise AerialDataError(
            f"latitude {latitude_deg:.3f}, longitude {longitude_deg:.3f} lies outside UTM (80 S to 84 N); "
            "is the CRS of the files the right one?"
        )
    zone = utm.latlon_to_zone_number(latitude_deg, longitude_deg)
    return CRS.from_epsg((32600 if latitude_deg >= 0.0 else 32700) + int(zone))


def utm_crs_of(crs: str, x: float, y: float) -> CRS:
    """Return the UTM zone (WGS84) of a place given in another CRS (x or longitude first).

    Raises AerialDataError where the place is not on Earth: the CRS is the wrong one then.
    """
    longitude, latitude = _transformer(crs, _WGS84_3D).transform(x, y)
    if not (abs(longitude) <= 360.0 and abs(latitude) <= 90.0):
        raise AerialDataError(
            f"the coordinates ({x:.7g}, {y:.7g}) do not fit the CRS {crs_name(crs)}; set the right one with --crs"
        )
    return utm_crs_for((longitude + 180.0) % 360.0 - 180.0, latitude)


def horizontal_text(text: str) -> str:
    """Return the horizontal part of a CRS, as `crs_text` does."""
    parsed = parse_crs(text)
    horizontal = _horizontal(parsed)
    return text if horizontal is parsed else crs_text(horizontal)


def same_crs(first: str, second: str) -> bool:
    """Return whether two texts name the same CRS."""
    return first == second or bool(parse_crs(first).equals(parse_crs(second), ignore_axis_order=True))


def metres_per_unit(crs: str, y: float) -> tuple[float, float]:
    """Return about how many metres one unit of x and of y are at the ordinate (or latitude) `y`."""
    horizontal = _horizontal(parse_crs(crs))
    if horizontal.is_geographic:
        return 111_320.0 * max(math.cos(math.radians(min(abs(y), 89.0))), 0.01), 111_320.0
    unit = float(horizontal.axis_info[0].unit_conversion_factor)
    return unit, unit


@dataclass(frozen=True)
class VerticalReference:
    """What a survey's heights are measured from, and in which unit."""

    name: str
    """For people and the manifest: `NAP height`, `WGS 84 ellipsoid`, `unknown`."""
    metres_per_unit: float
    ellipsoidal: bool


def vertical_reference(crs: str, metres_per_unit: float | None = None) -> VerticalReference:
    """Return the vertical part of a CRS.

    Without a vertical CRS heights are taken in the horizontal unit, as surveys in feet are delivered; in metres where
    the horizontal unit is the degree. `metres_per_unit` overrides the unit (GeoTIFF's VerticalUnitsGeoKey).
    """
    parsed = parse_crs(crs)
    if parsed.is_compound:
        vertical = next((part for part in parsed.sub_crs_list if part.is_vertical), None)
        if vertical is not None:
            unit = float(vertical.axis_info[0].unit_conversion_factor)
            return VerticalReference(str(vertical.name), metres_per_unit or unit, ellipsoidal=False)
    if len(parsed.axis_info) == 3:
        unit = float(parsed.axis_info[2].unit_conversion_factor)
        return VerticalReference(f"ellipsoid of {parsed.name}", metres_per_unit or unit, ellipsoidal=True)
    horizontal = _horizontal(parsed)
    unit = float(horizontal.axis_info[0].unit_conversion_factor) if horizontal.is_projected else 1.0
    return VerticalReference("unknown", metres_per_unit or unit, ellipsoidal=False)


class Projection:
    """Take points from a survey's CRS to a target CRS in metres; heights change their unit and nothing else."""

    def __init__(self, source_crs: str, target_crs: str, vertical_metres_per_unit: float | None = None) -> None:
        """Prepare the way from `source_crs` to `target_crs` (texts as `parse_crs` takes them)."""
        self.source_crs = source_crs
        self.target_crs = target_crs
        self.vertical = vertical_reference(source_crs, vertical_metres_per_unit)
        self._transformer = _transformer(source_crs, target_crs)
        source = _horizontal(parse_crs(source_crs))
        self._geographic = bool(source.is_geographic)
        self._unit_m = 1.0 if self._geographic else float(source.axis_info[0].unit_conversion_factor)

    def __call__(self, points: Float64Array) -> Float64Array:
        """Return (N, 3) easting, northing, height in metres of (N, 3) source coordinates (x or longitude first).

        Points that the projection cannot take, such as an easting of 1e30, come out as NaN.
        """
        result = np.full((len(points), 3), np.nan)
        inside = self._plausible(points)
        usable = points if inside.all() else points[inside]
        if len(usable) == 0:
            return result
        horizontal = self._horizontal(usable)
        heights = usable[:, 2] * self.vertical.metres_per_unit
        horizontal[~(np.isfinite(horizontal).all(axis=1) & np.isfinite(heights))] = np.nan
        result[inside, :2] = horizontal
        result[inside, 2] = np.where(np.isnan(horizontal[:, 0]), np.nan, heights)
        return result

    def _plausible(self, points: Float64Array) -> BoolArray:
        """Return which points lie on the Earth at all: PROJ wraps absurd coordinates around it instead of refusing."""
        limit = np.array([360.0, 90.0]) if self._geographic else np.array([_FARTHEST_M, _FARTHEST_M]) / self._unit_m
        return np.asarray((np.abs(points[:, :2]) <= limit).all(axis=1))

    def _horizontal(self, points: Float64Array) -> Float64Array:
        if len(points) < _FIT_FROM_POINTS:
            return self._exactly(points[:, :2])
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        polynomial = self._fit(low, high)
        return self._exactly(points[:, :2]) if polynomial is None else polynomial(points[:, :2])

    def _exactly(self, points: Float64Array) -> Float64Array:
        try:
            return np.column_stack(self._transformer.transform(points[:, 0], points[:, 1]))
        except ProjError as error:
            raise AerialDataError(
                f"cannot go from {crs_name(self.source_crs)} to {crs_name(self.target_crs)}: {error}"
            ) from error

    def _fit(self, low: Float64Array, high: Float64Array) -> _Cubic | None:
        """Return a cubic that follows the projection within a millimetre over a box, or None.

        PROJ takes a second a million points, more than reading them; over the few kilometres of a file the way from
        one projection to another is so smooth that a cubic is exact for every purpose, which is checked here.
        """
        centre, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1e-9)
        nodes = _square(np.cos(np.linspace(0.0, np.pi, 9)))
        target = self._exactly(nodes * half + centre)
        if not np.isfinite(target).all():
            return None
        offset = target.mean(axis=0)
        coefficients, *_ = np.linalg.lstsq(_monomials(nodes), target - offset, rcond=None)
        cubic = _Cubic(centre, half, offset, coefficients)
        probes = _square(np.linspace(-1.0, 1.0, 14)) * half + centre
        error = np.abs(cubic(probes) - self._exactly(probes)).max()
        return cubic if error < _FIT_TOLERANCE_M else None


@dataclass(frozen=True, eq=False)
class _Cubic:
    """A polynomial of the third degree in two variables, for two values."""

    centre: Float64Array
    half: Float64Array
    offset: Float64Array
    coefficients: Float64Array

    def __call__(self, points: Float64Array) -> Float64Array:
        result = np.empty((len(points), 2))
        for start in range(0, len(points), _BLOCK):  # blocks stay in the processor's cache: three times as fast
            part = slice(start, start + _BLOCK)
            x = (points[part, 0] - self.centre[0]) / self.half[0]
            y = (points[part, 1] - self.centre[1]) / self.half[1]
            for axis in range(2):
                c = self.coefficients[:, axis]
                result[part, axis] = self.offset[axis] + (
                    c[0]
                    + y * (c[2] + y * (c[5] + y * c[9]))
                    + x * (c[1] + y * (c[4] + y * c[8]) + x * (c[3] + y * c[7] + x * c[6]))
                )
        return result


def _monomials(points: Float64Array) -> Float64Array:
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])


def _square(values: Float64Array) -> Float64Array:
    return np.stack(np.meshgrid(values, values), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class MapFrame:
    """The frames of one map: its projected CRS and the tangent frame at its origin."""

    crs: str
    """A projected CRS in metres, such as `EPSG:32631`."""
    origin: Float64Array
    """(3,) easting, northing, height of the ENU origin, metres, grid frame."""
    geoid_separation_m: float | None = None
    """Ellipsoidal height minus the map's height; 0 where the map's heights are ellipsoidal, None where not known."""

    def to_geographic(self, grid: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return latitude, longitude in degrees and ellipsoidal height in metres, each (N,), of grid points (N, 3).

        The height is NaN where the geoid separation is not known.
        """
        latitude, longitude = self._latitude_longitude(grid)
        if self.geoid_separation_m is None:
            return latitude, longitude, np.full(len(grid), np.nan)
        return latitude, longitude, grid[:, 2] + self.geoid_separation_m

    def from_geographic(
        self, latitude_deg: Float64Array, longitude_deg: Float64Array, altitude_m: Float64Array | None = None
    ) -> Float64Array:
        """Return grid points (N, 3) of WGS84 positions; heights are NaN where they or the geoid are not known."""
        latitude = np.atleast_1d(np.asarray(latitude_deg, dtype=np.float64))
        longitude = np.atleast_1d(np.asarray(longitude_deg, dtype=np.float64))
        easting, northing = _transformer(_WGS84_3D, self.crs).transform(longitude, latitude)
        grid = np.full((len(latitude), 3), np.nan)
        grid[:, 0], grid[:, 1] = easting, northing
        if altitude_m is not None and self.geoid_separation_m is not None:
            grid[:, 2] = np.asarray(altitude_m, dtype=np.float64) - self.geoid_separation_m
        return grid

    def to_enu(self, grid: Float64Array) -> Float64Array:
        """Return (N, 3) east, north, up in metres from the origin of grid points (N, 3).

        Where the geoid separation is not known it is taken as 0: that scales the frame by less than 1 in 60,000.
        """
        origin_ecef, R_enu_ecef = self._tangent
        result: Float64Array = (self._ecef(grid) - origin_ecef) @ R_enu_ecef.T
        return result

    def from_enu(self, enu: Float64Array) -> Float64Array:
        """Return the grid points (N, 3) of tangent-frame points (N, 3), the inverse of `to_enu`."""
        origin_ecef, R_enu_ecef = self._tangent
        ecef = enu @ R_enu_ecef + origin_ecef
        to_geographic = _transformer_3d(_WGS84_ECEF, _WGS84_3D)
        longitude, latitude, height = to_geographic.transform(ecef[:, 0], ecef[:, 1], ecef[:, 2])
        easting, northing = _transformer(_WGS84_3D, self.crs).transform(longitude, latitude)
        return np.column_stack([easting, northing, height - (self.geoid_separation_m or 0.0)])

    @property
    def pose_on_earth(self) -> Float64Array:
        """Return `T_earth_map` (4, 4): the tangent frame in `earth`, which is ECEF (REP-105), metres."""
        origin_ecef, R_enu_ecef = self._tangent
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R_enu_ecef.T, origin_ecef
        return T

    def convergence_rad(self, grid: Float64Array) -> Float64Array:
        """Return the angle (N,) from true north to grid north at grid points (N, 3), clockwise positive.

        A direction's yaw in a frame that points to true east is its yaw in the grid minus this angle.
        """
        latitude, longitude = self._latitude_longitude(grid)
        factors = _proj(self.crs).get_factors(longitude, latitude)
        return np.radians(np.atleast_1d(np.asarray(factors.meridian_convergence, dtype=np.float64)))

    @property
    def _tangent(self) -> tuple[Float64Array, Float64Array]:
        return _tangent_frame(self.crs, *(float(v) for v in self.origin), self.geoid_separation_m or 0.0)

    def _latitude_longitude(self, grid: Float64Array) -> tuple[Float64Array, Float64Array]:
        longitude, latitude = _transformer(self.crs, _WGS84_3D).transform(grid[:, 0], grid[:, 1])
        return np.asarray(latitude), np.asarray(longitude)

    def _ecef(self, grid: Float64Array) -> Float64Array:
        return _grid_to_ecef(self.crs, self.geoid_separation_m or 0.0, grid)


def _grid_to_ecef(crs: str, geoid_separation_m: float, grid: Float64Array) -> Float64Array:
    longitude, latitude = _transformer(crs, _WGS84_3D).transform(grid[:, 0], grid[:, 1])
    height = grid[:, 2] + geoid_separation_m
    to_ecef = _transformer_3d(_WGS84_3D, _WGS84_ECEF)
    return np.stack(to_ecef.transform(longitude, latitude, height), axis=-1)


@lru_cache(maxsize=16)
def _tangent_frame(
    crs: str, easting: float, northing: float, height: float, geoid_separation_m: float
) -> tuple[Float64Array, Float64Array]:
    """Return the origin in ECEF and the rotation from ECEF to east, north, up there."""
    origin = np.array([[easting, northing, height]])
    longitude, latitude = _transformer(crs, _WGS84_3D).transform(easting, northing)
    lam, phi = math.radians(longitude), math.radians(latitude)
    R_enu_ecef = np.array(
        [
            [-math.sin(lam), math.cos(lam), 0.0],
            [-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)],
            [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)],
        ]
    )
    return _grid_to_ecef(crs, geoid_separation_m, origin)[0], R_enu_ecef


@lru_cache(maxsize=64)
def _transformer(source: str, target: str) -> Transformer:
    """Return the horizontal transformation: vertical parts are taken off, so that no geoid is applied unasked."""
    return Transformer.from_crs(_horizontal(parse_crs(source)), _horizontal(parse_crs(target)), always_xy=True)


@lru_cache(maxsize=4)
def _transformer_3d(source: str, target: str) -> Transformer:
    return Transformer.from_crs(source, target, always_xy=True)


@lru_cache(maxsize=16)
def _proj(crs: str) -> Proj:
    return Proj(_horizontal(parse_crs(crs)))


def _horizontal(crs: CRS) -> CRS:
    if crs.is_compound:
        return _horizontal(crs.sub_crs_list[0])
    if crs.is_bound and crs.source_crs is not None:
        # The bound transformation to WGS84 is kept: PROJ uses it when it takes the whole CRS.
        return crs
    return crs.to_2d() if len(crs.axis_info) == 3 else crs


def _shortened(text: str, length: int = 80) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."
