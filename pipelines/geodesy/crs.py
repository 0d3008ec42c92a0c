"""Coordinate reference systems: from any that PROJ knows to WGS84 and back, point by point.

The only module that uses pyproj, and the only one that thinks about axis order: `xyz` here is always easting or
longitude first, as in ODM's files and PROJ's visualisation order; `lla` is latitude first, as everywhere else.

PROJ would rather answer than fail: without a geoid's grid it applies a *ballpark* transformation, that is none.
Here such transformations are forbidden, and a missing grid is an error that names it. One operation serves
all points of a call, or neighbours on two sides of an operation's border would be torn apart by metres.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.datadir import get_user_data_dir
from pyproj.enums import TransformDirection
from pyproj.exceptions import CRSError
from pyproj.transformer import AreaOfInterest, TransformerGroup

from pipelines.errors import InputError
from pipelines.geodesy.enu import lla_from_ecef
from pipelines.geodesy.vertical import ELLIPSOIDAL, VerticalChoice, assumed_ellipsoidal, missing_grid_error, name_of
from pipelines.products import FloatArray, VerticalDatum

ECEF = "EPSG:4978"
WGS84 = "EPSG:4326"
_WGS84_3D = "EPSG:4979"
_MAX_TEXT = 20_000
# Surveys lawfully run over the border of their zone; further than this from it the CRS is a mistake.
_AREA_MARGIN_DEG = 3.0
_UTM = re.compile(r"WGS\s?84\s*/?\s*UTM(?:\s+zone)?\s+(\d{1,2})\s*([NS])", re.IGNORECASE)


@dataclass(frozen=True)
class Operation:
    """How PROJ gets from a CRS to WGS84.

    Attributes:
        name: PROJ's description.
        accuracy_m: as published; None if unknown.
        missing_grids: grids with which there would be a better one.
    """

    name: str
    accuracy_m: float | None
    missing_grids: tuple[str, ...]


@dataclass(frozen=True)
class PointCrs:
    """What the three coordinates of a file's points mean.

    Attributes:
        name: as the file or option gave it, spaces tidied.
        vertical: what the heights count from.
        states_vertical: whether the CRS itself said so (compound, 3D or geocentric).
        height_unit: name of the heights' unit.
    """

    name: str
    vertical: VerticalDatum
    states_vertical: bool
    height_unit: str
    _crs: CRS = field(repr=False)
    _height_unit_m: float = field(repr=False)
    _three_dimensional: bool = field(repr=False)

    @property
    def is_geographic(self) -> bool:
        """Whether the horizontal coordinates are angles."""
        return _horizontal(self._crs).is_geographic

    @property
    def wkt(self) -> str:
        """As WKT2:2019."""
        return str(self._crs.to_wkt("WKT2_2019"))

    def lla_from_xyz(
        self, xyz: ArrayLike, *, path: Path | str | None = None, lines: Sequence[int] | None = None
    ) -> FloatArray:
        """WGS84 latitude, longitude (degrees) and ellipsoidal height (m), (N, 3), of points (N, 3) in this CRS.

        Args:
            xyz: longitude or easting, latitude or northing, height; X, Y, Z of a geocentric CRS.
            path: file of the points, for errors.
            lines: its line of each point, for errors.

        Raises:
            InputError: a point out of range or far outside the CRS's area, a missing grid, or no transformation.
        """
        points = np.asarray(xyz, dtype=np.float64).reshape(-1, 3)
        if not len(points):
            return points
        rows = _Rows(points, path, lines)
        lon, lat = self._rough_lon_lat(rows)
        transformer, _ = self._transformer(lon, lat, path)
        height = points[:, 2] * (1.0 if self._three_dimensional else self._height_unit_m)
        x, y, z = transformer.transform(points[:, 0], points[:, 1], height)
        lla = np.stack([y, x, z if self._three_dimensional else height], axis=-1)
        lla[:, 1] -= 360.0 * np.round(lla[:, 1] / 360.0)
        rows.require(np.isfinite(lla).all(axis=1), f"outside the domain of {self.name}")
        return lla

    def xyz_from_lla(self, lla: ArrayLike) -> FloatArray:
        """Points (N, 3) in this CRS of WGS84 latitude, longitude, ellipsoidal height (N, 3).

        Raises:
            InputError: a missing grid, no transformation, or a point outside the CRS's domain.
        """
        points = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
        if not len(points):
            return points
        transformer, _ = self._transformer(points[:, 1], points[:, 0], None)
        x, y, z = transformer.transform(
            points[:, 1], points[:, 0], points[:, 2], direction=TransformDirection.INVERSE
        )
        height = z if self._three_dimensional else points[:, 2] / self._height_unit_m
        xyz = np.stack([x, y, height], axis=-1)
        _Rows(points).require(np.isfinite(xyz).all(axis=1), f"outside the domain of {self.name}")
        return xyz

    def operation(self, lla: ArrayLike) -> Operation:
        """The transformation that serves points `lla` (N, 3), for the record.

        Raises:
            InputError: as `lla_from_xyz`.
        """
        points = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
        return self._transformer(points[:, 1], points[:, 0], None)[1]

    def _rough_lon_lat(self, rows: _Rows) -> tuple[FloatArray, FloatArray]:
        """Longitude and latitude in the CRS's own datum (within a kilometre of WGS84), checked for sanity."""
        points = rows.points
        rows.require(np.isfinite(points).all(axis=1), "not a number")
        if self._crs.is_geocentric:
            lla = lla_from_ecef(points)
            rows.require(np.abs(lla[:, 2]) < 1e5, f"not near the Earth's surface in {self.name}")
            return lla[:, 1], lla[:, 0]
        horizontal = _horizontal(self._crs)
        x, y = points[:, 0], points[:, 1]
        if horizontal.is_geographic:
            degrees = np.degrees(horizontal.axis_info[0].unit_conversion_factor)
            lon, lat = x * degrees, y * degrees
            order = f"(in {self.name} x is the longitude, y the latitude)"
            rows.require(np.abs(lat) <= 90.0, f"latitude out of range −90 … 90 {order}", "latitude")
            rows.require(np.abs(lon) <= 360.0, "longitude out of range −180 … 180", "longitude")
        else:
            metric = (np.abs(x) > 180.0) | (np.abs(y) > 90.0)
            rows.require(metric, f"degrees? {self.name} has eastings and northings: wrong CRS")
            to_degrees = Transformer.from_crs(horizontal, horizontal.geodetic_crs, always_xy=True)
            lon, lat = to_degrees.transform(x, y)
        rows.require(np.isfinite(lon + lat), f"outside the domain of {self.name}")
        self._check_area(lon, lat, rows)
        return lon, lat

    def _check_area(self, lon: FloatArray, lat: FloatArray, rows: _Rows) -> None:
        area = _horizontal(self._crs).area_of_use
        if area is None:
            return
        width = (area.east - area.west) % 360.0 or 360.0
        inside = (
            ((lon - area.west + _AREA_MARGIN_DEG) % 360.0 <= width + 2 * _AREA_MARGIN_DEG)
            & (lat >= area.south - _AREA_MARGIN_DEG)
            & (lat <= area.north + _AREA_MARGIN_DEG)
        )
        bounds = f"{area.south:g} … {area.north:g}° N, {area.west:g} … {area.east:g}° E"
        rows.require(inside, f"far outside the area of {self.name} ({bounds}): wrong CRS, or x and y swapped?")

    def _transformer(
        self, lon: FloatArray, lat: FloatArray, path: Path | str | None
    ) -> tuple[Transformer, Operation]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "best transformation is not available": told below
            group = TransformerGroup(
                self._crs,
                _WGS84_3D if self._three_dimensional else WGS84,
                always_xy=True,
                allow_ballpark=False,
                area_of_interest=_area(lon, lat),
            )
        missing = tuple(
            dict.fromkeys(
                grid.short_name
                for operation in group.unavailable_operations[:1]
                for grid in operation.grids
                if not grid.available
            )
        )
        if group.transformers:
            best = group.transformers[0]
            accuracy = best.accuracy if best.accuracy >= 0 else None
            return best, Operation(best.description, accuracy, () if group.best_available else missing)
        if missing:
            datum = self._crs.sub_crs_list[1].name if self._crs.is_compound else self.name
            raise missing_grid_error(datum, missing, get_user_data_dir(), path)
        raise InputError(
            f"no transformation from {self.name} to WGS84 is known here: name its datum (+datum=… or +towgs84=… in "
            "a PROJ string), or give another CRS",
            path=path,
        )


