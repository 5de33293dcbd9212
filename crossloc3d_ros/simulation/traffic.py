"""Cars and people under way while a robot drives: what moves between one scan and the next, and within a scan.

`Traffic.draw(world, route, rng)` puts them where there is room, near wherever the robot is at the time; `at(time)`
gives them as upright boxes with a velocity, which rays are tested against without building a scene anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.config import option
from crossloc3d_ros.simulation.route import Route
from crossloc3d_ros.simulation.scene import Hits, Label
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int64Array

_STEP_S = 0.2
_TURNS_RAD = np.radians([0.0, 12.0, -12.0, 25.0, -25.0, 50.0, -50.0, 80.0, -80.0, 120.0, -120.0, 180.0])
_REACH_M = 105.0


@dataclass(frozen=True)
class TrafficConfig:
    """How much is under way around the robot."""

    people: float = option(5.0, "people walking within 40 m of the robot, on average", low=0.0, high=1000.0)
    cars: float = option(2.0, "cars driving within 80 m of the robot, on average", low=0.0, high=1000.0)


@dataclass(frozen=True, eq=False)
class Movers:
    """Upright boxes at one moment."""

    centre_m: Float64Array
    """(B, 3) local metres."""
    size_m: Float64Array
    """(B, 3) length, width, height."""
    yaw_rad: Float64Array
    """(B,) of the length."""
    velocity_m_s: Float64Array
    """(B, 2) east, north."""

    def before(self, hits: Hits, origins: Float32Array, directions: Float32Array, time_s: Float64Array) -> Hits:
        """Return the hits with the boxes in front of them.

        `origins`, `directions` (N, 3) of the rays; `time_s` (N,) of each from the moment for which the boxes are given.
        """
        distance, cosine, box = hits.distance_m.copy(), hits.incidence_cos.copy(), np.full(len(origins), -1)
        _cast(self.centre_m, self.size_m / 2, self.yaw_rad, self.velocity_m_s, origins, directions, time_s,
              distance, cosine, box)  # fmt: skip
        met = box >= 0
        # Numbers that no scene's faces have, far enough apart to give each box a reflectivity of its own.
        face = np.where(met, 2**31 - 16 * (box + 1), hits.face).astype(np.int32)
        return Hits(distance, np.where(met, np.uint8(Label.STRUCTURE), hits.label), cosine, face)


@dataclass(frozen=True, eq=False)
class _Kind:
    """What people and cars differ in."""

    near_m: float
    life_s: float
    speed_m_s: tuple[float, float]
    clearance_m: float
    ahead_m: float
    """How far ahead it looks for room."""
    apart_m: float
    """What comes nearer to the robot than this goes out of its way: it is not there."""
    on_streets: bool


_PERSON = _Kind(40.0, 30.0, (0.7, 1.6), 0.5, 1.5, 1.4, False)
_CAR = _Kind(80.0, 16.0, (3.0, 9.0), 1.3, 5.0, 5.0, True)


@dataclass(frozen=True, eq=False)
class Traffic:
    """All movers of a drive."""

    start_s: Float64Array
    """(M,) when each appears."""
    track_m: Float64Array
    """(M, S, 3) where it is at each step, on the ground; NaN after it has gone."""
    yaw_rad: Float64Array
    """(M, S)"""
    apart_m: Float64Array
    """(M,) distance that it keeps from the robot."""
    size_m: Float64Array
    """(M, 3) length, width, height; a car's height is its roof's."""
    is_car: BoolArray

    def __len__(self) -> int:
        return len(self.start_s)

    @staticmethod
    def draw(world: World, route: Route, rng: np.random.Generator, config: TrafficConfig | None = None) -> Traffic:
        """Return movers for the whole of a route."""
        config = config or TrafficConfig()
        groups = [
            _draw_kind(world, route, rng, kind, around)
            for kind, around in ((_PERSON, config.people), (_CAR, config.cars))
        ]
        steps = max(group.track_m.shape[1] for group in groups)

        def padded(values: Float64Array) -> Float64Array:
            width = [(0, 0), (0, steps - values.shape[1])] + [(0, 0)] * (values.ndim - 2)
            return np.pad(values, width, constant_values=np.nan)

        return Traffic(
            np.concatenate([g.start_s for g in groups]), np.concatenate([padded(g.track_m) for g in groups]),
            np.concatenate([padded(g.yaw_rad) for g in groups]), np.concatenate([g.apart_m for g in groups]),
            np.concatenate([g.size_m for g in groups]), np.concatenate([g.is_car for g in groups]),
        )  # fmt: skip

    def at(self, time_s: float, robot_xy: npt.ArrayLike) -> Movers:
        """Return the boxes of what is under way at a time and within the sensor's reach of the robot."""
        step = (time_s - self.start_s) / _STEP_S
        low = np.floor(step).astype(np.int64)
        there = np.flatnonzero((low >= 0) & (low + 1 < self.track_m.shape[1]))
        low, share = low[there], (step[there] - low[there])[:, None]
        before, after = self.track_m[there, low], self.track_m[there, low + 1]
        place = (1 - share) * before + share * after
        away = np.hypot(*(place[:, :2] - np.asarray(robot_xy, dtype=np.float64)).T)
        seen = (away > self.apart_m[there]) & (away < _REACH_M)  # false where the track has ended
        there, place = there[seen], place[seen]
        velocity = (after - before)[seen, :2] / _STEP_S
        yaw = self.yaw_rad[there, low[seen]]
        return _boxes(place, self.size_m[there], yaw, velocity, self.is_car[there])


