"""Depth maps as images: 16-bit PNG or TIFF, float TIFF, and EXR. Values are in the unit that the user states."""

from __future__ import annotations

from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.extras import require
from pipelines.core.files import file_size
from pipelines.core.types import Float32Array
from pipelines.formats.image_file import MAX_BYTES, MAX_PIXELS, deep_pixels, image_header, read_bytes

DEPTH_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".exr"})
_NO_DATA_16 = 65535
_UNKNOWN_ABOVE = 1e9  # programs that render write such a depth where they met nothing
_DEPTH_CHANNELS = ("Z", "depth", "Depth", "depth.Z", "Depth.Z", "D", "Y", "V", "R")


@dataclass(frozen=True)
class DepthImage:
    """Depth map (H, W) in the file's unit, NaN where unknown; `step` is between its values, 0: floats of 32 bits.

    Floats of 16 bits have a step that grows with the value: `is_half`.
    """

    value: Float32Array
    step: float = 0.0
    is_half: bool = False


def read_depth_image(path: Path) -> DepthImage:
    """Return a depth map; zero, values that are not finite or negative, and 65535 of 16 bits are unknown.

    Raises:
        InputError: no such image, eight bits, several channels of which none is depth, too many pixels, or damaged.
        BackendUnavailableError: an EXR, and its library is missing; names the extra.

    Examples:
        >>> import cv2
        >>> _ = cv2.imwrite("depth.png", np.array([[0, 1500], [1510, 65535]], dtype=np.uint16))
        >>> read_depth_image(Path("depth.png")).value.tolist()  # in the unit of the file, here millimetres
        [[nan, 1500.0], [1510.0, nan]]
    """
    if path.suffix.lower() == ".exr":
        return _read_exr(path)
    data = read_bytes(path)
    header = image_header(data)
    if header is None or path.suffix.lower() not in DEPTH_SUFFIXES:
        raise InputError("not-an-image", "The file is no PNG, TIFF or EXR image.", path=path)
    _check_size(header.width, header.height, path)
    if header.channels != 1 or not (header.is_float or header.bits == 16):
        message = (
            f"The image has {header.channels} channels of {header.bits} bits; depth maps have one, of 16-bit "
            "integers or of floats. A coloured or 8-bit picture of depths has lost them."
        )
        raise InputError("depth-samples", message, path=path)
    pixels = deep_pixels(data)
    if pixels is None or pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.float32, np.float64):
        raise InputError("photograph-damaged", "The depth map does not decode to its end.", path=path)
    if pixels.dtype == np.uint16:
        value = np.where(pixels == _NO_DATA_16, 0, pixels).astype(np.float32)
        return DepthImage(_known(value), 1.0)
    return DepthImage(_known(pixels))


def _read_exr(path: Path) -> DepthImage:
    require("scans")
    import OpenEXR

    size = file_size(path, limit_bytes=MAX_BYTES, kind="depth map")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        low, high = (np.asarray(corner, dtype=np.int64) for corner in header["dataWindow"])
        names = [str(channel.name) for channel in header["channels"]]
    except Exception as error:
        raise _damaged(path, error) from error
    width, height = (high - low + 1).tolist()
    _check_size(width, height, path)
    # ZIP and others reach a thousandth on equal pixels; more is a header that asks for memory.
    if len(names) * width * height > 4000 * size:
        message = f"The header states {width}×{height} pixels of {len(names)} channels in {size} bytes."
        raise InputError("size-differs", f"{message} It is cut off or damaged.", path=path)
    chosen = _depth_channel(names)
    if chosen is None:
        message = f"None of the channels {', '.join(names)[:200]} is depth."
        remedy = "Name it Z, or write it alone."
        raise InputError("depth-channels", message, path=path, remedy=remedy)
    try:
        with redirect_stdout(StringIO()) as printed:  # OpenEXR prints what it cannot read, and leaves those rows
            channels = _exr_channels(OpenEXR.File(str(path), separate_channels=True))
        if printed.getvalue():
            raise ValueError(printed.getvalue().strip())
        pixels = channels[chosen]
    except Exception as error:
        raise _damaged(path, error) from error
    if chosen == "R" and not all(
        np.array_equal(pixels, channels[one], equal_nan=True) for one in "GB" if one in names
    ):
        message = (
            "The image is a picture in colours, whose channels R, G and B differ: a depth map has one channel."
        )
        raise InputError("depth-channels", message, path=path)
    if pixels.shape != (height, width):
        message = f"Channel {chosen} has {pixels.shape[1]}×{pixels.shape[0]} pixels, not {width}×{height}."
        raise InputError("depth-channels", message, path=path)
    return DepthImage(_known(pixels), is_half=pixels.dtype == np.float16)


_ExrFile = Any  # OpenEXR.File


def _exr_channels(file: _ExrFile) -> dict[str, np.ndarray]:
    return {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}


def _depth_channel(names: list[str]) -> str | None:
    """Return the channel of depths: the only one, or the first of the usual names; None: there is none."""
    if len(names) == 1:
        return names[0]
    layered = [name for name in names if name.rpartition(".")[2] == "Z"]
    plain = [name for name in _DEPTH_CHANNELS if name in names]
    return next(iter([*plain, *layered]), None)


def _known(pixels: np.ndarray) -> Float32Array:
    value = pixels.astype(np.float32)
    with np.errstate(invalid="ignore"):
        value[~((value > 0) & (value < _UNKNOWN_ABOVE))] = np.nan
    return value


def _check_size(width: int, height: int, path: Path) -> None:
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        message = f"The header states {width}×{height} pixels; the limit is {MAX_PIXELS // 10**6} million."
        raise InputError("too-many-pixels", message, path=path)


def _damaged(path: Path, error: Exception) -> InputError:
    message = f"The EXR file is damaged: {' '.join(str(error).split())[:200]}"
    return InputError("file-damaged", message, path=path)
