"""Identity of the camera behind a photograph's tags: serial numbers, and whether its lens is a fisheye.

Two bodies of one model have two lenses. Their serial numbers stand in EXIF, or in XMP under names that each maker
chose; those of other instruments on board are none of the camera.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from pipelines.formats.exif import PhotoTags
from pipelines.formats.xmp import XmpProperty, number_of

_SERIAL = re.compile(r"serial(number|no|num)?$|(?<=[a-z])SN$", re.IGNORECASE)
_OTHER_INSTRUMENT = re.compile(
    r"sunshine|irradiance|dls|gps|gnss|battery|remote|controller|base|gimbal|flash|panel|rtk|light|ils",
    re.IGNORECASE,
)
_AIRCRAFT = re.compile(r"drone|aircraft|vehicle|uav|skydio|parrot|autel|yuneec", re.IGNORECASE)
_CAMERA = re.compile(r"camera|body|payload|sensor|exif|micasense|pix4d", re.IGNORECASE)
_NO_NUMBER = re.compile(r"[0\W_]*|(n/?a|none|null|unknown|undefined|default|x+|f+|-1)", re.IGNORECASE)

_LENS_NAMES = frozenset(
    {"modeltype", "lenstype", "lensmodel", "lens", "lensprojection", "projection", "projectiontype", "cameramodel"}
    | {"cameratype", "distortionmodel", "lensinfo"}
)
_FISHEYE = re.compile(r"fish[\s_-]?eye|\bequidistant\b|\bf-?theta\b", re.IGNORECASE)
_DEWARPED = ("DewarpFlag", "Dewarped", "IsDewarped")
_NEAR_CENTRE = 0.1  # of a side: a principal point further off is in another unit
_WIDEST_RAD = 1.6  # angle off the axis up to which a fisheye's polynomial is taken over


@dataclass(frozen=True)
class Serials:
    """Serial numbers that a photograph's tags state, empty if they state none."""

    exif_body: str = ""
    xmp_body: str = ""
    lens: str = ""
    aircraft: str = ""

    @property
    def number(self) -> str:
        """Number of the camera for people: of its body, else of the aircraft, and of the lens if that is all."""
        if self.exif_body or self.xmp_body:
            return self.exif_body or self.xmp_body
        return f"aircraft {self.aircraft}" if self.aircraft else f"lens {self.lens}" if self.lens else ""

    @property
    def known(self) -> int:
        return sum(bool(getattr(self, field.name)) for field in fields(self))

    def fits(self, other: "Serials") -> bool:
        """Return whether no number of this one contradicts one of the other; the body outranks its aircraft."""
        names = ["exif_body", "xmp_body", "lens"]
        if not ((self.exif_body and other.exif_body) or (self.xmp_body and other.xmp_body)):
            names.append("aircraft")
        pairs = [(_plain(getattr(self, name)), _plain(getattr(other, name))) for name in names]
        return all(a == b for a, b in pairs if a and b)


def _plain(number: str) -> str:
    return number.casefold().lstrip("0")


def serials_of(tags: PhotoTags) -> Serials:
    """Return the serial numbers of a photograph; placeholders such as `0000` are none."""
    numbers: dict[str, str] = {}
    for key, kind in (
        ("EXIF BodySerialNumber", "exif_body"), ("Image CameraSerialNumber", "exif_body"),
        ("EXIF CameraSerialNumber", "exif_body"), ("Image BodySerialNumber", "exif_body"),
        ("EXIF LensSerialNumber", "lens"), ("Image LensSerialNumber", "lens"),
    ):  # fmt: skip
        tag = tags.exif.get(key)
        if tag is not None and (text := _number_in(tag.text)):
            numbers.setdefault(kind, text)
    for each in tags.xmp.properties:
        role = _role(each)
        if role and (text := _number_in(each.text)):
            numbers.setdefault(role, text)
    return Serials(**numbers)


def _number_in(text: str) -> str:
    number = text.strip("\x00 \t\r\n")
    return "" if _NO_NUMBER.fullmatch(number) else number[:64]


def _role(each: XmpProperty) -> str:
    """Return the field of `Serials` that a property of XMP states, empty if none."""
    if not _SERIAL.search(each.name):
        return ""
    words = f"{each.within} {_SERIAL.sub('', each.name)}"
    if re.search("lens", words, re.IGNORECASE):
        return "lens"
    for text in (words, each.namespace):  # the name says more than the namespace, which may be the maker's
        if _OTHER_INSTRUMENT.search(text):
            return ""
        if _CAMERA.search(text):
            return "xmp_body"
        if _AIRCRAFT.search(text):
            return "aircraft"
    return ""


