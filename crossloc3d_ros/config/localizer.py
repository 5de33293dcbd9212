"""From a scan to an estimate: the settings of the localizer and of its node."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Literal

from crossloc3d_ros.config.settings import option
from crossloc3d_ros.errors import ConfigError

_MOST_THREADS = 4  # more gain nothing for a single scan


@dataclass(frozen=True)
class MountingConfig:
    """Pose of the lidar on the robot, `T_base_lidar`; `base` stands on the ground."""

    x_m: float = option(0.0, "forward of the base frame", low=-20.0, high=20.0)
    y_m: float = option(0.0, "left of the base frame", low=-20.0, high=20.0)
    z_m: float = option(1.2, "above the base frame, which stands on the ground", low=-5.0, high=20.0)
    roll_deg: float = option(0.0, "about x", low=-180.0, high=180.0)
    pitch_deg: float = option(0.0, "about y, positive nose down (REP-103)", low=-180.0, high=180.0)
    yaw_deg: float = option(0.0, "about z, counter-clockwise", low=-180.0, high=180.0)


@dataclass(frozen=True)
class ScanConfig:
    """Which points of a scan are used."""

    min_range_m: float = option(1.0, "points nearer to the lidar are removed", low=0.0, high=100.0)
    max_range_m: float = option(100.0, "points farther from the lidar are removed", low=1.0, high=1000.0)
    body_min_m: tuple[float, float, float] = option(
        (-0.6, -0.5, -0.5),
        "lower corner of the robot's body in the base frame; points inside are removed",
        low=-50.0,
        high=50.0,
    )
    body_max_m: tuple[float, float, float] = option(
        (0.6, 0.5, 2.0), "upper corner of the robot's body; equal corners = no body", low=-50.0, high=50.0
    )
    period_s: float = option(0.1, "duration of one revolution of the lidar", low=0.0, high=10.0)
    stamped_at: float = option(
        1.0, "moment of the revolution that the stamp gives: 0 = its start, 1 = its end", low=0.0, high=1.0
    )
    mounting: MountingConfig = field(
        default_factory=MountingConfig, metadata={"text": "pose of the lidar in the base frame"}
    )
    deskew: Literal["auto", "off"] = option(
        "auto",
        "motion within a revolution: taken out where the points carry times and odometry tells the motion, or left in",
    )

    def __post_init__(self) -> None:
        """Refuse what no point could pass."""
        if self.min_range_m >= self.max_range_m:
            raise ConfigError(f"'min_range_m' ({self.min_range_m}) must be below 'max_range_m' ({self.max_range_m})")
        if any(low > high for low, high in zip(self.body_min_m, self.body_max_m, strict=True)):
            raise ConfigError(f"'body_min_m' {self.body_min_m} must not exceed 'body_max_m' {self.body_max_m}")


@dataclass(frozen=True)
class RetrievalConfig:
    """From the candidates' distances and spread to probabilities, a covariance and the decision to give a fix."""

    temperature: float = option(0.0, "temperature in place of the weights' calibration; 0 = theirs", low=0.0, high=1e6)
    null_distance: float = option(
        0.0, "null_distance in place of the weights' calibration; 0 = theirs", low=0.0, high=1e6
    )
    null_scale: float = option(0.0, "null_scale in place of the weights' calibration; 0 = theirs", low=0.0, high=1e6)
    cluster_radius_m: float = option(
        50.0, "candidates within this distance of each other are one place", low=1.0, high=1000.0
    )
    min_probability: float = option(
        0.7, "with alignment.scope none: probability of one place that a fix needs", low=0.0, high=1.0
    )
    min_std_m: float = option(
        25.0, "with alignment.scope none: least standard deviation east and north", low=0.1, high=1000.0
    )
    min_height_std_m: float = option(
        3.0, "with alignment.scope none: least standard deviation of the height", low=0.1, high=1000.0
    )


