"""`ros2 param set`, `dump` and `load` in every state of the node: accepted or refused, with a reason."""

from __future__ import annotations

import array
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

pytest.importorskip("rclpy")

from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue, SetParametersResult
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_dict_from_yaml_file, parameter_value_to_python

from crossloc3d_ros.config import LocalizerNodeConfig, settings_of

if TYPE_CHECKING:
    from conftest import NodeProcess, Robot, StartNode, World

SETTINGS = {setting.name: setting for setting in settings_of(LocalizerNodeConfig)}
VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2**62, 0.0, 0.5, 90.0, -3.0, 1e300, math.nan, math.inf, -math.inf, "", "no such thing",
    [b"\x01"], [True], [1, 2, 3], [0.0, 0.0, 0.0], [9.0, 9.0, 9.0], [math.nan, 1.0, 1.0], [1.0], ["a"],
)  # fmt: skip
"""Some of every type that a parameter can have, most of which no setting takes."""


class Parameters:
    """The parameter services of the node, as the command `ros2 param` calls them."""

    def __init__(self, robot: Robot, node: str = "/localizer") -> None:
        self.robot, self.node = robot, node

    def _call(self, kind: type, name: str, **request: Any) -> Any:
        return self.robot.call(kind, f"{self.node}/{name}", kind.Request(**request))

    def set(self, *values: tuple[str, Any]) -> list[SetParametersResult]:
        """Set one after the other."""
        return list(
            self._call(SetParameters, "set_parameters", parameters=[_message(*pair) for pair in values]).results
        )

    def set_together(self, values: Mapping[str, Any]) -> SetParametersResult:
        """Set all or none."""
        parameters = [_message(*pair) for pair in values.items()]
        return self._call(SetParametersAtomically, "set_parameters_atomically", parameters=parameters).result

    def values(self) -> dict[str, Any]:
        """Return everything that the node has."""
        names = list(self._call(ListParameters, "list_parameters").result.names)
        found = self._call(GetParameters, "get_parameters", names=names).values
        plain = (parameter_value_to_python(value) for value in found)
        lists = [list(value) if isinstance(value, (array.array, list)) else value for value in plain]
        return dict(zip(names, lists, strict=True))

    def dump(self, path: Path) -> None:
        """Write them as `ros2 param dump` does."""
        nested: dict[str, Any] = {}
        for name, value in self.values().items():
            *groups, last = name.split(".")
            here = nested
            for group in groups:
                here = here.setdefault(group, {})
            here[last] = value
        path.write_text(yaml.dump({self.node: {"ros__parameters": nested}}, default_flow_style=False))

    def load(self, path: Path) -> list[SetParametersResult]:
        """Set them as `ros2 param load` does."""
        parameters = list(parameter_dict_from_yaml_file(str(path), True).values())
        return list(self._call(SetParameters, "set_parameters", parameters=parameters).results)


def _message(name: str, value: Any) -> ParameterMessage:
    return Parameter(name, value=value).to_parameter_msg()


@pytest.fixture(scope="module")
def node(start_stand_in: StartNode, world: World) -> Iterator[NodeProcess]:
    node = start_stand_in({**world.parameters(), "scan.max_range_m": 80.0, "autostart": False})
    yield node
    assert node.is_alive, f"a value has ended the node:\n{node.output}"
    assert node.stop() == 0
    assert "Traceback" not in node.output


@pytest.fixture(params=["unconfigured", "inactive", "active", "finalized"], scope="module")
def parameters(request: pytest.FixtureRequest, node: NodeProcess, robot: Robot) -> Parameters:
    """Take the node from state to state; one that has ended its life still answers."""
    transition = {
        "inactive": Transition.TRANSITION_CONFIGURE,
        "active": Transition.TRANSITION_ACTIVATE,
        "finalized": Transition.TRANSITION_ACTIVE_SHUTDOWN,
    }.get(request.param)
    if transition is not None:
        assert robot.change_state(transition), node.output
    assert robot.state() == request.param
    return Parameters(robot)


