"""SPZ: compressed Gaussians, as Niantic's library, CesiumJS, Spark and PlayCanvas exchange them.

A file has a header and six sections of bytes: positions, opacities, colours, scales, rotations, harmonics. Versions
2 and 3 are one gzip stream. Version 4 is a plain header of 32 bytes, a table of sizes, and a zstd stream for each
section. Version 2, which is only read, has another form of the rotations. The layout is that of
github.com/nianticlabs/spz (`load-spz.cc`).

Readers of SPZ take its axes for right, up, back (x right, y up, z towards the viewer). The codec turns nothing.

| value | step | range |
|---|---|---|
| position | 2⁻¹² m (`fractional_bits`) | ±2048 m; beyond it, other writers wrap without a word |
| opacity | 1/255 | 0 … 1 |
| constant harmonic | 1/38.25 | ±3.33 |
| logarithm of the scale | 1/16 | −10 … 5.94 |
| rotation | quaternion, smallest three components with 9 bits and a sign each | |
| harmonics of degree 1 | 1/16 | −1 … 1 |
| harmonics of degree 2 and 3 | 1/8 | −1 … 1 |
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.files import replacing
from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz_extensions import (
    MOST_BYTES,
    SpzGeoreference,
    encode_georeference,
    georeference_in,
    require_known_axes,
)

SpzVersion = Literal[3, 4]

FRACTIONAL_BITS = 12
_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, degree, fractional bits, flags, reserved or streams
_HEADER4_BYTES = 32
_TABLE_ROW = struct.Struct("<QQ")  # compressed bytes, bytes
_ANTIALIASED = 1
_HAS_EXTENSIONS = 0x2
_POSITION_LIMIT = 1 << 23
_GZIP_LEVEL, _ZSTD_LEVEL = 6, 12
# Real splats compress by a factor of two or three; more is a forgery, or a small file.
_MOST_UNPACKED, _SMALL_BYTES = 16, 16 * 1024 * 1024
_COLOUR_STEPS = 0.15 * 255
_LARGEST_COMPONENT = 511 / np.sqrt(0.5)  # of the components that are not the largest, √½ is the bound
_CHUNK = 1 << 18  # Gaussians that are converted at once: bounds the memory of the intermediate values


@dataclass(frozen=True)
class _Layout:
    """Sizes of the sections, as the header states them."""

    version: int
    count: int
    degree: int
    fractional_bits: int
    has_extensions: bool = False

    @property
    def higher(self) -> int:
        """Number of harmonics above the constant one."""
        return (self.degree + 1) ** 2 - 1

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes a Gaussian of the sections that are not empty."""
        rotation = 3 if self.version == 2 else 4
        return tuple(width for width in (9, 1, 3, 3, rotation, 3 * self.higher) if width)

    @property
    def body_bytes(self) -> int:
        return self.count * sum(self.widths)


def write_spz(
    path: Path,
    splat: SplatArrays,
    version: SpzVersion = 3,
    georeference: SpzGeoreference | None = None,
    *,
    mip_filter: bool = False,
) -> None:
    """Write Gaussians; the file appears whole or not at all; arguments and errors as of `encode_spz`."""
    data = encode_spz(splat, version, georeference=georeference, mip_filter=mip_filter)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        draft.write_bytes(data)


