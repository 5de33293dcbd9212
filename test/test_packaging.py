"""What an installation must hold: executables where `ros2 run` looks, the ament marker, weights, one version."""

from __future__ import annotations

import ast
import importlib
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

import crossloc3d_ros

REPOSITORY = Path(__file__).resolve().parents[1]


def commands() -> list[str]:
    """Return the commands that setup.py installs."""
    tree = ast.parse((REPOSITORY / "setup.py").read_text())
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "COMMANDS":
            names: list[str] = ast.literal_eval(node.value)
            return names
    raise AssertionError("setup.py has no COMMANDS")


def test_every_command_is_a_module_with_a_main_and_every_such_module_a_command() -> None:
    folder = REPOSITORY / "crossloc3d_ros" / "cli"
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__", "common"}
    assert modules == set(commands())
    for name in commands():
        assert callable(importlib.import_module(f"crossloc3d_ros.cli.{name}").main)


@pytest.mark.parametrize("name", commands())
def test_every_command_explains_itself(name: str) -> None:
    call = [sys.executable, "-m", f"crossloc3d_ros.cli.{name}", "--help"]
    result = subprocess.run(call, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith(f"usage: {name}")


def test_there_is_one_version() -> None:
    package = ElementTree.parse(REPOSITORY / "package.xml").getroot()
    assert package.findtext("version") == crossloc3d_ros.__version__
    assert f'version="{crossloc3d_ros.__version__}"' in (REPOSITORY / "setup.py").read_text()
    assert crossloc3d_ros.__version__ in (REPOSITORY / "CHANGELOG.rst").read_text()


def test_colcon_takes_the_package_for_an_ament_one() -> None:
    package = ElementTree.parse(REPOSITORY / "package.xml").getroot()
    assert package.findtext("export/build_type") == "ament_python"
    maintainer = package.find("maintainer")
    assert maintainer is not None
    assert re.fullmatch(r"[^@\s]+@[^@\s]+\.[a-z]+", maintainer.get("email", ""))


def test_importing_the_package_and_its_light_rooms_is_cheap() -> None:
    code = (
        "import sys, crossloc3d_ros, crossloc3d_ros.types, crossloc3d_ros.config, crossloc3d_ros.errors;"
        "sys.exit(any(name in sys.modules for name in ('torch', 'rclpy', 'faiss', 'numba', 'laspy', 'rosbags')))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, check=False).returncode == 0


@pytest.mark.slow
def test_a_wheel_installs_for_ros2_run(tmp_path: Path) -> None:
    source = tmp_path / "source"
    subprocess.run(["git", "clone", "--quiet", str(REPOSITORY), str(source)], check=True)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", "dist", "."]
    subprocess.run(build, cwd=source, check=True)
    (wheel,) = (source / "dist").glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert any(name.endswith(".safetensors") for name in names)
    prefix = tmp_path / "prefix"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--prefix", str(prefix), str(wheel)]
    subprocess.run(install, check=True)
    for command in commands():
        assert os.access(prefix / "lib" / "crossloc3d_ros" / command, os.X_OK), command
    assert (prefix / "share/ament_index/resource_index/packages/crossloc3d_ros").is_file()
    assert (prefix / "share/crossloc3d_ros/config/localizer.yaml").is_file()
    assert (prefix / "share/crossloc3d_ros/launch/localizer.launch.py").is_file()


@pytest.mark.slow
def test_colcon_builds_for_ros2_run(tmp_path: Path) -> None:
    colcon = Path(sys.executable).with_name("colcon")
    if not colcon.exists():
        pytest.skip("colcon is not installed: pip install colcon-common-extensions")
    source = tmp_path / "src" / "crossloc3d_ros"
    subprocess.run(["git", "clone", "--quiet", str(REPOSITORY), str(source)], check=True)
    environment = {**os.environ, "PATH": f"{colcon.parent}:{os.environ['PATH']}"}
    subprocess.run([str(colcon), "build"], cwd=tmp_path, check=True, env=environment)
    prefix = tmp_path / "install" / "crossloc3d_ros"
    for command in commands():
        assert os.access(prefix / "lib" / "crossloc3d_ros" / command, os.X_OK), command
    assert (prefix / "share/ament_index/resource_index/packages/crossloc3d_ros").is_file()
    assert (prefix / "share/crossloc3d_ros/package.sh").is_file()
