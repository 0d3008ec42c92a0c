"""Vectors as files: features as GeoJSON, and contour lines as GeoPackage and DXF.

GeoJSON (RFC 7946) has longitude and latitude in WGS84 degrees, outer rings anticlockwise, cut at the date line.
Contours are a line a height, with the height as attribute and as z.
"""

import io
import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from pipelines.core.errors import InputError, StorageError, storage_error_in
from pipelines.core.files import file_size, replacing, storage_failure_of
from pipelines.core.json_values import Json, JsonValue
from pipelines.core.types import AnyArray, FloatArray
from pipelines.formats.vector_source import gdal, layers_with_shapes, reading_errors, rows_of_table, tables_alone
from pipelines.geometry.footprints import clipped_ring, ring_area

_DECIMALS = 8  # of a degree: 1 mm
_MOST_CONTOUR_BYTES = 1 << 30
_MINOR, _MAJOR = "CONTOURS", "CONTOURS_MAJOR"


def polygon(lon_lat: ArrayLike) -> Json | None:
    """Return the geometry of a ring (K, 2) in degrees, not closed: a Polygon, or two if it crosses the date line.

    None, which is the geometry of an unlocated feature, if the ring has no area.
    """
    ring = np.asarray(lon_lat, dtype=np.float64)
    if len(ring) < 3:
        return None
    ring = ring.copy()
    ring[:, 0] -= 360.0 * np.round((ring[:, 0] - ring[0, 0]) / 360.0)
    turned = [ring + np.array([turn, 0.0]) for turn in (-360.0, 0.0, 360.0)]
    east_of = [clipped_ring(part, part[:, 0] + 180.0) for part in turned]
    between = [clipped_ring(part, 180.0 - part[:, 0]) for part in east_of]
    rings = [closed for part in between if (closed := _closed(part)) is not None]
    if not rings:
        return None
    if len(rings) == 1:
        return {"type": "Polygon", "coordinates": [rings[0]]}
    return {"type": "MultiPolygon", "coordinates": [[one] for one in rings]}


def feature(
    geometry: Json | None, properties: Mapping[str, JsonValue], bbox: Sequence[float] | None = None
) -> Json:
    """Return a feature; NaN among the properties becomes null."""
    box = {} if bbox is None else {"bbox": list(bbox)}
    known = dict(properties)
    known |= {name: None for name, value in known.items() if isinstance(value, float) and math.isnan(value)}
    return {"type": "Feature", **box, "geometry": geometry, "properties": known}


def features_text(features: Sequence[Json]) -> str:
    """Return a FeatureCollection as text, one feature a line."""
    lines = ",\n".join(json.dumps(one, allow_nan=False, ensure_ascii=False) for one in features)
    return f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n'


def _closed(ring: FloatArray) -> list[list[float]] | None:
    if len(ring) < 3:
        return None
    rounded = np.round(ring, _DECIMALS)
    area = ring_area(rounded)
    if area == 0.0:
        return None
    outline = rounded if area > 0 else rounded[::-1]
    return [*outline.tolist(), outline[0].tolist()]


@dataclass(frozen=True)
class ContourLine:
    """Line of equal height (K, 2) in the CRS, easting or longitude first; every fifth is major, drawn thicker."""

    height: float
    xy: FloatArray
    is_major: bool


def write_contours_gpkg(path: Path, lines: Sequence[ContourLine], wkt: str) -> None:
    """Write contour lines as a GeoPackage 1.2 (OGC 12-128r15) with the layer `contours`."""
    shapes = [shapely.linestrings(np.insert(line.xy, 2, line.height, axis=1)) for line in lines]
    columns = {
        "height": np.array([line.height for line in lines], dtype=np.float64),
        "major": np.array([line.is_major for line in lines], dtype=np.bool_),
    }
    with _new_gpkg(path) as draft:
        _add_layer(draft, "contours", shapes, columns, kind="LineString Z", crs=wkt)


@contextmanager
def _new_gpkg(path: Path) -> Iterator[Path]:
    """Yield the draft of a GeoPackage, renamed when it is complete; GDAL takes the format from its suffix.

    Raises:
        StorageError: the disk is full or fails, which GDAL reports by errors of its own.
    """
    draft = path.with_name(f".{path.name}")
    logs = [draft.with_name(draft.name + mark) for mark in ("-journal", "-wal", "-shm")]
    for file in (draft, *logs):
        file.unlink(missing_ok=True)
    try:
        with replacing(path, draft):
            yield draft
    finally:
        for file in logs:
            file.unlink(missing_ok=True)


