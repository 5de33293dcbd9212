"""`compare`: train the paper's competitors, or its ablations, in one way and budget, and evaluate them in one table."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table

from crossloc3d_ros.cli import common
from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.datasets.amsterdam import find_surveys
from crossloc3d_ros.datasets.benchmarks import BENCHMARKS, open_benchmark
from crossloc3d_ros.pages.wording import percent

if TYPE_CHECKING:
    from crossloc3d_ros.training.comparison import Comparison, Result
    from crossloc3d_ros.training.comparison_table import TableTexts

TABLE_NAMES = (
    "competitors", "grains", "selection", "refinement", "sub_steps", "time_embedding", "headings", "position",
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    return common.run(lambda: _compare(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="compare",
        description="Train every row of a table on the same places, by the same recipe, for the same budget, and "
        "evaluate all on one benchmark (aerial database, random heading). An interrupted table continues; a larger "
        "budget continues the runs that exist.",
    )
    parser.add_argument("--table", choices=TABLE_NAMES, required=True, help="what is compared")
    parser.add_argument("--rows", nargs="+", default=[], metavar="ROW", help="only these rows (see --list)")
    parser.add_argument("--list", action="store_true", help="list the rows of the table and exit")
    parser.add_argument("--places", type=Path, action="append", help="folder of make-places; may be repeated")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--budget-minutes", type=float, help="time on the clock for each row")
    budget.add_argument("--budget-steps", type=int, help="batches for each row")
    parser.add_argument("--output", type=Path, help="folder (default: out/compare/TABLE)")
    parser.add_argument(
        "--benchmark", choices=list(BENCHMARKS), default="simulated_small", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("out/benchmark"),
        help="folder in which benchmarks and descriptors are kept (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--surveys", type=Path, help="folder of the two Amsterdam surveys (default: maps/amsterdam)")
    parser.add_argument("--encode-workers", type=int, default=1, help="processes that encode (default: %(default)s)")
    parser.add_argument("--only-table", action="store_true", help="write the table of the rows that are done")
    parser.add_argument("--config", type=Path, help="YAML file of which `train` is read")
    common.add_options(parser, TrainConfig)
    common.add_verbosity(parser)
    return parser


def _compare(arguments: argparse.Namespace) -> None:
    from crossloc3d_ros.training.comparison import rows_of, select
    from crossloc3d_ros.training.comparison_table import write_tables

    console = common.console()
    common.set_up_logging(arguments.verbose, console)
    config = common.train_config(arguments)
    rows = select(rows_of(arguments.table, config), arguments.rows)
    if arguments.list:
        for row in rows:
            print(f"{row.slug:<28} {row.name}")
        return
    output: Path = arguments.output or Path("out/compare") / arguments.table
    with common.ProgressDisplay(console) as display:
        comparison = _comparison(arguments, config, rows, output, console, display)
        texts = _texts(arguments, comparison)
        comparison.row_done = lambda results: _show(results, write_tables(output, results, texts), console)
        if arguments.only_table:
            results = comparison.results()
            write_tables(output, results, texts)
        else:
            results = comparison.run()
    Console(highlight=False).print(_terminal_table(results))
    for path in write_tables(output, results, texts):
        print(path)


def _comparison(
    arguments: argparse.Namespace,
    config: TrainConfig,
    rows: Sequence[Any],
    output: Path,
    console: Console,
    display: common.ProgressDisplay,
) -> Comparison:
    from crossloc3d_ros.errors import ConfigError
    from crossloc3d_ros.training.comparison import Comparison
    from crossloc3d_ros.training.schedule import Budget

    learning = any(row.config is not None for row in rows)
    if not arguments.only_table and learning:
        if not arguments.places:
            raise ConfigError("name the places to learn from by --places")
        if arguments.budget_minutes is None and arguments.budget_steps is None:
            raise ConfigError("give each row a budget: --budget-minutes or --budget-steps")
    if arguments.encode_workers < 1:
        raise ConfigError(f"--encode-workers must be at least 1, got {arguments.encode_workers}")
    none_given = arguments.budget_minutes is None and arguments.budget_steps is None
    evaluation_set = open_benchmark(
        arguments.benchmark,
        arguments.data,
        config.preprocessing,
        workers=arguments.encode_workers,
        surveys=find_surveys(arguments.surveys) if arguments.benchmark == "amsterdam" else None,
        progress=display,
    )

    def report(slug: str, progress: Any) -> None:
        line = f"{slug}: {100 * progress.share:5.1f} %  step {progress.step:6,}  loss {progress.loss:7.4f}"
        if progress.validation is None:
            line += f"  {progress.samples_per_second:5.1f} clouds/s"
        else:
            line += f"  validation: R@1 {100 * progress.validation.recall('R@1', 100.0).share.value:.1f} % at 100 m"
        console.print(line, soft_wrap=True)

    return Comparison(
        rows=rows,
        places=arguments.places or [],
        folder=output,
        budget=Budget(minutes=arguments.budget_minutes, steps=1 if none_given else arguments.budget_steps),
        evaluation_set=evaluation_set,
        preprocessing=config.preprocessing,
        cache=arguments.data / "descriptors",
        workers=arguments.encode_workers,
        report=report,
        encoding=display,
    )


def _texts(arguments: argparse.Namespace, comparison: Comparison) -> TableTexts:
    from crossloc3d_ros.training.comparison_table import TableTexts

    found = comparison.evaluation_set
    places = ", ".join(map(str, arguments.places or [])) or "as noted with each run"
    if arguments.budget_minutes is not None:
        budget = f"{arguments.budget_minutes:g} minutes"
    else:
        budget = f"{arguments.budget_steps:,} batches" if arguments.budget_steps else "as noted with each run"
    return TableTexts(
        title=f"{arguments.table.replace('_', ' ').capitalize()} on {arguments.benchmark}",
        facts=(
            f"{len(found.queries):,} queries of random heading in {len(found.area_names)} areas, against "
            f"{len(found.aerial):,} aerial submaps ({found.fingerprint()}).",
            f"Places learned from: {places}. Budget of each row: {budget}. Settings, seed and log of each row lie in "
            "its folder.",
        ),
    )


def _show(results: Sequence[Result], written: Sequence[Path], console: Console) -> None:
    """Say how far the table is."""
    last = results[-1]
    console.print(
        f"{last.name}: R@1 {percent(last.recall(1, 100.0).share.value, 1)} at 100 m, "
        f"{percent(last.recall(1, 25.0).share.value, 1)} at 25 m; {len(results)} rows in {written[0]}",
        soft_wrap=True,
    )


def _terminal_table(results: Sequence[Result]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for i, name in enumerate(("", "R@1 100 m", "R@25 100 m", "R@1 25 m", "parameters", "ms, 1 thread")):
        table.add_column(name, justify="right" if i else "left")
    for result in results:
        found = (result.recall(1, 100.0).share, result.recall(25, 100.0).share, result.recall(1, 25.0).share)
        shares = [f"{100 * share.value:.1f} [{100 * share.low:.0f}–{100 * share.high:.0f}]" for share in found]
        size = f"{result.parameters / 1e6:.2f} M" if result.parameters else "none"
        table.add_row(result.name, *shares, size, f"{result.one_thread_ms:.0f}")
    return table


if __name__ == "__main__":
    sys.exit(main())
