"""Photographs of single bands as their makers write them: TIFF files of 16 bits with EXIF and XMP."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from tests.photo_folders import DJI, PIX4D, packet

ISO, EXPOSURE, F_NUMBER, BLACK = 0x8827, 0x829A, 0x829D, 0xC61A


def band_tiff(
    pixels: np.ndarray, xmp: bytes | None, *, make: str = "Maker", tags: Mapping[int, Any] | None = None
) -> bytes:
    """Return a TIFF of pixels (H, W), with further tags of its first directory."""
    info: dict[int, Any] = {0x010F: make, 0x0110: "Model", **(tags or {})}
    if xmp is not None:
        info[700] = xmp
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "TIFF", tiffinfo=info)
    return file.getvalue()


def exposed(exposure_s: float, iso: int = 100, **more: Any) -> dict[int, Any]:
    """Return the tags of an exposure; `f_number` and `black` among them if they are given."""
    tags: dict[int, Any] = {EXPOSURE: IFDRational(round(exposure_s * 1e7), 10_000_000), ISO: iso}
    if "f_number" in more:
        tags[F_NUMBER] = IFDRational(round(more["f_number"] * 10), 10)
    if "black" in more:
        tags[BLACK] = (more["black"],) * 4
    return tags


def dji_band(**values: object) -> bytes:
    """Return the XMP of a band of DJI's multispectral cameras."""
    return packet(DJI, values)


def pix4d_band(**values: object) -> bytes:
    """Return the XMP of a band in the names that MicaSense and Parrot write."""
    return packet(PIX4D, values, elements=True)


def polynomial(radius: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Return 1 + k₀ r + k₁ r² + …"""
    value = np.ones_like(radius)
    for power, coefficient in enumerate(coefficients, start=1):
        value = value + coefficient * radius**power
    return value
