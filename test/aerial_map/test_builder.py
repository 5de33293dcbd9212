"""The builder: the right map, the same map in every way of building it, and nothing lost when it is stopped."""

from __future__ import annotations

import errno
import json
import logging
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from crossloc3d_ros.aerial_map import builder, spool, store, tile
from crossloc3d_ros.aerial_map.builder import build_map, work_folder
from crossloc3d_ros.aerial_map.progress import BuildProgress
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.tiling import cut_submap, submap_centres
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.errors import AerialDataError, ConfigError, MapError
from crossloc3d_ros.formats.las import write_laz

CRS = "EPSG:32631"


def contents(folder: Path) -> dict[str, bytes]:
    """Return what must agree between two builds of the same map: everything but the manifest's date."""
    files = {name: (folder / name).read_bytes() for name in store.DATA_FILES}
    manifest = json.loads((folder / store.MANIFEST).read_text())
    for name in ("created", "build"):
        del manifest[name]
    return {**files, "manifest": json.dumps(manifest, sort_keys=True).encode()}


@pytest.fixture(scope="module")
def built(survey_file: Path, small_tiles: BuildConfig, tmp_path_factory: pytest.TempPathFactory, town: Any) -> Path:
    """The map of the small survey, built without trouble."""
    from_conftest = town.__globals__["PolarHistogram"]
    output = tmp_path_factory.mktemp("maps") / "town"
    build_map([survey_file], output, from_conftest(), small_tiles)
    return output


# --- the right map ------------------------------------------------------------------------------------------------


def test_the_map_holds_the_submaps_of_the_survey(
    built: Path, survey: Any, encoder: Any, ground: Callable[..., np.ndarray]
) -> None:
    aerial = AerialMap.load(built, encoder.fingerprint)
    points = survey.points
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    inside = submap_centres((low[0] + 1, low[1] + 1, high[0] - 1, high[1] - 1), 19.0)
    # A place up to 5 m from a point counts as flown over.
    half = encoder.preprocessing.half_extent_m
    covered = (np.minimum(inside + half, high + 5) - np.maximum(inside - half, low - 5)).prod(axis=1) / (2 * half) ** 2
    have = {(e, n) for e, n, _ in aerial.submaps.grid}
    assert {(e, n) for e, n in inside[covered > 0.78]} <= have
    assert not {(e, n) for e, n in inside[covered < 0.7]} & have
    assert len(have) == len(aerial.submaps) == len(aerial.index) == aerial.manifest.counts.submaps
    np.testing.assert_allclose(
        aerial.submaps.grid[:, 2], ground(aerial.submaps.grid[:, 0], aerial.submaps.grid[:, 1]), atol=0.6
    )
    heights = np.column_stack([points[:, :2], points[:, 2] - ground(points[:, 0], points[:, 1])])
    well_inside = np.flatnonzero(
        ((aerial.submaps.grid[:, :2] > low + 25) & (aerial.submaps.grid[:, :2] < high - 25)).all(axis=1)
    )
    assert len(well_inside) > 10
    for row in well_inside:
        patch = cut_submap(heights, aerial.submaps.grid[row, :2], encoder.preprocessing)
        assert patch is not None
        assert abs(aerial.submaps.point_counts[row] - patch.source_count) <= 0.06 * patch.source_count
        expected = encoder.encode(patch.points)
        stored = aerial.index.descriptors(np.array([row]))[0]
        assert np.abs(stored - expected).sum() < 0.25  # the choice of points differs, the shape does not


