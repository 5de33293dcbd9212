"""`replay`: a recording through the localizer, or into ROS."""

from __future__ import annotations

import argparse
import sys
import typing
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli.common import (
    EXIT_INTERRUPTED,
    ProgressDisplay,
    add_options,
    add_verbosity,
    console,
    interrupts_held,
    options_given,
    run,
    set_up_logging,
)
from crossloc3d_ros.cli.modes.replay_publish import publish
from crossloc3d_ros.config import AlignmentConfig, LocalizerNodeConfig, MountingConfig
from crossloc3d_ros.config.sources import read_node_config
from crossloc3d_ros.datasets.truth import find_truth_topic
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import BagError, ConfigError
from crossloc3d_ros.evaluation.drives.evaluation import ESTIMATES, GEOJSON, evaluate
from crossloc3d_ros.evaluation.drives.page import About
from crossloc3d_ros.evaluation.drives.results import PAGE, has_rows, remove_results, write_results
from crossloc3d_ros.evaluation.drives.terminal import result_tables
from crossloc3d_ros.formats.bag import IMU, BagReader, open_bag
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.replay.recorded import Ended, OdometrySource, localize_bag
from crossloc3d_ros.replay.sources import choose_cloud_topic, choose_odometry, odometry_words
from crossloc3d_ros.types import Estimate

