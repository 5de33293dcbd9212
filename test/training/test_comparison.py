"""Tables of comparison: rows differ in one thing alone, go on after a stop, and hold what they measured."""

from __future__ import annotations

import csv
import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.cli import compare
from crossloc3d_ros.config import TrainConfig, to_dict
from crossloc3d_ros.datasets.place_sets import EvaluationSet, PlaceSet
from crossloc3d_ros.encoder.checkpoint import load_checkpoint
from crossloc3d_ros.encoder.networks import make_network
from crossloc3d_ros.errors import ConfigError, TrainingError
from crossloc3d_ros.evaluation.retrieval.predictions import load_predictions
from crossloc3d_ros.evaluation.retrieval.scores import score
from crossloc3d_ros.evaluation.statistics import Share
from crossloc3d_ros.training import comparison
from crossloc3d_ros.training.comparison import TABLES, Comparison, Result, Row, rows_of, select
from crossloc3d_ros.training.comparison_table import (
    CSV,
    HTML,
    MARKDOWN,
    TableTexts,
    as_csv,
    as_html,
    as_markdown,
    write_tables,
)
from crossloc3d_ros.training.loop import Trainer
from crossloc3d_ros.training.run_folder import read_config
from crossloc3d_ros.training.schedule import Budget
from crossloc3d_ros.training.shards import read_validation_town

TEXTS = TableTexts("Competitors <here>", ("Some places & others.",))


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Work with one thread: two that wait for each other on a busy machine take minutes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "usable_threads", lambda: 1)
        yield


@pytest.fixture(scope="module")
def evaluation_set(made_places: Path) -> EvaluationSet:
    """Give the held-out town as a benchmark."""
    town = read_validation_town(made_places / "validation_1000.npz")
    queries, aerial = len(town.query_xy_m), len(town.submap_xy_m)
    return EvaluationSet(
        "made-up",
        PlaceSet(town.query_patches, np.zeros(queries, np.int64), town.query_xy_m, np.full(queries, 0.5)),
        PlaceSet(town.submap_patches, np.zeros(aerial, np.int64), town.submap_xy_m, np.zeros(aerial)),
        None,
        ("town",),
        ("boxes",),
    )


def three_grains(tiny: TrainConfig) -> TrainConfig:
    model = dataclasses.replace(
        tiny.model, voxel_sizes=(0.1, 0.2, 0.4), kept_branches=3, memory_sizes=(32, 24, 16, 16, 8, 8), sub_steps=2
    )
    return dataclasses.replace(tiny, model=model)


@pytest.mark.parametrize("table", TABLES)
def test_rows_of_a_table_differ_in_what_it_compares_alone(table: comparison.TableName, tiny: TrainConfig) -> None:
    base = three_grains(tiny)
    rows = rows_of(table, base)
    assert len({row.slug for row in rows}) == len({row.name for row in rows}) == len(rows) >= 2
    assert sum(row.is_reference for row in rows) == 1
    reference = next(row for row in rows if row.is_reference)
    assert reference.config == base
    varied = {"sub_steps": {"sub_steps", "memory_sizes"}, "grains": {"voxel_sizes"}, "selection": {"kept_branches"}}
    allowed = varied.get(table, {table})
    for row in rows:
        if row.config is None:
            assert row.method is not None
            continue
        assert make_network(row.config.model).config.descriptor_size == base.model.descriptor_size
        if table != "headings":
            assert dataclasses.replace(row.config, model=base.model) == base
        if table not in ("competitors", "headings"):
            before, after = to_dict(base.model), to_dict(row.config.model)
            assert {key for key in before if before[key] != after[key]} <= allowed


def test_memories_of_other_sub_steps_are_each_grains_own(tiny: TrainConfig) -> None:
    sizes = {row.slug: row.config.model.memory_sizes for row in rows_of("sub_steps", three_grains(tiny)) if row.config}
    assert sizes["sub_steps_1"] == (32, 16, 8)
    assert sizes["sub_steps_2"] == (32, 24, 16, 16, 8, 8)
    assert sizes["sub_steps_3"] == (32, 24, 24, 16, 16, 16, 8, 8, 8)


def test_the_table_of_grains_needs_three(tiny: TrainConfig) -> None:
    with pytest.raises(ConfigError, match="three voxel sizes"):
        rows_of("grains", tiny)


def test_rows_are_chosen_by_name(tiny: TrainConfig) -> None:
    rows = rows_of("competitors", tiny)
    assert [row.slug for row in select(rows, ["crossloc3d", "lpdnet"])] == ["lpdnet", "crossloc3d"]
    assert select(rows, []) == rows
    with pytest.raises(ConfigError, match=r"no row 'netvlad'.*pointnetvlad"):
        select(rows, ["netvlad"])


