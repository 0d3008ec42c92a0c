"""A flight out of a folder of photographs, with or without a table of poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.gnss_logs import read_mrk
from pipelines.formats.ground_points import read_geo
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.geometry.trajectory import Rig, Trajectory
from pipelines.ingest.camera_events import at_times_of_events, event_of_each, from_antenna_to_camera, read_positions
from pipelines.ingest.exif_poses import poses_from_tags
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.navigation import (
    FlightRecord,
    RecordedNavigation,
    at_cameras,
    body_mount,
    given_rig,
    require_enough,
)
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo, camera_priors, scan_folder
from pipelines.ingest.table_poses import poses_from_table


def read_folder(
    folder: Path, options: IngestOptions, notes: Notes, progress: Progress = SILENT, *, decode: bool = True
) -> FlightRecord:
    """Read photographs, and the trajectory or `geo.txt` that the options name.

    Args:
        folder: of the photographs.
        options: of `ingest`.
        notes: what is assumed and doubtful.
        progress: a step a photograph.
        decode: as of `scan_folder`.

    Raises:
        InputError: anything wrong with the files, or too few photographs.
    """
    photos = _usable_photos(folder, notes, progress, decode=decode)
    poses = _poses(photos, options, notes)
    if options.time_offset_s and poses.recorded is None:
        raise InputError(
            "is for navigation by time: a --bag, or a --trajectory without a column of images",
            field="--time-offset",
        )
    rig, names = given_rig(options), [photo.name for photo in photos]
    navigation = None
    if poses.recorded is not None:
        navigation = _navigation(poses.recorded, rig, names, poses.time_s, options)
    poses = at_cameras(poses, rig, names, notes)
    cameras, camera_of = camera_priors(photos, options.focal_px, notes)
    return FlightRecord(folder.resolve(), photos, cameras, camera_of, poses, navigation)


def _usable_photos(folder: Path, notes: Notes, progress: Progress, *, decode: bool) -> list[Photo]:
    photos = scan_folder(folder, notes, progress, decode=decode)
    require_enough(photos, folder, "--images", notes)
    for problem in sorted({problem for photo in photos for problem in photo.tags.problems}):
        names = [photo.name for photo in photos if problem in photo.tags.problems]
        notes.warn_counted(names, f"image where {problem}", f"images where {problem}")
    notes.warn_counted(
        [photo.name for photo in photos if photo.tags.orientation != 1],
        "image has an EXIF orientation, which is ignored: pixels count as stored",
        "images have an EXIF orientation, which is ignored: pixels count as stored",
    )
    return photos


def _poses(photos: list[Photo], options: IngestOptions, notes: Notes) -> ImagePoses:
    table = _pose_table(photos, options, notes)
    if table is None:
        return poses_from_tags(photos, options, notes)
    if options.events is None:
        return poses_from_table(table, photos, options, notes)
    if table.names is not None:
        raise InputError("is for a --trajectory by time: this one names its images", field="--events")
    events = read_mrk(options.events)
    rows = event_of_each(events, photos, notes)
    poses = poses_from_table(table, at_times_of_events(events, photos, rows), options, notes)
    return from_antenna_to_camera(poses, events, rows)


def _pose_table(photos: list[Photo], options: IngestOptions, notes: Notes) -> PoseTable | None:
    if options.trajectory is not None:
        return read_positions(options.trajectory, photos, notes)
    return None if options.geo is None else read_geo(options.geo)


def _navigation(
    recorded: Trajectory, rig: Rig, names: list[str], time_s: FloatArray, options: IngestOptions
) -> RecordedNavigation:
    """Return a table by time as navigation of the photographs that have a time (N,)."""
    timed = np.flatnonzero(np.isfinite(time_s))
    turned = np.isfinite(recorded.rotation).all(axis=(1, 2))
    mount = body_mount(rig)
    attitudes = Trajectory.from_samples(
        recorded.time_s[turned], rotation=recorded.rotation[turned] @ mount, max_gap_s=recorded.max_gap_s
    )
    return RecordedNavigation(
        positions=recorded,
        attitudes=attitudes,
        rig=Rig(mount, rig.antenna_in_body, rig.nominal_from_cam),
        body_known=rig.cam_from_body is not None,
        images=tuple(names[row] for row in timed),
        image_time_s=time_s[timed],
        time_offset_s=options.time_offset_s,
    )
