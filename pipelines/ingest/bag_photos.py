"""Photographs from a bag: the selected frames, written as files one at a time, and their lens."""

from collections import deque
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.bag import BadImageError, Bag, ImageWriter, RawMessage, UndecodableError
from pipelines.formats.exif import PhotoTags
from pipelines.formats.image_file import MAX_PIXELS, ImageFile, inspect_image
from pipelines.ingest.bag_streams import CameraStream, TopicSamples
from pipelines.ingest.options import Every, IngestOptions
from pipelines.ingest.photo_folder import Photo, camera_priors
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.stray_pictures import BLURRED
from pipelines.survey.survey import CameraPrior

_NEIGHBOURS = 15
_LEAST_NEIGHBOURS = 3
_STEP_SLACK_S = 1e-6


def write_photos(
    bag: Bag,
    images: TopicSamples,
    place: FloatArray,
    *,
    options: IngestOptions,
    folder: Path,
    remarks: Remarks,
    progress: Progress = SILENT,
) -> tuple[list[Photo], list[int]]:
    """Write the chosen frames into `folder` as `frame_nnnnnn.jpg` or `.png`, numbered as in the bag.

    `place` (N, 3) has Cartesian positions at the times of the images, NaN where unknown. Photographs are returned
    with the number of each one's message.
    """
    folder.mkdir(parents=True, exist_ok=True)
    writer, topic, count = ImageWriter(), images.topic, len(images.time_s)
    photos: list[Photo] = []
    numbers: list[int] = []
    failed: list[str] = []
    recent: deque[float] = deque(maxlen=_NEIGHBOURS)
    blurred, hashes, copies = 0, set(), 0
    with progress.task("photographs", count) as task:
        for number, message in enumerate(bag.messages([topic])):
            task.advance()
            if number >= count or not images.usable[number]:
                continue
            last = numbers[-1] if numbers else None
            if options.every is not None and not _is_due(options.every, images.time_s, place, last, number):
                continue
            picture = _picture(writer, bag, message, number)
            if isinstance(picture, str):
                failed.append(picture)
                continue
            name, data, file = picture
            if options.skip_blurred and _is_blurred(file.sharpness, recent):
                blurred += 1
                continue
            if file.sha256 in hashes:
                copies += 1
                continue
            hashes.add(file.sha256)
            (folder / name).write_bytes(data)
            photos.append(Photo(name, file, PhotoTags(timestamp_s=float(images.time_s[number]))))
            numbers.append(number)
    _note_pictures(topic, failed, writer, remarks)
    if blurred:
        remarks.warn(
            "blurred-frames", f"{blurred} frames are blurred and are left out.", "--skip-blurred drops them."
        )
    if copies:
        remarks.warn("image-copies", f"{copies} frames are copies of earlier ones and are left out.")
    return photos, numbers


def write_messages(
    bag: Bag,
    images: TopicSamples,
    numbers: Collection[int],
    *,
    folder: Path,
    within: str,
    remarks: Remarks,
    progress: Progress = SILENT,
) -> list[tuple[Photo, int]]:
    """Write pictures of a topic, by the numbers of their messages, into the folder `within` of `folder`.

    Returned are the photographs, each with its number.
    """
    (folder / within).mkdir(parents=True, exist_ok=True)
    writer, photos, failed = ImageWriter(), [], []
    with progress.task(f"photographs, {within}", len(images.time_s)) as task:
        for number, message in enumerate(bag.messages([images.topic])):
            task.advance()
            if number not in numbers:
                continue
            picture = _picture(writer, bag, message, number)
            if isinstance(picture, str):
                failed.append(picture)
                continue
            name, data, file = picture
            (folder / within / name).write_bytes(data)
            tags = PhotoTags(timestamp_s=float(images.time_s[number]))
            photos.append((Photo(f"{within}/{name}", file, tags), number))
    _note_pictures(images.topic, failed, writer, remarks)
    return photos


