"""The page: complete in itself, well-formed, and saying what was measured."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.datasets.truth import TruthTrack
from crossloc3d_ros.errors import CrossLocError
from crossloc3d_ros.evaluation.drives import page as report
from crossloc3d_ros.evaluation.drives import page_map as replay_map
from crossloc3d_ros.evaluation.drives.estimates import EstimateTable, PoseLists, no_pose_lists
from crossloc3d_ros.evaluation.drives.evaluation import Evaluation, score_table
from crossloc3d_ros.evaluation.drives.track_scores import score_track
from crossloc3d_ros.pages import backdrop, charts
from crossloc3d_ros.pages.wording import degrees, metres, percent
from crossloc3d_ros.types import WHOLE_MAP, TrackState

VOID = {"meta", "input", "link", "br", "img", "hr"}
NASTY = "</script><script>alert(1)</script> & \"quotes\" {{data}} 'x'"


class Page(HTMLParser):
    """Checks that elements are closed in the order in which they were opened, and collects what matters."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.scripts: list[str] = []
        self.ids: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attributes:
            if name in ("src", "href", "xlink:href", "action", "data", "poster"):
                self.references.append(value or "")
            if name == "id" and value:
                self.ids.append(value)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts.append(data)
        elif not self.open or self.open[-1] != "style":
            self.words.append(data)


def made_up_table(
    town_map: AerialMap, scans: int = 40, top: int = 25, truth: bool = True, reason: str = ""
) -> EstimateTable:
    rng = np.random.default_rng(3)
    west, south, east, north = town_map.bounds
    place = np.column_stack([np.linspace(west + 40, east - 40, scans), np.full(scans, (south + north) / 2)])
    ids = np.stack([rng.permutation(len(town_map.submaps))[:top] for _ in range(scans)])
    grid = np.column_stack([place + rng.normal(0, 40, (scans, 2)), np.zeros(scans)])
    latitude, longitude, altitude = town_map.frame.to_geographic(grid)
    return EstimateTable(
        stamp_ns=1_700_000_000_000_000_000 + np.arange(scans) * 100_000_000,
        has_fix=rng.uniform(size=scans) < 0.6,
        geographic=np.column_stack([latitude, longitude, altitude]),
        grid=grid,
        covariance=np.tile(np.diag([900.0, 400.0, 9.0]), (scans, 1, 1)),
        timings_ms=np.column_stack(
            [
                rng.uniform(4, 6, scans),
                rng.uniform(9, 14, scans),
                np.full(scans, 0.3),
                *np.full((2, scans), np.nan),
                rng.uniform(15, 21, scans),
            ]
        ),
        points=np.full((scans, 2), 4096),
        candidate_ids=ids,
        candidate_distances=np.sort(rng.uniform(0, 1, (scans, top)), axis=1),
        candidate_probabilities=rng.dirichlet(np.ones(top), scans) if top else np.empty((scans, 0)),
        candidate_grid=town_map.submaps.grid[ids, :2],
        truth_grid=place if truth else np.full((scans, 2), np.nan),
        truth_heading_rad=np.full(scans, np.nan),
        states=(None,) * scans,
        probability=np.full(scans, np.nan),
        heading_rad=np.full(scans, np.nan),
        heading_std_rad=np.full(scans, np.nan),
        aligned=no_pose_lists(scans),
        aligned_sources=np.empty((scans, 0), dtype=np.int64),
        hypotheses=no_pose_lists(scans),
        reasons=tuple(reason or f"reason {i % 3}" for i in range(scans)),
    )


