"""Procedural towns to learn places from.

`make_town(seed, family)` gives a `Town`, a `World` of 600 x 600 m, in about a second. A seed makes the same town on
every machine; `epoch` makes the same town at another time: other cars and people, a building, hedge or tree more or
less, trees grown or bare.

    town = make_town(7, "old_town")
    survey = fly(town, SurveyConfig(), np.random.default_rng(1))        # simulation.survey
    T_world_base = town.sample_poses(100, np.random.default_rng(2))     # (100, 4, 4)
    scan = Vlp16().scan(town.scene, T_world_base[0] @ T_base_lidar, np.random.default_rng(3))   # simulation.vlp16
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.simulation import mesh
from crossloc3d_ros.simulation.families import FAMILIES, FAMILIES_BY_SEED, Family, draw_block, draw_street
from crossloc3d_ros.simulation.layout import BUSH, CONIFER, Layout, Plan, Rect, Warp, draw_belt, draw_streets, draw_warp
from crossloc3d_ros.simulation.scene import Label
from crossloc3d_ros.simulation.world import Bounds, World, free_space
from crossloc3d_ros.types import BoolArray, Float64Array

_MARGIN_M = 60.0
"""How far the town goes on beyond its bounds, so that a robot near the border sees something."""
_FREE_CELL_M = 1.0
_CHANGE = {"building": 0.012, "small": 0.03, "tree": 0.03}
"""Share of the things that are absent at any one epoch."""
_OPEN_BLOCKS = ("square", "car_park", "containers", "basin")


@dataclass(frozen=True, eq=False)
class Town(World):
    """A world made from a seed."""

    family: str
    seed: int
    epoch: int
    layout: Layout

    def digest(self) -> str:
        """Return a hash of all triangles, to the centimetre: it tells whether two towns are the same."""
        summary = hashlib.sha256()
        # Sine and cosine differ in the last bit between machines; a centimetre hardly ever does.
        summary.update(np.rint(self.scene.vertices.astype(np.float64) * 100).astype("<i4").tobytes())
        summary.update(self.scene.faces.astype("<i4").tobytes())
        summary.update(self.scene.labels.tobytes())
        return summary.hexdigest()


def make_town(seed: int, family: str | None = None, size_m: float = 600.0, epoch: int = 0) -> Town:
    """Return the town of a seed.

    `family` one of `families.FAMILIES`, or None: chosen by the seed from `FAMILIES_BY_SEED`. `size_m` side of the
    square that may be surveyed and driven, centred on the local zero. Raises ConfigError for an unknown family or an
    impossible size.
    """
    if family is None:
        family = FAMILIES_BY_SEED[int(_generator(seed, 0).integers(len(FAMILIES_BY_SEED)))]
    if family not in FAMILIES:
        raise ConfigError(f"unknown family '{family}'; known are: {', '.join(sorted(FAMILIES))}")
    if not 100.0 <= size_m <= 5000.0:
        raise ConfigError(f"'size_m' must lie between 100 and 5000, got {size_m}")
    if seed < 0 or epoch < 0:
        raise ConfigError(f"'seed' and 'epoch' must not be negative, got {seed} and {epoch}")
    half = size_m / 2
    bounds = Bounds(-half, -half, half, half)
    reach = half + _MARGIN_M
    rng = _generator(seed, 1)
    style = FAMILIES[family]
    layout: Layout = style.layouts[int(rng.integers(len(style.layouts)))]
    warp = draw_warp(layout, rng)
    plan, blocks, avenue = _draw_plan(style, warp, layout, reach, rng)
    relief = _Relief.draw(_generator(seed, 2), flat=style.flat)
    parts = _Parts.of(plan, warp, relief, reach, seed, epoch)

    cells = math.ceil(2 * reach / _FREE_CELL_M)
    obstacles = np.zeros((cells, cells), dtype=np.bool_)
    built = np.zeros_like(obstacles)
    _fill_quads(built, parts.quads[parts.solid & (parts.labels == Label.BUILDING)], -reach, reach, _FREE_CELL_M, 0.0)
    _fill_quads(obstacles, parts.quads[parts.solid], -reach, reach, _FREE_CELL_M, 0.3)
    _fill_quads(obstacles, parts.water, -reach, reach, _FREE_CELL_M, 0.3)
    _fill_quads(obstacles, mesh.oriented_boxes(parts.pole_xy, 0.3, 0.3, np.zeros(len(parts.pole_xy))),
                -reach, reach, _FREE_CELL_M, 0.3)  # fmt: skip

    wet = np.zeros_like(obstacles)
    _fill_quads(wet, parts.water, -reach, reach, _FREE_CELL_M, 0.0)
    parts = parts.without_trees_in(built | wet, reach)
    trunk_row, trunk_column = _cells(parts.trees[:, :2], reach, cells)
    obstacles[trunk_row, trunk_column] = True

    blocked = np.zeros_like(obstacles)
    _fill_quads(blocked, blocks, -reach, reach, _FREE_CELL_M, 0.0)
    cleared = np.zeros_like(obstacles)
    _fill_quads(cleared, avenue, -reach, reach, _FREE_CELL_M, 0.0)
    clearance, preference = free_space(obstacles, ~blocked | cleared, -reach, reach, _FREE_CELL_M)

    terrain = relief.raster(reach + 3.0)
    scene = mesh.scene_from(
        [_ground(relief, reach, parts.water, style.ground_cell_m), *parts.meshes(relief, seed, epoch)]
    )
    # Every town lies somewhere in UTM zone 31N, far enough from the others for maps not to overlap.
    origin = np.array([420_000.0 + 2_000.0 * (seed % 80), 5_400_000.0 + 2_000.0 * (seed // 80 % 100), 0.0])
    return Town(
        name=f"{family} {seed}", scene=scene, terrain=terrain, clearance=clearance, preference=preference,
        bounds=bounds, crs="EPSG:32631", origin_grid=origin,
        geoid_separation_m=0.0, family=family, seed=seed, epoch=epoch, layout=layout,
    )  # fmt: skip


def _generator(seed: int, *purpose: int) -> np.random.Generator:
    """Give every purpose its own stream, so that changing one part of the simulator leaves the others as they were."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *purpose])))


