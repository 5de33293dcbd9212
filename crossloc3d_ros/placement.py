"""Whether a CRS fits coordinates: its area of use, its unit, the direction of its axes, the accuracy of its datum.

Headers of surveys are often wrong in one of these, and a map at the wrong place looks like any other. What the EPSG
register says of each CRS tells the right reading from the wrong one.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.crs import CompoundCRS
from pyproj.database import get_units_map
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.geodesy import crs_name, crs_text, horizontal_text, parse_crs, vertical_reference
from crossloc3d_ros.types import Float64Array

_WGS84 = "EPSG:4326"
_MARGIN_DEG = 2.0
"""Surveys reach over the edge of an area of use; another country's CRS puts them further off."""
_UTM_MARGIN_DEG = 18.0
"""Countries wider than a zone are delivered in one zone as a whole, as Norway is in 33."""
_SAME_UNIT = 1e-5
"""The international and the US survey foot differ by 2e-6: below what tells a false header."""
_NORTH_ORIENTATED = {9808: (9807, "Transverse Mercator"), 9819: (1041, "Krovak (North Orientated)")}
"""EPSG methods whose axes point south and west, and those of the same projection whose axes point east and north."""
_FALSE_ORIGIN = (8806, 8807)


class _Area(NamedTuple):
    """Where the register says that a CRS is used, degrees; east may be less than west."""

    west: float
    south: float
    east: float
    north: float
    name: str


@dataclass(frozen=True)
class PlacedCrs:
    """A CRS as the coordinates of a survey are meant."""

    crs: str
    """As `parse_crs` takes it; differs from the one that the files name where they contradict it."""
    notes: tuple[str, ...] = ()
    """What a user must know, a sentence each."""


@dataclass(frozen=True)
class DatumAccuracy:
    """How well a place in a survey's CRS is known in WGS84, apart from the survey's own error."""

    metres: float | None
    """What the EPSG register says of the transformation; None where nobody knows."""
    transformation: str
    missing_grids: tuple[str, ...] = ()
    """Files whose absence costs accuracy."""
    metres_with_grids: float | None = None


def unit_metres(code: int) -> float | None:
    """Return metres in a linear unit of the EPSG register; None for a code that is none."""
    return _units().get(str(code), (None, ""))[0]


def unit_of(crs: str) -> float | None:
    """Return metres in the unit of a projected CRS, None for degrees."""
    parsed = parse_crs(horizontal_text(crs))
    return float(parsed.axis_info[0].unit_conversion_factor) if parsed.is_projected else None


def unit_name(metres: float) -> str:
    """Return the name of a linear unit for messages: `metre`, `US survey foot`, or its length."""
    names = [name for length, name in _units().values() if abs(length / metres - 1.0) < 1e-8]
    return min(names, key=len) if names else f"unit of {metres:.7g} m"


def place(crs: str, points: Float64Array, unit_m: float | None = None) -> PlacedCrs:
    """Return the CRS as coordinates (N, 2) or (N, 3) of it (x or longitude first) are meant.

    `unit_m`: metres in their unit, where the file names one apart from its CRS. The readings of a file that
    contradicts itself, or of a CRS whose axes point south and west, are told apart by the area of use. Raises
    AerialDataError where no reading lies there, or several do.
    """
    readings = _readings(crs, unit_m)
    where = [_median_place(text, points) for text in readings]
    outside = [np.inf if at is None else degrees_outside(text, *at) for text, at in zip(readings, where, strict=True)]
    fitting = [i for i, degrees in enumerate(outside) if degrees <= _margin_deg(crs)]
    inside = [i for i in fitting if outside[i] == 0.0] or fitting
    notes = list(_small_differences(crs, unit_m))
    if len(inside) > 1 and _differ([where[i] for i in inside]):
        raise AerialDataError(_contradiction(readings, unit_m, "both put it where the CRS is used"))
    if not inside:
        raise AerialDataError(_nowhere(crs, readings, where, points, unit_m))
    chosen = inside[0]
    if chosen == 0 and _contradicts(crs, unit_m):
        notes.append(f"its unit's key names the {unit_name(unit_m or 1.0)}, {readings[crs]} is taken for true")
    elif chosen > 0:
        notes.append(
            f"{list(readings.values())[chosen]} is taken for true: otherwise the survey would lie outside of the area "
            f"where {_short_name(crs)} is used"
        )
    if outside[chosen] > 0.0:
        notes.append(_beyond(list(readings)[chosen], where[chosen], outside[chosen]))
    return PlacedCrs(list(readings)[chosen], tuple(notes))


