"""What the localizer estimates in each piece of the belief benchmark: made once, kept, scored afterwards."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from crossloc3d_ros.config import LocalizerConfig, to_dict
from crossloc3d_ros.datasets.raw_scans import RawScan
from crossloc3d_ros.datasets.set_maps import Progress
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.evaluation.belief.climbing import COLUMN, Climber
from crossloc3d_ros.evaluation.belief.pieces import Piece, PieceAbout, code_digest, in_order_of_work, settings_of
from crossloc3d_ros.evaluation.poses.predictions import (
    PosePredictions,
    drives_of,
    join,
    localizer_of,
    map_of,
    predict_journey,
    predict_singles,
    set_of,
)
from crossloc3d_ros.evaluation.poses.store import load_rows, save_rows
from crossloc3d_ros.files import write_atomically
from crossloc3d_ros.types import DescriptorEncoder, Estimate, Float64Array, Int64Array
from crossloc3d_ros.workers import EncoderLoader, open_workers

PIECES, PLAN = "pieces", "plan.json"
FORMAT = 1


@dataclass(frozen=True)
class BeliefAbout:
    """What was evaluated, and how."""

    weights: str
    encoder: str
    """Fingerprint of the weights."""
    code: str
    """Digest of the code that localizes."""
    config: dict[str, Any] = field(default_factory=dict)
    every: int = 1
    pieces: tuple[str, ...] = ()
    """Their names."""


@dataclass(frozen=True, eq=False)
class BeliefPredictions:
    """The rows of all pieces."""

    rows: PosePredictions
    """Journeys are numbered by their pieces, areas over all sets."""
    piece: Int64Array
    """(N,) which of the pieces each row belongs to."""
    climbed: Float64Array
    """(N, 2) log likelihood of the pose refined from the truth, and of the answer; NaN along journeys."""
    pieces: tuple[PieceAbout, ...]
    missing: int
    """Pieces that are not made yet."""


def predict_pieces(
    output: Path, pieces: Sequence[Piece], loader: EncoderLoader, config: LocalizerConfig, label: str,
    *, every: int = 1, workers: int = 1, progress: Progress | None = None,
) -> None:  # fmt: skip
    """Localize the scans of every piece that is not there yet, in so many processes; the pieces lie in `output`.

    Raises EvaluationError for what cannot be written.
    """
    report = progress or (lambda stage, done, total, unit: None)
    # An estimate carries as many candidates as are aligned, for what is compared afterwards; the poses are the same.
    config = dataclasses.replace(config, top_k=max(config.top_k, config.alignment.candidates))
    encoder, code = loader(), code_digest()
    about = BeliefAbout(label, encoder.fingerprint, code, to_dict(config), every, tuple(p.about.name for p in pieces))
    write_atomically(
        output / PLAN,
        json.dumps({"format": FORMAT, **dataclasses.asdict(about)}, indent=1),
        EvaluationError,
        parents=True,
    )
    tasks = [
        _Task(piece, output / PIECES / f"{piece.about.name}.npz", config, settings)
        for piece in in_order_of_work(pieces)
        for settings in [settings_of(piece, config, encoder.fingerprint, code)]
    ]
    missing = [task for task in tasks if not _is_made(task)]
    total = sum(piece.scans for piece in pieces)
    done = total - sum(task.piece.scans for task in missing)

    def advance(count: int) -> None:
        nonlocal done
        done += count
        report("localizing", done, total, "scans")

    advance(0)
    if missing:
        with open_workers(loader, encoder, workers, None, output) as pool:
            for _ in pool.run_encoding(_do, ((task, task.piece.scans) for task in missing), advance):
                pass


@dataclass(frozen=True, eq=False)
class _Task:
    """A piece, and where it goes."""

    piece: Piece
    path: Path
    config: LocalizerConfig
    settings: dict[str, Any]


def _is_made(task: _Task) -> bool:
    try:
        return load_rows(task.path, [COLUMN])[1] == task.settings
    except EvaluationError:
        return False


def _do(task: _Task, encoder: DescriptorEncoder, advance: Callable[[int], None] | None) -> None:
    piece, report = task.piece, advance or (lambda _: None)
    frame = map_of(piece.map_folder, encoder.fingerprint).frame
    localizer = localizer_of(piece.map_folder, encoder, task.config)
    climbed: list[Float64Array] = []
    if piece.journey is None:
        climber = _climber(piece.map_folder, encoder, task.config)
        scans = set_of(piece.folder, piece.map_folder).scans

        def examine(scan: RawScan, estimate: Estimate) -> None:
            climbed.append(climber.compare(scan, estimate))

        seen = [piece.condition.seen(scans[i]) for i in piece.rows]
        rows = predict_singles(seen, localizer, frame, report, examine)
    else:
        drives = piece.condition.driven(drives_of(piece.folder), piece.journey)
        rows = predict_journey(0, piece.journey, drives, localizer, frame, "wheels", report, alone_every=0)
        climbed = [np.full(2, np.nan)] * len(rows)
    save_rows(task.path, rows, task.settings, {COLUMN: np.array(climbed)})


_climbers: dict[tuple[Path, str, LocalizerConfig], Climber] = {}


def _climber(map_folder: Path, encoder: DescriptorEncoder, config: LocalizerConfig) -> Climber:
    """Return this process's climber on a map: the pieces of a map come after each other."""
    key = (map_folder, encoder.fingerprint, config)
    if key not in _climbers:
        _climbers.clear()
        _climbers[key] = Climber(map_of(map_folder, encoder.fingerprint), encoder, config)
    return _climbers[key]


def load_pieces(output: Path) -> tuple[BeliefPredictions, BeliefAbout]:
    """Read all pieces of the run in `output` that are made; EvaluationError where there is none or one is damaged."""
    about = _about(output / PLAN)
    parts: list[PosePredictions] = []
    pieces: list[PieceAbout] = []
    numbers: list[Int64Array] = []
    climbed: list[Float64Array] = []
    areas: dict[str, int] = {}
    for name in about.pieces:
        path = output / PIECES / f"{name}.npz"
        if not path.exists():
            continue
        rows, settings, more = load_rows(path, [COLUMN])
        if (settings["code"], settings["encoder"], settings["config"]) != (about.code, about.encoder, about.config):
            continue  # of an earlier run; it is made anew when its turn comes
        piece = PieceAbout(**{**settings["about"], "areas": tuple(settings["about"]["areas"])})
        number = np.array([areas.setdefault(f"{piece.set_name}: {area}", len(areas)) for area in piece.areas])
        journey = np.where(rows.journey >= 0, len(pieces), rows.journey)
        parts.append(dataclasses.replace(rows, area=number[rows.area], journey=journey))
        numbers.append(np.full(len(rows), len(pieces)))
        climbed.append(more[COLUMN])
        pieces.append(piece)
    if not parts:
        raise EvaluationError(f"{output} holds no predictions of its plan: run the command without --only-score first")
    missing = len(about.pieces) - len(pieces)
    return BeliefPredictions(
        join(parts), np.concatenate(numbers), np.concatenate(climbed), tuple(pieces), missing
    ), about


def _about(path: Path) -> BeliefAbout:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("format") != FORMAT:
            raise EvaluationError(f"{path} is of another format: predict again, without --only-score")
        return BeliefAbout(**{**content, "pieces": tuple(content["pieces"])})
    except FileNotFoundError as error:
        raise EvaluationError(f"{path} does not exist: run the command without --only-score first") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError(f"{path} is damaged ({error}); predict again, without --only-score") from error
