"""What the commands share: how they fail, how they stop, how settings become arguments, how progress is shown."""

from __future__ import annotations

import argparse
import dataclasses
import logging
import os
import signal
import sys
import threading
import typing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

from rich.console import Console
from rich.logging import RichHandler

from crossloc3d_ros.config import from_dict
from crossloc3d_ros.errors import CrossLocError

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
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        except BrokenPipeError:
            # The reader of our output has gone; Python would complain once more when it flushes stdout at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return EXIT_BROKEN_PIPE


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
