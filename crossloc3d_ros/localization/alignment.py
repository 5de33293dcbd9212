"""From places to poses: where exactly, and in which heading, a scan fits the aerial map.

The surroundings of all candidates, or the whole map, are searched exhaustively in coarse cells; what fits best is
climbed to its top in fine ones. The score's height above what a scan from elsewhere would get becomes a likelihood, its
shape a covariance.
"""

from __future__ import annotations

import dataclasses
import math
import os

import numpy as np
from scipy.special import logsumexp

from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.localization.evidence import Evidence, evidence_of
from crossloc3d_ros.localization.likelihood import MapLikelihood
from crossloc3d_ros.localization.observation_model import ObservationModel
from crossloc3d_ros.localization.search import (
    Peaks,
    are_near,
    around,
    climb,
    inside,
    local_search,
    merge,
    scores_at,
    search_cells,
    wrapped,
)
from crossloc3d_ros.places.store import AerialMap
from crossloc3d_ros.types import (
    EXHAUSTIVE,
    AlignedPoses,
    Candidates,
    Float64Array,
    Hypotheses,
    Int64Array,
    no_aligned_poses,
)

COARSE_RETURNS, COARSE_PASSAGES = 160, 200
_MIDDLE_RETURNS, _MIDDLE_PASSAGES = 500, 500
_CLIMB_RETURNS, _CLIMB_PASSAGES = 600, 700
_FINE_RETURNS, _FINE_PASSAGES = 2000, 3000
COARSE_HEADINGS = 48
_APART_M = 8.0
_PLACE_M = 35.0  # so far from the centre of its submap a pose still is of its place
_UNSEEN = 0.2  # likelihood ratio of a place that is not among the candidates
_SAME_M, _SAME_RAD = 3.0, math.radians(12.0)
_SHAPE_STEPS_M = np.array([-1.2, -0.6, 0.0, 0.6, 1.2])
_SHAPE_STEPS_RAD = np.radians([-1.5, 0.0, 1.5])
_SHAPE = np.stack(np.meshgrid(_SHAPE_STEPS_M, _SHAPE_STEPS_M, _SHAPE_STEPS_RAD, indexing="ij"), -1).reshape(-1, 3)
_LEAST_STD_M, _LEAST_STD_RAD = 0.1, math.radians(0.2)


