"""Limits of a bag, checked before rosbags opens it.

rosbags trusts sizes: it allocates what a record claims, unpacks what a compressed block holds, and has all chunks
in memory that overlap in time.
"""

import mmap
import shutil
import struct
import sys
from collections.abc import Callable, Collection, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

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
    """Refuse a bag, file or folder, whose files are no regular files, or ask for more memory than any recorder's.

    Raises:
        InputError: names the file and its fault.
        ValueError: damaged records of an mcap.
    """
    files = [path]
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            file_size(path / "metadata.yaml", limit_bytes=_MAX_METADATA_BYTES, kind="metadata.yaml")
        files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3", ".zstd"))
    for file in files:
        check_file(file)


def check_file(file: Path) -> None:
    """Refuse a data file as `check_files` does."""
    size = file_size(file, field="--bag")
    with file.open("rb") as stream:
        is_mcap = stream.read(len(_MAGIC)) == _MAGIC or file.suffix == ".mcap"
    if is_mcap and size:
        _check_mcap(file)
    elif file.suffix == ".zstd":
        _check_unpacked(file, size)


def unpack_file(packed: Path, file: Path) -> None:
    """Write the content of a compressed file that `check_files` passed."""
    with _zstd().open(packed, "rb") as stream, file.open("wb") as out:
        shutil.copyfileobj(stream, out, _BLOCK_BYTES)


def refuse_large_chunk(path: Path, uncompressed_bytes: int) -> None:
    """Refuse a chunk that unpacks to more than 200 MiB, with its size and a command that rewrites the bag."""
    if uncompressed_bytes > MAX_CHUNK_BYTES:
        size = f"{uncompressed_bytes / 2**20:.0f} MiB; the limit is {MAX_CHUNK_BYTES // 2**20} MiB"
        remedy = "Rewrite it with smaller ones, e.g. `mcap compress --chunk-size 4194304`."
        raise InputError("chunk-too-large", f"The bag has a chunk of {size}.", path=path, remedy=remedy)


def unpacked(data: bytes, limit_bytes: int = MAX_CHUNK_BYTES) -> bytes:
    """Return the content of zstd frames; a ValueError: damaged, or more than `limit_bytes`."""
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
    from bz2 import BZ2Decompressor

    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import storage_mcap

    lz4, bz2 = partial(_unpacked_chunk, LZ4FrameDecompressor), partial(_unpacked_chunk, BZ2Decompressor)
    storage_mcap.DECOMPRESSORS.update({"lz4": lz4, "zstd": unpacked})
    rosbag1.decompressors.update({"lz4": lz4, "bz2": bz2})


class _Decompressor(Protocol):
    def decompress(self, data: bytes, max_length: int) -> bytes: ...


def _unpacked_chunk(
    decompressor: Callable[[], _Decompressor], data: bytes, limit_bytes: int = MAX_CHUNK_BYTES
) -> bytes:
    chunk: bytes = decompressor().decompress(data, max_length=limit_bytes + 1)
    if len(chunk) > limit_bytes:
        raise ValueError(f"a chunk unpacks to more than {limit_bytes / 2**20:.0f} MiB")
    return chunk


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
                message = f"The file is forged: it unpacks to more than {limit_bytes / 2**20:.0f} MiB."
                raise InputError("unpacks-too-large", message, path=file)


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
        size = f"{together / 2**20:.0f} MiB; the limit is {_MAX_TOGETHER_BYTES // 2**20} MiB"
        message = f"The chunks of one moment have {size}: sort the bag with `mcap sort`."
        raise InputError("chunks-overlap", message, path=file)


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
