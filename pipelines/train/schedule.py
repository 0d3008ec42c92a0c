"""The schedule of the joint optimisation: view, size, harmonics, weight and rate at an iteration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import IntArray
from pipelines.georef.weights import WeightSchedule, rising_weight
from pipelines.splat.surface import SurfaceSettings

_FINAL_RATE = 0.05  # of the geographic learning rates, relative to the first


@dataclass(frozen=True)
class JointOptions:
    """Settings of the joint optimisation.

    Attributes:
        iterations: length of the training.
        sh_degree: degree that the spherical harmonics reach.
        geo_weight: w_max of eq. 27.
        geo_rise: τ of eq. 27, as a fraction of the iterations.
        geo_schedule: "rising" as in eq. 27, or "constant": w_max from the first iteration.
        similarity_rate: first learning rate of the similarity and of constant errors of the measurements, in
            standard deviations an iteration.
        camera_rate: first learning rate of the camera corrections, likewise.
        variance_rate: first learning rate of the log-variances of the geographic terms.
        background: colour behind the scene.
        seed: of the order of views.
        coarse: (shrink, fraction) pairs: photographs are shrunken so much up to this fraction of the training.
        coarse_least_px: but never to a longest side of less than this.
        surface: weights of the surface losses; None: the photographs alone decide.
    """

    iterations: int
    sh_degree: int = 3
    geo_weight: float = 0.05
    geo_rise: float = 0.1
    geo_schedule: WeightSchedule = "rising"
    similarity_rate: float = 0.1
    camera_rate: float = 0.01
    variance_rate: float = 0.01
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0
    coarse: tuple[tuple[int, float], ...] = ()
    coarse_least_px: int = 160
    surface: SurfaceSettings | None = None


class TrainingSchedule:
    """Everything that follows from the number of an iteration, counted from 1.

    Args:
        options: settings of the optimisation.
        views: (V,) indices of the training images.
    """

    def __init__(self, options: JointOptions, views: IntArray) -> None:
        self._options, self._views = options, views

    def view(self, iteration: int) -> int:
        """Return the training image: every one once an epoch, in an order that seed and epoch alone decide."""
        epoch, place = divmod(iteration - 1, len(self._views))
        order = np.random.default_rng([self._options.seed, epoch]).permutation(len(self._views))
        return int(self._views[order[place]])

    def shrink(self, iteration: int, longest_side_px: int) -> int:
        """Return how many times smaller the photograph of that size is shown."""
        most = max(longest_side_px // self._options.coarse_least_px, 1)
        progress = self.progress(iteration)
        return min(next((shrink for shrink, until in self._options.coarse if progress <= until), 1), most)

    def sh_degree(self, iteration: int) -> int:
        """Return the degree: one more each sixth of the training, up to half of it (3DGS: each 1 000 of 30 000)."""
        every = max(self._options.iterations // 6, 1)
        return min(self._options.sh_degree, iteration // every)

    def geographic_weight(self, iteration: int) -> float:
        """Return w(t) of eq. 27, or its final value where the weight is constant."""
        options = self._options
        if options.geo_schedule == "constant":
            return options.geo_weight
        return rising_weight(iteration, options.geo_weight, options.geo_rise * options.iterations)

    def geographic_rate(self, iteration: int) -> float:
        """Return the learning rates of the geographic unknowns, relative to the first."""
        return float(_FINAL_RATE ** self.progress(iteration))

    def progress(self, iteration: int) -> float:
        """Return the part of the training that is done, 0 … 1."""
        return iteration / self._options.iterations
