"""Plans of a survey: where it is, how the cameras moved, how often the ground is seen, how photographs are tied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.plots.plan import add_bearings, add_legend, add_names, bar_axes, frame_around, new_plan, nice_number
from pipelines.plots.style import (
    BLUE,
    COLOUR_MAP,
    DARK,
    EMPTY_COLOUR,
    GREY,
    LABEL_POINTS,
    ORANGE,
    TICK_POINTS,
    png_of,
)

_BAR_ROOM = 0.9  # inches
_ARROW_SHARE, _ELLIPSE_SHARE = 0.08, 0.02  # of the longer side: the largest arrow, the median semi-axis
_OVERLAP_STEPS = (1, 2, 3, 4, 5, 7, 10, 15, 20)


@dataclass(frozen=True)
class NamedPlaces:
    """Names and places (N, 2), east and north in metres, of surveyed points."""

    names: Sequence[str]
    place_m: FloatArray


@dataclass(frozen=True)
class DrawnMovement:
    """Map of the cameras' movements, with its magnifications; None: nothing of the kind is drawn."""

    png: bytes
    arrow_factor: float | None
    ellipse_factor: float | None


def site_plan(
    training_m: FloatArray, test_m: FloatArray, control: NamedPlaces, check: NamedPlaces, scene_m: FloatArray
) -> bytes:
    """Return the plan of a survey as PNG.

    Args:
        training_m, test_m: (n, 2) cameras of the photographs.
        control, check: surveyed points.
        scene_m: (N, 2) points of the scene, drawn as its ground.
    """
    frame = frame_around(training_m, test_m, control.place_m, check.place_m)
    figure, axes = new_plan(frame, "Photographs and surveyed points", legend_rows=1)
    axes.scatter(scene_m[:, 0], scene_m[:, 1], s=1.5, color=GREY, alpha=0.6, linewidths=0, rasterized=True)
    size = float(np.clip(2600 / max(len(training_m), 1), 7, 24))
    styles: tuple[tuple[str, FloatArray, dict[str, Any]], ...] = (
        ("photograph for training", training_m, {"marker": "x", "s": size, "color": BLUE, "linewidths": 0.9}),
        (
            "test view",
            test_m,
            {"marker": "s", "s": size, "facecolors": "none", "edgecolors": BLUE, "linewidths": 0.9},
        ),
        (
            "control point",
            control.place_m,
            {"marker": "^", "s": 42, "color": ORANGE, "edgecolors": "black", "linewidths": 0.8},
        ),
        (
            "check point",
            check.place_m,
            {"marker": "o", "s": 28, "color": "white", "edgecolors": "black", "linewidths": 0.9},
        ),
    )
    for order, (name, places, style) in enumerate(styles):
        if len(places):
            axes.scatter(places[:, 0], places[:, 1], label=name, zorder=3 + order, **style)
    add_bearings(axes)
    marked = np.concatenate([control.place_m, check.place_m])
    add_names(figure, axes, marked, [*control.names, *check.names], np.concatenate([training_m, test_m]))
    add_legend(figure, axes)
    return png_of(figure)


