"""Predicted poses on the disk: one file, whole or not at all, that says how it was made."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.evaluation.poses.predictions import PoseAbout, PosePredictions, column_names
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.types import Float64Array

FORMAT = 1


def save_predictions(path: Path, predictions: PosePredictions, about: PoseAbout) -> None:
    """Write predictions to one file, whole or not at all."""
    save_rows(path, predictions, dataclasses.asdict(about))


def load_predictions(path: Path) -> tuple[PosePredictions, PoseAbout]:
    """Read predictions; EvaluationError where there are none, or they are damaged."""
    predictions, content, _ = load_rows(path)
    tuples = {name: tuple(value) for name, value in content.items() if isinstance(value, list)}
    try:
        return predictions, PoseAbout(**{**content, **tuples})
    except TypeError as error:
        raise EvaluationError(f"{path} is damaged ({error}); predict again, without --only-score") from error


def save_rows(
    path: Path, predictions: PosePredictions, about: Mapping[str, Any], more: Mapping[str, Float64Array] | None = None
) -> None:
    """Write predictions, what they say of themselves, and `more` columns (N, ...), whole or not at all."""
    columns = {name: getattr(predictions, name) for name in column_names()} | dict(more or {})
    with atomic_path(path, EvaluationError, parents=True) as partial, partial.open("wb") as file:
        np.savez_compressed(file, about=np.array(json.dumps({"format": FORMAT, **about})), **columns)


def load_rows(path: Path, more: Sequence[str] = ()) -> tuple[PosePredictions, dict[str, Any], dict[str, Float64Array]]:
    """Read what `save_rows` has written, and the columns named in `more`; EvaluationError as `load_predictions`."""
    try:
        with np.load(path, allow_pickle=False) as file:
            content: dict[str, Any] = json.loads(str(file["about"]))
            if content.pop("format") != FORMAT:
                raise EvaluationError(f"{path} is of another format: predict again, without --only-score")
            predictions = PosePredictions(**{name: file[name] for name in column_names()})
            others = {name: file[name] for name in more}
        columns = [*(getattr(predictions, name) for name in column_names()), *others.values()]
        if len({len(column) for column in columns}) != 1:
            raise EvaluationError(f"{path} is damaged: columns differ in length; predict again, without --only-score")
        return predictions, content, others
    except FileNotFoundError as error:
        raise EvaluationError(f"{path} does not exist: run the command without --only-score first") from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise EvaluationError(f"{path} is damaged ({error}); predict again, without --only-score") from error
