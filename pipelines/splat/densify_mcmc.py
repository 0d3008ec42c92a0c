"""3D Gaussian Splatting as Markov chain Monte Carlo (doi 10.48550/arXiv.2404.09591).

The Gaussians are samples of what the scene looks like. Transparent ones are moved to where opaque ones are, in such
a way that the image stays the same (section 3.4, eq. 9); noise lets them explore (eq. 8); two penalties let those
disappear that are not needed (eq. 10). The number grows by a fixed share up to a fixed limit: no thresholds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.splat.contributions import Probe
from pipelines.splat.densify import Change
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.morton import morton_order
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import Pinhole, ScreenStats

_MOST_COPIES = 51  # of one Gaussian in one edit: the binomials of eq. 9 are tabulated
_SIGMOID_STEEPNESS, _SIGMOID_CENTRE = 100.0, 0.995


@dataclass(frozen=True)
class McmcSettings:
    """Settings of `McmcStrategy`; iterations count from 1.

    Attributes:
        start: move and add Gaussians after this iteration,
        stop: and up to this one,
        every: after each so many iterations.
        growth: share of Gaussians to add at each edit.
        dead_opacity: what is less opaque is moved.
        noise: standard deviation of the noise, in learning rates of the centres times covariance, all in scene
            extents. The paper's 5e5 is for scenes whose extent is about 5 units, hence the factor 5².
        opacity_penalty: weight of the mean opacity,
        scale_penalty: and of the mean standard deviation, in scene extents.
        max_gaussians: never more than so many.
    """

    start: int = 500
    stop: int = 25_000
    every: int = 100
    growth: float = 0.05
    dead_opacity: float = 0.005
    noise: float = 5e5 * 5**2
    opacity_penalty: float = 0.01
    scale_penalty: float = 0.01 * 5
    max_gaussians: int = 1_000_000

    @classmethod
    def for_iterations(cls, iterations: int, count: int, max_gaussians: int) -> McmcSettings:
        """The schedule of the paper, made for 30 000 iterations, fitted to another length.

        The limit is to be reached at half of the training: shorter ones grow by more at each edit.
        """
        start, stop = min(max(iterations // 20, 50), 500), iterations * 5 // 6
        every = min(max(iterations // 40, 50), 100)
        edits = max((iterations // 2 - start) // every, 1)
        growth = (max_gaussians / max(count, 1)) ** (1 / edits) - 1
        return cls(start, stop, every, growth=max(growth, 0.05), max_gaussians=max_gaussians)


class McmcStrategy:
    """Relocation, growth and noise; see the module."""

    def __init__(self, settings: McmcSettings, extent_m: float, seed: int = 0) -> None:
        """Start; `extent_m` is the size of the scene."""
        self.settings, self.extent_m = settings, extent_m
        self._generator = torch.Generator().manual_seed(seed)
        self._visible: Tensor | None = None

    def penalty(self, gaussians: Gaussians, stats: ScreenStats) -> Tensor | None:
        """Mean opacity and mean standard deviation of what is visible, weighted.

        Only visible rows are updated; a Gaussian that is not shall not shrink either.
        """
        rows = stats.visible
        share = len(rows) / max(len(gaussians), 1)
        opacity = torch.sigmoid(gaussians.logit_opacities[rows]).mean()
        scale = gaussians.log_scales[rows].exp().mean() / self.extent_m
        return share * (self.settings.opacity_penalty * opacity + self.settings.scale_penalty * scale)

    def observe(self, stats: ScreenStats, camera: Pinhole) -> None:
        """Remember which Gaussians this iteration moves."""
        self._visible = stats.visible

    def update(self, iteration: int, optimizer: GaussianAdam, probe: Probe | None = None) -> Change:
        """See `Strategy.update`; the noise of this iteration is added, too."""
        settings, change = self.settings, Change()
        if settings.start < iteration <= settings.stop and iteration % settings.every == 0:
            change = self._edit(optimizer)
            self._visible = None
        if self._visible is not None and len(self._visible):
            self._shake(iteration, optimizer, self._visible)
        return change

    def state(self) -> dict[str, Tensor]:
        """See `Strategy.state`."""
        return {"generator": self._generator.get_state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """See `Strategy.restore`."""
        self._generator.set_state(state["generator"].cpu())

    @torch.no_grad()
    def _shake(self, iteration: int, optimizer: GaussianAdam, rows: Tensor) -> None:
        """Eq. 8: noise shaped like the Gaussian, on transparent ones, that fades with the learning rate."""
        moved = optimizer.gaussians
        opacity = torch.sigmoid(moved.logit_opacities[rows])
        free = torch.sigmoid(_SIGMOID_STEEPNESS * (1 - opacity - _SIGMOID_CENTRE))
        noise = torch.randn(len(rows), 3, generator=self._generator).to(opacity)
        rotation, variance = rotation_matrices(moved.quats_wxyz[rows]), (2 * moved.log_scales[rows]).exp()
        along = variance * (rotation.transpose(1, 2) @ noise[..., None])[..., 0]
        shaped = (rotation @ along[..., None])[..., 0]
        length = self.settings.noise * optimizer.means_rate(iteration) / self.extent_m
        moved.means[rows] += length * free[:, None] * shaped

    @torch.no_grad()
    def _edit(self, optimizer: GaussianAdam) -> Change:
        """Move the dead, add new ones, and put all into spatial order."""
        gaussians, settings = optimizer.gaussians.detached(), self.settings
        opacity = torch.sigmoid(gaussians.logit_opacities)
        dead = (opacity <= settings.dead_opacity).nonzero()[:, 0]
        count = len(gaussians)
        target = min(settings.max_gaussians, math.ceil((1 + settings.growth) * count))
        added = max(target - count, 0) if len(dead) < count else 0
        relocated = len(dead) if len(dead) < count else 0
        if relocated + added == 0:
            return Change()
        parent = self._drawn(opacity, dead, relocated + added)
        source = torch.arange(count, device=opacity.device)
        source[dead[:relocated]] = -1
        copies = torch.bincount(parent, minlength=count)
        shared = _shared_among(gaussians, copies + 1)
        source[copies > 0] = -1  # their moments belong to what they were
        edited = Gaussians.concatenate([shared, shared.select(parent[relocated:])])
        for name, tensor in edited.tensors().items():
            tensor[dead[:relocated]] = shared.tensors()[name][parent[:relocated]]
        source = torch.cat([source, source.new_full((added,), -1)])
        order = morton_order(edited.means)
        optimizer.rearrange(edited.select(order), source[order])
        return Change(cloned=added, relocated=relocated)

    def _drawn(self, opacity: Tensor, dead: Tensor, count: int) -> Tensor:
        """Parents (count,), drawn by opacity from those that live."""
        chance = opacity.double().cpu().clone()
        chance[dead.cpu()] = 0
        # Inverse of the cumulative distribution: `multinomial` takes no more than 2²⁴ categories.
        level = torch.cumsum(chance, dim=0)
        drawn = torch.rand(count, generator=self._generator, dtype=torch.float64) * level[-1]
        parent = torch.searchsorted(level, drawn, right=True).clamp_max(len(level) - 1)
        return parent.to(opacity.device)


def _shared_among(gaussians: Gaussians, copies: Tensor) -> Gaussians:
    """The Gaussians with opacity and scale such that `copies` (N,) of each look like one did (eq. 9)."""
    shared = Gaussians(**{name: tensor.clone() for name, tensor in gaussians.tensors().items()})
    rows = (copies > 1).nonzero()[:, 0]
    n = copies[rows].clamp_max(_MOST_COPIES)
    opacity = torch.sigmoid(gaussians.logit_opacities[rows].double())
    each = 1 - (1 - opacity) ** (1 / n)
    # A logit of 1 is infinite, and a copy below the dead ones' opacity would be moved at once.
    shared.logit_opacities[rows] = torch.logit(each.clamp(0.005, 1 - 1e-6)).to(shared.logit_opacities)
    shared.log_scales[rows] += (opacity / _overlap(each, n)).log().to(shared.log_scales)[:, None]
    return shared


def _overlap(opacity: Tensor, n: Tensor) -> Tensor:
    """Σ_{i=1..n} Σ_{k=0..i−1} C(i−1, k) (−1)^k o^(k+1) / √(k+1) for opacities (N,) and numbers n (N,).

    The alternating sum loses its digits in the binomials. With 1/√(k+1) = 2/√π ∫₀^∞ exp(−(k+1) t²) dt both sums
    can be carried out: it is 2/√π ∫₀^∞ 1 − (1 − o exp(−t²))^n dt, whose integrand is even and smooth, so that the
    trapezoidal rule is exact to many digits.
    """
    step, total = 0.1, (1 - (1 - opacity) ** n) / 2
    for node in range(1, 61):
        total = total + 1 - (1 - opacity * math.exp(-((node * step) ** 2))) ** n
    return 2 / math.sqrt(math.pi) * step * total
