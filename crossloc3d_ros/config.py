"""Every setting in one place: frozen dataclasses from which ROS parameters, YAML files and command lines are made.

A field carries its one default, and in its metadata the sentence that describes it and the range that it may lie in.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from crossloc3d_ros.errors import ConfigError

T = TypeVar("T")

RENAMED = {
    "most_waiting": "queue_depth",
    "publish_tf": "tf_broadcast",
    "tf_tolerance_s": "transform_tolerance",
    "odometry_wait_s": "odometry_timeout_s",
    "scan.turn_s": "scan.period_s",
    "credibility": "retrieval",
    "credibility.temperature": "retrieval.temperature",
    "credibility.none_distance": "retrieval.null_distance",
    "credibility.none_scale": "retrieval.null_scale",
    "credibility.cluster_radius_m": "retrieval.cluster_radius_m",
    "credibility.min_probability": "retrieval.min_probability",
    "credibility.position_floor_m": "retrieval.min_std_m",
    "credibility.height_floor_m": "retrieval.min_height_std_m",
    "alignment.search": "alignment.scope",
    "alignment.exhaustive_km2": "alignment.map_max_km2",
    "alignment.exhaustive_every_s": "alignment.map_period_s",
    "alignment.convincing": "alignment.sufficient_probability",
    "alignment.search_every_s": "alignment.candidates_period_s",
    "alignment.look_every_s": "alignment.candidates_period_localized_s",
    "alignment.radius_m": "alignment.candidate_radius_m",
    "alignment.follow_m": "alignment.hypothesis_radius_m",
    "alignment.peaks": "alignment.coarse_maxima",
    "alignment.poses": "alignment.fine_maxima",
    "alignment.shape_temperature": "alignment.covariance_temperature",
    "fusion.evidence_m": "fusion.novelty_m",
    "fusion.evidence_weight": "fusion.likelihood_weight",
    "fusion.evidence_limit": "fusion.max_log_likelihood",
    "fusion.blind_share": "fusion.clutter_probability",
    "fusion.found_share": "fusion.detection_probability",
    "fusion.carried_per_s": "fusion.kidnapping_per_s",
    "fusion.prior_belief": "fusion.initial_pose_probability",
    "fusion.error_scale": "fusion.measurement_std_scale",
    "fusion.error_share": "fusion.measurement_error_correlation",
    "fusion.error_m": "fusion.measurement_correlation_m",
    "fusion.position_floor_m": "fusion.measurement_min_std_m",
    "fusion.heading_floor_deg": "fusion.measurement_min_std_deg",
    "fusion.map_error_m": "fusion.map_std_m",
    "fusion.map_turn_deg": "fusion.map_std_deg",
    "fusion.odometry_error": "fusion.odometry_relative_std",
    "fusion.odometry_turn_deg_per_m": "fusion.odometry_drift_deg_per_m",
    "fusion.odometry_gap_s": "fusion.odometry_max_gap_s",
    "fusion.slip_m": "fusion.slip_std_m",
    "fusion.slip_share": "fusion.slip_probability",
    "fusion.forget_s": "fusion.unknown_motion_decay_s",
    "turns": "rotations",
}
"""Settings of version 0.1 under other names: an old name is refused with the new one."""

_MOST_THREADS = 4  # more gain nothing for a single scan


def usable_threads() -> int:
    """Return how many threads work on one scan by default: as many as this process may use cores, at most four."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _MOST_THREADS)


def option(default: T, text: str, *, low: float | None = None, high: float | None = None) -> T:
    """Declare a dataclass field with a description and, for numbers, an inclusive range."""
    return field(default=default, metadata={"text": text, "low": low, "high": high})


