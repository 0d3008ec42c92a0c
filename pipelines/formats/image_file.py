"""Photographs as files: size and samples from the header, a check that they decode, their values and their hash.

The header is read before memory is allocated, so that a file that claims a billion pixels is refused.
"""

import hashlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.core.types import AnyArray

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})
HEIF_SUFFIXES = frozenset({".heic", ".heif"})  # converted by `ingest`: see `formats.heif`
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v"})
MAX_BYTES = 512 * 1024 * 1024
MAX_PIXELS = 400_000_000
# EXIF and XMP of a JPEG lie in its first segments of 64 KiB.
_HEAD_BYTES = 256 * 1024
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_TIFF, _BIG_TIFF = (b"II*\x00", b"MM\x00*"), (b"II+\x00", b"MM\x00+")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}  # by colour type
_SUBFILE, _WIDTH, _HEIGHT, _BITS, _PHOTOMETRIC, _SAMPLES, _FORMAT = 254, 256, 257, 258, 262, 277, 339  # TIFF's tags
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB = 0, 1, 2  # TIFF's photometric interpretations
_UNSIGNED, _FLOAT = 1, 3  # TIFF's formats of a sample
_MOST_DIRECTORIES, _MOST_ENTRIES = 64, 4096
_ONE_IN = 10_000  # of pixels: beyond are hot and dead ones
_MINIATURE_PX, _LARGE_PX = 16, 256


@dataclass(frozen=True)
class ImageHeader:
    """Statements of the header of a JPEG, PNG or TIFF file; `refusal` is why such a file is not read."""

    width: int
    height: int
    channels: int = 3
    bits: int = 8  # of a sample
    is_float: bool = False
    refusal: str = ""

    @property
    def is_deep(self) -> bool:
        """Whether samples have more than eight bits."""
        return self.bits > 8


@dataclass(frozen=True)
class ImageFile:
    """Photograph that decodes: pixels as stored, before any EXIF orientation, and the hash of the whole file.

    `values` are the darkest and the brightest value of samples with more than eight bits, but for one pixel in ten
    thousand at each end; None: eight bits, or not decoded. `miniature` is the whole picture in 16×16 grey pixels.
    `sharpness` is the variance of the Laplacian of its grey values, of a large picture at a quarter of its size:
    low of blurred ones, and of dull scenes; 0: not decoded.
    """

    width: int
    height: int
    sha256: str
    channels: int = 3
    bits: int = 8
    is_float: bool = False
    values: tuple[float, float] | None = None
    miniature: bytes = b""
    sharpness: float = 0.0


def read_bytes(path: Path) -> bytes:
    """Return the bytes of the whole file; an InputError: unreadable, empty, or larger than 512 MiB.

    Examples:
        >>> import cv2
        >>> _ = cv2.imwrite("a.png", np.zeros((300, 400, 3), np.uint8))
        >>> inspect_image(read_bytes(Path("a.png")), Path("a.png")).width
        400
    """
    if file_size(path, limit_bytes=MAX_BYTES, kind="photograph") == 0:
        raise InputError("file-empty", "The file is empty.", path=path)
    with reading(path):
        return path.read_bytes()


