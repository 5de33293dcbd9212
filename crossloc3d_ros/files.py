"""Files and folders that appear whole or not at all, and locks that name the process that holds them."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TextIO

from crossloc3d_ros.errors import CrossLocError

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
LOCK = "lock"
"""The lock file of a folder that one process at a time works in."""
_LOCK_TRIES = 10


def write_atomically(
    path: Path,
    content: str | bytes,
    error: type[CrossLocError] = CrossLocError,
    *,
    synced: bool = False,
    parents: bool = False,
) -> None:
    """Write a text (UTF-8) or bytes to a file, whole or not at all; raise `error` where that fails.

    `synced`: the content is on the disk before the file has its name. `parents`: make the folders above it.
    """
    with atomic_path(path, error, synced=synced, parents=parents) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def atomic_path(
    path: Path, error: type[CrossLocError] | None, *, synced: bool = False, parents: bool = False
) -> Iterator[Path]:
    """Yield a partial path beside `path`, for a file or a folder, that takes its name when the block ends well.

    An older file or folder of the name is replaced. After a failure nothing partial is left and `path` is what it was;
    an OSError becomes `error` with path and reason, or stays an OSError where `error` is None.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        if parents:
            path.parent.mkdir(parents=True, exist_ok=True)
        _remove(partial)
        yield partial
        if synced:
            sync(partial)
        publish(partial, path)
    except OSError as failure:
        if error is None:
            raise
        raise write_error(path, failure, error) from failure
    finally:
        with suppress(OSError):
            _remove(partial)


def write_error(path: Path, failure: OSError, error: type[CrossLocError]) -> CrossLocError:
    """Return the error that says why `path` cannot be written, with advice where the disk is full."""
    advice = " (the disk is full; make room and give the same command again)" if failure.errno in DISK_FULL else ""
    return error(f"cannot write {path}: {failure.strerror or failure}{advice}")


def sync(path: Path) -> None:
    """Wait until a file, or a folder and the files in it, are on the disk."""
    for each in (*path.iterdir(), path) if path.is_dir() else (path,):
        descriptor = os.open(each, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def publish(finished: Path, target: Path) -> None:
    """Rename a finished file or folder to `target`, in place of an older one; at no moment is `target` half there."""
    if not finished.is_dir():
        finished.replace(target)
        return
    replaced = _replaced(target)
    shutil.rmtree(replaced, ignore_errors=True)
    if target.exists():
        target.rename(replaced)
    try:
        finished.rename(target)
    except OSError:
        restore(target)
        raise
    shutil.rmtree(replaced, ignore_errors=True)


def restore(target: Path) -> None:
    """Rename the older folder back to `target` where `publish` was interrupted between its two renames."""
    if _replaced(target).is_dir() and not target.exists():
        _replaced(target).rename(target)


def remove_leftovers(folder: Path) -> None:
    """Remove what processes that were killed while they wrote have left in a folder."""
    for partial in folder.glob(".*.partial"):
        _remove(partial)


def size_of(folder: Path, suffix: str = "") -> int:
    """Return the bytes of the files below a folder whose names end in `suffix`; files may vanish meanwhile."""
    total = 0
    for parent, _, names in os.walk(folder):  # skips folders that vanish
        for name in names:
            if name.endswith(suffix):
                with suppress(FileNotFoundError):
                    total += (Path(parent) / name).stat().st_size
    return total


@contextmanager
def work_lock(work: Path, error: type[CrossLocError], user: str) -> Iterator[None]:
    """Make the folder of unfinished work and hold it for this process alone.

    Raises `error` where another process holds it, with `user` ("build", "process") and who that is. A folder without
    any work in it is removed at the end.
    """

    def refuse(holder: str) -> None:
        raise error(f"another {user} works in {work} ({holder}); wait for it, or give --output another name")

    with lock(work / LOCK, error, refuse):
        try:
            yield
        finally:
            with suppress(OSError):
                if [path.name for path in work.iterdir()] == [LOCK]:
                    shutil.rmtree(work)


@contextmanager
def lock(path: Path, error: type[CrossLocError], busy: Callable[[str], None]) -> Iterator[None]:
    """Hold a lock file for this process alone.

    `busy` is called with the holder where another process has it: it raises, or returns to wait. Raises `error` where
    the file cannot be made.
    """
    with ExitStack() as held:
        try:
            held.enter_context(_locked_file(path, busy))
        except OSError as failure:
            raise write_error(path, failure, error) from failure
        yield


def _locked_file(path: Path, busy: Callable[[str], None]) -> TextIO:
    for _ in range(_LOCK_TRIES):
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError), ExitStack() as opened:  # the last holder removes file and folder
            file = opened.enter_context(path.open("a+", encoding="utf-8"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                busy(file.read().strip() or "unknown")
                fcntl.flock(file, fcntl.LOCK_EX)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                file.truncate(0)
                file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
                file.flush()
                opened.pop_all()
                return file
    raise FileNotFoundError(errno.ENOENT, "other processes keep removing it", str(path))


def _replaced(target: Path) -> Path:
    return target.with_name(f".{target.name}.replaced")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
