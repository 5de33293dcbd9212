"""What the score of a pose is worth: against the null hypothesis that the scan was taken elsewhere.

The sum of log likelihood ratios alone misleads: its cells are not independent, and its level depends on place and
survey. Crowns with ground beneath them explain any scan; a sparse or unclassified survey lowers the score of the right
pose below that of many wrong ones. So a score is compared with what the same scan would get here if it came from
elsewhere:

* **Expectation.** With p the rate at which beams hit something in cells of a class, and q the rate over all cells, the
  score to be expected of a robot that is here is the sum of p log(p / q) + (1 - p) log((1 - p) / (1 - q)) over the
  cells, and of a scan from elsewhere the same sum with q as the weight in place of p. The share of the way from the
  latter to the former that the score makes is the share of the evidence that the pose explains.
* **Surroundings.** The same evidence at shifts around the pose, in its heading, and turned in place. The evidence of
  each sector around the robot is a witness of its own: by how many standard deviations of the surroundings its score
  lies above their mean. At the right pose all sectors fit, at a wrong one a few; so the mean over the sectors counts.
* **Amount.** Few cells fit somewhere by chance: the logarithm of their number, as far as it is small.
* **Behind the best.** How much more another pose of the same scan explains. Along a canal hardly any pose stands out of
  its surroundings, but the right one scores best all the same.

`ObservationModel.log_likelihood` weighs these measures as `train alignment` learned it over surveys of all kinds.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from crossloc3d_ros.localization.alignment.evidence import CELL_M, LAYERS, Evidence
from crossloc3d_ros.localization.alignment.likelihood import MapLikelihood, UInt16Array
from crossloc3d_ros.localization.alignment.observation_model import MEASURES
from crossloc3d_ros.localization.alignment.pose_search import in_parts
from crossloc3d_ros.localization.alignment.surroundings import SHIFTED, SPUN
from crossloc3d_ros.localization.alignment.thread_pool import SERIAL, ThreadPool
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

SECTORS = 12
"""Of 30 degrees: a house beside a street fills one or two."""
EXPLAINED_BOUNDS = (-1.0, 1.2)
"""A score beyond what is to be expected here is no more evidence: crowns explain twice of it from anywhere."""
_LEAST_DEVIATION = 1.0  # nats: of surroundings without any structure
_LEAST_SHARE = 0.5  # of the mean of all sectors, is a sector's deviation: over water there is nothing to stand out of
_LEAST_PROMINENCE = 0.1  # for its logarithm; a pose that stands out as little is as good as refuted
_MOST_PROMINENCE = math.e  # beyond, a pose is no likelier to be right
_ENOUGH = 3000  # cells: beyond, more of them say no more
_BEHIND_PER_CELL = 0.25  # nats: by about so much the best pose explains a cell better than any pose at random
_FAR_BEHIND = 0.6  # of that: from there on it is one pose of many


def measures(
    evidence: Evidence,
    sample: Evidence,
    scores: Float64Array,
    likelihood: MapLikelihood,
    poses: Float64Array,
    pool: ThreadPool = SERIAL,
) -> Float64Array:
    """Return the `MEASURES` (p, M - 1) of poses (p, 3) with scores (p,), nats; all but the last of them.

    `evidence`: all that the scores are sums over; `sample`: as much of it as the surroundings are compared by.
    """
    if not len(poses):
        return np.empty((0, len(MEASURES) - 1))
    here, elsewhere = _expectations(evidence, likelihood, poses, pool)
    explained = (scores - elsewhere) / np.maximum(here - elsewhere, _LEAST_DEVIATION)
    columns = [np.clip(explained, *EXPLAINED_BOUNDS)]
    sector = _sectors(sample)
    own = _sector_scores(sample, sector, likelihood, poses, pool)
    for offsets in (SHIFTED, SPUN):
        around = _sector_scores(sample, sector, likelihood, (poses[:, None] + offsets).reshape(-1, 3), pool)
        around = around.reshape(len(poses), len(offsets), -1)
        deviation = around.std(axis=1)
        deviation = np.maximum(deviation, _LEAST_SHARE * deviation.mean(axis=1, keepdims=True))
        above = (own - around.mean(axis=1)) / np.maximum(deviation, _LEAST_DEVIATION)
        columns.append(np.log(np.clip(above.mean(axis=1), _LEAST_PROMINENCE, _MOST_PROMINENCE)))
    amount = math.log(min(max(len(evidence), 1) / _ENOUGH, 1.0))
    return np.column_stack([*columns, np.full(len(poses), amount)])


def with_behind_best(measured: Float64Array, scores: Float64Array, cells: int) -> Float64Array:
    """Return `MEASURES` (p, M) of all poses of a scan, whose scores (p,) are sums over so many cells.

    `measured` (p, M - 1): what `measures` returns of them.
    """
    behind = (np.max(scores, initial=-np.inf) - scores) / (_BEHIND_PER_CELL * max(cells, 1))
    return np.column_stack([measured, -np.sqrt(np.minimum(behind, _FAR_BEHIND))])


def _sectors(evidence: Evidence) -> Int64Array:
    """Return in which of the sectors that hold evidence each cell (n,) lies, numbered without gaps."""
    angle = np.arctan2(evidence.xy_m[:, 1], evidence.xy_m[:, 0])
    number = np.floor(angle / (2.0 * math.pi) * SECTORS).astype(np.int64) % SECTORS
    return np.unique(number, return_inverse=True)[1].astype(np.int64)


def _sector_scores(
    evidence: Evidence, sector: Int64Array, likelihood: MapLikelihood, poses: Float64Array, pool: ThreadPool
) -> Float64Array:
    """Return the scores (p, K) of the evidence in each of K sectors (n,) at poses (p, 3), nats."""
    xy, count = np.ascontiguousarray(evidence.xy_m), int(sector.max(initial=0)) + 1

    def part(some: Float64Array) -> tuple[Float64Array]:
        return (
            _sector_sums(
                likelihood.classes, likelihood.model.log_ratios, xy, evidence.channel, sector, count, some, CELL_M
            ),
        )

    return np.asarray(in_parts(part, poses, pool)[0])


def _expectations(
    evidence: Evidence, likelihood: MapLikelihood, poses: Float64Array, pool: ThreadPool
) -> tuple[Float64Array, Float64Array]:
    """Return the scores (p,) to be expected of a robot that is here, and of one elsewhere, nats."""
    xy, layer = np.ascontiguousarray(evidence.xy_m), evidence.channel % LAYERS
    here, elsewhere = likelihood.model.expectations

    def part(some: Float64Array) -> tuple[Float64Array]:
        return (_sums(likelihood.classes, here, elsewhere, xy, layer, some, CELL_M),)

    sums = in_parts(part, poses, pool)[0]
    return sums[:, 0], sums[:, 1]


@njit(cache=True, nogil=True)
def _sector_sums(
    classes: UInt16Array, log_ratios: Float32Array, xy: Float64Array, channel: Int64Array, sector: Int64Array,
    count: int, poses: Float64Array, cell: float,
) -> Float64Array:  # fmt: skip
    rows, columns = classes.shape
    sums = np.zeros((len(poses), count))
    for p in range(len(poses)):
        c, s = math.cos(poses[p, 2]) / cell, math.sin(poses[p, 2]) / cell
        u0, v0 = poses[p, 0] / cell, poses[p, 1] / cell
        for e in range(len(channel)):
            column = int(u0 + c * xy[e, 0] - s * xy[e, 1])
            row = int(v0 + s * xy[e, 0] + c * xy[e, 1])
            if 0 <= row < rows and 0 <= column < columns:
                sums[p, sector[e]] += log_ratios[channel[e], classes[row, column]]
    return sums


@njit(cache=True, nogil=True)
def _sums(
    classes: UInt16Array, here: Float32Array, elsewhere: Float32Array, xy: Float64Array, layer: Int64Array,
    poses: Float64Array, cell: float,
) -> Float64Array:  # fmt: skip
    """Return (p, 2) the sums of two tables (LAYERS, CLASSES) over the evidence at each pose (p, 3)."""
    rows, columns = classes.shape
    sums = np.zeros((len(poses), 2))
    for p in range(len(poses)):
        c, s = math.cos(poses[p, 2]) / cell, math.sin(poses[p, 2]) / cell
        u0, v0 = poses[p, 0] / cell, poses[p, 1] / cell
        for e in range(len(layer)):
            column = int(u0 + c * xy[e, 0] - s * xy[e, 1])
            row = int(v0 + s * xy[e, 0] + c * xy[e, 1])
            if 0 <= row < rows and 0 <= column < columns:
                sums[p, 0] += here[layer[e], classes[row, column]]
                sums[p, 1] += elsewhere[layer[e], classes[row, column]]
    return sums
