"""From places to poses: where exactly, and in which heading, a scan fits the aerial map.

The surroundings of all candidates, or the whole map, are searched exhaustively in coarse cells; the best poses are
refined by hill climbing in fine ones. The score becomes a likelihood, by how far it is above that of a scan from
elsewhere, and the shape of its maximum a covariance.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.angles import wrap
from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.config import AlignmentConfig, usable_threads
from crossloc3d_ros.localization.alignment.evidence import Evidence, evidence_of
from crossloc3d_ros.localization.alignment.likelihood import MapLikelihood
from crossloc3d_ros.localization.alignment.local_null import measures, with_behind_best
from crossloc3d_ros.localization.alignment.observation_model import MEASURES, ObservationModel
from crossloc3d_ros.localization.alignment.pose_search import (
    are_near,
    around,
    climb,
    inside,
    local_search,
    merge,
    no_peaks,
    scores_at,
    search_cells,
)
from crossloc3d_ros.localization.alignment.thread_pool import ThreadPool
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

COARSE_HITS, COARSE_FREE = 160, 200
"""Evidence of the coarse search: its time is proportional, and its sums stay within 16 bits."""
_MIDDLE_HITS, _MIDDLE_FREE = 500, 500  # more poses are compared, but only around each coarse one
_CLIMB_HITS, _CLIMB_FREE = 600, 700  # enough to find the maximum; the scores themselves are taken of the fine evidence
_FINE_HITS, _FINE_FREE = 2000, 3000  # what a scan of 16 rings has, about: beyond, cells are hardly independent
COARSE_HEADINGS = 48
"""7.5 degrees: at 30 m, a step of one coarse cell."""
_APART_M = 8.0  # two coarse cells: nearer ones climb to the same maximum
_MIDDLE_REACH_M, _MIDDLE_REACH_RAD = 4.0, math.radians(7.5)  # a coarse cell and a step of its headings
_MIDDLE_HEADINGS = 2  # tried to either side
MAP_COARSE_FACTOR, MAP_FINE_FACTOR = 4, 2
"""So many times as many maxima are refined on the whole map as around candidates."""
_PLACE_M = 35.0  # so far from the centre of its submap a pose is still of its place
_NOT_RETRIEVED = 0.2  # likelihood ratio of a place that is not among the candidates
_BEYOND_NEWEST = 8.0  # nats: the newest scan of a local map refutes a pose that only the scans before it speak for
_SAME_M, _SAME_RAD = 3.0, math.radians(12.0)  # poses this near belong to one maximum
_EXPLAINED = MEASURES.index("explained")
# Where the score is sampled for the covariance: about two standard deviations of a good pose to each side.
_SHAPE_STEPS_M = np.array([-1.2, -0.6, 0.0, 0.6, 1.2])
_SHAPE_STEPS_RAD = np.radians([-1.5, 0.0, 1.5])
_SHAPE = np.stack(np.meshgrid(_SHAPE_STEPS_M, _SHAPE_STEPS_M, _SHAPE_STEPS_RAD, indexing="ij"), -1).reshape(-1, 3)
_MIN_STD_M, _MIN_STD_RAD = 0.1, math.radians(0.2)  # below the last step of the climb nothing is known


class Aligner:
    """Align scans with one aerial map."""

    def __init__(
        self,
        aerial_map: AerialMap,
        config: AlignmentConfig,
        model: ObservationModel | None = None,
        *,
        threads: int = 0,
    ) -> None:
        """Bring map and observation model (the shipped one by default) together.

        `threads` work on a scan; 0 = `usable_threads()`. With one, all is done in the caller's thread.
        """
        self.aerial_map = aerial_map
        self.model = model or ObservationModel.load()
        self.likelihood = MapLikelihood(aerial_map, self.model)
        self.pool = ThreadPool(threads or usable_threads())
        west, south, east, north = aerial_map.bounds
        self.area_m2 = (east - west) * (north - south)
        self.reconfigure(config)

    def reconfigure(self, config: AlignmentConfig) -> None:
        """Use other settings from the next scan on; what was read of the map is kept."""
        self.config = config
        self.offset, self.calibration_words = calibration_offset(self.aerial_map, self.model, config)
        self.log_prior = -math.log(max(self.area_m2 / config.place_m2, 1.0))

    @property
    def searches_map(self) -> bool:
        """Whether the whole map is ever searched: by the scope `map`, or `auto` where the map is small."""
        small = self.area_m2 <= 1e6 * self.config.map_max_km2
        return self.config.scope == "map" or (self.config.scope == "auto" and small)

    def warm_up(self) -> None:
        """Read what a search of the whole map needs, so that the first scan does not wait for it."""
        if self.searches_map:
            self.likelihood.prepare()

    def has_evidence(self, prepared: PreparedScan) -> bool:
        """Return whether a scan has evidence in enough cells to be aligned."""
        return len(evidence_of(prepared.place, prepared.sensor_height_m)) >= self.config.min_cells

    def begin(self, evidence: Evidence, candidates: Candidates, newest: Evidence | None = None) -> Alignment | None:
        """Return the alignment of a scan, or of a local map of several, without any search yet; None for too little.

        The candidates' probabilities count wherever the poses come from. Of a local map, `newest` is the evidence of
        its newest scan: the whole says which pose it is, the newest where exactly, free of the errors of odometry.
        """
        return None if len(evidence) < self.config.min_cells else Alignment(self, evidence, candidates, newest)

    def align(
        self,
        prepared: PreparedScan,
        sensor_xy_m: tuple[float, float],
        candidates: Candidates,
        hypotheses: Hypotheses | None = None,
        *,
        search_candidates: bool = True,
        search_map: bool = False,
    ) -> AlignedPoses:
        """Return where the scan fits, best first: around the candidates, on the whole map, at the hypotheses.

        `sensor_xy_m`: where the sensor is on the base.
        """
        evidence = evidence_of(prepared.place, prepared.sensor_height_m, sensor_xy_m)
        alignment = self.begin(evidence, candidates)
        if alignment is None:
            return no_aligned_poses()
        if search_candidates:
            alignment.search_candidates()
        if search_map:
            alignment.search_map()
        if hypotheses is not None:
            alignment.refine_hypotheses(hypotheses)
        return alignment.result()

    def close(self) -> None:
        """End the threads."""
        self.pool.close()

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


def calibration_offset(aerial_map: AerialMap, model: ObservationModel, config: AlignmentConfig) -> tuple[float, str]:
    """Return what is added to log likelihoods on a map, nats, and a sentence on its calibration for people.

    The sentence is empty where the map was never calibrated.
    """
    calibration = aerial_map.calibration
    if calibration is None:
        fault = aerial_map.calibration_fault
        return 0.0, f"its calibration is not used: {fault}" if fault else ""
    made_for = f"for a {calibration.lidar} at {calibration.lidar_height_m:g} m"
    if not config.use_calibration:
        return 0.0, f"its calibration {made_for} is not used: alignment.use_calibration is false"
    if calibration.observation_model != model.fingerprint:
        return 0.0, (
            f"its calibration {made_for} is not used: it was made with another observation model; calibrate the "
            f"map again with 'calibrate_map {aerial_map.path}'"
        )
    return calibration.offset, f"calibrated {made_for}: {calibration.offset:+.2f} on log likelihoods"


class Alignment:
    """The alignment of one scan, search by search: each builds on what the ones before found."""

    def __init__(
        self, aligner: Aligner, evidence: Evidence, candidates: Candidates, newest: Evidence | None = None
    ) -> None:
        """Search nowhere yet."""
        self._aligner, self._config, self._pool = aligner, aligner.config, aligner.pool
        self._likelihood = aligner.likelihood
        self._evidence, self._candidates = evidence, candidates
        self._places = aligner.local(candidates.grid[:, :2])
        self._fine = fine_evidence(evidence)
        self._climb_evidence = self._fine.sample(_CLIMB_HITS, _CLIMB_FREE)
        self._newest = None if newest is None or newest is evidence else fine_evidence(newest)
        # What tells where exactly: all of it, and as much as poses climb by.
        self._exact, self._exact_sample = self._fine, self._climb_evidence
        if self._newest is not None:
            self._exact, self._exact_sample = self._newest, self._newest.sample(_CLIMB_HITS, _CLIMB_FREE)
        self._weighed: tuple[_Poses, Float64Array, Float64Array, Float64Array] | None = None
        self._maxima, self._is_refined = no_peaks(), np.empty(0, np.bool_)
        self._most_refined = 0
        self._found, self._tracked = _no_poses(), _no_poses()

    def search_candidates(self) -> None:
        """Search for poses around the candidates' places."""
        if not len(self._places):
            return
        self._aligner.prepare(self._candidates.grid)
        coarse = self._likelihood.levels[0]
        runs = around(self._likelihood, coarse, self._places, self._config.candidate_radius_m)
        self._search(runs, self._config.coarse_maxima, self._config.fine_maxima)

    def search_map(self) -> None:
        """Search for poses on the whole map."""
        self._likelihood.prepare()
        runs = inside(self._likelihood, self._likelihood.levels[0])
        self._search(runs, MAP_COARSE_FACTOR * self._config.coarse_maxima, MAP_FINE_FACTOR * self._config.fine_maxima)

    def refine_hypotheses(self, hypotheses: Hypotheses) -> None:
        """Refine each hypothesis to one pose; one that is off the map or NaN stays where it is."""
        if len(hypotheses):
            self._aligner.prepare(hypotheses.grid)
            poses = np.column_stack([self._aligner.local(hypotheses.grid[:, :2]), hypotheses.heading_rad])
            self._tracked = self._refined(poses, -1 - np.arange(len(poses)))
            self._weighed = None

    def is_sufficient(self) -> bool:
        """Return whether one pose is probable enough that the rest of the map need not be searched."""
        probabilities = self._weighted()[3]
        return bool(len(probabilities)) and float(probabilities.max()) >= self._config.sufficient_probability

    def result(self) -> AlignedPoses:
        """Return where the scan fits, best first.

        Every hypothesis has one pose of its own in the result, as far as it lies on the map.
        """
        refined, _, log_likelihood, probabilities = self._weighted()
        if not len(refined.poses):
            return no_aligned_poses()
        poses = self._where_exactly(refined.poses, log_likelihood)
        return AlignedPoses(
            grid=self._aligner.on_grid(poses),
            heading_rad=_headings(poses[:, 2]),
            covariance=self._covariances(poses),
            log_likelihood=log_likelihood,
            probabilities=probabilities,
            inliers=np.clip(refined.measures[:, _EXPLAINED], 0.0, 1.0),
            converged=refined.converged,
            source=refined.source,
            log_prior=self._aligner.log_prior,
        )

    def measured(self) -> tuple[AlignedPoses, Float64Array]:
        """Return where the scan fits, best first, and the `MEASURES` (n, M) of each pose."""
        return self.result(), self._weighted()[1]

    def _search(self, runs: Int64Array, coarse_maxima: int, fine_maxima: int) -> None:
        """Search the runs of coarse cells, and refine the best maxima that were not refined before."""
        coarse, middle = self._likelihood.levels
        evidence = self._evidence.coarser(coarse.cell_m, COARSE_HITS, COARSE_FREE)
        seeds = search_cells(evidence, coarse, runs, COARSE_HEADINGS, coarse_maxima, _APART_M, self._pool)
        if not len(seeds.poses):
            return
        evidence = self._evidence.coarser(middle.cell_m, _MIDDLE_HITS, _MIDDLE_FREE)
        found = local_search(
            evidence, middle, seeds.poses, _MIDDLE_REACH_M, _MIDDLE_REACH_RAD, _MIDDLE_HEADINGS, self._pool
        )
        self._maxima = self._maxima.join(found)
        self._is_refined = np.append(self._is_refined, np.zeros(len(found.scores), np.bool_))
        self._most_refined += fine_maxima
        order = self._maxima.by_both()
        merged = merge(self._maxima.poses, order, _MIDDLE_REACH_M, _SAME_RAD)[: self._most_refined]
        fresh = merged[~self._is_refined[merged]]
        self._is_refined[fresh] = True
        self._found = self._found.join(self._refined(self._maxima.poses[fresh], None))
        self._weighed = None

    def _refined(self, poses: Float64Array, source: Int64Array | None) -> _Poses:
        """Return where the climb from poses (p, 3) ends; without a source, the candidates near there are it."""
        peaks, converged = climb(
            self._climb_evidence, self._likelihood, poses, reach_m=self._config.hypothesis_radius_m, pool=self._pool
        )
        scores = scores_at(self._fine, self._likelihood, peaks.poses, self._pool)
        measured = measures(self._fine, self._climb_evidence, scores, self._likelihood, peaks.poses, self._pool)
        if source is None:
            source = np.full(len(poses), WHOLE_MAP, np.int64)
            if len(self._places):
                away = self._away(peaks.poses)
                near = away.min(axis=1) <= 2.0 * self._config.candidate_radius_m
                source[near] = away.argmin(axis=1)[near]
        return _Poses(peaks.poses, scores, measured, converged, source)

    def _weighted(self) -> tuple[_Poses, Float64Array, Float64Array, Float64Array]:
        """Return the poses that are kept, best first, their `MEASURES` (p, M), log likelihoods and probabilities."""
        if self._weighed is None:
            self._weighed = self._weigh()
        return self._weighed

    def _weigh(self) -> tuple[_Poses, Float64Array, Float64Array, Float64Array]:
        order = np.argsort(-self._found.scores, kind="stable")
        found = self._found.take(merge(self._found.poses, order, _SAME_M, _SAME_RAD))
        poses = found.join(self._tracked)
        measured = with_behind_best(poses.measures, poses.scores, len(self._fine))
        log_likelihood = self._aligner.model.log_likelihood(measured)
        log_likelihood = np.minimum(log_likelihood, self._of_newest(poses, log_likelihood) + _BEYOND_NEWEST)
        log_likelihood = log_likelihood + self._descriptor_log_ratios(poses.poses) + self._aligner.offset
        order = np.argsort(-log_likelihood, kind="stable")
        poses, measured, log_likelihood = poses.take(order), measured[order], log_likelihood[order]
        log_odds = log_likelihood + self._aligner.log_prior
        # A hypothesis and a maximum of the search may be one pose: it counts once.
        near = are_near(poses.poses, _SAME_M, _SAME_RAD)
        log_odds[np.tril(near, -1).any(axis=1)] = -np.inf
        return poses, measured, log_likelihood, np.exp(log_odds - np.logaddexp(0.0, np.logaddexp.reduce(log_odds)))

    def _descriptor_log_ratios(self, poses: Float64Array) -> Float64Array:
        """Return the log likelihood ratios (p,) of the descriptors: probability near a pose over chance level."""
        if not len(self._places):
            return np.zeros(len(poses))
        retrieved = (self._away(poses) <= _PLACE_M) @ self._candidates.probabilities
        chance = min(math.pi * _PLACE_M**2 / self._aligner.area_m2, 1.0)
        return np.asarray(self._config.descriptor_weight * np.log(retrieved / chance + _NOT_RETRIEVED))

    def _away(self, poses: Float64Array) -> Float64Array:
        """Return distances (p, k) of poses from the candidates' places; infinite where either is none."""
        away = np.hypot(*(poses[:, None, :2] - self._places[None]).transpose(2, 0, 1))
        return np.where(np.isnan(away), np.inf, away)

    def _of_newest(self, poses: _Poses, log_likelihood: Float64Array) -> Float64Array:
        """Return the log likelihood ratios (p,) of the newest scan alone, for poses that the local map speaks for.

        Infinite where it does not, and where there is no local map.
        """
        alone = np.full(len(log_likelihood), np.inf)
        some = np.flatnonzero(log_likelihood > 0.0)
        if self._newest is None or not len(self._newest) or not len(some):
            return alone
        scores = scores_at(self._newest, self._likelihood, poses.poses[some], self._pool)
        own = measures(self._newest, self._exact_sample, scores, self._likelihood, poses.poses[some], self._pool)
        alone[some] = self._aligner.model.log_likelihood(with_behind_best(own, scores, len(self._newest)))
        return alone

    def _where_exactly(self, poses: Float64Array, log_likelihood: Float64Array) -> Float64Array:
        """Return poses (p, 3), those that count at all moved to where the newest scan of a local map fits best."""
        if self._newest is None:
            return poses
        exact, counts = poses.copy(), log_likelihood > 0.0
        climbed, _ = climb(self._exact_sample, self._likelihood, poses[counts], reach_m=_SAME_M, pool=self._pool)
        exact[counts] = climbed.poses
        return exact

    def _covariances(self, poses: Float64Array) -> Float64Array:
        """Return the covariances (p, 3, 3) of poses from the shape of the score around them."""
        around_them = (poses[:, None] + _SHAPE).reshape(-1, 3)
        scores = scores_at(self._exact_sample, self._likelihood, around_them, self._pool).reshape(len(poses), -1)
        scores *= len(self._exact) / max(len(self._exact_sample), 1)  # a sample of the cells stands for all
        weights = np.exp((scores - scores.max(axis=1, keepdims=True)) / self._config.covariance_temperature)
        weights /= weights.sum(axis=1, keepdims=True)
        offsets = _SHAPE - (weights @ _SHAPE)[:, None]
        spread = np.einsum("ps,psi,psj->pij", weights, offsets, offsets)
        return np.asarray(spread + np.diag([_MIN_STD_M**2, _MIN_STD_M**2, _MIN_STD_RAD**2]))


