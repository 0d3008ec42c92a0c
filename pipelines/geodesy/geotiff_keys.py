"""Keys of GeoTIFF, as LAS files carry them: CRS, vertical datum and units by number.

Heights have two registers. OGC's GeoTIFF 1.1 (19-008r4) states a vertical CRS of EPSG. The specification of 1995,
which LAS 1.0 to 1.3 name, states ellipsoids as 5001 to 5033 (EPSG's ellipsoid minus 2000) and datums as 5101 to
5106, which are EPSG's numbers of the same datums, not of a CRS.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

from pyproj import CRS
from pyproj.crs import Ellipsoid
from pyproj.database import get_units_map, query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError

KeyValue = int | float | str

_MODEL, _GEOGRAPHIC_MODEL = 1024, 2
_CITATION, _GEOGRAPHIC, _ANGULAR_UNIT, _PROJECTED = 1026, 2048, 2054, 3072
_LINEAR_UNIT, _LINEAR_SIZE = 3076, 3077
_VERTICAL, _VERTICAL_CITATION, _VERTICAL_DATUM, _VERTICAL_UNIT = 4096, 4097, 4098, 4099
_USER_DEFINED = 32767
_ELLIPSOIDS, _EPSG_ELLIPSOIDS = range(5001, 5034), range(7001, 7100)
# Ellipsoids of frames that follow the Earth's centre, of which heights differ by less than a millimetre.
_MODERN_AXIS_M, _MODERN_FLATTENING = 6378137.0, (298.25, 298.26)
_DATUM_BY_NAME = (
    (re.compile(r"NAVD\W?(19)?88|North American Vertical Datum", re.IGNORECASE), 5703),
    (re.compile(r"NGVD\W?(19)?29|National Geodetic Vertical Datum", re.IGNORECASE), 5702),
    (re.compile(r"CGVD\W?(20)?13", re.IGNORECASE), 6647),
    (re.compile(r"CGVD\W?(19)?28", re.IGNORECASE), 5713),
    (re.compile(r"EGM\W?(20)?08", re.IGNORECASE), 3855),
    (re.compile(r"EGM\W?(19)?96", re.IGNORECASE), 5773),
    (re.compile(r"EGM\W?(19)?84", re.IGNORECASE), 5798),
)
_ELLIPSOIDAL_NAME = re.compile(r"ellipsoid", re.IGNORECASE)


@dataclass(frozen=True)
class FileCrs:
    """Statements of a file's records on its CRS, as they stand there.

    `wkt_counts`: the header has WKT decide where keys and WKT differ. `middle`: between the header's lowest and
    highest coordinates; None: not known.
    """

    wkt: str = ""
    keys: Mapping[int, KeyValue] = field(default_factory=dict)
    wkt_counts: bool = True
    middle: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Unit:
    """Unit of a coordinate; `size` in metres, or in radians."""

    name: str
    size: float

    def is_as_long_as(self, other: float) -> bool:
        return abs(self.size / other - 1) < 1e-9


@dataclass(frozen=True)
class KeyedCrs:
    """Statement of keys.

    `epsg`: horizontal CRS. `vertical_epsg`: vertical CRS; `unit_is_open`: of a datum, whose keys name no unit.
    `problem`, `vertical_problem`: what stands in place of the CRS, and cannot be used.
    """

    epsg: int | None = None
    vertical_epsg: int | None = None
    is_ellipsoidal: bool = False
    unit_is_open: bool = False
    vertical_note: str = ""
    plan_unit: Unit | None = None
    height_unit: Unit | None = None
    problem: str = ""
    vertical_problem: str = ""
    unit_problem: str = ""  # of heights


def keyed_crs(keys: Mapping[int, KeyValue]) -> KeyedCrs:
    """Return what keys of GeoTIFF say of horizontal CRS, heights, and units."""
    is_geographic = _code(keys, _MODEL) == _GEOGRAPHIC_MODEL or not _code(keys, _PROJECTED)
    code, problem = _code(keys, _GEOGRAPHIC if is_geographic else _PROJECTED), ""
    if code == _USER_DEFINED:
        citation = f" ({keys[_CITATION]})" if keys.get(_CITATION) else ""
        problem = f"GeoTIFF keys with parameters of their own{citation}, which are not read"
    if is_geographic:
        plan_unit, unit_problem = _unit(keys, _ANGULAR_UNIT, "angular")
    else:
        plan_unit, unit_problem = _unit(keys, _LINEAR_UNIT, "linear")
    height_unit, height_problem = _unit(keys, _VERTICAL_UNIT, "linear")
    vertical = _vertical(keys)
    return KeyedCrs(
        epsg=code if code not in (0, _USER_DEFINED) else None,
        vertical_epsg=vertical.vertical_epsg,
        is_ellipsoidal=vertical.is_ellipsoidal,
        unit_is_open=vertical.unit_is_open,
        vertical_note=vertical.vertical_note,
        plan_unit=plan_unit,
        height_unit=height_unit,
        problem=problem or unit_problem,
        vertical_problem=vertical.vertical_problem,
        unit_problem=height_problem,
    )


def _code(keys: Mapping[int, KeyValue], key: int) -> int:
    value = keys.get(key, 0)
    return value if isinstance(value, int) else 0


def _unit(keys: Mapping[int, KeyValue], key: int, category: str) -> tuple[Unit | None, str]:
    """Return the unit that a key states, and why it cannot be used."""
    code, size = _code(keys, key), keys.get(_LINEAR_SIZE)
    if not code:
        return None, ""
    if code == _USER_DEFINED and key == _LINEAR_UNIT and isinstance(size, float) and 0 < size < 1e6:
        return Unit(f"unit of {size:g} m", size), ""
    known = next((unit for unit in _units(category) if unit[0] == code), None)
    if known is None:
        return None, f"GeoTIFF key {key} = {code}, which is no {category} unit of EPSG"
    return Unit(known[1], known[2]), ""


@cache
def _units(category: str) -> tuple[tuple[int, str, float], ...]:
    units = get_units_map(auth_name="EPSG", category=category, allow_deprecated=True).values()
    return tuple((int(unit.code), unit.name, unit.conv_factor) for unit in units)


def _vertical(keys: Mapping[int, KeyValue]) -> KeyedCrs:
    """Return what keys say of heights alone: by the number of a CRS, of a datum, or by a name."""
    code, datum, citation = _code(keys, _VERTICAL), _code(keys, _VERTICAL_DATUM), keys.get(_VERTICAL_CITATION, "")
    found = KeyedCrs()
    for key, number in ((_VERTICAL, code), (_VERTICAL_DATUM, datum)):
        if number not in (0, _USER_DEFINED):
            found = vertical_of_code(number, f"GeoTIFF key {key} = {number}")
            if not found.vertical_problem:
                return found
    if not citation and code == _USER_DEFINED and not found.vertical_problem:
        return KeyedCrs(vertical_problem="GeoTIFF keys with a vertical CRS of their own, without a name")
    if not citation:
        return found
    text, note = str(citation), f"GeoTIFF key {_VERTICAL_CITATION} = {citation}"
    for pattern, epsg in _DATUM_BY_NAME:
        if pattern.search(text):
            return KeyedCrs(vertical_epsg=epsg, unit_is_open=True, vertical_note=note)
    if _ELLIPSOIDAL_NAME.search(text):
        return KeyedCrs(is_ellipsoidal=True, vertical_note=note)
    if code == _USER_DEFINED and not found.vertical_problem:
        return KeyedCrs(vertical_problem=f"{note}, whose datum is not known")
    return found


def vertical_of_code(code: int, note: str) -> KeyedCrs:
    """Return the heights that a number of EPSG or of GeoTIFF 1995 states; `note` says where it stands."""
    try:
        crs = CRS.from_epsg(code)
        if crs.is_vertical and not crs.is_compound:
            return KeyedCrs(vertical_epsg=code, vertical_note=note)
        if crs.is_geographic and len(crs.axis_info) == 3:
            return KeyedCrs(is_ellipsoidal=True, vertical_note=f"{note}: {crs.name}")
    except CRSError:
        pass
    number = code + 2000 if code in _ELLIPSOIDS else code
    if number in _EPSG_ELLIPSOIDS and (ellipsoid := _ellipsoid(number)) is not None:
        low, high = _MODERN_FLATTENING
        note = f"{note}: ellipsoid {ellipsoid.name}"
        is_modern = abs(ellipsoid.semi_major_metre - _MODERN_AXIS_M) < 1e-3
        if is_modern and low < ellipsoid.inverse_flattening < high:
            return KeyedCrs(is_ellipsoidal=True, vertical_note=note)
        return KeyedCrs(vertical_problem=f"{note}, heights above which are not transformed")
    if code in _vertical_by_datum():
        return KeyedCrs(vertical_epsg=_vertical_by_datum()[code], unit_is_open=True, vertical_note=note)
    return KeyedCrs(vertical_problem=f"{note}, which is no vertical CRS or datum")


def _ellipsoid(code: int) -> Ellipsoid | None:
    try:
        return Ellipsoid.from_epsg(code)
    except CRSError:
        return None


@cache
def _vertical_by_datum() -> Mapping[int, int]:
    """Return the EPSG code of the vertical CRS of each vertical datum of EPSG, heights before depths."""
    code_of: dict[int, int] = {}
    codes = sorted(int(info.code) for info in query_crs_info(auth_name="EPSG", pj_types=PJType.VERTICAL_CRS))
    for code in codes:
        crs = CRS.from_epsg(code)
        datum = crs.datum.to_json_dict().get("id", {}).get("code") if crs.datum is not None else None
        if isinstance(datum, int) and crs.axis_info[0].direction == "up":
            code_of.setdefault(datum, code)
    return code_of
