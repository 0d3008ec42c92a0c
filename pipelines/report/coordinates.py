"""Coordinates in the CRS of the report, as text."""

from __future__ import annotations

from pipelines.core.types import FloatArray
from pipelines.scene.target_crs import TargetCrs

_SHORT_UNIT = {"metre": "m", "degree": "°"}

Texts = tuple[str, str, str]


def units_of(crs: TargetCrs) -> Texts:
    """Return the short units of the three coordinates."""
    first, second, third = (_SHORT_UNIT.get(unit, unit) for unit in crs.crs.units)
    return first, second, third


def axes_of(crs: TargetCrs) -> Texts:
    """Return the names of the three coordinates, easting or longitude first."""
    first, second = ("longitude", "latitude") if crs.crs.is_geographic else ("easting", "northing")
    return first, second, f"height ({crs.crs.vertical.name})"


def heads_of(crs: TargetCrs) -> Texts:
    """Return the heads of the columns of a table of coordinates: name and unit."""
    first, second, third = (f"{axis} in {unit}" for axis, unit in zip(axes_of(crs), units_of(crs), strict=True))
    return first, second, third


def texts_of(crs: TargetCrs, point_in_geo: FloatArray) -> list[Texts]:
    """Return the coordinates of points (N, 3) in `geo` as text.

    Raises:
        InputError: a point lies outside the domain of the CRS.
    """
    if not len(point_in_geo):
        return []
    units = units_of(crs)
    return [
        (coordinate(x, units[0]), coordinate(y, units[1]), coordinate(z, units[2]))
        for x, y, z in crs.xyz_from_geo(point_in_geo).tolist()
    ]


def coordinate(value: float, unit: str) -> str:
    """Return a coordinate as text: 1e-7° is 1 cm, other units have three decimals."""
    return f"{value:.{7 if unit == '°' else 3}f}".replace("-", "−")
