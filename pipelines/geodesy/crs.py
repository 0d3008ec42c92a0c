"""Coordinate reference systems: points from any that PROJ knows to WGS84 and back, and the axes of map grids.

The only module that thinks about axis order: `xyz` here is always easting or longitude first, as in ODM's files and
PROJ's visualisation order; `lla` is latitude first, as everywhere else.

One operation serves all points of a call, or neighbours on two sides of an operation's border would be torn apart
by metres. `pipelines.geodesy.operations` chooses it, and refuses where a grid is missing.

PROJ strings, WKT and PROJJSON may name files of grids, triangulations and definitions, and PROJ opens any path:
such texts are refused before PROJ sees them. A grid that PROJ finds by its bare name, in its own folders, is
accepted.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.enums import TransformDirection
from pyproj.exceptions import CRSError, ProjError

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geodesy.crs_names import code_of_name, nearest_crs
from pipelines.geodesy.enu import ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from pipelines.geodesy.operations import Operation, OperationRequest, best_operation, proj_errors
from pipelines.geodesy.plausible import ListedPoints, check_area, horizontal_of, rough_lon_lat
from pipelines.geodesy.vertical import ELLIPSOIDAL, NAME_OF_EPSG, VerticalChoice, VerticalDatum

_BARE_NAME = re.compile(r"[\w.-]+")
_GRIDS = re.compile(r'(?<!\w)\w*grids?\s*=\s*"?([^\s"]*)', re.IGNORECASE)
_FILES = re.compile(r"(?<!\w)(?:init|file|catalog)\s*=", re.IGNORECASE)
_PIPELINE = re.compile(r"(?<!\w)(?:proj\s*=\s*pipeline|\+step)(?!\w)", re.IGNORECASE)
_WKT_FILE = re.compile(r"PARAMETERFILE", re.IGNORECASE)
_WKT_FILE_NAME = re.compile(r'PARAMETERFILE\s*[\[(]\s*"[^"]*"\s*,\s*"([^"]*)"', re.IGNORECASE)
ECEF = "EPSG:4978"
_MAX_TEXT = 20_000
_LONGEST_NAME = 80  # of a CRS that is looked for among names
_ELLIPSOID_HEIGHT = (
    'VERT_CS["Ellipsoid (metre)",VERT_DATUM["Ellipsoid",2002],UNIT["metre",1,AUTHORITY["EPSG","9001"]],'
    'AXIS["Up",UP]]'
)
_UTM = re.compile(r"WGS\s?84\s*/?\s*UTM(?:\s+zone)?\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
LOCAL_FRAME = "local metric frame, not on Earth"
_LOCAL = (
    'ENGCRS["{name}",EDATUM["local"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],AXIS["z",up],'
    'LENGTHUNIT["metre",1]]'
)
_STEP_M = 10.0  # long against the rounding of eastings and northings, short against the curvature of a grid
_SHORT_UNIT = {"metre": "m", "degree": "°"}


@dataclass(frozen=True)
class PointCrs:
    """CRS of the three coordinates of a file's points."""

    name: str  # as the file or option gave it, spaces tidied
    vertical: VerticalDatum  # datum of the heights
    states_vertical: bool  # whether the CRS itself has that datum (compound, 3D or geocentric)
    height_unit: str
    _crs: CRS = field(repr=False)
    _height_unit_m: float = field(repr=False)
    _three_dimensional: bool = field(repr=False)
    _chosen: tuple[Transformer, Operation] | None = field(default=None, repr=False, compare=False)

    @property
    def is_geographic(self) -> bool:
        """Whether the horizontal coordinates are angles."""
        return horizontal_of(self._crs).is_geographic

    @property
    def is_geocentric(self) -> bool:
        """Whether the coordinates are Earth-centred, without a map plane and heights."""
        return self._crs.is_geocentric

    @property
    def _plan_axes(self) -> list[Any]:
        source = self._crs.source_crs if self._crs.is_bound else None
        return list(horizontal_of(source or self._crs).axis_info[:2])

    @property
    def northing_first(self) -> bool:
        """Whether the register has the northing or latitude first, and the easting or longitude second."""
        return [axis.direction.lower() for axis in self._plan_axes] == ["north", "east"]

    @property
    def units(self) -> tuple[str, str, str]:
        first, second = (axis.unit_name for axis in self._plan_axes)
        return first, second, self.height_unit

    @property
    def short_units(self) -> tuple[str, str, str]:
        first, second, third = (_SHORT_UNIT.get(unit, unit) for unit in self.units)
        return first, second, third

    @property
    def height_unit_m(self) -> float:
        """Unit of the heights in metres."""
        axes = self._crs.axis_info
        if self._three_dimensional and len(axes) == 3:
            return float(axes[2].unit_conversion_factor)
        return self._height_unit_m

    @property
    def horizontal_unit(self) -> float:
        """Unit of the horizontal coordinates in metres; of a geographic CRS in radians."""
        return float(self._plan_axes[0].unit_conversion_factor)

    @property
    def read_as(self) -> str | None:
        """Name and code in the register, where the text is a name that is spelled otherwise there; else None."""
        text, registered = self.name.casefold(), self._crs.name.casefold()
        is_name = not any(sign in text for sign in ":+=[{") and not text.isdigit() and len(text) <= _LONGEST_NAME
        alike = text == registered or (self.is_geographic and text.replace(" ", "") == registered.replace(" ", ""))
        epsg = self._crs.to_epsg() if is_name and not alike and not _UTM.fullmatch(self.name) else None
        return None if epsg is None else f"{self._crs.name} (EPSG:{epsg})"

    @property
    def wkt(self) -> str:
        """As WKT2:2019."""
        return str(self._crs.to_wkt("WKT2_2019"))

    def with_heights(self) -> tuple[str, float]:
        """Return WKT2:2019 with three axes, and the metres in a unit of its heights.

        The CRS of a map alone gets heights above its ellipsoid, whose unit may be another than `height_unit_m`.
        """
        crs = self._crs if self._crs.is_compound or self._crs.is_bound else self._crs.to_3d()
        axes = crs.axis_info
        unit_m = float(axes[2].unit_conversion_factor) if len(axes) == 3 else self.height_unit_m
        return str(crs.to_wkt("WKT2_2019")), unit_m

    @property
    def wkt1(self) -> str:
        """As WKT1 in GDAL's dialect, for formats older than WKT2, such as LAS.

        WKT1 has no ellipsoidal heights. GDAL writes them as heights above a vertical datum of type 2002, and PROJ
        reads that as the three-dimensional CRS again.

        Raises:
            InputError: the CRS cannot be written as WKT1.
        """
        three_axes = self._three_dimensional and not self._crs.is_compound and not self._crs.is_geocentric
        try:
            if not three_axes:
                return str(self._crs.to_wkt("WKT1_GDAL"))
            flat = self._crs.to_2d().to_wkt("WKT1_GDAL")
        except CRSError as error:
            raise InputError(
                "crs-not-wkt1", f"{self.name} cannot be written as WKT1, which the file needs: {error}."
            ) from error
        return f'COMPD_CS["{self._crs.name.replace(chr(34), "")} + Ellipsoid (metre)",{flat},{_ELLIPSOID_HEIGHT}]'

    def lla_from_xyz(
        self, xyz: ArrayLike, *, path: Path | str | None = None, lines: Sequence[int] | None = None
    ) -> FloatArray:
        """Return WGS84 latitude, longitude (degrees), ellipsoidal height (m) (N, 3) of points (N, 3) in this CRS.

        The order is longitude or easting, latitude or northing, height; X, Y, Z of a geocentric CRS.

        Raises:
            InputError: a point out of range or far outside the CRS's area, a missing grid, or no transformation;
                names the file and the line of the point.
        """
        points = np.asarray(xyz, dtype=np.float64).reshape(-1, 3)
        if not len(points):
            return points
        listed = ListedPoints(points, self.name, path, lines)
        height = points[:, 2] * (1.0 if self._three_dimensional else self._height_unit_m)
        with proj_errors(self.name, path):
            lon, lat = self._rough_lon_lat(listed)
            transformer, _ = self._operation(lon, lat, path)
            x, y, z = transformer.transform(points[:, 0], points[:, 1], height)
        lla = np.stack([y, x, z if self._three_dimensional else height], axis=-1)
        lla[:, 1] -= 360.0 * np.round(lla[:, 1] / 360.0)
        listed.require(
            np.isfinite(lla).all(axis=1), "point-outside-domain", f"is outside the domain of {self.name}"
        )
        return lla

    def _rough_lon_lat(self, listed: ListedPoints) -> tuple[FloatArray, FloatArray]:
        """Return degrees as `rough_lon_lat`; a name of angles is answered with systems that the points fit."""
        try:
            return rough_lon_lat(self._crs, listed)
        except InputError as error:
            if error.code not in ("latitude-range", "longitude-range") or len(self.name) > _LONGEST_NAME:
                raise
            near = nearest_crs(self.name, listed.points)
            if not near:
                raise
            message = f"{error.message} {self.name} is {self._crs.name}, whose coordinates are angles.{near}"
            raise InputError(error.code, message, path=error.path, line=error.line, field=error.field) from error

    def xyz_from_lla(self, lla: ArrayLike) -> FloatArray:
        """Return points (N, 3) in this CRS of WGS84 latitude, longitude, ellipsoidal height (N, 3).

        Raises:
            InputError: a point far outside the CRS's area or domain, a missing grid, or no transformation.
        """
        points = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
        if not len(points):
            return points
        listed = ListedPoints(points, self.name)
        listed.require(np.isfinite(points).all(axis=1), "point-not-finite", "is not a number")
        with proj_errors(self.name):
            check_area(self._crs, points[:, 1], points[:, 0], listed)
            transformer, _ = self._operation(points[:, 1], points[:, 0])
            x, y, z = _inverse(transformer, points[:, 1], points[:, 0], points[:, 2])
        if not self._three_dimensional:
            # PROJ's horizontal datum shifts take a height for one above their source ellipsoid, which is another
            # one on the way back: millimetres apart. The way to WGS84 defines the points of a file.
            lon, lat, _ = transformer.transform(x, y, points[:, 2])
            off = points[:, 1] - lon
            off -= 360.0 * np.round(off / 360.0)
            x, y, _ = _inverse(transformer, points[:, 1] + off, 2 * points[:, 0] - lat, points[:, 2])
            z = points[:, 2] / self._height_unit_m
        xyz = np.stack([x, y, z], axis=-1)
        listed.require(
            np.isfinite(xyz).all(axis=1), "point-outside-domain", f"is outside the domain of {self.name}"
        )
        return xyz

    def operation(self, lla: ArrayLike) -> Operation:
        """Return the transformation that serves points `lla` (N, 3), for the record; raises as `lla_from_xyz`."""
        points = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
        return self._operation(points[:, 1], points[:, 0])[1]

    def serving(self, lla: ArrayLike) -> PointCrs:
        """Return the same CRS with the operation for points `lla` (N, 3) fixed for every later call.

        No step then lies between points of different calls. Raises as `xyz_from_lla`.
        """
        self.xyz_from_lla(lla)
        points = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
        return replace(self, _chosen=self._operation(points[:, 1], points[:, 0]))

    def _operation(
        self, lon: FloatArray, lat: FloatArray, path: Path | str | None = None
    ) -> tuple[Transformer, Operation]:
        if self._chosen is not None:
            return self._chosen
        request = OperationRequest(self._crs, self.name, self._three_dimensional, path)
        return best_operation(request, lon, lat)


