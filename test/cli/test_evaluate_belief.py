"""`evaluate --protocol belief` from nothing to the page: pieces are made once, and scores need nothing else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli import evaluate
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.datasets import belief_sets, halves, pose_drives, pose_sets
from crossloc3d_ros.datasets.belief_conditions import DELIVERED, Condition
from crossloc3d_ros.datasets.belief_sets import are_apart
from crossloc3d_ros.datasets.pose_drives import DrivePlan, Journey, Leg, RawDrive
from crossloc3d_ros.datasets.pose_sets import SimulatedPoses
from crossloc3d_ros.datasets.raw_scans import RawScan, RawScans
from crossloc3d_ros.datasets.simulated import BenchmarkTown, SimulatedBenchmark
from crossloc3d_ros.formats.las import write_laz
from crossloc3d_ros.simulation.survey import SurveyConfig
from crossloc3d_ros.types import Float64Array

TOWN = SimulatedPoses(
    SimulatedBenchmark(
        (BenchmarkTown("suburb", 990_021, False),), 260.0, 3, 0, flight=SurveyConfig(spacing_m=0.8),
        build=BuildConfig(spacing_m=38.0),
    ),
    columns=1, off_map=(BenchmarkTown("campus", 990_022, False),), off_map_scans=2,
)  # fmt: skip
PLANS = tuple(DrivePlan(f"drive {i}", i, 20.0, 2.5, 5, i, True, 1.2, 0.0) for i in range(2))
THIN, AGED, FEW = Condition("0.5 points/m2", 0.5), Condition("aged", is_aged=True), Condition("few", every_point=20)
BEAMS = Condition("64 beams", lidar="os1-64")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--protocol", "belief", "--dataset", "data"], "--protocol belief knows neither"),
        (["--protocol", "belief", "--every", "0"], "--every must be at least 1"),
        (["--protocol", "belief", "--odometry", "scan"], "leave --odometry out"),
        (["--protocol", "belief", "--only-score"], "without --only-score"),
        (["--protocol", "belief", "--aerial", "nowhere.laz"], "no such file"),
        (["--protocol", "pose", "--aerial", "woods.laz"], "--protocol belief"),
        (["--learned", "woods.laz"], "--protocol belief"),
    ],
)
def test_bad_options_are_one_clear_line(
    options: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate.main([*options, "--output", str(tmp_path / "out"), "--data", str(tmp_path / "data")]) == 2
    assert complaint in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "data").exists()


def test_a_scan_is_seen_as_the_condition_says() -> None:
    points = np.random.default_rng(0).uniform(-60, 60, (4000, 3)).astype(np.float32)
    scan = RawScan(points, np.eye(4), np.eye(4))
    assert DELIVERED.seen(scan) is scan
    np.testing.assert_array_equal(FEW.seen(scan).points, points[::20])
    near = Condition("near", max_range_m=30.0).seen(scan).points
    assert len(near) == (np.linalg.norm(points, axis=1) <= 30.0).sum() > 0
    drive = RawDrive(PLANS[0], RawScans.of([scan, scan]), np.zeros(0, np.int64), np.zeros((0, 3)))
    one, other = FEW.driven([drive, drive], Journey((Leg(1),)))
    assert one is drive
    assert [len(each.points) for each in other.scans] == [200, 200]


def test_only_poses_away_from_a_map_are_off_it(town_map: AerialMap) -> None:
    west, south, east, north = town_map.bounds

    def pose_at(easting: float, northing: float) -> Float64Array:
        pose = np.eye(4)
        pose[:2, 3] = easting, northing
        return pose[None]

    middle = (west + east) / 2, (south + north) / 2
    assert not are_apart(town_map, town_map, pose_at(*middle))
    assert not are_apart(town_map, town_map, pose_at(east + 50.0, middle[1]))
    assert are_apart(town_map, town_map, pose_at(east + 500.0, middle[1]))
    assert are_apart(town_map, town_map, pose_at(middle[0], south - 500.0))


@pytest.fixture
def park(tmp_path: Path) -> Path:
    """Write a survey of 120 x 120 m in another country: lawns, huts and hedges, 12 points/m2, with ground class."""
    rng = np.random.default_rng(5)
    xy = rng.uniform(0, 120, (170_000, 2))
    huts = rng.uniform(5, 115, (40, 2))
    inside = (np.abs(xy[:, None] - huts[None]).max(axis=2) < 3.0).any(axis=1)
    points = np.column_stack([xy + np.array([4e5, 5.3e6]), np.where(inside, 4.0, 0.0) + rng.normal(0, 0.02, len(xy))])
    write_laz(tmp_path / "park.laz", points, np.where(inside, 6, 2).astype(np.uint8), "EPSG:32632", scale=0.001)
    return tmp_path / "park.laz"


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_belief_is_predicted_piece_by_piece_and_scored_again(
    weights: Path, park: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "out"
    arguments = [
        "--protocol", "belief", "--weights", str(weights), "--benchmark", "simulated_small", "--learned", str(park),
        "--data", str(tmp_path / "data"), "--output", str(output),
        "--set", "alignment.scope=candidates", "--set", "alignment.candidates=5",
    ]  # fmt: skip
    monkeypatch.setitem(pose_sets.POSE_SETS, "simulated_small", TOWN)
    monkeypatch.setattr(belief_sets, "CONDITIONS", (DELIVERED, THIN, AGED, BEAMS, FEW))
    monkeypatch.setattr(halves, "_DRIVE_M", 20.0)
    monkeypatch.setattr(halves, "_DRIVES", 1)
    monkeypatch.setattr(halves, "_SCANS", 3)
    for module in (pose_drives, belief_sets):
        monkeypatch.setattr(module, "drive_plans", lambda _: PLANS)
    assert evaluate.main(arguments) == 0
    results = json.loads((output / "results.json").read_text())
    conditions = [(each["condition"], each["learned_from"], each["singles"]) for each in results["sets"]]
    assert conditions == [
        ("as delivered", False, 3), ("0.5 points/m2", False, 3), ("aged", False, 3), ("64 beams", False, 3),
        ("few", False, 3), ("as delivered", True, 3),
    ]  # fmt: skip
    # The drive off the map on the town's, both on the park's; the park's own drive is learned from.
    pairs = {(pair["map_name"], pair["set_name"], pair["drive"]) for pair in results["pairs"]}
    assert pairs == {
        ("simulated_small", "simulated_small", "drive 1"), ("park", "simulated_small", "drive 0"),
        ("park", "simulated_small", "drive 1"),
    }  # fmt: skip
    made = {path: path.stat().st_mtime_ns for path in (output / "pieces").glob("*.npz")}
    assert len(made) == 6 * 2 + 3
    table = (output / "table.md").read_text()

    victim, *_ = made
    victim.unlink()
    assert evaluate.main(arguments) == 0
    again = {path: path.stat().st_mtime_ns for path in (output / "pieces").glob("*.npz")}
    assert {path for path in made if made[path] != again[path]} == {victim}
    shutil.rmtree(tmp_path / "data")
    capsys.readouterr()
    assert evaluate.main([*arguments, "--only-score"]) == 0
    assert (output / "table.md").read_text() == table
    assert "Off the map" in capsys.readouterr().out
    victim.unlink()
    assert evaluate.main([*arguments, "--only-score"]) == 0
    assert "1 of 15 pieces are missing" in (output / "index.html").read_text()
