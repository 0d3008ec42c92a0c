"""Photographs out of a bag: which frames to take, and each as a file, one at a time.

The calibrated camera that a `CameraInfo` states.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.bag import BadImageError, Bag, ImageWriter, UndecodableError, sharpness
from pipelines.formats.exif import PhotoTags
from pipelines.formats.image_file import MAX_PIXELS, inspect_image
from pipelines.ingest.bag_streams import SampleTimes, SelectedTopics
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import Every, IngestOptions
from pipelines.ingest.photo_folder import Photo, camera_priors
from pipelines.survey.survey import CameraPrior

# A frame is blurred if it is less than half as sharp as the frames around it.
_BLURRED = 0.5
_NEIGHBOURS = 15
_LEAST_NEIGHBOURS = 3
_STEP_SLACK_S = 1e-6


@dataclass
class _FrameChooser:
    """Tells which frames are due."""

    every: Every | None
    last: FloatArray | None = None  # time, or place, of the frame taken last

    def due(self, time_s: float, place: FloatArray | None) -> bool:
        if self.every is None or self.last is None:
            return self.every is None or self.every.unit == "s" or place is not None
        if self.every.unit == "s":
            return bool(time_s - self.last[0] >= self.every.step - _STEP_SLACK_S)
        return place is not None and bool(np.linalg.norm(place - self.last) >= self.every.step)

    def record(self, time_s: float, place: FloatArray | None) -> None:
        self.last = place if self.every is not None and self.every.unit == "m" else np.array([time_s])


class _BlurDetector:
    """Judges sharpness against the frames looked at before, taken or not: a dull scene is not blurred for ever."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_NEIGHBOURS)

    def blurred(self, data: bytes) -> bool:
        current = sharpness(data)
        usual = float(np.median(self._recent)) if len(self._recent) >= _LEAST_NEIGHBOURS else 0.0
        self._recent.append(current)
        return current < _BLURRED * usual


def write_photos(
    bag: Bag,
    topic: str,
    clock: SampleTimes,
    place: FloatArray,
    *,
    options: IngestOptions,
    folder: Path,
    notes: Notes,
    progress: Progress = SILENT,
) -> tuple[list[Photo], list[int]]:
    """Write the chosen frames of `topic` into `folder` as `frame_nnnnnn.jpg` or `.png`, numbered as in the bag.

    Args:
        bag: open.
        topic: of the photographs.
        clock: times of the topic's messages.
        place: (N, 3) Cartesian positions at those times, NaN where unknown.
        options: which frames to take.
        folder: to write into.
        notes: frames that were left out.
        progress: a step a message.

    Returns:
        The photographs, and the number of each one's message.
    """
    folder.mkdir(parents=True, exist_ok=True)
    writer, chooser, blur = ImageWriter(), _FrameChooser(options.every), _BlurDetector()
    photos: list[Photo] = []
    numbers: list[int] = []
    failed: list[str] = []
    blurred, hashes, copies = 0, set(), 0
    with progress.task("photographs", len(clock.time_s)) as task:
        for number, message in enumerate(bag.messages([topic])):
            task.advance()
            if number >= len(clock.time_s) or not clock.usable[number]:
                continue
            time_s = float(clock.time_s[number])
            position = place[number] if np.isfinite(place[number]).all() else None
            if not chooser.due(time_s, position):
                continue
            try:
                data, suffix = writer.encoded(message.type, bag.decode(message))
                name = f"frame_{number:06d}{suffix}"
                file = inspect_image(data, Path(name))
            except (UndecodableError, BadImageError, InputError) as error:
                failed.append(f"message {number} ({str(error)[:120]})")
                continue
            if options.skip_blurred and blur.blurred(data):
                blurred += 1
                continue
            if file.sha256 in hashes:
                copies += 1
                continue
            hashes.add(file.sha256)
            (folder / name).write_bytes(data)
            photos.append(Photo(name, file, PhotoTags(timestamp_s=time_s)))
            numbers.append(number)
            chooser.record(time_s, position)
    notes.warn_counted(failed, f"image of {topic} was left out", f"images of {topic} were left out")
    if blurred:
        notes.warn(f"{blurred} frames are blurred and were passed over")
    if copies:
        notes.warn(f"{copies} frames are copies of earlier ones and were left out")
    if writer.bits is not None:
        notes.assume(f"16-bit images of {topic} have {writer.bits} bits in use, as the first one has")
    return photos, numbers


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
