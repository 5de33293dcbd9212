"""The localizer node with a localizer that finds places and makes up the rest, so that the node alone is tested.

Run as a program, it is the command `localizer` but for that. What the node hands over comes back in the reasons. With
STANDIN_TF2 set it also has a tf2_ros, which the package index lacks: transforms that are sent go to /tf_sent, and the
frames `odom_far` and `velodyne` are known.
"""

from __future__ import annotations

import math
import os
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli import common
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.localization.localizer import no_estimate
from crossloc3d_ros.localization.retrieval.candidates import encode_query, retrieve
from crossloc3d_ros.localization.retrieval.place_belief import effective_calibration
from crossloc3d_ros.types import WHOLE_MAP, AlignedPoses, Estimate, FixStatus, Hypotheses, Scan, TrackState

HEADING_RAD = 0.5
"""Of every pose that it makes up, from grid east."""
OFFSET_M = np.array([3.0, -2.0, 0.0])
"""From a candidate to where the stand-in aligns the scan around it."""
MIN_PROBABILITY = 0.7


class StandIn:
    """Retrieval, and poses that are made up."""

    def __init__(self, aerial_map: AerialMap, encoder: Any, config: LocalizerNodeConfig) -> None:
        self.aerial_map, self.encoder, self.config = aerial_map, encoder, config
        self.calibration = effective_calibration(config.retrieval, encoder)
        self.calibration_words = ""
        self.prior: Any = None
        self.resets = 0
        self.stamp_ns: int | None = None

    def warm_up(self) -> None:
        self.encoder.warm_up()
        self.localize(Scan(np.zeros((1000, 3), np.float32), 0, "warm_up"))

    def reset(self) -> None:
        self.prior = self.stamp_ns = None
        self.resets += 1

    def reconfigure(self, config: LocalizerNodeConfig) -> None:
        self.config = config
        self.calibration = effective_calibration(config.retrieval, self.encoder)

    def set_prior(self, prior: Any) -> None:
        self.prior = prior

    def localize(self, scan: Scan, gravity_base: Any = None, T_base_lidar: Any = None, motion: Any = None) -> Estimate:
        motion = motion() if callable(motion) else motion
        if scan.frame_id == "slow":
            time.sleep(5.0)
        prepared = prepare_scan(scan, self.config.scan, self.encoder.preprocessing, gravity_base, T_base_lidar)
        if prepared.patch is None:
            return no_estimate(scan.stamp_ns, prepared.reason, prepared.counts)
        descriptors = encode_query(self.encoder, prepared.patch.points)
        candidates = retrieve(descriptors, self.aerial_map, self.config.top_k, self.calibration)
        self.stamp_ns = scan.stamp_ns
        probability = float(candidates.probabilities[0])
        is_fix = probability >= MIN_PROBABILITY
        frame = self.aerial_map.frame
        grid = candidates.grid + OFFSET_M
        k = len(grid)
        covariance = np.tile(np.diag([0.04, 0.09, 0.0001]), (k, 1, 1))
        heading = np.full(k, HEADING_RAD)
        likelihood = np.log(np.maximum(candidates.probabilities, 1e-12))
        every = np.ones(k, bool)
        # Two of them fit around the first candidate, none around the last; one was found without any.
        source = np.arange(k) - 1
        source[0], source[1] = 0, WHOLE_MAP
        aligned = AlignedPoses(
            grid, heading, covariance, likelihood, candidates.probabilities, np.ones(k), every, source
        )
        hypotheses = Hypotheses(grid[:2], heading[:2], covariance[:2], np.array([0.9, 0.06]))
        enu = frame.to_enu(grid[:1])[0]
        forward = np.array([[math.cos(HEADING_RAD), math.sin(HEADING_RAD), 0.0]])
        ahead = frame.to_enu(grid[:1] + forward)[0] - enu
        yaw = math.atan2(ahead[1], ahead[0])
        T = np.eye(4)
        T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        T[:3, 3] = enu
        latitude, longitude, altitude = frame.to_geographic(grid[:1])
        pose_covariance = np.diag([0.04, 0.09, 0.25, 0.001, 0.002, 0.0001])
        return Estimate(
            stamp_ns=scan.stamp_ns,
            status=FixStatus.FIX if is_fix else FixStatus.NO_FIX,
            reason=f"probability {probability:.0%}; {self._motion_text(motion)}",
            grid=grid[0],
            enu=enu,
            latitude_deg=float(latitude[0]),
            longitude_deg=float(longitude[0]),
            altitude_m=float(altitude[0]),
            covariance=pose_covariance[:3, :3],
            candidates=candidates,
            counts=prepared.counts,
            state=TrackState.LOCALIZED if is_fix else TrackState.AMBIGUOUS,
            probability=probability,
            T_map_base=T,
            pose_covariance=pose_covariance,
            aligned=aligned,
            hypotheses=hypotheses,
        )

    def _motion_text(self, motion: Any) -> str:
        parts = [f"resets {self.resets}"]
        if motion is None:
            parts.append("no motion")
        elif motion.is_known:
            forward, left, turn = motion.delta
            parts.append(f"moved {forward:.2f} {left:.2f} {turn:.3f}")
        else:
            parts.append(f"unknown motion ({motion.reason})")
        if self.prior is not None:
            place = "nowhere" if self.prior.grid is None else "{:.1f} {:.1f}".format(*self.prior.grid[:2])
            heading = "nowhere" if self.prior.heading_rad is None else f"{self.prior.heading_rad:.3f}"
            deviations = " ".join(f"{v:.3f}" for v in np.sqrt(np.diag(self.prior.covariance)))
            parts.append(f"prior at {place} to {heading} give or take {deviations}")
        return ", ".join(parts)


