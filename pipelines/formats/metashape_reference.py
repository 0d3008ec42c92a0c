"""Metashape's reference table (File ▸ Export ▸ Export Reference): cameras, or markers without their marks.

A comment states the CRS as WKT, and another one is the header: `#Label,X/Longitude,Y/Latitude,Z/Altitude,…`. X is
the easting or longitude. Yaw, pitch and roll are those of the camera's mount: pitch 0 looks straight down. Columns
with `_est` and errors are results of Metashape and are not read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.delimited import Row, named_columns, rows, separator_of, split
from pipelines.formats.ground_points import GroundPoints, ListedPoint, without_repeats
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.formats.text import read_lines
from pipelines.geometry.rotations import geo_from_cam, quat_xyzw_from_matrix

KIND = "Metashape's reference"
HEADER = re.compile(r"#\s*label\b", re.IGNORECASE)
_CRS = re.compile(r"#\s*CoordinateSystem:\s*(.*)", re.IGNORECASE)
_GIMBAL_FROM_MOUNT_PITCH_DEG = -90.0
_ALIASES = {
    "label": "label",
    **dict.fromkeys(("x/longitude", "x/easting", "x", "longitude", "easting"), "x"),
    **dict.fromkeys(("y/latitude", "y/northing", "y", "latitude", "northing"), "y"),
    **dict.fromkeys(("z/altitude", "z", "altitude"), "z"),
    "accuracy": "sigma",
    "accuracyx/y": "sigma_h",
    "accuracyz": "sigma_v",
    **{name: name for name in ("yaw", "pitch", "roll")},
    **dict.fromkeys(("enable", "enabled"), "enabled"),
}
_RESULT = re.compile(r"error|est|variance|var\b|omega|phi|kappa|projections", re.IGNORECASE)
_OFF = frozenset({"0", "false"})


def read_markers(path: Path) -> GroundPoints:
    """Read markers without marks; a marker that is not enabled is a check point, as in Metashape.

    Raises:
        InputError: no header, no rows, a column is missing, a cell is no number, or one point at two places.
    """
    table = _Reference(path)
    points = [
        ListedPoint(
            line=row.line,
            name=row.text("label"),
            xyz=(row.finite("x"), row.finite("y"), row.finite("z")),
            sigma_h_m=row.sigma_m("sigma_h") or row.sigma_m("sigma"),
            sigma_v_m=row.sigma_m("sigma_v") or row.sigma_m("sigma"),
            is_check=not _is_enabled(row),
        )
        for row in table.rows
        if row.text("x")
    ]
    if not points:
        raise InputError("has no marker with coordinates", path=path)
    return GroundPoints(
        path=path,
        kind=KIND,
        points=without_repeats(points, path),
        crs_text=table.crs_text,
        crs_line=table.crs_line,
        geographic=table.geographic,
        unknown_columns=table.unknown_columns,
    )


def read_cameras(path: Path) -> PoseTable:
    """Read the positions, and the angles where they are there, of cameras; a label names the image.

    Raises:
        InputError: no header, no rows, a column is missing, or a cell is no number.
    """
    table = _Reference(path)
    on = np.array([_is_enabled(row) for row in table.rows])
    xyz = np.array([[row.number("x"), row.number("y"), row.number("z")] for row in table.rows])
    sigma = np.array([_sigma_enu_m(row) for row in table.rows])
    return PoseTable(
        path=path,
        source="metashape",
        lines=np.array([row.line for row in table.rows], dtype=np.int64),
        names=tuple(row.text("label") for row in table.rows),
        time_s=None,
        xyz=np.where(on[:, None], xyz, np.nan),
        geographic=table.geographic,
        quat_xyzw=_quaternions(table.rows),
        sigma_enu_m=sigma if np.isfinite(sigma).any() else None,
        crs_text=table.crs_text,
        crs_line=table.crs_line,
        unknown_columns=table.unknown_columns,
        header_line=table.header_line,
    )


class _Reference:
    """Header and rows of a reference table.

    Raises:
        InputError: no header, no row, or a column is missing.
    """

    def __init__(self, path: Path) -> None:
        lines = [(at, text.strip()) for at, text in enumerate(read_lines(path), start=1) if text.strip()]
        header = next(((at, text) for at, text in lines if HEADER.match(text)), None)
        if header is None:
            raise InputError("has no line that begins with #Label", path=path)
        self.header_line, text = header
        stated = next(((at, found[1]) for at, text in lines if (found := _CRS.match(text))), None)
        self.crs_line = 1 if stated is None else stated[0]
        self.crs_text = None if stated is None else stated[1]
        self.geographic = True if "longitude" in text.lower() else None
        separator = separator_of(text)
        cells = split(text.lstrip("# "), separator, path=path, line=self.header_line)
        columns, unknown = named_columns(cells, _ALIASES, path, self.header_line)
        self.unknown_columns = tuple(name for name in unknown if not _RESULT.search(name))
        missing = [name for name in ("label", "x", "y", "z") if name not in columns]
        if missing:
            raise InputError(f"the header names no {', '.join(missing)}", path=path, line=self.header_line)
        kept = [(at, text) for at, text in lines if at > self.header_line and not text.startswith("#")]
        self.rows: list[Row] = list(rows(path, kept, separator, columns))
        if not self.rows:
            raise InputError("has a header but no rows", path=path)
        unnamed = next((row for row in self.rows if not row.text("label")), None)
        if unnamed is not None:
            raise InputError("has no name", path=path, line=unnamed.line, field="label")


def _is_enabled(row: Row) -> bool:
    return "enabled" not in row.columns or row.text("enabled").lower() not in _OFF


def _sigma_enu_m(row: Row) -> tuple[float, float, float]:
    horizontal = row.sigma_m("sigma_h") or row.sigma_m("sigma") or np.nan
    return horizontal, horizontal, row.sigma_m("sigma_v") or row.sigma_m("sigma") or np.nan


def _quaternions(table: Sequence[Row]) -> FloatArray | None:
    """Return rotations camera → East-North-Up (N, 4), NaN where a row has no angles; None without any."""
    angles = np.array([[row.number(name) for name in ("yaw", "pitch", "roll")] for row in table])
    known = complete(angles)
    if not known.any():
        return None
    result = np.full((len(table), 4), np.nan)
    gimbal = angles[known] + np.array([0.0, _GIMBAL_FROM_MOUNT_PITCH_DEG, 0.0])
    result[known] = quat_xyzw_from_matrix(geo_from_cam(gimbal))
    return result
