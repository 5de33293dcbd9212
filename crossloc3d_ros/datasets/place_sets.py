"""What a benchmark is made of: ground queries and databases of submaps as patches, with where each was taken.

A set lies in a folder: `manifest.json` and plain `.npy` files. Patches are mapped into memory when they are read, so a
set may be larger than the memory.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from crossloc3d_ros.errors import EvaluationError
from crossloc3d_ros.files import atomic_path
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

MANIFEST = "manifest.json"
FORMAT = 1
_ROLES = ("queries", "aerial", "ground")
_HASHED_AT_ONCE = 1 << 24


class Patches(Sequence[Float32Array]):
    """Patches (n, 3) that lie one after the other in one array, or in several; n may differ from patch to patch."""

    def __init__(self, points: Float32Array, starts: Int64Array) -> None:
        """Wrap points (P, 3) of which patch i has the rows `starts[i]` to `starts[i + 1]`."""
        self._parts = [(points, np.asarray(starts, np.int64))]
        self._ends = np.array([len(starts) - 1])

    @classmethod
    def chain(cls, parts: Iterable[Sequence[Float32Array] | Float32Array]) -> Patches:
        """Return the patches of all parts, in order, without copying those that are `Patches` already."""
        chained = cls(np.empty((0, 3), np.float32), np.zeros(1, np.int64))
        chained._parts = [piece for part in parts for piece in as_patches(part)._parts]
        chained._ends = np.cumsum([len(starts) - 1 for _, starts in chained._parts])
        return chained

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    @overload
    def __getitem__(self, index: int) -> Float32Array: ...

    @overload
    def __getitem__(self, index: slice) -> list[Float32Array]: ...

    def __getitem__(self, index: int | slice) -> Float32Array | list[Float32Array]:
        """Return one patch (n, 3), or the list of several."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        i = index + len(self) if index < 0 else index
        if not 0 <= i < len(self):
            raise IndexError(index)
        part = int(np.searchsorted(self._ends, i, side="right"))
        points, starts = self._parts[part]
        i -= int(self._ends[part]) - (len(starts) - 1)
        return np.asarray(points[starts[i] : starts[i + 1]])

    @property
    def lengths(self) -> Int64Array:
        """Points (N,) of each patch."""
        return np.concatenate([np.zeros(0, np.int64), *(np.diff(starts) for _, starts in self._parts)])

    def blocks(self) -> Iterator[Float32Array]:
        """Yield all points in order, in pieces (m, 3) of a few megabytes."""
        rows = _HASHED_AT_ONCE // 12
        for points, starts in self._parts:
            for first in range(int(starts[0]), int(starts[-1]), rows):
                yield np.ascontiguousarray(points[first : min(first + rows, int(starts[-1]))], dtype="<f4")


def as_patches(patches: Sequence[Float32Array] | Float32Array) -> Patches:
    """Return any sequence of patches (n, 3) as `Patches`; an array (N, n, 3) float32 is not copied."""
    if isinstance(patches, Patches):
        return patches
    if isinstance(patches, np.ndarray) and patches.ndim == 3:
        starts = np.arange(len(patches) + 1, dtype=np.int64) * patches.shape[1]
        return Patches(patches.reshape(-1, 3).astype(np.float32, copy=False), starts)
    starts = np.cumsum([0, *(len(patch) for patch in patches)], dtype=np.int64)
    points = np.concatenate([np.empty((0, 3), np.float32), *patches]).astype(np.float32, copy=False)
    return Patches(points, starts)


