"""Decoding of photographs from ROS messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import ByteArray
from pipelines.formats.image_file import MAX_BYTES, MAX_PIXELS, header_size

IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
_PNG_EFFORT = 1
_BAYER = ("rggb", "bggr", "gbrg", "grbg")
# Encoding → bytes a pixel.
_PIXEL_BYTES = {
    "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono8": 1, "8uc1": 1, "mono16": 2,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
    **{f"bayer_{pattern}{depth}": depth // 8 for pattern in _BAYER for depth in (8, 16)},
}  # fmt: skip
ENCODINGS = tuple(_PIXEL_BYTES)


class BadImageError(ValueError):
    """An image message that cannot become a photograph; the text states the reason."""


@dataclass
class ImageWriter:
    """Converts image messages to the bytes of a JPEG or PNG file.

    JPEG and PNG in a `CompressedImage` stay as they are. A raw `Image` becomes a PNG without loss, but for 16 bits,
    which become 8 by the same factor for the whole bag: the first image decides how many bits are in use.

    Attributes:
        bits: bits in use of 16-bit images; None before the first.
    """

    bits: int | None = None

    def encoded(self, kind: str, message: Any) -> tuple[bytes, str]:
        """Return the file's bytes and its suffix.

        Raises:
            BadImageError: unknown encoding, too few bytes, or too many pixels.
        """
        if kind == COMPRESSED:
            return _compressed(message)
        import cv2

        done, data = cv2.imencode(".png", self._pixels(message), [cv2.IMWRITE_PNG_COMPRESSION, _PNG_EFFORT])
        if not done:
            raise BadImageError("does not encode as PNG")
        return data.tobytes(), ".png"

    def _pixels(self, message: Any) -> ByteArray:
        """Return BGR or grey pixels of a raw image."""
        encoding = str(message.encoding).strip().lower()
        if encoding not in _PIXEL_BYTES:
            raise BadImageError(f"encoding {message.encoding!r} is none of {', '.join(ENCODINGS)}")
        raw = _rows(message, _PIXEL_BYTES[encoding])
        if encoding.endswith("16"):
            return _to_bgr(
                self._eight_bits(raw.view(">u2" if message.is_bigendian else "<u2")), encoding[:-2] + "8"
            )
        return _to_bgr(raw, encoding)

    def _eight_bits(self, pixels: NDArray[np.uint16]) -> ByteArray:
        if self.bits is None:
            used = int(pixels.max(initial=1)).bit_length()
            self.bits = next(bits for bits in (8, 10, 12, 14, 16) if used <= bits)
        return np.asarray(np.minimum(pixels >> (self.bits - 8), 255).astype(np.uint8))


def sharpness(data: bytes) -> float:
    """Return the variance of the Laplacian of an encoded image at a quarter of its size: low for blurred images."""
    import cv2

    grey = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_4)
    return 0.0 if grey is None else float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _compressed(message: Any) -> tuple[bytes, str]:
    data = np.asarray(message.data, dtype=np.uint8).tobytes()
    if len(data) > MAX_BYTES:
        raise BadImageError(f"has {len(data) / 2**20:.0f} MiB (limit {MAX_BYTES // 2**20})")
    size = header_size(data)
    if data[:2] == b"\xff\xd8":
        suffix = ".jpg"
    elif data[:4] == b"\x89PNG":
        suffix = ".png"
    else:
        raise BadImageError(f"is neither JPEG nor PNG (format {str(message.format)[:40]!r})")
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise BadImageError("has a damaged header")
    return data, suffix


def _rows(message: Any, pixel_bytes: int) -> ByteArray:
    """Return the bytes (height, width · pixel_bytes) of a raw image without the padding of its rows."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    if not 0 < width * height <= MAX_PIXELS:
        raise BadImageError(f"claims {width}×{height} pixels")
    if step < width * pixel_bytes or len(data) < step * height:
        raise BadImageError(f"{len(data)} bytes in rows of {step} are too few for {width}×{height} pixels")
    rows = data[: step * height].reshape(height, step)[:, : width * pixel_bytes]
    return np.ascontiguousarray(rows)


def _to_bgr(raw: ByteArray, encoding: str) -> ByteArray:
    """Return BGR (height, width, 3) or grey (height, width) of rows of bytes."""
    import cv2

    height = len(raw)
    if encoding in ("mono8", "8uc1"):
        return raw
    if encoding.startswith("bayer_"):
        return np.asarray(cv2.cvtColor(raw, getattr(cv2, f"COLOR_Bayer{encoding[6:10].upper()}2BGR")), np.uint8)
    pixels = raw.reshape(height, -1, _PIXEL_BYTES[encoding])
    codes = {
        "rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR,
        "8uc4": cv2.COLOR_BGRA2BGR, "yuv422": cv2.COLOR_YUV2BGR_UYVY, "uyvy": cv2.COLOR_YUV2BGR_UYVY,
        "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2, "yuyv": cv2.COLOR_YUV2BGR_YUY2,
    }  # fmt: skip
    return pixels if encoding not in codes else np.asarray(cv2.cvtColor(pixels, codes[encoding]), np.uint8)