def encode_spz(
    splat: SplatArrays,
    version: SpzVersion = 3,
    fractional_bits: int = FRACTIONAL_BITS,
    *,
    georeference: SpzGeoreference | None = None,
    mip_filter: bool = False,
) -> bytes:
    """Return the bytes of an SPZ file, whose Gaussians need the mip filter or not.

    Version 4 can hold a georeference (`spz_extensions`), which is not part of the format yet.

    Opacities, colours, scales and harmonics beyond the format's range are clamped to it. Positions have steps of
    2^−bits m and lie within ±2^(23 − bits) m.

    Raises:
        InputError: values that are not finite, a rotation of length zero, or positions out of range.
        ValueError: shapes do not agree, no Gaussians, or a georeference in version 3.
    """
    if georeference is not None and version != 4:
        raise ValueError("only version 4 holds a georeference")
    count, coefficients = len(splat.means), splat.sh.shape[1]
    if coefficients not in (1, 4, 9, 16) or splat.sh.shape != (count, coefficients, 3):
        raise ValueError(f"expected spherical harmonics (N, 1 | 4 | 9 | 16, 3), got {splat.sh.shape}")
    if count == 0:
        raise ValueError("an SPZ file has at least one Gaussian")
    _check_values(splat, fractional_bits)
    degree = int(np.sqrt(coefficients)) - 1
    layout = _Layout(version, count, degree, fractional_bits)
    sections, flags = _quantised(splat, layout), _ANTIALIASED if mip_filter else 0
    if version == 3:
        head = _HEADER.pack(_MAGIC, 3, layout.count, degree, fractional_bits, flags, 0)
        stream = zlib.compressobj(_GZIP_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        parts = [stream.compress(head), *(stream.compress(section.data) for section in sections), stream.flush()]
        return b"".join(parts)
    import zstandard

    packed = [zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(section.data) for section in sections]
    extensions = b"" if georeference is None else encode_georeference(georeference)
    if extensions:
        flags |= _HAS_EXTENSIONS
    head = _HEADER.pack(_MAGIC, 4, layout.count, degree, fractional_bits, flags, len(packed))
    head += struct.pack("<I12x", _HEADER4_BYTES + len(extensions)) + extensions
    table = [_TABLE_ROW.pack(len(part), section.size) for part, section in zip(packed, sections, strict=True)]
    return b"".join((head, *table, *packed))


def encode_wide_spz(splat: SplatArrays, *, mip_filter: bool = False) -> bytes:
    """Return an SPZ file of version 3 of a scene of any extent; errors else as of `encode_spz`.

    A scene that reaches further than ±2048 m gets coarser steps of position: 0.49 mm up to ±4096 m, and so on.
    """
    furthest, reach = float(np.abs(splat.means).max()), _POSITION_LIMIT / 2.0**FRACTIONAL_BITS
    coarser = max(0, math.ceil(math.log2((furthest + 1) / reach))) if math.isfinite(furthest) else 0
    return encode_spz(splat, 3, FRACTIONAL_BITS - coarser, mip_filter=mip_filter)


def decode_spz(data: bytes, path: Path | None = None) -> SplatArrays:
    """Return the Gaussians in the bytes of an SPZ file of version 2, 3 or 4.

    Raises:
        InputError: not an SPZ file of that form, cut off, with other axes than right, up, back, or one that would
            unpack to more than sixteen times its size (and 16 MiB); names the path.

    Examples:
        >>> shapes = (1, 3), (1, 4), (1, 3), (1,), (1, 1, 3)  # mean, rotation, ln σ, logit of opacity, harmonics
        >>> splat = SplatArrays(*(np.ones(shape, np.float32) for shape in shapes))
        >>> decode_spz(encode_spz(splat)).means.tolist()
        [[1.0, 1.0, 1.0]]
    """
    layout, body, _ = _unpacked(data, path)
    return _dequantised(layout, body)


def spz_georeference(data: bytes, path: Path | None = None) -> SpzGeoreference | None:
    """Return the georeference that an SPZ file holds; None: none. Errors as of `decode_spz`, or it is damaged."""
    return georeference_in(_unpacked(data, path)[2], path)


def _unpacked(data: bytes, path: Path | None) -> tuple[_Layout, ByteArray, bytes]:
    """Return what the header states, the sections one after the other, and the extensions."""
    limit_bytes = max(_SMALL_BYTES, _MOST_UNPACKED * len(data))
    unpacked = _unpacked_gzip if data[:2] == b"\x1f\x8b" else _unpacked_zstd
    layout, body, extensions = unpacked(data, limit_bytes, path)
    if layout.has_extensions:
        require_known_axes(extensions, path)
    return layout, body, extensions


def _check_values(splat: SplatArrays, fractional_bits: int) -> None:
    for name, values in vars(splat).items():
        if not np.isfinite(values).all():
            message = "Gaussians with values that are not finite cannot be written as SPZ."
            raise InputError("values-not-finite", message, field=name)
    if not splat.quats_wxyz.any(axis=1).all():
        message = "A rotation of length zero cannot be written as SPZ."
        raise InputError("quaternion-length", message, field="quats_wxyz")
    furthest = float(np.abs(splat.means).max())
    reach = _POSITION_LIMIT / 2.0**fractional_bits
    # The rounded positive end of the range would be the negative one.
    if furthest >= reach - 0.5 / 2.0**fractional_bits:
        outside = int((np.abs(splat.means).max(axis=1) >= reach).sum())
        message = (
            f"SPZ holds positions within ±{reach:.0f} m; {max(outside, 1)} of {len(splat)} Gaussians are farther, "
            f"up to {furthest:.0f} m from the origin."
        )
        raise InputError("spz-range", message, field="means")


def _unpacked_gzip(data: bytes, limit_bytes: int, path: Path | None) -> tuple[_Layout, ByteArray, bytes]:
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        head = stream.decompress(data, _HEADER.size)
        layout = _stated_layout(head, (2, 3), limit_bytes, path)
        # One byte more than promised tells a longer stream from a whole one.
        behind = MOST_BYTES if layout.has_extensions else 0
        body = stream.decompress(stream.unconsumed_tail, layout.body_bytes + behind + 1)
    except zlib.error as error:
        raise _damage(f"{error}", path) from error
    if not layout.body_bytes <= len(body) <= layout.body_bytes + behind or not stream.eof:
        held = "more" if len(body) > layout.body_bytes else "fewer"
        message = (
            f"The header promises {layout.count} Gaussians in {layout.body_bytes} bytes, the file holds {held}."
        )
        raise InputError("size-differs", f"{message} It is cut off or damaged.", path=path)
    extensions = body[layout.body_bytes :]
    return layout, np.frombuffer(body, np.uint8, layout.body_bytes), extensions


def _unpacked_zstd(data: bytes, limit_bytes: int, path: Path | None) -> tuple[_Layout, ByteArray, bytes]:
    import zstandard

    layout = _stated_layout(data[: _HEADER.size], (4,), limit_bytes, path)
    streams = data[_HEADER.size - 1]
    if streams != len(layout.widths) or len(data) < _HEADER4_BYTES:
        raise _damage(f"{streams} streams instead of the {len(layout.widths)} of degree {layout.degree}", path)
    (table,) = struct.unpack_from("<I", data, _HEADER.size)
    offset = table + streams * _TABLE_ROW.size
    if table < _HEADER4_BYTES or offset > len(data):
        raise _damage("its table lies outside the file", path)
    parts = []
    for index, width in enumerate(layout.widths):
        packed, size = _TABLE_ROW.unpack_from(data, table + index * _TABLE_ROW.size)
        if size != width * layout.count or packed > len(data) - offset:
            message = f"Stream {index} has another size than the header promises: the file is cut off or damaged."
            raise InputError("size-differs", message, path=path)
        try:
            with zstandard.ZstdDecompressor().stream_reader(data[offset : offset + packed]) as reader:
                part = reader.read(size + 1)
        except zstandard.ZstdError as error:
            raise _damage(f"{error}", path) from error
        if len(part) != size:
            message = f"Stream {index} unpacks to another size than the header promises: the file is damaged."
            raise InputError("unpacked-size-differs", message, path=path)
        parts.append(part)
        offset += packed
    extensions = data[_HEADER4_BYTES:table] if layout.has_extensions else b""
    return layout, np.frombuffer(b"".join(parts), np.uint8), extensions


def _damage(reason: str, path: Path | None) -> InputError:
    return InputError("file-damaged", f"The SPZ file is damaged: {reason}", path=path)


def _stated_layout(head: bytes, versions: tuple[int, ...], limit_bytes: int, path: Path | None) -> _Layout:
    if len(head) < _HEADER.size or head[:4] != struct.pack("<I", _MAGIC):
        raise InputError("not-an-spz", "The file is not an SPZ file.", path=path)
    _, version, count, degree, fractional_bits, flags, _ = _HEADER.unpack(head)
    if version not in versions:
        message = f"The SPZ version is {version}; versions 2, 3 and 4 are supported."
        raise InputError("spz-version", message, path=path)
    if degree > 3 or not 1 <= fractional_bits <= 23 or count == 0:
        message = (
            f"The header states {count} Gaussians of degree {degree} with {fractional_bits} fractional bits, "
            "expected at least one Gaussian, degree 0 to 3 and 1 to 23 bits."
        )
        raise InputError("spz-header", message, path=path)
    layout = _Layout(version, count, degree, fractional_bits, bool(flags & _HAS_EXTENSIONS))
    if layout.body_bytes > limit_bytes:
        size, limit = layout.body_bytes / 2**20, limit_bytes / 2**20
        message = f"The header promises {size:.0f} MiB; the limit for a file of this size is {limit:.0f} MiB."
        raise InputError("unpacks-too-large", message, path=path)
    return layout


def _quantised(splat: SplatArrays, layout: _Layout) -> list[ByteArray]:
    """Return the sections (N · width,) that are not empty, of values that are finite and positions in range."""
    sections = [np.empty((layout.count, width), np.uint8) for width in layout.widths]
    for rows in _chunks(layout.count):
        fixed = np.rint(splat.means[rows].astype(np.float64) * 2.0**layout.fractional_bits).astype("<i4")
        sections[0][rows] = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].reshape(-1, 9)
        opacity = 0.5 + 0.5 * np.tanh(0.5 * splat.logit_opacities[rows, None].astype(np.float64))
        sections[1][rows] = _bytes(255 * opacity)
        sections[2][rows] = _bytes(_COLOUR_STEPS * splat.sh[rows, 0].astype(np.float64) + 127.5)
        sections[3][rows] = _bytes(16 * (splat.log_scales[rows].astype(np.float64) + 10))
        sections[4][rows] = _packed_rotations(splat.quats_wxyz[rows]).view(np.uint8).reshape(-1, 4)
        if layout.higher:
            sections[5][rows] = _coarse_harmonics(splat.sh[rows, 1:]).reshape(-1, 3 * layout.higher)
    return [section.reshape(-1) for section in sections]


