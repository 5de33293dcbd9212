"""The facade: with an encoder that needs no training, on a map of a few made-up places and in a simulated town."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.aerial_map.store import AerialMap, BuildCounts, Manifest, SubmapTable
from crossloc3d_ros.angles import wrap
from crossloc3d_ros.clouds.scan import prepare_scan
from crossloc3d_ros.config import (
    AlignmentConfig,
    BuildConfig,
    CalibrationConfig,
    LocalizerConfig,
    PreprocessingConfig,
    RetrievalConfig,
)
from crossloc3d_ros.datasets.pose_sets import PoseSet, placed_town
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.datasets.simulated import BenchmarkTown
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.fusion.odometry import Motion
from crossloc3d_ros.localization.localizer import Localizer, SearchSchedule
from crossloc3d_ros.simulation.vlp16 import Vlp16
from crossloc3d_ros.training.queries import query_of
from crossloc3d_ros.types import Estimate, FixStatus, Scan, TrackState

Float32 = npt.NDArray[np.float32]
ORIGIN = np.array([628_500.0, 5_804_000.0, 2.0])
PLACES = 30
BY_PLACE = AlignmentConfig(scope="none")  # the map of these tests has no rasters
STAMP_NS = 1_700_000_000_123_456_789


class HistogramEncoder:
    """A histogram over distance and height: the same from every heading, and different from place to place."""

    fingerprint = "histogram"
    descriptor_size = 64
    preprocessing = PreprocessingConfig()
    calibration = CalibrationConfig(temperature=0.01, null_distance=0.05, null_scale=0.005)

    def encode(self, points: Float32) -> Float32:
        radius = np.hypot(points[:, 0], points[:, 1])
        counts, _, _ = np.histogram2d(radius, points[:, 2], bins=8, range=((0, 1.42), (0, 0.4)))
        return (counts.ravel() / len(points)).astype(np.float32)

    def encode_batch(self, clouds: Sequence[Float32]) -> Float32:
        return np.stack([self.encode(cloud) for cloud in clouds])

    def warm_up(self) -> None:
        pass


def scan_of_place(seed: int, heading_rad: float = 0.0) -> Scan:
    """A level street floor and a few walls; the place is the seed."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-40, 40, (9000, 2)), rng.normal(-1.2, 0.01, 9000)])
    walls = []
    for _ in range(6):
        centre, along, height = rng.uniform(-35, 35, 2), rng.uniform(0, np.pi), rng.uniform(2, 15)
        if np.linalg.norm(centre) < 8:
            centre *= 8 / np.linalg.norm(centre)
        run = rng.uniform(-5, 5, 900)
        walls.append(np.column_stack([centre[0] + run * np.cos(along), centre[1] + run * np.sin(along),
                                      rng.uniform(-1.2, height - 1.2, 900)]))  # fmt: skip
    points = np.vstack([floor, *walls])
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    turned = points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    return Scan(turned.astype(np.float32), STAMP_NS, "velodyne")