def movement_plan(
    center_m: FloatArray, moved_m: FloatArray, covariance: FloatArray | None, is_outlier: BoolArray
) -> DrawnMovement:
    """Return the plan of the cameras with arrows from measured to adjusted positions, and their error ellipses.

    Args:
        center_m: (n, 2) adjusted positions.
        moved_m: (n, 2) adjusted minus measured; NaN: not measured.
        covariance: (n, 2, 2) m² of the adjusted positions in plan; None: not known.
        is_outlier: (n,) whether the solution has left the measured position out.
    """
    from matplotlib.collections import EllipseCollection

    frame = frame_around(center_m)
    figure, axes = new_plan(frame, "Adjusted positions of the photographs", legend_rows=2)
    axes.scatter(center_m[:, 0], center_m[:, 1], s=5, color=DARK, zorder=3, label="adjusted position")
    known = np.isfinite(moved_m).all(axis=1)
    arrow_factor = ellipse_factor = None
    used = known & ~is_outlier
    sized = used if used.any() else known  # the arrow of an outlier may leave the map
    largest = float(np.linalg.norm(moved_m[sized], axis=1).max()) if known.any() else 0.0
    if largest > 0:
        arrow_factor = nice_number(_ARROW_SHARE * frame.longer_m / largest)
        for chosen, colour, name in (
            (known & ~is_outlier, BLUE, "from measured to adjusted"),
            (known & is_outlier, ORANGE, "the same, left out as an outlier"),
        ):
            if chosen.any():
                start, arrow = center_m[chosen] - arrow_factor * moved_m[chosen], arrow_factor * moved_m[chosen]
                axes.quiver(
                    *start.T,
                    *arrow.T,
                    angles="xy",
                    scale_units="xy",
                    scale=1,
                    color=colour,
                    width=0.003,
                    zorder=4,
                    label=f"{name} (× {arrow_factor:g})",
                )
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
                    edgecolors=DARK,
                    linewidths=0.7,
                )
            )
            axes.plot([], [], "o", mfc="none", mec=DARK, label=f"1 σ ellipse (× {ellipse_factor:g})")
    add_bearings(axes)
    add_legend(figure, axes, columns=2)
    return DrawnMovement(png_of(figure), arrow_factor, ellipse_factor)


def overlap_plan(count: IntArray, corner_m: FloatArray, cell_m: float, camera_m: FloatArray) -> bytes:
    """Return the map of the number of photographs that see each cell of the ground, as PNG.

    Args:
        count: (R, C) rows from the south, columns from the west; −1: no scene.
        corner_m: (2,) east and north of the south-western corner.
        cell_m: side of a cell.
        camera_m: (n, 2) cameras.
    """
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm

    rows, columns = count.shape
    far = corner_m + cell_m * np.array([columns, rows])
    figure, axes = new_plan(frame_around(np.stack([corner_m, far])), "Overlap", right_inches=_BAR_ROOM)
    axes.set_facecolor(EMPTY_COLOUR)
    edges = [0, *_OVERLAP_STEPS, max(_OVERLAP_STEPS[-1] + 1, int(count.max()) + 1)]
    image = axes.imshow(
        np.ma.masked_less(count, 0),
        cmap=colormaps[COLOUR_MAP],
        norm=BoundaryNorm(edges, colormaps[COLOUR_MAP].N),
        origin="lower",
        extent=(corner_m[0], far[0], corner_m[1], far[1]),
        interpolation="nearest",
    )
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    axes.scatter(camera_m[:, 0], camera_m[:, 1], s=6, color="white", edgecolors=DARK, linewidths=0.5)
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)
    bar = figure.colorbar(image, cax=bar_axes(figure, axes))
    bar.set_ticks(
        ticks=[(low + high) / 2 for low, high in pairwise(edges)],
        labels=[str(low) if high == low + 1 else f"{low}–{high - 1}" for low, high in pairwise(edges)],
    )
    bar.set_label("photographs that see the cell", fontsize=LABEL_POINTS)
    bar.ax.tick_params(labelsize=TICK_POINTS)
    add_bearings(axes)
    return png_of(figure)


def match_plan(camera_m: FloatArray, pairs: IntArray, shared: IntArray) -> bytes:
    """Return the graph of the photographs that share points, as PNG: strong links last, dark and thick.

    Args:
        camera_m: (n, 2) cameras.
        pairs: (P, 2) indices of cameras.
        shared: (P,) number of points that both see, at least 1.
    """
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm

    figure, axes = new_plan(frame_around(camera_m), "Photographs that share points", right_inches=_BAR_ROOM)
    order = np.argsort(shared, kind="stable")
    most = max(int(shared.max()), 2) if len(shared) else 2
    norm, reversed_map = LogNorm(1, most), colormaps[f"{COLOUR_MAP}_r"]
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
    axes.scatter(camera_m[:, 0], camera_m[:, 1], s=10, color="white", edgecolors=DARK, linewidths=0.7, zorder=3)
    bar = figure.colorbar(lines, cax=bar_axes(figure, axes))
    bar.set_label("points that two photographs share", fontsize=LABEL_POINTS)
    bar.ax.tick_params(labelsize=TICK_POINTS)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    add_bearings(axes)
    return png_of(figure)
