"""Recordings: rosbag2 (sqlite3, mcap) and ROS 1 bags in, rosbag2 out, through `rosbags`; no ROS installation needed.

Reading streams: one message at a time, however large the bag. Time is integer nanoseconds.
"""

from __future__ import annotations

import logging
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

from rosbags.convert.converter import migrate_message
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats.bag_files import contradiction, has_metadata, left_beside, merged, storage_files

log = logging.getLogger(__name__)

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"

# A full disk reaches us as the one or the other, depending on the storage.
_DISK_ERRORS = (OSError, sqlite3.Error)

ReliabilityName = Literal["reliable", "best_effort", "unknown"]
DurabilityName = Literal["volatile", "transient_local", "unknown"]
Storage = Literal["mcap", "sqlite3"]


@dataclass(frozen=True)
class OfferedQos:
    """What a publisher in the recording offered, as far as a player has to repeat it."""

    reliability: ReliabilityName = "reliable"
    durability: DurabilityName = "volatile"
    depth: int = 10


@dataclass(frozen=True)
class BagTopic:
    """One topic of a recording."""

    name: str
    msgtype: str
    """ROS 2 style, `sensor_msgs/msg/PointCloud2`, for ROS 1 bags too."""
    count: int
    offered_qos_profiles: tuple[OfferedQos, ...] = ()
    """Empty where the recording names none."""


class BagMessage(NamedTuple):
    """A message as an object with the fields that its type has."""

    topic: str
    t_ns: int
    """When it was recorded; the message's own header may differ."""
    message: Any


class RawMessage(NamedTuple):
    """A message as the bytes that go over DDS."""

    topic: str
    msgtype: str
    t_ns: int
    cdr: bytes


