"""Cameras before any reconstruction: focal length in pixels from a photograph's lens tags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from pipelines.formats.exif import PhotoTags
from pipelines.ingest.notes import Notes
from pipelines.ingest.photo_folder import Photo
from pipelines.scene.survey import CameraPrior

# Longer side of the sensor in mm, for cameras that survey; a crop to 16:9 keeps the full width.
_SENSOR_WIDTH_MM = {
    "FC220": 6.17, "FC2103": 6.17, "FC2204": 6.17, "FC2403": 6.17, "FC300C": 6.17, "FC300S": 6.17,
    "FC300X": 6.17, "FC330": 6.17, "FC350": 6.17, "FC7203": 6.17, "FC7303": 6.17, "FC3170": 6.4,
    "FC3582": 9.6, "FC8482": 9.6, "FC3411": 13.2, "FC6310": 13.2, "FC6310R": 13.2, "FC6310S": 13.2,
    "FC6510": 13.2, "L1D-20C": 13.2, "FC550": 17.3, "FC6520": 17.3, "L2D-20C": 17.3, "M3E": 17.3,
    "M4E": 17.3, "FC6540": 23.5, "ZENMUSEP1": 35.9,
}  # fmt: skip
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# Without any lens tag: between a wide drone lens (0.6) and a phone's (0.8 …); OpenDroneMap starts with it too.
ASSUMED_RATIO = 0.85
FocalSource = Literal["exif", "assumed"]


def focal_px(tags: PhotoTags, width: int, height: int) -> tuple[float, FocalSource, str]:
    """Return the focal length in pixels of a stored image, its source, and a sentence on it.

    In this order: real focal length and the sensor's width in a table; real focal length and focal plane
    resolution (scaled by how much smaller the image is than when it was taken); 35 mm equivalent by the diagonal
    (CIPA DCG-001); else 0.85 of the longer side.

    Args:
        tags: of the photograph.
        width: of the stored image in pixels.
        height: of the stored image in pixels.
    """
    lens, long_side = tags.lens, max(width, height)
    sensor_mm = _SENSOR_WIDTH_MM.get(tags.model.strip().upper())
    if lens.focal_mm and sensor_mm:
        focal = lens.focal_mm * lens.zoom / sensor_mm * long_side
        return focal, "exif", f"from {lens.focal_mm:g} mm on a sensor {sensor_mm:g} mm wide"
    if lens.focal_mm and lens.px_per_mm:
        original_width_px = lens.taken_width_px or long_side
        focal = lens.focal_mm * lens.zoom * lens.px_per_mm * long_side / original_width_px
        if 0.2 * long_side < focal < 20.0 * long_side:  # the tag is often nonsense
            return focal, "exif", f"from {lens.focal_mm:g} mm and the focal plane resolution"
    if lens.focal_35mm_mm:
        focal = lens.focal_35mm_mm / _FILM_DIAGONAL_MM * math.hypot(width, height)
        return focal, "exif", f"from {lens.focal_35mm_mm:g} mm on 35 mm film"
    return ASSUMED_RATIO * long_side, "assumed", f"assumed as {ASSUMED_RATIO:g} of the longer side"


def camera_priors(
    photos: Sequence[Photo], given_focal_px: float | None, notes: Notes
) -> tuple[tuple[CameraPrior, ...], dict[str, int]]:
    """Return a prior for each size, camera model and focal length; and the id of each image's camera by name.

    Args:
        photos: the images.
        given_focal_px: focal length to use instead of EXIF's.
        notes: how each focal length was found.
    """
    cameras: dict[tuple[int, int, str, float], CameraPrior] = {}
    camera_of: dict[str, int] = {}
    for photo in photos:
        width, height = photo.file.width, photo.file.height
        name = photo.tags.make_model.strip()
        focal, source, origin = focal_px(photo.tags, width, height)
        if given_focal_px is not None:
            focal, origin = given_focal_px, "from --focal-px"
        key = (width, height, name, round(focal, 1))
        if key not in cameras:
            cameras[key] = CameraPrior(
                camera_id=len(cameras) + 1,
                model="SIMPLE_RADIAL",
                width=width,
                height=height,
                params=(focal, width / 2.0, height / 2.0, 0.0),
                focal_source=source if given_focal_px is None else "option",
                make_model=name,
            )
            notes.assume(f"focal length of {name or 'the camera'} at {width}×{height}: {focal:.1f} px, {origin}")
        camera_of[photo.name] = cameras[key].camera_id
    sizes = sorted({(width, height) for width, height, _, _ in cameras})
    if len(sizes) > 1:
        listed = ", ".join(f"{width}×{height}" for width, height in sizes)
        notes.warn(f"images have {len(sizes)} sizes ({listed}): each is a camera of its own")
    return tuple(cameras.values()), camera_of