def _add_layer(
    draft: Path,
    layer: str,
    shapes: Sequence[shapely.Geometry | None],
    columns: Mapping[str, AnyArray],
    *,
    kind: str,
    crs: str,
) -> None:
    """Write a layer of shapes, whose values are the columns, into a GeoPackage 1.2, which is made if missing.

    GIS of some years ago warn of later versions, which GDAL writes by itself.
    """
    is_new = not draft.exists()
    wkb = [None if shape is None else shapely.to_wkb(shape, output_dimension=3) for shape in shapes]
    try:
        gdal().raw.write(
            draft,
            geometry=np.array(wkb, dtype=object),
            field_data=list(columns.values()),
            fields=list(columns),
            layer=layer,
            driver="GPKG",
            geometry_type=kind,
            append=not is_new,
            dataset_options={"VERSION": "1.2"} if is_new else None,
            crs=crs or None,
        )
        whole = rows_of_table(draft, layer) == len(shapes)
    except (RuntimeError, ValueError) as error:  # pyogrio's are of these
        failure = storage_error_in(str(error), draft) or storage_failure_of(draft.parent)
        if failure is None:
            raise
        raise failure from error
    if not whole:
        message = f"{draft.parent}: the GeoPackage could not be written whole."
        raise storage_failure_of(draft.parent) or StorageError("gpkg-not-written", message)


@contextmanager
def replacing_features_gpkg(path: Path, layers: Mapping[str, Sequence[Json]]) -> Iterator[None]:
    """Write features of GeoJSON as a GeoPackage 1.2 in WGS84 with heights, renamed to `path` when the context ends.

    A layer has the features of a name; features may have no geometry. Properties are numbers, texts, or None. Where
    the context ends by an error, `path` stays as it is. Raises as `_new_gpkg`.
    """
    with _new_gpkg(path) as draft:
        for layer, features in layers.items():
            names = list(dict.fromkeys(name for one in features for name in one["properties"]))
            columns = {}
            for name, column in zip(names, column_names(names), strict=True):
                values = [one["properties"].get(name) for one in features]
                is_text = any(isinstance(value, str) for value in values)
                columns[column] = np.array(values, dtype=object if is_text else np.float64)
            geometries = [one["geometry"] for one in features]
            shapes = [None if one is None else shapely.from_geojson(json.dumps(one)) for one in geometries]
            kinds = {shape.geom_type for shape in shapes if shape is not None}
            kind = f"{kinds.pop()} Z" if len(kinds) == 1 else "Unknown"
            _add_layer(draft, layer, shapes, columns, kind=kind, crs="EPSG:4979")
        yield


def column_names(names: Sequence[str]) -> list[str]:
    """Return names of columns of a GeoPackage: SQLite tells no capitals apart, and `fid` and `geom` are taken."""
    taken, columns = {"fid", "geom"}, []
    for name in names:
        column, number = name.replace("\0", " "), 1
        while column.casefold() in taken:
            number += 1
            column = f"{name} {number}".replace("\0", " ")
        taken.add(column.casefold())
        columns.append(column)
    return columns


def read_contours(path: Path) -> tuple[str, list[ContourLine]]:
    """Return the CRS as WKT and the lines of a file that `write_contours_gpkg` wrote; an InputError: damaged.

    Examples:
        >>> lines = [ContourLine(height=500.0, xy=np.array([[7.0, 46.0], [7.1, 46.2]]), is_major=True)]
        >>> write_contours_gpkg(Path("contours.gpkg"), lines, "EPSG:4326")
        >>> crs, read = read_contours(Path("contours.gpkg"))
        >>> read[0].height, read[0].xy.tolist()
        (500.0, [[7.0, 46.0], [7.1, 46.2]])
    """
    wkt, shapes, rows = _read_gpkg(path, "contours", ("height", "major"), "georef export-raster --contours")
    lines = [
        ContourLine(float(height), shapely.get_coordinates(shape), bool(major))
        for shape, (height, major) in zip(shapes, rows, strict=True)
    ]
    return wkt, lines


def read_regions(
    path: Path, columns: Sequence[str], *, doubtful: bool = False
) -> tuple[str, list[Any], list[tuple[Any, ...]]]:
    """Return the CRS as WKT, polygons and some columns of the regions of `georef change`, as `read_contours`.

    `doubtful`: of the layer of regions that count as no change.

    Examples:
        >>> layers = {"regions": ([shapely.box(0, 0, 10, 10)], [{"name": "R1", "net_m3": -25.0}])}
        >>> write_polygons_gpkg(Path("regions.gpkg"), layers, "EPSG:32632")
        >>> crs, polygons, rows = read_regions(Path("regions.gpkg"), ["name", "net_m3"])
        >>> polygons[0].area, rows  # the area in m²
        (100.0, [('R1', -25.0)])
    """
    return _read_gpkg(path, "doubtful" if doubtful else "regions", columns, "georef change")


