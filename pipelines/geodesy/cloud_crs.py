"""CRS, datum and units of a cloud, by the statements of its file and of the user.

1. `--lidar-crs` overrules the file's horizontal CRS and the unit of its eastings; its vertical part, or
   `--lidar-vertical`, overrules the file's datum. A remark names what was overruled.
2. In the file, the header's WKT bit says whether WKT or the keys of GeoTIFF count; a remark names where they
   differ. What stands in the other one alone (a datum, the unit of heights) is used.
3. A unit that keys state beside a CRS is that of the coordinates. Units of keys and WKT that differ are refused,
   and so are the two feet where it is open which: they lie metres apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError

from pipelines.core.errors import InputError
from pipelines.core.products import Remark
from pipelines.core.types import FloatArray
from pipelines.geodesy.crs import PointCrs, parse_crs, proj_crs
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.geodesy.geotiff_keys import FileCrs, Unit, keyed_crs
from pipelines.geodesy.vertical import ELLIPSOIDAL, NAME_OF_EPSG, VerticalChoice, VerticalDatum

_SAME_PLACE_M = 0.01
_SAME = 1e-9  # relative difference of one unit in two registers
_NEARLY = 1e-4  # relative difference of units that no glance at the coordinates tells apart: the two feet
_KEYS, _WKT = "GeoTIFF keys", "WKT"


@dataclass(frozen=True)
class PlacedCrs:
    """CRS of a cloud, and the factors that turn coordinates, easting or longitude first, into its units."""

    crs: PointCrs
    scale: FloatArray = field(default_factory=lambda: np.ones(3))  # (3,)
    remarks: tuple[Remark, ...] = ()


@dataclass(frozen=True)
class _Statement:
    """Statement of one source. `vertical` without a horizontal CRS, and the reverse, are possible."""

    source: str
    horizontal: str = ""  # text of PROJ
    name: str = ""
    whole: str = ""  # text with its heights, where PROJ reads both as one
    vertical: CRS | None = None
    is_ellipsoidal: bool = False
    unit_is_open: bool = False
    vertical_note: str = ""
    plan_unit: Unit | None = None
    height_unit: Unit | None = None
    problem: str = ""
    vertical_problem: str = ""
    unit_problem: str = ""  # of heights
    is_unreadable: bool = False

    @property
    def has_heights(self) -> bool:
        return self.vertical is not None or self.is_ellipsoidal

    @property
    def datum(self) -> str:
        return _datum_name(self.vertical) if self.vertical is not None else ELLIPSOIDAL

    @property
    def stated_height_unit(self) -> Unit | None:
        """Unit of the heights if this source states it, by itself or by its vertical CRS."""
        if self.height_unit is None and self.vertical is not None and not self.unit_is_open:
            axis = self.vertical.axis_info[0]
            return Unit(axis.unit_name, axis.unit_conversion_factor)
        return self.height_unit


_NOTHING = _Statement("")


def place_crs(
    said: FileCrs, path: Path, *, crs: str | None = None, vertical: VerticalChoice | None = None, flag: str
) -> PlacedCrs:
    """Return the CRS of a file's points, by the rules of this module.

    Args:
        said: what the file's records say.
        crs, vertical: what the user says, by the options `--lidar-crs` and `--lidar-vertical` of the `flag`
            `--lidar`.

    Raises:
        InputError: no CRS, one that PROJ cannot use, a datum that is not known, or units that disagree.
    """
    return _Placing(said, path, crs, vertical, flag).result()


class _Placing:
    """One file, its statements in the order in which they count, and the remarks on it."""

    def __init__(
        self, said: FileCrs, path: Path, crs: str | None, vertical: VerticalChoice | None, flag: str
    ) -> None:
        self._flag, self._path, self._middle, self._choice = flag, path, said.middle, vertical
        self._option = _NOTHING
        if crs is not None:
            option = f"{flag}-crs"
            self._option = _of_text(crs, option, field=option)
            if self._option.problem:
                parse_crs(crs, field=option)  # the error of what is no CRS of points
        by_bit = [_of_keys(said), _of_wkt(said, path)]
        self._sources = [one for one in (by_bit[::-1] if said.wkt_counts else by_bit) if one is not _NOTHING]
        self._remarks: list[Remark] = []

    def result(self) -> PlacedCrs:
        file = next((one for one in self._sources if one.horizontal), _NOTHING)
        plan = self._option if self._option.horizontal else file
        if not plan.horizontal:
            raise self._without_crs()
        for one in self._sources:
            if one.is_unreadable and self._option is _NOTHING:
                self._remark(
                    "crs-unreadable",
                    f"{self._path.name}: its {one.source} cannot be read, its {plan.source} count: {one.problem}",
                )
        self._compare_plans(file)
        self._check_units()
        crs, heights = self._with_heights(plan)
        plan_unit = None if plan is self._option else plan.plan_unit
        across = self._plan_scale(crs, plan, plan_unit)
        scale = np.array([across, across, self._height_scale(crs, heights, across)])
        return PlacedCrs(_named(crs, scale, plan_unit), scale, tuple(self._remarks))

    def _without_crs(self) -> InputError:
        problems = ", and ".join(f"{one.source}: {one.problem}" for one in self._sources if one.problem)
        what = f"states no CRS of places on Earth ({problems})" if problems else "states no CRS"
        return InputError(
            "crs-unknown",
            f"{what}.",
            path=self._path,
            field=self._flag,
            remedy=f"Give {self._flag}-crs EPSG:n, or EPSG:n+m with the vertical CRS.",
        )

    def _remark(self, kind: str, sentence: str, remedy: str = "") -> None:
        code = f"{self._flag.removeprefix('--')}-{kind}"
        self._remarks.append(Remark(code=code, sentence=sentence, remedy=remedy))

    def _compare_plans(self, file: _Statement) -> None:
        """Note a CRS of the file that is overruled, and two of one file that differ."""
        if self._option.horizontal and file.horizontal and self._differ(self._option, file):
            self._remark(
                "crs-overrules",
                f"{self._path.name}: the stated CRS, {_crs_text(self._option)}, overrules the CRS of the file's "
                f"{file.source}, {_crs_text(file)}.",
            )
        others = [one for one in self._sources if one.horizontal and one is not file]
        if not self._option.horizontal and others and self._differ(file, others[0]):
            self._remark(
                "crs-disagrees",
                f"{self._path.name}: its {file.source} state {_crs_text(file)}, its {others[0].source} "
                f"{_crs_text(others[0])}. The header's WKT bit has the {file.source} count.",
                f"{self._flag}-crs overrules both.",
            )

    def _differ(self, one: _Statement, other: _Statement) -> bool:
        """Return whether two statements place the middle of the cloud differently."""
        if one.horizontal == other.horizontal and one.plan_unit == other.plan_unit:
            return False
        places = [self._middle_in_lla(statement) for statement in (one, other)]
        if places[0] is None or places[1] is None:
            try:
                first, second = CRS.from_user_input(one.horizontal), CRS.from_user_input(other.horizontal)
            except CRSError:  # A text that is no CRS is refused where it is used.
                return True
            epsg = first.to_epsg()
            same = first.equals(second, ignore_axis_order=True) or (epsg is not None and epsg == second.to_epsg())
            return not same or (places[0] is None) != (places[1] is None)
        return float(np.linalg.norm(places[0] - places[1])) > _SAME_PLACE_M

    def _middle_in_lla(self, statement: _Statement) -> FloatArray | None:
        if self._middle is None:
            return None
        try:
            crs = parse_crs(statement.horizontal)
            unit = 1.0 if statement.plan_unit is None else statement.plan_unit.size / crs.horizontal_unit
            lla = crs.lla_from_xyz([[self._middle[0] * unit, self._middle[1] * unit, 0.0]])
        except InputError:
            return None
        return np.asarray(ecef_from_lla(lla)[0])

    def _check_units(self) -> None:
        """Refuse units of keys and WKT that differ, unless the user states the CRS."""
        if self._option.horizontal or len(self._sources) < 2:
            return
        keys, wkt = sorted(self._sources, key=lambda one: one.source != _KEYS)
        pairs = [("heights", keys.stated_height_unit, wkt.stated_height_unit, _NEARLY)]
        if keys.plan_unit is not None and wkt.horizontal:
            crs = parse_crs(wkt.horizontal, path=self._path)
            pairs.append(("the map", keys.plan_unit, Unit(crs.units[0], crs.horizontal_unit), _SAME))
        for what, of_keys, of_wkt, most in pairs:
            if of_keys is not None and of_wkt is not None and abs(of_keys.size / of_wkt.size - 1) > most:
                raise InputError(
                    "cloud-units-disagree",
                    (f"states two units of {what}: {of_keys.name} in its {_KEYS}, {of_wkt.name} in its {_WKT}."),
                    path=self._path,
                    field=self._flag,
                    remedy=f"Give {self._flag}-crs EPSG:n+m with the units of the coordinates.",
                )

    def _with_heights(self, plan: _Statement) -> tuple[PointCrs, _Statement]:
        """Return the CRS with its heights, and the statement that they come from."""
        heights = next((one for one in (self._option, *self._sources) if one.has_heights), _NOTHING)
        chosen = self._choice
        if chosen is not None and self._option.has_heights and not _same_datum(self._option, chosen):
            raise InputError(
                "vertical-stated-twice",
                (f"{self._flag}-crs has heights above {self._option.datum}, {self._flag}-vertical is {chosen}."),
                field=f"{self._flag}-vertical",
                remedy="Give one of them.",
            )
        if chosen is not None and not self._option.has_heights:
            if heights.has_heights and not _same_datum(heights, chosen):
                self._remark(
                    "vertical-overrules",
                    f"{self._path.name}: the stated datum, {chosen}, overrules the datum of the file's "
                    f"{heights.source}, {heights.datum}.",
                )
            stated = replace(_NOTHING, source=f"{self._flag}-vertical", is_ellipsoidal=chosen.epsg is None)
            return parse_crs(plan.horizontal, vertical=chosen, path=self._path), stated
        if not heights.has_heights:
            problem = next((one.vertical_problem for one in self._sources if one.vertical_problem), "")
            if problem:
                raise InputError(
                    "vertical-datum-unknown",
                    f"states its heights by {problem}.",
                    path=self._path,
                    field=self._flag,
                    remedy=f"Give {self._flag}-vertical: ellipsoidal or EPSG:n.",
                )
            return parse_crs(plan.horizontal, path=self._path), heights
        self._compare_heights(heights)
        crs = _joined(plan, heights, self._path)
        return crs, heights

    def _compare_heights(self, heights: _Statement) -> None:
        other = next((one for one in self._sources if one.has_heights and one is not heights), None)
        if other is None or _same_heights(heights, other):
            return
        if heights is self._option:
            sentence = (
                f"{self._path.name}: the stated CRS has heights above {heights.datum}, and overrules the "
                f"datum of the file's {other.source}, {other.datum}."
            )
            self._remark("vertical-overrules", sentence)
            return
        self._remark(
            "vertical-disagrees",
            f"{self._path.name}: its {heights.source} state heights above {heights.datum}, its {other.source} "
            f"{other.datum}. The header's WKT bit has the {heights.source} count.",
            f"{self._flag}-vertical overrules both.",
        )

    def _plan_scale(self, crs: PointCrs, plan: _Statement, unit: Unit | None) -> float:
        crs_unit = crs.horizontal_unit
        if unit is None or unit.is_as_long_as(crs_unit):
            return 1.0
        if abs(unit.size / crs_unit - 1) < _NEARLY:
            raise InputError(
                "cloud-units-disagree",
                f"states coordinates in {unit.name} beside {plan.name}, which is in {crs.units[0]}.",
                path=self._path,
                field=self._flag,
                remedy=f"Give {self._flag}-crs {plan.name} if they are in {crs.units[0]}.",
            )
        self._remark(
            "map-unit",
            f"{self._path.name}: eastings and northings were converted from {unit.name}, which its {plan.source} "
            f"state beside {plan.name}, a CRS in {crs.units[0]}.",
            f"If they are in {crs.units[0]}: {self._flag}-crs {plan.name}.",
        )
        return unit.size / crs_unit

    def _height_scale(self, crs: PointCrs, heights: _Statement, plan_scale: float) -> float:
        """Return the stated unit of heights over that of the CRS.

        The whole CRS of the option states its unit too; a datum alone leaves it to the file.
        """
        crs_unit_m = crs.height_unit_m
        problem = next((one.unit_problem for one in self._sources if one.unit_problem), "")
        if problem and heights is not self._option:
            raise InputError(
                "height-unit-unknown",
                f"states the unit of its heights by {problem}.",
                path=self._path,
                field=self._flag,
                remedy=f"Give {self._flag}-crs EPSG:n+m, in its unit.",
            )
        # The user's CRS states its unit. So does a datum in feet, where one in metres is the datum's usual name.
        by_user = heights is self._option and heights is not _NOTHING
        by_choice = self._choice is not None and self._choice.epsg is not None and crs_unit_m != 1.0
        if by_user or by_choice:
            return 1.0
        has_own = heights.stated_height_unit is not None
        said = [heights] if has_own else self._sources
        unit = next((one.height_unit for one in said if one.height_unit is not None), None)
        if unit is None and heights.unit_is_open:  # a datum has no unit: heights are in that of the map
            unit = Unit("metre", 1.0) if crs.is_geographic else Unit(crs.units[0], crs.horizontal_unit)
        if unit is None and plan_scale != 1.0:
            self._remark(
                "height-unit-assumed",
                f"{self._path.name}: heights were taken in {crs.height_unit}, as of {crs.name}: the file states a "
                "unit of eastings and northings alone.",
            )
        if unit is None or unit.is_as_long_as(crs_unit_m):
            return 1.0
        self._remark(
            "height-unit",
            f"{self._path.name}: heights were converted from {unit.name}, which the file states; {crs.name} has "
            f"them in {crs.height_unit}.",
        )
        return unit.size / crs_unit_m


def _of_text(text: str, source: str, *, path: Path | None = None, field: str | None = None) -> _Statement:
    """Return what a text of PROJ says; a system of its own, which is nowhere on Earth, is none."""
    crs = proj_crs(text, path=path, field=field)
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    upright = next((part for part in parts if part.is_vertical), None)
    flat = next((part for part in parts if not part.is_vertical), None)
    note = "" if upright is None else f"{upright.name}, part of {source}"
    if flat is None or not (flat.is_geographic or flat.is_projected or flat.is_geocentric):
        problem = "a vertical CRS alone" if flat is None else f"a {flat.type_name} {flat.name!r}"
        return _Statement(source, vertical=upright, vertical_note=note, problem=problem)
    if not crs.is_compound:
        return _plain_statement(source, text, flat)
    horizontal = f"EPSG:{flat.to_epsg()}" if text.upper().startswith("EPSG:") else flat.to_wkt()
    return _Statement(source, horizontal, flat.name, text, upright, vertical_note=note)


def _plain_statement(source: str, text: str, crs: CRS) -> _Statement:
    """Return what the text of a CRS of two or three axes says that is not compound."""
    axes, name = (crs.source_crs or crs if crs.is_bound else crs).axis_info, _short_name(text, crs)
    if len(axes) < 3:
        return _Statement(source, text, name)
    flat = text if crs.is_geocentric or crs.is_bound else crs.to_2d().to_wkt()
    unit = Unit(axes[2].unit_name, axes[2].unit_conversion_factor)
    return _Statement(source, flat, name, text, is_ellipsoidal=True, height_unit=unit)


def _short_name(text: str, crs: CRS) -> str:
    return crs.name if len(text) > 60 else " ".join(text.split())


def _of_wkt(said: FileCrs, path: Path) -> _Statement:
    if not said.wkt:
        return _NOTHING
    try:
        return _of_text(said.wkt, _WKT, path=path)
    except InputError as error:
        return _Statement(_WKT, problem=error.message, is_unreadable=True)


def _of_keys(said: FileCrs) -> _Statement:
    if not said.keys:
        return _NOTHING
    keys = keyed_crs(said.keys)
    text, problem = f"EPSG:{keys.epsg}" if keys.epsg is not None else "", keys.problem
    vertical = None if keys.vertical_epsg is None else CRS.from_epsg(keys.vertical_epsg)
    common: dict[str, Any] = {
        "vertical": vertical,
        "is_ellipsoidal": keys.is_ellipsoidal,
        "unit_is_open": keys.unit_is_open,
        "vertical_note": keys.vertical_note,
        "plan_unit": keys.plan_unit,
        "height_unit": keys.height_unit,
        "vertical_problem": keys.vertical_problem,
        "unit_problem": keys.unit_problem,
    }
    if text and not problem:
        try:
            crs = proj_crs(text)
            if crs.is_geographic or crs.is_projected or crs.is_geocentric:
                whole = _plain_statement(_KEYS, text, crs)
                if whole.is_ellipsoidal and vertical is None and not keys.is_ellipsoidal:
                    common |= {"is_ellipsoidal": True, "height_unit": keys.height_unit or whole.height_unit}
                    return replace(whole, **common)
                return _Statement(_KEYS, whole.horizontal, text, **common)
            problem = f"{text} is a {crs.type_name}"
        except InputError as error:
            problem = error.message
    return _Statement(_KEYS, problem=problem, **common)


def _joined(plan: _Statement, heights: _Statement, path: Path) -> PointCrs:
    """Return the CRS of a plan with heights of the same or of another statement."""
    if plan is heights and plan.whole:
        return parse_crs(plan.whole, path=path)
    if heights.vertical is None:
        crs = parse_crs(plan.horizontal, vertical=VerticalChoice(ELLIPSOIDAL, None), path=path)
        note = heights.vertical_note or heights.source
        return replace(crs, vertical=VerticalDatum(name=ELLIPSOIDAL, stated=True, note=note))
    flat, upright = proj_crs(plan.horizontal, path=path), heights.vertical
    if len(flat.axis_info) == 3:
        flat = flat.to_2d()
    whole = CompoundCRS(f"{flat.name} + {upright.name}", [flat, upright])
    crs = parse_crs(whole.to_wkt(), path=path)
    epsg = upright.to_epsg()
    name = f"{plan.name}+{epsg}" if plan.name.startswith("EPSG:") and epsg else f"{plan.name} + {upright.name}"
    datum = VerticalDatum(name=_datum_name(upright), stated=True, note=heights.vertical_note or heights.source)
    return replace(crs, name=name, vertical=datum)


def _datum_name(upright: CRS) -> str:
    epsg = upright.to_epsg()
    return upright.name if epsg is None else NAME_OF_EPSG.get(epsg, f"{upright.name} (EPSG:{epsg})")


def _same_heights(one: _Statement, other: _Statement) -> bool:
    if one.vertical is None or other.vertical is None:
        return one.vertical is other.vertical
    return _same_upright(one.vertical, other.vertical)


def _same_datum(one: _Statement, choice: VerticalChoice) -> bool:
    if one.vertical is None or choice.epsg is None:
        return one.vertical is None and choice.epsg is None
    return _same_upright(one.vertical, CRS.from_epsg(choice.epsg))


def _same_upright(one: CRS, other: CRS) -> bool:
    """Return whether two vertical CRS count from one datum; their units may differ."""
    return one.equals(other) or (one.datum is not None and other.datum is not None and one.datum == other.datum)


def _crs_text(statement: _Statement) -> str:
    unit = "" if statement.plan_unit is None else f" in {statement.plan_unit.name}"
    return f"{statement.name}{unit}"


def _named(crs: PointCrs, scale: FloatArray, unit: Unit | None) -> PointCrs:
    """Return the CRS under a name that tells the unit its coordinates were converted from."""
    if scale[0] == 1.0 or unit is None:
        return crs
    return replace(crs, name=f"{crs.name} in {unit.name}")
