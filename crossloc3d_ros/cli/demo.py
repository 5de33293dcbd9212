"""`demo`: the whole chain on real data. A map of 2010, a drive through the town of 2014, the real node in between."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli.common import ProgressDisplay, add_verbosity, console, run, set_up_logging
from crossloc3d_ros.datasets.amsterdam import DRIVE_SURVEY, MAP_SURVEY, find_surveys
from crossloc3d_ros.datasets.amsterdam_drive import ODOMETRY_TOPIC, TOPIC, DemoDrive, make_drive, make_map, remove
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.evaluation.drives.evaluation import ESTIMATES, evaluate
from crossloc3d_ros.evaluation.drives.page import About
from crossloc3d_ros.evaluation.drives.results import PAGE, remove_results, write_results
from crossloc3d_ros.evaluation.drives.terminal import beside_the_truth, result_tables
from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.pages.wording import written_by
from crossloc3d_ros.types import DescriptorEncoder, Estimate, FixStatus


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _demo(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="demo",
        description="Build the Amsterdam map, drive a simulated VLP-16 through the town as it was four years later, "
        "play the drive into the real localizer node over DDS, and write what came of it.",
    )
    parser.add_argument("--output", type=Path, default=Path("out/demo"), help="folder (default: %(default)s)")
    parser.add_argument("--surveys", type=Path, help="folder with the two surveys (default: maps/amsterdam)")
    parser.add_argument("--weights", type=Path, help="weights file (default: the one that comes with the package)")
    parser.add_argument("--fresh", action="store_true", help="make map and drive again even if they are current")
    drive_defaults = DemoDrive()
    parser.add_argument("--length-m", type=float, default=drive_defaults.length_m, help="(default: %(default)s)")
    parser.add_argument("--speed-m-s", type=float, default=drive_defaults.speed_m_s, help="(default: %(default)s)")
    parser.add_argument("--seed", type=int, default=drive_defaults.seed, help="of the drive (default: %(default)s)")
    add_verbosity(parser)
    return parser


def _demo(arguments: argparse.Namespace) -> None:
    begun = time.monotonic()
    target = console()
    set_up_logging(arguments.verbose, target)
    localize_live = _live()
    output: Path = arguments.output
    map_folder, bag_path = output / "map", output / "drive"
    survey_map, survey_drive = (find_surveys(arguments.surveys) / name for name in (MAP_SURVEY, DRIVE_SURVEY))
    plan = DemoDrive(arguments.length_m, arguments.speed_m_s, seed=arguments.seed)
    if arguments.fresh:
        for folder in (map_folder, output / "map.build", bag_path):
            remove(folder)

    _headline(target, 1, f"the aerial map, from {survey_map.name}")
    encoder = load_encoder(arguments.weights)
    with ProgressDisplay(target) as display:
        make_map(survey_map, map_folder, arguments.weights, encoder.fingerprint, target.print, display)
    aerial_map = AerialMap.load(map_folder, encoder.fingerprint)
    target.print(f"{map_folder}: {len(aerial_map.submaps):,} submaps")

    _headline(target, 2, f"a drive with a simulated VLP-16 through {survey_drive.name}")
    with ProgressDisplay(target) as display:
        make_drive(survey_drive, bag_path, plan, target.print, display)

    _headline(target, 3, "the localizer node, listening over DDS")
    remove_results(output)
    log_path = output / "localizer.log"
    parameters = {} if arguments.weights is None else {"weights": str(arguments.weights.resolve())}
    with open_bag(bag_path) as bag, ProgressDisplay(target) as display:
        seconds = (bag.end_ns - bag.start_ns) / 1e9
        target.print(f"starting it; its log is {log_path}")
        live = localize_live(
            bag,
            TOPIC,
            map_folder,
            aerial_map.frame,
            output / ESTIMATES,
            odometry_topic=ODOMETRY_TOPIC,
            parameters=parameters,
            log_path=log_path,
            on_started=lambda s: target.print(f"up and warm after {s:.1f} s; playing {seconds:.0f} s in real time"),
            progress=lambda done, total, newest: display("play", done, total, f"scans; {_in_brief(newest)}"),
        )
    target.print(
        f"{live.estimates:,} estimates for {live.scans:,} scans; the player was late by "
        f"{live.play.late_median_ms:.1f} ms in the median, {live.play.late_p99_ms:.1f} ms at 99 %"
    )

    _headline(target, 4, "what came of it")
    with open_bag(bag_path) as bag:
        evaluation = evaluate(bag, output, aerial_map)
    results = Console(highlight=False)
    for table in (beside_the_truth(evaluation.table, aerial_map.frame), *result_tables(evaluation)):
        results.print(table)

    _headline(target, 5, "the page")
    write_results(output, evaluation, aerial_map, _about(arguments, encoder, live.scans, live.estimates))
    print(f"{output / PAGE}   (open it in a browser)")
    target.print(f"done in {time.monotonic() - begun:.0f} s")


def _about(arguments: argparse.Namespace, encoder: DescriptorEncoder, scans: int, estimates: int) -> About:
    dropped = scans - estimates
    unanswered = [f"{dropped:,} scans got no estimate (dropped or lost on the way); they count as misses."]
    return About(
        title="A robot in Amsterdam, localized",
        facts={
            "map": "AHN2, flown 2010",
            "drive": "simulated VLP-16 in AHN3, flown 2014",
            "weights": f"{arguments.weights or 'as shipped'} ({encoder.fingerprint[:12]})",
            "odometry": "of the wheels, drifting",
            "run": "the real node as a process, the bag played into it over DDS in real time",
            "unanswered": f"{dropped:,} of {scans:,} scans",
        },
        notes=(
            "The drive is simulated. The laser was cast through a surface made of the 2014 survey, the map is of 2010, "
            "so trees have grown and houses have changed; but facades are guessed from above, few people and cars "
            "move, and the sensor has no faults beyond noise. A real drive will be harder.",
        ),
        footer=f"{written_by()} Aerial data: AHN, Rijkswaterstaat / PDOK, CC0.",
        latency_is="from publishing the cloud to receiving the fix, over DDS, between two processes",
        extra_words=(
            *(unanswered if dropped else []),
            "Map and drive share the town, not the survey: nothing was aligned or tuned on it, and the weights were "
            "trained on simulated towns alone.",
            "The map is small. A whole city holds many more streets that look alike.",
        ),
    )


def _in_brief(newest: Estimate | None) -> str:
    if newest is None:
        return "no estimate yet"
    if newest.status is not FixStatus.FIX:
        return f"no fix, {newest.state.value}"
    return f"fix {newest.latitude_deg:.5f}, {newest.longitude_deg:.5f}"


def _headline(target: Console, step: int, text: str) -> None:
    target.print(f"\n[bold]{step}/5  {text}[/bold]")


def _live() -> Any:
    try:
        from crossloc3d_ros.replay.live import localize_live
    except ImportError as error:
        raise CrossLocError(
            f"ROS 2 was not found ({error}): source /opt/ros/jazzy/setup.bash, or pip install ros-jazzy-rclpy "
            "ros-jazzy-common-interfaces ros-jazzy-rmw-fastrtps-cpp"
        ) from error
    return localize_live


if __name__ == "__main__":
    sys.exit(main())
