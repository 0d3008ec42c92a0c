"""The data files of a bag, opened by rosbags' readers, and where `metadata.yaml` states something else.

`metadata.yaml` is written when a recording ends, and rewritten by tools and by hand: its texts on quality of
service, counts, topics and files often differ from the data. The data count. Of a recorder that was killed,
SQLite's last messages lie in `NAME.db3-wal`; they are read from a copy, since SQLite would write into the folder.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from pipelines.core.errors import InputError
from pipelines.core.json_values import JsonValue
from pipelines.core.products import Remark
from pipelines.formats.bag_limits import bound_decompressors, check_file, check_files, unpack_file

# Classes of rosbags, by name: a file that mentions one does not load the library.
BagStorage = Any  # reader of one data file
BagConnection = Any  # rosbags.interfaces.Connection
_Schema = Any  # of a file of mcap

_SQLITE, _MCAP = b"SQLite format 3\0", b"\x89MCAP0\r\n"
_STORAGE = {".mcap": "mcap", ".db3": "sqlite3"}
_FOOTER_BYTES = 37
# What SQLite keeps beside a database until it is closed.
_LOGS = ("-wal", "-journal")
_SHOWN = 6
_DEEPEST = 64  # brackets in YAML; recorders write three


@dataclass
class BagFiles:
    """Open data files of a bag, in the order of their first messages.

    `stated` has type and number of messages of each topic by `metadata.yaml`; it is empty for a bare file.
    """

    storages: list[Any]
    stated: dict[str, tuple[str, int]] = field(default_factory=dict)
    notes: list[Remark] = field(default_factory=list)


@dataclass
class _Metadata:
    """Fields of a `metadata.yaml` that count."""

    files: list[str] = field(default_factory=list)
    storage: str = ""
    topics: dict[str, tuple[str, int]] = field(default_factory=dict)
    quality: dict[str, Any] = field(default_factory=dict)  # by topic, as written


@contextmanager
def open_files(path: Path) -> Iterator[BagFiles]:
    """Open the data files of a rosbag2 folder, or a bare .mcap, .db3 or .bag file.

    Raises:
        InputError: no data file, one that is listed is lost, or forged ones.
        Exception: any error of rosbags' parsers.

    Examples:
        >>> from rosbags.rosbag2 import Writer
        >>> from rosbags.typesys import Stores, get_typestore
        >>> store = get_typestore(Stores.ROS2_JAZZY)
        >>> text = store.types["std_msgs/msg/String"]
        >>> with Writer(Path("flight"), version=9) as writer:
        ...     topic = writer.add_connection("/events", text.__msgtype__, typestore=store)
        ...     data = store.serialize_cdr(text("take-off"), text.__msgtype__)
        ...     writer.write(topic, 1_700_000_000_000_000_000, data)
        >>> with open_files(Path("flight")) as files:
        ...     files.stated
        {'/events': ('std_msgs/msg/String', 1)}
    """
    check_files(path)
    bound_decompressors()
    with ExitStack() as stack:
        room = Path(stack.enter_context(TemporaryDirectory(prefix="georef_bag_")))
        bag = BagFiles([])
        if not path.is_dir():
            bag.storages = [_opened(path, room, bag.notes, stack)]
            yield bag
            return
        information = _information(path / "metadata.yaml", bag.notes)
        metadata = _Metadata() if information is None else _stated(information, path / "metadata.yaml")
        listed, others = _data_files(path, metadata, bag.notes)
        bag.stated = metadata.topics
        bag.storages = [_opened(file, room, bag.notes, stack) for file in listed]
        before = len(bag.notes)
        for file in others:
            _add_unlisted(bag, file, _opened(file, room, bag.notes, stack))
        if information is None:  # that no file is listed was said
            bag.notes[before:] = [note for note in bag.notes[before:] if note.code != "bag-file-not-listed"]
        else:
            _note_differences(bag, metadata, {_storage_of(file) for file in listed})
        bag.storages.sort(key=lambda storage: storage.metadata.start_time)
        yield bag


def has_data_files(folder: Path) -> bool:
    """Return whether a folder has files of a rosbag2."""
    return any(Path(_unpacked_name(file)).suffix in _STORAGE for file in folder.iterdir())


def _information(path: Path, notes: list[Remark]) -> Any | None:
    """Return the information of a `metadata.yaml`; None, noted, where it is missing or damaged."""
    from ruamel.yaml import YAML

    if not path.exists():
        sentence = "The folder has no metadata.yaml, which a recorder writes last: its data files were read."
        notes.append(Remark(code="bag-metadata-missing", sentence=sentence))
        return None
    try:
        text = path.read_text(encoding="utf-8")
        _require_flat(text)
        return {**YAML(typ="safe").load(text)["rosbag2_bagfile_information"]}
    except Exception as error:  # of the parser, or of a document of another form
        cause = (str(error).splitlines() or [""])[0]
        sentence = f"metadata.yaml is damaged ({type(error).__name__}: {cause[:80]}): the data files were read."
        notes.append(Remark(code="bag-metadata-damaged", sentence=sentence))
        return None


def _require_flat(text: str) -> None:
    """Raise a ValueError for YAML with deep brackets, which cost its parser the square of their number."""
    depth = 0
    for match in re.finditer(r"[\[\]{}]", text):
        depth += 1 if match[0] in "[{" else -1
        if depth > _DEEPEST:
            raise ValueError("brackets are nested too deeply")


def _quality(stated: JsonValue) -> list[Any]:
    """Return the profiles of quality of service that a text or list states; none where it is damaged."""
    from rosbags.rosbag2.metadata import parse_qos

    try:
        if isinstance(stated, str):
            _require_flat(stated)
        return list(parse_qos(stated or []))
    except Exception:  # of the parser, or of other types than it expects
        return []


def _stated(information: Mapping[str, JsonValue], path: Path) -> _Metadata:
    packing = str(information.get("compression_format") or "").lower()
    if str(information.get("compression_mode") or "none").lower() != "none" and packing != "zstd":
        how = repr(packing) if packing else "a format that is not stated"
        message = f"The files are compressed by {how}, not by zstd: unpack them with `ros2 bag convert`."
        raise InputError("bag-compression", message, path=path, field="compression_format")
    known = _Metadata(storage=str(information.get("storage_identifier") or ""))
    known.files = [PurePath(str(file)).name for file in information.get("relative_file_paths") or ()]
    for each in information.get("topics_with_message_count") or ():
        topic, count = each["topic_metadata"], each["message_count"]
        if type(count) is not int:
            raise ValueError(f"metadata.yaml counts {str(count)[:40]!r} messages")
        before = known.topics.get(str(topic["name"]), ("", 0))[1]
        known.topics[str(topic["name"])] = (str(topic["type"]), before + count)
        known.quality[str(topic["name"])] = topic.get("offered_qos_profiles")
    return known


def _data_files(folder: Path, metadata: _Metadata, notes: list[Remark]) -> tuple[list[Path], list[Path]]:
    """Return the files that `metadata.yaml` lists, and the other data files of the folder."""
    listed = [folder / name for name in dict.fromkeys(metadata.files) if (folder / name).is_file()]
    lost = [name for name in metadata.files if not (folder / name).is_file()]
    stems = {_unpacked_name(file) for file in listed}
    others = [
        file
        for file in sorted(folder.iterdir())
        if Path(_unpacked_name(file)).suffix in _STORAGE
        and file not in listed
        and _unpacked_name(file) not in stems
    ]
    others = list({_unpacked_name(file): file for file in reversed(others)}.values())[::-1]
    if not others and (lost or not listed):
        what = f"{', '.join(lost[:_SHOWN])}, which metadata.yaml lists" if lost else "its data files"
        message = f"The folder lacks {what}."
        remedy = "Copy the bag again, or write its metadata anew with `ros2 bag reindex`."
        raise InputError("bag-file-missing", message, path=folder, field="--bag", remedy=remedy)
    if lost:
        names = ", ".join(lost[:_SHOWN])
        sentence = f"The bag lacks {names}, which metadata.yaml lists: their messages are missing unless renamed."
        notes.append(Remark(code="bag-file-missing", sentence=sentence))
    return listed, others


def _unpacked_name(file: Path) -> str:
    return file.name.removesuffix(".zstd")


def _storage_of(file: Path) -> str:
    """Return the storage of a file by its content, else by its name."""
    with file.open("rb") as handle:
        head = handle.read(16)
    if head == _SQLITE:
        return "sqlite3"
    return "mcap" if head.startswith(_MCAP) else _STORAGE.get(Path(_unpacked_name(file)).suffix, "")


def _opened(file: Path, room: Path, notes: list[Remark], stack: ExitStack) -> Any:
    """Return rosbags' reader of a data file, open until the stack is left."""
    if file.suffix == ".zstd":
        packed, file = file, room / _unpacked_name(file)
        unpack_file(packed, file)
        check_file(file)
    elif _storage_of(file) == "sqlite3":
        file = _settled(file, room, notes)
    reader = _readers()[".bag" if file.suffix == ".bag" else _storage_of(file)](file)
    reader.open()
    stack.callback(reader.close)
    return reader


