"""Rays against shapes whose distances can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.scene import ASPRS_CLASS, Label, Scene


def one_box(width: float = 4.0, depth: float = 6.0, height: float = 5.0) -> Scene:
    """Return a flat-roofed house around (10, 0) on the ground."""
    footprint = mesh.oriented_boxes(np.array([[10.0, 0.0]]), width, depth, 0.0)
    zeros = np.zeros(1)
    label = np.array([Label.BUILDING], dtype=np.uint8)
    return mesh.scene_from([mesh.prisms(footprint, zeros, zeros + height, zeros + height, zeros, label)])


def test_rays_meet_a_box_where_geometry_says() -> None:
    scene = one_box()
    origins = np.array([[0, 0, 1], [0, 0, 1], [10, 0, 20], [0, 0, 1], [10, -20, 2]], dtype=np.float32)
    directions = np.array([[1, 0, 0], [-1, 0, 0], [0, 0, -1], [0, 0, 1], [0, 1, 0]], dtype=np.float32)
    hits = scene.cast(origins, directions)
    np.testing.assert_allclose(hits.distance_m, [8.0, np.inf, 15.0, np.inf, 17.0], rtol=1e-6)
    np.testing.assert_array_equal(hits.label, [Label.BUILDING, 0, Label.BUILDING, 0, Label.BUILDING])
    np.testing.assert_array_equal(hits.mask, [True, False, True, False, True])


def test_incidence_is_the_angle_to_the_wall() -> None:
    angles = np.radians([0.0, 10.0, 15.0])
    directions = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1).astype(np.float32)
    hits = one_box().cast(np.tile(np.float32([[0, 0, 1]]), (3, 1)), directions)
    np.testing.assert_allclose(hits.incidence_cos, np.cos(angles), atol=1e-6)
    np.testing.assert_allclose(hits.distance_m, 8.0 / np.cos(angles), rtol=1e-5)


@pytest.mark.parametrize(("hip", "x", "y", "height"), [
    (0.0, 0.0, 0.0, 8.0), (0.0, 0.0, 2.0, 6.5), (0.0, 4.9, 0.0, 8.0), (0.5, 0.0, 0.0, 8.0), (0.5, 2.5, 0.0, 6.5),
])  # fmt: skip
def test_roofs_have_their_planes(hip: float, x: float, y: float, height: float) -> None:
    """A house of 10 x 8 m, eaves at 5 m, ridge along x at 8 m."""
    footprint = mesh.oriented_boxes(np.zeros((1, 2)), 10.0, 8.0, 0.0)
    one = np.ones(1)
    scene = mesh.scene_from([mesh.prisms(footprint, 0 * one, 5 * one, 8 * one, hip * one, np.array([2], np.uint8))])
    hits = scene.cast(np.float32([[x, y, 50]]), np.float32([[0, 0, -1]]))
    assert 50.0 - hits.distance_m[0] == pytest.approx(height, abs=1e-3)


def test_a_house_is_closed() -> None:
    """From inside, no ray gets out."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for hip, ridge in ((0.0, 5.0), (0.0, 8.0), (0.3, 8.0), (0.5, 8.0)):
        footprint = mesh.oriented_boxes(np.zeros((1, 2)), 10.0, 8.0, 0.4)
        one = np.ones(1)
        part = mesh.prisms(footprint, 0 * one, 5 * one, ridge * one, hip * one, np.array([2], np.uint8))
        hits = mesh.scene_from([part]).cast(np.tile(np.float32([[0, 0, 2]]), (500, 1)), directions.astype(np.float32))
        assert hits.mask.all()


def test_height_grid_is_interpolated() -> None:
    heights = np.add.outer(np.arange(5) * 0.5, np.arange(7) * 0.25)
    scene = mesh.scene_from([mesh.height_grid(heights, -3.0, 2.0, 2.0, Label.GROUND)])
    hits = scene.cast(np.float32([[1.5, 5.0, 30]]), np.float32([[0, 0, -1]]))
    assert 30.0 - hits.distance_m[0] == pytest.approx(0.25 * 4.5 / 2 + 0.5 * 3 / 2, abs=1e-4)


def test_no_rays_no_hits() -> None:
    assert len(one_box().cast(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)).distance_m) == 0


@pytest.mark.parametrize(("vertices", "faces", "labels", "what"), [
    (np.zeros((3, 2)), [[0, 1, 2]], [1], "vertices"), (np.zeros((3, 3)), np.zeros((0, 3)), [], "faces"),
    (np.zeros((3, 3)), [[0, 1, 2]], [1, 2], "labels"), (np.zeros((3, 3)), [[0, 1, 3]], [1], "do not exist"),
])  # fmt: skip
def test_impossible_meshes_are_refused(vertices: object, faces: object, labels: object, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        Scene(vertices, faces, labels)  # type: ignore[arg-type]


def test_labels_have_asprs_classes() -> None:
    np.testing.assert_array_equal(ASPRS_CLASS[[1, 2, 3, 4, 5]], [2, 6, 1, 1, 9])
