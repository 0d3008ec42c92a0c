"""Metashape's markers with their projections (XML), and its reference table of cameras or markers.

Markers (Tools ▸ Export ▸ Export Markers): a camera's label names the image. The centre of the top-left pixel is
(0.5, 0.5), as here. Projections that are not pinned were placed by Metashape and not by a person: they are left
out. A marker whose reference is not enabled is a check point. defusedxml refuses entities and document type
definitions.

Reference (File ▸ Export ▸ Export Reference): a comment states the CRS as WKT, and another one is the header:
`#Label,X/Longitude,Y/Latitude,Z/Altitude,…`. X is the easting or longitude. Yaw, pitch and roll are those of the
camera's mount: pitch 0 looks straight down. Omega, phi and kappa stand in their place where the chunk is set
so: they turn the camera's axes (x right, y up, z backward) into those of the CRS. Columns with `_est` and errors
are results of Metashape and are not read.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.formats import column_names, tables
from pipelines.formats.ground_points import GroundPoints, ListedMark, ListedPoint, without_repeats
from pipelines.formats.trajectory_csv import (
    PoseTable,
    camera_quaternions,
    complete,
    photogrammetric_quaternions,
)
from pipelines.formats.xml_events import OFF, XmlReader, read_xml

MARKERS = "Metashape's markers"
_MAX_BYTES = 64 * 1024 * 1024
_LONGEST_CRS = 1 << 16
_NO_MARKERS = "No marker has coordinates."
_EXPORT_MARKERS = "Export markers with their reference."


def read_markers_xml(path: Path) -> GroundPoints:
    """Read markers and their pinned projections; markers without coordinates are left out.

    Raises:
        InputError: unreadable, not well-formed XML, not of Metashape, several chunks, a value that is no number, or
            no marker with coordinates.

    Examples:
        >>> _ = Path("markers.xml").write_text(
        ...     '<document><chunk><cameras><camera id="0" label="a.jpg"/></cameras>'
        ...     '<markers><marker id="0" label="P1"><reference x="7.1" y="46.8" z="498.5"/></marker></markers>'
        ...     '<frames><frame><markers>'
        ...     '<marker marker_id="0"><location camera_id="0" x="1210.5" y="733" pinned="true"/></marker>'
        ...     '</markers></frame></frames></chunk></document>'
        ... )
        >>> found = read_markers_xml(Path("markers.xml"))
        >>> found.points[0].xyz, found.marks[0].image, found.marks[0].x_px
        ((7.1, 46.8, 498.5), 'a.jpg', 1210.5)
    """
    reader = _Reader(path)
    read_xml(reader, limit_bytes=_MAX_BYTES, kind="file of markers")
    return reader.result()


class _Reader(XmlReader):
    """Reader of one document, element by element."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._chunks = 0
        self._marker: tuple[str, str] | None = None  # id and label
        self._projected: str | None = None  # id
        self._crs = ""
        self._crs_line = 1
        self._labels: dict[str, str] = {}  # of cameras, by id
        self._names: dict[str, str] = {}  # of markers, by id
        self._ids: dict[str, str] = {}  # of markers, by name
        self._points: list[ListedPoint] = []
        self._projections: list[tuple[int, str, str, float, float]] = []  # line, marker, camera, x, y
        self._left_out: list[str] = []

    def begin(self, name: str, values: dict[str, str], parent: str) -> None:
        if name == "chunk":
            self._chunks += 1
            if self._chunks > 1:
                raise self.fault("several-chunks", "the file has several chunks: export the markers of one")
        elif name == "camera" and "id" in values and "label" in values:
            self._labels[values["id"]] = values["label"]
        elif name == "marker" and "marker_id" in values:
            self._projected = values["marker_id"]
        elif name == "marker" and "id" in values:
            self._marker = (values["id"], values.get("label", ""))
        elif name == "reference" and parent == "marker" and self._marker is not None:
            self._read_point(values)
        elif name == "reference":
            self._crs_line = self.line
        elif name == "location" and parent == "marker" and self._projected is not None:
            self._read_projection(values)

    def end(self, name: str) -> None:
        if name == "marker":
            self._marker = self._projected = None

    def text(self, content: str) -> None:
        if self.open and self.open[-1] == "reference":
            self._crs += content
            if len(self._crs) > _LONGEST_CRS:
                raise self.fault("crs-too-long", f"the CRS is longer than {_LONGEST_CRS} characters, the limit")

    def result(self) -> GroundPoints:
        if not self._points:
            raise InputError("no-markers", _NO_MARKERS, path=self.path, remedy=_EXPORT_MARKERS)
        known = {point.name for point in self._points}
        marks = [
            ListedMark(line, self._names[marker], self._labels.get(camera, f"camera {camera}"), x, y)
            for line, marker, camera, x, y in self._projections
            if self._names.get(marker) in known
        ]
        crs = self._crs.strip()
        return GroundPoints(
            path=self.path,
            kind=MARKERS,
            points=without_repeats(self._points, self.path),
            marks=tuple(marks),
            crs_text=crs or None,
            crs_line=self._crs_line,
            left_out=tuple(self._left_out),
        )

    def _read_point(self, values: dict[str, str]) -> None:
        marker, name = self._marker or ("", "")
        if not {"x", "y", "z"} <= set(values):
            return
        if not name:
            raise self.fault("name-missing", "the name is missing", "label")
        if self._ids.setdefault(name, marker) != marker:
            raise self.fault("marker-twice", f"two markers have the name {name}")
        self._names[marker] = name
        both = self._sigma(values, "sxyz")
        horizontal = [sigma for axis in ("sx", "sy") if (sigma := self._sigma(values, axis)) is not None]
        self._points.append(
            ListedPoint(
                line=self.line,
                name=name,
                xyz=(self._number(values, "x"), self._number(values, "y"), self._number(values, "z")),
                sigma_h_m=max(horizontal) if horizontal else both,
                sigma_v_m=self._sigma(values, "sz") or both,
                is_check=values.get("enabled", "true").lower() in OFF,
            )
        )

    def _read_projection(self, values: dict[str, str]) -> None:
        marker, camera = self._projected or "", values.get("camera_id", "")
        if not {"x", "y"} <= set(values) or values.get("valid", "true").lower() in OFF:
            return
        if values.get("pinned", "true").lower() in OFF:
            self._left_out.append(f"{self.path.name}:{self.line}")
            return
        self._projections.append((self.line, marker, camera, self._number(values, "x"), self._number(values, "y")))

    def _number(self, values: dict[str, str], key: str) -> float:
        try:
            value = float(values[key])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.fault("not-a-number", f"{values[key][:40]!r} is not a number", key)
        return value

    def _sigma(self, values: dict[str, str], key: str) -> float | None:
        """Return a σ that is above zero, or None."""
        value = self._number(values, key) if key in values else 0.0
        return value if value > 0 else None


