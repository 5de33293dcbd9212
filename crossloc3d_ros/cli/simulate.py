"""Drive a simulated lidar through a real survey or through a simulated town."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crossloc3d_ros.cli import common
from crossloc3d_ros.config import MountingConfig, from_dict, to_dict
from crossloc3d_ros.errors import BagError, ConfigError
from crossloc3d_ros.simulation.drive import DriveConfig, DriveReport, drive
from crossloc3d_ros.simulation.families import FAMILIES
from crossloc3d_ros.simulation.lidar import LidarConfig, LidarProfile
from crossloc3d_ros.simulation.profiles import PROFILES
from crossloc3d_ros.simulation.real_world import world_from_survey
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.simulation.survey import SurveyConfig, fly, write_survey
from crossloc3d_ros.simulation.town import make_town
from crossloc3d_ros.simulation.traffic import TrafficConfig
from crossloc3d_ros.simulation.vlp16 import VLP16
from crossloc3d_ros.simulation.world import World

_SURVEY_OPTIONS = ("spacing_m", "altitude_m", "scan_angle_deg", "overlap", "horizontal_error_m", "vertical_error_m")
_DRIVE_OPTIONS = ("scan_every", "gnss_rate_hz", "gnss_error_m", "gnss_outages", "gnss_outage_s")

_CLEARANCE_M = 0.05  # below the robot


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    return common.run(lambda: _simulate(_parser().parse_args(argv)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="simulate", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)

    drive_parser = commands.add_parser("drive", help="drive through the surface of a real aerial survey")
    drive_parser.add_argument(
        "--survey", nargs="+", required=True, metavar="FILE", help="LAS/LAZ files, folders, globs"
    )
    drive_parser.add_argument("--bag", type=Path, required=True, help="rosbag2 folder to write")
    drive_parser.add_argument("--crs", help="CRS of files whose headers name none, such as EPSG:28992")
    _add_route(drive_parser)

    town_parser = commands.add_parser("town", help="make a town: an aerial survey of it and a drive at another time")
    town_parser.add_argument("--output", type=Path, required=True, help="folder for survey/*.laz and bag/")
    town_parser.add_argument("--family", choices=sorted(FAMILIES), help="kind of town (default: chosen by the seed)")
    town_parser.add_argument("--size-m", type=float, default=600.0, help="side of the town (default: 600)")
    town_parser.add_argument(
        "--epoch", type=int, default=1, help="epoch of the drive; the survey is epoch 0 (default: 1)"
    )
    common.add_options(town_parser, SurveyConfig, _SURVEY_OPTIONS)
    _add_route(town_parser)
    return parser


def _add_route(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=0, help="of the town, the route and the noise (default: 0)")
    parser.add_argument("--length-m", type=float, default=600.0, help="length of the drive (default: 600)")
    parser.add_argument("--speed-m-s", type=float, default=2.0, help="cruising speed (default: 2)")
    parser.add_argument("--clearance-m", type=float, default=1.5, help="kept from obstacles (default: 1.5)")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="of the bag (default: mcap)")
    parser.add_argument("--lidar", choices=sorted(PROFILES), default=VLP16.name, help=f"model (default: {VLP16.name})")
    parser.add_argument(
        "--lidar-height-m", type=float, default=MountingConfig.z_m,
        help=f"of the lidar above the ground (default: {MountingConfig.z_m:g})",
    )  # fmt: skip
    parser.add_argument("--lidar-range-m", type=float, help="largest range (default: the model's)")
    parser.add_argument("--lidar-range-error-m", type=float, help="one sigma of a range (default: the model's)")
    common.add_options(parser, DriveConfig, _DRIVE_OPTIONS)
    common.add_options(parser, TrafficConfig)
    common.add_verbosity(parser)


def _simulate(arguments: argparse.Namespace) -> int:
    target = common.console()
    common.set_up_logging(arguments.verbose, target)
    _check(arguments)
    with common.ProgressDisplay(target) as progress:
        if arguments.command == "drive":
            world = world_from_survey(arguments.survey, crs=arguments.crs, seed=arguments.seed, progress=progress)
            bag_path = arguments.bag
        else:
            config = common.read_options(SurveyConfig, arguments)
            survey_folder, bag_path = arguments.output / "survey", arguments.output / "bag"
            town = make_town(arguments.seed, arguments.family, arguments.size_m)
            survey = fly(
                town, config, np.random.default_rng([arguments.seed, 0]),
                lambda share: progress("flying", 100 * share, 100, "%"),
            )  # fmt: skip
            paths = write_survey(town, survey, survey_folder)
            world = make_town(arguments.seed, arguments.family, arguments.size_m, arguments.epoch)
        report = _drive(world, bag_path, arguments, progress)
    if arguments.command == "town":
        print(f"{len(paths)} tiles with {len(survey.points):,} points in {survey_folder} ({town.crs})")
    print(
        f"{report.scans:,} scans ({report.points / report.scans:,.0f} points each) over {report.length_m:.0f} m "
        f"and {report.duration_s:.0f} s in {bag_path}"
    )
    return 0


def _check(arguments: argparse.Namespace) -> None:
    for name, low, high in (("length_m", 5.0, 20_000.0), ("speed_m_s", 0.1, 10.0), ("clearance_m", 0.6, 20.0),
                            ("lidar_height_m", 0.3, 3.0), ("seed", 0, 2**31 - 1)):  # fmt: skip
        value = getattr(arguments, name)
        if not low <= value <= high:
            raise ConfigError(f"--{name.replace('_', '-')} must lie between {low:g} and {high:g}, got {value:g}")
    folder = arguments.bag if arguments.command == "drive" else arguments.output / "bag"
    if folder.exists():
        raise BagError(f"{folder} exists already; choose another name or remove it first")


def _drive(
    world: World, bag_path: Path, arguments: argparse.Namespace, progress: common.ProgressDisplay
) -> DriveReport:
    route = plan_route(
        world, arguments.length_m, np.random.default_rng([arguments.seed, 1]),
        clearance_m=arguments.clearance_m, speed_m_s=arguments.speed_m_s,
    )  # fmt: skip
    traffic = common.read_options(TrafficConfig, arguments)
    profile = PROFILES[arguments.lidar]
    config = dataclasses.replace(
        common.read_options(DriveConfig, arguments),
        traffic=traffic,
        mounting=MountingConfig(z_m=arguments.lidar_height_m),
        sensor=_sensor(profile, arguments),
    )
    return drive(
        world, route, bag_path, config, seed=arguments.seed, profile=profile, storage=arguments.storage,
        progress=progress,
    )  # fmt: skip


def _sensor(profile: LidarProfile, arguments: argparse.Namespace) -> LidarConfig:
    """Return the settings of the lidar; of the robot's body below it, what lies above the ground."""
    given = {"max_range_m": arguments.lidar_range_m, "range_error_m": arguments.lidar_range_error_m}
    values = {**to_dict(profile.config), **{name: value for name, value in given.items() if value is not None}}
    boxes = np.asarray(profile.config.body, dtype=np.float64).reshape(-1, 6)
    boxes[:, 2] = np.maximum(boxes[:, 2], -arguments.lidar_height_m + _CLEARANCE_M)
    return from_dict(LidarConfig, {**values, "body": boxes[boxes[:, 2] < boxes[:, 5]].ravel().tolist()})


if __name__ == "__main__":
    raise SystemExit(main())
