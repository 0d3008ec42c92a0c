"""What a surveyor looks for on a map beside its colours: names, errors as arrows, coordinates, and north."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.plots.style import DARK, FIGURE_POINTS, LABEL_POINTS, ORANGE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_NAMES = 100  # more would hide the map
_NAME_OFFSET_POINTS = (4, 3)
_LONGEST_ARROW = 0.14  # of the longer side of the map
_OUTLIER = 4.0  # times the median: such an arrow may leave the map
_METRES_PER_DEGREE = 111_320.0
_NORTH_LENGTH, _NORTH_LEFT, _NORTH_GAP = 0.28, 0.45, 0.04  # inches: the arrow, its distance from the map's corner


@dataclass(frozen=True)
class MapCoordinates:
    """Coordinates to write beside the metres of a map.

    Attributes:
        crs: name of the CRS.
        names: of the first and second coordinate: `longitude`, `latitude`.
        unit: of both.
        of: returns coordinates (N, 2) of places east and north (N, 2).
    """

    crs: str
    names: tuple[str, str]
    unit: str
    of: Callable[[FloatArray], FloatArray]

    def label(self, axis: int) -> str:
        """Return the second line of the label of an axis."""
        return f"{self.names[axis]} in {self.unit} ({self.crs})"


def write_ticks(axes: Axes, coordinates: MapCoordinates) -> None:
    """Write a coordinate below each tick, as it is on the lower or left edge of the map."""
    from matplotlib.ticker import FuncFormatter

    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    decimals = _decimals(min(east - west, north - south), coordinates.unit)

    def text(value: float, axis: int) -> str:
        place = np.array([[value, south]] if axis == 0 else [[west, value]])
        return f"{value:.10g}\n{coordinates.of(place)[0, axis]:.{decimals}f}"

    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: text(value, 0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: text(value, 1)))


def write_names(axes: Axes, places: FloatArray, names: Sequence[str]) -> None:
    """Write the names beside their places (K, 2); no name where they are too many."""
    from matplotlib.patheffects import withStroke

    if len(names) > _MOST_NAMES:
        return
    for name, place in zip(names, places.tolist(), strict=True):
        axes.annotate(
            name,
            place,
            xytext=_NAME_OFFSET_POINTS,
            textcoords="offset points",
            fontsize=FIGURE_POINTS,
            color=DARK,
            parse_math=False,
            annotation_clip=True,
            path_effects=[withStroke(linewidth=1.6, foreground="white")],
        )


def exaggeration(lengths_m: FloatArray, side_m: float) -> float | None:
    """Return the factor 1, 2 or 5 times a power of ten by which errors are drawn; None: none is to be drawn.

    The longest arrow takes a seventh of the map's longer side, where it is not four times as long as the median.

    Args:
        lengths_m: (K,) of the errors; NaN: not measured.
        side_m: of the map.
    """
    known = lengths_m[np.isfinite(lengths_m)]
    longest = 0.0 if not len(known) else min(float(known.max()), _OUTLIER * float(np.median(known)))
    if longest <= 0:
        return None
    factor = _LONGEST_ARROW * side_m / longest
    power = 10.0 ** math.floor(math.log10(factor))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= factor * (1 + 1e-9))


def draw_errors(axes: Axes, places: FloatArray, errors_m: FloatArray, factor: float, *, of_control: bool) -> None:
    """Draw errors (K, 2) east and north, times a factor, as arrows at their places (K, 2); NaN: none."""
    known = np.isfinite(errors_m).all(axis=1)
    if not known.any():
        return
    (east, north), (right, up) = places[known].T, factor * errors_m[known].T
    axes.quiver(
        east, north, right, up,
        angles="xy", scale_units="xy", scale=1.0, width=0.006, zorder=5,
        color=ORANGE if of_control else DARK, edgecolor="white", linewidth=0.4,
    )  # fmt: skip


def draw_north(figure: Figure, axes: Axes) -> None:
    """Draw an arrow to the north left of a map, at its upper edge: up, as the axes of the map are."""
    width, height = figure.get_size_inches()
    box = axes.get_position()
    x, foot = box.x0 - _NORTH_LEFT / width, box.y1 + _NORTH_GAP / height
    head = foot + _NORTH_LENGTH / height
    axes.annotate(
        "",
        xy=(x, head),
        xytext=(x, foot),
        xycoords="figure fraction",
        textcoords="figure fraction",
        arrowprops={"arrowstyle": "-|>", "color": DARK, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.4},
    )
    figure.text(x, head, "N", ha="center", va="bottom", fontsize=LABEL_POINTS, color=DARK)


def _decimals(side_m: float, unit: str) -> int:
    """Return the decimals that state a coordinate to a hundredth of a map's side, or better."""
    step = side_m / 100 / (_METRES_PER_DEGREE if unit == "°" else 1.0)
    return max(0, math.ceil(-math.log10(step)))