def place_of(crs: str, x: float, y: float) -> tuple[float, float]:
    """Return longitude and latitude of coordinates in a CRS; AerialDataError where they are no place on Earth."""
    try:
        to_wgs84 = Transformer.from_crs(parse_crs(horizontal_text(crs)), _WGS84, always_xy=True)
        longitude, latitude = to_wgs84.transform(x, y)
    except ProjError:
        longitude = latitude = np.inf
    if not (abs(longitude) <= 360.0 and abs(latitude) <= 90.0):
        raise AerialDataError(
            f"the coordinates ({x:.7g}, {y:.7g}) do not fit the CRS {_short_name(crs)}; set the right one with --crs"
        )
    return (float(longitude) + 180.0) % 360.0 - 180.0, float(latitude)


def degrees_outside(crs: str, longitude_deg: float, latitude_deg: float) -> float:
    """Return how far a place lies outside of the area where a CRS is used, degrees; 0 inside or where none is known."""
    area = area_of_use(crs)
    if area is None:
        return 0.0
    width = (area.east - area.west) % 360.0 or 360.0
    east_of_west = (longitude_deg - area.west) % 360.0
    sideways = 0.0 if east_of_west <= width else min(east_of_west - width, 360.0 - east_of_west)
    return float(max(sideways, area.south - latitude_deg, latitude_deg - area.north, 0.0))


def area_of_use(crs: str) -> _Area | None:
    """Return where the register says that a CRS is used, None where it does not say."""
    parsed = parse_crs(horizontal_text(crs))
    area = parsed.area_of_use
    if area is None and (code := parsed.to_epsg()) is not None:
        area = CRS.from_epsg(code).area_of_use
    return None if area is None else _Area(area.west, area.south, area.east, area.north, area.name or "")


