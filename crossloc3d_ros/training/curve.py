"""How a run goes, as one HTML page that needs nothing but itself: loss, validation, rate and end time."""

from __future__ import annotations

import math
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.config import TrainConfig
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages import charts
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.types import Float64Array

_RECALLS = (("R@1", 100.0), ("R@1", 50.0), ("R@1", 25.0), ("R@25", 100.0))
_MOST_POINTS = 300  # of a curve: more than its width in pixels shows
_RELOAD_S = 60  # of a page while training runs


def write_curve(folder: Path, path: Path | None = None, *, live: bool = False) -> Path:
    """Write the page of the run in `folder`, by default into it, and return its path.

    A page that is `live` loads itself anew every minute. Raises TrainingError where the folder holds no run or one
    that has not logged anything yet.
    """
    path = path or folder / run_folder.CURVE
    write_atomically(path, curve_page(folder, live=live))
    return path


def curve_page(folder: Path, *, live: bool = False) -> str:
    """Return the page of the run in `folder`; see `write_curve`."""
    config = run_folder.read_config(folder)
    entries = run_folder.read_log(folder)
    steps = [entry for entry in entries if entry["kind"] == "step" and math.isfinite(entry["loss"])]
    validations = [entry for entry in entries if entry["kind"] == "validation"]
    starts = [entry for entry in entries if entry["kind"] == "start"]
    if not steps or not starts:
        raise TrainingError(f"the run in {folder} has not logged a step yet")
    last = steps[-1]
    end_h = max(entry["elapsed_s"] for entry in (*steps, *validations)) / 3600.0
    title = f"Training: {folder.resolve().name}"
    facts = _facts(config, starts, last, end_h)
    reload = f'<meta http-equiv="refresh" content="{_RELOAD_S}">' if live else ""
    body = "".join(
        [
            f"<header><h1>{escape(title)}</h1>",
            f'<ul class="facts">{"".join(f"<li>{k} <b>{escape(v)}</b></li>" for k, v in facts.items())}</ul></header>',
            '<section><h2>What it reaches on places that training never sees, and the loss</h2><div class="pair">',
            f"<div>{_recall_chart(validations, end_h)}{_legend()}</div>" if validations else "",
            f"<div>{_loss_chart(steps, end_h)}</div></div></section>",
            f"<section><h2>Validations</h2>{_table(validations)}</section>" if validations else "",
            f'<section><h2>Rate</h2><div class="pair"><div>{_rate_chart(steps, end_h)}</div>',
            f"<div>{_speed_chart(steps, end_h)}</div></div></section>",
        ]
    )
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">{reload}'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="color-scheme" content="light dark"><title>{escape(title)}</title>'
        f"<style>{_style()}</style></head><body><main>{body}</main></body></html>\n"
    )


def _facts(config: TrainConfig, starts: list[dict[str, Any]], last: dict[str, Any], end_h: float) -> dict[str, str]:
    return {
        "step": f"{last['step']:,}",
        "hours": f"{end_h:.2f}",
        "budget": starts[-1].get("budget", "unknown"),
        "loss": f"{last['loss']:.4f} ({config.loss})",
        "learning rate": f"{last['rate']:.2e}",
        "clouds a second": f"{last['samples_per_s']:.1f}",
        "clouds": f"{last.get('clouds', 2 * config.pairs * last['step']):,}",
        "resumed": f"{len(starts) - 1} times",
        "machine": f"{starts[-1]['processor']}, accelerator: {starts[-1]['accelerator']}",
    }


def _style() -> str:
    pages = resources.files("crossloc3d_ros.pages") / "assets"
    return "".join((pages / name).read_text(encoding="utf-8") for name in ("page.css", "benchmark.css"))


def _hours(entries: list[dict[str, Any]]) -> Float64Array:
    return np.array([entry["elapsed_s"] / 3600.0 for entry in entries])


def _thinned(hours: Float64Array, values: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the means of at most some hundred stretches of a series."""
    parts = np.array_split(np.arange(len(hours)), min(len(hours), _MOST_POINTS))
    return np.array([hours[part].mean() for part in parts]), np.array([values[part].mean() for part in parts])


def _series_chart(hours: Float64Array, values: Float64Array, end_h: float, label: str, title: str) -> str:
    chart = charts.Chart(
        charts.linear_axis(0.0, end_h, "hours"), charts.linear_axis(0.0, float(values.max()) * 1.05, label), title
    )
    return chart.render([chart.line(*_thinned(hours, values), "c-0")])


def _loss_chart(steps: list[dict[str, Any]], end_h: float) -> str:
    losses = np.array([entry["loss"] for entry in steps])
    return _series_chart(_hours(steps), losses, end_h, "training loss", "Training loss over the hours")


def _rate_chart(steps: list[dict[str, Any]], end_h: float) -> str:
    rates = np.array([1000.0 * entry["rate"] for entry in steps])
    return _series_chart(_hours(steps), rates, end_h, "learning rate × 1000", "Learning rate over the hours")


def _speed_chart(steps: list[dict[str, Any]], end_h: float) -> str:
    speeds = np.array([entry["samples_per_s"] for entry in steps])
    return _series_chart(_hours(steps), speeds, end_h, "clouds a second", "Clouds a second over the hours")


def _recall_chart(validations: list[dict[str, Any]], end_h: float) -> str:
    chart = charts.Chart(charts.linear_axis(0.0, end_h, "hours"), charts.share_axis("recall"), "Recall over the hours")
    hours = _hours(validations)
    marks = []
    for number, measure in enumerate(_RECALLS):
        values = np.array([_recall(entry, *measure)["value"] for entry in validations])
        marks += [chart.line(hours, values, f"c-{number}"), chart.dots(hours, values, ["truth"] * len(hours), 2.0)]
    return chart.render(marks)


def _legend() -> str:
    keys = "".join(
        f'<span><i class="key stroke k-{number}"></i>{label} {radius:.0f} m</span>'
        for number, (label, radius) in enumerate(_RECALLS)
    )
    return f'<p class="below">{keys}</p>'


def _table(validations: list[dict[str, Any]]) -> str:
    head = "".join(f"<th>{label} {radius:.0f} m</th>" for label, radius in _RECALLS)
    rows = []
    for entry in reversed(validations):
        cells = []
        for measure in _RECALLS:
            recall = _recall(entry, *measure)
            low, high = 100 * recall["low"], 100 * recall["high"]
            cells.append(f"<td>{100 * recall['value']:.1f} % <small>{low:.1f} to {high:.1f}</small></td>")
        rows.append(f"<tr><td>{entry['elapsed_s'] / 3600:.2f}</td><td>{entry['step']:,}</td>{''.join(cells)}</tr>")
    return (
        f'<div class="scroll"><table class="recall"><thead><tr><th>hours</th><th>step</th>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _recall(entry: dict[str, Any], label: str, radius_m: float) -> dict[str, Any]:
    return next(r for r in entry["recalls"] if r["label"] == label and r["radius_m"] == radius_m)
