"""Training: Gaussians, similarity and cameras optimised together (GeoRefGS section 2.4).

Reads the survey, the SfM model and the initial similarity. Writes `train/gaussians.ply` (frame `model`),
`train/model.json` (similarity with covariance, cameras), `train/metrics.jsonl` and the latest checkpoint. An
interrupted run leaves a checkpoint in `train.partial/` from which `--resume` continues.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pipelines.blocks.background import background
from pipelines.blocks.checkpoint import load_checkpoint, save_checkpoint
from pipelines.blocks.scene import Scene, geo_problem, initial_scene, photographs
from pipelines.blocks.trainer import JointOptions, JointTrainer, StepReport, Views
from pipelines.config import TrainConfig
from pipelines.formats.colmap import read_sparse
from pipelines.formats.image_cache import ImageCache
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.georef.problem import GeoProblem
from pipelines.interrupts import deferred_interrupts
from pipelines.products import (
    InitialSimilarity,
    Survey,
    TrainedCamera,
    TrainedModel,
    load_json,
    save_json,
)
from pipelines.progress import Progress
from pipelines.splat.densify import DefaultSettings, DefaultStrategy
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.initialise import (
    InitialisationOptions,
    gaussians_from_points,
    gaussians_of_size,
    scene_extent,
)
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.raster.api import Rasterizer, rasterizer
from pipelines.splat.storage import write_gaussians
from pipelines.stages import SIM3, SPARSE, SURVEY
from pipelines.workspace import StageRun, Summary

log = logging.getLogger(__name__)

_CHECKPOINT = "checkpoint.npz"
_METRICS = "metrics.jsonl"


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


def effort(config: TrainConfig) -> Preset:
    """The preset, with what the user changed of it."""
    preset = PRESETS[config.preset]
    return Preset(
        config.iterations or preset.iterations,
        config.max_image_size or preset.max_image_size,
        config.max_gaussians or preset.max_gaussians,
    )


def run(stage: StageRun, config: TrainConfig) -> Summary:
    """Train, with checkpoints, and write the result."""
    backend = rasterizer(config.backend)  # first: without a GPU, `--backend cuda` need not wait for its refusal
    workspace = stage.workspace
    survey = load_json(Survey, workspace.path(SURVEY))
    initial = load_json(InitialSimilarity, workspace.path(SIM3))
    scene = initial_scene(read_sparse(workspace.path(SPARSE)), survey, initial)
    images = photographs(scene.sparse, survey, workspace, effort(config).max_image_size)
    images.build(stage.progress)
    problem = geo_problem(scene, survey, initial, config)
    trainer = make_trainer(scene, images, problem, backend, config)
    seconds = _optimise(trainer, stage, config)
    return _save(trainer, scene, stage.out, seconds)


def make_trainer(
    scene: Scene, images: ImageCache, problem: GeoProblem, backend: Rasterizer, config: TrainConfig
) -> JointTrainer:
    """Gaussians from the SfM points, and everything that moves them.

    Raises:
        DegenerateGeometryError: too few SfM points.
    """
    preset = effort(config)
    device = torch.device("cuda" if backend.name == "cuda" else "cpu")
    gaussians = initial_gaussians(scene, images, config).to(device)
    extent_m = scene_extent(scene.poses.cam_center_in_model)
    settings = DefaultSettings.for_iterations(preset.iterations, preset.max_gaussians)
    return JointTrainer(
        GaussianAdam(gaussians, extent_m, preset.iterations),
        DefaultStrategy(settings, extent_m, len(gaussians), config.seed),
        problem.to(device),
        Views(scene.train, images),
        rasterizer=backend,
        options=JointOptions(preset.iterations, config.sh_degree, geo_weight=config.geo_weight, seed=config.seed),
    )


def initial_gaussians(scene: Scene, images: ImageCache, config: TrainConfig) -> Gaussians:
    """One at each SfM point, and those of the background.

    Raises:
        DegenerateGeometryError: too few SfM points.
    """
    most = effort(config).max_gaussians
    options = InitialisationOptions(sh_degree=config.sh_degree, max_gaussians=most)
    behind = background(scene, images)
    near = gaussians_from_points(scene.point_in_model, scene.sparse.point_rgb, options)
    far = gaussians_of_size(behind.point_in_model, behind.rgb, behind.sigma_m, options)
    room = max(most - len(near), 0)
    keep = torch.linspace(0, max(len(far) - 1, 0), min(room, len(far))).long()
    return Gaussians.concatenate([near, far.select(keep)])


def _optimise(trainer: JointTrainer, stage: StageRun, config: TrainConfig) -> float:
    """Iterate to the end; returns the seconds spent, those before a resume included.

    Raises:
        KeyboardInterrupt: the user asked to stop; a checkpoint was written.
        ConvergenceError: a loss is not finite.
    """
    checkpoint, metrics = stage.out / _CHECKPOINT, stage.out / _METRICS
    spent = _restore(trainer, checkpoint, metrics) if stage.resumed else 0.0
    total, clock = trainer.options.iterations, time.monotonic()

    def save() -> None:
        seconds = torch.tensor(spent + time.monotonic() - clock, dtype=torch.float64)
        save_checkpoint(checkpoint, {**trainer.state(), "seconds": seconds})

    with _bar(stage.progress, trainer) as advance, deferred_interrupts() as stop:
        with metrics.open("a", encoding="utf-8") as lines:
            while trainer.iteration < total:
                report = trainer.step()
                due = trainer.iteration % config.log_every == 0 or trainer.iteration == total
                if due:
                    trainer.check_finite(report)
                    row = _metrics_row(trainer, report, spent + time.monotonic() - clock)
                    lines.write(json.dumps(row) + "\n")
                    lines.flush()
                    advance(row)
                if stop.requested:
                    save()
                    log.warning("stopped at iteration %d of %d: --resume continues", trainer.iteration, total)
                    raise KeyboardInterrupt
                if trainer.iteration % config.checkpoint_every == 0:
                    save()
        save()
    return spent + time.monotonic() - clock


def _restore(trainer: JointTrainer, checkpoint: Path, metrics: Path) -> float:
    """Take over a checkpoint and drop the metrics that came after it; returns the seconds spent before."""
    if not checkpoint.exists():
        metrics.unlink(missing_ok=True)
        return 0.0
    state = load_checkpoint(checkpoint)
    trainer.restore(state)
    rows = metrics.read_text(encoding="utf-8").splitlines() if metrics.exists() else []
    kept = [row for row in rows if row.endswith("}") and json.loads(row)["iteration"] <= trainer.iteration]
    metrics.write_text("".join(row + "\n" for row in kept), encoding="utf-8")
    log.info("resumed at iteration %d", trainer.iteration)
    return float(state["seconds"])


@contextmanager
def _bar(progress: Progress, trainer: JointTrainer) -> Iterator[Callable[[dict[str, float]], None]]:
    """A progress bar that is advanced by a line of metrics."""
    with progress.task("training", trainer.options.iterations) as task:
        shown = 0

        def advance(row: dict[str, float]) -> None:
            nonlocal shown
            note = f"psnr {row['psnr']:.1f} dB, {row['gaussians']} gaussians"
            task.advance(trainer.iteration - shown, note)
            shown = trainer.iteration

        if trainer.iteration:
            task.advance(trainer.iteration)
            shown = trainer.iteration
        yield advance


def _metrics_row(trainer: JointTrainer, report: StepReport, seconds: float) -> dict[str, float]:
    problem = trainer.problem
    with torch.no_grad():
        terms = problem.terms()
    row = {
        "iteration": trainer.iteration,
        "seconds": round(seconds, 2),
        "photometric": float(report.photometric),
        "psnr": -10.0 * math.log10(max(float(report.mean_square_error), 1e-10)),
        "gaussians": len(trainer.optimizer.gaussians),
        "geo_weight": report.weight,
        "cameras": float(terms.cameras),
    }
    named = {"absolute": terms.absolute, "control": terms.control}
    return row | {name: float(value) for name, value in named.items() if value is not None}


def _save(trainer: JointTrainer, scene: Scene, out: Path, seconds: float) -> Summary:
    problem, gaussians = trainer.problem, trainer.optimizer.gaussians.detached()
    covariance = problem.covariance() if problem.fixes is not None or problem.marks is not None else None
    outliers = tuple(sorted(scene.sparse.image_name[index] for index in problem.outliers()))
    model = TrainedModel(
        geo_from_model=problem.similarity.current().to_record(
            "model",
            "geo",
            covariance=problem.similarity.prior_covariance() if covariance is None else covariance,
            pivot=problem.similarity.pivot_in_geo,
        ),
        model_from_local=scene.model_from_local.to_record("local", "model"),
        max_image_size=trainer.views.images.max_size_px,
        cameras=_cameras(trainer, scene),
        background=trainer.options.background,
        sh_degree=gaussians.sh_degree,
        iterations=trainer.iteration,
        gaussians=len(gaussians),
        backend=trainer.rasterizer.name,
        gnss_outliers=outliers,
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
        "seconds": round(seconds, 1),
        "seconds_per_iteration": round(seconds / trainer.iteration, 4),
        "similarity_sigma_m": [round(float(value), 5) for value in sigma[4:]],
        "gnss_outliers": list(outliers),
    }
    figure = f"{len(gaussians)} gaussians, train PSNR {psnr:.2f} dB"
    warnings = (f"{len(outliers)} fixes contradict the cameras: {', '.join(outliers[:5])}",) if outliers else ()
    return Summary(figure, values, warnings)


def _cameras(trainer: JointTrainer, scene: Scene) -> tuple[TrainedCamera, ...]:
    poses, train = trainer.problem.cameras.current(), set(map(int, scene.train))
    quats = quat_xyzw_from_matrix(poses.cam_from_model)
    translations = -np.einsum("nij,nj->ni", poses.cam_from_model, poses.cam_center_in_model)
    return tuple(
        TrainedCamera(
            name=name,
            split="train" if index in train else "test",
            quat_xyzw=tuple(quats[index]),
            translation=tuple(translations[index]),
        )
        for index, name in enumerate(scene.sparse.image_name)
    )