@pytest.fixture(scope="module")
def done(
    made_places: Path, finished_run: Path, evaluation_set: EvaluationSet, tmp_path_factory: pytest.TempPathFactory
) -> Comparison:
    """Give a small table that is done."""
    base = read_config(finished_run)  # the settings of `tiny`
    folder = tmp_path_factory.mktemp("compared")
    rows = select(rows_of("competitors", base), ["height_maps", "minkloc3d_coarser", "crossloc3d"])
    subject = Comparison(
        rows, [made_places], folder / "table", Budget(steps=2), evaluation_set, base.preprocessing, folder / "cache"
    )
    subject.run()
    return subject


@pytest.fixture
def table(done: Comparison, tmp_path: Path) -> Comparison:
    """Give it to change at will."""
    return dataclasses.replace(done, folder=shutil.copytree(done.folder, tmp_path / "table"))


def test_a_table_holds_what_was_measured(done: Comparison, evaluation_set: EvaluationSet) -> None:
    results = {result.slug: result for result in done.results()}
    assert list(results) == ["height_maps", "minkloc3d_coarser", "crossloc3d"]
    for row in done.rows:
        result, folder = results[row.slug], done.folder / row.slug
        figures = score(load_predictions(folder / "predictions.npz"), evaluation_set).overall
        for recall in result.recalls:
            assert recall == figures.recall(f"R@{recall.rank}", recall.radius_m)
        assert result.one_thread_ms > 0
        if row.config is None:
            assert (result.parameters, result.steps, result.clouds) == (0, 0, 0)
            continue
        checkpoint = load_checkpoint(folder / "final.safetensors")
        assert result.encoder == checkpoint.fingerprint
        assert result.parameters == sum(p.numel() for p in checkpoint.model.parameters())
        assert checkpoint.model.config == row.config.model
        assert (result.steps, result.clouds) == (2, 2 * 2 * row.config.pairs)
    reference = results["crossloc3d"]
    assert reference.ahead is None
    for slug in ("height_maps", "minkloc3d_coarser"):
        ahead = results[slug].ahead
        assert ahead is not None
        assert ahead.value == pytest.approx(
            results[slug].recall(1, 100.0).share.value - reference.recall(1, 100.0).share.value
        )


