"""Tables of comparison: the paper's competitors and its ablations, each row trained in the same way and budget.

A row is a training run in a folder of its own, or a method without learning. Rows are done one after the other; what
is done is kept, so a table that was stopped goes on where it was. Every row learns from the same places, by the same
recipe and seed, and is evaluated on the same benchmark as `evaluate` does it: aerial database, random heading.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import torch

from crossloc3d_ros.config import ModelConfig, PreprocessingConfig, TrainConfig, to_dict, usable_threads
from crossloc3d_ros.datasets.place_sets import EvaluationSet
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.encoder.networks import PUBLISHED, make_network
from crossloc3d_ros.errors import ConfigError, CrossLocError, TrainingError
from crossloc3d_ros.evaluation.retrieval.encoding import EncodingJob, time_queries
from crossloc3d_ros.evaluation.retrieval.predictions import (
    Plan,
    Predictions,
    load_predictions,
    predict_all,
    save_predictions,
    way_of,
)
from crossloc3d_ros.evaluation.retrieval.scores import difference, score
from crossloc3d_ros.evaluation.statistics import Recall, Share, find_recall
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.training import run_folder
from crossloc3d_ros.training.handcrafted import HeightMaps, ScanContext
from crossloc3d_ros.training.loop import Progress, Trainer
from crossloc3d_ros.training.material import read_material
from crossloc3d_ros.training.schedule import Budget
from crossloc3d_ros.types import DescriptorEncoder
from crossloc3d_ros.workers import EncoderLoader

logger = logging.getLogger(__name__)

TableName = Literal[
    "competitors", "grains", "selection", "refinement", "sub_steps", "time_embedding", "headings", "position"
]
TABLES: tuple[TableName, ...] = get_args(TableName)
RANKS, RADII_M = (1, 5, 25), (100.0, 25.0)
RESULT, PREDICTIONS, ENDED = "result.json", "predictions.npz", "ended.txt"
_FORMAT = 1  # of stored results; others are computed anew


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    slug: str
    """Its folder's name."""
    name: str
    config: TrainConfig | None
    """How it learns; None: it does not."""
    method: Literal["scan_context", "height_maps"] | None = None
    """What compares without learning."""
    published: tuple[float, float] | None = None
    """The paper's AR@1 and "AR@1%" on CS-Campus3D, per cent."""
    is_reference: bool = False
    """Whether the others are compared with it."""


@dataclass(frozen=True)
class Result:
    """What a row came to."""

    slug: str
    name: str
    encoder: str
    """Fingerprint of what was evaluated."""
    data: str
    """Fingerprint of the benchmark's set."""
    descriptor_size: int
    parameters: int
    query_headings: int
    """In how many headings a query is encoded."""
    one_thread_ms: float
    """Median to encode a query in all its headings on the CPU with one thread."""
    encode_ms: float
    """The same with as many threads as cores, at most four."""
    search_ms: float
    steps: int
    clouds: int
    """Clouds seen in training."""
    hours: float
    recalls: tuple[Recall, ...]
    ahead: Share | None = None
    """By how much its R@1 at 100 m exceeds the reference row's on the same queries; None for the reference."""
    published: tuple[float, float] | None = None

    def recall(self, rank: int, radius_m: float) -> Recall:
        """Return one recall; KeyError where there is none."""
        return find_recall(self.recalls, f"R@{rank}", radius_m)


def rows_of(table: TableName, base: TrainConfig) -> list[Row]:
    """Return the rows of a table; what a table does not vary is as in `base`."""
    if table not in TABLES:
        raise ConfigError(f"unknown table '{table}'; known are: {', '.join(TABLES)}")
    if table == "competitors":
        return _competitors(base)
    model = dataclasses.replace(base.model, network="crossloc3d")
    if table == "headings":
        return _heading_rows(base, model)
    return [
        Row(slug, name, dataclasses.replace(base, model=changed), is_reference=changed == model)
        for slug, name, changed in _variants(table, model)
    ]


def _heading_rows(base: TrainConfig, model: ModelConfig) -> list[Row]:
    return [
        Row(
            f"headings_{count}",
            "heading learned away" if count == 1 else f"{count} headings tried",
            dataclasses.replace(base, model=model, headings=count, rotations=base.rotations if count == 1 else 1),
            is_reference=count == base.headings,
        )
        for count in sorted({1, 4, 8, 16, base.headings})
    ]


