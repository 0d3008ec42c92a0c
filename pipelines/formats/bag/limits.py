"""Limits of a bag, checked before rosbags opens it: sizes of records and chunks, and what they unpack to.

rosbags trusts sizes: it allocates what a record claims, unpacks what a compressed block holds, and has all chunks
in memory that overlap in time.
"""

from __future__ import annotations

import mmap
import struct
import sys
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from pipelines.core.errors import InputError
from pipelines.core.files import file_size

# A chunk is unpacked in one piece, with up to three copies in memory; ROS writes 0.8 to 4 MiB.
MAX_CHUNK_BYTES = 200 * 1024 * 1024
# Chunks of the same moment are in memory together. Recorders close one chunk before they begin the next.
_MAX_TOGETHER_BYTES = 256 * 1024 * 1024
_MAX_METADATA_BYTES = 16 * 1024 * 1024
# Recordings of sensors compress by a factor of 2 to 20.
_MOST_UNPACKED, _SMALL_BYTES = 100, 1024 * 1024 * 1024
_BLOCK_BYTES = 1024 * 1024
_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _CHUNK_INDEX, _HEAD_BYTES = 0x06, 0x08, 9


class _Chunk(NamedTuple):
    """Chunk of an mcap as its own header or the index states it."""

    start_ns: int
    end_ns: int
    compressed_bytes: int
    uncompressed_bytes: int


def check_files(path: Path) -> None:
    """Refuse a bag whose files are no regular files, or ask for more memory than any recorder's.

    Args:
        path: bag file, or folder of a rosbag2.

    Raises:
        InputError: names the file and its fault.
        ValueError: damaged records of an mcap.
    """
    files = [path]
    if path.is_dir():
        file_size(path / "metadata.yaml", limit_bytes=_MAX_METADATA_BYTES, kind="metadata.yaml")
        files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3", ".zstd"))
    for file in files:
        size = file_size(file, field="--bag")
        if file.suffix == ".mcap" and size:
            _check_mcap(file)
        elif file.suffix == ".zstd":
            _check_unpacked(file, size)


def refuse_large_chunk(path: Path, uncompressed_bytes: int) -> None:
    """Refuse a chunk that unpacks to more than 200 MiB.

    Raises:
        InputError: states the size and a command that rewrites the bag.
    """
    if uncompressed_bytes > MAX_CHUNK_BYTES:
        raise InputError(
            f"has a chunk of {uncompressed_bytes / 2**20:.0f} MiB (limit {MAX_CHUNK_BYTES // 2**20}): rewrite it "
            "with smaller ones, e.g. `mcap compress --chunk-size 4194304`",
            path=path,
        )


def unpacked(data: bytes, limit_bytes: int = MAX_CHUNK_BYTES) -> bytes:
    """Return the content of zstd frames.

    Raises:
        ValueError: damaged, or more than `limit_bytes`.
    """
    zstd, parts, total = _zstd(), [], 0
    while data:
        decompressor = zstd.ZstdDecompressor()
        parts.append(decompressor.decompress(data, max_length=limit_bytes + 1 - total))
        total += len(parts[-1])
        if total > limit_bytes:
            raise ValueError(f"unpacks to more than {limit_bytes / 2**20:.0f} MiB")
        if not decompressor.eof:
            raise ValueError("compressed data end too early")
        data = decompressor.unused_data
    return b"".join(parts)


@cache
def bound_decompressors() -> None:
    """Let rosbags unpack chunks of mcap and of ROS 1 up to the limit only."""
    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import storage_mcap

    def lz4(data: bytes, limit_bytes: int = MAX_CHUNK_BYTES) -> bytes:
        return _at_most(LZ4FrameDecompressor().decompress(data, max_length=limit_bytes + 1), limit_bytes)

    def bz2(data: bytes) -> bytes:
        from bz2 import BZ2Decompressor

        return _at_most(BZ2Decompressor().decompress(data, max_length=MAX_CHUNK_BYTES + 1), MAX_CHUNK_BYTES)

    storage_mcap.DECOMPRESSORS.update({"lz4": lz4, "zstd": unpacked})
    rosbag1.decompressors.update({"lz4": lz4, "bz2": bz2})


