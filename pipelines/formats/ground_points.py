"""Surveyed points and their image marks, as the files of surveyors list them.

OpenDroneMap's text files: `geo.txt` (image positions) and `gcp_list.txt` (ground points and their marks).

Both begin with a CRS and have x (longitude or easting) first. Marks are in pixels of the full image; here the
centre of the top-left pixel is (0.5, 0.5), and marks are taken as given in that convention.

PIX4D's tables of ground points (`label, first, second, z [, σ, σ]`) and of their marks (`image, label, x, y`).

A header may stand or not. Without one, the coordinates are in the order of the axes of the CRS, latitude first for
EPSG:4326: https://support.pix4d.com/hc/en-us/articles/360038397752. The fifth column of marks is an accuracy or a
zoom level, by version, and is not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.tables import is_number, named_columns, number, read_lines, rows, separator_of, split
from pipelines.formats.trajectory_csv import PoseTable, complete
from pipelines.geometry.rotations import geo_from_cam, quat_xyzw_from_matrix

Xyz = tuple[float, float, float]


@dataclass(frozen=True)
class ListedPoint:
    """Surveyed point of a file.

    Attributes:
        line: where it stands first.
        name: of the point.
        xyz: coordinates in the order of the file's `GroundPoints.in_order_of_crs`.
        sigma_h_m: horizontal σ that the file states, metres.
        sigma_v_m: vertical σ.
        is_check: whether the file calls it a check point.
    """

    line: int
    name: str
    xyz: Xyz
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


@dataclass(frozen=True)
class GroundPoints:
    """Surveyed points of a file.

    Attributes:
        path: of the file.
        kind: of the file, for people.
        points: in the order of the file, names without repeats.
        marks: of these points; a file of another kind may have them.
        crs_text: CRS that the file states; None: it states none.
        crs_line: line of the CRS.
        geographic: whether the file calls its columns longitude and latitude; None if the CRS alone decides.
        in_order_of_crs: whether the first two coordinates stand in the order of the axes of the CRS; otherwise
            easting or longitude is first.
        unknown_columns: names in the header that mean nothing here.
        left_out: places of marks that the file itself does not count as made by a person.
    """

    path: Path
    kind: str
    points: tuple[ListedPoint, ...]
    marks: tuple[ListedMark, ...] = ()
    crs_text: str | None = None
    crs_line: int = 1
    geographic: bool | None = None
    in_order_of_crs: bool = False
    unknown_columns: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def without_repeats(points: list[ListedPoint], path: Path) -> tuple[ListedPoint, ...]:
    """Return the first line of each point.

    Raises:
        InputError: a point has other coordinates in a later line.
    """
    first: dict[str, ListedPoint] = {}
    for point in points:
        other = first.setdefault(point.name, point)
        if point.xyz != other.xyz:
            message = f"{point.name} has other coordinates in line {other.line}"
            raise InputError(message, path=path, line=point.line, field="x y z")
    return tuple(first.values())


ODM_POINTS = "OpenDroneMap's gcp_list.txt"
_GEO_COUNTS = "image x y [z] [yaw pitch roll] [h_acc v_acc]"
_GCP_FORM = "x y z px py image [name]"
# OpenDroneMap's pitch is 0 straight down, the gimbal's −90.
_GIMBAL_FROM_ODM_PITCH_DEG = -90.0


def read_geo(path: Path) -> PoseTable:
    """Read `geo.txt`. A position without z has NaN height.

    Raises:
        InputError: no CRS line, no row, a wrong number of columns, or a cell that is no number.
    """
    crs_text, rows = _rows(path)
    names, lines, values = [], [], []
    for line, cells in rows:
        texts = cells[1:9] if len(cells) >= 10 else cells[1:]
        if len(texts) not in (2, 3, 6, 8):
            message = f"has {len(cells)} columns, expected 3, 4, 7 or 9: {_GEO_COUNTS}{_comma_hint(cells)}"
            raise InputError(message, path=path, line=line)
        fields = ("x", "y", "z", "yaw", "pitch", "roll", "h_acc", "v_acc")
        numbers = [
            number(text, path=path, line=line, field=field) for text, field in zip(texts, fields, strict=False)
        ]
        names.append(cells[0])
        lines.append(line)
        values.append(numbers + [np.nan] * (8 - len(numbers)))
    table = np.array(values, dtype=np.float64)
    return PoseTable(
        path=path,
        source="geo.txt",
        lines=np.array(lines, dtype=np.int64),
        names=tuple(names),
        time_s=None,
        xyz=table[:, :3],
        geographic=None,
        quat_xyzw=_quaternions(table[:, 3:6]),
        sigma_enu_m=_sigmas(table[:, 6:8], path, lines),
        crs_text=crs_text,
    )


def read_ground_points(path: Path) -> GroundPoints:
    """Read `gcp_list.txt`. Points without a name are named by their place in the file.

    Raises:
        InputError: no CRS line, too few columns, a cell that is no number or NaN, no line at all, or one point at
            two places.
    """
    crs_text, rows = _rows(path)
    points, marks = [], []
    unnamed: dict[tuple[float, float, float], str] = {}
    for line, cells in rows:
        if len(cells) < 6:
            message = f"has {len(cells)} columns, expected at least 6: {_GCP_FORM}{_comma_hint(cells)}"
            raise InputError(message, path=path, line=line)
        fields = ("x", "y", "z", "px", "py")
        values = [
            number(text, path=path, line=line, field=field) for text, field in zip(cells, fields, strict=False)
        ]
        for value, field in zip(values, fields, strict=True):
            if np.isnan(value):
                raise InputError("is not a number", path=path, line=line, field=field)
        xyz = (values[0], values[1], values[2])
        name = cells[6] if len(cells) > 6 else unnamed.setdefault(xyz, f"point-{len(unnamed) + 1}")
        points.append(ListedPoint(line, name, xyz))
        marks.append(ListedMark(line, name, cells[5], values[3], values[4]))
    return GroundPoints(path, ODM_POINTS, without_repeats(points, path), tuple(marks), crs_text)


def _rows(path: Path) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the CRS, and line number and cells of each further line but blank ones and comments."""
    lines = [(at, text.strip()) for at, text in enumerate(read_lines(path), start=1)]
    lines = [(at, text) for at, text in lines if text and not text.startswith("#")]
    if not lines:
        raise InputError("is empty", path=path)
    first, crs_text = lines[0]
    rows = [(at, text.split()) for at, text in lines[1:]]
    if len(crs_text.split()) >= 3 and _is_number(crs_text.split()[1]) and not crs_text.startswith("+"):
        raise InputError(
            "the first line must be the CRS, e.g. EPSG:4326 or WGS84 UTM 16N; this is a row", path=path, line=first
        )
    if not rows:
        raise InputError("has a CRS but no rows", path=path)
    return crs_text, rows


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _comma_hint(cells: list[str]) -> str:
    return "; separate columns by spaces or tabs" if any("," in cell or ";" in cell for cell in cells) else ""


