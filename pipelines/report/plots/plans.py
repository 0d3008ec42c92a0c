"""Plans of a survey: where it is, how the cameras moved, how often the ground is seen, how photographs are tied.

East is to the right and north up, with north arrow, scale bar and names that do not overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, floor, log10
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.report.plots import style as look

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONGER_INCHES = 4.6
_LEFT, _RIGHT, _BELOW, _ABOVE = 0.95, 0.25, 0.6, 0.4  # around the map, in inches
_LEGEND_ROW = 0.22
_NARROWEST = 0.45  # shorter side of a map over its longer one
_MARGIN = 0.06  # of the longer side, around everything that is shown
_BAR_SHARE = 0.25  # of the width, that the scale bar takes at most
_SIDES = ((1, 1), (-1, 1), (1, -1), (-1, -1))  # of a sign, where its name may stand
_SIGN_DOTS = 4.0  # half the width of a sign
CHECK_SIGN = {"marker": "o", "s": 24, "linewidths": 0.8, "color": "white", "edgecolors": "black"}
CONTROL_SIGN = {"marker": "^", "s": 34, "linewidths": 0.8, "color": look.ORANGE, "edgecolors": "black"}
_BOX = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}


@dataclass(frozen=True)
class MapCoordinates:
    """Coordinates of a CRS along the axes of a map: their names, and those of places (N, 2) east and north."""

    crs: str
    names: tuple[str, str]
    unit: str
    of: Callable[[FloatArray], FloatArray]


def write_axes(axes: Axes, coordinates: MapCoordinates | None, most: tuple[int, int]) -> None:
    """Write round coordinates along the lower and the left edge of a map; None: metres of a local frame.

    Where a grid is turned against the map, the ticks are those of the edge.
    """
    from matplotlib.ticker import MaxNLocator

    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    if coordinates is None:
        coordinates = MapCoordinates("local frame", ("x", "y"), "m", lambda positions: positions)
    corner = coordinates.of(np.array([[west, south], [east, south], [west, north]]))
    edges = ((corner[:2, 0], (west, east)), (corner[[0, 2], 1], (south, north)))
    for index, (axis, (ends, side)) in enumerate(zip((axes.xaxis, axes.yaxis), edges, strict=True)):
        low, high = sorted(ends.tolist())
        ticks = MaxNLocator(nbins=most[index], steps=[1, 2, 5, 10]).tick_values(low, high)
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        positions = np.interp(ticks, [low, high], side if ends[0] <= ends[1] else side[::-1])
        step = float(np.diff(ticks).min()) if len(ticks) > 1 else high - low or 1.0
        decimals = max(0, ceil(-log10(step) - 1e-9))
        axis.set_ticks(positions, labels=[f"{value:.{decimals}f}" for value in ticks])
        text = f"{coordinates.names[index]} in {coordinates.unit} ({coordinates.crs})"
        axis.set_label_text(text, fontsize=look.LABEL_POINTS)


@dataclass(frozen=True)
class PlanFrame:
    """South-western and north-eastern corner (2,) of a plan, in metres."""

    low: FloatArray
    high: FloatArray

    @property
    def longer_m(self) -> float:
        return float((self.high - self.low).max())


def frame_around(
    *places: FloatArray, narrowest: float = _NARROWEST, margin: float = _MARGIN, least_m: float = 1.0
) -> PlanFrame:
    """Return the frame around groups of places (N, 2) in metres; NaN rows do not count.

    The shorter side is at least `narrowest` times the longer one, and that `least_m`; `margin` is a part of it.
    """
    everything = np.concatenate([np.zeros((0, 2)), *(np.asarray(group)[:, :2] for group in places)])
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        everything = np.zeros((1, 2))
    low, high = everything.min(axis=0), everything.max(axis=0)
    longer = max(float((high - low).max()), least_m)
    half = np.maximum(high - low, narrowest * longer) / 2 + margin * longer
    return PlanFrame((low + high) / 2 - half, (low + high) / 2 + half)


def new_plan(
    frame: PlanFrame,
    title: str,
    coordinates: MapCoordinates | None = None,
    *,
    right_inches: float = 0.0,
    legend_rows: int = 0,
) -> tuple[Figure, Axes]:
    """Return a figure with the axes of a plan, room for a colour bar beside it, and rows of the legend below."""
    width, height = (LONGER_INCHES * (frame.high - frame.low) / frame.longer_m).tolist()
    below = _BELOW + _LEGEND_ROW * (legend_rows + 0.4 * bool(legend_rows))
    size = (_LEFT + width + _RIGHT + right_inches, below + height + _ABOVE)
    figure = look.new_figure(size, None)
    axes = figure.add_axes((_LEFT / size[0], below / size[1], width / size[0], height / size[1]))
    look.label(axes, title)
    axes.set_xlim(frame.low[0], frame.high[0])
    axes.set_ylim(frame.low[1], frame.high[1])
    axes.set_aspect("equal")
    write_axes(
        axes, coordinates, (max(round(5 * width / LONGER_INCHES), 2), max(round(7 * height / LONGER_INCHES), 2))
    )
    return figure, axes


def bar_axes(figure: Figure, axes: Axes) -> Axes:
    """Return the axes of a colour bar beside a plan that has room for it."""
    box, width = axes.get_position(), figure.get_figwidth()
    return figure.add_axes((box.x1 + 0.1 / width, box.y0, 0.16 / width, box.height))


def add_bearings(axes: Axes) -> None:
    """Add north arrow and scale bar to a plan, inside its upper corners."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    width, height = east - west, north - south
    length = nice_number(_BAR_SHARE * width)
    left, top = west + 0.03 * width, north - 0.035 * max(width, height)
    tick = 0.008 * max(width, height)
    style: dict[str, Any] = {"color": look.DARK, "linewidth": 1.6, "zorder": 9, "solid_capstyle": "butt"}
    axes.plot([left, left + length], [top, top], **style)
    for end in (left, left + length):
        axes.plot([end, end], [top - tick, top + tick], **style)
    axes.text(
        left + length / 2,
        top - 2 * tick,
        f"{length:g} m",
        ha="center",
        va="top",
        fontsize=look.TICK_POINTS,
        bbox=_BOX,
        zorder=9,
    )
    axes.annotate(
        "N",
        xy=(0.965, 0.975),
        xytext=(0.965, 0.89),
        xycoords="axes fraction",
        ha="center",
        va="center",
        fontsize=look.TICK_POINTS + 1,
        fontweight="bold",
        arrowprops={"arrowstyle": "-|>", "color": look.DARK, "linewidth": 1.4},
        bbox=_BOX,
        zorder=9,
    )


