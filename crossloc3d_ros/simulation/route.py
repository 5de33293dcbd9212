"""A drive through the free space of a world: streets, smooth turns, honest speeds.

`plan_route(world, 800.0, rng)` strings shortest ways between far corners of the free space together, gladly along the
middle of streets and gladly where it has not been, and drives them with a robot that turns no faster than it can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial.transform import Rotation, Slerp

from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.simulation.world import World
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array


class RouteError(CrossLocError):
    """A world has no room for the route that was asked for."""


@dataclass(frozen=True, eq=False)
class Route:
    """Where the robot is at each moment of a drive."""

    time_s: Float64Array
    """(N,) from 0, at a constant rate."""
    poses: Float64Array
    """(N, 4, 4) `T_world_base`, the base on the ground."""

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1])

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.poses[:, :2, 3], axis=0), axis=1).sum())

    def at(self, time_s: npt.ArrayLike) -> Float64Array:
        """Return the poses (M, 4, 4) at times (M,) between 0 and the duration."""
        times = np.clip(np.atleast_1d(np.asarray(time_s, dtype=np.float64)), 0.0, self.duration_s)
        poses = np.zeros((len(times), 4, 4))
        poses[:, :3, :3] = Slerp(self.time_s, Rotation.from_matrix(self.poses[:, :3, :3]))(times).as_matrix()
        for axis in range(3):
            poses[:, axis, 3] = np.interp(times, self.time_s, self.poses[:, axis, 3])
        poses[:, 3, 3] = 1.0
        return poses

    def twist(self, time_s: npt.ArrayLike, step_s: float = 0.04) -> Float64Array:
        """Return velocity [m/s] and turn rate [rad/s] in the base frame, (M, 6), at times (M,)."""
        times = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        before = np.clip(times - step_s / 2, 0.0, self.duration_s - step_s)
        first, second = self.at(before), self.at(before + step_s)
        turn = np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3]
        here = self.at(times)
        moved = (second[:, :3, 3] - first[:, :3, 3]) / step_s
        linear = np.einsum("nji,nj->ni", here[:, :3, :3], moved)
        return np.concatenate([linear, Rotation.from_matrix(turn).as_rotvec() / step_s], axis=1)


def plan_route(
    world: World,
    length_m: float,
    rng: np.random.Generator,
    *,
    clearance_m: float = 1.5,
    border_m: float = 25.0,
    speed_m_s: float = 2.0,
    rate_hz: float = 50.0,
    tilt_deg: float = 0.6,
) -> Route:
    """Return a drive of about `length_m` metres that keeps `clearance_m` from obstacles.

    `border_m` from the bounds, cruising at `speed_m_s` and slower in bends; `tilt_deg` one sigma of the swaying on top
    of the slope. Streets are driven again where the world is too small for the length. Raises RouteError where no
    connected free ground of at least 60 m extent is left.
    """
    # A little more than asked for, because the robot cuts its corners a little.
    room = clearance_m + 0.2
    path = _smooth(_plan_path(world, length_m, rng, room, border_m), world, room)
    xy, yaw = _follow(path, length_m, speed_m_s, rate_hz)
    sway = math.radians(tilt_deg)
    noise = rng.standard_normal((2, len(xy)))
    smooth = ndimage.gaussian_filter1d(noise, 0.15 * rate_hz, axis=1, mode="wrap")
    smooth *= sway / max(float(smooth.std()), 1e-9)
    poses = world.poses_on_ground(xy, yaw, roll_rad=smooth[0], pitch_rad=smooth[1])
    return Route(np.arange(len(xy)) / rate_hz, poses)


def _plan_path(
    world: World, length_m: float, rng: np.random.Generator, clearance_m: float, border_m: float
) -> Float64Array:
    """Return a polyline (P, 2) over cell centres."""
    cell = world.clearance.cell_m
    rows, columns = world.clearance.values.shape
    x = world.clearance.west_m + (np.arange(columns) + 0.5) * cell
    y = world.clearance.north_m - (np.arange(rows) + 0.5) * cell
    free = (world.clearance.values >= clearance_m) & (world.preference.values > 0)
    free &= ((x > world.bounds.min_x + border_m) & (x < world.bounds.max_x - border_m))[None, :]
    free &= ((y > world.bounds.min_y + border_m) & (y < world.bounds.max_y - border_m))[:, None]
    regions, count = ndimage.label(free)
    sizes = np.bincount(regions.ravel(), weights=(world.preference.values + 0.01).ravel(), minlength=count + 1)
    sizes[0] = 0.0
    if count == 0:
        raise RouteError(f"'{world.name}' has no free ground {clearance_m} m wide and {border_m} m inside its bounds")
    nodes = np.flatnonzero(regions.ravel() == int(np.argmax(sizes)))
    number = np.full(rows * columns, -1, dtype=np.int64)
    number[nodes] = np.arange(len(nodes))
    row, column = np.divmod(nodes, columns)
    places = np.stack([x[column], y[row]], -1)
    if float(np.ptp(places, axis=0).max()) < 60.0:
        raise RouteError(
            f"'{world.name}' has no connected free ground for a drive with {clearance_m} m of clearance; take a "
            "smaller clearance or another survey"
        )
    clearance = world.clearance.values.ravel()[nodes]
    # Dear beside obstacles and off the streets.
    price = 1.0 + 3.0 * np.exp(-(clearance - clearance_m) / 1.5)
    price = price * np.where(world.preference.values.ravel()[nodes] < 0.9, 2.5, 1.0)
    edges = _edges(number.reshape(rows, columns), cell)

    visited = np.zeros(len(nodes), dtype=np.float32)
    here = int(rng.integers(len(nodes)))
    here = int(np.argmax(_walk(edges, price, here)[0] * (rng.random(len(nodes)) > 0.9)))  # begin at an end
    legs: list[Float64Array] = []
    total = 0.0
    while total < length_m + 20.0:
        costs, came_from = _walk(edges, price * (1.0 + 2.0 * visited), here)
        away = np.linalg.norm(places - places[here], axis=1)
        wanted = np.where((away > 60.0) & np.isfinite(costs), away * (1.0 - 0.8 * visited), 0.0)
        wanted *= rng.uniform(0.5, 1.0, len(nodes)) ** 2
        goal = int(np.argmax(wanted))
        way = [goal]
        while way[-1] != here:
            way.append(int(came_from[way[-1]]))
        leg = places[way[::-1]]
        legs.append(leg if not legs else leg[1:])
        total += float(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum())
        mark = np.zeros(rows * columns, dtype=np.bool_)
        mark[nodes[way]] = True
        near = ndimage.binary_dilation(mark.reshape(rows, columns), iterations=max(1, round(6.0 / cell)))
        visited = np.maximum(visited, near.ravel()[nodes].astype(np.float32))
        if visited.mean() > 0.85:
            visited[:] = 0.0
        here = goal
    return np.concatenate(legs)


_Edges = tuple[Int64Array, Int64Array, Float64Array]
"""From, to, length."""


def _edges(number: Int64Array, cell_m: float) -> _Edges:
    """Return the steps between neighbouring cells (eight directions) of a grid of node numbers, -1 for none."""
    rows, columns = number.shape
    starts, ends, lengths = [], [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = number[: rows - down, max(0, -right) : columns - max(0, right)]
        b = number[down:, max(0, right) : columns - max(0, -right)]
        both = (a >= 0) & (b >= 0)
        starts.append(a[both])
        ends.append(b[both])
        lengths.append(np.full(int(both.sum()), cell_m * math.hypot(down, right)))
    return np.concatenate(starts), np.concatenate(ends), np.concatenate(lengths)


def _walk(edges: _Edges, price: npt.NDArray[np.floating], start: int) -> tuple[Float64Array, npt.NDArray[np.int32]]:
    """Return the cheapest cost to every node and the node before it."""
    a, b, length = edges
    cost = length * 0.5 * (price[a] + price[b])
    graph = sparse.csr_matrix((cost, (a, b)), shape=(len(price), len(price)))
    costs, came_from = csgraph.dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    return np.where(np.isfinite(costs), costs, 0.0), came_from


def _smooth(path: Float64Array, world: World, clearance_m: float) -> Float64Array:
    """Return the polyline every half metre, its corners rounded as far as the clearance allows."""
    steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    along = np.arange(0.0, steps[-1], 0.5)
    points = np.stack([np.interp(along, steps, path[:, axis]) for axis in range(2)], -1)
    for _ in range(60):
        moved = points.copy()
        moved[1:-1] = 0.5 * points[1:-1] + 0.25 * (points[:-2] + points[2:])
        room = np.asarray(world.clearance.sample(moved[:, 0], moved[:, 1]))
        before = np.asarray(world.clearance.sample(points[:, 0], points[:, 1]))
        allowed = (room >= clearance_m) | (room >= before)
        points = np.where(allowed[:, None], moved, points)
    return points


def _follow(path: Float64Array, length_m: float, speed_m_s: float, rate_hz: float) -> tuple[Float64Array, Float64Array]:
    """Return positions (N, 2) and headings (N,) of a robot that follows the polyline for `length_m` metres.

    It looks a metre ahead, turns at most at 0.9 rad/s and slows down for that, on the spot where need be.
    """
    most_turn, ahead, step = 0.9, 1.0, 1.0 / rate_hz
    index, travelled = 0, 0.0
    x, y = path[0]
    first = path[min(4, len(path) - 1)] - path[0]
    yaw = math.atan2(first[1], first[0])
    speed, turn = 0.0, 0.0
    xy: list[tuple[float, float]] = [(x, y)]
    headings = [yaw]
    while travelled < length_m and index < len(path) - 1:
        while index < len(path) - 1 and math.hypot(path[index][0] - x, path[index][1] - y) < ahead:
            index += 1
        error = math.atan2(path[index][1] - y, path[index][0] - x) - yaw
        error = math.atan2(math.sin(error), math.cos(error))
        wanted_turn = min(max(2.0 * error, -most_turn), most_turn)
        turn += min(max(wanted_turn - turn, -3.0 * step), 3.0 * step)
        # At large heading errors it turns on the spot, so that it stays on the line that has room.
        wanted = speed_m_s * max(0.0, 1.0 - abs(error) / 0.6)
        speed += min(max(wanted - speed, -3.0 * step), 1.0 * step)
        yaw += turn * step
        x += speed * step * math.cos(yaw)
        y += speed * step * math.sin(yaw)
        travelled += speed * step
        xy.append((x, y))
        headings.append(yaw)
    return np.array(xy), np.array(headings)


def clearance_along(route: Route, world: World) -> Float32Array:
    """Return the clearance (N,) at the route's positions, metres."""
    return world.clearance.sample(route.poses[:, 0, 3], route.poses[:, 1, 3])