class Aligner:
    """Align scans with one aerial map."""

    def __init__(self, aerial_map: AerialMap, config: AlignmentConfig, model: ObservationModel | None = None) -> None:
        """Bring map and observation model (the shipped one by default) together."""
        self.aerial_map, self.config = aerial_map, config
        self.model = model or ObservationModel.load()
        self.likelihood = MapLikelihood(aerial_map, self.model)
        self._threads = min(os.cpu_count() or 1, 4)
        west, south, east, north = aerial_map.bounds
        self.area_m2 = (east - west) * (north - south)
        self.log_prior = -math.log(max(self.area_m2 / config.place_m2, 1.0))

    @property
    def searches_everywhere(self) -> bool:
        """Whether the whole map is searched at times: told to, or left the choice and the map is not too large."""
        small = self.area_m2 <= 1e6 * self.config.exhaustive_km2
        return self.config.search == "exhaustive" or (self.config.search == "auto" and small)

    def is_convincing(self, aligned: AlignedPoses) -> bool:
        """Whether a pose is believed enough to leave the rest of the map alone."""
        return bool(len(aligned)) and float(aligned.probabilities.max()) >= self.config.convincing

    def warm_up(self) -> None:
        """Read what an exhaustive search needs, so that the first scan does not wait for it."""
        if self.searches_everywhere:
            self.likelihood.prepare()

    def align(
        self,
        prepared: PreparedScan,
        sensor_xy_m: tuple[float, float],
        candidates: Candidates,
        hypotheses: Hypotheses | None = None,
        *,
        around: bool = True,
        everywhere: bool = False,
    ) -> AlignedPoses:
        """Return where the scan fits, best first.

        `sensor_xy_m`: where the sensor is on the base. `around` the candidates' places poses are sought, with
        `everywhere` on the whole map. Every hypothesis has one pose of its own in the result, as far as it lies on
        the map. The candidates' own shares of belief count too, wherever the poses come from.
        """
        evidence = evidence_of(prepared.place, prepared.sensor_height_m, sensor_xy_m)
        if len(evidence) < self.config.min_cells:
            return no_aligned_poses()
        fine = fine_evidence(evidence)
        found = self._found(evidence, candidates.grid if around else np.empty((0, 3)), everywhere)
        followed = self._followed(hypotheses)
        poses = np.vstack([found.poses, followed])
        if not len(poses):
            return no_aligned_poses()
        some = fine.some(_CLIMB_RETURNS, _CLIMB_PASSAGES)
        climbed, rested = climb(some, self.likelihood, poses, reach_m=self.config.follow_m)
        peaks = Peaks(climbed.poses, scores_at(fine, self.likelihood, climbed.poses))
        source = self._sources(peaks, len(found.poses), candidates.grid)
        kept = self._kept(peaks, len(found.poses))
        counts = fine.counts()
        log_likelihood = self.model.log_likelihood(peaks.scores, counts) + self._retrieved(peaks.poses, candidates)
        kept = kept[np.argsort(-log_likelihood[kept], kind="stable")]
        chosen = peaks.poses[kept]
        covariance = np.array([self._covariance(some, len(fine), pose) for pose in chosen]).reshape(-1, 3, 3)
        log_odds = log_likelihood[kept] + self.log_prior
        # A hypothesis and a peak of the search may be one pose: it counts once.
        log_odds[_repeated(chosen)] = -np.inf
        return AlignedPoses(
            grid=self._grid(chosen),
            heading_rad=np.array([wrapped(float(angle)) for angle in chosen[:, 2]]),
            covariance=covariance,
            log_likelihood=log_likelihood[kept],
            probabilities=np.exp(log_odds - np.logaddexp(0.0, logsumexp(log_odds))),
            inliers=np.clip(peaks.scores[kept] / max(float(self.model.expected @ counts), 1e-9), 0.0, 1.0),
            converged=rested[kept],
            source=source[kept],
            log_prior=self.log_prior,
        )

    def _found(self, evidence: Evidence, places: Float64Array, everywhere: bool) -> Peaks:
        """Return the best peaks around the places (k, 3) and, where asked, of the whole map, on the middle level."""
        coarse, middle = self.likelihood.levels
        laid = evidence.coarser(coarse.cell_m, COARSE_RETURNS, COARSE_PASSAGES)
        sought = []
        if everywhere:
            self.likelihood.prepare()
            sought.append((inside(self.likelihood, coarse), 2 * self.config.peaks, self._threads))
        if len(places):
            self._prepare(places)
            marked = around(self.likelihood, coarse, self._local(places[:, :2]), self.config.radius_m)
            sought.append((marked, self.config.peaks, 1))
        seeds = [
            search_cells(laid, coarse, cells, COARSE_HEADINGS, most, _APART_M, threads).poses
            for cells, most, threads in sought
        ]
        if not sum(len(poses) for poses in seeds):
            return Peaks(np.empty((0, 3)), np.empty(0))
        nearer = local_search(
            evidence.coarser(middle.cell_m, _MIDDLE_RETURNS, _MIDDLE_PASSAGES), middle, np.vstack(seeds), 4.0,
            math.radians(7.5), 2,
        )  # fmt: skip
        best = merge(nearer, 4.0, _SAME_RAD)[: len(sought) * self.config.poses]
        return Peaks(nearer.poses[best], nearer.scores[best])

    def _retrieved(self, poses: Float64Array, candidates: Candidates) -> Float64Array:
        """Return the log likelihood ratios (p,) that the descriptors give: belief near a pose over that by lot."""
        if not len(candidates):
            return np.zeros(len(poses))
        away = np.hypot(*(poses[:, None, :2] - self._local(candidates.grid[:, :2])[None]).transpose(2, 0, 1))
        believed = (away <= _PLACE_M) @ candidates.probabilities
        by_lot = min(math.pi * _PLACE_M**2 / self.area_m2, 1.0)
        return np.asarray(self.config.descriptor_weight * np.log(believed / by_lot + _UNSEEN))

    def _followed(self, hypotheses: Hypotheses | None) -> Float64Array:
        """Return the hypotheses (h, 3) as poses to begin at; those off the map as NaN are left to the climb."""
        if hypotheses is None or not len(hypotheses):
            return np.empty((0, 3))
        self._prepare(hypotheses.grid)
        return np.column_stack([self._local(hypotheses.grid[:, :2]), hypotheses.heading_rad])

    def _prepare(self, places: Float64Array) -> None:
        """Have the map read around places (k, 3); those that are not finite are none."""
        r = self.config.radius_m
        for easting, northing in places[np.isfinite(places[:, :2]).all(axis=1), :2]:
            self.likelihood.prepare((easting - r, northing - r, easting + r, northing + r))

    def _sources(self, peaks: Peaks, found: int, places: Float64Array) -> Int64Array:
        """Return where each pose comes from: the nearest candidate, the hypothesis, or everywhere."""
        source = np.full(len(peaks.scores), EXHAUSTIVE, np.int64)
        if len(places):
            away = np.hypot(*(peaks.poses[:found, None, :2] - self._local(places[:, :2])[None]).transpose(2, 0, 1))
            away[np.isnan(away)] = np.inf
            near = away.min(axis=1) <= 2.0 * self.config.radius_m
            source[:found][near] = away.argmin(axis=1)[near]
        source[found:] = -1 - np.arange(len(source) - found)
        return source

    def _kept(self, peaks: Peaks, found: int) -> Int64Array:
        """Return the rows of all hypotheses and of the peaks that are poses of their own."""
        first = Peaks(peaks.poses[:found], peaks.scores[:found])
        return np.concatenate([merge(first, _SAME_M, _SAME_RAD), np.arange(found, len(peaks.scores))])

    def _covariance(self, some: Evidence, cells: int, pose: Float64Array) -> Float64Array:
        """Return the covariance (3, 3) of a pose from the shape of the score around it.

        `some` of the `cells` of the whole evidence stand for all.
        """
        scores = scores_at(some, self.likelihood, pose + _SHAPE) * (cells / max(len(some), 1))
        weights = np.exp((scores - scores.max()) / self.config.shape_temperature)
        weights /= weights.sum()
        offsets = _SHAPE - weights @ _SHAPE
        spread = (offsets * weights[:, None]).T @ offsets
        return np.asarray(spread + np.diag([_LEAST_STD_M**2, _LEAST_STD_M**2, _LEAST_STD_RAD**2]))

    def _local(self, grid: Float64Array) -> Float64Array:
        return np.asarray(grid - np.array([self.likelihood.west_m, self.likelihood.south_m]))

    def _grid(self, poses: Float64Array) -> Float64Array:
        """Return (n, 3) grid positions of poses, on the terrain."""
        easting, northing = poses[:, 0] + self.likelihood.west_m, poses[:, 1] + self.likelihood.south_m
        heights = [self.likelihood.terrain_height(float(e), float(n)) for e, n in zip(easting, northing, strict=True)]
        return np.column_stack([easting, northing, heights])


