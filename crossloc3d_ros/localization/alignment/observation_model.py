"""How likely a beam hits something in a cell, given what an airborne survey shows there.

Airborne surveys see roofs and crowns, robots walls, trunks and hedges; what they have in common is learned. Each cell
of the aerial map has a class: how high its surface lies above the terrain, how low and how high the surface around it
gets, and how far it is to the next pulse that reached the ground, as pulses do between leaves and beside a wall but in
no house. For each class and each layer of height, scans of known pose give the probability p that a beam which enters
a cell hits something there. With q the same over all cells, the log likelihood ratio between "the scan was taken here"
and "somewhere" is log(p / q) for a hit and log((1 - p) / (1 - q)) for free space.

Inside of a house both are equally rare, since the beams that would enter it end at its walls. So cells without a pulse
to the ground beside them also count by how often beams enter them at all, at true poses and at others: log(v / w), with
v and w the shares of the class among all cells seen. This refutes poses whose beams would pass through houses.
"""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from scipy import ndimage

from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int32Array

SHIPPED = Path(__file__).resolve().parents[2] / "weights" / "alignment.safetensors"
HEIGHTS_M = np.array([0.4, 1.2, 2.5, 5.0, 10.0])
"""Heights above the terrain between which the classes change."""
_STEPS = len(HEIGHTS_M) + 1
_CLOSEDNESS = 4  # steps: pulses reach the ground in the cell, beside it, one cell farther, or nowhere near
_GROUND_M = 1.0  # an echo so low above the terrain came from the ground
_HOLE_M = 20  # half the width of the widest hole in a survey that is taken for water
HOLE = _CLOSEDNESS * _STEPS**3
"""Class of a cell without an echo in the midst of those that have one: mostly water, which mirrors pulses away."""
UNKNOWN = HOLE + 1
"""Class of a cell that was not surveyed."""
CLASSES = UNKNOWN + 1
OPEN_GROUND = 0
"""Class of a cell where all is low and pulses reach the ground."""
MARGIN_CELLS = 2 * _HOLE_M + 4
"""So far beyond its edges a raster must be known for the classes inside to be right."""
_PRIOR = 50.0  # pseudo-observations that a class starts with
_MAX_LOG_RATIO = 3.0  # of one cell; the 16 bit sums of the search rely on it
_MAX_REFUTATION = 1.0  # of a closed cell: a house may have gone since the survey, and hundreds of its cells with it
_CLOSED = 2  # from this step on a cell is inside of something


@dataclass(frozen=True, eq=False)
class ObservationModel:
    """The log likelihood ratios, and what sums of them mean."""

    log_ratios: Float32Array
    """(CHANNELS, CLASSES)"""
    search_ratios: Float32Array
    """(CHANNELS, CLASSES) the same without refutation, which in coarse cells would hold for the right pose too: for the
    coarse search."""
    expected: Float64Array
    """(CHANNELS,) mean log ratio of a cell of each channel at the true pose."""
    expected_share: float = 0.5
    """At this share of the score expected at the true pose, 'here' is as likely as 'off the map'."""
    temperature: float = 10.0
    """Score that multiplies the odds by e; scores are sums over cells that are not independent."""

    def log_likelihood(self, scores: Float64Array, counts: np.ndarray) -> Float64Array:
        """Return log likelihood ratios (n,) of scores (n,) of a scan with `counts` (CHANNELS,) cells a channel."""
        expected = float(self.expected @ counts)
        return np.asarray((scores - self.expected_share * expected) / self.temperature)

    def save(self, path: Path) -> None:
        """Write the model to a file."""
        tensors = {name: getattr(self, name) for name in ("log_ratios", "search_ratios", "expected")}
        settings = {"expected_share": self.expected_share, "temperature": self.temperature}
        save_file(tensors, path, metadata={"calibration": json.dumps(settings)})
        path.chmod(0o644)  # safetensors keeps it from everybody else, also from the robot's user

    @classmethod
    def load(cls, path: Path | None = None) -> ObservationModel:
        """Read a model, the shipped one by default; CrossLocError where the file is none."""
        return _load(path or SHIPPED)


@functools.cache
def _load(path: Path) -> ObservationModel:
    try:
        with safe_open(path, framework="numpy") as file:
            ratios, gentle = file.get_tensor("log_ratios"), file.get_tensor("search_ratios")
            expected = file.get_tensor("expected")
            settings = json.loads(file.metadata()["calibration"])
        if ratios.shape != (CHANNELS, CLASSES) or gentle.shape != ratios.shape or expected.shape != (CHANNELS,):
            raise ValueError(f"log ratios of shape {ratios.shape}")
        if not (np.abs([ratios, gentle]) <= _MAX_LOG_RATIO).all() or not np.isfinite(expected).all():
            raise ValueError(f"log ratios that are not finite, or beyond {_MAX_LOG_RATIO:g}")
        if not (float(settings["temperature"]) > 0.0 and math.isfinite(float(settings["expected_share"]))):
            raise ValueError(f"calibration {settings}")
        return ObservationModel(
            ratios, gentle, expected, float(settings["expected_share"]), float(settings["temperature"])
        )
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise CrossLocError(f"{path} is not an observation model of this version: {error}") from error


