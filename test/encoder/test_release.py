"""The published network, exactly: golden descriptors under weights drawn by a rule from key names and shapes."""

from __future__ import annotations

import csv
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.compiled import CompiledModel
from crossloc3d_ros.encoder.model import CAMPUS, CrossLoc3D
from crossloc3d_ros.encoder.release import from_release, read_release, release_aliases, release_names
from crossloc3d_ros.encoder.sparse import voxelize
from crossloc3d_ros.errors import CheckpointError

GOLDEN = Path(__file__).with_name("golden")


def fan_in(key: str, shape: tuple[int, ...]) -> int:
    """Return the fan-in by which the rule scales a tensor."""
    last = key.rsplit(".", 1)[-1]
    if last == "kernel":
        return math.prod(shape[:-1])
    if last in ("cluster_weights2",):
        return shape[1]
    if last in ("centers", "cluster_weights", "hidden1_weights", "gating_weights"):
        return shape[0]
    return math.prod(shape[1:])


@cache
def golden_state(keys_file: Path, statistics_file: Path) -> dict[str, torch.Tensor]:
    """Draw the release's 701 tensors by the rule of the golden weights."""
    statistics = np.load(statistics_file)
    state: dict[str, torch.Tensor] = {}
    rows = list(csv.DictReader(keys_file.open(), delimiter="\t"))
    for row in sorted(rows, key=lambda row: row["key"]):
        key = row["key"]
        shape = () if row["shape"] == "scalar" else tuple(int(n) for n in row["shape"].split("x"))
        if row["alias_of_lst2"] == "1":
            continue
        x = np.random.default_rng(1000 + int(row["index"])).standard_normal(shape)
        if key.endswith("num_batches_tracked"):
            state[key] = torch.tensor(0)
            continue
        if key.endswith(("running_mean", "running_var")):
            value = statistics[key]
        elif len(shape) >= 2:
            value = x / math.sqrt(fan_in(key, shape))
        elif key.endswith("weights"):
            value = x
        elif key.endswith("weight"):
            value = 1.0 + 0.1 * x
        else:
            value = 0.1 * x
        state[key] = torch.from_numpy(np.asarray(value, np.float32))
    for alias, key in release_aliases(CAMPUS).items():
        state[alias] = state[key]
    return state


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    return golden_state(GOLDEN / "state_dict_keys.tsv", GOLDEN / "golden_batchnorm_stats.npz")


@pytest.fixture(scope="module")
def golden() -> Any:
    return np.load(GOLDEN / "golden_descriptors.npz")


def test_parameter_count_is_the_published_one() -> None:
    assert sum(p.numel() for p in CrossLoc3D(CAMPUS).parameters()) == 15_348_401


def test_names_cover_the_release() -> None:
    rows = list(csv.DictReader((GOLDEN / "state_dict_keys.tsv").open(), delimiter="\t"))
    assert len(rows) == 701
    assert {r["key"] for r in rows if r["alias_of_lst2"] == "0"} == set(release_names(CAMPUS).values())
    assert {r["key"] for r in rows if r["alias_of_lst2"] == "1"} == set(release_aliases(CAMPUS))
    assert set(release_names(CAMPUS)) == set(CrossLoc3D(CAMPUS).state_dict())


def test_model_gives_the_golden_descriptors(state: dict[str, torch.Tensor], golden: Any) -> None:
    model = from_release(state)
    for name, cloud, expected in zip(golden["names"], golden["clouds"], golden["descriptors"], strict=True):
        with torch.no_grad():
            descriptor = model([torch.from_numpy(cloud)])[0].numpy()
        assert np.abs(descriptor - expected).max() < 1e-4, name


def test_compiled_model_gives_the_golden_descriptors(state: dict[str, torch.Tensor], golden: Any) -> None:
    model = CompiledModel(from_release(state))
    for name, cloud, expected in zip(golden["names"], golden["clouds"], golden["descriptors"], strict=True):
        assert np.abs(model.encode(cloud) - expected).max() < 1e-4, name


def test_voxels_are_the_golden_ones(golden: Any) -> None:
    for cloud, fine, coarse in zip(golden["clouds"], golden["voxels"], golden["voxels_stride2"], strict=True):
        grids = [voxelize([torch.from_numpy(cloud)], size) for size in CAMPUS.voxel_sizes]
        assert [len(grid.coords) for grid in grids] == fine.tolist()
        assert [len(grid.downsample().coords) for grid in grids] == coarse.tolist()


def test_model_in_float64_agrees_with_the_float64_reference(state: dict[str, torch.Tensor], golden: Any) -> None:
    model = from_release(state).double()
    with torch.no_grad():
        descriptor = model([torch.from_numpy(golden["clouds"][1])])[0].numpy()
    assert np.abs(descriptor - golden["descriptors_float64"][1]).max() < 1e-5


def test_time_embedding_is_the_golden_one(state: dict[str, torch.Tensor], golden: Any) -> None:
    model = from_release(state)
    assert model.refinement is not None
    assert model.refinement.time is not None
    for step, expected in enumerate(golden["time_embedding"]):
        assert np.abs(model.refinement.time(step).detach().numpy() - expected).max() < 1e-5


def test_a_release_file_is_read(state: dict[str, torch.Tensor], tmp_path: Path) -> None:
    torch.save({"model_state_dict": state, "epoch": 3, "best_metrics": {}}, tmp_path / "release.pth")
    model = read_release(tmp_path / "release.pth")
    assert torch.equal(model.fusion.weight, state["backbone.conv_fuse.0.weight"][..., 0])


def test_missing_and_unknown_tensors_are_named(state: dict[str, torch.Tensor]) -> None:
    broken = dict(state)
    del broken["pool.net_vlad.bn1.bias"]
    broken["pool.other"] = torch.zeros(1)
    with pytest.raises(CheckpointError, match=r"missing: 'pool\.net_vlad\.bn1\.bias'.*unknown: 'pool\.other'"):
        from_release(broken)


def test_a_wrong_shape_is_named(state: dict[str, torch.Tensor]) -> None:
    broken = dict(state) | {"pool.net_vlad.bn1.bias": torch.zeros(3)}
    with pytest.raises(CheckpointError, match=r"bn1\.bias.*shape \(3,\).*\(64,\)"):
        from_release(broken)


def test_an_alias_that_differs_is_refused(state: dict[str, torch.Tensor]) -> None:
    alias = "backbone.up_conv0.0.kernel"
    with pytest.raises(CheckpointError, match="second name"):
        from_release(dict(state) | {alias: state[alias] + 1.0})


def test_a_file_with_code_in_it_is_refused(tmp_path: Path) -> None:
    torch.save({"model_state_dict": Path}, tmp_path / "code.pth")
    with pytest.raises(CheckpointError, match="cannot read"):
        read_release(tmp_path / "code.pth")


def test_a_truncated_file_is_refused(state: dict[str, torch.Tensor], tmp_path: Path) -> None:
    path = tmp_path / "cut.pth"
    torch.save({"model_state_dict": {"a": torch.zeros(1000)}}, path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(CheckpointError, match="cannot read"):
        read_release(path)


def test_a_model_of_another_configuration_is_refused(state: dict[str, torch.Tensor]) -> None:
    with pytest.raises(CheckpointError):
        from_release(state, ModelConfig(descriptor_size=128))
