"""Measurements that a user has saved in the viewer: their records, and the file that holds them."""

import json
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ConfigDict, Field, ValidationError

from pipelines.core.errors import InputError
from pipelines.core.products import ImageName, Product
from pipelines.core.stages import SAVED_MEASUREMENTS
from pipelines.core.types import Matrix3, Vector3

MEASUREMENTS = Path(SAVED_MEASUREMENTS).name
Kind = Literal["point", "distance", "polyline", "area", "volume", "profile"]
CLOSED: tuple[Kind, ...] = ("area", "volume")
_MOST_BYTES = 64 << 20


@dataclass(frozen=True)
class Quantity:
    """Measured quantity with its standard deviation in the same unit; None: not known. Saved with measurements."""

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    name: str
    value: float
    sigma: float | None
    unit: str


def new_id() -> str:
    """Return a random identifier of 32 hexadecimal digits."""
    return uuid.uuid4().hex


class SavedPoint(Product):
    """Point of a measurement.

    Attributes:
        position_in_geo: metres.
        cov_of_surface: 3×3, m², of the surface alone; of rank one under a line of sight.
        images: names of the photographs that show it.
        xyz: in the CRS.
        sigma_m: east, north, up; None: not known.
        lla: latitude and longitude in degrees, ellipsoidal height in metres; None: in a local frame.
    """

    position_in_geo: Vector3
    cov_of_surface: Matrix3
    images: tuple[ImageName, ...]
    xyz: Vector3
    sigma_m: Vector3 | None
    lla: Vector3 | None


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
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
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
