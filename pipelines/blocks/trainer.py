"""The joint optimisation: Gaussians, similarity and cameras, one training view an iteration (GeoRefGS 2.4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.blocks.checkpoint import prefixed, unprefixed
from pipelines.errors import ConvergenceError
from pipelines.formats.image_cache import ImageCache
from pipelines.georef.losses import rising_weight
from pipelines.georef.problem import GeoProblem
from pipelines.splat.densify import Strategy
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import photometric_loss
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.raster.api import Pinhole, Rasterizer, RasterSettings

_FINAL_RATE = 0.05  # of the geographic learning rates, relative to the first


@dataclass(frozen=True)
class JointOptions:
    """Schedule of the joint optimisation.

    Attributes:
        iterations: length of the training.
        sh_degree: degree that the spherical harmonics reach.
        geo_weight: w_max of eq. 27.
        geo_rise: τ of eq. 27, as a fraction of the iterations.
        similarity_rate: first learning rate of the similarity, in standard deviations an iteration.
        camera_rate: first learning rate of the camera corrections, likewise.
        background: colour behind the scene.
        seed: of the order of views.
    """

    iterations: int
    sh_degree: int = 3
    geo_weight: float = 0.05
    geo_rise: float = 0.1
    similarity_rate: float = 0.1
    camera_rate: float = 0.01
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0


@dataclass(frozen=True)
class Views:
    """Training views.

    Attributes:
        camera: (V,) indices into the cameras (and the images) of those to train on.
        images: all undistorted images.
    """

    camera: np.ndarray
    images: ImageCache


@dataclass(frozen=True)
class StepReport:
    """What one iteration saw: scalars, not yet fetched from the device."""

    photometric: Tensor
    mean_square_error: Tensor
    geographic: Tensor
    weight: float


def pinhole(images: ImageCache, index: int) -> Pinhole:
    """Camera of an undistorted image, for the rasteriser."""
    camera = images.pinhole(index)
    return Pinhole(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


class JointTrainer:
    """State of a joint optimisation; every iteration is a pure function of it.

    Args:
        optimizer: the Gaussians and their moments.
        strategy: density control.
        problem: the geographic half.
        views: what to compare with.
        rasterizer: backend.
        options: schedule.
    """

    def __init__(
        self,
        optimizer: GaussianAdam,
        strategy: Strategy,
        problem: GeoProblem,
        views: Views,
        *,
        rasterizer: Rasterizer,
        options: JointOptions,
    ) -> None:
        self.optimizer, self.strategy, self.problem = optimizer, strategy, problem
        self.views, self.rasterizer, self.options = views, rasterizer, options
        self.iteration = 0
        self.device = optimizer.gaussians.means.device
        self._geo_adam = torch.optim.Adam(
            [
                {"params": [problem.similarity.y], "rate": options.similarity_rate},
                {"params": [problem.cameras.z], "rate": options.camera_rate},
            ]
        )

    def step(self) -> StepReport:
        """Render one view, compare, and move everything a little."""
        self.iteration += 1
        index = self._view_of(self.iteration)
        settings = RasterSettings(sh_degree=self._sh_degree(), background=self.options.background)
        camera = pinhole(self.views.images, index)
        pose = self.problem.cameras.cam_from_model(index)
        render = self.rasterizer.render(self.optimizer.gaussians, pose, camera, settings)
        target, mask = self.target(index)
        photometric = photometric_loss(render.colour, target, mask)
        weight = rising_weight(
            self.iteration, self.options.geo_weight, self.options.geo_rise * self.options.iterations
        )
        geographic = self.problem.loss()
        self.optimizer.zero_grad()
        self._geo_adam.zero_grad()
        (photometric + weight * geographic).backward()
        self._apply(render.stats.visible)
        self.strategy.observe(render.stats, camera)
        self.strategy.update(self.iteration, self.optimizer)
        with torch.no_grad():
            error = (render.colour - target).square()
            mean_square = error.mean() if mask is None else error[mask].mean()
        return StepReport(photometric.detach(), mean_square, geographic.detach(), weight)

    def target(self, index: int) -> tuple[Tensor, Tensor | None]:
        """Photograph (H, W, 3) from 0 to 1, and the pixels that count (None: all)."""
        pixels = torch.from_numpy(np.array(self.views.images.image(index)))
        covered = self.views.images.mask(index)
        mask = None if covered.all() else torch.from_numpy(covered).to(self.device)
        return pixels.to(self.device).float() / 255.0, mask

    def _apply(self, visible: Tensor) -> None:
        progress = self.iteration / self.options.iterations
        for group in self._geo_adam.param_groups:
            group["lr"] = group["rate"] * _FINAL_RATE**progress
        self._geo_adam.step()
        self.optimizer.step(self.iteration, visible)

    def _view_of(self, iteration: int) -> int:
        """Every view once an epoch, in an order that only depends on the seed and the epoch."""
        count = len(self.views.camera)
        epoch, place = divmod(iteration - 1, count)
        order = np.random.default_rng([self.options.seed, epoch]).permutation(count)
        return int(self.views.camera[order[place]])

    def _sh_degree(self) -> int:
        """One degree more each sixth of the training, up to half of it (3DGS: each 1 000 of 30 000)."""
        every = max(self.options.iterations // 6, 1)
        return min(self.options.sh_degree, self.iteration // every)

    def check_finite(self, report: StepReport) -> None:
        """Stop before a divergence spoils everything.

        Raises:
            ConvergenceError: a loss is not finite; names the term and the iteration.
        """
        terms = {"photometric": report.photometric, "geographic": report.geographic}
        for name, value in terms.items():
            if not bool(torch.isfinite(value)):
                raise ConvergenceError(
                    f"the {name} loss is not finite at iteration {self.iteration}: train again with another --seed "
                    "or a smaller --geo-weight"
                )

    def state(self) -> dict[str, Tensor]:
        """Everything that the next iteration depends on."""
        parameters = {"y": self.problem.similarity.y, "z": self.problem.cameras.z}
        geo: dict[str, Tensor] = {**parameters}
        for name, parameter in parameters.items():
            moments = self._geo_adam.state[parameter]
            geo |= {f"{name}_{key}": torch.as_tensor(value) for key, value in moments.items()}
        return {
            "iteration": torch.tensor(self.iteration),
            **prefixed("gaussians", self.optimizer.gaussians.tensors()),
            **prefixed("optimizer", self.optimizer.state()),
            **prefixed("strategy", self.strategy.state()),
            **prefixed("geo", geo),
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from `state`."""
        self.iteration = int(state["iteration"])
        tensors = {name: tensor.to(self.device) for name, tensor in unprefixed("gaussians", state).items()}
        gaussians = Gaussians(**tensors)
        fresh = torch.full((len(gaussians),), -1, dtype=torch.int64, device=self.device)
        fresh[: min(len(gaussians), len(self.optimizer.gaussians))] = 0
        self.optimizer.rearrange(gaussians, fresh)
        self.optimizer.restore(unprefixed("optimizer", state))
        self.strategy.restore(unprefixed("strategy", state))
        geo = unprefixed("geo", state)
        for name, parameter in (("y", self.problem.similarity.y), ("z", self.problem.cameras.z)):
            with torch.no_grad():
                parameter.copy_(geo[name])
            # Adam counts its steps on the CPU, whatever the device.
            self._geo_adam.state[parameter] = {
                key: geo[f"{name}_{key}"].to("cpu" if key == "step" else self.device)
                for key in ("step", "exp_avg", "exp_avg_sq")
                if f"{name}_{key}" in geo
            }