def _variants(table: TableName, model: ModelConfig) -> Iterator[tuple[str, str, ModelConfig]]:
    """Yield slug, name and network of each row of a table that varies the network."""
    if table == "grains":
        fine, middle, coarse = _three_grains(model)
        for sizes in (
            (fine,), (middle,), (coarse,), (fine, middle), (fine, coarse), (middle, coarse), (fine, middle, coarse),
        ):  # fmt: skip
            slug = "_".join(f"{1000 * size:.0f}" for size in sizes)
            name = " + ".join(f"{size:g}" for size in sizes)
            yield f"grains_{slug}", name, dataclasses.replace(model, voxel_sizes=sizes)
    elif table == "selection":
        for kept in (0, 1, 2, 3, 4, 5):
            name = "no selection: the mean of all five" if kept == 0 else f"top {kept} of five"
            yield f"selection_{kept}", name, dataclasses.replace(model, kept_branches=kept)
    elif table == "refinement":
        names = {"none": "no refinement", "fine_to_coarse": "fine to coarse", "coarse_to_fine": "coarse to fine"}
        for order, name in names.items():
            yield f"refinement_{order}", name, dataclasses.replace(model, refinement=order)  # type: ignore[arg-type]
    elif table == "sub_steps":
        for steps in (1, 2, 3, 4):
            changed = dataclasses.replace(model, sub_steps=steps, memory_sizes=_memories(model, steps))
            yield f"sub_steps_{steps}", f"{steps} sub-step{'s' * (steps > 1)} a grain", changed
    elif table == "time_embedding":
        for which, is_used in (("without", False), ("with", True)):
            changed = dataclasses.replace(model, time_embedding=is_used)
            yield f"time_embedding_{which}", f"{which} time embedding", changed
    elif table == "position":
        names = {"none": "no position", "radial": "distance and height", "cartesian": "x, y and height"}
        for kind, name in names.items():
            yield f"position_{kind}", name, dataclasses.replace(model, position=kind)  # type: ignore[arg-type]


def _competitors(base: TrainConfig) -> list[Row]:
    """Return the paper's competitors, at the width of the base's network, and the methods without learning."""
    published = {
        "pointnetvlad": ("PointNetVLAD", (19.1, 43.5)),
        "lpdnet": ("LPD-Net", (12.0, 40.7)),
        "minkloc3d": ("MinkLoc3D", (55.4, 85.2)),
        "minkloc3dv2": ("MinkLoc3Dv2", (52.5, 83.5)),
        "minkloc3d_s": ("MinkLoc3D-S", (32.2, 71.9)),
        "transloc3d": ("TransLoc3D", (43.0, 80.6)),
    }
    model = dataclasses.replace(base.model, network="crossloc3d")
    rows = [
        Row("scan_context", "Scan Context", None, "scan_context"),
        Row("height_maps", "height maps, matched", None, "height_maps"),
    ]
    for network, (name, figures) in published.items():
        sized = dataclasses.replace(
            PUBLISHED[network],
            channels=model.channels,
            fused_channels=model.fused_channels,
            clusters=model.clusters,
            descriptor_size=model.descriptor_size,
        )
        rows.append(Row(network, name, dataclasses.replace(base, model=sized), published=figures))
        if network in ("minkloc3d", "minkloc3dv2", "transloc3d"):
            # Their voxels were chosen for clouds of another density: the same network with voxels as fine as ours.
            coarser = dataclasses.replace(sized, voxel_sizes=model.voxel_sizes[:1])
            voxel = f"{model.voxel_sizes[0]:g}"
            rows.append(
                Row(f"{network}_coarser", f"{name}, voxels of {voxel}", dataclasses.replace(base, model=coarser))
            )
    ours = dataclasses.replace(base, model=model)
    return [*rows, Row("crossloc3d", "CrossLoc3D", ours, published=(70.7, 85.7), is_reference=True)]


def _three_grains(model: ModelConfig) -> tuple[float, float, float]:
    if len(model.voxel_sizes) != 3:
        raise ConfigError(f"the table 'grains' combines three voxel sizes, the settings have {model.voxel_sizes}")
    fine, middle, coarse = model.voxel_sizes
    return fine, middle, coarse


