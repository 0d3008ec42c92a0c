"""Charts of bars, residuals, correlations, and prediction against measurement; pictures side by side.

Also the distances between two surfaces, as map and histogram.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.report.plots import style as look
from pipelines.report.plots.plans import add_bearings, bar_axes, frame_around, new_plan, nice_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANEL_INCHES = (4.6, 4.2)
_WIDE_RANGE = 20.0  # between the largest and the smallest bar: beyond, only a logarithmic axis shows both


@dataclass(frozen=True)
class BarChart:
    """Group of bars for each member, a bar for each series."""

    title: str
    axis: str  # what the bars measure, with its unit
    members: tuple[str, ...]
    series: Mapping[str, Sequence[float | None]]  # heights of the members; None leaves a gap
    digits: int = 3  # decimals of the figures on the bars


def write_bars(path: Path, panels: Sequence[BarChart]) -> None:
    """Draw the panels side by side; a file that is there is replaced when the new one is complete."""
    width, height = _PANEL_INCHES
    figure = look.new_figure((width * len(panels), height), "constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw(axes, panel)
    look.write_png(figure, path)


def _draw(axes: Axes, panel: BarChart) -> None:
    # A logarithmic axis where bars of unlike size would vanish on a linear one.
    known = [value for values in panel.series.values() for value in values if value is not None]
    if known and min(known) > 0 and max(known) > _WIDE_RANGE * min(known):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(min(known) / 2, max(known) * 3)
    elif known:
        axes.set_ylim(0, 1.18 * max(*known, 1e-9))
    width = 0.8 / len(panel.series)
    for position, (name, values) in enumerate(panel.series.items()):
        heights = {index: value for index, value in enumerate(values) if value is not None}
        left = [index + (position - (len(panel.series) - 1) / 2) * width for index in heights]
        colour = look.SERIES_COLOURS[position]
        bars = axes.bar(left, list(heights.values()), 0.94 * width, color=colour, label=name)
        figures = [f"{value:.{panel.digits}f}" for value in heights.values()]
        turn = 90 if len(panel.series) > 1 else 0
        axes.bar_label(bars, figures, padding=2, fontsize=look.FIGURE_POINTS, rotation=turn)
    look.label(axes, panel.title, y=panel.axis)
    axes.set_xticks(range(len(panel.members)), panel.members)
    axes.spines[["top", "right"]].set_visible(False)
    if len(panel.series) > 1:
        form = {"frameon": False, "fontsize": look.TICK_POINTS, "ncols": len(panel.series)}
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), **form)


_MOST_CELLS = 600  # along the longer side of the map
_SCALE_QUANTILE = 0.95
_BINS = 121
_COLOURS = (look.BLUE, look.ORANGE, look.DARK, "#3a9d6e", look.GREY)


def write_distance_map(path: Path, place_m: FloatArray, distance_m: FloatArray, size_m: float) -> None:
    """Write the map of signed distances (C,) at places (C, 2), east and north, C ≥ 1: blue below zero, red above.

    A cell, whose least side is `size_m`, shows the median of its distances.
    """
    frame = frame_around(place_m)
    cell_m = max(size_m, frame.longer_m / _MOST_CELLS)
    raster = _medians(place_m, distance_m, frame.low, frame.high, cell_m)
    limit_m = round_up(float(np.quantile(np.abs(distance_m), _SCALE_QUANTILE)))
    figure, axes = new_plan(frame, "Model minus reference along the normals (M3C2)", right_inches=1.0)
    axes.set_facecolor(look.EMPTY_COLOUR)
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
    text = "m; above 0: the model lies before the reference"
    look.add_scale(figure, image, text, cax=bar_axes(figure, axes), extend="both")
    add_bearings(axes)
    look.write_png(figure, path)


def write_distance_histogram(path: Path, groups: Mapping[str, FloatArray], lod_m: float) -> None:
    """Write the densities of signed distances by group, none empty, and the median level of detection."""
    everything = np.concatenate(list(groups.values()))
    limit_m = round_up(max(float(np.quantile(np.abs(everything), 0.98)), 1.5 * lod_m))
    edges = np.linspace(-limit_m, limit_m, _BINS + 1)
    figure = look.new_figure((6.2, 3.4), "constrained")
    axes = figure.add_subplot()
    axes.axvspan(-lod_m, lod_m, color=look.EMPTY_COLOUR, label="level of detection (median, 95 %)")
    for (name, distance_m), colour in zip(groups.items(), _COLOURS, strict=False):
        count, _ = np.histogram(np.clip(distance_m, -limit_m, limit_m), edges)
        density = count / (len(distance_m) * (edges[1] - edges[0]))
        axes.stairs(density, edges, color=colour, linewidth=1.4, label=f"{name} ({len(distance_m)})")
        axes.axvline(float(np.median(distance_m)), color=colour, linewidth=0.8, linestyle=":")
    axes.set_ylim(bottom=0)
    axes.set_xlim(-limit_m, limit_m)
    look.label(axes, "", x="model minus reference in m (dotted: median; ends hold all beyond)", y="density in 1/m")
    axes.legend(fontsize=look.TICK_POINTS, frameon=False)
    look.write_png(figure, path)


def _medians(
    place_m: FloatArray, values: FloatArray, low: FloatArray, high: FloatArray, cell_m: float
) -> FloatArray:
    """Return the medians (R, C) of values in cells, rows from the south; NaN: none."""
    from scipy.ndimage import median

    columns, rows = (np.ceil((high - low) / cell_m).astype(int)).tolist()
    raster = np.full((rows, columns), np.nan)
    cell = np.floor((place_m - low) / cell_m).astype(np.int64)
    key = cell[:, 1] * columns + cell[:, 0]
    held = np.unique(key)
    raster.flat[held] = median(values, key, held)
    return raster


def round_up(value: float) -> float:
    """Return the next 1, 2 or 5 times a power of ten that is not below a value; 0.01 at the least."""
    power = 10.0 ** np.floor(np.log10(max(value, 0.01)))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= max(value, 0.01) * (1 - 1e-9)))


# Of the band above the pictures: its height and that of its letters, in pixels, by the width of a picture.
_BAND_PART, _LEAST_BAND_PX, _MOST_BAND_PX = 0.055, 14, 40
_LETTER_PART, _LETTER_WIDTH = 0.62, 0.62  # height by the band's, width by the height
_DOTS_PER_INCH, _POINTS_PER_INCH = 100, 72


def labelled(pictures: Sequence[ByteArray], labels: Sequence[str]) -> ByteArray:
    """Return pictures of one size (H, W, 3) side by side (H + band, n W, 3), each with its label in a band above.

    A label that is too long for its picture loses its beginning: the end of a name tells photographs apart.
    """
    strip = np.concatenate(pictures, axis=1)
    width = pictures[0].shape[1]
    band_px = band_height_px(width)
    letters_px = _LETTER_PART * band_px
    figure = look.new_figure(
        (strip.shape[1] / _DOTS_PER_INCH, band_px / _DOTS_PER_INCH), None, dots_per_inch=_DOTS_PER_INCH
    )
    most = max(int(width / (_LETTER_WIDTH * letters_px)), 1)
    for index, text in enumerate(labels):
        label = text if len(text) <= most else f"…{text[len(text) - most + 1 :]}"
        figure.text(
            (index + 0.5) / len(labels),
            0.5,
            label,
            ha="center",
            va="center",
            color=look.DARK,
            parse_math=False,
            fontsize=letters_px * _POINTS_PER_INCH / _DOTS_PER_INCH,
        )
    band = look.pixels_of(figure)[:band_px, : strip.shape[1]]
    return np.concatenate([band, strip], axis=0)


def without_labels(strip: ByteArray, count: int) -> list[ByteArray]:
    """Return the pictures (H, W, 3) of a strip that `labelled` has made of `count` pictures."""
    width = strip.shape[1] // count
    pictures = strip[band_height_px(width) :]
    return [pictures[:, index * width : (index + 1) * width] for index in range(count)]


def band_height_px(width_px: int) -> int:
    """Return the height of the band above pictures of a width."""
    return min(max(round(_BAND_PART * width_px), _LEAST_BAND_PX), _MOST_BAND_PX)


_AXES = ("east", "north", "up")
_ARROW_SHARE, _ARROW_QUANTILE = 0.9, 0.95  # of a region, that an arrow of this quantile takes
_CHART_INCHES = (5.6, 3.2)


def residual_field(
    size_px: tuple[int, int], mean_px: FloatArray, rms_px: FloatArray, title: str
) -> tuple[bytes, float | None]:
    """Return mean reprojection residuals by image region as arrows on their RMS, and the arrows' magnification.

    Means (R, C, 2), rows from the top, are NaN with too few observations; root mean square lengths are (R, C).
    """
    width, height = size_px
    rows, columns = rms_px.shape
    scale = 4.6 / max(width, height)
    figure = look.new_figure((width * scale + 1.7, height * scale + 1.0), "constrained")
    axes = figure.subplots()
    look.label(axes, title, x="x in px", y="y in px")
    image = axes.imshow(
        np.ma.masked_invalid(rms_px), cmap=look.COLOUR_MAP, extent=(0, width, height, 0), interpolation="nearest"
    )
    look.add_scale(figure, image, "RMS of the residuals in px", ax=axes, fraction=0.04, pad=0.02)
    x = (np.arange(columns) + 0.5) * width / columns
    y = (np.arange(rows) + 0.5) * height / rows
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    known = np.isfinite(mean_px).all(axis=-1)
    longest = float(np.quantile(np.linalg.norm(mean_px[known], axis=-1), _ARROW_QUANTILE)) if known.any() else 0.0
    factor = None
    if longest > 0:
        factor = nice_number(_ARROW_SHARE * min(width / columns, height / rows) / longest)
        # white on black: readable on every colour
        style = {"color": "white", "edgecolor": "black", "linewidth": 0.5}
        look.add_arrows(axes, grid[known], factor * mean_px[known], width=0.004, pivot="mid", **style)
    return look.png_of(figure), factor


def fix_series(
    abscissa: FloatArray, title: str, residual_m: FloatArray, sigma_m: FloatArray, is_outlier: BoolArray
) -> bytes:
    """Return the residuals (F, 3) of fixes, east, north and up, with the stated 2 σ and the mean, as PNG.

    The abscissa (F,), of that title, is seconds since the first, or the number of the photograph.
    """
    figure = look.new_figure((5.6, 5.6), "constrained")
    order = np.argsort(abscissa, kind="stable")
    for axis, axes in enumerate(figure.subplots(3, 1, sharex=True)):
        values, sigma = residual_m[:, axis], sigma_m[:, axis]
        band = {"color": look.GREY, "alpha": 0.3, "linewidth": 0, "label": "stated 2 σ"}
        axes.fill_between(abscissa[order], -2 * sigma[order], 2 * sigma[order], **band)
        axes.axhline(0, color=look.DARK, linewidth=0.6)
        used = ~is_outlier
        if used.any():
            axes.axhline(
                float(values[used].mean()), color=look.BLUE, linewidth=1.2, linestyle="--", label="mean (bias)"
            )
        for chosen, style, name in (
            (used, {"marker": "o", "color": look.BLUE, "s": 11}, "used"),
            (is_outlier, {"marker": "X", "color": look.ORANGE, "edgecolors": "black", "s": 34}, "outlier"),
        ):
            if chosen.any():
                axes.scatter(abscissa[chosen], values[chosen], label=name, linewidths=0.7, zorder=3, **style)
        look.label(axes, "", y=f"{_AXES[axis]} in m")
        axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel(title, fontsize=look.LABEL_POINTS)
    look.add_key(figure, 4, loc="outside upper center")
    return look.png_of(figure)


def correlation_matrix(names: Sequence[str], correlation: FloatArray) -> bytes:
    """Return correlations (P, P) of named parameters as PNG, with the figures in the cells."""
    side = 0.42 * len(names) + 1.4
    figure = look.new_figure((side + 0.8, side), "constrained")
    axes = figure.subplots()
    image = axes.imshow(correlation, cmap="PuOr", vmin=-1, vmax=1)
    axes.set_xticks(range(len(names)), names)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(labelsize=look.TICK_POINTS, length=0)
    for row, values in enumerate(correlation):
        for column, value in enumerate(values):
            dark = abs(value) > 0.65
            axes.text(
                column,
                row,
                f"{round(float(value), 2) + 0.0:.2f}".replace("-", "−"),
                ha="center",
                va="center",
                fontsize=look.FIGURE_POINTS - 1,
                color="white" if dark else "black",
            )
    look.label(axes, "Correlation of the lens parameters")
    look.add_scale(figure, image, "", ax=axes, fraction=0.04, pad=0.02)
    return look.png_of(figure)


def predicted_against_measured(sigma_m: FloatArray, error_m: FloatArray) -> bytes:
    """Return predicted σ (J, 2) against measured errors (J, 2) of check points, horizontal and vertical, as PNG."""
    figure = look.new_figure((6.4, 3.6), "constrained")
    for axis, (axes, name) in enumerate(zip(figure.subplots(1, 2), ("horizontal", "vertical"), strict=True)):
        sigma, error = sigma_m[:, axis], error_m[:, axis]
        most = 1.15 * max(float(sigma.max()), 1e-6)
        line = np.array([0.0, most])
        axes.fill_between(line, 0, line, color=look.BLUE, alpha=0.14, linewidth=0, label="within 1 σ")
        axes.fill_between(line, line, 2 * line, color=look.BLUE, alpha=0.07, linewidth=0, label="within 2 σ")
        axes.scatter(sigma, error, s=16, color=look.DARK, zorder=3, label="check point")
        axes.set_xlim(0, most)
        axes.set_ylim(0, 1.1 * max(float(error.max()), 2 * most))
        look.label(axes, name, x="predicted σ with survey in m", y="measured error in m")
        axes.spines[["top", "right"]].set_visible(False)
    look.add_key(figure, 3, loc="outside lower center")
    return look.png_of(figure)


def curves(abscissa_title: str, panels: Mapping[str, Mapping[str, tuple[FloatArray, FloatArray]]]) -> bytes:
    """Return curves below each other as PNG: by quantity, lines by name, abscissa (N,) and ordinate (N,)."""
    width, height = _CHART_INCHES
    figure = look.new_figure((width, 0.62 * height * len(panels) + 0.5), "constrained")
    all_axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    for axes, (quantity, lines) in zip(all_axes, panels.items(), strict=True):
        styles = itertools.product(("-", "--"), look.SERIES_COLOURS)
        for (name, (x, y)), (dash, colour) in zip(lines.items(), styles, strict=False):
            axes.plot(x, y, label=name, color=colour, linestyle=dash, linewidth=1.3)
        positive = [value for _, y in lines.values() for value in y if value > 0]
        if len(lines) > 1:
            if positive and max(positive) > 100 * min(positive):
                axes.set_yscale("log")
            axes.legend(fontsize=look.TICK_POINTS, frameon=False, ncols=2)
        look.label(axes, "", y=quantity)
        axes.spines[["top", "right"]].set_visible(False)
    all_axes[-1].set_xlabel(abscissa_title, fontsize=look.LABEL_POINTS)
    return look.png_of(figure)
