"""From places to poses: where exactly, and in which heading, a scan fits the aerial map.

The surroundings of all candidates, or the whole map, are searched exhaustively in coarse cells; what fits best is
climbed to its top in fine ones. The score's height above what a scan from elsewhere would get becomes a likelihood, its
shape a covariance.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.config import AlignmentConfig, usable_threads
from crossloc3d_ros.localization.alignment.evidence import Evidence, evidence_of
from crossloc3d_ros.localization.alignment.likelihood import MapLikelihood
from crossloc3d_ros.localization.alignment.observation_model import ObservationModel
from crossloc3d_ros.localization.alignment.pose_search import (
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
from crossloc3d_ros.types import (
    WHOLE_MAP,
    AlignedPoses,
    BoolArray,
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
PEAKS_EVERYWHERE, POSES_EVERYWHERE = 4, 2  # so many times as many on the whole map as around candidates
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
        self.aerial_map = aerial_map
        self.model = model or ObservationModel.load()
        self.likelihood = MapLikelihood(aerial_map, self.model)
        self.threads = usable_threads()
        west, south, east, north = aerial_map.bounds
        self.area_m2 = (east - west) * (north - south)
        self.reconfigure(config)

    def reconfigure(self, config: AlignmentConfig) -> None:
        """Use other settings from the next scan on; what was read of the map is kept."""
        self.config = config
        self.log_prior = -math.log(max(self.area_m2 / config.place_m2, 1.0))

    @property
    def searches_everywhere(self) -> bool:
        """Whether the whole map is searched at times: told to, or left the choice and the map is not too large."""
        small = self.area_m2 <= 1e6 * self.config.map_max_km2
        return self.config.scope == "map" or (self.config.scope == "auto" and small)

    def warm_up(self) -> None:
        """Read what an exhaustive search needs, so that the first scan does not wait for it."""
        if self.searches_everywhere:
            self.likelihood.prepare()

    def begin(
        self, prepared: PreparedScan, sensor_xy_m: tuple[float, float], candidates: Candidates
    ) -> Alignment | None:
        """Return the alignment of a scan, which has looked nowhere yet; None for a scan that saw too little.

        `sensor_xy_m`: where the sensor is on the base. The candidates' own shares of belief count wherever the poses
        come from.
        """
        evidence = evidence_of(prepared.place, prepared.sensor_height_m, sensor_xy_m)
        if len(evidence) < self.config.min_cells:
            return None
        return Alignment(self, evidence, candidates)

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
        """Return where the scan fits, best first: `around` the candidates' places, `everywhere`, at the hypotheses."""
        alignment = self.begin(prepared, sensor_xy_m, candidates)
        if alignment is None:
            return no_aligned_poses()
        if around:
            alignment.look_around()
        if everywhere:
            alignment.look_everywhere()
        if hypotheses is not None:
            alignment.follow(hypotheses)
        return alignment.result()

    def prepare(self, places: Float64Array) -> None:
        """Have the map read around places (k, 3); those that are not finite are none."""
        r = self.config.candidate_radius_m
        for easting, northing in places[np.isfinite(places[:, :2]).all(axis=1), :2]:
            self.likelihood.prepare((easting - r, northing - r, easting + r, northing + r))

    def local(self, grid: Float64Array) -> Float64Array:
        """Return grid positions (n, 2) in metres from the likelihood's south-west corner."""
        return np.asarray(grid - np.array([self.likelihood.west_m, self.likelihood.south_m]))

    def on_grid(self, poses: Float64Array) -> Float64Array:
        """Return (n, 3) grid positions of poses, on the terrain."""
        easting, northing = poses[:, 0] + self.likelihood.west_m, poses[:, 1] + self.likelihood.south_m
        heights = [self.likelihood.terrain_height(float(e), float(n)) for e, n in zip(easting, northing, strict=True)]
        return np.column_stack([easting, northing, heights])


