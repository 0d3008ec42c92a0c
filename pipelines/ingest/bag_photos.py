"""Photographs from a bag: the selected frames, written as files one at a time, their lens, and those of a rig.

Several cameras of one bag may expose together. The photographs of the chosen topic are the survey's. Those of the
other cameras accompany them, as in a folder (`rig_instants`): stamps tell who was exposed together, and
`/tf_static` may tell the rotations.
"""

import re
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.bag import BadImageError, Bag, ImageWriter, RosMessage, UndecodableError
from pipelines.formats.exif import PhotoTags
from pipelines.formats.image_file import MAX_PIXELS, ImageFile, inspect_image
from pipelines.geometry.rotations import log_so3, quat_xyzw_from_matrix
from pipelines.ingest.bag_streams import UNNAMED_FRAME, BagStreams, CameraStream, TopicSamples, camera_of_topic
from pipelines.ingest.options import Every, IngestOptions
from pipelines.ingest.photo_folder import Photo, camera_priors
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.rig_instants import FEWEST_INSTANTS, Accompanying, Quaternion, note_rig
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
    photos: list[Photo] = []
    numbers: list[int] = []
    recent: deque[float] = deque(maxlen=_NEIGHBOURS)
    blurred, hashes, copies = 0, set(), 0

    def wanted(number: int) -> bool:
        if number >= len(images.time_s) or not images.usable[number]:
            return False
        last = numbers[-1] if numbers else None
        return options.every is None or _is_due(options.every, images.time_s, place, last, number)

    for number, name, data, file in _pictures(
        bag, images, wanted, task_name="photographs", remarks=remarks, progress=progress
    ):
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
    photos = []
    task_name = f"photographs, {within}"
    for number, name, data, file in _pictures(
        bag, images, numbers.__contains__, task_name=task_name, remarks=remarks, progress=progress
    ):
        (folder / within / name).write_bytes(data)
        tags = PhotoTags(timestamp_s=float(images.time_s[number]))
        photos.append((Photo(f"{within}/{name}", file, tags), number))
    return photos


