"""Maps with what a surveyor looks for beside the colours: names, errors as arrows, coordinates, and north.

They show the predicted accuracy over a scene, and the places where LiDAR and photographs disagree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipelines.core.types import ByteArray, FloatArray
from pipelines.geometry.relief import pale
from pipelines.report.plots import plans
from pipelines.report.plots import style as look

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LONGEST_ARROW = 0.14  # of the longer side of the map
_OUTLIER = 4.0  # times the median: such an arrow may leave the map
_NORTH_LENGTH, _NORTH_LEFT, _NORTH_GAP = 0.28, 0.45, 0.04  # inches: the arrow, its distance from the map's corner


def exaggeration(lengths_m: FloatArray, side_m: float) -> float | None:
    """Return the factor 1, 2 or 5 times a power of ten by which errors are drawn; None: none is to be drawn.

    The longest arrow takes a seventh of the map's longer side, where it is not four times as long as the median.
    Lengths (K,) are NaN where errors were not measured.
    """
    known = lengths_m[np.isfinite(lengths_m)]
    longest = 0.0 if not len(known) else min(float(known.max()), _OUTLIER * float(np.median(known)))
    if longest <= 0:
        return None
    return plans.nice_number(_LONGEST_ARROW * side_m / longest)


def draw_scale_bar(axes: Axes) -> None:
    """Draw a bar of a round length inside the lower right corner of a map, white with a dark rim on any colour."""
    from matplotlib.patheffects import withStroke

    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    length = plans.nice_number(_SCALE_BAR * (east - west))
    left, foot = east - 0.04 * (east - west) - length, south + 0.04 * (north - south)
    rim = [withStroke(linewidth=2, foreground=look.DARK)]
    axes.plot([left, left + length], [foot, foot], color="white", linewidth=2, path_effects=rim, zorder=9)
    style: dict[str, Any] = {"fontsize": look.TICK_POINTS, "color": "white", "ha": "left", "va": "bottom"}
    axes.text(left, foot + 0.015 * (north - south), f"{length:g} m", path_effects=rim, zorder=9, **style)


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
        arrowprops={"arrowstyle": "-|>", "color": look.DARK, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.4},
    )
    figure.text(x, head, "N", ha="center", va="bottom", fontsize=look.LABEL_POINTS, color=look.DARK)


# Of the picture, in inches: the longer side of a map, and the room around each map for what is written there.
_MAP = 3.4
_LEFT, _RIGHT, _BELOW, _ABOVE = 1.15, 0.95, 1.2, 0.8
_BAR_GAP, _BAR_WIDTH = 0.1, 0.16
_LEGEND_HEIGHT, _HEADING_DEPTH = 0.2, 0.2  # above the lower edge, below the upper one

_NARROWEST = 0.4  # shorter side of a map over its longer one
_MARGIN = 0.04  # of the longer side, around everything that is shown
_MOST_TICKS = 5  # on the longer side
_SCALE_BAR = 0.25  # of the width, that the scale bar takes at most

_CAMERAS = {"marker": "X", "linewidths": 0.4, "color": "black", "edgecolors": "white"}
# Of the sign of a camera in square points: many cameras must not hide the map.
_LARGEST_SIGN, _SMALLEST_SIGN, _LARGE_SIGNS = 26.0, 9.0, 100


@dataclass(frozen=True)
class SigmaRaster:
    """Standard deviations (R, C) over a scene, rows from the south, columns from the west; NaN: there is no scene.

    `corner_m` (2,) is the south-western corner, east and north, and `cell_m` the side of a cell.
    """

    sigma_h_m: FloatArray
    sigma_v_m: FloatArray
    corner_m: FloatArray
    cell_m: float


@dataclass(frozen=True)
class MapPoints:
    """Points to mark on a map: cameras (K, 2) in metres east and north, control and check points."""

    cameras: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    control: plans.NamedPlaces = plans.NO_PLACES
    check: plans.NamedPlaces = plans.NO_PLACES


def write_accuracy_map(
    path: Path, raster: SigmaRaster, points: MapPoints, coordinates: plans.MapCoordinates | None = None
) -> None:
    """Draw horizontal and vertical σ side by side, north up, with cameras, control and check points.

    Errors of the points are arrows: horizontal ones on the left, vertical ones, up and down, on the right.
    The axes have coordinates of a CRS; None: metres of a local frame.
    """
    rows, columns = raster.sigma_h_m.shape
    corners = np.stack([raster.corner_m, raster.corner_m + raster.cell_m * np.array([columns, rows])])
    places = (corners, points.cameras, points.control.place_m, points.check.place_m)
    frame = plans.frame_around(*places, narrowest=_NARROWEST, margin=_MARGIN, least_m=0.0)
    low, high = frame.low, frame.high
    width, height = (_MAP * (high - low) / frame.longer_m).tolist()
    size = (2 * (_LEFT + width + _RIGHT), _BELOW + height + _ABOVE)
    figure = look.new_figure(size, None)
    figure.suptitle("Predicted accuracy, 1 σ", fontsize=look.HEADING_POINTS, y=1 - _HEADING_DEPTH / size[1])
    maps = (("σ H", "horizontal", raster.sigma_h_m, (0, 1)), ("σ V", "vertical", raster.sigma_v_m, (2,)))
    for number, (symbol, direction, sigma_m, errors_along) in enumerate(maps):
        left = _LEFT + number * size[0] / 2
        axes = figure.add_axes(_share(size, left, width, height))
        bar = figure.add_axes(_share(size, left + width + _BAR_GAP, _BAR_WIDTH, height))
        _draw_sigma(figure, axes, bar, corners, sigma_m, text=f"{symbol} in m")
        _mark(axes, points)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        named = [group.place_m[: len(group.names)] for group in (points.check, points.control)]
        names = [*points.check.names, *points.control.names]
        plans.add_names(figure, axes, np.concatenate(named), names, points.cameras)
        factor = _draw_errors(axes, points, errors_along, frame.longer_m)
        arrows = "" if factor is None else f"; arrows: errors × {factor:,g}"
        look.label(
            axes,
            f"{symbol}, {direction}{arrows}",
        )
        plans.write_axes(axes, coordinates, (_ticks_on(width), _ticks_on(height)))
        draw_north(figure, axes)
        draw_scale_bar(axes)
    look.add_key(figure, 3, loc="center", bbox_to_anchor=(0.5, _LEGEND_HEIGHT / figure.get_figheight()))
    look.write_png(figure, path)


def _ticks_on(side: float) -> int:
    return max(round(_MOST_TICKS * side / _MAP), 2)


def _share(
    size: tuple[float, float], left: float, width: float, height: float
) -> tuple[float, float, float, float]:
    """Left, lower edge, width and height in parts of the picture, of axes above the room for labels."""
    return left / size[0], _BELOW / size[1], width / size[0], height / size[1]


def _draw_sigma(
    figure: Figure, axes: Axes, bar: Axes, corners: FloatArray, sigma_m: FloatArray, *, text: str
) -> None:
    """Draw σ (R, C) between two corners (2, 2), with its scale."""
    west, east, south, north = corners.T.ravel().tolist()
    axes.set_facecolor(look.EMPTY_COLOUR)
    image = axes.imshow(
        np.ma.masked_invalid(sigma_m),
        cmap=look.COLOUR_MAP,
        origin="lower",
        extent=(west, east, south, north),
        interpolation="nearest",
        aspect="equal",
    )
    look.add_scale(figure, image, text, cax=bar)
    for each in (axes, bar):
        each.ticklabel_format(useOffset=False, style="plain")


def _mark(axes: Axes, points: MapPoints) -> None:
    size = min(max(_LARGEST_SIGN * _LARGE_SIGNS / max(len(points.cameras), 1), _SMALLEST_SIGN), _LARGEST_SIGN)

    def named(name: str, places: plans.NamedPlaces, arrow: str) -> str:
        return name if places.error_m is None else f"{name}, with {arrow}"

    kinds: tuple[tuple[str, FloatArray, Mapping[str, Any]], ...] = (
        ("camera", points.cameras, {**_CAMERAS, "s": size}),
        (named("check point", points.check, "its triangulated error"), points.check.place_m, plans.CHECK_SIGN),
        (named("control point", points.control, "its residual"), points.control.place_m, plans.CONTROL_SIGN),
    )
    for name, places, style in kinds:
        if len(places):
            axes.scatter(places[:, 0], places[:, 1], label=name, zorder=4, **style)


def _draw_errors(axes: Axes, points: MapPoints, along: tuple[int, ...], side_m: float) -> float | None:
    """Draw the errors along the map's axes, or up and down; return their exaggeration, None without errors."""
    groups = []
    for group in (points.control, points.check):
        none = np.full((len(group.place_m), len(along)), np.nan)
        groups.append((group, none if group.error_m is None else group.error_m[:, along]))
    factor = exaggeration(np.concatenate([np.linalg.norm(errors_m, axis=1) for _, errors_m in groups]), side_m)
    for group, errors_m in groups if factor is not None else ():
        known = np.isfinite(errors_m).all(axis=1)
        plan_m = errors_m if len(along) == 2 else np.column_stack([np.zeros(len(errors_m)), errors_m])
        style = {"edgecolor": "white", "linewidth": 0.4, "width": 0.006, "zorder": 5}
        colour = look.ORANGE if group is points.control else look.DARK
        if known.any():
            look.add_arrows(axes, group.place_m[known], (factor or 1.0) * plan_m[known], color=colour, **style)
    return factor


