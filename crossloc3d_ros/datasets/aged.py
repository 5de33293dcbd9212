"""A world many years later: some of its trees and houses are gone, everything else is what it was."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from crossloc3d_ros.simulation.scene import Label, Scene
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import BoolArray, Float64Array, Int64Array

TREES_GONE, HOUSES_GONE = 0.5, 0.2
"""Shares of the trees and of the houses; a renewed quarter and two decades of storms and saws, hardly more."""
_TREE_M = 8.0
"""Leaves do not hang together: those over one square of a tree's size stand for one tree."""


def aged(world: World, seed: int, trees_gone: float = TREES_GONE, houses_gone: float = HOUSES_GONE) -> World:
    """Return a world without so many of its trees and houses, drawn by the seed.

    A house is what hangs together by its corners: of a house with wings, each wing. Robots drive where they could drive
    before.
    """
    scene = world.scene
    rng = np.random.default_rng([seed, 8])
    gone = np.zeros(len(scene.faces), np.bool_)
    for label, thing, share in (
        (Label.VEGETATION, _trees(scene), trees_gone),
        (Label.BUILDING, _houses(scene), houses_gone),
    ):
        is_gone = rng.random(int(thing.max()) + 1) < share
        gone |= (scene.labels == label) & is_gone[thing]
    return dataclasses.replace(world, scene=_without(scene, gone))


def _trees(scene: Scene) -> Int64Array:
    """Return (F,) the number of the square that each face lies over."""
    middles: Float64Array = scene.vertices[scene.faces].astype(np.float64).mean(axis=1)
    squares = np.floor(middles[:, :2] / _TREE_M).astype(np.int64)
    return np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _houses(scene: Scene) -> Int64Array:
    """Return (F,) the number of the part that hangs together to which each face belongs."""
    count, faces = len(scene.vertices), scene.faces
    first, second = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    edges = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(count, count))
    part = connected_components(edges, directed=False)[1]
    return np.asarray(part[faces[:, 0]], np.int64)


def _without(scene: Scene, gone: BoolArray) -> Scene:
    return Scene(scene.vertices, scene.faces[~gone], scene.labels[~gone])