def _draw_plan(
    style: Family, warp: Warp, layout: Layout, reach: float, rng: np.random.Generator
) -> tuple[Plan, Float64Array, Float64Array]:
    """Return the plan, the local quads (K, 4, 2) of the blocks that are not open ground, and those of an avenue."""
    extent = 1.5 * reach
    jitter = style.jitter * (0.4 if layout == "grid" else 1.0)
    square = Rect(-extent, -extent, extent, extent)
    if style.belt is None:
        blocks, streets = draw_streets(square, style.block_m, style.street_m, jitter, rng)
    else:
        blocks, streets = draw_belt(square, style.belt, rng)
    plan = Plan()
    kinds, shares = list(style.blocks), np.array(list(style.blocks.values()))
    # Some towns lean towards one kind of block, as real quarters do.
    shares = shares * rng.gamma(2.0, 0.5, len(shares))
    shares[int(np.argmax(list(style.blocks.values())))] += 0.2
    shares /= shares.sum()
    closed: list[Float64Array] = []
    for block in blocks:
        block_rng = np.random.Generator(np.random.PCG64(rng.integers(2**63)))
        corners = warp(np.array([[block.u0, block.v0], [block.u1, block.v1]]))
        if np.abs(corners).min(axis=0).max() > reach + 20:
            continue
        kind = kinds[int(block_rng.choice(len(kinds), p=shares))]
        sidewalk = float(block_rng.uniform(0.3, 1.5))
        draw_block(kind, plan, block.inset(sidewalk), block_rng)
        if kind not in _OPEN_BLOCKS:
            closed.append(warp(_patches(block)))
    for street in streets:
        draw_street(plan, street, style, np.random.Generator(np.random.PCG64(rng.integers(2**63))))
    avenue = np.zeros((0, 4, 2))
    if style.avenues and rng.random() < (0.3 if layout == "grid" else 0.55):
        avenue = warp(_cut_avenue(plan, extent, rng))
    return plan, np.concatenate(closed) if closed else np.zeros((0, 4, 2)), avenue


def _patches(block: Rect, pieces: int = 4) -> Float64Array:
    """Return the block as (pieces^2, 4, 2) small quads, which a warp bends with it."""
    u, v = np.linspace(block.u0, block.u1, pieces + 1), np.linspace(block.v0, block.v1, pieces + 1)
    quads = [
        [(u[i], v[j]), (u[i + 1], v[j]), (u[i + 1], v[j + 1]), (u[i], v[j + 1])]
        for i in range(pieces)
        for j in range(pieces)
    ]
    return np.array(quads)


