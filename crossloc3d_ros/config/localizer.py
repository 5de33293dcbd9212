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

    x_m: float = option(0.0, "forward of base", low=-20.0, high=20.0)
    y_m: float = option(0.0, "left of base", low=-20.0, high=20.0)
    z_m: float = option(1.2, "above the ground under the robot", low=-5.0, high=20.0)
    roll_deg: float = option(0.0, "about x", low=-180.0, high=180.0)
    pitch_deg: float = option(0.0, "about y, positive nose down (REP-103)", low=-180.0, high=180.0)
    yaw_deg: float = option(0.0, "about z, counter-clockwise", low=-180.0, high=180.0)


@dataclass(frozen=True)
class ScanConfig:
    """Which points of a scan are used."""

    min_range_m: float = option(1.0, "nearer points are left out", low=0.0, high=100.0)
    max_range_m: float = option(100.0, "farther points are left out", low=1.0, high=1000.0)
    body_min_m: tuple[float, float, float] = option(
        (-0.6, -0.5, -0.5), "lower corner of the body, base frame", low=-50.0, high=50.0
    )
    body_max_m: tuple[float, float, float] = option(
        (0.6, 0.5, 2.0), "upper corner; equal = no body", low=-50.0, high=50.0
    )
    period_s: float = option(0.1, "time of one turn of the lidar", low=0.0, high=10.0)
    stamped_at: float = option(1.0, "what the stamp tells: 0 = the turn's start, 1 = its end", low=0.0, high=1.0)
    mounting: MountingConfig = field(default_factory=MountingConfig, metadata={"text": "pose of the lidar"})

    def __post_init__(self) -> None:
        """Refuse what no point could pass."""
        if self.min_range_m >= self.max_range_m:
            raise ConfigError(f"'min_range_m' ({self.min_range_m}) must be below 'max_range_m' ({self.max_range_m})")
        if any(low > high for low, high in zip(self.body_min_m, self.body_max_m, strict=True)):
            raise ConfigError(f"'body_min_m' {self.body_min_m} must not exceed 'body_max_m' {self.body_max_m}")


@dataclass(frozen=True)
class RetrievalConfig:
    """From the candidates' distances and spread to probabilities, a covariance and the decision to give a fix."""

    temperature: float = option(0.0, "overrides the weights' own calibration; 0 = keep it", low=0.0, high=1e6)
    null_distance: float = option(0.0, "overrides the weights' own calibration; 0 = keep it", low=0.0, high=1e6)
    null_scale: float = option(0.0, "overrides the weights' own calibration; 0 = keep it", low=0.0, high=1e6)
    cluster_radius_m: float = option(50.0, "candidates this near to each other mean one place", low=1.0, high=1000.0)
    min_probability: float = option(0.7, "a fix needs this belief in one place", low=0.0, high=1.0)
    min_std_m: float = option(25.0, "least standard deviation east and north", low=0.1, high=1000.0)
    min_height_std_m: float = option(3.0, "least standard deviation of the height", low=0.1, high=1000.0)


@dataclass(frozen=True)
class AlignmentConfig:
    """From places to poses."""

    scope: Literal["candidates", "map", "auto", "none"] = option(
        "auto",
        "where poses are searched: around the candidates, on the whole map, both where the map is small; or not at all",
    )
    map_max_km2: float = option(6.0, "largest map that auto searches as a whole", low=0.0, high=1e6)
    map_period_s: float = option(3.0, "the whole map is searched no more often", low=0.0, high=1e6)
    sufficient_probability: float = option(
        0.9, "auto leaves the rest of the map alone where one pose has this probability", low=0.0, high=1.0
    )
    candidates_period_s: float = option(0.45, "the candidates no more often while not localized", low=0.0, high=1e6)
    candidates_period_localized_s: float = option(1.0, "and no more often while localized", low=0.0, high=1e6)
    candidates: int = option(100, "so many candidates are aligned", low=1, high=10_000)
    candidate_radius_m: float = option(22.0, "how far around a candidate", low=1.0, high=200.0)
    hypothesis_radius_m: float = option(6.0, "how far from its prediction a hypothesis is aligned", low=0.5, high=50.0)
    coarse_maxima: int = option(
        64,
        "poses around the candidates that are looked at more closely; on the whole map four times as many",
        low=1,
        high=1000,
    )
    fine_maxima: int = option(16, "of these, how many in the finest cells; on the whole map twice", low=1, high=1000)
    descriptor_weight: float = option(0.5, "of the candidates' belief beside the alignment's", low=0.0, high=10.0)
    min_cells: int = option(100, "a scan that saw fewer cells says nothing", low=1, high=100_000)
    place_m2: float = option(100.0, "area of the map that counts as one place before a scan", low=0.01, high=1e6)
    covariance_temperature: float = option(20.0, "score difference of a factor e in probability", low=0.01)


