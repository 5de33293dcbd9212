"""A simulated lidar: beams that turn about the sensor's axis, or a rosette ahead of it, as a ROS 2 driver sends it.

    lidar = Lidar(PROFILES["os1-64"])                                                # simulation.profiles
    scan = lidar.scan(world.scene, T_world_lidar, np.random.default_rng(1))
    scan.points            # (N, 3) float32, lidar frame

Points come in firing order; `time` is relative to the end of the turn. What does not come back (sky, the largest range,
weak echoes at grazing incidence, water) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from crossloc3d_ros.config import option
from crossloc3d_ros.formats.messages import CloudLayout
from crossloc3d_ros.simulation.scene import Label, Scene
from crossloc3d_ros.simulation.traffic import Movers
from crossloc3d_ros.types import BoolArray, Float32Array, Float64Array, Int32Array, PointTimes, Scan

_WEDGE_HZ = (121.6, -77.7)
"""Turns a second of the two wedge prisms of a rosette. They have no common period within seconds, so that each turn
fills gaps of the ones before; makers do not publish theirs."""


@dataclass(frozen=True)
class LidarConfig:
    """What the sensor can do, and what of the robot it sees; the defaults are a VLP-16's."""

    rate_hz: float = option(10.0, "turns a second", low=5.0, high=20.0)
    min_range_m: float = option(0.5, "nearer echoes are dropped", low=0.0, high=5.0)
    max_range_m: float = option(100.0, "farther echoes are dropped", low=1.0, high=500.0)
    range_error_m: float = option(0.02, "one sigma of a range", low=0.0, high=1.0)
    echo_limit: float = option(1.5e-5, "weakest reflectivity * cos(incidence)^0.75 / range^2 that comes back", low=0.0)
    random_dropout: float = option(0.003, "share of echoes lost for no reason", low=0.0, high=1.0)
    body: tuple[float, ...] = option(
        (-0.42, -0.05, -0.6, -0.32, 0.05, 0.45, -0.9, -0.45, -1.0, 0.6, 0.45, -0.55),
        "boxes of the robot's own body in the lidar frame: 6 numbers each, lower and upper corner",
    )


@dataclass(frozen=True)
class LidarProfile:
    """How a model of lidar scans, and how its driver sends what it measures."""

    name: str
    elevations_deg: tuple[float, ...]
    """Of the beams, in the order in which they fire; for a rosette, beside the axis that the prisms turn."""
    column_s: float
    """From one firing of all beams to the next."""
    firing_s: float = 0.0
    """From one beam to the next; 0 = all at once."""
    half_field_deg: tuple[float, float] | None = None
    """Of a rosette: how far to the sides and how far up and down the axis is turned; None = the sensor spins."""
    range_step_m: float = 0.002
    """Ranges are multiples of it."""
    layout: CloudLayout = "velodyne"
    """Whose driver lays out the cloud."""
    stamped_at: float = 1.0
    """Moment of the turn that the cloud's stamp gives: 0 = its start, 1 = its end."""
    config: LidarConfig = LidarConfig()


@dataclass(frozen=True, eq=False)
class LidarScan:
    """One turn of the sensor, in firing order."""

    points: Float32Array
    """(N, 3) metres, lidar frame at each point's own time."""
    intensity: Float32Array
    """(N,) 0 to 255."""
    ring: npt.NDArray[np.uint16]
    """(N,) 0 the lowest beam."""
    time: Float32Array
    """(N,) seconds from the end of the turn, about -0.1 to 0."""

    def as_scan(self, stamp_ns: int = 0, frame_id: str = "velodyne") -> Scan:
        """Return the points as the localizer takes them."""
        return Scan(self.points, stamp_ns, frame_id, PointTimes("time", self.time))


_REFLECTIVITY = np.zeros((8, 2), dtype=np.float32)
_REFLECTIVITY[[Label.GROUND, Label.BUILDING, Label.VEGETATION, Label.STRUCTURE]] = [
    [0.12, 0.14], [0.18, 0.45], [0.25, 0.3], [0.08, 0.7],
]  # fmt: skip
"""(label, 2) least reflectivity and how much more a surface may have; water mirrors the beam away."""