def _cut_avenue(plan: Plan, extent: float, rng: np.random.Generator) -> Float64Array:
    """Clear a strip across the plan, slantwise to its streets, line it with trees, and return it (K, 4, 2)."""
    angle = rng.choice([-1, 1]) * rng.uniform(0.35, 1.2)
    direction = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-direction[1], direction[0]])
    offset, width = rng.uniform(-0.35, 0.35) * extent, rng.uniform(12.0, 26.0)

    def away(uv: npt.NDArray[np.floating]) -> Float64Array:
        return np.asarray(np.abs(uv @ normal - offset), dtype=np.float64)

    if plan.wings:
        rows = np.array(plan.wings)
        hit = (away(rows[:, :8].reshape(-1, 4, 2)) < width / 2).any(axis=1)
        gone = np.zeros(len(plan.anchors), dtype=np.bool_)
        gone[rows[hit, 13].astype(np.int64)] = True
        plan.wings = [wing for wing in plan.wings if not gone[int(wing[13])]]
    plan.trees = [tree for tree in plan.trees if away(np.array(tree[:2])) > width / 2]
    plan.cars = [car for car in plan.cars if away(np.array(car[:2])) > width / 2]
    plan.poles = [pole for pole in plan.poles if away(np.array(pole[:2])) > width / 2 + pole[3]]
    tall, spacing = rng.uniform(8, 15), rng.uniform(8, 14)
    occupied = rng.uniform(0.1, 0.8)
    for along in np.arange(-1.4 * extent, 1.4 * extent, spacing):
        for side in (-1, 1):
            u, v = direction * along + normal * (offset + side * (width / 2 - 1.5))
            if rng.random() < 0.9:
                plan.tree(u, v, rng, height=(0.85 * tall, 1.1 * tall), kinds=(0.95, 0, 0.05, 0))
            u, v = direction * (along + spacing / 2) + normal * (offset + side * (width / 2 - 2.6))
            plan.cars.append((u, v, angle, occupied, rng.random()))
    steps = np.arange(-1.4 * extent, 1.4 * extent, 20.0)
    middles = steps[:, None] * direction + offset * normal
    return mesh.oriented_boxes(middles, 20.0, width, np.full(len(steps), angle))


@dataclass(frozen=True, eq=False)
class _Relief:
    """Terrain as a sum of long waves, exact everywhere."""

    waves: Float64Array
    """(W, 4) wave vector [rad/m], phase, amplitude [m]."""

    @staticmethod
    def draw(rng: np.random.Generator, *, flat: bool) -> _Relief:
        hilly = rng.random() > (0.75 if flat else 0.4)
        slope = rng.uniform(0.015, 0.06) if hilly else rng.uniform(0.0, 0.006)
        waves = []
        for wavelength in (rng.uniform(700, 1400), rng.uniform(300, 600), rng.uniform(120, 240), rng.uniform(60, 100)):
            number, direction = 2 * np.pi / wavelength, rng.uniform(0, 2 * np.pi)
            amplitude = slope / number * rng.uniform(0.3, 1.0) * min(1.0, wavelength / 400)
            waves.append([number * np.cos(direction), number * np.sin(direction), rng.uniform(0, 2 * np.pi), amplitude])
        return _Relief(np.array(waves))

    def __call__(self, xy: npt.NDArray[np.floating]) -> Float64Array:
        height: Float64Array = np.zeros(xy.shape[:-1])
        for kx, ky, phase, amplitude in self.waves:
            height += amplitude * np.sin(xy[..., 0] * kx + xy[..., 1] * ky + phase)
        return height

    def raster(self, reach: float, cell_m: float = 2.0) -> Raster:
        count = math.ceil(2 * reach / cell_m)
        x = -reach + (np.arange(count) + 0.5) * cell_m
        centres = np.stack(np.meshgrid(x, reach - (np.arange(count) + 0.5) * cell_m), -1)
        return Raster(self(centres).astype(np.float32), -reach, reach, cell_m)


