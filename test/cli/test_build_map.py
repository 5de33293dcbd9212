"""The command: a map, a summary, exit codes, Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli import build_map, cut_survey
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.formats.las import iter_chunks, read_header, write_laz

MAPS = Path(__file__).resolve().parents[2] / "maps"


@pytest.fixture
def survey(tmp_path: Path) -> Path:
    """Houses on a plain, classified, RD New."""
    rng = np.random.default_rng(0)
    e, n = rng.uniform(0, 150, 60_000), rng.uniform(0, 120, 60_000)
    house = (e % 25 < 10) & (n % 25 < 8)
    points = np.column_stack([e + 121_000.0, n + 486_000.0, np.where(house, 7.0, 0.0)])
    classes = np.where(house, 6, 2).astype(np.uint8)
    classes[:100] = 7
    write_laz(tmp_path / "town.laz", points, classes, "EPSG:28992")
    return tmp_path / "town.laz"


def test_a_map_and_what_it_came_to(
    survey: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "map"
    arguments = [str(survey), "--output", str(output), "--weights", str(weights), "--geoid-separation", "43.2"]
    assert build_map.main([*arguments, "--spacing-m", "25"]) == 0
    printed = capsys.readouterr()
    for part in (
        "class 2 of the files", "100 dropped", "EPSG:32631", "+43.20 m to the ellipsoid", "every 25 m",
        "left out for lack of points", "points in", "a second",
    ):  # fmt: skip
        assert part in printed.out
    for stage in ("reading:", "encoding:", "writing:"):
        assert stage in printed.err  # progress, also where nobody looks at a terminal
    aerial = AerialMap.load(output, load_encoder(weights).fingerprint)
    assert aerial.manifest.build.spacing_m == 25.0 and aerial.frame.geoid_separation_m == 43.2

    assert build_map.main(arguments) == 2
    assert capsys.readouterr().err.count("\n") == 1  # one line
    assert build_map.main([*arguments, "--overwrite"]) == 0
    assert AerialMap.load(output).manifest.build.spacing_m == 19.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.laz"], "no such file"),
        (["{survey}", "--weights", "nowhere.safetensors"], "nowhere.safetensors"),
        (["{survey}", "--spacing-m", "0"], "'spacing_m' must lie between"),
        (["{survey}", "--crs", "EPSG:1"], "EPSG:1"),
        (["{survey}", "--lidar-height-m", "1.8"], "--lidar-height-m is of use with --calibrate alone"),
        (["{survey}", "--calibrate", "--lidar", "vlp-17"], "unknown lidar 'vlp-17'"),
    ],
)
def test_errors_are_one_line_and_code_2(
    survey: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    given = [a.format(survey=survey) for a in arguments]
    if "--weights" not in given:
        given += ["--weights", str(weights)]
    assert build_map.main([*given, "--output", str(tmp_path / "map")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and message in error


@pytest.mark.parametrize("how", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_stopped_command_goes_on(survey: Path, weights: Path, tmp_path: Path, how: signal.Signals) -> None:
    command = [
        sys.executable, "-m", "crossloc3d_ros.cli.build_map", str(survey), "--output", str(tmp_path / "map"),
        "--weights", str(weights), "--tile-m", "57", "--spacing-m", "9", "-v",
    ]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith("encoding:"):
            break
    process.send_signal(how)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130 and error.rstrip().endswith("interrupted") and "Traceback" not in error
    assert not (tmp_path / "map").exists() and (tmp_path / "map.build").exists()
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert finished.returncode == 0 and "an earlier build was continued" in finished.stdout
    AerialMap.load(tmp_path / "map")
    assert not (tmp_path / "map.build").exists()


def test_a_cut_keeps_what_lies_within(survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "cut.laz"
    bounds = ["121020", "486010", "121070", "486050"]
    assert cut_survey.main([str(survey), "--output", str(output), "--bounds", *bounds]) == 0
    assert "EPSG:28992" in capsys.readouterr().out
    (chunk,) = iter_chunks(output)
    (everything,) = iter_chunks(survey)
    e, n = everything.points[:, 0], everything.points[:, 1]
    inside = (e >= 121_020) & (e < 121_070) & (n >= 486_010) & (n < 486_050)
    np.testing.assert_allclose(chunk.points, everything.points[inside], atol=0.006)
    np.testing.assert_array_equal(chunk.classification, everything.classification[inside])
    assert cut_survey.main([str(survey), "--output", str(tmp_path / "none.laz"), "--bounds", "0", "0", "1", "1"]) == 2
    assert not (tmp_path / "none.laz").exists()


def test_the_shipped_surveys_are_whole_and_small() -> None:
    files = {"ahn2_2010.laz": 1_742_364, "ahn3_2014.laz": 715_273}
    folder = MAPS / "amsterdam"
    assert {path.name for path in folder.glob("*.laz")} == set(files)
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 8_000_000
    for name, count in files.items():
        header = read_header(folder / name)
        assert (header.point_count, header.crs) == (count, "EPSG:28992")
    readme = (MAPS / "README.md").read_text(encoding="utf-8")
    assert "AHN, Rijkswaterstaat / PDOK, CC0" in readme