@dataclass(frozen=True)
class AlignmentConfig:
    """From places to poses."""

    scope: Literal["candidates", "map", "auto", "none"] = option(
        "auto",
        "where poses are searched: around the candidates, on the whole map, both if it is small, or nowhere",
    )
    map_max_km2: float = option(6.0, "largest map that auto searches as a whole", low=0.0, high=1e6)
    map_period_s: float = option(3.0, "least time between two searches of the whole map", low=0.0, high=1e6)
    sufficient_probability: float = option(
        0.9, "auto does not search the whole map if a pose has this probability", low=0.0, high=1.0
    )
    candidates_period_s: float = option(
        0.45, "least time between two searches around the candidates while not localized", low=0.0, high=1e6
    )
    candidates_period_localized_s: float = option(
        1.0, "least time between two searches around the candidates while localized", low=0.0, high=1e6
    )
    candidates: int = option(100, "candidates around which poses are searched", low=1, high=10_000)
    candidate_radius_m: float = option(22.0, "radius of the search around a candidate", low=1.0, high=200.0)
    hypothesis_radius_m: float = option(
        6.0, "radius of the search around the predicted pose of a hypothesis", low=0.5, high=50.0
    )
    coarse_maxima: int = option(
        64,
        "maxima of the coarse search that are refined; four times as many on the whole map",
        low=1,
        high=1000,
    )
    fine_maxima: int = option(
        16, "of these, maxima refined in the finest cells; twice as many on the whole map", low=1, high=1000
    )
    descriptor_weight: float = option(
        0.5, "weight of the descriptors' log likelihood ratio beside the alignment's", low=0.0, high=10.0
    )
    local_map_m: float = option(
        30.0,
        "scans of the last metres that are aligned together, along odometry; 0 = each scan by itself",
        low=0.0,
        high=200.0,
    )
    min_cells: int = option(100, "a scan with evidence in fewer cells is not aligned", low=1, high=100_000)
    use_calibration: bool = option(
        True, "shift log likelihoods by the offset that calibrate_map left in the map's folder, where there is one"
    )
    place_m2: float = option(
        100.0, "area of one place: its share of the map's area is the prior of a pose", low=0.01, high=1e6
    )
    covariance_temperature: float = option(
        20.0, "score difference that changes the probability by a factor e, for the covariance", low=0.01
    )


@dataclass(frozen=True)
class FusionConfig:
    """From the aligned poses of successive scans and odometry to one pose with a probability."""

    min_probability: float = option(
        0.999, "probability of a horizontal error below 10 m that a fix needs", low=0.5, high=1.0
    )
    confirm_m: float = option(
        10.0, "distance over which the pose of a fix must have explained the scans", low=0.0, high=1000.0
    )
    max_hypotheses: int = option(10, "largest number of hypotheses", low=1, high=1000)
    novelty_m: float = option(
        10.0, "distance travelled over which a scan becomes independent of those before", low=0.1, high=1000.0
    )
    likelihood_weight: float = option(1.0, "factor on the log likelihoods of scans", low=0.01, high=10.0)
    max_log_likelihood: float = option(20.0, "largest log likelihood ratio of one scan", low=1.0, high=1000.0)
    null_log_likelihood: float = option(
        9.0,
        "log likelihood ratio that a wrong hypothesis may reach scan after scan: only what is above counts for one",
        low=0.0,
        high=100.0,
    )
    clutter_probability: float = option(
        0.05, "probability that a scan carries no information on the pose", low=1e-6, high=0.9
    )
    detection_probability: float = option(
        0.9, "probability that the true pose is among the aligned ones, if it is on the map", low=0.01, high=0.999
    )
    kidnapping_per_s: float = option(1e-4, "rate of unnoticed kidnapping", low=1e-9, high=1.0)
    initial_pose_probability: float = option(
        0.9, "probability of a pose given on the topic initialpose", low=0.01, high=0.999
    )
    measurement_std_scale: float = option(
        1.5, "factor on the standard deviations of aligned poses", low=0.1, high=100.0
    )
    measurement_error_correlation: float = option(
        0.3, "share of the variance of an aligned pose that is correlated with the next one", low=0.0, high=0.99
    )
    measurement_correlation_m: float = option(
        15.0, "distance travelled over which that correlation decays", low=0.1, high=1000.0
    )
    measurement_min_std_m: float = option(
        0.2, "least standard deviation of the position of an aligned pose", low=0.01, high=10.0
    )
    measurement_min_std_deg: float = option(
        0.4, "least standard deviation of the heading of an aligned pose", low=0.01, high=10.0
    )
    map_std_m: float = option(0.23, "standard deviation of the map's constant error in position", low=0.0, high=10.0)
    map_std_deg: float = option(0.2, "standard deviation of the map's constant error in heading", low=0.0, high=10.0)
    odometry_relative_std: float = option(
        0.05, "standard deviation of the odometry relative to distance and rotation", low=1e-4, high=1.0
    )
    odometry_drift_deg_per_m: float = option(
        0.3, "standard deviation of the odometry's heading drift per metre", low=0.0, high=45.0
    )
    odometry_max_gap_s: float = option(
        0.5, "a longer gap between odometry samples makes the motion unknown", low=0.01, high=60.0
    )
    slip_std_m: float = option(1.0, "standard deviation of a slip of the odometry", low=0.01, high=100.0)
    slip_probability: float = option(1e-3, "probability of a slip between two scans", low=0.0, high=0.5)
    max_speed_mps: float = option(10.0, "largest speed of the robot", low=0.1, high=200.0)
    max_turn_deg_per_s: float = option(120.0, "largest turn rate of the robot", low=1.0, high=10_000.0)
    unknown_motion_decay_s: float = option(
        10.0, "time of unknown motion after which hypotheses keep 1/e of their probability", low=0.1, high=1e5
    )
    restart_s: float = option(
        3.0, "a stamp earlier than the last by more is a new recording: hypotheses are discarded", low=0.0, high=1e5
    )


