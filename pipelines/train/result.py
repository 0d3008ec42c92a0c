"""Product of a training, with its summary and its warnings."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.core.workspace import Summary
from pipelines.survey.report_parts import EstimatedError, LidarReport
from pipelines.survey.trained_model import Adjustment, TrainedModel
from pipelines.train.adjusted_scene import with_exposures
from pipelines.train.loop import TrainingRecord
from pipelines.train.trainer import JointTrainer

_EVIDENT_SIGMAS = 3.0
_CAUSES = {
    "lever-arm": "`georef ingest --lever-arm` can apply it, in the axes of the body",
    "boresight": "`georef ingest --boresight` can apply it",
    "lidar-shift": "Check the LiDAR's CRS, datum and flight",
}


def trained_model(trainer: JointTrainer, solution: Adjustment) -> TrainedModel:
    """Return the product of `train` without the Gaussians, given the solution at the end of the training."""
    if trainer.exposures is not None:
        solution = with_exposures(solution, trainer.exposures.affine.cpu().numpy().astype(float))
    gaussians = trainer.optimizer.gaussians
    return TrainedModel(
        **dict(solution),
        max_image_size=trainer.views.images.max_size_px,
        background=trainer.options.background,
        sh_degree=gaussians.sh_degree,
        iterations=trainer.iteration,
        gaussians=len(gaussians),
        backend=trainer.rasterizer.name,
    )


def summary_of(
    model: TrainedModel, metrics: list[dict[str, Any]], record: TrainingRecord, lidar: LidarReport | None = None
) -> Summary:
    """Return headline, values and warnings of a training, given the rows of `metrics.jsonl`."""
    psnr = float(np.mean([row["psnr"] for row in metrics[-20:]]))
    sigma = np.sqrt(np.diag(np.array(model.geo_from_model.covariance)))
    values = {
        "iterations": model.iterations,
        "gaussians": model.gaussians,
        "train_psnr": round(psnr, 3),
        "seconds": round(record.seconds, 1),
        "seconds_per_iteration": round(record.seconds / model.iterations, 4),
        "similarity_sigma_m": [round(float(value), 5) for value in sigma[4:]],
        "gnss_outliers": list(model.gnss_outliers),
        "control_outliers": list(model.control_outliers),
        "estimated_errors": [error.model_dump() for error in model.estimated_errors],
    }
    if lidar is not None:
        values["lidar"] = lidar.model_dump(mode="json")
    key_figure = f"{model.gaussians} gaussians, train PSNR {psnr:.2f} dB"
    # A common error of the fixes is everyday: init-sim3 has tested it against its prior, and its cautions tell it.
    told = [_warning_of(error) for error in model.estimated_errors if error.name != "bias"]
    warnings = [text for text in (*told, record.recovery) if text is not None]
    if lidar is not None:
        warnings += lidar.assumptions
    if lidar is not None and lidar.areas:
        area_m2 = sum(area.area_m2 for area in lidar.areas)
        warnings.append(
            f"LiDAR and photographs contradict each other on {area_m2:.0f} m² in {len(lidar.areas)} places, which "
            "train/lidar.json lists and train/lidar.png shows: the LiDAR is not used there"
        )
    return Summary(key_figure, values, tuple(warnings), model.cautions)


def _warning_of(error: EstimatedError) -> str | None:
    """Return a warning if the error exceeds 3 σ or is not observable along every axis; else None."""
    axes = "east, north, up" if error.name == "lidar-shift" else "right, down, forward"
    values = ", ".join(f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(error.value, error.sigma, strict=True))
    evident = [
        abs(value) > _EVIDENT_SIGMAS * sigma and observed
        for value, sigma, observed in zip(error.value, error.sigma, error.observed, strict=True)
    ]
    if any(evident):
        evidence = f"{error.name} of ({values}) {error.unit} {axes}, beyond 3 σ: it is taken out here"
        return f"{evidence}. {_CAUSES[error.name]}"
    if not all(error.observed):
        return f"{error.name} is not observable along every axis: ({values}) {error.unit} {axes}"
    return None