def test_rasters_are_the_terrain_and_the_surface(built: Path, survey: Any, ground: Callable[..., np.ndarray]) -> None:
    aerial = AerialMap.load(built)
    points = survey.points
    terrain, surface = aerial.terrain(), aerial.surface()
    west, south, east, north = aerial.bounds
    assert terrain.values.shape == surface.values.shape == (round(north - south), round(east - west))
    np.testing.assert_array_equal([west, south], np.floor(points[:, :2].min(axis=0)))
    np.testing.assert_array_equal([east, north], np.ceil(points[:, :2].max(axis=0)))
    e, n = west + np.arange(terrain.values.shape[1]) + 0.5, north - np.arange(terrain.values.shape[0]) - 0.5
    true = ground(*np.meshgrid(e, n))
    error = np.abs(terrain.values - true)
    assert np.nanmedian(error) < 0.05 and np.nanmax(error) < 0.6 and not np.isnan(terrain.values).any()
    row, column = (north - points[:, 1]).astype(int), (points[:, 0] - west).astype(int)
    # A point within a millimetre of a cell's edge may lie in the next one.
    assert (surface.values[row, column] >= points[:, 2] - 1e-3).mean() > 0.999
    assert np.nanmax(surface.values - true) == pytest.approx(8.0, abs=0.2)


def test_the_manifest_says_what_the_map_is(built: Path, survey: Any, encoder: Any) -> None:
    manifest = store.read_manifest(built)
    counts = manifest.counts
    assert manifest.crs == CRS and manifest.ground == "classes"
    assert counts.points_in_files == counts.points_used == len(survey.points)
    assert counts.tiles > 4 and counts.submaps > 40
    assert manifest.preprocessing == encoder.preprocessing
    assert [source.name for source in manifest.sources] == ["town.laz"]
    assert manifest.geoid_separation_m is None and manifest.vertical_reference == "unknown"
    west, south, east, north = manifest.bounds
    assert west < manifest.origin[0] < east and south < manifest.origin[1] < north
    assert not work_folder(built).exists()


def test_every_point_is_counted(tmp_path: Path, survey: Any, encoder: Any, small_tiles: BuildConfig) -> None:
    classes = survey.classification.copy()
    classes[::10], classes[1::10] = 7, 18
    points = survey.points.copy()
    points[::10, 2] += 500.0  # noise that would show if it were used
    points[5] = [628_000.0 + 90_000, 5_803_000.0, 10.0]  # alone, far away
    write_laz(tmp_path / "a.laz", points, classes, CRS, scale=0.001)
    report = build_map([tmp_path / "a.laz"], tmp_path / "map", encoder, small_tiles)
    counts = report.manifest.counts
    assert counts.points_noise == (classes == 7).sum() + (classes == 18).sum()
    assert counts.points_stray == 1
    assert counts.points_used == len(points) - counts.points_noise - 1
    aerial = AerialMap.load(tmp_path / "map")
    assert np.nanmax(aerial.surface().values) < 30 and aerial.terrain().values.size < 1e5


def test_unclassified_files_go_through_the_filter(
    tmp_path: Path, survey: Any, encoder: Any, built: Path, ground: Callable[..., np.ndarray]
) -> None:
    write_laz(tmp_path / "a.laz", survey.points, np.ones(len(survey.points), np.uint8), CRS, scale=0.001)
    report = build_map([tmp_path / "a.laz"], tmp_path / "map", encoder)
    assert report.manifest.ground == "filter" and report.manifest.sources[0].ground == "filter"
    ours, theirs = AerialMap.load(tmp_path / "map"), AerialMap.load(built)
    np.testing.assert_allclose(ours.terrain().values, theirs.terrain().values, atol=0.5)
    assert abs(len(ours.submaps) - len(theirs.submaps)) <= 0.1 * len(theirs.submaps)


def test_classified_and_unclassified_files_mix(tmp_path: Path, survey: Any, encoder: Any) -> None:
    east = survey.points[:, 0] > survey.points[:, 0].mean()
    write_laz(tmp_path / "a.laz", survey.points[~east], survey.classification[~east], CRS, scale=0.001)
    write_laz(tmp_path / "b.laz", survey.points[east], np.zeros(east.sum(), np.uint8), CRS, scale=0.001)
    manifest = build_map([tmp_path], tmp_path / "map", encoder).manifest
    assert manifest.ground == "classes and filter"
    assert [source.ground for source in manifest.sources] == ["classes", "filter"]


