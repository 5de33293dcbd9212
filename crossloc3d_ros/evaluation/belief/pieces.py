"""The work of the belief benchmark in pieces: one journey, or the single scans of one area, on one map.

A piece is one file that says how it was made: by which weights and settings, on which map, by which state of the code.
A run that was stopped makes the pieces that are missing, and scores need the pieces alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import crossloc3d_ros
from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.store import AerialMap, sha256
from crossloc3d_ros.config import LocalizerConfig, to_dict
from crossloc3d_ros.datasets.belief_conditions import DELIVERED, Condition
from crossloc3d_ros.datasets.belief_sets import BeliefSet, BeliefSets, are_apart
from crossloc3d_ros.datasets.pose_drives import Journey, Leg, journeys_of, steps_of

_CODE = ("aerial_map", "clouds", "config", "encoder", "localization", "weights")
"""Packages that decide what is estimated for a scan."""
_QUICK_SEED = 0
_SINGLES_AT_ONCE = 60
"""Single scans of a piece: a minute of work, and so the most that a run which is stopped loses."""


@dataclass(frozen=True)
class PieceAbout:
    """What a piece is, for scores and tables."""

    name: str
    """Of its file."""
    is_on_map: bool
    map_name: str
    set_name: str
    """Where the scans come from."""
    condition: str
    drive: str
    """Name of the drive; of the area where the scans are single ones."""
    areas: tuple[str, ...]
    """Of the set, which the rows count."""
    map_is_learned: bool
    set_is_learned: bool
    """Whether something was learned or tuned on the survey of the map, or on that of the scans."""

    @property
    def is_learned(self) -> bool:
        """Whether it's no test for one of the two."""
        return self.map_is_learned or self.set_is_learned


@dataclass(frozen=True, eq=False)
class Piece:
    """What is to be done, and where the data lie."""

    about: PieceAbout
    folder: Path
    """Of the pose set."""
    map_folder: Path
    condition: Condition
    journey: Journey | None
    """None: single scans."""
    rows: tuple[int, ...]
    """Of the set's scans, where they are single ones."""
    scans: int
    """How many are localized."""


def pieces_of(sets: BeliefSets, every: int = 1) -> list[Piece]:
    """Return all pieces: set by set on their maps, then off the map.

    `every`: for a quick look, each n-th scan and journey of each set on its map, and one of n drives off the map, drawn
    by lot so that each map has some.
    """
    pieces = [piece for each in sets.on_map for piece in (*_singles(each, every), *_journeys(each, every))]
    off = _off_map(sets)
    chosen = np.random.default_rng(_QUICK_SEED).permutation(len(off))[: -(-len(off) // every)]
    return pieces + [off[i] for i in np.sort(chosen).tolist()]


def in_order_of_work(pieces: Sequence[Piece]) -> list[Piece]:
    """Return pieces map by map, as each process holds one, and the longest of each map first."""
    order = {folder: i for i, folder in enumerate(dict.fromkeys(piece.map_folder for piece in pieces))}
    return sorted(pieces, key=lambda piece: (order[piece.map_folder], -piece.scans))


def _about(each: BeliefSet, drive: str, number: str) -> PieceAbout:
    name = f"{each.name} {each.condition.name} {number}"
    return PieceAbout(
        _file_name(name), True, each.name, each.name, each.condition.name, drive, each.pose_set.area_names,
        each.is_learned, each.is_learned,
    )  # fmt: skip


def _singles(each: BeliefSet, every: int) -> list[Piece]:
    chosen = np.arange(0, len(each.pose_set.scans), every)
    areas = each.pose_set.scans.area[chosen]
    pieces = []
    for area in (area for area in np.unique(areas).tolist() if each.pose_set.on_map[area]):
        rows = chosen[areas == area].tolist()
        for first in range(0, len(rows), _SINGLES_AT_ONCE):
            part = tuple(rows[first : first + _SINGLES_AT_ONCE])
            number = f"scans {area:02d} from {first:03d} each {every}"
            about = _about(each, each.pose_set.area_names[area], number)
            where = (each.pose_set.folder, each.pose_set.map_folder)
            pieces.append(Piece(about, *where, each.condition, None, part, len(part)))
    return pieces


def _journeys(each: BeliefSet, every: int) -> list[Piece]:
    pieces = []
    journeys = journeys_of(each.pose_set, each.drives)
    on_map = [j for j in journeys if each.pose_set.on_map[each.drives[j.legs[0].drive].plan.area]]
    for i, journey in enumerate(on_map[::every]):
        started = each.condition.started(journey)
        drive = each.drives[started.legs[0].drive].plan.name
        about = _about(each, drive, f"journey {i * every:02d}")
        pieces.append(_driven(about, each, each.pose_set.map_folder, started))
    return pieces


def _off_map(sets: BeliefSets) -> list[Piece]:
    """Return every drive on every map that it keeps off: of sets learned on too where there are no others."""
    pieces = []
    maps = {folder: AerialMap.load(folder) for folder in dict.fromkeys(_map_folders(sets))}
    delivered = [each for each in sets.on_map if each.condition == DELIVERED]
    for each in [each for each in delivered if not each.is_learned] or delivered:
        for number, drive in enumerate(each.drives):
            for target in sets.maps:
                if not are_apart(maps[target.folder], maps[each.pose_set.map_folder], drive.scans.T_grid_base):
                    continue
                about = PieceAbout(
                    _file_name(f"on {target.name} off {each.name} drive {number:02d}"), False, target.name, each.name,
                    each.condition.name, drive.plan.name, each.pose_set.area_names, target.is_learned, each.is_learned,
                )  # fmt: skip
                pieces.append(_driven(about, each, target.folder, Journey((Leg(number),))))
    return pieces


def _driven(about: PieceAbout, each: BeliefSet, map_folder: Path, journey: Journey) -> Piece:
    scans = len(steps_of(journey, each.drives))
    return Piece(about, each.pose_set.folder, map_folder, each.condition, journey, (), scans)


def _map_folders(sets: BeliefSets) -> list[Path]:
    return [*(each.pose_set.map_folder for each in sets.on_map), *(each.folder for each in sets.maps)]


def _file_name(text: str) -> str:
    return "".join(letter if letter.isalnum() or letter in ".-" else "_" for letter in text)


def settings_of(piece: Piece, config: LocalizerConfig, encoder: str, code: str) -> dict[str, Any]:
    """Return everything that decides what a piece holds; `encoder` and `code` are digests."""
    return dict(
        json.loads(
            json.dumps(
                {
                    "about": dataclasses.asdict(piece.about),
                    "set": piece.folder.name,
                    "map": sha256(piece.map_folder / store.MANIFEST),
                    "condition": dataclasses.asdict(piece.condition),
                    "legs": [dataclasses.astuple(leg) for leg in piece.journey.legs] if piece.journey else [],
                    "rows": piece.rows,
                    "config": to_dict(config),
                    "encoder": encoder,
                    "code": code,
                }
            )
        )
    )  # fmt: skip


def code_digest(packages: Sequence[str] = _CODE) -> str:
    """Return 16 hexadecimal digits that change with any file that decides what is estimated for a scan."""
    root = Path(crossloc3d_ros.__file__).parent
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(p for p in (root / package).rglob("*") if p.suffix in (".py", ".safetensors", ".npz")):
            digest.update(path.relative_to(root).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
