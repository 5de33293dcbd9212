"""From a scan to poses: unbiased, never more belief than there is, whatever the map and the candidates lack."""

from __future__ import annotations

import dataclasses
import gc
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.angles import wrap
from crossloc3d_ros.clouds.scan import PreparedScan
from crossloc3d_ros.config import AlignmentConfig
from crossloc3d_ros.localization.alignment import aligner as alignment
from crossloc3d_ros.localization.alignment.aligner import Aligner
from crossloc3d_ros.types import (
    WHOLE_MAP,
    AlignedPoses,
    Candidates,
    Hypotheses,
    ScanCounts,
    no_candidates,
    no_hypotheses,
)

WEST, SOUTH = 628_000.0, 5_803_000.0
BASE = (0.0, 0.0)


def around(*places: tuple[float, float], probabilities: npt.ArrayLike | None = None) -> Candidates:
    """Return candidates at places, metres from the map's south-west corner."""
    count = len(places)
    grid = np.column_stack([np.array(places, float) + np.array([WEST, SOUTH]), np.full(count, 5.0)])
    shares = np.full(count, 1.0 / count) if probabilities is None else np.asarray(probabilities, float)
    return Candidates(np.arange(count), np.linspace(0.1, 0.2, count, dtype=np.float32), shares, grid)


def hypotheses(*poses: tuple[float, float, float]) -> Hypotheses:
    values = np.array(poses, float)
    grid = np.column_stack([values[:, :2] + np.array([WEST, SOUTH]), np.full(len(poses), 5.0)])
    return Hypotheses(grid, values[:, 2], np.tile(np.eye(3), (len(poses), 1, 1)), np.full(len(poses), 0.5 / len(poses)))


def errors(found: AlignedPoses, x: float, y: float, heading: float) -> tuple[npt.NDArray[np.float64], float]:
    return found.grid[0, :2] - [WEST + x, SOUTH + y], wrap(float(found.heading_rad[0]) - heading)


def check(found: AlignedPoses) -> None:
    """Hold what must be true of all aligned poses."""
    count = len(found)
    assert found.grid.shape == (count, 3) and found.covariance.shape == (count, 3, 3)
    for column in (found.heading_rad, found.probabilities, found.inliers, found.converged, found.source):
        assert column.shape == (count,)
    assert (found.probabilities >= 0.0).all() and found.probabilities.sum() <= 1.0 + 1e-9
    assert (np.diff(found.log_likelihood) <= 1e-9).all(), "best first"
    assert np.isfinite(found.log_likelihood).all()
    assert ((found.inliers >= 0.0) & (found.inliers <= 1.0)).all()
    assert np.isfinite(found.covariance).all()
    np.testing.assert_allclose(found.covariance, found.covariance.transpose(0, 2, 1), atol=1e-12)
    assert (np.linalg.eigvalsh(found.covariance) > 0.0).all()
    counted = np.where(found.probabilities > 0.0, found.log_likelihood + found.log_prior, -np.inf)
    shares = np.exp(counted - np.logaddexp(0.0, np.logaddexp.reduce(counted))) if count else np.empty(0)
    np.testing.assert_allclose(found.probabilities, shares, atol=1e-9)


@pytest.fixture(scope="module")
def aligner(box_map: AerialMap) -> Aligner:
    return Aligner(box_map, AlignmentConfig())


@pytest.fixture(scope="module")
def place(box_town: Any) -> tuple[float, float, float]:
    return (*box_town.street(np.random.default_rng(31)), 0.7)


@pytest.fixture(scope="module")
def scan(box_town: Any, place: tuple[float, float, float]) -> PreparedScan:
    found: PreparedScan = box_town.scan(*place)
    return found


def test_poses_are_found_without_bias_in_every_heading(aligner: Aligner, box_town: Any) -> None:
    rng, rows, converged = np.random.default_rng(0), [], 0
    for i in range(64):
        (x, y), heading = box_town.street(rng), wrap(2 * math.pi * (i + rng.uniform(0, 1)) / 64)
        near = around((x + rng.uniform(-9, 9), y + rng.uniform(-9, 9)))
        found = aligner.align(box_town.scan(x, y, heading, rng), BASE, near)
        check(found)
        (east, north), turned = errors(found, x, y, heading)
        assert math.hypot(east, north) < 1.3, f"{east:.2f}, {north:.2f} m off at {heading:.2f} rad"
        assert abs(turned) < math.radians(1.0)
        assert found.probabilities[0] > 0.9
        converged += found.converged[0]
        c, s = math.cos(heading), math.sin(heading)
        rows.append((east, north, c * east + s * north, -s * east + c * north, 10.0 * turned))
    np.testing.assert_allclose(np.mean(rows, axis=0), 0.0, atol=0.1)
    assert converged >= 52


