"""Pictures side by side, each with its label above."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.core.types import ByteArray
from pipelines.plots.style import DARK, new_figure, pixels_of

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
    figure = new_figure(
        (strip.shape[1] / _DOTS_PER_INCH, band_px / _DOTS_PER_INCH), None, dots_per_inch=_DOTS_PER_INCH
    )
    most = max(int(width / (_LETTER_WIDTH * letters_px)), 1)
    for place, text in enumerate(labels):
        shown = text if len(text) <= most else f"…{text[len(text) - most + 1 :]}"
        figure.text(
            (place + 0.5) / len(labels),
            0.5,
            shown,
            ha="center",
            va="center",
            color=DARK,
            parse_math=False,
            fontsize=letters_px * _POINTS_PER_INCH / _DOTS_PER_INCH,
        )
    band = pixels_of(figure)[:band_px, : strip.shape[1]]
    return np.concatenate([band, strip], axis=0)


def without_labels(strip: ByteArray, count: int) -> list[ByteArray]:
    """Return the pictures (H, W, 3) of a strip that `labelled` has made of `count` pictures."""
    width = strip.shape[1] // count
    pictures = strip[band_height_px(width) :]
    return [pictures[:, place * width : (place + 1) * width] for place in range(count)]


def band_height_px(width_px: int) -> int:
    """Return the height of the band above pictures of a width."""
    return min(max(round(_BAND_PART * width_px), _LEAST_BAND_PX), _MOST_BAND_PX)