REFERENCE = "Metashape's reference"
HEADER = re.compile(r"#\s*label\b", re.IGNORECASE)
_CRS = re.compile(r"#\s*CoordinateSystem:\s*(.*)", re.IGNORECASE)
_GIMBAL_FROM_MOUNT_DEG = np.array([0.0, -90.0, 0.0])
_VOCABULARY = {
    "label": "label",
    **dict.fromkeys(("xlongitude", "xeasting", "xeast", "x", "longitude", "easting", "east"), "x"),
    **dict.fromkeys(("ylatitude", "ynorthing", "ynorth", "y", "latitude", "northing", "north"), "y"),
    **dict.fromkeys(("zaltitude", "zheight", "zelevation", "z", "altitude", "height", "elevation"), "z"),
    **dict.fromkeys(("accuracy", "accuracyxyz", "xyzaccuracy"), "sigma"),
    **dict.fromkeys(("accuracyxy", "xyaccuracy"), "sigma_h"),
    **dict.fromkeys(("accuracyx", "xaccuracy"), "sigma_x"),
    **dict.fromkeys(("accuracyy", "yaccuracy"), "sigma_y"),
    **dict.fromkeys(("accuracyz", "zaccuracy"), "sigma_v"),
    **{name: name for name in ("yaw", "pitch", "roll", "omega", "phi", "kappa")},
    **dict.fromkeys(("enable", "enabled"), "enabled"),
}
_RESULT = re.compile(r"error|est|variance|var\b|projections", re.IGNORECASE)


def read_markers(path: Path) -> GroundPoints:
    r"""Read markers without marks; a marker that is not enabled is a check point, as in Metashape.

    Raises:
        InputError: no header, no rows, a column is missing, a cell is no number, or one point at two places.

    Examples:
        >>> _ = Path("markers.csv").write_text(
        ...     '# CoordinateSystem: LOCAL_CS["site"]\n#Label,X,Y,Z,Accuracy\nP1,10,20,498.5,0.02\n'
        ... )
        >>> point = read_markers(Path("markers.csv")).points[0]
        >>> point.xyz, point.sigma_v_m
        ((10.0, 20.0, 498.5), 0.02)
    """
    table, geographic = _reference(path)
    points = []
    for row in table.rows:
        if row.text("x"):
            xyz = (row.finite("x"), row.finite("y"), row.finite("z"))
            points.append(ListedPoint(row.line, row.text("label"), xyz, *_sigma_m(row), not _is_enabled(row)))
    if not points:
        raise InputError("no-markers", _NO_MARKERS, path=path, remedy=_EXPORT_MARKERS)
    return GroundPoints(
        path=path,
        kind=REFERENCE,
        points=without_repeats(points, path),
        crs_text=table.crs_text,
        crs_line=table.crs_line,
        geographic=geographic,
        unknown_columns=table.unknown,
    )


