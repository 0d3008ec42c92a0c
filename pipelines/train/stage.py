"""Stage `train`: joint optimisation of Gaussians, similarity and cameras (GeoRefGS, section 2.4).

Reads the survey, the SfM model, the geolocated points and the initial similarity. Writes `train/gaussians.ply`
(frame `model`), `train/model.json` (similarity with covariance, cameras, constant errors), `train/metrics.jsonl`
and the latest checkpoint. An interrupted run leaves a checkpoint in `train.partial/`, from which the next run with
the same options continues. A finished training with fewer iterations is extended from its last checkpoint.
"""

from __future__ import annotations

import json
import logging
import shutil

from pipelines.core.products import load_json, save_json
from pipelines.core.stages import POINTS, SIM3, SPARSE
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.scene.calibrated import load_survey
from pipelines.scene.geographic import geo_problem
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.measured_cloud import CloudFiles
from pipelines.scene.scene import initial_scene, photographs
from pipelines.scene.trained_model import TrainedModel
from pipelines.splat.memory import free_memory_bytes, require_memory
from pipelines.splat.rasterizer.backends import device_of, rasterizer
from pipelines.splat.storage import write_gaussians
from pipelines.train.assembly import make_trainer, training_size
from pipelines.train.depth_maps import DepthMaps
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.lidar.prepare import draw_changes, lidar_surface
from pipelines.train.loop import LoopOptions, optimise
from pipelines.train.options import TrainOptions
from pipelines.train.result import summary_of, trained_model
from pipelines.train.surface import SceneSurface

CHECKPOINT, METRICS = "checkpoint.npz", "metrics.jsonl"

log = logging.getLogger(__name__)


def run(stage: StageRun, options: TrainOptions) -> Summary:
    """Train the model, write products and checkpoints, and return the summary.

    Raises:
        BackendUnavailableError: `--backend cuda` without a GPU or without gsplat.
        ResourceError: the training would not fit into memory.
        ConvergenceError: the training diverged twice.
        KeyboardInterrupt: the user asked to stop; a checkpoint was written.
        GeorefError: a product or a photograph cannot be read, or the scene has too few points.
    """
    backend = rasterizer(options.backend)  # first, so that `--backend cuda` without a GPU fails at once
    workspace = stage.workspace
    clouds = None if options.lidar is None else CloudFiles(options.lidar, options.lidar_stated)
    initial = load_json(InitialSimilarity, workspace.path(SIM3))
    survey = initial.weighted(load_survey(workspace))
    scene = initial_scene(read_sparse(workspace.path(SPARSE)), survey, initial)
    images = photographs(scene.sparse, survey, workspace, options.effort.max_image_size)
    require_memory(training_size(scene, images, options), free_memory_bytes(device_of(backend)))
    images.build(stage.progress)
    surface, lidar = None, None
    if options.dense:
        maps = DepthMaps(workspace.cache / "surface", scene, images)
        maps.build(stage.progress)
        surface = SceneSurface(maps)
        if clouds is not None:
            lidar = lidar_surface(
                options, clouds, maps, survey,
                georeference=initial.geo_from_local, seed=options.seed, progress=stage.progress,
            )  # fmt: skip
            surface = lidar.surface
            save_json(lidar.report, stage.out / "lidar.json")
            draw_changes(stage.out / "lidar.png", lidar, scene)
    points = GeolocatedPoints.load(workspace.path(POINTS))
    problem = geo_problem(scene, survey, initial, options, points=points, seed=options.seed)
    trainer = make_trainer(TrainingScene(scene, images, surface), problem, backend, options)
    extend = not stage.resumed and _take_over(stage, options.effort.iterations)
    files = LoopOptions(
        stage.out / CHECKPOINT,
        stage.out / METRICS,
        options.checkpoint_every,
        options.log_every,
        resume=stage.resumed or extend,
        extend=extend,
        note=stage.record_progress,
    )
    record = optimise(trainer, files, stage.progress)
    model = trained_model(trainer, scene, initial)
    write_gaussians(stage.out / "gaussians.ply", trainer.optimizer.gaussians.detached())
    save_json(model, stage.out / "model.json")
    metrics = [json.loads(row) for row in files.metrics.read_text(encoding="utf-8").splitlines()]
    return summary_of(model, metrics, record, None if lidar is None else lidar.report)


def _take_over(stage: StageRun, iterations: int) -> bool:
    """Copy the last state of a finished training of fewer iterations, and return whether there is one.

    Raises:
        StorageError: the state cannot be copied.
    """
    if stage.extends is None or not all((stage.extends / name).is_file() for name in (CHECKPOINT, METRICS)):
        return False
    done = load_json(TrainedModel, stage.extends / "model.json").iterations
    if done >= iterations:
        return False
    log.info("the training of %d iterations is extended to %d; --force trains afresh", done, iterations)
    for name in (CHECKPOINT, METRICS):
        shutil.copyfile(stage.extends / name, stage.out / name)
    return True
