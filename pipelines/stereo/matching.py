"""Photometric matching of a photograph with its neighbours, hypothesis by hypothesis; the best hypothesis wins.

1. Normalised cross-correlation compares photographs: exposure does not change it.
2. The neighbours that agree best count (Kang, Szeliski & Chai, doi 10.1109/CVPR.2001.990462): an obstacle hides a
   place from some sides only.
3. A guided filter averages the correlations of each hypothesis, but not across edges of the photograph (Rhemann et
   al., doi 10.1109/CVPR.2011.5995372). Ground without texture needs a wide window; beside the edge of a roof a wide
   window sees the roof.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.core.types import BoolArray, Float32Array, FloatArray

UNSEEN = -1.0  # correlation outside a neighbour's image
_NOISE_VARIANCE = 0.3  # grey levels²: windows that vary less than the sensor's noise do not correlate
_LEAST_CURVATURE = 1e-6


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the comparison.

    Attributes:
        window_px: side of the correlation window, odd.
        reach_px: radius of the guided filter that averages correlations.
        edge_grey: step in grey levels across which the filter does not average.
        views: number of neighbours that count, the best of all.
    """

    window_px: int = 5
    reach_px: int = 6
    edge_grey: float = 10.0
    views: int = 3

    @property
    def support_px(self) -> int:
        """Distance from a pixel up to which its score depends on the image: the guided filter averages averages."""
        return self.window_px // 2 + 2 * self.reach_px


class Matcher:
    """Compares one photograph (H, W) with its neighbours, warped under a hypothesis."""

    def __init__(self, grey: Float32Array, settings: MatchSettings) -> None:
        self._correlation = _Correlation(grey, settings.window_px)
        self._smooth = cv2.ximgproc.createGuidedFilter(grey, settings.reach_px, settings.edge_grey**2)
        self._top_scores = _TopScores(grey.shape, settings.views)

    def __call__(self, shown: Iterable[Float32Array]) -> Float32Array:
        """Return the score (H, W) of a hypothesis from one or more warped neighbours (H, W), 0 where these end."""
        self._top_scores.clear()
        for image in shown:
            self._top_scores.add(self._correlation(image))
        return np.asarray(self._smooth.filter(self._top_scores.mean()), dtype=np.float32)


# Several hundred thousand images go through the next two classes. They write into arrays of their own: allocating
# fresh memory takes longer than filling it.
class _TopScores:
    """Largest values of a sequence of images (H, W) at each pixel, `count` of them."""

    def __init__(self, shape: tuple[int, ...], count: int) -> None:
        self._largest = [np.empty(shape, np.float32) for _ in range(count)]
        self._spare, self._leftover = np.empty(shape, np.float32), np.empty(shape, np.float32)
        self._count = 0

    def clear(self) -> None:
        """Forget all images."""
        self._count = 0

    def add(self, image: Float32Array) -> None:
        """Take the values of another image; the image itself is not kept."""
        np.copyto(self._leftover, image)
        for rank in range(self._count):
            kept = self._largest[rank]
            np.maximum(kept, self._leftover, out=self._spare)
            np.minimum(kept, self._leftover, out=self._leftover)
            self._largest[rank], self._spare = self._spare, kept
        if self._count < len(self._largest):
            self._largest[self._count], self._leftover = self._leftover, self._largest[self._count]
            self._count += 1

    def mean(self) -> Float32Array:
        """Return the mean (H, W) of the largest values, or of all if fewer; the next call overwrites it."""
        np.copyto(self._spare, self._largest[0])
        for kept in self._largest[1 : self._count]:
            self._spare += kept
        self._spare /= np.float32(self._count)
        return self._spare


class _Correlation:
    """Normalised cross-correlation of one image with others, over square windows."""

    def __init__(self, image: Float32Array, window_px: int) -> None:
        self._image, self._window = image, (window_px, window_px)
        self._mean = self._smooth(image, np.empty_like(image))
        variance = self._smooth(image * image, np.empty_like(image)) - self._mean * self._mean
        self._inverse_sigma = 1 / np.sqrt(np.maximum(variance, _NOISE_VARIANCE))
        self._other_mean, self._variance, self._product, self._products = (np.empty_like(image) for _ in range(4))

    def __call__(self, other: Float32Array) -> Float32Array:
        """Return the correlation (H, W), −1 where `other` is 0; the next call overwrites it."""
        mean, product = self._smooth(other, self._other_mean), self._product
        variance = self._smooth(np.multiply(other, other, out=product), self._variance)
        correlation = self._smooth(np.multiply(self._image, other, out=product), self._products)
        variance -= np.multiply(mean, mean, out=product)
        np.maximum(variance, _NOISE_VARIANCE, out=variance)
        correlation -= np.multiply(self._mean, mean, out=product)
        correlation *= self._inverse_sigma
        correlation /= np.sqrt(variance, out=variance)
        np.copyto(correlation, np.float32(UNSEEN), where=other == 0)
        return correlation

    def _smooth(self, image: Float32Array, out: Float32Array) -> Float32Array:
        cv2.boxFilter(image, -1, self._window, dst=out, borderType=cv2.BORDER_REFLECT)
        return out


@dataclass(frozen=True)
class Winner:
    """Best of a sequence of hypotheses at each pixel.

    Attributes:
        hypothesis: (H, W) its number, with a fraction.
        score: (H, W) correlation, −1 … 1.
        curvature: (H, W) minus the second derivative of the score by the number.
        inner: (H, W) whether scores of the hypotheses before and after exist.
    """

    hypothesis: FloatArray
    score: Float32Array
    curvature: Float32Array
    inner: BoolArray


class WinnerTakesAll:
    """Search for the largest of a sequence of score images at each pixel, with the scores before and after it."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count = 0
        self._hypothesis = np.zeros(shape, dtype=np.int64)
        self._best, self._before, self._after = (np.full(shape, -2.0, dtype=np.float32) for _ in range(3))
        self._last = np.full(shape, -2.0, dtype=np.float32)

    def add(self, score: Float32Array) -> None:
        """Take the scores (H, W) of the next hypothesis."""
        follows = (self._hypothesis == self._count - 1) & (self._count > 0)
        np.copyto(self._after, score, where=follows)
        better = score > self._best
        np.copyto(self._before, self._last, where=better)
        np.copyto(self._after, np.float32(-2.0), where=better)
        np.copyto(self._best, score, where=better)
        self._hypothesis[better] = self._count
        self._last = score
        self._count += 1

    def winner(self) -> Winner:
        """Return the best hypotheses, refined by the parabola through the scores before and after if both exist."""
        inner = (self._before > UNSEEN) & (self._after > UNSEEN)
        curvature = np.maximum(2 * self._best - self._before - self._after, _LEAST_CURVATURE)
        shift = np.where(inner, 0.5 * (self._after - self._before) / curvature, 0.0).clip(-0.5, 0.5)
        return Winner(self._hypothesis + shift, self._best, np.where(inner, curvature, _LEAST_CURVATURE), inner)
