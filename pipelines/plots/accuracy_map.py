"""The predicted accuracy over a scene as a pair of maps, horizontal and vertical σ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.plots.map_marks import (
    MapCoordinates,
    draw_errors,
    draw_north,
    exaggeration,
    write_names,
    write_ticks,
)
from pipelines.plots.style import (
    COLOUR_MAP,
    EMPTY_COLOUR,
    HEADING_POINTS,
    LABEL_POINTS,
    ORANGE,
    TICK_POINTS,
    label,
    new_figure,
    write_png,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

# Of the picture, in inches: the longer side of a map, and the room around each map for what is written there.
_MAP = 4.4
_LEFT, _RIGHT, _BELOW, _ABOVE = 1.15, 0.95, 1.2, 0.8
_BAR_GAP, _BAR_WIDTH = 0.1, 0.16
_LEGEND_HEIGHT, _HEADING_DEPTH = 0.2, 0.2  # above the lower edge, below the upper one

_NARROWEST = 0.4  # shorter side of a map over its longer one
_MARGIN = 0.04  # of the longer side, around everything that is shown
_MOST_TICKS = 8  # on the longer side

_CAMERAS = {"marker": "X", "linewidths": 0.4, "color": "black", "edgecolors": "white"}
_CHECK = {"marker": "o", "s": 24, "linewidths": 0.8, "color": "white", "edgecolors": "black"}
_CONTROL = {"marker": "^", "s": 34, "linewidths": 0.8, "color": ORANGE, "edgecolors": "black"}
# Of the sign of a camera in square points: many cameras must not hide the map.
_LARGEST_SIGN, _SMALLEST_SIGN, _LARGE_SIGNS = 26.0, 9.0, 100


@dataclass(frozen=True)
class SigmaRaster:
    """Standard deviations over a scene, as R rows from the south and C columns from the west.

    Attributes:
        sigma_h_m: (R, C) horizontal; NaN where there is no scene.
        sigma_v_m: (R, C) vertical.
        corner_m: (2,) east and north of the south-western corner.
        cell_m: side of a cell.
    """

    sigma_h_m: FloatArray
    sigma_v_m: FloatArray
    corner_m: FloatArray
    cell_m: float

    @property
    def bounds_m(self) -> tuple[FloatArray, FloatArray]:
        """East and north (2,) of the south-western and of the north-eastern corner."""
        rows, columns = self.sigma_h_m.shape
        return self.corner_m, self.corner_m + self.cell_m * np.array([columns, rows])


def _nowhere() -> FloatArray:
    return np.empty((0, 2))


@dataclass(frozen=True)
class NamedPlaces:
    """Surveyed points to mark on a map.

    Attributes:
        place: (K, 2) east and north in metres.
        names: of the points; empty: none is written.
        error_m: (K, 3) east, north, up, to be drawn as arrows; NaN: not measured; None: no arrows.
    """

    place: FloatArray = field(default_factory=_nowhere)
    names: tuple[str, ...] = ()
    error_m: FloatArray | None = None

    def error_of(self, axes: tuple[int, ...]) -> FloatArray:
        """Return the errors (K, len(axes)) along some axes; NaN where there is none."""
        none = np.full((len(self.place), len(axes)), np.nan)
        return none if self.error_m is None else self.error_m[:, axes]


@dataclass(frozen=True)
class MapPoints:
    """Points to mark on a map: cameras (K, 2) in metres east and north, control and check points."""

    cameras: FloatArray = field(default_factory=_nowhere)
    control: NamedPlaces = NamedPlaces()
    check: NamedPlaces = NamedPlaces()


def write_accuracy_map(
    path: Path, raster: SigmaRaster, points: MapPoints, coordinates: MapCoordinates | None = None
) -> None:
    """Draw horizontal and vertical σ side by side, north up, with cameras, control and check points.

    Errors of the points are arrows: horizontal ones on the left, vertical ones, up and down, on the right.

    Args:
        path: of the picture.
        raster: σ.
        points: to mark.
        coordinates: to write below the metres of the axes; None: none.
    """
    low, high = _limits(raster, points)
    width, height = (_MAP * (high - low) / (high - low).max()).tolist()
    size = (2 * (_LEFT + width + _RIGHT), _BELOW + height + _ABOVE)
    figure = new_figure(size, None)
    figure.suptitle("Predicted accuracy, 1 σ", fontsize=HEADING_POINTS, y=1 - _HEADING_DEPTH / size[1])
    maps = (("σ H", "horizontal", raster.sigma_h_m, (0, 1)), ("σ V", "vertical", raster.sigma_v_m, (2,)))
    for number, (symbol, direction, sigma_m, errors_along) in enumerate(maps):
        left = _LEFT + number * size[0] / 2
        axes = figure.add_axes(_share(size, left, width, height))
        bar = figure.add_axes(_share(size, left + width + _BAR_GAP, _BAR_WIDTH, height))
        image = _draw(axes, raster, sigma_m)
        _mark(axes, points)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        factor = _draw_errors(axes, points, errors_along, float((high - low).max()))
        arrows = "" if factor is None else f"; arrows: errors × {factor:,g}"
        below = ("", "") if coordinates is None else (f"\n{coordinates.label(0)}", f"\n{coordinates.label(1)}")
        label(
            axes,
            f"{symbol}, {direction}{arrows}",
            x=f"east of the survey's origin in m{below[0]}",
            y=f"north of the survey's origin in m{below[1]}",
        )
        if coordinates is not None:
            write_ticks(axes, coordinates)
        draw_north(figure, axes)
        axes.locator_params("x", nbins=max(round(_MOST_TICKS * width / _MAP), 2))
        axes.locator_params("y", nbins=max(round(_MOST_TICKS * height / _MAP), 2))
        _scale(figure, image, bar, f"{symbol} in m")
    _add_legend(figure)
    write_png(figure, path)


def _share(
    size: tuple[float, float], left: float, width: float, height: float
) -> tuple[float, float, float, float]:
    """Left, lower edge, width and height in parts of the picture, of axes above the room for labels."""
    return left / size[0], _BELOW / size[1], width / size[0], height / size[1]


def _limits(raster: SigmaRaster, points: MapPoints) -> tuple[FloatArray, FloatArray]:
    """South-western and north-eastern corner (2,) of the maps: all is inside, and neither side is too narrow."""
    corners = np.array(raster.bounds_m)
    places = np.concatenate([corners, points.cameras, points.control.place, points.check.place])
    low, high = places.min(axis=0), places.max(axis=0)
    longer = float((high - low).max())
    half = np.maximum(high - low, _NARROWEST * longer) / 2 + _MARGIN * longer
    return (low + high) / 2 - half, (low + high) / 2 + half


def _draw(axes: Axes, raster: SigmaRaster, sigma_m: FloatArray) -> AxesImage:
    (west, south), (east, north) = (corner.tolist() for corner in raster.bounds_m)
    axes.set_facecolor(EMPTY_COLOUR)
    image = axes.imshow(
        np.ma.masked_invalid(sigma_m),
        cmap=COLOUR_MAP,
        origin="lower",
        extent=(west, east, south, north),
        interpolation="nearest",
        aspect="equal",
    )
    axes.ticklabel_format(useOffset=False, style="plain")
    return image


def _scale(figure: Figure, image: AxesImage, axes: Axes, text: str) -> None:
    bar = figure.colorbar(image, cax=axes)
    bar.set_label(text, fontsize=LABEL_POINTS)
    axes.tick_params(labelsize=TICK_POINTS)
    axes.ticklabel_format(useOffset=False, style="plain")


def _mark(axes: Axes, points: MapPoints) -> None:
    size = min(max(_LARGEST_SIGN * _LARGE_SIGNS / max(len(points.cameras), 1), _SMALLEST_SIGN), _LARGEST_SIGN)
    kinds: tuple[tuple[str, FloatArray, Mapping[str, Any]], ...] = (
        ("camera", points.cameras, {**_CAMERAS, "s": size}),
        (_named("check point", points.check, "its triangulated error"), points.check.place, _CHECK),
        (_named("control point", points.control, "its residual"), points.control.place, _CONTROL),
    )
    for name, places, style in kinds:
        if len(places):
            axes.scatter(places[:, 0], places[:, 1], label=name, zorder=4, **style)
    for group in (points.check, points.control):
        write_names(axes, group.place[: len(group.names)], group.names)


def _named(name: str, points: NamedPlaces, arrow: str) -> str:
    return name if points.error_m is None else f"{name}, with {arrow}"


def _draw_errors(axes: Axes, points: MapPoints, along: tuple[int, ...], side_m: float) -> float | None:
    """Draw the errors along the map's axes, or up and down; return their exaggeration, None without errors."""
    groups = [(points.control, points.control.error_of(along)), (points.check, points.check.error_of(along))]
    lengths_m = np.concatenate([np.linalg.norm(errors_m, axis=1) for _, errors_m in groups])
    factor = exaggeration(lengths_m, side_m)
    for group, errors_m in groups if factor is not None else ():
        plan_m = errors_m if len(along) == 2 else np.column_stack([np.zeros(len(errors_m)), errors_m])
        draw_errors(axes, group.place, plan_m, factor or 1.0, of_control=group is points.control)
    return factor


def _add_legend(figure: Figure) -> None:
    handles, names = figure.axes[0].get_legend_handles_labels()
    if names:
        place = (0.5, _LEGEND_HEIGHT / figure.get_figheight())
        figure.legend(
            handles,
            names,
            loc="center",
            bbox_to_anchor=place,
            ncols=len(names),
            fontsize=TICK_POINTS,
            frameon=False,
        )
