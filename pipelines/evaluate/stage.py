"""Evaluation: images against held-out photographs, positions against check points (method, section 4).

Reads the trained model, the survey and the initial similarity. Writes `evaluate/report.json`, side-by-side
renders, and the predicted accuracy over the scene as `accuracy.csv` and `accuracy.png`. Check points enter no
solve; what was used in one is reported as a fit, not as an accuracy (docs/accuracy.md).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import dump_json, load_json
from pipelines.core.progress import Progress
from pipelines.core.stages import SIM3
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.evaluate.accuracy_map import AccuracyGrid, accuracy_grid, write_csv
from pipelines.evaluate.asprs import LEAST_POINTS, few_points
from pipelines.evaluate.coordinates import in_crs, target_crs
from pipelines.evaluate.options import EvaluateOptions
from pipelines.evaluate.point_report import point_report, point_rows, ray_counts
from pipelines.evaluate.points import Sights, points_by_camera, points_by_model, sights
from pipelines.evaluate.prediction import Prediction, cramer_rao, left_out
from pipelines.plots.accuracy_map import MapPoints, SigmaRaster, write_accuracy_map
from pipelines.robust.statistics import residual_stats
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.renderer import ModelRenderer
from pipelines.scene.restored import Restored, geographic_options_of, restore
from pipelines.scene.scene import photographs
from pipelines.scene.survey import SurveyedPoint
from pipelines.scene.trained import Trained, load_trained
from pipelines.splat.exposure import fitted_affine, with_affine
from pipelines.splat.metrics import lpips, psnr, ssim
from pipelines.splat.rasterizer.backends import rasterizer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Known:
    """What the measurements say of the trained survey's own accuracy.

    Attributes:
        restored: the geographic half, solved.
        prediction: covariances that follow from it.
        grid: the prediction over the scene; None for a scene of too few points.
    """

    restored: Restored
    prediction: Prediction
    grid: AccuracyGrid | None


def run(stage: StageRun, config: EvaluateOptions) -> Summary:
    """Measure, write the report, the renders and the map of the predicted accuracy."""
    trained = load_trained(stage.workspace, config.similarity)
    crs = None if config.crs is None else target_crs(config.crs, trained.survey)
    initial = load_json(InitialSimilarity, stage.workspace.path(SIM3))
    images = photographs(trained.sfm, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(stage.progress)
    renderer = ModelRenderer(trained, images, rasterizer(config.backend))
    known: Known | str
    try:
        restored = restore(trained, initial, geographic_options_of(stage.workspace))
        prediction = Prediction(restored)
        known = Known(restored, prediction, accuracy_grid(restored, prediction))
    except DegenerateGeometryError as error:
        known = str(error)
    report = evaluate(renderer, known, config, stage.out / "renders", stage.progress)
    if crs is not None:
        report["coordinates"] = in_crs(report["checkpoints"], trained.survey, crs)
    if isinstance(known, Known) and known.grid is not None:
        write_csv(known.grid, trained.survey.origin, stage.out / "accuracy.csv")
        _draw(known.grid, trained, stage.out / "accuracy.png")
    (stage.out / "report.json").write_text(dump_json(report) + "\n", encoding="utf-8")
    return _summarise(report, config)


def evaluate(
    renderer: ModelRenderer, known: Known | str, config: EvaluateOptions, renders: Path, progress: Progress
) -> dict[str, Any]:
    """The report as a plain document; side-by-side renders go to the folder `renders`.

    Args:
        known: what is known of the accuracy, or why nothing is.
    """
    trained = renderer.trained
    checks = sights(trained, trained.survey.check_points)
    depth = _depth_maps(renderer, checks, progress)
    return {
        "format_version": 1,
        "photometric": {"test": _photometric(renderer, config, renders, progress)},
        "checkpoints": {
            "camera": _checks_by_camera(trained, checks, known),
            "model": _checks_by_model(renderer, checks, depth),
        },
        "cross_validation": _cross_validation(trained, known, config),
        "accuracy": _accuracy(known, config),
        "fit": {"gnss": _gnss_fit(trained), "gcp": _control_fit(trained)},
        "similarity": {
            "sigma_ln_scale": float(np.sqrt(trained.model.geo_from_model.covariance[0][0])),
            "sigma_translation_m": [
                float(np.sqrt(trained.model.geo_from_model.covariance[i][i])) for i in (4, 5, 6)
            ],
        },
    }


def _photometric(
    renderer: ModelRenderer, config: EvaluateOptions, renders: Path, progress: Progress
) -> dict[str, Any]:
    """PSNR, SSIM and LPIPS of the test views; cameras of test views were never fitted to them.

    `psnr` compares the render as it is. `psnr_compensated` first gives it the photograph's own exposure, an affine
    change of colour fitted to that very photograph: what is left then is not a matter of exposure.
    """
    indices, rows = renderer.trained.indices("test"), []
    renders.mkdir(parents=True, exist_ok=True)
    distance = lpips(config.lpips_weights)
    with progress.task("test views", len(indices)) as task:
        for place, index in enumerate(indices):
            colour = renderer.render(index).colour.clamp(0, 1).cpu()
            photo = torch.from_numpy(np.array(renderer.images.image(index))).float() / 255.0
            mask = torch.from_numpy(np.array(renderer.images.mask(index)))
            name = renderer.trained.sparse.image_name[index]
            rows.append(
                {
                    "image": name,
                    "psnr": psnr(colour, photo, mask),
                    "psnr_compensated": psnr(with_affine(colour, fitted_affine(colour, photo, mask)), photo, mask),
                    "ssim": ssim(colour, photo, mask),
                    "lpips": distance(colour, photo, mask) if callable(distance) else None,
                }
            )
            if place < config.renders:
                _write_side_by_side(renders / render_name(name), photo, colour)
            task.advance()
    summary: dict[str, Any] = {"views": len(rows)}
    for metric in ("psnr", "psnr_compensated", "ssim", "lpips"):
        values = [row[metric] for row in rows if row[metric] is not None]
        summary[metric] = float(np.mean(np.array(values, dtype=np.float64))) if values else None
    if not callable(distance):
        summary["lpips_reason"] = distance
    return {**summary, "per_view": rows}


def render_name(image: str) -> str:
    """File name of an image's render: folders have become part of it, since images in two may share their names."""
    return Path(image).with_suffix(".png").as_posix().replace("/", "_")


