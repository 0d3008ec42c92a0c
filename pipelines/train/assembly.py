"""Assembly of the trainer from scene, measurements and options."""

from __future__ import annotations

from dataclasses import replace

import torch

from pipelines.splat.densify import DefaultSettings, DefaultStrategy, FastSettings, FastStrategy, Strategy
from pipelines.splat.densify_mcmc import McmcSettings, McmcStrategy
from pipelines.splat.exposure import Exposures, HeldExposures
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.initialise import InitialisationOptions, scene_extent
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.outlier_pixels import OutlierPixels, OutlierSettings
from pipelines.splat.rasterizer.api import Rasterizer
from pipelines.splat.rasterizer.backends import device_of
from pipelines.train.geographic.problem import GeoProblem
from pipelines.train.initial_gaussians import TrainingScene, initial_gaussians, points_to_hold
from pipelines.train.lidar_surface import FusedSurface
from pipelines.train.options import TrainOptions
from pipelines.train.schedule import JointOptions
from pipelines.train.trainer import JointTrainer, TrainingViews

_OUTLIERS_FROM = 0.5  # of the iterations: before, the model is too coarse to tell what has moved
_FINISHING_RATE = 0.3  # of the rates at which a training starts


def make_trainer(
    training: TrainingScene,
    problem: GeoProblem,
    backend: Rasterizer,
    options: TrainOptions,
    exposures: HeldExposures | None = None,
) -> JointTrainer:
    """Return the trainer with its initial Gaussians, before the first iteration.

    Args:
        training: cameras, photographs and surface.
        problem: the geographic losses, moved to the backend's device.
        backend, options: rasteriser and options of the training.
        exposures: to be held; None: those of the training photographs are fitted, if the options say so.

    Raises:
        DegenerateGeometryError: fewer than two different points to start from.
    """
    effort, device = options.effort, device_of(backend)
    scene, images, surface = training.scene, training.images, training.surface
    start = InitialisationOptions(sh_degree=options.sh_degree, max_gaussians=effort.max_gaussians)
    gaussians = initial_gaussians(training, start, effort.max_gaussians, options.seed).to(device)
    extent_m = scene_extent(scene.poses.cam_center_in_model)
    train = torch.from_numpy(scene.train)
    fitted = Exposures(len(images), train, effort.iterations, device) if options.exposure else None
    hold = points_to_hold(training, device) if options.faithful_surface else None
    measured = surface.losses(device) if isinstance(surface, FusedSurface) else ()
    outliers = OutlierSettings(views=int(_OUTLIERS_FROM * effort.iterations))
    return JointTrainer(
        GaussianAdam(gaussians, extent_m, effort.iterations),
        _strategy(options, extent_m, len(gaussians)),
        problem.to(device),
        TrainingViews(scene.train, images, hold, scene.sparse.lenses, measured),
        rasterizer=backend,
        options=JointOptions.of(options),
        exposures=exposures or fitted,
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
    exposures: HeldExposures | None,
) -> JointTrainer:
    """Return a trainer that goes on with trained Gaussians, at a low rate, and neither adds nor removes any.

    Args:
        training: cameras, photographs and region.
        gaussians: on the backend's device.
        problem: holds the cameras.
        backend, options: rasteriser and options of the training.
        exposures: to be held; None: none.
    """
    device, scene, iterations = device_of(backend), training.scene, options.effort.iterations
    extent_m = scene_extent(scene.poses.cam_center_in_model[scene.train])
    optimizer = GaussianAdam(gaussians, extent_m, iterations)
    optimizer.rate_factor = _FINISHING_RATE
    hold = points_to_hold(training, device) if options.faithful_surface else None
    return JointTrainer(
        optimizer,
        DefaultStrategy(DefaultSettings(stop=0, reset_every=0), extent_m, len(gaussians), options.seed),
        problem.to(device),
        TrainingViews(scene.train, training.images, hold, scene.sparse.lenses),
        rasterizer=backend,
        options=replace(JointOptions.of(options), sh_degree=gaussians.sh_degree, coarse=(), finishing=True),
        exposures=exposures,
        region=training.region,
    )


def _strategy(options: TrainOptions, extent_m: float, count: int) -> Strategy:
    iterations, most = options.effort.iterations, options.effort.max_gaussians
    if options.strategy == "mcmc":
        return McmcStrategy(McmcSettings.for_iterations(iterations, count, most), extent_m, options.seed)
    settings = DefaultSettings.for_iterations(iterations, most)
    if options.strategy == "fast":
        fast = FastSettings.for_iterations(iterations)
        return FastStrategy(settings, fast, extent_m, count, options.seed)
    return DefaultStrategy(settings, extent_m, count, options.seed)
