"""Folders that are either whole or not there, and say how they were made."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.files import atomic_path

_MADE = "made.json"


@contextmanager
def whole(folder: Path) -> Iterator[Path]:
    """Give a folder to write in that takes the name `folder` when all went well, in place of an older one."""
    with atomic_path(folder, EvaluationError, parents=True) as partial:
        partial.mkdir()
        yield partial


def mark_made(folder: Path, settings: dict[str, Any]) -> None:
    """Write down how the content of a folder was made, the last thing of all."""
    (folder / _MADE).write_text(json.dumps(settings), encoding="utf-8")


def how_made(folder: Path) -> dict[str, Any]:
    """Return what `mark_made` has written; empty where the folder is not whole."""
    try:
        made = json.loads((folder / _MADE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return dict(made)


def is_made(folder: Path, settings: dict[str, Any]) -> bool:
    """Say whether a folder is whole and was made in this way."""
    return how_made(folder) == settings
