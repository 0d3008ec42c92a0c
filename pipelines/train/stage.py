"""Stage `train`: joint optimisation of Gaussians, similarity and cameras (GeoRefGS, section 2.4).

Reads the survey, the SfM model, the geolocated points and the initial similarity. Writes `train/gaussians.ply`
(frame `model`), `train/model.json` (similarity with covariance, cameras, constant errors), `train/metrics.jsonl`
and the latest checkpoint. An interrupted run leaves a checkpoint in `train.partial/`, from which the next run with
the same options continues. A finished training with fewer iterations is extended from its last checkpoint.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

from pipelines.adjust.frozen_solution import solve_and_hold
from pipelines.adjust.geographic import geo_problem
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import LIDAR, LIDAR_MAP, POINTS
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.scene.calibrated import load_survey
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.measured_cloud import CloudFiles
from pipelines.scene.scene import load_initial_scene, photographs
from pipelines.scene.trained_model import TrainedModel
from pipelines.splat.memory import free_memory_bytes, require_memory
from pipelines.splat.rasterizer.backends import device_of, rasterizer
from pipelines.splat.storage import write_gaussians
from pipelines.train.assembly import make_trainer
from pipelines.train.depth_maps import DepthMaps
from pipelines.train.forecast import forecast_of
from pipelines.train.gaussian_limit import training_size, with_gaussian_limit
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.lidar.prepare import compared_lidar, draw_changes, lidar_surface
from pipelines.train.lidar.track import ScannerTrack
from pipelines.train.options import TrainOptions
from pipelines.train.result import summary_of, trained_model
from pipelines.train.surface import SceneSurface
from pipelines.train.training_files import METRICS, train_in_folder

log = logging.getLogger(__name__)


def run(stage: StageRun, options: TrainOptions) -> Summary:
    """Train the model, write products and checkpoints, and return the summary.

    Raises:
        BackendUnavailableError: `--backend cuda`, and a part that it needs is missing; names each.
        ResourceError: the training would not fit into memory.
        ConvergenceError: the training diverged twice.
        KeyboardInterrupt: the user asked to stop; a checkpoint was written.
        GeorefError: a product or a photograph cannot be read, or the scene has too few points.
    """
    # First, so that `--backend cuda` without a GPU fails at once.
    backend = rasterizer(options.backend, stage.progress)
    workspace = stage.workspace
    clouds = None if options.lidar is None else CloudFiles(options.lidar, options.lidar_stated)
    initial, survey, scene = load_initial_scene(workspace)
    track = None
    if options.lidar_trajectory is not None:
        track = ScannerTrack.read(options.lidar_trajectory, options.lidar_stated, survey.origin)
    options.require_trainable(len(scene.sparse.image_name))
    images = photographs(scene.sparse, survey, workspace, options.effort.max_image_size)
    free_bytes = free_memory_bytes(device_of(backend))
    options = with_gaussian_limit(options, len(images), images.largest(), free_bytes)
    require_memory(training_size(options, len(images), images.largest()), free_bytes)
    images.build(stage.progress)
    maps = DepthMaps(workspace.cache / "surface", scene, images) if options.dense else None
    if maps is not None:
        maps.build(stage.progress)
    compared = None
    if clouds is not None and maps is not None:
        compared = compared_lidar(
            options, clouds, maps, survey, track=track,
            georeference=initial.geo_from_local, seed=options.seed, progress=stage.progress,
        )  # fmt: skip
    points = GeolocatedPoints.load(workspace.path(POINTS))
    planes = compared.planes() if compared is not None and options.lidar_register else None
    problem = geo_problem(scene, survey, initial, options, points=points, planes=planes, seed=options.seed)
    if problem.bundle is not None:
        log.info("the %d cameras are solved once, before the training, and held", len(images))
    solve_and_hold(problem)
    surface, lidar = None if maps is None else SceneSurface(maps), None
    if compared is not None and clouds is not None:
        shift = problem.estimate().errors.lidar_m
        shift_m = None if shift is None else shift.detach().cpu().numpy()
        lidar = lidar_surface(compared, clouds, survey, options, shift_m)
        surface = lidar.surface
        save_json(lidar.report, stage.out / Path(LIDAR).name)
        draw_changes(stage.out / Path(LIDAR_MAP).name, lidar, scene)
    trainer = make_trainer(TrainingScene(scene, images, surface), problem, backend, options)
    record = train_in_folder(stage, trainer, options, _iterations(stage))
    model = trained_model(trainer, scene, initial)
    write_gaussians(stage.out / "gaussians.ply", trainer.optimizer.gaussians.detached())
    save_json(model, stage.out / "model.json")
    metrics = [json.loads(row) for row in (stage.out / METRICS).read_text(encoding="utf-8").splitlines()]
    return summary_of(model, metrics, record, None if lidar is None else lidar.report)


def made_in_parts(workspace: Workspace, options: TrainOptions) -> bool:
    """Return whether the survey is trained in blocks: as asked, or because one training would not fit into memory.

    Raises:
        BackendUnavailableError: `--backend cuda` without a GPU or without gsplat.
        GeorefError: the survey cannot be read.
    """
    return forecast_of(load_survey(workspace), options).in_blocks


def _iterations(stage: StageRun) -> int:
    """Return the iterations of the finished training that this one may extend; 0: there is none."""
    model = None if stage.extends is None else stage.extends / "model.json"
    return 0 if model is None else load_json(TrainedModel, model).iterations
