"""A flight out of a bag: photographs, lens, and where each camera was, from navigation, frames and options.

The navigation is on one clock: positions Earth-centred, attitudes against north and up. How the camera sits in the
body at each photograph is by the options, else by `/tf`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.bag import open_bag
from pipelines.formats.trajectory_csv import complete
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import ELLIPSOIDAL, HEIGHT_REMEDY, VerticalDatum
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.trajectory import Rig, Trajectory, frame_from_frd
from pipelines.ingest.bag_messages import BASE, GEODETIC_HEIGHTS, IMPOSSIBLE_HEIGHT
from pipelines.ingest.bag_photos import cameras_beside, lens_priors, photographs_beside, sensor_name, write_photos
from pipelines.ingest.bag_streams import BagStreams, TopicSamples, read_streams
from pipelines.ingest.flight_record import (
    RECEIVERS,
    FlightRecord,
    ImagePoses,
    RecordedNavigation,
    along_track,
    camera_poses,
    gap_limit,
    given_rig,
    require_enough,
    with_defaults,
)
from pipelines.ingest.options import ALL_SENSORS, IngestOptions
from pipelines.ingest.remarks import Remarks

_MANY_FRAMES = 1000


def read_bag(
    path: Path, options: IngestOptions, folder: Path, remarks: Remarks, progress: Progress = SILENT
) -> FlightRecord:
    """Read a bag, and write its chosen photographs into `folder`.

    Raises:
        InputError: no bag, no photographs in it or too few, a named topic that does not fit, or positions of a
            local frame without `--origin`.
    """
    with open_bag(path) as bag:
        streams = read_streams(bag, options, remarks, progress)
        beside = cameras_beside(streams, remarks) if options.sensor == ALL_SENSORS else ()
        positions, vertical = _positions(streams, options, remarks)
        position = positions.at(streams.camera.images.time_s + options.time_offset_s).position
        photos, numbers = write_photos(
            bag, streams.camera.images, position, options=options, folder=folder, remarks=remarks, progress=progress
        )
        if len(photos) > _MANY_FRAMES and options.every is None:
            remarks.warn(
                "all-frames-taken", f"All {len(photos)} frames were taken.", "--every 2s or --every 5m takes fewer."
            )
        require_enough(len(photos), path, "--bag", remarks)
        cameras, camera_of = lens_priors(photos, streams.camera, options, remarks)
        if beside:
            name = sensor_name(streams.camera.images.topic)
            photos = [replace(photo, sensor=name) for photo in photos]
            cameras = tuple(camera.model_copy(update={"sensor": name}) for camera in cameras)
        rig = photographs_beside(
            bag, beside, dict(zip(numbers, photos, strict=True)), known=len(cameras),
            options=options, folder=folder, remarks=remarks, progress=progress,
        )  # fmt: skip
    time_s = streams.camera.images.time_s[numbers]
    attitudes = _attitudes(streams, options)
    recorded = RecordedNavigation(
        positions=positions,
        attitudes=attitudes,
        rig=_rig_at(time_s + options.time_offset_s, attitudes, streams, given_rig(options), remarks),
        body_known=True,
        images=tuple(photo.name for photo in photos),
        image_time_s=time_s,
        time_offset_s=options.time_offset_s,
    )
    receivers = [] if streams.positions is None else streams.positions.receivers
    worst = max(receivers, key=RECEIVERS.index, default=RECEIVERS[-1])
    poses = _poses(recorded, worst, vertical, options, remarks)
    return FlightRecord(
        folder.resolve(),
        photos,
        (*cameras, *rig.cameras),
        {**camera_of, **rig.camera_of},
        poses,
        recorded,
        rig.accompanying,
        rig.rotations,
    )


def count_frames(
    path: Path, options: IngestOptions, remarks: Remarks, progress: Progress = SILENT
) -> tuple[int, int]:
    """Return the number of frames with a usable stamp, and of those with a position; nothing is written.

    Raises as `read_bag`, but for frames that are damaged, blurred or passed over.
    """
    with open_bag(path) as bag:
        streams = read_streams(bag, options, remarks, progress)
    if options.sensor == ALL_SENSORS:
        cameras_beside(streams, remarks)
    images, (positions, _) = streams.camera.images, _positions(streams, options, remarks)
    located = complete(positions.at(images.time_s + options.time_offset_s).position) & images.usable
    count = int(images.usable.sum())
    require_enough(count, path, "--bag", remarks)
    return count, int(located.sum())


def _positions(streams: BagStreams, options: IngestOptions, remarks: Remarks) -> tuple[Trajectory, VerticalDatum]:
    """Return the positions, Earth-centred with the σ of the messages, and what their heights counted from."""
    series = streams.positions
    if series is None or not len(series.stamps):
        if series is not None and set(series.problems) == {IMPOSSIBLE_HEIGHT}:
            message = f"All messages of {series.topic} have an impossible altitude: {HEIGHT_REMEDY}"
            raise InputError("height-impossible", message, path=streams.path, field=series.topic)
        if series is not None:
            remarks.warn("no-usable-position", f"No message of {series.topic} has a usable position.")
        return Trajectory.from_samples(np.empty(0)), VerticalDatum(name=ELLIPSOIDAL, stated=False)
    values = series.table()
    if series.type in GEODETIC_HEIGHTS:
        position_in_ecef, vertical = _geodetic(series, options, remarks)
    elif options.origin is None:
        raise InputError(
            "local-frame-without-origin",
            (f"{series.topic} has positions in the local frame {series.world!r}, whose place on Earth is unknown."),
            path=streams.path,
            field="--origin",
            remedy=(
                "Give its zero with --origin LAT,LON,HEIGHT (its axes are taken as East-North-Up), or a topic "
                "with latitude and longitude with --fix-topic."
            ),
        )
    else:
        lat_deg, lon_deg, alt_m = options.origin
        position_in_ecef = ecef_from_enu(values[:, :3], Origin(lat_deg=lat_deg, lon_deg=lon_deg, alt_m=alt_m))
        note = "height of the given origin taken as ellipsoidal"
        vertical = VerticalDatum(name=ELLIPSOIDAL, stated=False, note=note)
        remarks.assume(
            "local-frame-axes",
            f"The frame {series.world!r} of {series.topic} is East-North-Up, with its zero at the given origin.",
        )
    positions = Trajectory.from_samples(
        series.time_s[series.usable],
        position=position_in_ecef[series.usable],
        sigma_m=values[series.usable, 3:6],
        max_gap_s=gap_limit(series.time_s[series.usable], options),
    )
    return positions, vertical


def _geodetic(series: TopicSamples, options: IngestOptions, remarks: Remarks) -> tuple[FloatArray, VerticalDatum]:
    """Return positions in ECEF (K, 3) of latitudes, longitudes and heights, and what the heights counted from."""
    crs, heights = parse_crs(WGS84, vertical=options.vertical), GEODETIC_HEIGHTS[series.type]
    if options.vertical is None:
        remarks.assume(
            "bag-heights",
            f"Heights of {series.topic} are {heights}.",
            "If its driver writes others, state them with --vertical.",
        )
    by_definition = VerticalDatum(name=ELLIPSOIDAL, stated=False, note=heights, by_definition=True)
    lla = crs.lla_from_xyz(series.table()[:, [1, 0, 2]])
    return ecef_from_lla(lla), crs.vertical if crs.vertical.stated else by_definition


def _attitudes(streams: BagStreams, options: IngestOptions) -> Trajectory:
    """Return rotations from forward, right, down of the body's frame to East-North-Up at its place, with σ."""
    series = streams.attitudes
    if series is None or not len(series.stamps):
        return Trajectory.from_samples(np.empty(0))
    samples = series.table()[series.usable]
    return Trajectory.from_samples(
        series.time_s[series.usable],
        rotation=matrix_from_quat_xyzw(samples[:, :4]) @ frame_from_frd(series.axes),
        sigma_deg=samples[:, 4],
        max_gap_s=gap_limit(series.time_s[series.usable], options),
    )


