"""How the robot has moved between two scans: from samples of odometry, or from the scans themselves."""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from crossloc3d_ros.angles import wrap
from crossloc3d_ros.config import FusionConfig
from crossloc3d_ros.errors import ConfigError, PoseError
from crossloc3d_ros.localization.fusion.linear_algebra import why_no_covariance
from crossloc3d_ros.localization.inputs import check_stamp, float_array
from crossloc3d_ros.types import Float32Array, Float64Array

_KEPT_NS = 120_000_000_000  # no scan is localized later than that after it was taken
_TRANSFORMS = 2000  # ten seconds at 200 Hz, far more than a scan takes
_SCAN_GAP_S = 1.5  # scans farther apart than this share too little to be aligned with each other while driving
_LEAST_POINTS = 100  # of fewer, KISS-ICP aligns noise
_STAND_STILL_M = 0.01  # one sigma of a motion's position and, in radians, a tenth of it of its heading: never 0
_MOST_VARIANCE = 1e6  # of a kilometre, or of more than the circle
_FARTHEST_M = 1e8  # nothing drives so far from where its odometry began
_JITTER_S, _JITTER_M = 0.05, 0.05  # by which stamps and poses of a robot at top speed may be off


@dataclass(frozen=True, eq=False)
class Motion:
    """From one scan to the next, in the levelled base frame of the first."""

    delta: Float64Array
    """(3,) forward m, left m, turn rad counter-clockwise; zeros where unknown."""
    covariance: Float64Array
    """(3, 3) of the same: m2, m rad, rad2."""
    is_known: bool = True
    """False: the odometry reports nothing, or nothing plausible, of this time."""
    reason: str = ""
    """One sentence for people: why it is unknown."""

    def __post_init__(self) -> None:
        """Refuse, by PoseError, other shapes and what is no covariance; what is not finite is an unknown motion."""
        delta = float_array(self.delta, (3,), "the motion")
        covariance = float_array(self.covariance, (3, 3), "the covariance of a motion")
        why = why_no_covariance(covariance) if np.isfinite(covariance).all() else ""
        if why:
            raise PoseError(f"the covariance of a motion {why}: {np.round(covariance, 3).tolist()}")
        object.__setattr__(self, "delta", delta)
        object.__setattr__(self, "covariance", covariance)

    @property
    def distance_m(self) -> float:
        """Distance between the two positions, metres."""
        return float(np.hypot(*self.delta[:2]))


def unknown_motion(reason: str) -> Motion:
    """Return the motion of a time of which no odometry reports."""
    return Motion(np.zeros(3), np.zeros((3, 3)), is_known=False, reason=reason)


def plausible_motion(motion: Motion | None, elapsed_s: float, config: FusionConfig) -> Motion:
    """Return the motion, as unknown where it is missing, not finite or faster than the robot."""
    if motion is None:
        return unknown_motion("there is no odometry")
    if not motion.is_known:
        return motion
    if not (np.isfinite(motion.delta).all() and np.isfinite(motion.covariance).all()):
        return unknown_motion("the odometry is not a number")
    if np.diag(motion.covariance).max() > _MOST_VARIANCE:
        return unknown_motion("by its covariance the odometry knows nothing")
    if abs(float(motion.delta[2])) > 10.0 * (math.radians(config.max_turn_deg_per_s) * (elapsed_s + _JITTER_S) + 1.0):
        return unknown_motion(f"the odometry reports a turn of {motion.delta[2]:.3g} rad in {elapsed_s:.2g} s")
    if motion.distance_m > config.max_speed_mps * (elapsed_s + _JITTER_S) + _JITTER_M:
        return unknown_motion(
            f"the odometry reports {motion.distance_m:.3g} m in {elapsed_s:.2g} s, faster than the robot"
        )
    return motion