def surface_classes(terrain: Float32Array, surface: Float32Array, lowest: Float32Array) -> Int32Array:
    """Return the class (H, W) of each cell of 1 m from terrain, surface and lowest echoes (H, W).

    All in metres, NaN where unknown. A gap inside of the survey is as high as the mean of its eight neighbours with an
    echo: sparse surveys have many.
    """
    above = surface - terrain
    known = np.isfinite(above)
    if not known.any():
        return np.full(above.shape, UNKNOWN, np.int32)
    if not known.all():
        holes = _holes(known)
        weight = ndimage.uniform_filter(known.astype(np.float32), 3, mode="constant")
        total = ndimage.uniform_filter(np.where(known, above, 0.0), 3, mode="constant")
        filled = holes & (weight > 0.05)  # a ninth for each
        above = np.where(known, above, np.where(filled, total / np.where(filled, weight, 1.0), np.nan))
        known = np.isfinite(above)
        unseen = np.where(holes, HOLE, UNKNOWN)
    held = np.where(known, above, 0.0)
    most = ndimage.maximum_filter(np.where(known, above, -np.inf), 3)
    least = ndimage.minimum_filter(np.where(known, above, np.inf), 3)
    with np.errstate(invalid="ignore"):
        reached = lowest - terrain < _GROUND_M
    near, around = ndimage.maximum_filter(reached, 3), ndimage.maximum_filter(reached, 5)
    closed = 3 - reached.astype(np.int64) - near - around
    steps = [np.digitize(values, HEIGHTS_M) for values in (held, least, most)]
    classes = ((steps[0] * _STEPS + steps[1]) * _STEPS + steps[2]) * _CLOSEDNESS + closed
    return (classes if known.all() else np.where(known, classes, unseen)).astype(np.int32)


def _holes(known: BoolArray) -> BoolArray:
    """Mark the cells that a disc of `_HOLE_M` closes between known ones; beyond the array nothing is known."""
    padded = np.pad(known, _HOLE_M + 1)
    closed = ndimage.distance_transform_edt(~padded) <= _HOLE_M
    closed = ndimage.distance_transform_edt(closed) > _HOLE_M
    inner = slice(_HOLE_M + 1, -_HOLE_M - 1)
    return np.asarray(closed[inner, inner] & ~known)


def fit_log_ratios(here: Float64Array, elsewhere: Float64Array) -> tuple[Float32Array, Float32Array, Float64Array]:
    """Return log ratios and search ratios (CHANNELS, CLASSES), and what to expect at true poses (CHANNELS,).

    `here` and `elsewhere` (CHANNELS, CLASSES) count the cells of each channel that fell on each class at true poses,
    and at others. A layer in which all cells were hit, or none, counts only by where beams came; a class that was
    hardly ever seen counts little.
    """
    hits, free = here[:LAYERS], here[LAYERS:]
    seen, others = hits + free, elsewhere[:LAYERS] + elsewhere[LAYERS:]
    share = hits.sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1, keepdims=True), 1e-9)
    p = (hits + _PRIOR * share) / (seen + _PRIOR)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.concatenate([np.log(p / share), np.log((1.0 - p) / (1.0 - share))])
    ratios[np.tile((share <= 0.0) | (share >= 1.0), (2, 1))[:, 0]] = 0.0
    v, w = (values / np.maximum(values.sum(axis=1, keepdims=True), 1.0) for values in (seen, others))
    prior = _PRIOR / np.maximum(seen.sum(axis=1, keepdims=True), _PRIOR)
    closed = np.zeros(CLASSES, np.bool_)
    closed[:HOLE] = np.arange(HOLE) % _CLOSEDNESS >= _CLOSED
    refuting = np.where(closed, np.clip(np.log((v + prior) / (w + prior)), -_MAX_REFUTATION, 0.0), 0.0)
    full = ratios + np.tile(refuting, (2, 1))
    for values in (ratios, full):
        values[:, UNKNOWN] = 0.0
        np.clip(values, -_MAX_LOG_RATIO, _MAX_LOG_RATIO, out=values)
    expected = (here * full).sum(axis=1) / np.maximum(here.sum(axis=1), 1.0)
    return full.astype(np.float32), ratios.astype(np.float32), expected
