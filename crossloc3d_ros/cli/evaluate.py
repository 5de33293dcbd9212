"""`evaluate`: measure weights by the paper's protocol, or poses by our own, on a fixed benchmark or one's own data."""

from __future__ import annotations

import argparse
import datetime
import functools
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from rich import box
from rich.console import Console
from rich.table import Table

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli.common import ProgressDisplay, add_verbosity, console, run, set_up_logging
from crossloc3d_ros.cli.demo import find_surveys
from crossloc3d_ros.cli.replay import own_version
from crossloc3d_ros.config import LocalizerConfig, VerificationConfig, from_dict
from crossloc3d_ros.datasets.benchmarks import BENCHMARKS, open_benchmark
from crossloc3d_ros.datasets.place_sets import EvaluationSet
from crossloc3d_ros.datasets.pose_drives import journeys_of, open_drives
from crossloc3d_ros.datasets.pose_sets import POSE_SETS, open_pose_set
from crossloc3d_ros.datasets.published import load_evaluation_set
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.evaluation.poses import results as pose_results
from crossloc3d_ros.evaluation.poses.page import write_pose_page
from crossloc3d_ros.evaluation.poses.predictions import about_of
from crossloc3d_ros.evaluation.poses.predictions import load_predictions as load_pose_predictions
from crossloc3d_ros.evaluation.poses.predictions import predict as predict_poses
from crossloc3d_ros.evaluation.poses.predictions import save_predictions as save_pose_predictions
from crossloc3d_ros.evaluation.poses.scores import PoseScores, score_poses
from crossloc3d_ros.evaluation.retrieval.encoding import EncodingJob
from crossloc3d_ros.evaluation.retrieval.gallery import gallery
from crossloc3d_ros.evaluation.retrieval.page import PageTexts, describe, describe_briefly, write_page
from crossloc3d_ros.evaluation.retrieval.predictions import (
    HEADING_MODES,
    SETTINGS,
    Plan,
    Predictions,
    load_predictions,
    predict_all,
    save_predictions,
    way_of,
)
from crossloc3d_ros.evaluation.retrieval.results import as_csv, as_json, headline
from crossloc3d_ros.evaluation.retrieval.scan_context import ScanContext
from crossloc3d_ros.evaluation.retrieval.scores import PUBLISHED_ONE_PER_CENT, Scores, score
from crossloc3d_ros.evaluation.retrieval.verification import verify
from crossloc3d_ros.evaluation.statistics import RADII_M
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages.wording import percent
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import EncoderLoader

