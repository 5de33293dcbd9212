"""`calibrate_map`: find where a robot is localized on a map, and what the scores of its scans mean there."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Sequence
from pathlib import Path

from crossloc3d_ros.aerial_map.calibration import CALIBRATION
from crossloc3d_ros.cli.common import (
    ProgressDisplay,
    add_options,
    add_verbosity,
    console,
    read_options,
    run,
    set_up_logging,
)
from crossloc3d_ros.config import LocalizabilityConfig
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.localizability.calibrate import Localizability, calibrate_map
from crossloc3d_ros.localizability.page import PAGE
from crossloc3d_ros.localizability.raster import RASTER
from crossloc3d_ros.pages.wording import percent
from crossloc3d_ros.workers import EncoderLoader


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _calibrate(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="calibrate_map",
        description="Drive a simulated lidar through a map, off it too, and leave in the map's folder what a score "
        f"means there ({CALIBRATION}), where a robot is localized ({RASTER}), and both as a page ({PAGE}).",
    )
    parser.add_argument("map", type=Path, help="folder of the aerial map, as build_map writes it")
    parser.add_argument("--weights", type=Path, help="weights file (default: the one that comes with the package)")
    add_options(parser, LocalizabilityConfig)
    add_verbosity(parser)
    return parser


def _calibrate(arguments: argparse.Namespace) -> None:
    config = read_options(LocalizabilityConfig, arguments)
    target = console()
    set_up_logging(arguments.verbose, target)
    loader = functools.partial(load_encoder, arguments.weights, threads=1 if config.workers > 1 else None)
    with ProgressDisplay(target) as display:
        print(calibrate_and_sum_up(arguments.map, loader, config, display))


def calibrate_and_sum_up(
    folder: Path, loader: EncoderLoader, config: LocalizabilityConfig, display: ProgressDisplay
) -> str:
    """Calibrate a map and return what came of it, for people."""
    found = calibrate_map(folder, loader, config, progress=lambda p: display(p.stage, p.done, p.total, p.unit))
    return summary(folder, found)


def summary(folder: Path, found: Localizability) -> str:
    """Return what a calibration came to, for people."""
    calibration, counts = found.calibration, found.calibration.counts
    places = max(counts.places, 1)
    rows = [
        ("lidar", f"{calibration.lidar}, {calibration.lidar_height_m:g} m above the ground"),
        ("places", f"{counts.places:,} on the map; {counts.off_map:,} scans off it"),
        ("one scan", f"right in {percent(counts.right / places)}"),
        (
            "localized",
            f"at once {percent(counts.at_once / places)}, within 20 m {percent(counts.after_20_m / places)} more, "
            f"within 100 m {percent(counts.after_100_m / places)} more, never {percent(counts.never / places)}",
        ),
        ("wrong", f"{counts.wrong_fixes:,} drives with a fix more than 10 m off"),
        ("offset", f"{calibration.offset:+.2f} on log likelihoods; the most probable one is "
                   f"{calibration.unlimited_offset:+.2f} ± {calibration.offset_std:.2f}"),
        ("files", f"{folder / PAGE}, {folder / RASTER}, {folder / CALIBRATION}"),
    ]  # fmt: skip
    return "\n".join(f"{name:<9} {text}" for name, text in rows)


if __name__ == "__main__":
    raise SystemExit(main())