def test_where_no_ground_class_is_in_sight_the_filter_helps(
    tmp_path: Path, town: Callable[..., Any], encoder: Any
) -> None:
    survey = town(460.0, 60.0)
    classes = survey.classification.copy()
    classes[survey.points[:, 0] > 628_200.0] = 1  # classified in the west alone
    write_laz(tmp_path / "a.laz", survey.points, classes, CRS, scale=0.001)
    manifest = build_map([tmp_path], tmp_path / "map", encoder, BuildConfig(tile_m=76.0)).manifest
    assert manifest.ground == "classes and filter"
    terrain = AerialMap.load(tmp_path / "map").terrain().values
    assert np.isfinite(terrain).all() and np.ptp(terrain) < 20


def test_submaps_with_too_few_points_are_left_out_and_counted(
    tmp_path: Path, survey: Any, encoder: Any, built: Path
) -> None:
    bare = (survey.classification == 2) | (survey.points[:, 0] < 628_080.0)  # fields in the east
    write_laz(tmp_path / "a.laz", survey.points[bare], survey.classification[bare], CRS, scale=0.001)
    build_map([tmp_path], tmp_path / "map", encoder)
    ours, all_of_it = AerialMap.load(tmp_path / "map"), store.read_manifest(built).counts
    counts = ours.manifest.counts
    assert counts.submaps_with_too_few_points > 5
    assert counts.submaps + counts.submaps_with_too_few_points >= all_of_it.submaps
    assert ours.submaps.grid[:, 0].max() < 628_080.0 + encoder.preprocessing.half_extent_m
    assert (ours.submaps.point_counts >= encoder.preprocessing.min_points).all()


# --- units and reference systems ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("crs", "scale", "foot_h", "foot_v"),
    [
        ("EPSG:28992", 0.001, 1.0, 1.0),
        ("EPSG:7415", 0.001, 1.0, 1.0),
        ("EPSG:4326", 1e-8, 1.0, 1.0),
        ("EPSG:4979", 1e-8, 1.0, 1.0),
        ("+proj=utm +zone=31 +ellps=WGS84 +units=ft +type=crs", 0.001, 0.3048, 0.3048),
        ("+proj=utm +zone=31 +ellps=WGS84 +units=us-ft +type=crs", 0.001, 1200 / 3937, 1200 / 3937),
        ("EPSG:32631+6360", 0.001, 1.0, 1200 / 3937),
        ("EPSG:32631+8228", 0.001, 1.0, 0.3048),
    ],
)
def test_every_reference_system_gives_the_same_places(
    tmp_path: Path, survey: Any, encoder: Any, built: Path, crs: str, scale: float, foot_h: float, foot_v: float
) -> None:
    horizontal = pyproj.CRS(crs)
    horizontal = horizontal.sub_crs_list[0] if horizontal.is_compound else horizontal.to_2d()
    transformer = pyproj.Transformer.from_crs(CRS, horizontal, always_xy=True)
    x, y = transformer.transform(survey.points[:, 0], survey.points[:, 1])
    write_laz(
        tmp_path / "a.laz",
        np.column_stack([x, y, survey.points[:, 2] / foot_v]),
        survey.classification,
        crs,
        scale=scale,
    )
    build_map([tmp_path], tmp_path / "map", encoder, BuildConfig(tile_m=76.0))
    ours, theirs = AerialMap.load(tmp_path / "map"), AerialMap.load(built)
    assert ours.manifest.crs == CRS
    np.testing.assert_array_equal(ours.submaps.grid[:, :2], theirs.submaps.grid[:, :2])
    # Cells of a metre change hands where a point moves by a millimetre.
    np.testing.assert_allclose(ours.submaps.grid[:, 2], theirs.submaps.grid[:, 2], atol=0.2)
    np.testing.assert_allclose(ours.submaps.point_counts, theirs.submaps.point_counts, rtol=0.05)
    assert ours.manifest.geoid_separation_m == (0.0 if crs == "EPSG:4979" else None)


def test_the_geoid_separation_is_kept(tmp_path: Path, survey_file: Path, encoder: Any) -> None:
    build_map([survey_file], tmp_path / "map", encoder, geoid_separation_m=43.1)
    frame = AerialMap.load(tmp_path / "map").frame
    assert frame.to_geographic(frame.origin[None])[2][0] == pytest.approx(frame.origin[2] + 43.1)