def _rig_at(time_s: FloatArray, attitudes: Trajectory, streams: BagStreams, given: Rig, remarks: Remarks) -> Rig:
    """Return mount and lever arm at times (N,) of the navigation: given, else of `/tf`; NaN where neither tells."""
    mounts, arms = given.of_each(len(time_s))
    if streams.attitudes is None or not len(attitudes):
        remarks.warn(
            "no-attitudes", "The bag has no attitudes: only the photographs tell how the cameras were turned."
        )
        return Rig(mounts, arms, given.nominal_from_cam)
    frames, body, axes = streams.transforms, streams.attitudes.frame, streams.attitudes.axes
    image_frame, from_frd = streams.camera.images.frame, frame_from_frd(axes)
    if body not in frames and BASE in frames and axes == "flu":
        remarks.assume(
            "attitude-frame", f"/tf lacks the frame {body!r} of the attitudes, which is taken as {BASE}."
        )
        body = BASE
    camera = frames.between(body, image_frame, time_s)
    if body == image_frame and axes != "optical":
        camera = None  # a driver that names the body's frame says nothing of the camera's axes
    if given.cam_from_body is None and camera is not None:
        mounts = np.swapaxes(camera[0], 1, 2) @ from_frd
        if "optical" not in image_frame:
            remarks.assume(
                "image-frame-axes",
                f"The frame {image_frame!r} of the images is optical: x right, y down, z forward.",
            )
    elif given.cam_from_body is None:
        remarks.warn(
            "camera-mount-unknown",
            f"/tf does not link the frames {image_frame!r} of the camera and {body!r} of the attitudes, so that "
            "the cameras have no attitude.",
            "Give --camera-mount YAW,PITCH,ROLL.",
        )
    if given.antenna_in_body is None:
        antenna = frames.between(body, streams.positions.frame, time_s) if streams.positions else None
        if antenna is not None and camera is not None:
            arms = (antenna[1] - camera[1]) @ from_frd
        else:
            remarks.assume(
                "lever-arm-unknown",
                "The lever arm is unknown: positions of the antenna are taken as those of the camera.",
                "State it with --lever-arm.",
            )
    return Rig(mounts, arms, given.nominal_from_cam)


def _poses(
    recorded: RecordedNavigation, receiver: str, vertical: VerticalDatum, options: IngestOptions, remarks: Remarks
) -> ImagePoses:
    """Return poses of the cameras at their stamps (N,)."""
    time_s = recorded.image_time_s
    at_s = time_s + options.time_offset_s
    antenna, body = recorded.positions.at(at_s), recorded.attitudes.at(at_s)
    stamps = [f"{stamp:.3f} s" for stamp in time_s]
    remarks.warn_counted(
        "images-without-position",
        [stamps[row] for row in np.flatnonzero(~complete(antenna.position))],
        f"Frames have no position within {recorded.positions.max_gap_s:g} s",
        "--max-gap sets that limit.",
    )
    position_in_ecef, enu_from_cam = camera_poses(antenna.position, body.rotation, recorded.rig, stamps, remarks)
    receivers, located = (receiver,) * len(time_s), complete(position_in_ecef)
    sigma, sigma_source = with_defaults(antenna.sigma_m, receivers, located, options, remarks)
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
        vertical=vertical,
        along_track_m=along_track(recorded.positions, at_s, (np.zeros(len(at_s)), np.zeros(len(at_s)))),
    )
