"""The competitors: sizes as published, descriptors of one cloud alone, gradients everywhere, weights that survive."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from crossloc3d_ros.config import ModelConfig, PreprocessingConfig
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.baselines import pyramid
from crossloc3d_ros.encoder.baselines.lpdnet import local_features, nearest, voxel_means
from crossloc3d_ros.encoder.baselines.minkloc import spherical_steps
from crossloc3d_ros.encoder.checkpoint import fingerprint, load_checkpoint, load_encoder, save_checkpoint
from crossloc3d_ros.encoder.networks import PUBLISHED, make_network
from crossloc3d_ros.encoder.sparse import sparse_convolution, voxelize
from crossloc3d_ros.errors import CheckpointError, ConfigError
from crossloc3d_ros.types import Float32Array

NAMES = list(PUBLISHED)
EVERY = ["crossloc3d", *NAMES]


def small(name: str) -> ModelConfig:
    """Return the network at a width that a test can wait for."""
    sizes = (0.1, 0.3) if name == "crossloc3d" else (0.1,)
    return ModelConfig(
        network=name, voxel_sizes=sizes, channels=16, sub_steps=1, memory_sizes=(16, 16), fused_channels=32, clusters=8,
        descriptor_size=32,
    )  # type: ignore[arg-type]  # fmt: skip


def cloud(points: int, seed: int) -> torch.Tensor:
    """Return points on some walls, in [-1, 1]^3."""
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-0.9, 0.9, (6, 2))
    xyz = np.column_stack((rng.choice(walls, points) + rng.normal(0, 0.02, (points, 2)), rng.uniform(0, 0.3, points)))
    xyz[::2, 0] = rng.uniform(-1, 1, len(xyz[::2]))
    return torch.from_numpy(np.clip(xyz, -1, 1).astype(np.float32))


def used(name: str) -> Network:
    """Return a network as some training would leave it: nothing at zero, norms with statistics of their own."""
    torch.manual_seed(3)
    network = make_network(small(name))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            module.momentum = None  # the mean of all batches
    for step in range(3):
        network([cloud(300 + 40 * step, i) for i in range(4)])
    return network.eval()


def describe(network: Network, clouds: list[torch.Tensor]) -> Float32Array:
    with torch.no_grad():
        descriptors: Float32Array = network(clouds).numpy()
    return descriptors


PARAMETERS = {
    "pointnetvlad": 19.78e6,  # MinkLoc3D (WACV 2021), table of runtimes: 19.78 M
    "lpdnet": 19.81e6,  # the same table: 19.81 M, of which the feature transform that never learns has 1.86 M
    "minkloc3d": 1.06e6,  # the same table: 1.1 M; the released configuration has 1,055,713
    "minkloc3dv2": 2.66e6,  # MinkLoc3Dv2 (ICPR 2022): 2.7 M
    "minkloc3d_s": 1.06e6,  # MinkLoc3D with other coordinates
    "transloc3d": 10.97e6,  # TransLoc3D: the released configuration
}


@pytest.mark.parametrize("name", NAMES)
def test_the_networks_are_as_large_as_published(name: str) -> None:
    count = sum(p.numel() for p in make_network(PUBLISHED[name]).parameters())
    without = 1.86e6 if name == "lpdnet" else 0.0
    assert count == pytest.approx(PARAMETERS[name] - without, rel=0.01)


@pytest.mark.parametrize("name", EVERY)
def test_a_descriptor_depends_on_its_own_cloud_alone(name: str) -> None:
    network = used(name)
    clouds = [cloud(n, n) for n in (700, 90, 15, 400)]
    together = describe(network, clouds)
    assert together.shape == (4, 32)
    assert np.isfinite(together).all()
    scale = np.abs(together).max()
    for i, alone in enumerate(clouds):
        assert np.abs(describe(network, [alone])[0] - together[i]).max() < 1e-4 * scale
    assert np.abs(together[0] - together[3]).max() > 1e-3 * scale


@pytest.mark.parametrize("name", EVERY)
def test_the_order_of_points_does_not_matter(name: str) -> None:
    network = used(name)
    points = cloud(800, 5)
    shuffled = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(1))]
    plain, other = describe(network, [points])[0], describe(network, [shuffled])[0]
    assert np.abs(plain - other).max() < 1e-4 * np.abs(plain).max()


@pytest.mark.parametrize("name", EVERY)
def test_gradients_reach_every_weight(name: str) -> None:
    network = used(name).train()
    target = torch.randn(4, 32)
    (network([cloud(200, i) for i in range(4)]) - target).square().sum().backward()
    silent = [
        n
        for n, p in network.named_parameters()
        if p.grad is None or not bool((p.grad != 0).any() & p.grad.isfinite().all())
    ]
    assert silent == []


@pytest.mark.parametrize("name", EVERY)
def test_weights_survive_the_disk_and_serve_an_encoder(name: str, tmp_path: Path) -> None:
    network = used(name)
    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, network, PreprocessingConfig(), {"training": "none"}, dtype="float32")
    checkpoint = load_checkpoint(path)
    assert type(checkpoint.model) is type(network)
    assert checkpoint.model.config == network.config
    assert checkpoint.fingerprint == fingerprint(network, PreprocessingConfig())
    points = cloud(300, 1)
    expected = describe(network, [points])[0]
    # The fingerprint holds the weights to the bit; products may round otherwise where weights lie at other addresses.
    assert np.abs(describe(checkpoint.model, [points])[0] - expected).max() < 1e-5 * np.abs(expected).max()
    encoder = load_encoder(path)
    assert encoder.model_config.network == name
    assert np.abs(encoder.encode(points.numpy()) - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize("name", NAMES)
def test_another_networks_weights_are_refused(name: str, tmp_path: Path) -> None:
    network = used(name)
    network.config = dataclasses.replace(network.config, network="crossloc3d", voxel_sizes=(0.1, 0.3))
    path = tmp_path / "weights.safetensors"
    save_checkpoint(path, network, PreprocessingConfig(), dtype="float32")
    with pytest.raises(CheckpointError, match=r"does not fit its own configuration.*crossloc3d"):
        load_checkpoint(path)


def test_a_setting_that_came_later_leaves_old_fingerprints_alone() -> None:
    torch.manual_seed(0)
    network = make_network(small("crossloc3d"))
    with torch.no_grad():
        for tensor in network.state_dict().values():
            tensor.fill_(1)
    # a map made with these weights names these digits, whatever settings are added with a default
    assert fingerprint(network, PreprocessingConfig()) == "23dcb9afd8ec1b79"
    network.config = dataclasses.replace(network.config, position="radial")
    assert fingerprint(network, PreprocessingConfig()) != "23dcb9afd8ec1b79"


def test_every_network_has_a_fingerprint_of_its_own() -> None:
    empty = torch.nn.Module()
    marks = set()
    for name in EVERY:
        empty.config = small(name)  # type: ignore[assignment]
        marks.add(fingerprint(empty, PreprocessingConfig()))  # type: ignore[arg-type]
    assert len(marks) == len(EVERY)


@pytest.mark.parametrize("sizes", [(), (0.0,), (-0.1,)])
def test_voxels_without_a_size_are_refused(sizes: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match="voxel_sizes"):
        make_network(dataclasses.replace(small("minkloc3d"), voxel_sizes=sizes))


def test_halving_is_the_dense_strided_convolution_and_doubling_its_transpose() -> None:
    grid = voxelize([cloud(400, 1), cloud(60, 2)], 0.1)
    coarse, pairs = pyramid.halve(grid)
    assert sorted(pairs.in_rows.tolist()) == list(range(len(grid.coords)))
    x = torch.randn(len(grid.coords), 16)
    weight = torch.randn(8, 16, 16)
    coarse_x = torch.randn(len(coarse.coords), 16)
    halved, doubled = (
        sparse_convolution(x, weight, pairs),
        sparse_convolution(coarse_x, weight, pyramid.reversed_map(pairs)),
    )
    kernel = weight.view(2, 2, 2, 16, 16)  # z, y, x, in, out
    for number in range(2):
        fine_rows, coarse_rows = grid.batch == number, coarse.batch == number
        at = tuple((grid.coords[fine_rows].long() + 20)[:, axis] for axis in (2, 1, 0))
        coarse_at = tuple(((coarse.coords[coarse_rows].long() + 20) // 2)[:, axis] for axis in (2, 1, 0))
        dense = torch.zeros(1, 16, 40, 40, 40)
        dense[(0, slice(None), *at)] = x[fine_rows].t()
        expected = torch.nn.functional.conv3d(dense, kernel.permute(4, 3, 0, 1, 2), stride=2)[
            (0, slice(None), *coarse_at)
        ]
        assert torch.allclose(halved[coarse_rows], expected.t(), atol=1e-4)
        dense = torch.zeros(1, 16, 20, 20, 20)
        dense[(0, slice(None), *coarse_at)] = coarse_x[coarse_rows].t()
        expected = torch.nn.functional.conv_transpose3d(dense, kernel.permute(3, 4, 0, 1, 2), stride=2)
        assert torch.allclose(doubled[fine_rows], expected[(0, slice(None), *at)].t(), atol=1e-4)


def test_grids_halve_again_and_again() -> None:
    grid = voxelize([cloud(500, 1), cloud(300, 4)], 0.02)
    for stride in (2, 4, 8, 16):
        fine = grid
        grid, pairs = pyramid.halve(fine)
        assert grid.stride == stride
        offset = fine.coords[pairs.in_rows.long()] - grid.coords[pairs.out_rows.long()]
        assert int(offset.min()) >= 0
        assert int(offset.max()) < stride
        kernels = torch.repeat_interleave(torch.arange(8), torch.tensor(pairs.first).diff())
        assert torch.equal((offset // fine.stride) @ torch.tensor([1, 2, 4], dtype=torch.int32), kernels.int())
        assert torch.equal(fine.batch[pairs.in_rows.long()], grid.batch[pairs.out_rows.long()])


def test_the_generalised_mean_lies_between_mean_and_maximum() -> None:
    grid = voxelize([cloud(200, 1), cloud(50, 2)], 0.1)
    x = torch.rand(len(grid.coords), 5) + 0.1
    pool = pyramid.GeneralizedMean()
    parts = torch.split(x, grid.starts.diff().tolist())
    for power, expected in ((1.0, [p.mean(0) for p in parts]), (200.0, [p.amax(0) for p in parts])):
        pool.power.data.fill_(power)
        assert torch.allclose(pool(x, grid), torch.stack(expected), rtol=0.05)
    pool.power.data.fill_(3.0)
    expected = torch.stack([(p**3).mean(0) ** (1 / 3) for p in parts])
    assert torch.allclose(pool(x, grid), expected, atol=1e-5)


@pytest.mark.parametrize(("channels", "reach"), [(16, 3), (32, 3), (64, 3), (128, 5), (256, 5)])
def test_channel_attention_reaches_as_far_as_the_paper_says(channels: int, reach: int) -> None:
    assert pyramid.EfficientChannelAttention(channels).conv.kernel_size == (reach,)


def test_spherical_steps_are_those_of_plain_trigonometry() -> None:
    points = cloud(500, 7)
    points[:4] = torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5], [0.3, -1e-3, 0.1]])
    steps = spherical_steps(points, 0.05).numpy()
    for (x, y, z), found in zip(points.tolist(), steps, strict=True):
        reach = math.sqrt(x * x + y * y + z * z)
        bearing = math.degrees(math.atan2(y, x)) % 360.0
        assert found == pytest.approx(
            (reach / 0.05, bearing / 2.0, math.degrees(math.acos(z / reach)) / 1.875), rel=1e-5
        )
    assert steps[3, 1] == pytest.approx(180.0, abs=0.2)  # just short of a full turn, not just below nothing


def test_a_rotation_moves_bearings_alone() -> None:
    points = cloud(300, 8).double()
    angle = math.radians(14.0)
    rotated = points.clone()
    rotated[:, 0] = math.cos(angle) * points[:, 0] - math.sin(angle) * points[:, 1]
    rotated[:, 1] = math.sin(angle) * points[:, 0] + math.cos(angle) * points[:, 1]
    before, after = spherical_steps(points, 0.05), spherical_steps(rotated, 0.05)
    assert torch.allclose(before[:, [0, 2]], after[:, [0, 2]], atol=1e-4)
    assert torch.allclose(torch.remainder(after[:, 1] - before[:, 1] - 7.0 + 90, 180.0), torch.tensor(90.0), atol=1e-3)


def test_the_sensors_own_place_has_a_direction_too() -> None:
    assert torch.equal(spherical_steps(torch.zeros(1, 3), 0.05), torch.zeros(1, 3))


def test_voxel_means_are_the_means_of_the_voxels() -> None:
    points = cloud(400, 3)
    groups: dict[tuple[int, ...], list[torch.Tensor]] = {}
    for point in points:
        groups.setdefault(tuple(np.floor(point.numpy() / np.float32(0.2)).astype(int)), []).append(point.double())
    expected = torch.stack([torch.stack(groups[key]).mean(0) for key in sorted(groups)]).float()
    assert torch.allclose(voxel_means(points, 0.2), expected, atol=1e-6)


def test_local_features_separate_a_wall_from_a_pole_from_a_roof() -> None:
    rng = np.random.default_rng(0)
    n = 60
    wall = np.column_stack((rng.uniform(0, 0.2, n), np.zeros(n), rng.uniform(0, 0.2, n)))
    pole = np.column_stack((np.zeros((n, 2)), rng.uniform(0, 0.3, n)))
    roof = np.column_stack((rng.uniform(0, 0.2, (n, 2)), np.full(n, 0.3)))
    shapes = [torch.from_numpy(shape + rng.normal(0, 1e-4, shape.shape)).float() for shape in (wall, pole, roof)]
    wall_f, pole_f, roof_f = (local_features(shape, nearest(shape)).median(dim=0).values for shape in shapes)
    curvature, linearity, flat_linearity, vertical, rise = 0, 2, 6, 7, 8
    assert max(f[curvature] for f in (wall_f, pole_f, roof_f)) < 0.02
    assert pole_f[linearity] > 0.99 > wall_f[linearity]
    assert roof_f[vertical] > 0.98
    assert wall_f[vertical] < 0.05
    assert wall_f[flat_linearity] < 0.01 < roof_f[flat_linearity]
    assert roof_f[rise] < 0.01 < wall_f[rise]


def test_few_points_have_features_too() -> None:
    for points in (torch.zeros(1, 3), torch.tensor([[0.0, 0, 0], [0.5, 0, 0]])):
        features = local_features(points, nearest(points))
        assert features.shape == (len(points), 10)
        assert features.isfinite().all()