@dataclass(frozen=True)
class _Rows:
    """Points (N, 3) and where they stand, to blame the right one."""

    points: FloatArray
    path: Path | str | None = None
    lines: Sequence[int] | None = None

    def require(self, accepted: ArrayLike, message: str, field: str | None = None) -> None:
        """Raise an InputError for the first point that is not accepted (N,)."""
        good = np.asarray(accepted)
        if good.all():
            return
        worst = int(np.argmin(good))
        text = ", ".join(f"{value:.10g}" for value in self.points[worst])
        count = int((~good).sum())
        more = f" ({count} such points)" if count > 1 else ""
        line = self.lines[worst] if self.lines is not None else None
        raise InputError(f"({text}): {message}{more}", path=self.path, line=line, field=field)


def parse_crs(
    text: str,
    *,
    vertical: VerticalChoice | None = None,
    path: Path | str | None = None,
    line: int | None = None,
    field: str | None = None,
) -> PointCrs:
    """Read a CRS: `EPSG:n`, `EPSG:a+b`, a PROJ string, `WGS84 UTM 16N`, WKT, or anything else PROJ understands.

    A CRS without a vertical part has heights in the unit of its eastings (metres where those are angles): above
    `vertical`, or above the WGS84 ellipsoid, which the result calls stated or assumed. A CRS that has a vertical
    part keeps it. Heights above a vertical CRS are in that CRS's unit.

    Args:
        text: the CRS.
        vertical: datum of the heights where `text` is silent.
        path: file in which it stands, for errors.
        line: its line there.
        field: or the option.

    Raises:
        InputError: not a CRS, or not one of points on Earth.
    """
    name = " ".join(text.split())
    crs = _parse(name, path, line, field)
    horizontal = _horizontal(crs)
    if not (crs.is_geographic or crs.is_projected or crs.is_geocentric):
        raise InputError(
            f"{_short(name)} is a {crs.type_name}, which places no points on Earth",
            path=path,
            line=line,
            field=field,
        )
    axes = (crs.source_crs or crs if crs.is_bound else crs).axis_info
    if len(axes) == 3:
        stated = _own_vertical(crs, _short(name))
        return PointCrs(_short(name), stated, True, axes[2].unit_name, crs, 1.0, True)
    if vertical is not None and vertical.epsg is not None:
        upright = _vertical_crs(vertical)
        whole = CompoundCRS(f"{crs.name} + {upright.name}", [crs, upright])
        stated = VerticalDatum(name=vertical.name, stated=True, note="--vertical")
        return PointCrs(_short(name), stated, False, upright.axis_info[0].unit_name, whole, 1.0, True)
    datum_of = (
        VerticalDatum(name=ELLIPSOIDAL, stated=True, note="--vertical")
        if vertical is not None
        else assumed_ellipsoidal(f"{_short(name)} says nothing of heights")
    )
    unit = ("metre", 1.0) if horizontal.is_geographic else (axes[0].unit_name, axes[0].unit_conversion_factor)
    return PointCrs(_short(name), datum_of, False, unit[0], crs, unit[1], False)


