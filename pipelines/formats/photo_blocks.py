"""Blocks of metadata in photographs: where a JPEG, PNG or TIFF file keeps its EXIF and its XMP, and writing them.

A JPEG has them in APP1 segments, in any order and behind any other segment: EXIF once or several times, EXIF that
is longer than a segment in the following ones, and XMP as packets and as extensions of a packet. A PNG has them in
`eXIf`, in `iTXt`, or as hexadecimal text in a raw profile, a TIFF in its own directories. Other bytes, and files
that keep a packet elsewhere, are searched at their beginning and end.

Containers are walked here and not by Pillow, which decodes a PNG to find what follows its pixels, refuses large
pictures, and warns on standard error of tags that are broken.
"""

import hashlib
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

from pipelines.formats.tiff_tags import TIFF, read_directory

_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_EXIF = b"Exif\x00\x00"
_XMP, _XMP_EXTENSION = b"http://ns.adobe.com/xap/1.0/", b"http://ns.adobe.com/xmp/extension/\x00"
_XMP_TAG = 700
_PNG_XMP = b"XML:com.adobe.xmp"
_RAW_PROFILE = re.compile(rb"\s*\w+\s+\d+\s+([0-9a-fA-F\s]*)")
_OPEN, _CLOSE = b"<x:xmpmeta", b"</x:xmpmeta>"

_SEGMENT_BYTES = 65533  # of a JPEG's segment, without its length
_MAX_BLOCK_BYTES = 16 * 1024 * 1024  # of EXIF: makers' notes are megabytes at most
_MAX_EXTENSION_BYTES = 4 * 1024 * 1024  # of XMP: what is longer holds pictures
_MAX_PACKET_BYTES = 256 * 1024
_SEARCHED_BYTES = 1024 * 1024
_MAX_BLOCKS = 32


@dataclass(frozen=True)
class MetadataBlocks:
    """Metadata of a photograph as bytes, in the order of the file."""

    exif: tuple[bytes, ...] = ()  # TIFF structures
    xmp: tuple[bytes, ...] = ()  # XML
    problems: tuple[str, ...] = ()  # why a block was not found whole, one phrase each


@dataclass
class _Found:
    exif: list[bytes] = field(default_factory=list)
    xmp: list[bytes] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def add_exif(self, block: bytes) -> None:
        """Add a TIFF structure, with or without the name before it; a block without a header goes on the last."""
        block = block.removeprefix(_EXIF)
        if block[:4] in TIFF:
            self.exif.append(block)
        elif self.exif and len(self.exif[-1]) + len(block) <= _MAX_BLOCK_BYTES:
            self.exif[-1] += block


def find_blocks(data: bytes) -> MetadataBlocks:
    """Return EXIF and XMP of a photograph, or of its beginning; other bytes are searched for XMP."""
    blocks = _Found()
    if data[:2] == _JPEG:
        _find_in_jpeg(data, blocks)
    elif data[:8] == _PNG:
        _find_in_png(data, blocks)
    elif data[:4] in TIFF:
        blocks.exif.append(data)
        packet = read_directory(data, wanted=(_XMP_TAG,), limit_bytes=_MAX_EXTENSION_BYTES).get(_XMP_TAG)
        if packet is not None:
            blocks.xmp.append(packet.data)
    if not blocks.xmp:
        _search(data, blocks)
    return MetadataBlocks(tuple(blocks.exif[:_MAX_BLOCKS]), tuple(blocks.xmp[:_MAX_BLOCKS]), tuple(blocks.problems))


def jpeg_with_blocks(jpeg: bytes, exif: bytes | None, xmp: bytes | None) -> bytes:
    """Return a JPEG with EXIF (a TIFF structure) and XMP; what is longer than a segment is in several."""
    segments = []
    if exif:
        room = _SEGMENT_BYTES - len(_EXIF)
        exif = exif.removeprefix(_EXIF)
        segments += [_EXIF + exif[at : at + room] for at in range(0, len(exif), room)]
    if xmp and len(xmp) <= _SEGMENT_BYTES - len(_XMP) - 1:
        segments.append(_XMP + b"\x00" + xmp)
    elif xmp:
        name, room = hashlib.md5(xmp, usedforsecurity=False).hexdigest().upper().encode(), 60_000
        for at in range(0, len(xmp), room):
            head = _XMP_EXTENSION + name + struct.pack(">II", len(xmp), at)
            segments.append(head + xmp[at : at + room])
    app1 = b"".join(b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment for segment in segments)
    return jpeg[:2] + app1 + jpeg[2:]


