"""Positions and attitudes of images as a table states them, and a trajectory as CSV (docs/inputs.md).

Attitude is either the gimbal's `yaw, pitch, roll` in degrees (docs/conventions.md) or a quaternion
`qx, qy, qz, qw` that rotates camera axes (x right, y down, z forward) into East-North-Up at the camera.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray, rows_of
from pipelines.formats import tables
from pipelines.geometry.rotations import geo_from_cam, quat_xyzw_from_matrix


@dataclass(frozen=True)
class PoseTable:
    """N rows of a trajectory, all that the file has. Absent columns are None, absent cells NaN."""

    path: Path
    source: str  # kind of file, as fixes and attitudes of the survey state it
    lines: IntArray  # (N,)
    names: tuple[str, ...] | None  # image of each row
    time_s: FloatArray | None  # (N,) seconds since 1970; a text without a zone is read as UTC
    xyz: FloatArray  # (N, 3) longitude or easting, latitude or northing, height, in the file's CRS
    geographic: bool | None  # whether the columns were called latitude and longitude; None if the CRS alone decides
    quat_xyzw: FloatArray | None = None  # (N, 4) rotations camera → East-North-Up at the camera
    sigma_enu_m: FloatArray | None = None  # (N, 3)
    # (N,) `RTK fixed`, `RTK float`, `single-frequency` or `unknown receiver`, as the solution has it
    receiver: NDArray[np.str_] | None = None
    crs_text: str | None = None  # the CRS that the file states
    crs_line: int = 1
    # CRS of a file that states none, where `--crs` names none either; None: WGS84 for latitude and longitude, and
    # otherwise it must be named
    assumed_crs: str | None = None
    heights_above_geoid: bool = False  # whether the heights are above a geoid that the file does not name
    zoneless_times: bool = False  # whether a time was a text without a zone
    unknown_columns: tuple[str, ...] = ()  # names in the header that mean nothing here
    header_line: int = 1

    def take(self, rows: IntArray | BoolArray) -> PoseTable:
        """Return the rows of an index (M,) or mask (N,)."""
        names = None if self.names is None else tuple(np.array(self.names, dtype=object)[rows])
        return replace(rows_of(self, rows), names=names)


def complete(values: FloatArray) -> BoolArray:
    """Return which rows of (N, k) values have no NaN: (N,)."""
    return np.asarray(np.isfinite(values).all(axis=1))


def camera_quaternions(gimbal_yaw_pitch_roll_deg: FloatArray) -> FloatArray:
    """Return rotations camera → East-North-Up (N, 4) of a gimbal's angles (N, 3), NaN where one is NaN."""
    known = complete(gimbal_yaw_pitch_roll_deg)
    result = np.full((len(known), 4), np.nan)
    result[known] = quat_xyzw_from_matrix(geo_from_cam(gimbal_yaw_pitch_roll_deg[known]))
    return result


_ALIASES = {
    "image": ("image_name", "filename", "file_name", "file", "name"),
    "timestamp": ("timestamp_s", "time", "time_s", "t"),
    "latitude": ("lat", "latitude_deg"),
    "longitude": ("lon", "lng", "long", "longitude_deg"),
    "altitude": ("alt", "height", "altitude_m", "ellipsoidal_height"),
    "x": ("easting", "east"),
    "y": ("northing", "north"),
    "z": ("elevation",),
    "yaw": ("yaw_deg", "heading"),
    "pitch": ("pitch_deg",),
    "roll": ("roll_deg",),
    **dict.fromkeys(("qx", "qy", "qz", "qw"), ()),
    **{f"sigma_{axis}": (f"sigma_{axis}_m", f"std_{axis}") for axis in ("e", "n", "u")},
}
_CANONICAL = {alias: key for key, aliases in _ALIASES.items() for alias in (key, *aliases)}
_GEOGRAPHIC = ("longitude", "latitude", "altitude")
_PROJECTED = ("x", "y", "z")
_ANGLES = ("yaw", "pitch", "roll")
_QUATERNION = ("qx", "qy", "qz", "qw")
_SIGMAS = ("sigma_e", "sigma_n", "sigma_u")
_RANGES = {
    "latitude": (-90.0, 90.0),
    "longitude": (-360.0, 360.0),
    "yaw": (-360.0, 360.0),
    "pitch": (-180.0, 180.0),
    "roll": (-360.0, 360.0),
    **dict.fromkeys(_SIGMAS, (1e-6, 1e6)),
}
_LATEST_S = 1e11  # the year 5138; larger numbers are milliseconds or finer


