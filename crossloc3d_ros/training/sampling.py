"""Batches of matching places: a pure function of the seed and the step, so that a resumed run draws the same ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit

from crossloc3d_ros.clouds.patch import make_patch, turn
from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training.augmentation import change, heading_error, occlude, paper_batch, paper_cloud
from crossloc3d_ros.training.shards import TrainingTown
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int64Array

_CELL_M = 10.0  # a cut reads whole cells: small beside a patch, and many points each
_ATTEMPTS = 60  # scans drawn in vain before the material is declared unusable
_HARD_GROUP = 4
"""Places of a batch that were taken for each other."""


@dataclass(frozen=True, eq=False)
class Batch:
    """P scans and the P submaps that they lie in."""

    scans: list[Float32Array]
    """P patches (n, 3)."""
    submaps: list[Float32Array]
    """P patches (n, 3); row i belongs to scan i."""
    ignored: BoolArray
    """(P, P) scan i and submap j of one town, too near to call different and not the same; False on the diagonal."""
    matches: BoolArray
    """(P, P) scan i and submap j that belong together; True on the diagonal."""


@dataclass(frozen=True, eq=False)
class HardPlaces:
    """Places that weights take for each other."""

    town: Int64Array
    """(N,) index of the town."""
    scan: Int64Array
    """(N,) index of the scan in it, which is where the place is."""
    neighbours: Int64Array
    """(N, K) rows of the places with the nearest descriptors, all of them elsewhere."""


class Sampler(Protocol):
    """What draws batches, of whatever material."""

    @property
    def places(self) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Return town (N,), scan (N,) and position (N, 2) in metres, town frame, of all places to learn from."""
        ...

    def submap(self, town: int, scan: int) -> Float32Array | None:
        """Return the patch (n, 3) of the submap around the place of a scan, or None where there is too little."""
        ...

    def batch(self, step: int, *, pairs: int = 0, hard: HardPlaces | None = None) -> Batch:
        """Return the batch of a step, the same at every call with the same arguments.

        `pairs`: how many, by default as configured. With `hard` the share `hard_share` of them comes from groups of
        places that were taken for each other.
        """
        ...


_Pair = tuple[Float32Array, Float32Array, Float64Array, Float64Array]
"""Scan, submap, place and the submap's centre."""


class _Wish(NamedTuple):
    """A place that a pair is wanted of."""

    town: int
    scan: int
    heading_rad: float


class PointField:
    """A town's above-ground points in square cells, for cutting turned squares quickly."""

    def __init__(self, points: Float32Array) -> None:
        low = points[:, :2].min(axis=0)
        columns, rows = np.floor((points[:, :2].max(axis=0) - low) / _CELL_M).astype(np.int64) + 1
        cell = np.floor((points[:, :2] - low) / _CELL_M).astype(np.int64)
        flat = cell[:, 1] * columns + cell[:, 0]
        order = np.argsort(flat, kind="stable")
        self._points = np.ascontiguousarray(points[order])
        self._starts = np.searchsorted(flat[order], np.arange(rows * columns + 1)).astype(np.int64)
        self._low = low.astype(np.float64)
        self._columns, self._rows = int(columns), int(rows)

    def cut(self, centre: Float64Array, heading_rad: float, half_extent_m: float) -> Float32Array:
        """Return the points (n, 3) of the square around `centre` (2,), seen along a heading from its centre."""
        cut: Float32Array = _cut(
            self._points,
            self._starts,
            self._columns,
            self._rows,
            float(centre[0]),
            float(centre[1]),
            float(self._low[0]),
            float(self._low[1]),
            heading_rad,
            half_extent_m,
        )
        return cut


