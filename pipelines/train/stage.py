"""Stage `train`: joint optimisation of Gaussians, similarity and cameras (GeoRefGS, section 2.4).

Reads the survey, the SfM model, the intersected points and the adjustment of `init-sim3`, from which it starts.
Writes `train/gaussians.ply` (frame `model`), `train/model.json` and `train/adjustment.npz` (the adjustment at the
end of the training), `train/metrics.jsonl` and the latest checkpoint. An interrupted run leaves a checkpoint in
`train.partial/`, from which the next run with the same options continues. A finished training with fewer iterations
is extended from its last checkpoint.
"""

import json
import logging
import shutil
from pathlib import Path

import numpy as np

from pipelines.adjust.posterior import Posterior, load_posterior, save_posterior
from pipelines.adjust.solution import remarks_of
from pipelines.adjust.system import minimise
from pipelines.core.json_values import Json
from pipelines.core.products import Remark, load_json, save_json, save_npz
from pipelines.core.stages import HELD_OUT, LIDAR, LIDAR_MAP, MODEL, POINTS, SIM3_POSTERIOR, TRAIN_POSTERIOR
from pipelines.core.types import vector3
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.splat.exposure import Exposures
from pipelines.splat.gaussians import write_gaussians
from pipelines.splat.memory import free_memory_bytes, require_memory
from pipelines.splat.rasterizer.backends import MipFiltered, rasterizer
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.lidar_cloud import ScannerTrack
from pipelines.surface.measured_cloud import CloudReader, MeasuredFiles
from pipelines.surface.photo_depths import DepthStatement, PhotoDepths, holds_depth_maps
from pipelines.survey.area import boundary_area
from pipelines.survey.lidar_report import LidarReport
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CloudCrs
from pipelines.survey.photographs import ImageCache
from pipelines.survey.scene import SparseScene, load_adjusted_scene, photographs
from pipelines.survey.solution import GeolocatedPoints, LensVignetting, Solution, TrainedModel
from pipelines.survey.survey import Survey
from pipelines.train.compilation import compile_kernels
from pipelines.train.estimate import estimate_training, training_size, with_effort
from pipelines.train.georeference.problem import frozen_problem, refining_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.lidar import compared_lidar, draw_changes, lidar_surface, plane_observations
from pipelines.train.loop import METRICS, TrainingRecord, train_in_folder
from pipelines.train.options import TrainOptions
from pipelines.train.schedule import BACKGROUND
from pipelines.train.solution_state import (
    error_estimates,
    figures_of,
    measured_problem,
    solved_at,
    state_of,
    with_exposures,
)
from pipelines.train.surface import SceneSurface
from pipelines.train.trainer import JointTrainer, make_trainer

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
    backend = rasterizer(options.backend, stage.progress, mip_filter=options.mip_filter)
    workspace = stage.workspace
    (solution, survey, scene), path = load_adjusted_scene(workspace), options.lidar_trajectory
    solved, images = _seen_by(workspace, scene, survey, solution, options)
    clouds = measured_files(options, solved)
    track = None if path is None else ScannerTrack.read(path, _stated_crs(options), survey.origin_on_earth)
    options = _within_memory(options, images, free_memory_bytes(backend.device))
    images.build(stage.progress)
    compile_kernels(stage.progress, renders=backend.name == "cpu")
    surface, compared, planes, lidar = None, None, None, None
    if options.dense:
        maps = DepthMaps(workspace.cache / "surface", solved, images)
        maps.build(stage.progress)
        surface = SceneSurface(maps)
        if clouds is not None:
            compared = compared_lidar(
                options, clouds, maps, survey, track=track,
                georeference=solution.geo_from_model, seed=options.seed, progress=stage.progress,
            )  # fmt: skip
    if compared is not None and options.lidar_register:
        planes = plane_observations(compared.registration, scene.geo_from_model)
    measured = measured_problem(solution, survey, scene, control_points=options.gcp_loss, planes=planes)
    posterior: Posterior | None = None
    if planes is not None:
        minimum = minimise(measured, state_of(solution, scene, measured.errors))
        posterior = solved_at(solution, survey, scene, measured, minimum.state)
        solution = posterior.solution
        solved, images = _seen_by(workspace, scene, survey, solution, options)
        images.build(stage.progress)
    refines = options.refined_cameras(len(images)) > 0
    if refines:
        start = posterior or load_posterior(workspace.path(SIM3_POSTERIOR), solution, scene.sparse)
        problem = refining_problem(
            start, survey, scene, measured, options,
            points=GeolocatedPoints.load(workspace.path(POINTS)), seed=options.seed,
        )  # fmt: skip
    else:
        log.info("Similarity and cameras are frozen at the adjustment of init-sim3.")
        problem = frozen_problem(solution, scene)
    if compared is not None and clouds is not None:
        shift_m = measured.errors.value(error_estimates(solution, measured.errors)[0], "lidar-shift")
        lidar = lidar_surface(compared, clouds, survey, options, shift_m)
        surface = lidar.surface
        save_json(lidar.report, stage.out / Path(LIDAR).name)
        draw_changes(stage.out / Path(LIDAR_MAP).name, lidar, solved)
        if lidar.held_out is not None:
            save_npz(stage.out / Path(HELD_OUT).name, vars(lidar.held_out))
    area = boundary_area(options, solved.geo_from_model.apply(solved.point_in_model), survey.origin)
    trainer = make_trainer(TrainingScene(solved, images, surface, area=area), problem, backend, options)
    done = 0 if stage.extends is None else load_json(TrainedModel, stage.extends / Path(MODEL).name).iterations
    record = train_in_folder(stage, trainer, options, done)
    if refines:
        posterior = solved_at(solution, survey, scene, measured, problem.unknowns.state())
    model = _write_solution(stage, trainer, solution, posterior)
    metrics = [json.loads(row) for row in (stage.out / METRICS).read_text(encoding="utf-8").splitlines()]
    return _summary(model, metrics, record, None if lidar is None else lidar.report)


