"""Pictures in a folder of photographs that are none of the survey: reduced copies, panoramas, blurred ones.

Servers, viewers and other programs leave them beside the photographs, with the tags of these. They are left out,
and a remark names them.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np

from pipelines.core.errors import InputError
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks

_PANORAMA_NAME = re.compile(
    r"(?<![a-z])(pano(rama)?s?|stitch(ed)?|equirect(angular)?|(photo)?sphere|(?<!\d)360)(?![a-z\d])", re.IGNORECASE
)
_PANORAMA_SHAPE = 1.9  # of the sides of a picture whose name says panorama: parts of one are 4:3 or 3:2
_SPHERE_CAMERAS = re.compile(r"theta|insta ?360|gopro (max|fusion)|gear ?360|qoocam|mi sphere", re.IGNORECASE)
_FLAT = frozenset({"perspective", "rectilinear", "fisheye", "planar"})  # projections of XMP that are no panorama
_SAME, _SURE, _SAME_SIZE = 0.7, 0.95, 0.98  # correlations of two pictures
_SAME_PLACE_DEG = 1e-6  # a tenth of a metre: programs write fractions anew
_PLAIN = 2.0  # σ of the grey values of a picture that shows nothing to compare


BLURRED = 0.5  # of the sharpness of the pictures around: a blurred one has less
_AROUND, _LEAST_AROUND = 4, 3  # photographs before and after, by which sharpness is judged


def with_sharpness(photos: Sequence[Photo]) -> list[Photo]:
    """Return the photographs with their sharpness over that of those around in time, of the same camera.

    Forest, fields and water differ by more than blur does, but not from one photograph to the next. Of the medians
    before and after a photograph the lower one counts: the first one of a lake is as sharp as the next.
    """
    relative: dict[str, float] = {}
    cameras: dict[object, list[Photo]] = {}
    for photo in photos:
        kind = (photo.file.width, photo.file.height, photo.tags.make_model, photo.sensor)
        cameras.setdefault(kind, []).append(photo)
    for members in cameras.values():
        timed = all(photo.tags.timestamp_s is not None for photo in members)
        known = [photo for photo in members if photo.file.sharpness > 0.0]
        known.sort(key=lambda photo: (photo.tags.timestamp_s or 0.0) if timed else 0.0)  # else by name, as they are
        for index, photo in enumerate(known):
            sides = known[max(index - _AROUND, 0) : index], known[index + 1 : index + 1 + _AROUND]
            if sum(map(len, sides)) >= _LEAST_AROUND:
                usual = min(np.median([one.file.sharpness for one in side]) for side in sides if side)
                relative[photo.name] = float(photo.file.sharpness / usual)
    return [replace(photo, sharpness=relative.get(photo.name)) for photo in photos]


def without_blurred(photos: Sequence[Photo], remarks: Remarks) -> list[Photo]:
    """Return the photographs without those that are less than half as sharp as the ones around."""
    blurred = {photo.name: photo.sharpness for photo in photos if (photo.sharpness or 1.0) < BLURRED}
    remarks.warn_counted(
        "photographs-blurred",
        [f"{name} ({share:.2f})" for name, share in blurred.items()],
        f"Photographs have less than {BLURRED:g} of the sharpness of those around, and are left out",
    )
    return [photo for photo in photos if photo.name not in blurred]


def without_panoramas(photos: Sequence[Photo], remarks: Remarks) -> list[Photo]:
    """Return the photographs without stitched panoramas, which no lens sees.

    Raises:
        InputError: all are panoramas.
    """
    shapes: dict[str, list[bool]] = {}
    for photo in photos:
        shapes.setdefault(photo.tags.make_model, []).append(_is_sphere(photo))
    # Some telephones take photographs of 2:1: those of a panorama are the fewer ones.
    few = {model for model, spheres in shapes.items() if 2 * sum(spheres) < len(spheres)}
    panoramas = {photo.name for photo in photos if _is_panorama(photo, photo.tags.make_model in few)}
    if panoramas and len(panoramas) == len(photos):
        raise InputError(
            "only-panoramas",
            f"All {len(photos)} pictures are stitched panoramas, which have no lens.",
            field="--images",
            remedy="Give the photographs that they were made of, or perspective views cut out of them.",
        )
    remarks.warn_counted(
        "image-panorama", sorted(panoramas), "Stitched panoramas are no photographs of one lens, and are left out"
    )
    return [photo for photo in photos if photo.name not in panoramas]


def _is_panorama(photo: Photo, spheres_are_few: bool) -> bool:
    """Return whether a picture is a panorama: by XMP, by name and shape, or 2:1 among others of its camera."""
    xmp = photo.tags.xmp
    projection = xmp.text("ProjectionType", namespace="panorama")
    if projection is not None:
        return projection.strip().casefold() not in _FLAT
    if xmp.text("FullPanoWidthPixels", "FullPanoHeightPixels", namespace="panorama") is not None:
        return True
    sides = photo.file.width, photo.file.height
    if max(sides) >= _PANORAMA_SHAPE * min(sides) and _PANORAMA_NAME.search(photo.name):
        return True
    return _is_sphere(photo) and (spheres_are_few or _SPHERE_CAMERAS.search(photo.tags.make_model) is not None)


def _is_sphere(photo: Photo) -> bool:
    return abs(photo.file.width - 2 * photo.file.height) <= 1


def without_reduced_copies(photos: Sequence[Photo], remarks: Remarks) -> list[Photo]:
    """Return the photographs without copies of others that differ in size or compression; one of each stays.

    A copy has the shape of the larger picture and its name or its instant, and shows the same.
    """
    rivals: dict[object, list[Photo]] = {}
    copies: dict[str, str] = {}
    for photo in sorted(photos, key=lambda photo: (photo.tags.gps is None, -photo.file.width * photo.file.height)):
        second = photo.tags.timestamp_s
        keys: list[object] = [_stem(photo), *([] if second is None else [(math.floor(second), photo.tags.model)])]
        original = next((one for key in keys for one in rivals.get(key, []) if _is_copy(photo, one)), None)
        if original is not None:
            copies[photo.name] = original.name
            continue
        for key in keys:
            rivals.setdefault(key, []).append(photo)
    remarks.warn_counted(
        "image-reduced-copies",
        [f"{photo.name} (of {copies[photo.name]})" for photo in photos if photo.name in copies],
        "Smaller or recompressed copies of other photographs are left out",
    )
    return [photo for photo in photos if photo.name not in copies]


def _is_copy(small: Photo, large: Photo) -> bool:
    """Return whether a photograph is another one again, at the same size or a smaller one."""
    if small.sensor and large.sensor and small.sensor != large.sensor:
        return False
    scale = small.file.width / large.file.width
    # A side is rounded to whole pixels, and the shape is known no better.
    if scale > 1 or abs(small.file.height - scale * large.file.height) > 1 + scale:
        return False
    same_exposure, same_stem, likeness = (
        _is_same_exposure(small, large),
        _stem(small) == _stem(large),
        _likeness(small, large),
    )
    if same_exposure is False:
        return False
    if likeness is None:  # not decoded, or nothing to compare
        return bool(same_stem and same_exposure and scale < 1)
    if scale == 1:
        return same_stem and likeness >= _SAME_SIZE
    return likeness >= (_SAME if same_stem and same_exposure else _SURE)


def _stem(photo: Photo) -> str:
    return PurePosixPath(photo.name).stem.casefold()


def _is_same_exposure(a: Photo, b: Photo) -> bool | None:
    """Return whether the tags of two photographs tell one exposure; None: one of them has lost its tags."""
    equal: list[bool] = []
    if a.tags.make_model and b.tags.make_model:
        equal.append(a.tags.make_model == b.tags.make_model)
    if a.tags.timestamp_s is not None and b.tags.timestamp_s is not None:
        equal.append(abs(a.tags.timestamp_s - b.tags.timestamp_s) < 1.0)  # fractions have a tag of their own
    if a.tags.gps is not None and b.tags.gps is not None:
        places = [(one.lat_deg, one.lon_deg) for one in (a.tags.gps, b.tags.gps)]
        equal.append(bool(np.abs(np.diff(places, axis=0)).max() < _SAME_PLACE_DEG))
    if not all(equal):
        return False
    return True if len(equal) > 1 else None


def _likeness(a: Photo, b: Photo) -> float | None:
    """Return the correlation of two whole pictures; None: they are not known, or show nothing."""
    if not a.file.miniature or not b.file.miniature:
        return None
    grey = [np.frombuffer(photo.file.miniature, np.uint8).astype(float) for photo in (a, b)]
    if min(one.std() for one in grey) < _PLAIN:
        return None
    return float(np.corrcoef(grey)[0, 1])
