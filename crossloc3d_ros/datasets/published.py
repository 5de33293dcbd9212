"""Published datasets, and those of `make_dataset`, as patches and as evaluation sets.

Clouds of CS-Campus3D are brought to metres (an aerial unit is 100 m, a ground unit 20 m), put on the ground by their
lowest points where the weights want heights, and go through the same normalisation as every other cloud. Where the
weights want the published units themselves, as the release's do, they come out as they are.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from crossloc3d_ros.clouds.patch import crop_above_ground, patch_of_cropped
from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet, as_patches
from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.formats.cs_campus3d import (
    CLOUD_POINTS,
    CloudTable,
    EvaluationTuples,
    Preset,
    preset_of,
    read_cloud,
    read_evaluation,
    read_info,
)
from crossloc3d_ros.types import Float32Array, Float64Array

log = logging.getLogger(__name__)

_LOWEST = 1.0
"""Per cent of a cloud's points that lie on or below what is taken for the ground."""


@dataclass(frozen=True)
class PatchSource:
    """Makes patches for a preprocessing out of a dataset's clouds."""

    folder: Path
    preset: Preset
    preprocessing: PreprocessingConfig
    points: int = CLOUD_POINTS
    aerial_m: float | None = None
    """Metres of one unit of an aerial cloud; None: as it is."""
    ground_m: float | None = None
    above_ground: bool = field(default=False)
    """Whether z is the height above the ground already."""

    def patch(self, file: str, *, is_ground: bool) -> Float32Array | None:
        """Return the patch (n, 3) of one cloud; None where too few points stand above the ground.

        Raises DatasetError where the cloud is missing or damaged.
        """
        cloud = read_cloud(self.folder, file, self.points)
        unit_m = self.ground_m if is_ground else self.aerial_m
        config = self.preprocessing
        half_extent_m = config.scan_half_extent_m if is_ground else config.half_extent_m
        same_height = self.above_ground == (config.vertical_origin == "ground")
        if unit_m is None or (unit_m == half_extent_m and same_height and self.points == config.n_points):
            return cloud.astype(np.float32)
        return self._normalised(cloud * unit_m, half_extent_m, is_ground)

    def _normalised(self, metres: Float64Array, half_extent_m: float, is_ground: bool) -> Float32Array | None:
        config = self.preprocessing
        if not self.above_ground:
            # What was published has lost the ground; its lowest points stand just above it.
            metres[:, 2] += config.ground_clearance_m - np.percentile(metres[:, 2], _LOWEST)
            metres[:, 2] = np.maximum(metres[:, 2], config.ground_clearance_m)
        cropped = crop_above_ground(metres.astype(np.float32), half_extent_m, config)
        if is_ground:
            patch = patch_of_cropped(
                cropped, half_extent_m, config, origin="mean" if config.scan_origin == "mean" else "given"
            )
        else:
            origin = config.submap_origin == "bounding_box"
            patch = patch_of_cropped(cropped, half_extent_m, config, origin="bounding_box" if origin else "given")
        return None if patch is None else patch.points


def open_source(folder: Path, preset: Preset, preprocessing: PreprocessingConfig) -> PatchSource:
    """Return what makes patches of a dataset's clouds; DatasetError where `dataset.json` is needed and missing."""
    if preset.name != "plain":
        return PatchSource(folder, preset, preprocessing, CLOUD_POINTS, preset.aerial_m, preset.ground_m)
    info = read_info(folder)
    above_ground = info.get("preprocessing", {}).get("vertical_origin", "ground") == "ground"
    return PatchSource(
        folder, preset, preprocessing, int(info["points"]), float(info["half_extent_m"]),
        float(info["scan_half_extent_m"]), above_ground,
    )  # fmt: skip