class _LocalFrame(PointCrs):
    """Coordinates of a local metric frame: no CRS, so that no file with them claims a place on Earth."""

    @property
    def wkt(self) -> str:
        return ""

    def with_heights(self) -> tuple[str, float]:
        return str(self._crs.to_wkt("WKT2_2019")), 1.0

    @property
    def wkt1(self) -> str:
        return ""

    def lla_from_xyz(
        self, xyz: ArrayLike, *, path: Path | str | None = None, lines: Sequence[int] | None = None
    ) -> FloatArray:
        raise InputError(
            "not-on-earth", f"The coordinates are in a {self.name}: they have no latitude and longitude."
        )

    def xyz_from_lla(self, lla: ArrayLike) -> FloatArray:
        raise InputError("not-on-earth", f"The survey is in a {self.name}: no place on Earth can be shown in it.")


def local_frame() -> PointCrs:
    """Return what stands for the CRS of a local metric frame: names and units, without a text for files."""
    return _LocalFrame(
        name=LOCAL_FRAME,
        vertical=VerticalDatum(name="local frame", stated=True),
        states_vertical=True,
        height_unit="metre",
        _crs=CRS.from_wkt(_LOCAL.format(name=LOCAL_FRAME)),
        _height_unit_m=1.0,
        _three_dimensional=True,
    )


