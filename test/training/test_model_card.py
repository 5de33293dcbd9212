"""The card reports what was done, from the files alone; the page shows how it went."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from crossloc3d_ros.cli import train
from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.encoder.checkpoint import load_checkpoint
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.curve import curve_page, write_curve
from crossloc3d_ros.training.loop import Trainer, export_run, write_card
from crossloc3d_ros.training.schedule import Budget

MEASURES = (("R@1", 1), ("R@5", 5), ("R@25", 25), ("R@1%", 3))


@pytest.fixture
def shipped(finished: Path, places: Path, tmp_path: Path) -> Path:
    output = tmp_path / "shipped" / "town.safetensors"
    export_run(finished, output, [places])
    return output


@pytest.fixture
def evaluated(tmp_path: Path) -> Callable[..., Path]:
    """Give the writer of what `evaluate` leaves as JSON."""

    def write(encoder: str, recall: float | None = 0.625, name: str = "results.json") -> Path:
        def scores(heading: str, tried: int) -> dict[str, Any]:
            about = {
                "benchmark": "simulated", "encoder": encoder, "setting": "aerial", "heading": heading,
                "query_headings": tried, "way": "nearest", "database": 27_000,
            }  # fmt: skip
            figures = [
                {
                    "divided_by": divided, "measure": label, "radius_m": radius, "queries": 1234, "recall": value,
                    "low": 0.5, "high": 0.75, "chance": 0.05,
                }
                for divided, value in (("all", recall), ("family", 0.111))
                for label, _ in MEASURES
                for radius in (100.0, 50.0, 25.0)
            ]  # fmt: skip
            return {"about": about, "figures": figures, "curves": []}

        path = tmp_path / name
        path.write_text(json.dumps([scores("aligned", 1), scores("random", 8)]))
        return path

    return write


def test_the_card_takes_in_the_results_of_every_benchmark(
    finished: Path, shipped: Path, evaluated: Callable[..., Path]
) -> None:
    fingerprint = load_checkpoint(shipped).fingerprint
    results = [evaluated(fingerprint), evaluated(fingerprint, 0.5, "other.json")]
    card = write_card(finished, shipped, results=results).read_text()
    assert card.startswith("# Model card: town\n")
    rows = [line for line in card.splitlines() if line.startswith("| simulated |")]
    assert len(rows) == 4
    assert "62.5 % [50.0, 75.0]" in rows[0] and "27,000" in rows[0] and "north-aligned" in rows[0]
    assert "random, 8 rotations, nearest descriptor" in rows[1] and "5.0 %" in rows[1]
    assert "50.0 % [50.0, 75.0]" in rows[3] and "11.1 %" not in card


def test_results_of_other_weights_or_of_nothing_are_refused(
    finished: Path, shipped: Path, evaluated: Callable[..., Path], tmp_path: Path
) -> None:
    before = (shipped.parent / run_folder.MODEL_CARD).read_text()
    with pytest.raises(TrainingError, match="0123456789abcdef"):
        write_card(finished, shipped, results=[evaluated("0123456789abcdef")])
    for damaged in ("", "{}", "[]", '[{"about": {"encoder": "x"}, "figures": []}]'):
        (tmp_path / "damaged.json").write_text(damaged)
        with pytest.raises(TrainingError, match=r"damaged\.json"):
            write_card(finished, shipped, results=[tmp_path / "damaged.json"])
    assert (shipped.parent / run_folder.MODEL_CARD).read_text() == before


def test_a_measure_that_could_not_be_counted_is_reported(
    finished: Path, shipped: Path, evaluated: Callable[..., Path]
) -> None:
    results = evaluated(load_checkpoint(shipped).fingerprint, None)
    assert "none to count" in write_card(finished, shipped, results=[results]).read_text()


def test_the_card_of_exported_weights_shows_their_own_validation(finished: Path, shipped: Path) -> None:
    exported = json.loads(load_checkpoint(shipped).metadata["examined"])
    card = (shipped.parent / run_folder.MODEL_CARD).read_text()
    best = next(r for r in exported["recalls"] if (r["label"], r["radius_m"]) == ("R@1", 100.0))
    interval = f"{100 * best['value']:.1f} % [{100 * best['low']:.1f}, {100 * best['high']:.1f}]"
    assert f"| 100 m | R@1 | {interval} |" in card
    assert "from scratch" in card and "Previous weights" not in card


def test_the_card_reports_what_came_before_and_how_it_was_learned(
    finished: Path, places: Path, tmp_path: Path, tiny: TrainConfig
) -> None:
    config = dataclasses.replace(
        tiny, loss="smooth_ap", headings=4, chunk_pairs=3, hard_share=0.5, mine_steps=1, mined_places=30
    )
    trainer = Trainer(config, [places], tmp_path / "second", Budget(steps=2), finished / run_folder.FINAL)
    trainer.run()
    card = trainer.write_card().read_text()
    first = load_checkpoint(finished / run_folder.FINAL).fingerprint
    assert re.search(rf"\| final\.safetensors \| `{first}` \| 2 \| [\d.]+ \| info_nce \| 1 \|", card)
    for words in (
        "from `final.safetensors` (see", "--initial final.safetensors", "encoded in 4 headings", "average precision",
        "chunks of 3 pairs", "weights confused", "close in heading",
    ):  # fmt: skip
        assert words in card


def test_the_page_shows_the_run(finished: Path, tmp_path: Path) -> None:
    page = (finished / run_folder.CURVE).read_text()
    assert page.count("<svg") == 4 and "http-equiv" not in page and "src=" not in page and "href=" not in page
    validation = next(e for e in run_folder.read_log(finished) if e["kind"] == "validation")
    assert f"{100 * validation['recalls'][0]['value']:.1f} %" in page
    assert 'http-equiv="refresh"' in curve_page(finished, live=True)
    assert train.main(["curve", str(finished), "--output", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").read_text() == page


def test_a_run_without_anything_to_draw_is_reported(finished: Path) -> None:
    (finished / run_folder.LOG).write_text("")
    with pytest.raises(TrainingError, match="not logged a step"):
        write_curve(finished)