def test_two_reference_systems_are_refused_by_name(tmp_path: Path, survey: Any, encoder: Any) -> None:
    for name, crs in (("a.laz", CRS), ("b.laz", CRS), ("c.laz", "EPSG:28992")):
        write_laz(tmp_path / name, survey.points, survey.classification, crs)
    with pytest.raises(AerialDataError) as caught:
        build_map([tmp_path], tmp_path / "map", encoder)
    for part in ("EPSG:32631", "a.laz, b.laz", "EPSG:28992", "c.laz", "--crs"):
        assert part in str(caught.value)
    assert not (tmp_path / "map").exists() and not work_folder(tmp_path / "map").exists()
    build_map([tmp_path], tmp_path / "map", encoder, crs=CRS)


def test_a_file_without_crs_is_refused_and_built_with_one(tmp_path: Path, survey: Any, encoder: Any) -> None:
    write_laz(tmp_path / "a.laz", survey.points, survey.classification, None)
    with pytest.raises(AerialDataError, match=r"a\.laz names no CRS"):
        build_map([tmp_path], tmp_path / "map", encoder)
    assert build_map([tmp_path], tmp_path / "map", encoder, crs=CRS).manifest.crs == CRS


# --- the same map, however it is built ----------------------------------------------------------------------------


def test_chunks_and_the_order_of_the_inputs_do_not_matter(
    tmp_path: Path, survey: Any, encoder: Any, small_tiles: BuildConfig
) -> None:
    north = survey.points[:, 1] > survey.points[:, 1].mean()
    for name, part in (("a.laz", north), ("b.laz", ~north)):
        write_laz(tmp_path / name, survey.points[part], survey.classification[part], CRS, scale=0.001)
    a, b = tmp_path / "a.laz", tmp_path / "b.laz"
    build_map([a, b], tmp_path / "one", encoder, small_tiles)
    build_map([b, a, tmp_path], tmp_path / "two", encoder, BuildConfig(tile_m=76.0, chunk_points=7_001))
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_tiles_leave_no_seams(tmp_path: Path, survey_file: Path, encoder: Any, built: Path) -> None:
    build_map([survey_file], tmp_path / "one", encoder, BuildConfig(tile_m=950.0))
    whole, tiled = AerialMap.load(tmp_path / "one"), AerialMap.load(built)
    ours, theirs = (m.submaps.grid[np.lexsort(m.submaps.grid[:, :2].T)] for m in (whole, tiled))
    np.testing.assert_array_equal(ours[:, :2], theirs[:, :2])
    west, south, east, north = whole.bounds
    e, n = ours[:, 0], ours[:, 1]
    flown = (e > west) & (e < east) & (n > south) & (n < north)  # beyond, the ground is a guess
    np.testing.assert_allclose(ours[flown], theirs[flown], atol=0.02)
    np.testing.assert_allclose(np.sort(whole.submaps.point_counts), np.sort(tiled.submaps.point_counts), rtol=0.03)
    np.testing.assert_array_equal(whole.surface().values, tiled.surface().values)
    inner = np.s_[12:-12, 12:-12]  # the corner house hides ground that is known on two sides only
    np.testing.assert_allclose(whole.terrain().values[inner], tiled.terrain().values[inner], atol=0.02)


def test_spacing_is_a_setting(tmp_path: Path, survey_file: Path, encoder: Any) -> None:
    build_map([survey_file], tmp_path / "map", encoder, BuildConfig(spacing_m=50.0))
    grid = AerialMap.load(tmp_path / "map").submaps.grid
    assert (grid[:, :2] % 50.0 == 0).all() and 4 <= len(grid) <= 20


def test_progress_runs_from_nothing_to_everything(tmp_path: Path, survey_file: Path, encoder: Any) -> None:
    seen: list[BuildProgress] = []
    build_map([survey_file], tmp_path / "map", encoder, BuildConfig(tile_m=76.0), progress=seen.append)
    for stage in ("reading", "encoding", "writing"):
        done = [p.done for p in seen if p.stage == stage]
        assert done == sorted(done) and done[0] == 0 and done[-1] == next(p.total for p in seen if p.stage == stage)
    assert list(dict.fromkeys(p.stage for p in seen)) == ["reading", "encoding", "writing"]


