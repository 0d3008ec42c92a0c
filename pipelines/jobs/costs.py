"""Cost model: seconds of each step by its amounts of work, and the remaining time of a training.

The seconds are those of a stated machine. On another one they give an estimate before the work starts, which
`jobs.pace` corrects by what earlier runs took there, and the proportions of iterations with shrunken and with whole
photographs, for the remaining time of a running training.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pipelines.core.machine import thread_count

MEASURED_ON, MEASURED_CORES = "2 cores of an AMD EPYC without AVX-512", 2
_MOST_CORES = 16  # beyond, the kernels gain little
BUSY_CORES = 1.88  # of the two, in an iteration: its processor seconds for each of the clock
# Surface losses render depth and normals too. Ratio of iterations with them to those without, about.
SURFACE_FACTOR = 1.9
# Photographs that show a place of a survey, about, and the largest share of Gaussians that one shows.
_SEEN_BY, _MOST_SEEN = 25, 1 / 3


class Work(NamedTuple):
    """Amounts of work; as a row of `COSTS`, the seconds that one of each takes."""

    runs: float = 1.0
    photographs: float = 0.0
    megapixels: float = 0.0  # of all photographs as they are worked on; of an iteration, of the one that it sees
    pairs: float = 0.0  # of photographs to match, with 5000 features each
    visible: float = 0.0  # millions of Gaussians that an iteration sees
    gaussians: float = 0.0  # millions of Gaussians in all

    def of(self, amounts: Work) -> float:
        """Return what so much work takes in all, if this is the cost of one of each."""
        return sum(cost * amount for cost, amount in zip(self, amounts, strict=True))


# Seconds on the machine of `MEASURED_ON`.
COSTS: dict[str, Work] = {
    # Reconstructions of 18, 48 and 1000 photographs took 15, 23 and 1320 s, 2026-11-26; these say 14, 30 and 970 s.
    "features": Work(0.0, megapixels=0.54),
    "features at own size": Work(0.0, megapixels=0.18),  # of photographs that are not doubled
    "matching": Work(0.0, pairs=0.04),
    "mapping": Work(0.0, photographs=0.3),
    # Of 42 views in 10 s, and of 875 in 230 s, 2026-11-26; megapixels are those of the depth maps, and the sweep
    # counts by photographs.
    "stereo": Work(0.0, photographs=0.13, megapixels=0.3),
    # Fitted by `examples/benchmarks/training.py scaling` to 10 000 … 1 000 000 Gaussians, a third and a thirtieth
    # of them in view, in 0.25 … 1.2 megapixels, 2026-11-26.
    "iteration": Work(0.0016, megapixels=0.0481, visible=0.675, gaussians=0.0219),
    # Whole stages; these are rough, and the first run on a machine corrects them. Those of surface and evaluation
    # are of 400 photographs in 65 megapixels, 2026-11-28; rasters make the depth maps, which all share.
    "ingest": Work(0.2, photographs=0.01),
    "calibrate": Work(0.05, photographs=0.009),
    "geolocate": Work(0.05, photographs=0.012),
    "init-sim3": Work(0.1, photographs=0.05),
    "evaluate": Work(3.0, photographs=0.05, megapixels=0.6),
    "export-ply": Work(0.1, megapixels=0.01),
    "export-measurable": Work(10.0, photographs=0.1, megapixels=8.2),
    "export-raster": Work(8.0, photographs=0.03, megapixels=0.9),
    "export-cloud": Work(5.0, photographs=0.02, megapixels=0.45),
    "export-mesh": Work(10.0, photographs=0.03, megapixels=1.2),
    "export-spz": Work(0.5, megapixels=0.05),
    "export-sog": Work(1.0, megapixels=0.2),
    "export-tiles": Work(1.0, megapixels=0.2),
    "export-html": Work(1.0, megapixels=0.1),
    "export-cameras": Work(0.5, photographs=0.1),
    "export-opf": Work(3.0, photographs=0.03, megapixels=0.3),
    "report": Work(2.5, photographs=0.05),
}


def cores_factor() -> float:
    """Return how many times as long as in `COSTS` a parallel step takes with this process's threads."""
    return MEASURED_CORES / min(thread_count(), _MOST_CORES)


def iteration_seconds(
    pixels: float,
    gaussians: float,
    photographs: int,
    *,
    surface: bool,
    crops: int = 1,
    visible: float | None = None,
) -> float:
    """Return the seconds of one iteration on the machine of `MEASURED_ON`, with surface losses or without.

    Pixels and visible Gaussians are those of a photograph, which is seen in crops, one at an iteration. None: the
    visible Gaussians follow from the Gaussians of the model and its photographs.
    """
    if visible is None:
        visible = gaussians * min(_SEEN_BY / max(photographs, 1), _MOST_SEEN)
    work = Work(megapixels=pixels / crops / 1e6, visible=visible / crops / 1e6, gaussians=gaussians / 1e6)
    return (SURFACE_FACTOR if surface else 1.0) * COSTS["iteration"].of(work)


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