def _pictures(
    bag: Bag,
    images: TopicSamples,
    wanted: Callable[[int], bool],
    *,
    task_name: str,
    remarks: Remarks,
    progress: Progress,
) -> Iterator[tuple[int, str, bytes, ImageFile]]:
    """Yield number, file name, bytes and head of the pictures of a topic, and say which could not be read.

    `wanted` is asked for each message by its number, after the pictures before it were used.
    """
    writer, failed = ImageWriter(), []
    with progress.task(task_name, len(images.time_s)) as task:
        for number, message in enumerate(bag.messages([images.topic])):
            task.advance()
            if not wanted(number):
                continue
            try:
                data, suffix = writer.encoded(message.type, bag.decode(message))
                name = f"frame_{number:06d}{suffix}"
                file = inspect_image(data, Path(name))
            except (UndecodableError, BadImageError, InputError) as error:
                failed.append(f"message {number} ({str(error)[:120]})")
            else:
                yield number, name, data, file
    remarks.warn_counted("image-unreadable", failed, f"Images of {images.topic} cannot be read and are left out")
    if writer.bits is not None:
        remarks.assume(
            "image-bit-depth", f"16-bit images of {images.topic} use {writer.bits} bits, as the first one does."
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


def _camera_prior(message: RosMessage, rectified: bool) -> tuple[CameraPrior | None, str]:
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


def _numbers(message: RosMessage, name: str) -> FloatArray:
    """Return a field that ROS 2 writes in small letters, ROS 1 in capitals."""
    values = getattr(message, name, None)
    return np.asarray(getattr(message, name.upper()) if values is None else values, dtype=np.float64)


# By daylight, shutters are open for less: what is stamped further apart was not exposed together.
_TOGETHER_S = 0.005
_MOST_TURN_DEG = 1.0  # of two cameras against each other during a flight: more is no rig


@dataclass(frozen=True)
class CameraBeside:
    """Camera that exposes together with that of the photographs.

    `message` (N,) is the number of its message at each of the reference's messages, −1 where it has none, and
    `quat_xyzw` its rotation, camera ← reference, where `/tf` states one.
    """

    camera: CameraStream
    message: IntArray
    quat_xyzw: Quaternion | None

    @property
    def name(self) -> str:
        return sensor_name(self.camera.images.topic)


def sensor_name(topic: str) -> str:
    """Return the name of the camera of a topic, as of a folder and a sensor."""
    return re.sub(r"[^a-z0-9_-]+", "-", camera_of_topic(topic).strip("/").casefold()).strip("-") or "camera"


def cameras_beside(streams: BagStreams, remarks: Remarks) -> tuple[CameraBeside, ...]:
    """Return the cameras that expose together with that of the photographs; those that do not are named.

    Raises:
        InputError: there is none.
    """
    reference = streams.camera.images
    cameras = []
    for camera in streams.others:
        images = camera.images
        if images.frame == reference.frame != UNNAMED_FRAME:
            remarks.warn(
                "bag-camera-same",
                f"{images.topic} has the frame {images.frame!r} of {reference.topic}, so it shows pictures of the "
                "same camera, and is left out.",
            )
            continue
        message, apart_s = _partners(reference.time_s, reference.usable, images.time_s, images.usable)
        if (message >= 0).sum() < FEWEST_INSTANTS:
            remarks.warn(
                "bag-camera-apart",
                f"{images.topic} was not exposed together with {reference.topic}, and is left out: their stamps "
                f"are {1000 * apart_s:.1f} ms apart (median), with a limit of {1000 * _TOGETHER_S:.0f} ms.",
            )
            continue
        quat, turned_deg = _stated_rotation(streams, camera)
        if turned_deg > _MOST_TURN_DEG:
            remarks.warn(
                "bag-camera-moves",
                f"{images.topic} turns by {turned_deg:.1f}° against {reference.topic} by /tf, so it is no part of "
                "its rig, and is left out.",
            )
            continue
        cameras.append(CameraBeside(camera, message, quat))
    if not cameras:
        reasons = "".join(f" {warning.sentence}" for warning in remarks.warnings if "bag-camera" in warning.code)
        raise InputError(
            "no-rig",
            f"No other camera of the bag exposes together with {reference.topic} at {FEWEST_INSTANTS} instants or "
            f"more.{reasons}",
            remedy="Remove --sensor.",
            path=streams.path,
            field="--sensor",
        )
    return tuple(cameras)


def _partners(
    time_s: FloatArray, usable: BoolArray, other_s: FloatArray, other_usable: BoolArray
) -> tuple[IntArray, float]:
    """Return the message (N,) of another camera at each message, −1: none; and the median difference in seconds.

    Two messages belong together if each is the other's nearest one.
    """
    message = np.full(len(time_s), -1, dtype=np.int64)
    mine, theirs = np.flatnonzero(usable), np.flatnonzero(other_usable)
    if not len(mine) or not len(theirs):
        return message, np.inf
    nearest = _nearest(other_s[theirs], time_s[mine])
    back = _nearest(time_s[mine], other_s[theirs])
    apart_s = np.abs(other_s[theirs][nearest] - time_s[mine])
    together = (apart_s <= _TOGETHER_S) & (back[nearest] == np.arange(len(mine)))
    message[mine[together]] = theirs[nearest[together]]
    return message, float(np.median(apart_s))


def _nearest(times_s: FloatArray, at_s: FloatArray) -> IntArray:
    """Return the rows of the times, sorted, that are nearest to others (N,)."""
    after = np.searchsorted(times_s, at_s).clip(1, max(len(times_s) - 1, 1))
    before = after - 1
    after = after.clip(max=len(times_s) - 1)
    return np.where(np.abs(times_s[before] - at_s) <= np.abs(times_s[after] - at_s), before, after)


def _stated_rotation(streams: BagStreams, camera: CameraStream) -> tuple[Quaternion | None, float]:
    """Return the rotation camera ← reference of `/tf`, if it has one, and by how many degrees it varies."""
    reference = streams.camera.images
    time_s = reference.time_s[reference.usable]
    link = streams.transforms.between(camera.images.frame, reference.frame, time_s)
    known = None if link is None else link[0][np.isfinite(link[0]).all(axis=(1, 2))]
    if known is None or not len(known):
        return None, 0.0
    turned = np.linalg.norm(log_so3(known @ known[0].T), axis=-1)
    x, y, z, w = map(float, quat_xyzw_from_matrix(known[0]))
    return (x, y, z, w), float(np.degrees(turned.max()))


@dataclass(frozen=True)
class RigPhotographs:
    """Photographs of the other cameras of a rig, the stated rotations by photograph, and their cameras."""

    accompanying: tuple[Accompanying, ...] = ()
    rotations: Mapping[str, Quaternion] = field(default_factory=dict)
    cameras: tuple[CameraPrior, ...] = ()
    camera_of: Mapping[str, int] = field(default_factory=dict)


def photographs_beside(
    bag: Bag,
    cameras: Sequence[CameraBeside],
    photo_of: Mapping[int, Photo],
    *,
    known: int,
    options: IngestOptions,
    folder: Path,
    remarks: Remarks,
    progress: Progress,
) -> RigPhotographs:
    """Write the photographs of other cameras that were exposed together with those of the survey, `photo_of`.

    These have the numbers of their messages. `known` cameras have their numbers, and the others follow.

    Raises:
        InputError: two topics have the same pictures.
    """
    accompanying: list[Accompanying] = []
    rotations: dict[str, Quaternion] = {}
    priors: list[CameraPrior] = []
    camera_of: dict[str, int] = {}
    taken = {photo.file.sha256 for photo in photo_of.values()}
    for each in cameras:
        beside = {int(each.message[number]): photo.name for number, photo in photo_of.items()}
        beside.pop(-1, None)
        written = write_messages(
            bag, each.camera.images, beside, folder=folder, within=each.name, remarks=remarks, progress=progress
        )
        if sum(photo.file.sha256 in taken for photo, _ in written) > len(written) / 2:
            message = (
                f"Most pictures of {each.camera.images.topic} are those of another topic: one camera took both."
            )
            raise InputError("bag-camera-same", message, remedy="Remove --sensor.", path=bag.path, field="--sensor")
        own = [replace(photo, sensor=each.name) for photo, _ in written]
        taken |= {photo.file.sha256 for photo in own}
        lenses, lens_of = lens_priors(own, each.camera, options, remarks)
        before = known + len(priors)
        camera_of |= {name: before + number for name, number in lens_of.items()}
        priors += [
            lens.model_copy(update={"camera_id": before + lens.camera_id, "sensor": each.name}) for lens in lenses
        ]
        accompanying += [
            Accompanying(photo, beside[number]) for photo, (_, number) in zip(own, written, strict=True)
        ]
        if each.quat_xyzw is not None:
            rotations |= {photo.name: each.quat_xyzw for photo in own}
    photos = list(photo_of.values())
    if cameras:
        note_rig([*photos, *(each.photo for each in accompanying)], photos, accompanying, remarks)
    return RigPhotographs(tuple(accompanying), rotations, tuple(priors), camera_of)
