"""Events of a DJI flight tied to its photographs: the number in a photograph's name is that of its event.

Files of `--trajectory`, each read as what its content shows it to be.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from pipelines.core.errors import ContradictionError, InputError
from pipelines.core.types import IntArray
from pipelines.formats.gnss_logs import FIRST_LINE, CameraEvents, read_mrk, read_pos
from pipelines.formats.metashape import HEADER, REFERENCE, read_cameras
from pipelines.formats.tables import beginning
from pipelines.formats.trajectory_csv import PoseTable, read_trajectory
from pipelines.geodesy.enu import ecef_from_enu_rotation, lla_from_ecef
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.notes import Notes
from pipelines.ingest.photo_folder import Photo

_NUMBER = re.compile(r"(?<!\d)\d{4}(?!\d)")  # DJI_20240501120000_0007_V, DJI_0007, 100_0042_0007
# The camera's clock has whole seconds and may be hours off, but runs evenly: a photograph counted wrongly shows.
_MOST_SPREAD_S = 3.0


def event_of_each(events: CameraEvents, photos: Sequence[Photo], notes: Notes) -> IntArray:
    """Return the row of each photograph's event (N,), −1 without one; what did not fit is noted.

    Raises:
        InputError: one number in two folders, or no event fits.
        ContradictionError: the times in EXIF are not those of the events.
    """
    row_of = {int(number): row for row, number in enumerate(events.number)}
    rows = np.array([row_of.get(_number(photo.name), -1) for photo in photos], dtype=np.int64)
    folders = sorted(
        {PurePosixPath(photo.name).parent.as_posix() for photo, row in zip(photos, rows, strict=True) if row >= 0}
    )
    if not folders:
        raise InputError(
            f"has the events {events.number.min()} to {events.number.max()}, and no photograph has such a number "
            f"in its name, as DJI_0007.JPG has: the folder has {photos[0].name!r} …",
            path=events.path,
        )
    if len(folders) > 1:
        raise InputError(
            "counts the photographs of one flight, but its numbers occur in several folders "
            f"({', '.join(folders[:3])}): take one folder and its file",
            path=events.path,
        )
    _refuse_other_times(events, photos, rows)
    notes.warn_counted(
        [photo.name for photo, row in zip(photos, rows, strict=True) if row < 0],
        f"image has no event in {events.path.name}",
        f"images have no event in {events.path.name}",
    )
    unused = np.setdiff1d(np.arange(len(events.number)), rows)
    notes.warn_counted(
        [f"{events.path.name}:{events.lines[row]}" for row in unused.tolist()],
        "event has no photograph here",
        "events have no photographs here",
    )
    return rows


def positions_of_events(events: CameraEvents, photos: Sequence[Photo], notes: Notes) -> PoseTable:
    """Return the positions of the photographs' events, as a table by name.

    Raises:
        InputError: as `event_of_each`.
        ContradictionError: as `event_of_each`.
    """
    row_of_photo = event_of_each(events, photos, notes)
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


def at_times_of_events(events: CameraEvents, photos: Sequence[Photo], rows: IntArray) -> list[Photo]:
    """Return the photographs with the times of their events; the row −1 leaves a photograph without a time."""
    times = [float(events.time_s[row]) if row >= 0 else None for row in rows]
    return [
        replace(photo, tags=replace(photo.tags, timestamp_s=time_s, time_source=None))
        for photo, time_s in zip(photos, times, strict=True)
    ]


def from_antenna_to_camera(poses: ImagePoses, events: CameraEvents, rows: IntArray) -> ImagePoses:
    """Return poses of N images whose positions are moved from the antenna to the camera, by the events' offsets."""
    moved = np.flatnonzero(poses.located & (rows >= 0))
    position = poses.position_in_ecef.copy()
    ecef_from_enu = ecef_from_enu_rotation(lla_from_ecef(position[moved]))
    position[moved] += np.einsum("nij,nj->ni", ecef_from_enu, events.camera_from_antenna_enu_m[rows[moved]])
    return replace(poses, position_in_ecef=position, recorded=None)


def _number(name: str) -> int:
    """Return the last group of four digits in a photograph's name; −1 without one."""
    groups = _NUMBER.findall(PurePosixPath(name).stem)
    return int(groups[-1]) if groups else -1


def _refuse_other_times(events: CameraEvents, photos: Sequence[Photo], rows: IntArray) -> None:
    timed = [(photo, row) for photo, row in zip(photos, rows, strict=True) if row >= 0 and photo.tags.timestamp_s]
    if len(timed) < 2:
        return
    apart_s = np.array([events.time_s[row] - (photo.tags.timestamp_s or 0.0) for photo, row in timed])
    off_s = np.abs(apart_s - np.median(apart_s))
    if off_s.max() > _MOST_SPREAD_S:
        worst = timed[int(off_s.argmax())][0].name
        raise ContradictionError(
            f"{events.path}: by number, {int((off_s > _MOST_SPREAD_S).sum())} of {len(timed)} photographs do not "
            f"have the times of their events (EXIF of {worst}: {off_s.max():.0f} s off): is it the file of another "
            "flight?"
        )


def read_positions(path: Path, photos: Sequence[Photo], notes: Notes) -> PoseTable:
    """Read a table of poses; the kind of the file follows from its content, and is noted.

    1. The first line begins with %: RTKLIB's solution.
    2. The first line is an event of DJI's timestamp file: that.
    3. A line begins with `#Label`: Metashape's reference.
    4. Anything else: a CSV with a header.

    Raises:
        InputError: the file cannot be read as what it seems to be.
        ContradictionError: events are not those of the photographs.
    """
    lines = [line for line in beginning(path).splitlines() if line.strip()]
    if lines and lines[0].startswith("%"):
        notes.assume(f"{path.name} is read as RTKLIB's solution: positions of the antenna")
        return read_pos(path)
    if lines and FIRST_LINE.match(lines[0]):
        notes.assume(f"{path.name} is read as DJI's timestamp file: positions of the camera, by photograph number")
        return positions_of_events(read_mrk(path), photos, notes)
    if any(HEADER.match(line) for line in lines):
        notes.assume(f"{path.name} is read as {REFERENCE}")
        return read_cameras(path)
    return read_trajectory(path)
