"""Bar charts as PNG files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.plots.style import FIGURE_POINTS, SERIES_COLOURS, TICK_POINTS, label, new_figure, write_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANEL_INCHES = (4.6, 4.2)
_WIDE_RANGE = 20.0  # between the largest and the smallest bar: beyond, only a logarithmic axis shows both


@dataclass(frozen=True)
class Panel:
    """One chart: a group of bars for each member, a bar for each series.

    Attributes:
        title: above it.
        axis: what the bars measure, with its unit.
        members: names of the G groups.
        series: by name, G heights; None leaves a gap.
        digits: decimals of the figures on the bars.
        least: where a linear axis begins.
    """

    title: str
    axis: str
    members: tuple[str, ...]
    series: Mapping[str, Sequence[float | None]]
    digits: int = 3
    least: float = 0.0


def write_bars(path: Path, panels: Sequence[Panel]) -> None:
    """Draw the panels side by side; a file that is there is replaced when the new one is complete."""
    width, height = _PANEL_INCHES
    figure = new_figure((width * len(panels), height), "constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw(axes, panel)
    write_png(figure, path)


def _draw(axes: Axes, panel: Panel) -> None:
    _scale(axes, panel)
    width = 0.8 / len(panel.series)
    for position, (name, values) in enumerate(panel.series.items()):
        heights = {index: value for index, value in enumerate(values) if value is not None}
        left = [index + (position - (len(panel.series) - 1) / 2) * width for index in heights]
        colour = SERIES_COLOURS[position]
        bars = axes.bar(left, list(heights.values()), 0.94 * width, color=colour, label=name)
        figures = [f"{value:.{panel.digits}f}" for value in heights.values()]
        turn = 90 if len(panel.series) > 1 else 0
        axes.bar_label(bars, figures, padding=2, fontsize=FIGURE_POINTS, rotation=turn)
    label(axes, panel.title, y=panel.axis)
    axes.set_xticks(range(len(panel.members)), panel.members)
    axes.spines[["top", "right"]].set_visible(False)
    if len(panel.series) > 1:
        below = (0.5, -0.08)
        axes.legend(
            frameon=False, fontsize=TICK_POINTS, loc="upper center", bbox_to_anchor=below, ncols=len(panel.series)
        )


def _scale(axes: Axes, panel: Panel) -> None:
    """A logarithmic axis where bars of unlike size would vanish on a linear one."""
    heights = [value for values in panel.series.values() for value in values if value is not None]
    if heights and min(heights) > 0 and max(heights) > _WIDE_RANGE * min(heights):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(min(heights) / 2, max(heights) * 3)
    elif heights:
        axes.set_ylim(panel.least, panel.least + 1.18 * max(max(heights) - panel.least, 1e-9))
