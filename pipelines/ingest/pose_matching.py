"""Rows of a table of poses brought to the survey's images: by name, or by time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.geometry.trajectory import Trajectory
from pipelines.ingest.image_names import ImageNames
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.photo_poses import photo_times


def match_by_name(table: PoseTable, images: list[str], notes: Notes) -> PoseTable:
    """Return the rows that belong to `images`, with the images' own names; the other rows are noted.

    Raises:
        InputError: two rows for one image, a name that leaves the folder or is ambiguous, or no match at all.
    """
    index = ImageNames(images)
    row_of: dict[str, int] = {}
    unknown, loose = [], []
    for row, text in enumerate(table.names or ()):
        line = int(table.lines[row])
        name = index.find(text, path=table.path, line=line)
        if name is None:
            unknown.append(f"{table.path.name}:{line} ({text})")
            continue
        if name in row_of:
            earlier = int(table.lines[row_of[name]])
            raise InputError(
                f"{name} has a row already, in line {earlier}", path=table.path, line=line, field="image"
            )
        if Path(text.replace("\\", "/")).name != Path(name).name:
            loose.append(f"{table.path.name}:{line} ({text} for {name})")
        row_of[name] = row
    if not row_of:
        raise InputError(
            f"names none of the images: it has {(table.names or ('nothing',))[0]!r} …, the folder {images[0]!r} …",
            path=table.path,
            field="image",
        )
    notes.warn_counted(unknown, "row names no image here", "rows name no image here")
    notes.warn_counted(
        loose,
        "row names its image with another case or without suffix",
        "rows name their images with another case or without suffix",
    )
    matched = table.take(np.array([row_of[name] for name in row_of], dtype=np.int64))
    return replace(matched, names=tuple(row_of))


def match_by_time(
    trajectory: Trajectory, photos: Sequence[Photo], path: Path, options: IngestOptions, notes: Notes
) -> Trajectory:
    """Return the trajectory at the times of the photographs (N rows), NaN where it does not reach.

    Raises:
        InputError: no photograph has a time, or none of them lies within the trajectory.
    """
    time_s = photo_times(photos)
    timeless = [photo.name for photo in photos if photo.tags.timestamp_s is None]
    notes.warn_counted(timeless, "image has no time in EXIF", "images have no time in EXIF")
    if len(timeless) == len(photos):
        raise InputError("has no column image, and no image has a time in EXIF", path=path, field="timestamp")
    if any(photo.tags.time_source == "assumed UTC" for photo in photos):
        notes.assume("EXIF times without a zone are UTC")
    matched = trajectory.at(time_s + options.time_offset_s)
    if not complete(matched.position).any():
        raise InputError(
            f"covers {_span(trajectory.time_s)}, the images {_span(time_s)}: none fits, with gaps of "
            f"{trajectory.max_gap_s:g} s at most. Is the camera's clock in another time zone? Is --max-gap too "
            "small?",
            path=path,
            field="timestamp",
        )
    return matched


def _span(time_s: FloatArray) -> str:
    ends = (datetime.fromtimestamp(float(end), UTC) for end in (np.nanmin(time_s), np.nanmax(time_s)))
    return " to ".join(end.strftime("%Y-%m-%d %H:%M:%S UTC") for end in ends)