@dataclass(frozen=True)
class PreprocessingConfig:
    """How metres become a patch; travels with the weights, because they were trained on it."""

    half_extent_m: float = option(50.0, "half the side of a submap and the unit of its patch", low=1.0, high=1000.0)
    scan_half_extent_m: float = option(50.0, "the same for a scan", low=1.0, high=1000.0)
    n_points: int = option(4096, "points of a patch", low=16, high=1_000_000)
    ground_clearance_m: float = option(0.5, "what lies lower above the ground is left out", low=0.0, high=10.0)
    thin_m: float = option(0.5, "one point a cube of this side before the random choice; 0 = all", low=0.0, high=10.0)
    min_points: int = option(256, "with fewer points above the ground there is no patch", low=1, high=1_000_000)
    scan_origin: Literal["sensor", "mean"] = option("sensor", "what a scan's patch is centred on")
    submap_origin: Literal["grid", "bounding_box"] = option("grid", "what a submap's patch is centred on")
    vertical_origin: Literal["ground", "centre"] = option("ground", "z above the ground or from the centre")
    seed: int = option(0, "seed of the random choice of points", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class ModelConfig:
    """Everything that the paper varies, and the networks that it is compared with."""

    network: Literal[
        "crossloc3d", "pointnetvlad", "lpdnet", "minkloc3d", "minkloc3dv2", "minkloc3d_s", "transloc3d"
    ] = option("crossloc3d", "which network; the others read only what they have of the settings below")
    voxel_sizes: tuple[float, ...] = option((0.05, 0.12, 0.4), "grains, fine to coarse, in patch units; 1 to 4")
    kept_branches: int = option(3, "receptive fields kept of the five; 0 = no selection", low=0, high=5)
    refinement: Literal["coarse_to_fine", "fine_to_coarse", "none"] = option("coarse_to_fine", "none = concatenation")
    sub_steps: int = option(3, "refinement layers a grain", low=1, high=8)
    memory_sizes: tuple[int, ...] = option((256, 128, 128, 128, 64, 64, 32, 32, 32), "centres of each refinement layer")
    time_embedding: bool = option(True, "whether the layers are told their number")
    position: Literal["none", "radial", "cartesian"] = option("none", "what each voxel knows of where it lies")
    channels: int = option(64, "width of the backbone", low=8, high=512)
    heads: int = option(4, "attention heads", low=1, high=16)
    fused_channels: int = option(512, "width before the pooling", low=8, high=4096)
    clusters: int = option(64, "NetVLAD clusters", low=1, high=1024)
    descriptor_size: int = option(256, "numbers in a descriptor", low=2, high=4096)


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
class CalibrationConfig:
    """What distances between descriptors mean; fitted on known places and stored with the weights."""

    temperature: float = option(0.1, "distance by which a candidate's odds fall to 1/e", low=1e-6, high=1e6)
    null_distance: float = option(1.0, "best distance at which 'no such place' is as likely as not", low=1e-6, high=1e6)
    null_scale: float = option(0.1, "distance over which that belief turns", low=1e-6, high=1e6)


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


@dataclass(frozen=True)
class BuildConfig:
    """From an aerial survey to a map."""

    spacing_m: float = option(19.0, "distance between the centres of neighbouring submaps", low=1.0, high=1000.0)
    cell_m: float = option(1.0, "cell of the height rasters", low=0.1, high=10.0)
    tile_m: float = option(380.0, "side of the tiles in which the area is worked through", low=50.0, high=5000.0)
    min_coverage: float = option(0.75, "share of a submap that must have been flown over", low=0.0, high=1.0)
    chunk_points: int = option(1_000_000, "points read from a file at once", low=1000, high=100_000_000)
    workers: int = option(1, "processes on this machine", low=1, high=256)


@dataclass(frozen=True)
class PlacesConfig:
    """Simulated towns to learn from."""

    families: tuple[str, ...] = option((), "kinds of towns, taken in turns; empty = all but those held out")
    town_size_m: float = option(400.0, "side of a town", low=200.0, high=2000.0)
    scans: int = option(120, "scans of each town to learn from", low=1, high=100_000)
    validation_scans: int = option(40, "scans of each town to validate on", low=1, high=100_000)
    survey_spacing_m: float = option(0.35, "distance between neighbouring pulses of a survey", low=0.05, high=5.0)
    survey_vertical_error_m: float = option(0.1, "one sigma of a survey's heights", low=0.0, high=2.0)
    spacing_m: float = option(19.0, "distance between the centres of validation submaps", low=1.0, high=1000.0)
    cell_m: float = option(1.0, "cell of the terrain raster", low=0.1, high=10.0)
    sensor_height_m: tuple[float, float] = option((0.9, 1.6), "lowest and highest lidar above the ground", low=0.2)
    tilt_deg: float = option(1.0, "standard deviation of roll and pitch, added to the slope's", low=0.0, high=15.0)
    imu_share: float = option(0.5, "share of the scans that an IMU levels", low=0.0, high=1.0)
    surface_share: float = option(0.0, "share of the training scans cast in a surveyed surface", low=0.0, high=1.0)


@dataclass(frozen=True)
class TrainConfig:
    """How weights are learned."""

    pairs: int = option(32, "pairs of a scan and a submap in a batch", low=2, high=4096)
    towns_a_batch: int = option(4, "towns that a batch is drawn from: fewer = harder negatives", low=1, high=1024)
    chunk_pairs: int = option(0, "pairs encoded at once with a graph, the loss being the batch's; 0 = all", low=0)
    loss: Literal["info_nce", "smooth_ap", "batch_hard"] = option(
        "info_nce", "whole batch by cross entropy or by average precision, or the paper's triplets"
    )
    margin: float = option(0.2, "of the triplets, descriptor units", low=0.0, high=100.0)
    temperature: float = option(0.05, "of the average precision, mean difference of components", low=1e-6, high=1e3)
    positives: int = option(4, "nearest matches that the average precision counts", low=1, high=4096)
    match_m: float = option(0.0, "of the average precision: submaps centred nearer match too", low=0.0, high=1e4)
    most_pairs: int = option(0, "batches grow up to so many pairs while few triplets are active; 0 = never", low=0)
    growth: float = option(1.4, "factor by which they grow", low=1.0, high=10.0)
    growth_below: float = option(0.7, "they grow where a smaller share of the triplets is active", low=0.0, high=1.0)
    growth_steps: int = option(100, "batches over which that share is taken", low=1, high=1_000_000)
    learning_rate: float = option(1e-3, "highest learning rate of AdamW", low=1e-7, high=1.0)
    final_share: float = option(0.01, "learning rate at the end, as a share of the highest", low=0.0, high=1.0)
    warm_up: float = option(0.04, "share of the budget in which the learning rate rises", low=0.0, high=1.0)
    cooldown: float = option(1.0, "last share of the budget, in which the learning rate falls", low=0.0, high=1.0)
    milestones: tuple[float, ...] = option((), "shares at which it falls to a tenth, not by the cooldown", low=0.0)
    weight_decay: float = option(1e-3, "of AdamW", low=0.0, high=1.0)
    beta2: float = option(0.99, "of AdamW: decay of the squared gradients' mean", low=0.0, high=0.999999)
    clip_norm: float = option(5.0, "longest gradient; 0 = any", low=0.0, high=1e6)
    ema_decay: float = option(0.99, "of the averaged weights, once warm", low=0.0, high=1.0)
    headings: int = option(1, "1: learn not to mind the heading; more: the query is tried in so many", low=1, high=64)
    rotations: int = option(1, "with one heading: test-time rotations that are averaged", low=1, high=64)
    offset_m: float = option(9.5, "a submap's centre lies at most so far from its scan, each way", low=0.0, high=100.0)
    neighbour_m: float = option(20.0, "nearer places of one town are neither match nor mismatch", low=0.0, high=1e4)
    near_share: float = option(0.5, "share of places drawn near another of the batch: hard negatives", low=0, high=1)
    near_m: float = option(60.0, "how near that is", low=0.0, high=1e4)
    hard_share: float = option(0.0, "share of a batch from places that the weights confuse", low=0.0, high=1.0)
    mine_steps: int = option(1000, "batches between two searches for such places", low=1, high=10_000_000)
    mined_places: int = option(2048, "places of all towns that a search compares", low=2, high=1_000_000)
    augmentation: Literal["full_circle", "paper"] = option("full_circle", "headings and occlusions, or the paper's")
    keep_points: float = option(0.8, "least share of a scan's points that augmentation keeps", low=0.1, high=1.0)
    keep_survey: float = option(1.0, "least share of a survey's points that augmentation keeps", low=0.05, high=1.0)
    changes: float = option(
        0.0, "mean number of things that go from a submap, and of those that come", low=0.0, high=99
    )
    displacement_m: float = option(0.0, "largest noise of a survey's points, and its height's", low=0.0, high=10.0)
    sector_share: float = option(0.3, "share of scans with a blocked sector of up to 90 degrees", low=0.0, high=1.0)
    seed: int = option(1, "of weights, batches and augmentation", low=0, high=2**31 - 1)
    threads: int = option(1, "of torch", low=1, high=256)
    workers: int = option(0, "threads that draw the next batches meanwhile; 0 = none", low=0, high=64)
    device: Literal["cpu", "cuda"] = option("cpu", "where to train")
    precision: Literal["float32", "bfloat16"] = option("float32", "of matrix products; bfloat16 is for CUDA")
    save_minutes: float = option(4.0, "between saved states", low=0.01, high=1e4)
    validation_minutes: float = option(9.0, "between validations", low=0.01, high=1e4)
    log_steps: int = option(10, "batches between two lines of the log", low=1, high=100_000)
    model: ModelConfig = field(default_factory=ModelConfig, metadata={"text": "the network"})
    preprocessing: PreprocessingConfig = field(default_factory=PreprocessingConfig, metadata={"text": "the patch"})

    def __post_init__(self) -> None:
        """Refuse settings that do not fit each other."""
        if self.most_pairs and (self.loss != "batch_hard" or self.most_pairs < self.pairs):
            raise ConfigError("'most_pairs' is for the loss batch_hard, and at least as large as 'pairs'")
        if list(self.milestones) != sorted(self.milestones):
            raise ConfigError(f"'milestones' must ascend, got {self.milestones}")
        if self.precision == "bfloat16" and self.device == "cpu":
            raise ConfigError("'precision' bfloat16 needs the device cuda")
        if self.headings > 1 and self.rotations > 1:
            raise ConfigError("'rotations' averages over headings, which 'headings' above 1 tells apart: set one to 1")
        if self.augmentation == "paper" and self.headings > 1:
            raise ConfigError("the paper's augmentation does not teach several headings: 'headings' must be 1")


@dataclass(frozen=True)
class DatasetConfig:
    """From recordings with GNSS and a survey to a dataset in the layout of CS-Campus3D."""

    max_gnss_std_m: float = option(10.0, "a scan whose GNSS deviates by more (one sigma) is left out", low=0.01)
    max_gap_s: float = option(2.5, "between fixes farther apart in time no position is interpolated", low=0.01)
    scan_spacing_m: float = option(5.0, "a scan nearer to the last one used is left out", low=0.0, high=1000.0)
    positive_m: float = option(25.0, "clouds so near show the same place", low=1.0, high=1000.0)
    negative_m: float = option(100.0, "clouds farther apart show different places", low=1.0, high=10_000.0)
    hit_m: float = option(100.0, "a submap so near to a test scan is a right answer", low=1.0, high=1000.0)
    validation_share: float = option(0.1, "share of the scans that the validation area should have", low=0.0, high=0.9)
    test_share: float = option(0.2, "share of the scans that the test area should have", low=0.0, high=0.9)

    def __post_init__(self) -> None:
        """Refuse what leaves nothing to learn from."""
        if self.validation_share + self.test_share >= 1.0:
            raise ConfigError("'validation_share' and 'test_share' together must leave something to learn from")
        if self.negative_m < self.positive_m:
            raise ConfigError(f"'negative_m' ({self.negative_m}) must not be below 'positive_m' ({self.positive_m})")


def to_dict(config: Any) -> dict[str, Any]:
    """Return the configuration as plain nested dicts, ready for JSON or YAML."""
    return dataclasses.asdict(config)


def from_dict(kind: type[T], values: Mapping[str, Any], *, where: str = "") -> T:
    """Build a configuration from nested mappings; unknown keys, wrong types and out-of-range values raise ConfigError.

    Missing keys keep their defaults. `where` prefixes the names in messages.
    """
    hints = typing.get_type_hints(kind)
    fields = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{where}{key}"
        if key not in fields:
            raise ConfigError(unknown_setting(name, sorted(fields)))
        arguments[key] = check_value(name, hints[key], value, fields[key].metadata)
    return kind(**arguments)


def unknown_setting(name: str, known: Iterable[str], noun: str = "setting") -> str:
    """Return the message for a name that no field has: what it is called now, what it may have meant, or what exists.

    `known` are the names that `name` may have been, without the groups that precede them in `name`.
    """
    if name in RENAMED:
        return f"{noun} '{name}' is now called '{RENAMED[name]}'"
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1) or difflib.get_close_matches(
        name.rpartition(".")[2], names, n=1
    )
    hint = f"did you mean '{close[0]}'?" if close else f"known are: {', '.join(names)}"
    return f"unknown {noun} '{name}': {hint}"


