"""Pictures inside a page: as data, at a size that the page needs."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import ByteArray
from pipelines.formats.image_file import MAX_PIXELS, header_size, read_bytes

_PNG = b"\x89PNG"
_QUALITY = 82
_PAPER = 255  # behind transparent pixels


@dataclass(frozen=True)
class Picture:
    """Picture as the address of an `img` element.

    Attributes:
        address: `data:` with the whole picture.
        width_px, height_px: of its pixels.
    """

    address: str
    width_px: int
    height_px: int


def picture_of_png(data: bytes) -> Picture:
    """Return the picture of a PNG that this package drew."""
    size = header_size(data)
    assert size is not None
    return Picture(_address("png", data), *size)


def png_file(path: Path) -> Picture:
    """Return a PNG file as it is.

    Raises:
        InputError: it cannot be read, or is no PNG.
    """
    data = read_bytes(path)
    if header_size(data) is None or not data.startswith(_PNG):
        raise InputError("is no PNG: delete it, or make it again", path=path)
    return picture_of_png(data)


def picture_of(rgb: ByteArray, *, quality: int = _QUALITY) -> Picture:
    """Return a photograph (H, W, 3) RGB as JPEG."""
    height, width = rgb.shape[:2]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return Picture(_address("jpeg", data.tobytes()), width, height)


def read_picture(path: Path) -> ByteArray:
    """Return a picture of the workspace as (H, W, 3) RGB, transparent pixels on white.

    Raises:
        InputError: it cannot be read, does not decode, or claims more than 400 million pixels.
    """
    data = read_bytes(path)
    size = header_size(data)
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise InputError("is no picture that can be shown: delete it, or make it again", path=path)
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None or pixels.dtype != np.uint8:
        raise InputError("is no picture that can be shown: delete it, or make it again", path=path)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:] / np.float32(255)
        pixels = (pixels[..., :3] * alpha + _PAPER * (1 - alpha)).round().astype(np.uint8)
    return np.asarray(pixels[..., ::-1])


def limited(rgb: ByteArray, longest_px: int) -> ByteArray:
    """Return a picture (H, W, 3), made smaller so that its longer side has at most `longest_px` pixels."""
    scale = longest_px / max(rgb.shape[:2])
    if scale >= 1:
        return rgb
    height, width = (max(1, round(side * scale)) for side in rgb.shape[:2])
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA))


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
