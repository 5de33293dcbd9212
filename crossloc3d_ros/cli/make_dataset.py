"""`make_dataset`: recordings with GNSS and an aerial survey become a dataset to train and to test on."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from crossloc3d_ros.cli.common import (
    ProgressDisplay,
    add_options,
    add_verbosity,
    console,
    options_given,
    read_options,
    run,
    set_up_logging,
)
from crossloc3d_ros.config import BuildConfig, DatasetConfig, MountingConfig, PreprocessingConfig
from crossloc3d_ros.config.sources import read_node_config
from crossloc3d_ros.datasets.recordings import Topics
from crossloc3d_ros.training.areas import NONE, TEST, TRAINING, VALIDATION
from crossloc3d_ros.training.make_dataset import DatasetReport, DatasetRequest, make_dataset

_BUILD = ("spacing_m", "cell_m", "min_coverage", "workers")
_PREPROCESSING = ("half_extent_m", "scan_half_extent_m", "ground_clearance_m", "thin_m", "min_points")
_BOX = ("WEST", "SOUTH", "EAST", "NORTH")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _make(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="make_dataset",
        description="Make a dataset in the layout of CS-Campus3D out of recordings with points and GNSS and the aerial "
        "survey of the same area, split into training, validation and test areas. An interrupted call continues when "
        "it is given again.",
    )
    parser.add_argument("--bags", nargs="+", type=Path, required=True, help="rosbag2 folders, .mcap, .db3 or .bag")
    parser.add_argument("--survey", nargs="+", required=True, metavar="FILE", help="LAS/LAZ files, folders, globs")
    parser.add_argument("--output", type=Path, required=True, help="the dataset's folder")
    parser.add_argument("--crs", help="CRS of the survey, instead of what its files say, such as EPSG:28992")
    parser.add_argument("--topic", help="topic with the clouds (default: the only PointCloud2 topic)")
    parser.add_argument("--gnss-topic", help="NavSatFix topic (default: ground truth, or the only one)")
    parser.add_argument("--imu-topic", help="Imu topic, axes of the base, to level the scans by (default: none)")
    parser.add_argument("--odometry-topic", help="Odometry topic for the headings (default: the only one)")
    parser.add_argument(
        "--database-bags", nargs="+", type=Path, default=[], metavar="BAG",
        help="those of --bags whose scans in the test area are a ground database, not queries",
    )  # fmt: skip
    for role in ("test", "validation"):
        parser.add_argument(
            f"--{role}-box", nargs=4, type=float, metavar=_BOX, action="append", default=[],
            help=f"area to {'test' if role == 'test' else 'validate'} on, UTM metres; may be repeated (default: cut by "
            "shares)",
        )  # fmt: skip
    parser.add_argument("--config", type=Path, help="parameter file of the localizer node, of which scan.* is used")
    add_options(parser, DatasetConfig)
    cut = parser.add_argument_group("submaps and patches")
    add_options(cut, BuildConfig, _BUILD)  # type: ignore[arg-type]  # a group takes arguments as a parser does
    add_options(cut, PreprocessingConfig, _PREPROCESSING)  # type: ignore[arg-type]
    mounting = parser.add_argument_group("mounting of the lidar on the robot (takes precedence over --config)")
    add_options(mounting, MountingConfig)  # type: ignore[arg-type]
    add_verbosity(parser)
    return parser


def _make(arguments: argparse.Namespace) -> None:
    target = console()
    set_up_logging(arguments.verbose, target)
    request = DatasetRequest(
        bags=tuple(arguments.bags),
        survey=tuple(arguments.survey),
        output=arguments.output,
        topics=Topics(arguments.topic, arguments.gnss_topic, arguments.imu_topic, arguments.odometry_topic),
        crs=arguments.crs,
        database_bags=tuple(arguments.database_bags),
        test_boxes=tuple(tuple(box) for box in arguments.test_box),
        validation_boxes=tuple(tuple(box) for box in arguments.validation_box),
        config=read_options(DatasetConfig, arguments),
        scan=read_node_config(arguments.config, options_given(arguments, MountingConfig)).scan,
        preprocessing=read_options(PreprocessingConfig, arguments),
        build=read_options(BuildConfig, arguments),
    )
    with ProgressDisplay(target) as display:
        report = make_dataset(request, display)
    print(summary(report))


def summary(report: DatasetReport) -> str:
    """Return what a dataset came to, for people."""
    scans, submaps = report.scans, report.submaps
    names = {TRAINING: "to learn", VALIDATION: "to validate", TEST: "to test"}
    rows = [("dataset", f"{report.output}, {report.crs}")]
    rows += [(name, f"{scans[role]:,} scans, {submaps[role]:,} submaps") for role, name in names.items()]
    rows.append(("borders", f"{submaps[NONE]:,} submaps across a border of two areas are left out"))
    for recording in report.recordings:
        rows.append((recording.name, f"{recording.used:,} of {recording.seen:,} scans used"))
        for reason, count in sorted(recording.dropped.items(), key=lambda item: -item[1]):
            rows.append(("", f"{count:,} left out: {reason}"))
        if recording.damage:
            rows.append(("", f"read up to its damage: {recording.damage}"))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)


if __name__ == "__main__":
    raise SystemExit(main())
