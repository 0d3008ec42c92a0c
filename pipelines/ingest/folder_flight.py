"""A flight out of a folder of photographs: with their tags alone, with a table of poses, or with DJI's events.

Events are tied to photographs by the number in a photograph's name. Remarks name tags that are unusable, corrected
or repeated.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from pipelines.core.errors import InconsistencyError, InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.gnss_logs import FIRST_LINE, CameraEvents, read_mrk, read_pos
from pipelines.formats.ground_points import read_geo
from pipelines.formats.metashape import HEADER, REFERENCE, read_cameras
from pipelines.formats.tables import beginning
from pipelines.formats.trajectory_csv import PoseTable, read_trajectory
from pipelines.geodesy.enu import ecef_from_enu_rotation, lla_from_ecef
from pipelines.geometry.trajectory import Rig, Trajectory
from pipelines.ingest import flight_record
from pipelines.ingest.exif_poses import poses_from_tags
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo, camera_priors, scan_folder
from pipelines.ingest.photo_times import event_numbers, rows_by_order, with_times
from pipelines.ingest.reference_system import is_projected
from pipelines.ingest.remarks import Remarks, shortened
from pipelines.ingest.rig_instants import photos_of_rig
from pipelines.ingest.sensors import with_sensors
from pipelines.ingest.stray_pictures import (
    with_sharpness,
    without_blurred,
    without_panoramas,
    without_reduced_copies,
)
from pipelines.ingest.table_poses import poses_from_table

# The camera's clock has whole seconds and may be hours off, but runs evenly: a photograph counted wrongly shows.
_MOST_SPREAD_S = 3.0


def read_folder(
    folder: Path,
    options: IngestOptions,
    remarks: Remarks,
    progress: Progress = SILENT,
    *,
    decode: bool = True,
    table: PoseTable | None = None,
) -> flight_record.FlightRecord:
    """Read photographs, and the trajectory or `geo.txt` that the options name; `decode` as of `scan_folder`.

    `table` has positions of the photographs by name, in place of their tags.

    Raises:
        InconsistencyError: the files are inconsistent.
        InputError: anything wrong with the files, too few photographs, or none of the sensor that is asked for.
    """
    photos = without_panoramas(scan_folder(folder, remarks, progress, decode=decode), remarks)
    photos = without_reduced_copies(with_sensors(photos), remarks)
    photos, accompanying, rotations = photos_of_rig(photos, options.sensor, options.rig, remarks)
    photos = with_sharpness(photos)
    photos = without_blurred(photos, remarks) if options.skip_blurred else photos
    flight_record.require_enough(len(photos), folder, "--images", remarks)
    photos = with_times(photos, remarks)
    note_tags(photos, remarks)
    others = {each.photo.name for each in accompanying}
    poses = (
        _poses(photos, options, remarks, others)
        if table is None
        else poses_from_table(table, photos, options, remarks)
    )
    if options.time_offset_s and poses.recorded is None:
        raise InputError(
            "time-offset-without-times",
            "--time-offset needs a --bag, or a --trajectory with times and without image names.",
            field="--time-offset",
            remedy="Remove --time-offset.",
        )
    rig, names = flight_record.given_rig(options), [photo.name for photo in photos]
    located = np.where(poses.located[:, None], poses.position_in_ecef, np.nan)
    note_repeats(names, lla_from_ecef(located)[:, :2], poses.time_s, remarks)
    navigation = None
    if poses.recorded is not None:
        navigation = _navigation(poses.recorded, rig, names, poses.time_s, options)
    poses = flight_record.at_cameras(poses, rig, names, remarks)
    accompanying = tuple(each for each in accompanying if each.beside in names)
    everything = [*photos, *(each.photo for each in accompanying)]
    cameras, camera_of = camera_priors(everything, options.focal_px, remarks)
    return flight_record.FlightRecord(
        folder.resolve(), photos, cameras, camera_of, poses, navigation, accompanying, rotations
    )


def _poses(
    photos: list[Photo], options: IngestOptions, remarks: Remarks, others: set[str]
) -> flight_record.ImagePoses:
    """Return the poses of photographs; rows of a table that name `others`, of a rig's other lenses, are skipped."""
    if options.trajectory is not None:
        table = _read_positions(options.trajectory, photos, options, remarks)
    elif options.geo is not None:
        table = read_geo(options.geo)
    else:
        return poses_from_tags(photos, options, remarks)
    if others and table.names is not None:
        table = table.take(np.array([name not in others for name in table.names]))
    if options.events is None:
        if not options.time_offset and not options.estimated:
            table = rows_by_order(table, photos, remarks) or table
        return poses_from_table(table, photos, options, remarks)
    if table.names is not None:
        raise InputError(
            "events-without-times",
            f"--events needs a trajectory with times; {table.path.name} lists image names.",
            field="--events",
            remedy="Remove --events.",
        )
    events = read_mrk(options.events)
    rows = _event_of_each(events, photos, remarks)
    timed = []
    for photo, row in zip(photos, rows, strict=True):
        time_s = float(events.time_s[row]) if row >= 0 else None
        timed.append(
            replace(
                photo,
                tags=replace(photo.tags, timestamp_s=time_s, time_source=None, time_sigma_s=0.0, time_common_s=0.0),
            )
        )
    poses = poses_from_table(table, timed, options, remarks)
    # From the antenna to the camera, by the events' offsets.
    moved = np.flatnonzero(poses.located & (rows >= 0))
    position = poses.position_in_ecef.copy()
    ecef_from_enu = ecef_from_enu_rotation(lla_from_ecef(position[moved]))
    position[moved] += np.einsum("nij,nj->ni", ecef_from_enu, events.camera_from_antenna_enu_m[rows[moved]])
    return replace(poses, position_in_ecef=position, recorded=None)


