"""What is learned from, and how: simulated towns, recordings, the training itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from crossloc3d_ros.config.network import ModelConfig, PreprocessingConfig
from crossloc3d_ros.config.settings import option
from crossloc3d_ros.errors import ConfigError


@dataclass(frozen=True)
class PlacesConfig:
    """Simulated towns to learn from."""

    families: tuple[str, ...] = option((), "families of towns, used in turn; empty = all but the held-out ones")
    town_size_m: float = option(400.0, "side of a town", low=200.0, high=2000.0)
    scans: int = option(120, "training scans per town", low=1, high=100_000)
    validation_scans: int = option(40, "validation scans per town", low=1, high=100_000)
    survey_spacing_m: float = option(0.35, "distance between neighbouring pulses of a survey", low=0.05, high=5.0)
    survey_vertical_error_m: float = option(0.1, "standard deviation of a survey's heights", low=0.0, high=2.0)
    spacing_m: float = option(19.0, "distance between the centres of validation submaps", low=1.0, high=1000.0)
    cell_m: float = option(1.0, "cell of the terrain raster", low=0.1, high=10.0)
    sensor_height_m: tuple[float, float] = option(
        (0.9, 1.6), "least and largest height of the lidar above the ground", low=0.2
    )
    tilt_deg: float = option(1.0, "standard deviation of roll and pitch beside the slope", low=0.0, high=15.0)
    imu_share: float = option(0.5, "share of the scans levelled by an IMU", low=0.0, high=1.0)
    surface_share: float = option(0.0, "share of the training scans cast in a surveyed surface", low=0.0, high=1.0)


@dataclass(frozen=True)
class TrainConfig:
    """How weights are learned."""

    pairs: int = option(32, "pairs of a scan and a submap per batch", low=2, high=4096)
    towns_a_batch: int = option(4, "towns per batch; fewer = harder negatives", low=1, high=1024)
    chunk_pairs: int = option(0, "pairs encoded at once in multistage back-propagation; 0 = all", low=0)
    loss: Literal["info_nce", "smooth_ap", "batch_hard"] = option(
        "info_nce", "cross entropy or average precision over the batch, or the paper's triplets"
    )
    margin: float = option(0.2, "margin of the triplet loss, descriptor units", low=0.0, high=100.0)
    temperature: float = option(
        0.05, "temperature of the average precision, mean difference of components", low=1e-6, high=1e3
    )
    positives: int = option(4, "nearest matches in the average precision", low=1, high=4096)
    match_m: float = option(0.0, "average precision: submaps with a nearer centre match too", low=0.0, high=1e4)
    most_pairs: int = option(0, "largest batch in pairs while few triplets are active; 0 = batches do not grow", low=0)
    growth: float = option(1.4, "growth factor of batches", low=1.0, high=10.0)
    growth_below: float = option(0.7, "batches grow below this share of active triplets", low=0.0, high=1.0)
    growth_steps: int = option(100, "batches over which that share is measured", low=1, high=1_000_000)
    learning_rate: float = option(1e-3, "highest learning rate of AdamW", low=1e-7, high=1.0)
    final_share: float = option(0.01, "final learning rate relative to the highest", low=0.0, high=1.0)
    warm_up: float = option(0.04, "share of the budget with rising learning rate", low=0.0, high=1.0)
    cooldown: float = option(1.0, "share of the budget with falling learning rate", low=0.0, high=1.0)
    milestones: tuple[float, ...] = option(
        (), "shares of the budget at which the learning rate falls to a tenth, instead of the cooldown", low=0.0
    )
    weight_decay: float = option(1e-3, "weight decay of AdamW", low=0.0, high=1.0)
    beta2: float = option(0.99, "beta2 of AdamW", low=0.0, high=0.999999)
    clip_norm: float = option(5.0, "largest norm of the gradient; 0 = no limit", low=0.0, high=1e6)
    ema_decay: float = option(0.99, "decay of the exponential moving average of the weights", low=0.0, high=1.0)
    headings: int = option(
        1, "1 = descriptors invariant to heading; more = queries are encoded in this many headings", low=1, high=64
    )
    rotations: int = option(1, "test-time rotations whose descriptors are averaged, with one heading", low=1, high=64)
    offset_m: float = option(
        9.5, "largest offset of a submap's centre from its scan along each axis", low=0.0, high=100.0
    )
    neighbour_m: float = option(
        20.0, "places of one town within this distance are neither positive nor negative", low=0.0, high=1e4
    )
    near_share: float = option(0.5, "share of a batch drawn near another place of it: hard negatives", low=0, high=1)
    near_m: float = option(60.0, "distance of these hard negatives", low=0.0, high=1e4)
    hard_share: float = option(0.0, "share of a batch from mined hard negatives of all towns", low=0.0, high=1.0)
    mine_steps: int = option(1000, "batches between two minings", low=1, high=10_000_000)
    mined_places: int = option(2048, "places compared in a mining", low=2, high=1_000_000)
    augmentation: Literal["full_circle", "paper"] = option(
        "full_circle", "augmentation: rotation over the full circle and occlusions, or the paper's"
    )
    keep_points: float = option(0.8, "least share of a scan's points kept by augmentation", low=0.1, high=1.0)
    keep_survey: float = option(1.0, "least share of a submap's points kept by augmentation", low=0.05, high=1.0)
    changes: float = option(0.0, "mean number of objects removed from a submap, and of those added", low=0.0, high=99)
    displacement_m: float = option(0.0, "largest noise of a submap's points and of its height", low=0.0, high=10.0)
    sector_share: float = option(0.3, "share of scans with a blocked sector of up to 90 degrees", low=0.0, high=1.0)
    seed: int = option(1, "seed of weights, batches and augmentation", low=0, high=2**31 - 1)
    threads: int = option(1, "threads of torch", low=1, high=256)
    workers: int = option(0, "threads that prepare batches; 0 = none", low=0, high=64)
    device: Literal["cpu", "cuda"] = option("cpu", "device of the training")
    precision: Literal["float32", "bfloat16"] = option("float32", "precision of matrix products; bfloat16 needs CUDA")
    save_minutes: float = option(4.0, "minutes between saved states", low=0.01, high=1e4)
    validation_minutes: float = option(9.0, "minutes between validations", low=0.01, high=1e4)
    log_steps: int = option(10, "batches between two log lines", low=1, high=100_000)
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

    max_gnss_std_m: float = option(10.0, "scans with a larger standard deviation of GNSS are left out", low=0.01)
    max_gap_s: float = option(2.5, "largest time between fixes over which positions are interpolated", low=0.01)
    scan_spacing_m: float = option(5.0, "scans nearer to the last one used are left out", low=0.0, high=1000.0)
    positive_m: float = option(25.0, "clouds within this distance are positives", low=1.0, high=1000.0)
    negative_m: float = option(100.0, "clouds beyond this distance are negatives", low=1.0, high=10_000.0)
    hit_m: float = option(
        100.0, "a retrieved submap within this distance of a test scan is correct", low=1.0, high=1000.0
    )
    validation_share: float = option(0.1, "share of the scans in the validation area", low=0.0, high=0.9)
    test_share: float = option(0.2, "share of the scans in the test area", low=0.0, high=0.9)

    def __post_init__(self) -> None:
        """Refuse what leaves nothing to learn from."""
        if self.validation_share + self.test_share >= 1.0:
            raise ConfigError("'validation_share' and 'test_share' together must leave something to learn from")
        if self.negative_m < self.positive_m:
            raise ConfigError(f"'negative_m' ({self.negative_m}) must not be below 'positive_m' ({self.positive_m})")