def _seen_by(
    workspace: Workspace, scene: SparseScene, survey: Survey, solution: Solution, options: TrainOptions
) -> tuple[SparseScene, ImageCache]:
    """Return the scene at a solution, and its photographs, undistorted with the solved lenses but not yet built."""
    solved = scene.at(solution)
    return solved, photographs(solved.sparse, survey, workspace, options.effort.max_image_size)


def measured_files(options: TrainOptions, scene: SparseScene) -> MeasuredFiles | None:
    """Return the files of `--lidar`, checked; None: there are none."""
    if options.lidar is None:
        return None
    depths = holds_depth_maps(options.lidar)
    options.require_kind(depths=depths)
    if not depths:
        return CloudReader(options.lidar, _stated_crs(options))
    unit_m = 1.0 if options.depth_unit is None else options.depth_unit
    said = DepthStatement(unit_m, options.depth_along, options.depth_camera, options.lidar_sigma)
    return PhotoDepths(options.lidar, scene, said)


def _stated_crs(options: TrainOptions) -> CloudCrs:
    return CloudCrs(options.lidar_crs, options.lidar_vertical, offset=options.lidar_offset, up=options.lidar_up)


def _within_memory(options: TrainOptions, images: ImageCache, free_bytes: int | None) -> TrainOptions:
    """Return the options with as many Gaussians as fit into the memory, or raise a ResourceError."""
    options = with_effort(options, len(images), images.largest(), free_bytes)
    require_memory(training_size(options, len(images), images.largest()), free_bytes)
    return options


def _write_solution(
    stage: StageRun, trainer: JointTrainer, frozen: Solution, posterior: Posterior | None
) -> TrainedModel:
    """Write and return the product of a training, of which `frozen` is the adjustment if there is no posterior."""
    model = trained_model(trainer, frozen if posterior is None else posterior.solution)
    save_json(model, stage.out / Path(MODEL).name)
    gaussians = trainer.optimizer.gaussians.detached()
    write_gaussians(stage.out / "gaussians.ply", gaussians, mip_filter=model.mip_filter)
    path = stage.out / Path(TRAIN_POSTERIOR).name
    if posterior is None:
        shutil.copyfile(stage.workspace.path(SIM3_POSTERIOR), path)
    else:
        save_posterior(posterior, path)
    return model


def trained_model(trainer: JointTrainer, solution: Solution) -> TrainedModel:
    """Return the product of `train` without the Gaussians, given the solution at the end of the training."""
    vignetting: tuple[LensVignetting, ...] = ()
    if trainer.exposures is not None:
        solution = with_exposures(solution, trainer.exposures.affine.cpu().numpy().astype(float))
    if isinstance(trainer.exposures, Exposures):
        fitted = zip(trainer.exposures.lenses, trainer.exposures.vignetting.tolist(), strict=True)
        vignetting = tuple(
            LensVignetting(camera_id=lens, coefficients=vector3(np.array(falloff))) for lens, falloff in fitted
        )
    gaussians = trainer.optimizer.gaussians
    return TrainedModel(
        **dict(solution),
        vignetting=vignetting,
        max_image_size=trainer.views.images.max_size_px,
        background=BACKGROUND,
        sh_degree=gaussians.sh_degree,
        iterations=trainer.iteration,
        gaussians=len(gaussians),
        backend=trainer.rasterizer.name,
        mip_filter=isinstance(trainer.rasterizer, MipFiltered),
    )


def _summary(
    model: TrainedModel, metrics: list[Json], record: TrainingRecord, lidar: LidarReport | None = None
) -> Summary:
    """Return headline, values and warnings of a training, given the rows of `metrics.jsonl`."""
    psnr = float(np.mean([row["psnr"] for row in metrics[-20:]]))
    values = {
        "iterations": model.iterations,
        "gaussians": model.gaussians,
        "train_psnr": round(psnr, 3),
        "seconds": round(record.seconds, 1),
        "seconds_per_iteration": round(record.seconds / model.iterations, 4),
        **figures_of(model),
    }
    if lidar is not None:
        values["lidar"] = lidar.model_dump(mode="json")
    key_figure = f"{model.gaussians} gaussians, train PSNR {psnr:.2f} dB"
    # init-sim3 has told of the others.
    shifts = [error for error in model.estimated_errors if error.name == "lidar-shift"]
    warnings = [
        remark for error in shifts for remark in remarks_of(error, "Check the LiDAR's CRS, datum and flight.")
    ]
    if record.recovery is not None:
        warnings.append(Remark(code="training-recovered", sentence=record.recovery))
    if lidar is not None:
        warnings += lidar.assumptions
    if lidar is not None and lidar.areas:
        area_m2 = sum(area.area_m2 for area in lidar.areas)
        sentence = (
            f"LiDAR and photographs are inconsistent on {area_m2:.0f} m² in {len(lidar.areas)} places, where the "
            "LiDAR is not used (list: train/lidar.json, map: train/lidar.png)."
        )
        warnings.append(Remark(code="lidar-inconsistent", sentence=sentence))
    return Summary(key_figure, values, tuple(warnings), model.cautions)


def made_in_parts(workspace: Workspace, options: TrainOptions) -> bool:
    """Return whether the survey is trained in blocks: as asked, or because one training would not fit into memory.

    Raises:
        BackendUnavailableError: `--backend cuda` without a GPU or without gsplat.
        GeorefError: the survey cannot be read.
    """
    survey = load_survey(workspace)
    return estimate_training(len(survey.images), survey.largest_photograph_px, options).in_blocks
