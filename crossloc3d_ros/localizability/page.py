"""`localizability.html`: the map by where a robot is localized, and which streets are taken for each other."""

from __future__ import annotations

import math
from collections import Counter as Tally
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from crossloc3d_ros.aerial_map.calibration import MapCalibration
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.evaluation.statistics import Share, wilson_share
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.localizability.driving import FAR_M, NEAR_M, DrivenPlace
from crossloc3d_ros.localizability.raster import CELL_M, NEVER, RASTER, distance_class
from crossloc3d_ros.localizability.twins import Twin, twins_of
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.backdrop import Backdrop, draw_backdrop
from crossloc3d_ros.pages.render import render_page
from crossloc3d_ros.pages.wording import written_by
from crossloc3d_ros.types import Float64Array

PAGE = "localizability.html"
CLASSES = {0.0: "once", NEAR_M: "soon", FAR_M: "late", NEVER: "never"}
"""Names in the style sheet of what `distance_class` gives."""
WORDS = {
    "once": "at once",
    "soon": f"within {NEAR_M:g} m",
    "late": f"within {FAR_M:g} m",
    "never": f"not within {FAR_M:g} m",
}
MOST_TWINS = 20
"""Pairs that are listed and drawn."""


@dataclass(frozen=True)
class Kind:
    """One of the four classes of places."""

    css: str
    words: str
    share: Share
    count: int


@dataclass(frozen=True)
class Spot:
    """A place on the page's map, in metres right of and below its corner."""

    css: str
    x: float
    y: float
    words: str


@dataclass(frozen=True)
class TwinRow:
    """A pair of places on the page: in its list, and on its map."""

    number: int
    twin: Twin
    here: str
    there: str
    """Latitudes and longitudes."""
    ends: tuple[float, float, float, float]
    """x, y of either end on the map."""


@dataclass(frozen=True)
class MapPicture:
    """The page's map, in metres right of and below its corner."""

    picture_uri: str
    width_m: float
    height_m: float
    pixel_m: float
    scale_m: int
    cells: Mapping[str, str]
    """Of each class an SVG path of the cells around its places."""
    spots: Sequence[Spot]


@dataclass(frozen=True)
class LocalizabilityPage:
    """What the template of the page knows."""

    title: str
    facts: Mapping[str, str]
    calibration: MapCalibration
    limit_words: str
    kinds: Sequence[Kind]
    right: Share
    map: MapPicture
    twins: Sequence[TwinRow]
    twins_found: int
    chart: Markup
    raster: str
    far_m: float
    near_m: float
    footer: str


def write_page(
    folder: Path, aerial_map: AerialMap, calibration: MapCalibration, places: Sequence[DrivenPlace], distance: Raster
) -> None:
    """Write the page into the map's folder; MapError where that fails."""
    write_atomically(folder / PAGE, page_text(aerial_map, calibration, places, distance), MapError)


def page_text(
    aerial_map: AerialMap, calibration: MapCalibration, places: Sequence[DrivenPlace], distance: Raster
) -> str:
    """Return the page of a calibration: places with the offset, and the distances (H, W) of the raster."""
    backdrop = draw_backdrop(aerial_map, np.array([(place.easting, place.northing) for place in places]))
    found = twins_of(places)
    page = LocalizabilityPage(
        title=f"Where a robot is localized on {aerial_map.path.name}",
        facts=_facts(aerial_map, calibration),
        calibration=calibration,
        limit_words=limit_words(calibration),
        kinds=_kinds(places),
        right=wilson_share(calibration.counts.right / max(len(places), 1), len(places)),
        map=_picture(backdrop, places, distance),
        twins=[_row(number, twin, aerial_map, backdrop) for number, twin in enumerate(found[:MOST_TWINS], start=1)],
        twins_found=len(found),
        chart=_chart(places),
        raster=RASTER,
        far_m=FAR_M,
        near_m=NEAR_M,
        footer=written_by(),
    )
    return render_page("localizability.html.j2", page)


def limit_words(calibration: MapCalibration) -> str:
    """Return the sentence that says where the offset comes from."""
    fitted = f"{calibration.unlimited_offset:+.2f} ± {calibration.offset_std:.2f}"
    if calibration.offset == 0.0:
        return (
            f"The most probable offset, {fitted}, would raise the belief. Simulated scans fit the map that they are "
            "made of better than real ones, so it is left at 0; no scan off the map is believed above 99 %."
        )
    if calibration.offset < calibration.unlimited_offset:
        return (
            f"The most probable offset, {fitted}, is lowered to {calibration.offset:+.2f}, so that no scan off the map "
            "is believed above 99 %."
        )
    return f"It is the most probable one, {fitted}; with it no scan off the map is believed above 99 %."


