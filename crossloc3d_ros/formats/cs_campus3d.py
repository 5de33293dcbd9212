"""Datasets in the layout of CS-Campus3D and of Oxford RobotCar: clouds as bare numbers, and pickles that list them.

A cloud is a `.bin` of N x 3 little-endian float64. The training pickle is {id: {query: path, positives: [ids],
negatives: [ids], northing, easting}}; the pickles of databases and queries are lists of subsets, dictionaries or lists,
of {query, northing, easting}, where a query also names its true neighbours in subset m under the number m. Paths are
relative to the dataset's folder. Datasets of this package add `heading` (radians, from east) to scans, pickles of a
validation area, and `dataset.json`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.formats.plain_pickle import read_plain_pickle
from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array, UInt8Array

INFO = "dataset.json"
INFO_FORMAT = 1  # of the information file beside a dataset of one's own; a reader refuses others
CLOUD_POINTS = 4096  # as the published files hold
_MOST_CLOUDS = 5_000_000  # far more than any dataset has: a damaged or hostile file
_NAMED = 3  # missing files that a message names before it counts
_POSITIONS_CSV = "pointcloud_locations_20m_10overlap.csv"


@dataclass(frozen=True)
class Preset:
    """How a published dataset names its pickles and what its numbers mean."""

    name: str
    training: str
    database: str
    queries: str
    aerial_m: float | None
    """Metres of one unit of an aerial cloud; None: unknown, or given in `dataset.json`."""
    ground_m: float | None
    """The same for a scan."""
    validation_database: str | None = None
    validation_queries: str | None = None


PRESETS = {
    "campus": Preset(
        "campus", "training_queries_umd_4096.pickle", "umd_evaluation_database.pickle", "umd_evaluation_query.pickle",
        aerial_m=100.0, ground_m=20.0,
    ),
    "oxford": Preset(
        "oxford", "training_queries_baseline.pickle", "oxford_evaluation_database.pickle",
        "oxford_evaluation_query.pickle", aerial_m=None, ground_m=None,
    ),
    "plain": Preset(
        "plain", "training_queries_umd_4096.pickle", "umd_evaluation_database.pickle", "umd_evaluation_query.pickle",
        aerial_m=None, ground_m=None, validation_database="umd_validation_database.pickle",
        validation_queries="umd_validation_query.pickle",
    ),
}  # fmt: skip
"""`campus`: CS-Campus3D. `oxford`: Oxford RobotCar, whose clouds were scaled one by one. `plain`: what `make_dataset`
writes."""


@dataclass(frozen=True, eq=False)
class CloudTable:
    """Clouds and where they were taken."""

    files: tuple[str, ...]
    """(N,) relative to the dataset's folder."""
    xy_m: Float64Array
    """(N, 2) easting, northing, metres; NaN where the dataset has none."""
    heading_rad: Float64Array
    """(N,) of the cloud's x axis, counter-clockwise from east; 0 for submaps, NaN where not known."""
    is_ground: BoolArray
    """(N,) whether a robot took it; the others are aerial."""

    def __len__(self) -> int:
        return len(self.files)

    def rows(self, index: Int64Array | BoolArray) -> CloudTable:
        """Return the chosen rows."""
        chosen = np.arange(len(self))[index]
        files = tuple(self.files[i] for i in chosen)
        return CloudTable(files, self.xy_m[chosen], self.heading_rad[chosen], self.is_ground[chosen])


@dataclass(frozen=True, eq=False)
class TrainingTuples:
    """What is to be learned: which clouds show the same place."""

    clouds: CloudTable
    positives: tuple[Int64Array, ...]
    """(N,) rows of the clouds that show the same place as each."""
    negatives: tuple[UInt8Array, ...]
    """(N,) for each cloud one bit a row, set where that cloud shows another place; see `is_negative`."""

    def is_negative(self, row: int, others: Int64Array) -> BoolArray:
        """Return whether each of the rows `others` (K,) shows another place than `row`."""
        bits = self.negatives[row]
        inside = others < 8 * len(bits)
        found = np.zeros(len(others), np.bool_)
        chosen = others[inside]
        found[inside] = (bits[chosen >> 3] >> (7 - (chosen & 7)).astype(np.uint8)) & 1
        return found


