"""How a run goes, as one HTML page that needs nothing but itself: loss, validation, rate and end time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.evaluation.statistics import Share
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.pages import charts
from crossloc3d_ros.pages.render import render_page
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.types import Float64Array

RECALLS = (("R@1", 100.0), ("R@1", 50.0), ("R@1", 25.0), ("R@25", 100.0))
_MOST_POINTS = 300  # of a curve: more than its width in pixels shows
_RELOAD_S = 60  # of a page while training runs


@dataclass(frozen=True)
class Validation:
    """One validation of a run."""

    hours: float
    step: int
    recalls: tuple[Share, ...]
    """As `RECALLS`."""


@dataclass(frozen=True)
class CurvePage:
    """Return the values of the page's template."""

    run: str
    reload_s: int | None
    step: int
    hours: float
    budget: str | None
    loss: float
    loss_name: str
    learning_rate: float
    clouds_per_s: float
    clouds: int
    resumed: int
    processor: str
    accelerator: str
    validations: tuple[Validation, ...]
    recall_chart: Markup | None
    loss_chart: Markup
    rate_chart: Markup
    speed_chart: Markup
    recalls: tuple[tuple[str, float], ...] = RECALLS
    """Label and radius in metres."""


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
    end_h = max(entry["elapsed_s"] for entry in (*steps, *validations)) / 3600.0
    last, hours = steps[-1], _hours(steps)
    losses = np.array([entry["loss"] for entry in steps])
    rates = np.array([1000.0 * entry["rate"] for entry in steps])
    speeds = np.array([entry["samples_per_s"] for entry in steps])
    page = CurvePage(
        run=folder.resolve().name,
        reload_s=_RELOAD_S if live else None,
        step=last["step"],
        hours=end_h,
        budget=starts[-1].get("budget"),
        loss=last["loss"],
        loss_name=config.loss,
        learning_rate=last["rate"],
        clouds_per_s=last["samples_per_s"],
        clouds=last.get("clouds", 2 * config.pairs * last["step"]),
        resumed=len(starts) - 1,
        processor=starts[-1]["processor"],
        accelerator=starts[-1]["accelerator"],
        validations=tuple(_validation(entry) for entry in validations),
        recall_chart=_recall_chart(validations, end_h) if validations else None,
        loss_chart=_series_chart(hours, losses, end_h, "training loss", "Training loss over the hours"),
        rate_chart=_series_chart(hours, rates, end_h, "learning rate × 1000", "Learning rate over the hours"),
        speed_chart=_series_chart(hours, speeds, end_h, "clouds a second", "Clouds a second over the hours"),
    )
    return render_page("curve.html.j2", page)


def _hours(entries: list[dict[str, Any]]) -> Float64Array:
    return np.array([entry["elapsed_s"] / 3600.0 for entry in entries])


def _thinned(hours: Float64Array, values: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the means of at most some hundred stretches of a series."""
    parts = np.array_split(np.arange(len(hours)), min(len(hours), _MOST_POINTS))
    return np.array([hours[part].mean() for part in parts]), np.array([values[part].mean() for part in parts])


def _series_chart(hours: Float64Array, values: Float64Array, end_h: float, label: str, title: str) -> Markup:
    chart = charts.Chart(
        charts.linear_axis(0.0, end_h, "hours"), charts.linear_axis(0.0, float(values.max()) * 1.05, label), title
    )
    return chart.render([chart.line(*_thinned(hours, values), "c-0")])


def _recall_chart(validations: list[dict[str, Any]], end_h: float) -> Markup:
    chart = charts.Chart(charts.linear_axis(0.0, end_h, "hours"), charts.share_axis("recall"), "Recall over the hours")
    hours = _hours(validations)
    marks = []
    for number, measure in enumerate(RECALLS):
        values = np.array([_recall(entry, *measure)["value"] for entry in validations])
        marks += [chart.line(hours, values, f"c-{number}"), chart.dots(hours, values, ["truth"] * len(hours), 2.0)]
    return chart.render(marks)


def _validation(entry: dict[str, Any]) -> Validation:
    recalls = (_recall(entry, *measure) for measure in RECALLS)
    shares = tuple(Share(recall["value"], recall["low"], recall["high"]) for recall in recalls)
    return Validation(entry["elapsed_s"] / 3600.0, entry["step"], shares)


def _recall(entry: dict[str, Any], label: str, radius_m: float) -> dict[str, Any]:
    return next(r for r in entry["recalls"] if r["label"] == label and r["radius_m"] == radius_m)
