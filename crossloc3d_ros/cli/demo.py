"""`demo`: the whole chain on real data. A map of 2010, a drive through the town of 2014, the real node in between."""

from __future__ import annotations

import argparse
import datetime
import functools
import json
import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.store import AerialMap, sha256
from crossloc3d_ros.cli.common import ProgressDisplay, add_verbosity, console, run, set_up_logging
from crossloc3d_ros.cli.replay import PAGE, own_version, print_results, remove_results, write_results
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import CrossLocError, MapError
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable
from crossloc3d_ros.evaluation.drives.evaluation import ESTIMATES, evaluate
from crossloc3d_ros.evaluation.drives.page import About
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.formats.bag import POINT_CLOUD, open_bag
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.pages.wording import UNKNOWN, degrees, metres, percent
from crossloc3d_ros.simulation.drive import DriveConfig, drive
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.types import DescriptorEncoder, Estimate, FixStatus

MAP_SURVEY, DRIVE_SURVEY = "ahn2_2010.laz", "ahn3_2014.laz"
# Ellipsoidal height minus NAP in Amsterdam, rounded to the metre.
GEOID_SEPARATION_M = 43.0
TOPIC, ODOMETRY_TOPIC = "/velodyne_points", "/odom"
_SHOWN_EVERY_S = 5.0


@dataclass(frozen=True)
class DemoDrive:
    """The drive: long enough for some twenty different places, short enough to be watched."""

    length_m: float = 600.0
    speed_m_s: float = 5.0
    clearance_m: float = 1.5
    seed: int = 3


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
            shutil.rmtree(folder, ignore_errors=True)
            _stamp_of(folder).unlink(missing_ok=True)

    _headline(target, 1, f"the aerial map, from {survey_map.name}")
    encoder = load_encoder(arguments.weights)
    make_map(survey_map, map_folder, arguments.weights, encoder.fingerprint, target)
    aerial_map = AerialMap.load(map_folder, encoder.fingerprint)
    target.print(f"{map_folder}: {len(aerial_map.submaps):,} submaps")

    _headline(target, 2, f"a drive with a simulated VLP-16 through {survey_drive.name}")
    make_drive(survey_drive, bag_path, plan, target)

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
        f"{live.answers:,} answers to {live.scans:,} scans; the player was late by {live.play.late_median_ms:.1f} ms "
        f"in the median, {live.play.late_p99_ms:.1f} ms at 99 %"
    )

    _headline(target, 4, "what came of it")
    with open_bag(bag_path) as bag:
        evaluation = evaluate(bag, output, aerial_map)
    results = Console(highlight=False)
    results.print(beside_the_truth(evaluation.table, aerial_map.frame))
    print_results(evaluation, results)

    _headline(target, 5, "the page")
    write_results(output, evaluation, aerial_map, _about(arguments, encoder, live.scans, live.answers))
    print(f"{output / PAGE}   (open it in a browser)")
    target.print(f"done in {time.monotonic() - begun:.0f} s")


def find_surveys(folder: Path | None) -> Path:
    """Return the folder with the two surveys: the given one, or the clone's `maps/amsterdam`; MapError otherwise."""
    choices = [folder] if folder is not None else [Path("maps/amsterdam"), _clone() / "maps" / "amsterdam"]
    for choice in choices:
        if all((choice / name).is_file() for name in (MAP_SURVEY, DRIVE_SURVEY)):
            return choice
    raise MapError(
        f"{choices[0]} does not hold {MAP_SURVEY} and {DRIVE_SURVEY}; run the demo in a clone of the repository, or "
        "name their folder with --surveys"
    )


def make_map(survey: Path, folder: Path, weights: Path | None, fingerprint: str, target: Console) -> None:
    """Build the map, unless the one that is there was made by these weights from this file with these settings."""
    cores = min(os.cpu_count() or 1, 4)
    config = BuildConfig()
    stamp = _stamp_of(folder)
    made_from = {
        "survey": sha256(survey),
        "encoder": fingerprint,
        "config": asdict(config),
        "geoid_separation_m": GEOID_SEPARATION_M,
        "software": own_version(),
    }
    if folder.is_dir() and _is_made_from(stamp, made_from):
        try:
            AerialMap.load(folder, fingerprint)
        except MapError as error:
            target.print(f"built again: {error}")
            shutil.rmtree(folder)
        else:
            target.print("current, not built again (--fresh does)")
            return
    folder.parent.mkdir(parents=True, exist_ok=True)
    with ProgressDisplay(target) as display:
        build_map(
            [survey],
            folder,
            functools.partial(load_encoder, weights, threads=1),
            replace(config, workers=cores),  # what a worker's threads would do is better done by more workers
            geoid_separation_m=GEOID_SEPARATION_M,
            overwrite=True,
            progress=lambda p: display(p.stage, p.done, p.total, p.unit),
        )
    write_atomically(stamp, json.dumps(made_from, indent=2))