def _facts(aerial_map: AerialMap, calibration: MapCalibration) -> dict[str, str]:
    west, south, east, north = aerial_map.bounds
    return {
        "lidar": f"{calibration.lidar}, {calibration.lidar_height_m:g} m above the ground",
        "map": f"{(east - west) / 1e3:.2f} x {(north - south) / 1e3:.2f} km, {aerial_map.manifest.crs}",
        "places": f"{calibration.counts.places:,}",
        "scans off the map": f"{calibration.counts.off_map:,}",
        "offset": f"{calibration.offset:+.2f}",
        "seed": f"{calibration.seed}",
        "map built": aerial_map.manifest.created,
        "calibrated": calibration.created,
    }


def _kinds(places: Sequence[DrivenPlace]) -> list[Kind]:
    tally = Tally(distance_class(place) for place in places)
    return [
        Kind(css, WORDS[css], wilson_share(tally[value] / len(places), len(places)), tally[value])
        for value, css in CLASSES.items()
    ]


def _picture(backdrop: Backdrop, places: Sequence[DrivenPlace], distance: Raster) -> MapPicture:
    west, south, east, north = backdrop.bounds
    width, height = east - west, north - south
    spots = []
    for place in places:
        css = CLASSES[distance_class(place)]
        one = f"one scan alone: {'right' if place.is_right else 'wrong'}, probability {100 * place.probability:.0f} %"
        spots.append(Spot(css, place.easting - west, north - place.northing, f"{WORDS[css]}; {one}"))
    return MapPicture(
        picture_uri=backdrop.data_uri,
        width_m=width,
        height_m=height,
        pixel_m=max(width, height) / 900.0,
        scale_m=max(v for v in (10, 20, 50, 100, 200, 500, 1000, 2000) if v <= max(10.0, width / 4)),
        cells={css: _cells(distance, value, backdrop) for value, css in CLASSES.items()},
        spots=[spot for spot in spots if 0.0 <= spot.x <= width and 0.0 <= spot.y <= height],
    )


def _cells(distance: Raster, value: float, backdrop: Backdrop) -> str:
    """Return the path around all cells of one value, clipped to the picture."""
    west, south, east, north = backdrop.bounds
    commands = []
    for row, column in np.argwhere(distance.values == value).tolist():
        left, top = distance.west_m + column * CELL_M, distance.north_m - row * CELL_M
        x0, x1 = max(left, west) - west, min(left + CELL_M, east) - west
        y0, y1 = north - min(top, north), north - max(top - CELL_M, south)
        if x1 > x0 and y1 > y0:
            commands.append(f"M{x0:g} {y0:g}h{x1 - x0:g}v{y1 - y0:g}h{x0 - x1:g}z")
    return "".join(commands)


def _row(number: int, twin: Twin, aerial_map: AerialMap, backdrop: Backdrop) -> TwinRow:
    west, _, _, north = backdrop.bounds
    (x0, y0), (x1, y1) = twin.here, twin.there
    height = aerial_map.manifest.origin[2]
    latitude, longitude, _ = aerial_map.frame.to_geographic(np.array([[x0, y0, height], [x1, y1, height]]))
    here, there = (f"{latitude[i]:.5f}, {longitude[i]:.5f}" for i in range(2))
    return TwinRow(number, twin, here, there, (x0 - west, north - y0, x1 - west, north - y1))


def _chart(places: Sequence[DrivenPlace]) -> Markup:
    """Draw the share of places from which a robot is localized, over the metres driven."""
    metres = np.arange(0.0, FAR_M + 1.0)
    share = charts.cumulative(np.array([place.localized_m for place in places]), len(places), metres)
    chart = charts.Chart(
        charts.linear_axis(0.0, FAR_M, "metres driven from a place, knowing nothing", suffix=" m"),
        charts.share_axis("places localized"),
        "Share of the places from which a robot is localized, over the metres driven",
    )
    band = wilson_band(share, len(places))
    return chart.render([chart.band(metres, *band, "inside"), chart.line(metres, share, "s-fix")])


def wilson_band(share: Float64Array, count: int) -> tuple[Float64Array, Float64Array]:
    """Return the lower and upper ends of the 95 % intervals of shares (n,) of so many places."""
    intervals = [wilson_share(float(value), count) for value in share if math.isfinite(value)]
    return np.array([each.low for each in intervals]), np.array([each.high for each in intervals])
