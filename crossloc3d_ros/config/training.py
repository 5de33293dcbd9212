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
