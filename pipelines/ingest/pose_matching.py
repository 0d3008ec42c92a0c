"""A table of positions and attitudes, by image name or by time, in whatever CRS its file has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.geometry.rotations import exp_so3, log_so3, matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.ingest.image_names import ImageNames
from pipelines.ingest.notes import Notes

# Clocks write milliseconds: an image this close to a row was taken at it.
_SAME_TIME_S = 1e-3


def match_by_name(table: PoseTable, images: list[str], notes: Notes) -> PoseTable:
    """The rows that belong to `images`, with the images' own names; what did not match is noted.

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
    found = table.take(np.array([row_of[name] for name in row_of], dtype=np.int64))
    return replace(found, names=tuple(row_of))


def interpolate(table: PoseTable, time_s: FloatArray, max_gap_s: float) -> tuple[PoseTable, BoolArray]:
    """Rows of `table` at the times `time_s` (M,): positions and σ linearly, attitudes along the shortest arc.

    Nothing is extrapolated, and nothing interpolated between rows more than `max_gap_s` apart; an image that
    is outside, but within a millisecond of a row, gets that row. Positions should be
    Cartesian: degrees jump at the date line.

    Args:
        table: with times; rows without position or time do not count.
        time_s: times; NaN where unknown.
        max_gap_s: in seconds.

    Returns:
        The K rows that were found, and which of the M times they are for (M,).
    """
    if table.time_s is None:
        raise ValueError("a table without times cannot be interpolated")
    usable = np.isfinite(table.time_s) & complete(table.xyz)
    rows = table.take(np.flatnonzero(usable)[np.argsort(table.time_s[usable], kind="stable")])
    clock = np.asarray(rows.time_s)
    if not len(rows):
        return rows, np.zeros(len(time_s), dtype=bool)
    after = np.clip(np.searchsorted(clock, time_s), 1 if len(rows) > 1 else 0, len(rows) - 1)
    before = np.maximum(after - 1, 0)
    gap = clock[after] - clock[before]
    part = np.clip((time_s - clock[before]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
    nearest = np.where(part < 0.5, before, after)
    exact = np.abs(clock[nearest] - time_s) <= _SAME_TIME_S
    inside = (time_s >= clock[before]) & (time_s <= clock[after]) & (gap <= max_gap_s)
    found = np.asarray(exact | inside)
    exact &= ~inside
    before = np.where(exact, nearest, before)[found]
    after = np.where(exact, nearest, after)[found]
    part = np.where(exact, 0.0, part)[found]
    blended = replace(
        rows.take(nearest[found]),
        names=None,
        time_s=np.asarray(time_s)[found],
        xyz=_blend(rows.xyz, before, after, part),
        quat_xyzw=None if rows.quat_xyzw is None else _slerp(rows.quat_xyzw, before, after, part),
        sigma_enu_m=None if rows.sigma_enu_m is None else _blend(rows.sigma_enu_m, before, after, part),
    )
    return blended, found


def _blend(values: FloatArray, before: IntArray, after: IntArray, part: FloatArray) -> FloatArray:
    return values[before] + part[:, None] * (values[after] - values[before])


def _slerp(quat_xyzw: FloatArray, before: IntArray, after: IntArray, part: FloatArray) -> FloatArray:
    known = complete(quat_xyzw[before]) & complete(quat_xyzw[after])
    result = np.full((len(part), 4), np.nan)
    start = matrix_from_quat_xyzw(quat_xyzw[before[known]])
    end = matrix_from_quat_xyzw(quat_xyzw[after[known]])
    turn = log_so3(np.swapaxes(start, -1, -2) @ end)
    result[known] = quat_xyzw_from_matrix(start @ exp_so3(part[known, None] * turn))
    return result
