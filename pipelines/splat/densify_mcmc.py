"""3D Gaussian Splatting as Markov chain Monte Carlo (doi 10.48550/arXiv.2404.09591).

The Gaussians are samples of a distribution that represents the scene.

1. Transparent Gaussians move to places of opaque ones, in such a way that the image stays the same (section 3.4,
   eq. 9).
2. Noise lets Gaussians explore (eq. 8).
3. Two penalties make superfluous Gaussians disappear (eq. 10).
4. The number grows by a fixed share up to a fixed limit, without thresholds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.densify import DensityEdit, Growing, Probe
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import ScreenStats
from pipelines.splat.spatial import morton_order

_DEAD_OPACITY = 0.005  # Gaussians up to this opacity are moved
# Weights of the mean opacity, and of the mean standard deviation in scene extents.
_OPACITY_PENALTY, _SCALE_PENALTY = 0.01, 0.01 * 5
_MOST_COPIES = 51  # of one Gaussian in one edit: the binomials of eq. 9 are tabulated
_SEEDS_APART = 1_000_003  # more than there are iterations
_SIGMOID_STEEPNESS, _SIGMOID_CENTRE = 100.0, 0.995


@dataclass(frozen=True)
class McmcSettings:
    """Settings of `McmcStrategy`; iterations count from 1."""

    start: int = 500  # Gaussians are moved and added after it
    stop: int = 25_000  # and up to it
    every: int = 100  # so many iterations
    growth: float = 0.05  # share of Gaussians to add at each edit
    # standard deviation of the noise, in learning rates of the centres times covariance, all in scene extents. The
    # paper's 5e5 is for scenes whose extent is about 5 units, hence the factor 5²
    noise: float = 5e5 * 5**2
    max_gaussians: int = 1_000_000

    @classmethod
    def for_iterations(cls, iterations: int, count: int, max_gaussians: int) -> McmcSettings:
        """Return the schedule of the paper, made for 30 000 iterations, adapted to another length.

        The number reaches its limit at half of the training: shorter trainings grow by more at each edit.
        """
        start, stop = min(max(iterations // 20, 50), 500), iterations * 5 // 6
        every = min(max(iterations // 40, 50), 100)
        edits = max((iterations // 2 - start) // every, 1)
        growth = (max_gaussians / max(count, 1)) ** (1 / edits) - 1
        return cls(start, stop, every, growth=max(growth, 0.05), max_gaussians=max_gaussians)


class McmcStrategy:
    """Relocation, growth and noise in a scene of size `extent_m`; none is added where `growing` is false."""

    growing: Growing | None = None

    def __init__(self, settings: McmcSettings, extent_m: float, seed: int = 0) -> None:
        self.settings, self.extent_m, self._seed = settings, extent_m, seed
        self._generator = torch.Generator().manual_seed(seed)
        self._visible: Tensor | None = None

    def penalty(self, gaussians: Gaussians, stats: ScreenStats, count: int) -> Tensor | None:
        """Return the weighted sum of mean opacity and mean standard deviation of the visible Gaussians.

        Only visible rows are updated. Invisible Gaussians must not shrink either.
        """
        rows = stats.visible
        share = len(rows) / max(count, 1)
        opacity = torch.sigmoid(gaussians.logit_opacities[rows]).mean()
        scale = gaussians.log_scales[rows].exp().mean() / self.extent_m
        return share * (_OPACITY_PENALTY * opacity + _SCALE_PENALTY * scale)

    def observe(self, stats: ScreenStats, camera: Pinhole) -> None:
        self._visible = stats.visible

    def update(self, iteration: int, optimizer: GaussianAdam, probe: Probe | None = None) -> DensityEdit:
        settings, edit = self.settings, DensityEdit()
        if settings.start < iteration <= settings.stop and iteration % settings.every == 0:
            edit = self._edit(optimizer)
            self._visible = None
        if self._visible is not None and len(self._visible):
            self._shake(iteration, optimizer, self._visible)
        return edit

    def state(self) -> dict[str, Tensor]:
        return {"generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        self._generator.set_state(state["generator"].cpu())

    @torch.no_grad()
    def _shake(self, iteration: int, optimizer: GaussianAdam, rows: Tensor) -> None:
        """Add the noise of eq. 8: shaped like the Gaussian, on transparent ones, fading with the learning rate."""
        moved = optimizer.gaussians
        opacity = torch.sigmoid(moved.logit_opacities[rows])
        free = torch.sigmoid(_SIGMOID_STEEPNESS * (1 - opacity - _SIGMOID_CENTRE))
        if opacity.device.type == "cpu":
            noise = torch.randn(len(rows), 3, generator=self._generator)
        else:
            # Made on the device: copies from the CPU would wait for all its work. The seed follows from the
            # iteration, so that a resumed training shakes as an uninterrupted one does.
            generator = torch.Generator(opacity.device).manual_seed(self._seed * _SEEDS_APART + iteration)
            noise = torch.randn(len(rows), 3, generator=generator, device=opacity.device)
        rotation, variance = rotation_matrices(moved.quats_wxyz[rows]), (2 * moved.log_scales[rows]).exp()
        along = variance * (rotation.transpose(1, 2) @ noise[..., None])[..., 0]
        shaped = (rotation @ along[..., None])[..., 0]
        length = self.settings.noise * optimizer.means_rate(iteration) / self.extent_m
        moved.means[rows] += length * free[:, None] * shaped

    @torch.no_grad()
    def _edit(self, optimizer: GaussianAdam) -> DensityEdit:
        gaussians, settings = optimizer.gaussians.detached(), self.settings
        opacity = torch.sigmoid(gaussians.logit_opacities)
        dead = (opacity <= _DEAD_OPACITY).nonzero()[:, 0]
        count = len(gaussians)
        target = min(settings.max_gaussians, math.ceil((1 + settings.growth) * count))
        added = max(target - count, 0) if len(dead) < count else 0
        relocated = len(dead) if len(dead) < count else 0
        if relocated + added == 0:
            return DensityEdit()
        if self.growing is not None and bool((inside := self.growing(gaussians.means)).any()):
            opacity = torch.where(inside, opacity, torch.zeros_like(opacity))
        parent = self._drawn(opacity, dead, relocated + added)
        source = torch.arange(count, device=opacity.device)
        source[dead[:relocated]] = -1
        copies = torch.bincount(parent, minlength=count)
        shared = _shared_among(gaussians, copies + 1)
        source[copies > 0] = -1  # their moments belong to their former opacities and scales
        edited = Gaussians.concatenate([shared, shared.select(parent[relocated:])])
        for name, tensor in edited.tensors().items():
            tensor[dead[:relocated]] = shared.tensors()[name][parent[:relocated]]
        source = torch.cat([source, source.new_full((added,), -1)])
        order = morton_order(edited.means)
        optimizer.rearrange(edited.select(order), source[order])
        return DensityEdit(cloned=added, relocated=relocated)

    def _drawn(self, opacity: Tensor, dead: Tensor, count: int) -> Tensor:
        """Return parents (count,), drawn by opacity from the living Gaussians."""
        chance = opacity.double().cpu().clone()
        chance[dead.cpu()] = 0
        # Inverse of the cumulative distribution: `multinomial` takes no more than 2²⁴ categories.
        level = torch.cumsum(chance, dim=0)
        drawn = torch.rand(count, generator=self._generator, dtype=torch.float64) * level[-1]
        parent = torch.searchsorted(level, drawn, right=True).clamp_max(len(level) - 1)
        return parent.to(opacity.device)


def _shared_among(gaussians: Gaussians, copies: Tensor) -> Gaussians:
    """Return Gaussians whose `copies` (N,) together look like each original did (eq. 9: opacity and scale)."""
    shared = Gaussians(**{name: tensor.clone() for name, tensor in gaussians.tensors().items()})
    rows = (copies > 1).nonzero()[:, 0]
    n = copies[rows].clamp_max(_MOST_COPIES)
    opacity = torch.sigmoid(gaussians.logit_opacities[rows].double())
    shared_opacity = 1 - (1 - opacity) ** (1 / n)
    # A logit of 1 is infinite, and a copy below the opacity of dead Gaussians would be moved at once.
    shared.logit_opacities[rows] = torch.logit(shared_opacity.clamp(_DEAD_OPACITY, 1 - 1e-6)).to(
        shared.logit_opacities
    )
    shared.log_scales[rows] += (opacity / _overlap(shared_opacity, n)).log().to(shared.log_scales)[:, None]
    return shared


def _overlap(opacity: Tensor, n: Tensor) -> Tensor:
    """Return Σ_{i=1..n} Σ_{k=0..i−1} C(i−1, k) (−1)^k o^(k+1) / √(k+1) for opacities (N,) and numbers n (N,).

    The binomials cost the alternating sum its digits. With 1/√(k+1) = 2/√π ∫₀^∞ exp(−(k+1) t²) dt both sums have a
    closed form, 2/√π ∫₀^∞ 1 − (1 − o exp(−t²))^n dt. The integrand is even and smooth: the trapezoidal rule is
    exact to many digits.
    """
    step, total = 0.1, (1 - (1 - opacity) ** n) / 2
    for node in range(1, 61):
        total = total + 1 - (1 - opacity * math.exp(-((node * step) ** 2))) ** n
    return 2 / math.sqrt(math.pi) * step * total
