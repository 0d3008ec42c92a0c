"""Sensors of the photographs in a folder, of which a survey uses one: wide or zoom, thermal, or a band of a rig.

Lenses beside each other take one instant from places some centimetres apart, with focal lengths of their own. As
photographs of one camera, they would put that camera decimetres off. A photograph's sensor is what its XMP says;
else what its name says, where the folder's names have that form; else its size beside that of the others.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Literal

from pipelines.core.errors import InputError
from pipelines.formats.xmp import number_of
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks

Family = Literal["visible", "band", "thermal", "screen"]
VISIBLE, WIDE, ZOOM, THERMAL, SCREEN = "visible", "wide", "zoom", "thermal", "screen"
_FAMILIES: tuple[Family, ...] = ("visible", "band", "thermal", "screen")  # in the order of the default
_FAMILY_OF: dict[str, Family] = {
    "": "visible", VISIBLE: "visible", WIDE: "visible", ZOOM: "visible", THERMAL: "thermal", SCREEN: "screen"
}  # fmt: skip
_BEST_FIRST = (VISIBLE, WIDE, ZOOM, "green", "red", "panchromatic", "nir", "red-edge", "blue")
_COLOURS_NM = ((500, "blue"), (600, "green"), (690, "red"), (760, "red-edge"), (3000, "nir"))  # up to a wavelength
_LEAST_IMAGES = 3  # that a survey needs
_NEARLY_ALL = 0.5  # of the most frequent sensor of a family: a better one with so many photographs is preferred
_ALIASES = {
    "rgb": VISIBLE, "visual": VISIBLE, "color": VISIBLE, "colour": VISIBLE, "infrared": THERMAL, "ir": THERMAL,
    "lwir": THERMAL, "tele": ZOOM, "near-infrared": "nir", "rededge": "red-edge",
}  # fmt: skip

# Properties of XMP that say which camera of a payload took a photograph (DJI, Skydio, Autel and others).
_SOURCES = ("ImageSource", "CameraSource", "SourceCamera", "SensorType", "CameraType")
_WORDS = (
    (r"thermal|infra-?red|lwir|\bir\b", THERMAL),
    (r"wide", WIDE),
    (r"zoom|tele", ZOOM),
    (r"visible|visual|\brgb\b|colou?r|\beo\b", VISIBLE),
    (r"screen", SCREEN),
)
# Last part of a file's name. Most mean this in names of DJI, and where several names differ in them alone.
_SUFFIXES = {
    "t": THERMAL, "thrm": THERMAL, "thermal": THERMAL, "ir": THERMAL, "tir": THERMAL, "lwir": THERMAL,
    "infrared": THERMAL, "w": WIDE, "wide": WIDE, "z": ZOOM, "zoom": ZOOM, "tele": ZOOM, "v": VISIBLE,
    "vis": VISIBLE, "visible": VISIBLE, "d": VISIBLE, "rgb": VISIBLE, "eo": VISIBLE, "s": SCREEN, "scrn": SCREEN,
    "b": "blue", "blu": "blue", "blue": "blue", "g": "green", "gre": "green", "green": "green", "r": "red",
    "red": "red", "re": "red-edge", "reg": "red-edge", "rededge": "red-edge", "nir": "nir", "n": "nir",
    "pan": "panchromatic",
}  # fmt: skip
# Those that mean a sensor by themselves: a roof may be red.
_ALONE = frozenset({"thrm", "thermal", "infrared", "lwir", "tir", "nir", "rgb"})
_THERMAL_NAME = re.compile(r"(irx?|flir|thermal)[_-]?\d", re.IGNORECASE)
# Sensors of thermal cameras, in pixels.
_THERMAL_SIZES = frozenset(
    {(160, 120), (160, 128), (256, 192), (320, 240), (320, 256), (336, 256), (384, 288), (640, 480), (640, 512)}
    | {(1024, 768), (1280, 1024)}
)
_MUCH_WIDER = 1.5
_LENSES = range(3, 11)  # of a multispectral rig
_TOGETHER_S = 1.5  # between the lenses of a rig


def with_sensors(photos: Sequence[Photo]) -> list[Photo]:
    """Return the photographs with the names of their sensors, empty where nothing tells one."""
    sensor_of: dict[str, str] = {}
    for rule in (_by_xmp, _by_suffix, _by_number, _by_size):
        sensor_of |= rule([photo for photo in photos if photo.name not in sensor_of], photos)
    sensor_of = _sensors_by_band(photos, sensor_of)
    return _with_common_sensor([replace(photo, sensor=sensor_of.get(photo.name, "")) for photo in photos])


def chosen_sensor(photos: Sequence[Photo], wanted: str | None, remarks: Remarks) -> list[Photo]:
    """Return the photographs of one sensor, the wanted one or by default a visible one; the others are named.

    Of cameras of two models, each has its own: two drones with one lens each are no wide and zoom pair.

    Raises:
        InputError: no photograph is of the wanted sensor; lists those that the folder holds.
    """
    counts = Counter(photo.sensor or VISIBLE for photo in photos)
    if wanted is None:
        kept = _of_family(photos, _default_family(counts))
    elif (sensor_name := _wanted(wanted, counts)) == VISIBLE:
        kept = _of_family(photos, "visible")
    else:
        kept = [photo for photo in photos if photo.sensor == sensor_name]
    used = {photo.name for photo in kept}
    others: dict[str, list[str]] = {}
    for photo in photos:
        if photo.name not in used:
            others.setdefault(photo.sensor or VISIBLE, []).append(photo.name)
    if others:
        chosen = Counter(photo.sensor or VISIBLE for photo in kept).items()
        listed = "; ".join(f"{sensor} ({len(names)}), {_span(names)}" for sensor, names in others.items())
        remarks.warn(
            "other-sensors",
            f"The photographs are of {len(counts)} sensors, each with a lens of its own. Those of the sensor "
            f"{' and '.join(f'{sensor} ({count})' for sensor, count in chosen)} are used, and the others are left "
            f"out: {listed}.",
            f"Choose another with --sensor {'|'.join(others)}, or with --sensor all those that were exposed "
            "together, as a rig.",
        )
    return kept


def _span(names: Sequence[str]) -> str:
    """Return the first and the last of some names."""
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def family_of(sensor: str) -> Family:
    """Return the family of a sensor; all that have no name of their own are bands."""
    return _FAMILY_OF.get(sensor, "band")


def _default_family(counts: Mapping[str, int]) -> Family:
    for least in (_LEAST_IMAGES, 1):
        for family in _FAMILIES:
            if any(count >= least for sensor, count in counts.items() if family_of(sensor) == family):
                return family
    raise AssertionError("a folder without photographs has been refused before")


def _of_family(photos: Sequence[Photo], family: Family) -> list[Photo]:
    """Return the photographs of the best sensor of a family, for each model of camera."""
    members = [photo for photo in photos if family_of(photo.sensor) == family]
    lenses = Counter(photo.sensor for photo in members if photo.sensor in (WIDE, ZOOM))
    lens = _best(lenses) if lenses else ""
    of_model: dict[str, Counter[str]] = {}
    for photo in members:
        if photo.sensor not in (WIDE, ZOOM) or photo.sensor == lens:
            of_model.setdefault(photo.tags.make_model, Counter())[photo.sensor] += 1
    best = {model: _best(counts) for model, counts in of_model.items()}
    return [photo for photo in members if best.get(photo.tags.make_model) == photo.sensor]


def _best(counts: Mapping[str, int]) -> str:
    """Return the first sensor in the order of the default of those with nearly as many photographs as any."""
    least = _NEARLY_ALL * max(counts.values())
    return min((sensor for sensor, count in counts.items() if count >= least), key=_rank)


def _rank(name: str) -> tuple[int, str]:
    """Return the place of a sensor in the order of the default; of a band, by its colour."""
    colour = re.sub(r"-[\d.]+$", "", name or VISIBLE)
    wavelength = re.fullmatch(r"([\d.]+)-nm", name)
    if wavelength is not None:
        colour = next((each for most, each in _COLOURS_NM if float(wavelength[1]) < most), "")
    return (_BEST_FIRST.index(colour) if colour in _BEST_FIRST else len(_BEST_FIRST)), name


def _wanted(text: str, counts: Mapping[str, int]) -> str:
    slug = _slug(text)
    slug = _ALIASES.get(slug, slug)
    if slug == VISIBLE and any(family_of(name) == "visible" for name in counts):
        return VISIBLE
    forms: tuple[Callable[[str], bool], ...] = (
        lambda name: name == slug,
        lambda name: re.fullmatch(rf"{re.escape(slug)}-[\d.]+", name) is not None,  # green of green-531
        lambda name: slug.removesuffix("-nm").removesuffix("nm") in name.split("-"),  # 531 of green-531 or 531-nm
    )
    for form in forms:
        if len(matching := [name for name in counts if form(name)]) == 1:
            return matching[0]
    listed = ", ".join(f"{name} ({count})" for name, count in counts.items())
    raise InputError(
        "no-such-sensor",
        f"No photograph is of the sensor {text!r}. The folder has photographs of: {listed}.",
        field="--sensor",
        remedy="Give one of these.",
    )


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9.]+", "-", text.strip().casefold()).strip("-")


def _by_xmp(photos: Sequence[Photo], _all: Sequence[Photo]) -> dict[str, str]:
    sensor_of = {}
    for photo in photos:
        sensor = _stated(photo)
        if sensor is not None:
            sensor_of[photo.name] = sensor
    return sensor_of


def _stated(photo: Photo) -> str | None:
    """Return the sensor that XMP states: by band, by source of the picture, by wavelength, by lens of a rig."""
    xmp = photo.tags.xmp
    bands = [part for text in xmp.texts("BandName") for part in re.split(r"[,;|/]", text) if part.strip()]
    if bands:
        return _band(bands)
    for name in _SOURCES:
        for text in xmp.texts(name):
            spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|_", " ", text).casefold()
            for pattern, sensor in _WORDS:
                if re.search(pattern, spaced):
                    return sensor
    wavelengths = [value for text in xmp.texts("CentralWavelength") if (value := number_of(text)) is not None]
    if len(wavelengths) == 1 and photo.file.channels < 3:
        return _of_wavelength(wavelengths[0])
    index = xmp.text("RigCameraIndex")
    if index is None:
        return None
    return VISIBLE if photo.file.channels >= 3 else f"lens-{index.strip()}"


def _band(names: Sequence[str]) -> str:
    """Return the sensor of a band, or of a picture with several."""
    slugs = []
    for name in names:
        slug = re.sub(r"red-?edge|^reg?\b", "red-edge", _slug(name))
        slug = re.sub(r"^(near-?(ir|infrared)|n)$", "nir", slug)
        slugs.append(re.sub(r"^panchro\w*|^pan$", "panchromatic", slug))
    if {"red", "green", "blue"} <= set(slugs) or slugs[0] in ("rgb", "color", "colour", "visible"):
        return VISIBLE
    if any(re.search(r"lwir|thermal|tir", slug) for slug in slugs):
        return THERMAL
    return "-".join(dict.fromkeys(slugs))


def _of_wavelength(nanometres: float) -> str:
    """Return the sensor of a wavelength, which some makers state in micrometres."""
    value = nanometres * 1000 if nanometres < 100 else nanometres
    if value > 3000:
        return THERMAL
    return f"{value:g}-nm"


def _by_suffix(photos: Sequence[Photo], everything: Sequence[Photo]) -> dict[str, str]:
    """Return sensors by the last part of names such as `DJI_0007_T`, `IMG_0007_NIR`."""
    parts = {photo.name: name_and_lens(photo.name) for photo in photos}
    of_prefix: dict[str, set[str]] = {}
    for photo in everything:
        prefix, suffix = name_and_lens(photo.name)
        if suffix in _SUFFIXES:
            of_prefix.setdefault(prefix, set()).add(suffix)
    in_pairs = sum(len(suffixes) > 1 for suffixes in of_prefix.values()) > 1
    suffixes = set().union(*of_prefix.values()) if of_prefix else set()
    sensor_of = {}
    for photo in photos:
        prefix, suffix = parts[photo.name]
        sensor = _SUFFIXES.get(suffix)
        is_dji = PurePosixPath(photo.name).name.casefold().startswith("dji_")
        if sensor is None or not (suffix in _ALONE or in_pairs or is_dji):
            continue
        if suffix == "r" and not suffixes & {"g", "re", "nir"}:
            sensor = THERMAL  # FLIR's radiometric JPEG of DJI's Zenmuse XT
        sensor_of[photo.name] = sensor
    return sensor_of


def name_and_lens(name: str) -> tuple[str, str]:
    """Return a file's name up to its last underscore or hyphen, and what follows, both in small letters."""
    stem = PurePosixPath(name).stem.casefold()
    cut = max(stem.rfind("_"), stem.rfind("-"))
    return (stem, "") if cut < 0 else (stem[:cut], stem[cut + 1 :])


