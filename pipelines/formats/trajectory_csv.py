"""Positions and attitudes of images as a table states them, and a trajectory as CSV (docs/inputs.md).

Attitude is either the gimbal's `yaw, pitch, roll` in degrees (docs/conventions.md) or a quaternion
`qx, qy, qz, qw` that rotates camera axes (x right, y down, z forward) into East-North-Up at the camera.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray, rows_of
from pipelines.formats import column_names, tables
from pipelines.formats.place_columns import place_columns
from pipelines.formats.time_columns import TIMES, has_times, timestamps_of
from pipelines.geometry.rotations import geo_from_cam, map_from_cam, quat_xyzw_from_matrix


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
    attitudes_of_grid: bool = False  # whether the attitudes count from the axes of the CRS's grid, not from north
    plan_unit_m: float | None = None  # units of x and y, and of the height, where the header states them
    height_unit_m: float | None = None
    unknown_columns: tuple[str, ...] = ()  # names in the header that mean nothing here
    unread_columns: tuple[str, ...] = ()  # names of coordinates beside those that are read
    header_line: int = 1

    def take(self, rows: IntArray | BoolArray) -> PoseTable:
        """Return the rows of an index (M,) or mask (N,)."""
        names = None if self.names is None else tuple(np.array(self.names, dtype=object)[rows])
        return replace(rows_of(self, rows), names=names)


def photogrammetric_quaternions(omega_phi_kappa_deg: FloatArray) -> FloatArray:
    """Return rotations camera → axes of the map (N, 4) of omega, phi, kappa (N, 3), NaN where one is NaN."""
    known = complete(omega_phi_kappa_deg)
    result = np.full((len(known), 4), np.nan)
    result[known] = quat_xyzw_from_matrix(map_from_cam(omega_phi_kappa_deg[known]))
    return result


def complete(values: FloatArray) -> BoolArray:
    """Return which rows of (N, k) values have no NaN: (N,)."""
    return np.asarray(np.isfinite(values).all(axis=1))


def camera_quaternions(gimbal_yaw_pitch_roll_deg: FloatArray) -> FloatArray:
    """Return rotations camera → East-North-Up (N, 4) of a gimbal's angles (N, 3), NaN where one is NaN."""
    known = complete(gimbal_yaw_pitch_roll_deg)
    result = np.full((len(known), 4), np.nan)
    result[known] = quat_xyzw_from_matrix(geo_from_cam(gimbal_yaw_pitch_roll_deg[known]))
    return result


_VOCABULARY = (
    {"image": "image", **column_names.COORDINATES, **column_names.ANGLES, **column_names.ACCURACIES}
    | column_names.IMAGES
    | {"name": "image", "label": "image"}
    | TIMES
)
_NEEDED = "image and/or timestamp, then latitude,longitude,altitude or x,y,z"
_ANGLES = ("yaw", "pitch", "roll")
_PHOTOGRAMMETRIC = ("omega", "phi", "kappa")
_QUATERNION = ("qx", "qy", "qz", "qw")
_SIGMAS = ("sigma_e", "sigma_n", "sigma_u")
_ACCURACIES = ("sigma_h", "sigma_v")
_RANGES = {
    "latitude": (-90.0, 90.0),
    "longitude": (-360.0, 360.0),
    "yaw": (-360.0, 360.0),
    "pitch": (-180.0, 180.0),
    "roll": (-360.0, 360.0),
    **dict.fromkeys(_PHOTOGRAMMETRIC, (-360.0, 360.0)),
    **dict.fromkeys((*_SIGMAS, *_ACCURACIES), (1e-6, 1e6)),
}
_MOST_CONVERGENCE_DEG = 10.0  # in a zone of UTM near the pole
_FEWEST_WORDS = 4  # between spaces, of a header without other separators


def read_trajectory(path: Path, *, projected: bool = False) -> PoseTable:
    r"""Read a trajectory; `projected`: of x,y,z and latitude,longitude,altitude in one table, the former count.

    Separators are tab, `;`, `,` or spaces; with the first two, decimals may be written with commas.

    Raises:
        InputError: no usable header, no row, a cell that is no number, a value out of range, half a group of
            columns, or a row longer than the header. Names file, line and column.

    Examples:
        >>> _ = Path("track.csv").write_text("image,latitude,longitude,altitude\na.jpg,46.8,7.1,512\n")
        >>> read_trajectory(Path("track.csv")).xyz.tolist()
        [[7.1, 46.8, 512.0]]
    """
    table, header = _read_table(path)
    line = table.header_line or 1
    columns = place_columns(header, table.columns, _VOCABULARY, projected=projected, path=path, line=line)
    xyz = columns.numbers(table.rows)
    if columns.geographic:
        _require_ranges(xyz[:, :2], columns.plan, table)
    time_s, zoneless = timestamps_of(table) if has_times(table.columns) else (None, False)
    attitudes, of_grid = _attitudes(table)
    return PoseTable(
        path=path,
        source="csv",
        lines=table.lines,
        names=tuple(tables.plain_text(row.text("image")) for row in table.rows)
        if "image" in table.columns
        else None,
        time_s=time_s,
        xyz=xyz,
        geographic=columns.geographic,
        quat_xyzw=attitudes,
        attitudes_of_grid=of_grid,
        sigma_enu_m=_sigmas(table),
        zoneless_times=zoneless,
        assumed_crs="EPSG:4979" if columns.geographic and columns.above_ellipsoid else None,
        heights_above_geoid=columns.above_geoid,
        plan_unit_m=columns.plan_unit_m,
        height_unit_m=columns.height_unit_m,
        unknown_columns=table.unknown,
        unread_columns=columns.unread,
        header_line=line,
    )


