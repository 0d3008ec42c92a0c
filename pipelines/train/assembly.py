"""Assembly of the trainer from scene, measurements and options."""

from __future__ import annotations

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
from pipelines.splat.surface import SurfaceSettings
from pipelines.train.geographic.problem import GeoProblem
from pipelines.train.initial_gaussians import TrainingScene, initial_gaussians, points_to_hold
from pipelines.train.options import TrainOptions
from pipelines.train.schedule import COARSE, JointOptions
from pipelines.train.target_images import Crops
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
        backend: the rasteriser.
        options: of the training.
        exposures: of the photographs, to be held; None: those of the training photographs are fitted, if the
            options say so.

    Raises:
        DegenerateGeometryError: fewer than two different points to start from.
    """
    preset, device = options.effort, device_of(backend)
    scene, images = training.scene, training.images
    start = InitialisationOptions(sh_degree=options.sh_degree, max_gaussians=preset.max_gaussians)
    gaussians = initial_gaussians(training, start, preset.max_gaussians, options.seed).to(device)
    extent_m = scene_extent(scene.poses.cam_center_in_model)
    train = torch.from_numpy(scene.train)
    fitted = Exposures(len(images), train, preset.iterations, device) if options.exposure else None
    hold = points_to_hold(training, device) if options.faithful_surface else None
    beside = None if training.surface is None else training.surface.gaussian_loss(device)
    return JointTrainer(
        GaussianAdam(gaussians, extent_m, preset.iterations),
        _strategy(options, extent_m, len(gaussians)),
        problem.to(device),
        TrainingViews(scene.train, images, hold, scene.sparse.lenses, beside),
        rasterizer=backend,
        options=JointOptions(
            preset.iterations,
            options.sh_degree,
            geo_weight=options.geo_weight,
            geo_schedule=options.geo_schedule,
            seed=options.seed,
            coarse=COARSE if options.coarse_to_fine else (),
            crops=Crops(options.crop_size, options.seed),
            surface=SurfaceSettings() if options.faithful_surface else None,
        ),
        exposures=exposures or fitted,
        outliers=_outliers(options, device) if options.robust_photometric else None,
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
        backend: the rasteriser.
        options: of the training.
        exposures: of the photographs; None: none.
    """
    device = device_of(backend)
    extent_m = scene_extent(training.scene.poses.cam_center_in_model[training.scene.train])
    iterations = options.effort.iterations
    optimizer = GaussianAdam(gaussians, extent_m, iterations)
    optimizer.rate_factor = _FINISHING_RATE
    hold = points_to_hold(training, device) if options.faithful_surface else None
    return JointTrainer(
        optimizer,
        DefaultStrategy(DefaultSettings(stop=0, reset_every=0), extent_m, len(gaussians), options.seed),
        problem.to(device),
        TrainingViews(training.scene.train, training.images, hold, training.scene.sparse.lenses),
        rasterizer=backend,
        options=JointOptions(
            iterations,
            gaussians.sh_degree,
            seed=options.seed,
            crops=Crops(options.crop_size, options.seed),
            surface=SurfaceSettings() if options.faithful_surface else None,
            finishing=True,
        ),
        exposures=exposures,
        region=training.region,
    )


def _outliers(options: TrainOptions, device: torch.device) -> OutlierPixels:
    return OutlierPixels(device, OutlierSettings(views=int(_OUTLIERS_FROM * options.effort.iterations)))


def _strategy(options: TrainOptions, extent_m: float, count: int) -> Strategy:
    iterations, most = options.effort.iterations, options.effort.max_gaussians
    if options.strategy == "mcmc":
        return McmcStrategy(McmcSettings.for_iterations(iterations, count, most), extent_m, options.seed)
    settings = DefaultSettings.for_iterations(iterations, most)
    if options.strategy == "fast":
        fast = FastSettings(prune_stop=iterations * 5 // 6)
        return FastStrategy(settings, fast, extent_m, count, options.seed)
    return DefaultStrategy(settings, extent_m, count, options.seed)
