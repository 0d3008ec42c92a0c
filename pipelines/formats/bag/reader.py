"""Reading of ROS bags, one message at a time: rosbag2 folders and bare files (mcap, sqlite3), and ROS 1 bags.

Definitions of message types come from the bag, else from the ROS distribution. PX4's messages are in no
distribution: for them the layout of `bag.definitions` counts that fits the message. A damaged definition harms its
own topic only.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipelines.core.errors import InputError
from pipelines.formats.bag.definitions import DEFINITIONS
from pipelines.formats.bag.limits import bound_decompressors, check_files, refuse_large_chunk, unpacked
from pipelines.formats.image_file import MAX_BYTES

# Schemas of mcap that do not belong in a ROS bag; the reader cannot open a bag with them.
_FOREIGN_SCHEMAS = ("jsonschema", "protobuf", "flatbuffer", "ros1msg")
# PX4 sends a message within milliseconds of its sample.
_SAMPLE_LAG_US = 60_000_000
_REPAIR = "repair it with `mcap recover` (mcap) or `ros2 bag reindex` (sqlite3, or metadata.yaml missing)"


class UndecodableError(ValueError):
    """A message that does not fit its definition, or whose definition is unknown."""


@dataclass(frozen=True)
class BagTopic:
    """Topic: name, message type (`sensor_msgs/msg/Imu`) and number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class RawMessage:
    """Message as stored; `bag_ns` is the time of recording, nanoseconds since 1970."""

    topic: str
    type: str
    bag_ns: int
    data: bytes


class Bag:
    """Open bag; see `open_bag`.

    Attributes:
        path: file or folder.
        topics: by name.
        damage: reason why reading ended before the end of the bag; None if it did not.
        fallback_types: types decoded by a definition that the bag itself does not have.
    """

    def __init__(self, path: Path, reader: Any, ros2: bool) -> None:
        self.path, self._reader, self._ros2 = path, reader, ros2
        self._packed = _unpack_here(reader)
        self._connections = list(reader.connections)
        # Any file of a split bag may have the definition.
        links = [link for part in _parts(reader) for link in part.connections] + self._connections
        self._definitions = {link.msgtype: link.msgdef for link in links if link.msgdef.data}
        self._stores: dict[str, Any] = {}
        self.damage: str | None = None
        self.fallback_types: set[str] = set()
        counts: dict[tuple[str, str], int] = {}
        for link in self._connections:
            key = (link.topic, link.msgtype)
            counts[key] = counts.get(key, 0) + link.msgcount
        self.topics = {
            name: BagTopic(name, kind, count) for (name, kind), count in sorted(counts.items(), reverse=True)
        }

    @property
    def message_count(self) -> int:
        """Number of messages of all topics, by the bag's index."""
        return sum(topic.count for topic in self.topics.values())

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of these topics by time of recording.

        Reading ends early where the bag is damaged; `damage` then states the reason.
        """
        wanted = {name: self.topics[name].type for name in topics}
        links = [link for link in self._connections if wanted.get(link.topic) == link.msgtype]
        if not links:
            return
        stream = self._reader.messages(connections=links)
        while True:
            try:
                link, bag_ns, data = next(stream)
                if not isinstance(bag_ns, int) or not isinstance(data, bytes | bytearray | memoryview):
                    raise TypeError(f"a message of {link.topic} is no bytes")  # SQLite has any type in any column
                data = unpacked(bytes(data), MAX_BYTES) if self._packed else bytes(data)
            except StopIteration:
                return
            except Exception as error:  # the library raises any error of its parsers
                self.damage = f"{type(error).__name__}: {error}"
                return
            yield RawMessage(link.topic, link.msgtype, bag_ns, data)

    def decode(self, message: RawMessage) -> Any:
        """Return the message as an object with the fields of its definition.

        Raises:
            UndecodableError: the message does not fit, or has no known definition.
        """
        store = self._store(message)
        try:
            if self._ros2:
                return store.deserialize_cdr(message.data, message.type)
            return store.deserialize_ros1(message.data, message.type)
        except Exception as error:  # hostile bytes make generated code raise any error
            raise UndecodableError(f"{type(error).__name__}: {error}") from error

    def first(self, topic: str) -> Any | None:
        """Return the first message of a topic that decodes, or None."""
        for attempt, message in enumerate(self.messages([topic])):
            try:
                return self.decode(message)
            except UndecodableError:
                if attempt >= 9:
                    break
        return None

    def header_stamp_ns(self, message: RawMessage) -> int | None:
        """Return the stamp of a message that begins with a `std_msgs/Header`, without decoding it; None if zero."""
        try:
            if not self._ros2:
                sec, nanosec = struct.unpack_from("<II", message.data, 4)
            else:
                order = "<" if message.data[1] & 1 else ">"
                sec, nanosec = struct.unpack_from(f"{order}iI", message.data, 4)
        except (struct.error, IndexError):
            return None
        return sec * 1_000_000_000 + nanosec or None

    def _store(self, message: RawMessage) -> Any:
        """Return a typestore that has the type of `message`."""
        kind = message.type
        if kind not in self._stores:
            stated = self._definitions.get(kind)
            if stated is None and kind in DEFINITIONS:
                self._stores[kind] = self._store_that_fits(message)
            else:
                self._stores[kind] = self._make_store(kind, stated)
        store = self._stores[kind]
        if isinstance(store, str):
            raise UndecodableError(store)
        return store

    def _make_store(self, kind: str, stated: Any | None) -> Any:
        """Return a typestore that has `kind` by the bag's or a default definition, or the reason why none has."""
        if stated is not None:
            try:
                return _stated_store(stated, kind)
            except Exception as error:  # a grammar error, an unknown word, a repeated name …
                return f"its definition of {kind} cannot be read: {type(error).__name__}: {error}"
        self.fallback_types.add(kind)
        common = _common_store(self._ros2)
        return common if kind in common.types else f"it has no definition of {kind}"

    def _store_that_fits(self, message: RawMessage) -> Any:
        """Return a typestore with the layout of `DEFINITIONS` that fits `message`."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        for release, text in DEFINITIONS[message.type].items():
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(text, message.type))
            try:
                decoded: Any = store.deserialize_cdr(message.data, message.type)
            except Exception:  # another length, or damaged
                continue
            sample = getattr(decoded, "timestamp_sample", 0)
            if sample and abs(sample - decoded.timestamp) > _SAMPLE_LAG_US:
                continue
            self.fallback_types.add(f"{message.type} (as of PX4 {release})")
            return store
        # The failure is not stored: the next message may be whole.
        raise UndecodableError(
            f"{len(message.data)} bytes are none of the layouts of {message.type} that are known here"
        )


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for reading.

    Raises:
        InputError: no bag, damaged beyond opening, or with chunks too large for memory.
    """
    ros2 = path.suffix != ".bag"
    reader = _reader(path, ros2)
    try:
        reader.open()
    except InputError:
        raise
    except KeyError as error:
        if error.args[0] not in _FOREIGN_SCHEMAS:
            raise InputError(f"is no bag, or is damaged ({_describe(error)}): {_REPAIR}", path=path) from error
        raise InputError(
            f"has a topic in {error.args[0]!r}, which is not ROS 2's: leave it out with `mcap filter`", path=path
        ) from error
    except Exception as error:  # truncated and forged files make the parser raise any error
        raise InputError(f"is no bag, or is damaged ({_describe(error)}): {_REPAIR}", path=path) from error
    try:
        _check_chunks(reader, path)
        _check_topics(reader, path)
        yield Bag(path, reader, ros2)
    finally:
        reader.close()


