"""The model card, written from the run's own files and the benchmarks' results: nothing in it is typed by hand."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from crossloc3d_ros.config import TrainConfig, to_dict
from crossloc3d_ros.encoder.checkpoint import load_checkpoint
from crossloc3d_ros.errors import TrainingError
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.material import Dataset, Material, Towns
from crossloc3d_ros.training.shards import TRAINING, VALIDATION, Manifest, TownEntry
from crossloc3d_ros.training.validation import QUANTILES

_NAMES = {
    "crossloc3d": "CrossLoc3D (ICCV 2023)",
    "pointnetvlad": "PointNetVLAD (CVPR 2018)",
    "lpdnet": "LPD-Net (ICCV 2019)",
    "minkloc3d": "MinkLoc3D (WACV 2021)",
    "minkloc3dv2": "MinkLoc3Dv2 (ICPR 2022)",
    "minkloc3d_s": "MinkLoc3D-S (2021)",
    "transloc3d": "TransLoc3D (2021)",
}
_MEASURES = (("R@1", 100.0), ("R@1", 50.0), ("R@1", 25.0), ("R@25", 100.0), ("R@1%", 100.0))


def model_card(
    folder: Path,
    material: Material,
    *,
    weights: Path | None = None,
    results: Sequence[Path] = (),
) -> str:
    """Return the card of the run in `folder`, which learned from `material`, as Markdown.

    `weights`: the file that the card is of, exported from the run; by default what the run wrote last. `results`: JSON
    files of `evaluate`, of just these weights. Raises TrainingError where the run has not validated yet, and for
    results that cannot be read or are those of other weights.
    """
    config = run_folder.read_config(folder)
    entries = run_folder.read_log(folder)
    validations = _of_kind(entries, "validation")
    starts = _of_kind(entries, "start")
    shown = weights or folder / run_folder.FINAL
    benchmarks: list[dict[str, Any]] = []
    if weights is not None or results:
        checkpoint = load_checkpoint(shown)
        validations = _until_exported(validations, checkpoint.metadata)
        benchmarks = _read_results(results, checkpoint.fingerprint)
    if not validations or not starts:
        raise TrainingError(f"the run in {folder} has not validated yet: there are no results to write a card from")
    last = validations[-1]
    history = run_folder.history(folder)
    name = weights.stem if weights is not None else folder.name
    sections = [
        f"# Model card: {name}\n",
        _introduction(config, material, history),
        *([_benchmarks(benchmarks)] if benchmarks else []),
        _results(last),
        _distances(last),
        _course(validations),
        *_data(material),
        *([_history(history)] if history else []),
        _training(config, entries, last),
        _limits(material),
    ]
    return "\n".join(sections)


def _until_exported(validations: list[dict[str, Any]], metadata: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the validations up to the one of the exported weights, which their file holds whole."""
    if "examined" not in metadata:
        return validations
    exported = json.loads(metadata["examined"])
    return [v for v in validations if v["step"] < exported["step"]] + [exported]


def _introduction(config: TrainConfig, material: Material, history: Sequence[dict[str, Any]]) -> str:
    data = "simulated towns" if isinstance(material, Towns) else f"the dataset described below ({material.preset})"
    if isinstance(material, Towns) and any("surveys" in m.settings for m in material.manifests):
        data = "simulated towns and surveyed surfaces"
    begun = "from scratch" if not history else f"from `{history[-1]['weights']}` (see “Previous weights”)"
    if config.headings > 1:
        query = (
            f"The heading of a query matters: it is encoded in {config.headings} headings, and the nearest descriptor "
            "counts, which also gives the heading."
        )
    elif config.rotations > 1:
        query = (
            f"The descriptor of a query is the mean over {config.rotations} test-time rotations; its heading does not "
            "matter."
        )
    else:
        query = "The heading of a query does not matter."
    return (
        "LiDAR place recognition: a scan against submaps of an airborne survey, heading unknown. The network is "
        f"{_NAMES[config.model.network]}, with the settings below; the weights were trained {begun}, on {data}. "
        f"{query}\n"
    )