@dataclass(frozen=True, eq=False)
class QueryTable:
    """One subset of the queries."""

    clouds: CloudTable
    neighbours: tuple[Mapping[int, Int64Array], ...]
    """(N,) for each query: database subset -> rows in it that are right."""


@dataclass(frozen=True, eq=False)
class EvaluationTuples:
    """Queries and the databases that they are retrieved from."""

    database: tuple[CloudTable, ...]
    queries: tuple[QueryTable, ...]


def preset_of(folder: Path, name: str | None = None) -> Preset:
    """Return the preset of that name, or the one that fits the folder; DatasetError where none does."""
    if not folder.is_dir():
        raise DatasetError(f"{folder} is no dataset: there is no such folder")
    if name is not None:
        if name not in PRESETS:
            raise DatasetError(f"there is no preset '{name}'; known are: {', '.join(PRESETS)}")
        return PRESETS[name]
    if (folder / INFO).is_file():
        return PRESETS["plain"]
    for preset in (PRESETS["campus"], PRESETS["oxford"]):
        if any((folder / file).is_file() for file in (preset.training, preset.database)):
            return preset
    expected = ", ".join(sorted({preset.database for preset in PRESETS.values()}))
    raise DatasetError(f"{folder} is no dataset: it holds neither {INFO} nor {expected}")


def read_info(folder: Path) -> dict[str, Any]:
    """Return how the dataset was made, from `dataset.json`; DatasetError where it is missing or damaged."""
    path = folder / INFO
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != INFO_FORMAT:
            raise DatasetError(f"{path} is of format {content['format']}, this version reads {INFO_FORMAT}")
        for key in ("half_extent_m", "scan_half_extent_m", "points"):
            content[key] + 0
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing: the preset 'plain' is for what make_dataset wrote") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} is damaged ({error}); make the dataset anew") from error
    return dict(content)


def read_training(folder: Path, preset: Preset) -> TrainingTuples:
    """Return the training tuples of a dataset, whose clouds are all there.

    Raises DatasetError for a pickle that is missing, damaged or holds code, for entries that are not of the form, and
    for missing clouds.
    """
    path = folder / preset.training
    content = read_plain_pickle(path, _bits)
    entries = _entries(path, content)
    clouds = _clouds(path, list(entries.values()), preset)
    row_of = {key: row for row, key in enumerate(entries)}
    in_order = all(key == row for key, row in row_of.items())
    positives, negatives = [], []
    for key, entry in entries.items():
        try:
            ids = _whole(entry["positives"])
            positives.append(ids if in_order else np.array([row_of[i] for i in ids.tolist()], np.int64))
            bits = np.asarray(entry.get("negatives", np.zeros(0, np.uint8)))
            negatives.append(bits.astype(np.uint8) if in_order else _moved(bits, row_of))
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{path}: entry {key!r} has no usable positives ({error})") from error
        if len(ids) and in_order and not 0 <= int(ids.min()) <= int(ids.max()) < len(entries):
            raise DatasetError(f"{path}: entry {key!r} names a positive that is not there")
    if np.isnan(clouds.xy_m).all() and preset.name == "oxford":
        clouds = CloudTable(clouds.files, _csv_positions(folder, clouds.files), clouds.heading_rad, clouds.is_ground)
    check_clouds(folder, clouds.files, _points_of(folder, preset))
    return TrainingTuples(clouds, tuple(positives), tuple(negatives))


