"""What comes in: photographs with position and attitude, out of a folder and its tables or out of a ROS bag."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.odm import read_geo
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geodesy import enu
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import parse_vertical
from pipelines.geometry.rig import Rig, boresight, mount
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.ingest.bag.flight import BagOptions, RawTrack, read_flight
from pipelines.ingest.bag.photos import FrameOptions
from pipelines.ingest.bag.topics import AskedTopics
from pipelines.ingest.camera_priors import camera_priors
from pipelines.ingest.image_poses import Measured, PoseOptions, from_table, from_tags
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo, scan_folder
from pipelines.ingest.rig import with_rig
from pipelines.scene.navigation import NavigationTrack
from pipelines.scene.survey import CameraPrior

LEAST_IMAGES = 3
_BAG_ONLY = ("image_topic", "fix_topic", "attitude_topic", "every", "origin")


@dataclass(frozen=True)
class Intake:
    """Photographs, what was measured of them, their cameras; `track` gives the navigation in a frame."""

    folder: Path
    photos: list[Photo]
    measured: Measured
    cameras: tuple[CameraPrior, ...]
    camera_of: dict[str, int]
    track: Callable[[Origin], NavigationTrack | None]


def pose_options(config: IngestOptions) -> PoseOptions:
    """How to read positions."""
    return PoseOptions(
        crs=config.crs,
        vertical=parse_vertical(config.vertical) if config.vertical is not None else None,
        max_gap_s=config.max_gap,
        time_offset_s=config.time_offset_s,
        sigma_h_m=config.sigma_h,
        sigma_v_m=config.sigma_v,
    )


def take_in(config: IngestOptions, frames: Path | None, notes: Notes, progress: Progress = SILENT) -> Intake:
    """Read what the options name.

    Args:
        config: options of `ingest`.
        frames: where the photographs of a bag are written.
        notes: assumptions and warnings.
        progress: whom to tell.

    Raises:
        InputError: options that contradict each other, anything wrong with the inputs, too few photographs.
    """
    _check_options(config, frames)
    if config.estimated:
        notes.assume(
            f"{', '.join(config.estimated)}: as given, until `georef run` or `georef calibrate --apply` has "
            "estimated it after sfm"
        )
    if config.bag is not None and frames is not None:
        return _from_bag(config, config.bag, frames, notes, progress)
    return _from_folder(config, notes, progress)


def _from_bag(config: IngestOptions, bag: Path, frames: Path, notes: Notes, progress: Progress) -> Intake:
    origin = None
    if config.origin is not None:
        lat, lon, alt = config.origin
        origin = Origin(lat_deg=lat, lon_deg=lon, alt_m=alt)
    options = BagOptions(
        topics=AskedTopics(config.image_topic, config.fix_topic, config.attitude_topic),
        frames=FrameOptions(config.every, config.skip_blurred),
        local_origin=origin,
        time_offset_s=config.time_offset_s,
        rig=_rig(config),
        pose=pose_options(config),
        focal_px=config.focal_px,
    )
    flight = read_flight(bag, options, frames, notes, progress)
    _require_enough(flight.photos, bag, "--bag", notes)

    def track(origin: Origin) -> NavigationTrack | None:
        names, time_s = [photo.name for photo in flight.photos], flight.measured.time_s
        return _track(flight.track, names, time_s, config, origin)

    return Intake(frames.resolve(), flight.photos, flight.measured, flight.cameras, flight.camera_of, track)


def _from_folder(config: IngestOptions, notes: Notes, progress: Progress) -> Intake:
    folder = Path(str(config.images))
    photos = _usable(folder, notes, progress)
    options = pose_options(config)
    table: PoseTable | None = None
    if config.trajectory is not None:
        table = read_trajectory(config.trajectory)
    elif config.geo is not None:
        table = read_geo(config.geo)
    measured = from_tags(photos, options, notes) if table is None else from_table(table, photos, options, notes)
    names, recorded = [photo.name for photo in photos], measured.recorded
    if config.time_offset_s and recorded is None:
        raise InputError(
            "is for navigation by time: a --bag, or a --trajectory without a column of images",
            field="--time-offset",
        )
    measured = with_rig(measured, _rig(config), names, notes)
    cameras, camera_of = camera_priors(photos, config.focal_px, notes)

    def track(origin: Origin) -> NavigationTrack | None:
        if recorded is None:
            return None
        timed = np.isfinite(measured.time_s)
        raw = _raw_track(recorded, _rig(config), int(timed.sum()))
        timed_names = [name for name, one in zip(names, timed, strict=True) if one]
        return _track(raw, timed_names, measured.time_s[timed], config, origin)

    return Intake(folder.resolve(), photos, measured, cameras, camera_of, track)


def _check_options(config: IngestOptions, frames: Path | None) -> None:
    if config.images is None and config.bag is None:
        raise InputError("give the folder of photographs, or a --bag", field="--images")
    if config.bag is not None:
        if frames is None:
            raise InputError("a bag needs a workspace to put its photographs in", field="--bag")
        if config.crs is not None:
            raise InputError(
                "has no meaning for a --bag: its positions are latitude, longitude and ellipsoidal height, or "
                "metres in a frame whose zero --origin names",
                field="--crs",
            )
        beside = [name for name in ("images", "trajectory", "geo") if getattr(config, name) is not None]
        if beside:
            raise InputError(f"has photographs and positions itself: give it without --{beside[0]}", field="--bag")
    elif given := [name for name in _BAG_ONLY if getattr(config, name) is not None]:
        raise InputError("is for a --bag, which is not given", field="--" + given[0].replace("_", "-"))
    if config.trajectory is not None and config.geo is not None:
        raise InputError("give a trajectory or a geo.txt, not both", field="--geo")
    if config.crs is not None and config.trajectory is None:
        raise InputError("is for the columns of --trajectory; other files state their CRS", field="--crs")
    if config.check and config.gcp is None:
        raise InputError("names points of --gcp, which is not given", field="--check")
    if config.test_every == 1:
        raise InputError("1 would leave nothing to train on: give 0, or 2 and more", field="--test-every")


def _rig(config: IngestOptions) -> Rig:
    return Rig(
        cam_from_body=mount(config.camera_mount) if config.camera_mount is not None else None,
        antenna_in_body=np.array(config.lever_arm) if config.lever_arm is not None else None,
        nominal_from_cam=boresight(config.boresight),
    )


def _usable(root: Path, notes: Notes, progress: Progress) -> list[Photo]:
    photos = scan_folder(root, notes, progress)
    _require_enough(photos, root, "--images", notes)
    for problem in sorted({problem for photo in photos for problem in photo.tags.problems}):
        names = [photo.name for photo in photos if problem in photo.tags.problems]
        notes.warn_counted(names, f"image where {problem}", f"images where {problem}")
    notes.warn_counted(
        [photo.name for photo in photos if photo.tags.orientation != 1],
        "image has an EXIF orientation, which is ignored: pixels count as stored",
        "images have an EXIF orientation, which is ignored: pixels count as stored",
    )
    return photos


def _require_enough(photos: Sequence[Photo], source: Path, field: str, notes: Notes) -> None:
    if len(photos) < LEAST_IMAGES:
        why = "".join(f"; {warning}" for warning in notes.warnings)
        raise InputError(
            f"{len(photos)} usable images, a survey needs {LEAST_IMAGES}{why}", path=source, field=field
        )


def _raw_track(table: PoseTable, rig: Rig, images: int) -> RawTrack:
    """A table by time as navigation; without a mount, the cameras' nominal axes stand for the body's."""
    usable = np.flatnonzero(np.isfinite(np.asarray(table.time_s)) & complete(table.xyz))
    table = table.take(usable[np.argsort(np.asarray(table.time_s)[usable], kind="stable")])
    quat = np.full((len(table), 4), np.nan) if table.quat_xyzw is None else table.quat_xyzw
    turned = complete(quat)
    cam_from_body = np.eye(3) if rig.cam_from_body is None else rig.cam_from_body
    arm = np.full(3, np.nan) if rig.antenna_in_body is None else rig.antenna_in_body
    time_s = np.asarray(table.time_s)
    return RawTrack(
        position_time_s=time_s,
        position_in_ecef=table.xyz,
        sigma_enu_m=np.full((len(table), 3), np.nan) if table.sigma_enu_m is None else table.sigma_enu_m,
        attitude_time_s=time_s[turned],
        enu_from_body=matrix_from_quat_xyzw(quat[turned]) @ cam_from_body,
        cam_from_body=np.tile(cam_from_body, (images, 1, 1)),
        antenna_in_body=np.tile(arm, (images, 1)),
    )


def _track(
    raw: RawTrack, names: Sequence[str], time_s: FloatArray, config: IngestOptions, origin: Origin
) -> NavigationTrack | None:
    """The navigation in the frame at the origin, with images of those names at times (n,) of the camera's clock."""
    if not len(raw.position_time_s):
        return None
    return NavigationTrack(
        position_time_s=raw.position_time_s,
        antenna_in_geo=enu.enu_from_ecef(raw.position_in_ecef, origin),
        sigma_m=raw.sigma_enu_m,
        attitude_time_s=raw.attitude_time_s,
        geo_from_body=_turned_to_geo(raw, origin),
        image=np.array(names, dtype=np.str_),
        image_time_s=time_s,
        cam_from_body=raw.cam_from_body,
        antenna_in_body=raw.antenna_in_body,
        nominal_from_cam=_rig(config).nominal_from_cam,
        time_offset_s=np.array(config.time_offset_s),
        max_gap_s=np.array(config.max_gap),
        body_known=np.array(config.bag is not None or config.camera_mount is not None),
    )


def _turned_to_geo(raw: RawTrack, origin: Origin) -> FloatArray:
    """Attitudes against north and up where each was taken, turned into the frame at the origin."""
    if not len(raw.attitude_time_s):
        return raw.enu_from_body
    clock = raw.position_time_s
    place = np.stack(
        [np.interp(raw.attitude_time_s, clock, raw.position_in_ecef[:, axis]) for axis in range(3)], axis=1
    )
    return enu.geo_from_enu_at(enu.lla_from_ecef(place), origin) @ raw.enu_from_body
