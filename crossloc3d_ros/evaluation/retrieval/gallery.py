"""The paper's figure: a query beside its first five places, seen from above, right ones framed green, wrong ones red.

Which queries are shown is drawn at random with a fixed seed, half from those whose first place is right and half from
those where it is wrong: never chosen by hand.
"""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.evaluation.retrieval.encoding import north_angles
from crossloc3d_ros.evaluation.retrieval.predictions import Predictions, database_of, metres_of
from crossloc3d_ros.types import BoolArray, Float32Array, Int64Array, UInt8Array

TOP = 5
_PIXELS = 144
_SEED = 2023
_HEIGHTS_M = np.array([0.0, 2.0, 5.0, 10.0, 16.0, 30.0])
_COLOURS = np.array(
    [[36, 62, 94], [45, 112, 142], [47, 158, 136], [140, 196, 92], [240, 214, 74], [255, 248, 214]], np.float64
)
_EMPTY = np.array([18, 24, 33], np.float64)


@dataclass(frozen=True)
class Picture:
    """One cloud from above, north up."""

    data_uri: str
    caption: str
    right: bool | None
    """Whether a retrieved place is right; None for the query itself."""


@dataclass(frozen=True)
class Row:
    """A query and the places retrieved first."""

    query: Picture
    places: tuple[Picture, ...]


def choose(right: BoolArray, count: int) -> tuple[Int64Array, Int64Array]:
    """Return up to `count` queries at random from those that are right, (Q,), and up to `count` from the others."""
    order = np.random.default_rng(_SEED).permutation(len(right))
    return order[right[order]][:count], order[~right[order]][:count]


def gallery(
    predictions: Predictions, evaluation_set: EvaluationSet, half_extent_m: float, *, count: int = 4,
    radius_m: float = 100.0,
) -> tuple[list[Row], list[Row]]:  # fmt: skip
    """Return `count` rows whose first place lies within the radius, and `count` where it does not.

    `half_extent_m` is the unit of the patches. Every cloud is drawn with north up, whatever the robot's heading.
    """
    queries, database = evaluation_set.queries, database_of(evaluation_set, predictions.about.setting)
    metres = metres_of(predictions, evaluation_set)
    chosen = choose(np.asarray(metres[:, 0] <= radius_m, dtype=np.bool_), count)
    query_north, database_north = north_angles(queries), north_angles(database)

    def row(i: int) -> Row:
        area = evaluation_set.area_names[queries.area[i]].replace("_", " ")
        picture = _picture(queries, i, float(query_north[i, 0]), half_extent_m, area, None)
        retrieved = []
        for place, apart in zip(predictions.ids[i, :TOP], metres[i, :TOP], strict=True):
            other = evaluation_set.area_names[database.area[place]].replace("_", " ")
            caption = f"{apart:,.0f} m" if math.isfinite(apart) else f"in {other}"
            if place >= len(evaluation_set.aerial):
                caption += ", scan"
            north = float(database_north[place, 0])
            retrieved.append(_picture(database, int(place), north, half_extent_m, caption, bool(apart <= radius_m)))
        return Row(picture, tuple(retrieved))

    return [row(int(i)) for i in chosen[0]], [row(int(i)) for i in chosen[1]]


def top_view(points: Float32Array, half_extent_m: float, pixels: int = _PIXELS) -> UInt8Array:
    """Return a picture (pixels, pixels, 3) of a patch (n, 3) from above: brighter is higher, the highest point wins."""
    place = np.floor((points[:, :2] + 1.0) * 0.5 * pixels).astype(np.int64)
    heights = np.full((pixels + 1, pixels + 1), -np.inf, np.float32)
    inside = ((place >= 0) & (place < pixels)).all(axis=1)
    for right in (0, 1):  # dots of two pixels a side: a scan is thin
        for down in (0, 1):
            np.maximum.at(heights, (pixels - 1 - place[inside, 1] + down, place[inside, 0] + right), points[inside, 2])
    heights = heights[:pixels, :pixels]
    picture = np.empty((pixels, pixels, 3))
    for channel in range(3):
        coloured = np.interp(np.maximum(heights, 0.0) * half_extent_m, _HEIGHTS_M, _COLOURS[:, channel])
        picture[..., channel] = np.where(np.isfinite(heights), coloured, _EMPTY[channel])
    return picture.astype(np.uint8)


def _picture(
    places: PlaceSet, row: int, north_rad: float, half_extent_m: float, caption: str, right: bool | None
) -> Picture:
    points = rotate_about_z(np.asarray(places.patches[row]), north_rad)
    return Picture(_png_uri(top_view(points, half_extent_m)), caption, right)


def _png_uri(picture: UInt8Array) -> str:
    buffer = io.BytesIO()
    Image.fromarray(picture).quantize(48, method=Image.Quantize.MEDIANCUT).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