def _read_positions(path: Path, photos: Sequence[Photo], options: IngestOptions, remarks: Remarks) -> PoseTable:
    """Read a table of poses; the kind of the file follows from its content, and is noted.

    1. The first line begins with %: RTKLIB's solution.
    2. The first line is an event of DJI's timestamp file: that.
    3. A line begins with `#Label`: Metashape's reference.
    4. Anything else: a CSV with a header.
    """
    lines = [line for line in beginning(path).splitlines() if line.strip()]
    if lines and lines[0].startswith("%"):
        remarks.assume("file-kind", f"{path.name} is read as RTKLIB's solution: positions of the antenna.")
        return read_pos(path)
    if lines and FIRST_LINE.match(lines[0]):
        remarks.assume(
            "file-kind",
            f"{path.name} is read as DJI's timestamp file: positions of the camera, by photograph number.",
        )
        return _positions_of_events(read_mrk(path), photos, remarks)
    if any(HEADER.match(line) for line in lines):
        remarks.assume("file-kind", f"{path.name} is read as {REFERENCE}.")
        return read_cameras(path)
    try:
        return read_trajectory(path, projected=is_projected(options.crs, "--crs"))
    except InputError as error:
        if error.code != "header-missing":
            raise
        # No kind of file: what the option was given is no trajectory.
        message = f"{path}:{error.line} is no table of positions. {error.message}"
        raise InputError(error.code, message, field="--trajectory") from error


def _positions_of_events(events: CameraEvents, photos: Sequence[Photo], remarks: Remarks) -> PoseTable:
    """Return the positions of the photographs' events, as a table by name."""
    row_of_photo = _event_of_each(events, photos, remarks)
    rows = row_of_photo[row_of_photo >= 0]
    return PoseTable(
        path=events.path,
        source="mrk",
        lines=events.lines[rows],
        names=tuple(photo.name for photo, row in zip(photos, row_of_photo, strict=True) if row >= 0),
        time_s=events.time_s[rows],
        xyz=events.lon_lat_alt[rows],
        geographic=True,
        sigma_enu_m=events.sigma_enu_m[rows],
        receiver=events.receiver[rows],
        assumed_crs="EPSG:4979",
    )


def _event_of_each(events: CameraEvents, photos: Sequence[Photo], remarks: Remarks) -> IntArray:
    """Return the row of each photograph's event (N,), −1 without one; what did not fit is noted.

    Raises:
        InputError: one number in two folders, or no event fits.
        InconsistencyError: the times in EXIF are not those of the events.
    """
    row_of = {int(number): row for row, number in enumerate(events.number)}
    rows = np.full(len(photos), -1)
    for at, number in enumerate(event_numbers(events, photos, remarks)):
        rows[at] = -1 if number is None else row_of.get(number, -1)
    tied = [(photo, int(row)) for photo, row in zip(photos, rows, strict=True) if row >= 0]
    folders = sorted({PurePosixPath(photo.name).parent.as_posix() for photo, _ in tied})
    if not folders:
        raise InputError(
            "event-numbers",
            f"The events have the numbers {events.number.min()} to {events.number.max()}, and no photograph has "
            f"such a number in its name (as DJI_0007.JPG has); the folder has {photos[0].name!r} …",
            path=events.path,
        )
    if len(folders) > 1:
        raise InputError(
            "event-folders",
            (
                "The file numbers the photographs of one flight, but its numbers occur in several folders ("
                f"{', '.join(folders[:3])})."
            ),
            path=events.path,
            remedy="Give one folder and its file.",
        )
    _refuse_other_times(events, [(photo, row) for photo, row in tied if photo.tags.timestamp_s])
    remarks.warn_counted(
        "image-without-event",
        [photo.name for photo, row in zip(photos, rows, strict=True) if row < 0],
        f"Images have no event in {events.path.name}",
    )
    unused = np.setdiff1d(np.arange(len(events.number)), rows)
    remarks.warn_counted(
        "event-without-image",
        [f"{events.path.name}:{events.lines[row]}" for row in unused.tolist()],
        "Events have no photograph here",
    )
    return rows