PAGE, CSV, JSON, PREDICTIONS = "index.html", "results.csv", "results.json", "predictions"
POSE_PREDICTIONS, MARKDOWN = "predictions.npz", "table.md"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _evaluate_poses(arguments) if arguments.protocol == "pose" else _evaluate(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="evaluate",
        description="Retrieve the places of ground scans among aerial submaps, write the predictions, and score them: "
        "recall at 100, 50 and 25 m with chance level and interval, curves, pictures, one HTML page. With --protocol "
        "pose, evaluate poses of the whole localizer, of single scans and along drives. An interrupted run continues "
        "when the same command is given again.",
    )
    parser.add_argument(
        "--protocol", choices=["place", "pose"], default="place",
        help="place: recall of submaps; pose: metres, degrees, fixes and their covariance (default: %(default)s)",
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
        help="with --protocol pose: another setting of the localizer, such as fusion.min_probability=0.99",
    )  # fmt: skip
    parser.add_argument(
        "--odometry", choices=["wheels", "scan", "none"], default="wheels",
        help="with --protocol pose: source of the robot's motion along drives (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--every", type=int, default=1, metavar="N",
        help="with --protocol pose, for a quick look: each n-th scan and each n-th journey (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, help="folder (default: out/evaluate/BENCHMARK or pose_BENCHMARK)")
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
        raise ConfigError("--set changes the localizer, which --protocol place does not ask: add --protocol pose")
    verification = _verification(arguments)
    loader = _loader(arguments)
    encoder = loader()
    with ProgressDisplay(target) as display:
        evaluation_set = _open(arguments, encoder, display)
    output: Path = arguments.output or Path("out/evaluate") / evaluation_set.name.replace(" ", "_")
    if not arguments.only_score:
        with ProgressDisplay(target) as display:
            _predict(arguments, loader, encoder, evaluation_set, output, display)
    if verification is not None:
        with ProgressDisplay(target) as display:
            _verify(arguments, verification, encoder, evaluation_set, output / PREDICTIONS, display)
    predictions = _read_predictions(output / PREDICTIONS)
    scores = [score(each, evaluation_set) for each in predictions]
    main_scores = headline(scores, *way_of(encoder))
    main_predictions = predictions[scores.index(main_scores)]
    write_atomically(output / CSV, as_csv(scores))
    write_atomically(output / JSON, as_json(scores))
    pictures = gallery(main_predictions, evaluation_set, encoder.preprocessing.half_extent_m)
    write_page(output / PAGE, scores, main_scores, pictures, _texts(arguments, encoder, evaluation_set, main_scores))
    results = Console(highlight=False)
    for table in tables(scores, main_scores):
        results.print(table)
    print(f"{output / CSV}\n{output / JSON}\n{output / PAGE}   (open it in a browser)")


def _verification(arguments: argparse.Namespace) -> VerificationConfig | None:
    """Return what --verify asks for."""
    if arguments.verify == 0:
        return None
    return from_dict(VerificationConfig, {"candidates": arguments.verify, "weight": arguments.verify_weight})


def _verify(
    arguments: argparse.Namespace,
    config: VerificationConfig,
    encoder: DescriptorEncoder,
    evaluation_set: EvaluationSet,
    folder: Path,
    display: ProgressDisplay,
) -> None:
    """Write the answers of each retrieval among aerial submaps once more, ordered by height maps too."""
    stored = _read_predictions(folder)
    for made in stored:
        if made.about.verified:
            (folder / f"{made.about.name}.npz").unlink(missing_ok=True)
    retrieved = [made for made in stored if made.about.setting == "aerial" and not made.about.verified]
    if not retrieved:
        raise ConfigError("--verify orders answers among aerial submaps alone: add --setting aerial")
    for made in retrieved:
        verified = verify(made, evaluation_set, encoder, config, threads=arguments.workers, progress=display)
        save_predictions(folder / f"{verified.about.name}.npz", verified)


def _evaluate_poses(arguments: argparse.Namespace) -> None:
    target = console()
    set_up_logging(arguments.verbose, target)
    _check_pose_options(arguments)
    config = from_dict(LocalizerConfig, read_settings(arguments.set))
    output: Path = arguments.output or Path("out/evaluate") / f"pose_{arguments.benchmark}"
    if not arguments.only_score:
        with ProgressDisplay(target) as display:
            _predict_poses(arguments, config, output / POSE_PREDICTIONS, display)
    predictions, about = load_pose_predictions(output / POSE_PREDICTIONS)
    scores = score_poses(predictions, about)
    write_atomically(output / CSV, pose_results.as_csv(scores))
    write_atomically(output / JSON, pose_results.as_json(scores))
    write_atomically(output / MARKDOWN, pose_results.as_markdown(scores))
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    facts = {
        "map": f"{about.map_km2:.2f} km², {about.submaps:,} submaps",
        "scans": f"{len(predictions):,} in {len(about.area_names)} areas",
        "weights": f"{about.weights} ({about.encoder[:12]})",
        "odometry": about.odometry,
        "data": about.data,
    }
    if about.every > 1:
        facts["a quick look"] = f"one scan and one journey of {about.every}"
    words = _AMSTERDAM_WORDS[:1] if about.pose_set == "amsterdam" else _SIMULATED_WORDS
    write_pose_page(
        output / PAGE, scores, f"Poses, {about.pose_set}: {about.weights}", facts, words,
        f"Written by crossloc3d_ros {own_version()} on {today}.",
    )  # fmt: skip
    results = Console(highlight=False)
    for table in pose_tables(scores):
        results.print(table)
    print("\n".join(str(output / name) for name in (CSV, JSON, MARKDOWN)))
    print(f"{output / PAGE}   (open it in a browser)")


def _check_pose_options(arguments: argparse.Namespace) -> None:
    if arguments.workers < 1:
        raise ConfigError(f"--workers must be at least 1, got {arguments.workers}")
    if arguments.every < 1:
        raise ConfigError(f"--every must be at least 1, got {arguments.every}")
    if arguments.dataset is not None or arguments.method != "weights" or arguments.setting or arguments.query_headings:
        raise ConfigError("--protocol pose knows neither --dataset, --method, --setting nor --query-headings")
    if arguments.verify:
        raise ConfigError("--verify orders the answers of --protocol place; the localizer of --protocol pose aligns")


def _predict_poses(
    arguments: argparse.Namespace, config: LocalizerConfig, path: Path, display: ProgressDisplay
) -> None:
    loader = _loader(arguments)
    surveys = find_surveys(arguments.surveys) if arguments.benchmark == "amsterdam" else None
    pose_set = open_pose_set(
        arguments.benchmark, arguments.data, loader, workers=arguments.workers, surveys=surveys, progress=display
    )
    drives = open_drives(pose_set, workers=arguments.workers, surveys=surveys, progress=display)
    journeys = journeys_of(pose_set, drives)
    predictions = predict_poses(
        pose_set, drives, journeys, loader, config,
        odometry=arguments.odometry, every=arguments.every, workers=arguments.workers, progress=display,
    )  # fmt: skip
    about = about_of(
        pose_set, AerialMap.load(pose_set.map_folder), _label(arguments), config, arguments.odometry, arguments.every
    )
    save_pose_predictions(path, predictions, about)


def read_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Return settings given as `group.name=value` as nested groups; ConfigError where one is not of that form."""
    settings: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ConfigError(f"--set takes NAME=VALUE, such as fusion.min_probability=0.99, got '{text}'")
        *groups, last = name.split(".")
        place = settings
        for group in groups:
            place = place.setdefault(group, {})
            if not isinstance(place, dict):
                raise ConfigError(f"--set {text}: '{group}' was given a value before")
        try:
            place[last] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {text}: cannot read the value") from error
    return settings


def pose_tables(scores: PoseScores) -> list[Table]:
    """Return what the terminal shows of poses: the table of goals, and what each stage brings."""
    marks = {"goal": "✓ ", "floor": "– ", "below": "✗ ", "": ""}
    table = _table(f"Poses, {scores.about.pose_set}", ["", "measured", "95 %", "floor", "goal", "of"])
    table.columns[0].min_width = 22
    table.columns[0].overflow = "fold"
    table.caption = "✓ goal, – floor, ✗ neither; ∞: not within the drive"
    for each in scores.measures:
        floor = pose_results.wanted(each, each.floor, each.floor_high)
        goal = pose_results.wanted(each, each.goal, each.goal_high)
        measured = marks[each.verdict] + pose_results.shown(each)
        table.add_row(each.text, measured, pose_results.interval_of(each), floor, goal, f"{each.count:,}")
    shown = [table]
    for title, stages in (("Single scans", scores.stages), ("Scans along drives", scores.drive_stages)):
        part = _table(title, ["", "scans", "2 m and 5°, %", "10 m", "50 m", "median, m"])
        for stage in stages:
            middle = f"{stage.median_m:.1f}" if math.isfinite(stage.median_m) else "–"
            shares = (stage.within, stage.within_10_m, stage.within_50_m)
            part.add_row(
                stage.name, f"{stage.scans:,}", *(percent(share, 1, unit="") for share in shares), middle
            )  # fmt: skip
        if stages:
            shown.append(part)
    return shown


def _loader(arguments: argparse.Namespace) -> EncoderLoader:
    """Return what loads the method, in other processes too; there one thread each is best."""
    if arguments.method == "scan_context":
        if arguments.weights is not None:
            raise ConfigError("--method scan_context has no weights: leave --weights out")
        return ScanContext
    threads = 1 if arguments.workers > 1 else None
    return functools.partial(load_encoder, arguments.weights, arguments.device, threads)


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


def _predict(
    arguments: argparse.Namespace,
    loader: EncoderLoader,
    encoder: DescriptorEncoder,
    evaluation_set: EvaluationSet,
    output: Path,
    display: ProgressDisplay,
) -> None:
    possible = SETTINGS if evaluation_set.ground is not None else SETTINGS[:1]
    count, way = way_of(encoder)
    plan = Plan(
        settings=tuple(arguments.setting or possible),
        headings=tuple(arguments.heading),
        query_headings=tuple(arguments.query_headings or [count]),
        invariant=count == 1 or way == "mean",
        kept=arguments.verify,
    )
    job = EncodingJob(
        encoder,
        loader,
        arguments.data / "descriptors",
        arguments.workers,
        display,
    )
    made = predict_all(evaluation_set, job, plan, _label(arguments))
    folder = output / PREDICTIONS
    for before in folder.glob("*.npz"):
        before.unlink()
    for predictions in made:
        save_predictions(folder / f"{predictions.about.name}.npz", predictions)


def _read_predictions(folder: Path) -> list[Predictions]:
    found = [load_predictions(path) for path in sorted(folder.glob("*.npz"))]
    if not found:
        raise EvaluationError(f"{folder} holds no predictions: run the command without --only-score first")
    # Aerial before aerial+ground, aligned before random, few headings before many.
    order = [*SETTINGS, *HEADING_MODES]
    return sorted(
        found,
        key=lambda p: (
            order.index(p.about.setting),
            order.index(p.about.heading),
            p.about.query_headings,
            p.about.way,
            p.about.verified,
        ),
    )


def tables(scores: Sequence[Scores], main_scores: Scores) -> list[Table]:
    """Return what the terminal shows: a table a radius, and the main scores divided by group and family."""
    shown = []
    for radius in RADII_M:
        figures = [figure for figure in main_scores.overall.recalls if figure.radius_m == radius]
        names = [f"{figure.label}*" if figure.rank == PUBLISHED_ONE_PER_CENT else figure.label for figure in figures]
        table = _table(f"Within {radius:g} m, %", ["", names[0], "95 %", "by lot", *names[1:]])
        for each in scores:
            first, *others = (each.overall.recall(figure.label, radius) for figure in figures)
            table.add_row(
                describe_briefly(each.about),
                percent(first.share.value, 1, unit=""),
                f"{100 * first.share.low:.0f}–{100 * first.share.high:.0f}",
                percent(first.chance, 1, unit=""),
                *(percent(figure.share.value, 1, unit="") for figure in others),
            )
        shown.append(table)
    notes = ["* published as AR@1%: the released evaluators retrieve 25 answers"]
    if any(each.about.query_headings > 1 for each in scores):
        notes.append("8 nearest: tried in 8 headings, the nearest kept; 8 mean: by the mean of their descriptors")
    again = max(each.about.verified for each in scores)
    if again:
        notes.append(f"+ {again} height maps: so many answers ordered by retrieval + height maps; else by retrieval")
    shown[-1].caption = "\n".join(notes)
    divided = _table(
        f"{describe(main_scores.about)}, %", ["", "queries", *(f"R@1 {r:g} m" for r in RADII_M), "R@25 100 m"]
    )
    families = main_scores.families if len(main_scores.families) > 1 else ()
    for group in (*families, *main_scores.groups, main_scores.overall):
        values = [group.recall("R@1", radius) for radius in RADII_M] + [group.recall("R@25", 100.0)]
        divided.add_row(group.name, f"{group.queries:,}", *(percent(v.share.value, 1, unit="") for v in values))
    return [*shown, divided]


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(
        title=title, title_justify="left", caption_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False
    )
    for i, name in enumerate(columns):
        table.add_column(name, justify="right" if i else "left", no_wrap=bool(i))
    return table


def _texts(
    arguments: argparse.Namespace, encoder: DescriptorEncoder, evaluation_set: EvaluationSet, main_scores: Scores
) -> PageTexts:
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    ground = "none" if evaluation_set.ground is None else f"{len(evaluation_set.ground):,} scans"
    words = {
        "simulated": _SIMULATED_WORDS,
        "simulated_small": _SIMULATED_WORDS,
        "amsterdam": _AMSTERDAM_WORDS,
    }.get(evaluation_set.name, ())
    source = evaluation_set.name if arguments.dataset is None else arguments.dataset.name
    areas = len(evaluation_set.area_names)
    return PageTexts(
        title=f"Benchmark {source}: {_label(arguments)}",
        facts={
            "queries": f"{len(evaluation_set.queries):,} ground scans in {areas} area{'s' * (areas != 1)}",
            "aerial database": f"{len(evaluation_set.aerial):,} submaps",
            "ground database": ground,
            "weights": f"{_label(arguments)} ({encoder.fingerprint[:12]})",
            "descriptor": f"{main_scores.about.descriptor_size} numbers",
            "data": evaluation_set.fingerprint(),
        },
        footer=f"Written by crossloc3d_ros {own_version()} on {today}. Search: exact, by faiss.",
        cloud_width_m=2.0 * encoder.preprocessing.half_extent_m,
        words=words,
    )


_SIMULATED_WORDS = (
    "The towns are simulated and held out: their seeds belong to no training set, and the families named as held out "
    "were never learned from. Flown at one epoch, driven at another: cars, people and some trees and buildings differ.",
)
_AMSTERDAM_WORDS = (
    "The geometry is real, the scans are not: a laser was cast through a surface made of the survey of 2014 and looked "
    "for in the survey of 2010. Facades are guessed from above and nothing moves in the streets.",
    "The map is small: by lot, one answer in fifteen lies within 100 m.",
)


def _label(arguments: argparse.Namespace) -> str:
    if arguments.method == "scan_context":
        return "Scan Context"
    return "shipped weights" if arguments.weights is None else str(arguments.weights.stem)


if __name__ == "__main__":
    sys.exit(main())
