"""Triangles in bulk: every shape of a town is made for all its instances at once.

All functions return `Mesh`; `join` puts them together. Local metres, z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.simulation.scene import Scene
from crossloc3d_ros.types import Float32Array, Float64Array, Int32Array, UInt8Array


class Mesh(NamedTuple):
    """Triangles that are not yet a scene."""

    vertices: Float32Array
    """(V, 3) local metres."""
    faces: Int32Array
    """(F, 3) rows of the vertices."""
    labels: UInt8Array
    """(F,) `scene.Label`."""


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return all triangles as one mesh."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + np.int32(offset) for m, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([m.labels for m in meshes]),
    )


def scene_from(meshes: Sequence[Mesh]) -> Scene:
    """Return a scene of all the meshes' triangles."""
    return Scene(*join(meshes))


def instances(vertices: npt.NDArray[np.float64], faces: npt.ArrayLike, labels: npt.ArrayLike) -> Mesh:
    """Return K copies of one topology: `vertices` (K, V, 3), `faces` (F, 3) within a copy, `labels` (K,)."""
    count, size = vertices.shape[:2]
    pattern = np.asarray(faces, dtype=np.int32)
    all_faces = (np.arange(count, dtype=np.int32)[:, None, None] * np.int32(size) + pattern[None]).reshape(-1, 3)
    all_labels = np.repeat(np.asarray(labels, dtype=np.uint8), len(pattern))
    return Mesh(vertices.reshape(-1, 3).astype(np.float32), all_faces, all_labels)


_PRISM_FACES = (
    [[i, (i + 1) % 4, 4 + (i + 1) % 4] for i in range(4)]
    + [[i, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    + [[4, 5, 8], [4, 8, 9], [6, 7, 9], [6, 9, 8], [5, 6, 8], [7, 4, 9]]
    + [[0, 2, 1], [0, 3, 2]]
)


def prisms(
    footprints: Float64Array,
    bottom_m: Float64Array,
    eave_m: Float64Array,
    ridge_m: Float64Array,
    hip: Float64Array,
    labels: UInt8Array,
) -> Mesh:
    """Return K houses: four walls, a floor and a roof whose ridge runs along the edges 0-1 and 2-3.

    `footprints` (K, 4, 2) corners in order; `bottom_m`, `eave_m`, `ridge_m` (K,) heights, ridge = eave is a flat roof;
    `hip` (K,) how far the ridge's ends are drawn in: 0 a gable, 0.5 a pyramid; `labels` (K,).
    """
    count = len(footprints)
    vertices = np.empty((count, 10, 3))
    vertices[:, :4, :2] = footprints
    vertices[:, :4, 2] = bottom_m[:, None]
    vertices[:, 4:8, :2] = footprints
    vertices[:, 4:8, 2] = eave_m[:, None]
    end_1 = 0.5 * (footprints[:, 1] + footprints[:, 2])
    end_0 = 0.5 * (footprints[:, 3] + footprints[:, 0])
    vertices[:, 8, :2] = end_1 + hip[:, None] * (end_0 - end_1)
    vertices[:, 9, :2] = end_0 + hip[:, None] * (end_1 - end_0)
    vertices[:, 8:, 2] = ridge_m[:, None]
    return instances(vertices, _PRISM_FACES, labels)


def oriented_boxes(
    centres: Float64Array, lengths_m: npt.ArrayLike, widths_m: npt.ArrayLike, yaws_rad: npt.ArrayLike
) -> Float64Array:
    """Return the footprints (K, 4, 2) of rectangles around `centres` (K, 2), the length along the yaw."""
    yaw = np.asarray(yaws_rad, dtype=np.float64)
    forward = np.stack([np.cos(yaw), np.sin(yaw)], -1) * np.asarray(lengths_m, dtype=np.float64)[..., None] / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], -1) * np.asarray(widths_m, dtype=np.float64)[..., None] / 2
    forward, left = np.broadcast_arrays(forward, left)
    return np.stack(
        [centres - forward - left, centres + forward - left, centres + forward + left, centres - forward + left], axis=1
    )


def cylinders(
    centres: Float64Array,
    bottom_m: Float64Array,
    top_m: Float64Array,
    bottom_radius_m: Float64Array,
    top_radius_m: Float64Array,
    labels: UInt8Array,
    sides: int = 6,
) -> Mesh:
    """Return K upright cylinders or cones with a cap: `centres` (K, 2), all else (K,)."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    count = len(centres)
    vertices = np.empty((count, 2 * sides + 1, 3))
    vertices[:, :sides, :2] = centres[:, None] + bottom_radius_m[:, None, None] * ring
    vertices[:, :sides, 2] = bottom_m[:, None]
    vertices[:, sides : 2 * sides, :2] = centres[:, None] + top_radius_m[:, None, None] * ring
    vertices[:, sides : 2 * sides, 2] = top_m[:, None]
    vertices[:, 2 * sides, :2] = centres
    vertices[:, 2 * sides, 2] = top_m
    faces: list[list[int]] = []
    for i in range(sides):
        j = (i + 1) % sides
        faces += [[i, j, sides + j], [i, sides + j, sides + i], [sides + i, sides + j, 2 * sides]]
    return instances(vertices, faces, labels)


def leaves(centres: Float64Array, sizes_m: npt.ArrayLike, label: int, rng: np.random.Generator) -> Mesh:
    """Return one triangle of random attitude around each centre (K, 3): foliage that some rays pass through."""
    count = len(centres)
    first = rng.standard_normal((count, 3)).astype(np.float32)
    second = rng.standard_normal((count, 3)).astype(np.float32)
    first /= np.linalg.norm(first, axis=1, keepdims=True) + np.float32(1e-9)
    second -= first * np.einsum("ij,ij->i", first, second)[:, None]
    second /= np.linalg.norm(second, axis=1, keepdims=True) + np.float32(1e-9)
    size = np.broadcast_to(np.asarray(sizes_m, dtype=np.float32), (count,))[:, None]
    first *= size / np.float32(np.sqrt(3.0))
    second *= size / np.float32(2.0)
    middle = centres.astype(np.float32)
    vertices = np.stack([middle + first, middle - first / 2 + second, middle - first / 2 - second], axis=1)
    return Mesh(
        vertices.reshape(-1, 3),
        np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        np.full(count, label, dtype=np.uint8),
    )


def height_grid(heights: npt.NDArray[np.floating], west_m: float, south_m: float, cell_m: float, label: int) -> Mesh:
    """Return a surface over a grid of posts: `heights` (H, W), row 0 in the south, post (0, 0) at (west, south)."""
    rows, columns = heights.shape
    vertices = np.empty((rows, columns, 3), dtype=np.float32)
    vertices[..., 0] = west_m + np.arange(columns) * cell_m
    vertices[..., 1] = (south_m + np.arange(rows) * cell_m)[:, None]
    vertices[..., 2] = heights
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    return Mesh(vertices.reshape(-1, 3), faces, np.full(len(faces), label, dtype=np.uint8))
