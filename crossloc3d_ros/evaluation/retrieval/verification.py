"""Look again at the places that a descriptor found: how well does the scan's height map fit each of them?

A descriptor is short, so that all places can be searched; what distinguishes two similar places is often lost in it.
The first places of a query are few enough to compare heights cell by cell, in every heading and at the offset that fits
best (`clouds.height_map`; nothing is learned). Both distances then count:

    score = d / temperature + weight * m

with d the descriptors' distance and m that of the height maps. The temperature is that of the calibration that travels
with the encoder's weights: it frees the score of the unit of the descriptors, whatever their training made of it, and
does not depend on the size of the database as the spread of a query's places does. So the weight, which is fitted by
`train verification` on towns that no benchmark holds, need not be fitted anew for other weights.

The localizer does without it: it aligns its candidates anyway, and aligning all 300 finds no fewer poses than aligning
the 100 that height maps put first, in less time. Single scans of the pose benchmark (each fourth, 105 of Amsterdam and
120 simulated ones; `alignment.scope: candidates`), pose right within 2 m and 5 degrees, median time of a scan on two
cores:

    candidates aligned            Amsterdam        simulated
    25 by distance                63 %   54 ms     77 %    55 ms
    25 by verification of 300     70 %   78 ms     89 %    79 ms
    100 by distance (default)     70 %   76 ms     88 %    84 ms
    100 by verification of 300    78 %   93 ms     91 %   105 ms
    200 by distance               77 %   80 ms     92 %    85 ms
    300 by distance               77 %   77 ms     93 %    92 ms
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from crossloc3d_ros.clouds.height_map import Complex64Array, HeightMatcher, height_raster
from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import HeightMapConfig, VerificationConfig
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.evaluation.retrieval.encoding import north_angles
from crossloc3d_ros.evaluation.retrieval.predictions import Predictions, check_predictions, database_of, driven_angles
from crossloc3d_ros.types import CalibratedEncoder, DescriptorEncoder, Float32Array, Float64Array, Int64Array

STAGE = "verifying"
_BLOCK = 256
_TIMED_QUERIES = 15

Progress = Callable[[str, float, float, str], None]


class Fits(NamedTuple):
    """How queries fit some of their places."""

    distances: Float32Array
    """(Q, N) between height maps; infinite for a query that shows nothing."""
    headings_rad: Float32Array
    """(Q, N) by how much the query must be turned counter-clockwise to lie as the place, in [0, 2 pi)."""
    query_ms: float
    """Median to compare one query with its N places, in one thread."""


class _Comparer:
    """The maps of the retrieved places, ready to be compared."""

    def __init__(self, places: PlaceSet, half_extent_m: float) -> None:
        self._config = HeightMapConfig()
        self._matcher = HeightMatcher(self._config, half_extent_m)
        self._places = places
        self._row = np.full(len(places), -1, np.int64)
        self._spectra: Complex64Array = np.empty((0, 0, 0), np.complex64)

    def prepare(self, ids: Int64Array, pool: ThreadPoolExecutor, report: Callable[[int, int], None]) -> None:
        """Prepare the places `ids` (N,)."""
        starts = range(0, len(ids), _BLOCK)
        for start, part in zip(starts, pool.map(lambda s: self._prepared(ids[s : s + _BLOCK]), starts), strict=True):
            if start == 0:
                self._spectra = np.empty((len(ids), *part.shape[1:]), np.complex64)
            self._spectra[start : start + len(part)] = part
            report(start + len(part), len(ids))
        self._row[ids] = np.arange(len(ids))

    def compare(self, points: Float32Array, ids: Int64Array) -> tuple[Float32Array, Float64Array]:
        """Return distances and headings (N,) of a patch (n, 3) to prepared places (N,)."""
        spectra = self._spectra[self._row[ids]].transpose(1, 2, 0)
        fits = self._matcher.match_prepared(self._raster(points)[None], spectra)
        return fits.distances[0], fits.headings_rad[0]

    def _prepared(self, ids: Int64Array) -> Complex64Array:
        """Return (M, F, 2 rings), a place in one piece: what a query is compared with is gathered place by place."""
        rasters = np.stack([self._raster(np.asarray(self._places.patches[int(i)])) for i in ids])
        return np.ascontiguousarray(self._matcher.prepare(rasters).transpose(2, 0, 1))

    def _raster(self, points: Float32Array) -> Float32Array:
        # A square that was turned has corners outside; they belong to no cell.
        inside = (np.abs(points[:, :2]) <= 1.0).all(axis=1)
        if not inside.any():
            return np.zeros((self._config.cells, self._config.cells), np.float32)
        return height_raster(points[inside], self._config.cells)


def verify(
    predictions: Predictions, evaluation_set: EvaluationSet, encoder: DescriptorEncoder,
    config: VerificationConfig | None = None, *, threads: int = 1, progress: Progress | None = None,
) -> Predictions:  # fmt: skip
    """Return predictions whose first places are ordered by both distances; those behind keep their order.

    `encoder` made them; nothing is encoded. The order is the same for any number of threads, and every query's does
    not depend on the other queries. A query that shows nothing keeps its order. Raises EvaluationError where the
    predictions are of another set or encoder, of a database that scans belong to (they do not show all that stands
    around them), were ordered by height maps already, or hold too few places, and where the encoder carries no
    calibration.
    """
    config = config or VerificationConfig()
    if predictions.about.encoder != encoder.fingerprint:
        raise EvaluationError(
            f"the predictions '{predictions.about.name}' were made by {predictions.about.encoder}, not by "
            f"{encoder.fingerprint}: predict again"
        )
    temperature = temperature_of(encoder)
    fits = compare(
        predictions, evaluation_set, encoder.preprocessing.half_extent_m, config.candidates, threads=threads,
        progress=progress,
    )  # fmt: skip
    count = fits.distances.shape[1]
    order = np.tile(np.arange(predictions.ids.shape[1]), (len(predictions.ids), 1))
    order[:, :count] = np.argsort(
        scores_of(predictions.distances[:, :count], fits.distances, temperature, config.weight), axis=1, kind="stable"
    )
    about = dataclasses.replace(
        predictions.about, verified=count, verification_weight=config.weight, verify_ms=round(fits.query_ms, 3)
    )
    behind = np.full((len(order), order.shape[1] - count), np.nan, np.float32)

    def ordered(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, order, axis=1)

    return Predictions(
        about,
        ordered(predictions.ids),
        ordered(predictions.distances),
        ordered(predictions.headings),
        fits=ordered(np.concatenate((fits.distances, behind), axis=1)),
        fit_headings_rad=ordered(np.concatenate((fits.headings_rad, behind), axis=1)),
    )


def compare(
    predictions: Predictions, evaluation_set: EvaluationSet, half_extent_m: float, candidates: int, *,
    threads: int = 1, progress: Progress | None = None,
) -> Fits:  # fmt: skip
    """Compare each query with its first `candidates` places; `half_extent_m` is the unit of the patches.

    Raises EvaluationError as `verify` does, but for what concerns the encoder.
    """
    report = progress or (lambda stage, done, total, unit: None)
    about = predictions.about
    if about.verified:
        raise EvaluationError(f"the predictions '{about.name}' were ordered by height maps before: give those without")
    if about.setting != "aerial":
        raise EvaluationError(
            f"the predictions '{about.name}' name scans as places: only aerial submaps can be compared by height maps"
        )
    check_predictions(predictions, evaluation_set)
    queries, database = evaluation_set.queries, database_of(evaluation_set, about.setting)
    wanted = min(candidates, len(database))
    if predictions.ids.shape[1] < wanted:
        raise EvaluationError(
            f"the predictions '{about.name}' hold {predictions.ids.shape[1]} places a query, {wanted} are to be "
            "compared: predict again with --verify, without --only-score"
        )
    ids = predictions.ids[:, :wanted]
    angles = (north_angles(queries) if about.heading == "aligned" else driven_angles(queries))[:, 0]
    comparer = _Comparer(database, half_extent_m)

    def one(row: int) -> tuple[Float32Array, Float64Array]:
        points = np.array(queries.patches[row])
        return comparer.compare(rotate_about_z(points, float(angles[row])) if angles[row] else points, ids[row])

    distances, headings = np.empty(ids.shape, np.float32), np.empty(ids.shape, np.float32)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        comparer.prepare(np.unique(ids), pool, lambda done, total: report("height maps", done, total, "places"))
        query_ms = _median_ms(one, len(ids))
        for row, found in enumerate(pool.map(one, range(len(ids)))):
            distances[row], headings[row] = found
            report(STAGE, row + 1, len(ids), "queries")
    return Fits(distances, headings, query_ms)


def scores_of(distances: Float32Array, fits: Float32Array, temperature: float, weight: float) -> Float64Array:
    """Return (Q, N) what places are ordered by, smaller first, of descriptors' and height maps' distances (Q, N)."""
    return distances.astype(np.float64) / temperature + weight * fits.astype(np.float64)


def temperature_of(encoder: DescriptorEncoder) -> float:
    """Return the temperature of the calibration that comes with an encoder; EvaluationError where none does."""
    calibration = encoder.calibration if isinstance(encoder, CalibratedEncoder) else None
    if calibration is None:
        raise EvaluationError(
            "height maps cannot be weighed against descriptors that come without a calibration: what their distances "
            "mean is not known; train the weights with `train run`, which fits one"
        )
    return calibration.temperature


def _median_ms(one: Callable[[int], object], count: int) -> float:
    """Return the median milliseconds of single queries, after a first one that does not count."""
    taken = []
    for row in range(min(count, _TIMED_QUERIES + 1)):
        started = time.perf_counter()
        one(row)
        taken.append(1e3 * (time.perf_counter() - started))
    return float(np.median(taken[1:] or taken)) if taken else 0.0
