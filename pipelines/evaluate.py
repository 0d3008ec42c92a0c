"""Evaluation: images against held-out photographs, positions against check points (method, section 4).

Reads the trained model, the survey and the initial similarity. Writes `evaluate/report.json` and side-by-side
renders. Check points enter no solve; what was used in one is reported as a fit, not as an accuracy.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from pipelines.blocks.coordinates import in_crs, target_crs
from pipelines.blocks.points import Sights, points_by_camera, points_by_model, sights
from pipelines.blocks.scene import photographs
from pipelines.blocks.trained import Trained, load_trained
from pipelines.config import EvaluateConfig
from pipelines.formats.image_cache import ImageCache
from pipelines.products import FloatArray, SurveyedPoint, dump_json
from pipelines.progress import Progress
from pipelines.robust.statistics import residual_stats
from pipelines.splat.exposure import fitted_affine, with_affine
from pipelines.splat.metrics import lpips, psnr, ssim
from pipelines.splat.raster.api import Rasterizer, RasterSettings, Render, rasterizer
from pipelines.workspace import StageRun, Summary

log = logging.getLogger(__name__)

_ASPRS_LEAST_POINTS = 30


def run(stage: StageRun, config: EvaluateConfig) -> Summary:
    """Measure, write the report and the renders."""
    trained = load_trained(stage.workspace, config.similarity)
    crs = None if config.crs is None else target_crs(config.crs, trained.survey)
    images = photographs(trained.sparse, trained.survey, stage.workspace, trained.model.max_image_size)
    images.build(stage.progress)
    eye = Eye(trained, images, rasterizer(config.backend))
    report = evaluate(eye, config, stage.out / "renders", stage.progress)
    if crs is not None:
        report["coordinates"] = in_crs(report["checkpoints"], trained.survey, crs)
    (stage.out / "report.json").write_text(dump_json(report) + "\n", encoding="utf-8")
    return _summarise(report)


class Eye:
    """Looks at the trained model through its own cameras."""

    def __init__(self, trained: Trained, images: ImageCache, backend: Rasterizer) -> None:
        self.trained, self.images, self._backend = trained, images, backend
        device = torch.device("cuda" if backend.name == "cuda" else "cpu")
        self._gaussians = trained.gaussians.to(device)

    def look(self, index: int, *, depth: bool = False) -> Render:
        """The model from camera `index`, at training size."""
        model, poses = self.trained.model, self.trained.poses
        matrix = np.eye(4)
        matrix[:3, :3] = poses.cam_from_model[index]
        matrix[:3, 3] = -poses.cam_from_model[index] @ poses.cam_center_in_model[index]
        settings = RasterSettings(sh_degree=model.sh_degree, background=model.background, depth=depth)
        pose = torch.as_tensor(matrix, dtype=torch.float32, device=self._gaussians.means.device)
        with torch.no_grad():
            return self._backend.render(self._gaussians, pose, self.images.pinhole(index), settings)


def evaluate(eye: Eye, config: EvaluateConfig, renders: Path, progress: Progress) -> dict[str, Any]:
    """The report as a plain document; side-by-side renders go to the folder `renders`."""
    trained = eye.trained
    checks = sights(trained, trained.survey.check_points)
    controls = sights(trained, trained.survey.control_points)
    depth = _depth_maps(eye, checks, progress)
    return {
        "format_version": 1,
        "photometric": {"test": _photometric(eye, config, renders, progress)},
        "checkpoints": {
            "camera": _by_camera(trained, checks, trained.survey.check_points),
            "model": _by_model(eye, checks, depth),
        },
        "fit": {
            "gnss": _gnss_fit(trained),
            "gcp": _by_camera(trained, controls, trained.survey.control_points),
        },
        "similarity": {
            "sigma_ln_scale": float(np.sqrt(trained.model.geo_from_model.covariance[0][0])),
            "sigma_translation_m": [
                float(np.sqrt(trained.model.geo_from_model.covariance[i][i])) for i in (4, 5, 6)
            ],
        },
    }


def _photometric(eye: Eye, config: EvaluateConfig, renders: Path, progress: Progress) -> dict[str, Any]:
    """PSNR, SSIM and LPIPS of the test views; cameras of test views were never fitted to them.

    `psnr` compares the render as it is. `psnr_compensated` first gives it the photograph's own exposure, an affine
    change of colour fitted to that very photograph: what is left then is not a matter of exposure.
    """
    indices, rows = eye.trained.indices("test"), []
    renders.mkdir(parents=True, exist_ok=True)
    distance = lpips(config.lpips_weights)
    with progress.task("test views", len(indices)) as task:
        for place, index in enumerate(indices):
            colour = eye.look(index).colour.clamp(0, 1).cpu()
            photo = torch.from_numpy(np.array(eye.images.image(index))).float() / 255.0
            mask = torch.from_numpy(np.array(eye.images.mask(index)))
            name = eye.trained.sparse.image_name[index]
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


def _depth_maps(eye: Eye, seen: Sights, progress: Progress) -> dict[int, FloatArray]:
    depth = {}
    cameras = sorted({int(i) for i in seen.camera})
    with progress.task("depth maps", len(cameras)) as task:
        for index in cameras:
            median = eye.look(index, depth=True).median_depth
            if median is not None:
                depth[index] = median.cpu().numpy()
            task.advance()
    return depth


def _by_camera(trained: Trained, seen: Sights, points: tuple[SurveyedPoint, ...]) -> dict[str, Any]:
    return _point_report(points_by_camera(trained, seen, len(points)), seen, points)


def _by_model(eye: Eye, seen: Sights, depth: dict[int, FloatArray]) -> dict[str, Any]:
    points = eye.trained.survey.check_points
    pinholes = {index: eye.images.pinhole(index) for index in depth}
    return _point_report(points_by_model(eye.trained, seen, depth, pinholes, len(points)), seen, points)


def _point_report(found: FloatArray, seen: Sights, points: tuple[SurveyedPoint, ...]) -> dict[str, Any]:
    """Statistics and rows of found (J, 3) against surveyed positions, in metres."""
    surveyed = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
    error = found.reshape(-1, 3) - surveyed
    measured = np.isfinite(error).all(axis=1)
    rows = [
        {
            "name": point.name,
            "rays": int((seen.point == j).sum()),
            "de_m": float(error[j, 0]) if measured[j] else None,
            "dn_m": float(error[j, 1]) if measured[j] else None,
            "du_m": float(error[j, 2]) if measured[j] else None,
        }
        for j, point in enumerate(points)
    ]
    return {**residual_stats(error[measured]).model_dump(), "points": rows}


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


def _summarise(report: dict[str, Any]) -> Summary:
    test, checks = report["photometric"]["test"], report["checkpoints"]
    parts = [f"test PSNR {test['psnr']:.2f} dB" if test["psnr"] is not None else "no test views"]
    warnings = []
    for way in ("camera", "model"):
        if checks[way]["count"]:
            parts.append(f"check points by {way} {checks[way]['mean_h_m']:.3f} m H")
    count = checks["camera"]["count"]
    if 0 < count < _ASPRS_LEAST_POINTS:
        warnings.append(f"{count} check points: the ASPRS standard asks for {_ASPRS_LEAST_POINTS} or more")
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
    return Summary(", ".join(parts), values, tuple(warnings))
