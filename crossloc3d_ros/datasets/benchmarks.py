"""The benchmarks by name: made once, kept in a folder, made anew where they are stale."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.datasets import amsterdam, simulated
from crossloc3d_ros.datasets.amsterdam import AMSTERDAM, AmsterdamBenchmark
from crossloc3d_ros.datasets.place_sets import EvaluationSet, join_sets, load_set, read_settings, save_set
from crossloc3d_ros.datasets.simulated import SIMULATED, SIMULATED_SMALL, BenchmarkTown, SimulatedBenchmark
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.files import lock
from crossloc3d_ros.workers import open_workers

_log = logging.getLogger(__name__)

BENCHMARKS: dict[str, SimulatedBenchmark | AmsterdamBenchmark] = {
    "simulated": SIMULATED,
    "simulated_small": SIMULATED_SMALL,
    "amsterdam": AMSTERDAM,
}

Progress = Callable[[str, float, float, str], None]
Task = TypeVar("Task")


@dataclass(frozen=True)
class _TownTask:
    town: BenchmarkTown
    benchmark: SimulatedBenchmark
    preprocessing: PreprocessingConfig
    folder: Path
    settings: dict[str, Any]


def open_benchmark(
    name: str,
    data: Path,
    preprocessing: PreprocessingConfig,
    *,
    workers: int = 1,
    surveys: Path | None = None,
    progress: Progress | None = None,
) -> EvaluationSet:
    """Return a benchmark of `BENCHMARKS`, made for the preprocessing of the weights that are to be evaluated.

    It is kept in `data/NAME-HASH`, where the hash is that of every setting and of the simulator's towns: a set that
    was made in another way is never taken for this one. A call that was stopped goes on town by town. `surveys`: the
    folder of the two surveys, for Amsterdam. Raises ConfigError for an unknown name and EvaluationError for what
    cannot be made or written.
    """
    if name not in BENCHMARKS:
        raise ConfigError(f"unknown benchmark '{name}'; known are: {', '.join(BENCHMARKS)}")
    benchmark, report = BENCHMARKS[name], progress or (lambda stage, done, total, unit: None)
    if isinstance(benchmark, SimulatedBenchmark):
        return _open_simulated(name, benchmark, data, preprocessing, workers, report)
    if surveys is None:
        raise EvaluationError(f"the benchmark '{name}' needs the folder of its two surveys")
    settings = plain(amsterdam.settings_of(benchmark, surveys, preprocessing))
    folder = folder_of(data, name, settings)
    made = _current(folder, settings)
    if made is not None:
        return made
    with alone(folder):
        if (made := _current(folder, settings)) is None:
            save_set(folder, amsterdam.make_amsterdam_set(benchmark, surveys, preprocessing, data, report), settings)
            made = load_set(folder, verify=True)
    return made


def _open_simulated(
    name: str,
    benchmark: SimulatedBenchmark,
    data: Path,
    preprocessing: PreprocessingConfig,
    workers: int,
    report: Progress,
) -> EvaluationSet:
    settings = plain(simulated.settings_of(benchmark, preprocessing))
    folder = folder_of(data, name, settings)
    folders = {town: folder / f"{town.family}_{town.seed}" for town in benchmark.towns}

    def finished() -> dict[BenchmarkTown, EvaluationSet]:
        return {town: found for town in benchmark.towns if (found := _current(folders[town], settings)) is not None}

    made = finished()
    if len(made) == len(benchmark.towns):
        return join_sets(name, [made[town] for town in benchmark.towns])
    with alone(folder):
        made = finished()
        missing = [town for town in benchmark.towns if town not in made]
        done, total = len(made), len(benchmark.towns)
        report("making", done, total, "towns")

        def advance(towns: int) -> None:
            nonlocal done
            done += towns
            report("making", done, total, "towns")

        tasks = [_TownTask(town, benchmark, preprocessing, folders[town], settings) for town in missing]
        without_encoder(_make_town, tasks, workers, folder, advance)
        made |= {town: load_set(folders[town], verify=True) for town in missing}
    return join_sets(name, [made[town] for town in benchmark.towns])


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Wait until no other process makes the same set; what it has made is found then."""

    def wait(holder: str) -> None:
        _log.warning("another process (%s) makes %s: waiting for it", holder, folder)

    with lock(folder.with_name(f".{folder.name}.lock"), EvaluationError, wait):
        yield


def _make_town(task: _TownTask, advance: Callable[[int], None] | None) -> None:
    town_set = simulated.make_town_set(task.town, task.benchmark, task.preprocessing)
    save_set(task.folder, town_set, task.settings)
    if advance is not None:
        advance(1)


def without_encoder(
    make: Callable[[Task, Callable[[int], None] | None], None],
    tasks: Sequence[Task],
    workers: int,
    folder: Path,
    advance: Callable[[int], None],
) -> None:
    """Do tasks that need no encoder, in so many processes; `advance` counts those done."""
    with open_workers(None, None, workers, None, folder) as pool:
        for _ in pool.run(make, ((task, 1) for task in tasks), advance):
            pass


def _current(folder: Path, settings: dict[str, Any]) -> EvaluationSet | None:
    """Return the set in a folder if it is whole and was made with these settings."""
    if not folder.exists():
        return None
    try:
        found = load_set(folder, verify=True)
        if read_settings(folder) == settings:
            return found
        _log.warning("%s was made with other settings and is made anew", folder)
    except EvaluationError as error:
        _log.warning("made anew: %s", error)
    return None


def folder_of(data: Path, name: str, settings: dict[str, Any]) -> Path:
    """Return where a set of these settings lies, and say so where older ones lie beside it."""
    key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    folder = data / f"{name}-{key}"
    try:
        data.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EvaluationError(f"cannot make {data}: {error.strerror or error}") from error
    others = sorted(path.name for path in data.glob(f"{name}-????????") if path != folder)
    if others and not folder.exists():
        _log.warning(
            "%s holds %s made with other settings or another simulator (%s): not used, made anew as %s",
            data, name, ", ".join(others), folder.name,
        )  # fmt: skip
    return folder


def plain(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings as they come back from JSON."""
    return dict(json.loads(json.dumps(settings)))