def _settled(file: Path, room: Path, notes: list[Remark]) -> Path:
    """Return a database that has all its messages in itself, a copy where SQLite's log beside it has more."""
    import sqlite3

    logs = [log for mark in _LOGS if (log := file.with_name(file.name + mark)).is_file() and log.stat().st_size]
    if not logs:
        if not set("?#%") & set(str(file)):
            return file
        link = room / file.name  # rosbags opens a URI, in which these have another meaning
        link.symlink_to(file.resolve())
        return link
    names = ", ".join(log.name for log in logs)
    size = file.stat().st_size + sum(log.stat().st_size for log in logs)
    if shutil.disk_usage(room).free < size:
        message = (
            f"{names} has messages that are not in {file.name} yet, and {room.parent} has no room for a copy "
            "of both."
        )
        remedy = f'Write them into the database: sqlite3 {file.name} "PRAGMA wal_checkpoint(TRUNCATE)".'
        raise InputError("bag-write-ahead-log", message, path=file, field="--bag", remedy=remedy)
    copy = room / file.name
    for source in (file, *logs):
        shutil.copyfile(source, room / source.name)
    base = sqlite3.connect(copy)
    try:
        base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        base.execute("PRAGMA journal_mode=DELETE")
        base.execute("SELECT count(*) FROM sqlite_master").fetchone()
    finally:
        base.close()
    sentence = f"The bag was not closed: {names} has messages that {file.name} does not have, and both were read."
    notes.append(Remark(code="bag-write-ahead-log", sentence=sentence))
    return copy