def read_evaluation(folder: Path, preset: Preset, *, validation: bool = False) -> EvaluationTuples:
    """Return databases and queries, of the validation area with `validation`; raises as `read_training`."""
    names = (preset.validation_database, preset.validation_queries) if validation else (preset.database, preset.queries)
    if names[0] is None or names[1] is None:
        raise DatasetError(f"a dataset of the preset '{preset.name}' has no validation area of its own")
    path = folder / names[0]
    database = tuple(
        _clouds(path, list(_entries(path, subset).values()), preset)
        for subset in _subsets(path, read_plain_pickle(path))
    )
    query_path = folder / names[1]
    queries = []
    for subset in _subsets(query_path, read_plain_pickle(query_path)):
        entries = list(_entries(query_path, subset).values())
        neighbours = tuple(_neighbours(query_path, entry, database) for entry in entries)
        queries.append(QueryTable(_clouds(query_path, entries, preset), neighbours))
    files = [file for table in (*database, *(q.clouds for q in queries)) for file in table.files]
    check_clouds(folder, files, _points_of(folder, preset))
    return EvaluationTuples(database, tuple(queries))


def check_clouds(folder: Path, files: Iterable[str], points: int = CLOUD_POINTS) -> None:
    """Raise DatasetError where clouds are missing or of another size, saying how many and naming the first."""
    expected = points * 3 * 8
    missing: list[str] = []
    wrong: list[tuple[str, int]] = []
    names = list(dict.fromkeys(files))
    for file in names:
        try:
            size = (folder / file).stat().st_size
        except OSError:
            missing.append(file)
            continue
        if size != expected:
            wrong.append((file, size))
    if missing:
        raise DatasetError(
            f"{len(missing):,} of the {len(names):,} clouds of {folder} are missing: {_first(missing)}; unpack the "
            "dataset again, and give the folder that its paths begin in"
        )
    if wrong:
        shown = _first([f"{file} ({size:,} bytes)" for file, size in wrong])
        raise DatasetError(
            f"{len(wrong):,} of the {len(names):,} clouds of {folder} have another size than {points} points "
            f"({expected:,} bytes): {shown}; unpack the dataset again"
        )


def read_cloud(folder: Path, file: str, points: int = CLOUD_POINTS) -> Float64Array:
    """Return a cloud (points, 3) in its own units; DatasetError where it is missing, of another size or not finite."""
    try:
        values = np.fromfile(folder / file, "<f8")
    except OSError as error:
        raise DatasetError(f"the cloud {folder / file} is missing or cannot be read") from error
    if len(values) != 3 * points:
        raise DatasetError(f"the cloud {folder / file} holds {len(values):,} numbers instead of {3 * points:,}")
    if not np.isfinite(values).all():
        raise DatasetError(f"the cloud {folder / file} holds numbers that are not finite")
    cloud: Float64Array = values.reshape(-1, 3)
    return cloud


def _bits(key: Any, value: Any) -> Any:
    """Keep of the negatives one bit each: published lists of them would fill the memory."""
    if key != "negatives":
        return value
    ids = _whole(value)
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < _MOST_CLOUDS:
        raise ValueError("a negative has an impossible number")
    flags = np.zeros(int(ids.max()) + 1 if len(ids) else 0, np.uint8)
    flags[ids] = 1
    return np.packbits(flags)


def _moved(bits: UInt8Array, row_of: Mapping[Any, int]) -> UInt8Array:
    """Return the bits by row instead of by id."""
    flags = np.zeros(len(row_of), np.uint8)
    for number in np.flatnonzero(np.unpackbits(bits.astype(np.uint8))).tolist():
        if number in row_of:
            flags[row_of[number]] = 1
    return np.packbits(flags)


def _whole(value: Any) -> Int64Array:
    numbers = np.asarray(sorted(value) if isinstance(value, (set, frozenset)) else value)
    if numbers.size == 0:
        return np.zeros(0, np.int64)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu":
        raise ValueError("not a list of whole numbers")
    return numbers.astype(np.int64)