def load_stand_in(config: LocalizerNodeConfig) -> Any:
    from crossloc3d_ros.encoder.checkpoint import load_encoder

    encoder = load_encoder(Path(config.weights), threads=1)
    return StandIn(AerialMap.load(Path(config.map), encoder.fingerprint), encoder, config)


def install_tf2() -> None:
    """Put a tf2_ros in place with two frames that publishes to a topic a test can subscribe to."""
    from geometry_msgs.msg import TransformStamped

    known = {("map", "odom_far"): ((100.0, 50.0, 0.0), math.pi / 2), ("base_link", "velodyne"): ((0.0, 0.0, 1.2), 0.0),
             ("base_link", "elsewhere"): ((0.0, 0.0, 3.0), math.pi / 2)}  # fmt: skip
    tf2_ros: Any = types.ModuleType("tf2_ros")

    class TransformException(Exception):  # noqa: N818 - tf2's own name
        pass

    class Buffer:
        def lookup_transform(self, target: str, source: str, when: object) -> TransformStamped:
            if (target, source) not in known:
                raise TransformException(f'"{source}" passed to lookupTransform argument source_frame does not exist')
            (x, y, z), yaw = known[target, source]
            stamped = TransformStamped()
            translation, rotation = stamped.transform.translation, stamped.transform.rotation
            translation.x, translation.y, translation.z = x, y, z
            rotation.z, rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
            return stamped

    class TransformListener:
        def __init__(self, buffer: Buffer, node: object, *, spin_thread: bool) -> None:
            assert not spin_thread, "the node's executor does the spinning"

        def unregister(self) -> None:
            pass

    class TransformBroadcaster:
        def __init__(self, node: Any) -> None:
            self.pub_tf = node.create_publisher(TransformStamped, "/tf_sent", 100)

        def sendTransform(self, transform: TransformStamped) -> None:  # noqa: N802 - tf2's own name
            self.pub_tf.publish(transform)

    for part in (TransformException, Buffer, TransformListener, TransformBroadcaster):
        setattr(tf2_ros, part.__name__, part)
    sys.modules["tf2_ros"] = tf2_ros


def main() -> int:
    from crossloc3d_ros.ros.process import run_localizer

    if os.environ.get("STANDIN_TF2"):
        install_tf2()
    return common.run(lambda: run_localizer(sys.argv[1:], load_stand_in))


if __name__ == "__main__":
    sys.exit(main())
