"""Settings that no point could pass, and devices that are not there, are refused by name."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

import crossloc3d_ros
from crossloc3d_ros.config import ScanConfig, from_dict
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
def test_a_gpu_that_is_not_there_is_said() -> None:
    with pytest.raises(ConfigError, match="sees no GPU"):
        load_encoder(device="cuda")


def test_settings_are_declared_in_the_configuration_and_the_simulator_alone() -> None:
    """The simulator's stay with it: see the configuration's docstring."""
    package = Path(crossloc3d_ros.__file__).parent
    sources = {path.relative_to(package): path.read_text() for path in package.rglob("*.py")}
    assert {path.parts[0] for path, source in sources.items() if "= option(" in source} == {"config", "simulation"}
