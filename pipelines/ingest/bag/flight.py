"""A flight out of a bag: photographs, lens, and where each camera was, from navigation, frames and options."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.bag.reader import Bag, open_bag
from pipelines.formats.pose_table import complete
from pipelines.geodesy.operations import WGS84
from pipelines.geometry.rig import Rig
from pipelines.ingest.bag.camera import lens_priors
from pipelines.ingest.bag.mounting import rig_at
from pipelines.ingest.bag.photos import write_photos
from pipelines.ingest.bag.streams import read_streams
from pipelines.ingest.bag.topics import RequestedTopics, SelectedTopics, select_topics
from pipelines.ingest.bag.trajectories import BagNavigation, navigation_of
from pipelines.ingest.flight_record import LEAST_IMAGES, FlightRecord, require_enough, too_few
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.position_sigma import with_defaults
from pipelines.ingest.recorded_navigation import RecordedNavigation
from pipelines.ingest.rig import camera_poses, given_rig

_MANY_FRAMES = 1000


def read_bag(
    path: Path, options: IngestOptions, folder: Path, notes: Notes, progress: Progress = SILENT
) -> FlightRecord:
    """Read a bag, and write its chosen photographs into `folder`.

    Raises:
        InputError: no bag, no photographs in it or too few, a named topic that does not fit, or positions of a
            local frame without `--origin`.
    """
    with open_bag(path) as bag:
        image, topics = _topics(bag, path, options, notes)
        streams = read_streams(bag, topics, notes, progress)
        navigation = navigation_of(streams, options, notes)
        clock = streams.clocks[image]
        place = navigation.positions.at(clock.time_s + options.time_offset_s).position
        photos, numbers = write_photos(
            bag, image, clock, place, options=options, folder=folder, notes=notes, progress=progress
        )
    if len(photos) > _MANY_FRAMES and options.every is None:
        notes.warn(f"all {len(photos)} frames were taken: --every 2s or --every 5m takes fewer")
    require_enough(photos, path, "--bag", notes)
    cameras, camera_of = lens_priors(photos, topics, streams.info, options, notes)
    time_s = clock.time_s[numbers]
    rig = rig_at(time_s + options.time_offset_s, navigation, streams, given_rig(options), notes)
    recorded = RecordedNavigation(
        positions=navigation.positions,
        attitudes=navigation.attitudes,
        rig=rig,
        body_known=True,
        images=tuple(photo.name for photo in photos),
        image_time_s=time_s,
        time_offset_s=options.time_offset_s,
    )
    poses = _poses(time_s, navigation, rig, options, notes)
    return FlightRecord(folder.resolve(), photos, cameras, camera_of, poses, recorded)


def count_frames(path: Path, options: IngestOptions, notes: Notes, progress: Progress = SILENT) -> tuple[int, int]:
    """Return the number of frames with a usable stamp, and of those with a position; nothing is written.

    Raises:
        InputError: as `read_bag`, but for frames that are damaged, blurred or passed over.
    """
    with open_bag(path) as bag:
        image, topics = _topics(bag, path, options, notes)
        streams = read_streams(bag, topics, notes, progress)
    clock, navigation = streams.clocks[image], navigation_of(streams, options, notes)
    located = complete(navigation.positions.at(clock.time_s + options.time_offset_s).position) & clock.usable
    count = int(clock.usable.sum())
    if count < LEAST_IMAGES:
        raise too_few(count, path, "--bag", notes)
    return count, int(located.sum())


def _topics(bag: Bag, path: Path, options: IngestOptions, notes: Notes) -> tuple[str, SelectedTopics]:
    """Return the topic of the photographs, and all that are read.

    Raises:
        InputError: no photographs, or a named topic that does not fit.
    """
    requested = RequestedTopics(options.image_topic, options.fix_topic, options.attitude_topic)
    topics = select_topics(bag, requested)
    if topics.image is None:
        raise InputError("has no topic of sensor_msgs/Image or CompressedImage: see `georef inspect`", path=path)
    _note_topics(topics, notes)
    return topics.image, topics


def _note_topics(topics: SelectedTopics, notes: Notes) -> None:
    subjects = {
        "photographs": topics.image,
        "lens": topics.info,
        "positions": topics.fix,
        "attitudes": topics.attitude,
    }
    notes.assume("topics: " + ", ".join(f"{subject} from {topic or 'none'}" for subject, topic in subjects.items()))
    for remark in topics.remarks:
        notes.assume(remark)


def _poses(
    time_s: FloatArray, navigation: BagNavigation, rig: Rig, options: IngestOptions, notes: Notes
) -> ImagePoses:
    """Return poses of the cameras at their stamps (N,)."""
    at_s = time_s + options.time_offset_s
    antenna, body = navigation.positions.at(at_s), navigation.attitudes.at(at_s)
    stamps = [f"{stamp:.3f} s" for stamp in time_s]
    notes.warn_counted(
        [stamps[row] for row in np.flatnonzero(~complete(antenna.position))],
        f"frame has no position within --max-gap {options.max_gap:g} s",
        f"frames have no position within --max-gap {options.max_gap:g} s",
    )
    position_in_ecef, enu_from_cam = camera_poses(antenna.position, body.rotation, rig, stamps, notes)
    receivers, located = (navigation.receiver,) * len(time_s), complete(position_in_ecef)
    sigma, sigma_source = with_defaults(antenna.sigma_m, receivers, located, options, notes)
    return ImagePoses(
        position_in_ecef=position_in_ecef,
        sigma_enu_m=sigma,
        sigma_source=sigma_source,
        receivers=receivers,
        enu_from_cam=enu_from_cam,
        attitude_source=tuple("bag" for _ in stamps),
        sigma_attitude_deg=body.sigma_deg,
        time_s=time_s,
        source="bag",
        crs_name=WGS84,
        vertical=navigation.vertical,
    )
