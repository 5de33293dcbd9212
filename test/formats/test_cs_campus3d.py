"""The layout of CS-Campus3D and Oxford RobotCar, as their own scripts write it."""

from __future__ import annotations

import errno
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crossloc3d_ros import files
from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.formats.cs_campus3d import (
    PRESETS,
    CloudTable,
    QueryTable,
    preset_of,
    read_cloud,
    read_evaluation,
    read_info,
    read_training,
)
from crossloc3d_ros.formats.cs_campus3d_writer import (
    write_cloud,
    write_database,
    write_info,
    write_queries,
    write_training,
)

CAMPUS, OXFORD, PLAIN = PRESETS["campus"], PRESETS["oxford"], PRESETS["plain"]


def publish(folder: Path, *, clouds: bool = True) -> dict[str, Any]:
    """Write a small CS-Campus3D in the form of the published one: numpy numbers, subsets as dict and as list."""
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 400, (12, 2)) + np.array([331_500.0, 4_317_000.0])
    files = [f"umd/umcp_lidar5_cloud_6/umd_aerial_cloud_20m/{i}.bin" for i in range(6)]
    files += [f"umd/umcp_lidar5_ground_umd_gps_{i}/umd_aerial_cloud_20m/{i}.bin" for i in range(6)]
    if clouds:
        for file in files:
            write_cloud(folder, file, rng.uniform(-1, 1, (4096, 3)))

    def entry(i: int) -> dict[Any, Any]:
        return {"query": files[i], "northing": np.float64(places[i, 1]), "easting": np.float64(places[i, 0])}

    training = {
        i: {**entry(i), "positives": [(i + 6) % 12], "negatives": [j for j in range(12) if j not in (i, (i + 6) % 12)]}
        for i in range(12)
    }
    database = [{i: entry(i) for i in range(12)}, [entry(i) for i in range(6)]]
    queries = [[{**entry(i), 0: [i, i - 6], 1: np.array([i - 6])} for i in range(9, 12)]]
    for name, content in ((CAMPUS.training, training), (CAMPUS.database, database), (CAMPUS.queries, queries)):
        (folder / name).write_bytes(pickle.dumps(content, pickle.HIGHEST_PROTOCOL))
    return {"places": places, "files": files, "training": training}


def test_a_published_dataset_is_read_as_it_is(tmp_path: Path) -> None:
    made = publish(tmp_path)
    assert preset_of(tmp_path) is CAMPUS
    training = read_training(tmp_path, CAMPUS)
    assert list(training.clouds.files) == made["files"]
    np.testing.assert_array_equal(training.clouds.xy_m, made["places"])
    assert training.clouds.is_ground.tolist() == [False] * 6 + [True] * 6
    np.testing.assert_array_equal(training.clouds.heading_rad, [0.0] * 6 + [np.nan] * 6)
    for row, entry in made["training"].items():
        assert training.positives[row].tolist() == entry["positives"]
        assert np.flatnonzero(training.is_negative(row, np.arange(12))).tolist() == entry["negatives"]

    evaluation = read_evaluation(tmp_path, CAMPUS)
    assert [len(table) for table in evaluation.database] == [12, 6]
    assert not evaluation.database[1].is_ground.any()
    (queries,) = evaluation.queries
    assert queries.clouds.files == tuple(made["files"][9:])
    assert {m: rows.tolist() for m, rows in queries.neighbours[0].items()} == {0: [9, 3], 1: [3]}


def test_ids_need_not_count_from_nought(tmp_path: Path) -> None:
    made = publish(tmp_path)
    training = {
        10 * i + 5: {**entry, "positives": [10 * p + 5 for p in entry["positives"]],
                     "negatives": [10 * n + 5 for n in entry["negatives"]]}
        for i, entry in made["training"].items()
    }  # fmt: skip
    (tmp_path / CAMPUS.training).write_bytes(pickle.dumps(training))
    found = read_training(tmp_path, CAMPUS)
    for row, entry in made["training"].items():
        assert found.positives[row].tolist() == entry["positives"]
        assert np.flatnonzero(found.is_negative(row, np.arange(12))).tolist() == entry["negatives"]


