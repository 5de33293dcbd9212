"""Files appear whole or not at all; a folder belongs to one process, which its lock names."""

from __future__ import annotations

import errno
import multiprocessing
import os
import shutil
import threading
from pathlib import Path

import pytest

from crossloc3d_ros import files
from crossloc3d_ros.errors import CrossLocError, MapError, TrainingError


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("content", ["München\n", b"\x00\xff\n"])
def test_a_file_is_replaced_whole_and_in_a_new_folder(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / "below" / "a.txt"
    with pytest.raises(CrossLocError, match="cannot write"):
        files.write_atomically(path, content)
    for _ in range(2):
        files.write_atomically(path, content, synced=True, parents=True)
        assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
    assert names(path.parent) == ["a.txt"]


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_after_a_failure_the_older_file_is_there_and_nothing_else(tmp_path: Path, failure: BaseException) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    kind = TrainingError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(kind) as raised, files.atomic_path(path, TrainingError) as partial:
        partial.write_text("half")
        raise failure
    assert path.read_text() == "old" and names(tmp_path) == ["a.txt"]
    if isinstance(failure, OSError):
        assert str(raised.value).startswith(f"cannot write {path}: No space left on device (the disk is full")


def test_without_an_error_class_the_reason_stays_an_os_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileExistsError), files.atomic_path(tmp_path / "file" / "a", None, parents=True):
        pytest.fail("there is no folder to write in")


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "set"
    for number in ("1", "2"):
        with files.atomic_path(target, CrossLocError, synced=True) as partial:
            partial.mkdir()
            (partial / number).write_text(number)
        assert names(tmp_path) == ["set"] and names(target) == [number]

    rename = Path.rename

    def full(path: Path, new: Path) -> Path:
        if "partial" in path.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        return rename(path, new)

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(CrossLocError, match="cannot write"), files.atomic_path(target, CrossLocError) as partial:
        partial.mkdir()
    assert names(tmp_path) == ["set"] and names(target) == ["2"]


def test_a_replacement_that_was_killed_half_way_is_undone(tmp_path: Path) -> None:
    target = tmp_path / "map"
    target.mkdir()
    target.rename(tmp_path / ".map.replaced")
    files.restore(target)
    assert names(tmp_path) == ["map"]
    (tmp_path / ".map.replaced").mkdir()
    files.restore(target)  # what is there stays
    assert names(tmp_path) == [".map.replaced", "map"]


def test_files_that_vanish_while_a_folder_is_sized_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.bin", "b.bin", "c.txt"):
        (tmp_path / name).write_bytes(b"1234")
    assert (files.size_of(tmp_path), files.size_of(tmp_path, ".bin")) == (12, 8)
    assert files.size_of(tmp_path / "missing") == 0
    walk = os.walk

    def walk_and_lose(folder: Path) -> list[tuple[str, list[str], list[str]]]:
        found = list(walk(folder))
        (tmp_path / "b.bin").unlink()
        return found

    monkeypatch.setattr(files.os, "walk", walk_and_lose)
    assert files.size_of(tmp_path) == 8


def hold(work: Path, locked: multiprocessing.Event, go: multiprocessing.Event) -> None:  # type: ignore[valid-type]
    with files.work_lock(work, MapError, "build"):
        locked.set()  # type: ignore[attr-defined]
        go.wait(60)  # type: ignore[attr-defined]


def test_a_lock_names_who_holds_it_and_leaves_with_it(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    locked, go = context.Event(), context.Event()
    work = tmp_path / "map.build"
    process = context.Process(target=hold, args=(work, locked, go))
    process.start()
    assert locked.wait(60)
    expected = rf"another build works in {work} \(process {process.pid} on .+\); wait for it"
    with pytest.raises(MapError, match=expected), files.work_lock(work, MapError, "build"):
        pytest.fail("two processes hold one lock")
    assert names(work) == ["lock"]
    go.set()
    process.join()
    assert not work.exists()
    with files.work_lock(work, MapError, "build"):
        (work / "piece").write_text("")
    assert names(work) == ["lock", "piece"]


def test_a_lock_that_is_removed_by_its_holder_is_taken_anew(tmp_path: Path) -> None:
    path, holders, order = tmp_path / "work" / "lock", [], []

    def busy(holder: str) -> None:
        holders.append(holder)
        waiting.set()

    def wait() -> None:
        with files.lock(path, MapError, busy):
            order.append(path.is_file())

    waiting = threading.Event()
    thread = threading.Thread(target=wait)
    with files.lock(path, MapError, busy):
        thread.start()
        assert waiting.wait(60)
        shutil.rmtree(path.parent)
        order.append(path.is_file())
    thread.join(60)
    assert order == [False, True] and holders[0].startswith(f"process {os.getpid()} on ")


def test_a_lock_that_cannot_be_made_is_an_error_that_says_where(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MapError, match=r"cannot write .*file"), files.work_lock(tmp_path / "file", MapError, "build"):
        pytest.fail("a file is no folder to work in")
