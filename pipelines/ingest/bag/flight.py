"""A flight out of a bag: photographs, lens, and where each camera was, from navigation, frames and options."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.bag.reader import Bag, open_bag
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, ecef_from_lla, lla_from_ecef, lla_from_enu
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import VerticalDatum, assumed_ellipsoidal
from pipelines.geometry.rig import Rig, frame_from_frd
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.ingest.bag.camera import camera_prior, scaled_prior
from pipelines.ingest.bag.navigation import BASE, POSITIONS, Axes
from pipelines.ingest.bag.photos import FrameOptions, write_photos
from pipelines.ingest.bag.streams import Clock, Streams, read_streams, settle_clocks
from pipelines.ingest.bag.topics import AskedTopics, Choice, choose_topics
from pipelines.ingest.camera_priors import camera_priors
from pipelines.ingest.image_poses import KINDS, Measured, PoseOptions, with_defaults
from pipelines.ingest.notes import Notes
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.pose_matching import interpolate
from pipelines.ingest.rig import camera_places
from pipelines.scene.survey import CameraPrior

_MANY_FRAMES = 1000


@dataclass(frozen=True)
class BagOptions:
    """How to read a bag: options of `ingest` under the same names.

    Attributes:
        local_origin: where local frames (odometry, poses) have their zero.
        time_offset_s: navigation clock minus camera clock.
        rig: stronger than `/tf`.
    """

    topics: AskedTopics = field(default_factory=AskedTopics)
    frames: FrameOptions = field(default_factory=FrameOptions)
    local_origin: Origin | None = None
    time_offset_s: float = 0.0
    rig: Rig = field(default_factory=Rig)
    pose: PoseOptions = field(default_factory=PoseOptions)
    focal_px: float | None = None


@dataclass(frozen=True)
class RawTrack:
    """The navigation as recorded, on its own clock, and how the cameras of N photographs sit in it.

    Attributes:
        position_time_s: (K,) and position_in_ecef: (K, 3), sigma_enu_m: (K, 3).
        attitude_time_s: (M,) and enu_from_body: (M, 3, 3), forward-right-down.
        cam_from_body: (N, 3, 3) mount, NaN where unknown.
        antenna_in_body: (N, 3) lever arm that was applied, NaN where none was known.
    """

    position_time_s: FloatArray
    position_in_ecef: FloatArray
    sigma_enu_m: FloatArray
    attitude_time_s: FloatArray
    enu_from_body: FloatArray
    cam_from_body: FloatArray
    antenna_in_body: FloatArray


@dataclass(frozen=True)
class BagFlight:
    """What a bag gave. `measured` is None if it has no positions that can be used."""

    photos: list[Photo]
    cameras: tuple[CameraPrior, ...]
    camera_of: dict[str, int]
    measured: Measured
    track: RawTrack


def read_flight(
    path: Path, options: BagOptions, folder: Path, notes: Notes, progress: Progress = SILENT
) -> BagFlight:
    """Read a bag, and write its chosen photographs into `folder`.

    Raises:
        InputError: no bag, no photographs in it, a named topic that does not fit, or positions of a local frame
            without `--origin`.
    """
    with open_bag(path) as bag:
        choice = choose_topics(bag, options.topics)
        if choice.image is None:
            raise InputError(
                "has no topic of sensor_msgs/Image or CompressedImage: see `georef inspect`", path=path
            )
        _note_choice(choice, notes)
        streams = read_streams(bag, choice, notes, progress)
        series = [one for one in (streams.images, streams.positions, streams.attitudes) if one is not None]
        read = _Read(bag, choice, streams, settle_clocks(series, notes), options, notes)
        table, vertical = _positions(read)
        turns = _attitudes(read)
        clock = read.clocks[choice.image]
        place = _spread(*interpolate(table, clock.time_s + options.time_offset_s, options.pose.max_gap_s))
        photos, numbers = write_photos(
            bag, choice.image, clock, place, options=options.frames, folder=folder, notes=notes, progress=progress
        )
    if len(photos) > _MANY_FRAMES and options.frames.every is None:
        notes.warn(f"all {len(photos)} frames were taken: --every 2s or --every 5m takes fewer")
    cameras, camera_of = _cameras(photos, read)
    time_s = clock.time_s[numbers]
    measured, track = _measure(read, time_s, table, turns)
    measured = replace(measured, vertical=vertical)
    return BagFlight(photos, cameras, camera_of, measured, track)


def _note_choice(choice: Choice, notes: Notes) -> None:
    chosen = {
        "photographs": choice.image,
        "lens": choice.info,
        "positions": choice.fix,
        "attitudes": choice.attitude,
    }
    notes.assume("topics: " + ", ".join(f"{what} from {topic or 'none'}" for what, topic in chosen.items()))
    for remark in choice.remarks:
        notes.assume(remark)


@dataclass(frozen=True)
class _Read:
    """What one pass over a bag gave, with the options to make sense of it."""

    bag: Bag
    choice: Choice
    streams: Streams
    clocks: dict[str, Clock]
    options: BagOptions
    notes: Notes


def _positions(read: _Read) -> tuple[PoseTable, VerticalDatum]:
    """Earth-centred positions on the navigation's clock, and what their heights counted from."""
    bag, choice, streams, options, notes = read.bag, read.choice, read.streams, read.options, read.notes
    datum = VerticalDatum(name="ellipsoidal", stated=True)
    if streams.positions is None or choice.fix is None or not len(streams.positions.stamps):
        if choice.fix is not None:
            notes.warn(f"no message of {choice.fix} has a usable position")
        return _table(bag, np.empty(0), np.empty((0, 3))), datum
    series, clock = streams.positions, read.clocks[choice.fix]
    kind = POSITIONS[bag.topics[choice.fix].type]
    values = series.table()
    if kind.geodetic:
        crs = parse_crs(WGS84, vertical=options.pose.vertical)
        lla = crs.lla_from_xyz(values[:, [1, 0, 2]])
        datum = crs.vertical if crs.vertical.stated else datum.model_copy(update={"note": kind.heights})
        if options.pose.vertical is None:
            notes.assume(
                f"heights of {choice.fix} are {kind.heights}; if its driver does otherwise, see --vertical"
            )
    elif options.local_origin is None:
        raise InputError(
            f"{choice.fix} has positions in the local frame {series.world!r} only: give --origin LAT,LON,HEIGHT of "
            "its zero (its axes being East-North-Up), or a topic with latitude and longitude as --fix-topic",
            path=bag.path,
            field="--origin",
        )
    else:
        lla = lla_from_enu(values[:, :3], options.local_origin)
        datum = assumed_ellipsoidal("height of --origin taken as ellipsoidal")
        notes.assume(f"the frame {series.world!r} of {choice.fix} is East-North-Up, with its zero at --origin")
    usable = clock.usable
    return _table(bag, clock.time_s[usable], ecef_from_lla(lla[usable]), values[usable, 3:6]), datum