def add_legend(figure: Figure, columns: int = 4) -> None:
    """Add the legend of a plan below its axes."""
    look.add_key(figure, columns, loc="lower center", bbox_to_anchor=(0.5, 0.04 / figure.get_figheight()))


def add_names(figure: Figure, axes: Axes, places: FloatArray, names: Sequence[str], others: FloatArray) -> int:
    """Write names beside places (N, 2), as many as cover no sign and no other name, and return their number.

    `others` (M, 2) are places of further symbols.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    taken = [text.get_window_extent(renderer) for text in axes.texts]
    symbols = axes.transData.transform(np.concatenate([places, others]))
    inside, written = axes.get_window_extent(renderer), 0
    for place, name in zip(places, names, strict=True):
        for across, along in _SIDES:
            text = axes.annotate(
                name,
                xy=(float(place[0]), float(place[1])),
                xytext=(5 * across, 5 * along),
                textcoords="offset points",
                ha="left" if across > 0 else "right",
                va="bottom" if along > 0 else "top",
                fontsize=look.FIGURE_POINTS,
                color=look.DARK,
                zorder=8,
                parse_math=False,  # A name may hold what is a formula elsewhere.
            )
            box = text.get_window_extent(renderer)
            around = box.padded(_SIGN_DOTS)
            on_sign = ((symbols > around.min) & (symbols < around.max)).all(axis=1).any()
            free = not on_sign and not any(box.overlaps(other) for other in taken)
            if free and inside.contains(box.x0, box.y0) and inside.contains(box.x1, box.y1):
                taken.append(box)
                written += 1
                break
            text.remove()
    return written


def nice_number(most: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above `most` > 0."""
    power = 10.0 ** floor(log10(most))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most * (1 + 1e-9)))


