"""Charts of observations: residuals in the image and in time, correlations, prediction against measurement."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.report.plots import style as look
from pipelines.report.plots.plans import nice_number

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
