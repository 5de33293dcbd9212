"""What every descriptor must keep: its own cloud alone decides, in any order, in any batch, on any backend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from crossloc3d_ros.config import ModelConfig, PreprocessingConfig
from crossloc3d_ros.encoder.checkpoint import fingerprint, load_checkpoint, load_encoder, save_checkpoint
from crossloc3d_ros.encoder.compiled import CompiledModel
from crossloc3d_ros.encoder.model import CAMPUS, OXFORD, CrossLoc3D
from crossloc3d_ros.encoder.runtime import Encoder
from crossloc3d_ros.errors import CheckpointError, CloudError, ConfigError
from crossloc3d_ros.types import Float32Array

SMALL = ModelConfig(
    channels=32, heads=2, fused_channels=64, clusters=16, descriptor_size=32, memory_sizes=(32, 16, 16) * 3
)
"""Every stage of the network at a width that a test can wait for."""


def street(n: int, seed: int) -> Float32Array:
    """Return points along two walls and on some boxes, in [-1, 1]^3."""
    rng = np.random.default_rng(seed)
    side = rng.choice([-0.3, 0.25], n)
    points = np.stack((rng.uniform(-1, 1, n), side + rng.normal(0, 0.01, n), rng.uniform(0, 0.3, n)), axis=1)
    boxes = rng.random(n) < 0.3
    points[boxes] = rng.choice(rng.uniform(-0.9, 0.9, (12, 3)), boxes.sum()) + rng.normal(0, 0.02, (boxes.sum(), 3))
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return np.clip(points @ turn.T, -1, 1).astype(np.float32)


def trained(config: ModelConfig, seed: int = 0) -> CrossLoc3D:
    """Return a model whose batch norms hold statistics that are neither 0 nor 1."""
    torch.manual_seed(seed)
    model = CrossLoc3D(config)
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, std=0.2)
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.normal_(std=0.2)
            module.running_var.uniform_(0.5, 2.0)
    return model.eval()


def describe(model: CrossLoc3D, clouds: list[Float32Array]) -> Float32Array:
    with torch.no_grad():
        descriptors: Float32Array = model([torch.from_numpy(cloud) for cloud in clouds]).numpy()
    return descriptors


@pytest.fixture(scope="module")
def model() -> CrossLoc3D:
    return trained(SMALL)


@pytest.mark.parametrize("batch", [2, 64])
def test_a_descriptor_does_not_depend_on_its_batch(model: CrossLoc3D, batch: int) -> None:
    clouds = [street(50 + 61 * i % 1500, i) for i in range(batch)]
    together = describe(model, clouds)
    for i in (0, 1, batch - 1):
        assert np.abs(describe(model, [clouds[i]])[0] - together[i]).max() < 1e-4


def test_a_descriptor_does_not_depend_on_the_order_of_points(model: CrossLoc3D) -> None:
    cloud = street(2000, 1)
    shuffled = np.random.default_rng(2).permutation(cloud)
    assert np.abs(describe(model, [cloud]) - describe(model, [shuffled])).max() < 1e-4
    compiled = CompiledModel(model, 2)
    assert np.abs(compiled.encode(cloud) - compiled.encode(shuffled)).max() < 1e-4


def test_descriptors_of_different_places_differ(model: CrossLoc3D) -> None:
    first, second = describe(model, [street(2000, 1), street(2000, 2)])
    assert np.abs(first - second).max() > 1e-2


VARIANTS = {
    "as published": SMALL,
    "one grain": ModelConfig(**{**SMALL.__dict__, "voxel_sizes": (0.12,)}),
    "four grains": ModelConfig(**{**SMALL.__dict__, "voxel_sizes": (0.05, 0.12, 0.2, 0.4), "memory_sizes": (16,) * 12}),
    "all branches kept": ModelConfig(**{**SMALL.__dict__, "kept_branches": 5}),
    "one branch kept": ModelConfig(**{**SMALL.__dict__, "kept_branches": 1}),
    "no selection": ModelConfig(**{**SMALL.__dict__, "kept_branches": 0}),
    "fine to coarse": ModelConfig(**{**SMALL.__dict__, "refinement": "fine_to_coarse"}),
    "no refinement": ModelConfig(**{**SMALL.__dict__, "refinement": "none"}),
    "one sub-step, no time": ModelConfig(**{**SMALL.__dict__, "sub_steps": 1, "time_embedding": False}),
    "narrow heads": ModelConfig(**{**SMALL.__dict__, "heads": 8}),
    "tiny voxels": ModelConfig(**{**SMALL.__dict__, "voxel_sizes": (0.002, 0.12, 0.4)}),
}


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", VARIANTS)
def test_the_compiled_network_is_the_network(name: str, threads: int) -> None:
    model = trained(VARIANTS[name])
    compiled = CompiledModel(model, threads)
    for cloud in (street(3000, 5), street(40, 6)):
        assert np.abs(compiled.encode(cloud) - describe(model, [cloud])[0]).max() < 1e-4


def test_one_point_is_enough(model: CrossLoc3D) -> None:
    cloud = np.zeros((1, 3), np.float32)
    descriptor = CompiledModel(model).encode(cloud)
    assert np.isfinite(descriptor).all()
    assert np.abs(descriptor - describe(model, [cloud])[0]).max() < 1e-4


def test_several_threads_may_encode_at_once(model: CrossLoc3D) -> None:
    from concurrent.futures import ThreadPoolExecutor

    compiled = CompiledModel(model, 2)
    clouds = [street(1500, seed) for seed in range(12)]
    expected = [compiled.encode(cloud) for cloud in clouds]
    with ThreadPoolExecutor(4) as pool:
        for descriptor, other in zip(pool.map(compiled.encode, clouds), expected, strict=True):
            assert np.array_equal(descriptor, other)


def test_widths_that_fill_no_vector_run_without_the_compiled_network() -> None:
    odd = ModelConfig(**{**SMALL.__dict__, "channels": 24, "heads": 3})
    model = trained(odd)
    assert not CompiledModel.can_compile(model)
    cloud = street(500, 1)
    encoder = Encoder(model, PreprocessingConfig(), "odd")
    assert np.abs(encoder.encode(cloud) - describe(model, [cloud])[0]).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"voxel_sizes": ()}, "1 to 4"),
        ({"voxel_sizes": (0.4, 0.1)}, "ascend"),
        ({"memory_sizes": (16,)}, "grains x sub-steps"),
        ({"heads": 5}, "multiple of 'heads'"),
    ],
)
def test_a_configuration_that_does_not_fit_itself_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CrossLoc3D(ModelConfig(**{**SMALL.__dict__, **change}))  # type: ignore[arg-type]


def test_the_presets_build() -> None:
    assert CrossLoc3D(CAMPUS).config.descriptor_size == 256
    assert CrossLoc3D(OXFORD).config.descriptor_size == 512


def test_weights_survive_the_disk(model: CrossLoc3D, tmp_path: Path) -> None:
    preprocessing = PreprocessingConfig(half_extent_m=40.0)
    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, model, preprocessing, {"training": "none"}, dtype="float32")
    checkpoint = load_checkpoint(path)
    assert checkpoint.preprocessing == preprocessing
    assert checkpoint.model.config == SMALL
    assert checkpoint.metadata == {"training": "none"}
    assert checkpoint.fingerprint == fingerprint(model, preprocessing)
    cloud = street(500, 1)
    # The fingerprint holds the weights to the bit; products may round otherwise where weights lie at other addresses.
    assert np.abs(describe(checkpoint.model, [cloud]) - describe(model, [cloud])).max() < 1e-5
    assert [p.name for p in tmp_path.iterdir()] == ["weights.safetensors"]


def test_half_precision_weights_stay_close(model: CrossLoc3D, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, model, PreprocessingConfig(), dtype="float16")
    encoder = load_encoder(path)
    cloud = street(1500, 1)
    expected = describe(model, [cloud])[0]
    assert np.linalg.norm(encoder.encode(cloud) - expected) < 0.02 * np.linalg.norm(expected)


def test_the_fingerprint_changes_with_weights_and_preprocessing(model: CrossLoc3D) -> None:
    other = trained(SMALL, seed=1)
    marks = {
        fingerprint(model, PreprocessingConfig()),
        fingerprint(other, PreprocessingConfig()),
        fingerprint(model, PreprocessingConfig(half_extent_m=49.0)),
    }
    assert len(marks) == 3


def test_a_weight_beyond_float16_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    model = trained(SMALL)
    with torch.no_grad():
        model.pooling.projection[0, 0] = 1e6
    with pytest.raises(CheckpointError, match=r"pooling\.projection"):
        save_checkpoint(tmp_path / "weights.safetensors", model, PreprocessingConfig())
    assert list(tmp_path.iterdir()) == []


def test_damaged_weights_are_refused(model: CrossLoc3D, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, model, PreprocessingConfig())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match="is it complete"):
        load_checkpoint(path)
    path.write_bytes(b"not weights at all")
    with pytest.raises(CheckpointError, match="is it complete"):
        load_checkpoint(path)
    with pytest.raises(CheckpointError, match="no such weights file"):
        load_checkpoint(tmp_path / "none.safetensors")


def test_weights_of_another_model_are_refused(model: CrossLoc3D, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, model, PreprocessingConfig())
    header = {"format": "crossloc3d_ros/1", "model": "{}", "preprocessing": "{}"}  # the published model's shapes
    state = load_file(path)
    save_file(state, path, metadata=header)
    with pytest.raises(CheckpointError, match="shape"):
        load_checkpoint(path)
    save_file({"other": torch.zeros(1)}, path, metadata=header)
    with pytest.raises(CheckpointError, match="missing"):
        load_checkpoint(path)
    save_file(state, path, metadata={"format": "pt"})
    with pytest.raises(CheckpointError, match="import_checkpoint"):
        load_checkpoint(path)


@pytest.mark.parametrize("shape", [(0, 3), (5, 2), (5,)])
def test_a_patch_of_the_wrong_shape_is_refused(model: CrossLoc3D, shape: tuple[int, ...]) -> None:
    with pytest.raises(CloudError, match=r"\(n, 3\)"):
        Encoder(model, PreprocessingConfig(), "x").encode(np.zeros(shape, np.float32))


def test_weights_can_be_read_by_everybody(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, CrossLoc3D(SMALL), PreprocessingConfig())
    assert path.stat().st_mode & 0o777 == 0o644
