"""Published clouds in our patch units, and published datasets as evaluation sets."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros.config import PreprocessingConfig
from crossloc3d_ros.datasets.published import load_evaluation_set, open_source
from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.formats.cs_campus3d import PRESETS
from crossloc3d_ros.formats.cs_campus3d_writer import write_cloud, write_info

OURS = PreprocessingConfig(min_points=32)
RELEASE = PreprocessingConfig(
    half_extent_m=100.0, scan_half_extent_m=20.0, ground_clearance_m=0.0, thin_m=0.0, min_points=1,
    scan_origin="mean", submap_origin="bounding_box", vertical_origin="centre",
)  # fmt: skip
EAST, NORTH = 331_500.0, 4_317_000.0


def wall(rng: np.random.Generator, at_m: float, unit_m: float) -> np.ndarray:
    """Return a cloud in units of `unit_m`: ground of 30 m around its centre, 1 m deep, and a wall of 8 m east of it."""
    points = np.column_stack([rng.uniform(-30, 30, (4096, 2)), rng.uniform(-4, -3.9, 4096)])
    points[:2000, 0] = at_m
    points[:2000, 2] = rng.uniform(-4, 4, 2000)
    return points / unit_m


@pytest.fixture
def campus(tmp_path: Path) -> Path:
    """Give a small CS-Campus3D: aerial clouds of 100 m units, scans of 20 m units, a scan that is its own query."""
    rng = np.random.default_rng(3)
    aerial = [f"umd/umcp_lidar5_cloud_7/aerial/{i}.bin" for i in range(4)]
    ground = [f"umd/umcp_lidar5_ground_umd_gps_{i}/aerial/{i}.bin" for i in range(5)]
    for i, file in enumerate(aerial):
        write_cloud(tmp_path, file, wall(rng, 5.0 * i, 100.0))
    for i, file in enumerate(ground):
        write_cloud(tmp_path, file, np.clip(wall(rng, 3.0 * i, 20.0), -1, 1))

    def entry(file: str, number: int) -> dict[Any, Any]:
        return {"query": file, "northing": NORTH + 10.0 * number, "easting": EAST + 20.0 * number}

    subset = {i: entry(file, i) for i, file in enumerate(aerial)}
    both = {**subset, **{4 + i: entry(file, i) for i, file in enumerate(ground[:3])}}
    queries = [[{**entry(file, i + 2), 0: [i], 1: [i]} for i, file in enumerate(ground[2:])]]
    preset = PRESETS["campus"]
    (tmp_path / preset.database).write_bytes(pickle.dumps([both, subset], 4))
    (tmp_path / preset.queries).write_bytes(pickle.dumps(queries, 4))
    return tmp_path


def test_both_settings_of_the_paper_are_there_and_no_query_answers_itself(campus: Path) -> None:
    found = load_evaluation_set(campus, OURS, "campus")
    assert (len(found.queries), len(found.aerial)) == (3, 4)
    assert found.ground is not None
    assert len(found.ground) == 2
    np.testing.assert_array_equal(found.queries.xy_m[:, 0], EAST + 20.0 * np.arange(2, 5))
    np.testing.assert_array_equal(found.aerial.heading_rad, 0.0)
    assert np.isnan(found.queries.heading_rad).all()


def test_units_become_metres_over_our_half_extent_and_heights_stand_on_the_ground(campus: Path) -> None:
    found = load_evaluation_set(campus, OURS)
    for i in range(4):
        patch = found.aerial.patches[i]
        high = patch[patch[:, 2] * 50.0 > 2.0]
        np.testing.assert_allclose(high[:, 0] * 50.0, 5.0 * i, atol=1e-3)
        assert high[:, 2].max() * 50.0 == pytest.approx(8.0, abs=1.0)
        assert patch[:, 2].min() * 50.0 >= OURS.ground_clearance_m - 1e-4
        assert np.abs(patch[:, :2]).max() * 50.0 == pytest.approx(30.0, abs=0.5)
    query = found.queries.patches[0]
    assert np.abs(query[:, :2]).max() * 50.0 <= 20.0 + 1e-3
    np.testing.assert_allclose(query[query[:, 2] * 50.0 > 2.0][:, 0] * 50.0, 6.0, atol=1e-3)


def test_weights_of_the_release_get_the_published_numbers_themselves(campus: Path) -> None:
    found = load_evaluation_set(campus, RELEASE)
    file = "umd/umcp_lidar5_cloud_7/aerial/2.bin"
    np.testing.assert_array_equal(found.aerial.patches[2], np.fromfile(campus / file).reshape(-1, 3).astype(np.float32))
    file = "umd/umcp_lidar5_ground_umd_gps_4/aerial/4.bin"
    np.testing.assert_array_equal(
        found.queries.patches[2], np.fromfile(campus / file).reshape(-1, 3).astype(np.float32)
    )


def test_clouds_without_enough_points_are_left_out(campus: Path) -> None:
    outside = np.full((4096, 3), 0.9)  # 90 m away
    write_cloud(campus, "umd/umcp_lidar5_cloud_7/aerial/1.bin", outside)
    found = load_evaluation_set(campus, OURS)
    np.testing.assert_array_equal(found.aerial.xy_m[:, 0] - EAST, [0.0, 40.0, 60.0])


def test_a_dataset_without_queries_is_refused(campus: Path) -> None:
    (campus / PRESETS["campus"].queries).write_bytes(pickle.dumps([[]]))
    with pytest.raises(DatasetError, match="no queries to test on"):
        load_evaluation_set(campus, OURS)


def test_a_dataset_without_positions_is_refused(campus: Path) -> None:
    query = {"query": "umd/umcp_lidar5_ground_umd_gps_4/aerial/4.bin", 0: [0], 1: [0]}
    (campus / PRESETS["campus"].queries).write_bytes(pickle.dumps([[query]]))
    with pytest.raises(DatasetError, match="does not say where 1 queries lie"):
        load_evaluation_set(campus, OURS)


@pytest.fixture
def oxford(tmp_path: Path) -> Path:
    """Give a small Oxford RobotCar of three runs."""
    rng = np.random.default_rng(4)
    database, queries = [], []
    for run in range(3):
        files = [f"oxford/run{run}/pointcloud_20m/{i}.bin" for i in range(4)]
        for file in files:
            write_cloud(tmp_path, file, rng.uniform(-1, 1, (4096, 3)))
        entries = [{"query": file, "northing": 5.73e6 + 10 * i, "easting": 6.2e5 + run} for i, file in enumerate(files)]
        database.append(dict(enumerate(entries)))
        queries.append({i: {**entry, **{m: [i] for m in range(3) if m != run}} for i, entry in enumerate(entries[:2])})
    preset = PRESETS["oxford"]
    (tmp_path / preset.database).write_bytes(pickle.dumps(database, 2))
    (tmp_path / preset.queries).write_bytes(pickle.dumps(queries, 2))
    return tmp_path


def test_oxfords_runs_are_looked_for_in_one_of_them(oxford: Path) -> None:
    found = load_evaluation_set(oxford, OURS, database_run=1)
    assert found.ground is None
    assert (len(found.queries), len(found.aerial)) == (4, 4)
    np.testing.assert_array_equal(found.aerial.xy_m[:, 0], 6.2e5 + 1)
    assert set(found.queries.xy_m[:, 0]) == {6.2e5, 6.2e5 + 2}
    raw = np.fromfile(oxford / "oxford/run1/pointcloud_20m/3.bin").reshape(-1, 3).astype(np.float32)
    np.testing.assert_array_equal(found.aerial.patches[3], raw)
    with pytest.raises(DatasetError, match="no run 3: its runs are 0 to 2"):
        load_evaluation_set(oxford, OURS, database_run=3)


def test_own_clouds_come_out_to_the_bit_and_are_normalised_for_other_weights(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    write_info(tmp_path, {"points": 64, "half_extent_m": 50.0, "scan_half_extent_m": 40.0})
    points = np.column_stack([rng.uniform(-1, 1, (64, 2)), rng.uniform(0.1, 0.9, 64)]).astype(np.float32)
    write_cloud(tmp_path, "clouds/ground_00/0.bin", points)
    config = dataclasses.replace(OURS, n_points=64, scan_half_extent_m=40.0)
    source = open_source(tmp_path, PRESETS["plain"], config)
    np.testing.assert_array_equal(source.patch("clouds/ground_00/0.bin", is_ground=True), points)
    wider = dataclasses.replace(config, scan_half_extent_m=80.0, min_points=1)
    patch = open_source(tmp_path, PRESETS["plain"], wider).patch("clouds/ground_00/0.bin", is_ground=True)
    assert patch is not None
    order = np.lexsort(points.T)
    np.testing.assert_allclose(patch[np.lexsort(patch.T)], points[order] / 2.0, atol=1e-6)
