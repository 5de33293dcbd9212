"""The localizer: scans in, estimates out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.clouds.scan import PreparedScan, prepare_scan
from crossloc3d_ros.config import AlignmentConfig, LocalizerConfig
from crossloc3d_ros.localization.alignment.aligner import Aligner, moved
from crossloc3d_ros.localization.alignment.evidence import evidence_of_scan
from crossloc3d_ros.localization.alignment.local_map import LocalMap
from crossloc3d_ros.localization.estimates import Watch, no_estimate, placed_estimate, posed_estimate
from crossloc3d_ros.localization.fusion.odometry import Motion, plausible_motion
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.fusion.tracker import Tracker
from crossloc3d_ros.localization.inputs import check_stamp
from crossloc3d_ros.localization.retrieval.candidates import encode_query, retrieve
from crossloc3d_ros.localization.retrieval.place_belief import decide, effective_calibration
from crossloc3d_ros.types import (
    AlignedPoses,
    Candidates,
    DescriptorEncoder,
    Estimate,
    Float64Array,
    Hypotheses,
    Scan,
    TrackState,
    no_aligned_poses,
    no_candidates,
)

__all__ = ["Localizer", "no_estimate"]


class Localizer:
    """Localize a LiDAR on an aerial map, scan after scan, without an initial pose."""

    def __init__(
        self, aerial_map: AerialMap, encoder: DescriptorEncoder, config: LocalizerConfig, *, threads: int = 0
    ) -> None:
        """Bring map and encoder together; they must belong to each other, as `AerialMap.load` ensures.

        `threads` align a scan; 0 = `usable_threads()`.
        """
        self.aerial_map = aerial_map
        self.encoder = encoder
        self._threads = threads
        self._aligner: Aligner | None = None
        self._is_warm = False
        self._tracker = Tracker(config.fusion)
        self._schedule = SearchSchedule(config.alignment)
        self._local_map = LocalMap(config.alignment.local_map_m)
        self.reconfigure(config)

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last scan that counted, from which the next one's motion leads; None before the first."""
        return self._tracker.stamp_ns

    @property
    def searches_map(self) -> bool:
        """Whether the whole map is ever searched for the pose of a scan."""
        return self._aligner is not None and self._aligner.searches_map

    @property
    def calibration_words(self) -> str:
        """A sentence on the map's calibration; empty where there is none, or no pose is aligned."""
        return "" if self._aligner is None else self._aligner.calibration_words

    def localize(
        self,
        scan: Scan,
        gravity_base: Float64Array | None = None,
        T_base_lidar: Float64Array | None = None,
        motion: Motion | Callable[[], Motion | None] | None = None,
    ) -> Estimate:
        """Return where `scan` was taken.

        A scan of too few points for a descriptor is aligned all the same, at the hypotheses and on the whole map, if
        it has evidence enough (`alignment.min_cells`).

        `gravity_base` (3,) is the unit vector that points up, measured in the base frame, where an IMU gives one;
        `T_base_lidar` (4, 4) replaces the mounting of the configuration, where TF gives it. `motion` leads from the
        last scan that counted (`stamp_ns` of this object) to this one; None = not known. A function is called for it
        when the descriptor is done: odometry may arrive later than the scan. CloudError and PoseError for what is none
        of these; the belief is left as it is.
        """
        check_stamp(scan.stamp_ns, "the stamp of a scan")
        watch = Watch()
        if T_base_lidar is None:
            T_base_lidar = mounting_matrix(self.config.scan.mounting)
        prepared = prepare_scan(scan, self.config.scan, self.encoder.preprocessing, gravity_base, T_base_lidar)
        watch.lap("prepare_ms")
        found = no_candidates()
        if prepared.patch is not None:
            descriptors = encode_query(self.encoder, prepared.patch.points)
            watch.lap("encode_ms")
            found = retrieve(descriptors, self.aerial_map, self._candidates_sought, self.calibration)
        elif self._aligner is None or not self._aligner.has_evidence(prepared):
            return no_estimate(scan.stamp_ns, prepared.reason, prepared.counts, watch.timings)
        candidates, frame = _first(found, self.config.top_k), self.aerial_map.frame
        place = decide(candidates, frame.to_enu(candidates.grid), self.config.retrieval)
        watch.lap("search_ms")
        if self._aligner is None:
            return placed_estimate(scan.stamp_ns, frame, place, candidates, prepared.counts, watch)
        motion = self._plausible(scan.stamp_ns, motion() if callable(motion) else motion)
        step = self._within_revolution(scan, motion)
        hypotheses = self._tracker.predict(scan.stamp_ns, motion)
        aligned = moved(self._align(self._aligner, scan.stamp_ns, prepared, T_base_lidar, found, hypotheses), step)
        watch.lap("align_ms")
        belief = self._tracker.update(aligned)
        self._schedule.state = belief.state
        watch.lap("fuse_ms")
        return posed_estimate(
            scan.stamp_ns, frame, place, candidates, aligned, belief, gravity_base, prepared.counts, watch
        )

    def set_prior(self, prior: PosePrior) -> None:
        """Take in what is known of the pose from outside: an operator's initial pose, a compass."""
        if self._aligner is not None:  # else no pose is tracked that it could belong to
            self._tracker.set_prior(prior)

    def reconfigure(self, config: LocalizerConfig) -> None:
        """Use other settings from the next scan on; the hypotheses and what was read of the map are kept."""
        self.config = config
        self.calibration = effective_calibration(config.retrieval, self.encoder)
        self._tracker.reconfigure(config.fusion)
        self._schedule.reconfigure(config.alignment)
        self._local_map.length_m = config.alignment.local_map_m
        if config.alignment.scope == "none":
            self._aligner = None
        elif self._aligner is None:
            self._aligner = Aligner(self.aerial_map, config.alignment, threads=self._threads)
            if self._is_warm:
                self._aligner.warm_up()
        else:
            self._aligner.reconfigure(config.alignment)

    def reset(self) -> None:
        """Forget every hypothesis: the robot may be anywhere."""
        self._tracker.reset()
        self._schedule.reset()
        self._local_map.clear()

    def warm_up(self) -> None:
        """Run every step once, so that the first scan is as fast as the others.

        Call it in the thread that localizes: numerical libraries keep state for each thread.
        """
        self.encoder.warm_up()
        if self._aligner is not None:
            self._aligner.warm_up()
        rng = np.random.default_rng(0)
        ground = np.column_stack([rng.uniform(-30, 30, (8000, 2)), np.full(8000, -self.config.scan.mounting.z_m)])
        walls = np.column_stack([rng.uniform(-30, 30, 8000), np.full(8000, 12.0), rng.uniform(0, 8, 8000)])
        points = np.vstack([ground, walls]).astype(np.float32)
        up = np.array([0.0, 0.0, 1.0])
        for gravity_base in (None, up):
            self.localize(Scan(points, stamp_ns=0, frame_id="warm_up"), gravity_base)
        self._is_warm = True
        self.reset()

    @property
    def _candidates_sought(self) -> int:
        aligned = 0 if self._aligner is None else self.config.alignment.candidates
        return max(self.config.top_k, aligned)

    def _align(
        self,
        aligner: Aligner,
        stamp_ns: int,
        prepared: PreparedScan,
        T_base_lidar: Float64Array,
        found: Candidates,
        hypotheses: Hypotheses,
    ) -> AlignedPoses:
        """Align at the hypotheses; around the candidates and on the whole map when a search is due."""
        config, schedule = self.config.alignment, self._schedule
        newest = evidence = evidence_of_scan(prepared, T_base_lidar)
        if not self._tracker.skips:
            motion = self._tracker.motion
            self._local_map.move(motion.delta if motion.is_known else None)
            evidence = self._local_map.add(newest)
        alignment = aligner.begin(evidence, _first(found, config.candidates), newest)
        if alignment is None:
            return no_aligned_poses()
        alignment.refine_hypotheses(hypotheses)
        if not self._tracker.skips:
            if schedule.candidates_due(stamp_ns) and config.scope != "map":
                alignment.search_candidates()
            if aligner.searches_map:
                is_enough = config.scope == "auto" and alignment.is_sufficient()
                if not is_enough and schedule.map_due(stamp_ns):
                    alignment.search_map()
        return alignment.result()

    def _plausible(self, stamp_ns: int, motion: Motion | None) -> Motion | None:
        since_ns = self._tracker.stamp_ns
        if since_ns is None or stamp_ns <= since_ns:
            return motion
        return plausible_motion(motion, (stamp_ns - since_ns) * 1e-9, self.config.fusion)

    def _within_revolution(self, scan: Scan, motion: Motion | None) -> Float64Array:
        """Return the motion (3,) from the middle of the lidar's revolution, where the scan is aligned, to its stamp.

        Zero where the points are at the moment of the stamp already.
        """
        since, stamp_ns = self._tracker.stamp_ns, scan.stamp_ns
        if scan.is_at_stamp or motion is None or not motion.is_known or since is None or stamp_ns <= since:
            return np.zeros(3)
        seconds = (self.config.scan.stamped_at - 0.5) * self.config.scan.period_s
        return np.asarray(motion.delta * (seconds / ((stamp_ns - since) * 1e-9)))


