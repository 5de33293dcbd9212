"""Settings that no point could pass, and devices that are not there, are refused by name."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
import yaml

import crossloc3d_ros
from crossloc3d_ros.config import RENAMED, LocalizerNodeConfig, ScanConfig, TrainConfig, from_dict, settings_of
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import ConfigError


def test_a_range_that_is_empty_is_refused() -> None:
    with pytest.raises(ConfigError, match="min_range_m"):
        from_dict(ScanConfig, {"min_range_m": 50.0, "max_range_m": 20.0})


def test_a_body_inside_out_is_refused() -> None:
    with pytest.raises(ConfigError, match="body_min_m"):
        from_dict(ScanConfig, {"body_min_m": [1.0, 0.0, 0.0], "body_max_m": [0.0, 1.0, 1.0]})


def test_a_body_that_is_no_number_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"body_max_m\[1\]"):
        from_dict(ScanConfig, {"body_max_m": [1.0, math.nan, 1.0]})


def test_a_device_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="cpu or cuda"):
        load_encoder(device="tpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there_is_reported() -> None:
    with pytest.raises(ConfigError, match="sees no GPU"):
        load_encoder(device="cuda")


def test_settings_are_declared_in_the_configuration_and_the_simulator_alone() -> None:
    """The simulator's stay with it: see the configuration's docstring."""
    package = Path(crossloc3d_ros.__file__).parent
    sources = {path.relative_to(package): path.read_text() for path in package.rglob("*.py")}
    assert {path.parts[0] for path, source in sources.items() if "= option(" in source} == {"config", "simulation"}


def test_alignment_can_be_switched_off_in_yaml() -> None:
    """A bare `off` is a boolean there."""
    config = from_dict(LocalizerNodeConfig, yaml.safe_load("alignment: {scope: none}\nodometry: none"))
    assert (config.alignment.scope, config.odometry) == ("none", "none")


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_an_old_name_is_refused_with_the_new_one(old: str) -> None:
    kind = TrainConfig if old == "turns" else LocalizerNodeConfig
    *groups, last = old.split(".")
    values: dict[str, object] = {last: 1.0}
    for group in reversed(groups):
        values = {group: values}
    with pytest.raises(ConfigError) as caught:
        from_dict(kind, values)
    new = RENAMED[old] if not old.startswith("credibility.") else "retrieval"
    assert f"is now called '{new}'" in str(caught.value)


def test_every_new_name_is_that_of_a_setting_or_of_a_group() -> None:
    names = {setting.name for kind in (LocalizerNodeConfig, TrainConfig) for setting in settings_of(kind)}
    groups = {name.rpartition(".")[0] for name in names}
    assert set(RENAMED.values()) <= names | groups
    assert not set(RENAMED) & names