def test_a_table_that_is_done_stays_as_it_is(table: Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("nothing is left to do")

    before = {path: path.read_bytes() for path in table.folder.rglob("*") if path.is_file()}
    monkeypatch.setattr(Trainer, "run", refuse)
    monkeypatch.setattr(comparison, "predict_all", refuse)
    assert len(table.run()) == 3
    assert {path: path.read_bytes() for path in table.folder.rglob("*") if path.is_file()} == before


def test_what_was_stopped_before_its_evaluation_is_evaluated(
    table: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = table.results()
    (table.folder / "crossloc3d" / "result.json").write_text("{")
    (table.folder / "minkloc3d_coarser" / "predictions.npz").unlink()
    assert [result.slug for result in table.results()] == ["height_maps"]
    monkeypatch.setattr(Trainer, "run", None)
    after = table.run()
    assert [result.recalls for result in after] == [result.recalls for result in before]


def test_a_run_that_was_killed_goes_on(table: Comparison) -> None:
    folder = table.folder / "crossloc3d"
    expected = load_checkpoint(folder / "final.safetensors").fingerprint
    for name in ("ended.txt", "final.safetensors", "state.pt", "result.json"):
        (folder / name).unlink()
    table.run()
    assert load_checkpoint(folder / "final.safetensors").fingerprint == expected


def test_a_larger_budget_goes_on_with_the_runs(table: Comparison) -> None:
    longer = dataclasses.replace(table, budget=Budget(steps=3), rows=table.rows[-1:])
    before, (after,) = table.results()[-1], longer.run()
    assert (before.steps, after.steps) == (2, 3)
    assert before.encoder != after.encoder


def test_results_of_another_benchmark_do_not_count(table: Comparison, evaluation_set: EvaluationSet) -> None:
    moved = dataclasses.replace(evaluation_set.queries, xy_m=evaluation_set.queries.xy_m + 1.0)
    other = dataclasses.replace(table, evaluation_set=dataclasses.replace(evaluation_set, queries=moved))
    assert other.results() == []


def test_a_row_of_other_settings_is_refused_and_the_others_are_done(table: Comparison) -> None:
    first = table.rows[1]
    assert first.config is not None
    changed = dataclasses.replace(first, config=dataclasses.replace(first.config, seed=7))
    shutil.rmtree(table.folder / "height_maps")
    mixed = dataclasses.replace(table, rows=[changed, table.rows[0], table.rows[2]])
    with pytest.raises(TrainingError, match=r"1 of 3 rows failed: minkloc3d_coarser.*'seed' 1, not 7"):
        mixed.run()
    assert (table.folder / "height_maps" / "result.json").exists()


def test_the_tables_say_what_the_results_hold(done: Comparison, tmp_path: Path) -> None:
    results = done.results()
    paths = write_tables(tmp_path, results, TEXTS)
    assert [path.suffix for path in paths] == [".csv", ".md", ".html"]
    lines = list(csv.DictReader(paths[0].read_text().splitlines()))
    for line, result in zip(lines, results, strict=True):
        assert line["slug"] == result.slug
        assert float(line["r25_100m"]) == pytest.approx(result.recall(25, 100.0).share.value, abs=1e-6)
        assert float(line["r1_25m_chance"]) == pytest.approx(result.recall(1, 25.0).chance, abs=1e-6)
        assert int(line["parameters"]) == result.parameters
    markdown, page = paths[1].read_text(), paths[2].read_text()
    rows = [line for line in markdown.splitlines() if line.startswith("| ")]
    assert len({line.count("|") for line in rows}) == 1
    for result in results:
        share = result.recall(1, 100.0).share
        shown = f"{100 * share.value:.1f} [{100 * share.low:.0f}–{100 * share.high:.0f}]"
        assert any(line.startswith(f"| {result.name} |") and shown in line for line in rows)
        assert shown in page
    assert "Competitors &lt;here&gt;" in page
    assert "Some places &amp; others." in page
    assert "reference" in rows[-1]
    assert "70.7" in rows[-1]


def test_a_table_without_its_reference_compares_nothing(done: Comparison) -> None:
    alone = dataclasses.replace(done, rows=done.rows[:1]).results()
    assert alone[0].ahead is None
    assert "| reference |" not in as_markdown(alone, TEXTS)
    assert as_csv(alone).count("\n") == 2


def test_an_empty_table_says_so() -> None:
    assert "No row is done yet" in as_markdown([], TEXTS)
    assert "No row is done yet" in as_html([], TEXTS)


def test_an_interval_without_zero_shows_its_sign(done: Comparison) -> None:
    result = dataclasses.replace(done.results()[0], ahead=Share(-0.1234, -0.2, 0.05))
    assert "-12.3 [-20, +5]" in as_markdown([result], TEXTS)


# The command.


def test_the_command_knows_the_tables() -> None:
    assert compare.TABLE_NAMES == TABLES


def test_the_command_lists_rows(capsys: pytest.CaptureFixture[str]) -> None:
    assert compare.main(["--table", "competitors", "--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()][-1] == "crossloc3d"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--budget-steps", "2"], "--places"),
        (["--places", "somewhere"], "--budget-minutes or --budget-steps"),
        (["--places", "somewhere", "--budget-steps", "2", "--rows", "nobody"], "no row 'nobody'"),
        (["--places", "somewhere", "--budget-steps", "2", "--encode-workers", "0"], "--encode-workers"),
        (["--places", "somewhere", "--budget-steps", "0"], "budget must be positive"),
        (["--places", "somewhere", "--budget-steps", "2", "--config", "nowhere.yaml"], "cannot read nowhere.yaml"),
    ],
)
def test_what_is_missing_is_reported_in_one_line(
    arguments: list[str], message: str, evaluation_set: EvaluationSet, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(compare, "open_benchmark", lambda *_, **__: evaluation_set)
    assert compare.main(["--table", "refinement", *arguments]) == 2
    errors = capsys.readouterr().err.strip().splitlines()
    assert len(errors) == 1
    assert message in errors[0]


def test_the_command_writes_the_table(
    evaluation_set: EvaluationSet, tiny: TrainConfig, made_places: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    import yaml

    monkeypatch.setattr(compare, "open_benchmark", lambda *_, **__: evaluation_set)
    settings = tmp_path / "settings.yaml"
    settings.write_text(yaml.safe_dump({"train": _plain(to_dict(tiny))}))
    arguments = [
        "--table", "time_embedding", "--places", str(made_places), "--budget-steps", "1", "--config", str(settings),
        "--output", str(tmp_path / "table"), "--data", str(tmp_path / "data"),
    ]  # fmt: skip
    assert compare.main(arguments) == 0
    assert [Path(line).name for line in capsys.readouterr().out.splitlines()[-3:]] == [CSV, MARKDOWN, HTML]
    written = (tmp_path / "table" / "comparison.md").read_text()
    assert written.count("time embedding |") == 2
    assert compare.main([*arguments, "--only-table"]) == 0
    assert (tmp_path / "table" / "comparison.md").read_text() == written


def _plain(values: dict[str, object]) -> dict[str, object]:
    """Return settings without tuples, which YAML has not."""
    return {
        key: _plain(value) if isinstance(value, dict) else list(value) if isinstance(value, tuple) else value
        for key, value in values.items()
    }


def test_results_survive_the_disk(done: Comparison) -> None:
    row: Row = done.rows[-1]
    (again,) = dataclasses.replace(done, rows=[row]).results()
    assert isinstance(again, Result)
    assert again.published == row.published
    assert again.recall(1, 25.0).radius_m == 25.0
