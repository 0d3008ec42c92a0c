"""Files of the test views: photograph, render and their difference side by side in one PNG."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.types import ByteArray

DIFFERENCE_GAIN = 3
_LONGEST_NAME_BYTES = 255


def write_render(folder: Path, image: str, strip: ByteArray) -> None:
    """Write a photograph beside its render as PNG.

    Args:
        folder: of the PNG.
        image: name of the photograph.
        strip: (H, W, 3) RGB: the photograph, its render, their difference, with labels above.
    """
    _, png = cv2.imencode(".png", np.ascontiguousarray(strip[..., ::-1]))  # `imwrite` reports no full disk
    (folder / render_name(image)).write_bytes(png.tobytes())


def render_name(image: str) -> str:
    """Return the file name of an image's render: its folders and name, or their hash beyond 255 bytes."""
    name = Path(image).with_suffix(".png").as_posix().replace("/", "_")
    if len(name.encode()) <= _LONGEST_NAME_BYTES:
        return name
    return f"{hashlib.sha256(name.encode()).hexdigest()[:32]}.png"
