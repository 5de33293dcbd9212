"""Settings from outside: the parameter file of a node, assignments on a command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from crossloc3d_ros.config.localizer import LocalizerNodeConfig
from crossloc3d_ros.config.settings import from_dict
from crossloc3d_ros.errors import ConfigError


def read_node_config(
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


def parse_assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Return settings given as `group.name=value` as nested groups; ConfigError where one is not of that form."""
    settings: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise ConfigError(f"--set takes NAME=VALUE, such as fusion.min_probability=0.99, got '{text}'")
        *groups, last = name.split(".")
        place = settings
        for group in groups:
            place = place.setdefault(group, {})
            if not isinstance(place, dict):
                raise ConfigError(f"--set {text}: '{group}' was given a value before")
        try:
            place[last] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {text}: cannot read the value") from error
    return settings
