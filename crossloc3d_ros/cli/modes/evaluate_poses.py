"""`evaluate --protocol pose`: poses of the whole localizer, of single scans and along drives."""

from __future__ import annotations

import argparse
import functools
from pathlib import Path

from rich.console import Console

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli.common import ProgressDisplay, console, set_up_logging
from crossloc3d_ros.config import LocalizerConfig, from_dict
from crossloc3d_ros.config.sources import parse_assignments
from crossloc3d_ros.datasets.amsterdam import find_surveys
from crossloc3d_ros.datasets.pose_drives import journeys_of, open_drives
from crossloc3d_ros.datasets.pose_sets import open_pose_set
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.evaluation.poses.predictions import about_of, predict
from crossloc3d_ros.evaluation.poses.report import CSV, JSON, MARKDOWN, PAGE, write_report
from crossloc3d_ros.evaluation.poses.scores import score_poses
from crossloc3d_ros.evaluation.poses.store import load_predictions, save_predictions
from crossloc3d_ros.evaluation.poses.terminal import pose_tables
from crossloc3d_ros.workers import EncoderLoader

PREDICTIONS = "predictions.npz"


def evaluate_poses(arguments: argparse.Namespace) -> None:
    """Make the predictions, score them, write and print the results."""
    target = console()
    set_up_logging(arguments.verbose, target)
    check_pose_options(arguments)
    config = from_dict(LocalizerConfig, parse_assignments(arguments.set))
    output: Path = arguments.output or Path("out/evaluate") / f"pose_{arguments.benchmark}"
    if not arguments.only_score:
        with ProgressDisplay(target) as display:
            _predict(arguments, config, output / PREDICTIONS, display)
    predictions, about = load_predictions(output / PREDICTIONS)
    scores = score_poses(predictions, about)
    write_report(output, scores, len(predictions))
    results = Console(highlight=False)
    for table in pose_tables(scores):
        results.print(table)
    print("\n".join(str(output / name) for name in (CSV, JSON, MARKDOWN)))
    print(f"{output / PAGE}   (open it in a browser)")


def loader_of(arguments: argparse.Namespace) -> EncoderLoader:
    """Return what loads the weights, in other processes too; there one thread each is best."""
    return functools.partial(load_encoder, arguments.weights, arguments.device, 1 if arguments.workers > 1 else None)


def label_of(arguments: argparse.Namespace) -> str:
    """Return what the weights are called in tables."""
    return "shipped weights" if arguments.weights is None else str(arguments.weights.stem)


def check_pose_options(arguments: argparse.Namespace) -> None:
    """Refuse options of --protocol place, and numbers that are none; ConfigError says which."""
    if arguments.workers < 1:
        raise ConfigError(f"--workers must be at least 1, got {arguments.workers}")
    if arguments.every < 1:
        raise ConfigError(f"--every must be at least 1, got {arguments.every}")
    if arguments.dataset is not None or arguments.method != "weights" or arguments.setting or arguments.query_headings:
        raise ConfigError(
            f"--protocol {arguments.protocol} knows neither --dataset, --method, --setting nor --query-headings"
        )
    if arguments.verify:
        raise ConfigError(
            f"--verify orders the places of --protocol place; the localizer of --protocol {arguments.protocol} aligns"
        )
    if arguments.protocol == "pose" and (arguments.aerial or arguments.learned):
        raise ConfigError("--aerial and --learned name surveys for --protocol belief: add it, or leave them out")


def _predict(arguments: argparse.Namespace, config: LocalizerConfig, path: Path, display: ProgressDisplay) -> None:
    loader, workers = loader_of(arguments), arguments.workers
    surveys = find_surveys(arguments.surveys) if arguments.benchmark == "amsterdam" else None
    pose_set = open_pose_set(
        arguments.benchmark, arguments.data, loader, workers=workers, surveys=surveys, progress=display
    )
    drives = open_drives(pose_set, workers=workers, surveys=surveys, progress=display)
    odometry, every = arguments.odometry, arguments.every
    predictions = predict(
        pose_set, drives, journeys_of(pose_set, drives), loader, config,
        odometry=odometry, every=every, workers=workers, progress=display,
    )  # fmt: skip
    aerial_map = AerialMap.load(pose_set.map_folder)
    save_predictions(path, predictions, about_of(pose_set, aerial_map, label_of(arguments), config, odometry, every))
