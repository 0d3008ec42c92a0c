"""Pictures of the change between two epochs: relief under colours, histogram of differences, profiles."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.geometry.relief import LEVEL_LIGHT, sunlight
from pipelines.report.plots import style as look

DIVERGING = "RdBu"  # red: lowered, blue: raised
_EXAGGERATION = 2.0
_LIGHTEST, _DARKEST = 250.0, 70.0  # of the relief
_STRONG, _FAINT = 0.85, 0.3  # opacity of significant and of other differences
_BINS = 101
_PROFILE_INCHES, _HISTOGRAM_INCHES = (6.4, 2.9), (6.4, 3.3)


def change_picture(
    height_m: FloatArray, difference_m: FloatArray, significant: BoolArray, cell_m: float, limit_m: float
) -> ByteArray:
    """Return the map (H, W, 4) RGBA of differences over a relief of heights (H, W); transparent: nothing is known.

    Differences have full colours from `limit_m` on, and stand out where they are significant.
    """
    from matplotlib import colormaps

    grey = _relief(height_m, cell_m)[..., None]
    share = np.clip(np.nan_to_num(difference_m) / (2 * limit_m) + 0.5, 0.0, 1.0)
    colour = 255.0 * np.asarray(colormaps[DIVERGING](share))[..., :3]
    opacity = np.where(significant, _STRONG, _FAINT * np.minimum(np.abs(2 * share - 1), 1.0))[..., None]
    known = np.isfinite(difference_m)
    rgb = np.where(known[..., None], opacity * colour * (grey / _LIGHTEST) ** 0.5 + (1 - opacity) * grey, grey)
    alpha = np.where(known, 255, np.where(np.isfinite(height_m), 90, 0))
    return np.dstack([np.clip(rgb, 0, 255), alpha]).astype(np.uint8)


def _relief(height_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the grey values (H, W) of heights in the light from the north-west."""
    light = sunlight(_EXAGGERATION * height_m, cell_m)
    bright = np.where(light < LEVEL_LIGHT, light / LEVEL_LIGHT, 1 + (light - LEVEL_LIGHT) / (1 - LEVEL_LIGHT)) / 2
    return np.asarray(_DARKEST + (_LIGHTEST - _DARKEST) * np.clip(bright, 0, 1) ** 0.7)


def scale_colours(count: int = 9) -> tuple[str, ...]:
    """Return colours of the map, from the lowest to the highest difference, as a page writes them."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return tuple(to_hex(colour) for colour in colormaps[DIVERGING](np.linspace(0, 1, count)))


def difference_histogram(stable_m: FloatArray, changed_m: FloatArray, lod_m: float, limit_m: float) -> bytes:
    """Return the histogram of differences of cells without (N,) and with significant change (M,), as PNG.

    Counts are on a logarithmic axis; the ends hold all beyond the limit.
    """
    edges = np.linspace(-limit_m, limit_m, _BINS + 1)
    figure = look.new_figure(_HISTOGRAM_INCHES, "constrained")
    axes = figure.add_subplot()
    axes.axvspan(-lod_m, lod_m, color=look.EMPTY_COLOUR, label="within the median level of detection")
    for name, values, colour in (
        ("no significant change", stable_m, look.GREY),
        ("significant change", changed_m, look.ORANGE),
    ):
        if len(values):
            count, _ = np.histogram(np.clip(values, -limit_m, limit_m), edges)
            axes.stairs(count, edges, color=colour, linewidth=1.6, label=name)
    axes.set_yscale("log")
    axes.set_xlim(-limit_m, limit_m)
    look.label(axes, "", x="later minus earlier height in m", y="sampled cells")
    axes.spines[["top", "right"]].set_visible(False)
    look.add_key(figure, 3, loc="outside upper center")
    return look.png_of(figure)


@dataclass(frozen=True)
class ChangeProfile:
    """Heights of both epochs along a line: distance (N,) in metres, heights and σ (2, N); NaN: not known.

    `part` are the distances at which the line enters and leaves the region, two by two.
    """

    distance_m: FloatArray
    height_m: FloatArray
    sigma_m: FloatArray
    part: tuple[float, ...]


def profile_chart(profile: ChangeProfile, names: tuple[str, str]) -> bytes:
    """Return the heights of both epochs, with a band of ± 1.96 σ around each, as PNG."""
    figure = look.new_figure(_PROFILE_INCHES, "constrained")
    axes = figure.add_subplot()
    for start, end in zip(profile.part[::2], profile.part[1::2], strict=True):
        axes.axvspan(start, end, color=look.EMPTY_COLOUR, zorder=0)
    for name, colour, height, sigma in zip(
        names, (look.BLUE, look.ORANGE), profile.height_m, profile.sigma_m, strict=True
    ):
        band = 1.96 * np.nan_to_num(sigma)
        axes.fill_between(profile.distance_m, height - band, height + band, color=colour, alpha=0.12, linewidth=0)
        for side in (-1, 1):  # lines keep their colour in the dark, where a pale area becomes a dark one
            axes.plot(profile.distance_m, height + side * band, color=colour, linewidth=0.6, linestyle="--")
        axes.plot(profile.distance_m, height, color=colour, linewidth=1.7, label=name)
    known = profile.height_m[np.isfinite(profile.height_m)]
    if len(known):  # heights are shown in full; bands of interpolated parts may leave the picture
        low, high = float(known.min()), float(known.max())
        margin = max(0.12 * (high - low), 0.05)
        axes.set_ylim(low - margin, high + margin)
    look.label(axes, "", x="distance along the line in m", y="height in m")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.set_xlim(profile.distance_m[0], profile.distance_m[-1])
    axes.spines[["top", "right"]].set_visible(False)
    look.add_key(figure, 2, loc="outside upper center")
    return look.png_of(figure)


def inside_parts(distance_m: FloatArray, inside: BoolArray) -> tuple[float, ...]:
    """Return where a line enters and leaves, by the distances (N,) that are inside (N,)."""
    edge = np.flatnonzero(np.diff(inside.astype(np.int8), prepend=0, append=0))
    last = len(distance_m) - 1
    pairs = list(pairwise(edge.tolist()))[::2]
    return tuple(value for start, end in pairs for value in (distance_m[start], distance_m[min(end, last)]))
