"""Height maps: against the definition, in every heading, beside the centre, for scans that see a part of the survey."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.clouds.height_map import (
    SENSOR_M,
    HeightMatcher,
    height_raster,
    known_cells,
    polar_maxima,
)
from crossloc3d_ros.config import HeightMapConfig, from_dict
from crossloc3d_ros.errors import CloudError, ConfigError
from crossloc3d_ros.types import Float32Array

CELLS, RINGS, SECTORS = 64, 10, 22  # no cell of the raster lies on the border of two sectors
PLAIN = HeightMapConfig(cells=CELLS, rings=RINGS, sectors=SECTORS, reach=0, smooth=0)


def place(seed: int) -> Float32Array:
    """Return walls around a free centre, in patch units."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.8, 0.8, (14, 2))
    corners = corners[np.hypot(*corners.T) > 0.25]
    height = rng.uniform(0.02, 0.2, len(corners))
    owner = rng.integers(0, len(corners), 2500)
    xy = corners[owner] + rng.uniform(-0.08, 0.08, (2500, 2))
    return np.column_stack((xy, rng.uniform(0.01, 1.0, 2500) * height[owner])).astype(np.float32)


def rotated(points: Float32Array, angle_rad: float) -> Float32Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return (points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32)


def rasters(*clouds: Float32Array) -> Float32Array:
    return np.stack([height_raster(cloud, CELLS) for cloud in clouds])


