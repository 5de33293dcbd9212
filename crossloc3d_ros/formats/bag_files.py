"""The files of a rosbag2 recording where its metadata is missing, broken or false, and what SQLite left beside them."""

from __future__ import annotations

import logging
import shutil
import sqlite3
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

log = logging.getLogger(__name__)

_LEFT_BESIDE = ("-wal", "-journal")
"""What SQLite writes beside a file, and merges into it when it is closed: a recorder that was killed does not."""


def has_metadata(folder: Path) -> bool:
    """Return whether a folder has rosbag2's description of a recording."""
    return (folder / "metadata.yaml").is_file()


def storage_files(path: Path) -> list[Path]:
    """Return the files that hold a recording's messages, sorted; none of a recording that is compressed as a whole."""
    if path.is_file():
        return [path]
    return sorted(file for file in path.iterdir() if file.suffix in {".mcap", ".db3"} and file.is_file())


def left_beside(file: Path) -> list[Path]:
    """Return the files beside a storage file that hold messages, or their undoing, that are not in it yet."""
    if file.suffix != ".db3":
        return []
    beside = (file.with_name(file.name + suffix) for suffix in _LEFT_BESIDE)
    return [other for other in beside if other.is_file() and other.stat().st_size > 0]


def merged(file: Path, stack: ExitStack) -> Path:
    """Return a file with all of its messages: itself, or a copy that is deleted with `stack`.

    The recording itself is never written to. Raises OSError or sqlite3.Error where the copy cannot be made.
    """
    beside = left_beside(file)
    if not beside:
        return file
    names = ", ".join(str(other) for other in beside)
    log.warning("%s was not closed: %s is merged in a copy of it", file, names)
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="crossloc3d_bag_")))
    for part in (file, *beside):
        shutil.copyfile(part, folder / part.name)
    with closing(sqlite3.connect(folder / file.name)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        database.execute("PRAGMA journal_mode=DELETE").fetchall()
    return folder / file.name


def contradiction(reader: AnyReader) -> str:
    """Return where the metadata of an opened folder and its files contradict each other so that messages are lost; ''.

    The library takes from a file only the messages of connections that equal one of the metadata in all of topic, type
    and offered QoS, and says nothing of the others.
    """
    for part in reader.readers:
        storage: Any = getattr(part, "storage", None)
        if not hasattr(storage, "storages") or storage.metadata.compression_mode:
            continue
        told = list(storage.connections)
        for file in storage.storages:
            for connection in file.connections:
                same = [c for c in told if (c.topic, c.msgtype) == (connection.topic, connection.msgtype)]
                if connection.msgcount and not same:
                    return f"it does not name the topic {connection.topic}"
                if connection.msgcount and not any(c.ext == connection.ext for c in same):
                    return f"its QoS of {connection.topic} is not the one in the file"
        there = sum(file.metadata.message_count for file in storage.storages)
        if there != storage.metadata.message_count:
            return f"it counts {storage.metadata.message_count:,} messages, the files hold {there:,}"
    return ""