_BAR_ROOM = 0.9  # inches
_ARROW_SHARE, _ELLIPSE_SHARE = 0.08, 0.02  # of the longer side: the largest arrow, the median semi-axis
_OVERLAP_STEPS = (1, 2, 3, 4, 5, 7, 10, 15, 20)


@dataclass(frozen=True)
class NamedPlaces:
    """Surveyed points to mark on a map."""

    place_m: FloatArray = field(default_factory=lambda: np.empty((0, 2)))  # (K, 2) east and north
    names: Sequence[str] = ()  # empty: none is written
    error_m: FloatArray | None = None  # (K, 3) east, north, up, as arrows; NaN: not measured


NO_PLACES = NamedPlaces()


@dataclass(frozen=True)
class DrawnMovement:
    """Map of the cameras' movements, with its magnifications; None: nothing of the kind is drawn."""

    png: bytes
    arrow_factor: float | None
    ellipse_factor: float | None


def site_plan(  # noqa: PLR0917
    training_m: FloatArray,
    test_m: FloatArray,
    control: NamedPlaces,
    check: NamedPlaces,
    scene_m: FloatArray,
    coordinates: MapCoordinates | None = None,
) -> bytes:
    """Return the plan of a survey with cameras (n, 2) and points as PNG; the scene (N, 2) is its ground."""
    frame = frame_around(training_m, test_m, control.place_m, check.place_m)
    figure, axes = new_plan(frame, "Photographs and surveyed points", coordinates, legend_rows=1)
    axes.scatter(scene_m[:, 0], scene_m[:, 1], s=1.5, color=look.GREY, alpha=0.6, linewidths=0, rasterized=True)
    size = float(np.clip(2600 / max(len(training_m), 1), 7, 24))
    trained: dict[str, Any] = {"marker": "x", "s": size, "color": look.BLUE, "linewidths": 0.9}
    tested = {"marker": "s", "s": size, "facecolors": "none", "edgecolors": look.BLUE, "linewidths": 0.9}
    styles = (
        ("photograph for training", training_m, trained),
        ("test view", test_m, tested),
        ("control point", control.place_m, CONTROL_SIGN),
        ("check point", check.place_m, CHECK_SIGN),
    )
    for order, (name, places, style) in enumerate(styles):
        if len(places):
            axes.scatter(places[:, 0], places[:, 1], label=name, zorder=3 + order, **style)
    add_bearings(axes)
    marked = np.concatenate([control.place_m, check.place_m])
    add_names(figure, axes, marked, [*control.names, *check.names], np.concatenate([training_m, test_m]))
    add_legend(figure)
    return look.png_of(figure)


def movement_plan(
    center_m: FloatArray,
    moved_m: FloatArray,
    covariance: FloatArray | None,
    is_outlier: BoolArray,
    coordinates: MapCoordinates | None = None,
) -> DrawnMovement:
    """Return the plan of the cameras with arrows from measured to adjusted positions, and their error ellipses.

    Adjusted minus measured positions (n, 2) are NaN if not measured; the covariance (n, 2, 2) of the adjusted ones
    is in m², None: unknown. The solution has left outliers (n,) out.
    """
    from matplotlib.collections import EllipseCollection

    frame = frame_around(center_m)
    figure, axes = new_plan(frame, "Adjusted positions of the photographs", coordinates, legend_rows=2)
    axes.scatter(center_m[:, 0], center_m[:, 1], s=5, color=look.DARK, zorder=3, label="adjusted position")
    known = np.isfinite(moved_m).all(axis=1)
    arrow_factor = ellipse_factor = None
    used = known & ~is_outlier
    sized = used if used.any() else known  # the arrow of an outlier may leave the map
    largest = float(np.linalg.norm(moved_m[sized], axis=1).max()) if known.any() else 0.0
    if largest > 0:
        arrow_factor = nice_number(_ARROW_SHARE * frame.longer_m / largest)
        for chosen, colour, name in (
            (known & ~is_outlier, look.BLUE, "from measured to adjusted"),
            (known & is_outlier, look.ORANGE, "the same, left out as an outlier"),
        ):
            if chosen.any():
                start, arrow = center_m[chosen] - arrow_factor * moved_m[chosen], arrow_factor * moved_m[chosen]
                text = f"{name} (× {arrow_factor:g})"
                look.add_arrows(axes, start, arrow, color=colour, width=0.003, zorder=4, label=text)
    if covariance is not None and np.isfinite(covariance).all():
        variance, axis = np.linalg.eigh(covariance)
        semi = np.sqrt(np.maximum(variance, 0.0))
        middle = float(np.median(semi[:, 1]))
        if middle > 0:
            ellipse_factor = nice_number(_ELLIPSE_SHARE * frame.longer_m / middle)
            angle = np.degrees(np.arctan2(axis[:, 1, 1], axis[:, 0, 1]))
            axes.add_collection(
                EllipseCollection(
                    2 * ellipse_factor * semi[:, 1],
                    2 * ellipse_factor * semi[:, 0],
                    angle,
                    units="xy",
                    offsets=center_m,
                    transOffset=axes.transData,
                    facecolors="none",
                    edgecolors=look.DARK,
                    linewidths=0.7,
                )
            )
            axes.plot([], [], "o", mfc="none", mec=look.DARK, label=f"1 σ ellipse (× {ellipse_factor:g})")
    add_bearings(axes)
    add_legend(figure, columns=2)
    return DrawnMovement(look.png_of(figure), arrow_factor, ellipse_factor)


