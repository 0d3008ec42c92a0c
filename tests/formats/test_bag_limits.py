"""Bags that ask for more than they hold: refused before rosbags opens them."""

from __future__ import annotations

import contextlib
import os
import sqlite3
import struct
import sys
import tracemalloc
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from pipelines.core.errors import InputError
from pipelines.formats.bag import open_bag
from pipelines.formats.bag_limits import MAX_CHUNK_BYTES, unpacked
from tests import bags
from tests.refusals import refused

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b"\x89MCAP0\r\n"


def record(operation: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", operation, len(content) if length is None else length) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(start: int, end: int, uncompressed: int, data: bytes, compression: str = "zstd") -> bytes:
    head = struct.pack("<QQQI", start, end, uncompressed, 0)
    return record(6, head + text(compression) + struct.pack("<Q", len(data)) + data)


def indexed(start: int, end: int, offset: int, uncompressed: int, data: bytes, compression: str = "zstd") -> bytes:
    head = struct.pack("<QQQQI", start, end, offset, 0, 0) + struct.pack("<Q", 0)
    return record(8, head + text(compression) + struct.pack("<QQ", len(data), uncompressed))


def mcap(*chunks: tuple[int, int, int, bytes], index: list[bytes] | None = None) -> bytes:
    """A bag of chunks (start, end, uncompressed size, data), with an index of them or with `index`."""
    data = MAGIC + record(1, text("ros2") + text(""))
    listed = []
    for start, end, uncompressed, content in chunks:
        listed.append(indexed(start, end, len(data), uncompressed, content))
        data += chunk(start, end, uncompressed, content)
    data += record(15, bytes(4))
    summary = len(data)
    return (
        data + b"".join(listed if index is None else index) + record(2, struct.pack("<QQI", summary, 0, 0)) + MAGIC
    )


def refusal(path: Path, data: bytes) -> InputError:
    """The error of opening these bytes as a bag, which take no memory."""
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught, open_bag(path):
            pass
        assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
    finally:
        tracemalloc.stop()
    return caught.value


ZEROS = zstd.compress(bytes(100 * 2**20))


@pytest.mark.parametrize(
    ("data", "code", "words"),
    [
        (mcap((0, 1, MAX_CHUNK_BYTES + 1, b"x")), "chunk-too-large", "200 MiB"),
        (mcap((0, 1, 2**60, b"x")), "chunk-too-large", "1099511627776 MiB"),
        (mcap(*[(0, 9, 100 * 2**20, ZEROS)] * 60), "chunks-overlap", "6000 MiB"),
        (mcap((0, 1, 9, b"x"), index=[indexed(0, 1, 25, 2**40, b"x")]), "bag-damaged", "with the chunk at"),
        (mcap((0, 1, 9, b"x"), index=[indexed(0, 1, 7, 9, b"x")]), "bag-damaged", "with the chunk at 7"),
        (mcap((0, 1, 9, b"x"), index=[indexed(0, 1, 25, 9, b"x")] * 2), "bag-damaged", "in the index twice"),
        (MAGIC + record(1, b"", 2**50) + MAGIC, "bag-damaged", "1125899906842624 bytes, 0 follow"),
        (
            MAGIC + record(6, struct.pack("<QQQI", 0, 1, 9, 0) + text("") + b"\xff" * 8) + MAGIC,
            "bag-damaged",
            "larger than its",
        ),
        (MAGIC + record(6, bytes(28) + b"\xff" * 4 + bytes(8)) + MAGIC, "bag-damaged", "larger than its record"),
        (b"nothing", "bag-damaged", ""),
    ],
    ids=["chunk", "huge chunk", "overlap", "index", "offset", "twice", "record", "data", "name", "no mcap"],
)
def test_mcap_that_claims_too_much(tmp_path: Path, data: bytes, code: str, words: str) -> None:
    error = refusal(tmp_path / "a.mcap", data)
    assert error.code == code and words in error.message


def test_frames_unpack_up_to_the_limit() -> None:
    packed = zstd.compress(b"abc" * 1000)
    assert unpacked(packed + packed) == b"abc" * 2000
    assert unpacked(packed, 3000) == b"abc" * 1000
    with pytest.raises(ValueError, match="more than 0 MiB"):
        unpacked(packed + packed, 5999)
    with pytest.raises(ValueError, match="end too early"):
        unpacked(packed[:-3])


def test_chunk_that_unpacks_to_more_than_it_states(tmp_path: Path) -> None:
    """Its own size is small; the frame's is not. Without an index it is unpacked while the bag is opened."""
    data = mcap((0, 1, 9, ZEROS), index=[])
    assert refusal(tmp_path / "a.mcap", data).code == "bag-damaged"


def test_metadata_and_files_of_a_folder(tmp_path: Path) -> None:
    if sys.platform == "win32":
        pytest.skip("no pipes in folders")
    (tmp_path / "metadata.yaml").write_text("{}")
    os.mkfifo(tmp_path / "a.db3")
    with refused("not-a-file", InputError) as error, open_bag(tmp_path):
        pass
    assert (error.value.path, error.value.field) == (tmp_path / "a.db3", "--bag")
    assert "a named pipe" in error.value.message
    os.mkfifo(tmp_path / "b.bag")
    with refused("not-a-file", InputError), open_bag(tmp_path / "b.bag"):
        pass
    (tmp_path / "a.db3").unlink()
    with (tmp_path / "metadata.yaml").open("wb") as handle:
        handle.truncate(2**30)
    with refused("file-too-large", InputError) as error, open_bag(tmp_path):
        pass
    assert "1024 MiB" in error.value.message and "metadata.yaml" in error.value.message


@pytest.mark.parametrize("name", ["message_count: some", "message_count: 1.5"])
def test_metadata_with_a_count_that_is_none(tmp_path: Path, name: str) -> None:
    """YAML has any type in any place."""
    path = bags.write(tmp_path / "bag", bags.imu(bags.Flight(count=1))[:3])
    text = (path / "metadata.yaml").read_text()
    at = text.index("topic_metadata")
    changed = text[:at].replace("message_count: 3", name) if "- message_count: 3" in text[:at] else text
    changed = text.replace("- message_count: 3", f"- {name}") if changed == text else changed + text[at:]
    (path / "metadata.yaml").write_text(changed)
    with refused("bag-damaged", InputError), open_bag(path):
        pass


def test_sqlite_with_a_number_in_place_of_bytes(tmp_path: Path) -> None:
    """`bytes(10**12)` would be a terabyte of zeros."""
    path = bags.write(tmp_path / "bag", bags.imu(bags.Flight(count=1))[:3], bags.Form(StoragePlugin.SQLITE3))
    (file,) = path.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as base:
        base.execute("UPDATE messages SET data = 1000000000000 WHERE id = 2")
        base.commit()
    with open_bag(file) as bag:
        assert len(list(bag.messages(bag.topics))) == 1
        assert bag.damage is not None and "is no bytes" in bag.damage
    with contextlib.closing(sqlite3.connect(file)) as base:
        base.execute("UPDATE topics SET name = x'00ff'")
        base.commit()
    with refused("bag-damaged", InputError), open_bag(file):
        pass
