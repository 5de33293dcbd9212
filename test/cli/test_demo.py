"""The demo's steps: what is current is not made again, and what is missing is named; all of it where time allows."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from crossloc3d_ros.cli import demo
from crossloc3d_ros.datasets import amsterdam, amsterdam_drive
from crossloc3d_ros.errors import MapError
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable, no_pose_lists
from crossloc3d_ros.evaluation.drives.terminal import beside_the_truth
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import TrackState

REPOSITORY = Path(__file__).resolve().parents[2]


def test_the_surveys_of_the_clone_are_found() -> None:
    folder = amsterdam.find_surveys(None)
    assert (folder / amsterdam.MAP_SURVEY).stat().st_size + (folder / amsterdam.DRIVE_SURVEY).stat().st_size < 8_000_000


def test_missing_surveys_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MapError, match=r"does not hold ahn2_2010\.laz and ahn3_2014\.laz"):
        amsterdam.find_surveys(tmp_path)
    pytest.importorskip("rclpy")
    assert demo.main(["--surveys", str(tmp_path), "--output", str(tmp_path / "out")]) == 2
    assert "--surveys" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def quiet(*_: object) -> None:
    """Say nothing."""


def test_what_is_current_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey, folder = tmp_path / "s.laz", tmp_path / "map"
    survey.write_bytes(b"one")
    built: list[str] = []

    def build_map(inputs: list[Path], output: Path, *_: object, **__: object) -> None:
        built.append(inputs[0].read_text())
        output.mkdir(exist_ok=True)

    monkeypatch.setattr(amsterdam_drive, "build_map", build_map)
    damaged: list[str] = []

    def load(folder: Path, fingerprint: str) -> None:
        if damaged:
            raise MapError(damaged.pop())

    monkeypatch.setattr(amsterdam_drive.AerialMap, "load", load)
    amsterdam_drive.make_map(survey, folder, None, "weights-1", quiet, quiet)
    amsterdam_drive.make_map(survey, folder, None, "weights-1", quiet, quiet)
    assert built == ["one"]
    amsterdam_drive.make_map(survey, folder, None, "weights-2", quiet, quiet)
    survey.write_bytes(b"two")
    amsterdam_drive.make_map(survey, folder, None, "weights-2", quiet, quiet)
    assert built == ["one", "one", "two"]
    (tmp_path / "map.made-from.json").write_text("{")
    amsterdam_drive.make_map(survey, folder, None, "weights-2", quiet, quiet)
    assert len(built) == 4
    damaged.append("the index is cut short")
    amsterdam_drive.make_map(survey, folder, None, "weights-2", quiet, quiet)
    assert len(built) == 5


def test_an_interrupted_build_is_not_taken_for_current(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey, folder = tmp_path / "s.laz", tmp_path / "map"
    survey.write_bytes(b"one")

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(amsterdam_drive, "build_map", interrupted)
    with pytest.raises(KeyboardInterrupt):
        amsterdam_drive.make_map(survey, folder, None, "weights", quiet, quiet)
    assert list(tmp_path.glob("*.made-from.json")) == []


@pytest.mark.parametrize("tracked", [False, True])
def test_fixes_stand_beside_the_truth(tracked: bool) -> None:
    frame = MapFrame("EPSG:32631", np.array([628_700.0, 5_803_600.0, 2.0]), 43.0)
    count = 121
    truth = np.column_stack([628_700.0 + np.arange(count), np.full(count, 5_803_600.0)])
    grid = np.column_stack([truth + np.array([30.0, 40.0]), np.zeros(count)])
    latitude, longitude, altitude = frame.to_geographic(grid)
    table = EstimateTable(
        stamp_ns=np.arange(count) * 100_000_000,
        has_fix=np.arange(count) < 60,
        geographic=np.column_stack([latitude, longitude, altitude]),
        grid=grid,
        covariance=np.zeros((count, 3, 3)),
        timings_ms=np.full((count, 6), 21.0),
        points=np.zeros((count, 2), dtype=np.int64),
        candidate_ids=np.zeros((count, 1), dtype=np.int64),
        candidate_distances=np.zeros((count, 1)),
        candidate_probabilities=np.full((count, 1), 0.75),
        candidate_grid=truth[:, None] + np.array([0.0, 12.0]),
        truth_grid=truth,
        truth_heading_rad=np.zeros(count),
        states=((TrackState.LOCALIZED if tracked else None),) * 60
        + ((TrackState.AMBIGUOUS if tracked else None),) * 61,
        probability=np.full(count, 0.99912 if tracked else np.nan),
        heading_rad=np.full(count, np.radians(-1.2) if tracked else np.nan),
        heading_std_rad=np.full(count, np.nan),
        aligned=no_pose_lists(count),
        aligned_sources=np.empty((count, 0), dtype=np.int64),
        hypotheses=no_pose_lists(count),
        reasons=("",) * count,
    )
    said = io.StringIO()
    Console(width=80, file=said).print(beside_the_truth(table, frame))
    lines = [line for line in said.getvalue().splitlines() if line.strip()]
    assert max(len(line) for line in lines) <= 80
    rows = [line.split() for line in lines if " s " in line]
    assert len(rows) == 3  # every five seconds of twelve
    assert [("50" in row) for row in rows] == [True, True, False]
    assert "no fix" in lines[-1]
    if tracked:
        assert [row[-1] for row in rows] == ["localized", "localized", "ambiguous"]
        assert ["1.2°" in row for row in rows] == [True, True, False]
        assert all("99.9" in row for row in rows)
    else:
        assert all("12" in row and "75%" in row for row in rows)
    assert f"{latitude[0]:.5f}," in rows[0]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_whole_demo_on_a_short_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rclpy")
    arguments = ["--output", str(tmp_path), "--length-m", "60", "--speed-m-s", "4"]
    assert demo.main(arguments) == 0
    said = capsys.readouterr()
    for word in ("Fixes beside the truth", "AR@25", str(tmp_path / "index.html")):
        assert word in said.out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["scans"] > 100
    assert summary["scores"]["scored"] == summary["scans"]
    page = (tmp_path / "index.html").read_text()
    assert "simulated" in page
    before = (tmp_path / "map" / "manifest.json").stat().st_mtime_ns, (tmp_path / "drive").stat().st_mtime_ns
    assert demo.main(arguments) == 0
    assert before == ((tmp_path / "map" / "manifest.json").stat().st_mtime_ns, (tmp_path / "drive").stat().st_mtime_ns)
    assert capsys.readouterr().err.count("current, not") == 2