def read_trajectory(path: Path) -> PoseTable:
    """Read a trajectory.

    Separators are `,`, `;` or tab; with the latter two, decimals may be written with commas.

    Raises:
        InputError: no usable header, no row, a cell that is no number, a value out of range, half a group of
            columns, or a row longer than the header. Names file, line and column.
    """
    table = _read_table(path)
    geographic, projected = table.has(_GEOGRAPHIC), table.has(_PROJECTED)
    if geographic == projected:
        code, which = ("columns-ambiguous", "both") if geographic else ("column-missing", "neither of")
        message = f"The header has {which} latitude,longitude,altitude and x,y,z."
        raise InputError(code, message, path=path, line=table.header_line)
    xyz = _in_range(table, _GEOGRAPHIC) if geographic else table.numbers(_PROJECTED)
    time_s, zoneless = _times(table) if "timestamp" in table.columns else (None, False)
    return PoseTable(
        path=path,
        source="csv",
        lines=table.lines,
        names=tuple(tables.plain_text(row.text("image")) for row in table.rows)
        if "image" in table.columns
        else None,
        time_s=time_s,
        xyz=xyz,
        geographic=geographic,
        quat_xyzw=_attitudes(table),
        sigma_enu_m=_in_range(table, _SIGMAS) if table.has(_SIGMAS) else None,
        zoneless_times=zoneless,
        unknown_columns=table.unknown,
        header_line=table.header_line or 1,
    )


def _read_table(path: Path) -> tables.Table:
    """Return the rows; unlike those of other tables, cells in quotes may hold line ends."""
    lines = tables.read_lines(path)
    first = next(index for index, line in enumerate(lines) if line.strip())
    header = lines[first].lstrip("# ")
    separator = tables.separator_of(header)
    if separator is None:
        message = "The header has one column only: separate columns by , ; or tab."
        raise InputError("one-column", message, path=path, line=first + 1)
    names = [name.strip() for name in tables.split(header, separator, path=path, line=first + 1)]
    columns, unknown = tables.named_columns(
        names, _CANONICAL, path, first + 1, lambda name: name.lower().replace(" ", "_")
    )
    if not columns:
        message = (
            "The first line must be a header: image and/or timestamp, then latitude,longitude,altitude or x,y,z."
        )
        raise InputError("header-missing", message, path=path, line=first + 1)
    if "image" not in columns and "timestamp" not in columns:
        message = "The header has no column image and no column timestamp."
        raise InputError("column-missing", message, path=path, line=first + 1)
    width = header.count(separator) + 1
    rows = []
    reader = csv.reader(lines[first + 1 :], delimiter=separator)
    try:
        for cells in reader:
            line = first + 1 + reader.line_num
            if not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#"):
                continue
            if len(cells) > width and any(cell.strip() for cell in cells[width:]):
                hint = "; decimal commas need ; as separator" if separator == "," else ""
                message = f"The line has {len(cells)} cells, the header has {width}{hint}"
                raise InputError("wrong-columns", message, path=path, line=line)
            rows.append(tables.Row(path, line, cells, columns, separator != ","))
    except csv.Error as error:
        line = first + 1 + reader.line_num
        raise InputError("not-csv", f"The line is not CSV: {error}", path=path, line=line) from error
    tables.require_rows(rows, path)
    return tables.Table(path, first + 1, columns, unknown, rows)


def _in_range(table: tables.Table, columns: tuple[str, ...]) -> FloatArray:
    """Return the numbers of columns (N, K), each in its range."""
    values = table.numbers(columns)
    for name, (low, high) in _RANGES.items():
        if name in columns:
            column = values[:, columns.index(name)]
            tables.require_range(column, low, high, path=table.path, lines=table.lines, field=name)
    return values


def _attitudes(table: tables.Table) -> FloatArray | None:
    """Return rotations camera → East-North-Up (N, 4), NaN where a row has none."""
    angles, quaternion = table.has(_ANGLES), table.has(_QUATERNION)
    if angles and quaternion:
        message = "The header has both yaw,pitch,roll and qx,qy,qz,qw."
        raise InputError("columns-ambiguous", message, path=table.path, line=table.header_line)
    if angles:
        return camera_quaternions(_in_range(table, _ANGLES))
    if not quaternion:
        return None
    values = table.numbers(_QUATERNION)
    length = np.linalg.norm(values, axis=1)
    known = complete(values)
    tables.refuse_first(
        known & (np.abs(length - 1.0) > 0.01),
        "quaternion-length",
        lambda row: f"the quaternion has length {length[row]:g}, not 1",
        path=table.path,
        lines=table.lines,
        field="qx,qy,qz,qw",
    )
    return np.where(known[:, None], values / length[:, None], np.nan)


def _times(table: tables.Table) -> tuple[FloatArray, bool]:
    """Return seconds since 1970 (N,), of numbers or ISO 8601, and whether an ISO 8601 time has no zone."""
    moments = [_time(row) for row in table.rows]
    times = np.array([seconds for seconds, _ in moments])
    tables.refuse_first(
        np.abs(times) > _LATEST_S,
        "time-unit",
        lambda row: f"the time {times[row]:.0f} is probably in milliseconds or finer: give seconds since 1970",
        path=table.path,
        lines=table.lines,
        field="timestamp",
    )
    return times, any(zoneless for _, zoneless in moments)


def _time(row: tables.Row) -> tuple[float, bool]:
    text = row.text("timestamp")
    if text[4:5] != "-" or len(text) < 10:
        return row.number("timestamp"), False
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise row.fault("time-invalid", f"{text!r} is not an ISO 8601 time", "timestamp") from None
    zoneless = moment.tzinfo is None
    return (moment.replace(tzinfo=UTC) if zoneless else moment).timestamp(), zoneless
