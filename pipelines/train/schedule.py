"""Schedule of the joint optimisation: view, image size, harmonics, weight and rate of each iteration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from pipelines.core.types import IntArray
from pipelines.splat.surface import SurfaceSettings
from pipelines.train.options import LossOptions, TrainOptions
from pipelines.train.target_images import Crops

_FINAL_RATE = 0.05  # of the geographic unknowns, relative to their first learning rate
# Factor by which photographs are shrunken, and the fraction of the training up to which they are. A larger factor
# would make the Gaussians smaller than a pixel, and push them off the surface that they start on.
COARSE = ((2, 0.3),)
_DENSITY_UNTIL = 0.5  # of the training
_GEO_RISE = 0.1  # τ of eq. 27, as a fraction of the iterations
BACKGROUND = (0.0, 0.0, 0.0)  # RGB behind the scene in renders of the trained model


@dataclass(frozen=True)
class JointOptions:
    """Settings of the joint optimisation."""

    iterations: int
    sh_degree: int = 3  # that the spherical harmonics reach
    losses: LossOptions = field(default_factory=LossOptions)  # weights that the user decides
    # first learning rate of similarity, cameras, lens and systematic errors, in standard deviations an iteration
    solution_rate: float = 0.01
    seed: int = 0  # of the order of views
    coarse: tuple[tuple[int, float], ...] = ()  # (factor, fraction of the training that sees them shrunken)
    coarse_least_px: int = 160  # lower limit of the longest side of a shrunken photograph
    crops: Crops | None = None  # of large photographs; None: all are trained as wholes
    surface: SurfaceSettings | None = None  # weights; None: no surface losses
    finishing: bool = False  # the Gaussians are trained already, with all their harmonics

    @classmethod
    def of(cls, options: TrainOptions) -> JointOptions:
        """Return the settings of a training with the options of `georef train`."""
        return cls(
            options.effort.iterations,
            options.sh_degree,
            losses=options,
            seed=options.seed,
            coarse=COARSE if options.coarse_to_fine else (),
            crops=Crops(options.crop_size, options.seed),
            surface=SurfaceSettings() if options.geometry_regularisation else None,
        )


def pyramid(
    width: int, height: int, coarse: tuple[tuple[int, float], ...], crops: Crops | None
) -> list[tuple[int, float]]:
    """Return factors by which a photograph is shrunken, and the fraction of the training up to which it is.

    A photograph that is trained in crops is first shrunken until it is seen as a whole, and then by half of that
    factor until density control ends. The others follow `coarse`.
    """
    if not coarse:
        return [(1, 1.0)]
    whole = 1 if crops is None else crops.shrink(width, height)
    levels = [(max(shrink, whole), until) for shrink, until in coarse]
    return [*levels, (max(whole // 2, 1), max(_DENSITY_UNTIL, levels[-1][1])), (1, 1.0)]


class TrainingSchedule:
    """Settings of an iteration that follow from its number, counted from 1.

    A finished training can be extended: it goes on at the place of its last iteration in the schedule of the longer
    training. Rates rise to those of that place and fall again, and density control goes on if it is not over there.
    Coarse photographs do not come back, and harmonics that were in use stay so.

    Attributes:
        views: (V,) indices of the training images.
        extended_from: last iteration of the finished training that this one extends; 0: none.
    """

    def __init__(self, options: JointOptions, views: IntArray) -> None:
        self.options, self.views = options, views
        self.extended_from = 0

    def view(self, iteration: int) -> int:
        """Return the training image of an iteration.

        Each epoch shows every image once, in an order that depends only on seed and epoch.
        """
        epoch, place = divmod(iteration - 1, len(self.views))
        order = np.random.default_rng([self.options.seed, epoch]).permutation(len(self.views))
        return int(self.views[order[place]])

    def visit(self, iteration: int) -> int:
        """Return how often the training image of an iteration was seen before."""
        return (iteration - 1) // len(self.views)

    def shrink(self, iteration: int, width: int, height: int) -> int:
        """Return the factor by which a photograph of that size is shrunken; see `pyramid`."""
        if self.extended_from:
            return 1
        most = max(max(width, height) // self.options.coarse_least_px, 1)
        progress = self.progress(iteration)
        levels = pyramid(width, height, self.options.coarse, self.options.crops)
        return min(next((shrink for shrink, until in levels if progress <= until), 1), most)

    def sh_degree(self, iteration: int) -> int:
        """Return the degree of the harmonics, which rises by one after each sixth of the training.

        So it reaches 3 at half of the training (3DGS: after each 1 000 of 30 000 iterations).
        """
        every = max(self.options.iterations // 6, 1)
        degree = min(self.options.sh_degree, iteration // every)
        return self.options.sh_degree if self.extended_from or self.options.finishing else degree

    def geographic_weight(self, iteration: int) -> float:
        """Return w(t) = w_max (1 − exp(−t/τ)), GeoRefGS eq. 27, or w_max if the weight is constant."""
        weights = self.options.losses
        if weights.geo_schedule == "constant":
            return weights.geo_weight
        return weights.geo_weight * (1.0 - math.exp(-iteration / (_GEO_RISE * self.options.iterations)))

    def geographic_rate(self, iteration: int) -> float:
        """Return the factor on the first learning rates of the geographic unknowns."""
        return float(_FINAL_RATE ** self.progress(iteration))

    def weight_of_normals(self, iteration: int) -> float:
        """Return the weight of the consistency of depth and normals; 0: the render needs no normals."""
        surface = self.options.surface
        if surface is None or self.progress(iteration) <= surface.normals_from or iteration % surface.normals_every:
            return 0.0
        return surface.normals_every * surface.normals

    def progress(self, iteration: int) -> float:
        """Return the fraction of the training that is done, 0 … 1."""
        return iteration / self.options.iterations
