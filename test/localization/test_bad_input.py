"""Bad input on a drive through a simulated town: it is said, it makes no fix wrong, and afterwards all is well again.

The whole localizer, told of its motion by samples of odometry as the node and the replay tell it. The map shows the
town at another time than the drive, and the encoder needs no training.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from crossloc3d_ros.aerial_map.geotiff import write_geotiff
from crossloc3d_ros.aerial_map.store import TERRAIN, AerialMap
from crossloc3d_ros.angles import wrap
from crossloc3d_ros.clouds.raster import Bounds
from crossloc3d_ros.config import LocalizerConfig
from crossloc3d_ros.datasets.pose_sets import PoseSet, placed_town
from crossloc3d_ros.datasets.simulated import BenchmarkTown
from crossloc3d_ros.errors import CloudError, MapError
from crossloc3d_ros.localization.fusion.decision import RIGHT_WITHIN_M
from crossloc3d_ros.localization.fusion.gravity import GravityFilter
from crossloc3d_ros.localization.fusion.odometry import OdometryBuffer
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.localizer import Localizer, no_estimate
from crossloc3d_ros.localization.session import Session
from crossloc3d_ros.simulation.route import plan_route
from crossloc3d_ros.simulation.vlp16 import Vlp16
from crossloc3d_ros.types import BoolArray, Estimate, FixStatus, Float32Array, Float64Array, Scan, TrackState

Array = npt.NDArray[np.float64]
Change = Callable[[Any], Any]
MapChange = Callable[[Float32Array, Float32Array, Array], tuple[Float32Array, Float32Array]]

START_NS = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
STEP_NS = SECOND // 2  # from scan to scan
SAMPLES = 10  # of odometry and IMU from scan to scan
GRAVITY = np.array([0.0, 0.0, 9.81])


@dataclass(frozen=True, eq=False)
class Ride:
    """A drive of a hundred metres at 2 m/s, nearly straight, and the map of where it leads."""

    aerial_map: AerialMap
    encoder: Any
    ways: Float64Array
    """(S, SAMPLES + 1, 4, 4) `T_grid_base` from one scan to the next, both ends included."""
    scans: list[Float32Array]
    """S turns of the sensor, lidar frame; each at the end of its way."""
    T_base_lidar: Float64Array

    def __len__(self) -> int:
        return len(self.scans)


@pytest.fixture(scope="module")
def ride(simulated_town: tuple[PoseSet, Any]) -> Ride:
    """Plan the drive through the town as it is now, and scan it."""
    pose_set, encoder = simulated_town
    town = BenchmarkTown("estate", 990_112, False)
    world, _ = placed_town(town, 1 - town.seed % 2, 300.0, (0.0, 0.0))
    route = plan_route(world, 106.0, np.random.default_rng(3), border_m=0.0)
    T_base_lidar = pose_set.scans[0].T_base_lidar
    times = np.arange(2.0, route.duration_s - 2.0, STEP_NS / SECOND)  # it begins and ends at rest
    fine = times[:, None] + np.linspace(-STEP_NS / SECOND, 0.0, SAMPLES + 1)
    poses = route.at(fine.ravel())
    sensor, rng = Vlp16(), np.random.default_rng(1)
    scans = [
        sensor.scan(world.scene, T @ T_base_lidar, rng, twist).points
        for T, twist in zip(route.at(times), route.twist(times), strict=True)
    ]
    poses[:, :3, 3] = world.to_grid(poses[:, :3, 3])
    aerial_map = AerialMap.load(pose_set.map_folder, encoder.fingerprint)
    return Ride(aerial_map, encoder, poses.reshape(*fine.shape, 4, 4), scans, T_base_lidar)


@dataclass(frozen=True, eq=False)
class Told:
    """What came of a scan."""

    estimate: Estimate
    error_m: float
    """NaN where nothing is estimated."""

    @property
    def is_fix(self) -> bool:
        return self.estimate.status is FixStatus.FIX

    def __str__(self) -> str:
        e = self.estimate
        return f"{e.state.value:10} {e.status.value:6} {self.error_m:6.2f} {e.probability:.5f} {e.reason}"


class Robot:
    """Drives along the ride, scan by scan, and hands over what its sensors say, or what is made of that."""

    def __init__(self, ride: Ride, aerial_map: AerialMap | None = None, *, imu: bool = False) -> None:
        config = LocalizerConfig()
        self.ride = ride
        self.localizer = Localizer(aerial_map or ride.aerial_map, ride.encoder, config)
        self.odometry = OdometryBuffer(config.fusion)
        self.gravity = GravityFilter(1.0) if imu else None
        self.clock_ns = START_NS
        self.T_odom_base = np.eye(4)
        self.place: int | None = None

    def ahead(self, scans: int) -> range:
        """Return the next places, so many of them."""
        first = 0 if self.place is None else self.place + 1
        return range(first, first + scans)

    def drive(
        self,
        places: Iterable[int],
        *,
        step: Change | None = None,
        points: Change | None = None,
        force: Change | None = None,
        compass: Change | None = None,
        odometry: bool = True,
        late_ns: int = 0,
    ) -> list[Told]:
        """Go from place to place, each next to the one before, and tell what came of each scan.

        `step` changes what the odometry tells from sample to sample, `points` a scan, `force` what the IMU measures,
        all in their own axes; `compass` gives the heading that it tells for a true one. The odometry is silent where
        it is told to. A scan has the stamp of `late_ns` ago.
        """
        told = []
        for place in places:
            T_grid_base = self._go(place, step, force, odometry)
            stamp_ns = self.clock_ns - late_ns
            if compass is not None:
                heading = compass(math.atan2(T_grid_base[1, 0], T_grid_base[0, 0]))
                covariance = np.diag([np.inf, np.inf, math.radians(15.0) ** 2])
                self.localizer.set_prior(PosePrior(None, heading, covariance, stamp_ns))
            since, up = self.localizer.stamp_ns, None if self.gravity is None else self.gravity.up(stamp_ns)
            motion = None if since is None else self.odometry.motion(since, stamp_ns)
            turn = self.ride.scans[place]
            scan = Scan(turn if points is None else points(turn), stamp_ns, "velodyne")
            try:
                estimate = self.localizer.localize(scan, up, self.ride.T_base_lidar, motion)
            except (CloudError, MapError) as error:  # as the node and the replay do
                estimate = no_estimate(stamp_ns, str(error))
            told.append(Told(estimate, float(np.hypot(*(estimate.grid - T_grid_base[:3, 3])[:2]))))
        return told

    def _go(self, place: int, step: Change | None, force: Change | None, odometry: bool) -> Array:
        """Drive to a place, forward or in reverse, and return the pose there."""
        ways, before = self.ride.ways, self.place
        if before is None:
            way = ways[place]
        else:
            assert abs(place - before) == 1
            way = ways[place] if place > before else ways[before][::-1]
        for begin, end in itertools.pairwise(way):
            self.clock_ns += STEP_NS // SAMPLES
            moved = np.linalg.inv(begin) @ end
            self.T_odom_base = self.T_odom_base @ (moved if step is None else step(moved))
            if odometry:
                self.odometry.add(self.clock_ns, self.T_odom_base)
            if self.gravity is not None:
                measured = end[:3, :3].T @ GRAVITY
                self.gravity.update(self.clock_ns, measured if force is None else force(measured))
        self.place = place
        return np.asarray(way[-1])


def said(told: Sequence[Told]) -> str:
    return "\n".join(["", *map(str, told)])


def no_fix_is_wrong(told: Sequence[Told]) -> None:
    assert not [t for t in told if t.is_fix and not t.error_m < RIGHT_WITHIN_M], said(told)


def no_fix(told: Sequence[Told]) -> None:
    assert not any(t.is_fix for t in told), said(told)


def says(told: Sequence[Told], words: str) -> None:
    assert all(re.search(words, t.estimate.reason) for t in told), said(told)


def found(robot: Robot, places: Iterable[int], **changes: Any) -> list[Told]:
    """Drive on until there are two fixes in succession, within so many places; none may be wrong on the way."""
    told: list[Told] = []
    for place in places:
        told += robot.drive([place], **changes)
        if len(told) > 1 and told[-2].is_fix and told[-1].is_fix:
            no_fix_is_wrong(told)
            assert told[-1].error_m < 1.0, said(told)
            return told
    raise AssertionError(said(told))


def lost(robot: Robot, places: Iterable[int], **changes: Any) -> list[Told]:
    """Drive on until it is said, within so many places, that nothing fits any more; no fix may be wrong on the way."""
    told: list[Told] = []
    for place in places:
        told += robot.drive([place], **changes)
        if told[-1].estimate.state is TrackState.LOST:
            says(told[-1:], "the tracked pose no longer fits the scans")
            no_fix_is_wrong(told)
            no_fix(told[-5:])
            return told
    raise AssertionError(said(told))


def localized(ride: Ride, **how: Any) -> Robot:
    """Return a robot that has found itself."""
    robot = Robot(ride, **how)
    found(robot, robot.ahead(16))
    return robot


# Odometry


@pytest.mark.parametrize(("by", "words"), [((30.0, 0.0), "30 m"), ((0.0, 90.0), "(89|90|91) degrees")])
def test_odometry_that_jumps(ride: Ride, by: tuple[float, float], words: str) -> None:
    robot = localized(ride)
    metres, angle = by[0], math.radians(by[1])
    c, s = math.cos(angle), math.sin(angle)
    robot.T_odom_base = robot.T_odom_base @ np.array([[c, -s, 0, metres], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    told = robot.drive(robot.ahead(8))
    no_fix(told)
    says(told, f"since the motion was unknown: the odometry jumps by {words}")
    found(robot, robot.ahead(10))


def test_odometry_that_jumps_all_the_time(ride: Ride) -> None:
    robot = localized(ride)
    far = np.eye(4)
    far[:2, 3] = 8.0, 5.0
    told = robot.drive(robot.ahead(10), step=lambda moved: moved @ far)
    no_fix(told)
    says(told, "since the motion was unknown: the odometry jumps by")
    found(robot, robot.ahead(20))


@pytest.mark.parametrize(("share", "words"), [(1.2, "too long"), (0.8, "too short")])
def test_odometry_that_drifts_by_a_fifth(ride: Ride, share: float, words: str) -> None:
    def drifting(moved: Array) -> Array:
        wrong = moved.copy()
        wrong[:3, 3] *= share
        return wrong

    robot = Robot(ride)
    found(robot, robot.ahead(20), step=drifting)
    told = robot.drive(robot.ahead(30), step=drifting)
    no_fix_is_wrong(told)
    assert all(t.is_fix for t in told), said(told)  # it is seen through
    spoken = [t.estimate.reason for t in told if "the odometry's distances are" in t.estimate.reason]
    assert len(spoken) >= 5, said(told)
    for reason in spoken:
        clause = re.search(r"; the odometry's distances are (\d+)% (.*)$", reason)
        assert clause is not None
        assert clause[2] == words
        assert int(clause[1]) == pytest.approx(20, abs=6)
    good = robot.drive(robot.ahead(25))
    no_fix_is_wrong(good)
    assert good[-1].is_fix
    assert "odometry" not in good[-1].estimate.reason, said(good)


def test_odometry_that_stands_still_while_the_robot_drives(ride: Ride) -> None:
    robot = localized(ride)
    told = robot.drive(robot.ahead(24), step=lambda moved: np.eye(4))
    no_fix_is_wrong(told)
    # Where the doubt is so large that the pose is born anew, there is nothing for a while that could disagree.
    assert sum("odometry and map disagree" in each.estimate.reason for each in told[-8:]) >= 4, said(told)
    found(robot, robot.ahead(25))


def test_odometry_that_comes_no_more(ride: Ride) -> None:
    robot = localized(ride)
    told = robot.drive(robot.ahead(12), odometry=False)
    no_fix_is_wrong(told)
    no_fix(told[1:])  # half a second is bridged
    says(told[1:], "since the motion was unknown: the odometry has stopped")
    good = robot.drive(robot.ahead(4))
    no_fix(good)
    says(good, "since the motion was unknown: the odometry has a gap")
    found(robot, robot.ahead(16))


# IMU


def test_an_imu_that_tells_down_for_up(ride: Ride) -> None:
    """An accelerometer in axes of forward, right, down; or one that tells gravity for what holds against it."""
    axes = np.array([1.0, -1.0, -1.0])
    robot, other = Robot(ride, imu=True), localized(ride, imu=True)
    told = robot.drive(robot.ahead(6), force=lambda force: axes * force)
    told += other.drive(other.ahead(8), force=lambda force: -force)[1:]  # for half a second up is still up
    no_fix(told)
    says(told, "by the measured gravity the robot lies on its side")
    found(robot, robot.ahead(18))
    found(other, other.ahead(4))


def test_a_compass_that_counts_clockwise_from_north(ride: Ride) -> None:
    """It is listened to, and overruled: here it is off by more than 60 degrees."""

    def clockwise(heading: float) -> float:
        return math.pi / 2 - heading

    for T in ride.ways[:8, -1]:
        heading = math.atan2(T[1, 0], T[0, 0])
        assert abs(wrap(clockwise(heading) - heading)) > math.radians(60.0)
    alone, robot = Robot(ride), Robot(ride)
    [without], [misled] = alone.drive(alone.ahead(1)), robot.drive(robot.ahead(1), compass=clockwise)
    assert 1.0 - misled.estimate.probability > 2.0 * (1.0 - without.estimate.probability)
    found(robot, robot.ahead(18), compass=clockwise)
    found(robot, robot.ahead(2), compass=lambda heading: heading)


# Scans


def upside_down(points: Float32Array) -> Float32Array:
    return points * np.float32([1.0, -1.0, -1.0])


def test_scans_upside_down(ride: Ride) -> None:
    robot = localized(ride)
    told = lost(robot, robot.ahead(28), points=upside_down)
    no_fix(told[4:])
    found(robot, robot.ahead(28))


def test_scans_upside_down_from_the_start(ride: Ride) -> None:
    robot = Robot(ride)
    told = robot.drive(robot.ahead(12), points=upside_down)
    no_fix(told)
    says(told, "no pose fits the scans well")
    assert {t.estimate.state for t in told} == {TrackState.SEARCHING}
    found(robot, robot.ahead(20))


# The lidar, by its scans alone: the session looks at each before it is localized


def covered(points: Float32Array) -> Float32Array:
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(points * (0.9 + 0.02 * (ranges % 50.0)) / ranges, dtype=np.float32)


def on_its_side(points: Float32Array) -> Float32Array:
    """As of a lidar that looks down where it is taken to look ahead: the ground ahead of it."""
    return np.ascontiguousarray(points[:, [2, 1, 0]] * np.float32([-1.0, 1.0, 1.0]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (upside_down, "the lidar is upside down: the ground lies above it"),
        (on_its_side, "turned by 90 degrees in pitch: the ground stands upright ahead of it"),
        (covered, "the lidar is covered or blocked"),
        (None, "the lidar is frozen: it repeats a scan of"),
    ],
)
def test_what_is_wrong_with_the_lidar_is_named(ride: Ride, change: Change | None, words: str) -> None:
    """It is localized, then drives on with the fault, then all is well again."""
    first, last = 20, 32
    robot = Robot(ride)
    session = Session(robot.localizer, "topic")
    robot.odometry.add = session.add_odometry  # type: ignore[method-assign]
    told: list[Told] = []
    for place in range(len(ride)):
        T_grid_base, points = robot._go(place, None, None, True), ride.scans[place]
        if first <= place < last:
            points = ride.scans[first - 1] if change is None else change(points)
        received = session.receive(Scan(points, robot.clock_ns, "velodyne"), ride.T_base_lidar)
        estimate = session.localize(received).estimate
        told.append(Told(estimate, float(np.hypot(*(estimate.grid - T_grid_base[:3, 3])[:2]))))
    assert told[first - 1].is_fix, said(told)
    no_fix(told[first:last])
    says(told[first:last], words)
    no_fix_is_wrong(told)
    assert told[-1].is_fix, said(told)


# Time


def test_a_clock_that_is_set_back_a_little(ride: Ride) -> None:
    robot = localized(ride)
    robot.clock_ns -= 2 * SECOND
    told = robot.drive(robot.ahead(10))
    no_fix(told)
    says(told[:3], "the scan is [0-9.]+ s older than one before it")
    says(told[3:4], "the scan has the same stamp as the one before it")
    says(told[4:], "since the motion was unknown: the odometry jumps by")  # what it told meanwhile came late
    found(robot, robot.ahead(12))


def test_scans_that_overtake_each_other(ride: Ride) -> None:
    robot = localized(ride)
    newest_ns, place = robot.localizer.stamp_ns, robot.place
    assert newest_ns is not None
    assert place is not None
    for back in (1, 3):
        scan = Scan(ride.scans[place - back], newest_ns - back * STEP_NS, "velodyne")
        motion = robot.odometry.motion(newest_ns, scan.stamp_ns)
        estimate = robot.localizer.localize(scan, None, ride.T_base_lidar, motion)
        assert estimate.status is FixStatus.NO_FIX
        assert f"the scan is {back / 2:g} s older than one before it" in estimate.reason
    assert robot.localizer.stamp_ns == newest_ns
    found(robot, robot.ahead(2))


def test_a_recording_that_begins_anew(ride: Ride) -> None:
    robot = localized(ride)
    robot.clock_ns -= 3600 * SECOND
    told = robot.drive(robot.ahead(9))
    no_fix(told)
    first = told[0].estimate.reason  # nothing of before counts: neither the distance nor the probability
    assert "has explained the scans over only 0.0 m" in first or "99.9 % needed" in first
    found(robot, robot.ahead(8))


def test_a_sensor_whose_clock_alone_goes_back(ride: Ride) -> None:
    robot = localized(ride)
    told = robot.drive(robot.ahead(6), late_ns=3600 * SECOND)
    no_fix(told)
    says(told[1:], "since the motion was unknown: the odometry begins 3.6e.03 s after the last scan")
    found(robot, robot.ahead(20))


# The map


def changed_map(aerial_map: AerialMap, folder: Path, change: MapChange) -> AerialMap:
    """Return the map with other rasters: `change` makes terrain and surface (H, W) of theirs and of the middles
    (H, W, 2) of their cells."""
    terrain, surface = aerial_map.terrain(), aerial_map.surface()
    rows, columns, cell_m = *terrain.values.shape, terrain.cell_m
    east = terrain.west_m + (np.arange(columns) + 0.5) * cell_m
    north = terrain.north_m - (np.arange(rows) + 0.5) * cell_m
    made = change(terrain.values.copy(), surface.values.copy(), np.stack(np.meshgrid(east, north), axis=-1))
    # What is new lets no pulse through; where something has gone, they reach the ground.
    lowest = np.where(made[1] == surface.values, aerial_map.lowest().values, made[1])
    for name, values in zip(("terrain", "surface", "lowest"), (*made, lowest), strict=True):

        def block(part: Bounds, values: Float32Array = values) -> Float32Array:
            row, column = round((terrain.north_m - part[3]) / cell_m), round((part[0] - terrain.west_m) / cell_m)
            height, width = round((part[3] - part[1]) / cell_m), round((part[2] - part[0]) / cell_m)
            return values[row : row + height, column : column + width]

        write_geotiff(folder / f"{name}.tif", aerial_map.bounds, cell_m, aerial_map.manifest.crs, block, name)
    paths = {f"{name}_path": folder / f"{name}.tif" for name in ("terrain", "surface", "lowest")}
    return dataclasses.replace(aerial_map, **paths)


def beyond(ride: Ride, cells: Array) -> BoolArray:
    """Mark the cells (H, W) on the far side of place 60: half of the map, and of the drive."""
    ends = ride.ways[[0, -1], -1, :2, 3]
    return np.asarray((cells - ride.ways[60, -1, :2, 3]) @ (ends[1] - ends[0]) > 0.0)


def test_a_map_whose_terrain_is_unknown(ride: Ride, tmp_path: Path) -> None:
    aerial_map = changed_map(ride.aerial_map, tmp_path, lambda t, s, _: (np.full_like(t, np.nan), s))
    told = Robot(ride, aerial_map).drive(range(10))
    no_fix(told)
    says(told, "no pose on the map fits the scan")
    assert {t.estimate.state for t in told} == {TrackState.SEARCHING}


def test_a_map_whose_terrain_is_unknown_in_one_half(ride: Ride, tmp_path: Path) -> None:
    def without(terrain: Float32Array, surface: Float32Array, cells: Array) -> tuple[Float32Array, Float32Array]:
        return np.where(beyond(ride, cells), np.float32("nan"), terrain), surface

    robot = Robot(ride, changed_map(ride.aerial_map, tmp_path, without))
    told = robot.drive(range(90, 79, -1))
    no_fix(told)
    says(told, "no pose fits the scans well")
    found(robot, range(79, -1, -1))


def test_a_map_whose_terrain_is_missing(ride: Ride, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    shutil.copytree(ride.aerial_map.path, folder)
    aerial_map = AerialMap.load(folder, ride.encoder.fingerprint)
    (folder / TERRAIN).rename(tmp_path / TERRAIN)
    with pytest.raises(MapError, match=f"lacks its file {TERRAIN}; copy the map again or build it anew"):
        AerialMap.load(folder, ride.encoder.fingerprint)
    robot = Robot(ride, aerial_map)  # which was opened before
    told = robot.drive(robot.ahead(3))
    no_fix(told)
    says(told, f"{TERRAIN} is damaged or missing; copy the map again or build it anew")
    (tmp_path / TERRAIN).rename(folder / TERRAIN)
    found(robot, robot.ahead(16))


def test_a_map_that_lacks_one_half(ride: Ride, tmp_path: Path) -> None:
    def without(terrain: Float32Array, surface: Float32Array, cells: Array) -> tuple[Float32Array, Float32Array]:
        far, nothing = beyond(ride, cells), np.float32("nan")
        return np.where(far, nothing, terrain), np.where(far, nothing, surface)

    robot = Robot(ride, changed_map(ride.aerial_map, tmp_path, without))
    found(robot, range(15, 50))
    assert robot.place is not None
    told = lost(robot, range(robot.place + 1, len(ride)))
    no_fix(told[-20:])
    found(robot, range(robot.place - 1, -1, -1))


def other_town(ride: Ride, share: float, around: Array | None = None, radius_m: float = 0.0) -> MapChange:
    """Take away a share of all that stands in the town, and put as many boxes beside the road instead; where a place is
    given, within that radius of it alone."""

    def change(terrain: Float32Array, surface: Float32Array, cells: Array) -> tuple[Float32Array, Float32Array]:
        rng = np.random.default_rng(1)
        things, count = ndimage.label(np.nan_to_num(surface - terrain) > 2.5)
        is_gone = rng.random(count + 1) < share
        is_gone[0] = False
        here = np.ones(surface.shape, np.bool_)
        if around is not None:
            here = np.hypot(*np.moveaxis(cells - around, -1, 0)) < radius_m
        made = np.where(ndimage.binary_dilation(is_gone[things] & here), terrain, surface)
        free, wanted = (things == 0) & here, round(share * count)
        for _ in range(2000):
            row, column = (int(rng.integers(10, side - 10)) for side in surface.shape)
            up, across = rng.integers(4, 9, 2)
            box = np.s_[row - up : row + up, column - across : column + across]
            away = np.hypot(*(ride.ways[:, -1, :2, 3] - cells[row, column]).T).min()
            if wanted > 0 and away > 12.0 and free[box].all():
                made[box] = terrain[box] + np.float32(rng.uniform(4.0, 12.0))
                free[box] = False
                wanted -= 1
        return terrain, made

    return change


def test_a_town_of_which_a_tenth_has_changed(ride: Ride, tmp_path: Path) -> None:
    robot = Robot(ride, changed_map(ride.aerial_map, tmp_path, other_town(ride, 0.1)))
    told = found(robot, robot.ahead(40))
    unchanged = Robot(ride).drive(range(1))[0].estimate.probability
    assert told[0].estimate.probability < unchanged, said(told)  # it is noticed


def test_a_town_that_is_hardly_the_same(ride: Ride, tmp_path: Path) -> None:
    robot = Robot(ride, changed_map(ride.aerial_map, tmp_path, other_town(ride, 0.6)))
    told = robot.drive(robot.ahead(16))
    no_fix(told)
    says(told, "no pose fits the scans well")
    assert {t.estimate.state for t in told} == {TrackState.SEARCHING}


@pytest.mark.slow
def test_a_quarter_that_was_built_anew(ride: Ride, tmp_path: Path) -> None:
    quarter = other_town(ride, 1.0, ride.ways[0, -1, :2, 3], 30.0)
    robot = Robot(ride, changed_map(ride.aerial_map, tmp_path, quarter))
    found(robot, range(len(ride) - 1, 70, -1))
    assert robot.place is not None
    lost(robot, range(robot.place - 1, -1, -1))
    found(robot, [*range(robot.place + 1, len(ride)), *range(len(ride) - 2, 70, -1)])