def _find_in_jpeg(data: bytes, blocks: _Found) -> None:
    extensions: dict[bytes, dict[int, bytes]] = {}
    for payload in _app1_segments(data):
        if payload.startswith(_EXIF):
            blocks.add_exif(payload)
        elif payload.startswith(_XMP):
            blocks.xmp.append(payload[len(_XMP) :].lstrip(b"\x00"))
        elif payload.startswith(_XMP_EXTENSION):
            head = len(_XMP_EXTENSION) + 40
            name, length, at = struct.unpack(">32sII", payload[len(_XMP_EXTENSION) : head].ljust(40, b"\xff"))
            if length <= _MAX_EXTENSION_BYTES:
                extensions.setdefault(name, {})[at] = payload[head:]
    for parts in extensions.values():
        packet = b"".join(parts[at] for at in sorted(parts))
        if b"RDF" in packet:  # and not the pictures that some cameras keep there
            blocks.xmp.append(packet)


def _app1_segments(data: bytes) -> Iterator[bytes]:
    """Yield the APP1 segments of a JPEG before its pixels."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # padding
            at += 1
        elif marker in (0xD8, 0x01) or 0xD0 <= marker <= 0xD7:  # without a length
            at += 2
        elif marker in (0xDA, 0xD9):  # pixels, end
            return
        else:
            (length,) = struct.unpack_from(">H", data, at + 2)
            if marker == 0xE1:
                yield data[at + 4 : at + 2 + length]
            at += 2 + max(length, 2)


def _find_in_png(data: bytes, blocks: _Found) -> None:
    at = 8
    while at + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        body = data[at + 8 : at + 8 + length] if length <= _MAX_BLOCK_BYTES else b""
        at += 12 + length
        if kind == b"eXIf":
            blocks.add_exif(body)
        elif kind in (b"tEXt", b"zTXt", b"iTXt"):
            keyword, _, rest = body.partition(b"\x00")
            text = _png_text(kind, rest)
            if keyword.startswith(b"Raw profile type "):
                _add_profile(text, blocks)
            elif keyword == _PNG_XMP and len(text) <= _MAX_EXTENSION_BYTES:
                blocks.xmp.append(text)
        elif kind == b"IEND":
            return


def _png_text(kind: bytes, rest: bytes) -> bytes:
    """Return the text of a chunk behind its keyword; nothing of one that is broken."""
    if kind == b"tEXt":
        return rest
    if kind == b"zTXt":
        return _inflated(rest[1:])
    packed, parts = rest[:1] == b"\x01", rest[2:].split(b"\x00", 2)
    if len(parts) < 3:
        return b""
    return _inflated(parts[2]) if packed else parts[2]


def _inflated(data: bytes) -> bytes:
    try:
        return zlib.decompressobj().decompress(data, _MAX_BLOCK_BYTES)
    except zlib.error:
        return b""


def _add_profile(text: bytes, blocks: _Found) -> None:
    """Add what ImageMagick writes as hexadecimal text: EXIF, XMP or a segment of a JPEG with either."""
    profile = _RAW_PROFILE.match(text)
    if profile is None:
        return
    try:
        block = bytes.fromhex(profile[1].decode("ascii"))
    except ValueError:
        return
    if block.startswith(_XMP):
        blocks.xmp.append(block[len(_XMP) :].lstrip(b"\x00"))
    elif block.lstrip()[:1] == b"<":
        blocks.xmp.append(block)
    else:
        blocks.add_exif(block)


def _search(data: bytes, blocks: _Found) -> None:
    """Add the XMP packets in the first and last mebibyte of a file."""
    for part in (data[:_SEARCHED_BYTES], data[max(_SEARCHED_BYTES, len(data) - _SEARCHED_BYTES) :]):
        begin = part.find(_OPEN)
        while begin >= 0 and len(blocks.xmp) < _MAX_BLOCKS:
            end = part.find(_CLOSE, begin, begin + _MAX_PACKET_BYTES)
            if end < 0:
                blocks.problems.append("the XMP packet has no end within 256 KiB")
                return
            blocks.xmp.append(part[begin : end + len(_CLOSE)])
            begin = part.find(_OPEN, end)