def read_head(path: Path) -> bytes:
    """Return the beginning of a photograph, with its tags and its size; the whole file where that says neither.

    Raises:
        InputError: as `read_bytes`.

    Examples:
        >>> import cv2
        >>> _ = cv2.imwrite("a.png", np.zeros((300, 400, 3), np.uint8))
        >>> header_size(read_head(Path("a.png")))
        (400, 300)
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
    """Return size, samples and hash of a JPEG, PNG or TIFF file, after decoding it to its end.

    Without `decode`, the data are a head that is not decoded, and what is hashed is the head.

    Raises:
        InputError: no such image, more than 400 million pixels, samples that make no photograph (five bands in one
            file), or it does not decode.
    """
    if data[:4] in _BIG_TIFF:
        message = "The file is a BigTIFF, which is not read."
        remedy = "Convert it to a plain TIFF."
        raise InputError("big-tiff", message, path=path, remedy=remedy)
    header = image_header(data)
    if header is None:
        raise InputError("not-an-image", "The file is not a JPEG, PNG or TIFF image.", path=path)
    width, height = header.width, header.height
    if not (0 < width * height <= MAX_PIXELS):
        message = f"The header states {width}×{height} pixels; the limit is {MAX_PIXELS // 10**6} million."
        raise InputError("too-many-pixels", message, path=path)
    if header.refusal:
        raise InputError("image-samples", header.refusal, path=path)
    sha256 = hashlib.sha256(data).hexdigest()
    file = ImageFile(width, height, sha256, header.channels, header.bits, header.is_float)
    if not decode:
        return file
    pixels = deep_pixels(data) if header.is_deep else _grey(data, reduced=min(width, height) >= _LARGE_PX)
    if pixels is None or not pixels.size:
        message = "The photograph is damaged: it does not decode to its end."
        raise InputError("photograph-damaged", message, path=path)
    values = _extremes(pixels) if header.is_deep else None
    return replace(file, values=values, miniature=_miniature(pixels, values), sharpness=_sharpness(pixels, values))


def header_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height that a JPEG, PNG or TIFF header states, or None."""
    header = image_header(data)
    return None if header is None else (header.width, header.height)


def image_header(data: bytes) -> ImageHeader | None:
    """Return what a JPEG, PNG or TIFF header states, or None."""
    try:
        if data[:2] == _JPEG:
            return _jpeg_header(data)
        if data[:8] == _PNG and data[12:16] == b"IHDR":
            width, height = struct.unpack(">II", data[16:24])
            bits, colour = (data[24], data[25]) if len(data) > 25 else (8, 2)
            return ImageHeader(width, height, _PNG_CHANNELS.get(colour, 3), bits)
        if data[:4] in _TIFF:
            return _tiff_header(data)
    except (struct.error, IndexError):
        return None
    return None


def _jpeg_header(data: bytes) -> ImageHeader | None:
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            return None
        marker = data[position + 1]
        if marker == 0xFF:  # padding
            position += 1
            continue
        if marker in _FRAME_MARKERS:
            bits, height, width, channels = struct.unpack(">BHHB", data[position + 4 : position + 10])
            refusal = f"The file is a JPEG of {bits} bits, of which 8 are read. Convert it." if bits != 8 else ""
            return ImageHeader(width, height, channels, 8, refusal=refusal)
        (length,) = struct.unpack(">H", data[position + 2 : position + 4])
        position += 2 + length
    return None


def _tiff_header(data: bytes) -> ImageHeader | None:
    pages = list(_tiff_directories(data))
    first = pages[0] if pages else {}
    if not {_WIDTH, _HEIGHT} <= set(first):
        return None
    width, height, channels = first[_WIDTH], first[_HEIGHT], first.get(_SAMPLES, 1)
    bits, form = first.get(_BITS, 1), first.get(_FORMAT, _UNSIGNED)
    header = ImageHeader(width, height, channels, bits, form == _FLOAT)
    # Further directories are thumbnails (smaller, or marked as reduced), or a stack of bands.
    alike = (first[_WIDTH], first[_HEIGHT], 0)
    stacked = sum((page.get(_WIDTH), page.get(_HEIGHT), page.get(_SUBFILE, 0) & 1) == alike for page in pages)
    if stacked > 1:
        return _refused(header, f"a stack of {stacked} pictures in one TIFF file")
    photometric = first.get(_PHOTOMETRIC, _BLACK_IS_ZERO if channels < 3 else _RGB)
    most = 2 if photometric in (_WHITE_IS_ZERO, _BLACK_IS_ZERO) else 4  # one of them opacity
    if channels > most:
        return _refused(header, f"a TIFF of {channels} bands in one file")
    if form == _FLOAT and bits not in (32, 64):
        return _refused(header, f"a TIFF of floating-point numbers of {bits} bits")
    if form != _FLOAT and bits > 16:
        return _refused(header, f"a TIFF of integers of {bits} bits")
    return header


