"""The predictions of one run in a folder: written, ordered anew by height maps, read back."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from crossloc3d_ros.config import VerificationConfig
from crossloc3d_ros.datasets.place_sets import EvaluationSet
from crossloc3d_ros.errors import ConfigError, EvaluationError
from crossloc3d_ros.evaluation.retrieval.predictions import (
    HEADING_MODES,
    SETTINGS,
    Predictions,
    load_predictions,
    save_predictions,
)
from crossloc3d_ros.evaluation.retrieval.verification import Progress, verify
from crossloc3d_ros.types import DescriptorEncoder


def replace_predictions(folder: Path, made: Iterable[Predictions]) -> None:
    """Write predictions into a folder in place of those of an earlier run."""
    for before in folder.glob("*.npz"):
        before.unlink()
    for predictions in made:
        save_predictions(folder / f"{predictions.about.name}.npz", predictions)


def add_verified(
    folder: Path,
    evaluation_set: EvaluationSet,
    encoder: DescriptorEncoder,
    config: VerificationConfig,
    *,
    threads: int,
    progress: Progress,
) -> None:
    """Write the predictions of each retrieval among aerial submaps once more, ordered by height maps too."""
    stored = read_predictions(folder)
    for made in stored:
        if made.about.verified:
            (folder / f"{made.about.name}.npz").unlink(missing_ok=True)
    retrieved = [made for made in stored if made.about.setting == "aerial" and not made.about.verified]
    if not retrieved:
        raise ConfigError("--verify orders aerial submaps alone: add --setting aerial")
    for made in retrieved:
        verified = verify(made, evaluation_set, encoder, config, threads=threads, progress=progress)
        save_predictions(folder / f"{verified.about.name}.npz", verified)


def read_predictions(folder: Path) -> list[Predictions]:
    """Return the predictions of a folder in the order of the tables; EvaluationError where there are none."""
    found = [load_predictions(path) for path in sorted(folder.glob("*.npz"))]
    if not found:
        raise EvaluationError(f"{folder} holds no predictions: run the command without --only-score first")
    # Aerial before aerial+ground, aligned before random, few headings before many.
    order = [*SETTINGS, *HEADING_MODES]
    return sorted(
        found,
        key=lambda p: (
            order.index(p.about.setting),
            order.index(p.about.heading),
            p.about.query_headings,
            p.about.way,
            p.about.verified,
        ),
    )
