"""Photographs that several lenses exposed together: which belong to one instant, and which lens is the reference.

The reference lens's photographs are those of the survey. Those of the other lenses accompany them: structure from
motion takes all, with one pose of the rig at each instant, and their places follow from the reference's.

Who was exposed together is told, in this order, by a capture's identifier in XMP, by names that differ in their
last part alone (`IMG_0007_GRE`, `IMG_0007_NIR`), and by the time of exposure; or by the file of `--rig`.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from pipelines.core.errors import InputError
from pipelines.formats.rig_config import read_rig_config
from pipelines.ingest.options import ALL_SENSORS
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.sensors import VISIBLE, chosen_sensor, family_of, name_and_lens

Quaternion = tuple[float, float, float, float]
_CAPTURES = ("CaptureUUID", "CaptureID", "CaptureUniqueID")
_TOGETHER_S = 0.2  # by the time of exposure alone
_TOGETHER_BY_NAME_S = 1.5  # where the name says so, too: clocks count whole seconds
FEWEST_INSTANTS = 3  # of a lens: fewer do not determine its place in the rig


@dataclass(frozen=True)
class Accompanying:
    """Photograph of another lens of a rig, and the name of the reference's that was exposed together with it."""

    photo: Photo
    beside: str


def photos_of_rig(
    photos: list[Photo], sensor: str | None, config: Path | None, remarks: Remarks
) -> tuple[list[Photo], tuple[Accompanying, ...], Mapping[str, Quaternion]]:
    """Return the photographs of one sensor, those of a rig's other lenses beside them, and these lenses' rotations.

    The rotations, lens ← reference as x, y, z, w, are those that the file `config` states, by photograph.

    Raises:
        InputError: as `chosen_sensor` and `read_rig_config`, or no lens was exposed together with the sensor.
    """
    if not photos:
        return photos, (), {}
    if config is not None:
        kept, companions, rotations = _by_rig_file(photos, config)
    elif sensor == ALL_SENSORS:
        kept, rotations = chosen_sensor(photos, None, Remarks()), {}
        companions = exposed_together(photos, kept)
    else:
        return chosen_sensor(photos, sensor, remarks), (), {}
    if not companions:
        raise InputError(
            "no-rig",
            (
                "No lens was exposed together with the reference lens at three instants or more: neither "
                "identifiers of captures, names nor times tell it."
            ),
            field="--sensor" if config is None else "--rig",
            remedy="Give --rig with the names, or one sensor by --sensor.",
        )
    note_rig(photos, kept, companions, remarks)
    return kept, companions, rotations


def exposed_together(photos: Sequence[Photo], reference: Sequence[Photo]) -> tuple[Accompanying, ...]:
    """Return the photographs of other lenses that were exposed together with those of a reference lens.

    Thermal cameras and screens are none of these: their pictures match no others. A lens with fewer than three
    common instants is left out, too.
    """
    used = {photo.name for photo in reference}
    others = [p for p in photos if p.name not in used and family_of(p.sensor) in ("band", "visible")]
    beside: dict[str, str] = {}
    for key in (_capture, _name):
        members: dict[tuple[str, ...], list[Photo]] = {}
        for photo in reference:
            if (instant := key(photo)) is not None:
                members.setdefault(instant, []).append(photo)
        for photo in others:
            instant = key(photo)
            candidates = members.get(instant, []) if instant is not None and photo.name not in beside else []
            near = [each for each in candidates if _apart_s(each, photo) <= _TOGETHER_BY_NAME_S]
            if len(near) == 1:
                beside[photo.name] = near[0].name
    for photo in others:
        if photo.name not in beside and photo.tags.xmp.text("RigName", "RigCameraIndex") is not None:
            near = [each for each in reference if _apart_s(each, photo, unknown=1e9) <= _TOGETHER_S]
            if len(near) == 1:
                beside[photo.name] = near[0].name
    return _sound([Accompanying(photo, beside[photo.name]) for photo in others if photo.name in beside])