class Alignment:
    """The alignment of one scan, look by look: what one look found is known to the next."""

    def __init__(self, aligner: Aligner, evidence: Evidence, candidates: Candidates) -> None:
        """Look nowhere yet."""
        self._aligner, self._config, self._threads = aligner, aligner.config, aligner.threads
        self._likelihood = aligner.likelihood
        self._evidence, self._candidates = evidence, candidates
        self._places = aligner.local(candidates.grid[:, :2])
        self._fine = fine_evidence(evidence)
        self._some = self._fine.some(_CLIMB_RETURNS, _CLIMB_PASSAGES)
        self._nearer, self._is_climbed = _no_peaks(), np.empty(0, np.bool_)
        self._most_climbed = 0
        self._found, self._followed = _no_climbed(), _no_climbed()

    def look_around(self) -> None:
        """Seek poses around the candidates' places."""
        if not len(self._places):
            return
        self._aligner.prepare(self._candidates.grid)
        coarse = self._likelihood.levels[0]
        runs = around(self._likelihood, coarse, self._places, self._config.candidate_radius_m)
        self._look(runs, self._config.coarse_maxima, self._config.fine_maxima)

    def look_everywhere(self) -> None:
        """Seek poses on the whole map."""
        self._likelihood.prepare()
        runs = inside(self._likelihood, self._likelihood.levels[0])
        self._look(runs, PEAKS_EVERYWHERE * self._config.coarse_maxima, POSES_EVERYWHERE * self._config.fine_maxima)

    def follow(self, hypotheses: Hypotheses) -> None:
        """Seek one pose for each hypothesis; those off the map as NaN are left to the climb."""
        if len(hypotheses):
            self._aligner.prepare(hypotheses.grid)
            poses = np.column_stack([self._aligner.local(hypotheses.grid[:, :2]), hypotheses.heading_rad])
            self._followed = self._climbed(poses, -1 - np.arange(len(poses)))

    def is_convincing(self) -> bool:
        """Whether a pose is believed enough to leave the rest of the map alone."""
        probabilities = self._weighed()[2]
        return bool(len(probabilities)) and float(probabilities.max()) >= self._config.sufficient_probability

    def result(self) -> AlignedPoses:
        """Return where the scan fits, best first.

        Every hypothesis has one pose of its own in the result, as far as it lies on the map.
        """
        climbed, log_likelihood, probabilities = self._weighed()
        if not len(climbed.poses):
            return no_aligned_poses()
        expected = max(float(self._aligner.model.expected @ self._fine.counts()), 1e-9)
        return AlignedPoses(
            grid=self._aligner.on_grid(climbed.poses),
            heading_rad=np.array([wrapped(float(angle)) for angle in climbed.poses[:, 2]]),
            covariance=self._covariances(climbed.poses),
            log_likelihood=log_likelihood,
            probabilities=probabilities,
            inliers=np.clip(climbed.scores / expected, 0.0, 1.0),
            converged=climbed.rested,
            source=climbed.source,
            log_prior=self._aligner.log_prior,
        )

    def _look(self, runs: Int64Array, most: int, best: int) -> None:
        """Seek `most` poses in the runs of coarse cells, and climb from the `best` that were not climbed from."""
        coarse, middle = self._likelihood.levels
        laid = self._evidence.coarser(coarse.cell_m, COARSE_RETURNS, COARSE_PASSAGES)
        seeds = search_cells(laid, coarse, runs, COARSE_HEADINGS, most, _APART_M, self._threads)
        if not len(seeds.poses):
            return
        finer = self._evidence.coarser(middle.cell_m, _MIDDLE_RETURNS, _MIDDLE_PASSAGES)
        nearer = local_search(finer, middle, seeds.poses, 4.0, math.radians(7.5), 2, self._threads)
        self._nearer = Peaks(*map(np.concatenate, zip(vars(self._nearer).values(), vars(nearer).values(), strict=True)))
        self._is_climbed = np.append(self._is_climbed, np.zeros(len(nearer.scores), np.bool_))
        self._most_climbed += best
        merged = merge(self._nearer, 4.0, _SAME_RAD)[: self._most_climbed]
        fresh = merged[~self._is_climbed[merged]]
        self._is_climbed[fresh] = True
        self._found = self._found.join(self._climbed(self._nearer.poses[fresh], None))

    def _climbed(self, poses: Float64Array, source: Int64Array | None) -> _Climbed:
        """Return where the climb from poses (p, 3) ends, and whether candidates lie there where no source is given."""
        peaks, rested = climb(
            self._some, self._likelihood, poses, reach_m=self._config.hypothesis_radius_m, threads=self._threads
        )
        scores = scores_at(self._fine, self._likelihood, peaks.poses, self._threads)
        if source is None:
            source = np.full(len(poses), WHOLE_MAP, np.int64)
            if len(self._places):
                away = self._away(peaks.poses)
                near = away.min(axis=1) <= 2.0 * self._config.candidate_radius_m
                source[near] = away.argmin(axis=1)[near]
        return _Climbed(peaks.poses, scores, rested, source)

    def _weighed(self) -> tuple[_Climbed, Float64Array, Float64Array]:
        """Return the poses that are kept, best first, with log likelihoods and probabilities."""
        found = self._found.take(merge(Peaks(self._found.poses, self._found.scores), _SAME_M, _SAME_RAD))
        climbed = found.join(self._followed)
        log_likelihood = self._aligner.model.log_likelihood(climbed.scores, self._fine.counts())
        log_likelihood = log_likelihood + self._retrieved(climbed.poses)
        order = np.argsort(-log_likelihood, kind="stable")
        climbed, log_likelihood = climbed.take(order), log_likelihood[order]
        log_odds = log_likelihood + self._aligner.log_prior
        # A hypothesis and a peak of the search may be one pose: it counts once.
        near = are_near(climbed.poses, _SAME_M, _SAME_RAD)
        log_odds[np.tril(near, -1).any(axis=1)] = -np.inf
        return climbed, log_likelihood, np.exp(log_odds - np.logaddexp(0.0, np.logaddexp.reduce(log_odds)))

    def _retrieved(self, poses: Float64Array) -> Float64Array:
        """Return the log likelihood ratios (p,) that the descriptors give: belief near a pose over that by lot."""
        if not len(self._places):
            return np.zeros(len(poses))
        believed = (self._away(poses) <= _PLACE_M) @ self._candidates.probabilities
        by_lot = min(math.pi * _PLACE_M**2 / self._aligner.area_m2, 1.0)
        return np.asarray(self._config.descriptor_weight * np.log(believed / by_lot + _UNSEEN))

    def _away(self, poses: Float64Array) -> Float64Array:
        """Return distances (p, k) of poses from the candidates' places; infinite where either is none."""
        away = np.hypot(*(poses[:, None, :2] - self._places[None]).transpose(2, 0, 1))
        return np.where(np.isnan(away), np.inf, away)

    def _covariances(self, poses: Float64Array) -> Float64Array:
        """Return the covariances (p, 3, 3) of poses from the shape of the score around them."""
        around_them = (poses[:, None] + _SHAPE).reshape(-1, 3)
        scores = scores_at(self._some, self._likelihood, around_them, self._threads).reshape(len(poses), -1)
        scores *= len(self._fine) / max(len(self._some), 1)  # some of the cells stand for all
        weights = np.exp((scores - scores.max(axis=1, keepdims=True)) / self._config.covariance_temperature)
        weights /= weights.sum(axis=1, keepdims=True)
        offsets = _SHAPE - (weights @ _SHAPE)[:, None]
        spread = np.einsum("ps,psi,psj->pij", weights, offsets, offsets)
        return np.asarray(spread + np.diag([_LEAST_STD_M**2, _LEAST_STD_M**2, _LEAST_STD_RAD**2]))


@dataclass(frozen=True, eq=False)
class _Climbed:
    """Where climbs ended."""

    poses: Float64Array
    """(p, 3) local metres, radians."""
    scores: Float64Array
    """(p,) nats, of the fine evidence."""
    rested: BoolArray
    """(p,) whether the climb came to rest near where it began."""
    source: Int64Array
    """(p,) as `AlignedPoses` has it."""

    def take(self, rows: Int64Array) -> _Climbed:
        return _Climbed(*(values[rows] for values in vars(self).values()))

    def join(self, other: _Climbed) -> _Climbed:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Climbed(*(np.concatenate(pair) for pair in pairs))


def _no_peaks() -> Peaks:
    return Peaks(np.empty((0, 3)), np.empty(0))


def _no_climbed() -> _Climbed:
    return _Climbed(np.empty((0, 3)), np.empty(0), np.empty(0, np.bool_), np.empty(0, np.int64))


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
