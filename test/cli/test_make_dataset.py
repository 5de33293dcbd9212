"""The command: what it prints, how it fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from crossloc3d_ros.cli.make_dataset import main
from crossloc3d_ros.formats.cs_campus3d import read_info


def test_recordings_and_a_survey_become_a_dataset(
    recorded_area, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # type: ignore[no-untyped-def]
    output = tmp_path / "own"
    call = [
        "--bags", *map(str, recorded_area.bags), "--survey", str(recorded_area.survey), "--output", str(output),
        "--half-extent-m", "15", "--scan-half-extent-m", "15", "--min-points", "40", "--spacing-m", "12",
        "--scan-spacing-m", "6", "--validation-share", "0", "--z-m", "1.2",
    ]  # fmt: skip
    assert main(call) == 0
    printed = capsys.readouterr().out
    assert f"{output}, {recorded_area.crs}" in printed
    assert "13 left out: the receiver had no fix" in printed
    assert "9 left out: the GNSS covariance is too large" in printed
    info = read_info(output)
    assert info["preprocessing"]["half_extent_m"] == 15.0
    assert info["scan"]["mounting"]["z_m"] == 1.2
    assert f"{info['scans']['test']:,} scans" in printed

    assert main(call) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--bags", "none"], "none does not exist"),
        (["--test-share", "0.9", "--validation-share", "0.2"], "must leave something to learn from"),
        (["--scan-spacing-m", "-1"], "scan_spacing_m"),
        (["--gnss-topic", "/fix"], "has no topic '/fix'"),
        (["--config", "none.yaml"], "cannot read none.yaml"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    recorded_area, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: list[str], message: str
) -> None:  # type: ignore[no-untyped-def]
    call = [
        "--bags", str(recorded_area.bags[0]), "--survey", str(recorded_area.survey), "--output", str(tmp_path / "own"),
        *change,
    ]  # fmt: skip
    assert main(call) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert not (tmp_path / "own").exists()


def test_a_real_recording_without_gnss_is_refused(shared, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    bag, survey = shared("data/vlp16/einride_vlp16_pointcloud2_sqlite3"), shared("data/aerial")
    assert main(["--bags", str(bag), "--survey", str(survey), "--output", str(tmp_path / "own")]) == 2
    error = capsys.readouterr().err
    assert "NavSatFix" in error
    assert "a dataset needs GNSS" in error
