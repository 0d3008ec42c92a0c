"""Vertical datums by name, stated or assumed; the error for a missing grid, and heights that no survey has.

An ellipsoidal height and one above a geoid differ by up to 100 m, so every survey says which it has, and
whether that was stated or assumed.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.options import WRITTEN, from_text
from pipelines.core.products import Product
from pipelines.core.types import BoolArray

ELLIPSOIDAL = "ellipsoidal"
MOST_GEOID_M = 110.0  # between the ellipsoid and any geoid
FOOT_M = 0.3048  # international foot; the US survey foot differs by 2e-6
# Metres below and above which nobody flies and nothing is surveyed: the deepest pits lie above, jets fly below.
LOWEST_M, HIGHEST_M = -1000.0, 20_000.0
HEIGHT_REMEDY = (
    f"heights of flights and surveys lie between {LOWEST_M:.0f} and {HIGHEST_M:.0f} m. Check the column and its "
    "unit (autopilots log millimetres)."
)
_EPSG_OF = {"EGM84": 5798, "EGM96": 5773, "EGM2008": 3855}
NAME_OF_EPSG = {code: name for name, code in _EPSG_OF.items()}  # `EPSG:5773` and `EGM96` are the same datum


def impossible_heights(height_m: ArrayLike) -> BoolArray:
    """Return which heights, above any datum, no flight and no survey has; NaN is none of them."""
    heights = np.asarray(height_m, dtype=np.float64)
    return np.asarray((heights < LOWEST_M) | (heights > HIGHEST_M))


@dataclass(frozen=True)
class VerticalChoice:
    """A vertical datum as an option names it, and the code of its vertical CRS; None for ellipsoidal heights."""

    name: str
    epsg: int | None

    def __str__(self) -> str:
        return self.name


def parse_vertical(text: str) -> VerticalChoice:
    """Return the vertical datum of `ellipsoidal`, `EGM84`, `EGM96`, `EGM2008` or `EPSG:n` (any case).

    Raises:
        InputError: none of these.
    """
    name = text.strip()
    if name.lower() == ELLIPSOIDAL:
        return VerticalChoice(ELLIPSOIDAL, None)
    if name.upper() in _EPSG_OF:
        return VerticalChoice(name.upper(), _EPSG_OF[name.upper()])
    match = re.fullmatch(r"EPSG:(\d{1,6})", name, re.IGNORECASE)
    if match is None:
        known = ", ".join([ELLIPSOIDAL, *_EPSG_OF, "EPSG:n"])
        raise InputError(
            "vertical-datum-unknown",
            f"{text!r} is no vertical datum.",
            field="--vertical",
            remedy=f"Give one of {known}.",
        )
    epsg = int(match[1])
    return VerticalChoice(NAME_OF_EPSG.get(epsg, f"EPSG:{epsg}"), epsg)


def missing_grid_error(
    datum: str | None, crs_name: str, grids: Sequence[str], folder: str, path: Path | str | None
) -> InputError:
    """Return the error for points of a CRS that need `grids`, of which none is in PROJ's data `folder`.

    `datum` is that of the heights, if they do not count from the ellipsoid.
    """
    problem = f"Points of {crs_name} cannot be transformed to WGS84"
    instead = "Or give coordinates in another CRS."
    if datum is not None:
        problem = f"Heights above {datum} cannot be converted to ellipsoidal heights"
        instead = (
            "If the heights are ellipsoidal already, give the horizontal CRS alone and --vertical ellipsoidal."
        )
    files = f"the PROJ grid {grids[0]} is" if len(grids) == 1 else f"the PROJ grids {', '.join(grids)} are"
    command = " ".join(["pyproj sync", *(f"--file {grid}" for grid in grids)])
    return InputError(
        "grid-not-installed",
        f"{problem}: {files} not installed.",
        remedy=f"Run `{command}`, or copy from https://cdn.proj.org into {folder}. {instead}",
        path=path,
    )


# Datum of heights as an option.
Vertical = Annotated[VerticalChoice, from_text(parse_vertical), WRITTEN]


class VerticalDatum(Product):
    """Vertical datum of heights; whether the user or the file stated it; `note`: where from, or why assumed.

    `by_definition`: nobody stated it, but the kind of message or file has one datum only, which `note` names.
    """

    name: str
    stated: bool
    note: str = ""
    by_definition: bool = False

    @property
    def is_assumed(self) -> bool:
        """Whether neither user, file nor the definition of its format names the datum."""
        return not (self.stated or self.by_definition)

    @property
    def source(self) -> str:
        """Where the datum comes from: `as stated`, `by definition` or `assumed: nobody stated the datum`."""
        if self.stated:
            return "as stated"
        return f"by definition: {self.note}" if self.by_definition else "assumed: nobody stated the datum"

    @property
    def described(self) -> str:
        """Name and source, for pages and metadata."""
        return f"{self.name}, {self.source}"
