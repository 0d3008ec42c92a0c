"""What the user saves in the viewer: its files, its measurements as GeoJSON and CSV, and the panels' tables.

Several viewers may show one workspace. Each change reads the file again, changes the records that it is about, and
writes the file whole: nothing is lost of what another viewer has saved meanwhile. One writer at a time.

The points of a measurement are stored in `geo` with the covariance of the surface and the photographs that show
them, so that σ of what is made of several measurements is again the joint one. All texts of the survey are escaped
in the tables.
"""

import html
import json
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from pipelines.core.errors import InputError, storage_failures
from pipelines.core.files import replace_texts
from pipelines.core.lock import WriteLock
from pipelines.core.products import ImageName, Product
from pipelines.core.types import FloatArray, Matrix3, Vector3
from pipelines.formats.tables import table_text
from pipelines.formats.vector_files import Json, feature, features_text
from pipelines.survey.target_crs import TargetCrs
from pipelines.view.quantities import Quantity

FOLDER = "view"  # of the workspace: what the user saves in the viewer
_PATIENCE_S = 5.0  # for another viewer, which holds the folder for the time of one write
_MOST_STEPS = 100
MEASUREMENTS, TABLE = "measurements.geojson", "measurements.csv"
Kind = Literal["point", "distance", "polyline", "area", "volume"]
_MOST_BYTES = 64 << 20
_COLUMNS = ("name", "kind", "vertex", "x", "y", "z", "crs", "sigma_e_m", "sigma_n_m", "sigma_u_m")
_TEXT = "font-size:0.85em;margin:0.4em 0.8em"
_ALARM = "padding:0.4em 0.6em;border-left:0.3em solid #d33;background:rgba(221,51,51,0.12);font-weight:600"
_TABLE = "width:100%;font-size:0.8em;border-spacing:0.3em 0.1em;font-variant-numeric:tabular-nums;text-align:right"


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


class History:
    """Steps that can be undone, the last one first."""

    def __init__(self) -> None:
        self._steps: deque[tuple[str, Callable[[], object]]] = deque(maxlen=_MOST_STEPS)

    def add(self, step: str, undo: Callable[[], object]) -> None:
        """Add a step that was taken, in words, with its undoing; one that fails can be repeated."""
        self._steps.append((step, undo))

    def undo(self) -> str | None:
        """Undo the last step and return it in words; None: there is none."""
        if not self._steps:
            return None
        step, undo = self._steps[-1]
        undo()
        self._steps.pop()
        return step


def new_id() -> str:
    return uuid.uuid4().hex


class SavedPoint(Product):
    """Point of a measurement.

    Attributes:
        position_in_geo: metres.
        cov_of_surface: 3×3, m², of the surface alone; of rank one under a line of sight.
        images: names of the photographs that show it.
        xyz: in the CRS.
        sigma_m: east, north, up; None: not known.
        lla: latitude and longitude in degrees, ellipsoidal height in metres.
    """

    position_in_geo: Vector3
    cov_of_surface: Matrix3
    images: tuple[ImageName, ...]
    xyz: Vector3
    sigma_m: Vector3 | None
    lla: Vector3


class NamedMeasurement(Product):
    """Saved measurement.

    Attributes:
        id: by which viewers know it, whatever its name.
        crs: name of the CRS of `xyz`.
        model: hash of the trained model in which it was measured.
    """

    format_version: Literal[1] = 1
    id: str = Field(default_factory=new_id, pattern="^[0-9a-f]{32}$")
    name: str = Field(min_length=1, max_length=200)
    kind: Kind
    crs: str
    model: str
    points: tuple[SavedPoint, ...] = Field(min_length=1, max_length=10_000)
    quantities: tuple[Quantity, ...] = ()


