"""Learning from a dataset in the layout of CS-Campus3D: a user's own, or a published one.

The clouds of such a dataset were cut once, so a submap is rotated by quarters, which loses nothing, and a scan by any
angle. Datasets of `make_dataset` bring an area to validate on; of the others a strip of the training clouds is held
out, and what would see both sides of its border is used for neither.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.datasets.place_sets import PlaceSet
from crossloc3d_ros.datasets.published import PatchSource, load_evaluation_set, open_source, place_set
from crossloc3d_ros.errors import DatasetError, TrainingError
from crossloc3d_ros.formats.cs_campus3d import INFO, CloudTable, Preset, TrainingTuples, preset_of, read_training
from crossloc3d_ros.training.areas import TRAINING, VALIDATION, Roles, cut_areas
from crossloc3d_ros.training.augmentation import heading_error, occlude, paper_batch, paper_cloud
from crossloc3d_ros.training.sampling import Batch, HardPlaces
from crossloc3d_ros.training.shards import ValidationTown
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int64Array

_ATTEMPTS = 60  # scans drawn in vain before the material is declared unusable
_HELD_OUT = 0.1
"""Share of the scans that is held out where the dataset has no validation area."""
_CLOUD_REACH_M = 25.0
"""How far Oxford RobotCar's clouds see: their scale is not published, they are cut every 10 m from 20 m of a drive."""


@dataclass(frozen=True, eq=False)
class _Material:
    """A dataset's training tuples and which of them may be learned from."""

    source: PatchSource
    tuples: TrainingTuples
    roles: Roles
    """(N,) of each cloud: to learn from, to validate on, or '' for neither."""