def _by_number(photos: Sequence[Photo], _all: Sequence[Photo]) -> dict[str, str]:
    """Return the lenses of a rig by names such as `IMG_0007_1` … `_5`: grey pictures, alike in number and time."""
    groups: dict[str, dict[str, Photo]] = {}
    for photo in photos:
        prefix, number = name_and_lens(photo.name)
        if photo.file.channels < 3 and re.fullmatch(r"\d{1,2}", number):
            groups.setdefault(prefix, {})[number] = photo
    if len(groups) < 2:
        return {}
    usual = Counter(frozenset(group) for group in groups.values()).most_common(1)[0][0]
    first = sorted(int(number) for number in usual)
    if len(usual) not in _LENSES or first[0] > 1 or first != list(range(first[0], first[0] + len(first))):
        return {}
    if not all(set(group) <= usual and _together(group.values()) for group in groups.values()):
        return {}
    return {photo.name: f"lens-{n}" for group in groups.values() for n, photo in group.items()}


def _together(photos: Iterable[Photo]) -> bool:
    times = [photo.tags.timestamp_s for photo in photos if photo.tags.timestamp_s is not None]
    return not times or max(times) - min(times) <= _TOGETHER_S


def _by_size(photos: Sequence[Photo], _all: Sequence[Photo]) -> dict[str, str]:
    """Return the thermal photographs beside larger ones, by their size.

    Their maker, name or folder says so, or they have a shape that the larger ones of the same model lack.
    """
    shapes: dict[str, set[tuple[int, float]]] = {}
    for photo in photos:
        width, height = _sides(photo)
        shapes.setdefault(photo.tags.make_model, set()).add((width, round(width / height, 2)))
    widest = max((width for members in shapes.values() for width, _ in members), default=0)
    sensor_of = {}
    for photo in photos:
        width, height = _sides(photo)
        if (width, height) not in _THERMAL_SIZES or not widest > _MUCH_WIDER * width:
            continue
        parts = [part.casefold() for part in PurePosixPath(photo.name).parts]
        is_thermal = "flir" in photo.tags.make_model.casefold() or _THERMAL_NAME.match(parts[-1]) is not None
        is_thermal |= any(_ALIASES.get(part, part) == THERMAL for part in parts[:-1])
        larger = {shape for wide, shape in shapes[photo.tags.make_model] if wide > _MUCH_WIDER * width}
        if is_thermal or (photo.tags.make_model and larger and round(width / height, 2) not in larger):
            sensor_of[photo.name] = THERMAL
    return sensor_of


