"""Density control: strategies that add and remove Gaussians while training, behind one small interface.

A strategy observes every render after its backward pass. Then it may edit the Gaussians through the optimiser,
which keeps the moments of the rows that stay. All random numbers come from the strategy's own generator.

The blending weight of Gaussian k at pixel p is w_k(p) = α_k(p) T_k(p), and Σ_p w_k(p) e(p) is the derivative of
Σ_p e(p) c(p) by the Gaussian's colour. One render of grey Gaussians and its backward pass therefore give the sums
of all Gaussians at once, on every backend (the auxiliary gradient of doi 10.48550/arXiv.2404.06109, section 3.1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings, ScreenStats
from pipelines.splat.sh import C0
from pipelines.splat.spatial import morton_order

# An error counts as high from this fraction of the view's largest (FastGS takes maps normalised to 0 … 1).
_HIGH_ERROR = 0.1


@dataclass(frozen=True)
class ViewContributions:
    """Pixels (N,) that N Gaussians make up in one view, Σ w, and those with a high error, Σ w [error is high]."""

    weight_px: Tensor
    high_error_px: Tensor


# Returns which of means (N, 3) in `model` lie where Gaussians may be added.
Growing = Callable[[Tensor], Tensor]
# Returns the contributions to a number of different training views, drawn with the generator.
Probe = Callable[[int, torch.Generator], list[ViewContributions]]


def view_contributions(
    gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, error: Tensor, rasterizer: Rasterizer
) -> ViewContributions:
    """Return the contributions of N Gaussians to a view of H × W pixels from a pose (4, 4).

    The absolute error (H, W) of the view is 0 where no pixel counts.
    """
    scaled = error / error.max().clamp_min(1e-9)
    maps = torch.stack([torch.ones_like(error), (scaled > _HIGH_ERROR).to(error), torch.zeros_like(error)], dim=-1)
    grey = gaussians.detached()
    grey.sh = torch.zeros(len(gaussians), 1, 3, device=error.device, requires_grad=True)
    with torch.enable_grad():
        render = rasterizer.render(grey, cam_from_model.detach(), camera, RasterSettings(sh_degree=0))
        (gradient,) = torch.autograd.grad((render.colour * maps).sum(), grey.sh)
    sums = gradient[:, 0] / C0
    return ViewContributions(sums[:, 0], sums[:, 1])


_SPLIT_SCALE = 0.01  # largest standard deviation to clone, in scene extents; larger Gaussians are split
_LEAST_OPACITY = 0.005  # Gaussians below are removed
_LARGEST_SCALE = 0.1  # of the scene extent plus the distance from its middle: Gaussians above are removed
_RESET_OPACITY = 0.01  # largest after a reset
_CHILDREN = 2
_SHRINK = 0.8 * _CHILDREN  # 3DGS: a child of a split has 1/1.6 of its parent's standard deviations


@dataclass(frozen=True)
class DensityEdit:
    """Numbers of Gaussians that a strategy edited in one iteration."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0
    relocated: int = 0
    opacity_reset: bool = False


