"""Saved measurements: a GeoJSON file that is read again, and the same as CSV for tables.

The points are stored in `geo` with the covariance of the surface and the photographs that show them, so that σ of
what is made of several measurements is again the joint one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from pipelines.core.errors import InputError
from pipelines.core.products import ImageName, Product
from pipelines.core.types import Matrix3, Vector3
from pipelines.formats.csv_writer import write_table
from pipelines.formats.geojson import Json, feature, write_features
from pipelines.view.surface_points import SurfacePoint

MEASUREMENTS, TABLE = "measurements.geojson", "measurements.csv"
Kind = Literal["point", "distance", "polyline", "area", "volume"]
_MOST_BYTES = 64 << 20
_COLUMNS = ("name", "kind", "vertex", "x", "y", "z", "crs", "sigma_e_m", "sigma_n_m", "sigma_u_m")


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
        name: given by the user.
        kind: of the measurement.
        crs: name of the CRS of `xyz`.
        model: hash of the trained model in which it was measured.
        points: in order.
        quantities: values with their σ.
    """

    format_version: Literal[1] = 1
    name: str = Field(min_length=1, max_length=200)
    kind: Kind
    crs: str
    model: str
    points: tuple[SavedPoint, ...] = Field(min_length=1, max_length=10_000)
    quantities: tuple[SavedQuantity, ...] = ()


def write_measurements(folder: Path, measurements: Sequence[Measurement]) -> None:
    """Write measurements as GeoJSON and CSV; each file appears whole or not at all.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_features(folder / MEASUREMENTS, [_feature(each) for each in measurements])
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
    write_table(folder / TABLE, (_COLUMNS, *points, (), named, *quantities))


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