def _read_table(path: Path) -> tuple[tables.Table, list[str]]:
    """Return the rows and the header; unlike those of other tables, cells in quotes may hold line ends."""
    lines = tables.read_lines(path)
    first = next(index for index, line in enumerate(lines) if line.strip())
    header = lines[first].lstrip("# ")
    separator = tables.separator_of(header)
    if separator is None and len(header.split()) < _FEWEST_WORDS:
        message = "The header has one column only: separate columns by , ; or tab."
        raise InputError("one-column", message, path=path, line=first + 1)
    names = [name.strip() for name in tables.split(header, separator, path=path, line=first + 1)]
    columns, unknown = tables.named_columns(names, _VOCABULARY, path, first + 1)
    if not columns:
        raise tables.unknown_header(names, _VOCABULARY, _NEEDED, path=path, line=first + 1)
    if "image" not in columns and not has_times(columns):
        message = (
            f"The header has no column image and no column timestamp; it has {column_names.listed_columns(names)}."
        )
        message += column_names.nearest_columns(unknown, _VOCABULARY)
        raise InputError("column-missing", message, path=path, line=first + 1)
    width, units = len(names), tables.units_of(names, columns)
    if separator is None:
        lines = [*lines[: first + 1], *("\t".join(line.split()) for line in lines[first + 1 :])]
    rows = []
    reader = csv.reader(lines[first + 1 :], delimiter=separator or "\t")
    try:
        for cells in reader:
            line = first + 1 + reader.line_num
            if not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#"):
                continue
            if len(cells) > width and any(cell.strip() for cell in cells[width:]):
                hint = "; decimal commas need ; as separator" if separator == "," else ""
                message = f"The line has {len(cells)} cells, the header has {width}{hint}"
                raise InputError("wrong-columns", message, path=path, line=line)
            rows.append(tables.Row(path, line, cells, columns, separator != ",", units))
    except csv.Error as error:
        line = first + 1 + reader.line_num
        raise InputError("not-csv", f"The line is not CSV: {error}", path=path, line=line) from error
    tables.require_rows(rows, path)
    return tables.Table(path, first + 1, columns, unknown, rows, units=units), names


def _in_range(table: tables.Table, columns: tuple[str, ...], factors: Mapping[str, float]) -> FloatArray:
    """Return the numbers of columns (N, K), each in its range; factors (by unit) lead to metres or degrees."""
    factor = [factors.get(table.units.get(name, ""), 1.0) for name in columns]
    values: FloatArray = table.numbers(columns) * np.array(factor)
    _require_ranges(values, columns, table)
    return values


def _require_ranges(values: FloatArray, columns: tuple[str, ...], table: tables.Table) -> None:
    for name, (low, high) in _RANGES.items():
        if name in columns:
            column = values[:, columns.index(name)]
            tables.require_range(column, low, high, path=table.path, lines=table.lines, field=name)


def _sigmas(table: tables.Table) -> FloatArray | None:
    """Return σ east, north, up (N, 3): by axis, or horizontal and vertical."""
    if table.has(_SIGMAS):
        return _in_range(table, _SIGMAS, column_names.LENGTHS_M)
    if not table.has(_ACCURACIES):
        return None
    return _in_range(table, _ACCURACIES, column_names.LENGTHS_M)[:, [0, 0, 1]]


def _attitudes(table: tables.Table) -> tuple[FloatArray | None, bool]:
    """Return rotations camera → East-North-Up (N, 4), NaN where a row has none; and whether to the grid's axes."""
    angles, photogrammetric, quaternion = (table.has(kind) for kind in (_ANGLES, _PHOTOGRAMMETRIC, _QUATERNION))
    if angles and quaternion:
        message = "The header has both yaw,pitch,roll and qx,qy,qz,qw."
        raise InputError("columns-ambiguous", message, path=table.path, line=table.header_line)
    if photogrammetric:
        by_omega = photogrammetric_quaternions(_in_range(table, _PHOTOGRAMMETRIC, column_names.ANGLES_DEG))
    if angles:
        by_yaw = camera_quaternions(_in_range(table, _ANGLES, column_names.ANGLES_DEG))
        if photogrammetric:
            _require_alike(by_yaw, by_omega, table)
        return by_yaw, False
    if photogrammetric:
        return by_omega, True
    if not quaternion:
        return None, False
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
    return np.where(known[:, None], values / length[:, None], np.nan), False


def _require_alike(by_yaw: FloatArray, by_omega: FloatArray, table: tables.Table) -> None:
    """Refuse attitudes (N, 4) of two kinds that differ by more than north of a grid and true north can."""
    apart_deg = 2 * np.degrees(np.arccos(np.clip(np.abs((by_yaw * by_omega).sum(axis=1)), 0.0, 1.0)))
    tables.refuse_first(
        apart_deg > _MOST_CONVERGENCE_DEG,
        "attitudes-disagree",
        lambda row: f"yaw,pitch,roll and omega,phi,kappa are {apart_deg[row]:.1f}° apart: remove the wrong ones",
        path=table.path,
        lines=table.lines,
        field="omega,phi,kappa",
    )
