"""Files of `--trajectory`, each read as what its content shows it to be."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipelines.formats.dji_mrk import FIRST_LINE, read_mrk
from pipelines.formats.metashape_reference import HEADER, KIND, read_cameras
from pipelines.formats.pose_table import PoseTable
from pipelines.formats.rtklib_pos import read_pos
from pipelines.formats.text import beginning
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.ingest.camera_events import positions_of_events
from pipelines.ingest.notes import Notes
from pipelines.ingest.photo_folder import Photo


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
        notes.assume(f"{path.name} is read as {KIND}")
        return read_cameras(path)
    return read_trajectory(path)