def load_evaluation_set(
    folder: Path,
    preprocessing: PreprocessingConfig,
    preset: str | None = None,
    *,
    validation: bool = False,
    database_run: int = 0,
) -> EvaluationSet:
    """Return a dataset's test queries and databases as patches for `preprocessing`.

    `preset`: `campus`, `oxford`, `plain`, or the one that fits the folder. The aerial database holds the aerial clouds
    of all database subsets, the ground database the scans in them that are no queries themselves. Oxford RobotCar has
    no aerial clouds: its run `database_run` is the database (in the role `aerial`), and the queries are those of the
    other runs. Raises DatasetError where the dataset is missing, damaged or has no queries.
    """
    kind = preset_of(folder, preset)
    source = open_source(folder, kind, preprocessing)
    tuples = read_evaluation(folder, kind, validation=validation)
    if kind.name == "oxford":
        queries, database, ground = _of_one_run(folder, tuples, database_run)
    else:
        queries = _joined([subset.clouds for subset in tuples.queries])
        listed = _joined(tuples.database)
        queried = set(queries.files)
        own = np.array([file in queried for file in listed.files], np.bool_)
        database, ground = listed.rows(~listed.is_ground), listed.rows(listed.is_ground & ~own)
    for name, clouds in (("queries", queries), ("database clouds", database)):
        if len(clouds) == 0:
            raise DatasetError(f"{folder} has no {name} to {'validate on' if validation else 'test on'}")
        if np.isnan(clouds.xy_m).any():
            raise DatasetError(f"{folder} does not say where {int(np.isnan(clouds.xy_m[:, 0]).sum()):,} {name} lie")
    ground_places = place_set(source, ground) if len(ground) else None
    return EvaluationSet(
        name=f"{folder.name}{' (validation)' if validation else ''}",
        queries=place_set(source, queries),
        aerial=place_set(source, database),
        ground=ground_places if ground_places is not None and len(ground_places) else None,
        area_names=(folder.name,),
        families=("published" if kind.name != "plain" else "recorded",),
    )


def place_set(source: PatchSource, clouds: CloudTable) -> PlaceSet:
    """Return the patches of clouds and where they were taken; clouds with too few points are left out and logged."""
    patches: list[Float32Array] = []
    kept: list[int] = []
    for row, file in enumerate(clouds.files):
        patch = source.patch(file, is_ground=bool(clouds.is_ground[row]))
        if patch is not None:
            patches.append(patch)
            kept.append(row)
    if len(kept) < len(clouds):
        log.warning("%d of %d clouds have too few points and are left out", len(clouds) - len(kept), len(clouds))
    rows = np.array(kept, np.int64)
    return PlaceSet(as_patches(patches), np.zeros(len(rows), np.int64), clouds.xy_m[rows], clouds.heading_rad[rows])


def _of_one_run(folder: Path, tuples: EvaluationTuples, run: int) -> tuple[CloudTable, CloudTable, CloudTable]:
    if not 0 <= run < len(tuples.database):
        raise DatasetError(f"{folder} has no run {run}: its runs are 0 to {len(tuples.database) - 1}")
    others = [subset.clouds for number, subset in enumerate(tuples.queries) if number != run]
    queries, database = _joined(others), tuples.database[run]
    return queries, database, database.rows(np.zeros(len(database), np.bool_))


def _joined(tables: Sequence[CloudTable]) -> CloudTable:
    """Return the clouds of all tables, each once."""
    files = [file for table in tables for file in table.files]
    first: dict[str, int] = {}
    for row, file in enumerate(files):
        first.setdefault(file, row)
    empty = CloudTable((), np.empty((0, 2)), np.empty(0), np.zeros(0, np.bool_))
    parts = [empty, *tables]
    whole = CloudTable(
        tuple(files),
        np.concatenate([table.xy_m for table in parts]),
        np.concatenate([table.heading_rad for table in parts]),
        np.concatenate([table.is_ground for table in parts]),
    )
    return whole.rows(np.array(sorted(first.values()), np.int64))
