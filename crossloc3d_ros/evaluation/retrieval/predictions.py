"""What a method predicts, before it is scored: the nearest places of every query, in files.

The searching knows nothing of where a query was taken but for the heading mode "aligned", in which the query is turned
to north by its true heading, as with a compass. Scoring (`scores`) is another step, from these files alone.
"""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.config import from_dict
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet, join_places
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.evaluation.retrieval.encoding import (
    EncodingJob,
    OwnDistance,
    encode_places,
    north_angles,
    time_queries,
)
from crossloc3d_ros.evaluation.statistics import one_per_cent
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.localization.retrieval.candidates import heading_angles
from crossloc3d_ros.types import DescriptorEncoder, Float32Array, Float64Array, HeadingEncoder, Int64Array

Setting = Literal["aerial", "aerial+ground"]
HeadingMode = Literal["aligned", "random"]
Way = Literal["nearest", "mean"]
SETTINGS: tuple[Setting, ...] = ("aerial", "aerial+ground")
HEADING_MODES: tuple[HeadingMode, ...] = ("aligned", "random")
STORED = 100
"""Places kept of each query, or as many as one per cent of the database where that is more."""
_BLOCK = 64
_ANGLE_SEED = 20_240_817
_OF_FITS = ("fits", "fit_headings_rad")


@dataclass(frozen=True)
class About:
    """What predictions were made of, and how."""

    benchmark: str
    data: str
    """Fingerprint of the evaluation set."""
    weights: str
    """What the method is called in tables."""
    encoder: str
    """Fingerprint of the encoder."""
    setting: Setting
    heading: HeadingMode
    query_headings: int = 1
    """In how many headings, evenly over the circle, each query was encoded."""
    way: Way = "nearest"
    """What was made of them: the nearest kept, or the mean of the descriptors."""
    database: int = 0
    """Places searched."""
    descriptor_size: int = 0
    encode_ms: float = 0.0
    """Median to encode one query in all its headings, in one process."""
    search_ms: float = 0.0
    verified: int = 0
    """How many first places of a query were reordered by height maps (`verification`); 0: retrieval alone."""
    verification_weight: float = 0.0
    verify_ms: float = 0.0
    """Median to compare one query with that many places, in one thread."""

    @property
    def name(self) -> str:
        """A short name, unique among the predictions of one method and benchmark."""
        way = "" if self.query_headings == 1 else f"_{self.query_headings}-{self.way}"
        again = f"_verified-{self.verified}" if self.verified else ""
        return f"{self.setting.replace('+', '_')}_{self.heading}{way}{again}"

    @property
    def kind(self) -> str:
        """What ordered the places, for people."""
        return "retrieval + height maps" if self.verified else "retrieval"

    @property
    def query_ms(self) -> float:
        """Time a query takes in all."""
        return self.encode_ms + self.search_ms + self.verify_ms


@dataclass(frozen=True, eq=False)
class Predictions:
    """The nearest places of every query, best first."""

    about: About
    ids: Int64Array
    """(Q, K) rows of the database: the aerial places, then those of the ground database."""
    distances: Float32Array
    """(Q, K) between descriptors; they ascend unless the places were verified."""
    headings: Int64Array
    """(Q, K) number of the heading, of `about.query_headings`, in which the query lay nearest."""
    fits: Float32Array | None = None
    """(Q, K) between height maps, NaN for places that were not verified; None where none was."""
    fit_headings_rad: Float32Array | None = None
    """(Q, K) in which heading the height maps fitted best, counter-clockwise from how the query was given."""


@dataclass(frozen=True)
class Plan:
    """Which predictions are made."""

    settings: tuple[Setting, ...] = SETTINGS
    headings: tuple[HeadingMode, ...] = HEADING_MODES
    query_headings: tuple[int, ...] = (1,)
    """Compared in the heading mode "random"; an aligned query needs no other heading."""
    invariant: bool = True
    """Whether descriptors are meant to be the same in every heading, so that their mean makes sense."""
    kept: int = STORED
    """Places kept of each query at least, as far as the database has them."""

    def __post_init__(self) -> None:
        """Refuse a plan without anything to do."""
        if not (self.settings and self.headings and self.query_headings):
            raise ConfigError("name at least one setting, one heading mode and one number of query headings")
        for count in self.query_headings:
            if not 1 <= count <= 360:
                raise ConfigError(f"'query_headings' must lie between 1 and 360, got {count}")


def way_of(encoder: DescriptorEncoder) -> tuple[int, Way]:
    """Return in how many headings the localizer tries a query with an encoder, and what it makes of them."""
    if isinstance(encoder, HeadingEncoder):
        if encoder.headings > 1:
            return encoder.headings, "nearest"
        if encoder.rotations > 1:
            return encoder.rotations, "mean"
    return 1, "nearest"