@cache
def _readers() -> dict[str, Any]:
    """Return rosbags' reader by storage, that of mcap also for files of ROS 1 and for those without a profile."""
    from rosbags import rosbag1
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.rosbag2 import ReaderError, storage_mcap, storage_sqlite3
    from rosbags.typesys.msg import normalize_msgtype

    usual = storage_mcap.get_msgdef

    def definition_of(schema: _Schema | None) -> Any:
        if schema is not None and schema.encoding == "ros1msg":
            return MessageDefinition(MessageDefinitionFormat.MSG, schema.data)
        return usual(schema)

    class McapReader(storage_mcap.McapReader):
        """Also reads files of ROS 1, and of any profile: schemas and channels tell what messages are.

        Chunks are not passed over for what their index lacks or states falsely: their messages decide.
        """

        def _open(self) -> None:
            bio = self.bio
            assert bio
            if bio.read(len(_MCAP)) != _MCAP or bio.read(1) != b"\x01":
                raise ReaderError("File magic is invalid.")
            storage_mcap.read_sized(bio)
            self.data_start = bio.tell()
            footer_at = bio.seek(-_FOOTER_BYTES, 2)
            footer = bio.read()
            if footer[:9] != b"\x02\x14" + bytes(7) or not footer.endswith(_MCAP):
                raise ReaderError("The file ends without a footer.")
            summary_at = int.from_bytes(footer[9:17], "little")
            if summary_at and not self.data_start <= summary_at <= footer_at:
                raise ReaderError("Invalid MCAP summary offset.")
            self.data_end = summary_at or footer_at
            if summary_at:
                self.read_index()
            if self.statistics is None or not self.connections:
                self.meta_scan()
            assert self.statistics
            counts, total = self.statistics.channel_message_counts, self.statistics.message_count
            self.connections = [self._named(link, counts.get(link.id, 0)) for link in self.connections]
            for chunk in self.chunks:
                if not chunk.channel_count:
                    chunk.channel_count.update(dict.fromkeys(self.channels, 1))
            first, last = self.statistics.start_time, self.statistics.end_time
            self.metadata = self.metadata._replace(
                start_time=first if total else 2**63 - 1, end_time=last + 1 if total else 0, message_count=total
            )

        def _named(self, link: BagConnection, count: int) -> Any:
            """Return a connection with its count, and with its type as ROS 2 writes it."""
            name = self.channels[link.id].schema
            is_ros1 = any(each.name == name and each.encoding == "ros1msg" for each in self.schemas.values())
            if is_ros1 != (link.ext.serialization_format == "ros1"):
                raise KeyError("ros1msg")
            return link._replace(
                msgcount=count, msgtype=normalize_msgtype(link.msgtype) if is_ros1 else link.msgtype
            )

        def messages(
            self, connections: Collection[BagConnection], start: int | None = None, stop: int | None = None
        ) -> Any:
            return super().messages(
                connections, -1 if start is None else start, 2**63 - 1 if stop is None else stop
            )

    storage_mcap.get_msgdef = definition_of
    modules: tuple[Any, ...] = (storage_mcap, storage_sqlite3)
    for module in modules:
        module.parse_qos = _quality
    return {"mcap": McapReader, "sqlite3": storage_sqlite3.Sqlite3Reader, ".bag": rosbag1.Reader}


