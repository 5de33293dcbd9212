"""ROS parameters made from a configuration dataclass: names, defaults, descriptions and ranges are the fields' own."""

from __future__ import annotations

import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from crossloc3d_ros.config import Setting, check_value, from_dict, settings_of, unknown_setting
from crossloc3d_ros.errors import ConfigError

T = TypeVar("T")

_EVERY_NODES_OWN = ("use_sim_time", "start_type_description_service")
_QOS = "qos_overrides."
_CLIENT_LIBRARYS_TOPICS = ("/clock", "/parameter_events", "/rosout")


def descriptor_of(setting: Setting) -> ParameterDescriptor:
    """Return a setting's description and range as ROS shows and enforces them."""
    descriptor = ParameterDescriptor(description=setting.text)
    low, high = setting.low, setting.high
    if setting.choices:
        descriptor.additional_constraints = f"one of: {', '.join(setting.choices)}"
    elif low is None or high is None:
        pass  # every number has both; what has none is text or a switch
    elif setting.hint is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    elif setting.hint is float:
        bounds = FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        descriptor.floating_point_range = [bounds]
    else:
        descriptor.additional_constraints = f"each value between {low} and {high}"
    return descriptor


class ConfigParameters(Generic[T]):
    """The parameters of a node that mirror one configuration dataclass, and that configuration as it stands now.

    The node must have been made with `automatically_declare_parameters_from_overrides=True`: that is how overrides
    from files and command lines show that belong to no field, and they are refused.
    """

    def __init__(
        self,
        node: Node,
        kind: type[T],
        *,
        topics: Sequence[str] = (),
        why_fixed: Callable[[str], str | None] = lambda name: None,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        """Declare every field; raises ConfigError naming each override that is unknown or out of range.

        `topics` are the fully qualified topics whose QoS may be overridden. `why_fixed(name)` returns why a parameter
        cannot be changed now, or None; `on_change` is called after a change.
        """
        self._node = node
        self._kind = kind
        self._settings = {setting.name: setting for setting in settings_of(kind)}
        self._topics = (*topics, *_CLIENT_LIBRARYS_TOPICS)
        self._why_fixed = why_fixed
        self._on_change = on_change
        self._declare(self._overrides())
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._changed)

    @property
    def config(self) -> T:
        """Return the configuration that the parameters' values make; raises ConfigError."""
        return self._with([])

    def admit(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Return those parameters that change anything, integers converted to the floats that they are meant to be.

        Of a name that comes twice the last value counts. Raises ConfigError that names what is unknown or wrong, alone
        or beside the values of the others; rclpy's own message leaves the name out.
        """
        for parameter in parameters:
            if not self._node.has_parameter(parameter.name):
                raise ConfigError(self._unknown(parameter.name))
        last = {parameter.name: parameter for parameter in parameters}
        changes = [change for change in map(self._change, last.values()) if change is not None]
        self._with(changes)
        return changes

    def _change(self, parameter: Parameter) -> Parameter | None:
        """Return the parameter as it can be set; None where it has this value already, which is no change."""
        name, setting = parameter.name, self._settings.get(parameter.name)
        if setting is not None:
            value = check_value(name, setting.hint, _plain(parameter.value), setting.metadata)
            parameter = Parameter(name, value=_ros(value))
        held = self._node.get_parameter(name)
        if parameter.type_ == held.type_ and _plain(parameter.value) == _plain(held.value):
            return None
        if parameter.type_ != held.type_:  # only of those that are no settings
            raise ConfigError(f"'{name}' must be of type {held.type_.name.lower()}, got {parameter.type_.name.lower()}")
        reason = self._why_fixed(name) if setting is not None else None
        if reason is not None:
            raise ConfigError(f"'{name}' {reason}")
        return parameter

    def _with(self, changes: Sequence[Parameter]) -> T:
        """Return the configuration after some changes; ConfigError where values contradict each other."""
        new = {change.name: _plain(change.value) for change in changes}
        return self._made_of({name: new[name] if name in new else self._value(name) for name in self._settings})

    def _made_of(self, values: Mapping[str, Any]) -> T:
        return from_dict(self._kind, _nested(values))

    def _overrides(self) -> dict[str, Any]:
        given = {name: self._value(name) for name in self._node.list_parameters([], 0).names}
        others = [name for name in given if name not in self._settings and name not in _EVERY_NODES_OWN]
        unknown = [name for name in others if not name.startswith(_QOS)]
        if unknown:
            raise ConfigError("; ".join(self._unknown(name) for name in unknown))
        # The dump of a node with other remaps holds such; this one has nothing that they could mean.
        idle = [n for n in others if n.startswith(_QOS) and not any(n.startswith(f"{_QOS}{t}.") for t in self._topics)]
        for name in idle:
            self._node.undeclare_parameter(name)
        if idle:
            self._node.get_logger().warning(f"of no effect: {'; '.join(self._unknown(name) for name in idle)}")
        return {name: value for name, value in given.items() if name in self._settings}

    def _unknown(self, name: str) -> str:
        if name.startswith(_QOS):
            return f"unknown parameter '{name}': QoS can be overridden for {', '.join(self._topics)}"
        return unknown_setting(name, list(self._settings), "parameter")

    def _declare(self, overrides: Mapping[str, Any]) -> None:
        self._made_of(overrides)
        for name, setting in self._settings.items():
            value = setting.default
            if name in overrides:
                # Once more for its own sake: an integer is converted to the float that the field holds.
                value = check_value(name, setting.hint, overrides[name], setting.metadata)
                self._node.undeclare_parameter(name)
            self._node.declare_parameter(name, _ros(value), descriptor_of(setting), ignore_override=True)

    def _value(self, name: str) -> Any:
        return _plain(self._node.get_parameter(name).value)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        # Called for declarations too, of parameters that do not exist yet.
        try:
            self.admit([parameter for parameter in parameters if self._node.has_parameter(parameter.name)])
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _changed(self, parameters: list[Parameter]) -> None:
        if any(parameter.name in self._settings for parameter in parameters):
            self._on_change()


def _plain(value: Any) -> Any:
    """Return a parameter's value as the configuration reads it."""
    return list(value) if isinstance(value, (array.array, tuple)) else value


def _ros(value: Any) -> Any:
    """Return a configuration's value as a parameter holds it."""
    return list(value) if isinstance(value, tuple) else value


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted names as nested mappings."""
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, last = name.split(".")
        here = nested
        for group in groups:
            here = here.setdefault(group, {})
        here[last] = value
    return nested