def test_oxfords_positions_come_from_its_tables_where_the_pickle_has_none(tmp_path: Path) -> None:
    run = "oxford/2014-05-19-13-20-57"
    files = [f"{run}/pointcloud_20m_10overlap/{1400505794141322 + i}.bin" for i in range(3)]
    for file in files:
        write_cloud(tmp_path, file, np.zeros((4096, 3)))
    training = {i: {"query": file, "positives": [(i + 1) % 3], "negatives": []} for i, file in enumerate(files)}
    (tmp_path / OXFORD.training).write_bytes(pickle.dumps(training, 4))
    table = "timestamp,northing,easting\n" + "".join(
        f"{1400505794141322 + i},573000{i}.5,62000{i}.25\n" for i in (0, 2)
    )
    (tmp_path / run / "pointcloud_locations_20m_10overlap.csv").write_text(table)
    assert preset_of(tmp_path) is OXFORD
    found = read_training(tmp_path, OXFORD)
    assert found.clouds.is_ground.all()
    np.testing.assert_array_equal(found.clouds.xy_m, [[620000.25, 5730000.5], [np.nan, np.nan], [620002.25, 5730002.5]])


def table(files: list[str], *, ground: bool) -> CloudTable:
    """Return a table of clouds."""
    rng = np.random.default_rng(len(files))
    heading = rng.uniform(-3, 3, len(files)) if ground else np.zeros(len(files))
    return CloudTable(
        tuple(files), rng.uniform(0, 1e6, (len(files), 2)), heading, np.full(len(files), ground, np.bool_)
    )


def test_what_is_written_is_read_back_and_written_again_to_the_byte(tmp_path: Path) -> None:
    aerial = table([f"clouds/aerial/{i}.bin" for i in range(5)], ground=False)
    ground = table([f"clouds/ground_0/{i}.bin" for i in range(3)], ground=True)
    both = CloudTable(
        aerial.files + ground.files, np.vstack([aerial.xy_m, ground.xy_m]),
        np.concatenate([aerial.heading_rad, ground.heading_rad]), np.concatenate([aerial.is_ground, ground.is_ground]),
    )  # fmt: skip
    rng = np.random.default_rng(1)
    clouds = {file: rng.uniform(-1, 1, (64, 3)) for file in both.files}
    for file, points in clouds.items():
        write_cloud(tmp_path, file, points)
    write_info(tmp_path, {"points": 64, "half_extent_m": 50.0, "scan_half_extent_m": 50.0})
    pairs = [([(i + 1) % 8], [j for j in range(8) if j not in (i, (i + 1) % 8)]) for i in range(8)]
    write_training(tmp_path / PLAIN.training, both, iter(pairs))
    write_database(tmp_path / PLAIN.database, [both, aerial])
    write_queries(
        tmp_path / PLAIN.queries,
        [QueryTable(ground, tuple({0: np.array([i]), 1: np.array([], int)} for i in range(3)))],
    )
    first = {path.name: path.read_bytes() for path in tmp_path.glob("*.pickle")}

    assert pickle.loads(first[PLAIN.training])[5]["positives"] == [6]  # an ordinary pickle
    training, evaluation = read_training(tmp_path, PLAIN), read_evaluation(tmp_path, PLAIN)
    np.testing.assert_array_equal(training.clouds.heading_rad, both.heading_rad)
    rows = np.arange(8)
    again = tmp_path / "again"
    again.mkdir()
    write_training(
        again / PLAIN.training, training.clouds,
        ((training.positives[i], rows[training.is_negative(i, rows)]) for i in range(8)),
    )  # fmt: skip
    write_database(again / PLAIN.database, evaluation.database)
    write_queries(again / PLAIN.queries, evaluation.queries)
    for name, content in first.items():
        assert (again / name).read_bytes() == content, name
    for file, points in clouds.items():
        assert (tmp_path / file).read_bytes() == points.astype("<f8").tobytes()
        np.testing.assert_array_equal(read_cloud(tmp_path, file, 64), points)
    assert read_info(tmp_path)["points"] == 64


def test_missing_clouds_are_counted_and_named(tmp_path: Path) -> None:
    made = publish(tmp_path)
    for file in made["files"][2:7]:
        (tmp_path / file).unlink()
    with pytest.raises(DatasetError, match=r"5 of the 12 clouds .* are missing: .*/2\.bin, .*/3\.bin, .*/4\.bin and 2"):
        read_training(tmp_path, CAMPUS)
    with pytest.raises(DatasetError, match="5 of the 12 clouds"):
        read_evaluation(tmp_path, CAMPUS)


