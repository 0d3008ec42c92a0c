"""Sizes come from headers; whatever does not decode to its end is refused before it costs memory."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.image_file import MAX_BYTES, header_size, inspect_image, read_bytes
from tests.photos import Exif, jpeg
from tests.refusals import refused

PATH = Path("a.jpg")


def _encoded(suffix: str) -> bytes:
    pixels = np.random.default_rng(1).integers(0, 255, (30, 70, 3), dtype=np.uint8)
    return cv2.imencode(suffix, pixels)[1].tobytes()


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_size_and_hash(suffix: str) -> None:
    data = _encoded(suffix)
    image = inspect_image(data, PATH)
    assert (image.width, image.height) == (70, 30)
    assert image.sha256 == hashlib.sha256(data).hexdigest()


def test_orientation_does_not_turn_the_size() -> None:
    image = inspect_image(jpeg(size=(64, 48), exif=Exif(image=[(0x0112, 3, 6)])), PATH)
    assert (image.width, image.height) == (64, 48)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
@pytest.mark.parametrize("part", [0.3, 0.9])
def test_truncated_is_damaged(suffix: str, part: float) -> None:
    data = _encoded(suffix)
    with pytest.raises(InputError) as error:
        inspect_image(data[: int(len(data) * part)], PATH)
    assert error.value.code in ("photograph-damaged", "not-an-image") and error.value.path == PATH


@pytest.mark.parametrize("data", [b"hello", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\x00\xff\xff\xff\xff", b""])
def test_no_image(data: bytes) -> None:
    with refused("not-an-image", InputError):
        inspect_image(data, PATH)


def test_a_claim_of_too_many_pixels_is_refused_by_the_header() -> None:
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + struct.pack(">II", 60000, 60000)
    assert header_size(bomb) == (60000, 60000)
    with refused("too-many-pixels", InputError) as error:
        inspect_image(bomb, PATH)
    assert "60000×60000 pixels" in error.value.message


def test_empty_and_huge_files(tmp_path: Path) -> None:
    (tmp_path / "empty.jpg").touch()
    with refused("file-empty", InputError) as error:
        read_bytes(tmp_path / "empty.jpg")
    assert error.value.path == tmp_path / "empty.jpg"
    with (tmp_path / "huge.jpg").open("wb") as handle:
        handle.truncate(MAX_BYTES + 1)  # a sparse file
    with refused("file-too-large", InputError):
        read_bytes(tmp_path / "huge.jpg")
    with refused("file-unreadable", InputError):
        read_bytes(tmp_path / "absent.jpg")


def _tiff(pixels: np.ndarray, **more: object) -> bytes:
    """A TIFF of any number of bands, by GDAL."""
    import rasterio
    from rasterio.io import MemoryFile

    bands = pixels if pixels.ndim == 3 else pixels[None]
    with MemoryFile() as memory:
        with rasterio.open(
            memory, "w", driver="GTiff", width=bands.shape[2], height=bands.shape[1], count=len(bands),
            dtype=bands.dtype, **more,
        ) as file:  # fmt: skip
            file.write(bands)
        return bytes(memory.read())


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
@pytest.mark.parametrize(
    ("bands", "dtype", "more", "code", "text"),
    [
        (5, "uint16", {}, "image-samples", "5 bands"),
        (5, "uint8", {"interleave": "band"}, "image-samples", "5 bands"),
        (4, "uint16", {"photometric": "minisblack"}, "image-samples", "4 bands"),
        (7, "float32", {}, "image-samples", "7 bands"),
        (1, "uint32", {}, "image-samples", "integers of 32 bits"),
        (3, "uint8", {"BIGTIFF": "YES"}, "big-tiff", "BigTIFF"),
        (5, "uint16", {"BIGTIFF": "YES", "ENDIANNESS": "BIG"}, "big-tiff", "BigTIFF"),
    ],
)
def test_rasters_that_are_no_photographs(
    bands: int, dtype: str, more: dict[str, str], code: str, text: str
) -> None:
    pixels = np.random.default_rng(2).integers(0, 255, (bands, 30, 40)).astype(dtype)
    with refused(code, InputError) as error:
        inspect_image(_tiff(pixels, **more), PATH)
    assert text in error.value.message


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_a_stack_of_pages_is_told_from_a_thumbnail() -> None:
    import io

    from PIL import Image

    full, small = (Image.fromarray(np.full((h, 2 * h), 90, np.uint8)) for h in (30, 10))
    for second, is_stack in ((full, True), (small, False)):
        out = io.BytesIO()
        full.save(out, "TIFF", save_all=True, append_images=[second])
        if is_stack:
            with refused("image-samples", InputError) as error:
                inspect_image(out.getvalue(), PATH)
            assert "2 pictures" in error.value.message
        else:
            assert inspect_image(out.getvalue(), PATH).width == 60


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_opacity_is_no_band() -> None:
    for bands, more in ((2, {"alpha": "YES"}), (4, {"photometric": "RGB", "alpha": "YES"})):
        pixels = np.full((bands, 30, 40), 200, np.uint8)
        assert inspect_image(_tiff(pixels, **more), PATH).channels == bands