@dataclass(frozen=True, eq=False)
class PlaceSet:
    """Patches and where they were taken."""

    patches: Sequence[Float32Array] | Float32Array
    """N patches (n, 3) in patch units; an array (N, n, 3) will do."""
    area: Int64Array
    """(N,) places of different areas are never the same."""
    xy_m: Float64Array
    """(N, 2) in the area's own frame, metres: east, north."""
    heading_rad: Float64Array
    """(N,) true heading of the patch's x axis, counter-clockwise from east; 0 is aligned, NaN unknown."""

    def __post_init__(self) -> None:
        """Refuse columns that do not belong together."""
        count = len(self.patches)
        shapes = {"area": (count,), "xy_m": (count, 2), "heading_rad": (count,)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise EvaluationError(
                    f"{count} patches need '{name}' of shape {shape}, got {np.shape(getattr(self, name))}"
                )
        if not np.isfinite(self.xy_m).all():
            raise EvaluationError("every place of a set needs a finite position")

    def __len__(self) -> int:
        return len(self.patches)

    def fingerprint(self) -> str:
        """Return 16 hexadecimal digits that change with any point, position, heading and area."""
        return self._fingerprint

    @functools.cached_property
    def _fingerprint(self) -> str:
        patches = as_patches(self.patches)
        digest = hashlib.sha256()
        for column, kind in ((self.area, "<i8"), (self.xy_m, "<f8"), (self.heading_rad, "<f8")):
            digest.update(np.ascontiguousarray(column, dtype=kind).tobytes())
        digest.update(patches.lengths.astype("<i8").tobytes())
        for block in patches.blocks():
            digest.update(block.data)
        return digest.hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class EvaluationSet:
    """Ground queries, the aerial database that they are looked for in, and a ground database where there is one."""

    name: str
    queries: PlaceSet
    aerial: PlaceSet
    ground: PlaceSet | None
    """Scans of other positions or another day: with them the paper's aerial + ground database."""
    area_names: tuple[str, ...]
    """Of each area."""
    families: tuple[str, ...]
    """What kind of town each area is."""
    query_groups: tuple[str, ...] = ()
    """Of each query, under what name it is scored separately as well; empty where there are no such groups."""

    def __post_init__(self) -> None:
        """Refuse areas without a name, and groups of some queries only."""
        if self.query_groups and len(self.query_groups) != len(self.queries):
            raise EvaluationError(f"{len(self.queries)} queries have {len(self.query_groups)} groups")
        if len(self.area_names) != len(self.families):
            raise EvaluationError(f"{len(self.area_names)} areas have {len(self.families)} families")
        for role, places in self.places().items():
            if len(places) and not (places.area.min() >= 0 and places.area.max() < len(self.area_names)):
                raise EvaluationError(f"'{role}' names areas beyond the {len(self.area_names)} of the set")

    def places(self) -> dict[str, PlaceSet]:
        """Return the place sets that there are by their roles: queries, aerial and perhaps ground."""
        given = {"queries": self.queries, "aerial": self.aerial, "ground": self.ground}
        return {role: places for role, places in given.items() if places is not None}

    def fingerprint(self) -> str:
        """Return 16 hexadecimal digits that change with anything in the set but its name."""
        parts = [f"{role} {places.fingerprint()}" for role, places in self.places().items()]
        names = [self.area_names, self.families, self.query_groups]
        return hashlib.sha256(json.dumps([parts, *names]).encode()).hexdigest()[:16]


def join_places(parts: Sequence[PlaceSet], first_areas: Sequence[int]) -> PlaceSet:
    """Return the places of all parts; `first_areas` is added to the areas of each."""
    areas = [part.area + first for part, first in zip(parts, first_areas, strict=True)]
    return PlaceSet(
        Patches.chain(part.patches for part in parts),
        np.concatenate([np.empty(0, np.int64), *areas]),
        np.concatenate([np.empty((0, 2)), *(part.xy_m for part in parts)]),
        np.concatenate([np.empty(0), *(part.heading_rad for part in parts)]),
    )


def join_sets(name: str, parts: Sequence[EvaluationSet]) -> EvaluationSet:
    """Return one set of all parts, with the areas of each numbered on; points are not copied."""
    first = np.cumsum([0, *(len(part.area_names) for part in parts)])[:-1].tolist()
    grounds = [(part.ground, start) for part, start in zip(parts, first, strict=True) if part.ground is not None]
    return EvaluationSet(
        name,
        join_places([part.queries for part in parts], first),
        join_places([part.aerial for part in parts], first),
        join_places([g for g, _ in grounds], [start for _, start in grounds]) if grounds else None,
        tuple(area for part in parts for area in part.area_names),
        tuple(family for part in parts for family in part.families),
        tuple(group for part in parts for group in part.query_groups or (part.name,) * len(part.queries))
        if any(part.query_groups for part in parts)
        else (),
    )


def save_set(folder: Path, evaluation_set: EvaluationSet, settings: Mapping[str, Any] | None = None) -> None:
    """Write a set to a folder, whole or not at all; an older set of that name is replaced.

    `settings`: how it was made, kept in the manifest. Raises EvaluationError where it cannot be written, and where
    the folder holds something else.
    """
    if folder.exists() and any(folder.iterdir()) and not (folder / MANIFEST).is_file():
        raise EvaluationError(f"{folder} holds something else than an evaluation set: name another folder")
    with atomic_path(folder, EvaluationError, synced=True, parents=True) as partial:
        partial.mkdir()
        roles = {}
        for role, places in evaluation_set.places().items():
            _write_places(partial, role, places)
            roles[role] = {"places": len(places), "fingerprint": places.fingerprint()}
        manifest = {
            "format": FORMAT,
            "name": evaluation_set.name,
            "settings": dict(settings or {}),
            "areas": list(evaluation_set.area_names),
            "families": list(evaluation_set.families),
            "query_groups": list(evaluation_set.query_groups),
            "places": roles,
            "bytes": {path.name: path.stat().st_size for path in sorted(partial.glob("*.npy"))},
        }
        (partial / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")


def load_set(folder: Path, *, verify: bool = False) -> EvaluationSet:
    """Read a set that `save_set` wrote, its patches mapped from the disk.

    A missing, cut or unreadable file raises EvaluationError; `verify` reads every point and finds any changed byte.
    """
    manifest = _read_manifest(folder)
    try:
        roles: dict[str, PlaceSet] = {}
        for name, size in manifest["bytes"].items():
            found = (folder / name).stat().st_size
            if found != size:
                raise EvaluationError(f"{folder / name} is damaged: {found:,} bytes instead of {size:,}")
        for role in manifest["places"]:
            roles[role] = _read_places(folder, role)
        evaluation_set = EvaluationSet(
            str(manifest["name"]),
            roles["queries"],
            roles["aerial"],
            roles.get("ground"),
            tuple(manifest["areas"]),
            tuple(manifest["families"]),
            tuple(manifest["query_groups"]),
        )
        for role, noted in manifest["places"].items():
            if len(roles[role]) != noted["places"]:
                raise EvaluationError(f"{folder} is damaged: {role} has {len(roles[role])} of {noted['places']} places")
            if verify and roles[role].fingerprint() != noted["fingerprint"]:
                raise EvaluationError(f"{folder} is damaged: the points of '{role}' are not those that were written")
    except FileNotFoundError as error:
        raise EvaluationError(
            f"{folder} is incomplete: {Path(error.filename).name} is missing; make it anew"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, EOFError, AttributeError) as error:
        raise EvaluationError(f"{folder} is damaged ({error}); make it anew") from error
    return evaluation_set


def read_settings(folder: Path) -> dict[str, Any]:
    """Return how the set in a folder was made, as `save_set` was given it."""
    settings = _read_manifest(folder)["settings"]
    return dict(settings)


def _read_manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise EvaluationError(f"{path} is of format {content['format']}, this version reads {FORMAT}: make it anew")
        for key in ("name", "settings", "areas", "families", "query_groups", "places", "bytes"):
            content[key]
    except FileNotFoundError as error:
        raise EvaluationError(f"{folder} holds no evaluation set") from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError(f"{path} is damaged ({error}); make the set anew") from error
    return dict(content)


def _write_places(folder: Path, role: str, places: PlaceSet) -> None:
    patches = as_patches(places.patches)
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(patches.lengths)])
    columns = {"area": places.area, "xy_m": places.xy_m, "heading_rad": places.heading_rad, "starts": starts}
    for name, column in columns.items():
        np.save(folder / f"{role}_{name}.npy", column, allow_pickle=False)
    with (folder / f"{role}_points.npy").open("wb") as file:  # a piece at a time: it may be larger than the memory
        header = {"descr": "<f4", "fortran_order": False, "shape": (int(starts[-1]), 3)}
        np.lib.format.write_array_header_1_0(file, header)
        for block in patches.blocks():
            file.write(block.data)


def _read_places(folder: Path, role: str) -> PlaceSet:
    def column(name: str) -> Any:
        return np.load(folder / f"{role}_{name}.npy", allow_pickle=False)

    path = folder / f"{role}_points.npy"
    starts = column("starts")
    mapped = starts[-1] > 0  # nothing cannot be mapped
    points = np.load(path, mmap_mode="r" if mapped else None, allow_pickle=False)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype != np.float32:
        raise EvaluationError(f"{path} is damaged: {points.dtype} of shape {points.shape} instead of points (n, 3)")
    if starts[0] != 0 or starts[-1] != len(points) or (np.diff(starts) <= 0).any():
        raise EvaluationError(f"{folder} is damaged: the patches of '{role}' do not cover its points")
    return PlaceSet(Patches(points, starts), column("area"), column("xy_m"), column("heading_rad"))


def distances_m(queries: PlaceSet, row: int, places: PlaceSet) -> Float64Array:
    """Return the horizontal distances (N,) in metres of all places from one query, infinite in other areas."""
    offsets = places.xy_m - queries.xy_m[row]
    distances: Float64Array = np.hypot(offsets[:, 0], offsets[:, 1])
    distances[places.area != queries.area[row]] = math.inf
    return distances