class Lidar:
    """A sensor that scans scenes."""

    def __init__(self, profile: LidarProfile, config: LidarConfig | None = None) -> None:
        """Set up a sensor of the profile; `config` in place of the profile's own."""
        self.profile = profile
        self.config = config or profile.config
        beams = len(profile.elevations_deg)
        period = 1.0 / self.config.rate_hz
        # A column that only the rounding of the quotient takes away belongs to the turn.
        self._columns = int(period / profile.column_s + 1e-6)
        columns, firings = np.arange(self._columns)[:, None], np.arange(beams)[None, :]
        self._time = (columns * profile.column_s + firings * profile.firing_s).ravel() - period
        elevations = np.array(profile.elevations_deg, dtype=np.float64)
        self._ring = np.tile(np.argsort(np.argsort(elevations)).astype(np.uint16), self._columns)
        self._elevation = np.tile(np.radians(elevations), self._columns)
        self._body = np.asarray(self.config.body, dtype=np.float64).reshape(-1, 6)

    def scan(
        self,
        scene: Scene,
        T_world_lidar: Float64Array,
        rng: np.random.Generator,
        twist: npt.ArrayLike | None = None,
        movers: Movers | None = None,
    ) -> LidarScan:
        """Return the turn that ends at the pose `T_world_lidar` (4, 4).

        `twist` (6,): velocity [m/s] and turn rate [rad/s] in the lidar frame, held during the turn; the points are then
        distorted as a driver without motion compensation delivers them. `movers`: what else is about at the turn's end.
        """
        config = self.config
        azimuth, elevation = self._angles(rng)
        motion = np.zeros(6) if twist is None else np.asarray(twist, dtype=np.float64)
        beams, origins, directions = _rays(
            azimuth, elevation, self._time, np.ascontiguousarray(T_world_lidar, dtype=np.float64), motion
        )
        hits = scene.cast(origins, directions)
        if movers is not None:
            hits = movers.before(hits, origins, directions, self._time)
        own_range = _body_range(beams, self._body)
        shadowed = own_range < hits.distance_m
        true_range = np.where(shadowed, own_range, hits.distance_m)
        reflectivity = surface_reflectivity(hits.label, hits.face)
        reflectivity = np.where(shadowed, np.float32(0.3), reflectivity)
        cosine = np.where(shadowed, np.float32(0.7), hits.incidence_cos)
        kept = _echoes(true_range, reflectivity, cosine, hits.label, config, rng)
        kept |= shadowed & (own_range > config.min_range_m)
        measured = true_range[kept] + config.range_error_m * rng.standard_normal(int(kept.sum())).astype(np.float32)
        measured = np.rint(measured / self.profile.range_step_m) * self.profile.range_step_m
        points = (beams[kept] * measured[:, None]).astype(np.float32)
        brightness = 200.0 * reflectivity[kept] * np.sqrt(cosine[kept]) + 4.0 * rng.standard_normal(len(measured))
        return LidarScan(
            points=points,
            intensity=np.clip(np.rint(brightness), 0, 255).astype(np.float32),
            ring=self._ring[kept],
            time=self._time[kept].astype(np.float32),
        )

    def _angles(self, rng: np.random.Generator) -> tuple[Float64Array, Float64Array]:
        """Return azimuth and elevation, rad, of every beam of a turn that begins anywhere."""
        config, since_start = self.config, self._time + 1.0 / self.config.rate_hz
        if self.profile.half_field_deg is None:
            # The sensor turns clockwise seen from above.
            return rng.uniform(0, 2 * np.pi) - 2 * np.pi * config.rate_hz * since_start, self._elevation
        # Two thin wedge prisms of equal power deflect the axis by vectors that add up: petals through its middle.
        phases = rng.uniform(0, 2 * np.pi, 2)
        deflection = sum(
            0.5 * np.exp(1j * (2 * np.pi * rate * since_start + phase))
            for rate, phase in zip(_WEDGE_HZ, phases, strict=True)
        )
        aside, up = np.radians(self.profile.half_field_deg)
        return aside * np.real(deflection), up * np.imag(deflection) + self._elevation