def _chunks(count: int) -> Iterator[slice]:
    return (slice(first, min(first + _CHUNK, count)) for first in range(0, count, _CHUNK))


def _bytes(values: FloatArray) -> ByteArray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _coarse_harmonics(higher: Float32Array) -> ByteArray:
    """Return harmonics (N, K − 1, 3) as bytes of which the lowest 3 or 4 bits are zero: they compress well."""
    step = np.full((higher.shape[1], 1), 16)
    step[:3] = 8
    exact = 128 * np.clip(higher, -2, 2) + 128
    coarse: ByteArray = np.clip(np.floor(exact / step + 0.5) * step, 0, 255).astype(np.uint8)
    return coarse


def _packed_rotations(quats_wxyz: Float32Array) -> NDArray[np.uint32]:
    """Return quaternions (N, 4) as words: index of the largest component of xyzw, then the others from x on."""
    xyzw = np.roll(quats_wxyz.astype(np.float64), -1, axis=1)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1.0, 1.0)
    words = largest.astype(np.uint32)
    for axis in range(4):
        size = np.minimum(np.rint(_LARGEST_COMPONENT * np.abs(xyzw[:, axis])), 511).astype(np.uint32)
        signed = (xyzw[:, axis] < 0).astype(np.uint32) << np.uint32(9) | size
        words = np.where(largest == axis, words, words << np.uint32(10) | signed)
    little_endian: NDArray[np.uint32] = words.astype("<u4")
    return little_endian