def _capture(photo: Photo) -> tuple[str, ...] | None:
    text = photo.tags.xmp.text(*_CAPTURES)
    return None if text is None or not text.strip("0- ") else (text.strip(),)


def _name(photo: Photo) -> tuple[str, ...] | None:
    prefix, last = name_and_lens(photo.name)
    return (PurePosixPath(photo.name).parent.as_posix(), prefix) if last else None


def _apart_s(one: Photo, other: Photo, unknown: float = 0.0) -> float:
    first, second = one.tags.timestamp_s, other.tags.timestamp_s
    return unknown if first is None or second is None else abs(first - second)


def _sound(companions: Iterable[Accompanying]) -> tuple[Accompanying, ...]:
    """Return those with one photograph for each lens and instant, of lenses with instants enough."""
    single: dict[tuple[str, str], Accompanying] = {}
    for each in companions:
        single.setdefault((each.photo.sensor, each.beside), each)
    count = Counter(sensor for sensor, _ in single)
    return tuple(each for (sensor, _), each in single.items() if count[sensor] >= FEWEST_INSTANTS)


def _by_rig_file(
    photos: Sequence[Photo], path: Path
) -> tuple[list[Photo], tuple[Accompanying, ...], dict[str, Quaternion]]:
    """Return the reference's photographs, those beside them, and the stated rotations by photograph of the lens.

    Photographs of none of the file's lenses stay photographs of the survey.
    """
    survey = list(photos)
    accompanying: list[Accompanying] = []
    rotations: dict[str, Quaternion] = {}
    names = {photo.name for photo in photos}
    for rig in read_rig_config(path):
        prefix = rig.lenses[0].prefix
        for lens in rig.lenses:
            members = [photo for photo in survey if photo.name.startswith(lens.prefix)]
            if not members:
                raise InputError(
                    "rig-prefix-unknown",
                    f"No photograph's name begins with {lens.prefix!r}: the folder has {photos[0].name!r} …",
                    path=path,
                    field="--rig",
                )
            survey = [photo for photo in survey if photo not in members]
            # Lenses alike in all their tags are cameras of their own.
            members = [replace(photo, sensor=photo.sensor or _lens_name(lens.prefix)) for photo in members]
            if lens.prefix == prefix:
                survey = sorted([*survey, *members], key=lambda photo: photo.name)
                continue
            for photo in members:
                other = prefix + photo.name.removeprefix(lens.prefix)
                if other in names:
                    accompanying.append(Accompanying(photo, other))
                    if lens.quat_xyzw is not None:
                        rotations[photo.name] = lens.quat_xyzw
    return survey, tuple(accompanying), rotations


def _lens_name(prefix: str) -> str:
    return prefix.strip("/_-. ").casefold().replace("/", "-") or "lens"


def note_rig(
    photos: Sequence[Photo], reference: Sequence[Photo], companions: Sequence[Accompanying], remarks: Remarks
) -> None:
    """Note the lenses of a rig, and warn of photographs of its other lenses that stay alone."""
    count = Counter(each.photo.sensor or VISIBLE for each in companions)
    instants = len({each.beside for each in companions})
    lenses = ", ".join(f"{sensor} ({number})" for sensor, number in count.items())
    main = ", ".join(sorted({photo.sensor or VISIBLE for photo in reference}))
    remarks.assume(
        "rig",
        f"A rig of several lenses exposed together at {instants} instants: {main}, which is the reference, and "
        f"{lenses}. It has one pose at each instant, and the poses of the lenses in it are estimated. The splat is "
        "trained from the reference lens.",
    )
    used = {photo.name for photo in reference} | {each.photo.name for each in companions}
    remarks.warn_counted(
        "rig-photograph-alone",
        sorted(photo.name for photo in photos if photo.name not in used),
        "Photographs of other lenses were not exposed together with one of the reference lens, and are left out",
    )