def surface_reflectivity(label: npt.NDArray[np.uint8], face: Int32Array) -> Float32Array:
    """Return the reflectivity 0 to 1 of each hit: a face keeps its own in every scan."""
    scrambled = (face.astype(np.uint32) // np.uint32(16)) * np.uint32(2654435761)
    share = (scrambled >> np.uint32(8)).astype(np.float32) / np.float32(2**24)
    bounds = _REFLECTIVITY[label]
    return np.asarray(bounds[:, 0] + bounds[:, 1] * share, dtype=np.float32)


def _echoes(
    distance: Float32Array,
    reflectivity: Float32Array,
    cosine: Float32Array,
    label: npt.NDArray[np.uint8],
    config: LidarConfig,
    rng: np.random.Generator,
) -> BoolArray:
    """Return which beams come back strongly enough."""
    inside = (distance > config.min_range_m) & (distance < config.max_range_m)
    # Asphalt and grass are rough: at grazing incidence they send back more than Lambert's cosine.
    strength = reflectivity * cosine**0.75 / np.maximum(distance, np.float32(0.1)) ** 2
    draw = rng.random(len(distance), dtype=np.float32)
    # The limit is not sharp: the same wall flickers over a factor of two.
    kept = inside & (strength > config.echo_limit * (0.7 + 0.8 * draw))
    lost = np.where(label == Label.VEGETATION, 0.08, config.random_dropout)
    return np.asarray(kept & (rng.random(len(distance), dtype=np.float32) >= lost), dtype=np.bool_)


@njit(cache=True, nogil=True)
def _rays(  # type: ignore[no-untyped-def]
    azimuth: Float64Array, elevation: Float64Array, time: Float64Array, T: Float64Array, twist: Float64Array
):
    """Return beams in the lidar frame and, where the moving sensor was at each time, origins and directions."""
    count = azimuth.shape[0]
    beams = np.empty((count, 3), dtype=np.float32)
    origins = np.empty((count, 3), dtype=np.float32)
    directions = np.empty((count, 3), dtype=np.float32)
    moving = False
    for i in range(6):
        moving = moving or twist[i] != 0.0
    R = T[:3, :3].copy()
    rate = np.sqrt(twist[3] ** 2 + twist[4] ** 2 + twist[5] ** 2)
    for i in range(count):
        flat = np.cos(elevation[i])
        x, y, z = flat * np.cos(azimuth[i]), flat * np.sin(azimuth[i]), np.sin(elevation[i])
        beams[i, 0], beams[i, 1], beams[i, 2] = x, y, z
        px = py = pz = 0.0
        if moving:
            t = time[i]
            px, py, pz = twist[0] * t, twist[1] * t, twist[2] * t
            if rate > 0.0:
                # Rodrigues' formula for the turn made between this firing and the end of the sweep.
                ax, ay, az = twist[3] / rate, twist[4] / rate, twist[5] / rate
                c, s = np.cos(rate * t), np.sin(rate * t)
                dot = (ax * x + ay * y + az * z) * (1.0 - c)
                x, y, z = (
                    x * c + (ay * z - az * y) * s + ax * dot,
                    y * c + (az * x - ax * z) * s + ay * dot,
                    z * c + (ax * y - ay * x) * s + az * dot,
                )
        for j in range(3):
            origins[i, j] = T[j, 3] + R[j, 0] * px + R[j, 1] * py + R[j, 2] * pz
            directions[i, j] = R[j, 0] * x + R[j, 1] * y + R[j, 2] * z
    return beams, origins, directions


@njit(cache=True, nogil=True)
def _body_range(beams: Float32Array, boxes: Float64Array) -> Float32Array:
    """Return how far each beam (N, 3) gets before it meets the robot's own body; infinity where it does not."""
    ranges = np.full(beams.shape[0], np.inf, dtype=np.float32)
    for i in range(beams.shape[0]):
        for k in range(boxes.shape[0]):
            near, far = 0.0, np.inf
            for axis in range(3):
                step = beams[i, axis]
                low, high = boxes[k, axis], boxes[k, axis + 3]
                if abs(step) < 1e-9:
                    if low > 0.0 or high < 0.0:
                        far = -1.0
                    continue
                a, b = low / step, high / step
                if a > b:
                    a, b = b, a
                near, far = max(near, a), min(far, b)
            if near <= far and 0.0 < near < ranges[i]:
                ranges[i] = near
    return ranges
