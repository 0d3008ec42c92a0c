"""The calibrated camera that a `CameraInfo` states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.formats.image_file import MAX_PIXELS
from pipelines.ingest.bag.topics import SelectedTopics
from pipelines.ingest.camera_priors import camera_priors
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.scene.survey import CameraPrior


def lens_priors(
    photos: Sequence[Photo], topics: SelectedTopics, info: Any | None, options: IngestOptions, notes: Notes
) -> tuple[tuple[CameraPrior, ...], dict[str, int]]:
    """Return one calibrated camera of all photographs, or else assumed ones; and the id of each one's camera.

    Args:
        photos: the photographs.
        topics: whose names tell rectified images.
        info: first `CameraInfo`.
        options: `--focal-px` is stronger than the bag.
        notes: how the lens was found.
    """
    sizes = {(photo.file.width, photo.file.height) for photo in photos}
    if info is None or options.focal_px is not None or len(sizes) != 1:
        return camera_priors(photos, options.focal_px, notes)
    rectified = "rect" in str(topics.image).rpartition("/")[2] or "_rect" in str(topics.image)
    prior, remark = camera_prior(info, rectified)
    (width, height) = next(iter(sizes))
    fitted = scaled_prior(prior, width, height) if prior is not None else None
    if prior is not None and fitted is None:
        remark = f"CameraInfo is of images of {prior.width}×{prior.height}, these are {width}×{height}"
    if fitted is None:
        notes.warn(f"{remark}: it is not used")
        return camera_priors(photos, options.focal_px, notes)
    notes.assume(f"lens from {topics.info}: {remark}")
    return (fitted,), {photo.name: 1 for photo in photos}


def camera_prior(message: Any, rectified: bool) -> tuple[CameraPrior | None, str]:
    """Return the calibration of a `CameraInfo` and a remark on it; no prior where it is not calibrated.

    ROS counts pixels from the centre of the first one, COLMAP from its corner.

    Args:
        message: the `CameraInfo`.
        rectified: the images are rectified already: `p` applies, and no distortion is left.
    """
    matrix = _numbers(message, "p" if rectified else "k").reshape(3, -1)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    width, height = int(message.width), int(message.height)
    lens = _numbers(message, "d")
    numbers = np.array([fx, fy, cx, cy, *lens])
    if not (np.isfinite(numbers).all() and fx > 0 and fy > 0 and 0 < width * height <= MAX_PIXELS):
        return None, "CameraInfo is not calibrated"
    name = str(message.distortion_model).strip().lower()
    state = "rectified" if rectified else name or "no distortion"
    if rectified or not lens.any():
        name, lens = "", lens[:0]
    model, extra = _lens(name, lens)
    if model == "":
        return (
            None,
            f"CameraInfo has distortion_model {name!r} with {len(lens)} coefficients, which is not supported",
        )
    params = tuple(float(value) for value in (fx, fy, cx, cy, *extra))
    prior = CameraPrior(
        camera_id=1, model=model, width=width, height=height, params=params, focal_source="calibrated"
    )
    return prior, f"CameraInfo ({state}): {model} with a focal length of {fx:.1f} px"


def scaled_prior(prior: CameraPrior, width: int, height: int) -> CameraPrior | None:
    """Return the calibration for images of another size but the same shape; None if the shape differs."""
    factor = width / prior.width
    if abs(prior.height * factor - height) > 1.0:
        return None
    fx, fy, cx, cy, *extra = prior.params
    params = (fx * factor, fy * factor, cx * factor, cy * factor, *extra)
    return prior.model_copy(update={"width": width, "height": height, "params": params})


def _lens(name: str, lens: FloatArray) -> tuple[str, list[float]]:
    """Return COLMAP's model and its distortion; an empty name if none fits."""
    if not len(lens):
        return "PINHOLE", []
    if name in ("equidistant", "fisheye") and len(lens) == 4:
        return "OPENCV_FISHEYE", lens.tolist()
    if name == "plumb_bob" and len(lens) in (4, 5):
        k3 = float(lens[4]) if len(lens) == 5 else 0.0
        return ("FULL_OPENCV", [*lens[:4], k3, 0.0, 0.0, 0.0]) if k3 else ("OPENCV", lens[:4].tolist())
    if name == "rational_polynomial" and len(lens) >= 8 and not lens[8:].any():
        return "FULL_OPENCV", lens[:8].tolist()
    return "", []


def _numbers(message: Any, name: str) -> FloatArray:
    """Return a field that ROS 2 writes in small letters, ROS 1 in capitals."""
    values = getattr(message, name, None)
    return np.asarray(getattr(message, name.upper()) if values is None else values, dtype=np.float64)
