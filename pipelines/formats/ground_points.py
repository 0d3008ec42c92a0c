"""Surveyed points and their image marks as OpenDroneMap and PIX4D list them, and OpenDroneMap's image positions.

OpenDroneMap's `geo.txt` (image positions) and `gcp_list.txt` (ground points with marks) begin with a CRS and have x
(longitude or easting) first. Marks are in pixels of the full image; here the centre of the top-left pixel is (0.5,
0.5), and marks are taken as given in that convention.

PIX4D has a table of points (`label, first, second, z [, σ, σ]`) and one of marks (`image, label, x, y`). A header
may stand or not. Without one, the coordinates are in the order of the axes of the CRS, latitude first for
EPSG:4326: https://support.pix4d.com/hc/en-us/articles/360038397752. The fifth column of marks is an accuracy or a
zoom level, by version, and is not read.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import Vector3
from pipelines.formats import column_names, tables
from pipelines.formats.place_columns import PlaceColumns, place_columns
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
    assumed_crs: str | None = None  # of latitude and longitude, as of `PoseTable`
    heights_above_geoid: bool = False  # whether the heights are above a geoid that the file does not name
    plan_unit_m: float | None = None  # units of x and y, and of the height, where the header states them
    height_unit_m: float | None = None
    unknown_columns: tuple[str, ...] = ()  # names in the header that mean nothing here
    unread_columns: tuple[str, ...] = ()  # names of coordinates beside those that are read
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
_PHOTOGRAPH = re.compile(r"(.*?\.(?:jpe?g|png|tiff?|heic|heif|dng))(?=\s|$)", re.IGNORECASE)
_GIMBAL_FROM_ODM_DEG = np.array([0.0, -90.0, 0.0])


def read_geo(path: Path) -> PoseTable:
    r"""Read `geo.txt`. A position without z has NaN height.

    Raises:
        InputError: no CRS line, no row, a wrong number of columns, or a cell that is no number.

    Examples:
        >>> _ = Path("geo.txt").write_text("EPSG:32632\na.jpg 500000 5180000 512\n")
        >>> table = read_geo(Path("geo.txt"))
        >>> table.names, table.xyz.tolist(), table.crs_text
        (('a.jpg',), [[500000.0, 5180000.0, 512.0]], 'EPSG:32632')
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
    r"""Read `gcp_list.txt`. Points without a name are named by their place in the file.

    Raises:
        InputError: no CRS line, too few columns, a cell that is no number or NaN, no line at all, or one point at
            two places.

    Examples:
        >>> _ = Path("gcp_list.txt").write_text("EPSG:32632\n500010 5180020 498.5 1210.5 733 a.jpg P1\n")
        >>> read_ground_points(Path("gcp_list.txt")).marks
        (ListedMark(line=2, name='P1', image='a.jpg', x_px=1210.5, y_px=733.0, sigma_px=None),)
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
    rows = [_cells(line) for line in lines if not line.startswith("#")][:2]
    return any(len(row) == 4 and all(tables.is_number(cell) for cell in row[1:]) for row in rows)


def _cells(line: str) -> list[str]:
    """Return the cells of a line: between tabs, where it has tabs, so that names may hold spaces; else spaces."""
    return line.split("\t") if "\t" in line else line.split()


def read_point_list(path: Path) -> GroundPoints:
    r"""Read ground points without marks: rows `name x y z`, x the easting or longitude, below the CRS if stated.

    Raises:
        InputError: no row, a number of columns other than four, a cell that is no number, or one point at two
            places.

    Examples:
        >>> _ = Path("points.txt").write_text("EPSG:32632\nP1 500010 5180020 498.5\n")
        >>> read_point_list(Path("points.txt")).points[0].xyz
        (500010.0, 5180020.0, 498.5)
    """
    lines = [(at, text) for at, text in tables.numbered_lines(path) if not text.startswith("#")]
    tables.require_rows(lines, path)
    crs_text = None if is_point_list([lines[0][1]]) else lines.pop(0)[1]
    tables.require_rows(lines, path)
    places = {name: at for at, name in enumerate(_LIST_COLUMNS)}
    points = []
    for row in [tables.Row(path, at, _cells(text), places) for at, text in lines]:
        if len(row.cells) != 4:
            raise _wrong_columns(row, f"4: {' '.join(_LIST_COLUMNS)}")
        points.append(ListedPoint(row.line, row.named("name"), (row.finite("x"), row.finite("y"), row.finite("z"))))
    return GroundPoints(path, POINT_LIST, without_repeats(points, path), crs_text=crs_text)


_WKT = re.compile(r"[A-Z]{3,}[A-Z_0-9]*\s*\[")


def _odm_table(path: Path, columns: Sequence[str]) -> tables.Table:
    """Return the rows below the CRS but comments, with columns in an order."""
    lines = [(at, text) for at, text in tables.numbered_lines(path) if not text.startswith("#")]
    tables.require_rows(lines, path)
    first, crs_text = lines[0]
    words = crs_text.split()
    is_row = len(words) >= 3 and tables.is_number(words[1], decimal_comma=False)
    if is_row and not crs_text.startswith("+") and not _WKT.match(crs_text):
        message = "The first line must be the CRS, e.g. EPSG:4326 or WGS84 UTM 16N; this is a row."
        raise InputError("crs-missing", message, path=path, line=first)
    tables.require_rows(lines[1:], path)
    places = {name: at for at, name in enumerate(columns)}
    image_at = places["image"]
    rows = [tables.Row(path, at, _cells_around_image(text, image_at), places) for at, text in lines[1:]]
    return tables.Table(path, None, places, (), rows, crs_text)


def _cells_around_image(line: str, image_at: int) -> list[str]:
    """Return the cells of a line of OpenDroneMap: between tabs, where tabs separate the numbers; else spaces.

    Between spaces, the name of an image extends to the first suffix of photographs, if there is one.
    """
    by_tab = [cell.strip() for cell in line.split("\t")]
    numbers = by_tab[:image_at] or by_tab[1:3]
    if len(by_tab) > image_at + (image_at == 0) * 2 and all(map(tables.is_number, numbers)):
        return by_tab
    words = line.split(None, image_at)
    if len(words) <= image_at:
        return words
    named = _PHOTOGRAPH.match(words[image_at])
    if named is None:
        return [*words[:image_at], *words[image_at].split()]
    return [*words[:image_at], named[1], *words[image_at][named.end() :].split()]


def _wrong_columns(row: tables.Row, expected: str) -> InputError:
    has_commas = any("," in cell or ";" in cell for cell in row.cells)
    hint = "; separate columns by spaces or tabs" if has_commas else ""
    return row.fault("wrong-columns", f"the line has {len(row.cells)} columns, expected {expected}{hint}")


PIX4D_POINTS = "a table of points (PIX4D)"
_POINT_VOCABULARY = column_names.POINTS | column_names.COORDINATES | column_names.ACCURACIES
_PIXEL = ("image", "img", "pixel", "pix", "px", "photo", "screen", "picture", "proj", "projection")
_MARK_VOCABULARY = {
    **column_names.IMAGES,
    **column_names.POINTS,
    **dict.fromkeys(("tiepoint", "tiepointname", "object", "class"), "label"),
    **{name: axis for axis in "xy" for word in _PIXEL for name in (word + axis, axis + word)},
    **dict.fromkeys(("x", "u", "px", "imageu", "col", "column", "sample"), "x"),
    **dict.fromkeys(("y", "v", "py", "imagev", "row"), "y"),
    **dict.fromkeys(("sigma", "sigmapx"), "sigma"),
}
_DISTANCE_VOCABULARY = {
    **dict.fromkeys(("from", "a", "point1", "first", "start"), "from"),
    **dict.fromkeys(("to", "b", "point2", "second", "end"), "to"),
    **dict.fromkeys(("distance", "distancem", "length", "lengthm", "d"), "distance"),
    **dict.fromkeys(("sigma", "sigmam", "accuracy", "accuracym"), "sigma"),
    **dict.fromkeys(("use", "type", "role"), "use"),
}
_DISTANCE_COLUMNS = ("from", "to", "distance", "sigma", "use")
_POINT_COLUMNS = ("label", "first", "second", "z", "sigma_h", "sigma_v")
_MARK_COLUMNS = ("image", "label", "x", "y")


def read_point_table(path: Path, *, projected: bool = False) -> GroundPoints:
    r"""Read ground points without marks; `projected`: x,y,z count where a table has latitude,longitude too.

    Raises:
        InputError: no rows, a column is missing, a cell is no number, or one point at two places.

    Examples:
        >>> _ = Path("points.csv").write_text("label,x,y,z\nP1,500010,5180020,498.5\n")
        >>> read_point_table(Path("points.csv")).points[0].xyz
        (500010.0, 5180020.0, 498.5)
    """
    table, header = _pix4d_table(
        path, _POINT_VOCABULARY, _POINT_COLUMNS, slice(1, 4), "label, two coordinates and z"
    )
    place = None
    if header is not None:
        line = table.header_line or 1
        place = place_columns(header, table.columns, _POINT_VOCABULARY, projected=projected, path=path, line=line)
        if "label" not in table.columns:
            needed = "label, z, and either x and y or longitude and latitude"
            raise tables.unknown_header(header, _POINT_VOCABULARY, needed, path=path, line=line)
    tables.require_rows(table.rows, path)
    points = [
        ListedPoint(row.line, row.named("label"), _point_xyz(row, place), *_point_sigma_m(row))
        for row in table.rows
    ]
    return GroundPoints(
        path=path,
        kind=PIX4D_POINTS,
        points=without_repeats(points, path),
        geographic=None if place is None else place.geographic,
        in_order_of_crs=place is None,
        assumed_crs="EPSG:4979" if place is not None and place.geographic and place.above_ellipsoid else None,
        heights_above_geoid=place is not None and place.above_geoid,
        plan_unit_m=None if place is None else place.plan_unit_m,
        height_unit_m=None if place is None else place.height_unit_m,
        unknown_columns=table.unknown,
        unread_columns=() if place is None else place.unread,
    )


def _point_xyz(row: tables.Row, place: PlaceColumns | None) -> Vector3:
    if place is None:
        return row.finite("first"), row.finite("second"), row.finite("z")
    for value, column in zip(place.xyz(row), (*place.plan, place.height), strict=True):
        if not np.isfinite(value):
            raise row.fault("number-missing", "the number is missing or not finite", column)
    return place.xyz(row)


def _point_sigma_m(row: tables.Row) -> tuple[float | None, float | None]:
    """Return σ horizontal, of east and north the larger one, and vertical."""
    by_axis = [sigma for axis in ("sigma_e", "sigma_n") if (sigma := row.sigma_m(axis)) is not None]
    return row.sigma_m("sigma_h") or max(by_axis, default=None), row.sigma_m("sigma_v") or row.sigma_m("sigma_u")


def read_marks(path: Path) -> tuple[ListedMark, ...]:
    r"""Read marks of ground points; an InputError: no rows, a column is missing, or a cell is no number.

    Examples:
        >>> _ = Path("marks.csv").write_text("image,label,x,y\na.jpg,P1,1210.5,733\n")
        >>> read_marks(Path("marks.csv"))[0].x_px
        1210.5
    """
    table, header = _pix4d_table(path, _MARK_VOCABULARY, _MARK_COLUMNS, slice(2, 4), "image, label, x and y")
    if header is not None and not set(_MARK_COLUMNS) <= table.columns.keys():
        needed = "image, label, x and y"
        raise tables.unknown_header(header, _MARK_VOCABULARY, needed, path=path, line=table.header_line)
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
    r"""Read distances between marked points: columns from, to, distance, and optionally σ and use, in metres.

    Raises:
        InputError: no rows, a column is missing, a distance or σ is not above zero, both ends are one point, a pair
            is listed twice, or a use is neither control nor check.

    Examples:
        >>> _ = Path("bars.csv").write_text("from,to,distance,sigma\nA,B,1.2504,0.0002\n")
        >>> read_distances(Path("bars.csv"))
        (ListedDistance(line=2, ends=('A', 'B'), distance_m=1.2504, sigma_m=0.0002, is_check=False),)
    """
    needed = "from, to and distance"
    table, header = _pix4d_table(path, _DISTANCE_VOCABULARY, _DISTANCE_COLUMNS, slice(2, 3), needed)
    if header is not None and not set(_DISTANCE_COLUMNS[:3]) <= table.columns.keys():
        raise tables.unknown_header(header, _DISTANCE_VOCABULARY, needed, path=path, line=table.header_line)
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
    path: Path, vocabulary: Mapping[str, str], in_order: Sequence[str], numeric: slice, expected: str
) -> tuple[tables.Table, list[str] | None]:
    """Return a table and its header: the first line if none of its cells `numeric` is a number, else None."""
    numbered = enumerate(tables.read_lines(path), start=1)
    lines = [(at, text) for at, text in numbered if text.strip()]
    # A comment that names columns is the header (RealityCapture: `#name,x,y,alt`).
    while len(lines) > 1 and lines[0][1].lstrip().startswith("#"):
        cells = tables.split(
            lines[0][1].lstrip("# "), tables.separator_of(lines[0][1]), path=path, line=lines[0][0]
        )
        known = sum(column_names.meaning_of(cell, vocabulary) is not None for cell in cells)
        if len(cells) >= numeric.stop and known >= numeric.stop:
            lines[0] = (lines[0][0], lines[0][1].lstrip("# "))
            break
        del lines[0]
    lines = [(at, text) for at, text in lines if not text.lstrip().startswith("#")]
    tables.require_rows(lines, path)
    first, text = lines[0]
    separator = tables.separator_of(text)
    header = tables.split(text, separator, path=path, line=first)
    if len(header) < numeric.stop:
        message = f"The line has {len(header)} columns, expected {expected}."
        raise InputError("wrong-columns", message, path=path, line=first)
    if any(map(tables.is_number, header[numeric])):
        places = {name: at for at, name in enumerate(in_order)}
        return tables.Table(path, None, places, (), tables.table_rows(path, lines, separator, places)), None
    columns, unknown = tables.named_columns(header, vocabulary, path, first)
    named, units = (
        tuple(name for name in unknown if column_names.plain_name(name)),
        tables.units_of(header, columns),
    )
    listed = tables.table_rows(path, lines[1:], separator, columns, units)
    return tables.Table(path, first, columns, named, listed, units=units), header
