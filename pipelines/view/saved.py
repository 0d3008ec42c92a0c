"""Files that the user saves in the viewer: measurements as GeoJSON, GeoPackage, and a table for each kind.

Several viewers may show one workspace. Each change reads the file again, changes the records that it is about, and
writes the file whole: nothing is lost of what another viewer has saved meanwhile. One writer at a time.

The points of a measurement are stored in `geo` with the covariance of the surface and the photographs that show
them, so that σ of what is made of several measurements is again the joint one. All texts of the survey are escaped
in the tables.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import shapely

from pipelines.core.errors import storage_failures
from pipelines.core.extras import extra_part
from pipelines.core.files import replace_texts
from pipelines.core.json_values import Json
from pipelines.core.lock import WriteLock
from pipelines.core.stages import SAVED_MEASUREMENTS
from pipelines.formats.tables import table_text
from pipelines.formats.vector_files import feature, features_text, replacing_features_gpkg
from pipelines.survey.saved_measurements import (
    CLOSED,
    MEASUREMENTS,
    Kind,
    NamedMeasurement,
    SavedPoint,
    read_measurements,
)

FOLDER = Path(SAVED_MEASUREMENTS).parent.name  # of the workspace: what the user saves in the viewer
_PATIENCE_S = 5.0  # for another viewer, which holds the folder for the time of one write
TABLES: dict[Kind, str] = {
    "point": "points.csv",
    "distance": "distances.csv",
    "polyline": "polylines.csv",
    "area": "areas.csv",
    "volume": "volumes.csv",
    "profile": "profiles.csv",
}
PACKAGE = "measurements.gpkg"  # where the extra `vectors` is installed
FILES = (MEASUREMENTS, PACKAGE, *TABLES.values())
_PLACE = ("x", "y", "z", "sigma_e_m", "sigma_n_m", "sigma_u_m")


@contextmanager
def changing(folder: Path) -> Iterator[None]:
    """Hold the right to change the viewer's files in a folder.

    Raises:
        WorkspaceBusyError: another process holds it for too long.
        InputError: the folder cannot be made or locked.
        StorageError: the disk is full or fails.
    """
    with storage_failures():
        try:
            with WriteLock(folder).hold("georef view", _PATIENCE_S):
                yield
        except OSError as error:
            error.filename = error.filename or str(folder)
            raise


class SavedMeasurements:
    """Measurements saved by the viewers of a workspace, in the file's order; errors as of `read_measurements`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.read()

    def read(self) -> None:
        """Read the file again, which another viewer may have changed."""
        self.all: tuple[NamedMeasurement, ...] = tuple(read_measurements(self._folder))

    def put(self, measurement: NamedMeasurement, row: int | None = None) -> None:
        """Save a measurement, in the place of its id, else in a row, else last; a GeorefError: it was not."""

        def with_it(saved: list[NamedMeasurement]) -> list[NamedMeasurement]:
            ids = [each.id for each in saved]
            if measurement.id in ids:
                saved[ids.index(measurement.id)] = measurement
            else:
                saved.insert(len(saved) if row is None else row, measurement)
            return saved

        self._change(with_it)

    def remove(self, measurement: NamedMeasurement) -> None:
        """Remove a measurement; a GeorefError: nothing was removed, and why."""
        self._change(lambda saved: [each for each in saved if each.id != measurement.id])

    def _change(self, changed: Callable[[list[NamedMeasurement]], list[NamedMeasurement]]) -> None:
        with changing(self._folder):
            measurements = changed(read_measurements(self._folder))
            texts = {
                MEASUREMENTS: features_text([_feature(each) for each in measurements]),
                **tables_of(measurements),
            }
            with _package(self._folder / PACKAGE, measurements):
                replace_texts({self._folder / name: text for name, text in texts.items()})
            for file in set(TABLES.values()) - set(texts):
                (self._folder / file).unlink(missing_ok=True)
        self.all = tuple(measurements)