def grid_of_place(i: int) -> npt.NDArray[np.float64]:
    return ORIGIN + np.array([120.0 * (i % 6), 120.0 * (i // 6), 0.5 * i])


@pytest.fixture(scope="module")
def aerial_map() -> AerialMap:
    encoder, config = HistogramEncoder(), LocalizerConfig(alignment=BY_PLACE)
    descriptors = []
    for i in range(PLACES):
        patch = prepare_scan(scan_of_place(i), config.scan, encoder.preprocessing).patch
        assert patch is not None
        descriptors.append(encoder.encode(patch.points))
    manifest = Manifest(
        crs="EPSG:32631", origin=tuple(ORIGIN), bounds=(0.0, 0.0, 1.0, 1.0), vertical_reference="unknown",
        geoid_separation_m=None, encoder_fingerprint=encoder.fingerprint, descriptor_size=64,
        preprocessing=encoder.preprocessing, build=BuildConfig(),
        ground="classes", counts=BuildCounts(), sources=(), files=(), created="", software="",
    )  # fmt: skip
    grid = np.array([grid_of_place(i) for i in range(PLACES)])
    submaps = SubmapTable(grid, np.full(PLACES, 4096, np.int32))
    frame = MapFrame("EPSG:32631", ORIGIN)
    return AerialMap(Path(), manifest, frame, submaps, DescriptorMap(np.array(descriptors)))


@pytest.fixture(scope="module")
def localizer(aerial_map: AerialMap) -> Localizer:
    return Localizer(aerial_map, HistogramEncoder(), LocalizerConfig(alignment=BY_PLACE))


@pytest.mark.parametrize("place", [0, 7, 29])
@pytest.mark.parametrize("heading_rad", [0.0, 0.7, 3.0])
def test_a_scan_is_found_where_it_was_taken_from_every_heading(
    localizer: Localizer, place: int, heading_rad: float
) -> None:
    estimate = localizer.localize(scan_of_place(place, heading_rad))
    assert estimate.status is FixStatus.FIX, estimate.reason
    assert estimate.stamp_ns == STAMP_NS
    assert estimate.candidates.submap_ids[0] == place
    assert np.linalg.norm(estimate.grid[:2] - grid_of_place(place)[:2]) < 25.0


def test_grid_enu_and_latitude_longitude_are_the_same_place(localizer: Localizer) -> None:
    estimate = localizer.localize(scan_of_place(11))
    frame = localizer.aerial_map.frame
    np.testing.assert_allclose(frame.to_enu(estimate.grid[None])[0], estimate.enu, atol=1e-3)
    back = frame.from_geographic(np.array([estimate.latitude_deg]), np.array([estimate.longitude_deg]))
    np.testing.assert_allclose(back[0, :2], estimate.grid[:2], atol=1e-3)
    assert np.isnan(estimate.altitude_m), "the map does not know its geoid"


def test_the_same_scan_gives_the_same_estimate(localizer: Localizer) -> None:
    first, second = (localizer.localize(scan_of_place(3)) for _ in range(2))
    np.testing.assert_array_equal(first.candidates.descriptor_distances, second.candidates.descriptor_distances)
    np.testing.assert_array_equal(first.grid, second.grid)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.empty((0, 3)), "empty"),
        (np.full((28_800, 3), np.nan), "0 of 28,800 points left"),
        (np.full((28_800, 3), 1e30), "0 of 28,800 points left"),
        (np.vstack([np.full((28_797, 3), np.nan), np.full((3, 3), 9.0)]), "3 of 28,800 points left after filtering"),
        (np.random.default_rng(0).uniform(2, 9, (12, 3)), "12"),
        (np.column_stack([np.random.default_rng(0).uniform(-30, 30, (9000, 2)), np.full(9000, -1.2)]), "above the gr"),
    ],
    ids=["empty", "all NaN", "1e30 m away", "3 left", "twelve points", "bare ground"],
)
def test_a_scan_without_use_gives_no_fix_and_the_reason(localizer: Localizer, points: Float32, reason: str) -> None:
    estimate = localizer.localize(Scan(points.astype(np.float32), STAMP_NS, "velodyne"))
    assert estimate.status is FixStatus.NO_FIX
    assert reason in estimate.reason
    assert len(estimate.candidates) == 0
    assert np.isnan([*estimate.grid, *estimate.enu, estimate.latitude_deg, estimate.longitude_deg]).all()
    assert estimate.counts.received == len(points)


def test_a_scan_from_nowhere_gives_no_fix(localizer: Localizer) -> None:
    box = np.random.default_rng(5).uniform([-3, -3, -1.2], [3, 3, 1.8], (9000, 3))
    box[:4500, 0] = 3.0
    estimate = localizer.localize(Scan(box.astype(np.float32), STAMP_NS, "velodyne"))
    assert estimate.status is FixStatus.NO_FIX
    assert "no submap resembles the scan" in estimate.reason
    assert len(estimate.candidates) == 25


