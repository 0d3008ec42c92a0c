"""Pages for people: a frame with style, contents and sections, which every report of the package shares.

A page is one file. It holds its style and its pictures, and loads nothing: its own policy forbids that, and every
script but the page's own, whose hash it states. Most pages have none. Texts of users (names of points, of
photographs, of workspaces) enter through the escaping of jinja2 only, and their control characters are written as
escapes.

A room that makes a page has a folder `templates/` with one template a section. The templates hold all HTML; Python
gives them typed facts, figures as text (decimals that fit their size, a true minus, a dash for what does not
exist), and pictures as data, at a size that the page needs.
"""

import base64
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.figures import ACCURACY_H, MISSING
from pipelines.core.files import file_size
from pipelines.core.json_values import JsonValue
from pipelines.core.sentences import duration, printable_lines, without_folders
from pipelines.core.types import ByteArray
from pipelines.formats.image_file import MAX_PIXELS, header_size, read_bytes


def number_text(value: float | None, decimals: int = 2) -> str:
    """Return a number with fixed decimals: `−0.12`; a dash for None and NaN."""
    if value is None or isnan(value):
        return MISSING
    text = f"{value:.{decimals}f}"
    if float(text) == 0.0:
        text = text.removeprefix("-")
    return text.replace("-", "−")


def metres(value: float | None) -> str:
    """Return metres without their unit: millimetres below 10 m, tenths of them below 1 cm, else centimetres."""
    if value is None or isnan(value):
        return MISSING
    return "0" if value == 0 else number_text(value, 4 if abs(value) < 0.00995 else 3 if abs(value) < 9.9995 else 2)


def in_metres(value: float | None) -> str:
    """Return a length with its unit; a dash for None and NaN."""
    return MISSING if value is None or isnan(value) else f"{metres(value)} m"


def signed(value: float | None) -> str:
    """Return millimetre-fine metres without their unit, with a sign: a column of errors."""
    return _with_sign(number_text(value, 3))


def _with_sign(text: str) -> str:
    return text if text == MISSING or text.startswith("−") else f"+{text}"


def share(value: float | None) -> str:
    """Return a share of one as per cent: `97.5 %`."""
    return MISSING if value is None or isnan(value) else f"{number_text(100 * value, 1).removesuffix('.0')} %"


def decibel(value: float | None) -> str:
    """Return a PSNR with two decimals and its unit; a dash for None."""
    return MISSING if value is None else f"{number_text(value, 2)} dB"


def parts_per_million(value: float | None) -> str:
    """Return a relative quantity in parts per million, or per cent from one per mille on: `96.4 ppm`, `1.86 %`."""
    if value is None:
        return MISSING
    return f"{number_text(1e6 * value, 1)} ppm" if abs(value) < 1e-3 else f"{number_text(100 * value, 2)} %"


def count_text(value: int | None) -> str:
    """Return a whole number with thin spaces between thousands."""
    return MISSING if value is None else f"{value:,}".replace(",", "\u2009").replace("-", "−")


def volume(value: float | None) -> str:
    """Return cubic or square metres without their unit, with three figures at least: `1 059.9`, `0.52`."""
    if value is None or isnan(value):
        return MISSING
    decimals = 2 if abs(value) < 9.995 else 1 if abs(value) < 9999.95 else 0
    return f"{float(number_text(value, decimals).replace('−', '-')):,.{decimals}f}".replace(",", "\u2009").replace(
        "-", "−"
    )


def signed_volume(value: float | None) -> str:
    """Return a volume as `volume` does, with its sign."""
    return _with_sign(volume(value))


def moment(value: datetime | None) -> str:
    """Return a time in UTC, to the minute."""
    return MISSING if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


# Filters of the templates, and the forms in which they ask for a figure of the document.
FORMS: dict[str, Callable[..., str]] = {
    "accuracy": ACCURACY_H.with_unit,
    "client": without_folders,
    "file_size": lambda size: f"{size / 1e6:.1f} MB" if size >= 95_000 else f"{size / 1e3:.1f} kB",
    "as_json": partial(json.dumps, allow_nan=False),  # in full, for programs that read the page
    "whole": count_text,
    "decibel": decibel,
    "duration": lambda seconds: duration(seconds) or MISSING,
    "in_metres": in_metres,
    "metres": metres,
    "millimetre_fine": partial(number_text, decimals=3),
    "moment": moment,
    "number": number_text,
    "parts_per_million": parts_per_million,
    "plain": lambda value: MISSING if value is None else str(value),
    "ratio": number_text,
    "share": share,
    "signed": signed,
    "signed_volume": signed_volume,
    "similarity": partial(number_text, decimals=4),
    "volume": volume,
    "square_km": lambda km2: MISSING if km2 is None else f"{number_text(km2, 3)} km²",
}


@dataclass(frozen=True)
class Section:
    """Section of a page: `template`, of the `templates/` of its room, shows `facts`; folded: not on paper."""

    anchor: str
    title: str
    template: str
    facts: object
    folded: bool = False


@dataclass(frozen=True)
class Page:
    """Content of a page: name and value of each line of its head, such as the time, then its sections.

    Figures are taken from the JSON document by their path (`figure` in `macros.html`). A cover, which the template
    `cover.html` of the page's room shows, stands in place of the head and is a page of its own on paper. `script`
    is written as it is: it holds no text of users.
    """

    title: str
    subtitle: str
    about: Mapping[str, str]
    sections: Sequence[Section]
    document: Mapping[str, Any] = field(default_factory=dict)
    cover: object = None
    script: str = ""

    @property
    def policy(self) -> str:
        """Content policy: pictures and style in the file, and the script by its hash."""
        policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
        if not self.script:
            return policy
        digest = base64.b64encode(hashlib.sha256(self.script.encode()).digest()).decode("ascii")
        return f"{policy}; script-src 'sha256-{digest}'"


