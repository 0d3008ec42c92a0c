"""Bags whose `metadata.yaml` states something else than their data files, and bags that were not closed."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import struct
import sys
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from ruamel.yaml import YAML

from georef_cli import boundary
from georef_cli.main import cli
from tests import bags
from tests.bags import START, Flight, Form, Message
from tests.ingested_bags import Ingest, Refusal, check, remarked

STORAGES = list(StoragePlugin)
QOS_NUMBERS = """- history: {history}
  depth: {depth}
  reliability: 1
  durability: 2
  deadline: {{sec: 0, nsec: 0}}
  lifespan: {{sec: 9223372036, nsec: 854775807}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 0, nsec: 0}}
  avoid_ros_namespace_conventions: false
"""
WORDS = {"history": "unknown", "reliability": "reliable", "durability": "volatile", "liveliness": "automatic"}
# Topics of the folders that rosbag2 is tested with: type, messages, and how many profiles each topic has.
TALKER = {"/topic": ("std_msgs/msg/String", 10, 1), "/rosout": ("rcl_interfaces/msg/Log", 10, 1)}
REWRITER_A = {"a_empty": ("test_msgs/msg/Empty", 100, 2), "b_basictypes": ("test_msgs/msg/Number", 50, 1)}
REWRITER_B = {"c_strings": ("std_msgs/msg/String", 50, 1), "a_empty": ("test_msgs/msg/Empty", 25, 1)}
FOLDERS = [
    *(("talker", TALKER, storage, 4) for storage in STORAGES),
    *(("convert_a", REWRITER_A, storage, 5) for storage in STORAGES),
    ("convert_b", REWRITER_B, StoragePlugin.SQLITE3, 5),
    *(("rewriter_a", REWRITER_A, storage, version) for storage, version in zip(STORAGES, (6, 5), strict=True)),
    ("rewriter_b", REWRITER_B, StoragePlugin.SQLITE3, 7),
    ("rewriter_b", REWRITER_B, StoragePlugin.MCAP, 8),
    ("talker", TALKER, StoragePlugin.MCAP, 9),
]


def change(bag: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """Change the information in `metadata.yaml`."""
    yaml = YAML(typ="safe")
    document = yaml.load((bag / "metadata.yaml").read_text())
    edit(document["rosbag2_bagfile_information"])
    with (bag / "metadata.yaml").open("w") as handle:
        yaml.dump(document, handle)
    return bag


def topic_of(information: dict[str, Any], name: str) -> dict[str, Any]:
    return next(each for each in information["topics_with_message_count"] if each["topic_metadata"]["name"] == name)


def without(information: dict[str, Any], name: str) -> None:
    """Take a topic out."""
    kept = [each for each in information["topics_with_message_count"] if each["topic_metadata"]["name"] != name]
    information["topics_with_message_count"] = kept


def inspected(path: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert boundary.guarded(cli, ["inspect", str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def as_of_version(information: dict[str, Any], version: int, profiles: dict[str, int]) -> None:
    """State quality of service and files as a release writes them, and not as the data have them."""
    information["version"] = version
    for key, first in (("files", 5), ("custom_data", 6), ("ros_distro", 8)):
        if version < first:
            information.pop(key, None)
    for each in information["topics_with_message_count"]:
        topic = each["topic_metadata"]
        many = profiles[topic["name"]]
        if version < 7:
            topic.pop("type_description_hash", None)
        if version < 9:
            texts = [QOS_NUMBERS.format(history=3 - number % 2, depth=number) for number in range(many)]
            topic["offered_qos_profiles"] = "".join(texts)
        else:
            zero = {"sec": 0, "nsec": 0}
            times = dict.fromkeys(("deadline", "lifespan", "liveliness_lease_duration"), zero)
            one = {**WORDS, **times, "depth": 0, "avoid_ros_namespace_conventions": False}
            topic["offered_qos_profiles"] = [one] * many


@pytest.mark.parametrize(("name", "topics", "storage", "version"), FOLDERS)
def test_folders_that_rosbag2_is_tested_with(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    topics: dict[str, tuple[str, int, int]],
    storage: StoragePlugin,
    version: int,
) -> None:
    bags.TYPES.register(get_types_from_msg("uint8 structure_needs_at_least_one_member", "test_msgs/msg/Empty"))
    bags.TYPES.register(get_types_from_msg("uint32 number", "test_msgs/msg/Number"))
    made = {
        "std_msgs/msg/String": lambda: bags.make("std_msgs/msg/String", "hello"),
        "test_msgs/msg/Empty": lambda: bags.make("test_msgs/msg/Empty", 0),
        "test_msgs/msg/Number": lambda: bags.make("test_msgs/msg/Number", 7),
        "rcl_interfaces/msg/Log": lambda: bags.make(
            "rcl_interfaces/msg/Log", bags.time(START), 20, "talker", "hello", "a.cpp", "f", 1
        ),
    }
    messages: list[Message] = [
        (topic, kind, 1_000_000 * number, made[kind]())
        for topic, (kind, count, _) in topics.items()
        for number in range(count)
    ]
    bag = bags.write(tmp_path / name, messages, Form(storage))
    profiles = {topic: many for topic, (_, _, many) in topics.items()}
    change(bag, lambda information: as_of_version(information, version, profiles))
    document = inspected(bag, capsys)
    assert {row["name"]: row["messages"] for row in document["topics"]} == {
        topic: count for topic, (_, count, _) in topics.items()
    }
    assert document["messages"] == sum(count for _, count, _ in topics.values())
    assert any(f"for {len(topics)} topics" in remark for remark in document["remarks"])


def lose_counts(information: dict[str, Any]) -> None:
    for each in information["topics_with_message_count"]:
        each["message_count"] = 0


EDITS: dict[str, Callable[[dict[str, Any]], object]] = {
    "no storage": lambda found: found.update(storage_identifier=""),
    "another storage": lambda found: found.update(storage_identifier="sqlite3_or_mcap"),
    "topic not listed": lambda found: without(found, "/gnss/fix"),
    "no topics": lambda found: found.update(topics_with_message_count=[]),
    "counts of zero": lose_counts,
    "other counts": lambda found: topic_of(found, "/gnss/fix").update(message_count=3),
    "QoS by hand": lambda found: topic_of(found, "/gnss/fix")["topic_metadata"].update(
        offered_qos_profiles=QOS_NUMBERS.format(history=1, depth=5)
    ),
    "nothing on services": lambda found: topic_of(found, "/gnss/fix")["topic_metadata"].pop("offered_qos_profiles"),
    "damaged QoS": lambda found: topic_of(found, "/gnss/fix")["topic_metadata"].update(offered_qos_profiles="["),
    "another hash": lambda found: topic_of(found, "/gnss/fix")["topic_metadata"].update(type_description_hash="x"),
    "a later version": lambda found: found.update(version=12),
    "file listed in a folder": lambda found: found.update(
        relative_file_paths=[f"bag/{found['relative_file_paths'][0]}"]
    ),
}


@pytest.mark.parametrize(("edit", "storage"), list(zip(EDITS, cycle(STORAGES))))
def test_data_count_and_not_what_is_stated(
    ingest: Ingest, tmp_path: Path, edit: str, storage: StoragePlugin
) -> None:
    flight = Flight(count=3)
    survey = ingest(change(bags.write(tmp_path / "bag", bags.usual(flight), Form(storage)), EDITS[edit]))
    check(survey, flight)
    if "QoS" in edit:
        assert remarked(survey, "bag-qos-differs", " 1 topics")
    elif edit not in ("another hash", "a later version", "file listed in a folder", "nothing on services"):
        assert remarked(survey, "bag-metadata-differs")
    if edit == "other counts":
        assert remarked(survey, "bag-metadata-differs", "/gnss/fix 3 for 35 messages")


def split(tmp_path: Path, flight: Flight) -> tuple[Path, int]:
    """Return a bag of two files, and how many messages the second one has."""
    messages = sorted(bags.usual(flight), key=lambda one: one[2])
    half = len(messages) // 2
    parts = [bags.write(tmp_path / "a", messages[:half]), bags.write(tmp_path / "b", messages[half:])]
    bags.join(tmp_path / "bag", parts)
    return tmp_path / "bag", len(messages) - half


@pytest.mark.parametrize("number", [0, 1])
def test_file_that_is_not_listed(ingest: Ingest, tmp_path: Path, number: int) -> None:
    flight = Flight(count=4)
    bag, _ = split(tmp_path, flight)
    change(bag, lambda found: found["relative_file_paths"].pop(number))
    survey = ingest(bag)
    check(survey, flight)
    assert remarked(survey, "bag-file-not-listed", f"bag_{number}.mcap")


def test_file_that_was_renamed(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight(count=4)
    bag = bags.write(tmp_path / "bag", bags.usual(flight))
    (file,) = bag.glob("*.mcap")
    file.rename(bag / "renamed.mcap")
    survey = ingest(bag)
    check(survey, flight)
    assert remarked(survey, "bag-file-missing", file.name) and remarked(survey, "bag-file-not-listed", "renamed")


def test_copy_in_the_folder_is_not_read_twice(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight(count=4)
    bag = bags.write(tmp_path / "bag", bags.usual(flight))
    (file,) = bag.glob("*.mcap")
    shutil.copyfile(file, bag / "copy.mcap")
    survey = ingest(bag)
    check(survey, flight)
    assert remarked(survey, "bag-file-is-copy", "copy.mcap")


def test_file_that_is_lost(refusal: Refusal, tmp_path: Path) -> None:
    bag, _ = split(tmp_path, Flight(count=4))
    (bag / "bag_1.mcap").unlink()
    error = refusal(bag)
    assert error["code"] == "bag-file-missing" and "bag_1.mcap" in error["message"]


LOST = ["/gnss/fix", "/imu/data", "/camera/image_raw/compressed", "/tf_static"]


@pytest.mark.parametrize(("topic", "storage"), list(zip(LOST, cycle(STORAGES))))
def test_counted_topic_that_no_file_has(
    refusal: Refusal, tmp_path: Path, capsys: pytest.CaptureFixture[str], topic: str, storage: StoragePlugin
) -> None:
    flight = Flight(count=3)
    whole = bags.usual(flight)
    bag = bags.write(tmp_path / "bag", [message for message in whole if message[0] != topic], Form(storage))
    kind = next(message[1] for message in whole if message[0] == topic)
    stated = {"name": topic, "type": kind, "serialization_format": "cdr", "offered_qos_profiles": []}
    change(
        bag,
        lambda found: found["topics_with_message_count"].append({"topic_metadata": stated, "message_count": 35}),
    )
    error = refusal(bag)
    assert (error["code"], error["field"]) == ("topic-not-read", topic) and "35 messages" in error["message"]
    document = inspected(bag, capsys)
    row = next(row for row in document["topics"] if row["name"] == topic)
    assert row["messages"] == 0 and "35" in row["problem"]
    assert any(topic in text and "35" in text for text in document["missing"])


def test_lost_topic_that_another_one_replaces(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight(count=3)
    bag = bags.write(tmp_path / "bag", bags.usual(flight))
    stated = {"name": "/other/fix", "type": "sensor_msgs/msg/NavSatFix", "serialization_format": "cdr"}
    change(
        bag,
        lambda found: found["topics_with_message_count"].append({"topic_metadata": stated, "message_count": 9}),
    )
    survey = ingest(bag, "--fix-topic", "/gnss/fix")
    check(survey, flight)
    assert remarked(survey, "topic-not-read", "9 messages of /other/fix")


@pytest.mark.parametrize("moved", [0, 10, 1000])
def test_messages_in_the_log_of_sqlite(ingest: Ingest, tmp_path: Path, moved: int) -> None:
    """A recorder that was killed leaves them: the last ones, or all and the tables too."""
    flight = Flight(count=4)
    bag = bags.write(tmp_path / "whole", bags.usual(flight), Form(StoragePlugin.SQLITE3))
    (file,) = bag.glob("*.db3")
    open_bag = tmp_path / "bag"
    open_bag.mkdir()
    with contextlib.closing(sqlite3.connect(file)) as whole:
        statements = list(whole.iterdump())
        rows = whole.execute("SELECT count(*) FROM messages").fetchone()[0]
    with contextlib.closing(sqlite3.connect(open_bag / file.name, isolation_level=None)) as base:
        base.execute("PRAGMA journal_mode=WAL")
        base.execute("PRAGMA wal_autocheckpoint=0")
        script = [text for text in statements if not text.startswith(("BEGIN", "COMMIT"))]
        inserts = [text for text in script if 'INTO "messages"' in text]
        for text in script:
            if text in inserts[moved : moved + 1]:
                base.execute("PRAGMA wal_checkpoint(FULL)")
            base.execute(text)
        copy = tmp_path / "killed"
        shutil.copytree(open_bag, copy)
    shutil.copyfile(bag / "metadata.yaml", copy / "metadata.yaml")
    for shared in copy.glob("*-shm"):
        shared.unlink()
    assert len(inserts) == rows > 100
    before = {each.name: each.read_bytes() for each in copy.iterdir()}
    survey = ingest(copy)
    check(survey, flight)
    assert remarked(survey, "bag-write-ahead-log", f"{file.name}-wal")
    assert {each.name: each.read_bytes() for each in copy.iterdir()} == before


@pytest.mark.skipif(sys.platform == "win32", reason="no such names")
@pytest.mark.parametrize("name", ["flight#2", "flight?a=b", "100%25 done"])
def test_folder_whose_name_has_a_meaning_in_addresses(ingest: Ingest, tmp_path: Path, name: str) -> None:
    flight = Flight(count=3)
    bag = bags.write(tmp_path / "bag", bags.usual(flight), Form(StoragePlugin.SQLITE3))
    check(ingest(bag.rename(tmp_path / name)), flight)


@pytest.mark.parametrize("storage", STORAGES)
def test_compression_that_metadata_does_not_state(ingest: Ingest, tmp_path: Path, storage: StoragePlugin) -> None:
    flight = Flight(count=3)
    bag = bags.write(tmp_path / "bag", bags.usual(flight), Form(storage, CompressionMode.MESSAGE))
    check(ingest(change(bag, lambda found: found.update(compression_mode="", compression_format=""))), flight)
    plain = bags.write(tmp_path / "plain", bags.usual(flight), Form(storage))
    stated = {"compression_mode": "MESSAGE", "compression_format": "zstd"}
    check(ingest(change(plain, lambda found: found.update(stated))), flight)


def test_compression_that_is_not_known(refusal: Refusal, tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "bag", bags.usual(Flight(count=3)))
    stated = {"compression_mode": "file", "compression_format": "lz4"}
    error = refusal(change(bag, lambda found: found.update(stated)))
    assert error["code"] == "bag-compression" and "lz4" in error["message"]


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def mcap(profile: str, encoding: str, schema: str, rows: list[tuple[str, str, str, int, bytes]]) -> bytes:
    """Return an mcap without chunks and index, of rows of topic, type, definition, time and bytes."""

    def record(operation: int, content: bytes) -> bytes:
        return struct.pack("<BQ", operation, len(content)) + content

    parts = [b"\x89MCAP0\r\n", record(1, text(profile) + text("test"))]
    known: dict[str, int] = {}
    for topic, kind, definition, ns, data in rows:
        if topic not in known:
            number = known[topic] = len(known) + 1
            parts.append(record(3, struct.pack("<H", number) + text(kind) + text(schema) + text(definition)))
            channel = struct.pack("<HH", number, number) + text(topic) + text(encoding) + struct.pack("<I", 0)
            parts.append(record(4, channel))
        parts.append(record(5, struct.pack("<HIQQ", known[topic], 0, ns, ns) + data))
    return b"".join([*parts, record(15, bytes(4)), record(2, bytes(20)), b"\x89MCAP0\r\n"])


def rows_of(flight: Flight, ros1: bool) -> list[tuple[str, str, str, int, bytes]]:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    rows = []
    for topic, kind, ns, message in sorted(bags.usual(flight), key=lambda one: one[2]):
        definition = store.generate_msgdef(kind, ros_version=1 if ros1 else 2)[0]
        if ros1:
            data = bytes(store.serialize_ros1(bags.as_ros1(message, store), kind))
        else:
            data = bytes(store.serialize_cdr(message, kind))
        rows.append((topic, kind.replace("/msg/", "/") if ros1 else kind, definition, int(ns), data))
    return rows


@pytest.mark.parametrize("profile", ["ros1", ""])
def test_mcap_of_ros1(ingest: Ingest, tmp_path: Path, capsys: pytest.CaptureFixture[str], profile: str) -> None:
    flight = Flight(count=4)
    (tmp_path / "flight.mcap").write_bytes(mcap(profile, "ros1", "ros1msg", rows_of(flight, True)))
    check(ingest(tmp_path / "flight.mcap"), flight)
    kinds = {row["name"]: row["type"] for row in inspected(tmp_path / "flight.mcap", capsys)["topics"]}
    assert kinds["/gnss/fix"] == "sensor_msgs/msg/NavSatFix"


@pytest.mark.parametrize("profile", ["", "ros2", "a profile of somebody"])
def test_mcap_of_any_profile(ingest: Ingest, tmp_path: Path, profile: str) -> None:
    """Libraries that convert and merge leave the profile out."""
    flight = Flight(count=4)
    (tmp_path / "flight.mcap").write_bytes(mcap(profile, "cdr", "ros2msg", rows_of(flight, False)))
    check(ingest(tmp_path / "flight.mcap"), flight)


CUT = [None, "", "rosbag2_bagfile_information:\n  version: 5\n  relative_fi", "{", "a: 1", "- 1", "[" * 50_000]


@pytest.mark.parametrize(
    ("text", "storage"),
    list(zip(CUT, cycle(STORAGES))),
    ids=["none", "empty", "cut", "open", "other", "list", "deep"],
)
def test_metadata_that_a_killed_recorder_leaves(
    ingest: Ingest, tmp_path: Path, storage: StoragePlugin, text: str | None
) -> None:
    flight = Flight(count=3)
    bag = bags.write(tmp_path / "bag", bags.usual(flight), Form(storage))
    if text is None:
        (bag / "metadata.yaml").unlink()
    else:
        (bag / "metadata.yaml").write_text(text)
    survey = ingest(bag)
    check(survey, flight)
    assert remarked(survey, "bag-metadata-missing" if text is None else "bag-metadata-damaged")
    assert not remarked(survey, "bag-file-not-listed")


@pytest.mark.parametrize("text", ["[" * 50_000, "- history: [", "3", "- 4"])
def test_damaged_quality_of_service_in_the_data(ingest: Ingest, tmp_path: Path, text: str) -> None:
    flight = Flight(count=3)
    bag = bags.write(tmp_path / "bag", bags.usual(flight), Form(StoragePlugin.SQLITE3))
    (file,) = bag.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file, isolation_level=None)) as base:
        base.execute("UPDATE topics SET offered_qos_profiles = ?", (text,))
    check(ingest(file), flight)
