"""`replay`: a recording through the localizer, or into ROS."""

from __future__ import annotations

import argparse
import datetime
import shlex
import sys
import typing
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml
from rich import box
from rich.console import Console
from rich.table import Table

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli.common import (
    EXIT_INTERRUPTED,
    ProgressDisplay,
    add_options,
    add_verbosity,
    console,
    interrupts_held,
    run,
    set_up_logging,
)
from crossloc3d_ros.config import AlignmentConfig, LocalizerNodeConfig, MountingConfig, PlayerConfig, from_dict
from crossloc3d_ros.datasets.truth import find_truth_topic
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import BagError, ConfigError, CrossLocError
from crossloc3d_ros.evaluation.drives.evaluation import (
    ESTIMATES,
    GEOJSON,
    SUMMARY,
    Evaluation,
    evaluate,
    latency_summary,
    write_summary,
)
from crossloc3d_ros.evaluation.drives.page import About, write_report
from crossloc3d_ros.evaluation.drives.place_scores import RANKS
from crossloc3d_ros.evaluation.drives.track_scores import LOST, TrackScores
from crossloc3d_ros.evaluation.statistics import INDEPENDENT_M, RADII_M
from crossloc3d_ros.formats.bag import IMU, ODOMETRY, POINT_CLOUD, BagReader, open_bag
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.pages.wording import degrees, metres, percent
from crossloc3d_ros.replay.recorded import OdometrySource, localize_bag
from crossloc3d_ros.types import Estimate

PAGE = "index.html"
ROS_ARGUMENTS = "--ros-args"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    given = list(sys.argv[1:] if argv is None else argv)
    at = given.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in given else len(given)
    parser = _parser()
    arguments = parser.parse_args(given[:at])
    ros_arguments = [argument for argument in given[at + 1 :] if argument != "--"]
    if arguments.publish:
        return run(lambda: _publish(arguments, ros_arguments))
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


# Localize and score


def _replay(arguments: argparse.Namespace) -> int:
    if arguments.every < 1:
        raise ConfigError(f"--every must be at least 1, got {arguments.every}")
    target = console()
    set_up_logging(arguments.verbose, target)
    config = read_config(arguments.config, _given(arguments, MountingConfig), _given(arguments, LocalizerNodeConfig))
    if arguments.scope is not None:
        config = replace(config, alignment=replace(config.alignment, scope=arguments.scope))
    if not config.map:
        raise ConfigError(f"--map is needed: {arguments.config} names none")
    folder = arguments.output or Path("out") / "replay" / arguments.bag.resolve().stem
    broken: BagError | None = None
    interrupted = False
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
        remove_results(folder)
        moved = odometry_words(odometry)
        target.print(f"warming up, then localizing '{topic}' on {len(aerial_map.submaps):,} submaps; odometry: {moved}")
        with interrupts_held() as let_through, ProgressDisplay(target) as display:

            def show(done: int, total: int, _: Estimate) -> None:
                display("localize", done, total, "scans")
                let_through()

            localizer.warm_up()
            let_through()
            try:
                localize_bag(
                    bag,
                    topic,
                    localizer,
                    folder / ESTIMATES,
                    every=arguments.every,
                    imu_topic=arguments.imu_topic,
                    imu_time_constant_s=config.imu_time_constant_s,
                    odometry=odometry,
                    progress=show,
                )
                let_through()
            except BagError as error:
                broken = error  # what was read before the damage is worth its figures
            except KeyboardInterrupt:
                interrupted = True
                target.print("interrupted: writing up what there is; Ctrl-C once more to leave it")
        if not _has_rows(folder / ESTIMATES):
            if broken is not None:
                raise broken
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
    notes = []
    if broken is not None:
        notes.append(f"The recording is damaged; only the part before the damage is shown. {broken}")
    if interrupted:
        notes.append("The run was interrupted; only the scans before that are shown.")
    write_results(folder, evaluation, aerial_map, About(f"Replay of {arguments.bag.name}", facts, tuple(notes)))
    print_results(evaluation, Console(highlight=False))
    print(f"{folder / PAGE}\n{folder / ESTIMATES}\n{folder / GEOJSON}")
    if broken is not None:
        raise broken
    return EXIT_INTERRUPTED if interrupted else 0


def choose_cloud_topic(bag: BagReader, chosen: str | None) -> str:
    """Return the topic with the clouds: the chosen one, or the only one there is; BagError lists the topics."""
    if chosen is not None:
        return bag.topic(chosen, POINT_CLOUD).name
    return bag.only_topic(POINT_CLOUD, "choose one with --topic").name


