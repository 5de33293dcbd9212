"""What the commands share: how they fail, how they stop, how settings become arguments, how progress is shown."""

from __future__ import annotations

import argparse
import dataclasses
import logging
import os
import signal
import sys
import threading
import time
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from crossloc3d_ros.config import TrainConfig, check_value, from_dict
from crossloc3d_ros.errors import ConfigError, CrossLocError

T = TypeVar("T")

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141


def run(action: Callable[[], int | None]) -> int:
    """Call `action` and return the exit code of the process.

    A CrossLocError becomes one line on stderr and code 2; Ctrl-C and SIGTERM become code 130, so that a command
    that is stopped from outside cleans up as one that is stopped by hand; everything else is a bug and keeps
    its traceback.
    """
    with _terminate_as_interrupt():
        try:
            return action() or 0
        except CrossLocError as error:
            print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
            return EXIT_ERROR
        except (KeyboardInterrupt, SystemError) as error:
            # Compiled code that was being loaded when the interrupt came wraps it into a SystemError.
            if not _is_interrupt(error):
                raise
            print("interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        except BrokenPipeError:
            # The reader of our output has gone; Python would complain once more when it flushes stdout at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return EXIT_BROKEN_PIPE


@contextmanager
def interrupts_held() -> Iterator[Callable[[], None]]:
    """Hold back the first Ctrl-C or SIGTERM until the function that is yielded is called, which raises it.

    So a step is finished before a command stops: an interrupt in the midst of compiled code that is being loaded would
    leave it broken. A second signal interrupts at once.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    held = False

    def hold(number: int, frame: object) -> None:
        nonlocal held
        if held:
            raise KeyboardInterrupt
        held = True

    def let_through() -> None:
        if held:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, hold) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield let_through
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_interrupt(error: BaseException | None) -> bool:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


@contextmanager
def _terminate_as_interrupt() -> Iterator[None]:
    """Turn SIGTERM into KeyboardInterrupt while the context lasts, where signals can be handled at all."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def console() -> Console:
    """Return the console for people: stderr, so that stdout stays free for results."""
    return Console(stderr=True, highlight=False)


def set_up_logging(verbosity: int, target: Console | None = None) -> None:
    """Show this package's log on stderr: warnings and what a user should know, with `verbosity` 1 everything."""
    handler = RichHandler(console=target or console(), show_path=False, show_time=False, markup=False)
    logger = logging.getLogger("crossloc3d_ros")
    logger.handlers[:] = [handler]
    logger.setLevel(logging.DEBUG if verbosity else logging.INFO)
    logger.propagate = False


class ProgressDisplay:
    """Show how far a long command is: a bar with rate and end time, or a line now and then where nobody watches.

    Use it as a context manager and call it with what is being done, how much is done of how much, and the unit.
    """

    def __init__(self, target: Console, *, line_every_s: float = 5.0) -> None:
        self._console = target
        self._line_every_s = line_every_s
        self._bar: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._started: dict[str, tuple[float, float]] = {}
        self._last_line_s = 0.0
        if target.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description:<9}"),
                BarColumn(bar_width=None),
                TextColumn("{task.percentage:>3.0f}%"),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(elapsed_when_finished=True),
                console=target,
            )

    def __enter__(self) -> ProgressDisplay:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, stage: str, done: float, total: float, unit: str) -> None:
        """Show that `done` of `total` units of a stage are done."""
        now = time.monotonic()
        # What an earlier run did counts as done but not towards the rate.
        is_new = stage not in self._started
        begun_s, begun = self._started.setdefault(stage, (now, done))
        rate = (done - begun) / (now - begun_s) if now > begun_s else 0.0
        text = f"{done:,.0f} of {total:,.0f} {unit}" + (f", {rate:,.3g} a second" if rate > 0 else "")
        if self._bar is not None:
            if stage not in self._tasks:
                self._tasks[stage] = self._bar.add_task(stage, total=total, rate="")
            self._bar.update(self._tasks[stage], completed=done, rate=text)
        elif is_new or done >= total or now - self._last_line_s >= self._line_every_s:
            left = f", {(total - done) / rate:,.0f} s left" if rate > 0 and done < total else ""
            self._console.print(f"{stage}: {text}{left}")
            self._last_line_s = now


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Add `-v`."""
    parser.add_argument("-v", "--verbose", action="count", default=0, help="log every step")


def add_options(parser: argparse.ArgumentParser, kind: type[Any], names: Sequence[str] | None = None) -> None:
    """Add one argument for each plain field of the configuration dataclass `kind`, or for `names` alone.

    `spacing_m` becomes `--spacing-m`; help, default and range are the field's own. A value that was not given stays
    None in the namespace, so that `read_options` can tell it from one that was.
    """
    hints = typing.get_type_hints(kind)
    for item in dataclasses.fields(kind):
        hint = hints[item.name]
        plain = hint in (int, float, str, bool) or typing.get_origin(hint) is Literal
        if not plain or (names is not None and item.name not in names):
            continue
        text = f"{item.metadata.get('text', '')} (default: {item.default})"
        flag = "--" + item.name.replace("_", "-")
        if hint is bool:
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=None, help=text)
        elif typing.get_origin(hint) is Literal:
            parser.add_argument(flag, choices=typing.get_args(hint), default=None, help=text)
        else:
            parser.add_argument(flag, type=hint, default=None, metavar=hint.__name__.upper(), help=text)


def read_options(kind: type[T], namespace: argparse.Namespace) -> T:
    """Return the configuration that `add_options` asked for; out-of-range values raise ConfigError."""
    names = {item.name for item in dataclasses.fields(typing.cast(Any, kind))}
    given = {name: value for name, value in vars(namespace).items() if name in names and value is not None}
    return from_dict(kind, given)


def options_given(namespace: argparse.Namespace, kind: type[Any]) -> dict[str, Any]:
    """Return the arguments that are settings of `kind` and were given; paths as text."""
    given = {name: vars(namespace).get(name) for name in kind.__dataclass_fields__}
    return {
        name: str(value) if isinstance(value, Path) else value for name, value in given.items() if value is not None
    }


def train_config(arguments: argparse.Namespace) -> TrainConfig:
    """Return the settings of a training: the group `train` of the file `--config`, changed by the options given."""
    config = from_dict(TrainConfig, read_yaml(arguments.config).get("train", {}), where="train.")
    fields = {item.name: item for item in dataclasses.fields(TrainConfig)}
    given = {name: getattr(arguments, name) for name in fields if getattr(arguments, name, None) is not None}
    for name, value in given.items():
        check_value(name, type(value), value, fields[name].metadata)
    return dataclasses.replace(config, **given)


def read_yaml(path: Path | None) -> dict[str, Any]:
    """Return the groups `places` and `train` of a settings file; empty without a file."""
    if path is None:
        return {}
    try:
        document = yaml.safe_load(path.read_text()) or {}
    except (OSError, yaml.YAMLError) as error:
        raise ConfigError(f"cannot read {path}: {error}") from error
    if not isinstance(document, dict) or not document.keys() <= {"places", "train"}:
        raise ConfigError(f"{path} must hold the groups 'places' and 'train' and nothing else")
    return document