@dataclass(frozen=True, eq=False)
class _Parts:
    """The plan's parts in local metres, as they stand at one epoch."""

    quads: Float64Array
    """(K, 4, 2) footprints."""
    bottom: Float64Array
    eave: Float64Array
    ridge: Float64Array
    hip: Float64Array
    labels: npt.NDArray[np.uint8]
    solid: BoolArray
    """(K,) whether a robot runs into it: the bottom lies lower than the robot is high."""
    trees: Float64Array
    """(T, 6) x, y, kind, height, crown radius, crown base share."""
    pole_xy: Float64Array
    poles: Float64Array
    """(P, 4) height, radii at foot and top, label."""
    water: Float64Array
    """(Q, 4, 2)"""

    @staticmethod
    def of(plan: Plan, warp: Warp, relief: _Relief, reach: float, seed: int, epoch: int) -> _Parts:
        rng = _generator(seed, 3, epoch)
        wings = np.array(plan.wings).reshape(-1, 14)
        owner = wings[:, 13].astype(np.int64)
        anchors = warp(np.array(plan.anchors).reshape(-1, 2))
        small = np.zeros(len(anchors), dtype=np.bool_)
        small[owner[wings[:, 12] != Label.BUILDING]] = True
        here = rng.random(len(anchors)) >= np.where(small, _CHANGE["small"], _CHANGE["building"])
        here &= np.abs(anchors).max(axis=1) < reach - 5
        wings, owner = wings[here[owner]], owner[here[owner]]
        quads = warp(wings[:, :8].reshape(-1, 4, 2))
        ground = relief(anchors)[owner]
        foot = relief(quads).min(axis=1) - 1.0
        hung = wings[:, 8]
        floating = np.isfinite(hung)
        bottom = np.where(floating, ground + np.where(floating, hung, 0.0), foot)
        cars = _cars(plan, warp, relief, reach, _generator(seed, 4, epoch))
        people = _people(plan, warp, relief, reach, _generator(seed, 5, epoch))
        extra = [cars, people]

        trees = np.array(plan.trees).reshape(-1, 6)
        trees[:, :2] = warp(trees[:, :2])
        trees = trees[np.abs(trees[:, :2]).max(axis=1) < reach - 2] if len(trees) else trees
        tree_rng = _generator(seed, 6, epoch)
        trees = trees[tree_rng.random(len(trees)) >= _CHANGE["tree"]]
        if epoch > 0:
            growth = 1.0 + tree_rng.uniform(0.0, 0.12) * tree_rng.random(len(trees))
            trees[:, 3] *= growth
            trees[:, 4] *= growth
        poles = np.array(plan.poles).reshape(-1, 6)
        pole_xy = warp(poles[:, :2])
        near = np.abs(pole_xy).max(axis=1) < reach - 5 if len(poles) else np.zeros(0, np.bool_)
        water = [warp(_patches(rect)) for rect in plan.water]
        return _Parts(
            quads=np.concatenate([quads, *[e[0] for e in extra]]),
            bottom=np.concatenate([bottom, *[e[1] for e in extra]]),
            eave=np.concatenate([ground + wings[:, 9], *[e[2] for e in extra]]),
            ridge=np.concatenate([ground + wings[:, 10], *[e[3] for e in extra]]),
            hip=np.concatenate([wings[:, 11], *[np.full(len(e[0]), 0.15) for e in extra]]),
            labels=np.concatenate(
                [wings[:, 12].astype(np.uint8), *[np.full(len(e[0]), Label.STRUCTURE, np.uint8) for e in extra]]
            ),
            solid=np.concatenate([~(floating & (hung > 2.3)), *[np.ones(len(e[0]), np.bool_) for e in extra]]),
            trees=trees, pole_xy=pole_xy[near], poles=poles[near, 2:],
            water=np.concatenate(water) if water else np.zeros((0, 4, 2)),
        )  # fmt: skip

    def without_trees_in(self, mask: BoolArray, reach: float) -> _Parts:
        """Drop the trees that would grow inside a house or in the water."""
        row, column = _cells(self.trees[:, :2], reach, len(mask))
        return _replace_trees(self, self.trees[~mask[row, column]])

    def meshes(self, relief: _Relief, seed: int, epoch: int) -> list[mesh.Mesh]:
        """Return everything but the ground as triangles."""
        rng = _generator(seed, 7, epoch)
        foot = relief(self.pole_xy)
        poles = self.poles
        meshes = [
            mesh.prisms(self.quads, self.bottom, self.eave, self.ridge, self.hip, self.labels),
            mesh.cylinders(self.pole_xy, foot - 0.5, foot + poles[:, 0], poles[:, 1], poles[:, 2],
                           poles[:, 3].astype(np.uint8), sides=8),
        ]  # fmt: skip
        if len(self.trees):
            leaf_share = 1.0 if epoch == 0 else float(rng.choice([1.0, 0.8, 0.35]))
            meshes += grow_trees(self.trees, relief(self.trees[:, :2]), leaf_share, rng)
        return meshes


