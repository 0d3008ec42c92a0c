"""HEIC photographs, as telephones take them, as JPEG with the same tags (the sole home of pillow-heif)."""

import io
from pathlib import Path
from typing import Any

from pipelines.core.errors import InputError
from pipelines.core.extras import require
from pipelines.formats.image_file import MAX_PIXELS, read_bytes
from pipelines.formats.photo_blocks import jpeg_with_blocks

_QUALITY = 97


def heif_size(path: Path) -> tuple[int, int]:
    """Return width and height of a photograph by its header; errors as of `jpeg_of_heif`."""
    width, height = _opened(path).size
    return width, height


def jpeg_of_heif(path: Path) -> bytes:
    """Return a HEIC photograph as JPEG of a quality that loses less than its own compression did, upright.

    Raises:
        InputError: unreadable, empty, larger than 512 MiB or 400 million pixels, or it does not decode.
        BackendUnavailableError: pillow-heif is not installed.
    """
    import pillow_heif

    image, out = _opened(path), io.BytesIO()
    try:
        picture = image.to_pillow().convert("RGB")
    except (OSError, ValueError, RuntimeError, EOFError) as error:
        raise InputError("image-damaged", f"The photograph does not decode: {error}.", path=path) from error
    pillow_heif.set_orientation(image.info)  # decoding has turned the picture: its tag must not do so again
    picture.save(out, "JPEG", quality=_QUALITY, subsampling=0)
    return jpeg_with_blocks(out.getvalue(), image.info.get("exif"), image.info.get("xmp"))


def _opened(path: Path) -> Any:
    require("heif")
    import pillow_heif

    data = read_bytes(path)
    try:
        image = pillow_heif.open_heif(data, convert_hdr_to_8bit=True)
    except (OSError, ValueError, RuntimeError, EOFError, SyntaxError) as error:
        raise InputError("not-an-image", f"The file is no HEIC photograph: {error}.", path=path) from error
    width, height = image.size
    if width * height > MAX_PIXELS:
        raise InputError("image-too-large", f"The photograph has {width}×{height} pixels, too many.", path=path)
    return image