def _quaternions(yaw_pitch_roll_deg: FloatArray) -> FloatArray | None:
    known = complete(yaw_pitch_roll_deg)
    if not known.any():
        return None
    result = np.full((len(known), 4), np.nan)
    gimbal = yaw_pitch_roll_deg[known] + np.array([0.0, _GIMBAL_FROM_ODM_PITCH_DEG, 0.0])
    result[known] = quat_xyzw_from_matrix(geo_from_cam(gimbal))
    return result


def _sigmas(accuracy_m: FloatArray, path: Path, lines: list[int]) -> FloatArray | None:
    bad = np.flatnonzero((accuracy_m <= 0.0).any(axis=1))
    if len(bad):
        raise InputError("must be above zero", path=path, line=lines[bad[0]], field="h_acc, v_acc")
    if not np.isfinite(accuracy_m).any():
        return None
    return accuracy_m[:, [0, 0, 1]]


PIX4D_MARKS = "a table of points (PIX4D)"
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
}
_POINT_COLUMNS = ("label", "first", "second", "z", "sigma_h", "sigma_v")
_MARK_COLUMNS = ("image", "label", "x", "y")


def read_point_table(path: Path) -> GroundPoints:
    """Read ground points without marks.

    Raises:
        InputError: no rows, a column is missing, a cell is no number, or one point at two places.
    """
    lines = _lines(path)
    first, text = lines[0]
    separator = separator_of(text)
    header = split(text, separator, path=path, line=first)
    geographic: bool | None = None
    if len(header) < 4:
        raise InputError(f"has {len(header)} columns, expected label, two coordinates and z", path=path, line=first)
    has_header = not any(is_number(cell) for cell in header[1:4])
    if has_header:
        columns, unknown = named_columns(header, _POINT_ALIASES, path, first)
        geographic = "latitude" in columns or "longitude" in columns
        axes = ("longitude", "latitude") if geographic else ("x", "y")
        missing = [name for name in ("label", *axes, "z") if name not in columns]
        if missing or (geographic and {"x", "y"} & set(columns)):
            raise InputError(
                f"the header must name label, z, and either x and y or longitude and latitude; it is {text!r}"[
                    :300
                ],
                path=path,
                line=first,
            )
        lines = lines[1:]
    else:
        columns, unknown, axes = {name: at for at, name in enumerate(_POINT_COLUMNS)}, (), ("first", "second")
    points = [
        ListedPoint(
            line=row.line,
            name=_name(row.text("label"), path, row.line),
            xyz=(row.finite(axes[0]), row.finite(axes[1]), row.finite("z")),
            sigma_h_m=row.sigma_m("sigma_h"),
            sigma_v_m=row.sigma_m("sigma_v"),
        )
        for row in rows(path, lines, separator, columns)
    ]
    if not points:
        raise InputError("has a header but no rows", path=path)
    return GroundPoints(
        path=path,
        kind=PIX4D_MARKS,
        points=without_repeats(points, path),
        geographic=geographic,
        in_order_of_crs=not has_header,
        unknown_columns=unknown,
    )


