"""What a robot can drive through: a scene, its terrain, and where there is room to drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.simulation.scene import Scene
from crossloc3d_ros.types import BoolArray, Float64Array


class Bounds(NamedTuple):
    """A rectangle in local metres."""

    min_x: float
    min_y: float
    max_x: float
    max_y: float


@dataclass(frozen=True, eq=False)
class World:
    """A place in local metres: x east, y north along the CRS's grid, z up; `origin_grid` added gives the CRS."""

    name: str
    scene: Scene
    terrain: Raster
    """Height of the bare ground, metres, local."""
    clearance: Raster
    """Horizontal distance to the nearest thing that a robot would run into, metres; 0 inside of it and off the map."""
    preference: Raster
    """How gladly a robot drives there: 0 unreachable, 1 a street; between: lawns, yards, car parks."""
    bounds: Bounds
    """The part that may be surveyed and driven; the scene reaches beyond it."""
    crs: str
    origin_grid: Float64Array
    """(3,) easting, northing, height in the CRS of the local zero."""
    geoid_separation_m: float | None
    """Ellipsoidal height minus the world's height; None where not known."""

    def terrain_height(self, xy: npt.NDArray[np.floating]) -> Float64Array:
        """Return the ground's height (N,) under local positions (N, 2)."""
        x, y = _inside(self.terrain, xy)
        return np.asarray(self.terrain.sample(x, y), dtype=np.float64)

    def sample_poses(
        self,
        count: int,
        rng: np.random.Generator,
        *,
        clearance_m: float = 1.2,
        border_m: float = 40.0,
        tilt_deg: float = 1.0,
    ) -> Float64Array:
        """Return `count` poses `T_world_base` (count, 4, 4) of a robot standing anywhere that it could drive to.

        Heading uniform over the circle, roll and pitch from the slope plus a normal `tilt_deg`, at least `clearance_m`
        from obstacles and `border_m` inside the bounds. Raises ValueError where there is no such place.
        """
        weight = self.preference.values * (self.clearance.values >= clearance_m)
        rows, columns = weight.shape
        cell = self.preference.cell_m
        x = self.preference.west_m + (np.arange(columns) + 0.5) * cell
        y = self.preference.north_m - (np.arange(rows) + 0.5) * cell
        inside_x = (x > self.bounds.min_x + border_m) & (x < self.bounds.max_x - border_m)
        inside_y = (y > self.bounds.min_y + border_m) & (y < self.bounds.max_y - border_m)
        weight = weight * inside_y[:, None] * inside_x[None, :]
        cumulative = np.cumsum(weight.ravel(), dtype=np.float64)
        if cumulative[-1] <= 0:
            raise ValueError(f"'{self.name}' has no free ground {border_m} m inside of its bounds")
        index = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
        row, column = np.divmod(np.minimum(index, weight.size - 1), columns)
        xy = np.stack([x[column], y[row]], -1) + (rng.random((count, 2)) - 0.5) * cell
        yaw = rng.random(count) * 2 * np.pi
        tilt = np.radians(tilt_deg) * rng.standard_normal((count, 2))
        return self.poses_on_ground(xy, yaw, roll_rad=tilt[:, 0], pitch_rad=tilt[:, 1])

    def poses_on_ground(
        self,
        xy: Float64Array,
        yaw_rad: Float64Array,
        *,
        roll_rad: npt.NDArray[np.floating] | float = 0.0,
        pitch_rad: npt.NDArray[np.floating] | float = 0.0,
        wheelbase_m: float = 1.0,
    ) -> Float64Array:
        """Return `T_world_base` (N, 4, 4) of a robot on the ground at `xy` (N, 2), tilted with the slope.

        `roll_rad`, `pitch_rad` (positive nose down) are added to the slope's.
        """
        forward = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], -1)
        left = np.stack([-forward[:, 1], forward[:, 0]], -1)
        half = wheelbase_m / 2
        ahead, behind = self.terrain_height(xy + half * forward), self.terrain_height(xy - half * forward)
        port, starboard = self.terrain_height(xy + half * left), self.terrain_height(xy - half * left)
        pitch = -np.arctan2(ahead - behind, wheelbase_m) + pitch_rad
        roll = np.arctan2(port - starboard, wheelbase_m) + roll_rad
        poses = np.zeros((len(xy), 4, 4))
        poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw_rad, pitch, roll], -1)).as_matrix()
        poses[:, :2, 3] = xy
        poses[:, 2, 3] = self.terrain_height(xy)
        poses[:, 3, 3] = 1.0
        return poses

    def to_grid(self, local: npt.NDArray[np.floating]) -> Float64Array:
        """Return local points (N, 3) in the world's CRS: easting, northing, height."""
        return np.asarray(local, dtype=np.float64) + self.origin_grid


def free_space(
    obstacles: BoolArray,
    roads: BoolArray,
    west_m: float,
    north_m: float,
    cell_m: float,
    *,
    least_share: float = 0.05,
) -> tuple[Raster, Raster]:
    """Return clearance and preference from masks of cells (row 0 = north).

    What hangs together with no road, keeping a metre on either side, is not preferred at all: closed courtyards. Nor
    are regions whose roads have less than `least_share` of the largest region's.
    """
    padded = np.pad(obstacles, 1, constant_values=True)
    distance = ndimage.distance_transform_edt(~padded)[1:-1, 1:-1] * cell_m
    # The transform counts from cell centre to cell centre; an obstacle may begin half a cell earlier.
    clearance = np.maximum(distance - 0.5 * cell_m, 0.0).astype(np.float32)
    passable = clearance >= 1.0
    regions, count = ndimage.label(passable)
    preference = np.zeros(obstacles.shape, dtype=np.float32)
    if count:
        votes = np.bincount(regions[roads & passable], minlength=count + 1)
        votes[0] = 0
        if votes.max() == 0:
            votes = np.bincount(regions.ravel(), minlength=count + 1)
            votes[0] = 0
        # Quarters on either side of a river are both real places; a strip between two fences is none.
        reachable = (votes >= max(1.0, least_share * votes.max()))[regions]
        preference[reachable] = 0.2
        preference[reachable & roads] = 1.0
    return (
        Raster(clearance, west_m, north_m, cell_m),
        Raster(preference, west_m, north_m, cell_m),
    )


def _inside(raster: Raster, xy: npt.NDArray[np.floating]) -> tuple[Float64Array, Float64Array]:
    """Clamp positions to where the raster can be interpolated."""
    rows, columns = raster.values.shape
    margin = 0.5001 * raster.cell_m
    x = np.clip(xy[:, 0], raster.west_m + margin, raster.west_m + columns * raster.cell_m - margin)
    y = np.clip(xy[:, 1], raster.north_m - rows * raster.cell_m + margin, raster.north_m - margin)
    return np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