def _add_unlisted(bag: BagFiles, file: Path, storage: BagStorage) -> None:
    """Add a file that `metadata.yaml` does not list, unless it is a copy of what was read."""
    topics = {link.topic for link in storage.connections if link.msgcount}
    middle = (storage.metadata.start_time + storage.metadata.end_time) // 2
    for other in bag.storages:
        shared = topics & {link.topic for link in other.connections if link.msgcount}
        if shared and other.metadata.start_time <= middle < other.metadata.end_time:
            sentence = (
                f"{file.name} is passed over: metadata.yaml does not list it, and it has the time of another file."
            )
            bag.notes.append(Remark(code="bag-file-is-copy", sentence=sentence))
            return
    bag.storages.append(storage)
    if topics:
        count = sum(link.msgcount for link in storage.connections)
        sentence = f"{file.name}, which metadata.yaml does not list, was read too: {count} messages."
        bag.notes.append(Remark(code="bag-file-not-listed", sentence=sentence))


def message_counts(storages: list[BagStorage]) -> dict[tuple[str, str], int]:
    """Return the number of messages by topic and type, as the data files state them."""
    counts: dict[tuple[str, str], int] = {}
    for link in (link for storage in storages for link in storage.connections):
        counts[link.topic, link.msgtype] = counts.get((link.topic, link.msgtype), 0) + link.msgcount
    return counts


def _note_differences(bag: BagFiles, metadata: _Metadata, storages: set[str]) -> None:
    """Note what `metadata.yaml` states otherwise than the data files."""
    held: dict[str, int] = {}
    for (topic, _), count in message_counts(bag.storages).items():
        held[topic] = held.get(topic, 0) + count
    parts = []
    if storages and {metadata.storage} != storages:
        parts.append(f"storage_identifier {metadata.storage!r} for {' and '.join(sorted(storages))}")
    counted = {topic: count for topic, (_, count) in metadata.topics.items()}
    wrong = [topic for topic in counted.keys() | held.keys() if counted.get(topic, 0) != held.get(topic, 0)]
    differences = [f"{topic} {counted.get(topic, 0)} for {held.get(topic, 0)} messages" for topic in sorted(wrong)]
    parts += differences[:_SHOWN] + (
        [f"{len(differences) - _SHOWN} more topics"] if len(differences) > _SHOWN else []
    )
    other = sum(
        _quality_differs(bag.storages, topic, metadata.quality[topic]) for topic in counted.keys() & held.keys()
    )
    if other:
        sentence = f"metadata.yaml states another quality of service than the data files for {other} topics."
        bag.notes.append(Remark(code="bag-qos-differs", sentence=sentence))
    if parts:
        sentence = f"The data files count where metadata.yaml states something else: {'; '.join(parts)}."
        bag.notes.append(Remark(code="bag-metadata-differs", sentence=sentence))


def _quality_differs(storages: list[BagStorage], topic: str, stated: JsonValue) -> bool:
    wanted = _quality(stated)
    links = [link for storage in storages for link in storage.connections if link.topic == topic]
    return (bool(stated) and not wanted) or all(list(link.ext.offered_qos_profiles) != wanted for link in links)
