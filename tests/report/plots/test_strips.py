"""Pictures side by side: as given, below labels."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.report.plots.charts import band_height_px, labelled, without_labels


@pytest.mark.parametrize("width", [40, 96, 321, 1600])
def test_pictures_are_unchanged_below_their_labels(width: int) -> None:
    pictures = [np.random.default_rng(seed).integers(0, 255, (30, width, 3), dtype=np.uint8) for seed in range(3)]
    strip = labelled(pictures, ("photograph flight/DJI_0007.JPG", "render, PSNR 24.31 dB", "×"))
    band = band_height_px(width)
    assert strip.shape == (30 + band, 3 * width, 3) and strip.dtype == np.uint8
    np.testing.assert_array_equal(strip[band:], np.concatenate(pictures, axis=1))
    for picture, again in zip(pictures, without_labels(strip, 3), strict=True):
        np.testing.assert_array_equal(picture, again)
    for part in np.split(strip[:band], 3, axis=1):
        written = (part < 128).any(axis=(0, 2))
        assert written.any() and not written[[0, -1]].any()  # within its own picture


def test_long_name_keeps_its_end() -> None:
    """Photographs of a flight differ at the end of their names."""
    pictures = [np.zeros((10, 200, 3), np.uint8)]
    first, second = (labelled(pictures, ("a" * 300 + end,)) for end in ("0007.JPG", "0008.JPG"))
    assert (first != second).any()