def test_every_value_of_every_parameter_is_taken_or_refused_with_its_name(
    parameters: Parameters, node: NodeProcess
) -> None:
    before = parameters.values()
    assert set(SETTINGS) < set(before)
    steps = []
    for name, value in before.items():
        setting = SETTINGS.get(name)
        own = (setting.low, setting.high, *setting.choices, setting.default) if setting else ()
        for other in (*VALUES, *(list(v) if isinstance(v, tuple) else v for v in own)):
            steps += [(name, other), (name, value)]
    results = parameters.set(*steps)
    for (name, value), result, back in zip(steps[::2], results[::2], results[1::2], strict=True):
        own_name = name.rpartition(".")[2]
        assert result.successful or own_name in result.reason, f"{name} = {value!r}: {result.reason}"
        assert back.successful, f"{name} after {value!r}: {back.reason}"
    assert parameters.values() == before
    assert node.is_alive, node.output


def test_a_value_of_no_type_that_there_is_does_not_end_the_node(parameters: Parameters, node: NodeProcess) -> None:
    """The client library raises where it reads one, and leaves the call unanswered."""
    client = parameters.robot.node.create_client(SetParameters, "/localizer/set_parameters")
    parameters.robot.wait_until(client.service_is_ready, 60.0)
    told = node.output.count("was left unanswered")
    strange = ParameterMessage(name="top_k", value=ParameterValue(type=200))
    client.call_async(SetParameters.Request(parameters=[strange]))
    node.wait_for_output("a message or call was left unanswered", 20.0)
    parameters.robot.wait_until(lambda: node.output.count("was left unanswered") > told, 20.0)
    parameters.robot.node.destroy_client(client)
    assert parameters.values()["top_k"] == SETTINGS["top_k"].default


def test_values_that_contradict_each_other_are_refused_and_the_rest_is_kept(
    parameters: Parameters, node: NodeProcess
) -> None:
    before = parameters.values()
    (result,) = parameters.set(("scan.min_range_m", 90.0))
    assert not result.successful
    assert "'min_range_m' (90.0) must be below 'max_range_m' (80.0)" in result.reason
    together = parameters.set_together({"scan.body_max_m": [-2.0, 0.5, 2.0], "top_k": 3})
    assert not together.successful
    assert "'body_min_m'" in together.reason
    assert parameters.values() == before
    assert parameters.set_together({"scan.min_range_m": 90.0, "scan.max_range_m": 100.0}).successful
    assert parameters.set_together({"scan.min_range_m": 1.0, "scan.max_range_m": 80.0}).successful
    assert node.is_alive, node.output


def test_ones_own_dump_loads_and_changes_nothing(parameters: Parameters, node: NodeProcess, tmp_path: Path) -> None:
    parameters.dump(tmp_path / "dump.yaml")
    told = node.output.count("other settings hold")
    results = parameters.load(tmp_path / "dump.yaml")
    assert len(results) > len(SETTINGS)
    assert [result.reason for result in results if not result.successful] == []
    assert node.output.count("other settings hold") == told


def test_a_node_starts_from_a_dump_without_the_remaps_of_the_dumped_one(
    start_stand_in: StartNode, world: World, robot: Robot, tmp_path: Path
) -> None:
    """Overrides for topics that it does not have hold nowhere, and it says so."""
    own = {**world.parameters(), "qos_overrides./lidar.subscription.depth": 7, "fusion.max_speed_mps": 4.0}
    first = start_stand_in(own, "-r", "__node:=first", "-r", "points:=/lidar")
    first.wait_for_output("listening on /lidar")
    dump = tmp_path / "dump.yaml"
    Parameters(robot, "/first").dump(dump)
    assert first.stop() == 0
    second = start_stand_in({}, "--params-file", str(dump), "-r", "__node:=first", "-r", "points:=/elsewhere")
    second.wait_for_output("listening on /elsewhere")
    assert "qos_overrides./lidar.subscription" in second.output
    assert Parameters(robot, "/first").values()["fusion.max_speed_mps"] == 4.0
    assert second.stop() == 0