ROS_ARGUMENTS = "--ros-args"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    given = list(sys.argv[1:] if argv is None else argv)
    at = given.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in given else len(given)
    parser = _parser()
    arguments = parser.parse_args(given[:at])
    ros_arguments = [argument for argument in given[at + 1 :] if argument != "--"]
    if arguments.publish:
        return run(lambda: publish(arguments, ros_arguments))
    if ros_arguments:
        parser.error(f"{ROS_ARGUMENTS} has a meaning with --publish only")
    if arguments.map is None and arguments.config is None:
        parser.error("--map is needed, the folder that build_map wrote (or --publish, to play into ROS)")
    return run(lambda: _replay(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="replay",
        description="Localize every scan of a recording and score the fixes against its GNSS; or play the recording "
        "into ROS with its own timing, where 'ros2 bag' is not installed.",
        epilog="With --publish, remappings may follow: --ros-args -r /velodyne_points:=/points",
    )
    parser.add_argument("bag", type=Path, help="rosbag2 folder, .mcap or .db3 file, or ROS 1 .bag")
    parser.add_argument("--topic", help="topic with the clouds (default: the only PointCloud2 topic)")
    add_verbosity(parser)

    localize = parser.add_argument_group("localize and score")
    localize.add_argument("--map", type=Path, help="folder of the aerial map")
    localize.add_argument("--weights", type=Path, help="weights file (default: the one that comes with the package)")
    localize.add_argument("--device", help="where to encode: cpu or cuda (default: cpu)")
    localize.add_argument("--gnss-topic", help="NavSatFix topic to score against (default: ground truth, or the only)")
    localize.add_argument("--imu-topic", help="Imu topic, axes of the base, to level the scans by (default: none)")
    localize.add_argument(
        "--odometry",
        choices=("topic", "scan", "none"),
        help="source of the robot's motion: a topic, the scans by KISS-ICP, or none "
        "(default: topic, where the recording has one)",
    )
    localize.add_argument("--odom-topic", help="Odometry topic (default: the only one beside ground truth, or /odom)")
    localize.add_argument(
        "--scope",
        choices=typing.get_args(typing.get_type_hints(AlignmentConfig)["scope"]),
        help="where poses are searched (default: as the parameter alignment.scope of the node)",
    )
    localize.add_argument("--every", type=int, default=1, metavar="N", help="use every N-th scan (default: all)")
    localize.add_argument("--output", type=Path, help="folder for the results (default: out/replay/BAG)")
    localize.add_argument(
        "--config", type=Path, help="parameter file of the localizer node; options given here take precedence"
    )

    mounting = parser.add_argument_group("mounting of the lidar on the robot (takes precedence over --config)")
    add_options(mounting, MountingConfig)  # type: ignore[arg-type]  # a group takes arguments as a parser does

    publish = parser.add_argument_group("play into ROS")
    publish.add_argument("--publish", action="store_true", help="play the messages instead of localizing here")
    publish.add_argument("--rate", type=float, default=1.0, help="speed (default: %(default)s)")
    publish.add_argument("--clock", action="store_true", help="publish /clock, for nodes with use_sim_time")
    publish.add_argument("--loop", action="store_true", help="start again at the end, until Ctrl-C")
    publish.add_argument("--wait-s", type=float, default=30.0, help="wait for a subscriber; 0 = do not (default: 30)")
    publish.add_argument("--play-topics", nargs="+", metavar="TOPIC", help="play these alone (default: all)")
    return parser


def _replay(arguments: argparse.Namespace) -> int:
    if arguments.every < 1:
        raise ConfigError(f"--every must be at least 1, got {arguments.every}")
    target = console()
    set_up_logging(arguments.verbose, target)
    config = _config(arguments)
    folder = arguments.output or Path("out") / "replay" / arguments.bag.resolve().stem
    with open_bag(arguments.bag) as bag:
        # Everything that can be refused is refused before the long work begins.
        topic = choose_cloud_topic(bag, arguments.topic)
        find_truth_topic(bag, arguments.gnss_topic)
        if arguments.imu_topic is not None:
            bag.topic(arguments.imu_topic, IMU)
        odometry = choose_odometry(bag, arguments.odom_topic, config, asked_for=arguments.odometry is not None)
        weights = Path(config.weights) if config.weights else None
        encoder = load_encoder(weights, device=config.device, threads=config.threads or None)
        aerial_map = AerialMap.load(config.map, encoder.fingerprint)
        localizer = Localizer(aerial_map, encoder, config, threads=config.threads)
        if localizer.calibration_words:
            target.print(f"the map: {localizer.calibration_words}")
        remove_results(folder)
        moved = odometry_words(odometry)
        target.print(f"warming up, then localizing '{topic}' on {len(aerial_map.submaps):,} submaps; odometry: {moved}")
        ended = _localize(bag, topic, localizer, folder / ESTIMATES, arguments, config, odometry, target)
        if not has_rows(folder / ESTIMATES):
            if ended.broken is not None:
                raise ended.broken
            return EXIT_INTERRUPTED
        evaluation = evaluate(bag, folder, aerial_map, arguments.gnss_topic)
    facts = {
        "bag": str(arguments.bag),
        "topic": topic,
        "odometry": moved,
        "map": config.map,
        "weights": encoder.fingerprint[:12],
        "run": "straight through the localizer",
    }
    write_results(folder, evaluation, aerial_map, About(f"Replay of {arguments.bag.name}", facts, ended.notes))
    results = Console(highlight=False)
    for table in result_tables(evaluation):
        results.print(table)
    print(f"{folder / PAGE}\n{folder / ESTIMATES}\n{folder / GEOJSON}")
    if ended.broken is not None:
        raise ended.broken
    return EXIT_INTERRUPTED if ended.interrupted else 0


def _config(arguments: argparse.Namespace) -> LocalizerNodeConfig:
    mounting, others = options_given(arguments, MountingConfig), options_given(arguments, LocalizerNodeConfig)
    config = read_node_config(arguments.config, mounting, others)
    if arguments.scope is not None:
        config = replace(config, alignment=replace(config.alignment, scope=arguments.scope))
    if not config.map:
        raise ConfigError(f"--map is needed: {arguments.config} names none")
    return config


def _localize(
    bag: BagReader,
    topic: str,
    localizer: Localizer,
    output: Path,
    arguments: argparse.Namespace,
    config: LocalizerNodeConfig,
    odometry: OdometrySource | None,
    target: Console,
) -> Ended:
    with interrupts_held() as let_through, ProgressDisplay(target) as display:

        def show(done: int, total: int, _: Estimate) -> None:
            display("localize", done, total, "scans")
            let_through()

        localizer.warm_up()
        let_through()
        try:
            localize_bag(
                bag, topic, localizer, output, every=arguments.every, imu_topic=arguments.imu_topic,
                imu_time_constant_s=config.imu_time_constant_s, odometry=odometry,
                base_frame_id=config.base_frame_id or "base_link", progress=show,
            )  # fmt: skip
            let_through()
        except BagError as error:
            return Ended(broken=error)
        except KeyboardInterrupt:
            target.print("interrupted: writing up what there is; Ctrl-C once more to leave it")
            return Ended(interrupted=True)
    return Ended()


if __name__ == "__main__":
    sys.exit(main())