class SearchSchedule:
    """When to search beyond the hypotheses: at once where nothing is known, periodically afterwards."""

    def __init__(self, config: AlignmentConfig) -> None:
        self._config = config
        self.reset()

    def reconfigure(self, config: AlignmentConfig) -> None:
        """Use other periods from the next scan on."""
        self._config = config

    def reset(self) -> None:
        """Search at the next scan."""
        self.state = TrackState.SEARCHING
        self._last_ns: dict[str, int] = {}

    def candidates_due(self, stamp_ns: int) -> bool:
        """Return whether a search around the candidates is due; if so, it counts as done."""
        config, is_localized = self._config, self.state is TrackState.LOCALIZED
        period_s = config.candidates_period_localized_s if is_localized else config.candidates_period_s
        return self._due("candidates", stamp_ns, period_s)

    def map_due(self, stamp_ns: int) -> bool:
        """Return whether a search of the whole map is due; if so, it counts as done."""
        return self._due("map", stamp_ns, self._config.map_period_s)

    def _due(self, which: str, stamp_ns: int, period_s: float) -> bool:
        last_ns = self._last_ns.get(which)
        due = last_ns is None or not 0 <= stamp_ns - last_ns < round(period_s * 1e9)
        if due:
            self._last_ns[which] = stamp_ns
        return due


def _first(candidates: Candidates, count: int) -> Candidates:
    """Return the first `count` candidates; their probabilities are those among all."""
    return dataclasses.replace(
        candidates,
        **{item.name: getattr(candidates, item.name)[:count] for item in dataclasses.fields(candidates)},
    )
