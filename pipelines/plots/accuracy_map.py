"""The predicted accuracy over a scene as a pair of maps, horizontal and vertical σ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.core.types import FloatArray
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
_LEFT, _RIGHT, _BELOW, _ABOVE = 0.85, 1.0, 0.95, 0.75
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


@dataclass(frozen=True)
class MapPoints:
    """East and north (K, 2) in metres of the points to mark on a map."""

    cameras: FloatArray
    control: FloatArray
    check: FloatArray


def write_accuracy_map(path: Path, raster: SigmaRaster, points: MapPoints) -> None:
    """Draw horizontal and vertical σ side by side, north up, with cameras, control and check points."""
    low, high = _limits(raster, points)
    width, height = (_MAP * (high - low) / (high - low).max()).tolist()
    size = (2 * (_LEFT + width + _RIGHT), _BELOW + height + _ABOVE)
    figure = new_figure(size, None)
    figure.suptitle("Predicted accuracy, 1 σ", fontsize=HEADING_POINTS, y=1 - _HEADING_DEPTH / size[1])
    maps = (("σ H", "horizontal", raster.sigma_h_m), ("σ V", "vertical", raster.sigma_v_m))
    for number, (symbol, direction, sigma_m) in enumerate(maps):
        left = _LEFT + number * size[0] / 2
        axes = figure.add_axes(_share(size, left, width, height))
        bar = figure.add_axes(_share(size, left + width + _BAR_GAP, _BAR_WIDTH, height))
        label(
            axes,
            f"{symbol}, {direction}",
            x="east of the survey's origin in m",
            y="north of the survey's origin in m",
        )
        image = _draw(axes, raster, sigma_m)
        _mark(axes, points)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
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
    places = np.concatenate([corners, points.cameras, points.control, points.check])
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
        ("check point", points.check, _CHECK),
        ("control point", points.control, _CONTROL),
    )
    for name, places, style in kinds:
        if len(places):
            axes.scatter(places[:, 0], places[:, 1], label=name, **style)


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