def choose_odometry(
    bag: BagReader, chosen: str | None, config: LocalizerNodeConfig, *, asked_for: bool = False
) -> OdometrySource | None:
    """Return what tells how the robot moved, as `config.odometry` wants it; None where nothing does.

    `chosen` is a topic. Without one, the only topic that is not called ground truth, or `/odom` among several. A
    recording without any is localized without odometry, unless a topic was `asked_for`: then BagError lists what there
    is, as it does where several topics leave the choice open.
    """
    if chosen is not None and asked_for and config.odometry != "topic":
        raise ConfigError(f"--odom-topic has no meaning with --odometry {config.odometry}")
    if chosen is None and config.odometry == "none":
        return None
    if chosen is None and config.odometry == "scan":
        return OdometrySource(None, config.base_frame_id)
    if chosen is not None:
        return OdometrySource(bag.topic(chosen, ODOMETRY).name, config.base_frame_id)
    names = [t.name for t in bag.topics().values() if t.msgtype == ODOMETRY and "truth" not in t.name]
    if not names:
        if asked_for:
            bag.only_topic(ODOMETRY, "choose one with --odom-topic")
            raise BagError(f"{bag.path} has no odometry beside ground truth; --odom-topic takes that too")
        return None
    if len(names) > 1 and "/odom" not in names:
        raise BagError(f"{bag.path} has several odometry topics ({', '.join(names)}); choose one with --odom-topic")
    return OdometrySource("/odom" if len(names) > 1 else names[0], config.base_frame_id)


def odometry_words(odometry: OdometrySource | None) -> str:
    """Return for people what tells how the robot moved."""
    if odometry is None:
        return "none (--odometry scan makes one from the scans)"
    return odometry.topic or "from scan to scan, KISS-ICP"


def remove_results(folder: Path) -> None:
    """Remove an earlier run's results, so that old figures never stand beside new ones."""
    for name in (ESTIMATES, GEOJSON, SUMMARY, PAGE):
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as error:
            raise CrossLocError(f"cannot write into {folder}: {error}") from error


def write_results(folder: Path, evaluation: Evaluation, aerial_map: AerialMap, about: About) -> None:
    """Write summary and page into the folder of the estimates."""
    write_summary(folder, evaluation, {**about.facts, "notes": list(about.notes)})
    if not about.footer:
        today = datetime.datetime.now(datetime.UTC).date().isoformat()
        about = About(**{**vars(about), "footer": f"Written by crossloc3d_ros {own_version()} on {today}."})
    write_report(folder / PAGE, evaluation, aerial_map, about)


def print_results(evaluation: Evaluation, target: Console) -> None:
    """Print the scores for people."""
    table, scores = evaluation.table, evaluation.scores
    figures = Table(title="Results", title_justify="left", show_header=False, box=box.SIMPLE)
    figures.add_column(style="bold", no_wrap=True)
    figures.add_column()
    fixes = int(table.has_fix.sum())
    figures.add_row("scans", f"{len(table):,}, of which {fixes:,} led to a fix ({fixes / max(len(table), 1):.0%})")
    latency = latency_summary(table)
    if latency:
        figures.add_row("time a scan", f"median {latency['median']:.1f} ms, 95 % {latency['p95']:.1f} ms")
    if scores is None:
        figures.add_row("errors", "not known: the recording has no usable GNSS at the time of the scans")
        target.print(figures)
        return
    error, first = scores.fix_error, scores.best_candidate_error
    if evaluation.track is not None:
        _add_track(figures, evaluation.track)
    elif error.count:
        figures.add_row("error of a fix", f"median {error.median_m:.0f} m, 95 % {error.p95_m:.0f} m")
        figures.add_row("truth in the 95 % ellipse", f"{error.within_ellipse:.0%} of the fixes")
    if first.count:
        figures.add_row("error of first candidate", f"median {first.median_m:.0f} m, 95 % {first.p95_m:.0f} m")
    figures.add_row("evidence", f"{scores.places} places at least {INDEPENDENT_M:g} m apart")
    target.print(figures)
    recall = Table(title="Right place among the candidates", title_justify="left", box=box.SIMPLE)
    recall.add_column("", style="bold", no_wrap=True)
    for radius in RADII_M:
        recall.add_column(f"within {radius:g} m", justify="right", no_wrap=True)
    for rank in RANKS:
        cells = [scores.recall(rank, radius) for radius in RADII_M]
        recall.add_row(f"AR@{rank}", *(f"{cell.share.value:.0%} (by lot {cell.chance:.0%})" for cell in cells))
    target.print(recall)


