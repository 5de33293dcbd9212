"""Where the robot is, from the aligned poses of scan after scan and the odometry between them.

Multi-hypothesis localization: a Gaussian mixture over the poses that the robot may have, beside the null hypothesis
that it has none of them. Each scan: move every hypothesis by odometry (`predict`), branch it over the aligned poses
that it explains and correct it by each (`update`), let aligned poses that no hypothesis explains be born out of the
null hypothesis, merge, prune.

Three things keep the belief honest. A scan is new information only as far as the robot drove on since the last: the
scans of one spot count once, by their mean. The errors of aligned poses are correlated over some metres: each
hypothesis carries the error that they have in common as part of its state. And the robot may be kidnapped at any time,
unnoticed by its odometry.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.localization.fusion.association import births, branch, measurements, was_searched
from crossloc3d_ros.localization.fusion.decision import Belief, FixDecision, no_belief
from crossloc3d_ros.localization.fusion.filter import predict, predict_unknown
from crossloc3d_ros.localization.fusion.linear_algebra import diagonal
from crossloc3d_ros.localization.fusion.mixture import POSITION, merge, no_mixture
from crossloc3d_ros.localization.fusion.null_hypothesis import NullHypothesis, complement, normalize
from crossloc3d_ros.localization.fusion.odometry import Motion, plausible_motion, unknown_motion
from crossloc3d_ros.localization.fusion.priors import LARGEST_STD_M, PosePrior, Priors
from crossloc3d_ros.localization.inputs import check_stamp
from crossloc3d_ros.types import AlignedPoses, Hypotheses, TrackState


class Tracker:
    """Fuse aligned poses and odometry into one belief, starting from nothing, recovering from anything."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self.reset()

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the last scan that counted, where the next motion has to begin; None before the first."""
        return self._stamp_ns

    @property
    def skips(self) -> bool:
        """Whether the scan given to `predict` changes nothing: it is late, or a repeated one."""
        return bool(self._skipped)

    @property
    def motion(self) -> Motion:
        """The motion that the last `predict` took for plausible; unknown where there was none."""
        return self._motion

    def reconfigure(self, config: FusionConfig) -> None:
        """Use other settings from the next scan on; the hypotheses are kept."""
        self._config = config

    def reset(self) -> None:
        """Forget everything."""
        self._stamp_ns: int | None = None
        self._mixture = no_mixture(self._config)
        self._null = NullHypothesis()
        self._priors = Priors()
        self._decision = FixDecision()
        self._motion = unknown_motion("no scan yet")
        self._travelled_m: float | None = None  # distance since the last update; None = unknown
        self._skipped = ""
        self._belief = no_belief(TrackState.SEARCHING, "no scan yet")

    def set_prior(self, prior: PosePrior) -> None:
        """Take in what is known of the pose from outside; it counts from the next scan on.

        A position (with or without a heading) becomes a hypothesis of `initial_pose_probability`. A heading alone makes
        hypotheses and aligned poses of other headings less likely.
        """
        self._priors.add(prior)

    def predict(self, stamp_ns: int, motion: Motion | None) -> Hypotheses:
        """Move the belief to the stamp of a scan, and return where to align it.

        `motion` leads from the last scan that counted (`stamp_ns` of this object) to this one; None = unknown. A
        repeated or late stamp changes nothing; one that lies back by more than `restart_s` forgets everything.
        PoseError for what is no stamp.
        """
        check_stamp(stamp_ns, "the stamp of a scan")
        self._skipped = ""
        if self._stamp_ns is not None:
            elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
            if elapsed_s > 0.0:
                self._move(plausible_motion(motion, elapsed_s, self._config), elapsed_s)
            elif -elapsed_s > self._config.restart_s:
                priors = self._priors
                self.reset()
                self._priors = priors
            else:
                late = f"the scan is {-elapsed_s:.2g} s older than one before it"
                self._skipped = late if elapsed_s < 0.0 else "the scan has the same stamp as the one before it"
                return self._mixture.as_hypotheses()
        self._stamp_ns = stamp_ns
        self._take_in_initial_poses(stamp_ns)
        self._mixture = self._mixture.by_weight()
        return self._mixture.as_hypotheses()

    def update(self, aligned: AlignedPoses) -> Belief:
        """Weigh the hypotheses by how the scan fits at them, correct them, let new ones be born, and decide.

        `aligned` holds the poses found around the candidates and around the hypotheses that `predict` returned.
        """
        if self._skipped:
            return dataclasses.replace(self._belief, reason=self._skipped, is_fix=False)
        config = self._config
        travelled_m = self._travelled_m or 0.0
        novelty = -math.expm1(-travelled_m / config.novelty_m)  # after unknown motion, none is granted
        poses = measurements(aligned, config)
        compass = self._priors.log_likelihood_ratio(poses.heading_rad, self._stamp_ns)
        poses = dataclasses.replace(poses, log_likelihood=poses.log_likelihood + compass)
        branches = branch(self._mixture, poses, novelty, travelled_m, config)
        # A kidnapped robot sees a new place: its scan is new information as a whole.
        log_kidnapped = self._null.log_kidnapped(branches.log_unseen)
        log_undetected = float(np.logaddexp(self._null.log_undetected, log_kidnapped))
        born = births(poses, log_undetected, aligned.log_prior, branches, config)
        null = self._null.update(log_kidnapped, novelty, was_searched(aligned), config)
        mixture, null = normalize(branches.mixture.join(born), null)
        self._mixture = merge(mixture, config.max_hypotheses)
        self._null = complement(self._mixture, null)
        self._travelled_m = 0.0
        self._belief = self._decision.decide(self._mixture, self._null, config)
        return self._belief

    def _move(self, motion: Motion, elapsed_s: float) -> None:
        self._motion = motion
        self._decision.add_motion(motion)
        self._null = self._null.predict(elapsed_s, motion.is_known, self._config)
        if motion.is_known:
            self._mixture = predict(self._mixture, motion, self._config)
            if self._travelled_m is not None:
                self._travelled_m += motion.distance_m
            return
        self._mixture = predict_unknown(self._mixture, elapsed_s, self._config)
        self._travelled_m = None
        wide = diagonal(self._mixture.covariance)[:, POSITION].max(axis=1, initial=0.0) > LARGEST_STD_M**2
        if wide.any():
            self._null = self._null.absorb(self._mixture.log_weight[wide])
            self._mixture = self._mixture.take(~wide)

    def _take_in_initial_poses(self, stamp_ns: int) -> None:
        log_rest = math.log1p(-self._config.initial_pose_probability)
        for given in self._priors.take_poses(stamp_ns, self._travelled_m or 0.0, self._config):
            self._null = self._null.scaled(log_rest)
            self._mixture = self._mixture.scaled(log_rest).join(given)
            self._decision.add_initial_pose()
