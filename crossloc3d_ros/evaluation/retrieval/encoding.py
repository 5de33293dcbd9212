"""Descriptors of whole place sets: in chunks that are kept, over several processes, so that a stopped run goes on."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.clouds.patch import rotate_about_z
from crossloc3d_ros.datasets.place_sets import PlaceSet
from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.types import DescriptorEncoder, Float32Array, Float64Array
from crossloc3d_ros.workers import EncoderLoader, open_workers

CHUNK_CLOUDS = 256
"""Clouds encoded between two writes."""
BATCH = 32
_TIMED_QUERIES = 15

Progress = Callable[[str, float, float, str], None]


@runtime_checkable
class OwnDistance(Protocol):
    """An encoder whose descriptors are not compared by their Euclidean distance."""

    def distances(self, queries: Float32Array, database: Float32Array) -> Float32Array:
        """Return the distances (Q, M) of descriptors (Q, D) from descriptors (M, D); smaller is more alike."""


@dataclass(frozen=True)
class EncodingJob:
    """Who encodes, where and with how many processes."""

    encoder: DescriptorEncoder
    loader: EncoderLoader
    """Loads the same encoder in another process."""
    cache: Path
    """Folder in which descriptors are kept, by weights and places."""
    workers: int = 1
    progress: Progress = lambda stage, done, total, unit: None


class _Chunk(NamedTuple):
    path: Path
    clouds: list[Float32Array]
    angles_rad: Float64Array
    """(n, A) by which each cloud is turned."""


def encode_places(job: EncodingJob, places: PlaceSet, angles_rad: Float64Array, stage: str) -> Float32Array:
    """Return the descriptors (N, A, D) of N places, each turned counter-clockwise by its A angles (N, A).

    What is done is kept in the cache by the fingerprints of encoder and places and by the angles, chunk by chunk.
    Raises EvaluationError where the cache cannot be written.
    """
    if angles_rad.ndim != 2 or len(angles_rad) != len(places):
        raise EvaluationError(f"{len(places)} places need angles ({len(places)}, A), got {angles_rad.shape}")
    if len(places) == 0:
        return np.empty((0, angles_rad.shape[1], job.encoder.descriptor_size), np.float32)
    folder = job.cache / f"{_slug(job.encoder.fingerprint)}-{_key(places, angles_rad)}"
    per_chunk = max(1, CHUNK_CLOUDS // angles_rad.shape[1])
    starts = range(0, len(places), per_chunk)
    files = [folder / f"{start:08d}.npy" for start in starts]
    shapes = [
        (min(per_chunk, len(places) - start), angles_rad.shape[1], job.encoder.descriptor_size) for start in starts
    ]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = {file for file, shape in zip(files, shapes, strict=True) if _read(file, shape) is not None}
        missing = [start for start, file in zip(starts, files, strict=True) if file not in found]
        done = sum(shape[0] for file, shape in zip(files, shapes, strict=True) if file in found)
        job.progress(stage, done, len(places), "places")

        def advance(count: int) -> None:
            nonlocal done
            done += count
            job.progress(stage, done, len(places), "places")

        if missing:
            with open_workers(job.loader, job.encoder, job.workers, None, folder) as workers:
                tasks = _chunks(places, angles_rad, missing, per_chunk, folder)
                for _ in workers.run_encoding(_encode_chunk, tasks, advance):
                    pass
    except OSError as error:
        raise EvaluationError(f"cannot write the descriptors in {folder}: {error.strerror or error}") from error
    parts = [_read(file, shape) for file, shape in zip(files, shapes, strict=True)]
    if any(part is None for part in parts):
        raise EvaluationError(f"{folder} was changed by somebody else; give the same command again")
    return np.concatenate([part for part in parts if part is not None])


def north_angles(places: PlaceSet) -> Float64Array:
    """Return (N, 1) the angles that turn places to north by their true headings; 0 where the heading is unknown."""
    return np.nan_to_num(places.heading_rad, nan=0.0)[:, None]


def time_queries(
    encoder: DescriptorEncoder, places: PlaceSet, headings: int, database: Float32Array, top: int
) -> tuple[float, float]:
    """Return the median milliseconds that encoding one query in `headings` headings takes, and searching for it.

    One query after the other in this process, as on a robot, after a first one that does not count; `database` (M, D).
    """
    own = encoder if isinstance(encoder, OwnDistance) else None
    index = None if own else DescriptorMap(database)
    angles = 2.0 * math.pi * np.arange(headings) / headings
    encode_ms, search_ms = [], []
    for i in range(min(len(places), _TIMED_QUERIES + 1)):
        cloud = np.array(places.patches[i])
        started = time.perf_counter()
        descriptors = encoder.encode_batch([rotate_about_z(cloud, float(angle)) for angle in angles])
        encoded = time.perf_counter()
        if own is not None:
            own.distances(descriptors, database)
        elif index is not None:
            index.search_many(descriptors, top)
        encode_ms.append(1e3 * (encoded - started))
        search_ms.append(1e3 * (time.perf_counter() - encoded))
    counted = slice(1, None) if len(encode_ms) > 1 else slice(None)
    return float(np.median(encode_ms[counted])), float(np.median(search_ms[counted]))


def _chunks(
    places: PlaceSet, angles_rad: Float64Array, missing: list[int], per_chunk: int, folder: Path
) -> Iterator[tuple[_Chunk, int]]:
    for start in missing:
        end = min(start + per_chunk, len(places))
        clouds = [np.array(places.patches[i]) for i in range(start, end)]  # what is mapped is read-only
        yield _Chunk(folder / f"{start:08d}.npy", clouds, angles_rad[start:end]), end - start


def _encode_chunk(chunk: _Chunk, encoder: DescriptorEncoder, advance: Callable[[int], None] | None) -> None:
    clouds = [
        rotate_about_z(cloud, float(angle)) if angle else cloud
        for cloud, angles in zip(chunk.clouds, chunk.angles_rad, strict=True)
        for angle in angles
    ]
    parts = [encoder.encode_batch(clouds[i : i + BATCH]) for i in range(0, len(clouds), BATCH)]
    descriptors = np.concatenate(parts).reshape(*chunk.angles_rad.shape, -1).astype(np.float32, copy=False)
    if not np.isfinite(descriptors).all():
        raise EvaluationError("the encoder gave descriptors that are not finite: are these weights damaged?")
    with atomic_path(chunk.path, None) as partial, partial.open("wb") as file:
        np.save(file, descriptors, allow_pickle=False)
    if advance is not None:
        advance(len(chunk.clouds))


def _read(path: Path, shape: tuple[int, ...]) -> Float32Array | None:
    """Return a chunk, or None where it has to be encoded (again)."""
    try:
        found = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    return found if found.shape == shape and found.dtype == np.float32 else None


def _key(places: PlaceSet, angles_rad: Float64Array) -> str:
    digest = hashlib.sha256(places.fingerprint().encode())
    digest.update(str(angles_rad.shape).encode())
    digest.update(np.ascontiguousarray(angles_rad, dtype="<f8").tobytes())
    return digest.hexdigest()[:16]


def _slug(text: str) -> str:
    """Return a text as part of a file's name."""
    return "".join(letter if letter.isalnum() else "_" for letter in text)[:32]