def render_page(page: Page, room: str) -> str:
    """Return the HTML of a page, whose room is the package with the `templates/` of its sections.

    Raises:
        jinja2.UndefinedError: a template names a fact that does not exist.
    """
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(room), PackageLoader("pipelines.report")]),
        autoescape=True,
        finalize=lambda value: printable_lines(value) if type(value) is str else value,  # not of markup
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= FORMS
    environment.globals |= {"value_at": value_at, "forms": FORMS}
    return environment.get_template("frame.html").render(page=page, document=page.document)


def value_at(document: JsonValue, path: str) -> Any:
    """Return the value at a path of keys and indices: `checkpoints.triangulated.points.3.de_m`.

    None where a part on the way is None: a part of a report that does not exist has no figures.

    Raises:
        KeyError, IndexError: the document has no such path.
    """
    for key in path.split("."):
        if document is None:
            return None
        document = document[int(key)] if isinstance(document, list) else document[key]
    return document


_PNG, _JPEG = b"\x89PNG", b"\xff\xd8\xff"
_MOST_LOGO_BYTES, _MOST_LOGO_PIXELS, _LOGO_PX = 4 * 1024 * 1024, 16_000_000, 600
_QUALITY = 82
_PAPER = 255  # behind transparent pixels


@dataclass(frozen=True)
class Picture:
    """Picture as the address of an `img` element: `data:` with the whole picture."""

    address: str
    width_px: int
    height_px: int


def picture_of_png(data: bytes) -> Picture:
    """Return the picture of a PNG that this package drew."""
    size = header_size(data)
    assert size is not None
    return Picture(_address("png", data), *size)


def png_file(path: Path) -> Picture | None:
    """Return a PNG file as it is, or None without one; an InputError: it cannot be read, or is no PNG."""
    if not path.is_file():
        return None
    data = read_bytes(path)
    if header_size(data) is None or not data.startswith(_PNG):
        raise InputError(
            "not-a-png", "is no PNG.", path=path, remedy="Make it again with `georef evaluate --force`."
        )
    return picture_of_png(data)


def picture_of(pixels: ByteArray) -> Picture:
    """Return a photograph (H, W, 3) RGB as JPEG; with transparency (H, W, 4) as WebP, which keeps it."""
    import cv2

    height, width, channels = pixels.shape
    if channels == 4:
        bgra = cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA)
        _, data = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
        return Picture(_address("webp", data.tobytes()), width, height)
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return Picture(_address("jpeg", data.tobytes()), width, height)


def logo_picture(path: Path) -> Picture:
    """Return a logo at the size of a page; an InputError: unreadable, too large, or neither PNG nor JPEG."""
    file_size(path, limit_bytes=_MOST_LOGO_BYTES, kind="logo", field="--logo")
    data = read_bytes(path)
    if not data.startswith((_PNG, _JPEG)):
        raise InputError(
            "logo-not-a-picture", "is neither PNG nor JPEG.", path=path, field="--logo", remedy="Give another file."
        )
    width, height = header_size(data) or (0, 0)
    if width * height > _MOST_LOGO_PIXELS:
        message = f"has {width} × {height} pixels; a logo has at most {_MOST_LOGO_PIXELS // 10**6} million."
        raise InputError("too-many-pixels", message, path=path, field="--logo")
    return picture_of(limited(read_pixels(path), _LOGO_PX))


def read_picture(path: Path) -> ByteArray:
    """Return a picture as (H, W, 3) RGB, transparent pixels on white; errors as of `read_pixels`."""
    pixels = read_pixels(path)
    alpha = pixels[..., 3:] / np.float32(255)
    return np.asarray((pixels[..., :3] * alpha + _PAPER * (1 - alpha)).round().astype(np.uint8))


def read_pixels(path: Path) -> ByteArray:
    """Return a picture as (H, W, 4) RGBA; an InputError: unreadable, or too large."""
    import cv2

    data = read_bytes(path)
    (width, height), pixels = header_size(data) or (0, 0), None
    if 0 < width * height <= MAX_PIXELS:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None or pixels.dtype != np.uint8:
        message = "is no picture that can be shown."
        remedy = "Delete it, or make it again."
        raise InputError("not-a-picture", message, path=path, remedy=remedy)
    to_rgba = {2: cv2.COLOR_GRAY2RGBA, 3: cv2.COLOR_BGR2RGBA, 4: cv2.COLOR_BGRA2RGBA}
    return np.asarray(cv2.cvtColor(pixels, to_rgba[2 if pixels.ndim == 2 else pixels.shape[2]]))


def preview(path: Path, longest_px: int) -> Picture | None:
    """Return a picture of the workspace, as `read_picture`, made smaller if it is larger; None: there is none."""
    return picture_of(limited(read_pixels(path), longest_px)) if path.is_file() else None


def limited(rgb: ByteArray, longest_px: int) -> ByteArray:
    """Return a picture (H, W, 3), made smaller so that its longer side has at most `longest_px` pixels."""
    import cv2

    scale = longest_px / max(rgb.shape[:2])
    if scale >= 1:
        return rgb
    height, width = (max(1, round(side * scale)) for side in rgb.shape[:2])
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA))


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