def check_value(name: str, hint: Any, value: Any, metadata: Mapping[str, Any]) -> Any:
    """Return `value` converted to the field's type, or raise ConfigError naming the setting."""
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise ConfigError(f"'{name}' must be a group of settings, got {value!r}")
        return from_dict(typing.cast(type[Any], hint), value, where=f"{name}.")
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in typing.get_args(hint):
            return None
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
        origin = typing.get_origin(hint)
    if origin is Literal:
        if value not in typing.get_args(hint):
            raise ConfigError(f"'{name}' must be one of {', '.join(map(str, typing.get_args(hint)))}, got {value!r}")
        return value
    if origin is tuple:
        inner = typing.get_args(hint)
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"'{name}' must be a list, got {value!r}")
        if inner[-1] is not Ellipsis and len(value) != len(inner):
            raise ConfigError(f"'{name}' must hold {len(inner)} values, got {len(value)}")
        return tuple(check_value(f"{name}[{i}]", inner[0], v, metadata) for i, v in enumerate(value))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, hint) or (hint is not bool and isinstance(value, bool)):
        raise ConfigError(f"'{name}' must be of type {hint.__name__}, got {value!r}")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        low, high = metadata.get("low"), metadata.get("high")
        if not ((low is None or value >= low) and (high is None or value <= high)):
            raise ConfigError(f"'{name}' must lie between {low} and {high}, got {value}")
    return value