def _memories(model: ModelConfig, sub_steps: int) -> tuple[int, ...]:
    """Return memory sizes for another number of sub-steps: each grain's own, the last repeated or left out."""
    grains, own = len(model.voxel_sizes), model.sub_steps
    return tuple(
        model.memory_sizes[grain * own + min(step, own - 1)] for grain in range(grains) for step in range(sub_steps)
    )


@dataclass
class Comparison:
    """The rows of one table, made one after the other in one folder."""

    rows: Sequence[Row]
    places: Sequence[Path]
    folder: Path
    budget: Budget
    evaluation_set: EvaluationSet
    preprocessing: PreprocessingConfig
    """Of the set's patches: for the methods that have none of their own."""
    cache: Path
    """Folder in which descriptors are kept."""
    workers: int = 1
    report: Callable[[str, Progress], None] = field(default=lambda slug, progress: None)
    encoding: Callable[[str, float, float, str], None] = field(default=lambda stage, done, total, unit: None)
    row_done: Callable[[list[Result]], None] = field(default=lambda results: None)
    """Called with the results so far after every row."""

    def run(self) -> list[Result]:
        """Train and evaluate every row that is not done; return all results in the rows' order.

        A row that fails is left out and does not stop the others; when all are through it is raised as TrainingError.
        A row that was trained with other settings or on other places is refused.
        """
        failures = []
        for row in self.rows:
            try:
                self._do(row)
            except CrossLocError as error:
                logger.error("%s: %s", row.name, error)
                failures.append(f"{row.slug} ({error})")
            else:
                self.row_done(self.results())
        if failures:
            raise TrainingError(f"{len(failures)} of {len(self.rows)} rows failed: {'; '.join(failures)}")
        return self.results()

    def results(self) -> list[Result]:
        """Return what is there already, each row compared with the reference; nothing is trained or encoded."""
        found = [(row, result) for row in self.rows if (result := self._read(row)) is not None]
        reference = next((row for row, _ in found if row.is_reference), None)
        if reference is None:
            return [result for _, result in found]
        theirs = load_predictions(self.folder / reference.slug / PREDICTIONS)
        compared = []
        for row, result in found:
            ahead = None
            if row.slug != reference.slug:
                mine = load_predictions(self.folder / row.slug / PREDICTIONS)
                ahead = difference(mine, theirs, self.evaluation_set, 1, 100.0)
            compared.append(dataclasses.replace(result, ahead=ahead))
        return compared

    def _do(self, row: Row) -> None:
        folder = self.folder / row.slug
        if row.config is not None:
            self._train(row, row.config, folder)
        encoder, loader = self._encoder(row, folder)
        before = self._read(row)
        if before is not None and before.encoder == encoder.fingerprint:
            return
        predictions = self._predict(row, encoder, loader)
        write_predictions(folder / PREDICTIONS, predictions)
        result = self._result(row, encoder, predictions)
        content = json.dumps({"format": _FORMAT, **_stored(result)}, indent=1) + "\n"
        write_atomically(folder / RESULT, content, TrainingError, synced=True)

    def _train(self, row: Row, config: TrainConfig, folder: Path) -> None:
        """Bring the row's run to the end of the budget; nothing where it is there."""
        trainer = Trainer(
            config, self.places, folder, self.budget, report=lambda progress: self.report(row.slug, progress)
        )
        begun = (folder / run_folder.SETTINGS).exists()
        if (folder / run_folder.FINAL).exists() and _ended_budget(folder) == self.budget.option():
            run_folder.prepare(folder, config, read_material(self.places, config.preprocessing), None, resume=True)
            return
        trainer.run(resume=begun)
        trainer.write_card()
        write_atomically(folder / ENDED, self.budget.option() + "\n", TrainingError, synced=True)

    def _encoder(self, row: Row, folder: Path) -> tuple[DescriptorEncoder, EncoderLoader]:
        if row.config is None:
            method = ScanContext if row.method == "scan_context" else HeightMaps
            loader: EncoderLoader = functools.partial(method, self.preprocessing)
            return loader(), loader
        path = folder / run_folder.FINAL
        return load_encoder(path), functools.partial(load_encoder, path, threads=1)

    def _predict(self, row: Row, encoder: DescriptorEncoder, loader: EncoderLoader) -> Predictions:
        count, way = way_of(encoder)
        plan = Plan(("aerial",), ("random",), (count,), invariant=way == "mean")
        job = EncodingJob(encoder, loader, self.cache, self.workers, self.encoding)
        before = torch.get_num_threads()
        torch.set_num_threads(usable_threads())
        try:
            made = predict_all(self.evaluation_set, job, plan, row.name)
        finally:
            torch.set_num_threads(before)
        return next(p for p in made if (p.about.query_headings, p.about.way) == (count, way))

    def _result(self, row: Row, encoder: DescriptorEncoder, predictions: Predictions) -> Result:
        about = predictions.about
        scores = score(predictions, self.evaluation_set).overall
        recalls = tuple(scores.recall(f"R@{rank}", radius_m) for radius_m in RADII_M for rank in RANKS)
        parameters, steps, clouds, hours = 0, 0, 0, 0.0
        if row.config is not None:
            parameters = sum(p.numel() for p in make_network(row.config.model).parameters())
            state = run_folder.load_state(self.folder / row.slug) or {}
            steps, clouds = state.get("step", 0), state.get("clouds", 0)
            hours = round(state.get("elapsed_s", 0.0) / 3600.0, 3)
        return Result(
            slug=row.slug,
            name=row.name,
            encoder=encoder.fingerprint,
            data=about.data,
            descriptor_size=encoder.descriptor_size,
            parameters=parameters,
            query_headings=about.query_headings,
            one_thread_ms=self._one_thread_ms(row, about.query_headings),
            encode_ms=about.encode_ms,
            search_ms=about.search_ms,
            steps=steps,
            clouds=clouds,
            hours=hours,
            recalls=recalls,
            published=row.published,
        )

    def _one_thread_ms(self, row: Row, query_headings: int) -> float:
        folder = self.folder / row.slug
        encoder = self._encoder(row, folder)[1]()
        cloud = self.evaluation_set.queries.patches[0]
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            nothing_to_search = encoder.encode_batch([cloud])
            timed, _ = time_queries(encoder, self.evaluation_set.queries, query_headings, nothing_to_search, 1)
        finally:
            torch.set_num_threads(before)
        return round(timed, 3)

    def _read(self, row: Row) -> Result | None:
        """Return the row's result if it is one of this benchmark and whole, else None."""
        path = self.folder / row.slug / RESULT
        try:
            content: dict[str, Any] = json.loads(path.read_text())
            if content.pop("format") != _FORMAT or content["data"] != self.evaluation_set.fingerprint():
                return None
            content["recalls"] = tuple(_recall(cell) for cell in content.pop("cells"))
            content["published"] = row.published
            result = Result(**{**content, "ahead": None})
            load_predictions(path.with_name(PREDICTIONS))
        except (OSError, ValueError, KeyError, TypeError, CrossLocError):
            return None
        return dataclasses.replace(result, name=row.name)