def _picture(writer: ImageWriter, bag: Bag, message: RawMessage, number: int) -> tuple[str, bytes, ImageFile] | str:
    """Return name, bytes and head of the file of a message, or the reason why it is none."""
    try:
        data, suffix = writer.encoded(message.type, bag.decode(message))
        name = f"frame_{number:06d}{suffix}"
        return name, data, inspect_image(data, Path(name))
    except (UndecodableError, BadImageError, InputError) as error:
        return f"message {number} ({str(error)[:120]})"


def _note_pictures(topic: str, failed: Sequence[str], writer: ImageWriter, remarks: Remarks) -> None:
    remarks.warn_counted("image-unreadable", failed, f"Images of {topic} cannot be read and are left out")
    if writer.bits is not None:
        remarks.assume(
            "image-bit-depth", f"16-bit images of {topic} use {writer.bits} bits, as the first one does."
        )


def _is_due(every: Every, time_s: FloatArray, place: FloatArray, last: int | None, number: int) -> bool:
    """Return whether a frame is `every` step after the last one; in metres, a frame without a place never is."""
    if every.unit == "s":
        return last is None or bool(time_s[number] - time_s[last] >= every.step - _STEP_SLACK_S)
    if not np.isfinite(place[number]).all():
        return False
    return last is None or bool(np.linalg.norm(place[number] - place[last]) >= every.step)


def _is_blurred(current: float, recent: deque[float]) -> bool:
    """Return whether a frame is blurred against those before it, taken or not, so that a dull scene is not."""
    usual = float(np.median(recent)) if len(recent) >= _LEAST_NEIGHBOURS else 0.0
    recent.append(current)
    return current < BLURRED * usual


def lens_priors(
    photos: Sequence[Photo], camera: CameraStream, options: IngestOptions, remarks: Remarks
) -> tuple[tuple[CameraPrior, ...], dict[str, int]]:
    """Return one calibrated camera of all photographs, or else assumed ones; and each photograph's camera id.

    A topic with `rect` in its last part or `_rect` anywhere is rectified. `--focal-px` overrides `CameraInfo`.
    """
    sizes = {(photo.file.width, photo.file.height) for photo in photos}
    if camera.info is None or options.focal_px is not None or len(sizes) != 1:
        return camera_priors(photos, options.focal_px, remarks)
    topic = camera.images.topic
    prior, remark = _camera_prior(camera.info, "rect" in topic.rpartition("/")[2] or "_rect" in topic)
    (width, height) = next(iter(sizes))
    fitted = _scaled_prior(prior, width, height) if prior is not None else None
    if prior is not None and fitted is None:
        remark = f"CameraInfo is for images of {prior.width}×{prior.height}, but these are {width}×{height}"
    if fitted is None:
        remarks.warn("camera-info-unused", f"{remark}. It is not used.")
        return camera_priors(photos, options.focal_px, remarks)
    remarks.assume("lens-from-camera-info", f"The lens is from {camera.info_topic}: {remark}.")
    return (fitted,), {photo.name: 1 for photo in photos}


def _camera_prior(message: Any, rectified: bool) -> tuple[CameraPrior | None, str]:
    """Return the calibration of a `CameraInfo` and a remark on it; no prior where it is not calibrated.

    Of rectified images `p` applies, and no distortion is left.
    """
    # ROS counts pixels from the centre of the first one, COLMAP from its corner.
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
        remark = f"CameraInfo has distortion_model {name!r} with {len(lens)} coefficients, which is not supported"
        return None, remark
    params = tuple(float(value) for value in (fx, fy, cx, cy, *extra))
    prior = CameraPrior(
        camera_id=1, model=model, width=width, height=height, params=params, focal_source="calibrated"
    )
    return prior, f"CameraInfo ({state}): {model} with a focal length of {fx:.1f} px"


def _scaled_prior(prior: CameraPrior, width: int, height: int) -> CameraPrior | None:
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