def make_drive(survey: Path, bag_path: Path, plan: DemoDrive, target: Console) -> None:
    """Record the drive, unless the bag that is there is of this survey and plan."""
    config = DriveConfig()
    stamp = _stamp_of(bag_path)
    made_from = {"survey": sha256(survey), "plan": asdict(plan), "config": asdict(config), "software": own_version()}
    if bag_path.is_dir() and _is_made_from(stamp, made_from):
        target.print("current, not driven again (--fresh does)")
    else:
        shutil.rmtree(bag_path, ignore_errors=True)
        with ProgressDisplay(target) as display:
            world = world_from_survey([survey], seed=plan.seed, progress=display)
            rng = np.random.default_rng([plan.seed, 1])
            route = plan_route(world, plan.length_m, rng, clearance_m=plan.clearance_m, speed_m_s=plan.speed_m_s)
            drive(world, route, bag_path, config, seed=plan.seed, progress=display)
        write_atomically(stamp, json.dumps(made_from, indent=2))
    with open_bag(bag_path) as bag:
        scans = bag.topic(TOPIC, POINT_CLOUD).count
        target.print(f"{bag_path}: {scans:,} scans in {(bag.end_ns - bag.start_ns) / 1e9:.0f} s")


def beside_the_truth(table: EstimateTable, frame: MapFrame) -> Table:
    """Return fixes and truth side by side, a scan every few seconds."""
    result = Table(title="Fixes beside the truth", title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
    tracked = table.has_track
    last = ("turned", "belief", "state") if tracked else ("1st cand.", "belief", "latency")
    for name in ("time", "truth", "fix", "off by", *last):
        result.add_column(name, justify="right", no_wrap=True)
    if not len(table):
        return result
    seconds = (table.stamp_ns - table.stamp_ns[0]) / 1e9
    known = np.asarray(np.isfinite(table.truth_grid).all(axis=1), dtype=np.bool_)
    latitude, longitude = np.full(len(table), np.nan), np.full(len(table), np.nan)
    if known.any():
        places = np.column_stack([table.truth_grid[known], np.zeros(int(known.sum()))])
        latitude[known], longitude[known], _ = frame.to_geographic(places)
    errors, turned_deg = table.error_m, np.degrees(np.abs(table.heading_error_rad))
    first_errors, beliefs = np.full(len(table), np.nan), np.full(len(table), np.nan)
    if table.candidate_ids.shape[1]:
        first_errors = np.hypot(*(table.candidate_grid[:, 0] - table.truth_grid).T)
        beliefs = table.candidate_probabilities[:, 0]
    for moment in np.arange(0.0, seconds[-1] + 1e-9, _SHOWN_EVERY_S):
        i = int(np.searchsorted(seconds, moment - 1e-9))
        fixed, state, latency = table.has_fix[i], table.states[i], table.latency_ms[i]
        if tracked:
            cells = [
                degrees(turned_deg[i]) if fixed else UNKNOWN,
                percent(table.probability[i]),
                UNKNOWN if state is None else state.value,
            ]
        else:
            cells = [
                f"{first_errors[i]:.0f} m" if np.isfinite(first_errors[i]) else UNKNOWN,
                f"{beliefs[i]:.0%}" if np.isfinite(beliefs[i]) else UNKNOWN,
                f"{latency:.0f} ms" if np.isfinite(latency) else UNKNOWN,
            ]
        result.add_row(
            f"{seconds[i]:.1f} s",
            f"{latitude[i]:.5f}, {longitude[i]:.5f}" if known[i] else UNKNOWN,
            f"{table.geographic[i, 0]:.5f}, {table.geographic[i, 1]:.5f}" if fixed else "no fix",
            metres(errors[i]) if fixed else UNKNOWN,
            *cells,
        )
    return result


def _about(arguments: argparse.Namespace, encoder: DescriptorEncoder, scans: int, answers: int) -> About:
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    dropped = scans - answers
    unanswered = [f"{dropped:,} scans got no answer (dropped or lost on the way); they count as misses."]
    return About(
        title="A robot in Amsterdam, told where it is",
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
        footer=f"Written by crossloc3d_ros {own_version()} on {today}. Aerial data: AHN, Rijkswaterstaat / PDOK, CC0.",
        latency_is="from publishing the cloud to receiving the fix, over DDS, between two processes",
        extra_words=(
            *(unanswered if dropped else []),
            "Map and drive share the town, not the survey: nothing was aligned or tuned on it, and the weights were "
            "trained on simulated towns alone.",
            "The map is small. A whole city holds many more streets that look alike.",
        ),
    )


def _stamp_of(folder: Path) -> Path:
    """Return the file that says what a folder was made from."""
    return folder.with_name(f"{folder.name}.made-from.json")


def _is_made_from(stamp: Path, made_from: Mapping[str, Any]) -> bool:
    try:
        found = json.loads(stamp.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return bool(found == json.loads(json.dumps(made_from)))


def _in_brief(newest: Estimate | None) -> str:
    if newest is None:
        return "no answer yet"
    if newest.status is not FixStatus.FIX:
        return f"no fix, {newest.state.value}"
    return f"fix {newest.latitude_deg:.5f}, {newest.longitude_deg:.5f}"


def _headline(target: Console, step: int, text: str) -> None:
    target.print(f"\n[bold]{step}/5  {text}[/bold]")


def _clone() -> Path:
    return Path(__file__).resolve().parents[2]


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
