"""Install crossloc3d_ros with colcon (ament_python) or with pip.

Both put the executables where `ros2 run` looks, `lib/crossloc3d_ros/`, and the marker where the ament index looks.
colcon does so through the script directories of setup.cfg; a wheel's console scripts always go to `bin/`, so a wheel
carries small launchers for `lib/crossloc3d_ros/` besides.
"""

from pathlib import Path

from setuptools import Command, find_packages, setup

try:
    from setuptools.command.bdist_wheel import bdist_wheel
except ImportError:  # an older setuptools, as colcon finds it on Ubuntu 24.04: no wheel is built there
    bdist_wheel = Command

NAME = "crossloc3d_ros"
COMMANDS = [
    "build_map",
    "calibrate_map",
    "compare",
    "cut_survey",
    "demo",
    "evaluate",
    "import_checkpoint",
    "localizer",
    "make_dataset",
    "replay",
    "simulate",
    "train",
]
# The site of docs/; from 2 on MkDocs does without plugins and themes of others.
DOCS = ["mkdocs>=1.6,<2", "mkdocs-material>=9.5,<10"]
LAUNCHER = """#!/usr/bin/env python3
import sys

from {name}.cli.{command} import main

sys.exit(main())
"""


def files(folder, pattern):
    return sorted(str(path) for path in Path(folder).glob(pattern))


class WheelWithLaunchers(bdist_wheel):
    """Add launchers for `ros2 run` to the data files of a wheel."""

    def run(self):
        folder = Path("build/launchers")
        folder.mkdir(parents=True, exist_ok=True)
        for command in COMMANDS:
            launcher = folder / command
            launcher.write_text(LAUNCHER.format(name=NAME, command=command))
            launcher.chmod(0o755)
        self.distribution.data_files.append((f"lib/{NAME}", files(folder, "*")))
        super().run()


setup(
    name=NAME,
    version="0.1.0",
    description="Where a robot with a LiDAR is on an airborne LiDAR survey, without GNSS and without a first guess",
    long_description=Path("README.md").read_text() if Path("README.md").exists() else "",
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="crossloc3d_ros maintainers",
    maintainer_email="maintainers@crossloc3d.org",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "weights/*", "pages/assets/*", "pages/templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", files("config", "*.yaml")),
        (f"share/{NAME}/launch", files("launch", "*.launch.py")),
    ],
    zip_safe=False,
    python_requires=">=3.11",
    install_requires=[
        "embreex>=2.17",
        "faiss-cpu>=1.8",
        "jinja2>=3.1",
        "laspy[lazrs]>=2.5",
        "numba>=0.60",
        "numpy>=1.26",
        "pillow>=10",
        "pyproj>=3.6",
        "pyyaml>=6",
        "rasterio>=1.3",
        "rich>=13",
        "rosbags>=0.10",
        "safetensors>=0.4",
        "scipy>=1.11",
        "torch>=2.4",
        "utm>=0.7",
    ],
    extras_require={
        # Where ROS 2 Jazzy is not installed: the real client and middleware as wheels.
        "ros": ["ros-jazzy-common-interfaces", "ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp"],
        # Where the robot has no odometry of its own: from scan to scan.
        "odometry": ["kiss-icp>=1.2"],
        "cluster": ["dask>=2024.1", "distributed>=2024.1"],
        "docs": DOCS,
        "test": [
            *DOCS,
            "hypothesis>=6",
            "import-linter>=2",
            "mypy>=1.10",
            "packaging>=23",
            "pytest>=8",
            "pytest-timeout>=2",
            "ruff>=0.6",
            "threadpoolctl>=3",
            "types-PyYAML",
        ],
    },
    cmdclass={"bdist_wheel": WheelWithLaunchers},
    entry_points={"console_scripts": [f"{command} = {NAME}.cli.{command}:main" for command in COMMANDS]},
)
