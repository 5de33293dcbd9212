"""Parts of a survey that have the same points on every machine: a thinner one, or two halves without a point in common.

Each point is given a number between 0 and 1 by a hash of its coordinates; a part holds those of one range of numbers.
A survey thinned to 0.5 points/m2 is so a part of the same survey thinned to 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.survey import read_survey
from crossloc3d_ros.clouds.survey_ground import classify_ground
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.formats.las import GROUND, HIGH_NOISE, LOW_NOISE, LazWriter, iter_chunks
from crossloc3d_ros.geodesy import Projection, parse_crs
from crossloc3d_ros.types import Float64Array

_MILLIMETRE, _DEGREE_STEP = 0.001, 1e-8
"""Steps of the coordinates written: finer than those of the surveys, so that none is moved."""
_CELL_M = 5.0
"""Cells in which the area that a survey covers is counted: a gap of a roof's shadow is none, a missing tile is one."""
_MULTIPLIERS = np.array([0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB], np.uint64)
"""Odd, of irregular bits: those of the generator splitmix64 (Steele et al. 2014)."""


def numbers_of(points: Float64Array) -> Float64Array:
    """Return a number (N,) from 0 to less than 1 for each point (N, 3), uniform, the same for equal coordinates."""
    # In millionths of a unit: enough for degrees, and the same whatever the last bit of a coordinate is.
    steps = np.rint(np.asarray(points, np.float64) * 1e6).astype(np.int64).view(np.uint64)
    mixed = np.zeros(len(points), np.uint64)
    for column in range(3):
        mixed = (mixed ^ steps[:, column]) * _MULTIPLIERS[0]
        mixed = (mixed ^ (mixed >> np.uint64(30))) * _MULTIPLIERS[1]
        mixed = (mixed ^ (mixed >> np.uint64(27))) * _MULTIPLIERS[2]
        mixed ^= mixed >> np.uint64(31)
    return np.asarray((mixed >> np.uint64(11)).astype(np.float64) / 2.0**53)


def write_part(inputs: Sequence[Path], target: Path, low: float, high: float) -> int:
    """Write the points whose number is at least `low` and less than `high` to one LAZ file, and count them.

    Raises AerialDataError where a file cannot be read, EvaluationError where no point is left.
    """
    survey = read_survey(inputs)
    kept = 0
    with LazWriter(target, survey.crs, scale=_step(survey.crs), offset=np.floor(survey.minimum)) as writer:
        for header in survey.headers:
            for chunk in iter_chunks(header.path):
                numbers = numbers_of(chunk.points)
                chosen = (numbers >= low) & (numbers < high)
                writer.write(chunk.points[chosen], chunk.classification[chosen])
                kept += int(chosen.sum())
        if kept == 0:
            raise EvaluationError(f"none of the {survey.points:,} points of {inputs[0]} is left: ask for more of them")
    return kept


def classify_part(path: Path) -> None:
    """Give a LAZ file's ground points their class, by the filter of the map builder, where none has it.

    Nothing is done to a file that holds points of class 2. Noise is no ground; what is none keeps its class. Raises
    AerialDataError where the file cannot be read.
    """
    survey = read_survey([path])
    chunks = list(iter_chunks(path))
    points = np.concatenate([chunk.points for chunk in chunks])
    classes = np.concatenate([chunk.classification for chunk in chunks])
    if (classes == GROUND).any():
        return
    grid = Projection(survey.crs, survey.map_crs, survey.vertical_metres_per_unit)(points)
    grid[np.isin(classes, (LOW_NOISE, HIGH_NOISE))] = np.nan
    classes[classify_ground(grid)] = GROUND
    with LazWriter(path, survey.crs, scale=_step(survey.crs), offset=np.floor(survey.minimum)) as writer:
        writer.write(points, classes)


def _step(crs: str) -> float:
    return _DEGREE_STEP if parse_crs(crs).is_geographic else _MILLIMETRE


def density_per_m2(inputs: Sequence[Path]) -> float:
    """Return how many points a survey has on each square metre that it covers."""
    survey = read_survey(inputs)
    cells: list[np.ndarray[tuple[int, int], np.dtype[np.int64]]] = []
    points = 0
    for header in survey.headers:
        to_grid = Projection(header.crs, survey.map_crs, header.vertical_metres_per_unit)
        for chunk in iter_chunks(header.path):
            grid = to_grid(chunk.points)
            grid = grid[np.isfinite(grid).all(axis=1)]
            points += len(grid)
            cells.append(np.unique(np.floor(grid[:, :2] / _CELL_M).astype(np.int64), axis=0))
    covered = len(np.unique(np.concatenate(cells), axis=0)) * _CELL_M**2
    return points / covered