class OdometryBuffer:
    """Keep the samples of an odometry; return the motion between any two stamps, and the pose at a recent one."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self._stamps_ns: list[int] = []
        self._poses: list[tuple[float, float, float]] = []  # x, y, heading in the odometry's frame, levelled
        self._jumps: list[str] = []  # what is impossible in the step that ends at the sample; empty where nothing is
        self._transforms: deque[Float64Array] = deque(maxlen=_TRANSFORMS)  # the whole poses of the newest samples
        self._refused = ""

    def reconfigure(self, config: FusionConfig) -> None:
        """Use other settings from now on, for the samples that are there too."""
        self._config = config
        stamps, poses = self._stamps_ns, self._poses
        steps = zip(stamps, poses, stamps[1:], poses[1:], strict=False)
        self._jumps = ["", *(_impossible(*step, config) for step in steps)] if stamps else []

    def __len__(self) -> int:
        return len(self._stamps_ns)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample; None where there is none."""
        return self._stamps_ns[-1] if self._stamps_ns else None

    def is_late(self, stamp_ns: int) -> bool:
        """Return whether a sample of this stamp would be left out as late or repeated."""
        return bool(self._stamps_ns) and 0 <= self._stamps_ns[-1] - stamp_ns <= self._config.restart_s * 1e9

    def reset(self) -> None:
        """Forget all samples."""
        self._clear()

    def add(self, stamp_ns: int, T_odom_base: Float64Array) -> bool:
        """Take in one pose (4, 4) of the base, and return whether it can be used.

        Late and repeated samples and poses that are none are left out; a stamp that lies back by more than `restart_s`
        begins anew. PoseError for a stamp or numbers that are none.
        """
        check_stamp(stamp_ns, "the stamp of an odometry pose")
        transform = float_array(T_odom_base, None, "the pose of the odometry")
        pose = _planar(transform)
        if pose is None:
            self._refused = "the last pose of the odometry is not a pose"
            return False
        self._refused = ""
        if self.is_late(stamp_ns):
            return False
        if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
            self._clear()
        stamps, poses = self._stamps_ns, self._poses
        self._jumps.append(_impossible(stamps[-1], poses[-1], stamp_ns, pose, self._config) if stamps else "")
        stamps.append(stamp_ns)
        poses.append(pose)
        self._transforms.append(transform)
        if stamp_ns - stamps[0] > 2 * _KEPT_NS:
            old = bisect.bisect_left(stamps, stamp_ns - _KEPT_NS)
            del stamps[:old], poses[:old], self._jumps[:old]
        return True

    def motion(self, from_ns: int, to_ns: int) -> Motion:
        """Return how the base moved between two stamps, by interpolation.

        Beyond the newest sample it goes on as before for up to `odometry_max_gap_s`. Unknown where there are no
        samples, a gap, a jump that no robot drives, or time that goes backwards.
        """
        stamps, poses = self._stamps_ns, self._poses
        gap_ns = int(self._config.odometry_max_gap_s * 1e9)
        reason = self._why_unknown(from_ns, to_ns, gap_ns)
        if reason:
            return unknown_motion(reason)
        first, last = bisect.bisect_right(stamps, from_ns), bisect.bisect_left(stamps, to_ns)
        path = np.array([self._at(from_ns), *poses[first:last], self._at(to_ns)])
        steps = np.diff(path, axis=0)
        turns = wrap(steps[:, 2])
        heading = path[0, 2]
        east, north = path[-1, :2] - path[0, :2]
        cosine, sine = math.cos(heading), math.sin(heading)
        delta = np.array([cosine * east + sine * north, -sine * east + cosine * north, turns.sum()])
        length_m, turned_rad = float(np.hypot(steps[:, 0], steps[:, 1]).sum()), float(np.abs(turns).sum())
        return Motion(delta, motion_covariance(length_m, turned_rad, self._config))

    def pose_at(self, stamp_ns: int) -> Float64Array | None:
        """Return `T_odom_base` (4, 4) at a stamp: linear translation, spherical rotation between two samples.

        None beyond the samples of the last seconds, within a gap and within a jump.
        """
        after = bisect.bisect_left(self._stamps_ns, stamp_ns)
        newest = after - len(self._stamps_ns) + len(self._transforms)  # row among the whole poses
        if after == len(self._stamps_ns) or newest < 0:
            return None
        end_ns, T_end = self._stamps_ns[after], self._transforms[newest]
        if end_ns == stamp_ns:
            return T_end
        if newest == 0:
            return None
        begin_ns, T_begin = self._stamps_ns[after - 1], self._transforms[newest - 1]
        if not self.motion(begin_ns, end_ns).is_known:
            return None
        share = (stamp_ns - begin_ns) / (end_ns - begin_ns)
        T = np.eye(4)
        T[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix([T_begin[:3, :3], T_end[:3, :3]]))(share).as_matrix()
        T[:3, 3] = T_begin[:3, 3] + share * (T_end[:3, 3] - T_begin[:3, 3])
        return T

    def _clear(self) -> None:
        self._stamps_ns, self._poses, self._jumps = [], [], []
        self._transforms.clear()

    def _why_unknown(self, from_ns: int, to_ns: int, gap_ns: int) -> str:
        stamps = self._stamps_ns
        if to_ns < from_ns:
            return f"time goes backwards by {(from_ns - to_ns) * 1e-9:.2g} s"
        if not stamps:
            return self._refused or "there is no odometry"
        if from_ns < stamps[0]:
            return f"the odometry begins {(stamps[0] - from_ns) * 1e-9:.2g} s after the last scan"
        if to_ns > stamps[-1] + gap_ns:
            return self._refused or f"the odometry has stopped {(to_ns - stamps[-1]) * 1e-9:.2g} s before the scan"
        # Every step that the time touches, from the sample at or before its begin to the one at or after its end.
        begin = bisect.bisect_right(stamps, from_ns) - 1
        end = min(bisect.bisect_left(stamps, to_ns), len(stamps) - 1)
        steps = np.diff(stamps[begin : end + 1])
        if len(steps) and steps.max() > gap_ns:
            return f"the odometry has a gap of {steps.max() * 1e-9:.2g} s"
        return next((jump for jump in self._jumps[begin + 1 : end + 1] if jump), "")

    def _at(self, stamp_ns: int) -> tuple[float, float, float]:
        """Return the pose at a stamp: between two samples, or beyond the newest as between the last two."""
        stamps, poses = self._stamps_ns, self._poses
        after = bisect.bisect_left(stamps, stamp_ns)
        if after < len(stamps) and stamps[after] == stamp_ns:
            return poses[after]
        if after == len(stamps):
            if len(stamps) == 1 or stamps[-1] - stamps[-2] > self._config.odometry_max_gap_s * 1e9 or self._jumps[-1]:
                return poses[-1]
            after -= 1
        (x0, y0, heading0), (x1, y1, heading1) = poses[after - 1], poses[after]
        share = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
        turn = float(wrap(heading1 - heading0))
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0), heading0 + share * turn