def datum_accuracy(crs: str, longitude_deg: float, latitude_deg: float) -> DatumAccuracy:
    """Return how accurate the way from a CRS to WGS84 is at a place, with the grids that are there."""
    reach = 0.01
    area = AreaOfInterest(
        max(longitude_deg - reach, -180.0), max(latitude_deg - reach, -90.0),
        min(longitude_deg + reach, 180.0), min(latitude_deg + reach, 90.0),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missing grids are part of the answer
        group = TransformerGroup(parse_crs(horizontal_text(crs)), _WGS84, always_xy=True, area_of_interest=area)  # type: ignore[arg-type]
    if not group.transformers:
        return DatumAccuracy(None, "none")
    used = group.transformers[0]
    metres = used.accuracy if used.accuracy >= 0.0 else None
    better = [
        operation
        for operation in group.unavailable_operations
        if 0.0 <= operation.accuracy < (np.inf if metres is None else metres)
    ]
    if not better:
        return DatumAccuracy(metres, used.description)
    best = min(better, key=lambda operation: operation.accuracy)
    grids = tuple(grid.short_name for grid in best.grids if not grid.available)
    return DatumAccuracy(metres, used.description, grids, best.accuracy)


def datum_words(datum: DatumAccuracy) -> str:
    """Return for people how well the survey's places are known in WGS84."""
    by = datum.transformation.removesuffix(" + axis order change (2D)").removeprefix("axis order change (2D) + ")
    if datum.metres == 0.0:
        return "the survey is in WGS84, the datum of GNSS; its own error alone counts"
    if datum.metres is None:
        return f"not known in WGS84, the datum of GNSS ({by})"
    return f"within {datum.metres:g} m in WGS84, the datum of GNSS, beside the survey's own error ({by})"


def datum_warnings(datum: DatumAccuracy) -> tuple[str, ...]:
    """Return what a user must know before fixes on a map of this survey are compared with GNSS, a sentence each."""
    if datum.missing_grids:
        now = "unknown" if datum.metres is None else f"{datum.metres:g} m"
        fetch = "; ".join(f"pyproj sync --file {grid}" for grid in datum.missing_grids)
        return (
            f"without the grid {', '.join(datum.missing_grids)} the error of the survey's datum is {now}, with it "
            f"{datum.metres_with_grids:g} m: fetch it ({fetch}) and build again",
        )
    if datum.metres is None:
        return (
            "no way from the survey's datum to WGS84 is known: fixes may be off by hundreds of metres; name the CRS by "
            "its EPSG code with --crs",
        )
    return ()


def with_vertical(crs: str, vertical_of: str) -> str:
    """Return a CRS with the vertical part of another, where it has none itself and that one has."""
    parsed, other = parse_crs(crs), parse_crs(vertical_of)
    if names_heights(crs) or not other.is_compound:
        return crs
    vertical = next((part for part in other.sub_crs_list if part.is_vertical), None)
    if vertical is None:
        return crs
    try:
        return crs_text(CompoundCRS(f"{parsed.name} + {vertical.name}", [parsed, vertical]))
    except CRSError as error:
        raise AerialDataError(f"the heights' {vertical.name} cannot be joined to {crs_name(crs)}: {error}") from error


def names_heights(crs: str) -> bool:
    """Return whether a CRS says what heights are measured from."""
    return vertical_reference(crs).name != "unknown"


@lru_cache(maxsize=1)
def _units() -> dict[str, tuple[float, str]]:
    units = get_units_map(auth_name="EPSG", category="linear", allow_deprecated=True)
    return {unit.code: (float(unit.conv_factor), unit.name) for unit in units.values()}


def _contradicts(crs: str, unit_m: float | None) -> bool:
    declared = unit_of(crs)
    return bool(declared and unit_m and abs(unit_m / declared - 1.0) > _SAME_UNIT)


def _readings(crs: str, unit_m: float | None) -> dict[str, str]:
    """Return the CRSs that coordinates may be meant in, the declared one first, each with what would be true then."""
    declared = unit_of(crs)
    readings = {crs: f"the unit of the CRS, {unit_name(declared)}," if declared else "the CRS"}
    if declared and unit_m and _contradicts(crs, unit_m):
        readings[_in_unit(crs, unit_m)] = f"the unit that the file names apart from its CRS, {unit_name(unit_m)},"
    for text in list(readings):
        turned = _east_and_north(text)
        if turned is not None:
            readings[turned] = "that x points east and y north, against the axes of the CRS,"
    return readings


def _in_unit(crs: str, unit_m: float) -> str:
    """Return a projected CRS with another unit of its coordinates; its parameters keep theirs."""
    horizontal = horizontal_text(crs)
    values = _without_identity(horizontal)
    for axis in values["coordinate_system"]["axis"]:
        axis["unit"] = {"type": "LinearUnit", "name": unit_name(unit_m), "conversion_factor": unit_m}
    return with_vertical(CRS.from_json_dict(values).to_wkt(), crs)


def _east_and_north(crs: str) -> str | None:
    """Return a CRS whose axes point south and west with axes that point east and north; None for any other."""
    horizontal = horizontal_text(crs)
    parsed = parse_crs(horizontal)
    if {axis.direction for axis in parsed.axis_info} != {"south", "west"}:
        return None
    values = _without_identity(horizontal)
    conversion = values.get("conversion", {})
    method = _NORTH_ORIENTATED.get(conversion.get("method", {}).get("id", {}).get("code"))
    if method is None:
        return None
    conversion.pop("id", None)
    conversion["method"] = {"name": method[1], "id": {"authority": "EPSG", "code": method[0]}}
    for parameter in conversion["parameters"]:
        if parameter.get("id", {}).get("code") in _FALSE_ORIGIN:
            parameter["value"] = -parameter["value"]
    unit = values["coordinate_system"]["axis"][0]["unit"]
    values["coordinate_system"]["axis"] = [
        {"name": name, "abbreviation": name[0], "direction": name.lower(), "unit": unit} for name in ("East", "North")
    ]
    return with_vertical(CRS.from_json_dict(values).to_wkt(), crs)


def _without_identity(crs: str) -> dict[str, Any]:
    values: dict[str, Any] = parse_crs(crs).to_json_dict()
    values.pop("id", None)
    values["name"] = f"{values['name']} as delivered"
    return values


def _median_place(crs: str, points: Float64Array) -> tuple[float, float] | None:
    """Return longitude and latitude of the middle of coordinates, as a stray point does not move it; None off Earth."""
    try:
        return place_of(crs, *(float(value) for value in np.median(points[:, :2], axis=0)))
    except AerialDataError:
        return None


def _differ(places: list[tuple[float, float] | None]) -> bool:
    return len({None if at is None else (round(at[0], 5), round(at[1], 5)) for at in places}) > 1


def _margin_deg(crs: str) -> float:
    return _UTM_MARGIN_DEG if "UTM zone" in parse_crs(crs).name else _MARGIN_DEG


def _small_differences(crs: str, unit_m: float | None) -> list[str]:
    declared = unit_of(crs)
    if not declared or not unit_m or not 1e-9 < abs(unit_m / declared - 1.0) <= _SAME_UNIT:
        return []
    return [
        f"the file names the {unit_name(unit_m)} beside {_short_name(crs)}, which has the {unit_name(declared)}; that "
        "of the CRS is used, and the two differ by metres far from its origin"
    ]


def _short_name(crs: str) -> str:
    return crs_name(horizontal_text(crs))


def _contradiction(readings: dict[str, str], unit_m: float | None, why: str) -> str:
    crs = next(iter(readings))
    declared = unit_of(crs)
    if declared and unit_m and _contradicts(crs, unit_m):
        what = f"contradicts itself: {_short_name(crs)} has the {unit_name(declared)}, its unit's key the "
        what += f"{unit_name(unit_m)}, and {why}"
    else:
        what = f"can be read in two ways, with the axes of {_short_name(crs)} or with x to the east, and {why}"
    return f"{what}; say with --crs which CRS its coordinates are in"


def _nowhere(
    crs: str,
    readings: dict[str, str],
    where: list[tuple[float, float] | None],
    points: Float64Array,
    unit_m: float | None,
) -> str:
    at = where[0]
    x, y = np.median(points[:, :2], axis=0)
    if at is None and len(readings) == 1:
        return f"the coordinates ({x:.7g}, {y:.7g}) do not fit the CRS {_short_name(crs)}; set the right one with --crs"
    if len(readings) > 1:
        return _contradiction(readings, unit_m, "neither puts it where the CRS is used")
    assert at is not None
    return (
        f"the coordinates ({x:.7g}, {y:.7g}) lie at {place_words(at[1], at[0])} by {_short_name(crs)}, which is used "
        f"{_area_words(crs)} only; set the right CRS with --crs"
    )


def _beyond(crs: str, at: tuple[float, float] | None, degrees: float) -> str:
    assert at is not None
    return (
        f"the survey lies at {place_words(at[1], at[0])}, {degrees:.1f} degrees outside of the area where "
        f"{_short_name(crs)} is used ({_area_words(crs)}); make sure that this is where it was flown"
    )


def place_words(latitude_deg: float, longitude_deg: float) -> str:
    """Return a place for people: `52.3702 N, 4.8952 E`."""
    return (
        f"{abs(latitude_deg):.4f} {'N' if latitude_deg >= 0 else 'S'}, "
        f"{abs(longitude_deg):.4f} {'E' if longitude_deg >= 0 else 'W'}"
    )


def _area_words(crs: str) -> str:
    area = area_of_use(crs)
    assert area is not None
    return (
        f"from {place_words(area.south, area.west)} to {place_words(area.north, area.east)} "
        f"({area.name.split(':')[0].rstrip('.')})"
    )