def _replace_trees(parts: _Parts, trees: Float64Array) -> _Parts:
    values = {name: getattr(parts, name) for name in parts.__dataclass_fields__}
    return _Parts(**(values | {"trees": trees}))


_Boxes = tuple[Float64Array, Float64Array, Float64Array, Float64Array]
"""Footprints, bottoms, eaves, ridges."""


def _cars(plan: Plan, warp: Warp, relief: _Relief, reach: float, rng: np.random.Generator) -> _Boxes:
    """Return hull and cabin of every car that stands there at this epoch."""
    rows = np.array(plan.cars).reshape(-1, 5)
    rows = rows[rng.random(len(rows)) < rows[:, 3]]
    uv = rows[:, :2] + 0.35 * rng.standard_normal((len(rows), 2))
    xy, yaw = warp(uv), warp.yaw(uv, rows[:, 2] + 0.04 * rng.standard_normal(len(rows)))
    near = np.abs(xy).max(axis=1) < reach - 5
    xy, yaw, size = xy[near], yaw[near], (0.6 * rows[near, 4] + 0.4 * rng.random(int(near.sum())))
    van = size > 0.86
    length = np.where(van, 5.2 + 8.0 * (size - 0.86), 3.7 + 1.1 * size)
    width = np.where(van, 2.05, 1.7 + 0.15 * size)
    ground = relief(xy)
    shoulder = np.where(van, 2.1 + 2.0 * (size - 0.86), 0.85 + 0.2 * size)
    roof = np.where(van, shoulder + 0.1, 1.42 + 0.3 * size)
    hull = mesh.oriented_boxes(xy, length, width, yaw)
    back = xy - 0.1 * length[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], -1)
    cabin = mesh.oriented_boxes(back, 0.52 * length, 0.86 * width, yaw)
    return (
        np.concatenate([hull, cabin]),
        np.concatenate([ground + 0.2, ground + shoulder - 0.05]),
        np.concatenate([ground + shoulder, ground + roof]),
        np.concatenate([ground + shoulder + 0.02, ground + roof + 0.02]),
    )


def _people(plan: Plan, warp: Warp, relief: _Relief, reach: float, rng: np.random.Generator) -> _Boxes:
    """Return people who happen to stand where people walk."""
    spots: list[Float64Array] = []
    for rect in plan.pedestrians:
        count = int(rng.poisson(0.00035 * max(rect.width, 0) * max(rect.height, 0) + 0.1))
        spots.append(np.array([rect.u0, rect.v0]) + rng.random((count, 2)) * [max(rect.width, 0), max(rect.height, 0)])
    uv = np.concatenate(spots) if spots else np.zeros((0, 2))
    xy = warp(uv)
    xy = xy[np.abs(xy).max(axis=1) < reach - 5] if len(xy) else xy
    ground = relief(xy)
    tall = 1.55 + 0.35 * rng.random(len(xy))
    return (mesh.oriented_boxes(xy, 0.5, 0.3, rng.random(len(xy)) * np.pi), ground, ground + tall - 0.2, ground + tall)


