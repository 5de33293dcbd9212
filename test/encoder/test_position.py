"""The position embedding of the voxels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.compiled import CompiledModel
from crossloc3d_ros.encoder.model import CrossLoc3D, PositionEmbedding
from crossloc3d_ros.types import Float32Array

SMALL = {"channels": 16, "heads": 2, "memory_sizes": (16,) * 9, "fused_channels": 32, "clusters": 16}


def _model(kind: str) -> CrossLoc3D:
    torch.manual_seed(0)
    model = CrossLoc3D(ModelConfig(position=kind, **SMALL))  # type: ignore[arg-type]
    for module in model.modules():
        if isinstance(module, PositionEmbedding):
            torch.nn.init.normal_(module.linear.weight, std=0.3)
    return model.eval()


def _cloud(seed: int) -> Float32Array:
    return np.random.default_rng(seed).uniform(-1.4, 1.4, (1200, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", ["radial", "cartesian"])
@pytest.mark.parametrize("threads", [1, 2])
def test_compiled_network_embeds_as_torch_does(kind: str, threads: int) -> None:
    model, clouds = _model(kind), [_cloud(seed) for seed in range(3)]
    with torch.no_grad():
        expected = model([torch.from_numpy(cloud) for cloud in clouds]).numpy()
    compiled = CompiledModel(model, threads)
    np.testing.assert_allclose(compiled.encode_many(clouds), expected, atol=1e-5)
    np.testing.assert_allclose(compiled.encode(clouds[0]), expected[0], atol=1e-5)


def test_radial_embedding_is_invariant_to_rotations_and_cartesian_is_not() -> None:
    places = _cloud(1)
    rotated = rotate_about_z(places, 1.0)
    for kind, equal in (("radial", True), ("cartesian", False)):
        embedding = PositionEmbedding(kind, 8)
        torch.nn.init.normal_(embedding.linear.weight)
        with torch.no_grad():
            before, after = embedding(torch.from_numpy(places)), embedding(torch.from_numpy(rotated))
        assert torch.allclose(before, after, atol=1e-4) == equal


def test_fresh_embedding_changes_nothing() -> None:
    torch.manual_seed(3)
    plain = CrossLoc3D(ModelConfig(**SMALL)).eval()  # type: ignore[arg-type]
    with_position = CrossLoc3D(ModelConfig(position="cartesian", **SMALL)).eval()  # type: ignore[arg-type]
    missing = with_position.load_state_dict(plain.state_dict(), strict=False).missing_keys
    assert all("position" in key for key in missing) and missing
    cloud = [torch.from_numpy(_cloud(4))]
    with torch.no_grad():
        assert torch.equal(plain(cloud), with_position(cloud))