class SavedMeasurements:
    """Measurements saved by the viewers of a workspace, in the file's order; errors as of `read_measurements`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.all: tuple[NamedMeasurement, ...] = tuple(read_measurements(folder))

    def put(self, measurement: NamedMeasurement, row: int | None = None) -> None:
        """Save a measurement, in the place of its id, else in a row, else last; a GeorefError: it was not."""

        def with_it(found: list[NamedMeasurement]) -> list[NamedMeasurement]:
            ids = [each.id for each in found]
            if measurement.id in ids:
                found[ids.index(measurement.id)] = measurement
            else:
                found.insert(len(found) if row is None else row, measurement)
            return found

        self._change(with_it)

    def remove(self, measurement: NamedMeasurement) -> None:
        """Remove a measurement; a GeorefError: nothing was removed, and why."""
        self._change(lambda found: [each for each in found if each.id != measurement.id])

    def _change(self, changed: Callable[[list[NamedMeasurement]], list[NamedMeasurement]]) -> None:
        with changing(self._folder):
            measurements = changed(read_measurements(self._folder))
            replace_texts(
                {
                    self._folder / MEASUREMENTS: features_text([_feature(each) for each in measurements]),
                    self._folder / TABLE: _table(measurements),
                }
            )
        self.all = tuple(measurements)


def _table(measurements: Sequence[NamedMeasurement]) -> str:
    points = (
        (each.name, each.kind, vertex, *point.xyz, each.crs, *(point.sigma_m or ("", "", "")))
        for each in measurements
        for vertex, point in enumerate(each.points, start=1)
    )
    quantities = (
        (each.name, each.kind, found.name, found.value, found.unit, "" if found.sigma is None else found.sigma)
        for each in measurements
        for found in each.quantities
    )
    named = ("name", "kind", "quantity", "value", "unit", "sigma")
    return table_text((_COLUMNS, *points, (), named, *quantities))


def read_measurements(folder: Path) -> list[NamedMeasurement]:
    """Return the saved measurements of a folder; none without a file. An InputError names a bad file or feature."""
    path = folder / MEASUREMENTS
    if not path.exists():
        return []
    if path.stat().st_size > _MOST_BYTES:
        message = f"is larger than {_MOST_BYTES >> 20} MiB; move the file away."
        raise InputError("measurements-too-large", message, path=path)
    try:
        document = json.loads(path.read_text("utf-8"))
        features = document["features"]
        measurements = [each["properties"]["georef"] for each in features]
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = "is no file of saved measurements; move the file away."
        raise InputError("not-measurements", message, path=path) from error
    read = []
    for number, each in enumerate(measurements):
        try:
            read.append(NamedMeasurement.model_validate(each))
        except ValidationError as error:
            first = error.errors()[0]
            field = f"features[{number}].properties.georef." + ".".join(map(str, first["loc"]))
            message = f"{first['msg']}; move the file away."
            raise InputError("measurement-invalid", message, path=path, field=field) from error
    return read


def _feature(measurement: NamedMeasurement) -> Json:
    """Return the feature: a Point, a LineString or a Polygon in longitude, latitude and ellipsoidal height."""
    lon_lat_h = [[point.lla[1], point.lla[0], point.lla[2]] for point in measurement.points]
    geometry: dict[str, Any]
    if len(lon_lat_h) == 1:
        geometry = {"type": "Point", "coordinates": lon_lat_h[0]}
    elif measurement.kind in ("area", "volume") and len(lon_lat_h) > 2:
        geometry = {"type": "Polygon", "coordinates": [_anticlockwise(lon_lat_h)]}
    else:
        geometry = {"type": "LineString", "coordinates": lon_lat_h}
    values = {quantity.name: quantity.value for quantity in measurement.quantities}
    sigmas = {f"sigma of {quantity.name}": quantity.sigma for quantity in measurement.quantities}
    own = {"name": measurement.name, "kind": measurement.kind, **values, **sigmas}
    return feature(geometry, {**own, "georef": measurement.model_dump(mode="json")})


def _anticlockwise(ring: list[list[float]]) -> list[list[float]]:
    x, y = (np.array([point[axis] for point in ring]) for axis in (0, 1))
    area = float((x - x[0]) @ np.roll(y - y[0], -1) - (y - y[0]) @ np.roll(x - x[0], -1))
    turned = ring if area > 0 else ring[::-1]
    return [*turned, turned[0]]


@dataclass(frozen=True)
class PlaceRow:
    """Place (3,) in `geo` with σ (3,) east, north, up in metres, or None."""

    name: str
    position_in_geo: FloatArray
    sigma_m: FloatArray | None


def paragraph(text: str, mark: str = "note") -> str:
    """Return a paragraph; `data-…` of the name `mark` lets scripts find it."""
    return f'<p data-{mark}="yes" style="{_TEXT}">{html.escape(text)}</p>'


def failure(text: str) -> str:
    """Return a paragraph that stands out."""
    return f'<p data-failed="yes" role="alert" style="{_TEXT};{_ALARM}">{html.escape(text)}</p>'


def place_table(target: TargetCrs, rows: Sequence[PlaceRow], marked: str = "place") -> str:
    """Return places with their coordinates in the CRS; `data-…` of the name `marked` has metres in `geo`."""
    crs = target.crs
    names = ("longitude", "latitude", "height") if crs.is_geographic else ("easting", "northing", "height")
    heads = "".join(f"<th>{name} ({html.escape(unit)})</th>" for name, unit in zip(names, crs.units, strict=True))
    decimals = (8, 8, 3) if crs.is_geographic else (3, 3, 3)
    lines = []
    for row in rows:
        xyz = target.xyz_from_geo(row.position_in_geo[None])[0]
        cells = "".join(f"<td>{value:.{digits}f}</td>" for value, digits in zip(xyz, decimals, strict=True))
        data = ",".join(f"{value:.6f}" for value in row.position_in_geo)
        lines.append(f'<tr data-{marked}="{data}"><th>{html.escape(row.name)}</th>{cells}</tr>')
        if row.sigma_m is not None:
            cells = "".join(f"<td>±{value:.3f}</td>" for value in row.sigma_m)
            lines.append(f"<tr><th>σ E, N, U (m)</th>{cells}</tr>")
    return _html_table(f"<tr><th></th>{heads}</tr>{''.join(lines)}")


def quantity_text(quantity: Quantity) -> str:
    """Return a quantity with its σ and unit in one line."""
    sigma = "" if quantity.sigma is None else f" ± {quantity.sigma:.3f}"
    return f"{quantity.name} {quantity.value:.3f}{sigma} {quantity.unit}"


def quantity_table(quantities: Sequence[Quantity]) -> str:
    """Return quantities with their σ; empty without any."""
    rows = []
    for each in quantities:
        sigma = "" if each.sigma is None else f"±{each.sigma:.3f}"
        data = f'data-quantity="{html.escape(each.name)}" data-value="{each.value:.6f}"'
        data += "" if each.sigma is None else f' data-sigma="{each.sigma:.6f}"'
        cells = f"<td>{each.value:.3f}</td><td>{sigma}</td><td>{html.escape(each.unit)}</td>"
        rows.append(f"<tr {data}><th>{html.escape(each.name)}</th>{cells}</tr>")
    return _html_table("".join(rows)) if rows else ""


def saved_table(rows: Sequence[tuple[str, str, str]]) -> str:
    """Return saved measurements: name, what is shown of it, values."""
    if not rows:
        return "<p>Nothing saved yet.</p>"
    lines = [
        f'<tr data-saved="{html.escape(name)}"><th>{html.escape(shown)}</th><td>{html.escape(values)}</td></tr>'
        for name, shown, values in rows
    ]
    return _html_table("".join(lines))


def mark_table(marks: Mapping[str, tuple[float, float]], residual_px: Mapping[str, float]) -> str:
    """Return the marks of a point by image, with their residuals where the point is determined."""
    lines = []
    for image, (x, y) in marks.items():
        residual = f"{residual_px[image]:.2f}" if image in residual_px else ""
        name = html.escape(image)
        cells = f"<td>{x:.2f}</td><td>{y:.2f}</td><td>{residual}</td>"
        lines.append(f'<tr data-mark="{name}" data-px="{x:.3f},{y:.3f}"><th>{name}</th>{cells}</tr>')
    heads = "<tr><th>mark in</th><th>x (px)</th><th>y (px)</th><th>residual (px)</th></tr>"
    return _html_table(heads + "".join(lines))


def _html_table(rows: str) -> str:
    return f'<table style="{_TABLE}">{rows}</table>'