def _boxes(
    foot: Float64Array, size: Float64Array, yaw: Float64Array, velocity: Float64Array, is_car: BoolArray
) -> Movers:
    """Return one box a person; hull and cabin of a car."""
    cars = np.flatnonzero(is_car)
    low = np.where(is_car, 0.2, 0.0)
    top = np.where(is_car, 0.62 * size[:, 2], size[:, 2])
    body = foot + np.stack([np.zeros(len(foot)), np.zeros(len(foot)), (low + top) / 2], -1)
    body_size = np.stack([size[:, 0], size[:, 1], top - low], -1)
    back = -0.1 * size[cars, 0]
    cabin = foot[cars] + np.stack([back * np.cos(yaw[cars]), back * np.sin(yaw[cars]), 0.8 * size[cars, 2]], -1)
    cabin_size = size[cars] * [0.52, 0.86, 0.4]
    return Movers(
        np.concatenate([body, cabin]), np.concatenate([body_size, cabin_size]),
        np.concatenate([yaw, yaw[cars]]), np.concatenate([velocity, velocity[cars]]),
    )  # fmt: skip


def _draw_kind(world: World, route: Route, rng: np.random.Generator, kind: _Kind, around: float) -> Traffic:
    steps = round(kind.life_s / _STEP_S) + 1
    count = int(rng.poisson(around * (route.duration_s + kind.life_s) / kind.life_s)) if around > 0 else 0
    middle = rng.uniform(-kind.life_s / 2, route.duration_s + kind.life_s / 2, count)
    robot = route.at(np.clip(middle, 0.0, route.duration_s))[:, :2, 3]
    xy, yaw, found = _starts(world, robot, rng, kind)
    start_s, count = middle[found] - kind.life_s / 2, int(found.sum())
    track, headings = _walk(world, xy, yaw, rng, kind, steps)
    if kind.on_streets:
        length = rng.uniform(3.8, 4.8, count)
        size = np.stack([length, rng.uniform(1.7, 1.9, count), rng.uniform(1.4, 1.75, count)], -1)
    else:
        size = np.stack([np.full(count, 0.3), np.full(count, 0.5), rng.uniform(1.5, 1.95, count)], -1)
    return Traffic(start_s, track, headings, np.full(count, kind.apart_m), size, np.full(count, kind.on_streets))