def _parse(name: str, path: Path | str | None, line: int | None, field: str | None) -> CRS:
    if len(name) > _MAX_TEXT:
        raise InputError(f"no CRS is {len(name)} characters long", path=path, line=line, field=field)
    utm = _UTM.fullmatch(name)
    if utm:
        zone, south = int(utm[1]), utm[2].upper() == "S"
        if not 1 <= zone <= 60:
            raise InputError(f"UTM has zones 1 to 60, not {zone}", path=path, line=line, field=field)
        return CRS.from_epsg((32700 if south else 32600) + zone)
    try:
        return CRS.from_user_input(name)
    except CRSError as error:
        raise InputError(
            f"{_short(name)!r} is no CRS that PROJ knows: give EPSG:n, EPSG:n+m, PROJ string, WGS84 UTM 16N or WKT",
            path=path,
            line=line,
            field=field,
        ) from error


def _own_vertical(crs: CRS, name: str) -> VerticalDatum:
    if not crs.is_compound:
        return VerticalDatum(name=ELLIPSOIDAL, stated=True, note=f"part of {name}")
    upright = crs.sub_crs_list[1]
    epsg = upright.to_epsg()
    short = upright.name if epsg is None else name_of(epsg)
    return VerticalDatum(name=short, stated=True, note=f"{upright.name}, part of {name}")


def _vertical_crs(choice: VerticalChoice) -> CRS:
    try:
        crs = CRS.from_user_input(f"EPSG:{choice.epsg}")
    except CRSError as error:
        raise InputError(f"PROJ knows no {choice.name}", field="--vertical") from error
    if not crs.is_vertical or crs.is_compound:
        raise InputError(f"{choice.name} ({crs.name}) is no vertical CRS", field="--vertical")
    return crs


def _horizontal(crs: CRS) -> CRS:
    return crs.sub_crs_list[0] if crs.is_compound else crs


def _area(lon: FloatArray, lat: FloatArray) -> AreaOfInterest | None:
    """Box around points, widened by a metre or so; None where it would straddle the date line."""
    margin = 1e-5
    west, east = float(lon.min()) - margin, float(lon.max()) + margin
    if west < -180.0 or east > 180.0 or east - west > 180.0:
        return None
    return AreaOfInterest(west, max(float(lat.min()) - margin, -90.0), east, min(float(lat.max()) + margin, 90.0))


def _short(name: str) -> str:
    return name if len(name) <= 120 else name[:117] + "…"
