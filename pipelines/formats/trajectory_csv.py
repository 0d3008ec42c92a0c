"""A trajectory as CSV with a header. docs/inputs.md tells the columns to users.

Attitude is either the gimbal's `yaw, pitch, roll` in degrees (docs/conventions.md) or a quaternion
`qx, qy, qz, qw` that rotates camera axes (x right, y down, z forward) into East-North-Up at the camera.

Positions and attitudes of images as a table states them, row by row.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.tables import number, plain_text, read_lines
from pipelines.geometry.rotations import geo_from_cam, quat_xyzw_from_matrix


@dataclass(frozen=True)
class PoseTable:
    """N rows of a trajectory, all that the file has. Absent columns are None, absent cells NaN.

    Attributes:
        path: its file.
        source: kind of file.
        lines: (N,) line of each row.
        names: image of each row.
        time_s: (N,) seconds since 1970; a text without a zone is read as UTC.
        xyz: (N, 3) longitude or easting, latitude or northing, height, in the file's CRS.
        geographic: whether the columns were called latitude and longitude; None if the CRS alone decides.
        quat_xyzw: (N, 4) rotations camera → East-North-Up at the camera.
        sigma_enu_m: (N, 3) σ east, north, up.
        receiver: (N,) kind of receiver, as the solution has it: `RTK fixed`, `RTK float`, `single-frequency` or
            `unknown receiver`.
        crs_text: the CRS that the file states.
        crs_line: line of the CRS.
        assumed_crs: CRS of a file that states none, where `--crs` names none either; None: WGS84 for latitude and
            longitude, and otherwise it must be named.
        heights_above_geoid: whether the heights are above a geoid that the file does not name.
        zoneless_times: whether a time was a text without a zone.
        unknown_columns: names in the header that mean nothing here.
        header_line: line of the header.
    """

    path: Path
    source: Literal["csv", "geo.txt", "metashape", "pos", "mrk"]
    lines: IntArray
    names: tuple[str, ...] | None
    time_s: FloatArray | None
    xyz: FloatArray
    geographic: bool | None
    quat_xyzw: FloatArray | None = None
    sigma_enu_m: FloatArray | None = None
    receiver: NDArray[np.str_] | None = None
    crs_text: str | None = None
    crs_line: int = 1
    assumed_crs: str | None = None
    heights_above_geoid: bool = False
    zoneless_times: bool = False
    unknown_columns: tuple[str, ...] = ()
    header_line: int = 1

    def __len__(self) -> int:
        return len(self.xyz)

    def take(self, rows: IntArray | BoolArray) -> PoseTable:
        """Return the rows of an index (M,) or mask (N,)."""
        names = None if self.names is None else tuple(np.array(self.names, dtype=object)[rows])
        return replace(
            self,
            lines=self.lines[rows],
            names=names,
            time_s=_taken(self.time_s, rows),
            xyz=self.xyz[rows],
            quat_xyzw=_taken(self.quat_xyzw, rows),
            sigma_enu_m=_taken(self.sigma_enu_m, rows),
            receiver=None if self.receiver is None else self.receiver[rows],
        )


def complete(values: FloatArray) -> BoolArray:
    """Return which rows of (N, k) values have no NaN: (N,)."""
    return np.asarray(np.isfinite(values).all(axis=1))


def _taken(values: FloatArray | None, rows: IntArray | BoolArray) -> FloatArray | None:
    return None if values is None else values[rows]


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
_LATEST_S = 1e11  # the year 5138; larger numbers are milliseconds or finer


def read_trajectory(path: Path) -> PoseTable:
    """Read a trajectory.

    Separators are `,`, `;` or tab; with the latter two, decimals may be written with commas.

    Raises:
        InputError: no usable header, no row, a cell that is no number, a latitude out of range, half a group of
            columns, or a row longer than the header. Names file, line and column.
    """
    cells = _Cells.read(path)
    position = _position_columns(cells)
    xyz = cells.group(position)
    geographic = position == _GEOGRAPHIC
    if geographic:
        cells.check_range(xyz[:, 1], 90.0, "latitude")
        cells.check_range(xyz[:, 0], 360.0, "longitude")
    moments = _times(cells) if "timestamp" in cells.columns else None
    return PoseTable(
        path=path,
        source="csv",
        lines=np.array(cells.lines, dtype=np.int64),
        names=tuple(map(plain_text, cells.texts("image"))) if "image" in cells.columns else None,
        time_s=None if moments is None else moments[0],
        xyz=xyz,
        geographic=geographic,
        quat_xyzw=_attitudes(cells),
        sigma_enu_m=_sigmas(cells),
        zoneless_times=moments is not None and moments[1],
        unknown_columns=cells.unknown_columns,
        header_line=cells.header_line,
    )


@dataclass(frozen=True)
class _Cells:
    """The rows as text, with the column that each canonical name has."""

    path: Path
    header_line: int
    columns: dict[str, int]
    unknown_columns: tuple[str, ...]
    rows: list[list[str]]
    lines: list[int]
    decimal_comma: bool

    @classmethod
    def read(cls, path: Path) -> _Cells:
        lines = read_lines(path)
        first = next(index for index, line in enumerate(lines) if line.strip())
        header = lines[first].lstrip("# ")
        separator = max(";\t,", key=header.count)
        if separator not in header:
            raise InputError(
                "the header has one column only: separate columns by , ; or tab", path=path, line=first + 1
            )
        columns, unknown = _columns(next(csv.reader([header], delimiter=separator)), path, first + 1)
        width = header.count(separator) + 1
        rows, numbers = [], []
        reader = csv.reader(lines[first + 1 :], delimiter=separator)
        try:
            for row in reader:
                line = first + 1 + reader.line_num
                if not any(cell.strip() for cell in row) or row[0].lstrip().startswith("#"):
                    continue
                if len(row) > width and any(cell.strip() for cell in row[width:]):
                    hint = "; decimal commas need ; as separator" if separator == "," else ""
                    raise InputError(f"has {len(row)} cells, the header has {width}{hint}", path=path, line=line)
                rows.append(row)
                numbers.append(line)
        except csv.Error as error:
            raise InputError(f"is no CSV: {error}", path=path, line=first + 1 + reader.line_num) from error
        if not rows:
            raise InputError("has a header but no rows", path=path)
        return cls(path, first + 1, columns, unknown, rows, numbers, separator != ",")

    def texts(self, column: str) -> list[str]:
        at = self.columns[column]
        return [row[at].strip() if at < len(row) else "" for row in self.rows]

    def numbers(self, column: str) -> FloatArray:
        """Return the numbers of a column (N,); NaN where empty."""
        return np.array(
            [
                number(text, path=self.path, line=line, field=column, decimal_comma=self.decimal_comma)
                for text, line in zip(self.texts(column), self.lines, strict=True)
            ]
        )

    def has(self, columns: tuple[str, ...]) -> bool:
        """Return whether a group of columns is there: all of them, or none."""
        present = [name for name in columns if name in self.columns]
        if present and len(present) < len(columns):
            missing = ", ".join(name for name in columns if name not in self.columns)
            raise InputError(f"has {', '.join(present)} but not {missing}", path=self.path, line=self.header_line)
        return bool(present)

    def group(self, columns: tuple[str, ...]) -> FloatArray:
        """Return the numbers of several columns (N, len(columns))."""
        return np.stack([self.numbers(column) for column in columns], axis=-1)

    def check_range(self, values: FloatArray, limit: float, column: str, least: float | None = None) -> None:
        """Raise for the first value outside −limit … limit (or least … limit)."""
        lowest = -limit if least is None else least
        bad = np.flatnonzero((values < lowest) | (values > limit))
        if len(bad):
            message = f"{values[bad[0]]:g} is out of range {lowest:g} … {limit:g}"
            raise InputError(message, path=self.path, line=self.lines[bad[0]], field=column)


def _columns(names: list[str], path: Path, line: int) -> tuple[dict[str, int], tuple[str, ...]]:
    """Return the place of each canonical name in the header, and the names that mean nothing here."""
    columns: dict[str, int] = {}
    unknown = []
    for at, name in enumerate(names):
        key = _CANONICAL.get(name.strip().lower().replace(" ", "_"))
        if key is None:
            unknown.append(name.strip())
        elif key in columns:
            raise InputError(
                f"two columns for {key}: {names[columns[key]].strip()}, {name.strip()}", path=path, line=line
            )
        else:
            columns[key] = at
    if not columns:
        raise InputError(
            "the first line must be a header: image and/or timestamp, then latitude,longitude,altitude or x,y,z",
            path=path,
            line=line,
        )
    if "image" not in columns and "timestamp" not in columns:
        raise InputError("needs a column image or timestamp", path=path, line=line)
    return columns, tuple(unknown)


def _position_columns(cells: _Cells) -> tuple[str, ...]:
    geographic, projected = cells.has(_GEOGRAPHIC), cells.has(_PROJECTED)
    if geographic == projected:
        which = "both" if geographic else "neither of"
        raise InputError(
            f"has {which} latitude,longitude,altitude and x,y,z", path=cells.path, line=cells.header_line
        )
    return _GEOGRAPHIC if geographic else _PROJECTED


def _attitudes(cells: _Cells) -> FloatArray | None:
    """Return rotations camera → East-North-Up (N, 4), NaN where a row has none."""
    angles, quaternion = cells.has(_ANGLES), cells.has(_QUATERNION)
    if angles and quaternion:
        raise InputError("has both yaw,pitch,roll and qx,qy,qz,qw", path=cells.path, line=cells.header_line)
    if not (angles or quaternion):
        return None
    values = cells.group(_ANGLES if angles else _QUATERNION)
    known = complete(values)
    result = np.full((len(values), 4), np.nan)
    if angles:
        cells.check_range(values[:, 0], 360.0, "yaw")
        cells.check_range(values[:, 1], 180.0, "pitch")
        cells.check_range(values[:, 2], 360.0, "roll")
        result[known] = quat_xyzw_from_matrix(geo_from_cam(values[known]))
        return result
    length = np.linalg.norm(values, axis=1)
    bad = np.flatnonzero(known & (np.abs(length - 1.0) > 0.01))
    if len(bad):
        message = f"the quaternion has length {length[bad[0]]:g}, not 1"
        raise InputError(message, path=cells.path, line=cells.lines[bad[0]], field="qx,qy,qz,qw")
    result[known] = values[known] / length[known, None]
    return result


def _sigmas(cells: _Cells) -> FloatArray | None:
    if not cells.has(_SIGMAS):
        return None
    values = cells.group(_SIGMAS)
    for axis, column in enumerate(_SIGMAS):
        cells.check_range(values[:, axis], 1e6, column, least=1e-6)
    return values


def _times(cells: _Cells) -> tuple[FloatArray, bool]:
    """Return seconds since 1970 (N,), of numbers or ISO 8601, and whether an ISO 8601 time has no zone.

    A time without a zone is read as UTC.
    """
    moments = [
        _time(text, cells.path, line, cells.decimal_comma)
        for text, line in zip(cells.texts("timestamp"), cells.lines, strict=True)
    ]
    times = np.array([seconds for seconds, _ in moments])
    late = np.flatnonzero(np.abs(times) > _LATEST_S)
    if len(late):
        message = f"{times[late[0]]:.0f} looks like milliseconds or finer: give seconds since 1970"
        raise InputError(message, path=cells.path, line=cells.lines[late[0]], field="timestamp")
    return times, any(zoneless for _, zoneless in moments)


def _time(text: str, path: Path, line: int, decimal_comma: bool) -> tuple[float, bool]:
    """Return a time in seconds, and whether it is a text without a zone."""
    if text[4:5] == "-" and len(text) >= 10:
        try:
            moment = datetime.fromisoformat(text)
        except ValueError:
            raise InputError(f"{text!r} is no ISO 8601 time", path=path, line=line, field="timestamp") from None
        zoneless = moment.tzinfo is None
        return (moment.replace(tzinfo=UTC) if zoneless else moment).timestamp(), zoneless
    return number(text, path=path, line=line, field="timestamp", decimal_comma=decimal_comma), False