def read_marks(path: Path) -> tuple[ListedMark, ...]:
    """Read marks of ground points.

    Raises:
        InputError: no rows, a column is missing, or a cell is no number.
    """
    lines = _lines(path)
    first, text = lines[0]
    separator = separator_of(text)
    header = split(text, separator, path=path, line=first)
    if len(header) < 4:
        raise InputError(f"has {len(header)} columns, expected image, label, x and y", path=path, line=first)
    columns = {name: at for at, name in enumerate(_MARK_COLUMNS)}
    if not any(is_number(cell) for cell in header[2:4]):
        columns, _ = named_columns(header, _MARK_ALIASES, path, first)
        missing = [name for name in _MARK_COLUMNS if name not in columns]
        if missing:
            raise InputError(f"the header names no {', '.join(missing)}", path=path, line=first)
        lines = lines[1:]
    marks = tuple(
        ListedMark(
            row.line, _name(row.text("label"), path, row.line), row.text("image"), row.finite("x"), row.finite("y")
        )
        for row in rows(path, lines, separator, columns)
    )
    if not marks:
        raise InputError("has a header but no rows", path=path)
    return marks


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the numbered lines that are neither blank nor comments."""
    lines = [(at, text) for at, text in enumerate(read_lines(path), start=1) if text.strip()]
    kept = [(at, text) for at, text in lines if not text.lstrip().startswith("#")]
    if not kept:
        raise InputError("has comments only", path=path)
    return kept


def _name(text: str, path: Path, line: int) -> str:
    if not text:
        raise InputError("has no name", path=path, line=line, field="label")
    return text