def _table(bag: Bag, time_s: FloatArray, xyz: FloatArray, sigma: FloatArray | None = None) -> PoseTable:
    return PoseTable(
        path=bag.path,
        source="bag",
        lines=np.arange(len(time_s)),
        names=None,
        time_s=time_s,
        xyz=xyz,
        geographic=None,
        sigma_enu_m=sigma,
    )


@dataclass(frozen=True)
class _Turns:
    """Attitudes: rotations of the axes of `frame` into East-North-Up, as a table without places."""

    table: PoseTable
    frame: str
    axes: Axes


def _attitudes(read: _Read) -> _Turns | None:
    series = read.streams.attitudes
    if series is None or not len(series.stamps):
        return None
    clock, values = read.clocks[series.topic], series.table()
    usable = clock.usable
    table = _table(read.bag, clock.time_s[usable], np.zeros((int(usable.sum()), 3)))
    sigma = np.repeat(values[usable, 4:5], 3, axis=1)
    return _Turns(replace(table, quat_xyzw=values[usable, :4], sigma_enu_m=sigma), series.frame, series.axes)


def _measure(read: _Read, time_s: FloatArray, table: PoseTable, turns: _Turns | None) -> tuple[Measured, RawTrack]:
    """Positions and attitudes of the cameras at their stamps (N,), and the track that they are from."""
    streams, options, notes = read.streams, read.options, read.notes
    count, at_s = len(time_s), time_s + options.time_offset_s
    rows, located = interpolate(table, at_s, options.pose.max_gap_s)
    ecef, sigma = _spread(rows, located), np.full((count, 3), np.nan)
    if rows.sigma_enu_m is not None:
        sigma[located] = rows.sigma_enu_m
    enu_from_body, sigma_deg = np.full((count, 3, 3), np.nan), np.full(count, np.nan)
    if turns is not None:
        turned, found = interpolate(turns.table, at_s, options.pose.max_gap_s)
        from_frd = frame_from_frd(turns.axes)
        enu_from_body[found] = matrix_from_quat_xyzw(np.asarray(turned.quat_xyzw)) @ from_frd
        sigma_deg[found] = np.asarray(turned.sigma_enu_m)[:, 0]
    cam_from_body, arm = _rig(turns, streams, at_s, options.rig, notes)
    names = [f"{stamp:.3f} s" for stamp in time_s]
    notes.warn_counted(
        [name for name, one in zip(names, located, strict=True) if not one],
        f"frame has no position within --max-gap {options.pose.max_gap_s:g} s",
        f"frames have no position within --max-gap {options.pose.max_gap_s:g} s",
    )
    track = RawTrack(
        position_time_s=np.asarray(table.time_s),
        position_in_ecef=table.xyz,
        sigma_enu_m=np.full((len(table), 3), np.nan) if table.sigma_enu_m is None else table.sigma_enu_m,
        attitude_time_s=np.empty(0) if turns is None else np.asarray(turns.table.time_s),
        enu_from_body=np.empty((0, 3, 3))
        if turns is None
        else matrix_from_quat_xyzw(np.asarray(turns.table.quat_xyzw)) @ frame_from_frd(turns.axes),
        cam_from_body=cam_from_body,
        antenna_in_body=arm,
    )
    ecef = camera_places(ecef, enu_from_body, arm, names, notes)
    enu_from_cam = enu_from_body @ np.swapaxes(cam_from_body, 1, 2) @ options.rig.nominal_from_cam
    quat, known = np.full((count, 4), np.nan), np.isfinite(enu_from_cam).all(axis=(1, 2))
    quat[known] = quat_xyzw_from_matrix(enu_from_cam[known])
    kind = (
        max(streams.positions.kinds, key=KINDS.index)
        if streams.positions and streams.positions.kinds
        else KINDS[-1]
    )
    sigma, source = with_defaults(list(sigma), [kind] * count, complete(ecef), options.pose, notes)
    measured = Measured(
        lla=_lla(ecef),
        sigma_enu_m=sigma,
        sigma_source=source,
        quat_xyzw=quat,
        attitude_source=tuple("bag" for _ in range(count)),
        time_s=time_s,
        source="bag",
        crs_name=WGS84,
        vertical=assumed_ellipsoidal(""),
        sigma_attitude_deg=sigma_deg,
    )
    return measured, track