def overlap_plan(
    count: IntArray,
    corner_m: FloatArray,
    cell_m: float,
    camera_m: FloatArray,
    coordinates: MapCoordinates | None = None,
) -> bytes:
    """Return the map of the number of photographs that see each cell of the ground, as PNG.

    Counts (R, C) are by row from the south and column from the west; −1: no scene. Corner (2,) and cameras (n, 2)
    are east and north.
    """
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm

    rows, columns = count.shape
    far = corner_m + cell_m * np.array([columns, rows])
    figure, axes = new_plan(frame_around(np.stack([corner_m, far])), "Overlap", coordinates, right_inches=_BAR_ROOM)
    axes.set_facecolor(look.EMPTY_COLOUR)
    edges = [0, *_OVERLAP_STEPS, max(_OVERLAP_STEPS[-1] + 1, int(count.max()) + 1)]
    image = axes.imshow(
        np.ma.masked_less(count, 0),
        cmap=colormaps[look.COLOUR_MAP],
        norm=BoundaryNorm(edges, colormaps[look.COLOUR_MAP].N),
        origin="lower",
        extent=(corner_m[0], far[0], corner_m[1], far[1]),
        interpolation="nearest",
    )
    axes.scatter(camera_m[:, 0], camera_m[:, 1], s=6, color="white", edgecolors=look.DARK, linewidths=0.5)
    bar = look.add_scale(figure, image, "photographs that see the cell", cax=bar_axes(figure, axes))
    bar.set_ticks(
        ticks=[(low + high) / 2 for low, high in pairwise(edges)],
        labels=[str(low) if high == low + 1 else f"{low}–{high - 1}" for low, high in pairwise(edges)],
    )
    add_bearings(axes)
    return look.png_of(figure)


def match_plan(
    camera_m: FloatArray, pairs: IntArray, shared: IntArray, coordinates: MapCoordinates | None = None
) -> bytes:
    """Return the graph of the photographs that share points, as PNG: strong links last, dark and thick.

    Pairs (P, 2) index the cameras (n, 2); `shared` (P,) is the number of points that both see, at least 1.
    """
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm

    figure, axes = new_plan(
        frame_around(camera_m), "Photographs that share points", coordinates, right_inches=_BAR_ROOM
    )
    order = np.argsort(shared, kind="stable")
    most = max(int(shared.max()), 2) if len(shared) else 2
    norm, reversed_map = LogNorm(1, most), colormaps[f"{look.COLOUR_MAP}_r"]
    strength = np.log(shared[order]) / np.log(most)
    lines = LineCollection(
        list(camera_m[pairs[order]]),
        cmap=reversed_map,
        norm=norm,
        linewidths=0.3 + 1.5 * strength,
        alpha=0.85,
    )
    lines.set_array(shared[order])
    axes.add_collection(lines)
    axes.scatter(
        camera_m[:, 0], camera_m[:, 1], s=10, color="white", edgecolors=look.DARK, linewidths=0.7, zorder=3
    )
    bar = look.add_scale(figure, lines, "points that two photographs share", cax=bar_axes(figure, axes))
    bar.ax.yaxis.set_major_formatter("{x:g}")
    add_bearings(axes)
    return look.png_of(figure)
