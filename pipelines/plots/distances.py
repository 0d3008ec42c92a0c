"""Distances between two surfaces: as a map and as histograms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.plots.plan import add_bearings, bar_axes, frame_around, new_plan
from pipelines.plots.style import (
    BLUE,
    DARK,
    EMPTY_COLOUR,
    GREY,
    LABEL_POINTS,
    ORANGE,
    TICK_POINTS,
    label,
    new_figure,
    write_png,
)

_MOST_CELLS = 600  # along the longer side of the map
_SCALE_QUANTILE = 0.95
_BINS = 121
_COLOURS = (BLUE, ORANGE, DARK, "#3a9d6e", GREY)


def write_distance_map(path: Path, place_m: FloatArray, distance_m: FloatArray, size_m: float) -> None:
    """Write the map of signed distances: blue below zero, red above.

    Args:
        path: of the PNG.
        place_m: (C, 2) east and north, C ≥ 1.
        distance_m: (C,).
        size_m: least side of a cell, which shows the median of its distances.
    """
    frame = frame_around(place_m)
    cell_m = max(size_m, frame.longer_m / _MOST_CELLS)
    raster = _medians(place_m, distance_m, frame.low, frame.high, cell_m)
    limit_m = _round_up(float(np.quantile(np.abs(distance_m), _SCALE_QUANTILE)))
    figure, axes = new_plan(frame, "Model minus reference along the normals (M3C2)", right_inches=1.0)
    axes.set_facecolor(EMPTY_COLOUR)
    rows, columns = raster.shape
    east, north = frame.low.tolist()
    image = axes.imshow(
        raster,
        origin="lower",
        extent=(east, east + columns * cell_m, north, north + rows * cell_m),
        cmap="RdBu_r",
        vmin=-limit_m,
        vmax=limit_m,
        interpolation="nearest",
    )
    axes.set_xlim(frame.low[0], frame.high[0])
    axes.set_ylim(frame.low[1], frame.high[1])
    bar = figure.colorbar(image, cax=bar_axes(figure, axes), extend="both")
    bar.set_label("m; above 0: the model lies before the reference", fontsize=LABEL_POINTS)
    bar.ax.tick_params(labelsize=TICK_POINTS)
    add_bearings(axes)
    write_png(figure, path)


def write_distance_histogram(path: Path, groups: Mapping[str, FloatArray], lod_m: float) -> None:
    """Write the densities of signed distances by group, and the band of the level of detection.

    Args:
        path: of the PNG.
        groups: distances (C,) by name, none empty.
        lod_m: median level of detection, 95 %.
    """
    everything = np.concatenate(list(groups.values()))
    limit_m = _round_up(max(float(np.quantile(np.abs(everything), 0.98)), 1.5 * lod_m))
    edges = np.linspace(-limit_m, limit_m, _BINS + 1)
    figure = new_figure((6.2, 3.4), "constrained")
    axes = figure.add_subplot()
    axes.axvspan(-lod_m, lod_m, color=EMPTY_COLOUR, label="level of detection (median, 95 %)")
    for (name, distance_m), colour in zip(groups.items(), _COLOURS, strict=False):
        count, _ = np.histogram(np.clip(distance_m, -limit_m, limit_m), edges)
        density = count / (len(distance_m) * (edges[1] - edges[0]))
        axes.stairs(density, edges, color=colour, linewidth=1.4, label=f"{name} ({len(distance_m)})")
        axes.axvline(float(np.median(distance_m)), color=colour, linewidth=0.8, linestyle=":")
    axes.set_ylim(bottom=0)
    axes.set_xlim(-limit_m, limit_m)
    label(axes, "", x="model minus reference in m (dotted: median; ends hold all beyond)", y="density in 1/m")
    axes.legend(fontsize=TICK_POINTS, frameon=False)
    write_png(figure, path)


def _medians(
    place_m: FloatArray, values: FloatArray, low: FloatArray, high: FloatArray, cell_m: float
) -> FloatArray:
    """Return the medians (R, C) of values in cells, rows from the south; NaN: none."""
    columns, rows = (np.ceil((high - low) / cell_m).astype(int)).tolist()
    raster = np.full((rows, columns), np.nan)
    cell = np.floor((place_m - low) / cell_m).astype(np.int64)
    order = np.lexsort((values, cell[:, 0], cell[:, 1]))
    key = (cell[:, 1] * columns + cell[:, 0])[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    last = np.append(first[1:], len(key)) - 1
    ordered = values[order]
    raster.flat[key[first]] = (ordered[(first + last) // 2] + ordered[(first + last + 1) // 2]) / 2
    return raster


def _round_up(value: float) -> float:
    """Return the next 1, 2 or 5 times a power of ten that is not below a value; 0.01 at the least."""
    power = 10.0 ** np.floor(np.log10(max(value, 0.01)))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= max(value, 0.01) * (1 - 1e-9)))
