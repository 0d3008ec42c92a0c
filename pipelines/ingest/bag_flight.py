"""A flight out of a bag: photographs, lens, and where each camera was, from navigation, frames and options.

The navigation of a bag on one clock: positions Earth-centred, attitudes against north and up.

How the camera sits in the body at each photograph: by the options, else by `/tf`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.bag import Bag, open_bag
from pipelines.formats.trajectory_csv import complete
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import VerticalDatum, assumed_ellipsoidal
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.trajectory import Rig, Trajectory, frame_from_frd
from pipelines.ingest.bag_messages import BASE, POSITIONS, Axes
from pipelines.ingest.bag_photos import lens_priors, write_photos
from pipelines.ingest.bag_streams import (
    BagStreams,
    RequestedTopics,
    SelectedTopics,
    TopicSamples,
    read_streams,
    select_topics,
)
from pipelines.ingest.image_poses import RECEIVERS, ImagePoses, with_defaults
from pipelines.ingest.navigation import (
    FlightRecord,
    RecordedNavigation,
    camera_poses,
    given_rig,
    require_enough,
)
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions


@dataclass(frozen=True)
class BagNavigation:
    """Positions and attitudes of frames of the aircraft; trajectories without samples where there are none.

    Attributes:
        positions: Earth-centred, with the σ that the messages state.
        vertical: the datum that their heights counted from.
        receiver: kind of receiver, the worst that occurs.
        attitudes: rotations from forward, right, down of the body's frame to East-North-Up at its place, with σ.
        body_frame: name of that frame.
        body_axes: its own axes.
    """

    positions: Trajectory
    vertical: VerticalDatum
    receiver: str
    attitudes: Trajectory
    body_frame: str
    body_axes: Axes


def navigation_of(streams: BagStreams, options: IngestOptions, notes: Notes) -> BagNavigation:
    """Return the navigation of a bag.

    Raises:
        InputError: positions of a local frame without `--origin`, or a missing grid.
    """
    positions, vertical = _positions(streams, options, notes)
    receivers = [] if streams.positions is None else streams.positions.receivers
    attitudes = streams.attitudes
    return BagNavigation(
        positions=positions,
        vertical=vertical,
        receiver=max(receivers, key=RECEIVERS.index, default=RECEIVERS[-1]),
        attitudes=_attitudes(streams, options),
        body_frame="" if attitudes is None else attitudes.frame,
        body_axes="flu" if attitudes is None else attitudes.axes,
    )


def _positions(streams: BagStreams, options: IngestOptions, notes: Notes) -> tuple[Trajectory, VerticalDatum]:
    series = streams.positions
    if series is None or not len(series.stamps):
        if series is not None:
            notes.warn(f"no message of {series.topic} has a usable position")
        return Trajectory.from_samples(np.empty(0)), VerticalDatum(name="ellipsoidal", stated=True)
    values = series.table()
    if POSITIONS[series.type].geodetic:
        position_in_ecef, vertical = _geodetic(series, options, notes)
    else:
        position_in_ecef = ecef_from_enu(values[:, :3], _zero_of(series, streams, options))
        vertical = assumed_ellipsoidal("height of --origin taken as ellipsoidal")
        notes.assume(f"the frame {series.world!r} of {series.topic} is East-North-Up, with its zero at --origin")
    clock = streams.clocks[series.topic]
    positions = Trajectory.from_samples(
        clock.time_s[clock.usable],
        position=position_in_ecef[clock.usable],
        sigma_m=values[clock.usable, 3:6],
        max_gap_s=options.max_gap,
    )
    return positions, vertical


def _geodetic(series: TopicSamples, options: IngestOptions, notes: Notes) -> tuple[FloatArray, VerticalDatum]:
    """Return positions in ECEF (K, 3) of latitudes, longitudes and heights, and what the heights counted from."""
    crs, kind = parse_crs(WGS84, vertical=options.vertical), POSITIONS[series.type]
    if options.vertical is None:
        notes.assume(f"heights of {series.topic} are {kind.heights}; if its driver does otherwise, see --vertical")
    by_definition = VerticalDatum(name="ellipsoidal", stated=True, note=kind.heights)
    lla = crs.lla_from_xyz(series.table()[:, [1, 0, 2]])
    return ecef_from_lla(lla), crs.vertical if crs.vertical.stated else by_definition


def _zero_of(series: TopicSamples, streams: BagStreams, options: IngestOptions) -> Origin:
    if options.origin is None:
        raise InputError(
            f"{series.topic} has positions in the local frame {series.world!r} only: give --origin LAT,LON,HEIGHT "
            "of its zero (its axes being East-North-Up), or a topic with latitude and longitude as --fix-topic",
            path=streams.path,
            field="--origin",
        )
    lat_deg, lon_deg, alt_m = options.origin
    return Origin(lat_deg=lat_deg, lon_deg=lon_deg, alt_m=alt_m)


def _attitudes(streams: BagStreams, options: IngestOptions) -> Trajectory:
    series = streams.attitudes
    if series is None or not len(series.stamps):
        return Trajectory.from_samples(np.empty(0))
    clock = streams.clocks[series.topic]
    samples = series.table()[clock.usable]
    return Trajectory.from_samples(
        clock.time_s[clock.usable],
        rotation=matrix_from_quat_xyzw(samples[:, :4]) @ frame_from_frd(series.axes),
        sigma_deg=samples[:, 4],
        max_gap_s=options.max_gap,
    )


def rig_at(time_s: FloatArray, navigation: BagNavigation, streams: BagStreams, given: Rig, notes: Notes) -> Rig:
    """Return mount and lever arm at times (N,): of the options, else of `/tf`; NaN where neither tells.

    Args:
        time_s: of the photographs, on the navigation's clock.
        navigation: whose attitudes name the body's frame.
        streams: the frames, and which of them the photographs and positions are of.
        given: rig of the options.
        notes: what was assumed, and what is missing.
    """
    mounts, arms = given.of_each(len(time_s))
    if not len(navigation.attitudes):
        notes.warn("no attitudes: only the photographs tell how the cameras were turned")
        return Rig(mounts, arms, given.nominal_from_cam)
    frames, body, from_frd = streams.transforms, navigation.body_frame, frame_from_frd(navigation.body_axes)
    if body not in frames and BASE in frames and navigation.body_axes == "flu":
        notes.assume(f"the frame {body!r} of the attitudes is not in /tf and is taken as {BASE}")
        body = BASE
    camera = frames.between(body, streams.image_frame, time_s)
    if body == streams.image_frame and navigation.body_axes != "optical":
        camera = None  # a driver that names the body's frame says nothing of the camera's axes
    if given.cam_from_body is None and camera is not None:
        mounts = np.swapaxes(camera[0], 1, 2) @ from_frd
        if "optical" not in streams.image_frame:
            notes.assume(f"the frame {streams.image_frame!r} of the images is optical: x right, y down, z forward")
    elif given.cam_from_body is None:
        notes.warn(
            f"/tf does not link the frames {streams.image_frame!r} of the camera and {body!r} of the attitudes: "
            "the cameras have no attitude; give --camera-mount YAW,PITCH,ROLL"
        )
    if given.antenna_in_body is None:
        antenna = frames.between(body, streams.positions.frame, time_s) if streams.positions else None
        if antenna is not None and camera is not None:
            arms = (antenna[1] - camera[1]) @ from_frd
        else:
            notes.assume("the lever arm is not known: positions are taken for those of the camera; see --lever-arm")
    return Rig(mounts, arms, given.nominal_from_cam)


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
    require_enough(len(photos), path, "--bag", notes)
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
    require_enough(count, path, "--bag", notes)
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