def _refuse_other_times(events: CameraEvents, timed: Sequence[tuple[Photo, int]]) -> None:
    """Refuse events whose times are not those of their photographs, up to the offset of the camera's clock."""
    if len(timed) < 2:
        return
    apart_s = np.array([events.time_s[row] - (photo.tags.timestamp_s or 0.0) for photo, row in timed])
    off_s = np.abs(apart_s - np.median(apart_s))
    if off_s.max() > _MOST_SPREAD_S:
        worst = timed[int(off_s.argmax())][0].name
        raise InconsistencyError(
            "event-times",
            f"{events.path}: {int((off_s > _MOST_SPREAD_S).sum())} of {len(timed)} photographs do not have the "
            "times of the events with "
            f"their numbers (EXIF of {worst} is off by {off_s.max():.0f} s). Is it the file of another flight?",
        )


def _navigation(
    recorded: Trajectory, rig: Rig, names: list[str], time_s: FloatArray, options: IngestOptions
) -> flight_record.RecordedNavigation:
    """Return a table by time as navigation of the photographs that have a time (N,)."""
    timed = np.flatnonzero(np.isfinite(time_s))
    turned = np.isfinite(recorded.rotation).all(axis=(1, 2))
    mount = flight_record.body_mount(rig)
    attitudes = Trajectory.from_samples(
        recorded.time_s[turned], rotation=recorded.rotation[turned] @ mount, max_gap_s=recorded.max_gap_s
    )
    return flight_record.RecordedNavigation(
        positions=recorded,
        attitudes=attitudes,
        rig=Rig(mount, rig.antenna_in_body, rig.nominal_from_cam),
        body_known=rig.cam_from_body is not None,
        images=tuple(names[row] for row in timed),
        image_time_s=time_s[timed],
        time_offset_s=options.time_offset_s,
    )


_LEAST = 3
_REPEATED = 0.3  # of the photographs, from which repeats are no hovering
_SAME_DEG = 1e-9


def note_tags(photos: Sequence[Photo], remarks: Remarks) -> None:
    """Note tags that are not used, and those of a wrong form with the way in which they are read."""
    for problem in sorted({problem for photo in photos for problem in photo.tags.problems}):
        with_it = [photo.name for photo in photos if problem in photo.tags.problems]
        remarks.warn_counted("exif-unusable", with_it, f"Tags of images are not used, because {problem}")
    for correction in sorted({correction for photo in photos for correction in photo.tags.corrections}):
        with_it = [photo.name for photo in photos if correction in photo.tags.corrections]
        remarks.warn_counted("tag-corrected", with_it, correction.removesuffix("."))
    remarks.warn_counted(
        "exif-orientation",
        [photo.name for photo in photos if photo.tags.orientation != 1],
        "Images have an EXIF orientation, which is ignored: pixels are read as stored",
    )


def note_repeats(names: Sequence[str], lat_lon_deg: FloatArray, time_s: FloatArray, remarks: Remarks) -> None:
    """Note places (N, 2), NaN where unknown, that photographs of other moments repeat."""
    known = np.flatnonzero(np.isfinite(lat_lon_deg).all(axis=1))
    if len(known) < _LEAST:
        return
    if np.ptp(lat_lon_deg[known], axis=0).max() < _SAME_DEG:
        remarks.caution(
            "one-position-for-all",
            f"All {len(known)} photographs have one position: programs write that of an album, and receivers "
            "without a fix repeat the last. It says nothing about the size or the heading of the survey.",
        )
        return
    if np.isfinite(time_s[known]).all():
        known = known[np.argsort(time_s[known], kind="stable")]
    places, times = lat_lon_deg[known], time_s[known]
    same = np.abs(np.diff(places, axis=0)).max(axis=1) < _SAME_DEG
    same &= ~(np.abs(np.diff(times)) < 0.5)  # two cameras of one moment; an unknown time is another
    if same.sum() >= max(2.0, _REPEATED * len(known)):
        remarks.caution(
            "positions-repeat",
            f"{int(same.sum())} of {len(known)} photographs repeat the position of the one before them: "
            f"{shortened([names[row] for row in known[1:][same]])}. The receiver had no new fix, or the "
            "camera hovered.",
        )