def _reader(path: Path, ros2: bool) -> Any:
    from rosbags import rosbag1, rosbag2

    if not path.exists():
        raise InputError("no such bag", path=path, field="--bag")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        raise InputError(
            "has no metadata.yaml: give the .mcap or .db3 file in it, or `ros2 bag reindex` the folder",
            path=path,
            field="--bag",
        )
    if not path.is_dir() and path.suffix not in (".bag", ".mcap", ".db3"):
        raise InputError(
            "is no bag: give a rosbag2 folder, or a .mcap, .db3 or .bag file", path=path, field="--bag"
        )
    try:
        check_files(path)
        bound_decompressors()
        return rosbag2.Reader(path) if ros2 else rosbag1.Reader(path)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"is no bag, or is damaged ({_describe(error)}): {_REPAIR}", path=path) from error


def _check_chunks(reader: Any, path: Path) -> None:
    for storage in _parts(reader):
        largest = max((chunk.uncompressed_size for chunk in getattr(storage, "chunks", ())), default=0)
        refuse_large_chunk(path, largest)


def _check_topics(reader: Any, path: Path) -> None:
    """Refuse topics whose names, types or counts are none: SQLite and YAML have any type in any place."""
    for link in reader.connections:
        if not (isinstance(link.topic, str) and isinstance(link.msgtype, str) and isinstance(link.msgcount, int)):
            raise InputError(f"is damaged (topic {str(link.topic)[:40]!r}): {_REPAIR}", path=path)


def _unpack_here(reader: Any) -> bool:
    """Return whether messages are compressed one by one, and let rosbags hand them over packed."""
    storage: Any = getattr(reader, "storage", None)
    if getattr(getattr(storage, "metadata", None), "compression_mode", None) != "message":
        return False
    storage.metadata = storage.metadata._replace(compression_mode=None)
    return True


def _parts(reader: Any) -> list[Any]:
    """Return the files of a rosbag2."""
    outer = getattr(reader, "storage", None)
    return list(getattr(outer, "storages", [] if outer is None else [outer]))


@lru_cache(maxsize=256)
def _stated_store(definition: Any, kind: str) -> Any:
    """Return a typestore with the types of a definition; the code that decodes them is generated once."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(_parsed(definition, kind))
    return store


@lru_cache
def _common_store(ros2: bool) -> Any:
    """Return a typestore with the types of a ROS distribution."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)


def _parsed(definition: Any, kind: str) -> Any:
    """Return the types of a definition, in ROS's message language or in IDL."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if definition.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(definition.data, kind)
    rule = "=" * 80 + "\n"
    # rosbags' parser takes no directives; the definitions that they include follow below.
    text = re.sub(r"^[ \t]*#.*$", "", definition.data, flags=re.MULTILINE)
    if not text.startswith(f"{rule}IDL: "):
        return get_types_from_idl(text)
    types: dict[str, Any] = {}
    for part in text.split(rule)[1:]:
        types.update(get_types_from_idl(part.partition("\n")[2]))
    return types


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ").rstrip(".")