@dataclass(frozen=True)
class LocalizerConfig:
    """From a scan to an estimate."""

    top_k: int = option(25, "number of candidates to report", low=1, high=1000)
    scan: ScanConfig = field(default_factory=ScanConfig, metadata={"text": "points of a scan that are used"})
    retrieval: RetrievalConfig = field(
        default_factory=RetrievalConfig, metadata={"text": "from descriptor distances to probabilities"}
    )
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig, metadata={"text": "from places to poses"})
    fusion: FusionConfig = field(default_factory=FusionConfig, metadata={"text": "hypotheses over time, with odometry"})


@dataclass(frozen=True)
class LocalizerNodeConfig(LocalizerConfig):
    """The localizer node's parameters: the localizer's own and what only a node needs."""

    map: str = option("", "folder of the aerial map, as build_map writes it")
    weights: str = option("", "weights file (safetensors); empty = the shipped weights")
    device: Literal["cpu", "cuda"] = option("cpu", "where the encoder runs")
    threads: int = option(0, "CPU threads of encoder and alignment; 0 = one per core, at most four", low=0, high=64)
    queue_depth: int = option(
        4,
        "scans that may wait; when more arrive, all but the newest are dropped",
        low=1,
        high=100,
    )
    stall_s: float = option(5.0, "a scan that takes longer is reported as an error", low=0.1, high=3600.0)
    autostart: bool = option(True, "configure and activate without a lifecycle manager")
    global_frame_id: str = option("map", "ENU frame at the origin of the map")
    base_frame_id: str = option("base_link", "frame of the robot whose pose is reported; it stands on the ground")
    odom_frame_id: str = option("", "frame of the odometry; empty = as its messages name it")
    mounting_from_tf: bool = option(
        False, "take the pose of the lidar on base_frame_id from TF instead of scan.mounting"
    )
    use_imu: bool = option(
        False, "level scans by the accelerations on the topic imu (axes of base_frame_id, or TF with mounting_from_tf)"
    )
    imu_time_constant_s: float = option(
        1.0, "time constant of the low-pass filter on the accelerations", low=0.01, high=60.0
    )
    use_imu_heading: bool = option(
        False, "use the orientation on the topic imu (ENU, REP-145) as a prior of the heading while not localized"
    )
    imu_heading_std_deg: float = option(15.0, "standard deviation of that heading", low=1.0, high=180.0)
    imu_heading_offset_deg: float = option(
        0.0, "added to that heading, counter-clockwise, such as minus the magnetic declination", low=-360.0, high=360.0
    )
    odometry: Literal["topic", "scan", "none"] = option(
        "topic",
        "source of the robot's motion: the topic odom, KISS-ICP on the scans (extra 'odometry'), or none: no fix",
    )
    odometry_timeout_s: float = option(0.02, "time that a scan waits for the odometry of its stamp", low=0.0, high=1.0)
    tf_broadcast: bool = option(
        False, "publish global_frame_id -> frame of the odometry on /tf while localized (REP-105)"
    )
    transform_tolerance: float = option(
        0.2, "time by which that transform is stamped ahead of its scan", low=0.0, high=10.0
    )

    def __post_init__(self) -> None:
        """Refuse frames that tf2 does not know."""
        for name in ("global_frame_id", "base_frame_id", "odom_frame_id"):
            frame = getattr(self, name)
            if frame.startswith("/"):
                raise ConfigError(f"'{name}' must not begin with a slash, which tf2 refuses: set '{frame.lstrip('/')}'")


def usable_threads() -> int:
    """Return how many threads work on one scan by default: as many as this process may use cores, at most four."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _MOST_THREADS)