def _add_track(figures: Table, track: TrackScores) -> None:
    """Add the rows of a pose that was followed."""
    for search in track.searches:
        if search.cause != LOST:
            found = f"after {metres(search.travelled_m)} and {search.seconds:.1f} s"
            figures.add_row(f"localized, {search.cause}", found if search.end is not None else "never")
    lost = [search.travelled_m for search in track.searches if search.cause == LOST]
    if lost:
        longest = f", {metres(max(lost))} at most" if len(lost) > 1 else ""
        figures.add_row("afterwards without a fix", f"{len(lost)} times, {metres(sum(lost))} in all{longest}")
    errors = track.errors
    if errors.count:
        figures.add_row("error of a fix", f"median {metres(errors.median_m)}, 95 % {metres(errors.p95_m)}")
        if errors.headings:
            figures.add_row(
                "error of its heading", f"median {degrees(errors.median_deg)}, 95 % {degrees(errors.p95_deg)}"
            )
        figures.add_row("wrong by more than 10 m", f"{errors.wrong:,} of {errors.count:,} fixes")
        for row in track.coverage[1:2]:
            inside = f"{percent(row.position)} of the positions, {percent(row.heading)} of the headings"
            figures.add_row("errors inside 2 sigma", f"{inside} (should be {percent(row.expected)})")


def read_config(
    path: Path | None, mounting: Mapping[str, Any], others: Mapping[str, Any] | None = None
) -> LocalizerNodeConfig:
    """Return the localizer's settings from a node's parameter file, with `mounting` and `others` on top.

    Understands `ros__parameters` under the node's name or a wildcard, nested or with dots; ConfigError names what is
    wrong.
    """
    values: dict[str, Any] = {}
    if path is not None:
        try:
            document = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ConfigError(f"cannot read {path}: {error}") from error
        values = _parameters_of(document, path)
    if mounting:
        scan = values.setdefault("scan", {})
        scan["mounting"] = {**scan.get("mounting", {}), **mounting}
    values.update(others or {})
    return from_dict(LocalizerNodeConfig, values)


def _parameters_of(document: Any, path: Path) -> dict[str, Any]:
    if not isinstance(document, dict):
        raise ConfigError(f"{path} holds no parameters")
    merged: dict[str, Any] = {}
    for node, content in document.items():
        if isinstance(content, dict) and "ros__parameters" in content:
            if node in ("localizer", "/localizer", "/**", "/*"):
                _merge(merged, content["ros__parameters"] or {})
        else:
            raise ConfigError(f"{path}: '{node}' has no 'ros__parameters'; write 'localizer: ros__parameters: ...'")
    # What any node may be told has no meaning without a node.
    return {key: value for key, value in merged.items() if key not in ("use_sim_time", "qos_overrides")}


def _merge(target: dict[str, Any], source: Mapping[str, Any]) -> None:
    for key, value in source.items():
        head, _, rest = str(key).partition(".")
        if rest:
            value = {rest: value}
        if isinstance(value, Mapping):
            group = target.setdefault(head, {})
            if isinstance(group, dict):
                _merge(group, value)
                continue
        target[head] = value


def _given(arguments: argparse.Namespace, kind: type[Any]) -> dict[str, Any]:
    """Return the arguments that are settings of `kind` and were given."""
    given = {name: vars(arguments).get(name) for name in kind.__dataclass_fields__}
    return {name: str(v) if isinstance(v, Path) else v for name, v in given.items() if v is not None}


def own_version() -> str:
    """Return the version of the package."""
    try:
        return version("crossloc3d_ros")
    except PackageNotFoundError:
        return "(not installed)"


def _has_rows(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8") as file:
            return sum(1 for _, _ in zip(file, range(2), strict=False)) == 2
    except OSError:
        return False


# Play into ROS


def _publish(arguments: argparse.Namespace, ros_arguments: Sequence[str]) -> None:
    target = console()
    set_up_logging(arguments.verbose, target)
    try:
        from crossloc3d_ros.ros.player import play_bag
    except ImportError as error:
        raise CrossLocError(
            f"ROS 2 was not found ({error}): source /opt/ros/jazzy/setup.bash, or pip install ros-jazzy-rclpy "
            "ros-jazzy-common-interfaces ros-jazzy-rmw-fastrtps-cpp"
        ) from error
    config = from_dict(
        PlayerConfig,
        {name: getattr(arguments, name) for name in ("rate", "clock", "loop", "wait_s")},
    )
    with open_bag(arguments.bag) as bag:
        if arguments.topic is not None:
            bag.topic(arguments.topic, POINT_CLOUD)
        seconds = (bag.end_ns - bag.start_ns) / 1e9 / config.rate
        target.print(f"{shlex.quote(str(arguments.bag))}: {bag.message_count:,} messages, {seconds:.1f} s at this rate")
        target.print("waiting for a subscriber")
        report = play_bag(
            bag,
            config,
            topics=arguments.play_topics,
            ros_arguments=ros_arguments,
            on_ready=lambda: target.print("playing"),
        )
    print(
        f"{report.messages:,} messages in {report.duration_s:.1f} s, late by {report.late_median_ms:.2f} ms in the "
        f"median, {report.late_p99_ms:.2f} ms at 99 %"
    )


if __name__ == "__main__":
    sys.exit(main())