def _inverse(
    transformer: Transformer, lon: FloatArray, lat: FloatArray, height: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    x, y, z = transformer.transform(lon, lat, height, direction=TransformDirection.INVERSE)
    return x, y, z


def with_authority(text: str) -> str:
    """Return the text of a CRS; bare numbers, as of `32632` or `32632+5773`, are codes of EPSG."""
    name = " ".join(text.split())
    return f"EPSG:{name}" if re.fullmatch(r"\d{4,6}(\+\d{4,6})?", name) else name


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

    Raises:
        InputError: not a CRS, or not one of points on Earth; names the file and line in which it stands, or the
            field or option.
    """
    name = with_authority(text)
    refusal = partial(InputError, path=path, line=line, field=field)
    try:
        crs = _parse(name, refusal)
        if not (crs.is_geographic or crs.is_projected or crs.is_geocentric):
            raise refusal(
                "crs-not-of-points", f"{_short(name)} is a {crs.type_name}, which has no points on Earth."
            )
        return _point_crs(crs, name, vertical)
    except ProjError as error:  # of a CRS that PROJ reads, but whose parts it does not combine
        raise refusal("crs-unusable", f"PROJ cannot use {_short(name)!r}: {error}.") from error


def proj_crs(text: str, *, path: Path | str | None = None, field: str | None = None) -> CRS:
    """Return what PROJ makes of the text of a CRS, of points or not; an InputError: none, or it opens files."""
    refusal = partial(InputError, path=path, field=field)
    name = with_authority(text)
    try:
        return _parse(name, refusal)
    except ProjError as error:
        raise refusal("crs-unusable", f"PROJ cannot use {_short(name)!r}: {error}.") from error


def _point_crs(crs: CRS, name: str, vertical: VerticalChoice | None) -> PointCrs:
    axes = (crs.source_crs or crs if crs.is_bound else crs).axis_info
    short = _short(name)
    if len(axes) == 3:
        stated = VerticalDatum(name=ELLIPSOIDAL, stated=True, note=f"part of {short}")
        if crs.is_compound:
            upright = crs.sub_crs_list[1]
            epsg = upright.to_epsg()
            datum = upright.name if epsg is None else NAME_OF_EPSG.get(epsg, f"EPSG:{epsg}")
            stated = VerticalDatum(name=datum, stated=True, note=f"{upright.name}, part of {short}")
        return PointCrs(short, stated, True, axes[2].unit_name, crs, 1.0, True)
    if vertical is not None and vertical.epsg is not None:
        upright = _vertical_crs(vertical)
        whole = CompoundCRS(f"{crs.name} + {upright.name}", [crs, upright])
        stated = VerticalDatum(name=vertical.name, stated=True, note="--vertical")
        return PointCrs(short, stated, False, upright.axis_info[0].unit_name, whole, 1.0, True)
    note = "--vertical" if vertical is not None else f"{short} says nothing of heights"
    datum_of = VerticalDatum(name=ELLIPSOIDAL, stated=vertical is not None, note=note)
    geographic = horizontal_of(crs).is_geographic
    unit = ("metre", 1.0) if geographic else (axes[0].unit_name, axes[0].unit_conversion_factor)
    return PointCrs(short, datum_of, False, unit[0], crs, unit[1], False)


def _parse(name: str, refusal: Callable[..., InputError]) -> CRS:
    if len(name) > _MAX_TEXT:
        raise refusal("crs-too-long", f"The text of a CRS has at most {_MAX_TEXT} characters, not {len(name)}.")
    file = file_in(name)
    if file is not None:
        raise refusal(
            "crs-opens-file",
            f"{_short(file)!r} would open a file.",
            remedy="Give EPSG:n, or a grid by its bare name in PROJ's own folders.",
        )
    utm = _UTM.fullmatch(name)
    if utm:
        zone, south = int(utm[1]), utm[2].upper() == "S"
        if not 1 <= zone <= 60:
            raise refusal("utm-zone", f"UTM has zones 1 to 60, not {zone}.")
        return CRS.from_epsg((32700 if south else 32600) + zone)
    try:
        return CRS.from_user_input(name)
    except CRSError as error:
        is_name = len(name) <= _LONGEST_NAME and not any(sign in name for sign in "+=[{")
        code = code_of_name(name) if is_name else None
        if code is not None:
            return CRS.from_epsg(code)
        near = nearest_crs(name) if is_name else ""
        raise refusal(
            "crs-unknown",
            f"PROJ knows no CRS {_short(name)!r}.{near} Give EPSG:n, EPSG:n+m, a PROJ string, WGS84 UTM 16N or "
            "WKT.",
        ) from error


def _vertical_crs(choice: VerticalChoice) -> CRS:
    try:
        crs = CRS.from_user_input(f"EPSG:{choice.epsg}")
    except CRSError as error:
        raise InputError("vertical-crs-unknown", f"PROJ knows no {choice.name}.", field="--vertical") from error
    if not crs.is_vertical or crs.is_compound:
        raise InputError(
            "not-a-vertical-crs", f"{choice.name} ({crs.name}) is no vertical CRS.", field="--vertical"
        )
    return crs


def _short(name: str) -> str:
    return name if len(name) <= 120 else name[:117] + "…"


def grid_from_enu(crs: PointCrs, lla: ArrayLike) -> FloatArray:
    """Return rotations (n, 3, 3) from true East-North-Up to the axes of a CRS, at places `lla` (n, 3).

    The third axis stays up, along the normal of the ellipsoid. The first two are the directions in which the first
    and the second coordinate grow. In a projection that is not conformal they are not at right angles: the result
    is the rotation nearest to them. A CRS without a grid (angles, or geocentric) has the axes of true
    East-North-Up.

    Raises:
        InputError: the axes of the CRS are left-handed, or a place lies outside its domain.
    """
    places = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
    rotations = np.tile(np.eye(3), (len(places), 1, 1))
    if crs.is_geographic or crs.is_geocentric or not len(places):
        return rotations
    left, _, right = np.linalg.svd(_grid_by_enu(crs, places))
    rotations[:, :2, :2] = left @ right
    if (np.linalg.det(rotations) < 0).any():
        raise InputError(
            "axes-left-handed",
            f"The axes of {crs.name} are left-handed, and angles of cameras are not defined in them.",
            remedy="Give a CRS with easting and northing.",
        )
    return rotations


def grid_scale(crs: PointCrs, lla: ArrayLike) -> FloatArray:
    """Return the lengths (n,) in metres on a map of a metre on the ground, at places `lla` (n, 3).

    It is the mean of both directions, and counts the height above the ellipsoid.
    """
    singular = np.linalg.svd(_grid_by_enu(crs, np.asarray(lla, dtype=np.float64)), compute_uv=False)
    return np.asarray(singular.mean(axis=1) * crs.horizontal_unit)


def _grid_by_enu(crs: PointCrs, places: FloatArray) -> FloatArray:
    """Return the change (n, 2, 2) of easting and northing by a metre to the true east and north of places."""
    axes = ecef_from_enu_rotation(places)
    steps = _STEP_M * np.stack([axes[..., 0], -axes[..., 0], axes[..., 1], -axes[..., 1]])
    moved = crs.xyz_from_lla(lla_from_ecef(ecef_from_lla(places) + steps).reshape(-1, 3)).reshape(4, -1, 3)
    return np.stack([moved[0] - moved[1], moved[2] - moved[3]], axis=-1)[:, :2] / (2 * _STEP_M)


def file_in(text: str) -> str | None:
    """Return the part of a CRS text that would open a file outside PROJ's own folders; None if there is none."""
    forbidden = _FILES.search(text) or _PIPELINE.search(text)
    if forbidden:
        return forbidden[0]
    for grids in _GRIDS.finditer(text):
        if not all(_is_bare(name) for name in grids[1].split(",")):
            return grids[0]
    names = _WKT_FILE_NAME.findall(text)
    if len(names) != len(_WKT_FILE.findall(text)):
        return "PARAMETERFILE"
    if text.lstrip().startswith("{"):
        names += _values(text)
    return next((name for name in names if not _is_bare(name)), None)


def _is_bare(name: str) -> bool:
    return _BARE_NAME.fullmatch(name.removeprefix("@")) is not None  # @ marks an optional grid


def _values(text: str) -> Iterator[str]:
    """Yield the texts that stand for values of parameters in PROJJSON."""
    try:
        pending: list[Any] = [json.loads(text)]
    except (ValueError, RecursionError):
        return  # PROJ refuses it, too
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            if isinstance(item.get("value"), str):
                yield item["value"]
            pending += item.values()
        elif isinstance(item, list):
            pending += item
