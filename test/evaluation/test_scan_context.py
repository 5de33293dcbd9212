"""Polar height maps: against a plain loop, in every heading, for scans that see a part of what the survey sees."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crossloc3d_ros.config import PreprocessingConfig, from_dict
from crossloc3d_ros.errors import CloudError, ConfigError
from crossloc3d_ros.evaluation.encoding import OwnDistance
from crossloc3d_ros.evaluation.scan_context import ScanContext, ScanContextConfig
from crossloc3d_ros.types import DescriptorEncoder, Float32Array

ONE_CENTRE = {"rings": 8, "sectors": 24, "shift_m": 0.0}


def place(seed: int, points: int = 1500) -> Float32Array:
    """Return walls and trees around a free centre, in patch units."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.8, 0.8, (14, 2))
    corners = corners[np.hypot(*corners.T) > 0.25]
    height = rng.uniform(0.02, 0.2, len(corners))
    owner = rng.integers(0, len(corners), points)
    xy = corners[owner] + rng.uniform(-0.08, 0.08, (points, 2))
    return np.column_stack((xy, rng.uniform(0.01, 1.0, points) * height[owner])).astype(np.float32)


def turned(points: Float32Array, angle_rad: float) -> Float32Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return (points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32)


def method(**settings: object) -> ScanContext:
    return ScanContext(config=ScanContextConfig(**{**ONE_CENTRE, **settings}))  # type: ignore[arg-type]


def test_a_map_holds_the_greatest_height_of_each_cell() -> None:
    points = place(1)
    expected = np.zeros((8, 24), np.float32)
    for x, y, z in points.tolist():
        ring, sector = int(math.hypot(x, y) * 8), int(math.degrees(math.atan2(y, x)) % 360.0 / 15.0)
        if ring < 8:
            expected[ring, sector] = max(expected[ring, sector], z)
    assert np.array_equal(method().encode(points), expected.ravel())


def _plain_masked(query: Float32Array, place: Float32Array, ceiling: Float32Array) -> list[float]:
    """Return the distance of each shift by the definition: cells that the scan knows, root mean square."""
    query, place = (np.minimum(m.reshape(8, 24), ceiling[:, None]) for m in (query, place))
    distances = []
    for shift in range(24):
        squares = []
        for sector in range(24):
            hits = [ring for ring in range(8) if query[ring, sector] > 0]
            for ring in range(8):
                if hits and (ring in hits or ring < hits[0]):
                    squares.append((query[ring, sector] - place[ring, (sector + shift) % 24]) ** 2)
        distances.append(math.sqrt(sum(squares) / len(squares)))
    return distances


def test_the_masked_distance_is_the_least_over_plain_shifts() -> None:
    subject = method(smooth=0)
    maps = subject.encode_batch([place(seed) for seed in range(5)])
    middle_m = (np.arange(8) + 0.5) / 8 * 50.0
    ceiling = ((1.2 + middle_m * math.tan(math.radians(15.0))) / 50.0).astype(np.float32)
    distances, headings = subject.compare(maps[:2], maps)
    for i in range(2):
        for j in range(5):
            plain = _plain_masked(maps[i], maps[j], ceiling)
            assert distances[i, j] == pytest.approx(min(plain), abs=1e-3)
            if i != j:
                assert headings[i, j] == pytest.approx(2 * math.pi * int(np.argmin(plain)) / 24)


def test_the_published_distance_is_the_least_over_plain_shifts() -> None:
    subject = method(distance="cosine")
    maps = subject.encode_batch([place(seed) for seed in range(4)])
    distances, _ = subject.compare(maps, maps)
    for i in range(4):
        for j in range(4):
            one, other = maps[i].reshape(8, 24), maps[j].reshape(8, 24)
            plain = []
            for shift in range(24):
                rolled = np.roll(other, -shift, axis=1)
                both = (one > 0).any(0) & (rolled > 0).any(0)
                cosines = (one * rolled).sum(0)[both] / (
                    np.linalg.norm(one, axis=0) * np.linalg.norm(rolled, axis=0)
                )[both]  # fmt: skip
                plain.append(1.0 - cosines.mean())
            assert distances[i, j] == pytest.approx(min(plain), abs=1e-4)