class PatchSampler:
    """Draws batches of a scan and a submap of the same place from a dataset's clouds."""

    def __init__(self, source: PatchSource, tuples: TrainingTuples, rows: BoolArray, config: TrainConfig) -> None:
        """Use the clouds `rows` (N,); TrainingError where no scan among them has a positive to learn from."""
        self._source, self._tuples, self._config = source, tuples, config
        clouds = tuples.clouds
        self._clouds = clouds
        self._known = bool(np.isfinite(clouds.xy_m[rows]).all())
        from_air = bool((~clouds.is_ground).any())
        self._positives: list[Int64Array] = []
        anchors = []
        unknown_heading = 0
        for row in np.flatnonzero(rows & clouds.is_ground).tolist():
            positives = tuples.positives[row]
            positives = positives[rows[positives] & ~(clouds.is_ground[positives] if from_air else positives == row)]
            if len(positives) == 0:
                continue
            if config.headings > 1 and not np.isfinite(clouds.heading_rad[row]):
                unknown_heading += 1
                continue
            anchors.append(row)
            self._positives.append(self._near(row, positives))
        self._anchors = np.array(anchors, np.int64)
        if unknown_heading and not anchors:
            raise TrainingError(
                f"{source.folder} holds no headings of its scans: train with headings 1, not {config.headings}"
            )
        if not anchors:
            what = "an aerial submap" if from_air else "another cloud"
            raise TrainingError(
                f"the training area of {source.folder} ({self._area(rows)}) holds "
                f"{int((rows & clouds.is_ground).sum()):,} scans and none of them has {what} as a positive: there is "
                "nothing to learn from"
            )

    def __len__(self) -> int:
        """Return how many scans there are to learn from."""
        return len(self._anchors)

    @property
    def places(self) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Return town (N,), which is 0, scan (N,) and position (N, 2), metres, of all scans to learn from."""
        if not self._known:
            raise TrainingError(f"{self._source.folder} holds no positions of its clouds: train without hard_share")
        numbers = np.arange(len(self._anchors), dtype=np.int64)
        return np.zeros_like(numbers), numbers, self._clouds.xy_m[self._anchors]

    def submap(self, town: int, scan: int) -> Float32Array | None:
        """Return the patch (n, 3) of the submap nearest to a scan, or None where there is too little."""
        row = int(self._positives[scan][0])
        return self._source.patch(self._clouds.files[row], is_ground=bool(self._clouds.is_ground[row]))

    def batch(self, step: int, *, pairs: int = 0, hard: HardPlaces | None = None) -> Batch:
        """Return the batch of a step, the same at every call with the same arguments; see `BatchSampler.batch`."""
        config = self._config
        rng = np.random.default_rng((config.seed, step))
        pairs = pairs or config.pairs
        wanted: list[int] = []
        if hard is not None:
            count = round(config.hard_share * pairs)
            while len(wanted) < count:
                first = int(rng.integers(len(hard.scan)))
                wanted += hard.scan[[first, *rng.permutation(hard.neighbours[first])[:3]]].tolist()
            wanted = wanted[:count]
        scans: list[Float32Array] = []
        submaps: list[Float32Array] = []
        scan_rows = np.empty(pairs, np.int64)
        submap_rows = np.empty(pairs, np.int64)
        for i in range(pairs):
            request = wanted[i - pairs] if i >= pairs - len(wanted) else None
            scan, submap, scan_rows[i], submap_rows[i] = self._pair(rng, scan_rows[:i], request)
            scans.append(scan)
            submaps.append(submap)
        if config.augmentation == "paper":
            scans, submaps = paper_batch((scans, submaps), rng)
        matches, ignored = self._relations(scan_rows, submap_rows)
        return Batch(scans, submaps, ignored, matches)

    def _pair(
        self, rng: np.random.Generator, taken: Int64Array, request: int | None
    ) -> tuple[Float32Array, Float32Array, int, int]:
        """Return a scan, a submap of its place and the rows of both; the place is not among those `taken`."""
        config, clouds = self._config, self._clouds
        choices = self._choices(rng, taken)
        for attempt in range(_ATTEMPTS):
            number = request if request is not None and attempt == 0 else int(rng.choice(choices))
            row = int(self._anchors[number])
            other = int(rng.choice(self._positives[number]))
            scan = self._source.patch(clouds.files[row], is_ground=True)
            submap = self._source.patch(clouds.files[other], is_ground=bool(clouds.is_ground[other]))
            if scan is None or submap is None:
                continue
            if config.augmentation == "paper":
                return paper_cloud(scan, rng), paper_cloud(submap, rng), row, other
            scan = occlude(scan, rng, config)
            if len(scan) == 0:
                continue
            quarter = int(rng.integers(4))
            submap = rotate_about_z(submap, quarter * math.pi / 2.0)
            angle = heading_error(rng, config)
            if config.headings > 1:
                angle += float(clouds.heading_rad[row]) + quarter * math.pi / 2.0
            scan = rotate_about_z(scan, angle)
            if rng.integers(2):
                mirror = np.array([1.0, -1.0, 1.0], np.float32)
                scan, submap = scan * mirror, submap * mirror
            return scan, submap, row, other
        raise TrainingError(
            f"{self._source.folder}: {_ATTEMPTS} scans in a row gave no pair of patches with at least "
            f"{config.preprocessing.min_points} points; lower min_points"
        )

    def _choices(self, rng: np.random.Generator, taken: Int64Array) -> Int64Array:
        """Return the numbers of the scans to draw from: apart from those taken, with `near_share` near one of them."""
        config = self._config
        everything = np.arange(len(self._anchors))
        if len(taken) == 0:
            return everything
        if not self._known:
            free = ~np.any([self._same(row, self._anchors) for row in taken.tolist()], axis=0)
            return everything[free] if free.any() else everything
        here = self._clouds.xy_m[self._anchors]
        nearest = np.full(len(here), np.inf)
        for place in self._clouds.xy_m[taken]:
            np.minimum(nearest, np.hypot(here[:, 0] - place[0], here[:, 1] - place[1]), out=nearest)
        free = nearest >= config.neighbour_m
        near = free & (nearest <= config.near_m)
        if rng.random() < config.near_share and near.any():
            free = near
        return everything[free] if free.any() else everything

    def _relations(self, scan_rows: Int64Array, submap_rows: Int64Array) -> tuple[BoolArray, BoolArray]:
        """Return which scans and submaps (P, P) match and which are neither match nor mismatch."""
        config = self._config
        if self._known:
            scan_xy, submap_xy = self._clouds.xy_m[scan_rows], self._clouds.xy_m[submap_rows]
            apart = np.hypot(*(scan_xy[:, None] - submap_xy[None]).transpose(2, 0, 1))
            matches = apart < config.match_m
            unclear = apart < config.neighbour_m
        else:
            matches = np.zeros((len(scan_rows), len(submap_rows)), np.bool_)
            unclear = np.array([self._same(row, submap_rows) for row in scan_rows.tolist()])
        np.fill_diagonal(matches, True)
        return matches, unclear & ~matches

    def _same(self, row: int, others: Int64Array) -> BoolArray:
        """Return which rows may show the same place as `row`, by what the dataset calls different."""
        return np.logical_not(self._tuples.is_negative(row, others))

    def _near(self, row: int, positives: Int64Array) -> Int64Array:
        """Return the positives that lie about as near as the configured offset allows, the nearest first."""
        if not self._known:
            return positives
        offsets = self._clouds.xy_m[positives] - self._clouds.xy_m[row]
        distances = np.hypot(offsets[:, 0], offsets[:, 1])
        order = np.argsort(distances, kind="stable")
        limit = max(float(distances.min()), math.sqrt(2.0) * self._config.offset_m)
        near: Int64Array = positives[order][distances[order] <= limit]
        return near

    def _area(self, rows: BoolArray) -> str:
        places = self._clouds.xy_m[rows]
        places = places[np.isfinite(places).all(axis=1)]
        if len(places) == 0:
            return f"{int(rows.sum()):,} clouds, positions unknown"
        (west, south), (east, north) = places.min(axis=0), places.max(axis=0)
        return f"easting {west:.0f} to {east:.0f}, northing {south:.0f} to {north:.0f}"


def load_training(folder: Path, preset: str | None, config: TrainConfig) -> PatchSampler:
    """Return what draws batches from the training area of a dataset.

    `preset`: `campus`, `oxford`, `plain`, or None for the one that fits. Raises DatasetError where the dataset is
    missing or damaged and TrainingError where its training area has no positives.
    """
    material = _read(folder, preset, config)
    return PatchSampler(material.source, material.tuples, material.roles == TRAINING, config)


def load_validation(folder: Path, preset: str | None, config: TrainConfig) -> list[ValidationTown]:
    """Return what is validated on: the dataset's own validation area, or the part of its training clouds held out.

    Raises as `load_training`, and TrainingError where there is no scan or no submap to validate on.
    """
    kind = preset_of(folder, preset)
    if kind.validation_queries is not None:
        try:
            places = load_evaluation_set(folder, config.preprocessing, kind.name, validation=True)
        except DatasetError as error:
            raise TrainingError(f"{error}; make the dataset with a --validation-share above 0") from error
        return [_town(places.name, places.queries, places.aerial)]
    material = _read(folder, preset, config)
    clouds = material.tuples.clouds
    held = material.roles == VALIDATION
    queries, database = clouds.rows(held & clouds.is_ground), clouds.rows(held & ~clouds.is_ground)
    if len(database) == 0 and kind.name == "oxford":
        queries, database = _other_runs(queries)
    return [
        _town(f"{folder.name} (held out)", place_set(material.source, queries), place_set(material.source, database))
    ]


def fingerprint(folder: Path, preset: str | None = None) -> str:
    """Return 64 hexadecimal digits that change with the lists of a dataset's clouds; DatasetError where they miss."""
    kind = preset_of(folder, preset)
    names = [kind.training, kind.validation_database, kind.validation_queries]
    names += [INFO] if kind.name == "plain" else []
    digest = hashlib.sha256(kind.name.encode())
    for name in names:
        if name is not None:
            try:
                with (folder / name).open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
            except OSError as error:
                raise DatasetError(f"{folder / name} is missing or cannot be read") from error
    return digest.hexdigest()


