"""One look for all pictures: sizes, colours, and a way to the file that gives equal bytes for equal figures.

Figures are drawn on canvas objects of their own, so that no display, no pyplot and no global state is involved.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipelines.core.files import replacing
from pipelines.core.types import ByteArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colorbar import Colorbar
    from matplotlib.figure import Figure

# Blue and orange stay apart with every kind of colour blindness, and the third by its lightness.
BLUE, ORANGE, DARK, GREY = "#2b6cb0", "#dd8a3b", "#333333", "#9aa3ad"
SERIES_COLOURS = (BLUE, ORANGE, DARK)
COLOUR_MAP = "viridis"
EMPTY_COLOUR = "#e8e8e8"

HEADING_POINTS, TITLE_POINTS, LABEL_POINTS, TICK_POINTS, FIGURE_POINTS = 12, 11, 9, 8, 7
_DOTS_PER_INCH = 130


def new_figure(
    size_inches: tuple[float, float],
    layout: Literal["constrained"] | None,
    *,
    dots_per_inch: int = _DOTS_PER_INCH,
) -> Figure:
    """Return an empty figure; `constrained` makes room for labels, None leaves the axes where they are put."""
    from matplotlib.figure import Figure

    return Figure(figsize=size_inches, dpi=dots_per_inch, facecolor="white", layout=layout)


def label(axes: Axes, title: str, *, x: str | None = None, y: str | None = None) -> None:
    """Write the title, and the quantity and unit of each axis."""
    axes.set_title(title, fontsize=TITLE_POINTS)
    axes.set_xlabel(x or "", fontsize=LABEL_POINTS)
    axes.set_ylabel(y or "", fontsize=LABEL_POINTS)
    axes.tick_params(labelsize=TICK_POINTS)


def add_scale(figure: Figure, image: ScalarMappable, text: str, **place: Any) -> Colorbar:
    """Add a colour bar with its quantity; `place` are the arguments of matplotlib that put it."""
    bar = figure.colorbar(image, **place)
    bar.set_label(text, fontsize=LABEL_POINTS)
    bar.ax.tick_params(labelsize=TICK_POINTS)
    return bar


def add_key(figure: Figure, columns: int, **place: Any) -> None:
    """Add the legend of the first axes, if they have one, to the figure; `place` is where matplotlib puts it."""
    handles, names = figure.axes[0].get_legend_handles_labels()
    if names:
        columns = min(columns, len(names))
        figure.legend(handles, names, ncols=columns, fontsize=TICK_POINTS, frameon=False, **place)


def add_arrows(axes: Axes, start: FloatArray, arrow: FloatArray, **style: Any) -> None:
    """Draw arrows (N, 2) in the units of the axes at their places (N, 2), in a style of matplotlib's `quiver`."""
    axes.quiver(*start.T, *arrow.T, angles="xy", scale_units="xy", scale=1, **style)


def pixels_of(figure: Figure) -> ByteArray:
    """Return a figure as RGB values (H, W, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas, buffer = FigureCanvasAgg(figure), io.BytesIO()
    figure.savefig(buffer, format="rgba", dpi="figure")
    width, height = canvas.get_width_height()
    return np.frombuffer(buffer.getvalue(), np.uint8).reshape(height, width, 4)[..., :3]


def colours_of(values: FloatArray, low: float, high: float) -> ByteArray:
    """Return the colours (N, 3) of values (N,) on the scale of the maps, from `low` to `high`."""
    from matplotlib import colormaps

    share = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)
    return np.asarray(np.round(255 * colormaps[COLOUR_MAP](share)[:, :3]), dtype=np.uint8)


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG, the same bytes at each call: without the program's name in its metadata."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi="figure", metadata={"Software": None})
    return data.getvalue()


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure; a file that is there is replaced when the new one is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        draft.write_bytes(png_of(figure))