def _sides(photo: Photo) -> tuple[int, int]:
    width, height = photo.file.width, photo.file.height
    return max(width, height), min(width, height)


def _sensors_by_band(photos: Sequence[Photo], sensor_of: Mapping[str, str]) -> dict[str, str]:
    """Return the sensors, bands of one camera and name but of different wavelengths or lenses told apart."""
    members: dict[tuple[str, str], list[Photo]] = {}
    for photo in photos:
        if family_of(sensor_of.get(photo.name, "")) == "band":
            members.setdefault((photo.tags.make_model, sensor_of[photo.name]), []).append(photo)
    result = dict(sensor_of)
    readings: tuple[Callable[[Photo], str], ...] = (
        lambda photo: f"{photo.tags.xmp.number('CentralWavelength') or 0:.0f}",
        lambda photo: photo.tags.xmp.text("RigCameraIndex") or "",
    )
    for (_, sensor), of_sensor in members.items():
        for reading in readings:
            if len({reading(photo) for photo in of_sensor}) > 1:
                result |= {photo.name: f"{sensor}-{reading(photo)}" for photo in of_sensor}
                break
    return result


def _with_common_sensor(photos: list[Photo]) -> list[Photo]:
    """Return the photographs, those without a stated sensor with that of all others of their model and size."""
    known: dict[tuple[object, ...], set[str]] = {}
    for photo in photos:
        if photo.sensor:
            known.setdefault(_likeness(photo), set()).add(photo.sensor)
    return [
        replace(photo, sensor=next(iter(sensors)))
        if not photo.sensor and len(sensors := known.get(_likeness(photo), set())) == 1
        else photo
        for photo in photos
    ]


def _likeness(photo: Photo) -> tuple[object, ...]:
    suffix = PurePosixPath(photo.name).suffix.casefold()
    return (photo.tags.make_model, photo.file.width, photo.file.height, photo.file.channels, suffix)
