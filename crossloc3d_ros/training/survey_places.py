"""Places to learn from in a real survey: a simulated sensor driven through the surface that the survey shows.

Weights trained in simulated towns can so be trained on for the town that they are to be used in, before any robot was
there: all that is needed is the survey of which the map is made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.store import sha256
from crossloc3d_ros.config import PlacesConfig, PreprocessingConfig, to_dict
from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.formats.las import expand_inputs
from crossloc3d_ros.simulation.real_world import LocalSurvey, read_survey, world_from_points
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.stopwatch import Stopwatch
from crossloc3d_ros.training.places import SURFACE_CLEARANCE_M, Made, above_terrain, already_made, training_town
from crossloc3d_ros.training.shards import TRAINING, Manifest, TownEntry, write_manifest, write_town
from crossloc3d_ros.types import Float64Array, Int64Array

FAMILY = "survey"
"""What the manifest calls a part of a real survey."""
_PART_M = 200.0
_LEAST_SCANS = 8


def make_survey_places(
    output: Path,
    surveys: Sequence[str | Path],
    *,
    scans: int,
    seed: int,
    config: PlacesConfig,
    preprocessing: PreprocessingConfig,
    crs: str | None = None,
    report: Callable[[Made], None] = lambda made: None,
) -> Manifest:
    """Scan `scans` places of a survey (files, folders or globs) and return the manifest of what lies in `output`.

    The survey is cut into parts of 200 m, each a town to the sampler. `crs` is for files that name none. A folder that
    holds places of other settings raises TrainingError, a survey without free ground to drive on AerialDataError.
    """
    files = expand_inputs(surveys)
    settings = {
        "seed": seed, "scans": scans, "surveys": {file.name: sha256(file) for file in files}, "places": to_dict(config),
        "preprocessing": to_dict(preprocessing),
    }  # fmt: skip
    made = already_made(output, settings)
    if made:
        return Manifest(settings, tuple(made.values()))
    survey = read_survey(files, crs=crs)
    world = world_from_points(
        survey.points, survey.classes, survey.bounds, name=survey.name, crs=survey.crs,
        origin_grid=survey.origin_grid, seed=seed,
    )  # fmt: skip
    above_ground = above_terrain(survey.points, survey.classes, survey.bounds, config.cell_m)
    rng = np.random.default_rng(seed)
    poses = _sample_poses(world, survey, scans, config, preprocessing, rng)
    parts = [rows for rows in _parts(poses[:, :2, 3], survey) if len(rows) >= _LEAST_SCANS]
    if not parts:
        raise AerialDataError(f"{survey.name}: {scans} scans are too few for its area; request more")
    stopwatch = Stopwatch()
    for number, rows in enumerate(parts):
        file = f"{TRAINING}_{seed}_{number:04d}_{FAMILY}.npz"
        near = _near(above_ground, poses[rows, :2, 3], 1.5 * preprocessing.half_extent_m)
        town = training_town(file, poses[rows], [world] * len(rows), near, config, preprocessing, rng)
        write_town(output / file, town)
        seconds = round(stopwatch.lap(), 2)
        made[file] = TownEntry(file, TRAINING, FAMILY, seed, len(town), 0, seconds)
        report(Made(len(made), len(parts), made[file], seconds * (len(parts) - number - 1)))
    # The manifest last: a folder without one is begun anew.
    manifest = Manifest(settings, tuple(made.values()))
    write_manifest(output, manifest)
    return manifest


def _sample_poses(
    world: World, survey: LocalSurvey, scans: int, config: PlacesConfig, preprocessing: PreprocessingConfig,
    rng: np.random.Generator,
) -> Float64Array:  # fmt: skip
    border_m = preprocessing.half_extent_m + 10.0
    try:
        return world.sample_poses(
            scans, rng, clearance_m=SURFACE_CLEARANCE_M, border_m=border_m, tilt_deg=config.tilt_deg
        )
    except ValueError as error:
        raise AerialDataError(
            f"{survey.name}: no ground to drive on {border_m:.0f} m inside of the survey; name neighbouring files too"
        ) from error


def _parts(xy_m: Float64Array, survey: LocalSurvey) -> list[Int64Array]:
    """Return the rows of the places (S, 2) in each square of the survey."""
    column, row = np.floor((xy_m - np.asarray(survey.bounds)[:2]) / _PART_M).astype(np.int64).T
    squares = row * 100_000 + column
    return [np.flatnonzero(squares == square) for square in np.unique(squares)]


def _near(points: Float64Array, places: Float64Array, margin_m: float) -> Float64Array:
    low, high = places.min(axis=0) - margin_m, places.max(axis=0) + margin_m
    near: Float64Array = points[np.all((points[:, :2] >= low) & (points[:, :2] <= high), axis=1)]
    return near