def test_the_pose_is_that_of_the_base_wherever_the_sensor_is_on_it(aligner: Aligner, box_town: Any) -> None:
    rng = np.random.default_rng(3)
    x, y = box_town.street(rng)
    for heading in (0.4, 2.9):
        c, s = math.cos(heading), math.sin(heading)
        base = x - (1.7 * c - 0.6 * s), y - (1.7 * s + 0.6 * c)
        found = aligner.align(box_town.scan(x, y, heading, rng), (1.7, 0.6), around(base))
        assert np.hypot(*errors(found, *base, heading)[0]) < 0.7


def test_the_whole_map_is_searched_with_the_same_result(aligner: Aligner, scan: PreparedScan, place: Any) -> None:
    near = aligner.align(scan, BASE, around(place[:2]))
    everywhere = aligner.align(scan, BASE, no_candidates(), search_map=True)
    check(everywhere)
    assert (everywhere.source == WHOLE_MAP).all()
    np.testing.assert_allclose(everywhere.grid[0], near.grid[0], atol=0.3)


@pytest.fixture
def no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a thread is started")

    monkeypatch.setattr(threading.Thread, "start", refuse)


def aligned_by(threads: int, box_map: AerialMap, scan: PreparedScan, place: Any) -> AlignedPoses:
    aligner = Aligner(box_map, AlignmentConfig(), threads=threads)
    found = aligner.align(scan, BASE, around(place[:2], (40.0, 40.0)), hypotheses(place), search_map=True)
    assert (aligner.pool._executor is not None) == (threads > 1)
    aligner.close()
    return found


@pytest.mark.usefixtures("no_threads")
def test_with_one_thread_no_other_is_started(box_map: AerialMap, scan: PreparedScan, place: Any) -> None:
    assert len(aligned_by(1, box_map, scan, place))
    with pytest.raises(AssertionError, match="a thread is started"):
        aligned_by(2, box_map, scan, place)


def test_threads_change_no_bit(box_map: AerialMap, scan: PreparedScan, place: Any) -> None:
    one = aligned_by(1, box_map, scan, place)
    for threads in (2, 5):
        other = aligned_by(threads, box_map, scan, place)
        for field in dataclasses.fields(AlignedPoses):
            np.testing.assert_array_equal(getattr(other, field.name), getattr(one, field.name), strict=True)


def test_an_aligner_keeps_its_threads_and_ends_them(box_map: AerialMap, scan: PreparedScan, place: Any) -> None:
    before = set(threading.enumerate())
    aligner = Aligner(box_map, AlignmentConfig(), threads=3)
    assert set(threading.enumerate()) <= before, "none before the first scan"
    for _ in range(3):
        aligner.align(scan, BASE, around(place[:2]))
    assert 0 < len(set(threading.enumerate()) - before) <= 3
    aligner.close()
    assert set(threading.enumerate()) <= before
    aligner.align(scan, BASE, around(place[:2]))
    started = set(threading.enumerate()) - before
    assert started
    del aligner
    gc.collect()
    for thread in started:
        thread.join(10.0)
        assert not thread.is_alive(), "they end with their aligner"


def test_every_hypothesis_gets_a_pose_of_its_own(aligner: Aligner, scan: PreparedScan, place: Any) -> None:
    x, y, heading = place
    given = hypotheses(
        (x + 2.0, y - 1.0, heading + 0.05), (40.0, 40.0, 2.0), (x, y + 1.0, heading), (-900.0, 50.0, 0.0)
    )
    for sought in (around((x, y)), no_candidates()):
        found = aligner.align(scan, BASE, sought, given, search_candidates=len(sought) > 0)
        check(found)
        rows = {int(source): row for row, source in enumerate(found.source) if source < 0}
        assert sorted(rows) == [-4, -3, -2, -1]
        for h, row in ((0, rows[-1]), (2, rows[-3])):
            assert np.hypot(*(found.grid[row, :2] - [WEST + x, SOUTH + y])) < 1.0, h
            assert found.converged[row]
        assert np.hypot(*(found.grid[rows[-2], :2] - [WEST + 40.0, SOUTH + 40.0])) < 17.0, (
            "climbed around its prediction"
        )
        assert found.probabilities[rows[-4]] < 1e-3, "off the map"
        here = np.hypot(*(found.grid[:, :2] - [WEST + x, SOUTH + y]).T) < 2.0
        assert np.count_nonzero(found.probabilities[here]) == 1, "one pose counts once"
        assert (found.source >= 0).any() == (len(sought) > 0)