@dataclass(frozen=True, eq=False)
class _Poses:
    """Refined poses."""

    poses: Float64Array
    """(p, 3) local metres, radians."""
    scores: Float64Array
    """(p,) nats, of the fine evidence."""
    measures: Float64Array
    """(p, M - 1) the `MEASURES` of each, but for how far behind the best it is."""
    converged: BoolArray
    """(p,) whether the climb converged near where it began."""
    source: Int64Array
    """(p,) as `AlignedPoses` has it."""

    def take(self, rows: Int64Array) -> _Poses:
        return _Poses(*(values[rows] for values in vars(self).values()))

    def join(self, other: _Poses) -> _Poses:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Poses(*(np.concatenate(pair) for pair in pairs))


def _no_poses() -> _Poses:
    return _Poses(
        np.empty((0, 3)), np.empty(0), np.empty((0, len(MEASURES) - 1)), np.empty(0, np.bool_), np.empty(0, np.int64)
    )


def fine_evidence(evidence: Evidence) -> Evidence:
    """Return as much of the evidence as poses are compared by at the end."""
    return evidence.sample(_FINE_HITS, _FINE_FREE)


def moved(aligned: AlignedPoses, step: Float64Array) -> AlignedPoses:
    """Return the poses moved by `step` (3,): forward, left in metres and a turn in radians."""
    c, s = np.cos(aligned.heading_rad), np.sin(aligned.heading_rad)
    grid = aligned.grid.copy()
    grid[:, 0] += c * step[0] - s * step[1]
    grid[:, 1] += s * step[0] + c * step[1]
    return dataclasses.replace(aligned, grid=grid, heading_rad=_headings(aligned.heading_rad + step[2]))


def _headings(angle_rad: Float64Array) -> Float64Array:
    """Return angles in (-pi, pi]: west is pi, as `atan2` has it."""
    return 0.0 - wrap(-angle_rad)  # not -wrap(...), which has a negative zero
