"""Datasets in the layout of CS-Campus3D, written: clouds as bare numbers, and the pickles that list them."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.files import atomic_path, write_atomically
from crossloc3d_ros.formats.cs_campus3d import INFO, INFO_FORMAT, CloudTable, QueryTable


def write_cloud(folder: Path, file: str, points: Any) -> None:
    """Write a cloud (N, 3) as float64; nothing is done where it lies there with that content already."""
    path = folder / file
    data = np.ascontiguousarray(points, "<f8").tobytes()
    if path.exists() and path.stat().st_size == len(data) and path.read_bytes() == data:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def write_training(
    path: Path, clouds: CloudTable, pairs: Iterable[tuple[npt.ArrayLike, npt.ArrayLike]], first_id: int = 0
) -> None:
    """Write a training pickle entry by entry, whole or not at all; `pairs` gives positives and negatives of each cloud.

    The file is an ordinary pickle of protocol 2. It is put together of pickles of its parts, so that the negatives,
    half a gigabyte for ten thousand clouds, are never in memory at once.
    """
    with atomic_path(path, DatasetError, synced=True) as partial, partial.open("wb") as file:
        file.write(pickle.PROTO + b"\x02" + pickle.EMPTY_DICT + pickle.MARK)
        for row, (positives, negatives) in enumerate(pairs):
            entry = {
                "query": clouds.files[row],
                "positives": np.asarray(positives, np.int64).tolist(),
                "negatives": np.asarray(negatives, np.int64).tolist(),
                **_place(clouds, row),
            }
            for part in (first_id + row, entry):
                file.write(pickle.dumps(part, protocol=2)[2:-1])
        file.write(pickle.SETITEMS + pickle.STOP)


def write_database(path: Path, subsets: Sequence[CloudTable]) -> None:
    """Write a database pickle, whole or not at all."""
    content = [
        {row: {"query": clouds.files[row], **_place(clouds, row)} for row in range(len(clouds))} for clouds in subsets
    ]
    write_atomically(path, pickle.dumps(content, protocol=2), DatasetError, synced=True)


def write_queries(path: Path, subsets: Sequence[QueryTable]) -> None:
    """Write a query pickle, whole or not at all."""
    content = []
    for subset in subsets:
        entries = {}
        for row, neighbours in enumerate(subset.neighbours):
            entry: dict[Any, Any] = {"query": subset.clouds.files[row], **_place(subset.clouds, row)}
            entry.update((int(m), [int(i) for i in rows]) for m, rows in neighbours.items())
            entries[row] = entry
        content.append(entries)
    write_atomically(path, pickle.dumps(content, protocol=2), DatasetError, synced=True)


def write_info(folder: Path, info: Mapping[str, Any]) -> None:
    """Write `dataset.json`, whole or not at all."""
    text = json.dumps({"format": INFO_FORMAT, **info}, indent=1, allow_nan=False) + "\n"
    write_atomically(folder / INFO, text, DatasetError, synced=True)


def _place(clouds: CloudTable, row: int) -> dict[str, float]:
    place = {"northing": float(clouds.xy_m[row, 1]), "easting": float(clouds.xy_m[row, 0])}
    if clouds.is_ground[row] and np.isfinite(clouds.heading_rad[row]):
        place["heading"] = float(clouds.heading_rad[row])
    return place
