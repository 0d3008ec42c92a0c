"""SPZ: compressed Gaussians, as Niantic's library, CesiumJS, Spark and PlayCanvas exchange them.

A file has a header and six sections of bytes: positions, opacities, colours, scales, rotations, harmonics. Versions
2 and 3 are one gzip stream. Version 4 is a plain header of 32 bytes, a table of sizes, and a zstd stream for each
section. Version 2, which is only read, has another form of the rotations. The layout is that of
github.com/nianticlabs/spz (`load-spz.cc`). The quantisation is in `spz_sections`.

Readers of SPZ take its axes for right, up, back (x right, y up, z towards the viewer). The codec turns nothing.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.durable import replace_file
from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.core.types import ByteArray
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz_sections import SpzLayout, dequantised, quantised

SpzVersion = Literal[3, 4]

FRACTIONAL_BITS = 12
_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved or streams
_HEADER4_BYTES = 32
_TABLE_ROW = struct.Struct("<QQ")  # compressed bytes, bytes
_HAS_EXTENSIONS = 0x2
_POSITION_LIMIT = 1 << 23
_GZIP_LEVEL, _ZSTD_LEVEL = 6, 12
# Real splats compress by a factor of two or three; more is a forgery, or a small file.
_MOST_UNPACKED, _SMALL_BYTES = 16, 16 * 1024 * 1024


def write_spz(path: Path, splat: SplatArrays, version: SpzVersion = 3) -> None:
    """Write Gaussians; the file appears whole or not at all.

    Raises:
        InputError: as `encode_spz`.
        OSError: the file cannot be written.
    """
    data = encode_spz(splat, version)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".tmp")
    draft.write_bytes(data)
    replace_file(draft, path)


def read_spz(path: Path) -> SplatArrays:
    """Read Gaussians of version 2, 3 or 4.

    Raises:
        InputError: no such file, not an SPZ file of that form, cut off, with extensions, or a file that would
            unpack to more than sixteen times its size (and 16 MiB).
    """
    file_size(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    return decode_spz(data, path)


def encode_spz(splat: SplatArrays, version: SpzVersion = 3, fractional_bits: int = FRACTIONAL_BITS) -> bytes:
    """Return the bytes of an SPZ file.

    Opacities, colours, scales and harmonics beyond the format's range are clamped to it.

    Args:
        splat: N ≥ 1 Gaussians of degree 0 to 3.
        version: 3 or 4.
        fractional_bits: positions have steps of 2^−bits m and lie within ±2^(23 − bits) m.

    Raises:
        InputError: values that are not finite, a rotation of length zero, or positions out of range.
        ValueError: shapes do not agree, or no Gaussians.
    """
    degree = _degree(splat)
    _check(splat, fractional_bits)
    layout = SpzLayout(version, len(splat), degree, fractional_bits)
    sections = quantised(splat, layout)
    if version == 3:
        head = _HEADER.pack(_MAGIC, 3, layout.count, degree, fractional_bits, 0, 0)
        stream = zlib.compressobj(_GZIP_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        parts = [stream.compress(head), *(stream.compress(section.data) for section in sections), stream.flush()]
        return b"".join(parts)
    import zstandard

    packed = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(section.data) for section in sections]
    head = _HEADER.pack(_MAGIC, 4, layout.count, degree, fractional_bits, 0, len(packed))
    head += struct.pack("<I12x", _HEADER4_BYTES)
    table = [_TABLE_ROW.pack(len(part), section.size) for part, section in zip(packed, sections, strict=True)]
    return b"".join((head, *table, *packed))


def decode_spz(data: bytes, path: Path | None = None) -> SplatArrays:
    """Return the Gaussians in the bytes of an SPZ file.

    Args:
        data: the file.
        path: of the file, for errors.

    Raises:
        InputError: as `read_spz`.
    """
    limit_bytes = max(_SMALL_BYTES, _MOST_UNPACKED * len(data))
    try:
        if data[:2] == b"\x1f\x8b":
            layout, body = _unpacked_gzip(data, limit_bytes)
        else:
            layout, body = _unpacked_zstd(data, limit_bytes)
    except ValueError as error:
        raise InputError(str(error), path=path) from error
    return dequantised(layout, body)


def _degree(splat: SplatArrays) -> int:
    count, coefficients = len(splat), splat.sh.shape[1]
    if coefficients not in (1, 4, 9, 16) or splat.sh.shape != (count, coefficients, 3):
        raise ValueError(f"expected spherical harmonics (N, 1 | 4 | 9 | 16, 3), got {splat.sh.shape}")
    if count == 0:
        raise ValueError("an SPZ file has at least one Gaussian")
    return int(np.sqrt(coefficients)) - 1


def _check(splat: SplatArrays, fractional_bits: int) -> None:
    for name, values in vars(splat).items():
        if not np.isfinite(values).all():
            raise InputError("Gaussians with values that are not finite cannot be written as SPZ", field=name)
    if not splat.quats_wxyz.any(axis=1).all():
        raise InputError("a rotation of length zero cannot be written as SPZ", field="quats_wxyz")
    furthest = float(np.abs(splat.means).max())
    reach = _POSITION_LIMIT / 2.0**fractional_bits
    # The rounded positive end of the range would be the negative one.
    if furthest >= reach - 0.5 / 2.0**fractional_bits:
        outside = int((np.abs(splat.means).max(axis=1) >= reach).sum())
        raise InputError(
            f"SPZ holds positions within ±{reach:.0f} m, and {max(outside, 1)} of {len(splat)} Gaussians lie "
            f"beyond, up to {furthest:.0f} m from the origin",
            field="means",
        )


def _unpacked_gzip(data: bytes, limit_bytes: int) -> tuple[SpzLayout, ByteArray]:
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        head = stream.decompress(data, _HEADER.size)
        layout = _layout(head, versions=(2, 3), limit_bytes=limit_bytes)
        # One byte more than promised tells a longer stream from a whole one.
        body = stream.decompress(stream.unconsumed_tail, layout.body_bytes + 1)
    except zlib.error as error:
        raise ValueError(f"damaged SPZ file: {error}") from error
    if len(body) != layout.body_bytes or not stream.eof:
        raise ValueError(
            f"the header promises {layout.count} Gaussians in {layout.body_bytes} bytes, the file holds "
            f"{'more' if len(body) > layout.body_bytes else 'fewer'}: it is cut off or damaged"
        )
    return layout, np.frombuffer(body, np.uint8)


def _unpacked_zstd(data: bytes, limit_bytes: int) -> tuple[SpzLayout, ByteArray]:
    import zstandard

    layout = _layout(data[: _HEADER.size], versions=(4,), limit_bytes=limit_bytes)
    streams = data[_HEADER.size - 1]
    if streams != len(layout.widths) or len(data) < _HEADER4_BYTES:
        raise ValueError(f"{streams} streams where a degree of {layout.degree} has {len(layout.widths)}")
    (table,) = struct.unpack_from("<I", data, _HEADER.size)
    place = table + streams * _TABLE_ROW.size
    if table < _HEADER4_BYTES or place > len(data):
        raise ValueError("damaged SPZ file: its table lies outside the file")
    parts = []
    for index, width in enumerate(layout.widths):
        packed, size = _TABLE_ROW.unpack_from(data, table + index * _TABLE_ROW.size)
        if size != width * layout.count or packed > len(data) - place:
            raise ValueError(f"stream {index} has another size than the header promises: cut off or damaged")
        try:
            with zstandard.ZstdDecompressor().stream_reader(data[place : place + packed]) as reader:
                part = reader.read(size + 1)
        except zstandard.ZstdError as error:
            raise ValueError(f"damaged SPZ file: {error}") from error
        if len(part) != size:
            raise ValueError(f"stream {index} unpacks to another size than promised: cut off or damaged")
        parts.append(part)
        place += packed
    return layout, np.frombuffer(b"".join(parts), np.uint8)


def _layout(head: bytes, versions: tuple[int, ...], limit_bytes: int) -> SpzLayout:
    if len(head) < _HEADER.size or head[:4] != struct.pack("<I", _MAGIC):
        raise ValueError("not an SPZ file")
    _, version, count, degree, fractional_bits, flags, _ = _HEADER.unpack(head)
    if version not in versions:
        raise ValueError(f"SPZ version {version} is not read: versions 2, 3 and 4 are")
    if degree > 3 or not 1 <= fractional_bits <= 23 or count == 0:
        raise ValueError(
            f"{count} Gaussians of degree {degree} with {fractional_bits} fractional bits: expected at least one "
            "Gaussian, degree 0 to 3 and 1 to 23 bits"
        )
    if flags & _HAS_EXTENSIONS:
        raise ValueError("SPZ files with extensions are not read")
    layout = SpzLayout(version, count, degree, fractional_bits)
    if layout.body_bytes > limit_bytes:
        raise ValueError(
            f"the header promises {layout.body_bytes / 2**20:.0f} MiB, and {limit_bytes / 2**20:.0f} MiB are the "
            "limit for a file of this size"
        )
    return layout
