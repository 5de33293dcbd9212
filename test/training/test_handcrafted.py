"""Scan Context against its definition, and both methods in the place of an encoder."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.config import HeightMapConfig, PreprocessingConfig
from crossloc3d_ros.errors import CloudError
from crossloc3d_ros.evaluation.retrieval.encoding import OwnDistance
from crossloc3d_ros.training.handcrafted import HeightMaps, ScanContext
from crossloc3d_ros.types import DescriptorEncoder, Float32Array


def place(seed: int, points: int = 1500) -> Float32Array:
    """Return walls and trees around a free centre, in patch units."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.8, 0.8, (14, 2))
    corners = corners[np.hypot(*corners.T) > 0.25]
    height = rng.uniform(0.02, 0.2, len(corners))
    owner = rng.integers(0, len(corners), points)
    xy = corners[owner] + rng.uniform(-0.08, 0.08, (points, 2))
    return np.column_stack((xy, rng.uniform(0.01, 1.0, points) * height[owner])).astype(np.float32)


def rotated(points: Float32Array, angle_rad: float) -> Float32Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return (points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32)


def context() -> ScanContext:
    return ScanContext(rings=8, sectors=24)


def test_a_map_holds_the_greatest_height_of_each_cell() -> None:
    points = place(1)
    expected = np.zeros((8, 24), np.float32)
    for x, y, z in points.tolist():
        ring, sector = int(math.hypot(x, y) * 8), int(math.degrees(math.atan2(y, x)) % 360.0 / 15.0)
        if ring < 8:
            expected[ring, sector] = max(expected[ring, sector], z)
    assert np.array_equal(context().encode(points), expected.ravel())


def test_the_published_distance_is_the_least_over_plain_shifts() -> None:
    subject = context()
    maps = subject.encode_batch([place(seed) for seed in range(4)])
    distances, _ = subject.compare(maps, maps)
    for i in range(4):
        for j in range(4):
            one, other = maps[i].reshape(8, 24), maps[j].reshape(8, 24)
            plain = []
            for shift in range(24):
                rolled = np.roll(other, -shift, axis=1)
                both = (one > 0).any(0) & (rolled > 0).any(0)
                cosines = (one * rolled).sum(0)[both] / (
                    np.linalg.norm(one, axis=0) * np.linalg.norm(rolled, axis=0)
                )[both]  # fmt: skip
                plain.append(1.0 - cosines.mean())
            assert distances[i, j] == pytest.approx(min(plain), abs=1e-4)


@pytest.mark.parametrize("method", [context(), HeightMaps(config=HeightMapConfig(sectors=24))], ids=["context", "maps"])
def test_a_rotated_scan_is_found_with_its_heading(method: ScanContext | HeightMaps) -> None:
    places = [place(seed) for seed in range(12)]
    database = method.encode_batch(places)
    for row, step in ((3, 5), (7, 17), (10, 0)):
        heading = step * math.pi / 12  # whole sectors of 15 degrees
        distances, headings, *_ = method.compare(method.encode_batch([rotated(places[row], -heading)]), database)
        assert distances[0].argmin() == row
        assert headings[0, row] == pytest.approx(heading)


@pytest.mark.parametrize("method", [ScanContext(), HeightMaps()], ids=["context", "maps"])
def test_methods_stand_in_for_an_encoder(method: DescriptorEncoder) -> None:
    assert isinstance(method, OwnDistance)
    method.warm_up()
    descriptors = method.encode_batch([place(1), place(2)])
    assert descriptors.shape == (2, method.descriptor_size)
    assert np.array_equal(method.encode(place(2)), descriptors[1])
    distances = method.distances(descriptors, descriptors)
    assert (distances.argmin(axis=1) == [0, 1]).all()
    with pytest.raises(CloudError, match="must be an array"):
        method.encode(np.zeros((5, 2), np.float32))


def test_what_decides_a_descriptor_decides_the_fingerprint() -> None:
    other = PreprocessingConfig(thin_m=0.4)
    methods = [
        ScanContext(), ScanContext(other), ScanContext(rings=10), HeightMaps(), HeightMaps(other),
        HeightMaps(config=HeightMapConfig(cells=50)),
    ]  # fmt: skip
    assert len({method.fingerprint for method in methods}) == len(methods)
    assert ScanContext().fingerprint == ScanContext().fingerprint


@pytest.mark.parametrize("method", [context(), HeightMaps()], ids=["context", "maps"])
def test_another_database_is_another_database(method: ScanContext | HeightMaps) -> None:
    first, second = (method.encode_batch([place(seed), place(seed + 1)]) for seed in (1, 5))
    query = method.encode_batch([place(5)])
    assert method.distances(query, first).min() > method.distances(query, second).min()
    assert method.distances(query, second)[0].argmin() == 0