def _refused(header: ImageHeader, what: str) -> ImageHeader:
    refusal = f"The file is {what}, which is no photograph. Give each band as a file of its own, of 8 or 16 bits."
    return ImageHeader(header.width, header.height, header.channels, header.bits, header.is_float, refusal)


def _tiff_directories(data: bytes) -> Iterator[dict[int, int]]:
    """Yield the directories of a TIFF file: the first value of each tag that holds integers."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    seen: set[int] = set()
    while at and at not in seen and len(seen) < _MOST_DIRECTORIES:
        seen.add(at)
        try:
            (count,) = struct.unpack_from(order + "H", data, at)
            if count > _MOST_ENTRIES:
                return
            yield dict(_tiff_entries(data, at, count, order))
            (at,) = struct.unpack_from(order + "I", data, at + 2 + 12 * count)
        except struct.error:  # of a file that is cut short: decoding it fails
            if len(seen) == 1:
                raise
            return


def _tiff_entries(data: bytes, at: int, count: int, order: str) -> Iterator[tuple[int, int]]:
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, length = struct.unpack_from(order + "HHI", data, entry)
        size = {1: 1, 3: 2, 4: 4}.get(kind)
        if size is None or not length:
            continue
        offset = entry + 8
        if size * length > 4:
            (offset,) = struct.unpack_from(order + "I", data, offset)
        if offset + size <= len(data):
            yield tag, struct.unpack_from(order + {1: "B", 2: "H", 4: "I"}[size], data, offset)[0]


def deep_pixels(data: bytes) -> NDArray[Any] | None:
    """Return the pixels (H, W) or (H, W, 3) BGR as stored, of integers or floats; None: they do not decode."""
    import cv2

    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    return _decoded(data, flags)


def _grey(data: bytes, *, reduced: bool) -> NDArray[Any] | None:
    import cv2

    # Decoding at a quarter of the size still reads the entropy-coded stream to its end, where truncation shows.
    flags = cv2.IMREAD_REDUCED_GRAYSCALE_4 if reduced else cv2.IMREAD_GRAYSCALE
    return _decoded(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)


def _decoded(data: bytes, flags: int) -> NDArray[Any] | None:
    import cv2

    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None


def _extremes(pixels: AnyArray) -> tuple[float, float]:
    """Return the values that all but one pixel in ten thousand at each end lie between; zeros without a number."""
    values = pixels[np.isfinite(pixels)] if pixels.dtype.kind == "f" else pixels.ravel()
    if not values.size:
        return 0.0, 0.0
    beyond = values.size // _ONE_IN
    ends = np.partition(values, (beyond, values.size - 1 - beyond))
    return float(ends[beyond]), float(ends[values.size - 1 - beyond])


def _miniature(pixels: AnyArray, values: tuple[float, float] | None) -> bytes:
    import cv2

    small = cv2.resize(_grey_values(pixels), (_MINIATURE_PX, _MINIATURE_PX), interpolation=cv2.INTER_AREA)
    low, high = values or (0.0, 255.0)
    scale = 255.0 / (high - low) if high > low else 0.0
    return bytes(np.clip((small - low) * scale, 0, 255).astype(np.uint8).tobytes())


def _sharpness(pixels: AnyArray, values: tuple[float, float] | None) -> float:
    import cv2

    grey = _grey_values(pixels)
    if values is not None and min(grey.shape) >= _LARGE_PX:  # decoded at its whole size
        grey = cv2.resize(grey, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def _grey_values(pixels: AnyArray) -> NDArray[Any]:
    grey = pixels.astype(np.float32) if pixels.ndim == 2 else pixels.mean(axis=2, dtype=np.float32)
    return np.asarray(np.nan_to_num(grey))
