"""Map of the places where LiDAR and photographs contradict each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.plots.plan import add_bearings, add_legend, add_names, frame_around, new_plan
from pipelines.plots.style import BLUE, GREY, ORANGE, write_png

_COLOUR = {"removed": ORANGE, "added": BLUE}
_MEANING = {"removed": "only in the LiDAR", "added": "only in the photographs"}
_MOST_POINTS = 40_000
_NAMED = 12


@dataclass(frozen=True)
class DrawnArea:
    """Changed area.

    Attributes:
        kind: `removed`: only the LiDAR has it; `added`: only the photographs have it.
        area_m2: in plan.
        corner_in_geo: (C, 2) south-western corners of its cells, east and north in metres.
        cell_m: side of these cells.
    """

    kind: Literal["removed", "added"]
    area_m2: float
    corner_in_geo: FloatArray
    cell_m: float


def write_lidar_map(path: Path, points_in_geo: FloatArray, areas: Sequence[DrawnArea]) -> None:
    """Write the map as PNG.

    Args:
        path: of the picture.
        points_in_geo: (P, 3) cloud, drawn by its height.
        areas: that have changed, the largest first.

    Raises:
        OSError: the picture cannot be written.
    """
    from matplotlib.collections import PolyCollection

    step = max(1, len(points_in_geo) // _MOST_POINTS)
    drawn = points_in_geo[::step]
    figure, axes = new_plan(frame_around(drawn), "LiDAR against photographs", legend_rows=1)
    low, high = np.quantile(drawn[:, 2], [0.02, 0.98])
    shade = 0.93 - 0.55 * np.clip((drawn[:, 2] - low) / max(high - low, 1e-6), 0, 1)
    axes.scatter(
        drawn[:, 0], drawn[:, 1], s=1.2, c=np.repeat(shade[:, None], 3, axis=1), linewidths=0, rasterized=True
    )
    axes.scatter([], [], s=12, color=GREY, label="LiDAR, dark: high")
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
        add_names(figure, axes, np.array(middles), names, np.zeros((0, 2)))
    add_bearings(axes)
    add_legend(figure, axes)
    write_png(figure, path)