def grow_trees(
    trees: Float64Array, ground: Float64Array, leaf_share: float, rng: np.random.Generator
) -> list[mesh.Mesh]:
    """Return trunks and porous crowns of trees (T, 6) x, y, kind, height, crown radius, crown base share.

    A crown is some lobes whose shells are covered with loose leaf triangles, about one optical depth and a half
    through its middle: what the airborne scanner sees from above and the robot from below is the same tree.
    """
    kind, height, radius = trees[:, 2].astype(np.int64), trees[:, 3], trees[:, 4]
    base = trees[:, 5] * height
    with_trunk = kind != BUSH
    girth = 0.06 + 0.022 * height[with_trunk]
    trunk_top = (0.65 * height)[with_trunk] + ground[with_trunk]
    trunks = mesh.cylinders(trees[with_trunk, :2], ground[with_trunk] - 0.5, trunk_top, girth, 0.4 * girth,
                            np.full(int(with_trunk.sum()), Label.VEGETATION, np.uint8), sides=5)  # fmt: skip
    tall = height - base
    leaf = np.clip(0.30 * radius, 0.4, 1.25)
    counts = np.rint(leaf_share * 1.5 * np.pi * radius * np.sqrt(radius * tall / 2) / (0.2165 * leaf**2)).astype(int)
    counts = np.clip(counts, 12, 420)
    lobes = 7
    direction = rng.standard_normal((len(trees), lobes, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    lobe_radius = rng.uniform(0.35, 0.7, (len(trees), lobes))
    middle = direction * (1.0 - lobe_radius)[..., None]
    tree = np.repeat(np.arange(len(trees)), counts)
    lobe = rng.integers(lobes, size=len(tree))
    shell = rng.standard_normal((len(tree), 3))
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    depth = rng.random((len(tree), 1)) ** 0.3
    unit = middle[tree, lobe] + shell * depth * lobe_radius[tree, lobe][:, None]
    up = 0.5 * (unit[:, 2] + 1.0)
    cone = kind[tree] == CONIFER
    # A conifer is a cone: the higher, the narrower, and most of its needles are low.
    up = np.where(cone, 1.0 - np.sqrt(np.clip(1.0 - up, 0.0, 1.0)), up)
    spread = np.where(cone, 1.3 * (1.0 - up), 1.0) * radius[tree]
    points = np.empty((len(tree), 3))
    points[:, 0] = trees[tree, 0] + unit[:, 0] * spread
    points[:, 1] = trees[tree, 1] + unit[:, 1] * spread
    points[:, 2] = (ground + base)[tree] + up * tall[tree]
    return [trunks, mesh.leaves(points, leaf[tree], Label.VEGETATION, rng)]


def _ground(relief: _Relief, reach: float, water: Float64Array, cell_m: float) -> mesh.Mesh:
    """Return the terrain, with canals and ponds sunk into it."""
    far = reach + 60.0
    count = math.ceil(2 * far / cell_m) + 1
    line = -far + np.arange(count) * cell_m
    heights = relief(np.stack(np.meshgrid(line, line), -1))
    ground = mesh.height_grid(heights, -far, -far, cell_m, Label.GROUND)
    if len(water) == 0:
        return ground
    wet = np.zeros((count, count), dtype=np.bool_)
    edge = far + cell_m / 2
    # Cells centred on the posts; flipped, because the filler's row 0 lies in the north.
    _fill_quads(wet, water, -edge, -edge + count * cell_m, cell_m, 0.0)
    sunk = np.flipud(wet).ravel()
    vertices = ground.vertices.copy()
    vertices[sunk, 2] -= 1.6
    labels = ground.labels.copy()
    labels[sunk[ground.faces].all(axis=1)] = Label.WATER
    return mesh.Mesh(vertices, ground.faces, labels)


def _cells(xy: Float64Array, reach: float, count: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    column = np.clip(np.floor((xy[:, 0] + reach) / _FREE_CELL_M), 0, count - 1).astype(np.int64)
    row = np.clip(np.floor((reach - xy[:, 1]) / _FREE_CELL_M), 0, count - 1).astype(np.int64)
    return row, column


@njit(cache=True, nogil=True)
def _fill_quads(mask: BoolArray, quads: Float64Array, west: float, north: float, cell: float, grow: float) -> None:
    """Set the cells whose centres lie in a convex quad or within `grow` of its edges' lines."""
    rows, columns = mask.shape
    for k in range(quads.shape[0]):
        low_x = high_x = quads[k, 0, 0]
        low_y = high_y = quads[k, 0, 1]
        area = 0.0
        for i in range(4):
            x, y = quads[k, i, 0], quads[k, i, 1]
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
            j = (i + 1) % 4
            area += x * quads[k, j, 1] - quads[k, j, 0] * y
        sign = 1.0 if area > 0 else -1.0
        first_column = max(int(np.floor((low_x - grow - west) / cell)), 0)
        last_column = min(int(np.floor((high_x + grow - west) / cell)), columns - 1)
        first_row = max(int(np.floor((north - high_y - grow) / cell)), 0)
        last_row = min(int(np.floor((north - low_y + grow) / cell)), rows - 1)
        for row in range(first_row, last_row + 1):
            y = north - (row + 0.5) * cell
            for column in range(first_column, last_column + 1):
                x = west + (column + 0.5) * cell
                inside = True
                for i in range(4):
                    j = (i + 1) % 4
                    ex, ey = quads[k, j, 0] - quads[k, i, 0], quads[k, j, 1] - quads[k, i, 1]
                    length = np.sqrt(ex * ex + ey * ey)
                    if length < 1e-9:
                        continue
                    side = sign * (ex * (y - quads[k, i, 1]) - ey * (x - quads[k, i, 0])) / length
                    if side < -grow:
                        inside = False
                        break
                if inside:
                    mask[row, column] = True
