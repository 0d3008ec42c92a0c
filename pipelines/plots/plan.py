"""Plans: axes with east to the right and north up, with north arrow, scale bar and names that do not overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, log10
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.plots.style import DARK, FIGURE_POINTS, TICK_POINTS, label, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

LONGER_INCHES = 6.2
_LEFT, _RIGHT, _BELOW, _ABOVE = 0.85, 0.25, 0.6, 0.4  # around the map, in inches
_LEGEND_ROW = 0.22
_NARROWEST = 0.45  # shorter side of a map over its longer one
_MARGIN = 0.06  # of the longer side, around everything that is shown
_BAR_SHARE = 0.25  # of the width, that the scale bar takes at most
_SIDES = ((1, 1), (-1, 1), (1, -1), (-1, -1))  # of a sign, where its name may stand
_SIGN_DOTS = 4.0  # half the width of a sign
_BOX = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}


@dataclass(frozen=True)
class Frame:
    """South-western and north-eastern corner (2,) of a plan, in metres."""

    low: FloatArray
    high: FloatArray

    @property
    def longer_m(self) -> float:
        """Longer side."""
        return float((self.high - self.low).max())


def frame_around(*places: FloatArray) -> Frame:
    """Return the frame around groups of places (N, 2) in metres; a margin is added, and no side is too narrow."""
    everything = np.concatenate([np.zeros((0, 2)), *(np.asarray(group)[:, :2] for group in places)])
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        everything = np.zeros((1, 2))
    low, high = everything.min(axis=0), everything.max(axis=0)
    longer = max(float((high - low).max()), 1.0)
    half = np.maximum(high - low, _NARROWEST * longer) / 2 + _MARGIN * longer
    return Frame((low + high) / 2 - half, (low + high) / 2 + half)


def new_plan(frame: Frame, title: str, *, right_inches: float = 0.0, legend_rows: int = 0) -> tuple[Figure, Axes]:
    """Return a figure with the axes of a plan.

    Args:
        frame: that the axes show.
        title: above them.
        right_inches: room beside the map, for a colour bar.
        legend_rows: rows of the legend below the map.
    """
    width, height = (LONGER_INCHES * (frame.high - frame.low) / frame.longer_m).tolist()
    below = _BELOW + _LEGEND_ROW * (legend_rows + 0.4 * bool(legend_rows))
    size = (_LEFT + width + _RIGHT + right_inches, below + height + _ABOVE)
    figure = new_figure(size, None)
    axes = figure.add_axes((_LEFT / size[0], below / size[1], width / size[0], height / size[1]))
    label(axes, title, x="east of the survey's origin in m", y="north of the survey's origin in m")
    axes.set_xlim(frame.low[0], frame.high[0])
    axes.set_ylim(frame.low[1], frame.high[1])
    axes.set_aspect("equal")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params("x", nbins=max(round(8 * width / LONGER_INCHES), 3))
    return figure, axes


def bar_axes(figure: Figure, axes: Axes) -> Axes:
    """Return the axes of a colour bar beside a plan that has room for it."""
    place, width = axes.get_position(), figure.get_figwidth()
    return figure.add_axes((place.x1 + 0.1 / width, place.y0, 0.16 / width, place.height))


def add_bearings(axes: Axes) -> None:
    """Add north arrow and scale bar to a plan, inside its upper corners."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    width, height = east - west, north - south
    length = nice_number(_BAR_SHARE * width)
    left, top = west + 0.03 * width, north - 0.035 * max(width, height)
    tick = 0.008 * max(width, height)
    style: dict[str, Any] = {"color": DARK, "linewidth": 1.6, "zorder": 9, "solid_capstyle": "butt"}
    axes.plot([left, left + length], [top, top], **style)
    for end in (left, left + length):
        axes.plot([end, end], [top - tick, top + tick], **style)
    axes.text(
        left + length / 2,
        top - 2 * tick,
        f"{length:g} m",
        ha="center",
        va="top",
        fontsize=TICK_POINTS,
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
        fontsize=TICK_POINTS + 1,
        fontweight="bold",
        arrowprops={"arrowstyle": "-|>", "color": DARK, "linewidth": 1.4},
        bbox=_BOX,
        zorder=9,
    )


def add_legend(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """Add the legend of a plan below it."""
    handles, names = axes.get_legend_handles_labels()
    if names:
        figure.legend(
            handles,
            names,
            loc="lower center",
            bbox_to_anchor=(0.5, 0.04 / figure.get_figheight()),
            ncols=min(columns, len(names)),
            fontsize=TICK_POINTS,
            frameon=False,
        )


def add_names(figure: Figure, axes: Axes, places: FloatArray, names: Sequence[str], others: FloatArray) -> int:
    """Write names beside places (N, 2), as many as cover no sign and no other name, and return their number.

    Args:
        figure: of the axes.
        axes: of the plan, with its limits.
        places: (N, 2) metres.
        names: N.
        others: (M, 2) places of further signs, in metres.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]
    taken = [text.get_window_extent(renderer) for text in axes.texts]
    signs = axes.transData.transform(np.concatenate([places, others]))
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
                fontsize=FIGURE_POINTS,
                color=DARK,
                zorder=8,
                parse_math=False,  # A name may hold what is a formula elsewhere.
            )
            box = text.get_window_extent(renderer)
            free = not any(box.overlaps(other) for other in taken) and not _holds_any(box, signs)
            if free and inside.contains(box.x0, box.y0) and inside.contains(box.x1, box.y1):
                taken.append(box)
                written += 1
                break
            text.remove()
    return written


def _holds_any(box: Bbox, places: FloatArray) -> bool:
    """Return whether a sign at places (N, 2) in dots touches a box."""
    low, high = np.array([box.x0, box.y0]) - _SIGN_DOTS, np.array([box.x1, box.y1]) + _SIGN_DOTS
    return bool(((places > low) & (places < high)).all(axis=1).any())


def nice_number(most: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above `most` > 0."""
    power = 10.0 ** floor(log10(most))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most * (1 + 1e-9)))
