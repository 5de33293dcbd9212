"""A query that is tried in several headings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.localization.retrieval.candidates import encode_query, heading_angles, search_headings
from crossloc3d_ros.types import Float32Array


class Compass:
    """An encoder whose descriptor is the mean of the points: it turns with the patch."""

    fingerprint = "compass"
    descriptor_size = 3

    def __init__(self, headings: int, rotations: int = 1) -> None:
        self.headings = headings
        self.rotations = rotations

    def encode(self, points: Float32Array) -> Float32Array:
        mean: Float32Array = points.mean(axis=0)
        return mean

    def encode_batch(self, clouds: list[Float32Array]) -> Float32Array:
        return np.stack([self.encode(cloud) for cloud in clouds])


class Plain(Compass):
    def __init__(self) -> None:
        pass


def _patch(rng: np.random.Generator) -> Float32Array:
    return rng.uniform((0.3, 0.0, 0.1), (0.7, 0.4, 0.5), (300, 3)).astype(np.float32)


def test_encoder_without_headings_is_asked_once() -> None:
    patch = _patch(np.random.default_rng(0))
    descriptors = encode_query(Plain(), patch)  # type: ignore[arg-type]
    np.testing.assert_array_equal(descriptors, Plain().encode(patch)[None])


def test_mean_over_turns_takes_the_heading_out() -> None:
    patch = _patch(np.random.default_rng(3))
    encoder = Compass(1, rotations=4)
    first, second = (encode_query(encoder, rotate_about_z(patch, angle)) for angle in (0.0, math.pi / 2))  # type: ignore[arg-type]
    np.testing.assert_allclose(first, second, atol=1e-6)
    np.testing.assert_allclose(first[0, :2], 0.0, atol=1e-6)
    assert first.shape == (1, 3)


@pytest.mark.parametrize("true_number", [0, 3, 7])
def test_heading_of_the_robot_comes_with_the_candidate(true_number: int) -> None:
    north_up = _patch(np.random.default_rng(1))
    angle = float(heading_angles(8)[true_number])
    as_the_robot_sees_it = rotate_about_z(north_up, -angle)
    encoder = Compass(8)
    submaps = DescriptorMap(np.stack([encoder.encode(north_up), np.float32([9.0, 9.0, 9.0])]))
    ids, distances, numbers = search_headings(submaps, encode_query(encoder, as_the_robot_sees_it), 2)  # type: ignore[arg-type]
    assert ids.tolist() == [0, 1]
    assert numbers[0] == true_number
    assert distances[0] < 1e-5


def test_search_is_the_minimum_over_the_headings_and_names_each_submap_once() -> None:
    rng = np.random.default_rng(2)
    stored, queries = rng.normal(size=(60, 8)).astype(np.float32), rng.normal(size=(5, 8)).astype(np.float32)
    table = np.linalg.norm(queries[:, None] - stored[None], axis=2)
    ids, distances, numbers = search_headings(DescriptorMap(stored), queries, 20)
    order = np.argsort(table.min(axis=0))[:20]
    assert ids.tolist() == order.tolist()
    np.testing.assert_allclose(distances, table.min(axis=0)[order], rtol=1e-5)
    assert numbers.tolist() == table.argmin(axis=0)[order].tolist()


def test_turn_goes_counter_clockwise_and_back() -> None:
    east = np.float32([[1.0, 0.0, 0.4]])
    np.testing.assert_allclose(rotate_about_z(east, math.pi / 2), [[0.0, 1.0, 0.4]], atol=1e-6)
    np.testing.assert_allclose(rotate_about_z(rotate_about_z(east, 0.7), -0.7), east, atol=1e-6)