def polar_of(raster: Float32Array) -> Float32Array:
    """Return the square roots of what a beam reaches, ring by ring, by the definition."""
    maps = np.zeros((RINGS, SECTORS))
    for row, column in zip(*np.nonzero(raster), strict=True):
        x, y = (column + 0.5) / CELLS * 2 - 1, (row + 0.5) / CELLS * 2 - 1
        ring = int(math.hypot(x, y) * RINGS)
        if ring < RINGS:
            sector = int(math.degrees(math.atan2(y, x)) % 360.0 // (360.0 / SECTORS))
            reach_m = SENSOR_M + (ring + 0.5) / RINGS * 50.0 * math.tan(math.radians(15.0))
            maps[ring, sector] = max(maps[ring, sector], math.sqrt(min(raster[row, column], reach_m / 50.0)))
    return maps


def test_a_raster_holds_the_greatest_heights() -> None:
    points = np.array([[-1, -1, 0.1], [1, 1, 0.2], [0.99, 0.99, 0.3], [0.01, -0.99, 0.4]], np.float32)
    raster = height_raster(points, 8)
    assert raster[0, 0] == np.float32(0.1)
    assert raster[7, 7] == np.float32(0.3)
    assert raster[0, 4] == np.float32(0.4)
    assert np.count_nonzero(raster) == 3


def test_the_distance_is_the_least_over_plain_rotations() -> None:
    matcher = HeightMatcher(PLAIN, 50.0)
    scans = rasters(*(place(seed) for seed in range(2)))
    submaps = rasters(*(place(seed) for seed in range(4)))
    match = matcher.match(scans, submaps)
    for i, scan in enumerate(map(polar_of, scans)):
        known = [
            (ring, sector)
            for sector in range(SECTORS)
            for hits in [np.nonzero(scan[:, sector])[0]]
            for ring in range(RINGS)
            if len(hits) and (ring in hits or ring < hits[0])
        ]
        for j, submap in enumerate(map(polar_of, submaps)):
            plain = [
                math.sqrt(np.mean([(scan[r, s] - submap[r, (s + turn) % SECTORS]) ** 2 for r, s in known]))
                for turn in range(SECTORS)
            ]
            assert match.distances[i, j] == pytest.approx(min(plain), abs=2e-3)
            found = round(match.headings_rad[i, j] / (2 * math.pi) * SECTORS)
            assert plain[found] == pytest.approx(min(plain), abs=2e-3)


@pytest.mark.parametrize("heading_deg", [0.0, 60.0, 210.0])
def test_heading_and_offset_are_found(heading_deg: float) -> None:
    matcher = HeightMatcher(HeightMapConfig(smooth=0), 50.0)
    survey = place(3)
    robot_m = np.array([7.0, -3.5])  # from the submap's centre, east and north
    seen = survey - np.array([*robot_m / 50.0, 0.0], np.float32)
    scan = rotated(seen, -math.radians(heading_deg))
    match = matcher.match(rasters(scan), rasters(survey, *(place(seed) for seed in range(10, 20))))
    assert match.distances[0].argmin() == 0
    assert match.headings_rad[0, 0] == pytest.approx(math.radians(heading_deg), abs=math.radians(6.1))
    assert np.abs(match.offsets_m[0, 0] - robot_m).max() < 2.6


def test_a_scan_beside_the_centre_is_found_from_another_centre() -> None:
    places = [place(seed) for seed in range(15)]
    aside = [cloud + np.array([7.0 / 50.0, 0.0, 0.0], np.float32) for cloud in places]
    wrong = {}
    for reach in (0, 2):
        match = HeightMatcher(HeightMapConfig(reach=reach), 50.0).match(rasters(*aside), rasters(*places))
        wrong[reach] = int((match.distances.argmin(axis=1) != np.arange(15)).sum())
    assert wrong[2] == 0 < wrong[0]


def test_what_a_scan_cannot_see_does_not_count() -> None:
    survey = place(4)
    maps = polar_maxima(survey, RINGS, SECTORS)
    first = np.where((maps > 0).any(0), (maps > 0).argmax(0), RINGS)
    ring = (np.hypot(survey[:, 0], survey[:, 1]) * RINGS).astype(int)
    sector = (np.degrees(np.arctan2(survey[:, 1], survey[:, 0])) % 360.0 / (360.0 / SECTORS)).astype(int)
    scan = survey[ring <= first[sector]]  # the first wall of every sector; what is behind it is hidden
    assert len(scan) < 0.8 * len(survey)
    others = (place(seed) for seed in range(20, 40))
    distances = HeightMatcher(PLAIN, 50.0).match(rasters(scan), rasters(survey, *others)).distances[0]
    assert distances[0] < 0.3 * distances[1:].min()


def test_heights_beyond_the_sensors_view_do_not_count() -> None:
    points = np.array([[0.4, 0.0, 0.15], [0.0, 0.6, 0.05]], np.float32)
    tower, low = points.copy(), points.copy()
    tower[0, 2], low[0, 2] = 0.5, 0.05  # 25 m, seen from above; the highest beam passes there at about 7 m
    distances = HeightMatcher(PLAIN, 50.0).match(rasters(points), rasters(tower, low)).distances[0]
    assert distances[0] < 1e-3 < distances[1]


def test_a_scan_that_saw_nothing_fits_nowhere() -> None:
    nothing = np.array([[1.0, 1.0, 0.1]], np.float32)  # beyond the last ring
    assert np.isinf(HeightMatcher(PLAIN, 50.0).match(rasters(nothing), rasters(place(1), place(2))).distances).all()


def test_submaps_in_blocks_are_submaps_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    matcher = HeightMatcher(HeightMapConfig(), 50.0)
    scans, submaps = rasters(place(1)), rasters(*(place(seed) for seed in range(9)))
    whole = matcher.match(scans, submaps)
    monkeypatch.setattr("crossloc3d_ros.clouds.height_map._BLOCK_CELLS", 60 * 25 * 4)
    for part, other in zip(matcher.match(scans, submaps), whole, strict=True):
        assert np.allclose(part, other, atol=1e-6)


def test_what_a_scan_knows_ends_at_the_first_hit() -> None:
    maps = np.zeros((1, 4, 3), np.float32)
    maps[0, 2, 0] = maps[0, 3, 0] = 0.1  # sector 0: hits in rings 2 and 3
    maps[0, 0, 1] = maps[0, 2, 1] = 0.1  # sector 1: hits in rings 0 and 2; ring 1 is behind the first
    expected = np.array([[1, 1, 0], [1, 0, 0], [1, 1, 0], [1, 0, 0]])
    assert np.array_equal(known_cells(maps)[0], expected)


@pytest.mark.parametrize("shape", [(0, 3), (5, 2), (5,)])
def test_a_patch_of_the_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(CloudError, match="must be an array"):
        height_raster(np.zeros(shape, np.float32), 8)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="sectors"):
        from_dict(HeightMapConfig, {"sectors": 2})
