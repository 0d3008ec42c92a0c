"""Boundaries as people draw them: polygons and closed lines of GeoJSON, GeoPackage, KML, KMZ and DXF files.

GDAL reads GeoPackage and DXF. GeoJSON and KML are read here: GDAL drops rings of KML that are not closed, knows no
UTF-16, and follows the addresses that both formats may name.

Lines are polygons where they are closed, or where they close around areas together. One open line alone is closed
by its chord; the file then has a remark.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.core.json_values import JsonValue
from pipelines.core.products import Remark
from pipelines.formats.kml import read_kml
from pipelines.formats.vector_files import ReadLayer, read_layers

_MOST_BYTES = 64 * 1024 * 1024
# By suffix: what the file begins with, white space and a byte order mark apart. GDAL opens a file by its content,
# also one that names other files and servers.
BOUNDARY_FORMATS: dict[str, tuple[bytes, ...]] = {
    ".geojson": (b"{",),
    ".json": (b"{",),
    ".gpkg": (b"SQLite format 3\0",),
    ".kml": (b"<",),
    ".kmz": (b"PK\x03\x04",),
    ".dxf": (b"0", b"999", b"AutoCAD Binary DXF"),
}
_MARKS = {  # byte order marks, longer ones first
    b"\0\0\xfe\xff": "utf-32", b"\xff\xfe\0\0": "utf-32", b"\xef\xbb\xbf": "utf-8", b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
}  # fmt: skip
_WGS84 = "EPSG:4326"  # of GeoJSON (RFC 7946) and KML
_DXF_UNIT = re.compile(rb"\$INSUNITS\s*?\r?\n\s*70\s*?\r?\n\s*(\d{1,2})\s")
_DXF_UNIT_BINARY = re.compile(rb"\$INSUNITS\0F\0(.\0)", re.DOTALL)
_DXF_HEADER_BYTES = 1 << 20
_US_FOOT_M = 1200 / 3937
_DXF_UNITS: dict[int, tuple[str, float]] = {
    1: ("inches", 0.0254), 2: ("feet", 0.3048), 3: ("miles", 1609.344), 4: ("millimetres", 0.001),
    5: ("centimetres", 0.01), 6: ("metres", 1.0), 7: ("kilometres", 1000.0), 8: ("microinches", 2.54e-8),
    9: ("mils", 2.54e-5), 10: ("yards", 0.9144), 13: ("micrometres", 1e-6), 14: ("decimetres", 0.1),
    15: ("decametres", 10.0), 16: ("hectometres", 100.0), 21: ("US survey feet", _US_FOOT_M),
    22: ("US survey inches", _US_FOOT_M / 12), 23: ("US survey yards", 3 * _US_FOOT_M),
    24: ("US survey miles", 5280 * _US_FOOT_M),
}  # fmt: skip
_ROUNDING = 1e-6  # of a line's length: a gap that is none


@dataclass(frozen=True)
class BoundaryLayer:
    """Layer of a file with polygons in plan, easting or longitude first.

    `crs` is its CRS as text; empty: it states none. `crs_is_default`: it is the format's, not named in the file.
    """

    name: str
    polygons: tuple[Any, ...]
    crs: str = ""
    crs_is_default: bool = False


@dataclass(frozen=True)
class Boundary:
    """Layers of a file, each of polygons; `unit`: name and size in metres of a drawing's unit, if it states one.

    `is_drawing`: the layers are those of a CAD drawing, which holds more than a boundary.
    """

    layers: tuple[BoundaryLayer, ...]
    unit: tuple[str, float] | None = None
    is_drawing: bool = False
    remarks: tuple[Remark, ...] = ()


@dataclass(frozen=True)
class _Shapes:
    """Shapes of one layer as a file has them."""

    name: str
    shapes: list[Any]
    crs: str = ""
    crs_is_default: bool = False


Refusal = Callable[..., InputError]


def read_boundary(path: Path, *, field: str) -> Boundary:
    """Read the polygons and the closed lines of a GeoJSON, GeoPackage, KML, KMZ or DXF file.

    Raises:
        InputError: not such a file, too large, damaged, with a coordinate that is no number, or without an area;
            names file and option.

    Examples:
        >>> _ = Path("site.geojson").write_text(
        ...     '{"type": "Polygon", "coordinates": [[[7, 46], [7.1, 46], [7.1, 46.1], [7, 46]]]}'
        ... )
        >>> layer = read_boundary(Path("site.geojson"), field="--boundary").layers[0]
        >>> layer.polygons[0].wkt, layer.crs
        ('POLYGON ((7 46, 7.1 46, 7.1 46.1, 7 46))', 'EPSG:4326')
    """
    refusal = partial(InputError, path=path, field=field)
    file_size(path, limit_bytes=_MOST_BYTES, kind="boundary", field=field)
    suffix = path.suffix.lower()
    if suffix in (".geojson", ".json", ".kml", ".kmz"):
        data = path.read_bytes()
        if suffix == ".kmz" and data.startswith(BOUNDARY_FORMATS[suffix]):
            data, suffix = _unzipped(data, refusal), ".kml"
        data = _as_utf8(data, refusal)
    else:
        with path.open("rb") as file:
            data = file.read(_DXF_HEADER_BYTES)
    begins = BOUNDARY_FORMATS.get(suffix, ())
    head = data[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if not begins or not head.startswith(begins) or b"<OGR" in head:
        raise _no_boundary(refusal)
    unit = _drawing_unit(data) if suffix == ".dxf" else None
    with np.errstate(invalid="ignore"):  # corners that are no numbers are named below
        if suffix == ".kml":
            layers = [_Shapes("", read_kml(data, refusal), _WGS84, crs_is_default=True)]
        elif suffix in (".geojson", ".json"):
            layers = [_geojson(data, refusal)]
        else:
            layers = _gdal_layers(path, is_drawing=suffix == ".dxf", field=field)
    for layer in layers:
        _check_finite(layer, refusal)
    usable, remarks = _with_areas(layers, path.name)
    if not usable:
        count = sum(len(layer.shapes) for layer in layers)
        raise refusal(
            "boundary-without-area",
            f"has {count} shapes, and none is a polygon.",
            remedy="Draw the boundary as one.",
        )
    return Boundary(tuple(usable), unit, suffix == ".dxf", remarks)


def _no_boundary(refusal: Refusal) -> InputError:
    kinds = "GeoJSON (.geojson), GeoPackage (.gpkg), KML (.kml, .kmz) or DXF (.dxf)"
    return refusal("boundary-format", "is no boundary file that is known.", remedy=f"Give {kinds}.")


def _unzipped(data: bytes, refusal: Refusal) -> bytes:
    """Return the KML of a KMZ: the first in the order of the archive (OGC 12-007r2). Nothing is written to disk."""
    unreadable = partial(refusal, "boundary-unreadable")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            name = next((name for name in archive.namelist() if name.lower().endswith(".kml")), None)
            if name is None:
                raise unreadable("is a KMZ without a KML inside.", remedy="Export it again.")
            with archive.open(name) as file:
                document = file.read(_MOST_BYTES + 1)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, zlib.error) as error:
        message = f"cannot be unpacked as KMZ: {type(error).__name__} {str(error)[:100]}."
        remedy = "Export it again, as KML."
        raise unreadable(message, remedy=remedy) from error
    if len(document) > _MOST_BYTES:
        raise refusal(
            "file-too-large",
            f"unpacks to more than {_MOST_BYTES >> 20} MiB of KML.",
            remedy="Draw the boundary alone.",
        )
    return document


def _as_utf8(data: bytes, refusal: Refusal) -> bytes:
    """Return a text in UTF-8, whichever encoding its byte order mark, its zeros or its XML declaration tell."""
    encoding = next((name for mark, name in _MARKS.items() if data.startswith(mark)), "")
    if not encoding and b"\0" in data[:4]:  # UTF-16 without a mark: its first character is ASCII
        encoding = "utf-16-be" if data[:1] == b"\0" else "utf-16-le"
    declared = re.match(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"']([\w.:-]{1,40})[\"']", data[:400])
    names = [encoding] if encoding else ["utf-8", declared[1].decode() if declared else "", "cp1252"]
    for name in filter(None, names):
        try:
            return data.decode(name).lstrip("\ufeff").encode()
        except (UnicodeError, LookupError):
            continue
    raise refusal("boundary-encoding", f"is no text in {names[0].upper()}.", remedy="Save it as UTF-8.")


def _geojson(data: bytes, refusal: Refusal) -> _Shapes:
    unreadable = partial(refusal, "boundary-unreadable")
    try:
        document = json.loads(data)
        pending, shapes, crs_members = [document], [], []
        while pending:
            item = pending.pop()
            crs_members += [item["crs"]] if "crs" in item else []
            if item["type"] == "FeatureCollection":
                pending += item["features"][::-1]
            elif item["type"] == "Feature":
                pending += [item["geometry"]] if item["geometry"] is not None else []
            elif item["type"] == "GeometryCollection":
                pending += item["geometries"][::-1]
            else:
                shapes += _geometry(item["type"], item["coordinates"])
    except (ValueError, TypeError, KeyError, IndexError, RecursionError, shapely.errors.ShapelyError) as error:
        message = f"cannot be read as GeoJSON: {type(error).__name__} {str(error)[:100]}."
        remedy = "Write it again."
        raise unreadable(message, remedy=remedy) from error
    if not crs_members:
        return _Shapes("", shapes, _WGS84, crs_is_default=True)
    names = list(dict.fromkeys(_crs_member(member, refusal) for member in crs_members))
    if len(names) > 1:
        raise refusal("boundary-two-crs", f"names several CRSs: {', '.join(names)}.", remedy="Give one of them.")
    return _Shapes("", shapes, names[0])


def _geometry(kind: str, coordinates: JsonValue) -> list[Any]:
    """Return the polygons and lines of a geometry of GeoJSON; the reader of it catches what is malformed."""

    def plan(places: JsonValue) -> list[tuple[float, float]]:
        return [(float(vertex[0]), float(vertex[1])) for vertex in places]

    if kind == "Polygon":
        rings = [plan(ring) for ring in coordinates]
        return [shapely.Polygon(rings[0], rings[1:])] if rings and len(rings[0]) > 2 else []
    if kind == "LineString":
        return [shapely.LineString(plan(coordinates))] if len(coordinates) > 1 else []
    if kind in ("MultiPolygon", "MultiLineString"):
        return [shape for part in coordinates for shape in _geometry(kind.removeprefix("Multi"), part)]
    if kind in ("Point", "MultiPoint"):
        return [shapely.Point(*vertex[:2]) for vertex in ([coordinates] if kind == "Point" else coordinates)]
    raise ValueError(f"type {str(kind)[:40]}")


def _crs_member(member: JsonValue, refusal: Refusal) -> str:
    """Return the CRS that a member `crs` of GeoJSON 2008 names; empty: that it is unknown."""
    if member is None:
        return ""
    if isinstance(member, str):
        return member
    properties = member.get("properties") if isinstance(member, dict) else None
    if isinstance(properties, dict):
        name, code = properties.get("name"), properties.get("code")
        if isinstance(name, str):
            return name
        if isinstance(code, int | str):
            return f"EPSG:{code}"
    raise refusal(
        "boundary-crs-member", "has a member `crs` without a name.", remedy="Write the CRS as EPSG:n there."
    )


def _gdal_layers(path: Path, *, is_drawing: bool, field: str) -> list[_Shapes]:
    layers: list[_Shapes] = []
    for layer in read_layers(path, ("Layer", "PaperSpace") if is_drawing else (), field=field):
        layers += _drawn(layer) if is_drawing else [_Shapes(layer.name, list(layer.shapes), layer.crs)]
    return [replace(one, shapes=[shape for shape in one.shapes if shape is not None]) for one in layers]


def _drawn(read: ReadLayer) -> Iterator[_Shapes]:
    """Yield the layers of a drawing's model space; what lies on its sheets of paper has their coordinates."""
    shapes, count = read.shapes, len(read.shapes)
    layer = read.values.get("Layer", np.full(count, ""))
    paper = read.values.get("PaperSpace", np.zeros(count))
    is_paper = np.array([value is not None and bool(np.nan_to_num(value)) for value in paper], dtype=bool)
    for name in dict.fromkeys(layer[~is_paper].tolist()):
        yield _Shapes(str(name or ""), list(shapes[~is_paper & (layer == name)]))