def write_predictions(path: Path, predictions: Predictions) -> None:
    """Write a row's predictions, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_predictions(path, predictions)


def _stored(result: Result) -> dict[str, Any]:
    """Return what a row's file holds, see `_recall`."""
    cells = [
        {"rank": r.rank, "radius_m": r.radius_m, "recall": r.share.value, "low": r.share.low, "high": r.share.high,
         "chance": r.chance}
        for r in result.recalls
    ]  # fmt: skip
    content = {("cells" if key == "recalls" else key): value for key, value in to_dict(result).items()}
    return {**content, "cells": cells}


def _recall(cell: dict[str, Any]) -> Recall:
    rank, share = cell["rank"], Share(cell["recall"], cell["low"], cell["high"])
    return Recall(rank, cell["radius_m"], share, cell["chance"], f"R@{rank}")


def select(rows: Sequence[Row], slugs: Sequence[str]) -> list[Row]:
    """Return the rows that are named, in the table's order; ConfigError for one that the table does not have."""
    known = {row.slug for row in rows}
    unknown = [slug for slug in slugs if slug not in known]
    if unknown:
        raise ConfigError(f"the table has no row '{unknown[0]}'; its rows are: {', '.join(row.slug for row in rows)}")
    return [row for row in rows if not slugs or row.slug in slugs]


def _ended_budget(folder: Path) -> str | None:
    """Return the budget that the run in a folder has used up; None where it has not ended."""
    path = folder / ENDED
    return path.read_text().strip() if path.exists() else None
