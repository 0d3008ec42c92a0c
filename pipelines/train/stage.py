"""Training: Gaussians, similarity and cameras optimised together (GeoRefGS section 2.4).

Reads the survey, the SfM model, the geolocated points and the initial similarity. Writes `train/gaussians.ply`
(frame `model`), `train/model.json` (similarity with covariance, cameras, constant errors), `train/metrics.jsonl`
and the latest checkpoint. An interrupted run leaves a checkpoint in `train.partial/` for `--resume` to go on from.
"""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from pipelines.core.products import load_json, save_json
from pipelines.core.stages import POINTS, SIM3, SPARSE
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.georef.problem import GeoProblem
from pipelines.georef.systematic import ErrorEstimate
from pipelines.scene.calibrated import load_survey
from pipelines.scene.geographic import geo_problem
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.photographs import ImageCache
from pipelines.scene.scene import Scene, initial_scene, photographs
from pipelines.scene.trained_model import EstimatedError, TrainedCamera, TrainedLens, TrainedModel
from pipelines.splat.densify import DefaultSettings, DefaultStrategy, Strategy
from pipelines.splat.densify_fast import FastSettings, FastStrategy
from pipelines.splat.densify_mcmc import McmcSettings, McmcStrategy
from pipelines.splat.exposure import Exposures
from pipelines.splat.initialise import InitialisationOptions, scene_extent
from pipelines.splat.memory import TrainingSize, free_memory_bytes, require_memory
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import Rasterizer
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.splat.storage import write_gaussians
from pipelines.splat.surface import SurfaceSettings
from pipelines.train.depth_maps import DepthMaps
from pipelines.train.loop import LoopOptions, Outcome, optimise
from pipelines.train.material import Material, initial_gaussians, points_to_hold
from pipelines.train.options import TrainOptions
from pipelines.train.surface import SceneSurface
from pipelines.train.trainer import JointOptions, JointTrainer, Views

log = logging.getLogger(__name__)

_CHECKPOINT = "checkpoint.npz"
_METRICS = "metrics.jsonl"
_EVIDENT_SIGMAS = 3.0
_CAUSES = {
    "bias": "Check the base station, the vertical datum and the antenna offset",
    "lever-arm": "`georef ingest --lever-arm` can apply it, in the axes of the body",
    "boresight": "`georef ingest --boresight` can apply it",
}
# Shrunken so much, up to this fraction of the training. More would push Gaussians, which are then smaller than a
# pixel, off the surface that they start on.
_COARSE = ((2, 0.3),)


@dataclass(frozen=True)
class Preset:
    """Effort: iterations, longest image side in pixels, most Gaussians."""

    iterations: int
    max_image_size: int
    max_gaussians: int


PRESETS = {
    "smoke": Preset(200, 320, 20_000),
    "fast": Preset(2_000, 480, 60_000),
    "standard": Preset(7_000, 640, 120_000),
    "high": Preset(30_000, 1_600, 1_000_000),
}


def effort(config: TrainOptions) -> Preset:
    """The preset, with what the user changed of it."""
    preset = PRESETS[config.preset]
    return Preset(
        config.iterations or preset.iterations,
        config.max_image_size or preset.max_image_size,
        config.max_gaussians or preset.max_gaussians,
    )


def run(stage: StageRun, config: TrainOptions) -> Summary:
    """Train, with checkpoints, and write the result.

    Raises:
        BackendUnavailableError: `--backend cuda` without a GPU or without gsplat.
        ResourceError: the training would not fit into memory.
        ConvergenceError: it diverged twice.
    """
    backend = rasterizer(config.backend)  # first: without a GPU, `--backend cuda` need not wait for its refusal
    workspace = stage.workspace
    survey = load_survey(workspace)
    initial = load_json(InitialSimilarity, workspace.path(SIM3))
    scene = initial_scene(read_sparse(workspace.path(SPARSE)), survey, initial)
    images = photographs(scene.sparse, survey, workspace, effort(config).max_image_size)
    require_memory(training_size(scene, images, config), free_memory_bytes(device_of(backend)))
    images.build(stage.progress)
    surface = None
    if config.dense:
        maps = DepthMaps(workspace.cache / "surface", scene, images)
        maps.build(stage.progress)
        surface = SceneSurface(maps)
    points = GeolocatedPoints.load(workspace.path(POINTS))
    problem = geo_problem(scene, survey, initial, config, points=points, seed=config.seed)
    trainer = make_trainer(Material(scene, images, surface), problem, backend, config)
    options = LoopOptions(
        stage.out / _CHECKPOINT, stage.out / _METRICS, config.checkpoint_every, config.log_every, stage.resumed
    )
    return _save(trainer, scene, stage.out, optimise(trainer, options, stage.progress))