def fine_counts(prepared: PreparedScan, sensor_xy_m: tuple[float, float]) -> Int64Array:
    """Return (CHANNELS,) how many cells of each channel a scan's scores are summed over."""
    return fine_evidence(evidence_of(prepared.place, prepared.sensor_height_m, sensor_xy_m)).counts()


def fine_evidence(evidence: Evidence) -> Evidence:
    """Return as much of the evidence as poses are compared by at the end."""
    return evidence.some(_FINE_RETURNS, _FINE_PASSAGES)


def moved(aligned: AlignedPoses, step: Float64Array) -> AlignedPoses:
    """Return the poses moved by `step` (3,): forward, left in metres and a turn in radians."""
    c, s = np.cos(aligned.heading_rad), np.sin(aligned.heading_rad)
    grid = aligned.grid.copy()
    grid[:, 0] += c * step[0] - s * step[1]
    grid[:, 1] += s * step[0] + c * step[1]
    heading = np.array([wrapped(float(angle)) for angle in aligned.heading_rad + step[2]])
    return dataclasses.replace(aligned, grid=grid, heading_rad=heading)


def _repeated(poses: Float64Array) -> np.ndarray:
    """Mark the poses (n, 3), best first, that are the same as a better one."""
    return np.array(
        [any(are_near(poses[i], poses[j], _SAME_M, _SAME_RAD) for j in range(i)) for i in range(len(poses))], np.bool_
    )