def test_settings_override_the_calibration_of_the_weights(aerial_map: AerialMap) -> None:
    def localize(credibility: RetrievalConfig) -> Estimate:
        config = LocalizerConfig(top_k=5, retrieval=credibility, alignment=BY_PLACE)
        return Localizer(aerial_map, HistogramEncoder(), config).localize(scan_of_place(4))

    assert localize(RetrievalConfig()).status is FixStatus.FIX
    doubtful = RetrievalConfig(null_distance=1e-6, null_scale=0.01, min_probability=0.9)
    assert localize(doubtful).status is FixStatus.NO_FIX
    assert localize(RetrievalConfig(temperature=1e3)).status is FixStatus.NO_FIX, "all candidates alike"
    assert len(localize(RetrievalConfig()).candidates) == 5


def test_warm_up_leaves_nothing_behind(aerial_map: AerialMap) -> None:
    cold, warm = (Localizer(aerial_map, HistogramEncoder(), LocalizerConfig(alignment=BY_PLACE)) for _ in range(2))
    warm.warm_up()
    np.testing.assert_array_equal(cold.localize(scan_of_place(2)).grid, warm.localize(scan_of_place(2)).grid)


# In a simulated town, with poses.


@pytest.fixture(scope="module")
def town(simulated_town: tuple[PoseSet, Any]) -> tuple[PoseSet, AerialMap, Any]:
    pose_set, encoder = simulated_town
    return pose_set, AerialMap.load(pose_set.map_folder, encoder.fingerprint), encoder


def in_town(town: tuple[PoseSet, AerialMap, Any], **alignment: Any) -> Localizer:
    return Localizer(town[1], town[2], LocalizerConfig(alignment=AlignmentConfig(**alignment)))


def seen(localizer: Localizer, scan: RawScan, stamp_ns: int = STAMP_NS, motion: Motion | None = None) -> Estimate:
    as_scan = dataclasses.replace(scan.as_scan(), stamp_ns=stamp_ns)
    return localizer.localize(as_scan, scan.up_base, scan.T_base_lidar, motion)


def is_right(scan: RawScan, grid: npt.NDArray[np.float64], heading_rad: float) -> bool:
    turned = abs(wrap(heading_rad - scan.heading_rad))
    return bool(np.hypot(*(grid[:2] - scan.T_grid_base[:2, 3])) < 2.0 and turned < np.radians(5.0))


@pytest.mark.parametrize("scope", ["candidates", "map", "auto"])
def test_one_scan_is_enough_for_position_and_heading(town: tuple[PoseSet, AerialMap, Any], scope: Any) -> None:
    localizer = in_town(town, scope=scope)
    right = believed = 0
    scans = [scan for scan in town[0].scans if town[0].on_map[scan.area]]
    for scan in scans:
        localizer.reset()
        estimate = seen(localizer, scan)
        aligned = estimate.aligned
        right += is_right(scan, aligned.grid[0], float(aligned.heading_rad[0]))
        assert aligned.probabilities.sum() <= 1.0 + 1e-9
        assert estimate.timings.align_ms > 0.0
        if scope == "map":
            assert estimate.status is FixStatus.NO_FIX, "one scan alone is no fix"
        if estimate.state is not TrackState.SEARCHING and np.isfinite(estimate.T_map_base).all():
            believed += 1
            turn = float(town[1].frame.convergence_rad(estimate.grid[None])[0])
            heading = np.arctan2(estimate.T_map_base[1, 0], estimate.T_map_base[0, 0]) + turn
            assert is_right(scan, estimate.grid, float(heading))
            assert (np.linalg.eigvalsh(estimate.pose_covariance) > 0.0).all()
    assert right == len(scans)
    assert believed >= 3