@contextmanager
def _package(path: Path, measurements: Sequence[NamedMeasurement]) -> Iterator[None]:
    """Write a GeoPackage with a layer for each kind, where the extra `vectors` is installed.

    It takes its place when the context ends: what cannot be written whole is not stored at all.
    """
    if extra_part("vectors").found is None or not measurements:
        yield
        path.unlink(missing_ok=True)
        return
    layers: dict[str, list[Json]] = {}
    for each in measurements:
        one = _feature(each)
        layers.setdefault(TABLES[each.kind].removesuffix(".csv"), []).append(
            {**one, "properties": {name: value for name, value in one["properties"].items() if name != "georef"}}
        )
    with replacing_features_gpkg(path, layers):
        yield


def tables_of(measurements: Sequence[NamedMeasurement]) -> dict[str, str]:
    """Return a table for each kind of measurement that there is, by file: a line each, with its geometry as WKT.

    Geometry and coordinates are in the CRS of the measurement, which a column names.
    """
    tables = {}
    for kind, file in TABLES.items():
        rows = [each for each in measurements if each.kind == kind]
        names = list(dict.fromkeys(quantity.name for each in rows for quantity in each.quantities))
        if not rows:
            continue
        heads = [f"{name}{part}" for name in names for part in ("", " sigma", " unit")]
        lines: list[Sequence[object]] = [["name", "wkt", "crs", *_PLACE, *heads]]
        for each in rows:
            place = _place_cells(each.points[0]) if kind == "point" else ("",) * len(_PLACE)
            by_name = {quantity.name: quantity for quantity in each.quantities}
            values: list[object] = []
            for one in map(by_name.get, names):
                values += (
                    ["", "", ""] if one is None else [one.value, "" if one.sigma is None else one.sigma, one.unit]
                )
            lines.append([each.name, _wkt(each), each.crs, *place, *values])
        tables[file] = table_text(lines)
    return tables


def _place_cells(point: SavedPoint) -> tuple[object, ...]:
    """Return the cells of the columns `_PLACE`; those of an unknown σ are empty."""
    return (*point.xyz, *(point.sigma_m or ("", "", "")))


def _wkt(measurement: NamedMeasurement) -> str:
    places = [
        " ".join(f"{value:.9g}" if abs(value) < 400 else f"{value:.4f}" for value in point.xyz)
        for point in measurement.points
    ]
    if len(places) == 1:
        return f"POINT Z ({places[0]})"
    if measurement.kind in CLOSED and len(places) > 2:
        return f"POLYGON Z (({', '.join([*places, places[0]])}))"
    return f"LINESTRING Z ({', '.join(places)})"


def _feature(measurement: NamedMeasurement) -> Json:
    """Return the feature: a Point, a LineString or a Polygon in longitude, latitude and ellipsoidal height.

    The geometry is null in a local frame, which GeoJSON cannot state.
    """
    lon_lat_h = [(lla[1], lla[0], lla[2]) for point in measurement.points if (lla := point.lla) is not None]
    shape: shapely.Geometry | None
    if not lon_lat_h:  # in a local frame
        shape = None
    elif len(lon_lat_h) == 1:
        shape = shapely.Point(lon_lat_h[0])
    elif measurement.kind in CLOSED and len(lon_lat_h) > 2:
        shape = shapely.orient_polygons(shapely.Polygon(lon_lat_h))
    else:
        shape = shapely.LineString(lon_lat_h)
    values = {quantity.name: quantity.value for quantity in measurement.quantities}
    sigmas = {f"sigma of {quantity.name}": quantity.sigma for quantity in measurement.quantities}
    names = {"name": measurement.name, "kind": measurement.kind}  # which no quantity replaces
    properties = {**names, **values, **sigmas, **names}
    geometry = None if shape is None else shapely.geometry.mapping(shape)
    return feature(geometry, {**properties, "georef": measurement.model_dump(mode="json")})
