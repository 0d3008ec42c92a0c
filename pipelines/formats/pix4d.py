"""PIX4D's tables of ground points (`label, first, second, z [, σ, σ]`) and of their marks (`image, label, x, y`).

A header may stand or not. Without one, the coordinates are in the order of the axes of the CRS, latitude first for
EPSG:4326: https://support.pix4d.com/hc/en-us/articles/360038397752. The fifth column of marks is an accuracy or a
zoom level, by version, and is not read.
"""

from __future__ import annotations

from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.formats.delimited import is_number, named_columns, rows, separator_of, split
from pipelines.formats.ground_points import GroundPoints, ListedMark, ListedPoint, without_repeats
from pipelines.formats.text import read_lines

KIND = "a table of points (PIX4D)"
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
        kind=KIND,
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