def _write_side_by_side(path: Path, photo: torch.Tensor, colour: torch.Tensor) -> None:
    """Photograph, render, and their difference (× 3)."""
    difference = (3 * (photo - colour).abs()).clamp(0, 1)
    strip = torch.cat([photo, colour, difference], dim=1).mul(255).round().byte().numpy()
    cv2.imwrite(str(path), np.ascontiguousarray(strip[..., ::-1]))


def _depth_maps(renderer: ModelRenderer, seen: Sights, progress: Progress) -> dict[int, FloatArray]:
    depth = {}
    cameras = sorted({int(i) for i in seen.camera})
    with progress.task("depth maps", len(cameras)) as task:
        for index in cameras:
            depth[index] = renderer.depth_m(index)
            task.advance()
    return depth


def _surveyed(points: tuple[SurveyedPoint, ...]) -> FloatArray:
    return np.array([point.position_in_geo for point in points]).reshape(-1, 3)


def _checks_by_camera(trained: Trained, seen: Sights, known: Known | str) -> dict[str, Any]:
    points = trained.survey.check_points
    found, predicted, bound = points_by_camera(trained, seen, len(points)), None, None
    if isinstance(known, Known) and points:
        predicted = known.prediction.of_sights(found, seen)
        try:
            bound = cramer_rao(known.restored, seen)
        except DegenerateGeometryError as error:
            log.info("no Cramér–Rao bound: %s", error)
    rays = ray_counts(seen, len(points))
    return point_report(found - _surveyed(points), points, rays=rays, predicted=predicted, bound=bound)


def _checks_by_model(renderer: ModelRenderer, seen: Sights, depth: dict[int, FloatArray]) -> dict[str, Any]:
    points = renderer.trained.survey.check_points
    pinholes = {index: renderer.pinhole(index) for index in depth}
    found = points_by_model(renderer.trained, seen, depth, pinholes, len(points))
    return point_report(found - _surveyed(points), points, rays=ray_counts(seen, len(points)))


def _cross_validation(trained: Trained, known: Known | str, config: EvaluateOptions) -> dict[str, Any] | None:
    """Control points, each measured by a solution without it; None where that was not asked for."""
    if not config.cross_validate:
        return None
    if isinstance(known, str):
        return {"count": 0, "reason": known}
    points = trained.survey.control_points
    found = left_out(known.restored)
    rays = ray_counts(sights(trained, points), len(points))
    report = point_report(found.error_in_geo, points, rays=rays, predicted=found.cov_in_geo)
    for of_check_points_only in ("asprs", "cramer_rao"):
        del report[of_check_points_only]
    reason = None if report["count"] else "no control point can be spared, or none entered the training"
    return {**report, "reason": reason}


