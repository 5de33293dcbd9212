"""Estimates: the same pose in every frame, no number where nothing is known, no fix on less than a pose."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.localization.estimates import (
    HEIGHT_STD_M,
    TILT_STD_RAD,
    Watch,
    no_estimate,
    placed_estimate,
    posed_estimate,
)
from crossloc3d_ros.localization.fusion.decision import Belief
from crossloc3d_ros.localization.retrieval.place_belief import PlaceBelief
from crossloc3d_ros.types import (
    Estimate,
    FixStatus,
    Float64Array,
    ScanCounts,
    TrackState,
    no_aligned_poses,
    no_candidates,
    no_hypotheses,
)

ORIGIN = np.array(
    [500_000.0 + 130_000.0, 5_803_000.0, 31.0]
)  # 1.9 degrees off the zone's middle: grid and true north differ
FRAME = MapFrame("EPSG:32631", ORIGIN, 43.0)
PLACE = PlaceBelief(
    status=FixStatus.FIX, reason="a place", probability=0.5, enu=np.array([300.0, -200.0, 4.0]),
    covariance=np.diag([400.0, 400.0, 9.0]), members=np.ones(1, np.bool_),
)  # fmt: skip


def belief(grid: list[float], heading: float = 0.6, is_fix: bool = True) -> Belief:
    A = np.random.default_rng(0).normal(size=(3, 3))
    return Belief(
        state=TrackState.LOCALIZED, reason="", probability=0.9995, grid=np.array(grid), heading_rad=heading,
        covariance=A @ A.T, hypotheses=no_hypotheses(), is_fix=is_fix,
    )  # fmt: skip


def posed(about: Belief, gravity: Float64Array | None = None) -> Estimate:
    return posed_estimate(
        7, FRAME, PLACE, no_candidates(), no_aligned_poses(), about, gravity, ScanCounts(received=3), Watch()
    )


def test_the_heading_is_rotated_from_the_grid_s_north_to_the_true_one() -> None:
    about = belief([ORIGIN[0] + 900.0, ORIGIN[1] + 1500.0, 36.0])
    found = posed(about)
    ahead = about.grid + 10.0 * np.array([math.cos(about.heading_rad), math.sin(about.heading_rad), 0.0])
    step = FRAME.to_enu(ahead[None])[0] - FRAME.to_enu(about.grid[None])[0]
    assert abs(math.degrees(math.atan2(step[1], step[0]) - about.heading_rad)) > 1.0, "or nothing is tested"
    np.testing.assert_allclose(found.T_map_base[:2, 0], step[:2] / np.linalg.norm(step[:2]), atol=2e-4)
    np.testing.assert_allclose(found.T_map_base[:3, :3] @ found.T_map_base[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.T_map_base[:3, 3], found.enu)
    np.testing.assert_allclose(FRAME.to_enu(found.grid[None])[0], found.enu, atol=1e-6)
    back = FRAME.from_geographic(np.array([found.latitude_deg]), np.array([found.longitude_deg]))
    np.testing.assert_allclose(back[0, :2], about.grid[:2], atol=1e-3)
    assert found.status is FixStatus.FIX
    assert found.stamp_ns == 7
    assert found.probability == 0.9995


def test_the_covariance_rotates_with_the_frame() -> None:
    about = belief([ORIGIN[0] + 900.0, ORIGIN[1] + 1500.0, 36.0])
    found = posed(about)
    rows = [0, 1, 5]
    rotated = found.pose_covariance[np.ix_(rows, rows)]
    np.testing.assert_allclose(np.linalg.eigvalsh(rotated), np.linalg.eigvalsh(about.covariance), rtol=1e-9)
    # The standard deviation along the robot's axis is the same in grid and map.
    along_grid = np.array([math.cos(about.heading_rad), math.sin(about.heading_rad)])
    along_map = found.T_map_base[:2, 0]
    assert along_map @ rotated[:2, :2] @ along_map == pytest.approx(along_grid @ about.covariance[:2, :2] @ along_grid)
    assert rotated[2, 2] == pytest.approx(about.covariance[2, 2])
    assert np.diag(found.pose_covariance)[[2, 3, 4]].tolist() == [HEIGHT_STD_M**2, TILT_STD_RAD**2, TILT_STD_RAD**2]
    np.testing.assert_array_equal(found.covariance, found.pose_covariance[:3, :3])
    assert (np.linalg.eigvalsh(found.pose_covariance) > 0.0).all()


@pytest.mark.parametrize("heading", [0.0, 2.0, -1.3])
def test_the_base_leans_as_measured_by_gravity(heading: float) -> None:
    true = Rotation.from_euler("ZYX", [heading, 0.08, -0.05]).as_matrix()
    gravity = true.T @ np.array([0.0, 0.0, 9.81])
    found = posed(belief([*ORIGIN], heading), gravity)
    np.testing.assert_allclose(found.T_map_base[2, :3], true[2], atol=1e-9)
    upright = posed(belief([*ORIGIN], heading)).T_map_base
    np.testing.assert_allclose(upright[2], [0.0, 0.0, 1.0, upright[2, 3]], atol=1e-12)
    assert upright[:2, 0] @ found.T_map_base[:2, 0] > 0.99


def test_where_the_terrain_is_not_known_the_candidates_height_is_taken() -> None:
    known = posed(belief([ORIGIN[0] + 300.0, ORIGIN[1] - 200.0, 36.0]))
    found = posed(belief([ORIGIN[0] + 300.0, ORIGIN[1] - 200.0, math.nan]))
    assert np.isfinite([*found.grid, *found.enu, found.altitude_m]).all()
    np.testing.assert_allclose(found.grid[:2], known.grid[:2])
    assert found.enu[2] == pytest.approx(PLACE.enu[2], abs=0.05)
    assert found.grid[2] == pytest.approx(FRAME.from_enu(PLACE.enu[None])[0, 2], abs=0.05)


def test_without_a_pose_there_is_a_place_but_no_fix() -> None:
    about = dataclasses.replace(
        belief([math.nan] * 3, math.nan, False), state=TrackState.LOST, reason="it fits nowhere", probability=0.0
    )
    found = posed(about)
    assert found.status is FixStatus.NO_FIX
    assert found.state is TrackState.LOST
    assert found.reason == "it fits nowhere"
    np.testing.assert_allclose(found.enu, PLACE.enu)
    np.testing.assert_allclose(found.covariance, PLACE.covariance)


def test_a_pose_that_is_not_sure_is_no_fix() -> None:
    assert posed(belief([*ORIGIN], is_fix=False)).status is FixStatus.NO_FIX


def test_a_place_alone_has_a_state_but_no_heading() -> None:
    for status, state in ((FixStatus.FIX, TrackState.LOCALIZED), (FixStatus.NO_FIX, TrackState.SEARCHING)):
        place = dataclasses.replace(PLACE, status=status)
        found = placed_estimate(9, FRAME, place, no_candidates(), ScanCounts(), Watch())
        assert (found.status, found.state, found.stamp_ns) == (status, state, 9)
        np.testing.assert_allclose(FRAME.to_enu(found.grid[None])[0], PLACE.enu, atol=1e-6)
        assert len(found.aligned) == len(found.hypotheses) == 0


def test_no_estimate_holds_no_number() -> None:
    found = no_estimate(5, "the scan is empty", ScanCounts(received=0))
    numbers = [
        *found.grid,
        *found.enu,
        *found.covariance.ravel(),
        found.latitude_deg,
        found.longitude_deg,
        found.altitude_m,
    ]
    assert np.isnan(numbers).all()
    assert (found.status, found.reason, found.stamp_ns) == (FixStatus.NO_FIX, "the scan is empty", 5)
    assert len(found.candidates) == len(found.aligned) == len(found.hypotheses) == 0


def test_the_watch_records_each_lap_once(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([1.0, 1.5, 1.75])
    monkeypatch.setattr("crossloc3d_ros.stopwatch.time.perf_counter", lambda: next(times))
    watch = Watch()
    watch.lap("prepare_ms")
    watch.lap("align_ms")
    assert (watch.timings.prepare_ms, watch.timings.align_ms) == (500.0, 250.0)
