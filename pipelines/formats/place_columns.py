"""Columns of a table that place its rows on Earth or in a map: which group, in which order, unit and datum."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats import column_names, tables

_GEOGRAPHIC, _PROJECTED = ("longitude", "latitude"), ("x", "y")
_RELATIVE = "The heights ({}) count from take-off or from the ground."
Height = Literal["altitude", "z", "ellipsoidal", "orthometric"]


@dataclass(frozen=True)
class PlaceColumns:
    """Group of columns that is read: longitude, latitude or x, y, and a height."""

    geographic: bool
    height: Height
    unread: tuple[str, ...]  # names of coordinates of the other group, and of other heights
    plan_unit_m: float | None  # unit of x and y that the header states
    height_unit_m: float | None  # unit of the height that the header states

    @property
    def above_ellipsoid(self) -> bool:
        """Whether the header says that heights are above the ellipsoid."""
        return self.height == "ellipsoidal"

    @property
    def above_geoid(self) -> bool:
        """Whether the header says that heights are above a geoid, which it does not name."""
        return self.height == "orthometric"

    @property
    def plan(self) -> tuple[str, str]:
        return _GEOGRAPHIC if self.geographic else _PROJECTED

    def xyz(self, row: tables.Row) -> tuple[float, float, float]:
        """Return longitude or easting, latitude or northing, and height of a row; NaN where a cell is empty."""
        read = row.degrees if self.geographic else row.number
        first, second = (read(column) for column in self.plan)
        height = row.number(self.height)
        below = "altitude_ref" in row.columns and row.text("altitude_ref").lower().startswith(("1", "below"))
        return first, second, -abs(height) if below and self.height == "altitude" else height

    def numbers(self, rows: Sequence[tables.Row]) -> FloatArray:
        """Return `xyz` of rows (N, 3)."""
        return np.array([self.xyz(row) for row in rows], dtype=np.float64).reshape(-1, 3)


def place_columns(
    header: Sequence[str],
    columns: Mapping[str, int],
    vocabulary: Mapping[str, str],
    *,
    projected: bool,
    path: Path,
    line: int,
) -> PlaceColumns:
    """Return the columns that place the rows of a table.

    Of two groups, x and y count if the user named their CRS (`projected`); else latitude and longitude, if a height
    above the ellipsoid is beside them. Of several heights, the one above the ellipsoid counts.

    Raises:
        InputError: no group is whole, both are and nothing decides, or the heights count from the ground.
    """
    present = [group for group in (_GEOGRAPHIC, _PROJECTED) if any(name in columns for name in group)]
    whole = [group for group in present if all(name in columns for name in group)]
    if not whole:
        needed = "latitude,longitude,altitude or x,y,z"
        missing = [name for group in present for name in group if name not in columns]
        raise tables.unknown_header(header, vocabulary, needed, path=path, line=line, missing=missing)
    if len(whole) == 2 and not projected and "ellipsoidal" not in columns:
        message = "The header has both latitude,longitude,altitude and x,y,z."
        remedy = "Remove one group, or name the CRS of x,y,z."
        raise InputError("columns-ambiguous", message, path=path, line=line, remedy=remedy)
    geographic = whole[0] == _GEOGRAPHIC and not (projected and len(whole) == 2)
    order: tuple[Height, ...] = ("altitude", "z") if geographic else ("z", "altitude")
    if not geographic and len(whole) == 2:  # of two groups with a height each
        order = (*order, "orthometric", "ellipsoidal")
    else:
        order = ("ellipsoidal", *order, "orthometric")
    height = next((name for name in order if name in columns), None)
    if height is None and "relative" in columns:
        named = header[columns["relative"]].strip()[:40]
        remedy = "Give a column of heights above sea or ellipsoid."
        raise InputError("heights-relative", _RELATIVE.format(named), path=path, line=line, remedy=remedy)
    if height is None:
        missing_height = "altitude" if geographic else "z"
        message = f"The header has no column {missing_height}; it has {column_names.listed_columns(header)}."
        raise InputError("column-missing", message, path=path, line=line)
    group = _GEOGRAPHIC if geographic else _PROJECTED
    coordinates = (*_GEOGRAPHIC, *_PROJECTED, "altitude", "z", "ellipsoidal", "orthometric", "relative")
    unread = [columns[name] for name in coordinates if name in columns and name not in (*group, height)]
    units = tables.units_of(header, columns)
    plan_m = None if geographic else column_names.LENGTHS_M.get(units.get("x", ""))
    return PlaceColumns(
        geographic=geographic,
        height=height,
        unread=tuple(header[at].strip() for at in sorted(unread)),
        plan_unit_m=plan_m,
        height_unit_m=column_names.LENGTHS_M.get(units.get(height, "")),
    )