def _read(folder: Path, preset: str | None, config: TrainConfig) -> _Material:
    kind = preset_of(folder, preset)
    source = open_source(folder, kind, config.preprocessing)
    tuples = read_training(folder, kind)
    return _Material(source, tuples, _roles(folder, kind, tuples, config))


def _roles(folder: Path, kind: Preset, tuples: TrainingTuples, config: TrainConfig) -> Roles:
    clouds = tuples.clouds
    if kind.validation_queries is not None:
        return np.full(len(clouds), TRAINING, dtype="<U10")
    if not np.isfinite(clouds.xy_m).all():
        raise TrainingError(
            f"{folder} holds no positions of its training clouds, so that no area can be held out to validate on; "
            "Oxford RobotCar's positions stand in the .csv files beside its clouds"
        )
    if kind.name == "oxford":
        scan_reach_m = submap_reach_m = _CLOUD_REACH_M
    else:
        scan_reach_m = math.sqrt(2.0) * config.preprocessing.scan_half_extent_m
        submap_reach_m = config.preprocessing.half_extent_m
    try:
        areas = cut_areas(
            clouds.xy_m[clouds.is_ground], scan_reach_m, {TRAINING: 1.0 - _HELD_OUT, VALIDATION: _HELD_OUT}
        )
    except DatasetError as error:
        raise TrainingError(f"no area of {folder} can be held out to validate on: {error}") from error
    ground, aerial = areas.roles(clouds.xy_m, scan_reach_m), areas.roles(clouds.xy_m, submap_reach_m)
    return np.where(clouds.is_ground, ground, aerial)


def _other_runs(clouds: CloudTable) -> tuple[CloudTable, CloudTable]:
    """Return the clouds of the run that has the most of them, to be retrieved from those of the other runs."""
    runs = np.array([file.rsplit("/", 2)[0] for file in clouds.files])
    names, counts = np.unique(runs, return_counts=True)
    is_query = runs == names[counts.argmax()] if len(names) > 1 else np.arange(len(clouds)) % 2 == 0
    return clouds.rows(is_query), clouds.rows(~is_query)


def _town(name: str, queries: PlaceSet, submaps: PlaceSet) -> ValidationTown:
    if len(queries) == 0 or len(submaps) == 0:
        raise TrainingError(f"{name} has {len(queries)} scans and {len(submaps)} submaps to validate on")
    return ValidationTown(
        name=name,
        query_xy_m=queries.xy_m,
        query_patches=np.stack(list(queries.patches)),
        submap_xy_m=submaps.xy_m,
        submap_patches=np.stack(list(submaps.patches)),
    )