class Strategy(Protocol):
    """Interface of density control."""

    def penalty(self, gaussians: Gaussians, stats: ScreenStats, count: int) -> Tensor | None:
        """Return a scalar term to add to the loss of a render of some of `count` Gaussians, or None."""

    def observe(self, stats: ScreenStats, camera: Pinhole) -> None:
        """Record a render, after its backward pass."""

    def update(self, iteration: int, optimizer: GaussianAdam, probe: Probe | None = None) -> DensityEdit:
        """Edit the Gaussians if the schedule says so; called after the optimiser's step of every iteration, from 1.

        The `probe` returns contributions to sampled training views, for strategies that need them.
        """

    def state(self) -> dict[str, Tensor]:
        """Return copies of the running state, for a checkpoint."""

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore a state."""


@dataclass(frozen=True)
class DefaultSettings:
    """Settings of `DefaultStrategy`; iterations count from 1."""

    start: int = 500  # Gaussians are added after it
    stop: int = 15_000  # and up to it
    every: int = 100  # at every such number of iterations
    reset_every: int = 3_000  # iterations between opacity resets, before `stop` (0: none)
    # mean length of ∂L/∂(centre in normalised device coordinates) from which a Gaussian is cloned or split
    gradient_threshold: float = 2e-4
    prune_scale_from: int = 3_000  # Gaussians are removed for their size after this iteration
    max_gaussians: int = 1_000_000

    @classmethod
    def for_iterations(cls, iterations: int, max_gaussians: int, surveys: float = 1.0) -> DefaultSettings:
        """Return the schedule of 3DGS, made for 30 000 iterations, adapted to a training of another length.

        Fewer iterations mean more frequent, not only fewer, additions; between two of them every Gaussian must
        still be seen a few times. Recovery from a reset of the opacities takes several hundred iterations: short
        trainings have none. A survey as large as so many `surveys` sees each Gaussian as many times less often, and
        has the schedule of a training of its share, in so many times as many iterations.
        """
        share = int(iterations / surveys)
        stop, reset_every = share // 2, max(share // 10, 1_500)
        return cls(
            start=int(surveys * min(max(share // 20, 50), 500)),
            stop=int(surveys * stop),
            every=int(surveys * min(max(share // 40, 50), 100)),
            reset_every=int(surveys * reset_every) if reset_every < stop else 0,
            prune_scale_from=iterations // 10,
            max_gaussians=max_gaussians,
        )


class DefaultStrategy:
    """Adaptive density control of 3D Gaussian Splatting (doi 10.1145/3592433, section 5.2).

    1. Gaussians with a large gradient of the projected centre are cloned if small, and split if large. If the limit
       leaves no room for all, those with the largest gradients come first.
    2. Transparent and oversized Gaussians are removed.
    3. Opacities are reset at intervals.
    4. Edited Gaussians are put back into spatial order.

    Where `growing` is false, none are added.
    """

    growing: Growing | None = None

    def __init__(self, settings: DefaultSettings, extent_m: float, count: int, seed: int = 0) -> None:
        self.settings = settings
        self.extent_m = extent_m
        self._generator = torch.Generator().manual_seed(seed)
        self._gradient_sum = torch.zeros(count)
        self._observations = torch.zeros(count)

    def penalty(self, gaussians: Gaussians, stats: ScreenStats, count: int) -> Tensor | None:
        """See `Strategy.penalty`; the photographs alone decide."""
        return None

    def observe(self, stats: ScreenStats, camera: Pinhole) -> None:
        """Add a render's screen gradients to those since the last edit; a ValueError: it had no backward pass."""
        if stats.mean_gradient is None:
            raise ValueError("the render has no screen gradients yet: call backward() first")
        # Threshold and 3DGS are in normalised device coordinates: 2 units across the image.
        x, y = stats.mean_gradient.unbind(dim=1)
        length = torch.hypot(x * (camera.width / 2), y * (camera.height / 2)).float()
        self._gradient_sum = self._gradient_sum.to(length.device)
        self._observations = self._observations.to(length.device)
        self._gradient_sum.index_add_(0, stats.visible, length)
        counted = torch.ones_like(length) if stats.counted is None else stats.counted.to(length)
        self._observations.index_add_(0, stats.visible, counted)

    def update(self, iteration: int, optimizer: GaussianAdam, probe: Probe | None = None) -> DensityEdit:
        settings, edit = self.settings, DensityEdit()
        if settings.start < iteration <= settings.stop and iteration % settings.every == 0:
            alive = self._alive(optimizer.gaussians.detached(), iteration)
            gradient = (self._gradient_sum / self._observations.clamp_min(1)).to(alive.device)
            chosen = self._growing(optimizer, alive & (gradient >= settings.gradient_threshold))
            edit = self._edit(optimizer, alive, self._within_room(alive, chosen, gradient))
        if settings.reset_every and iteration < settings.stop and iteration % settings.reset_every == 0:
            ceiling = math.log(_RESET_OPACITY / (1 - _RESET_OPACITY))
            capped = optimizer.gaussians.logit_opacities.detach().clamp_max(ceiling)
            optimizer.overwrite("logit_opacities", capped)
            edit = replace(edit, opacity_reset=True)
        return edit

    def state(self) -> dict[str, Tensor]:
        return {
            "gradient_sum": self._gradient_sum.clone(),
            "observations": self._observations.clone(),
            "generator": self._generator.get_state(),
        }

    def restore(self, state: dict[str, Tensor]) -> None:
        self._gradient_sum = state["gradient_sum"].clone()
        self._observations = state["observations"].clone()
        self._generator.set_state(state["generator"])

    def _edit(self, optimizer: GaussianAdam, alive: Tensor, chosen: Tensor) -> DensityEdit:
        """Keep the Gaussians of the mask `alive`, and add one for each of the mask `chosen`."""
        gaussians = optimizer.gaussians.detached()
        large = gaussians.log_scales.amax(dim=1).exp() > _SPLIT_SCALE * self.extent_m
        cloned, parents = chosen & ~large, chosen & large
        stay = (alive & ~parents).nonzero()[:, 0]
        parts = [gaussians.select(stay), gaussians.select(cloned), self._children(gaussians.select(parents))]
        edited = Gaussians.concatenate(parts)
        source = torch.full((len(edited),), -1, dtype=torch.int64, device=stay.device)
        source[: len(stay)] = stay
        order = morton_order(edited.means)
        optimizer.rearrange(edited.select(order), source[order])
        self._gradient_sum = edited.means.new_zeros(len(edited))
        self._observations = torch.zeros_like(self._gradient_sum)
        return DensityEdit(int(cloned.sum()), int(parents.sum()), int((~alive).sum()))

    def _alive(self, gaussians: Gaussians, iteration: int) -> Tensor:
        alive = torch.sigmoid(gaussians.logit_opacities) >= _LEAST_OPACITY
        if iteration > self.settings.prune_scale_from:
            # Sky and horizon are far away. 3DGS compares with the extent alone, and so removes them with each edit;
            # the photographs then have a black background until other Gaussians have grown over it.
            distance = (gaussians.means - gaussians.means.median(dim=0).values).norm(dim=1)
            scale = gaussians.log_scales.amax(dim=1).exp()
            alive &= scale <= _LARGEST_SCALE * (self.extent_m + distance)
        return alive

    def _growing(self, optimizer: GaussianAdam, chosen: Tensor) -> Tensor:
        return chosen if self.growing is None else chosen & self.growing(optimizer.gaussians.means.detach())

    def _within_room(self, alive: Tensor, chosen: Tensor, score: Tensor) -> Tensor:
        """Reduce the mask `chosen` to the highest scores that the limit leaves room for."""
        room = max(self.settings.max_gaussians - int(alive.sum()), 0)
        if int(chosen.sum()) > room:
            strongest = torch.argsort(score * chosen, descending=True, stable=True)[:room]
            chosen = torch.zeros_like(chosen)
            chosen[strongest] = True
        return chosen

    def _children(self, parents: Gaussians) -> Gaussians:
        """Return two smaller Gaussians for each parent, at random places within it."""
        children = Gaussians.concatenate([parents] * _CHILDREN)
        noise = torch.randn(len(children), 3, generator=self._generator).to(children.means)
        offset = rotation_matrices(children.quats_wxyz) @ (children.log_scales.exp() * noise)[..., None]
        children.means = children.means + offset[..., 0]
        children.log_scales = children.log_scales - math.log(_SHRINK)
        return children


