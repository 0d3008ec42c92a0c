"""Photographs as files: size from the header, a check that they decode, and their hash.

The header is read before memory is allocated, so that a file that claims a billion pixels is refused.
"""

import hashlib
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})
HEIF_SUFFIXES = frozenset({".heic", ".heif"})  # converted by `ingest`: see `formats.heif`
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v"})
MAX_BYTES = 512 * 1024 * 1024
MAX_PIXELS = 400_000_000
# EXIF and XMP of a JPEG lie in its first segments of 64 KiB.
_HEAD_BYTES = 256 * 1024
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG = b"\xff\xd8"
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


@dataclass(frozen=True)
class ImageFile:
    """Photograph that decodes: pixels as stored, before any EXIF orientation, and the hash of the whole file."""

    width: int
    height: int
    sha256: str


def read_bytes(path: Path) -> bytes:
    """Return the bytes of the whole file; an InputError: unreadable, empty, or larger than 512 MiB."""
    if file_size(path, limit_bytes=MAX_BYTES, kind="photograph") == 0:
        raise InputError("file-empty", "The file is empty.", path=path)
    with reading(path):
        return path.read_bytes()


def read_head(path: Path) -> bytes:
    """Return the beginning of a photograph, with its tags and its size; the whole file where that says neither.

    Raises:
        InputError: as `read_bytes`.
    """
    with reading(path), path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    return head if head[:2] == _JPEG and header_size(head) is not None else read_bytes(path)


def require_unchanged(data: bytes, sha256: str, path: Path) -> None:
    """Refuse a photograph whose hash is not the recorded one of the whole file; empty: none was recorded."""
    if sha256 and hashlib.sha256(data).hexdigest() != sha256:
        remedy = "put it back, or run `georef ingest` again"
        message = f"The photograph has changed since `georef ingest` read it: {remedy}"
        raise InputError("photograph-changed", message, path=path)


def inspect_image(data: bytes, path: Path, *, decode: bool = True) -> ImageFile:
    """Return size and hash of a JPEG, PNG or TIFF file, after decoding it to its end.

    Without `decode`, the data are a head that is not decoded, and what is hashed is the head.

    Raises:
        InputError: no such image, more than 400 million pixels, or it does not decode.
    """
    size = header_size(data)
    if size is None:
        raise InputError("not-an-image", "The file is not a JPEG, PNG or TIFF image.", path=path)
    width, height = size
    if not (0 < width * height <= MAX_PIXELS):
        message = f"The header states {width}×{height} pixels; the limit is {MAX_PIXELS // 10**6} million."
        raise InputError("too-many-pixels", message, path=path)
    if decode and not _decodes(data):
        message = "The photograph is damaged: it does not decode to its end."
        raise InputError("photograph-damaged", message, path=path)
    return ImageFile(width, height, hashlib.sha256(data).hexdigest())


def header_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height that a JPEG, PNG or TIFF header states, or None."""
    try:
        if data[:2] == _JPEG:
            return _jpeg_size(data)
        if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR":
            return struct.unpack(">II", data[16:24])
        if data[:4] in (b"II*\x00", b"MM\x00*"):
            return _tiff_size(data)
    except (struct.error, IndexError):
        return None
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            return None
        marker = data[position + 1]
        if marker == 0xFF:  # padding
            position += 1
            continue
        if marker in _FRAME_MARKERS:
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        (length,) = struct.unpack(">H", data[position + 2 : position + 4])
        position += 2 + length
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    order = "<" if data[:2] == b"II" else ">"
    (directory,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, directory)
    sizes: dict[int, int] = {}
    for entry in range(count):
        at = directory + 2 + 12 * entry
        tag, kind = struct.unpack_from(order + "HH", data, at)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            (sizes[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 8)
    if len(sizes) < 2:
        return None
    return sizes[_TIFF_WIDTH], sizes[_TIFF_HEIGHT]


def _decodes(data: bytes) -> bool:
    import cv2

    # Decoding at an eighth of the size still reads the entropy-coded stream to its end, where truncation shows.
    flags = cv2.IMREAD_REDUCED_GRAYSCALE_8 | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) is not None
    except cv2.error:
        return False