def _at_most(data: bytes, limit_bytes: int) -> bytes:
    if len(data) > limit_bytes:
        raise ValueError(f"a chunk unpacks to more than {limit_bytes / 2**20:.0f} MiB")
    return data


def _zstd() -> Any:
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


def _check_unpacked(file: Path, size: int) -> None:
    """Refuse a compressed file of a rosbag2 that fills the disk: rosbags unpacks it whole."""
    limit_bytes, total = max(_SMALL_BYTES, _MOST_UNPACKED * size), 0
    with _zstd().open(file, "rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            total += len(block)
            if total > limit_bytes:
                raise InputError(f"unpacks to more than {limit_bytes / 2**20:.0f} MiB: it is forged", path=file)


def _check_mcap(file: Path) -> None:
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        chunks: dict[int, _Chunk] = {}
        index: dict[int, _Chunk] = {}
        for operation, at, length in _records(data):
            if operation == _CHUNK:
                chunks[at - _HEAD_BYTES] = _stored_chunk(data, at, length)
            elif operation == _CHUNK_INDEX:
                offset, chunk = _indexed_chunk(data, at, length)
                if offset in index:
                    raise ValueError(f"the chunk at {offset} is in the index twice")
                index[offset] = chunk
    for chunk in chunks.values():
        refuse_large_chunk(file, chunk.uncompressed_bytes)
    wrong = next((offset for offset, chunk in index.items() if chunks.get(offset) != chunk), None)
    if wrong is not None:
        raise ValueError(f"the index does not agree with the chunk at {wrong}")
    together = _together(index.values())
    if together > _MAX_TOGETHER_BYTES:
        raise InputError(
            f"has chunks of the same moment of {together / 2**20:.0f} MiB in all (limit "
            f"{_MAX_TOGETHER_BYTES // 2**20}): sort it with `mcap sort`",
            path=file,
        )


def _records(data: mmap.mmap) -> Iterator[tuple[int, int, int]]:
    """Yield operation, place and length of the content of each record of an mcap."""
    end = len(data) - len(_MAGIC)
    if data[: len(_MAGIC)] != _MAGIC:
        raise ValueError("File magic is invalid")
    at = len(_MAGIC)
    while at < end:
        if at + _HEAD_BYTES > end:
            raise ValueError(f"truncated record at offset {at}")
        operation, length = struct.unpack_from("<BQ", data, at)
        at += _HEAD_BYTES
        if length > end - at:
            raise ValueError(f"the record at offset {at - _HEAD_BYTES} claims {length} bytes, {end - at} follow")
        yield operation, at, length
        at += length


def _stored_chunk(data: mmap.mmap, at: int, length: int) -> _Chunk:
    start_ns, end_ns, uncompressed, _, name = struct.unpack_from("<QQQII", data, at)
    (compressed,) = struct.unpack_from("<Q", data, at + 32 + name) if name < 64 else (2**64,)
    if 40 + name + compressed > length:
        raise ValueError(f"the chunk at offset {at - _HEAD_BYTES} is larger than its record")
    if not name and compressed != uncompressed:
        raise ValueError(f"the chunk at offset {at - _HEAD_BYTES} has another size than it states")
    return _Chunk(start_ns, end_ns, compressed, uncompressed)


def _indexed_chunk(data: mmap.mmap, at: int, length: int) -> tuple[int, _Chunk]:
    """Return the offset of a chunk and what the index states about it."""
    record = data[at : at + length]
    start_ns, end_ns, offset, _, channels = struct.unpack_from("<QQQQI", record)
    (name,) = struct.unpack_from("<I", record, 44 + channels)
    compressed, uncompressed = struct.unpack_from("<QQ", record, 48 + channels + name)
    return offset, _Chunk(start_ns, end_ns, compressed, uncompressed)


def _together(chunks: Collection[_Chunk]) -> int:
    """Return the greatest sum of bytes of chunks that overlap in time."""
    events = [(chunk.start_ns, 0, chunk.uncompressed_bytes) for chunk in chunks]
    events += [(chunk.end_ns, 1, -chunk.uncompressed_bytes) for chunk in chunks]
    total = greatest = 0
    for _, _, change in sorted(events):
        total += change
        greatest = max(greatest, total)
    return greatest