def _accuracy(known: Known | str, config: EvaluateOptions) -> dict[str, Any]:
    """The predicted accuracy over the scene in short; the grid is in `accuracy.csv`."""
    if isinstance(known, str):
        return {"cells": 0, "reason": known, "cautions": []}
    cautions = list(known.prediction.cautions)
    if config.similarity == "initial":
        cautions.append("measured with the initial similarity: the prediction is that of the trained one")
    if known.grid is None:
        return {"cells": 0, "reason": "the scene has too few points", "cautions": cautions}
    return {**known.grid.figures(), "reason": None, "cautions": cautions}


def _control_fit(trained: Trained) -> dict[str, Any]:
    """Residuals of the control points: how the solution fits, not how accurate it is."""
    points = trained.survey.control_points
    seen = sights(trained, points)
    error = points_by_camera(trained, seen, len(points)) - _surveyed(points)
    rows = point_rows(error, points, ray_counts(seen, len(points)))
    return {**residual_stats(error[~np.isnan(error[:, 0])]).model_dump(), "points": rows}


def _gnss_fit(trained: Trained) -> dict[str, Any]:
    """Residuals of the training cameras' fixes: how the solution fits, not how accurate it is."""
    centers = trained.geo_from_model.apply(trained.poses.cam_center_in_model)
    outliers = set(trained.model.gnss_outliers)
    residuals, left_out = [], 0
    for index in trained.indices("train"):
        image = trained.survey.image(trained.sparse.image_name[index])
        if image is None or image.fix is None:
            continue
        if image.name in outliers:
            left_out += 1
            continue
        residuals.append(centers[index] - np.array(image.fix.position_in_geo))
    stats = residual_stats(np.array(residuals).reshape(-1, 3))
    return {**stats.model_dump(), "outliers": left_out}


def _summarise(report: dict[str, Any], config: EvaluateOptions) -> Summary:
    test, checks = report["photometric"]["test"], report["checkpoints"]
    parts = [f"test PSNR {test['psnr']:.2f} dB" if test["psnr"] is not None else "no test views"]
    for way in ("camera", "model"):
        if checks[way]["count"]:
            parts.append(f"check points by {way} {checks[way]['mean_h_m']:.3f} m H")
    values = {
        "views": test["views"],
        "psnr": test["psnr"],
        "psnr_compensated": test["psnr_compensated"],
        "ssim": test["ssim"],
        **{
            f"{way}_{key}": checks[way][key]
            for way in ("camera", "model")
            for key in ("count", "mean_h_m", "rmse_h_m", "rmse_v_m", "rmse_3d_m")
        },
    }
    return Summary(", ".join(parts), values, _warnings(report, config))


def _warnings(report: dict[str, Any], config: EvaluateOptions) -> tuple[str, ...]:
    warnings, checks = list(report["accuracy"]["cautions"]), report["checkpoints"]
    count = checks["camera"]["count"]
    if 0 < count < LEAST_POINTS:
        warnings.append(few_points(count))
    for way in ("camera", "model"):
        names = checks[way]["blunders"]
        if names:
            more = " …" if len(names) > 8 else ""
            warnings.append(
                f"by {way}, {len(names)} of {checks[way]['count']} check points are off by more than three times "
                f"the class that the others meet: {', '.join(names[:8])}{more}"
            )
    crossed = report["cross_validation"]
    if config.cross_validate and crossed["reason"] is not None:
        warnings.append(f"no cross-validation: {crossed['reason']}")
    return tuple(warnings)


def _draw(grid: AccuracyGrid, trained: Trained, path: Path) -> None:
    """Draw the predicted accuracy with cameras, control and check points."""
    raster = SigmaRaster(grid.raster(grid.sigma_h_m), grid.raster(grid.sigma_v_m), grid.corner_in_geo, grid.size_m)
    points = MapPoints(
        trained.geo_from_model.apply(trained.poses.cam_center_in_model)[:, :2],
        _plan(trained.survey.control_points),
        _plan(trained.survey.check_points),
    )
    write_accuracy_map(path, raster, points)


def _plan(points: tuple[SurveyedPoint, ...]) -> FloatArray:
    """East and north (K, 2) of surveyed points in metres."""
    return np.array([point.position_in_geo for point in points]).reshape(-1, 3)[:, :2]