def read_cameras(path: Path) -> PoseTable:
    r"""Read the positions, and the angles where they are there, of cameras; a label names the image.

    Raises:
        InputError: no header, no rows, a column is missing, or a cell is no number.

    Examples:
        >>> _ = Path("cameras.csv").write_text("#Label,X/Longitude,Y/Latitude,Z/Altitude\na.jpg,7.1,46.8,512\n")
        >>> read_cameras(Path("cameras.csv")).xyz.tolist()  # longitude, latitude, height
        [[7.1, 46.8, 512.0]]
    """
    table, geographic = _reference(path)
    on = np.array([_is_enabled(row) for row in table.rows])
    xyz = np.array([[row.number(name) for name in "xyz"] for row in table.rows])
    sigma = np.array([_sigma_m(row) for row in table.rows], dtype=np.float64)[:, [0, 0, 1]]  # NaN for None
    gimbal = table.numbers(("yaw", "pitch", "roll")) + _GIMBAL_FROM_MOUNT_DEG
    attitudes, of_grid = camera_quaternions(gimbal), False
    if not complete(gimbal).any():
        attitudes, of_grid = photogrammetric_quaternions(table.numbers(("omega", "phi", "kappa"))), True
    return PoseTable(
        path=path,
        source="metashape",
        lines=table.lines,
        names=tuple(row.text("label") for row in table.rows),
        time_s=None,
        xyz=np.where(on[:, None], xyz, np.nan),
        geographic=geographic,
        quat_xyzw=attitudes if complete(attitudes).any() else None,
        attitudes_of_grid=of_grid,
        sigma_enu_m=sigma if np.isfinite(sigma).any() else None,
        crs_text=table.crs_text,
        crs_line=table.crs_line,
        unknown_columns=table.unknown,
        header_line=table.header_line or 1,
    )


def _reference(path: Path) -> tuple[tables.Table, bool | None]:
    """Return a reference table, and True if its header has longitudes, else None."""
    lines = tables.numbered_lines(path)
    header_at = next(((at, text) for at, text in lines if HEADER.match(text)), None)
    if header_at is None:
        raise InputError("header-missing", "No line begins with #Label.", path=path)
    header_line, header = header_at
    crs_line, crs_text = next(((at, crs[1]) for at, text in lines if (crs := _CRS.match(text))), (1, None))
    separator = tables.separator_of(header)
    cells = tables.split(header.lstrip("# "), separator, path=path, line=header_line)
    columns, unknown = tables.named_columns(cells, _VOCABULARY, path, header_line)
    missing = [name for name in ("label", "x", "y", "z") if name not in columns]
    if missing:
        needed = "Label, X/Longitude or X/Easting, Y/Latitude or Y/Northing, and Z/Altitude"
        raise tables.unknown_header(cells, _VOCABULARY, needed, path=path, line=header_line, missing=missing)
    kept = [(at, text) for at, text in lines if at > header_line and not text.startswith("#")]
    named = tuple(name for name in unknown if column_names.plain_name(name) and not _RESULT.search(name))
    units = tables.units_of(cells, columns)
    listed = tables.table_rows(path, kept, separator, columns, units)
    table = tables.Table(path, header_line, columns, named, listed, crs_text, crs_line, units)
    tables.require_rows(table.rows, path)
    for row in table.rows:
        row.named("label")
    return table, True if "longitude" in header.lower() else None


def _is_enabled(row: tables.Row) -> bool:
    return "enabled" not in row.columns or row.text("enabled").lower() not in OFF


def _sigma_m(row: tables.Row) -> tuple[float | None, float | None]:
    """Return σ horizontal and vertical; of σ along x and y the larger one."""
    by_axis = [sigma for axis in ("sigma_x", "sigma_y") if (sigma := row.sigma_m(axis)) is not None]
    both = row.sigma_m("sigma")
    return row.sigma_m("sigma_h") or max(by_axis, default=both), row.sigma_m("sigma_v") or both
