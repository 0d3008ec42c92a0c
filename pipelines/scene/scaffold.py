"""Effort of the scaffold: the coarse model of the whole survey that stands in for the world around a block."""

from __future__ import annotations

_SHARE = 0.1
_MOST = 200_000
_LEAST = 2_000
_MOST_IMAGE_PX = 320


def scaffold_gaussians(most: int) -> int:
    """Return the limit of the scaffold's Gaussians for a survey with a limit of `most`."""
    return min(max(int(_SHARE * most), _LEAST), _MOST, most)


def scaffold_image_px(max_image_size: int) -> int:
    """Return the longest side in pixels of the photographs that the scaffold is trained on."""
    return min(max_image_size, _MOST_IMAGE_PX)