def _read_results(paths: Sequence[Path], fingerprint: str) -> list[dict[str, Any]]:
    """Return what `evaluate` wrote; TrainingError where it is damaged or of other weights than the card."""
    found: list[dict[str, Any]] = []
    for path in paths:
        try:
            content = json.loads(path.read_text())
            encoders = {scores["about"]["encoder"] for scores in content}
            for scores in content:
                scores["all"] = {
                    (f["measure"], float(f["radius_m"])): f for f in scores["figures"] if f["divided_by"] == "all"
                }
            missing = [m for scores in content for m in _MEASURES if m not in scores["all"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise TrainingError(f"{path} cannot be read as results of `evaluate` ({error})") from error
        if missing or not content:
            raise TrainingError(f"{path} holds no results of `evaluate`, or not all of them")
        if encoders != {fingerprint}:
            raise TrainingError(
                f"{path} holds results of the weights {', '.join(sorted(encoders))}, the card is of {fingerprint}"
            )
        found += content
    return found


def _benchmarks(results: Sequence[dict[str, Any]]) -> str:
    lines = [
        "## Benchmarks\n",
        "Written by `evaluate`. In brackets the 95 % interval of a bootstrap over whole towns, or over squares of 50 m "
        "where there are fewer than eight towns; the chance level is R@1 at 100 m of a random order. Nothing was "
        "trained or tuned on them.\n",
        "| benchmark | database | heading of the query | queries | "
        + " | ".join(f"{label} {radius:.0f} m" for label, radius in _MEASURES)
        + " | chance level |",
        "|---" * (5 + len(_MEASURES)) + "|",
    ]
    for scores in results:
        about, figures = scores["about"], scores["all"]
        tried = about["query_headings"]
        how = {"nearest": "nearest descriptor", "mean": "mean descriptor"}[about["way"]]
        heading = "north-aligned" if about["heading"] == "aligned" else "random"
        heading += f", {tried} rotations, {how}" if tried > 1 else ""
        if verified := about.get("verified"):
            heading += f"; first {verified:,} reordered by height maps"
        cells = [_percent(figures[measure]) for measure in _MEASURES]
        chance = f"{100 * figures['R@1', 100.0]['chance']:.1f} %"
        lines.append(
            f"| {about['benchmark']} | {about['setting']}, {about['database']:,} | {heading} | "
            f"{figures['R@1', 100.0]['queries']:,} | {' | '.join(cells)} | {chance} |"
        )
    return "\n".join(lines) + "\n"


def _percent(figure: dict[str, Any]) -> str:
    value = figure["recall"] if "recall" in figure else figure["value"]
    if value is None:
        return "none to count"
    return f"{100 * value:.1f} % [{100 * figure['low']:.1f}, {100 * figure['high']:.1f}]"


def _results(entry: dict[str, Any]) -> str:
    lines = [
        "## Validation\n",
        f"{entry['queries']:,} scans of places that training never saw, against one database of "
        f"{entry['submaps']:,} submaps of those places. In brackets the 95 % Wilson interval over the queries; queries "
        "of one town resemble each other, so the true interval is wider. They served to "
        "select `best.safetensors` and to fit the calibration that is stored with the weights.\n",
        "| within | measure | recall | chance |",
        "|---|---|---|---|",
    ]
    for r in entry["recalls"]:
        measure = f"{r['label']} ({r['count']})" if r["label"] == "R@1%" else r["label"]
        lines.append(f"| {r['radius_m']:.0f} m | {measure} | {_percent(r)} | {100 * r['chance']:.1f} % |")
    return "\n".join(lines) + "\n"


def _distances(entry: dict[str, Any]) -> str:
    lines = [
        "## Descriptor distances on the same places\n",
        "Euclidean, to the submap whose centre is nearest to the scan, and to the nearest descriptor among the submaps "
        "more than 100 m away. The same numbers are in the metadata of the weights (`distances`).\n",
        "| quantile | " + " | ".join(f"{100 * q:.0f} %" for q in QUANTILES) + " |",
        "|---|" + "---|" * len(QUANTILES),
        "| right | " + " | ".join(f"{d:.2f}" for d in entry["true_distances"]) + " |",
        "| nearest wrong | " + " | ".join(f"{d:.2f}" for d in entry["false_distances"]) + " |",
    ]
    return "\n".join(lines) + "\n"


def _course(validations: list[dict[str, Any]]) -> str:
    lines = [
        "## Course of the training\n",
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


def _data(material: Material) -> Iterator[str]:
    yield "## Data\n"
    if isinstance(material, Dataset):
        digest = material.sha256()
        yield f"A dataset in the layout of CS-Campus3D, preset `{material.preset}`, fingerprint `{digest}`.\n"
    elif isinstance(material, Towns):
        yield from map(_towns, material.manifests)


def _towns(manifest: Manifest) -> str:
    settings = dict(manifest.settings)
    if {"towns", "validation_towns", "seed"} <= settings.keys():
        made = (
            "Simulated, by this package, from seeds; no real data. "
            f"`train make-places --towns {settings['towns']} --validation-towns {settings['validation_towns']} "
            f"--seed {settings['seed']}` with the settings below reproduces the places.\n"
        )
    else:
        made = (
            "A simulated sensor in the surface of a real survey: `train make-places --survey FILES` with the files, "
            "the seed and the settings below.\n"
        )
    lines = [made, "| | towns | families | scans | submaps |", "|---|---|---|---|---|"]
    for role, submaps in ((TRAINING, "cut anywhere, at any heading"), (VALIDATION, "")):
        towns = manifest.of_role(role)
        if towns:
            cut = submaps or f"{sum(t.submaps for t in towns):,}"
            lines.append(f"| {role} | {len(towns)} | {_families(towns)} | {sum(t.scans for t in towns):,} | {cut} |")
    rest = {key: value for key, value in settings.items() if key not in ("towns", "validation_towns")}
    lines.append(f"\nSettings: `{json.dumps(rest)}`")
    return "\n".join(lines) + "\n"


def _families(towns: list[TownEntry]) -> str:
    counts: dict[str, int] = {}
    for town in towns:
        counts[town.family] = counts.get(town.family, 0) + 1
    return ", ".join(f"{family} {count}" for family, count in sorted(counts.items()))


def _history(history: Sequence[dict[str, Any]]) -> str:
    lines = [
        "## Previous weights\n",
        "The run started from the last of these weights, as far as their tensors fit; each of them from the one "
        "above.\n",
        "| weights | fingerprint | steps | hours | loss | seed |",
        "|---|---|---|---|---|---|",
    ]
    for entry in history:
        training = entry.get("training", {})
        values = [str(training.get(key, "unknown")) for key in ("steps", "hours", "loss", "seed")]
        lines.append(f"| {entry['weights']} | `{entry['fingerprint']}` | {' | '.join(values)} |")
    return "\n".join(lines) + "\n"


def _training(config: TrainConfig, entries: list[dict[str, Any]], last: dict[str, Any]) -> str:
    starts = _of_kind(entries, "start")
    steps = [entry for entry in _of_kind(entries, "step") if entry["step"] <= last["step"]]
    first, resumed = starts[0], len(starts) - 1
    samples = steps[-1].get("clouds", 2 * config.pairs * last["step"]) if steps else 2 * config.pairs * last["step"]
    loss = f"{steps[-1]['loss']:.3f}" if steps else "unknown"
    initial = [entry["weights"] for entry in _of_kind(entries, "initial")][:1]
    begun = f" --initial {Path(initial[0]).name}" if initial else ""
    machines = dict.fromkeys(
        f"{start['processor']}, {start['threads']} of {start['cores']} cores, accelerator: {start['accelerator']}"
        for start in starts
    )
    budget = starts[-1].get("budget", "")
    settings = to_dict(config)
    recipe = {key: value for key, value in settings.items() if key not in ("model", "preprocessing", "device")}
    return f"""## Training

* Command: `train run --places PLACES --output RUN{begun} {budget} --config SETTINGS`, the settings being those below; \
seed {config.seed}; stopped and resumed {resumed} times.
* {last["step"]:,} steps, about {samples:,} clouds, {last["elapsed_s"] / 3600:.2f} hours on the clock, validation \
included; training loss at the end {loss}.
* Machine: {"; then ".join(machines)}. Python {first["python"]}, torch {first["torch"]}, numpy {first["numpy"]}.
* Network: `{json.dumps(settings["model"])}`
* Preprocessing: `{json.dumps(settings["preprocessing"])}`
* Recipe: `{json.dumps(recipe)}`
* {_recipe(config)}
"""


def _recipe(config: TrainConfig) -> str:
    """Say the recipe in words."""
    losses = {
        "info_nce": "cross entropy of each pair against the whole batch, both ways",
        "smooth_ap": "truncated smooth average precision over the whole batch, both ways",
        "batch_hard": "batch-hard triplets with swap",
    }
    rate = "a warm-up, a constant part and a cosine" if not config.milestones else "a tenth at each milestone"
    parts = [f"AdamW, learning rate with {rate}", f"loss: {losses[config.loss]}, on the Euclidean distance"]
    if config.chunk_pairs:
        parts.append(f"multistage back-propagation in chunks of {config.chunk_pairs} pairs, batch norms by chunk")
    if config.hard_share > 0.0:
        parts.append("part of each batch from places of all towns that the weights confused")
    if config.augmentation == "paper":
        parts.append("the published augmentation")
    elif config.headings == 1:
        parts.append(
            "both sides of a pair rotated over the full circle and mirrored together, scans thinned and partly occluded"
        )
    else:
        parts.append("pairs rotated and mirrored together, close in heading, scans thinned and partly occluded")
    if config.ema_decay > 0.0:
        parts.append("averaged weights with batch-norm statistics of their own")
    return "; ".join(parts) + "."


def _limits(material: Material) -> str:
    seen = "simulated towns only: real buildings, trees and sensors differ, and figures on them do not carry over"
    if isinstance(material, Dataset):
        seen = "the places of one dataset: other towns, seasons and sensors differ, and figures do not carry over"
    return f"""## What it cannot do

* It has seen {seen}. Evaluate it on a drive of your own before relying on it.
* It distinguishes places by what stands above the ground within a patch. Open fields, water, forests without \
structure, tunnels and interiors have nothing of that kind.
* It is made for the sensors of its data, upright within a few degrees.
* A descriptor gives a place, not a pose: the centre of the nearest submap.
"""


def _of_kind(entries: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [entry for entry in entries if entry["kind"] == kind]