def test_a_scan_of_too_few_points_for_a_descriptor_is_aligned(town: tuple[PoseSet, AerialMap, Any]) -> None:
    localizer, by_retrieval = in_town(town, scope="map"), in_town(town, scope="none")
    fewest = localizer.encoder.preprocessing.min_points
    right = few = 0
    for scan in town[0].scans:
        sparse = dataclasses.replace(scan, points=scan.points[::40])
        if not town[0].on_map[scan.area] or not 0 < seen(by_retrieval, sparse).counts.in_patch < fewest:
            continue
        assert "are needed" in seen(by_retrieval, sparse).reason
        localizer.reset()
        estimate = seen(localizer, sparse)
        few += 1
        assert len(estimate.candidates) == 0 and len(estimate.aligned) > 0
        right += is_right(sparse, estimate.aligned.grid[0], float(estimate.aligned.heading_rad[0]))
        hopeless = dataclasses.replace(scan, points=scan.points[::4000])
        assert "points left after filtering" in seen(localizer, hopeless).reason, "nothing that could be aligned"
    assert few >= 3
    assert right > few / 2


@pytest.mark.parametrize("scope", ["candidates", "auto"])
def test_a_robot_outside_of_the_map_gets_no_fix(town: tuple[PoseSet, AerialMap, Any], scope: Any) -> None:
    localizer = in_town(town, scope=scope)
    motion = Motion(np.array([6.0, 0.0, 0.0]), np.diag([0.1, 0.1, 0.01]))
    outside = [scan for scan in town[0].scans if not town[0].on_map[scan.area]]
    for i, scan in enumerate(outside * 2):
        estimate = seen(localizer, scan, STAMP_NS + i * 3_000_000_000, motion)
        assert estimate.status is FixStatus.NO_FIX
        assert estimate.probability < 0.9
        assert estimate.reason


def drive(pose_set: PoseSet, start: RawScan, metres: Sequence[float]) -> list[RawScan]:
    """Scan the town of the set again, so many metres ahead of where a scan was taken."""
    town = BenchmarkTown("estate", 990_112, False)
    world, _ = placed_town(town, 1 - town.seed % 2, 300.0, (0.0, 0.0))
    rng, scans = np.random.default_rng(1), []
    for ahead in metres:
        T_grid_base = start.T_grid_base.copy()
        T_grid_base[:3, 3] += ahead * start.T_grid_base[:3, 0]
        local = T_grid_base.copy()
        local[:3, 3] -= world.origin_grid
        points = Vlp16().scan(world.scene, local @ start.T_base_lidar, rng).points
        scans.append(dataclasses.replace(start, points=points, T_grid_base=T_grid_base))
    return scans


def test_a_drive_leads_to_a_fix_and_being_carried_away_ends_it(town: tuple[PoseSet, AerialMap, Any]) -> None:
    pose_set = town[0]
    localizer = in_town(town, scope="auto")
    ahead = Motion(np.array([2.0, 0.0, 0.0]), np.diag([0.05, 0.05, 0.01]) ** 2)
    states, stamp_ns = [], STAMP_NS
    for scan in drive(pose_set, pose_set.scans[4], np.arange(-12.0, 6.0, 2.0)):
        estimate = seen(localizer, scan, stamp_ns, ahead if localizer.stamp_ns is not None else None)
        stamp_ns += 1_000_000_000
        states.append(estimate.status)
        if estimate.status is FixStatus.FIX:
            error = (estimate.grid - scan.T_grid_base[:3, 3])[:2]
            assert np.hypot(*error) < 1.0
            assert error @ np.linalg.inv(estimate.covariance[:2, :2]) @ error < 16.0
            assert estimate.state is TrackState.LOCALIZED
    assert states[0] is FixStatus.NO_FIX, "one scan is no drive"
    assert states[-1] is FixStatus.FIX
    outside = [scan for scan in pose_set.scans if not pose_set.on_map[scan.area]]
    for scan in outside * 3:
        estimate = seen(localizer, scan, stamp_ns, Motion(np.array([4.0, 0.0, 0.0]), ahead.covariance))
        stamp_ns += 1_000_000_000
    assert estimate.status is FixStatus.NO_FIX
    assert estimate.probability < 0.9
    assert estimate.reason