@dataclass(frozen=True)
class FusionConfig:
    """From the aligned poses of scan after scan, and odometry, to one pose that may be driven by."""

    min_probability: float = option(0.999, "a fix needs this belief in an error below 10 m", low=0.5, high=1.0)
    confirm_m: float = option(10.0, "and a pose that has explained the scans for so long a way", low=0.0, high=1000.0)
    max_hypotheses: int = option(10, "poses carried along at most", low=1, high=1000)
    novelty_m: float = option(10.0, "way over which a scan becomes independent of those before", low=0.1, high=1000.0)
    likelihood_weight: float = option(1.0, "factor on the scans' log likelihoods", low=0.01, high=10.0)
    max_log_likelihood: float = option(15.0, "no scan tells more than this logarithm for the map", low=1.0, high=1000.0)
    clutter_probability: float = option(0.05, "share of the scans that tell nothing of the place", low=1e-6, high=0.9)
    detection_probability: float = option(
        0.9, "share of the scans on the map whose true pose is among the aligned ones", low=0.01, high=0.999
    )
    kidnapping_per_s: float = option(1e-4, "rate at which the robot is kidnapped unnoticed", low=1e-9, high=1.0)
    initial_pose_probability: float = option(0.9, "belief in a pose that is given from outside", low=0.01, high=0.999)
    measurement_std_scale: float = option(1.5, "factor on aligned poses' standard deviations", low=0.1, high=100.0)
    measurement_error_correlation: float = option(
        0.3, "share of an aligned pose's variance that the next scan's error has in common", low=0.0, high=0.99
    )
    measurement_correlation_m: float = option(15.0, "way over which that common error changes", low=0.1, high=1000.0)
    measurement_min_std_m: float = option(0.2, "least standard deviation of an aligned pose", low=0.01, high=10.0)
    measurement_min_std_deg: float = option(0.4, "the same of its heading", low=0.01, high=10.0)
    map_std_m: float = option(0.23, "error that never changes, one sigma, of every position", low=0.0, high=10.0)
    map_std_deg: float = option(0.2, "the same of every heading", low=0.0, high=10.0)
    odometry_relative_std: float = option(0.05, "one sigma, as a share of the way and of the turn", low=1e-4, high=1.0)
    odometry_drift_deg_per_m: float = option(0.3, "what it turns too much or too little a metre", low=0.0, high=45.0)
    odometry_max_gap_s: float = option(0.5, "over a longer gap between its samples it is unknown", low=0.01, high=60.0)
    slip_std_m: float = option(1.0, "size of an error of odometry beyond all bounds, one sigma", low=0.01, high=100.0)
    slip_probability: float = option(1e-3, "share of the scans before which there is one", low=0.0, high=0.5)
    max_speed_mps: float = option(10.0, "the robot drives no faster", low=0.1, high=200.0)
    max_turn_deg_per_s: float = option(120.0, "and turns no faster", low=1.0, high=10_000.0)
    unknown_motion_decay_s: float = option(
        10.0, "unknown motion for so long leaves 1/e of the belief", low=0.1, high=1e5
    )
    restart_s: float = option(3.0, "a stamp farther back begins a new recording: all is forgotten", low=0.0, high=1e5)


@dataclass(frozen=True)
class LocalizerConfig:
    """From a scan to an estimate."""

    top_k: int = option(25, "candidates to retrieve", low=1, high=1000)
    scan: ScanConfig = field(default_factory=ScanConfig, metadata={"text": "use of the scan"})
    retrieval: RetrievalConfig = field(
        default_factory=RetrievalConfig, metadata={"text": "what the distances of candidates mean"}
    )
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig, metadata={"text": "from places to poses"})
    fusion: FusionConfig = field(default_factory=FusionConfig, metadata={"text": "poses over time"})


@dataclass(frozen=True)
class LocalizerNodeConfig(LocalizerConfig):
    """The localizer node's parameters: the localizer's own and what only a node needs."""

    map: str = option("", "folder of the aerial map, as build_map writes it")
    weights: str = option("", "weights file (safetensors); empty = the shipped weights")
    device: Literal["cpu", "cuda"] = option("cpu", "where the encoder runs")
    threads: int = option(0, "CPU threads for a descriptor; 0 = as many as cores, at most four", low=0, high=64)
    queue_depth: int = option(
        4,
        "scans that may wait while one is worked on; where more come, all but the newest are dropped",
        low=1,
        high=100,
    )
    stall_s: float = option(5.0, "a scan that takes longer is reported as an error", low=0.1, high=3600.0)
    autostart: bool = option(True, "configure and activate without being told by a lifecycle manager")
    global_frame_id: str = option("map", "name of the ENU frame at the map's origin")
    base_frame_id: str = option("base_link", "name of the frame whose position is given")
    odom_frame_id: str = option("", "name of the odometry's frame; empty = as its messages name it")
    mounting_from_tf: bool = option(False, "take the lidar's pose on base_frame_id from TF, not from scan.mounting")
    use_imu: bool = option(False, "level the scan by the accelerations on topic imu (axes of base_frame_id)")
    imu_time_constant_s: float = option(1.0, "time constant of the low-pass on the accelerations", low=0.01, high=60.0)
    use_imu_heading: bool = option(False, "take the orientation on topic imu as a first guess of the heading")
    imu_heading_std_deg: float = option(15.0, "one sigma of that heading", low=1.0, high=180.0)
    imu_heading_offset_deg: float = option(
        0.0, "added to it, counter-clockwise: minus the magnetic declination, a mounting", low=-360.0, high=360.0
    )
    odometry: Literal["topic", "scan", "none"] = option(
        "topic", "how the robot has moved: told on topic odom, from scan to scan (the extra 'odometry'), or unknown"
    )
    odometry_timeout_s: float = option(0.02, "how long a scan waits for the odometry of its stamp", low=0.0, high=1.0)
    tf_broadcast: bool = option(False, "publish global_frame_id -> odometry frame on /tf while localized (REP-105)")
    transform_tolerance: float = option(0.2, "how far ahead of its scan that transform is stamped", low=0.0, high=10.0)


def usable_threads() -> int:
    """Return how many threads work on one scan by default: as many as this process may use cores, at most four."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _MOST_THREADS)