@pytest.mark.parametrize("settings", [{}, {"smooth": 0}, {"distance": "cosine"}, {"shift_m": 6.0}])
def test_a_turned_scan_is_found_and_its_heading_told(settings: dict[str, object]) -> None:
    subject = method(**settings)
    places = [place(seed) for seed in range(12)]
    database = subject.encode_batch(places)
    for row, step in ((3, 5), (7, 17), (10, 0)):
        heading = step * math.pi / 12  # whole sectors of 15 degrees
        query = subject.encode_batch([turned(places[row], -heading)])
        distances, headings = subject.compare(query, database)
        assert distances[0].argmin() == row
        assert headings[0, row] == pytest.approx(heading)


def test_what_a_scan_cannot_see_does_not_count() -> None:
    subject = method(smooth=0)
    survey = place(4)
    maps = subject.encode_batch([survey]).reshape(8, 24)
    first = np.where((maps > 0).any(0), (maps > 0).argmax(0), 8)
    ring = (np.hypot(survey[:, 0], survey[:, 1]) * 8).astype(int)
    sector = (np.degrees(np.arctan2(survey[:, 1], survey[:, 0])) % 360.0 / 15.0).astype(int)
    scan = survey[ring <= first[sector]]  # the first wall of every sector; what is behind it is hidden
    assert len(scan) < 0.8 * len(survey)
    database = subject.encode_batch([survey, *(place(seed) for seed in range(20, 40))])
    distances = subject.distances(subject.encode_batch([scan]), database)[0]
    assert distances[0] == pytest.approx(0.0, abs=1e-3)
    assert distances[1:].min() > 0.01


def test_heights_beyond_the_sensors_view_do_not_count() -> None:
    subject = method(smooth=0)
    points = np.array([[0.4, 0.0, 0.1], [0.0, 0.6, 0.05]], np.float32)
    tower = points.copy()
    tower[0, 2] = 0.5  # 25 m high, seen from above; the robot's highest beam passes there below 8 m
    cut = points.copy()
    cut[0, 2] = 0.15
    far = subject.distances(subject.encode_batch([cut]), subject.encode_batch([tower, points]))[0]
    assert far[0] < 1e-3 < far[1]


def test_a_scan_beside_the_centre_is_found_from_another_centre() -> None:
    places = [place(seed) for seed in range(15)]
    aside = [cloud + np.array([6.0 / 50.0, 0.0, 0.0], np.float32) for cloud in places]
    wrong = {}
    for shift_m in (0.0, 6.0):
        subject = method(shift_m=shift_m, rings=16)
        found = subject.distances(subject.encode_batch(aside), subject.encode_batch(places)).argmin(axis=1)
        wrong[shift_m] = int((found != np.arange(15)).sum())
    assert wrong[6.0] == 0 < wrong[0.0]


def test_a_scan_that_saw_nothing_is_like_nothing() -> None:
    subject = method()
    nothing = np.array([[1.0, 1.0, 0.1]], np.float32)  # beyond the last ring
    distances = subject.distances(subject.encode_batch([nothing]), subject.encode_batch([place(1), place(2)]))
    assert np.isinf(distances).all()


def test_it_stands_in_for_an_encoder() -> None:
    subject: DescriptorEncoder = ScanContext()
    assert isinstance(subject, OwnDistance)
    subject.warm_up()
    assert subject.encode(place(1)).shape == (subject.descriptor_size,)
    marks = {
        subject.fingerprint,
        ScanContext(PreprocessingConfig(thin_m=0.4)).fingerprint,
        ScanContext(config=ScanContextConfig(rings=10)).fingerprint,
    }
    assert len(marks) == 3


def test_another_database_is_another_database() -> None:
    subject = method()
    first, second = (subject.encode_batch([place(seed), place(seed + 1)]) for seed in (1, 5))
    query = subject.encode_batch([place(5)])
    assert subject.distances(query, first).min() > 0.01
    assert subject.distances(query, second)[0].argmin() == 0


@pytest.mark.parametrize("shape", [(0, 3), (5, 2), (5,)])
def test_a_patch_of_the_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(CloudError, match="must be an array"):
        method().encode(np.zeros(shape, np.float32))


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="sectors"):
        from_dict(ScanContextConfig, {"sectors": 2})