class ScanOdometry:
    """Odometry from scan to scan, by KISS-ICP (Vizzo et al., RA-L 2023), for a robot that has no other."""

    def __init__(self, config: FusionConfig, max_range_m: float = 100.0) -> None:
        """Set up KISS-ICP; ConfigError where the library is not installed."""
        self._max_range_m = max_range_m
        self._odometry = _kiss_icp(max_range_m)
        self._gap_s = max(config.odometry_max_gap_s, _SCAN_GAP_S)
        self._buffer = OdometryBuffer(dataclasses.replace(config, odometry_max_gap_s=self._gap_s))

    def reset(self) -> None:
        """Forget the scans seen so far."""
        self._odometry = _kiss_icp(self._max_range_m)
        self._buffer.reset()

    def reconfigure(self, config: FusionConfig, max_range_m: float) -> None:
        """Use other settings from now on; another range begins a new odometry after the next scan."""
        self._gap_s = max(config.odometry_max_gap_s, _SCAN_GAP_S)
        self._buffer.reconfigure(dataclasses.replace(config, odometry_max_gap_s=self._gap_s))
        if max_range_m != self._max_range_m:
            self._max_range_m = max_range_m
            self.reset()

    def add(self, stamp_ns: int, points: Float32Array | Float64Array) -> bool:
        """Take in one scan (N, 3), metres, base frame, and return whether it can be used.

        Late and repeated scans and those of fewer than a hundred points cannot; a stamp that lies back by more than
        `restart_s` begins anew.
        """
        finite = np.asarray(points, dtype=np.float64)
        finite = finite[np.isfinite(finite).all(axis=1)]
        if len(finite) < _LEAST_POINTS or self._buffer.is_late(stamp_ns):
            return False
        newest_ns = self._buffer.newest_ns
        if newest_ns is not None and not 0 < stamp_ns - newest_ns <= self._gap_s * 1e9:
            # Too far from the last scan to be aligned with it: a new odometry, which the gap keeps from the old one.
            self._odometry = _kiss_icp(self._max_range_m)
        self._odometry.register_frame(np.ascontiguousarray(finite), np.empty(0))
        return self._buffer.add(stamp_ns, np.asarray(self._odometry.last_pose))

    def motion(self, from_ns: int, to_ns: int) -> Motion:
        """Return how the base moved between the stamps of two scans."""
        return self._buffer.motion(from_ns, to_ns)


