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
    horizontal_text,
    metres_per_unit,
    same_crs,
    utm_crs_of,
    vertical_reference,
)
from crossloc3d_ros.placement import DatumAccuracy, datum_accuracy, names_heights, place, place_of
from crossloc3d_ros.types import Float64Array

_log = logging.getLogger(__name__)
_MOST_AREA_A_POINT_M2 = 25.0
_SAME_UNIT = 1e-7
"""The international and the US survey foot differ by 2e-6."""


@dataclass(frozen=True, eq=False)
class Survey:
    """The headers of a survey's files and what they have in common."""

    headers: tuple[AerialHeader, ...]
    """Of the files that hold points, all with the same CRS."""
    map_crs: str
    """The UTM zone of the survey's middle, such as EPSG:32631."""
    vertical: VerticalReference
    """What the heights are measured from, and their unit."""
    datum: DatumAccuracy
    """How well places in the files' CRS are known in WGS84."""

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

    Files without points are left out. What headers say falsely, and can be read around, is logged as a warning. Raises
    AerialDataError where a file cannot be read or has no CRS, where no file holds a point, where the files differ in
    CRS or vertical unit, and where the points lie outside of the area where their CRS is used.
    """
    paths = expand_inputs(inputs)
    headers = [read_header(path, crs) for path in paths]
    for header in headers:
        if header.point_count == 0:
            _log.warning("%s holds no points and is left out", header.path)
    _log_notes([(header.path, note) for header in headers for note in header.notes])
    headers = [_with_sound_box(header) for header in headers if header.point_count > 0]
    if not headers:
        raise AerialDataError(f"the area is empty: none of the {len(paths)} files holds a point")
    # The first look names files of several CRSs, the second those that are meant otherwise than they say.
    headers = _of_one_crs(_placed(_of_one_crs(headers)))
    vertical = vertical_reference(headers[0].crs, headers[0].vertical_metres_per_unit)
    x, y = _middle(headers)
    map_crs = crs_text(utm_crs_of(headers[0].crs, x, y))
    datum = datum_accuracy(headers[0].crs, *place_of(headers[0].crs, x, y))
    return Survey(tuple(headers), map_crs, vertical, datum)


def _log_notes(notes: Sequence[tuple[Path, str]]) -> None:
    """Say each thing once, however many files it is true of."""
    files: dict[str, list[Path]] = {}
    for path, note in notes:
        files.setdefault(note, []).append(path)
    for note, paths in files.items():
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        _log.warning("%s%s: %s", paths[0], more, note)


def _with_sound_box(header: AerialHeader) -> AerialHeader:
    """Return the header with the box of its sample where its own box is false: most of the sample lies outside."""
    if len(header.sample) == 0:
        return header
    box = np.array([header.minimum, header.maximum])[:, :2]
    slack = 0.01 * np.ptp(header.sample[:, :2], axis=0) + 1e-6
    sample = header.sample[:, :2]
    inside = ((sample >= box[0] - slack) & (sample <= box[1] + slack)).all(axis=1)
    if np.isfinite([header.minimum, header.maximum]).all() and inside.mean() > 0.5:
        return header
    _log.warning("%s: the box in its header is false and left aside", header.path)
    return dataclasses.replace(header, minimum=header.sample.min(axis=0), maximum=header.sample.max(axis=0))


def _placed(headers: Sequence[AerialHeader]) -> list[AerialHeader]:
    """Return the headers with the CRSs that their coordinates are meant in."""
    groups: dict[tuple[str, float | None], list[int]] = {}
    for index, header in enumerate(headers):
        groups.setdefault((header.crs, header.metres_per_unit), []).append(index)
    placed = list(headers)
    for (crs, unit_m), members in groups.items():
        points = np.concatenate([_sampled(headers[index]) for index in members])
        try:
            meant = place(crs, points, unit_m)
        except AerialDataError as error:
            raise AerialDataError(f"{headers[members[0]].path}: {error}") from error
        _log_notes([(headers[index].path, note) for note in meant.notes for index in members])
        for index in members:
            placed[index] = dataclasses.replace(headers[index], crs=meant.crs, metres_per_unit=None)
    return placed


def _of_one_crs(headers: Sequence[AerialHeader]) -> list[AerialHeader]:
    """Return the headers with one CRS and one vertical unit for all; AerialDataError where they differ.

    The same unit of heights may be said by a vertical CRS in one file and by a key in another. A file that does not
    say what its heights are measured from goes with those that do.
    """
    groups: list[list[AerialHeader]] = []
    for header in headers:
        group = next((group for group in groups if _agree(group[0], header)), None)
        if group is None:
            groups.append([header])
        elif names_heights(header.crs) and not names_heights(group[0].crs):
            group.insert(0, header)
        else:
            group.append(header)
    if len(groups) > 1:
        raise AerialDataError(
            f"the files of one build must share one CRS; here are {len(groups)}: "
            + "; ".join(_described(group) for group in groups)
            + ". Build a map of each, or, where headers are wrong, say the right CRS with --crs, with that of the "
            "heights, as in EPSG:<horizontal>+<vertical>"
        )
    first = groups[0][0]
    if names_heights(first.crs):
        silent = [header.path for header in headers if not names_heights(header.crs)]
        name = vertical_reference(first.crs).name
        _log_notes([(path, f"it does not say what its heights are measured from; taken for {name}") for path in silent])
    unit_m = first.vertical_metres_per_unit
    return [dataclasses.replace(header, crs=first.crs, vertical_metres_per_unit=unit_m) for header in headers]


def _agree(first: AerialHeader, second: AerialHeader) -> bool:
    if not same_crs(horizontal_text(first.crs), horizontal_text(second.crs)):
        return False
    one, other = (vertical_reference(header.crs, header.vertical_metres_per_unit) for header in (first, second))
    if abs(one.metres_per_unit / other.metres_per_unit - 1.0) > _SAME_UNIT:
        return False
    both_named = names_heights(first.crs) and names_heights(second.crs)
    return not both_named or same_crs(first.crs, second.crs) or one.name == other.name


def _described(group: Sequence[AerialHeader]) -> str:
    names = ", ".join(header.path.name for header in group[:3])
    more = f" and {len(group) - 3} more" if len(group) > 3 else ""
    unit_m = vertical_reference(group[0].crs, group[0].vertical_metres_per_unit).metres_per_unit
    return f"{crs_name(group[0].crs)}, heights in units of {unit_m:.7g} m in {names}{more}"


def _sampled(header: AerialHeader) -> Float64Array:
    """Return points (N, 3) of a file; those of a file that cannot be read are the corners of its box."""
    return header.sample if len(header.sample) else np.array([header.minimum, header.maximum])


def _middle(headers: Sequence[AerialHeader]) -> tuple[float, float]:
    """Return the median of the survey's x and y, each file weighed by its points: stray ones do not move it."""
    samples = [_sampled(header)[:, :2] for header in headers]
    points = np.concatenate(samples)
    weights = np.concatenate(
        [np.full(len(s), header.point_count / len(s)) for s, header in zip(samples, headers, strict=True)]
    )
    middle = []
    for values in points.T:
        order = np.argsort(values)
        sums = np.cumsum(weights[order])
        middle.append(float(values[order][np.searchsorted(sums, sums[-1] / 2.0)]))
    return middle[0], middle[1]
