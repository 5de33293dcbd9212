"""What the files of an aerial survey are together: one CRS, one vertical reference, one UTM zone for the map."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.formats.las import AerialHeader, expand_inputs, read_header
from crossloc3d_ros.geodesy import (
    VerticalReference,
    crs_name,
    crs_text,
    metres_per_unit,
    same_crs,
    utm_crs_of,
    vertical_reference,
)
from crossloc3d_ros.types import Float64Array

_log = logging.getLogger(__name__)
_MOST_AREA_A_POINT_M2 = 25.0


@dataclass(frozen=True, eq=False)
class Survey:
    """The headers of a survey's files and what they have in common."""

    headers: tuple[AerialHeader, ...]
    """Of the files that hold points, all with the same CRS."""
    map_crs: str
    """The UTM zone of the survey's middle, such as EPSG:32631."""
    vertical: VerticalReference
    """What the heights are measured from, and their unit."""

    @property
    def crs(self) -> str:
        """The CRS of the files."""
        return self.headers[0].crs

    @property
    def vertical_metres_per_unit(self) -> float | None:
        """Metres in a unit of height where the headers name it apart from the CRS."""
        return self.headers[0].vertical_metres_per_unit

    @property
    def points(self) -> int:
        """Points in all files."""
        return sum(header.point_count for header in self.headers)

    @property
    def minimum(self) -> Float64Array:
        """(3,) least coordinates of all files, in the files' units."""
        return np.asarray(np.min([header.minimum for header in self.headers], axis=0))

    @property
    def area_m2(self) -> float:
        """The area of the files' boxes, no more than so many points can cover.

        The box of a header with a stray point, or a broken one, is no measure of the area.
        """
        area_m2 = 0.0
        for header in self.headers:
            sides = (header.maximum - header.minimum)[:2] * metres_per_unit(self.crs, float(header.minimum[1]))
            area_m2 += min(float(np.prod(np.maximum(sides, 1.0))), _MOST_AREA_A_POINT_M2 * header.point_count)
        return area_m2


def read_survey(inputs: Sequence[str | Path], crs: str | None = None) -> Survey:
    """Read the headers of files, folders and globs; `crs` replaces that of the files.

    Files without points are left out. Raises AerialDataError where a file cannot be read or has no CRS, where no file
    holds a point, and where the files differ in CRS or vertical unit.
    """
    paths = expand_inputs(inputs)
    headers = [read_header(path, crs) for path in paths]
    for header in headers:
        if header.point_count == 0:
            _log.warning("%s holds no points and is left out", header.path)
    headers = [header for header in headers if header.point_count > 0]
    if not headers:
        raise AerialDataError(f"the area is empty: none of the {len(paths)} files holds a point")
    _check_same_crs(headers)
    headers = [dataclasses.replace(header, crs=headers[0].crs) for header in headers]
    vertical = vertical_reference(headers[0].crs, headers[0].vertical_metres_per_unit)
    return Survey(tuple(headers), _utm_crs(headers), vertical)


def _check_same_crs(headers: Sequence[AerialHeader]) -> None:
    groups: list[list[AerialHeader]] = []
    for header in headers:
        for group in groups:
            if same_crs(group[0].crs, header.crs) and (
                group[0].vertical_metres_per_unit == header.vertical_metres_per_unit
            ):
                group.append(header)
                break
        else:
            groups.append([header])
    if len(groups) > 1:
        raise AerialDataError(
            f"the files of one build must share one CRS; here are {len(groups)}: "
            + "; ".join(_described(group) for group in groups)
            + ". Build a map of each, or, where headers are wrong, say the right CRS with --crs"
        )


def _described(group: Sequence[AerialHeader]) -> str:
    names = ", ".join(header.path.name for header in group[:3])
    more = f" and {len(group) - 3} more" if len(group) > 3 else ""
    unit = group[0].vertical_metres_per_unit
    heights = "" if unit is None else f", heights in units of {unit:.7g} m"
    return f"{crs_name(group[0].crs)}{heights} in {names}{more}"


def _utm_crs(headers: Sequence[AerialHeader]) -> str:
    """Return the UTM zone of the survey's middle, each file weighed by its points."""
    weights = np.array([header.point_count for header in headers], dtype=np.float64)
    centres = np.array([(header.minimum[:2] + header.maximum[:2]) / 2.0 for header in headers])
    x, y = (weights / weights.sum()) @ centres
    return crs_text(utm_crs_of(headers[0].crs, float(x), float(y)))