def _drawing_unit(data: bytes) -> tuple[str, float] | None:
    if (match := _DXF_UNIT.search(data)) is not None:
        return _DXF_UNITS.get(int(match[1]))
    binary = _DXF_UNIT_BINARY.search(data)
    return None if binary is None else _DXF_UNITS.get(int.from_bytes(binary[1], "little"))


def _check_finite(layer: _Shapes, refusal: Refusal) -> None:
    for number, shape in enumerate(layer.shapes, start=1):
        places = shapely.get_coordinates(shape)
        wrong = np.flatnonzero(~np.isfinite(places).all(axis=1))
        if len(wrong):
            x, y = places[wrong[0]].tolist()
            of_layer = f" of layer {layer.name}" if layer.name else ""
            raise refusal(
                "boundary-not-finite",
                (
                    f"has a corner that is no place: ({x:g}, {y:g}), corner {int(wrong[0]) + 1} of shape "
                    f"{number}{of_layer}."
                ),
                remedy="Write its coordinates as numbers.",
            )


def _with_areas(layers: list[_Shapes], name: str) -> tuple[list[BoundaryLayer], tuple[Remark, ...]]:
    """Return the layers that hold an area, and a remark if an open line had to be closed for one."""
    parts = [[part for shape in layer.shapes for part in _simple_parts(shape)] for layer in layers]
    lines = [[part for part in every if part.geom_type == "LineString" and not _is_ring(part)] for every in parts]
    areas = [[area for part in every if (area := _area(part)) is not None] for every in parts]
    if not any(areas):
        areas = [list(shapely.get_parts(shapely.polygonize(every))) for every in lines]
    remarks: tuple[Remark, ...] = ()
    drawn = [(at, line) for at, every in enumerate(lines) for line in every if len(line.coords) > 2]
    if not any(areas) and len(drawn) == 1:
        at, line = drawn[0]
        areas[at] = [shapely.Polygon(line.coords)]
        sentence = f"{name}: its line is open, and was closed by the straight line from its end to its beginning."
        remarks = (Remark(code="boundary-line-closed", sentence=sentence),)
    usable = []
    for layer, polygons in zip(layers, areas, strict=True):
        valid = [part for shape in shapely.make_valid(polygons) for part in _simple_parts(shape)]
        valid = [part for part in valid if part.geom_type == "Polygon" and part.area > 0]
        if valid:
            usable.append(BoundaryLayer(layer.name, tuple(valid), layer.crs, layer.crs_is_default))
    return usable, remarks


def _simple_parts(shape: shapely.Geometry) -> Iterator[Any]:
    pending = [shape]
    while pending:
        one = pending.pop()
        if one.geom_type.startswith("Multi") or one.geom_type == "GeometryCollection":
            pending += shapely.get_parts(one).tolist()[::-1]
        else:
            yield one


def _is_ring(line: shapely.LineString) -> bool:
    first, last = line.coords[0], line.coords[-1]
    return len(line.coords) > 3 and float(np.hypot(*np.subtract(first, last))) <= _ROUNDING * line.length


def _area(part: shapely.Geometry) -> Any | None:
    if part.geom_type == "Polygon":
        return part
    return shapely.Polygon(part.coords) if part.geom_type == "LineString" and _is_ring(part) else None
