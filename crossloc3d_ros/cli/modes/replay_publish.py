"""`replay --publish`: a recording into ROS, with its own timing."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence

from crossloc3d_ros.cli.common import console, set_up_logging
from crossloc3d_ros.config import PlayerConfig, from_dict
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.formats.bag import POINT_CLOUD, open_bag


def publish(arguments: argparse.Namespace, ros_arguments: Sequence[str]) -> None:
    """Play the recording and print how well its timing was kept."""
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