# --- stopped at any moment ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("stop_at", [0, 1, 3, 5, 9])
def test_a_stopped_build_goes_on_to_the_same_map(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig, built: Path, stop_at: int
) -> None:
    calls = 0

    def stop(_: BuildProgress) -> None:
        nonlocal calls
        calls += 1
        if calls > stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_map([survey_file], tmp_path / "town", encoder, small_tiles, progress=stop)
    assert not (tmp_path / "town").exists()
    before = encoder.calls
    report = build_map([survey_file], tmp_path / "town", encoder, small_tiles)
    assert report.resumed
    assert contents(tmp_path / "town") == contents(built)
    assert [p.name for p in tmp_path.iterdir()] == ["town"]
    if stop_at > 1:
        assert report.points_read == 0
    if stop_at >= 5:
        assert encoder.calls - before == report.submaps_encoded < report.manifest.counts.submaps


def _build_slowly(survey_file: Path, output: Path, encoder: Any, config: BuildConfig) -> None:
    build_map([survey_file], output, encoder, config, progress=lambda _: time.sleep(0.05))


@pytest.mark.parametrize("after_s", [0.3, 0.9])
def test_a_killed_build_goes_on(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig, built: Path, after_s: float
) -> None:
    process = multiprocessing.get_context("fork").Process(
        target=_build_slowly, args=(survey_file, tmp_path / "town", encoder, small_tiles)
    )
    process.start()
    deadline = time.monotonic() + 20
    while not (work_folder(tmp_path / "town") / "job.json").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(after_s)
    process.kill()
    process.join()
    assert not (tmp_path / "town").exists()
    assert build_map([survey_file], tmp_path / "town", encoder, small_tiles).resumed
    assert contents(tmp_path / "town") == contents(built)


def interrupt_while_encoding(inputs: list[Path], output: Path, encoder: Any, config: BuildConfig) -> None:
    def stop(progress: BuildProgress) -> None:
        if progress.stage == "encoding" and progress.done > progress.total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_map(inputs, output, encoder, config, progress=stop)


@pytest.mark.parametrize("change", ["spacing", "input", "encoder"])
def test_another_build_starts_anew_and_says_so(
    tmp_path: Path, survey: Any, encoder: Any, small_tiles: BuildConfig, caplog: pytest.LogCaptureFixture, change: str
) -> None:
    source, config = tmp_path / "a.laz", small_tiles
    write_laz(source, survey.points, survey.classification, CRS, scale=0.001)
    interrupt_while_encoding([source], tmp_path / "map", encoder, config)
    if change == "spacing":
        config = BuildConfig(tile_m=76.0, spacing_m=25.0)
    elif change == "input":
        write_laz(source, survey.points[::2], survey.classification[::2], CRS, scale=0.001)
    else:
        encoder.fingerprint = "polar-histogram-2"
    with caplog.at_level(logging.WARNING):
        report = build_map([source], tmp_path / "map", encoder, config)
    assert not report.resumed and "starting anew" in caplog.text
    build_map([source], tmp_path / "fresh", encoder, config)
    assert contents(tmp_path / "map") == contents(tmp_path / "fresh")


def test_a_damaged_piece_of_work_is_done_again(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig, built: Path
) -> None:
    interrupt_while_encoding([survey_file], tmp_path / "map", encoder, small_tiles)
    work = work_folder(tmp_path / "map")
    piece = next((work / "tiles").glob("*.npz"))
    piece.write_bytes(piece.read_bytes()[:1000])
    spooled = next((work / "spool" / "000000").glob("*.bin"))
    spooled.write_bytes(spooled.read_bytes()[:-13])
    report = build_map([survey_file], tmp_path / "map", encoder, small_tiles)
    assert report.resumed and report.points_read > 0
    assert contents(tmp_path / "map") == contents(built)


# --- bad input ----------------------------------------------------------------------------------------------------


