"""`evaluate` writes predictions, scores them, and says clearly what it cannot use."""

from __future__ import annotations

import csv
import dataclasses
import json
import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from crossloc3d_ros.cli import evaluate
from crossloc3d_ros.config import BuildConfig, CalibrationConfig
from crossloc3d_ros.config.sources import parse_assignments
from crossloc3d_ros.datasets import benchmarks, pose_drives, pose_sets
from crossloc3d_ros.datasets.amsterdam import AmsterdamBenchmark
from crossloc3d_ros.datasets.pose_drives import DrivePlan
from crossloc3d_ros.datasets.pose_sets import SimulatedPoses
from crossloc3d_ros.datasets.simulated import BenchmarkTown, SimulatedBenchmark
from crossloc3d_ros.evaluation.retrieval.predictions import load_predictions, save_predictions
from crossloc3d_ros.formats.cs_campus3d import CLOUD_POINTS, PRESETS
from crossloc3d_ros.formats.cs_campus3d_writer import write_cloud
from crossloc3d_ros.simulation.survey import SurveyConfig

TINY = SimulatedBenchmark(
    (BenchmarkTown("suburb", 990_001, False), BenchmarkTown("campus", 990_002, True)),
    town_size_m=160.0, queries=8, ground=4, border_m=40.0, flight=SurveyConfig(spacing_m=1.0),
    build=BuildConfig(spacing_m=19.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def tiny() -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(benchmarks.BENCHMARKS, "simulated_small", TINY)
        yield


@pytest.fixture(scope="module")
def evaluated(tiny: object, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Run the command on two small towns; return the output folder and the arguments."""
    folder = tmp_path_factory.mktemp("evaluate")
    arguments = [
        "--weights", str(weights), "--benchmark", "simulated_small", "--query-headings", "1", "4",
        "--data", str(folder / "data"), "--output", str(folder / "out"),
    ]  # fmt: skip
    assert evaluate.main(arguments) == 0
    return folder / "out", arguments


def test_everything_is_written(evaluated: tuple[Path, list[str]]) -> None:
    output, _ = evaluated
    names = {path.stem for path in (output / "predictions").iterdir()}
    each = {"aligned", "random", "random_4-mean", "random_4-nearest"}
    assert names == {f"{setting}_{way}" for setting in ("aerial", "aerial_ground") for way in each}
    rows = list(csv.DictReader((output / "results.csv").open()))
    assert {row["divided_by"] for row in rows} == {"all", "group", "family", "area"}
    assert {row["name"] for row in rows if row["divided_by"] == "family"} == {"suburb", "campus"}
    for row in rows:
        if row["counted"] != "0":
            assert float(row["low"]) <= float(row["recall"]) <= float(row["high"])
    content = json.loads((output / "results.json").read_text())
    assert len(content) == 8
    predictions = load_predictions(output / "predictions" / "aerial_random.npz")
    assert predictions.about.encoder == content[0]["about"]["encoder"]


def test_the_page_needs_nothing_but_itself(evaluated: tuple[Path, list[str]]) -> None:
    page = (evaluated[0] / "index.html").read_text()
    assert not re.search(r'(?:src|href)="(?!data:)', page)
    assert "http" not in re.sub(r'src="data:[^"]*"', "", page)
    assert "{{" not in page
    assert page.count("<figure") >= 6
    for word in ("chance level", "AR@1%", "random heading", "north-aligned"):
        assert word in page


def test_scoring_again_needs_no_encoding(evaluated: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    output, arguments = evaluated
    before = {name: (output / name).read_text() for name in ("results.csv", "results.json")}
    (output / "results.csv").unlink()
    monkeypatch.setattr(evaluate, "predict_all", lambda *_: pytest.fail("nothing must be predicted"))
    assert evaluate.main([*arguments, "--only-score"]) == 0
    assert {name: (output / name).read_text() for name in before} == before


def test_the_table_fits_a_terminal(
    evaluated: tuple[Path, list[str]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert evaluate.main([*evaluated[1], "--only-score"]) == 0
    shown = capsys.readouterr().out
    assert "aerial, random, 4 nearest" in shown
    assert "…" not in shown
    assert all(len(line) <= 80 for line in shown.splitlines() if "/" not in line)


def test_scan_context_takes_the_place_of_weights(evaluated: tuple[Path, list[str]], tmp_path: Path) -> None:
    data = evaluated[1][evaluated[1].index("--data") + 1]
    arguments = ["--method", "scan_context", "--benchmark", "simulated_small", "--data", data, "--heading", "random"]
    assert evaluate.main([*arguments, "--setting", "aerial", "--output", str(tmp_path / "out")]) == 0
    (content,) = json.loads((tmp_path / "out" / "results.json").read_text())
    assert content["about"]["weights"] == "Scan Context"


@pytest.fixture(scope="module")
def calibrated(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the same weights with a calibration."""
    path = tmp_path_factory.mktemp("calibrated") / "tiny.safetensors"
    with safe_open(weights, framework="numpy") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = file.metadata()
    save_file(tensors, path, metadata | {"credibility": json.dumps(dataclasses.asdict(CalibrationConfig(1.0)))})
    return path


def test_height_maps_order_the_answers_anew(
    evaluated: tuple[Path, list[str]], calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv("COLUMNS", "80")
    arguments = [*evaluated[1], "--weights", str(calibrated), "--setting", "aerial", "--output", str(tmp_path / "out")]
    arguments = [*arguments, "--query-headings", "1"]
    assert evaluate.main([*arguments, "--verify", "20"]) == 0
    shown = capsys.readouterr().out
    assert "  + 20 height maps" in shown
    assert "retrieval + height maps" in shown
    assert all(len(line) <= 80 for line in shown.splitlines() if "/" not in line)
    folder = tmp_path / "out" / "predictions"
    kinds = {path.stem: load_predictions(path).about.kind for path in folder.iterdir()}
    assert kinds == {
        "aerial_aligned": "retrieval", "aerial_aligned_verified-20": "retrieval + height maps",
        "aerial_random": "retrieval", "aerial_random_verified-20": "retrieval + height maps",
    }  # fmt: skip
    rows = list(csv.DictReader((tmp_path / "out" / "results.csv").open()))
    assert {(row["kind"], row["verified"]) for row in rows} == {("retrieval", "0"), ("retrieval + height maps", "20")}
    page = (tmp_path / "out" / "index.html").read_text()
    assert "by retrieval + height maps" in page
    assert "by retrieval<" in page
    # Stored answers can be verified later, otherwise, and scored as they lie.
    monkeypatch.setattr(evaluate, "predict_all", lambda *_: pytest.fail("nothing must be predicted"))
    assert evaluate.main([*arguments, "--only-score", "--verify", "10", "--verify-weight", "100"]) == 0
    assert {path.stem for path in folder.iterdir()} == {
        "aerial_aligned", "aerial_aligned_verified-10", "aerial_random", "aerial_random_verified-10",
    }  # fmt: skip
    assert evaluate.main([*arguments, "--only-score"]) == 0
    content = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [each["about"]["verified"] for each in content] == [0, 10, 0, 10]
    assert content[1]["about"]["verification_weight"] == 100.0


def test_answers_that_height_maps_cannot_order_are_one_clear_line(
    evaluated: tuple[Path, list[str]], calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(evaluated[0], tmp_path / "out")
    arguments = [*evaluated[1], "--output", str(tmp_path / "out"), "--only-score", "--verify", "20"]
    assert "without a calibration" in fails(arguments, capsys)
    arguments += ["--weights", str(calibrated)]
    assert "'candidates'" in fails([*arguments, "--verify", "-1"], capsys)
    assert "'weight'" in fails([*arguments, "--verify-weight", "-1"], capsys)
    assert "--protocol place" in fails(["--protocol", "pose", "--verify", "20"], capsys)
    stored = tmp_path / "out" / "predictions" / "aerial_random.npz"
    made = load_predictions(stored)
    save_predictions(
        stored, dataclasses.replace(made, about=dataclasses.replace(made.about, encoder="0123456789abcdef"))
    )
    assert "predict again" in fails(arguments, capsys)
    for path in stored.parent.glob("aerial_[ar]*.npz"):
        path.unlink()
    assert "--setting aerial" in fails(arguments, capsys)


def fails(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert evaluate.main(arguments) == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("error:"))
    return line


def test_bad_input_is_one_clear_line(
    evaluated: tuple[Path, list[str]], weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, arguments = evaluated
    assert "no such weights" in fails(["--weights", str(tmp_path / "none.safetensors")], capsys)
    (tmp_path / "photo.safetensors").write_bytes(b"\xff\xd8 a photo")
    assert "cannot be read" in fails(["--weights", str(tmp_path / "photo.safetensors")], capsys)
    assert "no weights" in fails(["--weights", str(weights), "--method", "scan_context"], capsys)
    assert "--workers" in fails([*arguments, "--workers", "0"], capsys)
    assert "query_headings" in fails([*arguments, "--query-headings", "0"], capsys)
    missing = ["--weights", str(weights), "--dataset", str(tmp_path / "missing")]
    assert str(tmp_path / "missing") in fails(missing, capsys)
    surveys = ["--weights", str(weights), "--benchmark", "amsterdam", "--surveys", str(tmp_path)]
    assert "ahn2_2010.laz" in fails([*surveys, "--data", str(tmp_path / "data")], capsys)
    nothing = [*arguments, "--output", str(tmp_path / "empty"), "--only-score"]
    assert "no predictions" in fails(nothing, capsys)
    shutil.copytree(output, tmp_path / "copy")
    (tmp_path / "copy" / "predictions" / "aerial_random.npz").write_bytes(b"cut")
    assert "damaged" in fails([*arguments, "--output", str(tmp_path / "copy"), "--only-score"], capsys)


def test_predictions_of_another_benchmark_are_not_scored(
    evaluated: tuple[Path, list[str]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = dataclasses.replace(TINY, towns=TINY.towns[:1], queries=2)
    monkeypatch.setitem(benchmarks.BENCHMARKS, "simulated_small", other)
    assert "another set" in fails([*evaluated[1], "--only-score"], capsys)


def test_a_setting_that_the_benchmark_lacks_is_told(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tiny: object
) -> None:
    alone = dataclasses.replace(TINY, towns=TINY.towns[:1], queries=2, ground=0)
    monkeypatch.setitem(benchmarks.BENCHMARKS, "simulated_small", alone)
    arguments = ["--weights", str(weights), "--benchmark", "simulated_small", "--setting", "aerial+ground"]
    assert "no ground database" in fails([*arguments, "--data", str(tmp_path)], capsys)


def test_a_published_dataset_is_evaluated_as_it_is(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    preset, folder = PRESETS["campus"], tmp_path / "campus"
    aerial = [f"umd/umcp_lidar5_cloud_7/aerial/{i}.bin" for i in range(6)]
    ground = [f"umd/umcp_lidar5_ground_umd_gps_{i}/aerial/{i}.bin" for i in range(5)]
    for file in (*aerial, *ground):
        points = rng.uniform(-1, 1, (CLOUD_POINTS, 3))
        points[:, 2] *= 0.2 if file in aerial else 0.8
        write_cloud(folder, file, points)

    def entry(file: str, number: int) -> dict[object, object]:
        return {"query": file, "northing": 4_317_000.0, "easting": 331_500.0 + 30.0 * number}

    both = {i: entry(file, i % 6) for i, file in enumerate([*aerial, *ground])}
    queries = [[{**entry(file, i), 0: [i]} for i, file in enumerate(ground[:3])]]
    (folder / preset.database).write_bytes(pickle.dumps([both], 4))
    (folder / preset.queries).write_bytes(pickle.dumps(queries, 4))

    output = ["--data", str(tmp_path / "data"), "--output", str(tmp_path / "out")]
    arguments = ["--weights", str(weights), "--dataset", str(folder), *output]
    assert evaluate.main(arguments) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "results.csv").open()))
    databases = {row["setting"]: row for row in rows if row["divided_by"] == "all"}
    assert set(databases) == {"aerial", "aerial+ground"}
    assert {row["queries"] for row in databases.values()} == {"3"}
    assert {row["heading"] for row in rows} == {"aligned", "random"}
    (folder / aerial[2]).unlink()
    assert Path(aerial[2]).name in fails(arguments, capsys)


@pytest.mark.slow
def test_amsterdam_is_made_of_the_two_surveys(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = AmsterdamBenchmark(drive_every_m=60.0, spread=10, build=BuildConfig(spacing_m=57.0))
    monkeypatch.setitem(benchmarks.BENCHMARKS, "amsterdam", small)
    arguments = ["--weights", str(weights), "--benchmark", "amsterdam", "--data", str(tmp_path / "data")]
    assert evaluate.main([*arguments, "--output", str(tmp_path / "out"), "--heading", "random"]) == 0
    rows = list(csv.DictReader((tmp_path / "out" / "results.csv").open()))
    groups = {row["name"]: int(row["queries"]) for row in rows if row["divided_by"] == "group"}
    assert set(groups) == {"the demo's drive", "all streets"}
    assert groups["the demo's drive"] >= 9
    assert np.isfinite([float(row["recall"]) for row in rows if row["counted"] != "0"]).all()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--protocol", "pose", "--dataset", "data"], "knows neither"),
        (["--protocol", "pose", "--method", "scan_context"], "knows neither"),
        (["--protocol", "pose", "--workers", "0"], "at least 1"),
        (["--protocol", "pose", "--every", "0"], "--every must be at least 1"),
        (["--protocol", "pose", "--set", "fusion"], "NAME=VALUE"),
        (["--protocol", "pose", "--set", "fusion.nonsense=1"], "unknown setting 'fusion.nonsense'"),
        (["--protocol", "pose", "--set", "fusion.min_probability=2"], "must lie between"),
        (["--protocol", "pose", "--set", "top_k=5", "--set", "top_k.x=1"], "was given a value before"),
        (["--protocol", "pose", "--only-score"], "without --only-score"),
        (["--protocol", "place", "--set", "top_k=5"], "add --protocol pose"),
    ],
)
def test_options_of_the_other_protocol_are_refused(
    options: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate.main([*options, "--output", str(tmp_path / "out"), "--data", str(tmp_path / "data")]) == 2
    assert complaint in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "data").exists()


def test_settings_are_read_as_groups() -> None:
    read = parse_assignments(
        ["top_k=5", "fusion.min_probability=0.9", "scan.mounting.z_m=1.5", "fusion.unknown_motion_decay_s=2"]
    )
    assert read == {
        "top_k": 5, "fusion": {"min_probability": 0.9, "unknown_motion_decay_s": 2}, "scan": {"mounting": {"z_m": 1.5}},
    }  # fmt: skip


def test_a_benchmark_of_poses_has_no_places(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "--weights",
        str(weights),
        "--benchmark",
        "fitting",
        "--output",
        str(tmp_path),
        "--data",
        str(tmp_path),
    ]
    assert evaluate.main(arguments) == 2
    assert "--protocol pose" in capsys.readouterr().err


@pytest.mark.slow
def test_poses_are_asked_written_and_scored_again(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = BenchmarkTown("suburb", 990_021, False)
    town = SimulatedPoses(
        SimulatedBenchmark((one,), 260.0, 3, 0, flight=SurveyConfig(spacing_m=0.8), build=BuildConfig(spacing_m=38.0)),
        columns=1, off_map=(BenchmarkTown("campus", 990_022, False),), off_map_scans=2,
    )  # fmt: skip
    plans = tuple(DrivePlan(f"drive {i}", i, 40.0, 2.5, 5, i, True, 1.2, 0.0) for i in range(2))
    arguments = [
        "--protocol", "pose", "--weights", str(weights), "--benchmark", "simulated_small", "--workers", "2",
        "--set", "fusion.min_probability=0.9", "--data", str(tmp_path / "data"), "--output", str(tmp_path / "out"),
    ]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(pose_sets.POSE_SETS, "simulated_small", town)
        patch.setattr(pose_drives, "drive_plans", lambda _: plans)
        assert evaluate.main(arguments) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["about"]["config"]["fusion"]["min_probability"] == 0.9
    rows = {row["measure"]: row for row in results["table"]}
    assert rows["end_to_end"]["count"] == 3
    assert rows["until_median"]["count"] == 1
    before = (tmp_path / "out" / "results.csv").read_text()
    shutil.rmtree(tmp_path / "data")
    assert evaluate.main([*arguments, "--only-score"]) == 0
    assert (tmp_path / "out" / "results.csv").read_text() == before
    assert (tmp_path / "out" / "index.html").stat().st_size > 10_000
    assert "Single scans" in capsys.readouterr().out