_PICTURE = 3.3  # inches: longer side of a raster on the cover
_PICTURE_DOTS = 220


@dataclass(frozen=True)
class RasterPlace:
    """Place of a picture: bounds west, south, east, north in a CRS, and metres of its unit along both axes."""

    crs: str
    names: tuple[str, str]
    unit: str
    bounds: tuple[float, float, float, float]
    unit_m: tuple[float, float]


def raster_map(
    rgba: ByteArray, place: RasterPlace, title: str, heights: tuple[float, float, str] | None = None
) -> bytes:
    """Return the picture (H, W, 4) of a raster with coordinates, north arrow and scale bar, as PNG.

    `heights` are those at the ends of the colours (turbo), with their unit: the legend.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    west, south, east, north = place.bounds
    sides_m = np.array([(east - west) * place.unit_m[0], (north - south) * place.unit_m[1]])
    width, height = (_PICTURE * sides_m / sides_m.max()).tolist()
    left, right, below, above = 1.0, 1.0 if heights else 0.2, 0.6, 0.45
    size = (left + width + right, below + height + above)
    figure = look.new_figure(size, None, dots_per_inch=_PICTURE_DOTS)
    axes = figure.add_axes((left / size[0], below / size[1], width / size[0], height / size[1]))
    axes.imshow(rgba, extent=(0.0, sides_m[0], 0.0, sides_m[1]), interpolation="antialiased", aspect="auto")
    look.label(axes, title)
    unit_m = np.array(place.unit_m)
    coordinates = plans.MapCoordinates(
        place.crs, place.names, place.unit, lambda metres: np.array([west, south]) + metres / unit_m
    )
    plans.write_axes(axes, coordinates, (max(round(3 * width / _PICTURE), 2), max(round(5 * height / _PICTURE), 2)))
    draw_scale_bar(axes)
    draw_north(figure, axes)
    if heights is not None:
        low, high, unit = heights
        colours = ListedColormap(pale(colormaps["turbo"](np.linspace(0, 1, 256))[:, :3]))
        bar = figure.add_axes(_share_of(size, (left + width + _BAR_GAP, below, _BAR_WIDTH, height)))
        scale = ScalarMappable(Normalize(low, high), colours)
        look.add_scale(figure, scale, f"height in {unit}", cax=bar, extend="both")
    return look.png_of(figure)


def _share_of(
    size: tuple[float, float], box: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    return box[0] / size[0], box[1] / size[1], box[2] / size[0], box[3] / size[1]


_COLOUR = {"removed": look.ORANGE, "added": look.BLUE}
_MEANING = {"removed": "only in the LiDAR", "added": "only in the photographs"}
_MOST_POINTS = 40_000
_NAMED = 12


@dataclass(frozen=True)
class DrawnArea:
    """Changed area, which only the LiDAR has (`removed`) or only the photographs have (`added`).

    `corner_in_geo` (C, 2) are the south-western corners of its cells, east and north in metres.
    """

    kind: Literal["removed", "added"]
    area_m2: float
    corner_in_geo: FloatArray
    cell_m: float


def write_lidar_map(path: Path, points_in_geo: FloatArray, areas: Sequence[DrawnArea]) -> None:
    """Write the map of a cloud (P, 3) by height, with changed areas, the largest first; an OSError: it fails."""
    from matplotlib.collections import PolyCollection

    step = max(1, len(points_in_geo) // _MOST_POINTS)
    drawn = points_in_geo[::step]
    figure, axes = plans.new_plan(plans.frame_around(drawn), "LiDAR against photographs", legend_rows=1)
    low, high = np.quantile(drawn[:, 2], [0.02, 0.98])
    shade = 0.93 - 0.55 * np.clip((drawn[:, 2] - low) / max(high - low, 1e-6), 0, 1)
    axes.scatter(
        drawn[:, 0], drawn[:, 1], s=1.2, c=np.repeat(shade[:, None], 3, axis=1), linewidths=0, rasterized=True
    )
    axes.scatter([], [], s=12, color=look.GREY, label="LiDAR, dark: high")
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    for kind, meaning in _MEANING.items():
        mine = [area for area in areas if area.kind == kind]
        total_m2 = sum(area.area_m2 for area in mine)
        if mine:
            corners = np.concatenate([area.corner_in_geo[:, None] + area.cell_m * square for area in mine])
            cells = PolyCollection(list(corners), facecolors=_COLOUR[kind], edgecolors="none", label="", zorder=4)
            axes.add_collection(cells)
        axes.scatter([], [], s=24, marker="s", color=_COLOUR[kind], label=f"{meaning}: {total_m2:.0f} m²")
    middles = [area.corner_in_geo.mean(axis=0) + area.cell_m / 2 for area in areas[:_NAMED]]
    if middles:
        names = [f"{area.area_m2:.0f} m²" for area in areas[:_NAMED]]
        plans.add_names(figure, axes, np.array(middles), names, np.zeros((0, 2)))
    plans.add_bearings(axes)
    plans.add_legend(figure)
    look.write_png(figure, path)