def device_of(backend: Rasterizer) -> torch.device:
    """Where the tensors of a backend live."""
    return torch.device("cuda" if backend.name == "cuda" else "cpu")


def training_size(scene: Scene, images: ImageCache, config: TrainOptions) -> TrainingSize:
    """What the memory of a training depends on."""
    cameras = [images.pinhole(index) for index in map(int, scene.train)]
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    corrected = len(images) if config.optimize_cameras else 0
    return TrainingSize(effort(config).max_gaussians, largest, config.sh_degree, corrected)


def make_trainer(
    material: Material, problem: GeoProblem, backend: Rasterizer, config: TrainOptions
) -> JointTrainer:
    """Gaussians on the surface, and everything that moves them.

    Raises:
        DegenerateGeometryError: too few SfM points.
    """
    preset, device = effort(config), device_of(backend)
    scene, images = material.scene, material.images
    options = InitialisationOptions(sh_degree=config.sh_degree, max_gaussians=preset.max_gaussians)
    gaussians = initial_gaussians(material, options, preset.max_gaussians, config.seed).to(device)
    extent_m = scene_extent(scene.poses.cam_center_in_model)
    train = torch.from_numpy(scene.train)
    hold = points_to_hold(material, device) if config.faithful_surface else None
    return JointTrainer(
        GaussianAdam(gaussians, extent_m, preset.iterations),
        _strategy(config, extent_m, len(gaussians)),
        problem.to(device),
        Views(scene.train, images, hold, scene.sparse.lenses),
        rasterizer=backend,
        options=JointOptions(
            preset.iterations,
            config.sh_degree,
            geo_weight=config.geo_weight,
            geo_schedule=config.geo_schedule,
            seed=config.seed,
            coarse=_COARSE if config.coarse_to_fine else (),
            surface=SurfaceSettings() if config.faithful_surface else None,
        ),
        exposures=Exposures(len(images), train, preset.iterations, device) if config.exposure else None,
    )


def _strategy(config: TrainOptions, extent_m: float, count: int) -> Strategy:
    iterations, most = effort(config).iterations, effort(config).max_gaussians
    if config.strategy == "mcmc":
        return McmcStrategy(McmcSettings.for_iterations(iterations, count, most), extent_m, config.seed)
    settings = DefaultSettings.for_iterations(iterations, most)
    if config.strategy == "fast":
        fast = FastSettings.for_iterations(iterations)
        return FastStrategy(settings, fast, extent_m, count, config.seed)
    return DefaultStrategy(settings, extent_m, count, config.seed)


