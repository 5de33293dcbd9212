"""The launch and the parameter file: launch itself is not in the package index, so its parts are played here."""

from __future__ import annotations

import runpy
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import yaml

from crossloc3d_ros.config import LocalizerNodeConfig, from_dict, to_dict

REPOSITORY = Path(__file__).resolve().parents[2]


def test_the_parameter_file_holds_every_parameter_with_its_default() -> None:
    document = yaml.safe_load((REPOSITORY / "config" / "localizer.yaml").read_text())
    values = document["/**"]["ros__parameters"]
    assert from_dict(LocalizerNodeConfig, values) == LocalizerNodeConfig()
    assert keys_of(values) == keys_of(to_dict(LocalizerNodeConfig()))


def keys_of(values: dict[str, Any], prefix: str = "") -> set[str]:
    found = set()
    for key, value in values.items():
        found |= keys_of(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key}
    return found


class Recorder:
    """Remember what it was made with."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


class Argument(Recorder):
    def perform(self, context: dict[str, str]) -> str:
        return context[self.args[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    parts = {
        "launch": {"LaunchContext": dict, "LaunchDescription": Recorder},
        "launch.actions": {"DeclareLaunchArgument": Recorder, "OpaqueFunction": Recorder},
        "launch.substitutions": {"LaunchConfiguration": Argument},
        "launch_ros": {},
        "launch_ros.actions": {"LifecycleNode": Recorder},
        "ament_index_python.packages": {"get_package_share_directory": lambda package: str(REPOSITORY)},
    }
    for name, members in parts.items():
        module = types.ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(REPOSITORY / "launch" / "localizer.launch.py"))


def started_with(launch_file: dict[str, Any], **given: str) -> dict[str, Any]:
    (entities,) = launch_file["generate_launch_description"]().args
    *declared, function = entities
    context = {argument.args[0]: argument.kwargs["default_value"] for argument in declared}
    assert set(given) <= set(context)
    (node,) = function.kwargs["function"]({**context, **given})
    return node.kwargs


def test_arguments_reach_the_node_and_parameters_that_exist(launch_file: dict[str, Any]) -> None:
    node = started_with(
        launch_file, map="/maps/a", use_sim_time="true", autostart="false", points="/lidar", odom="/wheels"
    )
    assert {("points", "/lidar"), ("odom", "/wheels"), ("initialpose", "/initialpose")} <= set(node["remappings"])
    file, settings = node["parameters"]
    assert file == str(REPOSITORY / "config" / "localizer.yaml")
    assert settings == {"map": "/maps/a", "use_sim_time": True, "autostart": False}
    from_dict(LocalizerNodeConfig, {k: v for k, v in settings.items() if k != "use_sim_time"})


def test_what_is_not_given_stays_as_the_file_has_it(launch_file: dict[str, Any], tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("")
    assert started_with(launch_file, params_file=str(mine))["parameters"] == [str(mine), {}]


def test_a_parameter_file_that_does_not_exist_is_an_error(launch_file: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"params_file:=.*nowhere\.yaml: there is no such file"):
        started_with(launch_file, params_file=str(tmp_path / "nowhere.yaml"))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *((text, True) for text in ("true", "True", "TRUE", "yes", "on", "On", "y", "1", " true ")),
        *((text, False) for text in ("false", "False", "no", "NO", "off", "n", "0")),
    ],
)
@pytest.mark.parametrize("name", ["autostart", "tf_broadcast", "use_sim_time"])
def test_a_switch_is_read_as_yaml_reads_it(launch_file: dict[str, Any], name: str, text: str, value: bool) -> None:
    assert started_with(launch_file, **{name: text})["parameters"][1] == {name: value}


@pytest.mark.parametrize("text", ["ture", "2", "none", "-"])
def test_a_switch_that_is_neither_is_an_error(launch_file: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=f"autostart:={text}: must be true or false"):
        started_with(launch_file, autostart=text)