def _starts(
    world: World, robot: Float64Array, rng: np.random.Generator, kind: _Kind
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return places and headings with room near the robot's places (C, 2), and for which of those there was one."""
    found = np.zeros(len(robot), dtype=np.bool_)
    xy = np.zeros((len(robot), 2))
    for _ in range(40):
        missing = np.flatnonzero(~found)
        radius, bearing = kind.near_m * np.sqrt(rng.random(len(missing))), rng.uniform(0, 2 * np.pi, len(missing))
        xy[missing] = robot[missing] + radius[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
        found[missing] = _room(world, xy[missing], kind) & (rng.random(len(missing)) < _gladness(world, xy[missing]))
    return xy[found], rng.uniform(0, 2 * np.pi, int(found.sum())), found


def _cells(world: World, xy: Float64Array) -> tuple[Int64Array, Int64Array, BoolArray]:
    raster = world.preference
    row = np.floor((raster.north_m - xy[..., 1]) / raster.cell_m).astype(np.int64)
    column = np.floor((xy[..., 0] - raster.west_m) / raster.cell_m).astype(np.int64)
    inside = (row >= 0) & (row < raster.values.shape[0]) & (column >= 0) & (column < raster.values.shape[1])
    return np.where(inside, row, 0), np.where(inside, column, 0), inside


def _gladness(world: World, xy: Float64Array) -> Float64Array:
    row, column, inside = _cells(world, xy)
    return np.asarray(np.where(inside, world.preference.values[row, column], 0.0), dtype=np.float64)


def _room(world: World, xy: Float64Array, kind: _Kind) -> BoolArray:
    """Return whether there is room for a mover at places (..., 2), for cars on streets alone."""
    row, column, inside = _cells(world, xy)
    free = inside & (world.clearance.values[row, column] >= kind.clearance_m)
    least = 0.9 if kind.on_streets else 0.1
    return np.asarray(free & (world.preference.values[row, column] >= least), dtype=np.bool_)


def _walk(
    world: World, xy: Float64Array, yaw: Float64Array, rng: np.random.Generator, kind: _Kind, steps: int
) -> tuple[Float64Array, Float64Array]:
    """Return tracks (M, S, 3) and headings (M, S): straight on where there is room, else the least turn that has."""
    count = len(xy)
    track, headings = np.empty((count, steps, 3)), np.empty((count, steps))
    speed = rng.uniform(*kind.speed_m_s, count)
    track[:, 0, :2], headings[:, 0] = xy, yaw
    for step in range(1, steps):
        wanted = headings[:, step - 1] + 0.04 * rng.standard_normal(count)
        turned = wanted[:, None] + _TURNS_RAD
        forward = np.stack([np.cos(turned), np.sin(turned)], -1)
        here = track[:, step - 1, None, :2]
        moved = here + (speed * _STEP_S)[:, None, None] * forward
        free = _room(world, moved, kind)
        clear = free & _room(world, here + 0.5 * kind.ahead_m * forward, kind)
        clear &= _room(world, here + kind.ahead_m * forward, kind)
        # Room a step ahead is enough where there is none farther on; where there is none at all it waits and turns.
        cost = np.abs(_TURNS_RAD) + np.where(clear, 0.0, np.where(free, 10.0, 100.0))
        best = np.argmin(cost, axis=1)
        rows = np.arange(count)
        goes = free[rows, best]
        track[:, step, :2] = np.where(goes[:, None], moved[rows, best], track[:, step - 1, :2])
        headings[:, step] = np.where(goes, turned[rows, best], wanted + 0.5)
    track[..., 2] = world.terrain_height(track[..., :2].reshape(-1, 2)).reshape(count, steps)
    return track, headings


@njit(cache=True, nogil=True)
def _cast(
    centre: Float64Array, half: Float64Array, yaw: Float64Array, velocity: Float64Array, origins: Float32Array,
    directions: Float32Array, time: Float64Array, distance: Float32Array, cosine: Float32Array, box: Int64Array,
) -> None:  # fmt: skip
    """Shorten the rays that meet a box; slabs in the box's own frame."""
    low, high, step, start = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for b in range(centre.shape[0]):
        c, s = np.cos(yaw[b]), np.sin(yaw[b])
        radius = half[b, 0] ** 2 + half[b, 1] ** 2 + half[b, 2] ** 2
        for i in range(origins.shape[0]):
            x = origins[i, 0] - centre[b, 0] - velocity[b, 0] * time[i]
            y = origins[i, 1] - centre[b, 1] - velocity[b, 1] * time[i]
            z = origins[i, 2] - centre[b, 2]
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            along = -(x * dx + y * dy + z * dz)
            away = x * x + y * y + z * z
            if away - along * along > radius or (along < 0.0 and away > radius):
                continue
            start[0], start[1], start[2] = c * x + s * y, c * y - s * x, z
            step[0], step[1], step[2] = c * dx + s * dy, c * dy - s * dx, dz
            near, far, face = 0.0, np.inf, -1
            for axis in range(3):
                if abs(step[axis]) < 1e-12:
                    if abs(start[axis]) > half[b, axis]:
                        far = -1.0
                    continue
                low[axis] = (-half[b, axis] - start[axis]) / step[axis]
                high[axis] = (half[b, axis] - start[axis]) / step[axis]
                if low[axis] > high[axis]:
                    low[axis], high[axis] = high[axis], low[axis]
                if low[axis] > near:
                    near, face = low[axis], axis
                far = min(far, high[axis])
            if face >= 0 and near <= far and near < distance[i]:
                distance[i] = near
                cosine[i] = abs(step[face])
                box[i] = b
