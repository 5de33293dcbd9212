"""`evaluate`: measure weights by the paper's protocol, or poses by our own, on a fixed benchmark or one's own data."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from crossloc3d_ros.cli.common import ProgressDisplay, add_verbosity, console, run, set_up_logging
from crossloc3d_ros.cli.modes.evaluate_belief import evaluate_belief
from crossloc3d_ros.cli.modes.evaluate_poses import evaluate_poses, label_of, loader_of
from crossloc3d_ros.config import VerificationConfig, from_dict
from crossloc3d_ros.datasets.amsterdam import find_surveys
from crossloc3d_ros.datasets.benchmarks import BENCHMARKS, open_benchmark
from crossloc3d_ros.datasets.place_sets import EvaluationSet
from crossloc3d_ros.datasets.pose_sets import POSE_SETS
from crossloc3d_ros.datasets.published import load_evaluation_set
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.evaluation.retrieval.encoding import EncodingJob
from crossloc3d_ros.evaluation.retrieval.predictions import HEADING_MODES, SETTINGS, Plan, predict_all, way_of
from crossloc3d_ros.evaluation.retrieval.report import CSV, JSON, PAGE, write_report
from crossloc3d_ros.evaluation.retrieval.results import headline
from crossloc3d_ros.evaluation.retrieval.runs import add_verified, read_predictions, replace_predictions
from crossloc3d_ros.evaluation.retrieval.scores import score
from crossloc3d_ros.evaluation.retrieval.terminal import tables
from crossloc3d_ros.training.handcrafted import ScanContext
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import EncoderLoader

PREDICTIONS = "predictions"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    modes = {"place": _evaluate, "pose": evaluate_poses, "belief": evaluate_belief}
    return run(lambda: modes[arguments.protocol](arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evaluate",
        description="Retrieve the places of ground scans among aerial submaps, write the predictions, and score them: "
        "recall at 100, 50 and 25 m with chance level and interval, curves, pictures, one HTML page. With --protocol "
        "pose, evaluate poses of the whole localizer, of single scans and along drives; with --protocol belief, its "
        "probabilities: on thinned and other surveys, with fewer points, in aged towns, and of every drive on every "
        "map that it is not on. An interrupted run continues when the same command is given again.",
    )
    parser.add_argument(
        "--protocol", choices=["place", "pose", "belief"], default="place",
        help="place: recall of submaps; pose: metres, degrees, fixes and their covariance; belief: whether the "
        "probabilities hold, on the map and off it (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--weights", type=Path, help="weights file (default: the one that comes with the package)")
    parser.add_argument(
        "--method", choices=["weights", "scan_context"], default="weights",
        help="scan_context: polar height maps, without learning, in place of weights (default: %(default)s)",
    )  # fmt: skip
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--benchmark", choices=list(dict.fromkeys([*BENCHMARKS, *POSE_SETS])), default="simulated",
        help="fitting: towns to tune settings on, for poses only (default: %(default)s)",
    )  # fmt: skip
    source.add_argument("--dataset", type=Path, help="folder in the layout of CS-Campus3D, as make_dataset writes it")
    parser.add_argument(
        "--preset", choices=["campus", "oxford", "plain"], help="kind of --dataset (default: by its files)"
    )
    parser.add_argument(
        "--setting", nargs="+", choices=SETTINGS, help="databases searched (default: all that the benchmark has)"
    )
    parser.add_argument(
        "--heading", nargs="+", choices=HEADING_MODES, default=list(HEADING_MODES),
        help="queries aligned to north, or of random heading (default: both)",
    )  # fmt: skip
    parser.add_argument(
        "--query-headings", nargs="+", type=int, metavar="N",
        help="headings in which a query of unknown heading is encoded; several numbers are compared (default: that of "
        "the weights)",
    )  # fmt: skip
    parser.add_argument(
        "--verify", type=int, default=0, metavar="N",
        help="also reorder the first N retrieved aerial submaps, such as 300, by height maps, and score both "
        "orders (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--verify-weight", type=float, default=VerificationConfig().weight, metavar="W",
        help="weight of height maps beside descriptors; see `train verification` (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE",
        help="with --protocol pose or belief: another setting of the localizer, such as fusion.min_probability=0.99",
    )  # fmt: skip
    parser.add_argument(
        "--odometry", choices=["wheels", "scan", "none"], default="wheels",
        help="with --protocol pose: source of the robot's motion along drives (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--every", type=int, default=1, metavar="N",
        help="with --protocol pose or belief, for a quick look: each n-th scan and each n-th journey, and of the pairs "
        "off the map one of n (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--aerial", nargs="+", type=Path, default=[], metavar="FILE",
        help="with --protocol belief: further surveys, a file each; each is a map for drives from elsewhere, and one "
        "of at least 5 points/m2 with ground class is driven through in one half of its points on a map of the other",
    )  # fmt: skip
    parser.add_argument(
        "--learned", nargs="+", type=Path, default=[], metavar="FILE",
        help="with --protocol belief: the same, of surveys that something was learned or tuned on: shown as such, and "
        "counted in no total on the map",
    )  # fmt: skip
    parser.add_argument(
        "--output", type=Path, help="folder (default: out/evaluate/BENCHMARK, pose_BENCHMARK or belief_BENCHMARK)"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("out/benchmark"),
        help="folder in which benchmarks and descriptors are kept (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--surveys", type=Path, help="folder of the two Amsterdam surveys (default: maps/amsterdam)")
    parser.add_argument("--workers", type=int, default=1, help="processes (default: %(default)s)")
    parser.add_argument("--device", default="cpu", help="where the encoder runs: cpu or cuda (default: %(default)s)")
    parser.add_argument(
        "--only-score", action="store_true", help="score the predictions in --output; nothing is encoded"
    )
    add_verbosity(parser)
    return parser


def _evaluate(arguments: argparse.Namespace) -> None:
    target = console()
    set_up_logging(arguments.verbose, target)
    if arguments.workers < 1:
        raise ConfigError(f"--workers must be at least 1, got {arguments.workers}")
    if arguments.set:
        raise ConfigError("--set changes the localizer, which --protocol place does not evaluate: add --protocol pose")
    if arguments.aerial or arguments.learned:
        raise ConfigError("--aerial and --learned name surveys for --protocol belief: add it, or leave them out")
    verification = _verification(arguments)
    loader = _loader(arguments)
    encoder = loader()
    with ProgressDisplay(target) as display:
        evaluation_set = _open(arguments, encoder, display)
    output: Path = arguments.output or Path("out/evaluate") / evaluation_set.name.replace(" ", "_")
    folder = output / PREDICTIONS
    if not arguments.only_score:
        with ProgressDisplay(target) as display:
            job = EncodingJob(encoder, loader, arguments.data / "descriptors", arguments.workers, display)
            plan = _plan(arguments, encoder, evaluation_set)
            replace_predictions(folder, predict_all(evaluation_set, job, plan, _label(arguments)))
    if verification is not None:
        with ProgressDisplay(target) as display:
            add_verified(
                folder, evaluation_set, encoder, verification, threads=arguments.workers, progress=display
            )  # fmt: skip
    predictions = read_predictions(folder)
    scores = [score(each, evaluation_set) for each in predictions]
    main_scores = headline(scores, *way_of(encoder))
    source = evaluation_set.name if arguments.dataset is None else arguments.dataset.name
    write_report(output, predictions, scores, main_scores, evaluation_set, encoder, source)
    results = Console(highlight=False)
    for table in tables(scores, main_scores):
        results.print(table)
    print(f"{output / CSV}\n{output / JSON}\n{output / PAGE}   (open it in a browser)")


def _verification(arguments: argparse.Namespace) -> VerificationConfig | None:
    """Return what --verify asks for."""
    if arguments.verify == 0:
        return None
    return from_dict(VerificationConfig, {"candidates": arguments.verify, "weight": arguments.verify_weight})


def _loader(arguments: argparse.Namespace) -> EncoderLoader:
    if arguments.method != "scan_context":
        return loader_of(arguments)
    if arguments.weights is not None:
        raise ConfigError("--method scan_context has no weights: leave --weights out")
    return ScanContext


def _label(arguments: argparse.Namespace) -> str:
    return "Scan Context" if arguments.method == "scan_context" else label_of(arguments)


def _plan(arguments: argparse.Namespace, encoder: DescriptorEncoder, evaluation_set: EvaluationSet) -> Plan:
    possible = SETTINGS if evaluation_set.ground is not None else SETTINGS[:1]
    count, way = way_of(encoder)
    return Plan(
        settings=tuple(arguments.setting or possible),
        headings=tuple(arguments.heading),
        query_headings=tuple(arguments.query_headings or [count]),
        invariant=count == 1 or way == "mean",
        kept=arguments.verify,
    )


def _open(arguments: argparse.Namespace, encoder: DescriptorEncoder, display: ProgressDisplay) -> EvaluationSet:
    if arguments.dataset is not None:
        return load_evaluation_set(arguments.dataset, encoder.preprocessing, arguments.preset)
    if arguments.benchmark not in BENCHMARKS:
        raise ConfigError(f"the benchmark '{arguments.benchmark}' is one of poses: add --protocol pose")
    surveys = find_surveys(arguments.surveys) if arguments.benchmark == "amsterdam" else None
    return open_benchmark(
        arguments.benchmark,
        arguments.data,
        encoder.preprocessing,
        workers=arguments.workers,
        surveys=surveys,
        progress=display,
    )


if __name__ == "__main__":
    sys.exit(main())
