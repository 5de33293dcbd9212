"""From recordings and a survey to a dataset, to an evaluation set and to training."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.aerial_map import aerial_patches
from crossloc3d_ros.clouds.filters import mounting_matrix
from crossloc3d_ros.config import (
    BuildConfig,
    DatasetConfig,
    ModelConfig,
    MountingConfig,
    PreprocessingConfig,
    TrainConfig,
)
from crossloc3d_ros.datasets.published import load_evaluation_set
from crossloc3d_ros.datasets.recordings import Topics
from crossloc3d_ros.errors import AerialDataError, BagError, DatasetError, TrainingError
from crossloc3d_ros.files import work_lock
from crossloc3d_ros.formats import cs_campus3d_writer
from crossloc3d_ros.formats.cs_campus3d import PRESETS, read_evaluation, read_info, read_training
from crossloc3d_ros.training import make_dataset as module
from crossloc3d_ros.training.areas import NONE, TEST, TRAINING, VALIDATION
from crossloc3d_ros.training.make_dataset import BORDER, NO_SUBMAP, DatasetReport, DatasetRequest, make_dataset
from crossloc3d_ros.training.own_data import load_training, load_validation

PATCH = PreprocessingConfig(half_extent_m=15.0, scan_half_extent_m=15.0, n_points=256, min_points=40)
PLAIN = PRESETS["plain"]


def request_of(area, output: Path, **changes) -> DatasetRequest:  # type: ignore[no-untyped-def]
    """Return what the tests make a dataset of."""
    request = DatasetRequest(
        bags=area.bags, survey=(area.survey,), output=output, preprocessing=PATCH,
        config=DatasetConfig(scan_spacing_m=3.0, hit_m=30.0, negative_m=40.0), database_bags=area.bags[1:],
        build=BuildConfig(spacing_m=10.0, tile_m=200.0),
    )  # fmt: skip
    return dataclasses.replace(request, **changes)


@pytest.fixture(scope="module")
def made(recorded_area, tmp_path_factory: pytest.TempPathFactory) -> tuple[DatasetReport, Path]:  # type: ignore[no-untyped-def]
    """Give a dataset of both drives."""
    output = tmp_path_factory.mktemp("made") / "own"
    return make_dataset(request_of(recorded_area, output)), output


def test_the_files_are_those_of_cs_campus3d(made) -> None:  # type: ignore[no-untyped-def]
    report, folder = made
    training = pickle.loads((folder / "training_queries_umd_4096.pickle").read_bytes())
    database = pickle.loads((folder / "umd_evaluation_database.pickle").read_bytes())
    queries = pickle.loads((folder / "umd_evaluation_query.pickle").read_bytes())
    assert len(training) == report.scans[TRAINING] + report.submaps[TRAINING]
    for entry in training.values():
        assert {"query", "positives", "negatives", "northing", "easting"} <= entry.keys()
        assert np.fromfile(folder / entry["query"]).reshape(-1, 3).shape == (256, 3)
    assert [len(subset) for subset in database][1] == report.submaps[TEST]
    for key, entry in queries[0].items():
        place = np.array([entry["easting"], entry["northing"]])
        for number, subset in enumerate(database):
            near = [
                row for row, other in subset.items()
                if np.hypot(*(place - [other["easting"], other["northing"]])) <= 30.0
            ]  # fmt: skip
            assert entry[number] == near, key


def test_every_scan_is_accounted_for(made, recorded_area) -> None:  # type: ignore[no-untyped-def]
    report, folder = made
    for recording in report.recordings:
        assert recording.seen == recording.used + sum(recording.dropped.values()) == 220
    assert sum(report.scans.values()) == sum(recording.used for recording in report.recordings)
    info = read_info(folder)
    assert info["crs"] == recorded_area.crs
    assert info["recordings"][0]["dropped"] == dict(report.recordings[0].dropped)
    assert info["settings"]["max_gnss_std_m"] == 10.0
    assert not (folder.parent / "own.build").exists()
    assert min(report.scans[role] for role in (TRAINING, VALIDATION, TEST)) > 0


def test_areas_share_no_ground_that_their_clouds_see(made) -> None:  # type: ignore[no-untyped-def]
    _, folder = made
    training = read_training(folder, PLAIN).clouds
    validation, test = read_evaluation(folder, PLAIN, validation=True), read_evaluation(folder, PLAIN)
    tables = [[training], [*validation.database, *(q.clouds for q in validation.queries)],
              [*test.database, *(q.clouds for q in test.queries)]]  # fmt: skip
    low_high = []
    for group in tables:
        places = np.concatenate([table.xy_m for table in group])
        reach = np.concatenate([np.where(table.is_ground, 15.0 * 2**0.5, 15.0) for table in group])[:, None]
        low_high.append((places - reach, places + reach))
    for a in range(3):
        for b in range(a):
            meet = (low_high[a][0][:, None] < low_high[b][1][None] - 1e-6).all(axis=2)
            meet &= (low_high[b][0][None] < low_high[a][1][:, None] - 1e-6).all(axis=2)
            assert not meet.any()


def test_it_is_an_evaluation_set_with_both_settings(made) -> None:  # type: ignore[no-untyped-def]
    report, folder = made
    loaded = load_evaluation_set(folder, PATCH)
    assert len(loaded.aerial) == report.submaps[TEST]
    assert loaded.ground is not None
    assert len(loaded.queries) + len(loaded.ground) == report.scans[TEST]
    assert np.abs(loaded.queries.heading_rad).max() < 0.1  # the first drive goes east
    assert (np.abs(np.abs(loaded.ground.heading_rad) - np.pi) < 0.1).all()
    file = read_evaluation(folder, PLAIN).database[1].files[3]
    np.testing.assert_array_equal(loaded.aerial.patches[3], np.fromfile(folder / file).reshape(-1, 3))


def test_a_scan_and_its_submap_show_the_same_houses(made) -> None:  # type: ignore[no-untyped-def]
    _, folder = made
    loaded = load_evaluation_set(folder, PATCH)
    shares = []
    for i in range(len(loaded.queries)):
        offset = loaded.aerial.xy_m - loaded.queries.xy_m[i]
        nearest = int(np.hypot(*offset.T).argmin())
        scan, submap = loaded.queries.patches[i], loaded.aerial.patches[nearest]
        angle = loaded.queries.heading_rad[i]
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        seen = scan[:, :2] @ turn * 15.0 - offset[nearest]
        seen = seen[(np.abs(seen) < 13.0).all(axis=1)]
        gaps = np.hypot(*(seen[:, None] - submap[None, :, :2] * 15.0).transpose(2, 0, 1)).min(axis=1)
        shares.append(float((gaps < 1.5).mean()))
    assert np.median(shares) > 0.9


def test_it_trains(made, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    from crossloc3d_ros.training.loop import take_step
    from crossloc3d_ros.training.state import new_state

    _, folder = made
    model = ModelConfig(
        voxel_sizes=(0.2,), kept_branches=0, refinement="none", channels=16, fused_channels=32, clusters=4,
        descriptor_size=8,
    )  # fmt: skip
    config = TrainConfig(pairs=4, model=model, preprocessing=PATCH)
    sampler = load_training(folder, None, config)
    state = new_state(config)
    for _ in range(2):
        assert np.isfinite(take_step(state, sampler, 1e-3, config))  # type: ignore[arg-type]
        state.step += 1
    (town,) = load_validation(folder, None, config)
    assert len(town.query_xy_m) > 0


def test_an_interrupted_call_goes_on_and_gives_the_same(
    recorded_area, made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # type: ignore[no-untyped-def]
    _, whole = made
    output = tmp_path / "own"
    request = request_of(recorded_area, output)
    written = []

    def until_full(folder: Path, file: str, points: object) -> None:
        if len(written) == 50:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(file)
        cs_campus3d_writer.write_cloud(folder, file, points)

    with monkeypatch.context() as patched:
        patched.setattr(module, "write_cloud", until_full)
        with pytest.raises(DatasetError, match="the disk is full; make room and give the same command again"):
            make_dataset(request)
    assert not output.exists()

    def never(*_: object, **__: object) -> None:
        raise AssertionError("the survey and the recordings were read again")

    monkeypatch.setattr(aerial_patches, "build_tiles", never)
    monkeypatch.setattr(module, "read_scans", never)
    make_dataset(request)
    names = sorted(str(path.relative_to(whole)) for path in whole.rglob("*") if path.is_file())
    assert names == sorted(str(path.relative_to(output)) for path in output.rglob("*") if path.is_file())
    for name in names:
        assert (output / name).read_bytes() == (whole / name).read_bytes(), name


def test_other_areas_keep_what_was_read(recorded_area, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    output = tmp_path / "own"
    west, south = recorded_area.west, recorded_area.south
    far = request_of(recorded_area, output, test_boxes=((west, south, west + 470.0, south + 120.0),))
    with pytest.raises(DatasetError, match=r"the area to learn from holds 0 scans .* name other areas"):
        make_dataset(far)
    monkeypatch.setattr(module, "read_scans", None)
    box = (west - 50.0, south - 50.0, west + 150.0, south + 200.0)
    report = make_dataset(dataclasses.replace(far, test_boxes=(box,)))
    assert report.scans[VALIDATION] == 0
    places = read_evaluation(output, PLAIN).queries[0].clouds.xy_m
    assert (places[:, 0] + 15.0 * 2**0.5 <= west + 150.0).all()
    with pytest.raises(TrainingError, match="validation-share"):
        load_validation(output, None, TrainConfig(preprocessing=PATCH))


def test_a_disk_with_too_little_room_is_reported_before_the_writing(
    recorded_area, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # type: ignore[no-untyped-def]
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: usage._replace(free=5_000_000_000))
    request = request_of(recorded_area, tmp_path / "own")
    calls = []

    def small(path: object) -> object:
        calls.append(path)
        return usage._replace(free=1_000_000 if str(path).endswith("dataset") else 5_000_000_000)

    monkeypatch.setattr(module.shutil, "disk_usage", small)
    with pytest.raises(DatasetError, match=r"too little room: .* clouds need 0\.00 GB there"):
        make_dataset(request)
    assert calls
    assert not (tmp_path / "own").exists()


def test_recordings_of_another_place_are_refused(recorded_area, town_drive, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    from crossloc3d_ros.formats.las import write_laz

    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 120, (60_000, 2)), rng.uniform(0, 9, 60_000)])
    points[:30_000, 2] = 0.0
    write_laz(
        tmp_path / "far.laz",
        points + np.array([640_000.0, 5_803_000.0, 0.0]),
        np.full(60_000, 2, np.uint8),
        "EPSG:32631",
    )
    request = request_of(recorded_area, tmp_path / "own", survey=(tmp_path / "far.laz",))
    with pytest.raises(
        DatasetError, match=r"none of the .* scans lies within 25 m of a submap.*is it the survey of that"
    ):
        make_dataset(request)


def test_recordings_without_a_usable_fix_are_refused_with_the_reasons(recorded_area, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    config = DatasetConfig(max_gnss_std_m=0.1)
    with pytest.raises(DatasetError, match=r"none of the 440 scans can be used: .* the GNSS covariance is too large"):
        make_dataset(request_of(recorded_area, tmp_path / "own", config=config))


def test_what_can_be_refused_is_refused_at_once(recorded_area, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(module, "cut_aerial", None)
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "file").touch()
    output = tmp_path / "own"
    bag = recorded_area.bags[0]
    refused = [
        ({"output": taken}, DatasetError, "exists already"),
        ({"bags": ()}, DatasetError, "at least one recording"),
        ({"bags": (bag, bag)}, DatasetError, "named twice"),
        ({"database_bags": (tmp_path,)}, DatasetError, "none of the recordings"),
        ({"bags": (tmp_path / "none",), "database_bags": ()}, BagError, "does not exist"),
        ({"topics": Topics(gnss="/fix")}, BagError, "no topic '/fix'"),
        ({"survey": (tmp_path / "none.laz",)}, AerialDataError, "no such file"),
    ]
    for changes, kind, message in refused:
        with pytest.raises(kind, match=message):
            make_dataset(request_of(recorded_area, **{"output": output, **changes}))
    assert not output.with_name("own.build").exists()


def test_two_calls_do_not_work_in_one_folder(recorded_area, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    with (
        work_lock(tmp_path / "own.build", DatasetError, "process"),
        pytest.raises(DatasetError, match=r"another process works in .*own\.build"),
    ):
        make_dataset(request_of(recorded_area, tmp_path / "own"))


@pytest.mark.slow
def test_a_simulated_drive_through_a_simulated_town_becomes_a_dataset(tmp_path: Path) -> None:
    from crossloc3d_ros.config import ScanConfig
    from crossloc3d_ros.simulation.drive import DriveConfig, drive
    from crossloc3d_ros.simulation.route import plan_route
    from crossloc3d_ros.simulation.survey import SurveyConfig, fly, write_survey
    from crossloc3d_ros.simulation.town import make_town

    town = make_town(100_321, "campus", 400.0)
    survey = fly(town, SurveyConfig(spacing_m=0.6), np.random.default_rng(1))
    files = write_survey(town, survey, tmp_path / "survey")
    later = make_town(100_321, "campus", 400.0, 1)
    mounting = MountingConfig(z_m=1.1)
    route = plan_route(later, 400.0, np.random.default_rng(2), speed_m_s=3.0)
    drive(later, route, tmp_path / "bag", DriveConfig(scan_every=8, mounting=mounting), seed=3)
    patch = PreprocessingConfig(half_extent_m=20.0, scan_half_extent_m=20.0, n_points=1024, min_points=60)
    request = DatasetRequest(
        bags=(tmp_path / "bag",), survey=tuple(files), output=tmp_path / "own",
        topics=Topics(gnss="/gnss", imu="/imu"), scan=ScanConfig(mounting=mounting), preprocessing=patch,
        config=DatasetConfig(scan_spacing_m=2.0, hit_m=40.0, negative_m=60.0, validation_share=0.15),
        build=BuildConfig(spacing_m=15.0),
    )  # fmt: skip
    report = make_dataset(request)
    (recording,) = report.recordings
    assert recording.dropped["the receiver had no fix"] > 0
    assert min(report.scans[role] for role in (TRAINING, VALIDATION, TEST)) > 0
    loaded = load_evaluation_set(tmp_path / "own", patch)
    truth = mounting_matrix(mounting)
    assert truth[2, 3] == 1.1
    # At the pose that the drive gives a scan, the survey shows what the scan shows.
    heights = []
    for i in range(len(loaded.queries)):
        nearest = int(np.hypot(*(loaded.aerial.xy_m - loaded.queries.xy_m[i]).T).argmin())
        heights.append((loaded.queries.patches[i][:, 2].max(), loaded.aerial.patches[nearest][:, 2].max()))
    assert np.isfinite(heights).all()
    config = TrainConfig(pairs=4, preprocessing=patch, headings=8)
    batch = load_training(tmp_path / "own", None, config).batch(0)
    assert len(batch.scans) == len(batch.submaps) == 4


def test_the_reasons_of_the_report_are_words(made) -> None:  # type: ignore[no-untyped-def]
    report, folder = made
    assert {NO_SUBMAP, BORDER} & set(report.recordings[0].dropped) == {BORDER}
    assert report.submaps[NONE] > 0
    assert json.loads((folder / "dataset.json").read_text())["submaps"][BORDER] == report.submaps[NONE]
