"""What the commands share: exit codes, settings as arguments, progress."""

from __future__ import annotations

import argparse
import io
import os
import signal

import pytest
from rich.console import Console

from crossloc3d_ros.cli.common import ProgressDisplay, add_options, interrupts_held, read_options, run
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig
from crossloc3d_ros.errors import ConfigError, MapError


def raising(error: BaseException) -> object:
    def action() -> int:
        raise error

    return action


def test_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(lambda: None) == 0
    assert run(lambda: 3) == 3
    assert run(raising(MapError("a map\nis broken"))) == 2  # type: ignore[arg-type]
    assert capsys.readouterr().err == "error: a map is broken\n"
    assert run(raising(KeyboardInterrupt())) == 130  # type: ignore[arg-type]
    with pytest.raises(ZeroDivisionError):
        run(lambda: 1 // 0)


def test_being_terminated_is_being_interrupted() -> None:
    before = signal.getsignal(signal.SIGTERM)
    assert run(lambda: os.kill(os.getpid(), signal.SIGTERM)) == 130
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_held_interrupt_comes_through_between_steps(number: int) -> None:
    steps: list[str] = []

    def action() -> None:
        with interrupts_held() as let_through:
            let_through()
            os.kill(os.getpid(), number)
            steps.append("finished")
            let_through()
            steps.append("another")

    before = signal.getsignal(signal.SIGINT)
    assert run(action) == 130
    assert steps == ["finished"]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_interrupt_is_not_held() -> None:
    def action() -> None:
        with interrupts_held():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            pytest.fail("still running")

    assert run(action) == 130


def test_an_interrupt_inside_of_loading_compiled_code_is_one() -> None:
    def action() -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error

    assert run(action) == 130
    with pytest.raises(SystemError):
        run(raising(SystemError("another")))  # type: ignore[arg-type]


def parse(kind: type, arguments: list[str], names: list[str] | None = None) -> object:
    parser = argparse.ArgumentParser()
    add_options(parser, kind, names)
    return read_options(kind, parser.parse_args(arguments))


def test_settings_become_arguments() -> None:
    assert parse(BuildConfig, []) == BuildConfig()
    assert parse(BuildConfig, ["--spacing-m", "25", "--workers", "3"]) == BuildConfig(spacing_m=25.0, workers=3)
    assert parse(BuildConfig, ["--spacing", "25"]) == BuildConfig(spacing_m=25.0)
    assert parse(PreprocessingConfig, ["--vertical-origin", "centre"]).vertical_origin == "centre"  # type: ignore[attr-defined]


def test_settings_out_of_range_or_unknown_are_refused() -> None:
    with pytest.raises(ConfigError, match="'workers' must lie between"):
        parse(BuildConfig, ["--workers", "0"])
    with pytest.raises(SystemExit):
        parse(BuildConfig, ["--cell-m", "1"], ["workers"])
    with pytest.raises(SystemExit):
        parse(PreprocessingConfig, ["--vertical-origin", "sky"])


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_is_shown_with_a_rate(terminal: bool) -> None:
    text = io.StringIO()
    with ProgressDisplay(Console(file=text, force_terminal=terminal, width=120), line_every_s=0.0) as display:
        for done in (0, 50, 100):
            display("reading", done, 100, "points")
    assert "reading" in text.getvalue() and "100 of 100 points" in text.getvalue() and "a second" in text.getvalue()
