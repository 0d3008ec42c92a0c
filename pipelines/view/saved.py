"""Saved measurements: a GeoJSON file that is read again, and the same as CSV for tables.

The points are stored in `geo` with the covariance of the surface and the photographs that show them, so that σ of
what is made of several measurements is again the joint one.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from pipelines.core.durable import replace_texts
from pipelines.core.errors import InputError
from pipelines.core.products import ImageName, Product
from pipelines.core.types import Matrix3, Vector3
from pipelines.formats.csv_writer import table_text
from pipelines.formats.geojson import Json, feature, features_text
from pipelines.view.store import changing
from pipelines.view.surface_points import SurfacePoint

MEASUREMENTS, TABLE = "measurements.geojson", "measurements.csv"
Kind = Literal["point", "distance", "polyline", "area", "volume"]
_MOST_BYTES = 64 << 20
_COLUMNS = ("name", "kind", "vertex", "x", "y", "z", "crs", "sigma_e_m", "sigma_n_m", "sigma_u_m")


def new_id() -> str:
    """Return the id of a new measurement."""
    return uuid.uuid4().hex


class SavedQuantity(Product):
    """Quantity of a measurement; σ is None where it is not known."""

    name: str
    value: float
    sigma: float | None
    unit: str


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

    def surface_point(self, index: dict[str, int]) -> SurfacePoint:
        """Return the point, for a model whose images have these indices; unknown ones are left out."""
        cameras = np.array([index[name] for name in self.images if name in index], dtype=np.int64)
        return SurfacePoint(np.array(self.position_in_geo), np.array(self.cov_of_surface), cameras)


class Measurement(Product):
    """Saved measurement.

    Attributes:
        id: by which viewers know it, whatever its name.
        name: given by the user.
        kind: of the measurement.
        crs: name of the CRS of `xyz`.
        model: hash of the trained model in which it was measured.
        points: in order.
        quantities: values with their σ.
    """

    format_version: Literal[1] = 1
    id: str = Field(default_factory=new_id, pattern="^[0-9a-f]{32}$")
    name: str = Field(min_length=1, max_length=200)
    kind: Kind
    crs: str
    model: str
    points: tuple[SavedPoint, ...] = Field(min_length=1, max_length=10_000)
    quantities: tuple[SavedQuantity, ...] = ()


class SavedMeasurements:
    """Measurements that the viewers of a workspace have saved, in the order of the file.

    Args:
        folder: of the files.

    Raises:
        InputError: the file cannot be read, or holds no measurements of the viewer.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.all: tuple[Measurement, ...] = tuple(read_measurements(folder))

    def put(self, measurement: Measurement, row: int | None = None) -> None:
        """Save a measurement: in the place of the one with its id, else in a row, else as the last one.

        Raises:
            GeorefError: nothing was saved, and why.
        """

        def with_it(found: list[Measurement]) -> list[Measurement]:
            ids = [each.id for each in found]
            if measurement.id in ids:
                found[ids.index(measurement.id)] = measurement
            else:
                found.insert(len(found) if row is None else row, measurement)
            return found

        self._change(with_it)

    def remove(self, measurement: Measurement) -> None:
        """Remove a measurement.

        Raises:
            GeorefError: nothing was removed, and why.
        """
        self._change(lambda found: [each for each in found if each.id != measurement.id])

    def _change(self, changed: Callable[[list[Measurement]], list[Measurement]]) -> None:
        with changing(self._folder):
            measurements = changed(read_measurements(self._folder))
            replace_texts(
                {
                    self._folder / MEASUREMENTS: features_text([_feature(each) for each in measurements]),
                    self._folder / TABLE: _table(measurements),
                }
            )
        self.all = tuple(measurements)


def _table(measurements: Sequence[Measurement]) -> str:
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


def read_measurements(folder: Path) -> list[Measurement]:
    """Return the saved measurements of a folder; none without a file.

    Raises:
        InputError: the file cannot be read, or holds no measurements of the viewer; names the feature.
    """
    path = folder / MEASUREMENTS
    if not path.exists():
        return []
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(f"is larger than {_MOST_BYTES >> 20} MiB: move it away", path=path)
    try:
        document = json.loads(path.read_text("utf-8"))
        features = document["features"]
        measurements = [each["properties"]["georef"] for each in features]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("is no file of saved measurements: move it away", path=path) from error
    read = []
    for number, each in enumerate(measurements):
        try:
            read.append(Measurement.model_validate(each))
        except ValidationError as error:
            first = error.errors()[0]
            field = f"features[{number}].properties.georef." + ".".join(map(str, first["loc"]))
            raise InputError(f"{first['msg']}: move the file away", path=path, field=field) from error
    return read


def _feature(measurement: Measurement) -> Json:
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