def _rig(
    turns: _Turns | None, streams: Streams, at_s: FloatArray, rig: Rig, notes: Notes
) -> tuple[FloatArray, FloatArray]:
    """Mount cam ← body (N, 3, 3) and lever arm (N, 3) in the body at each time: of the options, else of `/tf`."""
    mount, arm = np.full((len(at_s), 3, 3), np.nan), np.full((len(at_s), 3), np.nan)
    if rig.cam_from_body is not None:
        mount[:] = rig.cam_from_body
    if rig.antenna_in_body is not None:
        arm[:] = rig.antenna_in_body
    if turns is None:
        notes.warn("no attitudes: only the photographs tell how the cameras were turned")
        return mount, arm
    frames, body, from_frd = streams.transforms, turns.frame, frame_from_frd(turns.axes)
    if body not in frames and BASE in frames and turns.axes == "flu":
        notes.assume(f"the frame {body!r} of the attitudes is not in /tf and is taken as {BASE}")
        body = BASE
    camera = frames.between(body, streams.image_frame, at_s)
    if body == streams.image_frame and turns.axes != "optical":
        camera = None  # a driver that names the body's frame says nothing of the camera's axes
    if rig.cam_from_body is None and camera is not None:
        mount = np.swapaxes(camera[0], 1, 2) @ from_frd
        if "optical" not in streams.image_frame:
            notes.assume(f"the frame {streams.image_frame!r} of the images is optical: x right, y down, z forward")
    elif rig.cam_from_body is None:
        notes.warn(
            f"/tf does not link the frames {streams.image_frame!r} of the camera and {body!r} of the attitudes: "
            "the cameras have no attitude; give --camera-mount YAW,PITCH,ROLL"
        )
    if rig.antenna_in_body is None:
        antenna = frames.between(body, streams.positions.frame, at_s) if streams.positions else None
        if antenna is not None and camera is not None:
            arm = (antenna[1] - camera[1]) @ from_frd
        else:
            notes.assume("the lever arm is not known: positions are taken for those of the camera; see --lever-arm")
    return mount, arm


def _cameras(photos: list[Photo], read: _Read) -> tuple[tuple[CameraPrior, ...], dict[str, int]]:
    """One calibrated camera of all photographs, or what can be assumed of them."""
    choice, streams, options, notes = read.choice, read.streams, read.options, read.notes
    sizes = {(photo.file.width, photo.file.height) for photo in photos}
    if streams.info is None or options.focal_px is not None or len(sizes) != 1:
        return camera_priors(photos, options.focal_px, notes)
    rectified = "rect" in str(choice.image).rpartition("/")[2] or "_rect" in str(choice.image)
    prior, told = camera_prior(streams.info, rectified)
    (width, height) = next(iter(sizes))
    fitted = scaled_prior(prior, width, height) if prior is not None else None
    if prior is not None and fitted is None:
        told = f"CameraInfo is of images of {prior.width}×{prior.height}, these are {width}×{height}"
    if fitted is None:
        notes.warn(f"{told}: it is not used")
        return camera_priors(photos, options.focal_px, notes)
    notes.assume(f"lens from {choice.info}: {told}")
    return (fitted,), {photo.name: 1 for photo in photos}


def _spread(rows: PoseTable, found: BoolArray) -> FloatArray:
    """Places (N, 3) of the rows found, NaN elsewhere."""
    result = np.full((len(found), 3), np.nan)
    result[found] = rows.xyz
    return result


def _lla(ecef: FloatArray) -> FloatArray:
    result, known = np.full(ecef.shape, np.nan), complete(ecef)
    result[known] = lla_from_ecef(ecef[known])
    return result