def tracked(table: EstimateTable, town_map: AerialMap, seed: int = 5) -> EstimateTable:
    """Return the table with poses: fixes metres off, four hypotheses, eight aligned poses, some searching."""
    rng = np.random.default_rng(seed)
    scans = len(table)
    true = table.truth_grid if np.isfinite(table.truth_grid).any() else table.grid[:, :2]
    grid = np.column_stack([true + rng.normal(0, 0.5, (scans, 2)), np.zeros(scans)])
    latitude, longitude, altitude = town_map.frame.to_geographic(grid)
    states = [TrackState.LOCALIZED if fix else TrackState.SEARCHING for fix in table.has_fix]
    states[: scans // 5] = [TrackState.AMBIGUOUS] * (scans // 5)
    covariance = np.zeros((scans, 3, 3))
    covariance[:, [0, 1], [0, 1]] = [0.25, 0.16]
    heading = rng.uniform(-np.pi, np.pi, scans)

    def poses(count: int, spread_m: float) -> PoseLists:
        places = true[:, None] + rng.normal(0, spread_m, (scans, count, 2))
        return PoseLists(
            np.where(np.isfinite(places), places, 0.0),
            rng.uniform(-np.pi, np.pi, (scans, count)),
            np.tile(np.diag([9.0, 4.0]), (scans, count, 1, 1)),
            np.full((scans, count), 0.02),
            np.sort(rng.dirichlet(np.ones(count), scans), axis=1)[:, ::-1],
        )

    return replace(
        table,
        has_fix=np.array([state is TrackState.LOCALIZED for state in states]),
        grid=grid,
        geographic=np.column_stack([latitude, longitude, altitude]),
        covariance=covariance,
        states=tuple(states),
        probability=np.where([state is TrackState.LOCALIZED for state in states], 0.9995, rng.uniform(size=scans)),
        heading_rad=heading + rng.normal(0, 0.01, scans),
        heading_std_rad=np.full(scans, 0.01),
        truth_heading_rad=heading if np.isfinite(table.truth_grid).any() else np.full(scans, np.nan),
        aligned=poses(8, 20.0),
        aligned_sources=np.tile(np.array([-1, WHOLE_MAP, 2, 3, 4, 5, 6, -2]), (scans, 1)),
        hypotheses=poses(4, 30.0),
    )


def page_of(
    table: EstimateTable, town_map: AerialMap, path: Path, about: report.About | None = None
) -> tuple[str, Page]:
    known = np.isfinite(table.truth_grid).all(axis=1)
    track = TruthTrack(
        "/gnss", table.stamp_ns[known], np.column_stack([table.truth_grid, table.truth_grid[:, 0]])[known], 3
    )
    evaluation = Evaluation(
        table, track if known.any() else None, score_table(table, town_map), score_track(table), "/truth/heading"
    )
    report.write_report(path, evaluation, town_map, about or report.About("A drive", {"bag": "drive", "map": "town"}))
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


def data_of(page: Page) -> dict:
    return json.loads(page.scripts[0], parse_constant=pytest.fail)


@pytest.mark.parametrize("with_track", [False, True], ids=["places", "poses"])
def test_the_page_needs_nothing_but_itself(town_map: AerialMap, tmp_path: Path, with_track: bool) -> None:
    table = made_up_table(town_map)
    text, page = page_of(tracked(table, town_map) if with_track else table, town_map, tmp_path / "page.html")
    assert page.references
    assert all(reference.startswith("data:") for reference in page.references)
    without_namespaces = text.replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?://|url\(|@import|//cdn|src=", without_namespaces)
    assert "{{" not in text
    assert len(page.ids) == len(set(page.ids))
    assert {"map", "overlay", "marks", "slider", "scan", "play", "errors", "data"} <= set(page.ids)
    for called in re.findall(r'getElementById\("([^"]+)"\)', text):
        assert called in page.ids
    assert text.startswith("<!doctype html>")
    assert 'name="viewport"' in text
    assert "prefers-color-scheme: dark" in text


def test_the_words_are_the_figures(town_map: AerialMap, tmp_path: Path) -> None:
    table = made_up_table(town_map)
    scores = score_table(table, town_map)
    assert scores is not None
    _, page = page_of(table, town_map, tmp_path / "page.html")
    words = " ".join(" ".join(page.words).split())
    assert f"{int(table.has_fix.sum())} of {len(table)} scans" in words
    assert f"{scores.fix_error.median_m:.0f} m" in words
    for cell in scores.recalls:
        assert f"{100 * cell.share.low:.0f} to {100 * cell.share.high:.0f} %" in words
    assert f"{len(town_map.submaps):,}" in words
    assert "/gnss" in words


def test_the_script_gets_every_scan(town_map: AerialMap, tmp_path: Path) -> None:
    table = made_up_table(town_map)
    _, page = page_of(table, town_map, tmp_path / "page.html")
    data = data_of(page)
    assert [scan["number"] for scan in data["scans"]] == list(range(len(table)))
    west, _, _, north = town_map.bounds
    for i, scan in enumerate(data["scans"]):
        assert scan["fix"] == bool(table.has_fix[i])
        assert data["reasons"][scan["reason"]] == table.reasons[i]
        np.testing.assert_allclose([west + scan["truth"][0], north - scan["truth"][1]], table.truth_grid[i], atol=0.06)
        assert len(scan["candidates"]) == replay_map.SHOWN_CANDIDATES
        east_m, north_m, distance, probability = np.array(scan["candidates"][2]) * [1, -1, 1, 1] + [west, north, 0, 0]
        np.testing.assert_allclose([east_m, north_m], table.candidate_grid[i, 2], atol=0.06)
        assert (distance, probability) == pytest.approx(
            (table.candidate_distances[i, 2], table.candidate_probabilities[i, 2]), abs=1e-4
        )
        if scan["fix"]:
            assert scan["error"] == pytest.approx(table.error_m[i], abs=0.06)
            assert scan["ellipse"][:2] == pytest.approx(np.sqrt(5.9915 * np.array([900, 400])), abs=0.06)
        else:
            assert scan["at"] is None


def test_the_words_of_a_track_are_its_figures(town_map: AerialMap, tmp_path: Path) -> None:
    table = tracked(made_up_table(town_map, scans=80), town_map)
    scores = score_track(table)
    assert scores is not None
    _, page = page_of(table, town_map, tmp_path / "page.html")
    words = " ".join(" ".join(page.words).split())
    errors, two = scores.errors, scores.coverage[1]
    for text in (
        f"{metres(errors.median_m)}",
        f"95 % within {metres(errors.p95_m)}",
        f"95 % within {degrees(errors.p95_deg)}",
        f"{errors.wrong:,} of {errors.count:,} off by over 10 m",
        f"should be {percent(two.expected)}",
        f"from nothing at 0.0 s, scan 1 {metres(scores.searches[0].travelled_m)}",
        "/truth/heading",
        "several places",
    ):
        assert text in words
    assert {"states", "errors", "headings", "beliefs", "belief-calibration", "coverage", "closeup"} <= set(page.ids)


def test_the_script_gets_poses_in_the_frame_of_the_map(town_map: AerialMap, tmp_path: Path) -> None:
    """True headings are from true east; on the map they are drawn from grid east."""
    table = tracked(made_up_table(town_map), town_map)
    _, page = page_of(table, town_map, tmp_path / "page.html")
    data = data_of(page)
    assert data["tracked"]
    west, _, _, north = town_map.bounds
    places = np.column_stack([table.truth_grid, np.zeros(len(table))])
    turn = np.degrees(town_map.frame.convergence_rad(places))
    assert np.abs(turn).min() > 0.5  # or the test could not tell one from the other
    for i, scan in enumerate(data["scans"]):
        state = table.states[i]
        assert state is not None
        assert scan["state"] == state.value
        assert scan["belief"] == pytest.approx(table.probability[i], abs=1e-6)
        off = scan["trueHeading"] - turn[i] - np.degrees(table.truth_heading_rad[i])
        assert (off + 180) % 360 - 180 == pytest.approx(0.0, abs=0.01)
        assert len(scan["hypotheses"]) == 4
        for rank, (x, y, heading, belief, major, minor, angle) in enumerate(scan["hypotheses"]):
            assert [west + x, north - y] == pytest.approx(table.hypotheses.grid[i, rank], abs=0.01)
            assert heading == pytest.approx(np.degrees(table.hypotheses.heading_rad[i, rank]), abs=0.06)
            assert belief == pytest.approx(table.hypotheses.probabilities[i, rank], abs=1e-5)
            assert (major, minor) == pytest.approx(np.sqrt(5.9915) * np.array([3.0, 2.0]), abs=0.01)
            assert angle % 180.0 == pytest.approx(0.0)
        assert [pose[4] for pose in scan["aligned"]] == table.aligned_sources[i, : replay_map.SHOWN_POSES].tolist()
        assert (scan["turned"] is None) == (not table.has_fix[i])


def test_states_are_drawn_on_over_scans_that_tell_none(town_map: AerialMap, tmp_path: Path) -> None:
    """Ten scans a second, of which every third is answered; then none for three seconds, then another state."""
    table = tracked(made_up_table(town_map, scans=61), town_map)
    states: list[TrackState | None] = [None] * 61
    states[0:22:3] = [TrackState.AMBIGUOUS] * 8
    states[51:61:3] = [TrackState.LOCALIZED] * 4
    _, page = page_of(replace(table, states=tuple(states)), town_map, tmp_path / "page.html")
    words = " ".join(page.words)
    assert "several places, 0.0 to 2.1 s" in words
    assert "localized, 5.1 to 6.0 s" in words
    assert words.count("several places, ") == words.count("localized, 5") == 1


def test_one_scan_alone_is_not_credited_with_what_earlier_ones_found(town_map: AerialMap) -> None:
    table = tracked(made_up_table(town_map, scans=6), town_map)
    grid, heading = table.first_aligned
    np.testing.assert_array_equal(grid, table.aligned.grid[:, 1])  # the first began at a hypothesis
    np.testing.assert_array_equal(heading, table.aligned.heading_rad[:, 1])
    hypotheses_only = replace(table, aligned_sources=np.full((6, 8), -1))
    assert np.isnan(hypotheses_only.first_aligned[0]).all()


def test_what_others_wrote_cannot_break_the_page(town_map: AerialMap, tmp_path: Path) -> None:
    table = tracked(made_up_table(town_map, scans=3, reason=NASTY), town_map)
    about = report.About(NASTY, {NASTY: NASTY}, notes=(NASTY,), footer=NASTY, latency_is=NASTY, extra_words=(NASTY,))
    _, page = page_of(table, town_map, tmp_path / "page.html", about)
    assert len(page.scripts) == 2  # the data and the page's own, nothing of the reason's
    assert data_of(page)["reasons"] == [NASTY]
    assert NASTY in "".join(page.words)


@pytest.mark.parametrize("with_track", [False, True], ids=["places", "poses"])
@pytest.mark.parametrize("case", ["no truth", "no fix", "no candidates", "one scan", "no latency", "no headings"])
def test_every_kind_of_drive_makes_a_page(town_map: AerialMap, tmp_path: Path, case: str, with_track: bool) -> None:
    table = made_up_table(
        town_map,
        scans=1 if case == "one scan" else 12,
        top=0 if case == "no candidates" else 25,
        truth=case != "no truth",
    )
    if with_track:
        table = tracked(table, town_map)
    if case in ("no fix", "no candidates"):
        table = replace(table, has_fix=np.zeros(len(table), dtype=bool), covariance=np.full((len(table), 3, 3), np.nan))
    if case == "no candidates":
        table = replace(table, grid=np.full_like(table.grid, np.nan), geographic=np.full_like(table.geographic, np.nan))
        nothing = np.full(len(table), np.nan)
        table = replace(table, aligned=no_pose_lists(len(table)), aligned_sources=np.empty((len(table), 0), np.int64))
        table = replace(table, hypotheses=no_pose_lists(len(table)), heading_rad=nothing, heading_std_rad=nothing)
    if case == "no headings":
        table = replace(table, truth_heading_rad=np.full(len(table), np.nan))
    if case == "no latency":
        table = replace(table, timings_ms=np.full_like(table.timings_ms, np.nan))
    text, page = page_of(table, town_map, tmp_path / "page.html")
    assert len(data_of(page)["scans"]) == len(table)
    assert not re.search(r'="-?(nan|inf)|\bnan\b|NaN', text.split('id="data"')[0])


def test_a_long_drive_is_thinned_on_the_page_alone(town_map: AerialMap, tmp_path: Path) -> None:
    table = tracked(made_up_table(town_map, scans=3301, top=5), town_map)
    text, page = page_of(table, town_map, tmp_path / "page.html")
    assert 1500 < len(data_of(page)["scans"]) <= 3000
    assert f"{3301:,}" in text
    assert len(text) < 4_000_000


def test_a_page_that_cannot_be_written_is_said(town_map: AerialMap, tmp_path: Path) -> None:
    with pytest.raises(CrossLocError, match="cannot write"):
        page_of(made_up_table(town_map, scans=2), town_map, tmp_path / "missing" / "page.html")


def test_the_backdrop_is_the_map(town_map: AerialMap) -> None:
    drawn = backdrop.draw_backdrop(town_map, np.empty((0, 2)))
    image = Image.open(io.BytesIO(base64.b64decode(drawn.data_uri.split(",")[1]))).convert("L")
    surface = town_map.surface()
    assert image.size == surface.values.shape[::-1]
    assert drawn.bounds == pytest.approx(town_map.bounds)
    brightness = np.asarray(image, dtype=float)
    above = surface.values - town_map.terrain().values
    assert brightness[above > 6].mean() > brightness[above < 1].mean() + 30  # roofs are lighter than streets


def test_light_comes_from_the_north_west() -> None:
    height, width = 41, 41
    row, column = np.mgrid[:height, :width]
    cone = np.maximum(0.0, 12.0 - np.hypot(row - 20, column - 20)).astype(np.float32)
    raster = Raster(cone, 0.0, 41.0, 1.0)
    flat = Raster(np.zeros_like(cone), 0.0, 41.0, 1.0)
    picture = backdrop.shade(raster, flat).astype(float).sum(axis=2)
    assert picture[15, 15] > picture[25, 25]  # the same height, towards and away from the sun


def test_holes_are_drawn_as_water_and_pinholes_are_not() -> None:
    values = np.full((60, 60), 2.0, dtype=np.float32)
    values[20:40, 20:40] = np.nan
    values[5, 5] = np.nan
    picture = backdrop.shade(Raster(values, 0.0, 60.0, 1.0), Raster(np.full_like(values, 2.0), 0.0, 60.0, 1.0))
    assert picture[30, 30].tolist() == backdrop._NO_RETURN.astype(int).tolist()
    assert picture[5, 5].tolist() == picture[8, 8].tolist()


def test_of_a_large_map_the_surroundings_of_the_drive_are_shown() -> None:
    bounds = (0.0, 0.0, 50_000.0, 40_000.0)
    track = np.column_stack([np.linspace(20_000, 20_600, 50), np.full(50, 10_000.0)])
    stray = np.array([[49_000.0, 39_000.0], [np.nan, np.nan]])
    west, south, east, north = backdrop.view_of(bounds, np.concatenate([track, stray]))
    assert west < 20_000
    assert east > 20_600
    assert east - west < 1500
    assert north - south < 1500
    assert backdrop.view_of((0.0, 0.0, 900.0, 700.0), track) == (0.0, 0.0, 900.0, 700.0)


def test_cumulative_counts_what_is_missing_as_far() -> None:
    values = np.array([5.0, 30.0, np.nan, 60.0])
    np.testing.assert_allclose(charts.cumulative(values, 4, np.array([1.0, 5.0, 50.0, 1e9])), [0, 0.25, 0.5, 0.75])


@pytest.mark.parametrize(("low", "high"), [(0.0, 93.4), (0.0, 1e-3), (0.0, 7200.0), (0.0, 0.0)])
def test_axes_have_a_few_round_ticks_inside(low: float, high: float) -> None:
    axis = charts.linear_axis(low, high, "x")
    assert 1 <= len(axis.ticks) <= 12
    assert all(axis.low <= value <= axis.high * 1.001 + 1e-6 for value, _ in axis.ticks)
    far = charts.distance_axis(90_000.0, "y")
    assert far.share(far.low) == 0.0
    assert far.share(far.high) == 1.0
    assert 0.0 < far.share(50.0) < far.share(100.0) < 1.0
