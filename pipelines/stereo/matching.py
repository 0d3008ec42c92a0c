"""How well neighbouring photographs fit a photograph, hypothesis by hypothesis, and where they fit best.

Photographs are compared by normalised cross-correlation, which exposure does not change. Only the neighbours that
agree best count, as in Kang, Szeliski & Chai (doi 10.1109/CVPR.2001.990462), since whatever stands in front of a
place does so from some sides only. A guided filter averages the correlations of each hypothesis, but not across
edges of the photograph (Rhemann et al., doi 10.1109/CVPR.2011.5995372): ground without texture needs a wide window,
and beside a roof's edge a wide window sees the roof.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.products import FloatArray

FloatImage = NDArray[np.float32]

UNSEEN = -1.0  # correlation where a neighbour does not look
_NOISE_VARIANCE = 0.3  # grey levels²: what varies less than the sensor's noise does not correlate
_LEAST_CURVATURE = 1e-6


@dataclass(frozen=True)
class MatchSettings:
    """How to compare.

    Attributes:
        window_px: side of the window that is compared, odd.
        reach_px: correlations are averaged over so many pixels around,
        edge_grey: but not across edges of more than so many grey levels.
        views: of the neighbours, so many that agree best count.
    """

    window_px: int = 5
    reach_px: int = 6
    edge_grey: float = 10.0
    views: int = 3


class Matcher:
    """Compares one photograph (H, W) with what its neighbours show under a hypothesis."""

    def __init__(self, grey: FloatImage, settings: MatchSettings) -> None:
        self._correlation = _Correlation(grey, settings.window_px)
        self._smooth = cv2.ximgproc.createGuidedFilter(grey, settings.reach_px, settings.edge_grey**2)
        self._views = settings.views

    def __call__(self, shown: Iterable[FloatImage]) -> FloatImage:
        """Score (H, W) of a hypothesis, by what neighbours, at least one, show of it (H, W): 0 where nothing."""
        scores = (self._correlation(image) for image in shown)
        return np.asarray(self._smooth.filter(_mean_of_best(scores, self._views)), dtype=np.float32)


def _mean_of_best(scores: Iterable[FloatImage], count: int) -> FloatImage:
    """Mean (H, W) of the `count` largest scores at each pixel, or of all where there are fewer."""
    largest: list[FloatImage] = []
    for score in scores:
        rest = score
        for place, kept in enumerate(largest):
            largest[place], rest = np.maximum(kept, rest), np.minimum(kept, rest)
        if len(largest) < count:
            largest.append(rest)
    return np.asarray(sum(largest[1:], start=largest[0]) / np.float32(len(largest)))


class _Correlation:
    """Normalised cross-correlation of one image with others, over square windows."""

    def __init__(self, image: FloatImage, window_px: int) -> None:
        self._image, self._window = image, (window_px, window_px)
        self._mean = self._smooth(image)
        variance = self._smooth(image * image) - self._mean * self._mean
        self._inverse_sigma = 1 / np.sqrt(np.maximum(variance, _NOISE_VARIANCE))

    def __call__(self, other: FloatImage) -> FloatImage:
        """Correlation (H, W); −1 where `other` is 0."""
        mean = self._smooth(other)
        variance = self._smooth(other * other)
        variance -= mean * mean
        np.maximum(variance, _NOISE_VARIANCE, out=variance)
        found = self._smooth(self._image * other)
        found -= self._mean * mean
        found *= self._inverse_sigma
        found /= np.sqrt(variance, out=variance)
        found[other == 0] = UNSEEN
        return found

    def _smooth(self, image: FloatImage) -> FloatImage:
        return np.asarray(cv2.boxFilter(image, -1, self._window, borderType=cv2.BORDER_REFLECT), np.float32)


@dataclass(frozen=True)
class Found:
    """The best of a sequence of hypotheses at each pixel.

    Attributes:
        place: (H, W) its number, with a fraction.
        score: (H, W) correlation, −1 … 1.
        curvature: (H, W) minus the second derivative of the score by the number.
        inner: (H, W) whether it was compared with one before and one after it.
    """

    place: FloatArray
    score: FloatImage
    curvature: FloatImage
    inner: NDArray[np.bool_]


class Peak:
    """The largest of a sequence of score images, with the scores before and after it."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count = 0
        self._place = np.zeros(shape, dtype=np.int64)
        self._best, self._before, self._after = (np.full(shape, -2.0, dtype=np.float32) for _ in range(3))
        self._last = np.full(shape, -2.0, dtype=np.float32)

    def add(self, score: FloatImage) -> None:
        """The next plane's scores."""
        follows = (self._place == self._count - 1) & (self._count > 0)
        np.copyto(self._after, score, where=follows)
        better = score > self._best
        np.copyto(self._before, self._last, where=better)
        np.copyto(self._after, np.float32(-2.0), where=better)
        np.copyto(self._best, score, where=better)
        self._place[better] = self._count
        self._last = score
        self._count += 1

    def found(self) -> Found:
        """Refine each peak by the parabola through it and its neighbours, where it has two."""
        inner = (self._before > UNSEEN) & (self._after > UNSEEN)
        curvature = np.maximum(2 * self._best - self._before - self._after, _LEAST_CURVATURE)
        shift = np.where(inner, 0.5 * (self._after - self._before) / curvature, 0.0).clip(-0.5, 0.5)
        return Found(self._place + shift, self._best, np.where(inner, curvature, _LEAST_CURVATURE), inner)