def test_sources_name_the_nearest_candidate(aligner: Aligner, scan: PreparedScan, place: Any) -> None:
    x, y, _ = place
    found = aligner.align(scan, BASE, around((x + 120.0, y), (x - 7.0, y + 3.0), (x, y + 130.0)))
    check(found)
    assert found.source[0] == 1
    for (easting, northing), source in zip(found.grid[:, :2] - [WEST, SOUTH], found.source, strict=True):
        away = [math.hypot(easting - a, northing - b) for a, b in ((x + 120, y), (x - 7, y + 3), (x, y + 130))]
        assert source == int(np.argmin(away))


def test_places_that_are_none_do_no_harm(aligner: Aligner, scan: PreparedScan, place: Any) -> None:
    x, y, heading = place
    nan, inf = math.nan, math.inf
    plain = aligner.align(scan, BASE, around((x, y), probabilities=[0.5]))
    bad = around((nan, nan), (inf, y), (1e9, -1e9), (-5000.0, y), (x, y), probabilities=[0.1, 0.1, 0.1, 0.1, 0.5])
    given = hypotheses((nan, nan, 0.0), (x, y, nan), (inf, y, 0.0), (1e12, 1e12, 1.0), (x, y, heading))
    with np.errstate(invalid="ignore"):
        found = aligner.align(scan, BASE, bad, given)
    check(found)
    own = found.source >= 0
    np.testing.assert_array_equal(found.grid[own], plain.grid)
    np.testing.assert_allclose(found.log_likelihood[own], plain.log_likelihood)
    assert (found.source[own] == 4).all()
    usable = np.isfinite(found.grid).all(axis=1) & np.isfinite(found.heading_rad)
    assert found.probabilities[~usable].sum() < 1e-3
    nowhere = aligner.align(scan, BASE, around((nan, nan), (1e7, 1e7)))
    assert len(nowhere) == 0


def test_without_anywhere_to_search_nothing_is_found(aligner: Aligner, scan: PreparedScan, place: Any) -> None:
    for found in (
        aligner.align(scan, BASE, no_candidates()),
        aligner.align(scan, BASE, around(place[:2]), search_candidates=False),
        aligner.align(scan, BASE, no_candidates(), no_hypotheses()),
    ):
        assert len(found) == 0
        check(found)


@pytest.mark.parametrize("points", [0, 1, 5])
def test_a_scan_that_saw_little_says_nothing(aligner: Aligner, scan: PreparedScan, place: Any, points: int) -> None:
    few = scan.place[np.argsort(scan.place[:, 0] ** 2 + scan.place[:, 1] ** 2)][:points]
    little = PreparedScan(None, ScanCounts(), "", few, few[:, 2].copy(), scan.sensor_height_m)
    given = hypotheses(place)
    assert len(aligner.align(little, BASE, around(place[:2]), given, search_map=True)) == 0


def test_a_scan_of_free_space_alone_is_aligned_without_certainty(aligner: Aligner, place: Any) -> None:
    """A wide empty square: there are beams, but they met nothing."""
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = np.column_stack([70.0 * np.cos(angle), 70.0 * np.sin(angle), np.full(720, 0.1)]).astype(np.float32)
    square = PreparedScan(None, ScanCounts(), "", ring, ring[:, 2].copy(), 1.3)
    found = aligner.align(square, BASE, around(place[:2]), search_map=True)
    check(found)
    assert found.probabilities.sum() < 0.5


def test_maps_that_lack_terrain_or_half_are_not_believed_where_nothing_is_known(
    box_map: AerialMap, box_town: Any, map_of: Callable[..., AerialMap], tmp_path: Path, scan: PreparedScan, place: Any
) -> None:
    terrain, surface = box_map.terrain().values, box_map.surface().values
    nothing = np.full_like(terrain, np.nan)
    for name, rasters in (("terrain", (nothing, surface)), ("surface", (terrain, nothing))):
        blind = Aligner(map_of(tmp_path / name, *rasters), AlignmentConfig())
        found = blind.align(scan, BASE, around(place[:2]), hypotheses(place), search_map=True)
        check(found)
        assert found.probabilities.sum() < 0.2, f"without {name}"
    half = surface.copy()
    half[:, 140:] = np.nan
    aligner = Aligner(map_of(tmp_path / "half", terrain, half), AlignmentConfig())
    rng = np.random.default_rng(2)
    for side in (-1, 1):
        while True:
            x, y = box_town.street(rng, border_m=40.0)
            if side * (x - 140.0) > 30.0:
                break
        found = aligner.align(box_town.scan(x, y, 1.0, rng), BASE, around((x, y)), search_map=True)
        check(found)
        right = np.hypot(*(found.grid[:, :2] - [WEST + x, SOUTH + y]).T) < 2.0
        if side < 0:
            assert right[0], "the known half is enough where the robot is in it"
        assert found.probabilities[~right].sum() < 0.5


