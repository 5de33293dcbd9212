"""Sets of raw scans: true poses, true maps, nothing made twice, nothing damaged taken for whole."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import BuildConfig, PreprocessingConfig
from crossloc3d_ros.datasets import pose_sets
from crossloc3d_ros.datasets.pose_drives import (
    KIDNAPPED_NS,
    DrivePlan,
    Journey,
    Leg,
    RawDrive,
    drive_plans,
    journeys_of,
    load_drives,
    open_drives,
    steps_of,
)
from crossloc3d_ros.datasets.pose_sets import POSE_SETS, PoseSet, SimulatedPoses, load_pose_set, open_pose_set
from crossloc3d_ros.datasets.raw_scans import RawScan, RawScans, load_scans, save_scans
from crossloc3d_ros.datasets.simulated import SIMULATED, SIMULATED_SMALL, BenchmarkTown, SimulatedBenchmark
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.simulation.families import HELD_OUT_FAMILIES
from crossloc3d_ros.simulation.survey import SurveyConfig

TINY = SimulatedPoses(
    SimulatedBenchmark(
        (BenchmarkTown("suburb", 990_011, False), BenchmarkTown("estate", 990_012, False)),
        town_size_m=260.0, queries=4, ground=0, flight=SurveyConfig(spacing_m=0.8), build=BuildConfig(spacing_m=38.0),
    ),
    columns=2,
    off_map=(BenchmarkTown("campus", 990_013, False),),
    off_map_scans=3,
)  # fmt: skip


class Heights:
    """Describe a patch by its mean height."""

    fingerprint = "heights-of-patches"
    descriptor_size = 1
    preprocessing = PreprocessingConfig()

    def encode(self, points):
        return np.array([points[:, 2].mean()], np.float32)

    def encode_batch(self, clouds):
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        pass


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pose")


@pytest.fixture(scope="module")
def tiny(data: Path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(POSE_SETS, "simulated_small", TINY)
        yield open_pose_set("simulated_small", data, Heights)


@pytest.fixture(scope="module")
def recorded(tiny: PoseSet) -> list[RawDrive]:
    return open_drives(tiny)


def test_the_scans_lie_on_the_map_where_their_poses_say(tiny: PoseSet) -> None:
    aerial_map = AerialMap.load(tiny.map_folder, Heights.fingerprint)
    terrain, surface = aerial_map.terrain(), aerial_map.surface()

    def explained(scan: RawScan, shift_m: float) -> float:
        T = scan.T_grid_base @ scan.T_base_lidar
        points = scan.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3] + [shift_m, 0.0, 0.0]
        above = points[:, 2] - terrain.sample(points[:, 0], points[:, 1])
        roof = surface.sample(points[:, 0], points[:, 1])
        high = np.isfinite(above) & np.isfinite(roof) & (above > 2.0)
        return float(np.mean(points[high, 2] < roof[high] + 1.0))

    here, beside = (
        np.mean([explained(scan, shift) for scan in tiny.scans if tiny.on_map[scan.area]]) for shift in (0.0, 4.0)
    )
    assert here > 0.75
    assert here > beside + 0.15


def test_robots_keep_off_the_seams_and_off_each_other_s_town(tiny: PoseSet) -> None:
    west, south, east, north = AerialMap.load(tiny.map_folder).bounds
    for scan in tiny.scans:
        x, y = scan.T_grid_base[:2, 3]
        if not tiny.on_map[scan.area]:
            assert not (west - 1000 < x < east + 1000 and south - 1000 < y < north + 1000)
            continue
        corner = np.array([500_000.0, 5_800_000.0]) + TINY.corner(scan.area)
        inside = np.array([x, y]) - corner
        assert (inside >= pose_sets.SEAM_M).all()
        assert (inside <= 260.0 - pose_sets.SEAM_M).all()


def test_areas_scans_and_imus_are_what_was_asked_for(tiny: PoseSet) -> None:
    assert np.bincount(tiny.scans.area).tolist() == [4, 4, 3]
    assert tiny.on_map == (True, True, False)
    assert tiny.area_names == ("suburb 990011", "estate 990012", "campus 990013")
    levelled = [scan for scan in tiny.scans if scan.up_base is not None]
    assert 0 < len(levelled) < len(tiny.scans)
    for scan in levelled:
        np.testing.assert_allclose(scan.up_base, scan.T_grid_base[2, :3], atol=0.03)
        assert 0.9 <= scan.T_base_lidar[2, 3] <= 1.6


def test_a_set_is_made_once(tiny: PoseSet, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_sets, "fly", lambda *_: pytest.fail("flown again"))
    again = open_pose_set("simulated_small", data, Heights)
    assert again.folder == tiny.folder
    np.testing.assert_array_equal(again.scans[3].points, tiny.scans[3].points)
    np.testing.assert_array_equal(load_pose_set(tiny.folder).scans.T_grid_base, tiny.scans.T_grid_base)


def test_a_stopped_set_goes_on_and_comes_out_the_same(
    tiny: PoseSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tmp_path / tiny.folder.name
    shutil.copytree(tiny.folder, made)
    (made / "estate_990012" / "made.json").unlink()  # as if this town had not been finished
    shutil.rmtree(made / tiny.map_folder.name)
    flown = []
    fly = pose_sets.fly
    monkeypatch.setattr(pose_sets, "fly", lambda world, *rest: flown.append(world.name) or fly(world, *rest))
    again = open_pose_set("simulated_small", tmp_path, Heights)
    assert flown == ["estate 990012"]
    for one, other in zip(again.scans, tiny.scans, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.T_grid_base, other.T_grid_base)


def test_another_making_is_another_folder(tiny: PoseSet, data: Path) -> None:
    other = dataclasses.replace(TINY, off_map_scans=5)
    assert pose_sets.settings_of(TINY) != pose_sets.settings_of(other)
    workers = dataclasses.replace(
        TINY, examined=dataclasses.replace(TINY.examined, build=dataclasses.replace(TINY.examined.build, workers=2))
    )
    assert pose_sets.settings_of(TINY) == pose_sets.settings_of(workers)


def test_unknown_and_missing_sets_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown pose set"):
        open_pose_set("nowhere", tmp_path, Heights)
    with pytest.raises(EvaluationError, match="needs the folder of its two surveys"):
        open_pose_set("amsterdam", tmp_path, Heights)
    with pytest.raises(EvaluationError, match="holds no pose set"):
        load_pose_set(tmp_path)


def test_raw_scans_come_back_as_they_were(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scans = [
        RawScan(rng.random((n, 3), np.float32), np.eye(4) * 1.0, np.eye(4), up, 10 * n, n % 3, n % 2)
        for n, up in ((5, None), (0, np.array([0.0, 0.0, 1.0])), (9, None))
    ]
    save_scans(tmp_path, RawScans.of(scans))
    for one, other in zip(load_scans(tmp_path), scans, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        assert (one.up_base is None) == (other.up_base is None)
        assert (one.stamp_ns, one.area, one.group) == (other.stamp_ns, other.area, other.group)


@pytest.mark.parametrize("name", ["points.npy", "scans.npz"])
@pytest.mark.parametrize("damage", ["missing", "cut", "empty"])
def test_damaged_scans_are_refused(tmp_path: Path, name: str, damage: str) -> None:
    points = np.ones((50, 3), np.float32)
    save_scans(tmp_path, RawScans.of([RawScan(points, np.eye(4), np.eye(4)) for _ in range(3)]))
    path = tmp_path / name
    content = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(content[: len(content) // 2 if damage == "cut" else 0])
    with pytest.raises(EvaluationError, match="make it anew"):
        load_scans(tmp_path)


def test_benchmark_towns_belong_to_no_training_set() -> None:
    fitting = POSE_SETS["fitting"]
    examined = POSE_SETS["simulated"]
    assert isinstance(fitting, SimulatedPoses)
    assert isinstance(examined, SimulatedPoses)
    tuned = {town.seed for town in (*fitting.examined.towns, *fitting.off_map)}
    assert all(150_000 <= seed < 900_000 for seed in tuned)
    assert not {town.family for town in fitting.examined.towns} & set(HELD_OUT_FAMILIES)
    on_map, off_map = set(examined.examined.towns), set(examined.off_map)
    assert len(on_map) == 16
    assert not on_map & off_map
    assert on_map | off_map <= set(SIMULATED.towns)
    assert {town.family for town in on_map} >= set(HELD_OUT_FAMILIES)
    assert len(on_map) * (examined.examined.town_size_m / 1000) ** 2 == pytest.approx(5.76)
    for town in (*SIMULATED.towns, *SIMULATED_SMALL.towns):
        assert town.held_out == (town.family in HELD_OUT_FAMILIES)


@pytest.mark.slow
def test_drives_are_recorded_once_and_tell_where_they_were(recorded: list[RawDrive], tiny: PoseSet) -> None:
    assert [drive.plan for drive in recorded] == list(drive_plans("simulated_small"))
    assert len(load_drives(tiny.folder)) == len(recorded)
    for drive in recorded:
        assert abs(drive.travelled_m[-1] - drive.plan.length_m) < 0.1 * drive.plan.length_m + 5
        assert (np.diff(drive.scans.stamp_ns) > 0).all()
        assert (np.diff(drive.odometry_ns) > 0).all()
        has_imu = np.isfinite(drive.scans.up_base).all(axis=1)
        assert has_imu.all() if drive.plan.has_imu else not has_imu.any()
        # Wheels measure what was driven, to a few per cent.
        at = np.searchsorted(drive.odometry_ns, drive.scans.stamp_ns)
        steps = np.diff(drive.odometry[np.minimum(at, len(drive.odometry) - 1), :2], axis=0)
        way = np.hypot(steps[:, 0], steps[:, 1]).sum()
        assert way == pytest.approx(drive.travelled_m[-1], rel=0.08)


def made_up(name: str, heading: float, area: int = 0, count: int = 20) -> RawDrive:
    """Return a drive straight ahead at 1 m a scan, with perfect odometry in a frame turned by `heading`."""
    stamps = 1_000_000_000 + np.arange(count) * 500_000_000
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    scans = [RawScan(np.zeros((1, 3), np.float32), poses[i], np.eye(4), None, int(stamps[i]), area)
             for i in range(count)]  # fmt: skip
    times = np.arange(900_000_000, stamps[-1] + 100_000_000, 20_000_000)
    along = (times - stamps[0]) / 500e6
    odometry = np.column_stack(
        [along * np.cos(heading) + 7.0, along * np.sin(heading) - 3.0, np.full(len(times), heading)]
    )
    plan = DrivePlan(name, area, float(count), 2.0, 5, 0, False, 1.2, 0.0)
    return RawDrive(plan, RawScans.of(scans), times, odometry)


def test_a_carried_robot_s_clock_and_wheels_go_on() -> None:
    drives = [made_up("one", 0.3), made_up("other", 2.0, 1)]
    steps = steps_of(Journey((Leg(0, 0.0, 10.0), Leg(1, 5.0))), drives)
    assert [step.leg for step in steps] == [0] * 10 + [1] * 15
    assert [step.row for step in steps] == [*range(10), *range(5, 20)]
    assert [step.travelled_m for step in steps] == [*range(10), *range(15)]
    stamps = np.array([step.stamp_ns for step in steps])
    gaps = np.diff(stamps)
    assert (np.delete(gaps, 9) == 500_000_000).all()
    assert KIDNAPPED_NS <= gaps[9] <= KIDNAPPED_NS + 1_000_000_000
    times = np.concatenate([step.odometry_ns for step in steps])
    assert (np.diff(times) > 0).all()
    assert np.diff(times).max() <= 100_000_000
    track = np.concatenate([step.odometry for step in steps])
    moved = np.hypot(*np.diff(track[:, :2], axis=0).T)
    assert moved.max() < 0.2  # no jump betrays that it was carried
    at = [np.searchsorted(times, stamp) for stamp in stamps]
    way = np.hypot(*np.diff(track[np.minimum(at, len(track) - 1), :2], axis=0).T)
    assert np.allclose(np.delete(way, 9), 1.0, atol=0.05)
    assert way[9] < 1.0
    for step in steps:
        assert step.odometry_ns[-1] <= step.stamp_ns + 20_000_000


def test_every_drive_begins_a_journey_and_robots_are_carried_to_other_towns() -> None:
    drives = [made_up(f"town {i}", 0.1 * i, i) for i in range(4)]
    areas = ("a", "b", "c", "d")
    pose_set = PoseSet("simulated", Path(), RawScans.of([]), areas, areas, (True, True, True, False), ("g",), Path())
    journeys = journeys_of(pose_set, drives)
    assert [journey.legs[0].drive for journey in journeys] == [0, 1, 2, 3]
    assert len(journeys[3].legs) == 1  # off the map
    for journey in journeys[:3]:
        one, other = (leg.drive for leg in journey.legs)
        assert one != other
        assert pose_set.on_map[drives[other].plan.area]


def test_the_long_drive_is_begun_anew_each_hundred_metres() -> None:
    drives = [made_up("long", 0.0, 0, 400), made_up("one", 0.0, 0, 100), made_up("other", 0.0, 0, 100)]
    pose_set = PoseSet("amsterdam", Path(), RawScans.of([]), ("a",), ("a",), (True,), ("g",), Path())
    journeys = journeys_of(pose_set, drives)
    starts = [journey.legs[0] for journey in journeys if journey.legs[0].drive == 0]
    assert [(leg.from_m, leg.to_m) for leg in starts[1:]] == [(100.0, 200.0), (200.0, 300.0), (300.0, 400.0)]
    assert starts[0] == Leg(0)
    steps = steps_of(Journey((starts[2],)), drives)
    assert [step.row for step in steps] == list(range(200, 300))
    assert steps[0].travelled_m == 0.0
    assert all(len(journey.legs) == 2 for journey in journeys if journey.legs[0].drive > 0)
