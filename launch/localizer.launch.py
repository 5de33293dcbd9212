"""Start the localizer: `ros2 launch crossloc3d_ros localizer.launch.py map:=FOLDER points:=/velodyne_points`."""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

from launch import LaunchContext, LaunchDescription

SETTINGS = {
    "map": (str, "folder of the aerial map"),
    "weights": (str, "weights file; empty = the shipped weights"),
    "autostart": (bool, "whether the node configures and activates itself"),
    "odometry": (str, "topic, scan or none: source of the robot's motion"),
    "tf_broadcast": (bool, "publish map -> odom on /tf while localized"),
    "use_sim_time": (bool, "whether the time comes from /clock"),
}
"""Parameters that can be given as arguments; what is left empty stays as the parameter file has it."""


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the node that is started with them."""
    defaults = Path(get_package_share_directory("crossloc3d_ros")) / "config" / "localizer.yaml"
    arguments = {
        **{name: ("", text) for name, (_, text) in SETTINGS.items()},
        "points": ("/velodyne_points", "topic of the clouds"),
        "odom": ("/odom", "topic of the odometry"),
        "imu": ("/imu", "topic of the IMU, where the parameter use_imu or use_imu_heading is set"),
        "initialpose": ("/initialpose", "topic of initial poses, as RViz publishes them"),
        "params_file": (str(defaults), "file of all parameters"),
        "namespace": ("", "namespace of the node"),
        "log_level": ("info", "debug, info, warn or error"),
    }
    declared = [DeclareLaunchArgument(name, default_value=d, description=t) for name, (d, t) in arguments.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])


def switch(name: str, text: str) -> bool:
    """Return what a text of the command line means, as YAML and ROS read it; ValueError where it means neither."""
    if text.strip().lower() in ("true", "yes", "on", "y", "1"):
        return True
    if text.strip().lower() in ("false", "no", "off", "n", "0"):
        return False
    raise ValueError(f"{name}:={text}: must be true or false")


def start(context: LaunchContext) -> list[LifecycleNode]:
    """Return the node, now that the arguments have values."""

    def given(name: str) -> str:
        return LaunchConfiguration(name).perform(context)

    settings = {
        name: given(name) if kind is str else switch(name, given(name))
        for name, (kind, _) in SETTINGS.items()
        if given(name)
    }
    if not Path(given("params_file")).is_file():  # launch itself would warn, and run on with the defaults
        raise ValueError(f"params_file:={given('params_file')}: there is no such file")
    return [
        LifecycleNode(
            package="crossloc3d_ros",
            executable="localizer",
            name="localizer",
            namespace=given("namespace"),
            output="screen",
            parameters=[given("params_file"), settings],
            remappings=[(name, given(name)) for name in ("points", "odom", "imu", "initialpose")],
            ros_arguments=["--log-level", given("log_level")],
        )
    ]
