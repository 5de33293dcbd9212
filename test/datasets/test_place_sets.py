"""Sets on disk come back as they were, and damage is told."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.datasets.place_sets import (
    MANIFEST,
    EvaluationSet,
    Patches,
    PlaceSet,
    join_sets,
    load_set,
    read_settings,
    save_set,
)
from crossloc3d_ros.errors import EvaluationError


def places(rng: np.random.Generator, lengths: list[int], areas: int = 1) -> PlaceSet:
    count = len(lengths)
    return PlaceSet(
        [rng.uniform(-1, 1, (n, 3)).astype(np.float32) for n in lengths],
        rng.integers(areas, size=count),
        rng.uniform(0, 1e5, (count, 2)),
        rng.uniform(-3, 3, count),
    )


def small_set(seed: int = 0, ground: bool = True) -> EvaluationSet:
    rng = np.random.default_rng(seed)
    return EvaluationSet(
        "small", places(rng, [5, 9, 1], 2), places(rng, [4] * 7, 2), places(rng, [3, 2], 2) if ground else None,
        ("north", "south"), ("campus", "wood"), ("held out", "seen", "seen"),
    )  # fmt: skip


def assert_same(one: PlaceSet | None, other: PlaceSet | None) -> None:
    assert (one is None) == (other is None)
    if one is None or other is None:
        return
    assert [p.tolist() for p in one.patches] == [p.tolist() for p in other.patches]
    for name in ("area", "xy_m", "heading_rad"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("ground", [True, False])
def test_a_set_comes_back_from_disk(tmp_path: Path, ground: bool) -> None:
    written = small_set(ground=ground)
    save_set(tmp_path / "set", written, {"seed": 7})
    read = load_set(tmp_path / "set", verify=True)
    for role in ("queries", "aerial", "ground"):
        assert_same(getattr(written, role), getattr(read, role))
    for name in ("name", "area_names", "families", "query_groups"):
        assert getattr(read, name) == getattr(written, name)
    assert read.fingerprint() == written.fingerprint()
    assert read_settings(tmp_path / "set") == {"seed": 7}
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_set_is_replaced_whole_and_other_folders_are_left_alone(tmp_path: Path) -> None:
    save_set(tmp_path / "set", small_set(0))
    save_set(tmp_path / "set", small_set(1, ground=False))
    assert load_set(tmp_path / "set", verify=True).ground is None
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat").write_text("meow")
    with pytest.raises(EvaluationError, match="something else"):
        save_set(tmp_path / "photos", small_set())
    assert (tmp_path / "photos" / "cat").read_text() == "meow"


@pytest.mark.parametrize("moment", ["writing", "moving"])
def test_a_full_disk_costs_nothing_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str) -> None:
    save_set(tmp_path / "set", small_set(0))
    rename = Path.rename

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def rename_fails(path: Path, target: Path) -> Path:
        return full() if "partial" in path.name else rename(path, target)  # type: ignore[func-returns-value, return-value]

    with monkeypatch.context() as patch:
        if moment == "writing":
            patch.setattr(np, "save", full)
        else:
            patch.setattr(Path, "rename", rename_fails)
        with pytest.raises(EvaluationError, match="No space left"):
            save_set(tmp_path / "set", small_set(1))
    assert load_set(tmp_path / "set", verify=True).fingerprint() == small_set(0).fingerprint()
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_an_array_of_patches_is_the_same_as_a_list(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    array = rng.uniform(-1, 1, (6, 8, 3)).astype(np.float32)
    area, xy_m, heading = np.zeros(6, np.int64), rng.uniform(0, 9, (6, 2)), np.zeros(6)
    assert (
        PlaceSet(array, area, xy_m, heading).fingerprint() == PlaceSet(list(array), area, xy_m, heading).fingerprint()
    )


def test_the_fingerprint_changes_with_every_column() -> None:
    base = small_set().aerial
    columns = {name: getattr(base, name) for name in ("patches", "area", "xy_m", "heading_rad")}
    seen = {base.fingerprint()}
    for name in ("area", "xy_m", "heading_rad"):
        changed = columns[name].copy()
        changed.flat[-1] += 1
        seen.add(PlaceSet(**{**columns, name: changed}).fingerprint())
    patches = [patch.copy() for patch in base.patches]
    patches[-1][-1, -1] += 1e-6
    seen.add(PlaceSet(**{**columns, "patches": patches}).fingerprint())
    assert len(seen) == 5


def test_joined_sets_number_their_areas_on() -> None:
    first, second = small_set(0), small_set(1, ground=False)
    both = join_sets("both", [first, second])
    assert both.area_names == first.area_names + second.area_names
    assert both.query_groups == first.query_groups + second.query_groups
    np.testing.assert_array_equal(both.queries.area[3:], second.queries.area + 2)
    assert [p.tolist() for p in both.aerial.patches] == [
        p.tolist() for part in (first, second) for p in part.aerial.patches
    ]
    assert_same(both.ground, first.ground)


def test_patches_are_a_sequence() -> None:
    patches = Patches.chain([[np.full((i + 1, 3), i, np.float32)] for i in range(4)])
    assert [len(p) for p in patches] == [1, 2, 3, 4]
    assert patches[-1][0, 0] == 3
    assert [p[0, 0] for p in patches[1:3]] == [1, 2]
    with pytest.raises(IndexError):
        patches[4]


@pytest.mark.parametrize("name", ["aerial_points.npy", "queries_xy_m.npy", "ground_starts.npy"])
@pytest.mark.parametrize("damage", ["missing", "cut", "changed"])
def test_damage_is_told(tmp_path: Path, name: str, damage: str) -> None:
    save_set(tmp_path / "set", small_set())
    path = tmp_path / "set" / name
    content = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "cut":
        path.write_bytes(content[:-5])
    else:
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(EvaluationError, match=r"missing|damaged"):
        load_set(tmp_path / "set", verify=True)


def test_a_missing_or_damaged_manifest_is_told(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="no evaluation set"):
        load_set(tmp_path)
    save_set(tmp_path / "set", small_set())
    manifest = tmp_path / "set" / MANIFEST
    good = json.loads(manifest.read_text())
    for text, words in (("{", "damaged"), (json.dumps({**good, "format": 99}), "format 99"), ("{}", "damaged")):
        manifest.write_text(text)
        with pytest.raises(EvaluationError, match=words):
            load_set(tmp_path / "set")


def test_columns_that_do_not_belong_together_are_refused() -> None:
    base = small_set().queries
    with pytest.raises(EvaluationError, match="xy_m"):
        PlaceSet(base.patches, base.area, base.xy_m[:2], base.heading_rad)
    with pytest.raises(EvaluationError, match="finite"):
        PlaceSet(base.patches, base.area, base.xy_m * np.nan, base.heading_rad)
    with pytest.raises(EvaluationError, match="areas"):
        EvaluationSet("x", base, base, None, ("only one",), ("campus",))
    with pytest.raises(EvaluationError, match="groups"):
        EvaluationSet("x", base, base, None, ("one", "two"), ("campus", "wood"), ("seen",))