class BagReader:
    """A recording opened for reading; made by `open_bag` and used in a `with` block."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stack = ExitStack()
        self._reader: AnyReader | None = None

    def __enter__(self) -> Self:
        _check_before_opening(self.path)
        try:
            self._reader = self._opened()
        except Exception as error:  # a damaged file makes the library raise nearly anything
            self._stack.close()
            raise self._damaged(error) from error
        return self

    def _opened(self) -> AnyReader:
        """Open the recording: by its metadata where they agree with the files, else by the files alone."""
        files = storage_files(self.path)
        unmerged = [file for file in files if left_beside(file)]
        if self.path.is_file() and not unmerged:
            return self._enter([self.path])
        if not unmerged:
            fault = "it is missing, as after a recorder that was stopped" if not has_metadata(self.path) else ""
            if not fault:
                try:
                    reader = self._enter([self.path])
                    fault = contradiction(reader)
                except Exception as error:
                    if not files:
                        raise
                    fault = " ".join(str(error).split())
                if not fault:
                    return reader
                self._stack.close()
            log.warning("%s is left aside, the files are read as they are: %s", self.path / "metadata.yaml", fault)
        return self._enter([merged(file, self._stack) for file in files])

    def _enter(self, paths: Sequence[Path]) -> AnyReader:
        # Bags from before Iron hold no message definitions: the standard types are then taken as Jazzy's.
        return self._stack.enter_context(AnyReader(paths, default_typestore=_jazzy()))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._reader = None
        self._stack.close()

    def topics(self) -> dict[str, BagTopic]:
        """Return the topics of the recording by name, sorted."""
        found: dict[str, BagTopic] = {}
        for connection in self._open_reader().connections:
            known = found.get(connection.topic)
            qos = known.offered_qos_profiles if known else ()
            found[connection.topic] = BagTopic(
                name=connection.topic,
                msgtype=connection.msgtype,
                count=connection.msgcount + (known.count if known else 0),
                offered_qos_profiles=qos + tuple(new for new in _offered_qos(connection) if new not in qos),
            )
        return dict(sorted(found.items()))

    def topic(self, name: str, msgtype: str) -> BagTopic:
        """Return the topic `name`; BagError lists the topics that there are, if it is missing or of another type."""
        topics = self.topics()
        if name not in topics:
            raise BagError(f"{self.path} has no topic '{name}'; {_list_topics(topics)}")
        if topics[name].msgtype != msgtype:
            raise BagError(
                f"topic '{name}' of {self.path} holds {topics[name].msgtype}, not {msgtype}; {_list_topics(topics)}"
            )
        return topics[name]

    def only_topic(self, msgtype: str, how_to_choose: str) -> BagTopic:
        """Return the one topic of a type; with none or several BagError lists them and adds `how_to_choose`."""
        topics = self.topics()
        fitting = [topic for topic in topics.values() if topic.msgtype == msgtype]
        if not fitting:
            raise BagError(f"{self.path} has no topic of type {msgtype}; {_list_topics(topics)}")
        if len(fitting) > 1:
            names = ", ".join(topic.name for topic in fitting)
            raise BagError(f"{self.path} has several topics of type {msgtype} ({names}); {how_to_choose}")
        return fitting[0]

    @property
    def start_ns(self) -> int:
        """Time of the first message; 0 in an empty bag."""
        return int(self._open_reader().start_time) if self.message_count else 0

    @property
    def end_ns(self) -> int:
        """Time of the last message; 0 in an empty bag."""
        return int(self._open_reader().end_time) - 1 if self.message_count else 0

    @property
    def message_count(self) -> int:
        """Messages in all topics together."""
        return int(self._open_reader().message_count)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages of the topics (None = all) in the order of recording."""
        reader = self._open_reader()
        for connection, t_ns, data in self._records(topics):
            try:
                message = reader.deserialize(data, connection.msgtype)
            except Exception as error:
                raise self._damaged(error, f"a message of '{connection.topic}' cannot be decoded: ") from error
            yield BagMessage(connection.topic, t_ns, message)

    def raw_messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages as CDR bytes, ready for `publisher.publish`; those of ROS 1 bags are converted.

        ROS 1 messages whose type Jazzy's standard packages do not have are left out and named once in the log.
        """
        reader = self._open_reader()
        migrations: dict[str, object] = {}
        unknown: set[str] = set()
        for connection, t_ns, data in self._records(topics):
            if not reader.is2:
                if connection.msgtype not in _jazzy().fielddefs:
                    if connection.topic not in unknown:
                        log.warning("'%s' left out: ROS 2 has no %s", connection.topic, connection.msgtype)
                        unknown.add(connection.topic)
                    continue
                try:
                    data = bytes(_cdr_from_ros1(reader.typestore, connection.msgtype, data, migrations))
                except Exception as error:
                    raise self._damaged(error, f"a message of '{connection.topic}' cannot be decoded: ") from error
            yield RawMessage(connection.topic, connection.msgtype, t_ns, bytes(data))

    def _records(self, topics: Collection[str] | None) -> Iterator[tuple[Connection, int, bytes]]:
        reader = self._open_reader()
        connections = [c for c in reader.connections if topics is None or c.topic in topics]
        if not connections:  # the library takes an empty list for all of them
            return
        records = reader.messages(connections=connections)
        read = 0
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except Exception as error:
                raise self._damaged(error, f"readable up to message {read} only: ") from error
            read += 1
            yield record

    def _open_reader(self) -> AnyReader:
        if self._reader is None:
            raise BagError(f"{self.path} is not open; use it in a with block")
        return self._reader

    def _damaged(self, error: Exception, what: str = "") -> BagError:
        files = [self.path]
        if self.path.is_dir():
            files = sorted(p for p in self.path.iterdir() if p.suffix in {".mcap", ".db3", ".zstd"}) or files
        names = ", ".join(str(file) for file in files)
        advice = "copy it again from where it was recorded"
        if self.path.suffix == ".bag":
            advice += ", or repair it with 'rosbag reindex'"
        elif any(".mcap" in file.suffixes for file in files):
            advice += ", or save what is whole with 'mcap recover FILE -o NEW.mcap' and give NEW.mcap itself"
        else:
            advice += ', or save what is whole with "sqlite3 FILE .recover | sqlite3 NEW.db3" and give NEW.db3 itself'
        detail = str(error).strip().rstrip(".") or type(error).__name__
        return BagError(f"cannot read {names}: {what}{detail}; {advice}")


def open_bag(path: Path | str) -> BagReader:
    """Return a reader for a rosbag2 folder, one `.mcap` or `.db3` file, or a ROS 1 `.bag`; use it in a `with` block.

    Entering raises BagError, naming the file and what to do, if it is not a readable recording.
    """
    return BagReader(Path(path))


class BagWriter:
    """A rosbag2 folder being written; it appears under its name only when the `with` block ends without an error."""

    def __init__(self, path: Path | str, storage: Storage = "mcap") -> None:
        self.path = Path(path)
        self.storage = storage
        self._folder: Path | None = None
        self._writer: Writer | None = None
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> Self:
        if self.path.exists():
            raise BagError(f"{self.path} exists already; choose another name or remove it first")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", dir=self.path.parent))
            plugin = StoragePlugin.MCAP if self.storage == "mcap" else StoragePlugin.SQLITE3
            self._writer = Writer(self._folder / self.path.name, version=9, storage_plugin=plugin)
            self._writer.open()
        except _DISK_ERRORS as error:
            self._remove()
            raise BagError(f"cannot write {self.path}: {error}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        writer, self._writer = self._writer, None
        if writer is None or self._folder is None:
            return
        try:
            if kind is None:
                writer.close()
                (self._folder / self.path.name).rename(self.path)
            else:
                with suppress(*_DISK_ERRORS):  # the earlier error is the cause
                    writer.abort()
        except _DISK_ERRORS as failure:
            raise BagError(f"cannot write {self.path}: {failure}") from failure
        finally:
            self._remove()

    def add_topic(self, topic: str, msgtype: str, qos: OfferedQos | None = None) -> None:
        """Declare a topic; needed only where the offered QoS is to be recorded."""
        if topic in self._connections:
            raise BagError(f"topic '{topic}' is in {self.path} already")
        self._connections[topic] = self._open_writer().add_connection(
            topic, msgtype, typestore=_jazzy(), offered_qos_profiles=[_qos_record(qos)] if qos else []
        )

    def write(self, topic: str, msgtype: str, stamp_ns: int, message: object) -> None:
        """Write one message, recorded at `stamp_ns`."""
        if topic not in self._connections:
            self.add_topic(topic, msgtype)
        try:
            data = _jazzy().serialize_cdr(message, msgtype)
            self._open_writer().write(self._connections[topic], int(stamp_ns), data)
        except _DISK_ERRORS as error:
            raise BagError(f"cannot write {self.path}: {error}") from error

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise BagError(f"{self.path} is not open for writing; use it in a with block")
        return self._writer

    def _remove(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


def stamp_ns_of(message: Any, recorded_ns: int) -> int:
    """Return the header's stamp, or the time of recording for a message whose header has none."""
    stamp = message.header.stamp
    stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return stamp_ns or recorded_ns