def database_of(evaluation_set: EvaluationSet, setting: Setting) -> PlaceSet:
    """Return the places that are searched; EvaluationError where the set has none of that setting."""
    if setting == "aerial":
        return evaluation_set.aerial
    if evaluation_set.ground is None:
        raise EvaluationError(f"'{evaluation_set.name}' has no ground database: only the setting 'aerial' is possible")
    return join_places([evaluation_set.aerial, evaluation_set.ground], [0, 0])


def check_set(evaluation_set: EvaluationSet) -> None:
    """Raise EvaluationError where nothing can be learned from a set: no query, or an area without any submap."""
    if len(evaluation_set.queries) == 0:
        raise EvaluationError(f"'{evaluation_set.name}' has no query")
    if len(evaluation_set.aerial) == 0:
        raise EvaluationError(f"'{evaluation_set.name}' has no aerial submap")
    lost = sorted(set(evaluation_set.queries.area.tolist()) - set(evaluation_set.aerial.area.tolist()))
    if lost:
        names = ", ".join(evaluation_set.area_names[area] for area in lost[:5])
        raise EvaluationError(f"'{evaluation_set.name}' has queries in areas without any aerial submap: {names}")


def predict_all(evaluation_set: EvaluationSet, job: EncodingJob, plan: Plan, weights: str) -> list[Predictions]:
    """Encode what the plan needs and search for every query, exactly; one `Predictions` a setting and way.

    Database places are turned to north by their headings (aerial ones lie so already), as mapped places can be.
    """
    check_set(evaluation_set)
    for setting in plan.settings:
        database_of(evaluation_set, setting)
    fingerprint = evaluation_set.fingerprint()
    encoded = [encode_places(job, evaluation_set.aerial, north_angles(evaluation_set.aerial), "submaps")]
    if "aerial+ground" in plan.settings and evaluation_set.ground is not None:
        encoded.append(encode_places(job, evaluation_set.ground, north_angles(evaluation_set.ground), "ground"))
    queries = evaluation_set.queries
    north = north_angles(queries)
    ways: list[tuple[HeadingMode, int, Way, Float32Array]] = []
    if "aligned" in plan.headings:
        ways.append(("aligned", 1, "nearest", encode_places(job, queries, north, "aligned")))
    if "random" in plan.headings:
        counts = sorted(set(plan.query_headings))
        most = counts[-1]
        # A divisor's headings are among those of the largest number.
        turns = {count: most if most % count == 0 else count for count in counts}
        driven = driven_angles(queries)
        tried = {
            most: encode_places(job, queries, driven + heading_angles(most), f"{most} heading" + "s" * (most > 1))
            for most in sorted(set(turns.values()))
        }
        for count in counts:
            descriptors = tried[turns[count]][:, :: turns[count] // count]
            ways.append(("random", count, "nearest", descriptors))
            if count > 1 and plan.invariant:
                ways.append(("random", count, "mean", descriptors.mean(axis=1, keepdims=True)))
    predictions = []
    own = job.encoder if isinstance(job.encoder, OwnDistance) else None
    timed: dict[int, tuple[float, float]] = {}
    for setting in plan.settings:
        database = np.concatenate(encoded if setting == "aerial+ground" else encoded[:1])[:, 0]
        top = min(len(database), max(STORED, plan.kept, one_per_cent(len(database), rounded_up=False)))
        index = DescriptorMap(database) if own is None else None
        for mode, count, way, descriptors in ways:
            if count not in timed:
                timed[count] = time_queries(job.encoder, queries, count, database, top)
            encode_ms, search_ms = timed[count]
            about = About(
                evaluation_set.name, fingerprint, weights, job.encoder.fingerprint, setting, mode, count, way,
                len(database), job.encoder.descriptor_size, round(encode_ms, 3), round(search_ms, 3),
            )  # fmt: skip
            if index is not None:
                found = nearest(index, descriptors, top)
            else:
                assert own is not None
                found = nearest_by(own, database, descriptors, top)
            predictions.append(Predictions(about, *found))
    return predictions


def driven_angles(queries: PlaceSet) -> Float64Array:
    """Return (Q, 1) by how much queries are turned for the heading mode "random".

    Nothing where a scan lies as it was driven. Queries of a data set that is aligned already (heading 0), or that does
    not say, are turned by random angles, the same at every call.
    """
    random_angles = np.random.default_rng(_ANGLE_SEED).uniform(0.0, 2.0 * np.pi, len(queries))
    as_driven = np.isfinite(queries.heading_rad) & (queries.heading_rad != 0.0)
    return np.where(as_driven, 0.0, random_angles)[:, None]


def nearest(index: DescriptorMap, queries: Float32Array, top: int) -> tuple[Int64Array, Float32Array, Int64Array]:
    """Return ids, distances and heading numbers (Q, top) of the places nearest to any of a query's (Q, H, D)."""
    count, headings, size = queries.shape
    ids, distances, numbers = _empty(count, min(top, len(index)))
    for start in range(0, count, _BLOCK):
        block = np.ascontiguousarray(queries[start : start + _BLOCK])
        found, apart = index.search_many(block.reshape(-1, size), top)
        for row in range(len(block)):
            part = slice(row * headings, (row + 1) * headings)
            merged = _merge(found[part], apart[part], ids.shape[1])
            ids[start + row], distances[start + row], numbers[start + row] = merged
    return ids, distances, numbers


def nearest_by(
    method: OwnDistance, database: Float32Array, queries: Float32Array, top: int
) -> tuple[Int64Array, Float32Array, Int64Array]:
    """Do the same as `nearest` by the distance of a method's own; places at the same distance in their order."""
    count, headings, size = queries.shape
    ids, distances, numbers = _empty(count, min(top, len(database)))
    block = max(1, _BLOCK // headings)
    for start in range(0, count, block):
        part = np.ascontiguousarray(queries[start : start + block])
        apart = method.distances(part.reshape(-1, size), database).reshape(len(part), headings, -1)
        best = apart.min(axis=1)
        order = np.argsort(best, axis=1, kind="stable")[:, : ids.shape[1]]
        rows = slice(start, start + len(part))
        ids[rows] = order
        distances[rows] = np.take_along_axis(best, order, axis=1)
        numbers[rows] = np.take_along_axis(apart.argmin(axis=1), order, axis=1)
    return ids, distances, numbers


def _empty(count: int, top: int) -> tuple[Int64Array, Float32Array, Int64Array]:
    shape = (count, top)
    return np.empty(shape, np.int64), np.empty(shape, np.float32), np.empty(shape, np.int64)


def _merge(ids: Int64Array, distances: Float32Array, top: int) -> tuple[Int64Array, Float32Array, Int64Array]:
    """Return one list (top,) of the lists (H, top) of a query's headings; a place counts where it is nearest."""
    order = np.argsort(distances, axis=None, kind="stable")
    flat = ids.reshape(-1)[order]
    first = np.sort(np.unique(flat, return_index=True)[1])[:top]
    best = order[first]
    return flat[first], distances.reshape(-1)[best], best // ids.shape[1]


def save_predictions(path: Path, predictions: Predictions) -> None:
    """Write predictions to a file, whole or not at all."""
    buffer = io.BytesIO()
    about = np.frombuffer(json.dumps(dataclasses.asdict(predictions.about)).encode(), np.uint8)
    np.savez(
        buffer,
        about=about,
        ids=predictions.ids.astype(np.int32),
        distances=predictions.distances,
        headings=predictions.headings.astype(np.int16),
        **{name: values for name in _OF_FITS if (values := getattr(predictions, name)) is not None},
    )
    write_atomically(path, buffer.getvalue(), EvaluationError, parents=True)


def load_predictions(path: Path) -> Predictions:
    """Read predictions; EvaluationError where the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            about = from_dict(About, json.loads(file["about"].tobytes()))
            ids, distances, headings = (file[name] for name in ("ids", "distances", "headings"))
            fits = {name: file[name].astype(np.float32) for name in _OF_FITS if about.verified}
    except FileNotFoundError as error:
        raise EvaluationError(f"no such predictions: {path}") from error
    except (OSError, ValueError, KeyError, EOFError, ConfigError, zipfile.BadZipFile) as error:
        raise EvaluationError(f"the predictions {path} are damaged ({error}); make them again") from error
    columns = (ids, distances, headings, *fits.values())
    if ids.ndim != 2 or any(column.shape != ids.shape for column in columns):
        raise EvaluationError(f"the predictions {path} are damaged; make them again")
    return Predictions(about, ids.astype(np.int64), distances.astype(np.float32), headings.astype(np.int64), **fits)


def check_predictions(predictions: Predictions, evaluation_set: EvaluationSet) -> None:
    """Raise EvaluationError where predictions and set do not belong together."""
    about, database = predictions.about, database_of(evaluation_set, predictions.about.setting)
    if about.data != evaluation_set.fingerprint():
        raise EvaluationError(
            f"the predictions '{about.name}' were made of another set than '{evaluation_set.name}' as it is here "
            f"({about.data}, this is {evaluation_set.fingerprint()}): predict again"
        )
    ids = predictions.ids
    if len(ids) != len(evaluation_set.queries) or (ids.size and not (ids.min() >= 0 and ids.max() < len(database))):
        raise EvaluationError(f"the predictions '{about.name}' name places that the set does not have: predict again")


def metres_of(predictions: Predictions, evaluation_set: EvaluationSet) -> Float64Array:
    """Return the horizontal distances (Q, K) in metres of each query from its places, infinite in other areas.

    Raises EvaluationError where predictions and set do not belong together.
    """
    check_predictions(predictions, evaluation_set)
    queries, database = evaluation_set.queries, database_of(evaluation_set, predictions.about.setting)
    ids = predictions.ids
    offsets = database.xy_m[ids] - queries.xy_m[:, None]
    metres = np.hypot(offsets[..., 0], offsets[..., 1])
    metres[database.area[ids] != queries.area[:, None]] = np.inf
    return np.asarray(metres)