@dataclass(frozen=True)
class Setting:
    """One plain field of a configuration, however deep."""

    name: str
    """Dotted path, such as `scan.mounting.z_m`."""
    hint: Any
    default: Any
    metadata: Mapping[str, Any]

    @property
    def text(self) -> str:
        """The sentence that describes it."""
        return str(self.metadata.get("text", ""))

    @property
    def low(self) -> float | None:
        """Least value of a number, or of each number of a list."""
        return self.metadata.get("low")

    @property
    def high(self) -> float | None:
        """Largest value of a number, or of each number of a list."""
        return self.metadata.get("high")

    @property
    def choices(self) -> tuple[str, ...]:
        """The texts to choose from, where they are limited."""
        return typing.get_args(self.hint) if typing.get_origin(self.hint) is Literal else ()


def settings_of(kind: type[Any], prefix: str = "") -> Iterator[Setting]:
    """Yield the plain fields of a configuration dataclass and of the groups that it holds."""
    hints = typing.get_type_hints(kind)
    for item in dataclasses.fields(kind):
        hint = hints[item.name]
        if dataclasses.is_dataclass(hint):
            yield from settings_of(typing.cast(type[Any], hint), f"{prefix}{item.name}.")
        else:
            yield Setting(f"{prefix}{item.name}", hint, item.default, item.metadata)
