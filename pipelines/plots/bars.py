"""Bar charts as PNG files, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = ("#2b6cb0", "#dd8a3b", "#4f9d69")
_PANEL_INCHES = (4.6, 4.2)
_DOTS_PER_INCH = 130
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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_PANEL_INCHES[0] * len(panels), _PANEL_INCHES[1]), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for place, panel in zip(axes, panels, strict=True):
        _draw(place, panel)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    with draft.open("wb") as handle:
        FigureCanvasAgg(figure).print_png(handle, metadata={"Software": None})
    draft.replace(path)


def _draw(axes: Axes, panel: Panel) -> None:
    heights = [value for values in panel.series.values() for value in values if value is not None]
    if heights and min(heights) > 0 and max(heights) > _WIDE_RANGE * min(heights):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(min(heights) / 2, max(heights) * 3)
    elif heights:
        axes.set_ylim(panel.least, panel.least + 1.18 * max(max(heights) - panel.least, 1e-9))
    width = 0.8 / len(panel.series)
    for place, (name, values) in enumerate(panel.series.items()):
        shown = [(index, value) for index, value in enumerate(values) if value is not None]
        left = [index + (place - (len(panel.series) - 1) / 2) * width for index, _ in shown]
        bars = axes.bar(left, [value for _, value in shown], 0.94 * width, color=_COLOURS[place], label=name)
        labels = [f"{value:.{panel.digits}f}" for _, value in shown]
        axes.bar_label(bars, labels, padding=2, fontsize=7, rotation=90 if len(panel.series) > 1 else 0)
    axes.set_xticks(range(len(panel.members)), panel.members)
    axes.set_title(panel.title, fontsize=11)
    axes.set_ylabel(panel.axis)
    axes.spines[["top", "right"]].set_visible(False)
    if len(panel.series) > 1:
        below = (0.5, -0.08)
        axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=below, ncols=len(panel.series))
