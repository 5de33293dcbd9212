"""The CRS of an aerial file out of the records in its header: WKT, or GeoTIFF keys as in LAS 1.0 to 1.3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.geodesy import crs_text, parse_crs, vertical_reference
from crossloc3d_ros.placement import unit_metres

_WKT, _GEOKEYS = 2112, 34735
_GEOGRAPHIC_KEY, _PROJECTED_KEY, _UNITS_KEY, _VERTICAL_KEY, _VERTICAL_UNITS_KEY = 2048, 3072, 3076, 4096, 4099
_USER_DEFINED = 32767
_ELLIPSOID_CODES = range(5001, 5034)
"""GeoTIFF's own codes of heights above an ellipsoid."""


class Record(NamedTuple):
    """A record of the user `LASF_Projection`."""

    record_id: int
    data: bytes


@dataclass(frozen=True)
class FileCrs:
    """What the records of a file say of its coordinates."""

    crs: str | None = None
    """As `geodesy.parse_crs` takes it; None where they name none that can be used."""
    problem: str = "names no CRS"
    """Why `crs` is None."""
    metres_per_unit: float | None = None
    """Of x and y, where a key names it apart from the CRS."""
    vertical_metres_per_unit: float | None = None
    """Of heights, where a key names it apart from the CRS."""
    notes: tuple[str, ...] = ()

    @property
    def heights_m(self) -> float | None:
        """Metres in a unit of height, where the file says so in any way; None where it does not."""
        if self.crs is None:
            return self.vertical_metres_per_unit
        vertical = vertical_reference(self.crs, self.vertical_metres_per_unit)
        return vertical.metres_per_unit if vertical.name != "unknown" or self.vertical_metres_per_unit else None


def crs_of_records(records: Sequence[Record]) -> FileCrs:
    """Return what the records say; a WKT goes before keys, as the LAS specification has it."""
    for record in records:
        text = _text(record.data) if record.record_id == _WKT else ""
        if text:
            try:
                return FileCrs(crs_text(parse_crs(text)))
            except AerialDataError as error:
                return FileCrs(problem=f"has a CRS in its header that cannot be used: {error}")
    for record in records:
        if record.record_id == _GEOKEYS:
            return _of_geokeys(record.data)
    return FileCrs()


def _text(data: bytes) -> str:
    """Return a WKT; writers on old Windows systems take their own encoding for UTF-8."""
    data = data.strip(b"\0 \n")
    try:
        return data.decode("utf-8").strip()
    except UnicodeDecodeError:
        return data.decode("latin-1").strip()


def _of_geokeys(data: bytes) -> FileCrs:
    entries = np.frombuffer(data[: len(data) // 8 * 8], "<u2").reshape(-1, 4)[1:]
    keys = {int(key): int(value) for key, location, _, value in entries if location == 0}
    horizontal = next((c for c in (keys.get(_PROJECTED_KEY), keys.get(_GEOGRAPHIC_KEY)) if _is_epsg(c)), None)
    unit_m, notes = _unit(keys.get(_UNITS_KEY), "x and y")
    vertical_unit_m, more = _unit(keys.get(_VERTICAL_UNITS_KEY), "heights")
    notes += more
    if horizontal is None or keys.get(_PROJECTED_KEY, 0) == _USER_DEFINED:
        problem = "describes a CRS without an EPSG code in its header"
        return FileCrs(None, problem, unit_m, vertical_unit_m, notes)
    try:
        crs, more = _with_height(horizontal, keys.get(_VERTICAL_KEY))
    except AerialDataError as error:
        problem = f"has a CRS in its header that cannot be used: {error}"
        return FileCrs(None, problem, unit_m, vertical_unit_m, notes)
    named_m = vertical_reference(crs).metres_per_unit if vertical_reference(crs).name != "unknown" else None
    if named_m and vertical_unit_m and abs(named_m / vertical_unit_m - 1.0) > 1e-9:
        more += (
            f"its vertical CRS has heights in units of {named_m:.7g} m, its key says {vertical_unit_m:.7g} m; the key "
            "is followed",
        )
    return FileCrs(crs, "", unit_m, vertical_unit_m, notes + more)


def _with_height(horizontal: int, vertical: int | None) -> tuple[str, tuple[str, ...]]:
    crs = parse_crs(f"EPSG:{horizontal}")
    if vertical is None or not _is_epsg(vertical):
        return crs_text(crs), ()
    try:
        return crs_text(parse_crs(f"EPSG:{horizontal}+{vertical}")), ()
    except AerialDataError:
        if vertical in _ELLIPSOID_CODES:
            return crs_text(crs.to_3d()), ()
        return crs_text(crs), (f"its vertical CRS {vertical} is unknown and left aside",)


def _unit(code: int | None, what: str) -> tuple[float | None, tuple[str, ...]]:
    if code is None or code == 0:
        return None, ()
    metres = unit_metres(code)
    if metres is None:
        return None, (f"its unit of {what}, code {code}, is unknown and left aside",)
    return metres, ()


def _is_epsg(code: int | None) -> bool:
    return code is not None and 1024 <= code <= 32766