def _save(trainer: JointTrainer, scene: Scene, out: Path, outcome: Outcome) -> Summary:
    problem, gaussians = trainer.problem, trainer.optimizer.gaussians.detached()
    measured = problem.fixes is not None or problem.marks is not None
    covariance, of_errors = problem.covariances() if measured else (problem.similarity.prior_covariance(), None)
    outliers = tuple(sorted(scene.sparse.image_name[index] for index in problem.outliers()))
    blunders = () if problem.marks is None else tuple(problem.marks.name[j] for j in problem.control_outliers())
    errors = () if of_errors is None else _errors(problem.errors.found(of_errors))
    model = TrainedModel(
        geo_from_model=problem.similarity.current().to_record(
            "model",
            "geo",
            covariance=covariance,
            pivot=problem.similarity.pivot_in_geo,
        ),
        model_from_local=scene.model_from_local.to_record("local", "model"),
        max_image_size=trainer.views.images.max_size_px,
        cameras=_cameras(trainer, scene),
        lenses=_lenses(trainer, scene),
        background=trainer.options.background,
        sh_degree=gaussians.sh_degree,
        iterations=trainer.iteration,
        gaussians=len(gaussians),
        backend=trainer.rasterizer.name,
        gnss_outliers=outliers,
        control_outliers=blunders,
        estimated_errors=errors,
    )
    write_gaussians(out / "gaussians.ply", gaussians)
    save_json(model, out / "model.json")
    rows = [json.loads(row) for row in (out / _METRICS).read_text(encoding="utf-8").splitlines()]
    psnr = float(np.mean([row["psnr"] for row in rows[-20:]]))
    sigma = np.sqrt(np.diag(np.array(model.geo_from_model.covariance)))
    values = {
        "iterations": trainer.iteration,
        "gaussians": len(gaussians),
        "train_psnr": round(psnr, 3),
        "seconds": round(outcome.seconds, 1),
        "seconds_per_iteration": round(outcome.seconds / trainer.iteration, 4),
        "similarity_sigma_m": [round(float(value), 5) for value in sigma[4:]],
        "gnss_outliers": list(outliers),
        "control_outliers": list(blunders),
        "estimated_errors": [error.model_dump() for error in errors],
    }
    figure = f"{len(gaussians)} gaussians, train PSNR {psnr:.2f} dB"
    warnings = [f"{len(outliers)} fixes contradict the cameras: {', '.join(outliers[:5])}"] if outliers else []
    if blunders:
        warnings.append(f"{len(blunders)} control points contradict the cameras: {', '.join(blunders[:5])}")
    warnings += [told for error in errors if (told := _told(error)) is not None]
    if outcome.recovery is not None:
        warnings.append(outcome.recovery)
    return Summary(figure, values, tuple(warnings))


def _errors(estimates: tuple[ErrorEstimate, ...]) -> tuple[EstimatedError, ...]:
    return tuple(EstimatedError.model_validate(asdict(estimate)) for estimate in estimates)


def _told(error: EstimatedError) -> str | None:
    """What to warn of: an error beyond 3 σ, or one that could not be observed."""
    axes = "east, north, up" if error.name == "bias" else "right, down, forward"
    flight = "" if error.flight is None else f" of flight {error.flight + 1}"
    what = f"{error.name}{flight}"
    values = ", ".join(f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(error.value, error.sigma, strict=True))
    far = [
        abs(value) > _EVIDENT_SIGMAS * sigma and seen
        for value, sigma, seen in zip(error.value, error.sigma, error.observed, strict=True)
    ]
    if any(far):
        return f"{what} of ({values}) {error.unit} {axes}, beyond 3 σ: it is taken out here. {_CAUSES[error.name]}"
    if not all(error.observed):
        return f"{what} is not observable along every axis: ({values}) {error.unit} {axes}"
    return None


def _cameras(trainer: JointTrainer, scene: Scene) -> tuple[TrainedCamera, ...]:
    poses, train = trainer.problem.cameras.current(), set(map(int, scene.train))
    exposure = None if trainer.exposures is None else trainer.exposures.affine.cpu().numpy().astype(float)
    quats = quat_xyzw_from_matrix(poses.cam_from_model)
    translations = -np.einsum("nij,nj->ni", poses.cam_from_model, poses.cam_center_in_model)
    return tuple(
        TrainedCamera(
            name=name,
            split="train" if index in train else "test",
            quat_xyzw=tuple(quats[index]),
            translation=tuple(translations[index]),
            exposure=None if exposure is None or index not in train else tuple(map(tuple, exposure[index])),
        )
        for index, name in enumerate(scene.sparse.image_name)
    )


def _lenses(trainer: JointTrainer, scene: Scene) -> tuple[TrainedLens, ...]:
    """The lenses that have followed the cameras; none where they stayed."""
    change = trainer.problem.cameras.lens().detach().cpu().numpy()
    if not len(change):
        return ()
    return tuple(
        TrainedLens(camera_id=key, model=camera.model, params=tuple(camera.params.tolist()))
        for key, camera in scene.sparse.lenses.moved(change).cameras.items()
    )
