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
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file
from scipy import ndimage
from scipy.special import expit, logit

from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.localization.alignment.evidence import CHANNELS, LAYERS
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array

SHIPPED = Path(__file__).resolve().parents[2] / "weights" / "alignment.safetensors"
HEIGHTS_M = np.array([0.4, 1.2, 2.5, 5.0, 10.0])
"""Heights above the terrain between which the classes change."""
_STEPS = len(HEIGHTS_M) + 1
_CLOSEDNESS = 4  # steps: pulses reach the ground in the cell, beside it, one cell farther, or nowhere near
SUPPORT_BOUNDS = np.array([0.7, 0.95])
"""Shares of cells with an echo, around a cell, between which the classes change: at some 1.2 and 3 echoes a square
metre. How low, how high and how closed a place appears depends on how many echoes there are to show it."""
_SUPPORTS = len(SUPPORT_BOUNDS) + 1
_SUPPORT_CELLS = 11  # side of the square that the share is taken of: a hundred cells, within one flight strip
_GAP_CELLS = 5  # side of the widest gap that sparse echoes leave: at 0.3 a square metre one in two thousand is wider
_GROUND_M = 1.0  # an echo so low above the terrain came from the ground
_HOLE_M = 20  # half the width of the widest hole in a survey that is taken for water
PATTERNS = _CLOSEDNESS * _STEPS**3
"""Classes of one level of support."""
HOLE = _SUPPORTS * PATTERNS
"""Class of a cell without an echo in the midst of those that have one: mostly water, which mirrors pulses away."""
UNKNOWN = HOLE + 1
"""Class of a cell that was not surveyed."""
CLASSES = UNKNOWN + 1
OPEN_GROUND = 0
"""Pattern of a cell where all is low and pulses reach the ground."""
MARGIN_CELLS = 2 * _HOLE_M + 4
"""So far beyond its edges a raster must be known for the classes inside to be right."""
_SHARE_BOUNDS = (1e-6, 1.0 - 1e-6)  # for their logarithms
_PRIOR = 50.0  # pseudo-observations that a class starts with
_MAX_LOG_RATIO = 3.0  # of one cell; the 16 bit sums of the search rely on it
_MAX_REFUTATION = 1.0  # of a closed cell: a house may have gone since the survey, and hundreds of its cells with it
MEASURES = ("explained", "above shifted", "above spun", "amount", "behind best")
"""What a pose is weighed by, see `alignment.local_null`: the share of the evidence that it explains, the logarithms of
by how many standard deviations its sectors stand out of its surroundings, how much evidence there is, and by how much
another pose explains it better."""
_TENSORS = ("log_ratios", "search_ratios", "hit_share", "weights")
_CLOSED = 2  # from this step on a cell is inside of something


@dataclass(frozen=True, eq=False)
class ObservationModel:
    """The log likelihood ratios, and what sums of them mean."""

    log_ratios: Float32Array
    """(CHANNELS, CLASSES)"""
    search_ratios: Float32Array
    """(CHANNELS, CLASSES) the same without refutation, which in coarse cells would hold for the right pose too: for the
    coarse search."""
    hit_share: Float64Array
    """(LAYERS,) share q of the cells of each layer, hit or free, that are hit."""
    weights: Float64Array
    """(M + 1,) of each of the `MEASURES`, and a constant: their sum is the log likelihood ratio of a pose."""

    def log_likelihood(self, measures: Float64Array) -> Float64Array:
        """Return log likelihood ratios (p,) of 'the scan was taken here' to 'elsewhere' from `MEASURES` (p, M)."""
        return np.asarray(measures @ self.weights[:-1] + self.weights[-1])

    @functools.cached_property
    def expectations(self) -> tuple[Float32Array, Float32Array]:
        """Mean log ratio of a cell of each layer and class (LAYERS, CLASSES): at true poses, and of other scans."""
        hit, free = (part.astype(np.float64) for part in (self.log_ratios[:LAYERS], self.log_ratios[LAYERS:]))
        q = self.hit_share[:, None]
        p = expit(logit(q) + hit - free)
        return (p * hit + (1.0 - p) * free).astype(np.float32), (q * hit + (1.0 - q) * free).astype(np.float32)

    @functools.cached_property
    def fingerprint(self) -> str:
        """Identify the model: 16 hexadecimal digits that change with any of its numbers."""
        digest = hashlib.sha256()
        for name in _TENSORS:
            digest.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        return digest.hexdigest()[:16]

    def save(self, path: Path) -> None:
        """Write the model to a file."""
        save_file({name: getattr(self, name) for name in _TENSORS}, path, metadata={"measures": json.dumps(MEASURES)})
        path.chmod(0o644)  # safetensors keeps it from everybody else, also from the robot's user

    @classmethod
    def load(cls, path: Path | None = None) -> ObservationModel:
        """Read a model, the shipped one by default; CrossLocError where the file is none."""
        return _load(path or SHIPPED)


