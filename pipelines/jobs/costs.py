"""Cost models: seconds of a reconstruction and of an iteration of training, and the remaining time of a training.

The seconds are those of a stated machine. On another one they give an estimate before the training starts, and the
proportions of iterations with shrunken and with whole photographs, for the remaining time of a running training.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from pipelines.core.types import FloatArray

MEASURED_CORES = 2
# Three reconstructions of 18, 48 and 1000 photographs took 15, 23 and 1320 s on 2 cores of an AMD EPYC, 2026-11-26.
# This model says 14, 30 and 970 s.
_FEATURES_MEGAPIXEL_S, _PAIR_S, _MAPPING_S = 0.54, 0.04, 0.3  # mapping: of a photograph
# Of photographs that are not doubled: a third of the time.
_OWN_SIZE_FEATURES_MEGAPIXEL_S = 0.18
# Features a megapixel of aerial photographs, about, and their number for which `_PAIR_S` holds: matching compares
# each feature of a photograph with each of the other.
_FEATURES_MEGAPIXEL, _OWN_SIZE_FEATURES_MEGAPIXEL, _PAIR_FEATURES = 6000, 3000, 5000


@dataclass(frozen=True)
class ReconstructionCost:
    """Seconds of one core for the steps of a reconstruction."""

    features_s: float
    matching_s: float
    mapping_s: float

    @property
    def total_s(self) -> float:
        return self.features_s + self.matching_s + self.mapping_s


def reconstruction_cost(
    photographs: int, megapixels: float, pairs: float, *, doubled: bool, max_features: int
) -> ReconstructionCost:
    """Return the estimated seconds of one core for each step, of numbers of photographs and of pairs to match.

    Megapixels and most features are of each photograph at the size in which features are detected; `doubled`: on
    twice that size, too.
    """
    detection_s = _FEATURES_MEGAPIXEL_S if doubled else _OWN_SIZE_FEATURES_MEGAPIXEL_S
    found = megapixels * (_FEATURES_MEGAPIXEL if doubled else _OWN_SIZE_FEATURES_MEGAPIXEL)
    compared = (min(found, max_features) / _PAIR_FEATURES) ** 2
    return ReconstructionCost(
        features_s=MEASURED_CORES * photographs * detection_s * megapixels,
        matching_s=MEASURED_CORES * _PAIR_S * pairs * compared,
        mapping_s=MEASURED_CORES * photographs * _MAPPING_S,
    )


_FIXED_BYTES = 300 << 20  # interpreter, libraries, reserves of the allocator
# Bytes a pixel of the photograph, and of the image that features are detected in, by thread: measured with
# photographs of 2.3 and 20.9 megapixels at 600, 1200 and 2400 px, where they are 1.04 to 1.28 times the growth.
# Photographs that are not doubled: 79 to 91 bytes at 1200, 1600 and 3200 px.
_PHOTO_BYTES_PX, _DETECTION_BYTES_PX, _OWN_SIZE_DETECTION_BYTES_PX = 4.0, 310.0, 95.0
# Mapping and the adjustments after it, of the global mapper, which needs more than the incremental one
# (`examples/benchmarks/many_photographs.py`; docs/benchmarks.md has the runs).
_FEATURE_BYTES = 133.0
_OBSERVATION_BYTES = 2500.0
# Features that COLMAP finds and observations of points, as multiples of `--max-features`: eight surveys had up to
# 1.5 and, with real photographs, 0.14 to 0.32.
_FOUND, _OBSERVED = 1.5, 0.35


def features_peak_bytes(pixels: int, shrink: float, *, doubled: bool, threads: int) -> int:
    """Return the peak of a process that detects or matches features in photographs, shrunken by a factor ≥ 1."""
    detection = _DETECTION_BYTES_PX if doubled else _OWN_SIZE_DETECTION_BYTES_PX
    a_thread = _PHOTO_BYTES_PX * pixels + detection * pixels / shrink**2
    return int(_FIXED_BYTES + threads * a_thread)


def mapping_peak_bytes(photographs: int, max_features: int) -> int:
    """Return the peak of mapping and the adjustments after it."""
    a_photograph = (_FEATURE_BYTES * _FOUND + _OBSERVATION_BYTES * _OBSERVED) * max_features
    return int(_FIXED_BYTES + photographs * a_photograph)


MEASURED_ON = "2 cores of an AMD EPYC"
# Surface losses render depth and normals too. Ratio of trainings with them to the cost below, about.
SURFACE_FACTOR = 1.9
# Photographs that show a place of a survey, about, and the largest share of Gaussians that one shows.
_SEEN_BY, _MOST_SEEN = 25, 1 / 3


@dataclass(frozen=True)
class IterationCost:
    """Cost of an iteration: c₀ + c₁ · pixels + c₂ · visible Gaussians + c₃ · all of them, each in millions."""

    coefficients: FloatArray  # (4,) c₀ … c₃: seconds, processor seconds, or bytes of the process at its peak

    def of(self, pixels: float, visible: float, gaussians: float) -> float:
        """Return the cost of so many pixels and visible Gaussians in a view, and Gaussians in all."""
        terms = np.array([[1.0, pixels / 1e6, visible / 1e6, gaussians / 1e6]])
        return float((terms @ self.coefficients).item())

    @staticmethod
    def fitted(sizes: FloatArray, measured: FloatArray) -> IterationCost:
        """Return the model that fits measurements best in relative terms, with no coefficient below zero.

        Sizes (B, 3) are pixels, visible and all Gaussians of each measurement (B,).
        """
        terms = np.column_stack([np.ones(len(sizes)), sizes / 1e6])
        return IterationCost(nnls(terms / measured[:, None], np.ones(len(measured)))[0])


# Fitted by `examples/benchmarks/training.py scaling` to 10 000 … 1 000 000 Gaussians, a third and a thirtieth of
# them in view, in 0.25 … 1.2 megapixels: seconds on 2 cores of an AMD EPYC without AVX-512, and processor seconds,
# 2026-11-26.
ITERATION_SECONDS = IterationCost(np.array([0.0016, 0.0481, 0.675, 0.0219]))
ITERATION_PROCESSOR_SECONDS = IterationCost(np.array([0.0014, 0.091, 1.273, 0.0402]))


def iteration_seconds(pixels: float, gaussians: float, photographs: int, *, surface: bool, crops: int = 1) -> float:
    """Return the seconds of one iteration on the machine of `MEASURED_ON`, with surface losses or without.

    Pixels are those of a photograph, which is seen in crops, one at an iteration; Gaussians those of the model of
    so many photographs.
    """
    visible = gaussians * min(_SEEN_BY / max(photographs, 1), _MOST_SEEN)
    plain = ITERATION_SECONDS.of(pixels / crops, visible / crops, gaussians)
    return (SURFACE_FACTOR if surface else 1.0) * plain


class TimeLeft:
    """Time of the remaining iterations, from the speed of those done and the work of each.

    The work is that of an iteration, counted from 1, in any unit.
    """

    def __init__(
        self, work: Callable[[int], float], iterations: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._done = np.concatenate([[0.0], np.cumsum([work(i) for i in range(1, iterations + 1)])])
        self._clock = clock
        self._begun: tuple[int, float] | None = None

    def start(self, iteration: int) -> None:
        self._begun = iteration, self._clock()

    def after(self, iteration: int) -> float | None:
        """Return the seconds that are left after an iteration; None as long as the speed is unknown."""
        if self._begun is None or iteration <= self._begun[0]:
            return None
        first, began = self._begun
        speed = (self._clock() - began) / (self._done[iteration] - self._done[first])
        return float(speed * (self._done[-1] - self._done[iteration]))
