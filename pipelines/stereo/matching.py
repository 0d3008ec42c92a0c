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

from pipelines.core.types import BoolArray, Float32Array, FloatArray

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

    @property
    def support_px(self) -> int:
        """How far from a pixel that is which its score depends on: the guided filter averages averages."""
        return self.window_px // 2 + 2 * self.reach_px


class Matcher:
    """Compares one photograph (H, W) with what its neighbours show under a hypothesis."""

    def __init__(self, grey: Float32Array, settings: MatchSettings) -> None:
        self._correlation = _Correlation(grey, settings.window_px)
        self._smooth = cv2.ximgproc.createGuidedFilter(grey, settings.reach_px, settings.edge_grey**2)
        self._best = _Best(grey.shape, settings.views)

    def __call__(self, shown: Iterable[Float32Array]) -> Float32Array:
        """Score (H, W) of a hypothesis, by what neighbours, at least one, show of it (H, W): 0 where nothing."""
        self._best.clear()
        for image in shown:
            self._best.add(self._correlation(image))
        return np.asarray(self._smooth.filter(self._best.mean()), dtype=np.float32)


# Some hundred thousand images go through these two: they write into arrays of their own, as it takes longer to get
# fresh memory than to fill it.
class _Best:
    """The `most` largest of images (H, W) at each pixel."""

    def __init__(self, shape: tuple[int, ...], most: int) -> None:
        self._largest = [np.empty(shape, np.float32) for _ in range(most)]
        self._spare, self._rest = np.empty(shape, np.float32), np.empty(shape, np.float32)
        self._count = 0

    def clear(self) -> None:
        """Begin anew."""
        self._count = 0

    def add(self, image: Float32Array) -> None:
        """One more, which is not kept."""
        np.copyto(self._rest, image)
        for place in range(self._count):
            kept = self._largest[place]
            np.maximum(kept, self._rest, out=self._spare)
            np.minimum(kept, self._rest, out=self._rest)
            self._largest[place], self._spare = self._spare, kept
        if self._count < len(self._largest):
            self._largest[self._count], self._rest = self._rest, self._largest[self._count]
            self._count += 1

    def mean(self) -> Float32Array:
        """Their mean (H, W), of all where there were fewer; written over by what follows."""
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
        self._other_mean, self._variance, self._product, self._found = (np.empty_like(image) for _ in range(4))

    def __call__(self, other: Float32Array) -> Float32Array:
        """Correlation (H, W), −1 where `other` is 0; written over by the next one."""
        mean, product = self._smooth(other, self._other_mean), self._product
        variance = self._smooth(np.multiply(other, other, out=product), self._variance)
        found = self._smooth(np.multiply(self._image, other, out=product), self._found)
        variance -= np.multiply(mean, mean, out=product)
        np.maximum(variance, _NOISE_VARIANCE, out=variance)
        found -= np.multiply(self._mean, mean, out=product)
        found *= self._inverse_sigma
        found /= np.sqrt(variance, out=variance)
        np.copyto(found, np.float32(UNSEEN), where=other == 0)
        return found

    def _smooth(self, image: Float32Array, out: Float32Array) -> Float32Array:
        cv2.boxFilter(image, -1, self._window, dst=out, borderType=cv2.BORDER_REFLECT)
        return out


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
    score: Float32Array
    curvature: Float32Array
    inner: BoolArray


class Peak:
    """The largest of a sequence of score images, with the scores before and after it."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count = 0
        self._place = np.zeros(shape, dtype=np.int64)
        self._best, self._before, self._after = (np.full(shape, -2.0, dtype=np.float32) for _ in range(3))
        self._last = np.full(shape, -2.0, dtype=np.float32)

    def add(self, score: Float32Array) -> None:
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
