"""Density control by several views together: fewer Gaussians for the same image.

After FastGS (doi 10.48550/arXiv.2511.04283, section 3) and Taming 3DGS (doi 10.1145/3680528.3687694):

1. A Gaussian is cloned or split only if it makes up pixels with a high error in several sampled views; a large
   gradient in one view is not enough.
2. A Gaussian that makes up hardly any pixel of any view is removed.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.splat.contributions import Probe, ViewContributions
from pipelines.splat.densify import DefaultSettings, DefaultStrategy, DensityEdit
from pipelines.splat.optimizer import GaussianAdam


@dataclass(frozen=True)
class FastSettings:
    """Settings of `FastStrategy` beside those of the default one.

    Attributes:
        views: number of views to sample for an edit.
        high_error_px: pixels of high error, mean over the views that see a Gaussian, from which that Gaussian is
            cloned or split.
        least_px: a Gaussian that makes up fewer pixels in each of the views is removed,
        least_views: if at least this number of views sees it.
        prune_stop: last iteration that removes Gaussians, later than the last that adds them.
    """

    views: int = 10
    high_error_px: float = 0.2
    least_px: float = 0.2
    least_views: int = 2
    prune_stop: int = 25_000

    @classmethod
    def for_iterations(cls, iterations: int) -> FastSettings:
        """Return settings whose removal ends at five sixths of the training, so that Gaussians can settle."""
        return cls(prune_stop=iterations * 5 // 6)


class FastStrategy(DefaultStrategy):
    """Default density control, with additions and removals that several views agree on."""

    def __init__(
        self, settings: DefaultSettings, fast: FastSettings, extent_m: float, count: int, seed: int = 0
    ) -> None:
        """Start without observations; see `DefaultStrategy`."""
        super().__init__(settings, extent_m, count, seed)
        self.fast = fast

    def update(self, iteration: int, optimizer: GaussianAdam, probe: Probe | None = None) -> DensityEdit:
        """See `Strategy.update`.

        Raises:
            ValueError: no probe.
        """
        settings = self.settings
        adds = settings.start < iteration <= settings.stop and iteration % settings.every == 0
        # Sampling views costs renders, and removal alone changes little: a quarter of the edits is enough.
        removes = settings.stop < iteration <= self.fast.prune_stop and iteration % (4 * settings.every) == 0
        if not adds and not removes:
            return DensityEdit()
        if probe is None:
            raise ValueError("this strategy asks training views: it needs a probe")
        contributions = probe(self.fast.views, self._generator)
        alive = self._alive(optimizer.gaussians.detached(), iteration) & ~self._redundant(contributions)
        chosen = self._agreed(alive, contributions) if adds else torch.zeros_like(alive)
        return self._edit(optimizer, alive, chosen)

    def _redundant(self, contributions: list[ViewContributions]) -> Tensor:
        """Return the mask of the Gaussians that views see, but that make up hardly any pixel of them."""
        weight = torch.stack([view.weight_px for view in contributions])
        views = (weight > 0).sum(dim=0)
        return (views >= self.fast.least_views) & (weight.amax(dim=0) < self.fast.least_px)

    def _agreed(self, alive: Tensor, contributions: list[ViewContributions]) -> Tensor:
        """Return the mask of the Gaussians to clone or split; those with most pixels in error if room is short."""
        error = torch.stack([view.high_error_px for view in contributions])
        views = torch.stack([view.weight_px > 0 for view in contributions]).sum(dim=0)
        score = error.sum(dim=0) / views.clamp_min(1)
        pulled = self._mean_gradient(alive.device) >= self.settings.gradient_threshold
        return self._within_room(alive, alive & pulled & (score >= self.fast.high_error_px), score)
