"""`localizer`: the node that turns clouds into fixes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from crossloc3d_ros.cli import common
from crossloc3d_ros.config import LocalizerNodeConfig, Setting, settings_of
from crossloc3d_ros.errors import CrossLocError

USAGE = """usage: localizer --ros-args -p map:=FOLDER [-p NAME:=VALUE ...] [--params-file FILE] [-r points:=TOPIC]

Localize a LiDAR on an aerial map.

subscribes  points                           sensor_msgs/PointCloud2
            odom                             nav_msgs/Odometry, where odometry is topic
            imu                              sensor_msgs/Imu, where use_imu or use_imu_heading is set
            initialpose                      geometry_msgs/PoseWithCovarianceStamped, in `map`, `earth`, the odometry's
                                             frame or one of TF
publishes   ~/fix                            sensor_msgs/NavSatFix, one for each scan that is processed
            ~/pose                           geometry_msgs/PoseWithCovarianceStamped, latched, only with a fix
            ~/state                          diagnostic_msgs/DiagnosticStatus, latched: searching, ambiguous,
                                             localized or lost, and why
            ~/hypotheses                     geometry_msgs/PoseArray, most probable first
            ~/candidates                     geometry_msgs/PoseArray
            ~/candidate_table                sensor_msgs/PointCloud2, with the pose at which the scan fits around each
            ~/markers                        visualization_msgs/MarkerArray
            ~/map_origin                     sensor_msgs/NavSatFix, latched: where the frame `map` has its origin
            /diagnostics                     diagnostic_msgs/DiagnosticArray
            /tf                              from `map` to the odometry's frame, where tf_broadcast is set
service     reinitialize_global_localization std_srvs/Empty

parameters
"""
ROS_PACKAGES = (
    "rclpy",
    "sensor_msgs",
    "geometry_msgs",
    "nav_msgs",
    "std_msgs",
    "std_srvs",
    "diagnostic_msgs",
    "visualization_msgs",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node and return the exit code of the process."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    own = arguments[: arguments.index("--ros-args")] if "--ros-args" in arguments else arguments
    if "-h" in own or "--help" in own:
        print(USAGE + "\n".join(_describe(setting) for setting in settings_of(LocalizerNodeConfig)))
        return 0

    # One query is too little work for a team of OpenMP threads, and on a busy robot its members wait for each other:
    # a search in 27,000 submaps took 3 ms with one thread, 20 to 48 ms with two. The encoder has threads of its own.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

    def action() -> int:
        try:
            from crossloc3d_ros.ros.process import run_localizer
        except ModuleNotFoundError as error:
            if (error.name or "").split(".")[0] not in ROS_PACKAGES:
                raise
            raise CrossLocError(
                f"ROS 2 was not found (no module '{error.name}'): source /opt/ros/jazzy/setup.bash, or "
                "pip install ros-jazzy-rclpy ros-jazzy-common-interfaces ros-jazzy-rmw-fastrtps-cpp"
            ) from error
        except KeyboardInterrupt:
            return 0  # a node that is told to stop has done nothing wrong, however early it is told
        return run_localizer(arguments)

    return common.run(action)


def _describe(setting: Setting) -> str:
    default = list(setting.default) if isinstance(setting.default, tuple) else setting.default
    limits = "" if setting.low is None or setting.high is None else f", {setting.low:g} to {setting.high:g}"
    return f"  {setting.name:30} {setting.text} (default: {default!r}{limits})"


if __name__ == "__main__":
    sys.exit(main())
