"""`georef ingest --bag` on every form in which a bag can be stored."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipelines.formats.px4_messages import DEFINITIONS
from tests import bags
from tests.bags import Flight, Form
from tests.ingested_bags import Ingest, Refusal, check, remarked
from tests.px4_bags import px4

FORMS = {
    "mcap": Form(),
    "sqlite3": Form(StoragePlugin.SQLITE3),
    "mcap, zstd by message": Form(compression=CompressionMode.MESSAGE),
    "sqlite3, zstd by message": Form(StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "sqlite3, zstd by file": Form(StoragePlugin.SQLITE3, CompressionMode.FILE),
    "mcap, zstd by file": Form(compression=CompressionMode.FILE),
    "mcap, storage compression": Form(compression=CompressionMode.STORAGE),
}


RULE = "=" * 80 + "\n"
# As a ROS 2 recorder writes a message that is defined in IDL, with all that it is made of.
FIX_IDL = f"""{RULE}IDL: sensor_msgs/msg/NavSatFix
#include "sensor_msgs/msg/NavSatStatus.idl"
#include "std_msgs/msg/Header.idl"
module sensor_msgs {{ module msg {{
  typedef double double__9[9];
  module NavSatFix_Constants {{ const uint8 COVARIANCE_TYPE_UNKNOWN = 0; }};
  @verbatim (language="comment", text="Navigation Satellite fix")
  struct NavSatFix {{
    std_msgs::msg::Header header;
    sensor_msgs::msg::NavSatStatus status;
    @unit (value="degrees")
    double latitude;
    double longitude;
    double altitude;
    double__9 position_covariance;
    uint8 position_covariance_type;
  }};
}}; }};
{RULE}IDL: sensor_msgs/msg/NavSatStatus
module sensor_msgs {{ module msg {{
  struct NavSatStatus {{ int8 status; uint16 service; }};
}}; }};
{RULE}IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs {{ module msg {{
  struct Header {{ builtin_interfaces::msg::Time stamp; string frame_id; }};
}}; }};
{RULE}IDL: builtin_interfaces/msg/Time
module builtin_interfaces {{ module msg {{
  struct Time {{ int32 sec; uint32 nanosec; }};
}}; }};
"""


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_definition_in_idl(ingest: Ingest, tmp_path: Path, storage: StoragePlugin) -> None:
    flight = Flight(count=4)
    form = Form(storage, definitions={"sensor_msgs/msg/NavSatFix": FIX_IDL})
    path = bags.write(tmp_path / "bag", bags.usual(flight), form)
    (file,) = [one for one in path.iterdir() if one.suffix in (".mcap", ".db3")]
    assert b"ros2idl" in file.read_bytes()
    check(ingest(path), flight)


def test_humble(ingest: Ingest, tmp_path: Path) -> None:
    """ROS 2 Humble's sqlite3 has no table of definitions at all."""
    flight = Flight(count=4)
    path = bags.write(tmp_path / "bag", bags.usual(flight), Form(StoragePlugin.SQLITE3))
    (file,) = path.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as base:
        base.executescript(
            "DROP TABLE message_definitions; DROP TABLE schema; DROP TABLE metadata;"
            "ALTER TABLE topics DROP COLUMN type_description_hash;"
        )
    survey = ingest(path)
    check(survey, flight)
    assert remarked(survey, "message-definitions")


@pytest.mark.parametrize("form", FORMS)
def test_storage(ingest: Ingest, tmp_path: Path, form: str) -> None:
    flight = Flight(count=4)
    check(ingest(bags.write(tmp_path / "bag", bags.usual(flight), FORMS[form])), flight)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_bare_file(ingest: Ingest, tmp_path: Path, storage: StoragePlugin) -> None:
    flight = Flight(count=4)
    bags.write(tmp_path / "bag", bags.usual(flight), Form(storage))
    (file,) = [path for path in (tmp_path / "bag").iterdir() if path.suffix in (".mcap", ".db3")]
    check(ingest(file), flight)


def test_split_bag(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight()
    messages = sorted(bags.usual(flight), key=lambda one: one[2])
    half = len(messages) // 2
    bags.join(
        tmp_path / "bag",
        [bags.write(tmp_path / "a", messages[:half]), bags.write(tmp_path / "b", messages[half:])],
    )
    check(ingest(tmp_path / "bag"), flight)


@pytest.mark.parametrize("without", [0, 1])
def test_split_bag_with_definitions_in_one_file_only(ingest: Ingest, tmp_path: Path, without: int) -> None:
    flight = Flight()
    gps, turns = px4(flight, "SensorGps"), px4(flight, "VehicleAttitude")
    messages = sorted([bags.transforms(flight), *gps, *turns, *bags.images(flight)], key=lambda one: one[2])
    # As a later file of a recorder that wrote its definitions once: those of a layout that nobody could guess.
    kind = "px4_msgs/msg/SensorGps"
    store = get_typestore(Stores.EMPTY)
    text = DEFINITIONS[kind]["1.15"].replace("uint32 device_id", "uint32 device_id\nuint64 more")
    store.register(get_types_from_msg(text, kind))
    for i, (topic, name, ns, message) in enumerate(messages):
        if name == kind:
            values = [getattr(message, field, 0) for field, _ in store.fielddefs[kind][1]]
            messages[i] = (topic, name, ns, bytes(store.serialize_cdr(store.types[kind](*values), kind)))
    half = len(messages) // 2
    parts = []
    for number, some in enumerate((messages[:half], messages[half:])):
        form = Form(definitions={kind: "" if number == without else text})
        parts.append(bags.write(tmp_path / f"part{number}", some, form))
    bags.join(tmp_path / "bag", parts)
    check(ingest(tmp_path / "bag", "--lever-arm", "0.1,-0.2,-0.3"), flight)


def test_ros1_bag(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight(count=4)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    with Writer1(tmp_path / "flight.bag") as writer:
        links: dict[str, Any] = {}
        for topic, kind, ns, message in sorted(bags.usual(flight), key=lambda one: one[2]):
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(links[topic], int(ns), store.serialize_ros1(bags.as_ros1(message, store), kind))
    check(ingest(tmp_path / "flight.bag"), flight)


def test_topic_that_is_not_of_ros(refusal: Refusal, tmp_path: Path) -> None:
    """Foxglove's recorders put JSON beside ROS messages into one mcap."""
    path = bags.write(tmp_path / "bag", bags.with_unknown(Flight()))
    (file,) = path.glob("*.mcap")
    data = file.read_bytes()
    name, length = b"nobody_msgs/msg/Thing", (7).to_bytes(4, "little")
    assert data.count(name + length + b"ros2msg") == 2  # in the chunk and in the summary
    # Of the same length, so that no offset moves.
    file.write_bytes(data.replace(name + length + b"ros2msg", name + length + b"ros1msg"))
    assert "'ros1msg'" in refusal(file)["message"]
