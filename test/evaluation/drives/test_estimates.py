"""Estimates on disk: CSV that reads back, GeoJSON that other programs accept."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros import files
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.evaluation.drives import estimates
from crossloc3d_ros.evaluation.drives.geojson import write_geojson
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import (
    AlignedPoses,
    Candidates,
    Estimate,
    FixStatus,
    Hypotheses,
    ScanCounts,
    Timings,
    TrackState,
)

FRAME = MapFrame("EPSG:32631", np.array([628_700.0, 5_803_600.0, 2.0]), 43.0)
STAMP = 1_700_000_000_123_456_789


def estimate(seed: int, candidates: int = 3, status: FixStatus = FixStatus.FIX, reason: str = "agreed") -> Estimate:
    rng = np.random.default_rng(seed)
    grid = np.array([628_700.0, 5_803_600.0, 3.0]) + rng.normal(0, 100, 3)
    root = rng.normal(size=(3, 3))
    latitude, longitude, altitude = FRAME.to_geographic(grid[None])
    places = np.array([628_700.0, 5_803_600.0, 3.0]) + rng.normal(0, 100, (candidates, 3))
    return Estimate(
        stamp_ns=STAMP + seed,
        status=status,
        reason=reason,
        grid=grid if candidates else np.full(3, np.nan),
        enu=np.zeros(3),
        latitude_deg=float(latitude[0]) if candidates else float("nan"),
        longitude_deg=float(longitude[0]) if candidates else float("nan"),
        altitude_m=float(altitude[0]) if candidates else float("nan"),
        covariance=root @ root.T if candidates else np.full((3, 3), np.nan),
        candidates=Candidates(
            rng.integers(0, 1000, candidates),
            rng.uniform(size=candidates).astype(np.float32),
            rng.dirichlet(np.ones(candidates)) if candidates else np.empty(0),
            places,
        ),
        counts=ScanCounts(received=28_800, in_patch=4096),
        timings=Timings(5.25, 11.5, 0.25),
    )


def covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    root = rng.normal(size=(count, 3, 3)) * [1.0, 1.0, 0.05]
    return np.swapaxes(root, 1, 2) @ root


def posed(seed: int, aligned: int = 4, hypotheses: int = 2, heading_rad: float = 0.3) -> Estimate:
    """Return an estimate that knows its pose."""
    rng = np.random.default_rng([seed, 1])
    place = np.array([628_700.0, 5_803_600.0, 3.0])
    T_map_base = np.eye(4)
    T_map_base[:2, :2] = [
        [np.cos(heading_rad), -np.sin(heading_rad)],
        [np.sin(heading_rad), np.cos(heading_rad)],
    ]
    return replace(
        estimate(seed),
        timings=Timings(5.25, 11.5, 0.25, 40.0, 2.0),
        state=TrackState.LOCALIZED,
        probability=0.99925,
        T_map_base=T_map_base,
        pose_covariance=np.diag([0.04, 0.09, 1.0, 1e-3, 1e-3, 0.0004]),
        aligned=AlignedPoses(
            place + rng.normal(0, 50, (aligned, 3)),
            rng.uniform(-np.pi, np.pi, aligned),
            covariances(rng, aligned),
            np.sort(rng.normal(0, 9, aligned))[::-1],
            rng.dirichlet(np.ones(aligned)) if aligned else np.empty(0),
            rng.uniform(size=aligned),
            rng.uniform(size=aligned) < 0.5,
            np.where(np.arange(aligned) % 2, -1, np.arange(aligned)),
        ),
        hypotheses=Hypotheses(
            place + rng.normal(0, 50, (hypotheses, 3)),
            rng.uniform(-np.pi, np.pi, hypotheses),
            covariances(rng, hypotheses),
            rng.dirichlet(np.ones(hypotheses)) if hypotheses else np.empty(0),
        ),
    )


AWKWARD = 'a "quoted", comma\nand a line; ünïcode </script> '


def write(path: Path, rows: list[Estimate]) -> Path:
    with estimates.EstimateWriter(path) as writer:
        for row in rows:
            writer.write(row)
    return path


def test_what_was_written_is_read_again(tmp_path: Path) -> None:
    rows = [
        estimate(0),
        estimate(1, candidates=25, status=FixStatus.NO_FIX, reason=AWKWARD),
        estimate(2, candidates=0, status=FixStatus.NO_FIX, reason="3 of 28,800 points left after filtering"),
    ]
    table = estimates.read_estimates(write(tmp_path / "e.csv", rows))
    assert table.stamp_ns.tolist() == [STAMP, STAMP + 1, STAMP + 2]  # nanoseconds survive
    assert table.has_fix.tolist() == [True, False, False]
    assert table.reasons == tuple(row.reason for row in rows)
    assert table.candidate_ids.shape == (3, 25)
    assert table.timings_ms[0].tolist() == [5.25, 11.5, 0.25, 0.0, 0.0, 17.0]
    assert table.latency_ms[0] == 17.0
    assert not table.has_track
    assert table.points[0].tolist() == [28_800, 4096]
    for i, row in enumerate(rows):
        k = len(row.candidates)
        assert table.candidate_ids[i, :k].tolist() == row.candidates.submap_ids.tolist()
        assert (table.candidate_ids[i, k:] == -1).all()
        np.testing.assert_allclose(table.candidate_distances[i, :k], row.candidates.descriptor_distances, rtol=1e-5)
        np.testing.assert_allclose(table.candidate_probabilities[i, :k], row.candidates.probabilities, rtol=1e-5)
        np.testing.assert_allclose(table.candidate_grid[i, :k], row.candidates.grid[:, :2], atol=0.01)
        assert np.isnan(table.candidate_grid[i, k:]).all()
        np.testing.assert_allclose(table.covariance[i], row.covariance, atol=1e-3)
        np.testing.assert_allclose(table.grid[i], row.grid, atol=1e-3)
        np.testing.assert_allclose(table.geographic[i, :2], [row.latitude_deg, row.longitude_deg], atol=1e-8)
    assert np.isnan(table.truth_grid).all()


def test_poses_are_read_again(tmp_path: Path) -> None:
    rows = [posed(0), posed(1, aligned=0, hypotheses=5, heading_rad=-3.1), estimate(2, candidates=0)]
    table = estimates.read_estimates(write(tmp_path / "e.csv", rows))
    assert table.has_track
    assert table.states == (TrackState.LOCALIZED, TrackState.LOCALIZED, None)  # the last one tells nothing
    np.testing.assert_allclose(table.probability, [0.99925, 0.99925, np.nan])
    np.testing.assert_allclose(table.heading_rad, [0.3, -3.1, np.nan], atol=2e-6)
    np.testing.assert_allclose(table.heading_std_rad[:2], 0.02, rtol=1e-4)
    assert table.timings_ms[0].tolist() == [5.25, 11.5, 0.25, 40.0, 2.0, 59.0]
    for lists, name in ((table.aligned, "aligned"), (table.hypotheses, "hypotheses")):
        for i, row in enumerate(rows):
            poses = getattr(row, name)
            n = len(poses)
            assert lists.count(i) == n
            np.testing.assert_allclose(lists.grid[i, :n], poses.grid[:, :2], atol=0.006)
            np.testing.assert_allclose(lists.heading_rad[i, :n], poses.heading_rad, atol=1e-4)
            np.testing.assert_allclose(lists.covariance[i, :n], poses.covariance[:, :2, :2], rtol=1e-3)
            np.testing.assert_allclose(lists.heading_std_rad[i, :n], np.sqrt(poses.covariance[:, 2, 2]), rtol=6e-3)
            np.testing.assert_allclose(lists.probabilities[i, :n], poses.probabilities, rtol=1e-5)
            assert np.isnan(lists.grid[i, n:]).all()
    first = next(csv.DictReader((tmp_path / "e.csv").open(newline="")))
    assert [int(source) for source in first["aligned_sources"].split()] == [0, -1, 2, -1]


def test_files_from_before_there_were_poses_are_read_and_scored(tmp_path: Path) -> None:
    """The columns as the first release wrote them."""
    path = write(tmp_path / "e.csv", [estimate(0), estimate(1, candidates=0, status=FixStatus.NO_FIX)])
    new = ("state", "probability", "heading_", "align_ms", "fuse_ms", "aligned_", "hypothesis_")
    rows = [{k: v for k, v in row.items() if not k.startswith(new)} for row in csv.DictReader(path.open(newline=""))]
    assert len(rows[0]) == 26
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    truth = np.array([[628_700.0, 5_803_600.0], [628_701.0, 5_803_600.0]])
    for table in (estimates.read_estimates(path), estimates.add_truth(path, truth, FRAME, np.array([0.1, 0.2]))):
        assert len(table) == 2
        assert not table.has_track
        assert table.states == (None, None)
        assert np.isnan(table.probability).all()
        assert table.aligned.grid.shape == table.hypotheses.grid.shape == (2, 0, 2)
        assert table.latency_ms[0] == 17.0
        assert np.isnan(table.timings_ms[0, 3])
    np.testing.assert_allclose(table.truth_heading_rad, [0.1, 0.2], atol=2e-6)
    assert np.isfinite(table.error_m[0])
    assert np.isnan(table.heading_error_rad).all()


def test_heading_errors_go_the_short_way_round(tmp_path: Path) -> None:
    rows = [posed(0, heading_rad=3.1), posed(1, heading_rad=-3.0), posed(2, heading_rad=0.5), posed(3)]
    path = write(tmp_path / "e.csv", rows)
    truth = np.array([row.grid[:2] for row in rows])
    table = estimates.add_truth(path, truth, FRAME, np.array([-3.1, 3.0, 0.25, np.nan]))
    expected = np.array([6.2 - 2 * np.pi, 2 * np.pi - 6.0, 0.25, np.nan])
    np.testing.assert_allclose(table.heading_error_rad, expected, atol=1e-5)
    written = [float(r["heading_error_deg"] or "nan") for r in csv.DictReader(path.open(newline=""))]
    np.testing.assert_allclose(written, np.degrees(expected), atol=1e-3)


def test_a_run_that_is_cut_short_leaves_whole_rows(tmp_path: Path) -> None:
    path = tmp_path / "e.csv"
    with pytest.raises(KeyboardInterrupt), estimates.EstimateWriter(path) as writer:
        writer.write(estimate(0))
        writer.write(estimate(1, reason=AWKWARD))
        raise KeyboardInterrupt
    assert len(estimates.read_estimates(path)) == 2


def test_truth_is_added_without_touching_the_predictions(tmp_path: Path) -> None:
    rows = [estimate(i, reason=AWKWARD) for i in range(4)]
    path = write(tmp_path / "e.csv", rows)
    before = list(csv.DictReader(path.open(newline="")))
    offsets = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0], [np.nan] * 3, [30.0, 40.0, 9.0]])
    truth = np.array([row.grid for row in rows]) + offsets
    table = estimates.add_truth(path, truth, FRAME)
    after = list(csv.DictReader(path.open(newline="")))
    assert [{k: v for k, v in row.items() if k in before[0]} for row in after] == before
    np.testing.assert_allclose(table.error_m, [5.0, 0.0, np.nan, 50.0], atol=2e-3)
    np.testing.assert_allclose([float(r["error_m"] or "nan") for r in after], [5.0, 0.0, np.nan, 50.0], atol=2e-3)
    back = FRAME.from_geographic(
        np.array([float(after[3]["truth_latitude_deg"])]), np.array([float(after[3]["truth_longitude_deg"])])
    )
    np.testing.assert_allclose(back[0, :2], truth[3, :2], atol=1e-3)
    again = estimates.add_truth(path, truth, FRAME)  # scoring twice is scoring once
    np.testing.assert_array_equal(again.truth_grid, table.truth_grid)


def positions(geometry: dict) -> list:
    if geometry is None:
        return []
    if geometry["type"] == "GeometryCollection":
        return [p for part in geometry["geometries"] for p in positions(part)]
    nesting = {"Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2}[geometry["type"]]
    flat = [geometry["coordinates"]]
    for _ in range(nesting):
        flat = [item for level in flat for item in level]
    return flat


def assert_is_rfc_7946(document: dict) -> None:
    assert document["type"] == "FeatureCollection"
    assert "crs" not in document  # withdrawn by the RFC: it is always WGS84
    for feature in document["features"]:
        assert feature["type"] == "Feature"
        assert set(feature) >= {"geometry", "properties"}
        geometry = feature["geometry"]
        lines = [geometry] if geometry and geometry["type"] != "GeometryCollection" else []
        lines += geometry["geometries"] if geometry and geometry["type"] == "GeometryCollection" else []
        for part in lines:
            if part["type"] == "LineString":
                assert len(part["coordinates"]) >= 2
            if part["type"] == "MultiLineString":
                assert all(len(line) >= 2 for line in part["coordinates"])
        for position in positions(geometry):
            assert len(position) in (2, 3)
            assert -180 <= position[0] <= 180
            assert -90 <= position[1] <= 90


@pytest.mark.parametrize(
    "known",
    [[1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0], [1, 1, 0, 1, 1, 1], [1, 0, 1, 0, 1, 0], [1, 1, 0, 1, 0, 0]],
    ids=["all", "none", "gap", "alone", "mixed"],
)
def test_geojson_is_rfc_7946(tmp_path: Path, known: list[int]) -> None:
    rows = [estimate(i, candidates=0 if i == 2 else 25, reason=AWKWARD) for i in range(5)] + [posed(5)]
    path = write(tmp_path / "e.csv", rows)
    truth = np.array([[628_700.0 + 10 * i, 5_803_600.0] if here else [np.nan] * 2 for i, here in enumerate(known)])
    table = estimates.add_truth(path, truth, FRAME)
    write_geojson(tmp_path / "e.geojson", table, FRAME)
    document = json.loads((tmp_path / "e.geojson").read_text(), parse_constant=pytest.fail)  # NaN is no JSON
    assert_is_rfc_7946(document)
    kinds = [feature["properties"]["kind"] for feature in document["features"]]
    assert kinds.count("truth") == (1 if any(known) else 0)
    assert kinds.count("fix") == 6
    assert kinds.count("candidates") == 5
    assert kinds.count("hypotheses") == 1
    properties = [f["properties"] for f in document["features"] if f["properties"].get("scan") == 5]
    assert properties[0]["state"] == "localized"
    assert properties[0]["heading_deg"] == pytest.approx(np.degrees(0.3), abs=0.01)
    if any(known):
        assert len(positions(document["features"][0]["geometry"])) == sum(known)
    unlocated = [f for f in document["features"] if f["properties"].get("scan") == 2]
    assert [f["geometry"] for f in unlocated] == [None]
    first = next(f for f in document["features"] if f["properties"]["kind"] == "fix")
    longitude, latitude, altitude = first["geometry"]["coordinates"]
    assert (longitude, latitude) == pytest.approx((rows[0].longitude_deg, rows[0].latitude_deg), abs=1e-7)
    assert altitude == pytest.approx(rows[0].altitude_m, abs=0.01)
    assert first["properties"]["stamp_ns"] == str(STAMP)


def test_foreign_and_broken_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(CrossLocError, match=r"nothing\.csv"):
        estimates.read_estimates(tmp_path / "nothing.csv")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(CrossLocError, match=r"other\.csv is not a file of estimates"):
        estimates.read_estimates(tmp_path / "other.csv")
    path = write(tmp_path / "e.csv", [estimate(0)])
    with pytest.raises(CrossLocError, match="truth for 2 scans does not fit the 1 estimates"):
        estimates.add_truth(path, np.zeros((2, 2)), FRAME)
    with pytest.raises(CrossLocError, match="cannot write"), estimates.EstimateWriter(path / "below" / "e.csv"):
        pass
    with pytest.raises(CrossLocError, match="cannot write"):
        files.write_atomically(tmp_path / "no" / "such" / "folder.txt", "text")


def test_a_full_disk_is_said_and_the_old_file_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "page.html"
    files.write_atomically(path, "old")

    def full(self: Path, *arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CrossLocError, match=r"cannot write .*page\.html.*No space left"):
        files.write_atomically(path, "new")
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
