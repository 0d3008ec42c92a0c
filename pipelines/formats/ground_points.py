"""Surveyed points and their image marks as OpenDroneMap and PIX4D list them, and OpenDroneMap's image positions.

OpenDroneMap's `geo.txt` (image positions) and `gcp_list.txt` (ground points with marks) begin with a CRS and have x
(longitude or easting) first. Marks are in pixels of the full image; here the centre of the top-left pixel is (0.5,
0.5), and marks are taken as given in that convention.

PIX4D has a table of points (`label, first, second, z [, σ, σ]`) and one of marks (`image, label, x, y`). A header
may stand or not. Without one, the coordinates are in the order of the axes of the CRS, latitude first for
EPSG:4326: https://support.pix4d.com/hc/en-us/articles/360038397752. The fifth column of marks is an accuracy or a
zoom level, by version, and is not read.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import Vector3
from pipelines.formats import tables
from pipelines.formats.trajectory_csv import PoseTable, camera_quaternions, complete


@dataclass(frozen=True)
class ListedPoint:
    """Surveyed point of a file: its first line, coordinates by `GroundPoints.in_order_of_crs`, and σ if stated."""

    line: int
    name: str
    xyz: Vector3
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None
    is_check: bool = False


@dataclass(frozen=True)
class ListedMark:
    """Place of a surveyed point in an image, pixels of the full image as the file has them."""

    line: int
    name: str
    image: str
    x_px: float
    y_px: float
    sigma_px: float | None = None


@dataclass(frozen=True)
class GroundPoints:
    """Surveyed points of a file."""

    path: Path
    kind: str  # of the file, for people
    points: tuple[ListedPoint, ...]  # in the order of the file, names without repeats
    marks: tuple[ListedMark, ...] = ()  # of these points; a file of another kind may have them
    crs_text: str | None = None  # CRS that the file states; None: it states none
    crs_line: int = 1
    # Whether the file calls its columns longitude and latitude; None if the CRS alone decides
    geographic: bool | None = None
    # Whether the coordinates are in the order of the axes of the CRS; else the easting is first
    in_order_of_crs: bool = False
    unknown_columns: tuple[str, ...] = ()  # names in the header that mean nothing here
    left_out: tuple[str, ...] = ()  # places of marks that the file itself does not count as made by a person


def without_repeats(points: Sequence[ListedPoint], path: Path) -> tuple[ListedPoint, ...]:
    """Return the first line of each point; an InputError: a point has other coordinates in a later line."""
    first: dict[str, ListedPoint] = {}
    for point in points:
        other = first.setdefault(point.name, point)
        if point.xyz != other.xyz:
            message = f"The point {point.name} has other coordinates in line {other.line}."
            raise InputError("point-twice", message, path=path, line=point.line, field="x y z")
    return tuple(first.values())


ODM_POINTS = "OpenDroneMap's gcp_list.txt"
_GEO_FORM = "image x y [z] [yaw pitch roll] [h_acc v_acc]"
_GEO_COLUMNS = ("image", "x", "y", "z", "yaw", "pitch", "roll", "h_acc", "v_acc")
_GCP_FORM = "x y z px py image [name]"
_GCP_COLUMNS = ("x", "y", "z", "px", "py", "image", "name")
# OpenDroneMap's pitch is 0 straight down, the gimbal's −90.
_GIMBAL_FROM_ODM_DEG = np.array([0.0, -90.0, 0.0])


def read_geo(path: Path) -> PoseTable:
    """Read `geo.txt`. A position without z has NaN height.

    Raises:
        InputError: no CRS line, no row, a wrong number of columns, or a cell that is no number.
    """
    table = _odm_table(path, _GEO_COLUMNS)
    numbers = []
    for row in table.rows:
        if len(row.cells) not in (3, 4, 7, 9) and len(row.cells) < 10:  # words may follow nine columns
            raise _wrong_columns(row, f"3, 4, 7 or 9: {_GEO_FORM}")
        numbers.append([row.number(column) for column in _GEO_COLUMNS[1:]])
    values = np.array(numbers)
    angles, accuracy = values[:, 3:6] + _GIMBAL_FROM_ODM_DEG, values[:, 6:8]
    tables.refuse_first(
        np.any(accuracy <= 0.0, axis=1),
        "sigma-not-positive",
        lambda row: f"the accuracies {accuracy[row, 0]:g} and {accuracy[row, 1]:g} m are not both above zero",
        path=path,
        lines=table.lines,
        field="h_acc, v_acc",
    )
    return PoseTable(
        path=path,
        source="geo.txt",
        lines=table.lines,
        names=tuple(row.cells[0] for row in table.rows),
        time_s=None,
        xyz=values[:, :3],
        geographic=None,
        quat_xyzw=camera_quaternions(angles) if complete(angles).any() else None,
        sigma_enu_m=accuracy[:, [0, 0, 1]] if np.isfinite(accuracy).any() else None,
        crs_text=table.crs_text,
    )


def read_ground_points(path: Path) -> GroundPoints:
    """Read `gcp_list.txt`. Points without a name are named by their place in the file.

    Raises:
        InputError: no CRS line, too few columns, a cell that is no number or NaN, no line at all, or one point at
            two places.
    """
    table = _odm_table(path, _GCP_COLUMNS)
    points, marks = [], []
    unnamed: dict[Vector3, str] = {}
    for row in table.rows:
        if len(row.cells) < 6:
            raise _wrong_columns(row, f"at least 6: {_GCP_FORM}")
        xyz = (row.finite("x"), row.finite("y"), row.finite("z"))
        x_px, y_px = row.finite("px"), row.finite("py")
        name = row.text("name") or unnamed.setdefault(xyz, f"point-{len(unnamed) + 1}")
        points.append(ListedPoint(row.line, name, xyz))
        marks.append(ListedMark(row.line, name, row.text("image"), x_px, y_px))
    return GroundPoints(path, ODM_POINTS, without_repeats(points, path), tuple(marks), table.crs_text)


POINT_LIST = "a list of points (name x y z)"
_LIST_COLUMNS = ("name", "x", "y", "z")


def is_point_list(lines: Sequence[str]) -> bool:
    """Return whether the first line without `#`, or the one after it, is a row of a list of points."""
    rows = [line.split() for line in lines if not line.startswith("#")][:2]
    return any(len(row) == 4 and all(tables.is_number(cell) for cell in row[1:]) for row in rows)


def read_point_list(path: Path) -> GroundPoints:
    """Read ground points without marks: rows `name x y z`, x the easting or longitude, below the CRS if stated.

    Raises:
        InputError: no row, a number of columns other than four, a cell that is no number, or one point at two
            places.
    """
    lines = [(at, text) for at, text in tables.numbered_lines(path) if not text.startswith("#")]
    tables.require_rows(lines, path)
    crs_text = None if is_point_list([lines[0][1]]) else lines.pop(0)[1]
    tables.require_rows(lines, path)
    places = {name: at for at, name in enumerate(_LIST_COLUMNS)}
    points = []
    for row in tables.table_rows(path, lines, None, places):
        if len(row.cells) != 4:
            raise _wrong_columns(row, f"4: {' '.join(_LIST_COLUMNS)}")
        points.append(ListedPoint(row.line, row.named("name"), (row.finite("x"), row.finite("y"), row.finite("z"))))
    return GroundPoints(path, POINT_LIST, without_repeats(points, path), crs_text=crs_text)


def _odm_table(path: Path, columns: Sequence[str]) -> tables.Table:
    """Return the rows below the CRS but comments, cells between spaces, with columns in an order."""
    lines = [(at, text) for at, text in tables.numbered_lines(path) if not text.startswith("#")]
    tables.require_rows(lines, path)
    first, crs_text = lines[0]
    words = crs_text.split()
    if len(words) >= 3 and tables.is_number(words[1], decimal_comma=False) and not crs_text.startswith("+"):
        message = "The first line must be the CRS, e.g. EPSG:4326 or WGS84 UTM 16N; this is a row."
        raise InputError("crs-missing", message, path=path, line=first)
    tables.require_rows(lines[1:], path)
    places = {name: at for at, name in enumerate(columns)}
    return tables.Table(path, None, places, (), tables.table_rows(path, lines[1:], None, places), crs_text)


def _wrong_columns(row: tables.Row, expected: str) -> InputError:
    has_commas = any("," in cell or ";" in cell for cell in row.cells)
    hint = "; separate columns by spaces or tabs" if has_commas else ""
    return row.fault("wrong-columns", f"the line has {len(row.cells)} columns, expected {expected}{hint}")


PIX4D_POINTS = "a table of points (PIX4D)"
_POINT_ALIASES = {
    **dict.fromkeys(
        ("label", "name", "id", "point", "pointname", "pointid", "gcp", "gcplabel", "gcpname"), "label"
    ),
    **dict.fromkeys(("x", "easting", "east", "e"), "x"),
    **dict.fromkeys(("y", "northing", "north", "n"), "y"),
    **dict.fromkeys(("latitude", "lat"), "latitude"),
    **dict.fromkeys(("longitude", "lon", "long", "lng"), "longitude"),
    **dict.fromkeys(("z", "altitude", "alt", "height", "elevation", "h", "ellipsoidalheight"), "z"),
    **dict.fromkeys(("accuracyhorz", "accuracyhorizontal", "horizontalaccuracy", "sigmah"), "sigma_h"),
    **dict.fromkeys(("accuracyvert", "accuracyvertical", "verticalaccuracy", "sigmav"), "sigma_v"),
}
_MARK_ALIASES = {
    **dict.fromkeys(("image", "imagename", "filename", "file", "photo"), "image"),
    **dict.fromkeys(("label", "name", "point", "gcp", "gcplabel", "gcpname", "tiepoint"), "label"),
    **dict.fromkeys(("x", "pixelx", "xpx", "px", "u", "imageu"), "x"),
    **dict.fromkeys(("y", "pixely", "ypx", "py", "v", "imagev"), "y"),
    **dict.fromkeys(("sigma", "sigmapx"), "sigma"),
}
_DISTANCE_ALIASES = {
    **dict.fromkeys(("from", "a", "point1", "first", "start"), "from"),
    **dict.fromkeys(("to", "b", "point2", "second", "end"), "to"),
    **dict.fromkeys(("distance", "distancem", "length", "lengthm", "d"), "distance"),
    **dict.fromkeys(("sigma", "sigmam", "accuracy", "accuracym"), "sigma"),
    **dict.fromkeys(("use", "type", "role"), "use"),
}
_DISTANCE_COLUMNS = ("from", "to", "distance", "sigma", "use")
_POINT_COLUMNS = ("label", "first", "second", "z", "sigma_h", "sigma_v")
_MARK_COLUMNS = ("image", "label", "x", "y")


def read_point_table(path: Path) -> GroundPoints:
    """Read ground points without marks.

    Raises:
        InputError: no rows, a column is missing, a cell is no number, or one point at two places.
    """
    table = _pix4d_table(path, _POINT_ALIASES, _POINT_COLUMNS, slice(1, 4), "label, two coordinates and z")
    axes, geographic = ("first", "second"), None
    if table.header_line is not None:
        geographic = "latitude" in table.columns or "longitude" in table.columns
        axes = ("longitude", "latitude") if geographic else ("x", "y")
        missing = {"label", *axes, "z"} - set(table.columns)
        if missing or (geographic and {"x", "y"} & set(table.columns)):
            header = tables.read_lines(path)[table.header_line - 1]
            message = (
                f"The header must name label, z, and either x and y or longitude and latitude; it is {header!r}."
            )
            raise InputError("column-missing", message[:300], path=path, line=table.header_line)
    tables.require_rows(table.rows, path)
    points = [
        ListedPoint(
            line=row.line,
            name=row.named("label"),
            xyz=(row.finite(axes[0]), row.finite(axes[1]), row.finite("z")),
            sigma_h_m=row.sigma_m("sigma_h"),
            sigma_v_m=row.sigma_m("sigma_v"),
        )
        for row in table.rows
    ]
    return GroundPoints(
        path=path,
        kind=PIX4D_POINTS,
        points=without_repeats(points, path),
        geographic=geographic,
        in_order_of_crs=table.header_line is None,
        unknown_columns=table.unknown,
    )


def read_marks(path: Path) -> tuple[ListedMark, ...]:
    """Read marks of ground points; an InputError: no rows, a column is missing, or a cell is no number."""
    table = _pix4d_table(path, _MARK_ALIASES, _MARK_COLUMNS, slice(2, 4), "image, label, x and y")
    tables.require_columns(table.columns, _MARK_COLUMNS, path, table.header_line)
    tables.require_rows(table.rows, path)
    return tuple(
        ListedMark(
            row.line, row.named("label"), row.text("image"), row.finite("x"), row.finite("y"), row.sigma_m("sigma")
        )
        for row in table.rows
    )


@dataclass(frozen=True)
class ListedDistance:
    """Measured distance between two marked points; `is_check`: it enters no solution."""

    line: int
    ends: tuple[str, str]
    distance_m: float
    sigma_m: float | None
    is_check: bool


def read_distances(path: Path) -> tuple[ListedDistance, ...]:
    """Read distances between marked points: columns from, to, distance, and optionally σ and use, in metres.

    Raises:
        InputError: no rows, a column is missing, a distance or σ is not above zero, both ends are one point, a pair
            is listed twice, or a use is neither control nor check.
    """
    table = _pix4d_table(path, _DISTANCE_ALIASES, _DISTANCE_COLUMNS, slice(2, 3), "from, to and distance")
    tables.require_columns(table.columns, _DISTANCE_COLUMNS[:3], path, table.header_line)
    tables.require_rows(table.rows, path)
    distances: list[ListedDistance] = []
    seen: dict[frozenset[str], int] = {}
    for row in table.rows:
        ends = (row.named("from"), row.named("to"))
        use = row.text("use").lower() if "use" in row.columns else ""
        distance_m = row.finite("distance")
        if distance_m <= 0:
            raise row.fault("distance-not-positive", f"the distance is {distance_m:g} m", "distance")
        if ends[0] == ends[1]:
            raise row.fault("distance-of-one-point", f"both ends are {ends[0]}", "to")
        if use not in ("", "control", "check"):
            raise row.fault("unknown-use", f"the use {use!r} is neither control nor check", "use")
        first = seen.setdefault(frozenset(ends), row.line)
        if first != row.line:
            raise row.fault("distance-twice", f"line {first} has the same two points", "to")
        distances.append(ListedDistance(row.line, ends, distance_m, row.sigma_m("sigma"), use == "check"))
    return tuple(distances)


def _pix4d_table(
    path: Path, aliases: Mapping[str, str], in_order: Sequence[str], numeric: slice, expected: str
) -> tables.Table:
    """Return a table whose first line is a header if none of its cells `numeric` is a number."""
    numbered = enumerate(tables.read_lines(path), start=1)
    lines = [(at, text) for at, text in numbered if text.strip() and not text.lstrip().startswith("#")]
    tables.require_rows(lines, path)
    first, text = lines[0]
    separator = tables.separator_of(text)
    header = tables.split(text, separator, path=path, line=first)
    if len(header) < numeric.stop:
        message = f"The line has {len(header)} columns, expected {expected}."
        raise InputError("wrong-columns", message, path=path, line=first)
    if any(map(tables.is_number, header[numeric])):
        places = {name: at for at, name in enumerate(in_order)}
        return tables.Table(path, None, places, (), tables.table_rows(path, lines, separator, places))
    columns, unknown = tables.named_columns(header, aliases, path, first)
    named = tuple(name for name in unknown if tables.bare_name(name))
    return tables.Table(path, first, columns, named, tables.table_rows(path, lines[1:], separator, columns))