@dataclass(frozen=True)
class FastSettings:
    """Settings of `FastStrategy` beside those of the default one."""

    views: int = 10  # to sample for an edit
    high_error_px: float = 0.2  # mean over the views that see a Gaussian from which it is cloned or split
    least_px: float = 0.2  # a Gaussian that makes up fewer pixels in each of the views is removed,
    least_views: int = 2  # if at least this number of views sees it
    prune_stop: int = 25_000  # last iteration that removes Gaussians, later than the last that adds them


class FastStrategy(DefaultStrategy):
    """Density control by several views together: fewer Gaussians for the same image.

    After FastGS (doi 10.48550/arXiv.2511.04283, section 3) and Taming 3DGS (doi 10.1145/3680528.3687694):

    1. A Gaussian is cloned or split only if it makes up pixels with a high error in several sampled views; a large
       gradient in one view is not enough. Those with most pixels in error come first, if room is short.
    2. A Gaussian that makes up hardly any pixel of any view is removed.
    """

    def __init__(
        self, settings: DefaultSettings, fast: FastSettings, extent_m: float, count: int, seed: int = 0
    ) -> None:
        super().__init__(settings, extent_m, count, seed)
        self.fast = fast

    def update(self, iteration: int, optimizer: GaussianAdam, probe: Probe | None = None) -> DensityEdit:
        """See `Strategy.update`; a ValueError says that there is no probe."""
        settings = self.settings
        adds = settings.start < iteration <= settings.stop and iteration % settings.every == 0
        # Sampling views costs renders, and removal alone changes little: a quarter of the edits is enough.
        removes = settings.stop < iteration <= self.fast.prune_stop and iteration % (4 * settings.every) == 0
        if not adds and not removes:
            return DensityEdit()
        if probe is None:
            raise ValueError("this strategy asks training views: it needs a probe")
        contributions = probe(self.fast.views, self._generator)
        weight = torch.stack([view.weight_px for view in contributions])
        views = (weight > 0).sum(dim=0)
        redundant = (views >= self.fast.least_views) & (weight.amax(dim=0) < self.fast.least_px)
        alive = self._alive(optimizer.gaussians.detached(), iteration) & ~redundant
        chosen = torch.zeros_like(alive)
        if adds:
            error = torch.stack([view.high_error_px for view in contributions])
            score = error.sum(dim=0) / views.clamp_min(1)
            gradient = (self._gradient_sum / self._observations.clamp_min(1)).to(alive.device)
            agreed = alive & (gradient >= settings.gradient_threshold) & (score >= self.fast.high_error_px)
            chosen = self._within_room(alive, self._growing(optimizer, agreed), score)
        return self._edit(optimizer, alive, chosen)
