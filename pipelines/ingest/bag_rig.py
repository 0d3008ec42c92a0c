"""Cameras of one bag that expose together: which of their messages are of one instant, and how they are turned.

The photographs of the chosen topic are the survey's. Those of the other cameras accompany them, as in a folder
(`rig_instants`): stamps tell who was exposed together, and `/tf_static` may tell the rotations.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import Progress
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.bag import Bag
from pipelines.geometry.rotations import log_so3, quat_xyzw_from_matrix
from pipelines.ingest.bag_photos import lens_priors, write_messages
from pipelines.ingest.bag_streams import UNNAMED_FRAME, BagStreams, CameraStream, camera_of_topic
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.rig_instants import FEWEST_INSTANTS, Accompanying, Quaternion, note_rig
from pipelines.survey.survey import CameraPrior

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
    found = []
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
        found.append(CameraBeside(camera, message, quat))
    if not found:
        reasons = "".join(f" {warning.sentence}" for warning in remarks.warnings if "bag-camera" in warning.code)
        raise InputError(
            "no-rig",
            f"No other camera of the bag exposes together with {reference.topic} at {FEWEST_INSTANTS} instants or "
            f"more.{reasons}",
            remedy="Remove --sensor.",
            path=streams.path,
            field="--sensor",
        )
    return tuple(found)


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
