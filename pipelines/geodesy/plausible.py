"""Whether coordinates can be of a CRS: degrees in a projection, swapped axes and wrong zones are caught."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geodesy.enu import lla_from_ecef

# Surveys lawfully run over the border of their zone; further than this from it the CRS is a mistake.
_AREA_MARGIN_DEG = 3.0
# A projection with false coordinates beyond this has no points at its zero; a site's own grid may.
_FALSE_ORIGIN_M = 100_000.0


@dataclass(frozen=True)
class ListedPoints:
    """Points (N, 3) of a CRS and where they stand, to blame the right one."""

    points: FloatArray
    crs_name: str
    path: Path | str | None = None
    lines: Sequence[int] | None = None

    def require(self, accepted: ArrayLike, code: str, fault: str, field: str | None = None) -> None:
        """Raise an InputError for the first point that is not accepted (N,); the fault is said of the point."""
        good = np.asarray(accepted)
        if good.all():
            return
        worst = int(np.argmin(good))
        text = ", ".join(f"{value:.10g}" for value in self.points[worst])
        count = int((~good).sum())
        more = f" {count} points are so." if count > 1 else ""
        line = self.lines[worst] if self.lines is not None else None
        raise InputError(code, f"Point ({text}) {fault}.{more}", path=self.path, line=line, field=field)


def horizontal_of(crs: CRS) -> CRS:
    """Return a compound CRS's horizontal part; any other CRS itself."""
    return crs.sub_crs_list[0] if crs.is_compound else crs


def rough_lon_lat(crs: CRS, listed: ListedPoints) -> tuple[FloatArray, FloatArray]:
    """Return longitude and latitude (N,) from Greenwich in the CRS's own datum, within a kilometre of WGS84.

    Raises:
        InputError: a point that is not finite, out of range, in degrees where metres are due, or far outside the
            CRS's area.
    """
    points, name = listed.points, listed.crs_name
    listed.require(np.isfinite(points).all(axis=1), "point-not-finite", "is not a number")
    if crs.is_geocentric:
        lla = lla_from_ecef(points)
        listed.require(np.abs(lla[:, 2]) < 1e5, "point-not-on-earth", f"is not near the Earth's surface in {name}")
        return lla[:, 1], lla[:, 0]
    horizontal = horizontal_of(crs)
    geodetic = horizontal.geodetic_crs or horizontal
    if horizontal.is_geographic:
        lon, lat = _from_greenwich(geodetic, points[:, 0], points[:, 1])
        order = f"(x is the longitude in {name}, y the latitude)"
        listed.require(
            np.abs(lat) <= 90.0, "latitude-range", f"has a latitude out of −90 … 90° {order}", "latitude"
        )
        listed.require(np.abs(lon) <= 360.0, "longitude-range", "has a longitude out of −180 … 180°", "longitude")
    else:
        to_degrees = Transformer.from_crs(horizontal, geodetic, always_xy=True)
        lon, lat = _from_greenwich(geodetic, *to_degrees.transform(points[:, 0], points[:, 1]))
        listed.require(np.isfinite(lon + lat), "point-outside-domain", f"is outside the domain of {name}")
        degrees = _look_like_degrees(horizontal, points, lon, lat)
        listed.require(
            ~degrees, "degrees-in-projection", f"seems to be in degrees, but {name} has eastings and northings"
        )
    check_area(crs, lon, lat, listed)
    return lon, lat


def check_area(crs: CRS, lon: FloatArray, lat: FloatArray, listed: ListedPoints) -> None:
    """Refuse points at `lon`, `lat` (N,) more than 3° outside the CRS's area of use, if it has one."""
    area = horizontal_of(crs).area_of_use
    if area is not None:
        bounds = f"{area.south:g} … {area.north:g}° N, {area.west:g} … {area.east:g}° E"
        fault = f"is far outside the area of {listed.crs_name} ({bounds}): the CRS is wrong, or x and y are swapped"
        listed.require(within_area(horizontal_of(crs), lon, lat, _AREA_MARGIN_DEG), "point-outside-area", fault)


def _from_greenwich(geodetic: CRS, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return degrees from Greenwich: old surveys count grads from Paris, or degrees from Ferro."""
    meridian, unit = geodetic.prime_meridian, np.degrees(geodetic.axis_info[0].unit_conversion_factor)
    shift = 0.0 if meridian is None else meridian.longitude * np.degrees(meridian.unit_conversion_factor)
    return np.asarray(x * unit + shift), np.asarray(y * unit)


def _look_like_degrees(projected: CRS, points: FloatArray, lon: FloatArray, lat: FloatArray) -> BoolArray:
    """Return which points (N,) of a projection are as small as degrees, far from where its metres can be."""
    small = (np.abs(points[:, 0]) <= 180.0) & (np.abs(points[:, 1]) <= 90.0)
    if projected.area_of_use is not None:
        return np.asarray(small & ~within_area(projected, lon, lat, 0.0))
    conversion = (projected.source_crs or projected if projected.is_bound else projected).coordinate_operation
    false_origin_m = [
        abs(float(parameter.value) * parameter.unit_conversion_factor)
        for parameter in ([] if conversion is None else conversion.params)
        if "asting" in parameter.name or "orthing" in parameter.name
    ]
    return small & (max(false_origin_m, default=0.0) > _FALSE_ORIGIN_M)


def within_area(horizontal: CRS, lon: FloatArray, lat: FloatArray, margin_deg: float = 0.0) -> BoolArray:
    """Return whether places (N,) in degrees lie in the area of use of a CRS or beside it; unknown: all."""
    area = horizontal.area_of_use
    if area is None:
        return np.ones(len(lon), dtype=bool)
    width = (area.east - area.west) % 360.0 or 360.0
    return np.asarray(
        ((lon - area.west + margin_deg) % 360.0 <= width + 2 * margin_deg)
        & (lat >= area.south - margin_deg)
        & (lat <= area.north + margin_deg)
    )
