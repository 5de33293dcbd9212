"""`evaluate --protocol belief`: the localizer's probabilities, on its map under many conditions, and off it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from crossloc3d_ros.cli.common import ProgressDisplay, console, set_up_logging
from crossloc3d_ros.cli.modes.evaluate_poses import check_pose_options, label_of, loader_of
from crossloc3d_ros.config import LocalizerConfig, from_dict
from crossloc3d_ros.config.sources import parse_assignments
from crossloc3d_ros.datasets.amsterdam import find_surveys
from crossloc3d_ros.datasets.belief_sets import BeliefRequest, open_belief_sets
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.evaluation.belief.pieces import pieces_of
from crossloc3d_ros.evaluation.belief.predictions import load_pieces, predict_pieces
from crossloc3d_ros.evaluation.belief.report import CSV, JSON, MARKDOWN, PAGE, write_report
from crossloc3d_ros.evaluation.belief.scores import score_belief
from crossloc3d_ros.evaluation.belief.terminal import WIDTH, belief_tables
from crossloc3d_ros.formats.las import expand_inputs


def evaluate_belief(arguments: argparse.Namespace) -> None:
    """Make the predictions that are missing, score them, write and print the results."""
    target = console()
    set_up_logging(arguments.verbose, target)
    check_pose_options(arguments)
    if arguments.odometry != "wheels":
        raise ConfigError("--protocol belief drives with the wheels' odometry alone: leave --odometry out")
    config = from_dict(LocalizerConfig, parse_assignments(arguments.set))
    output: Path = arguments.output or Path("out/evaluate") / f"belief_{arguments.benchmark}"
    if not arguments.only_score:
        with ProgressDisplay(target) as display:
            _predict(arguments, config, output, display)
    predictions, about = load_pieces(output)
    scores = score_belief(predictions, about)
    write_report(output, scores, len(predictions.rows))
    results = Console(highlight=False)
    if not results.is_terminal:
        results = Console(highlight=False, width=WIDTH)
    for table in belief_tables(scores):
        results.print(table)
    print("\n".join(str(output / name) for name in (CSV, JSON, MARKDOWN)))
    print(f"{output / PAGE}   (open it in a browser)")


def _predict(arguments: argparse.Namespace, config: LocalizerConfig, output: Path, display: ProgressDisplay) -> None:
    # The held-out towns and Amsterdam are evaluated together; another set is a look at itself.
    names = ("simulated", "amsterdam") if arguments.benchmark == "simulated" else (arguments.benchmark,)
    request = BeliefRequest(
        names,
        arguments.data,
        find_surveys(arguments.surveys) if "amsterdam" in names else None,
        _files(arguments.aerial),
        _files(arguments.learned),
    )
    loader, workers, every = loader_of(arguments), arguments.workers, arguments.every
    sets = open_belief_sets(request, loader, workers=workers, progress=display)
    predict_pieces(
        output, pieces_of(sets, every), loader, config, label_of(arguments),
        every=every, workers=workers, progress=display,
    )  # fmt: skip


def _files(inputs: Sequence[Path]) -> tuple[Path, ...]:
    return tuple(expand_inputs(inputs)) if inputs else ()