def _impossible(
    begin_ns: int,
    begin: tuple[float, float, float],
    end_ns: int,
    end: tuple[float, float, float],
    config: FusionConfig,
) -> str:
    """Return what no robot does between two samples; empty where the step is possible."""
    # A burst of samples with the jitter of its stamps is no jump: a hundredth of a second is granted.
    elapsed_s = (end_ns - begin_ns) * 1e-9 + 0.01
    moved_m = math.hypot(end[0] - begin[0], end[1] - begin[1])
    turned_deg = abs(math.degrees(wrap(end[2] - begin[2])))
    if moved_m > config.max_speed_mps * elapsed_s + 0.05:
        return f"the odometry jumps by {moved_m:.2g} m in {elapsed_s:.2g} s"
    if turned_deg > config.max_turn_deg_per_s * elapsed_s + 1.0:
        return f"the odometry jumps by {turned_deg:.0f} degrees in {elapsed_s:.2g} s"
    return ""


def motion_covariance(length_m: float, turned_rad: float, config: FusionConfig) -> Float64Array:
    """Return the covariance (3, 3) of a motion over a distance of `length_m` with turns of `turned_rad` in all."""
    position = (config.odometry_relative_std * length_m) ** 2 + _STAND_STILL_M**2
    drift = math.radians(config.odometry_drift_deg_per_m) * length_m
    heading = (config.odometry_relative_std * turned_rad) ** 2 + drift**2 + (0.1 * _STAND_STILL_M) ** 2
    return np.diag([position, position, heading])


def planar_pose(x_m: float, y_m: float, heading_rad: float) -> Float64Array:
    """Return the pose (4, 4) of a base on level ground, as `OdometryBuffer.add` takes it."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)


def _planar(T_odom_base: Float64Array) -> tuple[float, float, float] | None:
    """Return x, y and heading of a pose; None where the matrix (4, 4) is no pose, or stands on its nose."""
    if T_odom_base.shape != (4, 4) or not (np.abs(T_odom_base) < _FARTHEST_M).all():
        return None
    rotation = T_odom_base[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or math.hypot(rotation[0, 0], rotation[1, 0]) < 0.1:
        return None
    return float(T_odom_base[0, 3]), float(T_odom_base[1, 3]), math.atan2(rotation[1, 0], rotation[0, 0])


def require_kiss_icp() -> None:
    """Raise ConfigError where KISS-ICP, which odometry from scan to scan needs, is not installed."""
    _kiss_icp(100.0)


def _kiss_icp(max_range_m: float) -> Any:
    try:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP
    except ImportError as error:
        raise ConfigError(
            "odometry from scan to scan needs the library KISS-ICP: pip install 'crossloc3d_ros[odometry]'"
        ) from error
    settings = load_config(None)
    settings.data.max_range = max_range_m
    settings.data.deskew = False  # the points carry no times
    settings.mapping.voxel_size = max_range_m / 100.0
    settings.registration.max_num_threads = 1
    return KissICP(settings)
