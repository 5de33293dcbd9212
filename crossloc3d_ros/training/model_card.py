"""The model card, written from the run's own files: nothing in it is typed by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from crossloc3d_ros.config import to_dict
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.material import Material
from crossloc3d_ros.training.shards import TRAINING, VALIDATION, Manifest, TownEntry
from crossloc3d_ros.training.validation import QUANTILES


def model_card(folder: Path, material: Material, result: dict[str, Any] | None = None) -> str:
    """Return the card of the run in `folder` over the places of `material`, as Markdown.

    `result` is a validation in the form of the log's; without it the run's last one is taken. Raises TrainingError
    where there is none.
    """
    settings = to_dict(run_folder.read_config(folder))
    entries = run_folder.read_log(folder)
    validations = [entry for entry in entries if entry["kind"] == "validation"]
    steps = [entry for entry in entries if entry["kind"] == "step"]
    starts = [entry for entry in entries if entry["kind"] == "start"]
    if result is not None:
        validations = [v for v in validations if v["step"] < result["step"]] + [result]
    if not validations or not starts:
        raise TrainingError(f"the run in {folder} has not validated yet: there are no results to write a card from")
    last = validations[-1]
    sections = [
        "# Model card: CrossLoc3D, first weights\n",
        "LiDAR place recognition: a VLP-16 scan against submaps of an airborne survey, heading unknown. The network is "
        "that of CrossLoc3D (ICCV 2023); the weights were learned from scratch on simulated towns alone.\n",
        _results(last),
        _distances(last),
        _course(validations),
        *(_data(manifest) for manifest in material.manifests),
        _training(settings, steps, starts, last, len(starts) - 1),
        _LIMITS,
    ]
    return "\n".join(sections)


def _results(entry: dict[str, Any]) -> str:
    lines = [
        "## Results\n",
        f"{entry['queries']:,} scans of towns that training never saw, headings over the full circle, against one "
        f"database of {entry['submaps']:,} aerial submaps of those towns (no ground submaps). Surveys and scans are of "
        "different epochs. In brackets the 95 % Wilson interval over the queries; queries of one town resemble each "
        "other, so the true interval is wider. These towns served to pick `best.safetensors` and nothing else.\n",
        "| within | measure | recall | chance |",
        "|---|---|---|---|",
    ]
    for r in entry["recalls"]:
        measure = f"{r['label']} ({r['count']})" if r["label"] == "R@1%" else r["label"]
        interval = f"{100 * r['value']:.1f} % [{100 * r['low']:.1f}, {100 * r['high']:.1f}]"
        lines.append(f"| {r['radius_m']:.0f} m | {measure} | {interval} | {100 * r['chance']:.1f} % |")
    return "\n".join(lines) + "\n"


def _distances(entry: dict[str, Any]) -> str:
    lines = [
        "## Descriptor distances on the same towns\n",
        "Euclidean, to the submap whose centre is nearest to the scan, and to the nearest descriptor among the submaps "
        "more than 100 m away. The same numbers travel in the weights' metadata (`distances`).\n",
        "| quantile | " + " | ".join(f"{100 * q:.0f} %" for q in QUANTILES) + " |",
        "|---|" + "---|" * len(QUANTILES),
        "| right | " + " | ".join(f"{d:.2f}" for d in entry["true_distances"]) + " |",
        "| nearest wrong | " + " | ".join(f"{d:.2f}" for d in entry["false_distances"]) + " |",
    ]
    return "\n".join(lines) + "\n"


def _course(validations: list[dict[str, Any]]) -> str:
    lines = [
        "## How it got there\n",
        "| minutes | steps | R@1 100 m | R@1 25 m | R@25 100 m |",
        "|---|---|---|---|---|",
    ]
    for entry in validations:
        value = {(r["label"], r["radius_m"]): 100 * r["value"] for r in entry["recalls"]}
        lines.append(
            f"| {entry['elapsed_s'] / 60:.0f} | {entry['step']:,} | {value['R@1', 100.0]:.1f} % | "
            f"{value['R@1', 25.0]:.1f} % | {value['R@25', 100.0]:.1f} % |"
        )
    return "\n".join(lines) + "\n"


def _data(manifest: Manifest) -> str:
    settings = manifest.settings
    lines = [
        "## Data\n",
        "Simulated, by this package, from seeds; no real data. "
        f"`train make-places --towns {settings['towns']} --validation-towns {settings['validation_towns']} "
        f"--seed {settings['seed']}` makes the same places again.\n",
        "| | towns | families | scans | submaps |",
        "|---|---|---|---|---|",
    ]
    for role, submaps in ((TRAINING, "cut anywhere, at any heading"), (VALIDATION, "")):
        towns = manifest.of_role(role)
        cut = submaps or f"{sum(t.submaps for t in towns):,}"
        lines.append(f"| {role} | {len(towns)} | {_families(towns)} | {sum(t.scans for t in towns):,} | {cut} |")
    lines.append(
        f"\nSettings: `{json.dumps(settings['places'])}`, preprocessing `{json.dumps(settings['preprocessing'])}`"
    )
    return "\n".join(lines) + "\n"


def _families(towns: list[TownEntry]) -> str:
    counts: dict[str, int] = {}
    for town in towns:
        counts[town.family] = counts.get(town.family, 0) + 1
    return ", ".join(f"{family} {count}" for family, count in sorted(counts.items()))


def _training(
    settings: dict[str, Any],
    steps: list[dict[str, Any]],
    starts: list[dict[str, Any]],
    last: dict[str, Any],
    resumed: int,
) -> str:
    first = starts[0]
    samples = 2 * settings["pairs"] * last["step"]
    loss = f"{steps[-1]['loss']:.3f}" if steps else "unknown"
    hardware = (
        f"{first['processor']}, {first['threads']} of {first['cores']} cores, accelerator: {first['accelerator']}"
    )
    recipe = {key: value for key, value in settings.items() if key not in ("model", "preprocessing", "device")}
    budget = first.get("budget", "")
    return f"""## Training

* Command: `train run --places PLACES --output RUN {budget} --config SETTINGS`, the settings being those below; \
seed {settings["seed"]}; interrupted and resumed {resumed} times.
* {last["step"]:,} steps, {samples:,} clouds, {last["elapsed_s"] / 3600:.2f} hours on the clock, validation included, \
beside other work on the same machine; training loss at the end {loss}.
* Machine: {hardware}. Python {first["python"]}, torch {first["torch"]}, numpy {first["numpy"]}.
* Network: `{json.dumps(settings["model"])}`
* Recipe: `{json.dumps(recipe)}`
* AdamW, warm-up and cosine over the budget, clipped gradients, averaged weights with batch-norm statistics of their \
own; both sides of a pair are turned over the full circle and mirrored together, scans are thinned and partly blocked; \
the loss is on the Euclidean distance that the map is searched by.
"""


_LIMITS = """## What it cannot do

* It has seen simulated towns only: real buildings, trees and sensors differ, and the figures above do not carry over \
to them. Judge it on a drive through a real survey before relying on it.
* It tells places apart by what stands above the ground within 50 m. Open fields, water, forests without structure, \
tunnels and interiors give it nothing to go by.
* It knows one sensor (16 beams, -15 to +15 degrees) near 0.9 to 1.6 m above the ground, upright within a few degrees.
* A descriptor gives a place, not a heading, and not a metre: the nearest submap's centre is the answer.
"""