def test_clouds_of_another_size_are_named(tmp_path: Path) -> None:
    made = publish(tmp_path)
    (tmp_path / made["files"][3]).write_bytes(b"\0" * 4095 * 24)
    with pytest.raises(DatasetError, match=r"1 of the 12 clouds .*another size.*/3\.bin \(98,280 bytes\)"):
        read_training(tmp_path, CAMPUS)
    with pytest.raises(DatasetError, match="12,285 numbers instead of 12,288"):
        read_cloud(tmp_path, made["files"][3])
    write_cloud(tmp_path, made["files"][3], np.full((4096, 3), np.nan))
    with pytest.raises(DatasetError, match="not finite"):
        read_cloud(tmp_path, made["files"][3])


@pytest.mark.parametrize("name", [CAMPUS.training, CAMPUS.database, CAMPUS.queries])
def test_a_missing_or_cut_pickle_is_named(tmp_path: Path, name: str) -> None:
    publish(tmp_path)
    path = tmp_path / name
    path.write_bytes(path.read_bytes()[:-20])
    read = read_training if name == CAMPUS.training else read_evaluation
    with pytest.raises(DatasetError, match=f"{name} is damaged or cut short"):
        read(tmp_path, CAMPUS)
    path.unlink()
    with pytest.raises(DatasetError, match=f"{name} is missing"):
        read(tmp_path, CAMPUS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"query": "/etc/passwd"}, "outside of the dataset"),
        ({"query": "umd/../../secret.bin"}, "outside of the dataset"),
        ({"query": 7}, "names no cloud"),
        ({"positives": ["a"]}, "no usable positives"),
        ({"positives": [99]}, "a positive that is not there"),
        ({"positives": [-1]}, "a positive that is not there"),
        ({"negatives": [-1]}, "impossible number"),
        ({"northing": "north"}, "not a number"),
    ],
)
def test_entries_that_are_not_of_the_form_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    made = publish(tmp_path)
    made["training"][4].update(change)
    (tmp_path / CAMPUS.training).write_bytes(pickle.dumps(made["training"]))
    with pytest.raises(DatasetError, match=message):
        read_training(tmp_path, CAMPUS)


@pytest.mark.parametrize("content", [[1, 2], "text", [{0: 1}], {0: [{"northing": 1.0}]}])
def test_other_things_than_subsets_are_refused(tmp_path: Path, content: Any) -> None:
    publish(tmp_path, clouds=False)
    (tmp_path / CAMPUS.database).write_bytes(pickle.dumps(content))
    with pytest.raises(DatasetError, match=CAMPUS.database):
        read_evaluation(tmp_path, CAMPUS)


def test_neighbours_that_the_database_does_not_hold_are_refused(tmp_path: Path) -> None:
    made = publish(tmp_path)
    entry = {"query": made["files"][9], "northing": 0.0, "easting": 0.0, 1: [6]}
    (tmp_path / CAMPUS.queries).write_bytes(pickle.dumps([[entry]]))
    with pytest.raises(DatasetError, match="neighbours that the database does not hold"):
        read_evaluation(tmp_path, CAMPUS)


def test_a_folder_that_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no dataset: it holds neither"):
        preset_of(tmp_path)
    with pytest.raises(DatasetError, match="no such folder"):
        preset_of(tmp_path / "none")
    with pytest.raises(DatasetError, match="no preset 'kitti'"):
        preset_of(tmp_path, "kitti")
    with pytest.raises(DatasetError, match="no validation area of its own"):
        read_evaluation(tmp_path, CAMPUS, validation=True)
    with pytest.raises(DatasetError, match=r"dataset\.json is missing"):
        read_info(tmp_path)
    (tmp_path / "dataset.json").write_text('{"format": 1}')
    with pytest.raises(DatasetError, match="is damaged"):
        read_info(tmp_path)


def test_a_full_disk_leaves_the_older_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = table(["clouds/aerial/0.bin"], ground=False)
    path = tmp_path / PLAIN.database
    write_database(path, [clouds])
    before = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(DatasetError, match="the disk is full; make room"):
        write_database(path, [clouds, clouds])
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