def test_the_scans_of_the_last_metres_are_aligned_together(town: tuple[PoseSet, AerialMap, Any]) -> None:
    """Each of them alone holds too little evidence."""
    pose_set = town[0]
    scans = drive(pose_set, pose_set.scans[4], np.arange(-12.0, 6.0, 2.0))
    cells = max(len(query_of(scan).channel) for scan in scans)
    ahead = Motion(np.array([2.0, 0.0, 0.0]), np.diag([0.05, 0.05, 0.01]) ** 2)
    found = {}
    for length_m in (0.0, 30.0):
        localizer = in_town(town, scope="map", min_cells=cells + 1, local_map_m=length_m)
        estimates = [
            seen(localizer, scan, STAMP_NS + i * 4_000_000_000, ahead if i else None) for i, scan in enumerate(scans)
        ]
        found[length_m] = [len(estimate.aligned) for estimate in estimates]
    assert not any(found[0.0])
    assert not any(found[30.0][:1]) and all(found[30.0][2:])
    away = np.hypot(*(estimates[-1].aligned.grid[0] - scans[-1].T_grid_base[:3, 3])[:2])
    assert away < 1.0, "from the newest scan's own evidence"


def upside_down(scan: RawScan) -> RawScan:
    """Return what a sensor that hangs from its mast sends while everyone believes that it stands."""
    return dataclasses.replace(scan, points=scan.points * np.float32([1.0, -1.0, -1.0]), up_base=None)


def test_a_scan_upside_down_is_no_pose(town: tuple[PoseSet, AerialMap, Any]) -> None:
    localizer = in_town(town, scope="auto")
    for i, scan in enumerate(town[0].scans[:4]):
        estimate = seen(localizer, upside_down(scan), STAMP_NS + i * 1_000_000_000)
        assert estimate.status is FixStatus.NO_FIX
        assert estimate.reason
        assert estimate.aligned.probabilities.sum() < 0.5


def test_an_empty_scan_leaves_everything_as_it_was(town: tuple[PoseSet, AerialMap, Any]) -> None:
    empty = Scan(np.empty((0, 3), np.float32), STAMP_NS + 50_000_000, "velodyne")
    plain, disturbed = (in_town(town, scope="candidates") for _ in range(2))
    motion = Motion(np.zeros(3), np.diag([0.01, 0.01, 0.001]))
    for localizer in (plain, disturbed):
        seen(localizer, town[0].scans[0])
    estimate = disturbed.localize(empty)
    assert (estimate.status, estimate.reason) == (FixStatus.NO_FIX, "the scan is empty")
    assert disturbed.stamp_ns == STAMP_NS
    one, other = (seen(localizer, town[0].scans[0], STAMP_NS + 10**8, motion) for localizer in (plain, disturbed))
    np.testing.assert_array_equal(one.grid, other.grid)
    assert one.probability == other.probability


def test_reset_forgets_everything(town: tuple[PoseSet, AerialMap, Any]) -> None:
    fresh, used = (in_town(town, scope="auto") for _ in range(2))
    first, second = town[0].scans[0], town[0].scans[1]
    seen(used, first)
    assert used.stamp_ns == STAMP_NS
    used.reset()
    assert used.stamp_ns is None
    earlier = STAMP_NS - 10**12  # as when a bag is played again
    one, other = (seen(localizer, second, earlier) for localizer in (fresh, used))
    np.testing.assert_array_equal(one.aligned.grid, other.aligned.grid)
    np.testing.assert_array_equal(one.grid, other.grid)
    assert one.probability == other.probability
    assert len(one.hypotheses) == len(other.hypotheses)


def test_switched_off_there_are_places_but_no_poses(town: tuple[PoseSet, AerialMap, Any]) -> None:
    estimate = seen(in_town(town, scope="none"), town[0].scans[0])
    assert len(estimate.aligned) == len(estimate.hypotheses) == 0
    assert len(estimate.candidates) == 25
    assert np.isfinite(estimate.grid).all()
    assert estimate.timings.align_ms == 0.0