def test_a_truncated_file_loses_nothing_of_the_others(tmp_path: Path, survey: Any, encoder: Any) -> None:
    good, bad = tmp_path / "a.laz", tmp_path / "b.laz"
    write_laz(good, survey.points, survey.classification, CRS)
    write_laz(bad, survey.points[::2], survey.classification[::2], CRS)
    content = bad.read_bytes()
    bad.write_bytes(content[: len(content) // 2])
    with pytest.raises(AerialDataError, match=r"b\.laz is (damaged|truncated)"):
        build_map([tmp_path], tmp_path / "map", encoder)
    assert not (tmp_path / "map").exists()
    assert spool.read_report(work_folder(tmp_path / "map") / "spool" / "000000") is not None
    build_map([good], tmp_path / "map", encoder)
    AerialMap.load(tmp_path / "map")


@pytest.mark.parametrize("kind", ["no points", "all noise", "a handful", "a bare field"])
def test_an_empty_area_is_refused(tmp_path: Path, survey: Any, encoder: Any, kind: str) -> None:
    points, classes = survey.points, survey.classification
    if kind == "no points":
        points, classes = points[:0], classes[:0]
    elif kind == "all noise":
        classes = np.full(len(points), 7, np.uint8)
    elif kind == "a handful":
        points, classes = points[:12], classes[:12]
    else:
        points, classes = points[classes == 2], classes[classes == 2]
    write_laz(tmp_path / "a.laz", points, classes, CRS)
    with pytest.raises(AerialDataError, match="the area is empty"):
        build_map([tmp_path], tmp_path / "map", encoder)
    assert not (tmp_path / "map").exists()


def test_an_empty_file_among_others_is_left_out(
    tmp_path: Path, survey: Any, encoder: Any, caplog: pytest.LogCaptureFixture
) -> None:
    write_laz(tmp_path / "a.laz", survey.points, survey.classification, CRS)
    write_laz(tmp_path / "b.laz", survey.points[:0], survey.classification[:0], CRS)
    report = build_map([tmp_path], tmp_path / "map", encoder)
    assert [source.name for source in report.manifest.sources] == ["a.laz"]
    assert "b.laz holds no points" in caplog.text


@pytest.mark.parametrize("where", ["spool", "tile", "map"])
def test_a_full_disk_is_said_and_loses_nothing(
    tmp_path: Path,
    survey_file: Path,
    encoder: Any,
    small_tiles: BuildConfig,
    built: Path,
    monkeypatch: pytest.MonkeyPatch,
    where: str,
) -> None:
    calls = 0

    def full(real: Callable[..., Any]) -> Callable[..., Any]:
        def write(*arguments: Any, **named: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls > (2 if where == "tile" else 0):
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*arguments, **named)

        return write

    with monkeypatch.context() as patch:
        if where == "spool":
            patch.setattr(spool, "_split", full(spool._split))
        elif where == "tile":
            patch.setattr(tile.np, "savez", full(np.savez))
        else:
            patch.setattr(builder, "write_map", full(builder.write_map))
        with pytest.raises(MapError, match=r"the disk of .* is full: the build needs about .*B there.*is kept"):
            build_map([survey_file], tmp_path / "town", encoder, small_tiles)
    assert not (tmp_path / "town").exists()
    report = build_map([survey_file], tmp_path / "town", encoder, small_tiles)
    assert report.resumed
    assert report.submaps_encoded < report.manifest.counts.submaps or where == "spool"
    assert contents(tmp_path / "town") == contents(built)


def test_too_small_a_disk_is_said_before_the_work(
    tmp_path: Path, survey_file: Path, encoder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: real._replace(free=1_000_000))
    with pytest.raises(MapError, match=r"too little room: the build needs about [\d.]+ MB there and 1 MB is free"):
        build_map([survey_file], tmp_path / "map", encoder)
    assert encoder.calls == 0 and not (tmp_path / "map").exists()


def test_a_map_is_replaced_only_when_asked(tmp_path: Path, survey_file: Path, encoder: Any, built: Path) -> None:
    shutil.copytree(built, tmp_path / "map")
    with pytest.raises(MapError, match="--overwrite"):
        build_map([survey_file], tmp_path / "map", encoder)
    assert contents(tmp_path / "map") == contents(built)
    config = BuildConfig(spacing_m=38.0)
    report = build_map([survey_file], tmp_path / "map", encoder, config, overwrite=True)
    assert len(AerialMap.load(tmp_path / "map").submaps) == report.manifest.counts.submaps < 50
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


def test_what_is_no_map_is_never_replaced(tmp_path: Path, survey_file: Path, encoder: Any) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years")
    (tmp_path / "file").write_text("a file")
    for name in ("home", "file"):
        with pytest.raises(MapError, match="is no map"):
            build_map([survey_file], tmp_path / name, encoder, overwrite=True)
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years"


def test_two_builds_of_one_map_do_not_meet(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig
) -> None:
    def build_again(progress: BuildProgress) -> None:
        if progress.stage == "encoding":
            with pytest.raises(MapError, match="another build works"):
                build_map([survey_file], tmp_path / "map", encoder, small_tiles)

    build_map([survey_file], tmp_path / "map", encoder, small_tiles, progress=build_again)
    AerialMap.load(tmp_path / "map")


def test_settings_that_do_not_fit_are_refused(tmp_path: Path, survey_file: Path, encoder: Any) -> None:
    with pytest.raises(ConfigError, match="multiple of 'cell_m'"):
        build_map([survey_file], tmp_path / "map", encoder, BuildConfig(tile_m=380.0, cell_m=0.7))
    with pytest.raises(ConfigError, match="a function that loads it"):
        build_map([survey_file], tmp_path / "map", encoder, BuildConfig(workers=2))


def test_coordinates_that_do_not_fit_the_crs_are_refused(tmp_path: Path, survey_file: Path, encoder: Any) -> None:
    with pytest.raises(AerialDataError, match="do not fit the CRS"):
        build_map([survey_file], tmp_path / "map", encoder, crs="EPSG:4326")


def test_a_second_build_is_refused_by_name_and_touches_nothing(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig, built: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Neither checks of the disk or the inputs nor the undoing of a killed replacement come before the lock."""
    output, replaced = tmp_path / "map", tmp_path / ".map.replaced"
    shutil.copytree(built, output)
    refused = 0

    def no_encoder() -> Any:
        pytest.fail("the second build loads its encoder")

    def build_again(progress: BuildProgress) -> None:
        nonlocal refused
        if progress.stage != "encoding":
            return
        output.rename(replaced)  # as between the two renames of the first build
        with monkeypatch.context() as patch, pytest.raises(MapError, match=rf"another build works .*{os.getpid()} on"):
            patch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(1, 1, 0))
            build_map([tmp_path / "missing.laz"], output, no_encoder, small_tiles, overwrite=True)
        assert not output.exists()
        replaced.rename(output)
        refused += 1

    build_map([survey_file], output, encoder, small_tiles, overwrite=True, progress=build_again)
    assert refused > 2
    assert contents(output) == contents(built)


def test_a_file_that_vanishes_while_the_work_is_sized_does_not_end_the_build(
    tmp_path: Path, survey_file: Path, encoder: Any, small_tiles: BuildConfig, built: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    interrupt_while_encoding([survey_file], tmp_path / "map", encoder, small_tiles)
    lost = next((work_folder(tmp_path / "map") / "tiles").glob("*.npz"))
    stat = Path.stat

    def stat_and_lose(path: Path, **options: Any) -> os.stat_result:
        found = stat(path, **options)
        if path == lost:
            path.unlink()
        return found

    monkeypatch.setattr(Path, "stat", stat_and_lose)
    assert build_map([survey_file], tmp_path / "map", encoder, small_tiles).resumed
    assert contents(tmp_path / "map") == contents(built)


def test_a_build_that_is_refused_leaves_no_work(tmp_path: Path, survey_file: Path, encoder: Any, built: Path) -> None:
    with pytest.raises(AerialDataError, match="no such file"):
        build_map([tmp_path / "missing.laz"], tmp_path / "map", encoder)
    with pytest.raises(ConfigError):
        build_map([survey_file], tmp_path / "map", encoder, BuildConfig(tile_m=380.0, cell_m=0.7))
    assert list(tmp_path.iterdir()) == []