def _subsets(path: Path, content: Any) -> list[Any]:
    subsets = list(content.values()) if isinstance(content, dict) else content
    if not isinstance(subsets, list) or not all(isinstance(subset, (dict, list)) for subset in subsets):
        raise DatasetError(f"{path} is no list of subsets")
    return subsets


def _entries(path: Path, subset: Any) -> dict[Any, dict[Any, Any]]:
    entries = dict(enumerate(subset)) if isinstance(subset, (list, tuple)) else subset
    if not isinstance(entries, dict):
        raise DatasetError(f"{path} holds a {type(subset).__name__} where clouds should be listed")
    if len(entries) > _MOST_CLOUDS:
        raise DatasetError(f"{path} lists {len(entries):,} clouds, more than {_MOST_CLOUDS:,}")
    for key, entry in entries.items():
        if not isinstance(entry, dict) or not isinstance(entry.get("query"), str):
            raise DatasetError(f"{path}: entry {key!r} names no cloud under 'query'")
    return entries


def _clouds(path: Path, entries: Sequence[Mapping[Any, Any]], preset: Preset) -> CloudTable:
    files, places, headings = [], [], []
    for entry in entries:
        file = str(entry["query"])
        parts = PurePosixPath(file).parts
        if file.startswith("/") or ".." in parts:
            raise DatasetError(f"{path} is refused: '{file}' lies outside of the dataset")
        try:
            place = float(entry.get("easting", np.nan)), float(entry.get("northing", np.nan))
            headings.append(float(entry.get("heading", np.nan)))
        except (TypeError, ValueError) as error:
            raise DatasetError(f"{path}: the position of '{file}' is not a number") from error
        files.append(file)
        places.append(place)
    # By the folders; those of CS-Campus3D's ground scans hold files that are called aerial, too.
    is_ground = np.array(
        [preset.name == "oxford" or any("ground" in part for part in PurePosixPath(f).parts) for f in files], np.bool_
    )
    heading_rad = np.where(is_ground, np.array(headings, np.float64), 0.0)
    return CloudTable(tuple(files), np.array(places, np.float64).reshape(-1, 2), heading_rad, is_ground)


def _neighbours(path: Path, entry: Mapping[Any, Any], database: Sequence[CloudTable]) -> dict[int, Int64Array]:
    found = {}
    for key, value in entry.items():
        if not isinstance(key, int):
            continue
        try:
            rows = _whole(value)
        except ValueError as error:
            raise DatasetError(f"{path}: the neighbours of '{entry['query']}' are {error}") from error
        if not 0 <= key < len(database) or (len(rows) and not 0 <= rows.min() <= rows.max() < len(database[key])):
            raise DatasetError(f"{path}: '{entry['query']}' names neighbours that the database does not hold")
        found[key] = rows
    return found


def _points_of(folder: Path, preset: Preset) -> int:
    return int(read_info(folder)["points"]) if preset.name == "plain" else CLOUD_POINTS


def _csv_positions(folder: Path, files: Sequence[str]) -> Float64Array:
    """Return positions (N, 2) out of the tables that lie beside Oxford RobotCar's clouds; NaN where there is none."""
    tables: dict[PurePosixPath, dict[str, tuple[float, float]]] = {}
    places = np.full((len(files), 2), np.nan)
    for row, file in enumerate(files):
        run, stamp = PurePosixPath(file).parent.parent, PurePosixPath(file).stem
        if run not in tables:
            tables[run] = dict(_csv_rows(folder / run / _POSITIONS_CSV))
        if stamp in tables[run]:
            places[row] = tables[run][stamp]
    return places


def _csv_rows(path: Path) -> Iterator[tuple[str, tuple[float, float]]]:
    if not path.is_file():
        return
    try:
        for line in path.read_text(encoding="utf-8").splitlines()[1:]:
            stamp, northing, easting = line.split(",")[:3]
            yield stamp.strip(), (float(easting), float(northing))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} is damaged ({error})") from error


def _first(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMED:,} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more