def test_a_scan_from_another_town_is_believed_nowhere(aligner: Aligner, box_town: Any) -> None:
    mirrored = box_town.boxes.copy()
    mirrored[:, 0], mirrored[:, 4] = 280.0 - mirrored[:, 0], -mirrored[:, 4]
    other = type(box_town)(mirrored)
    rng = np.random.default_rng(4)
    for _ in range(3):
        x, y = other.street(rng)
        found = aligner.align(other.scan(x, y, rng.uniform(-3, 3), rng), BASE, no_candidates(), search_map=True)
        check(found)
        assert found.probabilities.sum() < 0.5


def test_along_a_straight_wall_less_is_known_than_across_it(
    box_town: Any, map_of: Callable[..., AerialMap], tmp_path: Path
) -> None:
    for angle in (0.0, math.pi / 2):
        c, s = abs(math.cos(angle)), abs(math.sin(angle))
        walls = [[140.0 - s * off, 140.0 + c * off, 130.0, 5.0, angle, 9.0] for off in (-14.0, 14.0)]
        canyon = type(box_town)(np.array(walls))
        surface = canyon.surface()
        aerial_map = map_of(tmp_path / f"{angle:.1f}", np.full_like(surface, 5.0), surface)
        aligner = Aligner(aerial_map, AlignmentConfig())
        found = aligner.align(
            canyon.scan(140.0, 140.0, angle + 0.2), BASE, no_candidates(), hypotheses((140, 140, angle + 0.2))
        )
        check(found)
        along, across = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
        covariance = found.covariance[0]
        assert along @ covariance @ along > 4.0 * (across @ covariance @ across)
        assert math.sqrt(across @ covariance @ across) < 0.5
        assert abs(across[:2] @ (found.grid[0, :2] - [WEST + 140.0, SOUTH + 140.0])) < 0.5


def test_the_descriptors_count(aligner: Aligner, scan: PreparedScan, place: Any) -> None:
    x, y, _ = place
    places = ((x, y), (x + 110.0, y))
    for_it, against_it = (
        aligner.align(scan, BASE, around(*places, probabilities=shares)) for shares in ([0.9, 0.1], [0.1, 0.9])
    )
    np.testing.assert_array_equal(for_it.grid[0], against_it.grid[0])
    assert for_it.log_likelihood[0] > against_it.log_likelihood[0] + 0.5
    deaf = Aligner(aligner.aerial_map, AlignmentConfig(descriptor_weight=0.0))
    one, other = (deaf.align(scan, BASE, around(*places, probabilities=shares)) for shares in ([0.9, 0.1], [0.1, 0.9]))
    np.testing.assert_array_equal(one.log_likelihood, other.log_likelihood)


def test_the_prior_is_the_share_of_a_place_in_the_map(box_map: AerialMap) -> None:
    assert Aligner(box_map, AlignmentConfig(place_m2=100.0)).log_prior == pytest.approx(-math.log(280**2 / 100))
    assert Aligner(box_map, AlignmentConfig(place_m2=1e6)).log_prior == 0.0


@pytest.mark.parametrize(
    ("search", "limit_km2", "everywhere"),
    [("auto", 1.0, True), ("auto", 0.05, False), ("candidates", 1.0, False), ("map", 0.0, True)],
)
def test_small_maps_are_searched_as_a_whole_if_wanted(
    box_map: AerialMap, search: Any, limit_km2: float, everywhere: bool
) -> None:
    aligner = Aligner(box_map, AlignmentConfig(scope=search, map_max_km2=limit_km2))
    assert aligner.searches_map is everywhere
    aligner.warm_up()
    assert bool(aligner.likelihood._filled.all()) is everywhere


def test_headings_are_wrapped_with_west_at_pi() -> None:
    headings = alignment._headings(np.array([0.0, -0.0, math.pi, -math.pi, 7.0]))
    np.testing.assert_allclose(headings, [0.0, 0.0, math.pi, math.pi, 7.0 - 2 * math.pi])
    assert headings[2] == headings[3] == math.pi
    assert not np.signbit(headings[:2]).any()