def grouped_by_serials(serials: Sequence[Serials]) -> list[int]:
    """Return the number of each photograph's camera, of those whose serial numbers do not contradict each other.

    A photograph that lacks a number belongs to the only camera that it fits, or else is of a camera of its own.
    """
    group = [0] * len(serials)
    cameras: list[Serials] = []
    for row in sorted(range(len(serials)), key=lambda row: -serials[row].known):
        fitting = [number for number, camera in enumerate(cameras) if serials[row].fits(camera)]
        if len(fitting) == 1:
            number = fitting[0]
        elif serials[row] in cameras:
            number = cameras.index(serials[row])
        else:
            number = len(cameras)
            cameras.append(serials[row])
        group[row] = number
    order = {number: rank for rank, number in enumerate(dict.fromkeys(group))}
    return [order[number] for number in group]


@dataclass(frozen=True)
class Fisheye:
    """Fisheye lens: principal point, focal length in pixels if stated, k1 and k2 of the equidistant model."""

    centre_px: tuple[float, float]
    focal_px: float | None = None
    k1: float = 0.0
    k2: float = 0.0


def fisheye_of(tags: PhotoTags, width: int, height: int) -> Fisheye | None:
    """Return the fisheye lens that a photograph's tags state; None: a perspective one, or corrected in the camera.

    PIX4D's tags state it as r = C ρ(2θ/π), with a polynomial ρ = p0 + p1 x + p2 x² + …, for the size as taken.
    """
    stated = [each.text for each in tags.xmp.properties if each.name.casefold() in _LENS_NAMES]
    in_exif = (tags.exif.get(key) for key in ("EXIF LensModel", "Image LensModel"))
    is_named = any(_FISHEYE.search(text) for text in (*stated, *(tag.text for tag in in_exif if tag is not None)))
    affine, polynomial = (_numbers(tags.xmp.text(name)) for name in ("FisheyeAffineMatrix", "FisheyePolynomial"))
    perspective = any(re.search(r"\bperspective\b|rectilinear|brown", text, re.IGNORECASE) for text in stated)
    if not (is_named or (affine and not perspective)) or tags.xmp.number(*_DEWARPED) == 1:
        return None
    scale = max(width, height) / (tags.lens.taken_width_px or max(width, height))
    centre_px = _principal_point(tags, width, height, scale)
    focal_px = 0.5 * (affine[0] + affine[3]) * 2 / np.pi * scale if len(affine) == 4 else 0.0
    if not 0 < focal_px < 20 * max(width, height):
        return Fisheye(centre_px)
    if len(polynomial) < 2:
        return Fisheye(centre_px, focal_px)
    angle = np.linspace(0.01, min(np.hypot(width, height) / 2 / focal_px, _WIDEST_RAD), 50)
    radius = np.polynomial.polynomial.polyval(angle * 2 / np.pi, polynomial) * np.pi / 2
    k1, k2 = np.linalg.lstsq(np.stack([angle**3, angle**5], axis=1), radius - angle, rcond=None)[0]
    rises = np.all(1 + 3 * k1 * angle**2 + 5 * k2 * angle**4 > 0)
    return Fisheye(centre_px, focal_px, float(k1), float(k2)) if rises else Fisheye(centre_px, focal_px)


def _principal_point(tags: PhotoTags, width: int, height: int, scale: float) -> tuple[float, float]:
    """Return the principal point that XMP states in millimetres from the first pixel, else the centre."""
    centre = (width / 2.0, height / 2.0)
    stated, px_per_mm = _numbers(tags.xmp.text("PrincipalPoint")), tags.lens.px_per_mm
    if len(stated) != 2 or px_per_mm is None:
        return centre
    x, y = (value * px_per_mm * scale for value in stated)
    near = abs(x - centre[0]) < _NEAR_CENTRE * width and abs(y - centre[1]) < _NEAR_CENTRE * height
    return (x, y) if near else centre


def _numbers(text: str | None) -> list[float]:
    values = [number_of(part) for part in re.split(r"[,\s]+", text.strip())] if text else []
    return [value for value in values if value is not None] if None not in values else []