@cache
def _jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def _check_before_opening(path: Path) -> None:
    if not path.exists():
        raise BagError(f"{path} does not exist; give a rosbag2 folder, a .mcap or .db3 file, or a ROS 1 .bag")
    if path.is_dir() and not has_metadata(path) and not storage_files(path):
        raise BagError(f"{path} is not a recording: it holds neither metadata.yaml nor a .mcap or .db3 file")
    if path.is_file() and path.suffix not in {".mcap", ".db3", ".bag"}:
        raise BagError(f"{path} is not a recording; give a rosbag2 folder, a .mcap or .db3 file, or a ROS 1 .bag")


def _list_topics(topics: Mapping[str, BagTopic]) -> str:
    if not topics:
        return "the bag is empty"
    return "its topics are: " + ", ".join(f"{t.name} ({t.msgtype}, {t.count:,} messages)" for t in topics.values())


def _offered_qos(connection: Connection) -> tuple[OfferedQos, ...]:
    if isinstance(connection.ext, ConnectionExtRosbag1):
        return (OfferedQos(durability="transient_local", depth=1),) if connection.ext.latching else ()
    reliabilities: dict[QosReliability, ReliabilityName] = {
        QosReliability.RELIABLE: "reliable",
        QosReliability.BEST_EFFORT: "best_effort",
    }
    durabilities: dict[QosDurability, DurabilityName] = {
        QosDurability.VOLATILE: "volatile",
        QosDurability.TRANSIENT_LOCAL: "transient_local",
    }
    return tuple(
        OfferedQos(
            reliabilities.get(qos.reliability, "unknown"), durabilities.get(qos.durability, "unknown"), qos.depth
        )
        for qos in connection.ext.offered_qos_profiles
    )


def _qos_record(qos: OfferedQos) -> Qos:
    forever = QosTime(2147483647, 4294967295)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=qos.depth,
        reliability=QosReliability[qos.reliability.upper()],
        durability=QosDurability[qos.durability.upper()],
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


def _cdr_from_ros1(source: Typestore, msgtype: str, data: bytes, cache_: dict[str, object]) -> memoryview:
    message = migrate_message(source, _jazzy(), msgtype, msgtype, cache_, source.deserialize_ros1(data, msgtype))
    return _jazzy().serialize_cdr(message, msgtype)