class BatchSampler:
    """Draws batches from towns; several pairs come from each town, so that some negatives are hard."""

    def __init__(self, towns: Sequence[TrainingTown], config: TrainConfig) -> None:
        if not towns or not any(len(town) for town in towns):
            raise TrainingError("there is no scan to learn from: the training places are empty")
        self._towns = [town for town in towns if len(town)]
        self._fields = [PointField(town.survey_points) for town in self._towns]
        self._config = config

    @property
    def places(self) -> tuple[Int64Array, Int64Array, Float64Array]:
        """See `Sampler.places`."""
        counts = [len(town) for town in self._towns]
        towns = np.repeat(np.arange(len(counts), dtype=np.int64), counts)
        scans = np.concatenate([np.arange(count, dtype=np.int64) for count in counts])
        return towns, scans, np.concatenate([town.scan_xy_m for town in self._towns])

    def submap(self, town: int, scan: int) -> Float32Array | None:
        """See `Sampler.submap`; it is centred where the scan was taken."""
        preprocessing = self._config.preprocessing
        points = self._fields[town].cut(self._towns[town].scan_xy_m[scan], 0.0, preprocessing.half_extent_m)
        patch = make_patch(points, preprocessing.half_extent_m, preprocessing)
        return None if patch is None else patch.points

    def batch(self, step: int, *, pairs: int = 0, hard: HardPlaces | None = None) -> Batch:
        """See `Sampler.batch`."""
        config = self._config
        rng = np.random.default_rng((config.seed, step))
        pairs = pairs or config.pairs
        wanted = self._hard_places(rng, round(config.hard_share * pairs), hard) if hard is not None else []
        drawn = min(config.towns_a_batch, len(self._towns), pairs)
        chosen = rng.choice(len(self._towns), drawn, replace=False)
        towns = np.concatenate(
            [chosen[np.sort(np.arange(pairs - len(wanted)) % drawn)], [place.town for place in wanted]]
        ).astype(np.int64)
        scans: list[Float32Array] = []
        submaps: list[Float32Array] = []
        places = np.empty((pairs, 2))
        centres = np.empty((pairs, 2))
        for i, town in enumerate(towns.tolist()):
            wish = wanted[i - pairs] if i >= pairs - len(wanted) else None
            scan, submap, places[i], centres[i] = self._pair(town, rng, places[:i][towns[:i] == town], wish)
            scans.append(scan)
            submaps.append(submap)
        if config.augmentation == "paper":
            scans, submaps = paper_batch((scans, submaps), rng)
        apart = np.hypot(*(places[:, None] - centres[None]).transpose(2, 0, 1))
        same_town = towns[:, None] == towns[None, :]
        matches = same_town & (apart < config.match_m)
        np.fill_diagonal(matches, True)
        return Batch(scans, submaps, same_town & (apart < config.neighbour_m) & ~matches, matches)

    def _hard_places(self, rng: np.random.Generator, count: int, hard: HardPlaces) -> list[_Wish]:
        """Return `count` places in groups of such as are taken for each other; a group is seen along one heading."""
        wanted: list[_Wish] = []
        while len(wanted) < count:
            row = int(rng.integers(len(hard.town)))
            others = rng.permutation(hard.neighbours[row])[: _HARD_GROUP - 1]
            heading = float(rng.uniform(0.0, 2.0 * math.pi))
            wanted += [_Wish(int(hard.town[r]), int(hard.scan[r]), heading) for r in (row, *others)]
        return wanted[:count]

    def _pair(self, town_index: int, rng: np.random.Generator, taken: Float64Array, wish: _Wish | None) -> _Pair:
        """Return a scan, a submap that it lies in, the scan's place and the submap's centre.

        The place is the one wished for, or one not yet among those `taken`, and then with probability `near_share`
        near one of them.
        """
        town, field, config = self._towns[town_index], self._fields[town_index], self._config
        wish_near = len(taken) > 0 and rng.random() < config.near_share
        for attempt in range(_ATTEMPTS):
            wished = wish is not None and attempt == 0
            index = wish.scan if wish is not None and wished else int(rng.integers(len(town)))
            place = town.scan_xy_m[index]
            nearest_m = float(np.hypot(*(taken - place).T).min()) if len(taken) else math.inf
            far_enough = nearest_m >= config.neighbour_m
            near_enough = far_enough and (not wish_near or nearest_m <= config.near_m)
            if not wished and (
                (not near_enough and attempt < _ATTEMPTS // 2) or (not far_enough and attempt < 3 * _ATTEMPTS // 4)
            ):
                continue
            if config.augmentation == "paper":
                pair = self._paper_pair(town, field, index, rng)
            else:
                pair = self._augmented_pair(town, field, index, None if wish is None else wish.heading_rad, rng)
            if pair is not None:
                return pair
        raise TrainingError(
            f"{town.name}: {_ATTEMPTS} scans in a row gave no pair of patches with at least "
            f"{config.preprocessing.min_points} points; lower min_points or make other places"
        )

    def _augmented_pair(
        self, town: TrainingTown, field: PointField, index: int, heading_rad: float | None, rng: np.random.Generator
    ) -> _Pair | None:
        """Return what `_pair` does, by this package's recipe: the submap along `heading_rad`, or any heading."""
        config, preprocessing = self._config, self._config.preprocessing
        place = town.scan_xy_m[index]
        seen = occlude(town.scan_points(index), rng, config)
        scan = make_patch(seen, preprocessing.scan_half_extent_m, preprocessing)
        centre = self._centre(place, rng)
        heading = float(rng.uniform(0.0, 2.0 * math.pi)) if heading_rad is None else heading_rad
        submap_points = field.cut(centre, heading, preprocessing.half_extent_m)
        submap_points = change(submap_points, preprocessing.half_extent_m, rng, config)
        mirrored = bool(rng.integers(2))
        if mirrored:
            submap_points[:, 1] *= -1.0
        submap = make_patch(submap_points, preprocessing.half_extent_m, preprocessing)
        if scan is None or submap is None:
            return None
        angle = float(town.scan_heading_rad[index]) - heading + heading_error(rng, config)
        scan_points = turn(scan.points, angle)
        if mirrored:
            scan_points[:, 1] *= -1.0
        return scan_points, submap.points, place, centre

    def _paper_pair(self, town: TrainingTown, field: PointField, index: int, rng: np.random.Generator) -> _Pair | None:
        """Return what `_pair` does, by the published recipe: the scan along the robot, the submap to the north."""
        preprocessing = self._config.preprocessing
        place = town.scan_xy_m[index]
        centre = self._centre(place, rng)
        points = field.cut(centre, 0.0, preprocessing.half_extent_m)
        scan = make_patch(town.scan_points(index), preprocessing.scan_half_extent_m, preprocessing)
        submap = make_patch(points, preprocessing.half_extent_m, preprocessing)
        if scan is None or submap is None:
            return None
        return paper_cloud(scan.points, rng), paper_cloud(submap.points, rng), place, centre

    def _centre(self, place: Float64Array, rng: np.random.Generator) -> Float64Array:
        """Return the centre (2,) of a submap that a place lies in."""
        return place + rng.uniform(-self._config.offset_m, self._config.offset_m, 2)


@njit(cache=True, nogil=True)
def _cut(
    points: Float32Array,
    starts: Int64Array,
    columns: int,
    rows: int,
    east: float,
    north: float,
    low_east: float,
    low_north: float,
    heading_rad: float,
    half_extent_m: float,
) -> Float32Array:
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    reach = half_extent_m * (abs(cosine) + abs(sine))
    first_column = max(0, int(np.floor((east - reach - low_east) / 10.0)))
    last_column = min(columns - 1, int(np.floor((east + reach - low_east) / 10.0)))
    first_row = max(0, int(np.floor((north - reach - low_north) / 10.0)))
    last_row = min(rows - 1, int(np.floor((north + reach - low_north) / 10.0)))
    most = 0
    for row in range(first_row, last_row + 1):
        if first_column <= last_column:
            most += starts[row * columns + last_column + 1] - starts[row * columns + first_column]
    cut = np.empty((most, 3), np.float32)
    count = 0
    for row in range(first_row, last_row + 1):
        if first_column > last_column:
            break
        for i in range(starts[row * columns + first_column], starts[row * columns + last_column + 1]):
            de = points[i, 0] - east
            dn = points[i, 1] - north
            x = cosine * de + sine * dn
            y = cosine * dn - sine * de
            if abs(x) <= half_extent_m and abs(y) <= half_extent_m:
                cut[count, 0] = x
                cut[count, 1] = y
                cut[count, 2] = points[i, 2]
                count += 1
    return cut[:count].copy()