def _dequantised(layout: _Layout, body: ByteArray) -> SplatArrays:
    """Return the Gaussians in the sections (B,) of a file, one after the other.

    An opacity of 0 or 255 steps is read a quarter of a step inside, so that its logit is finite.
    """
    ends = np.cumsum([layout.count * width for width in layout.widths])
    sections = [part.reshape(layout.count, -1) for part in np.split(body, ends[:-1])]
    widths = {
        "means": (3,),
        "quats_wxyz": (4,),
        "log_scales": (3,),
        "logit_opacities": (),
        "sh": (1 + layout.higher, 3),
    }
    splat = SplatArrays(**{name: np.empty((layout.count, *width), np.float32) for name, width in widths.items()})
    for rows in _chunks(layout.count):
        positions, opacities, colours, scales, rotations, *higher = (section[rows] for section in sections)
        words = np.zeros((len(positions), 3, 4), np.uint8)
        words[:, :, 1:] = positions.reshape(-1, 3, 3)
        fixed = words.view("<i4")[:, :, 0] >> 8  # an arithmetic shift extends the sign
        splat.means[rows] = fixed / 2.0**layout.fractional_bits
        splat.quats_wxyz[rows] = _unpacked_rotations(rotations)
        splat.log_scales[rows] = scales / 16 - 10
        opacity = np.clip(opacities[:, 0].astype(np.float64), 0.25, 254.75) / 255
        splat.logit_opacities[rows] = np.log(opacity / (1 - opacity))
        splat.sh[rows, 0] = (colours - 127.5) / _COLOUR_STEPS
        for section in higher:
            splat.sh[rows, 1:] = section.reshape(-1, layout.higher, 3) / np.float32(128) - 1
    return splat


def _unpacked_rotations(section: ByteArray) -> Float32Array:
    """Return quaternions (N, 4) wxyz of three bytes (x, y, z) or of four (smallest three)."""
    if section.shape[1] == 3:
        xyz = section / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1)))
        return np.column_stack([w, xyz]).astype(np.float32)
    words = np.ascontiguousarray(section).view("<u4")[:, 0]
    largest = words >> np.uint32(30)
    xyzw = np.zeros((len(words), 4))
    for axis in (3, 2, 1, 0):
        stored = largest != axis
        size = (words & np.uint32(511)) / _LARGEST_COMPONENT
        xyzw[:, axis] = np.where(stored, np.where(words & np.uint32(512), -size, size), 0)
        words = np.where(stored, words >> np.uint32(10), words)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(axis=1)))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), rest[:, None], 1)
    return np.roll(xyzw, 1, axis=1).astype(np.float32)
