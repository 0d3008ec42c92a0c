"""Joint optimisation of Gaussians, similarity and cameras, one view an iteration (GeoRefGS, section 2.4).

`make_trainer` assembles it from scene, measurements and options. Checkpoints are named tensors in one NPZ file
without pickle, replaced in one step.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from pipelines.core.errors import InputError
from pipelines.core.files import read_npz, replacing
from pipelines.core.types import IntArray
from pipelines.geometry.cameras import Lenses
from pipelines.jobs.costs import iteration_seconds
from pipelines.splat.densify import (
    DefaultSettings,
    DefaultStrategy,
    FastSettings,
    FastStrategy,
    Strategy,
    ViewContributions,
    view_contributions,
)
from pipelines.splat.densify_mcmc import McmcSettings, McmcStrategy
from pipelines.splat.exposure import Exposures, FrozenExposures, squared_radius
from pipelines.splat.gaussians import FinitenessMonitor, Gaussians
from pipelines.splat.initialise import InitialisationOptions, scene_extent
from pipelines.splat.losses import training_background
from pipelines.splat.optimizer import GaussianAdam, LearningRates
from pipelines.splat.outlier_pixels import OutlierPixels, OutlierSettings
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings, Render, ScreenStats
from pipelines.splat.surface import ObservedPoints
from pipelines.survey.photographs import ImageCache, Pinholes
from pipelines.train.georeference.problem import GeographicAdam, GeoProblem
from pipelines.train.initial_gaussians import TrainingScene, depth_loss_points, initial_gaussians
from pipelines.train.lidar_surface import FusedSurface
from pipelines.train.losses import Loss, RenderedView, training_losses, weighted_sum
from pipelines.train.options import TrainOptions, surveys_of
from pipelines.train.region import TrainingRegion
from pipelines.train.schedule import JointOptions, TrainingSchedule
from pipelines.train.target_images import ImageLook, TargetImage, TargetImages
from pipelines.train.track_exposures import exposures_from_tracks

_OUTLIERS_FROM = 0.5  # of the iterations: before, the model is too coarse to tell what has moved
_FINISHING_RATE = 0.3  # of the rates at which a training starts
_LENS_EVERY = 100  # iterations between two reads of the lens: each read waits for the device
# Each non-finite gradient shows in one of these: colours pass it on to the opacities.
_WATCHED = ("means", "quats_wxyz", "log_scales", "logit_opacities")


@dataclass(frozen=True)
class TrainingViews:
    """Training views, with the data that their renders are compared with."""

    camera: IntArray  # (V,) indices of the training views, into cameras and images
    images: ImageCache
    # returns the points in `model`, float32, that an image shows; None: no depth loss
    surface: Callable[[int], ObservedPoints] | None = None
    lenses: Lenses | None = None  # with which the images were undistorted; None: they never change
    measured: Sequence[Loss] = ()  # of a surface that was measured


@dataclass(frozen=True)
class StepReport:
    """Figures of one iteration; the scalar tensors are still on the device, because fetching them would wait."""

    losses: dict[str, Tensor]  # not yet weighted
    mean_square_error: Tensor  # of colours from 0 to 1, over the pixels that count
    weight: float  # w(t), the weight of the geographic losses
    visible: int  # number of Gaussians in the view, those around a region among them
    pixels: int  # of the render


class _Stateful(Protocol):
    def state(self) -> dict[str, Tensor]: ...

    def restore(self, state: dict[str, Tensor]) -> None: ...


class JointTrainer:
    """State of a joint optimisation; every iteration is a pure function of this state.

    An iteration waits for the device only to read the lens. Every hundredth iteration reads the lens that has
    followed the cameras, and all views are rendered through that lens until the next read.

    Args:
        exposures: of the photographs, optimised as well or frozen; None: all photographs have the same exposure.
        outliers: finds pixels that are inconsistent with the model, which do not count; None: all do.
        region: part of the scene that the Gaussians are to show; None: all of it.
    """

    def __init__(
        self,
        optimizer: GaussianAdam,
        strategy: Strategy,
        problem: GeoProblem,
        views: TrainingViews,
        *,
        rasterizer: Rasterizer,
        options: JointOptions,
        exposures: Exposures | FrozenExposures | None = None,
        outliers: OutlierPixels | None = None,
        region: TrainingRegion | None = None,
    ) -> None:
        self.optimizer, self.strategy, self.problem = optimizer, strategy, problem
        self.views, self.rasterizer, self.options = views, rasterizer, options
        self.exposures, self.outliers, self.region = exposures, outliers, region
        self.iteration = 0
        self.schedule = TrainingSchedule(options, views.camera)
        self.device = optimizer.gaussians.means.device
        self.pinholes = Pinholes(views.images, views.lenses)
        self._lens = self._undistorted_with = self.problem.unknowns.lens().detach().cpu().numpy().copy()
        masks = None if region is None else region.masks
        self._targets = TargetImages(views.images, self.pinholes, self.device, masks, options.crops)
        self._losses = training_losses(
            problem,
            strategy,
            self.schedule,
            extent_m=optimizer.extent_m,
            confined=region is not None,
            measured=views.measured,
        )
        self._unknowns = GeographicAdam(problem, options, self.device)
        nothing = torch.zeros((), device=self.device)
        self.watch = FinitenessMonitor(tuple(self._watched(nothing, nothing)), self.device)

    def step(self) -> StepReport:
        """Run one iteration and return its figures.

        1. One training view, or a window of it, is rendered and compared with its photograph.
        2. The gradient of all losses moves Gaussians, similarity, cameras, systematic errors, exposures.
        3. Density control records the render, and edits the Gaussians if its schedule says so.
        """
        self.iteration += 1
        if self.iteration % _LENS_EVERY == 1:
            self._use_lens(self.problem.unknowns.lens().detach().cpu().numpy())
        view = self._rendered(
            self._targets.get(self._image_look(self.iteration), self._image_look(self.iteration + 1))
        )
        self._unknowns.clear()
        total, values = weighted_sum(self._losses, view, self.iteration)
        total.backward()
        losses = {name: value.detach() for name, value in values.items()}
        geographic = losses["geographic"] + losses.get("control_by_depth", 0.0)
        self.watch.note(self.iteration, self._watched(losses["photometric"], geographic))
        stats = self._of_whole_photograph(self._of_trained(view.render.stats), view.pose, view.target)
        self._unknowns.step(self.optimizer.rate_factor * self.schedule.geographic_rate(self.iteration))
        self.optimizer.step(self.iteration, stats.visible)
        if self.exposures is not None:
            self.exposures.step(self.iteration)
        self.strategy.observe(stats.among(view.rows), view.target.whole)
        self.strategy.update(self.iteration, self.optimizer, self.sample_contributions)
        return StepReport(
            losses,
            _mean_square(view.colour, view.target),
            self.schedule.geographic_weight(self.iteration),
            len(view.render.stats.visible),
            view.target.camera.width * view.target.camera.height,
        )

    @torch.no_grad()
    def sample_contributions(self, count: int, generator: torch.Generator) -> list[ViewContributions]:
        """Return the contributions of all Gaussians to `count` different training views at most, as a `Probe`."""
        contributions = []
        for place in torch.randperm(len(self.views.camera), generator=generator)[:count].tolist():
            index = int(self.views.camera[place])
            camera = self.views.images.pinhole(index)
            least = 1 if self.options.crops is None else self.options.crops.shrink(camera.width, camera.height)
            shrink = max(self.schedule.shrink(self.iteration, camera.width, camera.height), least)
            target, pose = self._targets.get(ImageLook(index, shrink)), self.problem.unknowns.cam_from_model(index)
            render = self._render(self.optimizer.gaussians, pose, target, self._settings(target))
            colour = self._exposed(index, render.colour, target)
            error = (colour - target.colour).abs().mean(dim=-1)
            error = error if target.mask is None else error * target.mask
            of_view = view_contributions(self.optimizer.gaussians, pose, target.camera, error, self.rasterizer)
            # Strategies count pixels of the whole photographs, which the schedule may have shrunken.
            contributions.append(
                ViewContributions(shrink**2 * of_view.weight_px, shrink**2 * of_view.high_error_px)
            )
        return contributions

    def work(self, iteration: int) -> float:
        """Return the work of an iteration at the present number of Gaussians, relative to others' work."""
        camera = self.views.images.pinhole(int(self.views.camera[0]))
        shrink = self.schedule.shrink(iteration, camera.width, camera.height)
        width, height = camera.width // shrink, camera.height // shrink
        crops = 1 if self.options.crops is None else self.options.crops.count(width, height)
        surface = self.options.surface is not None
        gaussians, photographs = len(self.optimizer.gaussians), len(self.views.camera)
        return iteration_seconds(width * height, gaussians, photographs, surface=surface, crops=crops)

    def slow_down(self, factor: float) -> None:
        """Multiply all learning rates but the exposures' by `factor`, and forget values that were not finite."""
        self.optimizer.rate_factor *= factor
        self.watch.reset()

    def _image_look(self, iteration: int) -> ImageLook:
        index = self.schedule.view(iteration)
        camera = self.views.images.pinhole(index)
        shrink = self.schedule.shrink(iteration, camera.width, camera.height)
        return ImageLook(index, shrink, self.schedule.visit(iteration))

    def _use_lens(self, lens: np.ndarray) -> None:
        """Render from now on through the lenses that differ by (L,) from SfM's."""
        self._lens = lens.copy()
        if self.views.lenses is not None and len(lens):
            self.pinholes.renew(self.views.lenses.moved(self._lens - self._undistorted_with))

    def _rendered(self, target: TargetImage) -> RenderedView:
        """Return the view of this iteration, with all that its losses need."""
        index = self.schedule.view(self.iteration)
        pose = self.problem.unknowns.cam_from_model(index)
        depth = self.options.surface is not None or self.problem.sees_by_depth(index)
        normal = self.schedule.weight_of_normals(self.iteration) > 0
        settings, optimizer = self._settings(target, depth=depth, normal=normal), self.optimizer
        rows = self.rasterizer.candidates(optimizer.gaussians, pose, target.whole, settings)
        visible = optimizer.show(rows)
        render = self._render(visible, pose, target, settings)
        colour, counting = self._exposed(index, render.colour, target), target.mask
        if self.outliers is not None:
            longest_px = max(target.whole.width, target.whole.height)
            counting = self.outliers.inliers(colour, target.colour, counting, longest_px)
        points = None if self.views.surface is None else self.views.surface(index)
        count = len(optimizer.gaussians)
        return RenderedView(
            index,
            pose,
            target,
            visible,
            rows,
            count,
            render,
            self._of_trained(render.stats),
            colour,
            counting,
            points,
        )

    def _settings(self, target: TargetImage, *, depth: bool = False, normal: bool = False) -> RasterSettings:
        return RasterSettings(
            sh_degree=self.schedule.sh_degree(self.iteration),
            background=training_background(self.iteration),
            depth=depth,
            normal=normal,
            median=False,
            window=target.part.window,
        )

    def _render(self, gaussians: Gaussians, pose: Tensor, target: TargetImage, settings: RasterSettings) -> Render:
        """Return a render of Gaussians, and behind their rows those that surround the region."""
        if self.region is not None:
            gaussians = Gaussians.concatenate([gaussians, self.region.surroundings])
        return self.rasterizer.render(gaussians, pose, target.whole, settings)

    def _exposed(self, index: int, colour: Tensor, target: TargetImage) -> Tensor:
        if self.exposures is None:
            return colour
        return self.exposures.apply(index, colour, squared_radius(target.camera, target.whole, self.device))

    def _of_trained(self, stats: ScreenStats) -> ScreenStats:
        """Return the statistics of the Gaussians in training, without those that surround the region."""
        # Without a region nothing is left out: to look would make a GPU wait.
        return stats if self.region is None else stats.of_first(len(self.optimizer.shown))

    @torch.no_grad()
    def _of_whole_photograph(self, stats: ScreenStats, pose: Tensor, target: TargetImage) -> ScreenStats:
        """Return the statistics as a part of those of the whole photograph."""
        part = target.part
        if part.crops == 1:
            return stats if part.share == 1.0 else stats.of_part(part.share)
        means = self.optimizer.shown.means[stats.visible]
        in_cam, camera = means @ pose[:3, :3].to(means).T + pose[:3, 3].to(means), target.whole
        x, y, z = in_cam.unbind(dim=1)
        x, y = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        here = (x >= part.low[0]) & (x < part.high[0]) & (y >= part.low[1]) & (y < part.high[1])
        return stats.of_part(part.share / part.crops, here)

    def _watched(self, photometric: Tensor, geographic: Tensor) -> dict[str, Tensor]:
        """Return the scalars that must stay finite, by what messages call them."""
        tensors = self.optimizer.shown.tensors()
        gradients = {
            f"gradient of {name}": geographic.new_zeros(()) if tensor.grad is None else tensor.grad.sum()
            for name, tensor in ({name: tensors[name] for name in _WATCHED} | self._unknowns.named()).items()
        }
        return {"photometric loss": photometric, "geographic loss": geographic} | gradients

    def _parts(self) -> dict[str, _Stateful]:
        """Return what has a state of its own, by the name of that state in a checkpoint."""
        parts: dict[str, _Stateful | None] = {
            "optimizer": self.optimizer,
            "strategy": self.strategy,
            "geo": self._unknowns,
            "exposures": self.exposures,
            "outliers": self.outliers,
        }
        return {name: part for name, part in parts.items() if part is not None}

    def state(self) -> dict[str, Tensor]:
        """Return all tensors that the next iteration depends on, by name, for a checkpoint."""
        state = {
            "iteration": torch.tensor(self.iteration),
            "extended_from": torch.tensor(self.schedule.extended_from),
            "rate_factor": torch.tensor(self.optimizer.rate_factor, dtype=torch.float64),
            "lens": torch.from_numpy(self._lens),
            **prefixed("gaussians", self.optimizer.gaussians.tensors()),
        }
        for name, part in self._parts().items():
            state |= prefixed(name, part.state())
        return state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Restore a state, from which the next iteration continues."""
        self.iteration = int(state["iteration"])
        self.schedule.extended_from = int(state["extended_from"])
        self.optimizer.rate_factor = float(state["rate_factor"])
        self._use_lens(state["lens"].cpu().numpy())
        self.watch.reset()
        tensors = {
            name: tensor.to(self.device, copy=True) for name, tensor in unprefixed("gaussians", state).items()
        }
        gaussians = Gaussians(**tensors)
        fresh = torch.full((len(gaussians),), -1, dtype=torch.int64, device=self.device)
        fresh[: min(len(gaussians), len(self.optimizer.gaussians))] = 0
        self.optimizer.rearrange(gaussians, fresh)
        for name, part in self._parts().items():
            part.restore(unprefixed(name, state))


@torch.no_grad()
def _mean_square(colour: Tensor, target: TargetImage) -> Tensor:
    """Return the mean square error over the pixels that count, without waiting for the device to count them."""
    error = (colour - target.colour).square()
    if target.mask is None:
        return error.mean()
    return (error * target.mask[..., None]).sum() / (3 * target.mask.sum()).clamp_min(1)


def make_trainer(
    training: TrainingScene,
    problem: GeoProblem,
    backend: Rasterizer,
    options: TrainOptions,
    exposures: Exposures | FrozenExposures | None = None,
) -> JointTrainer:
    """Return the trainer with initial Gaussians; a DegenerateGeometryError: fewer than two different points.

    The problem moves to the backend's device. Exposures are those given; None: those of the training photographs
    are fitted, if the options say so, from those that their tracks have.
    """
    effort, device = options.effort, backend.device
    scene, images, surface = training.scene, training.images, training.surface
    start = InitialisationOptions(sh_degree=options.sh_degree, max_gaussians=effort.max_gaussians)
    gaussians = initial_gaussians(training, start, effort.max_gaussians, options.seed).to(device)
    extent_m = scene_extent(scene.poses.cam_center_in_model)
    train = torch.from_numpy(scene.train)
    lens = scene.sparse.image_camera_id.tolist()
    if exposures is None and options.exposure:
        from_tracks = torch.from_numpy(exposures_from_tracks(scene, images)).float().to(device)
        exposures = Exposures(from_tracks, train, effort.iterations, lens)
    known = depth_loss_points(training, device) if options.geometry_regularisation else None
    measured = surface.losses(device) if isinstance(surface, FusedSurface) else ()
    outliers = OutlierSettings(views=int(_OUTLIERS_FROM * effort.iterations))
    # A Gaussian is seen as often as in so many iterations of a small survey.
    share = int(effort.iterations / surveys_of(len(scene.train)))
    return JointTrainer(
        GaussianAdam(gaussians, extent_m, effort.iterations, LearningRates.for_iterations(share)),
        _strategy(options, extent_m, len(gaussians), training),
        problem.to(device),
        TrainingViews(scene.train, images, known, scene.sparse.lenses, measured),
        rasterizer=backend,
        options=JointOptions.of(options),
        exposures=exposures,
        outliers=OutlierPixels(device, outliers) if options.robust_photometric else None,
        region=training.region,
    )


def make_finisher(
    training: TrainingScene,
    gaussians: Gaussians,
    problem: GeoProblem,
    *,
    backend: Rasterizer,
    options: TrainOptions,
    exposures: FrozenExposures | None,
) -> JointTrainer:
    """Return a trainer that goes on with trained Gaussians, at a low rate, and neither adds nor removes any.

    The Gaussians are on the backend's device, and the problem freezes the cameras.
    """
    device, scene, iterations = backend.device, training.scene, options.effort.iterations
    extent_m = scene_extent(scene.poses.cam_center_in_model[scene.train])
    optimizer = GaussianAdam(gaussians, extent_m, iterations)
    optimizer.rate_factor = _FINISHING_RATE
    known = depth_loss_points(training, device) if options.geometry_regularisation else None
    return JointTrainer(
        optimizer,
        DefaultStrategy(DefaultSettings(stop=0, reset_every=0), extent_m, len(gaussians), options.seed),
        problem.to(device),
        TrainingViews(scene.train, training.images, known, scene.sparse.lenses),
        rasterizer=backend,
        options=replace(JointOptions.of(options), sh_degree=gaussians.sh_degree, coarse=(), finishing=True),
        exposures=exposures,
        region=training.region,
    )


def _strategy(options: TrainOptions, extent_m: float, count: int, training: TrainingScene) -> Strategy:
    iterations, most = options.effort.iterations, options.effort.max_gaussians
    strategy: McmcStrategy | DefaultStrategy
    if options.strategy == "mcmc":
        strategy = McmcStrategy(McmcSettings.for_iterations(iterations, count, most), extent_m, options.seed)
    else:
        settings = DefaultSettings.for_iterations(iterations, most, surveys_of(len(training.scene.train)))
        fast = FastSettings(prune_stop=iterations * 5 // 6)
        strategy = (
            FastStrategy(settings, fast, extent_m, count, options.seed)
            if options.strategy == "fast"
            else DefaultStrategy(settings, extent_m, count, options.seed)
        )
    if training.area is not None:
        strategy.growing = lambda means: torch.from_numpy(training.in_area(means.cpu().double().numpy())).to(
            means.device
        )
    return strategy


def save_checkpoint(path: Path, state: Mapping[str, Tensor]) -> None:
    """Write tensors to an NPZ file, which replaces an existing file only when complete."""
    draft = path.with_suffix(".tmp")
    with replacing(path, draft), draft.open("wb") as handle:
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in state.items()}
        np.savez(handle, **arrays)  # type: ignore[arg-type]


def load_checkpoint(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint by name; an InputError: the file cannot be read as a checkpoint."""
    try:
        return {name: torch.from_numpy(array) for name, array in read_npz(path).items()}
    except (
        InputError,
        TypeError,
        ValueError,
    ) as error:  # torch has no complex halves, texts or foreign byte orders
        raise InputError(
            "checkpoint-damaged", f"is not a readable checkpoint ({error}).", remedy="Train without --resume."
        ) from error


def prefixed(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a part of the state by names that begin with the name of the part."""
    return {f"{prefix}/{name}": tensor for name, tensor in state.items()}


def unprefixed(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with `prefix/`, without that prefix: inverts `prefixed`."""
    start = f"{prefix}/"
    return {name.removeprefix(start): tensor for name, tensor in state.items() if name.startswith(start)}
