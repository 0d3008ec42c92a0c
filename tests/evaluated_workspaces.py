"""Evaluated workspaces for the tests of the report: a true scene, its photographs, and made-up errors."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.products import Remark, load_json, save_json
from pipelines.core.stages import METRICS, RENDERS, REPORT, SURVEY
from pipelines.core.types import Vector3
from pipelines.core.workspace import Workspace
from pipelines.evaluate.check_points import RemeasuredPoints, check_point_errors
from pipelines.report.plots.charts import labelled
from pipelines.survey.photographs import write_render
from pipelines.survey.report import ViewFigures
from pipelines.survey.survey import Survey, SurveyedPoint
from tests.reports import report_with
from tests.scenes import TrueScene
from tests.trained_workspaces import trained_workspace

CHECK_POINTS = 3
ERROR_M: Vector3 = (0.0123456789, -0.02, 0.033)
SIGMA_M: Vector3 = (0.01, 0.02, 0.03)  # predicted
GREY = 90


@dataclass(frozen=True)
class Evaluated:
    """True scene, and its workspace as `evaluate` leaves it."""

    scene: TrueScene
    workspace: Workspace


def evaluated_workspace(root: Path, rename: str = "") -> Evaluated:
    """Return a workspace whose check points all have the error `ERROR_M`.

    Args:
        root: of the workspace.
        rename: text around the names of surveyed points, and in the texts of cautions and assumptions.
    """
    scene, workspace = trained_workspace(root)
    survey = load_json(Survey, workspace.path(SURVEY))
    points = [_renamed(point, rename) for point in survey.control_points]
    changed = {
        "image_dir": "photos",
        "control_points": tuple(points[CHECK_POINTS:]),
        "check_points": tuple(points[:CHECK_POINTS]),
        "assumptions": (Remark(code="flat-ground", sentence=f"The ground is flat {rename}."),),
    }
    survey = survey.model_copy(update=changed)
    save_json(survey, root / SURVEY)
    _write_photographs(scene, root / "photos")
    measured = RemeasuredPoints(
        survey.check_points,
        error_in_geo=np.tile(ERROR_M, (CHECK_POINTS, 1)),
        rays=np.array([len(point.marks) for point in survey.check_points]),
        cov_in_geo=np.tile(np.diag(SIGMA_M) ** 2, (CHECK_POINTS, 1, 1)),
    )
    area_km2 = 0.0123
    photometric = {"psnr": 23.456789, "psnr_compensated": 24.0, "ssim": 0.81, "lpips": None}
    views = (ViewFigures(image=scene.names[2], **photometric),)
    report = report_with(
        triangulated=check_point_errors(measured, area_km2),
        surface=check_point_errors(replace(measured, cov_in_geo=None), area_km2),
        test={**photometric, "views": 1, "lpips_reason": "none", "per_view": views},
        cautions=(Remark(code="made-up", sentence=f"Nothing is real here {rename}."),),
    )
    (root / REPORT).parent.mkdir(parents=True)
    save_json(report, root / REPORT)
    (root / RENDERS).mkdir()
    pictures = [np.full((30, 40, 3), GREY, dtype=np.uint8)] * 3
    write_render(root / RENDERS, scene.names[2], labelled(pictures, ("photograph", "render", "difference")))
    metrics = [{"iteration": 10 * step, "psnr": 10.0 + step, "gaussians": 100 + step} for step in range(1, 5)]
    (root / METRICS).write_text("".join(json.dumps(row) + "\n" for row in metrics), "utf-8")
    return Evaluated(scene, workspace)


def _renamed(point: SurveyedPoint, text: str) -> SurveyedPoint:
    return point.model_copy(update={"name": f"{text}{point.name}"})


def _write_photographs(scene: TrueScene, folder: Path) -> None:
    """Write grey photographs with a white square of 5 px around each true mark of a surveyed point."""
    folder.mkdir()
    _, image, xy = scene.pixels(scene.gcp_in_geo)
    for index, name in enumerate(scene.names):
        picture = np.full((scene.camera.height, scene.camera.width, 3), GREY, dtype=np.uint8)
        for x, y in np.floor(xy[image == index]).astype(int):
            picture[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = 255
        cv2.imwrite(str(folder / name), picture)