@functools.cache
def _load(path: Path) -> ObservationModel:
    try:
        with safe_open(path, framework="numpy") as file:
            ratios, gentle, share, weights = (file.get_tensor(name) for name in _TENSORS)
            measured = tuple(json.loads(file.metadata()["measures"]))
        if ratios.shape != (CHANNELS, CLASSES) or gentle.shape != ratios.shape or share.shape != (LAYERS,):
            raise ValueError(f"log ratios of shape {ratios.shape}")
        if not (np.abs([ratios, gentle]) <= _MAX_LOG_RATIO).all():
            raise ValueError(f"log ratios that are not finite, or beyond {_MAX_LOG_RATIO:g}")
        if measured != MEASURES or weights.shape != (len(MEASURES) + 1,) or not np.isfinite(weights).all():
            raise ValueError(f"weights of the measures {', '.join(map(str, measured))}")
        if not ((share > 0.0) & (share < 1.0)).all():
            raise ValueError(f"shares of hits {share}")
        return ObservationModel(ratios, gentle, share, weights)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise CrossLocError(f"{path} is not an observation model of this version: {error}") from error


def surface_classes(terrain: Float32Array, surface: Float32Array, lowest: Float32Array) -> Int32Array:
    """Return the class (H, W) of each cell of 1 m from terrain, surface and lowest echoes (H, W).

    All in metres, NaN where unknown. A gap inside of the survey is as high as the mean of its eight neighbours with an
    echo; where echoes are sparse, narrow gaps are filled from as far as three cells away. What is left is a hole.
    """
    above = surface - terrain
    known = np.isfinite(above)
    if not known.any():
        return np.full(above.shape, UNKNOWN, np.int32)
    support = np.full(above.shape, _SUPPORTS - 1)
    if not known.all():
        holes, covered = _holes(known), _covered(known)
        support = _support_levels(known, covered)
        above = _filled(above, holes, covered, support)
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
    patterns = ((steps[0] * _STEPS + steps[1]) * _STEPS + steps[2]) * _CLOSEDNESS + closed
    classes = (_SUPPORTS - 1 - support) * PATTERNS + patterns
    return (classes if known.all() else np.where(known, classes, unseen)).astype(np.int32)


def _covered(known: BoolArray) -> BoolArray:
    """Mark the cells with an echo, and gaps between them that are narrower than `_GAP_CELLS`: not the wider water."""
    square = np.ones((_GAP_CELLS, _GAP_CELLS), np.bool_)
    return np.asarray(ndimage.binary_erosion(ndimage.binary_dilation(known, square), square, border_value=1))


def _support_levels(known: BoolArray, covered: BoolArray) -> Int64Array:
    """Return the level (H, W) of the share of cells with an echo around each cell, among those that are covered."""
    area = ndimage.uniform_filter(covered.astype(np.float32), _SUPPORT_CELLS, mode="constant")
    share = ndimage.uniform_filter(known.astype(np.float32), _SUPPORT_CELLS, mode="constant")
    return np.asarray(np.digitize(share / np.maximum(area, 1e-6) + 1e-6, SUPPORT_BOUNDS), np.int64)


def _filled(above: Float32Array, holes: BoolArray, covered: BoolArray, support: Int64Array) -> Float32Array:
    """Return heights (H, W) with gaps of the survey filled by the mean of their neighbours.

    Beside an echo always; where echoes are sparse, covered cells from two or three cells away too.
    """
    for level in range(_SUPPORTS - 1, -1, -1):
        known = np.isfinite(above)
        weight = ndimage.uniform_filter(known.astype(np.float32), 3, mode="constant")
        total = ndimage.uniform_filter(np.where(known, above, 0.0), 3, mode="constant")
        gaps = holes if level == _SUPPORTS - 1 else covered & (support <= level)
        filled = ~known & gaps & (weight > 0.05)  # a ninth for each
        above = np.where(known, above, np.where(filled, total / np.where(filled, weight, 1.0), np.nan))
    return above


def _holes(known: BoolArray) -> BoolArray:
    """Mark the cells that a disc of `_HOLE_M` closes between known ones; beyond the array nothing is known."""
    padded = np.pad(known, _HOLE_M + 1)
    closed = ndimage.distance_transform_edt(~padded) <= _HOLE_M
    closed = ndimage.distance_transform_edt(closed) > _HOLE_M
    inner = slice(_HOLE_M + 1, -_HOLE_M - 1)
    return np.asarray(closed[inner, inner] & ~known)


def fit_log_ratios(here: Float64Array, elsewhere: Float64Array) -> tuple[Float32Array, Float32Array, Float64Array]:
    """Return log ratios and search ratios (CHANNELS, CLASSES), and the share of hits of each layer (LAYERS,).

    `here` and `elsewhere` (CHANNELS, CLASSES) count the cells of each channel that fell on each class at true poses,
    and at others. A layer in which all cells were hit, or none, counts only by where beams came; a class that was
    hardly ever seen counts as its pattern does at all levels of support, and little where that is rare too.
    """
    hits, free = here[:LAYERS], here[LAYERS:]
    seen, others = hits + free, elsewhere[:LAYERS] + elsewhere[LAYERS:]
    share = hits.sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1, keepdims=True), 1e-9)
    pooled = [_over_supports(counts) for counts in (hits, seen)]
    usual = (pooled[0] + _PRIOR * share) / (pooled[1] + _PRIOR)
    p = (hits + _PRIOR * usual) / (seen + _PRIOR)
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
    return full.astype(np.float32), ratios.astype(np.float32), np.clip(share[:, 0], *_SHARE_BOUNDS)


def _over_supports(counts: Float64Array) -> Float64Array:
    """Return counts (L, CLASSES) in which each pattern has the sum over all levels of support."""
    pooled = counts.copy()
    by_support = counts[:, :HOLE].reshape(len(counts), _SUPPORTS, PATTERNS)
    pooled[:, :HOLE] = np.tile(by_support.sum(axis=1), (1, _SUPPORTS))
    return pooled