def _read_gpkg(
    path: Path, layer: str, columns: Sequence[str], command: str
) -> tuple[str, list[Any], list[tuple[Any, ...]]]:
    """Return the CRS as WKT, shapes and columns of a layer; an InputError names the command that wrote it."""
    file_size(path, limit_bytes=_MOST_CONTOUR_BYTES, kind=layer)
    try:
        with tables_alone(path) as source:
            meta, _, shapes, values = gdal().raw.read(source, layer=layer, columns=list(columns))
        order = [list(meta["fields"]).index(name) for name in columns]
        rows = list(zip(*(values[at].tolist() for at in order), strict=True))
        return str(meta["crs"]), [shapely.from_wkb(shape) for shape in shapes], rows
    except (*reading_errors(), shapely.errors.ShapelyError) as error:
        message = f"cannot be read: {error}."
        remedy = f"Write it again with `{command}`."
        raise InputError(f"{layer}-unreadable", message, path=path, remedy=remedy) from error


def write_polygons_gpkg(
    path: Path, layers: Mapping[str, tuple[Sequence[shapely.Geometry], Sequence[Json]]], wkt: str
) -> None:
    """Write layers of polygons, with a row of attributes each, as a GeoPackage 1.2."""
    with _new_gpkg(path) as draft:
        for layer, (polygons, rows) in layers.items():
            shapes = [shapely.MultiPolygon(shapely.get_parts(one)) for one in polygons]
            columns = {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}
            _add_layer(draft, layer, shapes, columns, kind="MultiPolygon", crs=wkt)


def write_contours_dxf(path: Path, lines: Sequence[ContourLine]) -> None:
    """Write contour lines as DXF (R2010) polylines with their height as elevation, every fifth on its own layer."""
    from ezdxf.filemanagement import new

    document = new("R2010")
    document.layers.add(_MINOR, color=8)
    document.layers.add(_MAJOR, color=7, lineweight=50)
    space = document.modelspace()
    for line in lines:
        layer = _MAJOR if line.is_major else _MINOR
        polyline = space.add_lwpolyline(line.xy.tolist(), dxfattribs={"layer": layer})
        polyline.dxf.elevation = line.height
    with replacing(path) as draft:
        document.saveas(draft)


def drawing(lines: Sequence[tuple[str, int, FloatArray]]) -> bytes:
    """Return lines as a DXF (R2010): the layer of each, its colour by AutoCAD's index, and places (K, 2)."""
    from ezdxf.filemanagement import new

    document, text = new("R2010"), io.StringIO()
    for layer, colour, places in lines:
        if layer not in document.layers:
            document.layers.add(layer, color=colour)
        document.modelspace().add_lwpolyline(places.tolist(), dxfattribs={"layer": layer})
    document.write(text)
    return text.getvalue().encode(document.output_encoding, errors="replace")


@dataclass(frozen=True)
class ReadLayer:
    """Layer of a file as GDAL reads it: shapes in plan, of which None cannot be read, and columns of their values.

    `crs` is its CRS as text; empty: it states none.
    """

    name: str
    shapes: NDArray[Any]
    values: dict[str, NDArray[Any]]
    crs: str


def read_layers(path: Path, columns: Sequence[str] = (), *, field: str) -> list[ReadLayer]:
    """Return the layers with geometry of a GeoPackage or DXF file; an InputError names file and option.

    Examples:
        >>> lines = [ContourLine(height=500.0, xy=np.array([[7.0, 46.0], [7.1, 46.2]]), is_major=True)]
        >>> write_contours_gpkg(Path("contours.gpkg"), lines, "EPSG:4326")
        >>> layer = read_layers(Path("contours.gpkg"), ["height"], field="--boundary")[0]
        >>> layer.name, layer.shapes[0].wkt, layer.values["height"].tolist()
        ('contours', 'LINESTRING (7 46, 7.1 46.2)', [500.0])
    """
    layers = []
    try:
        with warnings.catch_warnings(), tables_alone(path, field=field) as source:
            warnings.simplefilter("ignore", RuntimeWarning)  # of GDAL, about what does not matter here
            for name in layers_with_shapes(source):
                meta, _, shapes, values = gdal().raw.read(source, layer=name, columns=list(columns), force_2d=True)
                known = dict(zip(meta["fields"], values, strict=True))
                plan = shapely.from_wkb(shapes, on_invalid="ignore")
                layers.append(ReadLayer(str(name), plan, known, meta["crs"] or ""))
    except reading_errors() as error:
        message = f"cannot be read: {error}."
        remedy = "Write it again, as GeoJSON."
        raise InputError("boundary-unreadable", message, path=path, field=field, remedy=remedy) from error
    return layers
