"""Make training places, train on them, write the weights and their card."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from crossloc3d_ros.cli import common
from crossloc3d_ros.config import PlacesConfig, TrainConfig, VerificationConfig, from_dict
from crossloc3d_ros.errors import ConfigError


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = _parser().parse_args(argv)
    common.set_up_logging(arguments.verbose)
    return common.run(lambda: arguments.action(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="train", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    places = commands.add_parser("make-places", help="simulate towns, their surveys and scans in them")
    places.add_argument("--towns", type=int, default=40, help="training towns (default: 40)")
    places.add_argument("--validation-towns", type=int, default=6, help="validation towns (default: 6)")
    places.add_argument("--seed", type=int, default=1, help="another seed, other towns (default: 1)")
    places.add_argument(
        "--survey", nargs="+", metavar="FILE",
        help="instead of towns: drive through the surface of this survey (LAS or LAZ), to train for the area of a map",
    )  # fmt: skip
    places.add_argument("--scans", type=int, default=1200, help="scans in the survey (default: 1200)")
    places.add_argument("--crs", help="of survey files that name none, such as EPSG:28992")
    places.add_argument("--output", type=Path, required=True, help="folder; towns that it holds already are kept")
    places.add_argument("--config", type=Path, help="YAML file of which `places` and `train` are read")
    places.add_argument("--workers", type=int, default=1, help="processes (default: 1)")
    places.set_defaults(action=_make_places)

    run = commands.add_parser("run", help="train until the budget is used")
    run.add_argument(
        "--places", type=Path, required=True, action="append",
        help="folder of make-places, may be repeated; or a dataset, of make_dataset or a published one",
    )  # fmt: skip
    run.add_argument(
        "--preset", choices=["campus", "oxford", "plain"], help="kind of a dataset (default: by its files)"
    )
    run.add_argument("--output", type=Path, required=True, help="folder of the run")
    budget = run.add_mutually_exclusive_group(required=True)
    budget.add_argument("--budget-minutes", type=float, help="time on the clock, validation included")
    budget.add_argument("--budget-steps", type=int, help="batches: the same result to the bit, however often resumed")
    run.add_argument("--initial", type=Path, metavar="WEIGHTS", help="start from the tensors of these weights that fit")
    run.add_argument("--resume", action="store_true", help="continue the run in --output")
    run.add_argument("--config", type=Path, help="YAML file of which `train` is read")
    common.add_options(run, TrainConfig)
    run.set_defaults(action=_run)

    export = commands.add_parser(
        "export", help="write the weights of a run, also of one that is still going or was killed"
    )
    export.add_argument("run", type=Path, help="folder of the run")
    export.add_argument("--places", type=Path, action="append", default=[], help="where its places are, if moved")
    export.add_argument(
        "--output", type=Path, required=True, help="file to write (.safetensors); the card lies beside it"
    )
    export.set_defaults(action=_export)

    card = commands.add_parser("card", help="write the card of exported weights with the results of benchmarks")
    card.add_argument("run", type=Path, help="folder of the run that the weights are from")
    card.add_argument("--weights", type=Path, required=True, help="exported weights; the card lies beside them")
    card.add_argument("--places", type=Path, action="append", default=[], help="where its places are, if moved")
    card.add_argument(
        "--results", type=Path, nargs="+", default=[], metavar="JSON", help="results.json of evaluate, of these weights"
    )
    card.set_defaults(action=_card)

    curve = commands.add_parser("curve", help="draw loss, validation and rate of a run as an HTML page")
    curve.add_argument("run", type=Path, help="folder of the run")
    curve.add_argument("--output", type=Path, help="file to write (default: progress.html in the run)")
    curve.set_defaults(action=_curve)
    alignment = commands.add_parser(
        "alignment", help="fit the observation model of the alignment and the weights of its local null hypothesis"
    )
    alignment.add_argument(
        "--data",
        type=Path,
        default=Path("out/benchmark"),
        help="folder in which pose sets are kept (default: %(default)s)",
    )
    alignment.add_argument(
        "--surveys", type=Path, nargs="+", metavar="LAZ",
        help="real surveys to learn from beside the simulated towns: files, folders, globs",
    )  # fmt: skip
    alignment.add_argument("--weights", type=Path, help="weights of the sets' maps (default: the shipped ones)")
    alignment.add_argument("--workers", type=int, default=1, help="processes that make the sets (default: 1)")
    alignment.add_argument("--output", type=Path, required=True, help="file to write (.safetensors)")
    alignment.set_defaults(action=_alignment)

    verification = commands.add_parser(
        "verification", help="fit the weight of height maps beside descriptors for `evaluate --verify`"
    )
    verification.add_argument(
        "--places", type=Path, required=True, action="append",
        help="folder of make-places whose validation towns are used, may be repeated",
    )  # fmt: skip
    verification.add_argument("--weights", type=Path, help="weights of the retrieval (default: the shipped ones)")
    verification.add_argument(
        "--candidates",
        type=int,
        default=300,
        help="retrieved submaps of a query that are compared (default: %(default)s)",
    )
    verification.add_argument(
        "--data", type=Path, default=Path("out/benchmark"),
        help="folder in which descriptors are kept (default: %(default)s)",
    )  # fmt: skip
    verification.add_argument("--workers", type=int, default=1, help="processes (default: 1)")
    verification.set_defaults(action=_verification)

    for command in (places, run, export, card, curve, alignment, verification):
        common.add_verbosity(command)
    return parser


def _alignment(arguments: argparse.Namespace) -> int:
    import functools

    from crossloc3d_ros.datasets.belief_sets import BeliefRequest, open_belief_sets
    from crossloc3d_ros.encoder.checkpoint import load_encoder
    from crossloc3d_ros.formats.las import expand_inputs
    from crossloc3d_ros.localization.alignment.observation_model import MEASURES
    from crossloc3d_ros.training.alignment import fit_alignment
    from crossloc3d_ros.training.learning_sets import learning_sets

    target = common.console()
    with common.ProgressDisplay(target) as display:
        loader = functools.partial(load_encoder, arguments.weights, "cpu", 1)
        surveys = tuple(expand_inputs(arguments.surveys)) if arguments.surveys else ()
        request = BeliefRequest(("fitting",), arguments.data, learned=surveys)
        sets = open_belief_sets(request, loader, workers=arguments.workers, progress=display)
        model, measured = fit_alignment(learning_sets(sets), progress=display)
    model.save(arguments.output)
    found = sum(poses.right == 0 for poses in measured)
    weights = ", ".join(f"{name} {weight:.2f}" for name, weight in zip(MEASURES, model.weights, strict=False))
    target.print(
        f"{arguments.output}: {len(measured)} scans on {len({poses.set_name for poses in measured})} maps, {found} of "
        f"them right at once; weights: {weights}, constant {model.weights[-1]:.2f}"
    )
    return 0


def _verification(arguments: argparse.Namespace) -> int:
    import functools

    from crossloc3d_ros.encoder.checkpoint import load_encoder
    from crossloc3d_ros.evaluation.retrieval.encoding import EncodingJob
    from crossloc3d_ros.evaluation.statistics import RADII_M
    from crossloc3d_ros.training.material import read_material
    from crossloc3d_ros.training.verification import fit_verification

    if arguments.workers < 1:
        raise ConfigError(f"--workers must be at least 1, got {arguments.workers}")
    candidates = from_dict(VerificationConfig, {"candidates": arguments.candidates}).candidates
    threads = 1 if arguments.workers > 1 else None
    loader = functools.partial(load_encoder, arguments.weights, "cpu", threads)
    encoder = loader()
    towns = read_material(arguments.places, encoder.preprocessing).validation_towns(TrainConfig())
    with common.ProgressDisplay(common.console()) as display:
        job = EncodingJob(encoder, loader, arguments.data / "descriptors", arguments.workers, display)
        fitted = fit_verification(towns, job, candidates, arguments.workers)
    print(f"{fitted.queries:,} queries among {fitted.submaps:,} submaps of {fitted.towns} towns; R@1, each town by the "
          "weight of the others:")  # fmt: skip
    for radius, before, after in zip(RADII_M, fitted.retrieval, fitted.verified, strict=True):
        print(f"  within {radius:3.0f} m: retrieval {100 * before:.1f} %, with height maps {100 * after:.1f} %")
    low, high = min(fitted.town_weights), max(fitted.town_weights)
    print(f"weight {fitted.weight:.3g} (without one town {low:.3g} to {high:.3g}): evaluate --verify {candidates} "
          f"--verify-weight {fitted.weight:.3g}")  # fmt: skip
    return 0


def _make_places(arguments: argparse.Namespace) -> int:
    from crossloc3d_ros.training.places import make_places
    from crossloc3d_ros.training.survey_places import make_survey_places

    console = common.console()
    document = common.read_yaml(arguments.config)
    settings = {
        "seed": arguments.seed,
        "config": from_dict(PlacesConfig, document.get("places", {}), where="places."),
        "preprocessing": from_dict(TrainConfig, document.get("train", {}), where="train.").preprocessing,
        "report": lambda made: console.print(
            f"{made.done:4d} of {made.total} towns  {made.town.family:<12} {made.town.scans:4d} scans  "
            f"{made.town.submaps:4d} submaps  {made.town.seconds:5.1f} s  ends in {_duration(made.remaining_s)}",
            soft_wrap=True,
        ),
    }
    if arguments.survey:
        manifest = make_survey_places(
            arguments.output, arguments.survey, scans=arguments.scans, crs=arguments.crs, **settings
        )
    else:
        counts = {"towns": arguments.towns, "validation_towns": arguments.validation_towns}
        manifest = make_places(arguments.output, **counts, workers=arguments.workers, **settings)
    print(f"{arguments.output}: {sum(t.scans for t in manifest.towns):,} scans in {len(manifest.towns)} towns")
    return 0


def _run(arguments: argparse.Namespace) -> int:
    from crossloc3d_ros.training.loop import Trainer
    from crossloc3d_ros.training.schedule import Budget

    budget = Budget(minutes=arguments.budget_minutes, steps=arguments.budget_steps)
    config = common.train_config(arguments)
    show = _progress(common.console())
    trainer = Trainer(
        config, arguments.places, arguments.output, budget, arguments.initial, arguments.preset, report=show
    )
    validation = trainer.run(resume=arguments.resume)
    trainer.write_card()
    for recall in validation.recalls:
        share, chance = 100 * recall.share.value, 100 * recall.chance
        print(f"{recall.label:>5} within {recall.radius_m:3.0f} m: {share:5.1f} %  (chance {chance:.1f} %)")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    from crossloc3d_ros.training.loop import export_run

    card = export_run(arguments.run, arguments.output, arguments.places)
    print(f"{arguments.output}\n{card}")
    return 0


def _card(arguments: argparse.Namespace) -> int:
    from crossloc3d_ros.training.loop import write_card
    from crossloc3d_ros.training.material import read_material

    material = read_material(arguments.places) if arguments.places else None
    print(write_card(arguments.run, arguments.weights, material, arguments.results))
    return 0


def _curve(arguments: argparse.Namespace) -> int:
    from crossloc3d_ros.training.curve import write_curve

    print(f"{write_curve(arguments.run, arguments.output)}   (open it in a browser)")
    return 0


def _progress(console: Console) -> Any:
    def show(progress: Any) -> None:
        line = (
            f"{100 * progress.share:5.1f} %  step {progress.step:6,}  loss {progress.loss:7.4f}  "
            f"rate {progress.learning_rate:.1e}"
        )
        if progress.validation is None:
            console.print(
                f"{line}  {progress.samples_per_second:5.1f} clouds/s  ends in {_duration(progress.remaining_s)}",
                soft_wrap=True,
            )
        else:
            near, far = progress.validation.recall("R@1", 25.0), progress.validation.recall("R@1", 100.0)
            most = progress.validation.recall("R@25", 100.0)
            console.print(
                f"{line}  validation: R@1 {100 * far.share.value:.1f} % at 100 m (chance {100 * far.chance:.1f} %), "
                f"{100 * near.share.value:.1f} % at 25 m; R@25 {100 * most.share.value:.1f} % at 100 m",
                soft_wrap=True,
            )

    return show


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


if __name__ == "__main__":
    raise SystemExit(main())