def test_one_thread_stays_one_also_with_other_settings(
    town: tuple[PoseSet, AerialMap, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a thread is started")

    config = LocalizerConfig(alignment=AlignmentConfig(scope="none"))
    localizer = Localizer(town[1], town[2], config, threads=1)
    localizer.reconfigure(LocalizerConfig(alignment=AlignmentConfig(scope="auto")))
    monkeypatch.setattr("crossloc3d_ros.localization.alignment.thread_pool.ThreadPoolExecutor", refuse)
    assert len(seen(localizer, town[0].scans[0]).aligned)


def test_a_pose_is_that_at_the_stamp_not_in_the_middle_of_the_turn(town: tuple[PoseSet, AerialMap, Any]) -> None:
    scan, later_ns = town[0].scans[0], STAMP_NS + 500_000_000
    motion = Motion(np.array([1.0, 0.2, 0.1]), np.diag([0.1, 0.1, 0.01]))
    still = Motion(np.zeros(3), motion.covariance)
    found = []
    for given in (still, motion):
        localizer = in_town(town, scope="candidates")
        seen(localizer, scan)
        aligned = seen(localizer, scan, later_ns, given).aligned
        row = int(np.flatnonzero(aligned.source >= 0)[0])
        found.append((*aligned.grid[row, :2], aligned.heading_rad[row]))
    step = np.array(found[1]) - np.array(found[0])
    heading = found[0][2]
    c, s = np.cos(heading), np.sin(heading)
    # A tenth of a second a turn, stamped at its end: half of it is a tenth of the way since the last scan.
    np.testing.assert_allclose(
        [c * step[0] + s * step[1], -s * step[0] + c * step[1], step[2]], motion.delta / 10, atol=1e-6
    )


def test_looks_are_due_at_once_then_now_and_then() -> None:
    looks, second = SearchSchedule(AlignmentConfig()), 1_000_000_000
    assert looks.candidates_due(0) and looks.map_due(0)
    assert [looks.candidates_due(t * second // 10) for t in range(1, 7)] == [False, False, False, False, True, False]
    assert not looks.map_due(second // 10)
    looks.state = TrackState.LOCALIZED
    assert [looks.candidates_due(6 * second // 10 + t * second // 4) for t in range(1, 6)] == [
        False,
        False,
        False,
        True,
        False,
    ]
    assert not looks.map_due(3 * second - 1)
    assert looks.map_due(3 * second)
    assert looks.map_due(second), "time went backwards"
    looks.state = TrackState.LOST
    assert looks.candidates_due(3 * second)
    assert not looks.candidates_due(3 * second + second // 5)
    looks.reset()
    assert looks.state is TrackState.SEARCHING
    assert looks.candidates_due(0) and looks.map_due(0)


def test_other_settings_keep_the_hypotheses_and_what_was_read_of_the_map(
    town: tuple[PoseSet, AerialMap, Any],
) -> None:
    localizer = in_town(town, scope="candidates")
    scan = next(scan for scan in town[0].scans if town[0].on_map[scan.area])
    before = seen(localizer, scan)
    likelihood = localizer._aligner.likelihood  # type: ignore[union-attr]
    config = LocalizerConfig(alignment=AlignmentConfig(scope="candidates", candidates=50), top_k=7)
    localizer.reconfigure(config)
    assert localizer._aligner.likelihood is likelihood  # type: ignore[union-attr]
    again = seen(localizer, scan)
    assert "same stamp" in again.reason, "what is known is kept, so that a scan that comes twice is one"
    assert len(again.candidates) == 7
    np.testing.assert_array_equal(again.grid, before.grid)
    localizer.reconfigure(LocalizerConfig(alignment=AlignmentConfig(scope="none")))
    assert localizer._aligner is None
